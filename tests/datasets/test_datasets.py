import json
import sys

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import least_squares

from hybridkin import ConstantCurvatureChain
from hybridkin.datasets import (
    Log,
    check_log,
    load_armlab,
    load_asl_trunk,
    load_ftdcr,
    load_log,
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
    q, x = map(torch.as_tensor, load_trunk(return_X_y=True))

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


def test_csv_invalid_rows_are_counted_or_dropped(log):
    rows = "0,r,1,1,1,1,1,1\n0,r,nan,1,1,1,1,1\n0,r,1,1,1,1,,1\n0,r,1,1,1,inf,1,1\n0,r,1,1,1\n"
    path = log(HEADER + rows)
    with pytest.raises(ValueError, match=r"4 of 5 rows .* .lines 3-6.; .*drop_invalid=True"):
        load_log(path, **COLUMNS)
    data = load_log(path, **COLUMNS, groups="run", drop_invalid=True)
    assert data.q.shape == (1, 3)
    assert data.line.tolist() == [2]
    assert data.groups.tolist() == ["r"]
    path = log(HEADER + "0,r,nan,1,1,1,1,1\n")
    with pytest.raises(ValueError, match=r"1 of 1 rows .* if others are left"):
        load_log(path, **COLUMNS, drop_invalid=True)


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        (HEADER + "0,r,1,x1,1,1,1,1\n", {}, r"Line 2 .* column 'b': .* got 'x1'"),
        (HEADER + "0,r,1,1,1,1,1,1,9\n", {}, "9 cells, the header 8"),
        (HEADER, {}, "no rows"),
        ("", {}, "is empty"),
        (HEADER, {"x": ["x", "Y", "Z"]}, "did you mean 'X'"),
        (HEADER + "0,r,1,1,1,1,1,1\n", {"groups": "runs"}, "did you mean 'run'"),
        (HEADER.replace(",", ";"), {"delimiter": ","}, "check `delimiter`"),
        ("a,a,b,c,X,Y,Z\n", {}, "'a' occurs 2 times"),
        (HEADER, {"x": ["X", "Y"]}, "3 columns"),
        (HEADER, {"q": []}, "column names"),
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
        ({"q": np.ones((3, 3)), "x": np.ones((2, 3))}, "equally long"),
        ({"q": np.ones((3, 3)), "tip": np.ones((3, 3))}, "no column 'x'"),
        ({"q": np.full((3, 3), "a"), "x": np.ones((3, 3))}, "must hold numbers"),
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


# what is wrong with a log


def tendon_log(n_motions=8, n=30, **truth):
    """A simulated log of a robot of two segments, without noise but for the tracker's."""
    rng = np.random.default_rng(0)
    chain = ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1], **truth)
    u = np.stack([np.cos(np.arange(3) * 2 * np.pi / 3), np.sin(np.arange(3) * 2 * np.pi / 3)])
    q = []
    for _ in range(n_motions):
        first, second = (0.003 * (rng.standard_normal((2, 2)) @ u).ravel() for _ in range(2))
        s = np.linspace(0.0, 4.0, n)[:, None]
        q.append(np.sin(s) * first + 0.5 * np.sin(2 * s) * second)
    q = np.concatenate(q)
    x = chain(torch.from_numpy(q)).numpy() + 1e-5 * rng.standard_normal((len(q), 3))
    time = np.linspace(0.0, 24.0, len(q))
    return {"q": q, "x": x, "groups": np.repeat(np.arange(n_motions), n), "time": time}


CHAIN = ConstantCurvatureChain([0.0055, 0.0055], lengths=[0.11, 0.09])


def found(log, **options):
    return {(f.kind, f.severity): f for f in check_log(Log(**log), **options).findings}


def test_a_clean_log_passes():
    report = check_log(Log(**tendon_log()), chain=CHAIN)
    (balance,) = report.findings  # what the log cannot show is no fault
    assert (balance.kind, balance.severity) == ("no motion", "note")
    assert "along +1 q[0] +1 q[1] +1 q[2]; +1 q[3] +1 q[4] +1 q[5], or only" in balance.message
    assert report.ok
    assert "240 rows, 8 motions, 6 actuators, 24 s" in str(report)
    assert "no errors and no warnings" in str(report)


