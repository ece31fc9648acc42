"""Data frames of pandas, polars and pyarrow give the log that a file gives."""

import datetime
import inspect

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin import robots
from hybridkin.datasets import Log, load_log

N = 8
START = datetime.datetime(2024, 5, 3, tzinfo=datetime.timezone.utc)
NAMES = {"q": ["a", "b", "c"], "x": ["X", "Y", "Z"], "groups": "m", "q_unit": "mm"}
UNITS = {"x_unit": "cm", "q_sign": [1, -1, 1]}


def columns(seed=0):
    rng = np.random.default_rng(seed)
    table = {name: rng.normal(size=N).round(4) for name in "abcXYZ"}
    table["a"] = rng.integers(-20, 20, size=N)
    return {**table, "m": np.repeat(["u", "v"], N // 2), "t": 0.1 * np.arange(N)}


LIBRARIES = {
    "pandas": lambda: pytest.importorskip("pandas"),
    "polars": lambda: pytest.importorskip("polars"),
    "pyarrow": lambda: pytest.importorskip("pyarrow"),
}


def frame_of(library, table):
    module = LIBRARIES[library]()
    if library == "pyarrow":
        return module.table(table)
    return module.DataFrame(table)


@pytest.fixture(params=[*LIBRARIES])
def library(request):
    LIBRARIES[request.param]()
    return request.param


@pytest.mark.parametrize("seed", range(5))
def test_a_frame_gives_the_log_of_a_file(tmp_path, library, seed):
    table = columns(seed)
    lines = [",".join(table)]
    lines += [",".join(map(str, row)) for row in zip(*table.values(), strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    expected = load_log(tmp_path / "log.csv", **NAMES, **UNITS, time="t")
    log = Log.from_frame(frame_of(library, table), **NAMES, **UNITS, time="t")
    for name in ("q", "x", "groups", "time"):
        assert_array_equal(getattr(log, name), getattr(expected, name))
    assert (log.units, log.file_units) == (expected.units, expected.file_units)
    assert log.line.tolist() == [*range(N)]


def test_null_is_missing(library):
    table = {name: list(column) for name, column in columns().items()}
    table["a"] = [*map(int, table["a"])]
    table["a"][1] = None
    table["Y"][3] = None
    table["m"] = [*map(str, table["m"])]
    table["m"][6] = None
    frame = frame_of(library, table)
    if library == "pandas":
        frame = frame.convert_dtypes()
        assert str(frame["a"].dtype) == "Int64"
    with pytest.raises(ValueError, match=r"3 of 8 rows of 'data frame' .*\(rows 1, 3, 6\)"):
        Log.from_frame(frame, **NAMES)
    log = Log.from_frame(frame, **NAMES, drop_invalid=True)
    assert log.invalid_lines.tolist() == [1, 3, 6]
    assert log.groups.tolist() == [*"uu", *"vvv"]


@pytest.mark.parametrize("zone", [None, datetime.timezone.utc])
def test_dates_are_seconds(library, zone):
    start = START.replace(tzinfo=zone)
    times = [start + datetime.timedelta(seconds=0.5 * k) for k in range(N)]
    frame = frame_of(library, {**columns(), "t": times})
    log = Log.from_frame(frame, **NAMES, time="t")
    assert_allclose(log.time, START.timestamp() + 0.5 * np.arange(N), rtol=1e-15)
    with pytest.raises(ValueError, match="Column 't' of 'data frame' must hold numbers"):
        Log.from_frame(frame, q=["t"], x=NAMES["x"])


def test_categories_are_motions():
    pd = pytest.importorskip("pandas", reason="needs pandas")
    frame = pd.DataFrame(columns())
    frame["m"] = frame["m"].astype("category")
    assert Log.from_frame(frame, **NAMES).groups.tolist() == [*"uuuuvvvv"]
    pl = pytest.importorskip("polars", reason="needs polars")
    frame = pl.DataFrame(columns()).with_columns(pl.col("m").cast(pl.Categorical))
    assert Log.from_frame(frame, **NAMES).groups.tolist() == [*"uuuuvvvv"]


def test_frames_of_narwhals():
    nw = pytest.importorskip("narwhals", reason="needs narwhals")
    frame = frame_of("pandas", columns())
    log = Log.from_frame(nw.from_native(frame), **NAMES)
    assert_array_equal(log.q, Log.from_frame(frame, **NAMES).q)


def test_names_that_occur_twice_or_are_no_text():
    pd = pytest.importorskip("pandas", reason="needs pandas")
    frame = pd.DataFrame(columns())
    frame.columns = ["a", "a", "c", "X", "Y", "Z", "m", 0]
    with pytest.raises(ValueError, match="Column 'a' occurs 2 times"):
        Log.from_frame(frame, **NAMES)
    log = Log.from_frame(frame, q=["c"], x=NAMES["x"], time="0")
    assert_allclose(log.time, 0.1 * np.arange(N))


@pytest.mark.parametrize("wrong", [None, 3, np.zeros((3, 6)), "log.csv", {"a": [1]}])
def test_what_is_no_frame_is_refused(wrong):
    with pytest.raises(TypeError, match="`df` must be a data frame"):
        Log.from_frame(wrong, **NAMES)


def test_frames_are_not_changed(library):
    table = columns()
    table["X"][2] = 9999.0
    frame = frame_of(library, table)
    log = Log.from_frame(frame, **NAMES, missing=[9999.0], drop_invalid=True)
    assert log.invalid_lines.tolist() == [2]
    assert np.asarray(frame["X"])[2] == 9999.0


def test_an_argument_of_reading_is_one_of_all_that_read():
    """A file, a data frame, and the format of a robot's logs have the same ones."""
    path, *of_file = inspect.signature(load_log).parameters.values()
    frame, *of_frame = inspect.signature(Log.from_frame).parameters.values()
    assert (path.name, frame.name) == ("path", "df")
    assert of_file == of_frame
    of_format = inspect.signature(robots.LogFormat).parameters.values()
    assert [one for one in of_format if one.name != "group_suffix"] == of_file
    with pytest.raises(TypeError, match=r"^load_log\(\) got an unexpected keyword argument 'unit'"):
        load_log("log.csv", ["a"], ["X", "Y", "Z"], unit="mm")
    with pytest.raises(TypeError, match=r"^from_frame\(\) missing a required argument: 'x'"):
        Log.from_frame(columns(), ["a"])
