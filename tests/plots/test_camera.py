"""The camera of a page: it sees everything, and what it sees fills the page."""

import numpy as np
import pytest

from hybridkin.plots.page_server import fitted_camera

EYE = (0.9, -1.1, 0.4)
FILLED = 0.9


@pytest.mark.parametrize("seed", range(20))
def test_every_point_is_on_the_page_and_they_fill_it(seed):
    rng = np.random.default_rng(seed)
    for _ in range(50):
        size = 10.0 ** rng.uniform(np.log10(0.005), np.log10(20.0))
        place = size * rng.normal(0.0, 5.0, 3)
        points = place + size * rng.uniform(0.05, 1.0, 3) * rng.normal(
            size=(rng.integers(2, 60), 3)
        )
        aspect = rng.uniform(0.4, 2.5)
        direction = rng.normal(size=3)
        camera = fitted_camera(points, direction, aspect)
        largest = np.abs(camera.on_page(points, aspect)).max()
        depths = (points - camera.position) @ camera.axes[2]
        among = depths.min() < 0.501 * np.ptp(depths) + 1.01e-3  # it cannot come nearer
        assert largest <= FILLED + 1e-9
        assert largest > FILLED - 1e-9 or among
        np.testing.assert_allclose(camera.on_page(camera.look_at[None], aspect), 0.0, atol=1e-9)
        assert camera.axes[1, 2] > 0.0  # upright


def test_an_eye_in_front_of_a_square_stands_where_geometry_says():
    square = [[-0.3, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.0, 0.6], [-0.3, 0.0, 0.6]]
    camera = fitted_camera(square, (0.0, -2.0, 0.0))
    away = 0.3 / (FILLED * np.tan(np.radians(22.5)))
    np.testing.assert_allclose(camera.position, [0.0, -away, 0.3], atol=1e-12)
    np.testing.assert_allclose(camera.look_at, [0.0, 0.0, 0.3], atol=1e-12)
    wide = fitted_camera(square, (0.0, -2.0, 0.0), 2.0)
    np.testing.assert_allclose(wide.position, camera.position)  # its height decides
    narrow = fitted_camera(square, (0.0, -2.0, 0.0), 0.5)
    np.testing.assert_allclose(narrow.position, [0.0, -2.0 * away, 0.3], atol=1e-12)


def test_points_behind_the_eye_are_not_on_the_page():
    camera = fitted_camera([[0.0, 0.0, 0.0], [0.0, 0.0, 0.2]], (0.0, -1.0, 0.0))
    behind = camera.position + np.array([0.0, -1.0, 0.0])
    assert np.isnan(camera.on_page(behind[None])).all()


def test_unknown_points_do_not_count_and_one_is_enough():
    points = np.array([[0.1, 0.2, 0.3], [np.nan, 0.0, 0.0]])
    camera = fitted_camera(points, EYE)
    assert np.isfinite(camera.position).all()
    np.testing.assert_allclose(camera.on_page(points[:1]), 0.0, atol=1e-9)
    with pytest.raises(ValueError, match="`points` must hold at least one finite point"):
        fitted_camera(np.full((3, 3), np.nan), EYE)
