"""Surfaces of obstacles as vertices and faces, for all pictures and pages."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import Numbers, shaped
from hybridkin._core.texts import visible

COLOR = "#A67C52"  # of obstacles, which no line has
OPACITY = 0.35
_ROUND = 5  # pieces of a quarter circle
_ROUNDING = 1e-12  # of a corner, in sizes of a picture
_BEYOND = 1.0  # how far infinite sides go beyond a picture, in its sizes


class Convex(Protocol):
    """An obstacle: the box ``low <= p <= high`` in a frame of its own, grown by a radius.

    See `hybridkin.obstacles`.
    """

    @property
    def center(self) -> Numbers: ...
    @property
    def axes(self) -> Numbers: ...
    @property
    def low(self) -> Numbers: ...
    @property
    def high(self) -> Numbers: ...
    @property
    def radius(self) -> float: ...
    @property
    def name(self) -> str: ...


class Solid(NamedTuple):
    """An obstacle as plain arrays [m], see `Convex`."""

    center: NDArray  # (3,)
    axes: NDArray  # (3, 3)
    low: NDArray  # (3,)
    high: NDArray
    radius: float
    name: str

    @property
    def is_finite(self) -> bool:
        """Whether it has an end in all directions."""
        return bool(np.isfinite([self.low, self.high]).all())

    def scaled(self, scale: float) -> Solid:
        """Return it in another unit of length."""
        return self._replace(
            center=scale * self.center,
            low=scale * self.low,
            high=scale * self.high,
            radius=scale * self.radius,
        )

    @property
    def label(self) -> str:
        """Its name in one line that can be seen."""
        return visible(self.name)


class Surface(NamedTuple):
    """A surface of triangles.

    Attributes
    ----------
    vertices : ndarray of shape (V, 3)
        Its corners [m].
    faces : ndarray of shape (F, 3)
        The corners of every triangle, counted from 0, counterclockwise from outside.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.intp]

    @property
    def triangles(self) -> NDArray[np.float64]:
        """The corners of every triangle (F, 3, 3) [m]."""
        return self.vertices[self.faces]


def solids(obstacles: Sequence[Convex], name: str = "obstacles") -> tuple[Solid, ...]:
    """Return a caller's obstacles as plain arrays, checked.

    Those that are plain arrays already stay as they are.
    """
    if not isinstance(obstacles, Iterable) or isinstance(obstacles, str):
        raise TypeError(
            f"`{name}` must be a list of obstacles, e.g. [obstacles.Sphere(center, radius)], got "
            f"{obstacles!r:.80}."
        )
    return tuple(_solid(obstacle, f"{name}[{k}]") for k, obstacle in enumerate(obstacles))


def _solid(obstacle: Convex, name: str) -> Solid:
    if not hasattr(obstacle, "axes") or not hasattr(obstacle, "high"):
        raise TypeError(
            f"`{name}` must be an obstacle, e.g. obstacles.Sphere(center, radius), got "
            f"{obstacle!r:.80}."
        )
    return Solid(
        shaped(obstacle.center, f"{name}.center", "3"),
        shaped(obstacle.axes, f"{name}.axes", "33"),
        shaped(obstacle.low, f"{name}.low", "3"),
        shaped(obstacle.high, f"{name}.high", "3"),
        float(obstacle.radius),
        obstacle.name,
    )


def obstacle_surface(obstacle: Convex, low: ArrayLike, high: ArrayLike) -> Surface:
    """Return the surface of an obstacle as triangles.

    Parameters
    ----------
    obstacle : Obstacle
        From `hybridkin.obstacles`, such as a sphere.
    low, high : array-like of shape (3,)
        Corners of the box that the picture shows [m]. An obstacle without an end, such as a
        half-space, is cut at it.

    Returns
    -------
    Surface
        Named tuple (vertices, faces) of shapes (V, 3) [m] and (F, 3). Without faces if the picture
        shows nothing of it.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import obstacles, plots
    >>> floor = obstacles.HalfSpace([0.0, 0.0, 1.0], 0.0)
    >>> surface = plots.obstacle_surface(floor, [-1.0, -1.0, -0.1], [1.0, 1.0, 2.0])
    >>> np.ptp(surface.vertices, axis=0).round(6).tolist()
    [2.0, 2.0, 0.0]
    """
    corner = shaped(low, "low", "3")
    return surface_of(_solid(obstacle, "obstacle"), corner, shaped(high, "high", "3"))


def surface_of(solid: Solid, low: NDArray, high: NDArray) -> Surface:
    """Return the surface of a solid, see `obstacle_surface`."""
    if solid.is_finite:
        return _grown_box(solid)
    surface = _grown_box(_cut(solid, low, high))
    return _within(surface.triangles, low, high)


def extent(obstacles: Sequence[Solid]) -> NDArray:
    """Return points (N, 3) that span all obstacles with an end [m]."""
    nowhere = np.zeros(3)
    parts = [np.empty((0, 3))]
    parts += [
        surface_of(solid, nowhere, nowhere).vertices for solid in obstacles if solid.is_finite
    ]
    return np.concatenate(parts)