@pytest.mark.parametrize(
    ("column", "severity", "what"),
    [("x", "error", "the tip"), ("x[1]", "warning", "'x[1]'"), ("q[4]", "warning", "'q[4]'")],
)
def test_frozen_sensors(column, severity, what):
    log = tendon_log()
    values = log[column[0]]
    if len(column) > 1:
        values = values[:, int(column[2])]
    values[70:85] = values[70]
    kind = "frozen tip" if column[0] == "x" else "frozen actuator"
    finding = found(log)[kind, severity]
    assert finding.rows.tolist() == [*range(70, 85)]
    assert what in finding.message
    assert "rows 70-84" in finding.message


def test_a_tip_at_rest_is_not_frozen():
    log = tendon_log()
    log["q"][70:85], log["x"][70:85] = log["q"][70], log["x"][70]
    assert not any(kind == "frozen tip" for kind, _ in found(log))


def test_invalid_rows():
    log = tendon_log()
    log["x"][[3, 4, 90], 2] = np.nan
    log["q"][10, 0] = np.inf
    finding = found(log)["invalid", "error"]
    assert "4 of 240 rows" in finding.message
    assert "rows 3-4, 10, 90" in finding.message
    assert finding.rows.tolist() == [3, 4, 10, 90]


def test_columns_that_never_change():
    log = tendon_log()
    log["q"][:, 2] = 0.001
    log["x"][:, 0] = 0.0
    report = check_log(Log(**log))
    messages = [f.message for f in report.warnings if f.kind == "constant"]
    assert len(messages) == 2
    assert "never move: 'q[2]'" in messages[0]
    assert "never change: 'x[0]'" in messages[1]
    log["x"][:] = 0.0
    assert ("constant", "error") in found(log)


def test_duplicates_and_same_commands():
    log = tendon_log()
    for name in ("q", "x"):
        log[name][200:203] = log[name][20:23]
    finding = found(log)["duplicates", "warning"]
    assert finding.rows.tolist() == [200, 201, 202]
    assert "3 of them in another motion" in finding.message
    log = tendon_log()
    log["q"][120:], log["x"][120:] = log["q"][:120], log["x"][:120] + np.array([3e-4, 0, 0])
    finding = found(log)["same command", "note"]
    assert "differ by 0.21 mm rms" in finding.message  # 0.3 / sqrt(2), and all start at 0


def test_jumps():
    log = tendon_log()
    log["x"][100] += [0.15, 0.0, 0.0]
    finding = found(log)["jumps", "warning"]
    assert finding.rows.tolist() == [100, 101]
    assert "soft_l1" in finding.advice


def test_times():
    log = tendon_log()
    log["time"][100:] += 5.0
    log["time"][[40, 41]] = log["time"][[41, 40]]
    messages = [f.message for f in check_log(Log(**log)).warnings]
    assert "do not increase at 1 rows (row 41)" in messages[0]
    assert "1 gaps in time within a motion, up to 5.1 s" in messages[1]
    assert "(row 100)" in messages[1]


