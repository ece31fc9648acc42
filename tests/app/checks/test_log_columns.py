"""Columns that could be read as other numbers without a word: dates, names, quotes, motions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin.datasets import load_log

N = 6
NAMES = {"q": ["a", "b", "c"], "x": ["X", "Y", "Z"]}
SECONDS = 86_400.0 * np.arange(N)
FIRST = 1_704_067_200.0  # 2024-01-01 in seconds since 1970
HEADER = "t,a,b,c,X,Y,Z,m\n"
ROWS = [f"{0.1 * i:.1f},{i}e-3,0,1e-3,0.0{i},.02,.1,{'u' if i < 4 else 'v'}\n" for i in range(8)]


def arrays(**changed):
    """The columns of a log, some of them changed."""
    numbers = 1e-3 * np.arange(float(6 * N)).reshape(6, N)
    motions = np.repeat(["u", "v"], N // 2)
    return {**dict(zip("abcXYZ", numbers, strict=True)), "t": np.arange(N), "m": motions, **changed}


def npz(folder, **changed):
    np.savez(folder / "log.npz", **arrays(**changed))
    return folder / "log.npz"


def parquet(folder, **changed):
    pd = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    pd.DataFrame(arrays(**changed)).to_parquet(folder / "log.parquet")
    return folder / "log.parquet"


def text(folder, *parts):
    (folder / "log.csv").write_text("".join(parts))
    return folder / "log.csv"


# dates and durations


@pytest.mark.parametrize("unit", ["ns", "ms", "s", "D"])
def test_dates_and_durations_are_seconds(tmp_path, unit):
    days = np.arange(N).astype("m8[D]").astype(f"m8[{unit}]")
    dates = (np.datetime64("2024-01-01") + days).astype(f"M8[{unit}]")
    for write in (npz, parquet) if unit != "D" else (npz,):
        assert_allclose(load_log(write(tmp_path, t=days), **NAMES, time="t").time, SECONDS)
        log = load_log(write(tmp_path, t=dates), **NAMES, time="t")
        assert_allclose(log.time, FIRST + SECONDS, rtol=1e-15)


def test_runs_are_a_column_of_their_own(tmp_path):
    runs = np.array(["a", "a", "a", "b", "nan", "b"])
    log = load_log(
        npz(tmp_path, r=runs), **NAMES, groups="m", runs="r", time="t", drop_invalid=True
    )
    assert log.runs.tolist() == ["a", "a", "a", "b", "b"]
    assert log.commands[3:].run_of_rows.tolist() == ["b", "b"]
    assert_array_equal(log.rows(slice(2, None)).commands.time, [2, 3, 5])
    assert load_log(npz(tmp_path), **NAMES, groups="m").commands.runs[-1] == "v"
    with pytest.raises(ValueError, match="`runs` must name each of 6 rows"):
        load_log(npz(tmp_path, r=np.array(["x" * 300] * N)), **NAMES, runs="r")


def test_a_missing_date_is_a_missing_value(tmp_path):
    dates = np.datetime64("2024-01-01") + np.arange(N).astype("m8[s]")
    dates[2] = "NaT"
    with pytest.raises(ValueError, match=r"1 of 6 rows .* missing.* \(row 2\)"):
        load_log(npz(tmp_path, t=dates), **NAMES, time="t")
    log = load_log(npz(tmp_path, t=dates), **NAMES, time="t", drop_invalid=True)
    assert_array_equal(log.time, FIRST + np.array([0, 1, 3, 4, 5]))


# a column has one use


@pytest.mark.parametrize(
    "use",
    [
        {"q": ["a", "b", "X"]},
        {"q": ["a", "b", "t"], "time": "t"},
        {"x": ["X", "Y", "t"], "time": "t"},
    ],
)
def test_a_column_is_used_once(tmp_path, use):
    for path in (text(tmp_path, HEADER, *ROWS), npz(tmp_path)):
        with pytest.raises(ValueError, match="must name a column once"):
            load_log(path, **{**NAMES, **use})


# the motion of every row


@pytest.mark.parametrize("missing", ["", "  ", "nan", "NaN", "None"])
def test_rows_without_a_motion_are_named(tmp_path, missing):
    path = text(tmp_path, HEADER, *(row.replace("u", missing) for row in ROWS))
    with pytest.raises(ValueError, match=r"4 of 8 rows .* no motion \(lines 2-5\); .*drop_invalid"):
        load_log(path, **NAMES, groups="m")
    log = load_log(path, **NAMES, groups="m", drop_invalid=True)
    assert log.groups.tolist() == ["v"] * 4
    assert log.invalid_lines.tolist() == [2, 3, 4, 5]
    assert len(load_log(path, **NAMES).q) == 8  # motions do not matter if they are not read


# quotes


@pytest.mark.parametrize(("at", "end", "cell"), [(1, None, 0), (2, 6, 3), (5, 7, 7), (6, 7, 0)])
def test_a_quote_that_hides_rows_is_noticed(tmp_path, at, end, cell):
    rows = [row.strip().split(",") for row in ROWS]
    rows[at][cell] = f'"{rows[at][cell]}'
    if end is not None and end > at:
        rows[end][-1] += '"'
    path = text(tmp_path, HEADER, *(",".join(row) + "\n" for row in rows))
    with pytest.raises(ValueError, match=rf"quote .* in line {at + 2} .* up to line \d|\d+ cells"):
        load_log(path, ["b", "c"], NAMES["x"])


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_cells_may_have_quotes_delimiters_and_line_breaks(tmp_path, newline):
    note = '"moved, base""s screw;\nand, more"'
    rows = [ROWS[0], ROWS[1].replace("u", note), "\n", *ROWS[2:]]
    content = HEADER.replace("m", '"m\n[name]"') + "".join(rows)
    (tmp_path / "log.csv").write_text(content.replace("\n", newline), newline="")
    log = load_log(tmp_path / "log.csv", **NAMES)
    assert_allclose(log.q[:, 0], 1e-3 * np.arange(8))
