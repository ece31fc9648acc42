"""Tracks that miss points, whole counts, and what the last line and the exit code say of them."""

import csv

import numpy as np
import pytest
import torch
from simulated_log import COLUMNS, ROBOT, document, rows, run

import hybridkin
from hybridkin import Hysteresis, IKStatus, open_model, save_model
from hybridkin.app import workflow
from hybridkin.app.workflow import Counts
from hybridkin.app.workflow.domain import Domain
from hybridkin.app.workflow.model import domain_distance, tips_at
from hybridkin.app.workflow.track import LEAD_IN, Attempts, best_track

CHAIN = hybridkin.ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1])
PROMISE = {"at_rows": 1e-3, "per_distance": 0.0, "p95": 2.0}
EIGHT = ["--shape", "figure-eight", "--size", "20,10", "--duration", "2", "--dt", "0.05"]


def saved(home, hysteresis=0.0, **notes):
    """Return a folder with a model of a simulated log whose errors are those of PROMISE."""
    table = rows()
    q = -1e-3 * table[:, 1:7]
    moved = Hysteresis.backlash(hysteresis).apply_by_group(q, table[:, 10])
    with torch.no_grad():
        x = CHAIN(torch.from_numpy(moved)).numpy() + 5e-4 * np.sin(200 * moved[:, :3])
    model = hybridkin.HybridForwardModel(CHAIN, "quadratic", hysteresis=hysteresis)
    model.fit(q, x, groups=table[:, 10])
    (home / "robot.toml").write_text(ROBOT)
    held_out = {"hybrid": {"mean": 1e-3, "p95": 2e-3}}
    training = {"saved": "hybrid", "held_out": held_out, "promise": PROMISE, **notes}
    save_model(model, home / "model.safetensors", training=training)
    return home


@pytest.fixture(autouse=True)
def _without_figures(monkeypatch):
    for name in ("_add_path", "_add_commands"):
        monkeypatch.setattr(f"hybridkin.app.workflow.track.{name}", lambda *_: None)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("plain"), counts=vars(Counts([1.0] * 6, [0.0] * 6)))


@pytest.fixture(scope="module")
def playful(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("playful"), hysteresis=4e-4)


def line_to(home, end, n=21):
    """Write a path of n points from the middle of the tips along z, a share of them beyond."""
    loaded = open_model(home)
    tip = tips_at(loaded, Domain(loaded, workflow.path_limits(loaded)).preferred[None])[0]
    z = np.linspace(tip[2], tip[2] + end, n)
    points = [f"{0.1 * k},{1e3 * tip[0]},{1e3 * tip[1]},{1e3 * z[k]}" for k in range(n)]
    path = home / f"line_{end}.csv"
    path.write_text("t,x,y,z\n" + "\n".join(points) + "\n")
    return path


def table_of(folder):
    with open(folder / "track.csv", encoding="utf-8") as lines:
        table = [*csv.DictReader(lines)]
    return {name: np.array([row[name] for row in table]) for name in table[0]}


def numbers(table, names):
    return np.stack([table[name].astype(float) for name in names], axis=1)


def test_a_model_with_a_guard_prefers_the_median_of_its_log_in_the_compiled_core(home):
    loaded = open_model(home)
    domain = Domain(loaded, workflow.path_limits(loaded))
    q = loaded.fitted_module_.tested.rows.numpy()
    assert len(q) > 50
    median = np.median(q, axis=0) @ domain.bending
    np.testing.assert_allclose(domain.preferred, median, rtol=0, atol=1e-9)
    assert domain_distance(loaded, median[None])[0] <= 1.0
    ik = domain.solver()
    np.testing.assert_allclose(ik.settings.posture.numbers, domain.preferred, rtol=0, atol=1e-8)
    assert ik.tracker(domain.preferred).backend == hybridkin.native.backend(
        loaded.module_.tip_model
    )


