import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin.ik.trajectories import Trajectory, figure_eight, from_csv, line, min_jerk, spiral

CENTER = np.array([0.1, -0.2, 0.7])


def test_min_jerk_starts_and_ends_at_rest():
    h = 1e-4
    s = np.array([0.0, h, 2 * h, 1 - 2 * h, 1 - h, 1.0])
    way = min_jerk(s)
    assert way[0] == 0.0
    assert way[-1] == 1.0
    assert min_jerk(0.5) == 0.5
    assert_allclose(min_jerk(0.25), 10 / 64 - 15 / 256 + 6 / 1024)
    assert way[1] < 11 * h**3  # no linear, no quadratic part
    assert 1.0 - way[-2] < 11 * h**3
    assert (np.diff(min_jerk(np.linspace(0, 1, 1000))) > 0).all()
    assert_array_equal(min_jerk([-1.0, 2.0]), [0.0, 1.0])


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (0, -2, 0), (1, 1, 1)])
def test_figure_eight_lies_in_its_plane_and_fills_its_size(normal):
    path = figure_eight(CENTER, (0.4, 0.2), duration=8.0, normal=normal, timing="uniform")
    offset = path.x - CENTER
    assert_allclose(offset @ np.array(normal), 0.0, atol=1e-15)
    assert_array_equal(path.x[0], path.x[-1])
    assert_array_equal(path.x[0], CENTER)
    assert_allclose(path.x[400], CENTER, atol=1e-15)  # crosses itself half way
    across = offset[200] / np.linalg.norm(offset[200])
    up = np.cross(np.array(normal) / np.linalg.norm(normal), across)
    assert_allclose(np.ptp(offset @ across), 0.4)
    assert_allclose(np.ptp(offset @ up), 0.2)
    u, w = offset @ across / 0.2, offset @ up / 0.1
    assert_allclose(w**2, 4 * u**2 * (1 - u**2), atol=1e-14)  # Gerono's lemniscate
    assert (u[1:400] > 0.0).all()
    assert (w[1:200] > 0.0).all()  # it leaves the crossing to the upper right


def test_spiral_radius_angle_and_rise():
    path = spiral(CENTER, (0.05, 0.15), rise=0.1, turns=2.0, duration=4.0, timing="uniform")
    offset = path.x - CENTER
    share = path.t / 4.0
    assert_allclose(np.hypot(offset[:, 0], offset[:, 1]), 0.05 + 0.1 * share)
    assert_allclose(offset[:, 2], 0.1 * share, atol=1e-15)
    angle = np.unwrap(np.arctan2(offset[:, 1], offset[:, 0]))
    assert_allclose(angle, 4.0 * np.pi * share, atol=1e-12)
    circle = spiral(CENTER, 0.1, turns=-1.0)
    assert_allclose(np.linalg.norm(circle.x - CENTER, axis=1), 0.1)
    assert circle.x[1, 1] < CENTER[1]  # clockwise


@pytest.mark.parametrize("timing", ["min_jerk", "uniform"])
def test_line_is_straight_and_meets_its_ends(timing):
    start, end = CENTER, np.array([0.3, 0.1, 0.9])
    path = line(start, end, duration=1.0, dt=0.1, timing=timing)
    assert_array_equal(path.x[[0, -1]], [start, end])
    assert_allclose(np.cross(path.x - start, end - start), 0.0, atol=1e-16)
    assert_allclose(path.t, np.arange(11) * 0.1)
    steps = np.linalg.norm(np.diff(path.x, axis=0), axis=1)
    assert np.ptp(steps) < 1e-15 if timing == "uniform" else steps[0] < 0.1 * steps[5]


def test_trajectory_is_checked_frozen_and_its_own():
    t, x = np.arange(3.0), np.zeros((3, 3))
    path = Trajectory(t, x)
    x[0] = 1.0
    assert_array_equal(path.x, 0.0)
    with pytest.raises(AttributeError):
        path.t = t
    assert repr(path) == "Trajectory(3 points, 2 s, 0 x 0 x 0 m)"
    with pytest.raises(ValueError, match=r"`x` must have shape \(T, 3\)"):
        Trajectory(t, np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"`t` must have shape \(3,\)"):
        Trajectory(t[:2], np.zeros((3, 3)))
    with pytest.raises(ValueError, match="`x` must hold at least one point"):
        Trajectory([], np.zeros((0, 3)))
    with pytest.raises(ValueError, match="first: row 1"):
        Trajectory(t, [[0, 0, 0], [0, np.nan, 0], [0, 0, 0]])
    with pytest.raises(ValueError, match=r"must increase.*row 2"):
        Trajectory([0.0, 1.0, 1.0], np.zeros((3, 3)))


