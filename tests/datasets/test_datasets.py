import sys

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import least_squares

from hybridkin import ConstantCurvatureChain
from hybridkin.datasets import (
    Log,
    load_armlab,
    load_asl_trunk,
    load_asu_bellows,
    load_ftdcr,
    load_log,
    load_soromox_tentacle,
    load_trunk,
    paper_split,
)

# the shipped data


def test_shipped_data_say_what_they_are():
    data = load_trunk()
    assert data.q.shape == data.q_target.shape == (2000, 9)
    assert np.bincount(data.part).tolist() == [500, 500, 500, 500]
    noise = data.q - data.q_target
    assert_allclose(noise.std(axis=0), 1e-3, rtol=0.1)
    assert_allclose(noise.mean(axis=0), 0, atol=1e-4)
    assert np.isfinite(data.x).all()
    assert "simulated" in data.DESCR


def test_shipped_data_break_constant_curvature_as_the_papers_trunk_does():
    data = load_trunk()
    q, x = torch.from_numpy(data.q), torch.from_numpy(data.x)

    def error(radii):
        return (ConstantCurvatureChain(radii)(q) - x).numpy()

    radii = least_squares(lambda r: error(r).ravel(), [0.1, 0.093, 0.079]).x
    distance = np.linalg.norm(error(radii), axis=1)
    assert 0.02 < distance.mean() < 0.03  # paper: 0.025
    assert 0.07 < distance.max() < 0.12  # paper: 0.093


def test_paper_split():
    data = load_trunk()
    train, test = paper_split(data, random_state=0)
    assert_array_equal(np.sort(np.concatenate([train, test])), np.arange(2000))
    assert (data.part[test] == 3).all()
    assert len(test) == 100
    assert_array_equal(paper_split(data.part, 0)[1], test)
    assert (paper_split(data, random_state=1)[1] != test).any()


# CSV logs


@pytest.fixture
def log(tmp_path):
    def write(text, name="log.csv", encoding="utf-8"):
        path = tmp_path / name
        path.write_text(text, encoding=encoding)
        return path

    return write


HEADER = "time,run,a,b,c,X,Y,Z\n"
COLUMNS = {"q": ["a", "b", "c"], "x": ["X", "Y", "Z"]}


def test_csv_reads_units_signs_groups_and_time(log):
    """Also with a byte order mark, blanks and an empty line."""
    text = HEADER + " 0.5,one,1,2,3,10,20,30\n\n1.5,two,4,5,6,40,50,60\n"
    path = log(text, encoding="utf-8-sig")
    options = {"groups": "run", "time": "time", "x_unit": "mm"}
    data = load_log(path, **COLUMNS, **options, q_unit="cm", q_sign=[-1, 1, 1])
    assert_allclose(data.q, [[-0.01, 0.02, 0.03], [-0.04, 0.05, 0.06]])
    assert_allclose(data.x, [[0.01, 0.02, 0.03], [0.04, 0.05, 0.06]])
    assert data.groups.tolist() == ["one", "two"]
    assert data.time.tolist() == [0.5, 1.5]
    assert data.line.tolist() == [2, 4]
    assert data.units == {"q": "m", "x": "m"}
    assert_allclose(
        load_log(path, **COLUMNS, q_unit="deg", x_unit="mm").q[0], np.radians([1, 2, 3])
    )
    counts = load_log(path, **COLUMNS, q_unit="1", x_unit="mm")
    assert_allclose(counts.q[0], [1, 2, 3])
    assert counts.units["q"] == "1"


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        (HEADER + "0,r,1,x1,1,1,1,1\n", {}, r"Line 2 .* column 'b': .* got 'x1'"),
        (HEADER + "0,r,1,1,1,1,1,1,9\n", {}, "names 8 columns, but line 2 has 9 cells"),
        (HEADER, {}, "no rows"),
        ("", {}, "is empty"),
        (HEADER, {"x": ["x", "Y", "Z"]}, "did you mean 'X'"),
        (HEADER + "0,r,1,1,1,1,1,1\n", {"groups": "runs"}, "did you mean 'run'"),
        (HEADER, {"x": ["X", "Y"]}, "3 columns"),
        (HEADER, {"q": ["a", "a"]}, "twice"),
        (HEADER, {"q_unit": "kPa"}, "give '1', and `gains`"),
        (HEADER, {"x_unit": "deg"}, "`x_unit` must be one of"),
        (HEADER, {"q_sign": [1, -1]}, "`q_sign` must be 1 or -1"),
    ],
)
def test_csv_errors(log, text, arguments, message):
    with pytest.raises(ValueError, match=message):
        load_log(log(text), **{**COLUMNS, **arguments})