@pytest.mark.slow
def test_a_promise_counts_the_points_that_are_missed(home, tmp_path, capsys):
    """Far beyond the reach the error to expect is the way that is left."""
    path = line_to(home, 0.1)
    command = ["track", home, path, "--unit", "mm", "--out", tmp_path / "t"]
    code, _, errors = run(capsys, *command)
    assert code == 2
    assert "--out-of-reach" in errors
    assert run(capsys, *command, "--force")[0] == 2
    code, printed, _ = run(capsys, *command, "--out-of-reach")
    assert code == 0
    code, record = document(capsys, *command, "--out-of-reach", "--fail-missed")
    assert code == 1
    table = table_of(tmp_path / "t")
    path_rows = table["status"] != LEAD_IN
    error = 1e-3 * table["error"][path_rows].astype(float)
    missed = ~np.isin(table["status"][path_rows], ("CONVERGED", "OUT_OF_DOMAIN"))
    assert record["missed"] == missed.sum() == record["n"] - record["reached"] > 10
    assert record["missed_by"] == pytest.approx(error[missed].max(), abs=1e-9)
    np.testing.assert_array_equal(missed, error > 1e-4)
    assert record["missed_by"] > 0.08
    assert record["expected"]["mean"] == pytest.approx(np.hypot(error, 1e-3).mean(), rel=1e-5)
    largest = np.quantile(np.hypot(error, 1e-3), 0.95)
    assert largest > np.hypot(error, 2e-3).mean()
    assert record["expected"]["p95"] == pytest.approx(largest, rel=1e-5)
    assert record["expected_inside"]["mean"] == pytest.approx(1e-3, rel=1e-3)
    last = " ".join(printed.split("\n\n")[-2].split())
    assert last.startswith(f"Reached: {record['reached']} of 21 points; missed: {missed.sum()}, by")
    assert f"{1e3 * record['missed_by']:.2g} mm. Expect" in last
    assert (
        "of the robot on this path, over all points, 1 mm at those reached inside the log" in last
    )


@pytest.mark.slow
def test_one_point_beyond_is_a_failure_only_if_asked(home, tmp_path, capsys):
    """The end of a path that is longer than the robot by a millimetre."""
    loaded = open_model(home)
    limits = workflow.path_limits(loaded)
    tip = tips_at(loaded, Domain(loaded, limits).preferred[None])[0]
    path = line_to(home, 0.0)
    lines = path.read_text().split()
    lines[-1] = f"2.0,{1e3 * tip[0]},{1e3 * tip[1]},{1e3 * (tip[2] + 0.002)}"
    path.write_text("\n".join(lines) + "\n")
    command = ["track", home, path, "--unit", "mm", "--out", tmp_path / "t"]
    code, record = document(capsys, *command)
    assert (code, record["reached"], record["missed"]) == (0, 20, 1)
    assert document(capsys, *command, "--fail-missed")[0] == 1


def test_progress_numbers_every_attempt_once():
    seen = []
    attempts = Attempts(lambda what, done, total: seen.append((what, done, total)))
    for total in (3, 1, 1000):
        for done in range(total):
            attempts(done, total)
    names = ["tracking", "tracking, attempt 2", "tracking, attempt 3"]
    assert [*dict.fromkeys(what for what, *_ in seen)] == names
    assert [end for end in seen if end[1] == end[2]] == [
        (names[0], 3, 3),
        (names[1], 1, 1),
        (names[2], 1000, 1000),
    ]
    assert len(seen) < 120


@pytest.mark.slow
@pytest.mark.parametrize("dq_max", [np.inf, 4e-3])
def test_errors_and_statuses_are_those_of_the_commands_alone(playful, dq_max):
    """Reversals between two points of a path are not in the file, so nothing may need them."""
    loaded = open_model(playful)
    limits = workflow.path_limits(loaded, dq_max=dq_max)
    domain = Domain(loaded, limits)
    size = (0.03, 0.015)
    path = workflow.shape_path(loaded, limits, "figure-eight", size, duration=4.0, dt=0.2)
    track = best_track(domain, path, 1e-4, Attempts(lambda *_: None))
    effective, _ = Hysteresis.backlash(4e-4).apply(track.q)
    np.testing.assert_allclose(track.effective, effective, rtol=0, atol=1e-15)
    error = np.linalg.norm(tips_at(loaded, effective) - path.x, axis=1)
    np.testing.assert_allclose(track.error, error, rtol=0, atol=1e-12)
    reached = np.isin(track.status, (IKStatus.CONVERGED, IKStatus.OUT_OF_DOMAIN))
    np.testing.assert_array_equal(reached, error <= 1e-4)
    if np.isinf(dq_max):
        assert reached.all()
    else:
        assert np.abs(np.diff(track.q, axis=0)).max() <= dq_max * 0.2 * (1 + 1e-9)


