"""Times of logs: their unit in a file, and what cannot be seconds."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hybridkin import Commands, ConstantCurvatureChain, HybridForwardModel
from hybridkin._core.clock import clock_doubt
from hybridkin._core.units import duration_in_words
from hybridkin.app import check_log
from hybridkin.datasets import Log, load_log

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
START = 1_700_000_000.0  # [s] since 1970


def written(path, time):
    rng = np.random.default_rng(0)
    q, x = rng.uniform(0.2, 0.3, (2, len(time), 3))
    np.savez(path, q=q, x=x, t=time)
    return {"q": ["q"], "x": ["x"], "time": "t"}


@pytest.mark.parametrize("unit", UNITS)
def test_a_file_has_times_in_its_unit(unit, tmp_path):
    seconds = 0.02 * np.arange(40)
    path = tmp_path / "log.npz"
    columns = written(path, seconds / UNITS[unit])
    assert_allclose(load_log(path, **columns, time_unit=unit).time, seconds, atol=1e-12)
    text = tmp_path / "log.csv"
    rows = "".join(f"1,2,3,4,5,6,{t / UNITS[unit]!r}\n" for t in seconds.tolist())
    text.write_text(f"a,b,c,x,y,z,t\n{rows}")
    log = load_log(text, q=[*"abc"], x=[*"xyz"], time="t", time_unit=unit)
    assert_allclose(log.time, seconds, atol=1e-12)


def test_frames_have_a_rate(tmp_path):
    path = tmp_path / "log.npz"
    columns = written(path, np.arange(40) + 1000)
    log = load_log(path, **columns, time_unit="frames", rate=120.0)
    assert_allclose(np.diff(log.time), 1.0 / 120.0)
    for rate in (None, 0.0, -1.0, np.inf, np.nan, "120"):
        with pytest.raises((ValueError, TypeError), match="`rate`"):
            load_log(path, **columns, time_unit="frames", rate=rate)
    with pytest.raises(ValueError, match='`rate` needs time_unit="frames"'):
        load_log(path, **columns, rate=120.0)
    with pytest.raises(ValueError, match="`time_unit`"):
        load_log(path, **columns, time_unit="min")


def test_dates_are_seconds_in_any_unit(tmp_path):
    dates = np.datetime64("2026-01-01", "us") + np.arange(40) * np.timedelta64(20_000, "us")
    columns = written(tmp_path / "log.npz", dates)
    logs = [load_log(tmp_path / "log.npz", **columns, time_unit=unit) for unit in UNITS]
    for log in logs:
        assert_allclose(np.diff(log.time), 0.02, atol=1e-6)


def found(time, groups=None):
    rng = np.random.default_rng(0)
    q = rng.uniform(0.2, 0.3, (len(time), 3))
    report = check_log(Log(q, rng.standard_normal((len(time), 3)), groups, time))
    return [finding for finding in report.findings if finding.kind == "time"]


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("start", [0.0, START])
@pytest.mark.parametrize("seed", range(3))
def test_the_check_names_the_unit(unit, start, seed):
    """Since 1970 any unit is known; from zero, where the steps cannot be seconds."""
    rng = np.random.default_rng(seed)
    step = 10.0 ** rng.uniform(-3.0, 0.0)
    time = start + np.cumsum(step * rng.uniform(0.8, 1.2, 400))
    if unit == "ms" and start == 0.0:
        assert clock_doubt(time * 1e3, np.zeros(400)).unit in ("", "ms")
        return
    if unit == "us" and start == 0.0 and step < 1.5e-3:
        return  # steps of seconds
    (finding,) = found(time / UNITS[unit])
    assert finding.severity == "warning"
    likely = (unit,) if start else ("ms", unit) if step > 0.5 else ("us", "ns")
    assert any(f"--time-unit {name}" in finding.advice for name in likely)


def test_the_check_names_frames_and_long_recordings():
    (finding,) = found(np.arange(500.0) + 3000)
    assert "--time-unit frames" in finding.advice
    assert finding.severity == "note"
    (finding,) = found(10.0 * np.arange(20_000) + np.arange(20_000) % 3)
    assert "--time-unit ms" in finding.advice


@pytest.mark.parametrize("step", [1e-3, 0.02, 0.5, 1.5, 60.0])
def test_seconds_are_not_doubted(step):
    """Also where they restart with each run, and of postures at rest, a minute apart."""
    time = step * np.arange(300.0) + 1e-4 * np.arange(300)
    for start in (0.0, 12.0, START):
        assert not found(start + time)
    groups = np.repeat(np.arange(6), 50)
    assert not found(np.tile(time[:50], 6), groups)
    by_turns = np.argsort(np.tile(np.arange(50), 6), kind="stable")
    assert not found(np.tile(time[:50], 6)[by_turns], groups[by_turns])


def test_creep_is_not_fitted_to_times_that_cannot_be_seconds():
    rng = np.random.default_rng(0)
    chain = ConstantCurvatureChain([0.05])
    q = 0.25 + 0.02 * rng.standard_normal((40, 3))
    x = rng.standard_normal((40, 3))
    runs = np.repeat([0, 1], 20)
    model = HybridForwardModel(chain, "drop", hysteresis=0.01)
    for time in (1e9 * (START + 0.01 * np.arange(40)), 1e7 * np.arange(40)):
        with pytest.raises(ValueError, match=r"`time` must be in seconds.*time_unit"):
            model.fit(Commands(q, runs, time), x, groups=runs)


def test_durations_read_well():
    for seconds, words in (
        (0.0, "0 s"),
        (2e-6, "2 us"),
        (0.0125, "12.5 ms"),
        (12.5, "12.5 s"),
        (600.0, "10 min"),
        (7200.0 * 3, "6 h"),
        (86400.0 * 10, "10 days"),
    ):
        assert duration_in_words(seconds) == words
    assert "years: are these seconds?" in duration_in_words(3.8e11)
