import numpy as np
import pytest
from learners import (
    LEARNERS,
    compare_learners,
    learners_report,
    learning_sets,
    main,
    make_arm,
    time_learners,
)
from sklearn.dummy import DummyRegressor

QUICK = ("ELMRegressor", "ELMRegressorCV", "RidgeCV")


@pytest.fixture(scope="module")
def sets():
    return learning_sets(300)


@pytest.fixture(scope="module")
def table(sets):
    return compare_learners(sets, {name: LEARNERS[name] for name in QUICK}, n_folds=3)


@pytest.mark.slow
def test_one_entry_for_every_set_and_learner(sets, table):
    assert [(e["set"], e["learner"]) for e in table] == [(s, name) for s in sets for name in QUICK]
    for entry in table:
        assert (entry["n"], entry["n_inputs"]) == sets[entry["set"]][0].shape
        assert entry["n"] == (442 if entry["set"] == "diabetes" else 300)
        assert entry["seeds"] == [0, 1, 2]
        assert len(entry["rmse"]) == len(entry["seconds"]) == 3
        assert np.all(np.array(entry["rmse"]) > 0)


def test_the_choosing_elm_is_best_on_smooth_sets(table):
    mean = {(e["set"], e["learner"]): np.mean(e["rmse"]) for e in table}
    for name in {entry["set"] for entry in table} - {"diabetes"}:
        assert mean[name, "ELMRegressorCV"] < mean[name, "ELMRegressor"]
        assert mean[name, "ELMRegressorCV"] < mean[name, "RidgeCV"]


@pytest.mark.slow
def test_the_same_again_from_the_same_seed(sets, table):
    again = learning_sets(300)
    for name, (X, y) in sets.items():
        np.testing.assert_array_equal(again[name][0], X)
        np.testing.assert_array_equal(again[name][1], y)
    one = {"ELMRegressorCV": LEARNERS["ELMRegressorCV"]}
    repeated = compare_learners({"arm": again["arm"]}, one, n_folds=3)[0]
    first = next(e for e in table if (e["set"], e["learner"]) == ("arm", "ELMRegressorCV"))
    assert repeated["rmse"] == first["rmse"]
    other = compare_learners({"arm": again["arm"]}, one, n_folds=3, random_state=3)[0]
    assert other["seeds"] == [3, 4, 5]
    assert other["rmse"] != first["rmse"]


def test_every_learner_has_the_same_folds_and_each_row_is_held_out_once():
    rows = np.arange(60.0)[:, None]
    seen = {"a": [], "b": []}

    class Spy(DummyRegressor):
        def __init__(self, name):
            super().__init__()
            self.name = name

        def fit(self, X, y):
            self.rows_ = set(X[:, 0])
            return super().fit(X, y)

        def predict(self, X):
            assert not self.rows_ & set(X[:, 0])
            seen[self.name].append(X[:, 0].tolist())
            return np.zeros(len(X))

    spies = {name: lambda d, seed, name=name: Spy(name) for name in seen}
    a, b = compare_learners({"rows": (rows, rows[:, 0])}, spies, n_folds=4)
    assert seen["a"] == seen["b"]
    assert sorted(row for test in seen["a"] for row in test) == rows[:, 0].tolist()
    expected = [np.sqrt(np.mean(np.square(test))) for test in seen["a"]]
    assert a["rmse"] == b["rmse"] == pytest.approx(expected)


def test_error_of_several_outputs_is_a_distance():
    zero = {"zero": lambda d, seed: DummyRegressor(strategy="constant", constant=[0.0, 0.0])}
    data = {"plane": (np.zeros((6, 1)), np.tile([3.0, 4.0], (6, 1)))}
    assert compare_learners(data, zero, n_folds=2)[0]["rmse"] == pytest.approx([5.0, 5.0])


@pytest.mark.slow
def test_every_learner_of_the_table_fits():
    progress = []
    X, y = make_arm(60)
    table = compare_learners(
        {"arm": (X, np.stack([y, -y], axis=1))},
        n_folds=2,
        progress=lambda *step: progress.append(step),
    )
    assert [entry["learner"] for entry in table] == list(LEARNERS)
    assert np.isfinite([entry["rmse"] for entry in table]).all()
    assert progress[-1] == ("GP, ARD on arm", len(LEARNERS), len(LEARNERS))


def test_arm_of_more_rows_is_the_same_arm():
    (X, y), (few, y_few) = make_arm(4000), make_arm(100)
    np.testing.assert_array_equal(few, X[:100])
    assert np.abs(X).max() <= np.pi / 2
    noise = 0.1 * y.std()
    assert np.std(y[:100] - y_few) == pytest.approx(np.sqrt(2) * noise, rel=0.3)


@pytest.mark.slow
def test_the_speed_curve_stops_and_the_report_shows_all(tmp_path, table):
    def slow(d, seed):
        class Slow(DummyRegressor):
            def fit(self, X, y):
                sum(range(2_000_000))
                return super().fit(X, y)

        return Slow()

    learners = {"slow": slow, "ELMRegressorCV": LEARNERS["ELMRegressorCV"]}
    curve = time_learners({"slow": slow}, (20, 40), longest=1e-4, n_test=50)
    assert [entry["n"] for entry in curve] == [20]
    curve = time_learners(learners, (100, 400), n_test=200)
    assert [(e["learner"], e["n"]) for e in curve] == [(e, n) for e in learners for n in (100, 400)]
    assert curve[3]["rmse"] < curve[2]["rmse"] < curve[0]["rmse"]
    report = learners_report(table, curve)
    paths = {path.name for path in report.write(tmp_path / "learners")}
    assert paths == {"report.md", "report.json", "elm_speed.png"}
    text = (tmp_path / "learners" / "report.md").read_text()
    assert "| trunk, 300 x 9 | " in text
    assert text.count("**") == 2 * 6


@pytest.mark.slow
def test_runs_from_the_command_line(tmp_path, capsys):
    out = tmp_path / "results"
    options = ["--learners", "ELMRegressor", "RidgeCV", "--rows", "60"]
    main(["--out", str(out), *options])
    printed, shown = capsys.readouterr()
    assert str(out / "report.md") in printed.splitlines()
    assert "12/12 RidgeCV on trunk" in shown
    assert "arm, 60 x 8" in (out / "report.md").read_text()