@pytest.mark.parametrize(
    ("column", "step", "zero"),
    [
        ([0.0, 1.0, 5.0], 1.0, 0.0),
        ([12.0, 4.0, 8.0], 4.0, 0.0),
        ([100.0, 103.0, 107.0], 1.0, 0.0),  # no spacing of 3, on which 107 would not lie
        ([-7.0, 3.0, 13.0], 10.0, 3.0),
        ([0.0, 1.5, 3.0], 0.0, 0.0),
        ([2.0, 2.0, 2.0], 0.0, 0.0),  # it does not move
        ([0.0, 1e300, 2e300], 0.0, 0.0),
    ],
)
def test_steps_of_a_column(column, step, zero):
    counts = Counts.of_log(np.array([column]).T)
    assert (counts.steps, counts.zeros) == ([step], [zero])
    numbers = np.linspace(-50.0, 50.0, 401)[:, None]
    rounded = counts.rounded(numbers, np.array([-20.3]), np.array([20.3]))
    if step == 0.0:
        np.testing.assert_array_equal(rounded, numbers)
        return
    assert not ((rounded - zero) % step).any()
    assert np.abs(rounded).max() <= 20.3
    inside = np.abs(numbers) <= 20.3 - step
    assert np.abs(rounded - numbers)[inside].max() <= 0.5 * step


@pytest.mark.slow
@pytest.mark.parametrize("model", ["home", "playful"])
def test_rounded_commands_are_whole_and_say_what_it_costs(model, request, tmp_path, capsys):
    folder = request.getfixturevalue(model)
    command = ["track", folder, *EIGHT, "--tol", 1, "--out", tmp_path / "t"]
    exact = document(capsys, *command)[1]
    assert exact["rounded"] is None
    hint = "hold whole numbers; these commands are not rounded: --round."
    printed = (tmp_path / "t" / "report.md").read_text()
    assert (hint in " ".join(printed.split())) is (model == "home")
    step = 0.05  # mm
    code, record = document(capsys, *command, "--round", step)
    assert code == 0
    printed = (tmp_path / "t" / "report.md").read_text()
    table = table_of(tmp_path / "t")
    q = numbers(table, COLUMNS)
    np.testing.assert_allclose(q / step, np.rint(q / step), rtol=0, atol=1e-9)
    loaded = open_model(folder)
    tips = 1e3 * loaded.predict(-1e-3 * q)
    np.testing.assert_allclose(tips, numbers(table, "xyz"), atol=1e-5)
    on_path = table["status"] != LEAD_IN
    after = 1e-3 * table["error"][on_path].astype(float).mean()
    assert record["rounded"]["after"] == pytest.approx(after, abs=1e-9)
    assert record["rounded"]["before"] == pytest.approx(exact["errors"]["mean"], rel=1e-9)
    assert record["rounded"]["after"] > 10 * record["rounded"]["before"]
    assert f"{1e3 * after:.3g} mm after" in " ".join(printed.split())


@pytest.mark.slow
def test_counts_of_the_log_are_written_as_integers(home, playful, tmp_path, capsys):
    """One count is a millimetre here, and all that the robot can do is within the rounding."""
    command = ["track", home, *EIGHT, "--round", "--out", tmp_path / "t"]
    code, record = document(capsys, *command)
    assert record["missed"] == 0
    assert code == 1  # commands so coarse leave the log
    assert record["in_domain"] < 0.8
    assert record["rounded"]["n"] > 30
    assert record["rounded"]["largest"] > 1e-3
    assert record["expected"]["mean"] > record["rounded"]["after"]
    printed = " ".join((tmp_path / "t" / "report.md").read_text().split())
    assert f"{record['rounded']['n']} points are reached within this rounding alone" in printed
    table = table_of(tmp_path / "t")
    for name in COLUMNS:
        assert all(str(int(text)) == text for text in table[name])
    code, _, errors = run(capsys, "track", playful, *EIGHT, "--round", "--out", tmp_path / "u")
    assert code == 2
    assert "--round 1" in errors
