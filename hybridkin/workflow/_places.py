"""Places for a path in the domain of a model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin.ik.results import IKStatus
from hybridkin.ik.solver import InverseKinematics
from hybridkin.ik.trajectories import Trajectory
from hybridkin.workflow.domain import Domain
from hybridkin.workflow.report import in_millimetres

_POINTS = (
    13  # of the path, evenly in time; the farthest points in each direction are added
)
_PLACES = 48  # places that are tried for a path


def placed(domain: Domain, path: Trajectory, tol: float) -> tuple[Trajectory, float]:
    """Return a path moved to where it lies in the domain, and the share of its points that does.

    Of equally good places it is the one with the least error to expect, or, for a model without
    held-out errors, the one nearest to the path.
    """
    commands, tips = domain.sample
    center = 0.5 * (path.x.min(axis=0) + path.x.max(axis=0))
    by_distance = np.argsort(np.linalg.norm(tips - center, axis=1))
    places = tips[by_distance[:: max(1, len(tips) // _PLACES)]]
    shifts = np.concatenate([np.zeros((1, 3)), places - center])
    x = path.x[some_rows(path)] + shifts[:, None]
    nearest = np.linalg.norm(tips - x[..., None, :], axis=-1).argmin(axis=-1)
    solution = solver(domain).solve(
        x, q0=commands[nearest], tol=tol, max_iter=100, restarts=0
    )
    inside = (solution.status == IKStatus.CONVERGED).mean(axis=1)
    good = np.flatnonzero(inside == inside.max())
    best = int(good[0])
    if promised := domain.loaded.promised_errors(
        solution.q[good].reshape(-1, commands.shape[1])
    ):
        best = int(good[promised["mean"].reshape(len(good), -1).mean(axis=1).argmin()])
    return Trajectory(path.t, path.x + shifts[best]), float(inside[best])


def better_place(domain: Domain, path: Trajectory, tol: float) -> str:
    """Return in words how a path that leaves the domain could lie in it."""
    moved, share_inside = placed(domain, path, tol)
    center = in_millimetres(0.5 * (moved.x.min(axis=0) + moved.x.max(axis=0)))
    if share_inside == 1.0:
        return f"move its centre to {center}"
    percent = f"{100 * share_inside:.0f} % is inside"
    return f"make it smaller (--scale); with its centre at {center}, {percent}"


def solver(domain: Domain) -> InverseKinematics:
    """Return the solver that looks for points of a path."""
    return InverseKinematics(
        domain.loaded.module,
        q_min=domain.limits.q_min,
        q_max=domain.limits.q_max,
        q_pref=domain.preferred,
    )


def some_rows(path: Trajectory) -> NDArray:
    """Return rows of a path: some evenly in time, and its ends in each direction."""
    evenly = np.linspace(0, len(path) - 1, _POINTS).astype(int)
    return np.unique([*evenly, *path.x.argmin(axis=0), *path.x.argmax(axis=0)])
