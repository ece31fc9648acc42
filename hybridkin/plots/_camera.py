"""Where the eye of a page stands, so that everything is seen and fills the page."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

FIELD = np.radians(45.0)  # of view, from bottom to top of a page [rad]
_FILLED = 0.9  # of the page, by what is seen
_UP = np.array([0.0, 0.0, 1.0])
_BEFORE = 0.5  # least distance of the eye from the nearest point, in depths of the points
_LEAST = 1e-3  # the same of a single point [m]
_NEAR = 0.05  # nearest and farthest distance that is drawn, in distances of the eye
_FAR = 100.0


class Camera(NamedTuple):
    """An eye and what it looks at.

    Attributes
    ----------
    position, look_at : ndarray of shape (3,)
        The eye, and the point in the middle of the page, about which a mouse turns it [m].
    """

    position: NDArray[np.float64]
    look_at: NDArray[np.float64]

    @property
    def distance(self) -> float:
        """The distance between the two points [m]."""
        return float(np.linalg.norm(self.position - self.look_at))

    @property
    def axes(self) -> NDArray[np.float64]:
        """The directions (3, 3) to the right, up and forward, one a row."""
        return _axes(self.position - self.look_at)

    def on_page(self, points: ArrayLike, aspect: float = 1.0) -> NDArray[np.float64]:
        """Return where points are on a page that reaches from -1 to 1.

        Parameters
        ----------
        points : array-like of shape (N, 3)
            Points [m].
        aspect : float, default=1.0
            Width over height of the page.

        Returns
        -------
        ndarray of shape (N, 2)
            To the right and up; NaN for points behind the eye.
        """
        right, up, ahead = self.axes @ (np.asarray(points, dtype=float) - self.position).T
        ahead = np.where(ahead > 0.0, ahead, np.nan)
        half = np.tan(0.5 * FIELD) * ahead
        return np.stack([right / (aspect * half), up / half], axis=1)

    def aim(self, camera: Any) -> None:
        """Place the camera of a viser server or client."""
        camera.fov = FIELD
        camera.near = _NEAR * self.distance
        camera.far = _FAR * self.distance
        camera.position = self.position
        camera.look_at = self.look_at


def fitted_camera(points: ArrayLike, direction: ArrayLike, aspect: float = 1.0) -> Camera:
    """Return the nearest camera in a direction that sees all points.

    Parameters
    ----------
    points : array-like of shape (N, 3)
        What must be seen [m]; rows with NaN do not count.
    direction : array-like of shape (3,)
        From what is seen to the eye, of any length and not straight up.
    aspect : float, default=1.0
        Width over height of the page.

    Returns
    -------
    Camera
        The points fill nine tenths of the page in width or in height, unless they are so deep that
        the eye would stand among them.

    Examples
    --------
    >>> from hybridkin.plots.page_server import fitted_camera
    >>> camera = fitted_camera([[0.0, 0.0, 0.0], [0.0, 0.0, 0.2]], (0.0, -1.0, 0.0))
    >>> camera.on_page([[0.0, 0.0, 0.2]]).round(3).tolist()
    [[0.0, 0.9]]
    """
    points = np.asarray(points, dtype=float)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise ValueError("`points` must hold at least one finite point, got none.")
    axes = _axes(np.asarray(direction, dtype=float))
    *across, depths = axes @ points.T
    height = _FILLED * np.tan(0.5 * FIELD)
    eye = np.empty(3)
    eye[2] = depths.min() - max(_LEAST, _BEFORE * np.ptp(depths))
    sides = []
    # A point is on the page where |offset| <= slope * depth, its distances from the eye. So the
    # largest offset - slope * depth of the points, on both sides, says how near the eye may come.
    for offsets, slope in zip(across, (aspect * height, height), strict=True):
        above = (offsets - slope * depths).max()
        below = (-offsets - slope * depths).max()
        sides.append(0.5 * (above - below))
        eye[2] = min(eye[2], -0.5 * (above + below) / slope)
    eye[:2] = sides
    middle = eye.copy()
    middle[2] = 0.5 * (depths.min() + depths.max())
    return Camera(eye @ axes, middle @ axes)


def _axes(direction: NDArray) -> NDArray:
    """Return the directions (3, 3) to the right, up and forward of an eye in a direction."""
    forward = -direction / np.linalg.norm(direction)
    right = np.cross(forward, _UP)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward])
