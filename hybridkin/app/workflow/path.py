"""Paths of the tip: points from a file, or a named shape in the workspace of a model."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin import HybridForwardModel, trajectories
from hybridkin.app.workflow.domain import Domain, PathLimits
from hybridkin.app.workflow.model import has_body
from hybridkin.app.workflow.reach import center_of, placed
from hybridkin.arguments import number, one_of, real_array

_TOL = 1e-4  # of a point that lies in the domain [m]
_EXAMPLE = ("40", "20", "0")  # sizes
# Shapes, with the meaning of their sizes.
_SHAPES = {
    "figure-eight": ("width", "height"),
    "spiral": ("first radius", "last radius"),
    "line": ("x", "y", "z"),
}


def scaled_path(path: trajectories.Trajectory, scale: float) -> trajectories.Trajectory:
    """Return a path scaled about its centre, at the same times.

    Parameters
    ----------
    path : Trajectory
        Points [m] and times [s].
    scale : float
        Its size relative to `path`.

    Returns
    -------
    Trajectory
        Its centre, that of the box around the points, does not change.
    """
    if not math.isfinite(number(scale, "scale")):
        raise ValueError(f"`scale` must be finite, got {scale!r}.")
    center = center_of(path)
    return trajectories.Trajectory(path.t, center + scale * (path.x - center))


def shape_path(
    model: HybridForwardModel,
    limits: PathLimits,
    shape: str,
    size: Sequence[float],
    *,
    center: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    turns: float = 3.0,
    rise: float = 0.0,
    duration: float = 10.0,
    dt: float = 0.02,
) -> trajectories.Trajectory:
    """Return the path of a named shape, in the workspace of a model.

    Parameters
    ----------
    model : HybridForwardModel
        The model, as from `open_model`.
    limits : PathLimits
        As from `path_limits`.
    shape : {"figure-eight", "spiral", "line"}
        Name of the shape.
    size : sequence of float
        Width (along the x-axis of the tips) and height of a figure eight; first and last radius of
        a spiral; x, y and z from end to end of a line [m].
    center : array-like of shape (3,), optional
        Centre of the shape [m]. Default: a tip in the domain of the model about which the whole
        shape lies in the domain, if possible, with the least error to expect.
    normal : array-like of shape (3,), optional
        Normal of its plane. Default: that of the plane nearest to these tips.
    turns : float, default=3.0
        Number of turns of a spiral.
    rise : float, default=0.0
        Rise of a spiral along the normal [m].
    duration, dt : float, default=10.0 and 0.02
        Time for the whole shape, and between its points [s].

    Returns
    -------
    Trajectory
        Points [m] and times [s].

    Raises
    ------
    ValueError
        If the number of sizes does not fit the shape.
    """
    sizes = _SHAPES[one_of(shape, "shape", _SHAPES)]
    extent = real_array(size, "size").tolist()
    if np.shape(extent) != (len(sizes),):
        example = ",".join(_EXAMPLE[: len(sizes)])
        raise ValueError(
            f"`size` does not fit: --size must be {len(sizes)} numbers for a {shape} "
            f"({', '.join(sizes)}), such as --size {example} --unit mm, got {size!r:.80}."
        )
    domain = Domain(model, limits)
    tips = domain.sample[1]
    middle = tips.mean(axis=0) if center is None else real_array(center, "center")
    plane: ArrayLike = _normal_of(tips, model) if normal is None else normal
    if shape == "figure-eight":
        path = trajectories.figure_eight(middle, extent, normal=plane, duration=duration, dt=dt)
    elif shape == "spiral":
        path = trajectories.spiral(
            middle,
            extent,
            normal=plane,
            turns=turns,
            rise=rise,
            duration=duration,
            dt=dt,
        )
    else:
        half = 0.5 * np.array(extent)
        path = trajectories.line(middle - half, middle + half, duration=duration, dt=dt)
    return placed(domain, path, _TOL)[0] if center is None else path


def _normal_of(tips: NDArray, model: HybridForwardModel) -> NDArray:
    """Return the normal (3,) of the plane nearest to tips (N, 3), along the base's z-axis."""
    normal = np.linalg.svd(tips - tips.mean(axis=0), full_matrices=False)[2][2]
    ahead = normal
    if has_body(model):
        ahead = model.module_.robot.base[:3, 2].numpy(force=True)
    return normal if normal @ ahead > 0.0 else -normal