def _cut(solid: Solid, low: NDArray, high: NDArray) -> Solid:
    """Return a solid whose infinite sides end beyond a picture."""
    corners = np.array([*itertools.product(*np.stack([low, high], axis=1))])
    places = (corners - solid.center) @ solid.axes.T
    beyond = _BEYOND * np.ptp(corners, axis=0).max() + solid.radius
    ends = places.max(axis=0) + beyond
    starts = places.min(axis=0) - beyond
    near = np.where(np.isfinite(solid.low), solid.low, np.minimum(starts, solid.high - beyond))
    far = np.where(np.isfinite(solid.high), solid.high, np.maximum(ends, near + beyond))
    return solid._replace(low=near, high=far)


def _grown_box(solid: Solid) -> Surface:
    """Return the surface of a solid with an end in all directions.

    Every direction d of a sphere leads to the point ``corner + radius d``, with the corner of the
    box on the side of d. Where a component of d changes its sign, both corners follow each other:
    these are the flat sides.
    """
    pieces = _ROUND if solid.radius > 0.0 else 1
    quarter = np.linspace(0.0, 0.5 * np.pi, pieces + 1)
    up = np.concatenate([quarter - 0.5 * np.pi, quarter])[:, None]
    around = np.concatenate([quarter + 0.5 * k * np.pi for k in range(4)])
    directions = [np.cos(up) * np.cos(around), np.cos(up) * np.sin(around)]
    directions.append(np.sin(up) + 0.0 * around)
    n_rows, n_columns = directions[0].shape
    quadrant = np.repeat(np.arange(4), pieces + 1)
    is_above = np.repeat([False, True], pieces + 1)[:, None]
    sides = [np.isin(quadrant, (0, 3)), np.isin(quadrant, (0, 1)), is_above]
    at_high = np.stack(np.broadcast_arrays(*sides), axis=-1)
    places = np.where(at_high, solid.high, solid.low) + solid.radius * np.stack(directions, axis=-1)
    vertices = solid.center + places.reshape(-1, 3) @ solid.axes
    faces = _grid_faces(n_rows, n_columns)
    return _without_empty(Surface(vertices, faces))


def _grid_faces(n_rows: int, n_columns: int) -> NDArray[np.intp]:
    """Return the triangles of a grid that closes around, with a fan at both ends."""
    index = np.arange(n_rows * n_columns).reshape(n_rows, n_columns)
    following = np.roll(index, -1, axis=1)
    below = np.stack([index[:-1], following[:-1], following[1:]], axis=-1)
    above = np.stack([index[:-1], following[1:], index[1:]], axis=-1)
    first = np.broadcast_to(index[0, 0], n_columns)
    last = np.broadcast_to(index[-1, 0], n_columns)
    start = np.stack([first, following[0], index[0]], axis=-1)
    end = np.stack([last, index[-1], following[-1]], axis=-1)
    return np.concatenate([below.reshape(-1, 3), above.reshape(-1, 3), start, end])


def _without_empty(surface: Surface) -> Surface:
    """Return a surface without the triangles that have no area."""
    first, second, third = np.moveaxis(surface.triangles, 1, 0)
    area = np.linalg.norm(np.cross(second - first, third - first), axis=-1)
    size = float(np.ptp(surface.vertices, axis=0).max())
    return surface._replace(faces=surface.faces[area > 1e-12 * size**2])


def _within(triangles: NDArray, low: NDArray, high: NDArray) -> Surface:
    """Return the part of triangles (F, 3, 3) in a box."""
    polygons = [*triangles]
    slack = _ROUNDING * (high - low).max()  # a floor may lie on the edge
    for axis in range(3):
        for side, end in ((1.0, low[axis] - slack), (-1.0, high[axis] + slack)):
            polygons = [_above(polygon, side * (polygon[:, axis] - end)) for polygon in polygons]
            polygons = [polygon for polygon in polygons if len(polygon) > 2]
    vertices = np.concatenate([np.empty((0, 3)), *polygons])
    faces = [np.empty((0, 3), dtype=np.intp)]
    start = 0
    for polygon in polygons:
        behind = np.arange(start + 2, start + len(polygon))
        faces.append(np.stack([np.full(len(behind), start), behind - 1, behind], axis=-1))
        start += len(polygon)
    return Surface(vertices, np.concatenate(faces))


def _above(polygon: NDArray, height: NDArray) -> NDArray:
    """Return the part of a convex polygon (P, 3) whose height (P,) is not negative."""
    corners = []
    for k in range(len(polygon)):
        before = height[k - 1]
        here = height[k]
        if before * here < 0.0:
            fraction = before / (before - here)
            corners.append(polygon[k - 1] + fraction * (polygon[k] - polygon[k - 1]))
        if here >= 0.0:
            corners.append(polygon[k])
    return np.reshape(corners, (-1, 3))
