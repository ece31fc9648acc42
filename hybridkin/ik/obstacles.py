"""Obstacles that the whole body of a robot keeps clear of: spheres, half-spaces, capsules, boxes.

Every obstacle is a convex box in a frame of its own, whose sides may be infinitely far or in one
place, grown by a radius: a sphere is a grown point, a capsule a grown line, a half-space a box with
one side. One formula gives the distance to all of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike

import torch
from torch import Tensor

from hybridkin._core.arrays import Numbers, as_path, as_tensor, check_shape, identity, number
from hybridkin._core.kernel_numbers import IK_OBSTACLE
from hybridkin._core.portable import Portable
from hybridkin.ik._scene_files import DescribedObstacle, described_obstacles

__all__ = ["Box", "Capsule", "HalfSpace", "Obstacle", "Sphere", "read_scene"]

_LARGEST = 1e6  # distance of a point of an obstacle from the origin [m]


@dataclass(frozen=True, eq=False, repr=False)
class Obstacle(Portable):
    """A box in a frame of its own, grown by a radius; made as one of its subclasses.

    It is the set of all points that are at most `radius` away from a point ``center + axes^T p``
    with ``low <= p <= high``.

    Attributes
    ----------
    center : Tensor of shape (3,)
        Origin of its frame, in the frame of x [m].
    axes : Tensor of shape (3, 3)
        The axes of its frame, one per row, orthonormal [1].
    low, high : Tensor of shape (3,)
        The sides of the box along these axes [m]; they may be infinite.
    radius : float
        By how much the box is grown [m].
    name : str
        What reports and pictures call it; may be empty.
    """

    center: Tensor
    axes: Tensor
    low: Tensor
    high: Tensor
    radius: float
    name: str = ""

    def __repr__(self) -> str:
        """Return the kind, the place and the name."""
        place = ", ".join(f"{c:.4g}" for c in self.center.tolist())
        called = f", {self.name!r:.80}" if self.name else ""
        return f"{type(self).__name__}(at [{place}]{called})"

    @property
    def numbers(self) -> Tensor:
        """The obstacle as one row of numbers, shape (IK_OBSTACLE,)."""
        radius = self.center.new_tensor([self.radius])
        return torch.cat([self.center, self.axes.flatten(), self.low, self.high, radius])

    def moved(self, center: Numbers) -> Obstacle:
        """Return the obstacle, not turned, with its `center` at another place (3,) [m]."""
        place = _point(center, "center")
        return Obstacle(place, self.axes, self.low, self.high, self.radius, self.name)

    def distance(self, points: Numbers) -> Tensor:
        """Return the distances of points (..., 3) to its surface, negative inside, (...) [m]."""
        x = as_tensor(points, "points")
        check_shape(x, "points", ("...", 3), "points [m]")
        return distances(x, self.numbers.to(x)[None])[0][..., 0]


class Sphere(Obstacle):
    """A ball.

    Parameters
    ----------
    center : array-like of shape (3,)
        Its centre, in the frame of x [m].
    radius : float
        Its radius [m].
    name : str, default=""
        What reports and pictures call it.

    Examples
    --------
    >>> from hybridkin import obstacles
    >>> ball = obstacles.Sphere([0.0, 0.0, 0.5], 0.1)
    >>> round(float(ball.distance([0.3, 0.0, 0.5])), 6)
    0.2
    """

    def __init__(self, center: Numbers, radius: float, *, name: str = "") -> None:
        middle = _point(center, "center")
        at = torch.zeros_like(middle)
        super().__init__(middle, identity(3, middle), at, at, _size(radius, "radius"), _name(name))


class HalfSpace(Obstacle):
    """All points behind a plane, such as a floor or a wall: ``normal x <= offset``.

    Parameters
    ----------
    normal : array-like of shape (3,)
        Normal of the plane, of any length, towards the free side [1].
    offset : float
        The plane is ``normal x = offset`` [m]; for a normal of length one it is the distance from
        the origin.
    name : str, default=""
        What reports and pictures call it.

    Examples
    --------
    A floor at z = 0:

    >>> from hybridkin import obstacles
    >>> float(obstacles.HalfSpace([0.0, 0.0, 1.0], 0.0).distance([0.3, 0.1, 0.5]))
    0.5
    """

    def __init__(self, normal: Numbers, offset: float, *, name: str = "") -> None:
        direction = _point(normal, "normal")
        length = float(direction.norm())
        if not length > 0.0:
            raise ValueError(f"`normal` must have a direction, got {direction.tolist()}.")
        axis = direction / length
        far = axis.new_tensor([math.inf, math.inf, math.inf])
        side = axis.new_tensor([math.inf, math.inf, 0.0])
        place = axis * (_place(offset, "offset") / length)
        super().__init__(place, _frame_along(axis), -far, side, 0.0, _name(name))


class Capsule(Obstacle):
    """All points near a line between two points, such as a rod, a pipe or a link of an arm.

    Parameters
    ----------
    start, end : array-like of shape (3,)
        Ends of the line, in the frame of x [m].
    radius : float
        Distance from the line to the surface [m].
    name : str, default=""
        What reports and pictures call it.

    Examples
    --------
    >>> from hybridkin import obstacles
    >>> rod = obstacles.Capsule([0.0, -1.0, 0.5], [0.0, 1.0, 0.5], 0.02)
    >>> round(float(rod.distance([0.1, 0.3, 0.5])), 6)
    0.08
    """

    def __init__(self, start: Numbers, end: Numbers, radius: float, *, name: str = "") -> None:
        first = _point(start, "start")
        way = _point(end, "end") - first
        length = float(way.norm())
        axes = identity(3, first)
        if length > 0.0:
            axes = _frame_along(way / length)
        low = torch.zeros_like(first)
        high = first.new_tensor([0.0, 0.0, length])
        super().__init__(first, axes, low, high, _size(radius, "radius"), _name(name))


class Box(Obstacle):
    """A box.

    Parameters
    ----------
    center : array-like of shape (3,)
        Its centre, in the frame of x [m].
    size : array-like of shape (3,)
        Its whole lengths along its axes [m].
    rotation : array-like of shape (3, 3), optional
        Its axes, one per column, in the frame of x [1]. Default: along the axes of x.
    radius : float, default=0.0
        By how much its corners are round, beyond `size` [m].
    name : str, default=""
        What reports and pictures call it.

    Examples
    --------
    >>> from hybridkin import obstacles
    >>> box = obstacles.Box([0.0, 0.0, 0.0], [0.2, 0.4, 1.0])
    >>> round(float(box.distance([0.3, 0.0, 0.1])), 6)
    0.2
    """

    def __init__(
        self,
        center: Numbers,
        size: Numbers,
        rotation: Numbers = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        radius: float = 0.0,
        *,
        name: str = "",
    ) -> None:
        middle = _point(center, "center")
        half = 0.5 * _point(size, "size")
        if not (half > 0.0).all():
            raise ValueError(f"`size` must be positive [m], got {(2.0 * half).tolist()}.")
        R = as_tensor(rotation, "rotation").cpu().double()
        check_shape(R, "rotation", (3, 3), "a rotation")
        off = (R.mT @ R - identity(3, R)).abs().max()
        if not (off <= 1e-6 and torch.linalg.det(R) > 0.0):
            raise ValueError(
                f"`rotation` must be orthonormal and right-handed, got {R.tolist()!r:.200}."
            )
        grown = 0.0 if radius == 0.0 else _size(radius, "radius")
        super().__init__(middle, R.mT, -half, half, grown, _name(name))


_KINDS = {"sphere": Sphere, "half_space": HalfSpace, "capsule": Capsule, "box": Box}


def read_scene(path: str | PathLike[str]) -> list[Obstacle]:
    r"""Return the obstacles that a TOML file describes.

    Parameters
    ----------
    path : path-like
        The file. Keys are those of the classes of this module, in metres::

            unit = "mm"                     # of all lengths: "m" (the default), "cm", "mm", ...

            [[sphere]]
            name = "lamp"                   # optional, for reports and pictures
            center = [0.0, 80.0, 500.0]
            radius = 30.0

            [[half_space]]                  # what lies behind a plane: normal x <= offset
            normal = [0.0, 0.0, 1.0]
            offset = -20.0

            [[capsule]]
            start = [-100.0, 0.0, 400.0]
            end = [100.0, 0.0, 400.0]
            radius = 10.0

            [[box]]
            center = [0.0, 0.0, 900.0]
            size = [200.0, 20.0, 100.0]
            rotation_vector_deg = [0.0, 0.0, 45.0]  # axis times angle, optional
            radius = 5.0                    # of round corners beyond the size, optional

    Returns
    -------
    list of Obstacle
        Kind by kind, each in the order of the file.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not TOML, lacks a key, or has an unknown key or a wrong value; the message
        names file, table and key.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from hybridkin import obstacles
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "scene.toml"
    ...     _ = path.write_text('unit = "mm"\n[[sphere]]\ncenter = [0, 0, 500]\nradius = 50\n')
    ...     obstacles.read_scene(path)
    [Sphere(at [0, 0, 0.5])]
    """
    file = as_path(path)
    if not file.is_file():
        raise FileNotFoundError(f"`path` must be a scene of obstacles, got {file}: no such file.")
    try:
        return [_made(described) for described in described_obstacles(file)]
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def _made(described: DescribedObstacle) -> Obstacle:
    """Return the obstacle of a table of a file."""
    try:
        return _KINDS[described.kind](**described.arguments)
    except ValueError as error:
        raise ValueError(f"{described.where}: {error}") from error


def as_scene(value: Sequence[Obstacle]) -> tuple[Obstacle, ...]:
    """Return a caller's obstacles, checked."""
    if not isinstance(value, Sequence):
        raise TypeError(
            "`obstacles` must be a list of obstacles, e.g. [obstacles.Sphere(center, radius)], got "
            f"{value!r:.200}."
        )
    for i, obstacle in enumerate(value):
        if not isinstance(obstacle, Obstacle):
            raise TypeError(
                f"`obstacles[{i}]` must be an obstacle, e.g. obstacles.Sphere(center, radius), got "
                f"{obstacle!r:.200}."
            )
    return tuple(value)