def test_paths_in_millimetres_are_noticed(tmp_path):
    file = tmp_path / "path.csv"
    file.write_text("t,x,y,z\n0,0,0,200\n1,10,0,200\n")
    with pytest.warns(UserWarning, match="looks like millimetres") as seen:
        figure_eight([0.0, 0.0, 200.0], (40.0, 20.0))
    assert seen[0].filename == __file__
    with pytest.warns(UserWarning, match="read a file with unit='mm'"):
        from_csv(file)
    assert from_csv(file, unit="mm").x[0, 2] == 0.2  # and says nothing: warnings are errors


def test_csv_with_and_without_times(tmp_path):
    file = tmp_path / "path.csv"
    file.write_text("# recorded\nt,x,y,z\n0.0,1,2,3\n0.5,4,5,6\n\n")
    path = from_csv(file, unit="mm")
    assert_array_equal(path.t, [0.0, 0.5])
    assert_allclose(path.x, [[1e-3, 2e-3, 3e-3], [4e-3, 5e-3, 6e-3]])
    file.write_text("1,2,3\n4,5,6\n")
    path = from_csv(file, dt=0.25)
    assert_array_equal(path.t, [0.0, 0.25])
    assert_array_equal(path.x, [[1, 2, 3], [4, 5, 6]])
    with pytest.raises(ValueError, match="has no times; give the time between its points"):
        from_csv(file)
    file.write_text("0.0,1,2,3\n0.5,4,5,6\n")
    path = from_csv(file, dt=0.25)
    assert_array_equal(path.t, [0.0, 0.25, 0.5])
    assert_array_equal(path.x[1], [2.5, 3.5, 4.5])


SHAPES = {
    "eight": lambda m, **options: figure_eight(m * CENTER, (0.4 * m, 0.2 * m), **options),
    "spiral": lambda m, **options: spiral(m * CENTER, (0.05 * m, 0.1 * m), rise=m, **options),
    "line": lambda m, **options: line(m * CENTER, [0.0, 0.1 * m, 0.6 * m], **options),
}


@pytest.mark.parametrize("timing", ["min_jerk", "uniform"])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_shape_has_no_unit_of_length_and_of_time(shape, timing):
    plain = SHAPES[shape](1.0, duration=2.0, dt=0.1, timing=timing)
    assert len(plain) == 21
    other = SHAPES[shape](4.0, duration=0.5, dt=0.025, timing=timing)
    assert_allclose(other.x, 4.0 * plain.x, rtol=1e-14, atol=1e-14)
    assert_allclose(other.t, plain.t / 4.0, rtol=1e-14)
    assert (plain.duration, other.duration) == pytest.approx((2.0, 0.5))
    # Half the period has the same points, and others between them.
    finer = SHAPES[shape](1.0, duration=2.0, dt=0.05, timing=timing)
    assert_allclose(finer.x[::2], plain.x, rtol=0, atol=1e-14)
    assert_allclose(finer.t[::2], plain.t, rtol=1e-14)


@pytest.mark.parametrize(("unit", "metre"), [("m", 1.0), ("cm", 1e-2), ("mm", 1e-3)])
@pytest.mark.parametrize("first", [0.0, 5.0])
def test_a_recorded_path_is_read_in_its_unit_at_its_times(tmp_path, unit, metre, first):
    t = first + np.array([0.0, 0.1, 0.4, 0.5])  # unequal periods
    x = np.array([[0.1, 0.2, 0.3], [0.2, 0.2, 0.3], [0.5, 0.2, 0.6], [0.5, 0.1, 0.6]])
    table = np.column_stack([t, x / metre])
    np.savetxt(tmp_path / "path.csv", table, delimiter=",")
    path = from_csv(tmp_path / "path.csv", unit=unit)
    assert_allclose(path.x, x, rtol=1e-14)
    assert_allclose(path.t, t, rtol=1e-14)
    even = from_csv(tmp_path / "path.csv", unit=unit, dt=0.1)
    assert_allclose(even.t, first + 0.1 * np.arange(6), rtol=1e-14)
    expected = [x[0], x[1], [0.3, 0.2, 0.4], [0.4, 0.2, 0.5], x[2], x[3]]
    assert_allclose(even.x, expected, rtol=1e-12)
