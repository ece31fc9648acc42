"""Whether a path lies in the reach of a robot, and where it lies in the domain of its model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin import IKStatus, trajectories
from hybridkin.app.workflow.domain import Domain
from hybridkin.app.workflow.model import promised_errors
from hybridkin.app.workflow.report import (
    Progress,
    millimetres,
    percent,
    point_in_millimetres,
)
from hybridkin.formats import rough_unit

_POINTS = 13  # of the path, evenly in time; its ends in each direction are added
_PLACES = 48  # places that are tried for a path
_HALVINGS = 7
_ITERATIONS = 100
_MOST_MISSED = 0.1  # share of the checked points of a path that does not leave the reach
_OTHER_UNIT = 20.0  # a path this many times larger than the workspace: another unit


def center_of(path: trajectories.Trajectory) -> NDArray:
    """Return the centre (3,) of the box around the points of a path [m]."""
    return 0.5 * (path.x.min(axis=0) + path.x.max(axis=0))


def placed(
    domain: Domain, path: trajectories.Trajectory, tol: float
) -> tuple[trajectories.Trajectory, float]:
    """Return a path moved to where it lies in the domain, and the share of its points that does.

    Of equally good places it is the one with the least error to expect, or, for a model without
    held-out errors, the one nearest to the path.
    """
    tips = domain.sample[1]
    center = center_of(path)
    by_distance = np.argsort(np.linalg.norm(tips - center, axis=1))
    places = tips[by_distance[:: max(1, len(tips) // _PLACES)]]
    shifts = np.concatenate([np.zeros((1, 3)), places - center])
    x = path.x[_some_rows(path)] + shifts[:, None]
    solution = domain.solver().solve(
        x, q0=domain.nearest(x), tol=tol, max_iter=_ITERATIONS, restarts=0
    )
    inside = (solution.status == IKStatus.CONVERGED).mean(axis=1)
    good = np.flatnonzero(inside == inside.max())
    best = int(good[0])
    q = solution.q[good]
    promised = promised_errors(domain.model, q.reshape(-1, q.shape[-1]))
    if promised.known:
        best = int(good[promised.mean.reshape(len(good), -1).mean(axis=1).argmin()])
    return trajectories.Trajectory(path.t, path.x + shifts[best]), float(inside[best])


def better_place(domain: Domain, path: trajectories.Trajectory, tol: float) -> str:
    """Return in words how a path that leaves the domain could lie in it."""
    moved, share_inside = placed(domain, path, tol)
    center = point_in_millimetres(center_of(moved))
    if share_inside == 1.0:
        return f"move its centre to {center}"
    inside = percent(share_inside)
    return f"make it smaller (--scale); with its centre at {center}, {inside} is inside"


def check_reach(
    domain: Domain,
    path: trajectories.Trajectory,
    tol: float,
    out_of_reach: bool,
    progress: Progress,
) -> None:
    """Raise if a path is in another unit or, unless `out_of_reach` is set, leaves the reach.

    A path leaves the reach if more than a tenth of the checked points are missed.
    """
    tips = domain.sample[1]
    far = np.linalg.norm(path.x, axis=1).max()
    reach = np.linalg.norm(tips, axis=1).max()
    if far > _OTHER_UNIT * reach:
        unit = rough_unit(far / reach)
        raise ValueError(
            f"`path` goes {far:.4g} m from the origin, the tips of the robot {reach:.3g} m. This "
            f"looks like {unit.name} read as metres; give --unit {unit.symbol}."
        )
    if out_of_reach:
        return
    center = center_of(path)

    def missed_by(scale: float, rows: NDArray) -> NDArray:
        """Return by how much points of the scaled path are missed (k,) [m]; reached: 0."""
        progress("checking the reach", 0, 1)
        x = center + scale * (path.x[rows] - center)
        solution = domain.solver().solve(x, q0=domain.nearest(x), tol=tol, max_iter=_ITERATIONS)
        return np.where(solution.error <= tol, 0.0, solution.error)

    rows = _some_rows(path)
    missed = missed_by(1.0, rows)
    far_out = rows[missed > 0.0]
    if len(far_out) <= _MOST_MISSED * len(rows):
        return
    if missed_by(0.0, far_out[:1]).any():
        low = point_in_millimetres(tips.min(axis=0))
        high = point_in_millimetres(tips.max(axis=0))
        way_out = f"its centre is out of reach too: tips go from {low} to {high}; check --unit"
    else:
        scale = 0.0
        for step in 0.5 ** np.arange(1, _HALVINGS + 1):
            if not missed_by(scale + step, far_out).any():
                scale += step
        scale *= 0.99  # margin for points between the checked ones
        way_out = f"{scale:.2g} of its size, about its centre, can be reached: --scale {scale:.2g}"
    worst = point_in_millimetres(path.x[rows[missed.argmax()]])
    raise ValueError(
        "`path` (of the file or --shape) leaves the reach of the robot within its limits "
        f"({domain.limits.source}): {len(far_out)} of {len(rows)} checked points are out of reach, "
        f"{worst} by {millimetres(missed.max())}; {way_out}. To track as closely as possible: "
        "--out-of-reach."
    )


def _some_rows(path: trajectories.Trajectory) -> NDArray:
    """Return rows of a path: some evenly in time, and its ends in each direction."""
    evenly = np.linspace(0, len(path) - 1, _POINTS).astype(int)
    return np.unique([*evenly, *path.x.argmin(axis=0), *path.x.argmax(axis=0)])