def test_logs_of_every_format_hold_the_same(tmp_path):
    pd = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    table = np.arange(24.0).reshape(4, 6) + 0.5
    runs = np.array(["one", "one", "two", "two"])
    text = "".join(
        f"{';'.join(map(str, row))};{run}\n" for row, run in zip(table, runs, strict=True)
    )
    (tmp_path / "log.csv").write_text("a;b;c;X;Y;Z;run\n" + text)
    np.savez(tmp_path / "log.npz", pulls=table[:, :3], X=table[:, 3], YZ=table[:, 4:], run=runs)
    frame = pd.DataFrame(table, columns=[*"abcXYZ"]).assign(run=runs)
    frame.to_parquet(tmp_path / "log.parquet")
    options = {"q_unit": "mm", "x_unit": "mm", "q_sign": -1}
    csv = load_log(tmp_path / "log.csv", [*"abc"], [*"XYZ"], "run", **options)
    assert_allclose(csv.q, -1e-3 * table[:, :3])
    parquet = load_log(tmp_path / "log.parquet", [*"abc"], [*"XYZ"], "run", **options)
    npz = load_log(tmp_path / "log.npz", "pulls", ["X", "YZ"], "run", **options)
    assert npz.q_names == ["pulls[0]", "pulls[1]", "pulls[2]"]
    assert npz.x_names == ["X", "YZ[0]", "YZ[1]"]
    for other in (parquet, npz):
        assert_array_equal(other.q, csv.q)
        assert_array_equal(other.x, csv.x)
        assert other.groups.tolist() == csv.groups.tolist() == runs.tolist()
        assert other.line.tolist() == [0, 1, 2, 3]
    swapped = load_log(
        tmp_path / "log.npz", ["pulls[2]", "pulls[0]"], ["X", "YZ"], q_unit="1", x_unit="mm"
    )
    assert_array_equal(swapped.q, table[:, [2, 0]])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"q": np.ones((3, 3)), "tip": np.ones((3, 3))}, "no column 'x'"),
        ({"q": np.ones((0, 3)), "x": np.ones((0, 3))}, "has no rows"),
        ({"q": np.full((3, 3), None), "x": np.ones((3, 3))}, "not an npz file"),
        ({"q": np.ones((3, 20_000)), "x": np.ones((3, 3))}, "transpose"),
    ],
)
def test_npz_errors(tmp_path, arrays, message):
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(ValueError, match=message):
        load_log(tmp_path / "log.npz", ["q"], ["x"])


def test_files_that_are_no_logs_raise(tmp_path, monkeypatch):
    for name in ("log.npz", "log.csv", "log.parquet"):
        (tmp_path / name).write_bytes(b"\xff\x00PAR1 no log")
        monkeypatch.setitem(sys.modules, "pandas", None)  # not installed
        expected = ImportError if name == "log.parquet" else ValueError
        with pytest.raises(expected, match=name):
            load_log(tmp_path / name, ["q"], ["x", "y", "z"])
    with pytest.raises(FileNotFoundError):
        load_log(tmp_path / "absent.npz", ["q"], ["x"])


# recordings of real robots


_RECORDINGS = [load_ftdcr, load_armlab, load_asl_trunk, load_asu_bellows, load_soromox_tentacle]


@pytest.mark.parametrize("load", _RECORDINGS)
def test_absent_recordings_name_their_source(load, tmp_path, monkeypatch):
    monkeypatch.delenv("HYBRIDKIN_DATA", raising=False)
    with pytest.raises(FileNotFoundError, match="github"):
        load()
    monkeypatch.setenv("HYBRIDKIN_DATA", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="there is no"):
        load()


def test_ftdcr(data_home):
    data = load_ftdcr(data_home)
    assert data.q.shape == (1620, 9)
    assert not any(label.endswith("_hold") for label in data.groups)
    # Pulled is shortened; the first motion pulls the first tendon.
    first = data.groups == "rep1_tendon0_id4_pull"
    assert data.q[first].min() == data.q[first, 0].min() < -0.003
    assert 0.15 < np.median(np.linalg.norm(data.x, axis=1)) < 0.25
    assert (np.diff(data.time) > 0).all()
    pulls = load_ftdcr(data_home, subset="tendon_pull")
    assert_array_equal(pulls.q, data.q[: len(pulls.q)])


def test_armlab_and_asl_trunk(data_home):
    data = load_armlab(data_home)
    assert data.q.shape == (24019, 3)
    assert (data.q.max(), data.q.min()) == (0.0, -0.01)
    # A line holds one coordinate of the raster.
    for group in (0, 50, 101, 150):
        column = 1 if group <= 100 else 0
        assert len(np.unique(data.q[data.groups == group, column])) == 1
    trunk = load_asl_trunk(data_home)
    assert trunk.q.shape == (2170, 6)
    assert_array_equal(trunk.x, trunk.disks[:, 2])
    assert set(trunk.groups) <= set(range(len(trunk.run_names)))


def test_asu_bellows(data_home):
    data = load_asu_bellows(data_home)
    assert data.q.shape == data.q_command.shape == (8956, 6)
    for run in np.unique(data.groups):
        rows = data.groups == run
        assert (np.diff(data.time[rows]) > 0).all()
        assert {data.run_names[run].split("__")[0]} == set(data.day[rows])
    # The tip hangs at the length of the arm; pressures follow their commands.
    assert 0.2 < np.median(np.linalg.norm(data.x, axis=1)) < 0.4
    assert np.median(np.abs(data.q - data.q_command)) < 0.1 * np.ptp(data.q_command)


def test_soromox_tentacle(data_home):
    data = load_soromox_tentacle(data_home)
    assert data.q.shape == (22, 2)
    assert data.x.shape == (22, 12)
    assert len(set(data.groups)) == 22
    # One tendon pulls to one side, the other one to the other.
    single = (data.q == 0).any(axis=1)
    assert_array_equal(np.sign(data.x[single, -1]), np.sign(data.q @ [1, -1])[single])


def test_a_log_shows_a_summary():
    x = np.array([[0.0, 0.0, 1.0], [0.03, np.nan, 1.2]])
    names = {"q_names": ("left", "right"), "source": "log.csv"}
    log = Log(np.array([[0.1, 0.2], [0.15, 0.3]]), x, ["a", "b"], np.array([2.0, 4.5]), **names)
    assert str(log).splitlines() == [
        "Log of log.csv: 2 rows, 2 motions",
        "  2 actuators: left, right; 0.1 to 0.3 m",
        "  tips within 0.03 x 0 x 0.2 m",
        "  time from 2 to 4.5 s: 2.5 s",
    ]
