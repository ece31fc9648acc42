"""A log merged from a recording of the motors and one of a camera."""

import numpy as np
import pytest

from hybridkin.datasets import TimedColumns, merge_logs, read_columns


def motion(rng, n=4):
    """Return smooth commands as a function of time."""
    frequencies = rng.uniform(0.1, 0.8, (n, 4))
    phases = rng.uniform(0.0, 2.0 * np.pi, (n, 4))

    def q(t):
        waves = np.sin(2.0 * np.pi * frequencies * t[:, None, None] + phases)
        return 2e-3 * waves.sum(axis=2)

    return q


def tips(q):
    a, b, c, d = (100.0 * q).T
    return 0.1 * np.stack([np.sin(a + 0.5 * b), b * c + d, np.cos(c)], axis=1)


def recordings(seed, lag, noise=1e-4):
    """Return random recordings of one motion, whose clocks differ by a lag, and the commands."""
    rng = np.random.default_rng(seed)
    q = motion(rng)
    period = rng.uniform(0.005, 0.02)
    t = np.cumsum(rng.uniform(0.5, 1.5, 1500) * period)
    duration = rng.uniform(0.5, 0.9) * t[-1]
    first = rng.uniform(0.0, t[-1] - duration)
    seen = first + np.arange(0.0, duration, 1.0 / rng.choice([30, 60, 120]))
    x = tips(q(seen)) + noise * rng.standard_normal((len(seen), 3))
    return TimedColumns(q(t), t), TimedColumns(x, seen + lag), q


@pytest.mark.parametrize("seed", range(10))
def test_lag_of_any_size_is_found(seed):
    lag = [0.0, 0.034, -3.2, 55.0, 1.7e9][seed % 5]
    motors, camera, q = recordings(seed, lag)
    merged = merge_logs(motors, camera)
    assert abs(merged.lag - lag) < 5e-3
    assert merged.n_left_out < 0.02 * len(camera.time)
    # A part of a period of the fastest motion, and what is linear between two motor rows.
    assert np.abs(merged.log.q - q(merged.log.time)).max() < 1e-4
    assert f"clock is {merged.lag:.4f} s later" in str(merged)