def as_numbers(scene: Sequence[Obstacle]) -> Tensor:
    """Return obstacles as rows of numbers, shape (K, IK_OBSTACLE)."""
    none = torch.empty(0, IK_OBSTACLE, dtype=torch.float64, device="cpu")
    return torch.cat([none, *(obstacle.numbers[None] for obstacle in scene)])


def distances(x: Tensor, scene: Tensor) -> tuple[Tensor, Tensor]:
    """Return distances of points to obstacles, negative inside, and the directions out of them.

    Parameters
    ----------
    x : Tensor of shape (..., 3)
        Points [m].
    scene : Tensor of shape (K, IK_OBSTACLE)
        Obstacles, as from `as_numbers`.

    Returns
    -------
    distance : Tensor of shape (..., K)
        Distances to the surfaces [m].
    normal : Tensor of shape (..., K, 3)
        Unit vectors along which they grow, outwards.
    """
    center, axes, low, high, radius = scene.split([3, 9, 3, 3, 1], dim=-1)
    axes = axes.unflatten(-1, (3, 3))
    place = (axes @ (x[..., None, :] - center)[..., None])[..., 0]
    way = place - torch.minimum(torch.maximum(place, low), high)
    outside = way.norm(dim=-1)
    # Inside, the nearest side is the way out.
    below = place - low
    above = high - place
    depth, side = torch.minimum(below, above).min(-1, keepdim=True)
    upwards = (above < below).gather(-1, side)
    towards = torch.where(upwards, 1.0, -1.0).to(place)
    out = torch.zeros_like(place).scatter(-1, side, towards)
    is_outside = (outside > 0.0)[..., None]
    length = torch.where(is_outside, outside[..., None], 1.0)
    direction = torch.where(is_outside, way / length, out)
    reached = torch.where(is_outside, outside[..., None], -depth)[..., 0]
    normal = (axes.mT @ direction[..., None])[..., 0]
    return reached - radius[..., 0], normal