def test_motions():
    log = tendon_log()
    assert "--groups" in found({**log, "groups": None})["motions", "warning"].advice
    few = found({**log, "groups": np.arange(240) // 100})["motions", "warning"]
    assert "only 3 motions" in few.message
    alone = found({**log, "groups": np.arange(240)})["motions", "warning"]
    assert "random split" in alone.message
    assert ("rows", "warning") in found({name: value[:20] for name, value in log.items()})


@pytest.mark.parametrize(
    ("q", "x", "units", "advice"),
    [
        (1e3, 1e3, {"q": "m", "x": "m"}, ['q_unit = "mm"', 'x_unit = "mm"']),
        (1e2, 1.0, {"q": "m", "x": "mm"}, ['q_unit = "cm"']),
        (1.0, 1e3, {"q": "mm", "x": "m"}, ['x_unit = "mm"']),
        (1e-3, 1e-3, {"q": "mm", "x": "mm"}, ['q_unit = "m"', 'x_unit = "m"']),
        (1.0, 1e-2, {"q": "mm", "x": "mm"}, ["`x_unit`"]),
    ],
)
def test_units_that_cannot_be(q, x, units, advice):
    log = tendon_log()
    log |= {"q": q * log["q"], "x": x * log["x"], "file_units": units}
    report = check_log(Log(**log), chain=CHAIN)
    assert [f.kind for f in report.errors] == ["units"] * len(advice)
    for finding, wanted in zip(report.errors, advice, strict=True):
        assert wanted in finding.advice


def test_logs_in_counts_are_checked_in_metres():
    gains = np.array([2e-5, -3e-5, 2.5e-5, 1e-5, 4e-5, 2e-5])
    zeros = torch.full((6,), 512.0, dtype=torch.float64)
    chain = CHAIN.with_geometry(gains=torch.from_numpy(gains), actuator_zeros=zeros)
    log, units = tendon_log(), {"q": "1", "x": "m"}

    def findings(sign):
        counts = {**log, "q": sign * log["q"] / gains + 512, "units": units}
        metres = {**log, "q": sign * log["q"]}
        pair = (check_log(Log(**counts), chain=chain), check_log(Log(**metres), chain=CHAIN))
        # What did not move is named in the unit of the log.
        return [[f.message for f in r.findings if f.kind != "no motion"] for r in pair]

    assert findings(1.0)[0] == findings(1.0)[1]
    found, wanted = findings(-1.0)
    assert found == wanted
    assert any("sign of q flipped" in message for message in found)


def test_a_wrong_sign_is_told():
    log = tendon_log()
    flipped = {**log, "q": -log["q"]}
    finding = found(flipped, chain=CHAIN, base_is_free=False)["sign", "warning"]
    assert "set q_sign = -1" in finding.advice
    # A half turn of a free base makes up for it where all tendons are taut.
    turned = found(flipped, chain=CHAIN)["sign", "warning"]
    assert "rotated by" in turned.message
    assert "set q_sign = -1" in turned.advice
    mounted = CHAIN.with_geometry(base=torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]).double()))
    assert [*found(flipped, chain=mounted)] == [("no motion", "note")]
    released = {**log, "q": np.abs(log["q"])}
    assert "only lengthened" in found(released, chain=CHAIN)["sign", "warning"].message


@pytest.mark.parametrize("base_is_free", [True, False])
def test_clockwise_numbering_is_told(base_is_free):
    turned = np.negative([2 * np.pi / 3 * np.arange(3)] * 2)
    log = tendon_log(angles=turned)
    finding = found(log, chain=CHAIN, base_is_free=base_is_free)["numbering", "warning"]
    assert "clockwise = true" in finding.advice
    assert check_log(Log(**tendon_log()), chain=CHAIN, base_is_free=base_is_free).ok


def test_a_report_is_json(log):
    data = load_log(
        log(HEADER + "0,r,1,2,3,1,2,3\n1,r,1,nan,3,1,2,3\n"), **COLUMNS, drop_invalid=True
    )
    record = json.loads(json.dumps(check_log(data).to_dict()))
    assert record["n_rows"] == 1
    assert any("(line 3)" in finding["message"] for finding in record["findings"])


# recordings of real robots


@pytest.mark.parametrize("load", [load_ftdcr, load_armlab, load_asl_trunk])
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


def test_a_log_shows_a_summary():
    x = np.array([[0.0, 0.0, 1.0], [0.03, np.nan, 1.2]])
    names = {"q_names": ("left", "right"), "source": "log.csv"}
    log = Log(np.array([[0.1, 0.2], [0.15, 0.3]]), x, ["a", "b"], np.array([2.0, 4.5]), **names)
    assert str(log).splitlines() == [
        "Log of log.csv: 2 rows, 2 motions",
        "  2 actuators: left, right; 0.1 to 0.3 m",
        "  tips within 0.03 x 0 x 0.2 m",
        "  time from 2 to 4.5 s",
    ]