def test_lag_of_held_postures_is_found():
    """Long rests between quick moves: many rows are the same, few say when the robot moves."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        targets = rng.uniform(-4e-3, 4e-3, (60, 4))
        starts = np.cumsum(rng.uniform(1.0, 3.0, 59))

        def q(t, targets=targets, starts=starts):
            k = np.searchsorted(starts, t)
            share = np.clip((t - starts[np.maximum(k - 1, 0)]) / 0.4, 0.0, 1.0)[:, None]
            return targets[np.maximum(k - 1, 0)] * (1.0 - share) + targets[k] * share

        t = np.arange(0.0, 100.0, 0.02)
        seen = np.arange(10.0, 80.0, 1.0 / 60.0)
        x = tips(q(seen)) + 2e-4 * rng.standard_normal((len(seen), 3))
        merged = merge_logs(TimedColumns(q(t), t), TimedColumns(x, seen - 40.0))
        assert abs(merged.lag + 40.0) < 5e-3


def test_given_lag_is_exact():
    motors, camera, q = recordings(3, 12.5, noise=0.0)
    merged = merge_logs(motors, camera, lag=12.5)
    assert not merged.is_estimated
    np.testing.assert_array_equal(merged.log.x, camera.values)
    np.testing.assert_allclose(merged.log.time, camera.time - 12.5)
    middle = np.abs(merged.log.q - q(merged.log.time)).max()
    step = np.diff(motors.time).max()
    # The error of a chord: step^2 / 8 times the largest second derivative.
    assert middle <= step**2 / 8.0 * 4 * 2e-3 * (2.0 * np.pi * 0.8) ** 2


def test_rows_of_the_motors_are_met_exactly():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.01, 0.03, 200))
    q = rng.standard_normal((200, 4))
    for hold in (False, True):
        log = merge_logs(TimedColumns(q, t), TimedColumns(q[:, :3], t), lag=0.0, hold=hold).log
        np.testing.assert_array_equal(log.q, q)


def test_commands_hold():
    motors = TimedColumns([[1.0], [2.0], [4.0]], [0.0, 10.0, 11.0])
    camera = TimedColumns(np.ones((4, 3)), [0.0, 9.9, 10.0, 10.5])
    log = merge_logs(motors, camera, lag=0.0, hold=True).log
    np.testing.assert_array_equal(log.q, [[1.0], [1.0], [2.0], [2.0]])


def test_gaps_are_left_out_and_begin_runs():
    t = np.concatenate([np.arange(0.0, 1.0, 0.1), np.arange(3.0, 4.0, 0.1)])
    motors = TimedColumns(np.stack([t, t**2], axis=1), t)
    seen = np.arange(-0.5, 4.5, 0.05)
    merged = merge_logs(motors, TimedColumns(np.ones((len(seen), 3)), seen), lag=0.0)
    log = merged.log
    assert not ((log.time > 0.9) & (log.time < 3.0)).any()
    assert len(np.unique(log.runs)) == 2
    assert merged.n_left_out == len(seen) - len(log.q)
    whole = merge_logs(motors, TimedColumns(np.ones((len(seen), 3)), seen), lag=0.0, tolerance=3.0)
    assert ((whole.log.time > 1.0) & (whole.log.time < 3.0)).any()
    assert len(np.unique(whole.log.runs)) == 1


def test_motions_of_the_motors_are_kept():
    t = np.arange(0.0, 2.0, 0.1)
    motors = TimedColumns(t[:, None], t, groups=np.repeat(["a", "b"], 10))
    seen = np.arange(0.0, 1.9, 0.03)
    log = merge_logs(motors, TimedColumns(np.ones((len(seen), 3)), seen), lag=0.0).log
    assert set(log.groups[log.time < 0.89]) == {"a"}
    assert set(log.groups[log.time > 1.0]) == {"b"}
    assert not ((log.time > 0.91) & (log.time < 0.99)).any()


def test_missing_markers_stay_missing():
    motors, camera, _ = recordings(1, 7.0)
    x = np.hstack([camera.values + 1.0, camera.values])
    x[::7, 3:5] = np.nan
    x[::11, 0] = np.nan
    x[::77] = np.nan
    merged = merge_logs(motors, TimedColumns(x, camera.time))
    assert abs(merged.lag - 7.0) < 5e-3
    log = merged.log
    assert log.x.shape[1] == 6
    # Of a marker all or nothing is known.
    known = np.isfinite(log.x).reshape(len(log.x), 2, 3)
    assert (known.all(axis=2) == known.any(axis=2)).all()
    assert known.any(axis=(1, 2)).all()


def test_periodic_motion_needs_the_lag():
    t = np.arange(0.0, 60.0, 0.01)
    q = np.stack([np.sin(3.0 * t), np.cos(3.0 * t), np.sin(3.0 * t + 1.0), np.sin(6.0 * t)], axis=1)
    seen = slice(500, 4000, 2)
    camera = TimedColumns(tips(1e-3 * q[seen]), t[seen])
    with pytest.raises(ValueError, match=r"where a motion repeats.*try these lags as `lag`"):
        merge_logs(TimedColumns(q, t), camera)
    assert merge_logs(TimedColumns(q, t), camera, lag=0.0).lag == 0.0


def motions_of_equal_duration(seed, reach):
    """Return recordings of 16 motions of 8 s from rest and back: the speeds fit every 4 s."""
    rng = np.random.default_rng(seed)
    goals = rng.uniform(-reach, reach, (16, 4))

    def q(t):
        goal = goals[np.clip((t // 8.0).astype(int), 0, 15)]
        return goal * np.sin(np.pi * t / 8.0)[:, None] ** 2

    t = np.arange(0.0, 128.0, 0.04)
    seen = np.arange(0.7, 127.5, 1.0 / 30.0)
    commands = q(t) + 2e-5 * rng.standard_normal((len(t), 4))
    x = tips(q(seen)) + 3e-4 * rng.standard_normal((len(seen), 3))
    return TimedColumns(commands, t + 5012.3), TimedColumns(x, seen + 15.718)


@pytest.mark.parametrize("seed", range(4))
def test_motions_of_equal_duration_have_one_lag(seed):
    merged = merge_logs(*motions_of_equal_duration(seed, 4e-3))
    assert abs(merged.lag + 4996.582) < 0.01


def test_a_lag_that_is_not_clear_is_named_first():
    """The tips bend too strongly for a rough model, which then explains a part of the motion."""
    with pytest.raises(ValueError, match=r"is not clear: -4996\.5\d\d s \([1-7]\d\.\d%\), -\d+"):
        merge_logs(*motions_of_equal_duration(0, 1.6e-2))


def test_recordings_of_different_motions_are_refused():
    for seed in range(5):
        motors = recordings(seed, 0.0)[0]
        camera = recordings(seed + 50, 0.0)[1]
        with pytest.raises(ValueError, match="is not clear"):
            merge_logs(motors, camera)


def test_bad_input_names_the_way_out():
    motors, camera, _ = recordings(0, 0.0)
    with pytest.raises(ValueError, match=r"must increase from row to row.*row 2"):
        TimedColumns(np.ones((3, 3)), [0.0, 1.0, 1.0])
    with pytest.raises(ValueError, match="three columns for each marker, got 4"):
        merge_logs(motors, motors)
    with pytest.raises(ValueError, match="`tolerance` must be a positive time"):
        merge_logs(motors, camera, lag=0.0, tolerance=0.0)
    with pytest.raises(ValueError, match="No camera row lies between two motor rows"):
        merge_logs(motors, camera, lag=1e4)
    with pytest.raises(ValueError, match="at least 3 complete rows"):
        merge_logs(motors, TimedColumns(np.full((9, 3), np.nan), np.arange(9.0)))


def test_files_are_read_in_their_units(tmp_path):
    path = tmp_path / "motors.csv"
    path.write_text("t,a,b,m\n0.0,1,90,x\n,5,6,x\n0.5,,180,y\n")
    columns = read_columns(path, ["a", "b"], time="t", unit="deg", sign=[1, -1], groups="m")
    expected = np.radians([[1.0, -90.0], [np.nan, -180.0]])
    np.testing.assert_allclose(columns.values, expected)
    assert columns.time.tolist() == [0.0, 0.5]
    assert columns.groups.tolist() == ["x", "y"]
    with pytest.raises(ValueError, match="`unit` must be"):
        read_columns(path, ["a"], time="t", unit="bar")
