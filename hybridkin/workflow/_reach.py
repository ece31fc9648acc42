"""Check that a path lies within the reach of a robot; else the scale at which it does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin.ik.trajectories import Trajectory
from hybridkin.workflow._places import solver, some_rows
from hybridkin.workflow.domain import Domain
from hybridkin.workflow.path import scaled_path
from hybridkin.workflow.report import Progress, in_millimetres

_HALVINGS = 7
_OTHER_UNIT = (
    100.0  # a path this many times larger than the workspace is in another unit
)


def check_reach(
    domain: Domain, path: Trajectory, tol: float, force: bool, progress: Progress
) -> None:
    """Raise if a path is in another unit or, unless `force` is set, leaves the robot's reach."""
    limits = domain.limits
    (commands, tips) = domain.sample
    far, reach = (float(np.linalg.norm(x, axis=1).max()) for x in (path.x, tips))
    if far > _OTHER_UNIT * reach:
        raise ValueError(
            f"`path` goes {far:.4g} m from the origin, the tips of the robot {reach:.3g} m. This "
            "looks like millimetres read as metres; give --unit mm."
        )
    if force:
        return
    ik = solver(domain)
    rows = some_rows(path)

    def missed_by(scale: float, rows: NDArray) -> NDArray:
        progress("checking the reach", 0, 1)
        x = scaled_path(path, scale).x[rows]
        nearest = np.linalg.norm(tips - x[:, None], axis=2).argmin(axis=1)
        error = ik.solve(x, q0=commands[nearest], tol=tol, max_iter=100).error
        return np.where(error <= tol, 0.0, error)

    missed = missed_by(1.0, rows)
    far_out = rows[missed > 0.0]
    if len(far_out) == 0:
        return
    worst = path.x[rows[missed.argmax()]]
    ends = " to ".join(map(in_millimetres, (tips.min(axis=0), tips.max(axis=0))))
    way_out = f"its centre is out of reach too: tips go from {ends}; check --unit"
    if not missed_by(0.0, far_out[:1]).any():
        scale = 0.0
        for step in 0.5 ** np.arange(1, _HALVINGS + 1):
            scale += 0.0 if missed_by(scale + step, far_out).any() else step
        scale *= 0.99  # margin for points between the checked ones
        way_out = f"{scale:.2g} of its size, about its centre, can be reached: --scale {scale:.2g}"
    raise ValueError(
        f"`path` leaves the reach of the robot within its limits ({limits.source}): "
        f"{len(far_out)} of {len(rows)} checked points are out of reach, {in_millimetres(worst)} "
        f"by {1e3 * missed.max():.3g} mm; {way_out}. To track as closely as possible: --force."
    )