def _point(value: Numbers, name: str) -> Tensor:
    """Return a caller's point or vector as a float64 tensor (3,)."""
    point = as_tensor(value, name).cpu().double()
    check_shape(point, name, (3,), "a point or direction in the frame of x")
    if not (point.abs() <= _LARGEST).all():
        raise ValueError(f"`{name}` must be finite, up to 1e6, got {point.tolist()}.")
    return point.clone()


def _place(value: float, name: str) -> float:
    """Return a caller's distance along an axis [m]."""
    place = number(value, name)
    if not abs(place) <= _LARGEST:
        raise ValueError(f"`{name}` must be finite, up to 1e6 m, got {place!r}.")
    return place


def _size(value: float, name: str) -> float:
    """Return a caller's positive length [m]."""
    size = number(value, name)
    if not 0.0 < size <= _LARGEST:
        raise ValueError(f"`{name}` must be a positive length [m], got {size!r}.")
    return size


def _name(value: str) -> str:
    """Return a caller's name of an obstacle."""
    if not isinstance(value, str):
        raise TypeError(f"`name` must be text, got {value!r:.80}.")
    return value


def _frame_along(axis: Tensor) -> Tensor:
    """Return a right-handed frame (3, 3), one axis per row, whose last one is a unit vector."""
    beside = torch.zeros_like(axis)
    beside[axis.abs().argmin()] = 1.0
    first = torch.linalg.cross(beside, axis)
    first = first / first.norm()
    return torch.stack([first, torch.linalg.cross(axis, first), axis])
