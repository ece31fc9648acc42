"""The obstacles around a robot, and how near a track comes to each of them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import hybridkin
from hybridkin import HybridForwardModel, InverseKinematics, Track, obstacles
from hybridkin.app.workflow.report import Report, millimetres

_BODIES = 7  # of a track that a figure shows
_ROUNDING = 1e-6  # less than this below the clearance is rounding [m]


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What the body of a robot keeps clear of.

    Attributes
    ----------
    obstacles : sequence of Obstacle
        The obstacles.
    clearance : float
        Least distance between body and obstacles [m].
    """

    obstacles: Sequence[obstacles.Obstacle] = ()
    clearance: float = 0.0

    def __post_init__(self) -> None:
        """Check the obstacles."""
        is_list = isinstance(self.obstacles, Sequence)
        if not (is_list and all(map(_is_obstacle, self.obstacles))):
            raise TypeError(
                "`obstacles` must be a list of obstacles, as from obstacles.read_scene(path), got "
                f"{self.obstacles!r:.200}."
            )

    def distances(self, ik: InverseKinematics, q: NDArray) -> NDArray:
        """Return the distances (T, K) of the body at motions (T, n) to every obstacle [m]."""
        if not self:
            return np.empty((len(q), 0))
        return np.asarray(ik.body_distances(q))

    def __bool__(self) -> bool:
        """Return whether there are any obstacles."""
        return len(self.obstacles) > 0

    @property
    def names(self) -> list[str]:
        """Names of the obstacles, no two the same."""
        names = []
        counts = Counter[str]()
        for k, obstacle in enumerate(self.obstacles):
            name = obstacle.name or f"obstacle {k + 1}"
            counts[name] += 1
            if counts[name] > 1:
                name = f"{name} ({counts[name]})"
            names.append(name)
        return names


def _is_obstacle(value: object) -> bool:
    return isinstance(value, obstacles.Obstacle)


@dataclass(frozen=True)
class ObstacleDistance:
    """How near the body comes to an obstacle, by the model.

    Attributes
    ----------
    name : str
        The obstacle.
    path, lead_in : float
        Least distance along the path, and on the way to it [m]; negative inside the obstacle.
        Without a way to the path `lead_in` is infinite.
    """

    name: str
    path: float
    lead_in: float


def nearest_distances(
    surroundings: Surroundings, distances: NDArray, n_lead: int
) -> list[ObstacleDistance]:
    """Return the least of distances (T, K) to every obstacle; `n_lead` rows lead to the path."""
    on_way = distances[:n_lead].min(axis=0, initial=np.inf)
    on_path = distances[n_lead:].min(axis=0)
    rows = zip(surroundings.names, on_path.tolist(), on_way.tolist(), strict=True)
    return [ObstacleDistance(*row) for row in rows]


def add_distances(
    report: Report, nearest: Sequence[ObstacleDistance], clearance: float, blocked: int
) -> None:
    """Add to a report how near a track comes to obstacles, and whether it enters one."""
    if not nearest:
        return
    has_way = all(math.isfinite(row.lead_in) for row in nearest)
    header = ["smallest distance of the body [mm]", "path"]
    if has_way:
        header.append("lead-in")
    rows = []
    for row in nearest:
        cells = [row.name, f"{1e3 * row.path:.2f}"]
        if has_way:
            cells.append(f"{1e3 * row.lead_in:.2f}")
        rows.append(cells)
    report.table(header, rows)
    report.text(
        f"Distances are those of the model; clearance {millimetres(clearance)}. BLOCKED: {blocked} "
        "points, where an obstacle is in the way."
    )
    on_way = [row.name for row in nearest if row.lead_in < clearance - _ROUNDING]
    if on_way:
        report.text(
            "**The lead-in does not keep clear** of {names}: it goes straight from the start to "
            "the path. Move the robot to the path by another way, and give --from path.",
            names=", ".join(on_way),
        )
    on_path = [row.name for row in nearest if row.path < clearance - _ROUNDING]
    if on_path:
        report.text("**The path does not keep clear** of {names}.", names=", ".join(on_path))


def add_bodies(
    report: Report,
    surroundings: Surroundings,
    model: HybridForwardModel,
    track: Track,
    distances: NDArray,
) -> None:
    """Add a figure of the body among its obstacles, and of its distances (T, K) to them."""
    if not surroundings:
        return
    plots = hybridkin.plots
    figure, (ax, place) = plots.new_figure(10.0, 4.6, 1, 2)
    place.remove()
    space = figure.add_subplot(1, 2, 2, projection="3d")
    rows = np.unique(np.linspace(0, len(track.t) - 1, _BODIES).astype(int))
    bodies = plots.BackboneDisplay.from_estimator(
        model.module_.robot, track.effective[rows], obstacles=surroundings.obstacles
    )
    space.plot(*(1e3 * track.target.T), color="black", linewidth=1.0)
    bodies.plot(space, unit="mm")
    by_name = dict(zip(surroundings.names, distances.T, strict=True))
    plots.ClearanceDisplay(by_name, track.t, clearance=surroundings.clearance).plot(ax, unit="mm")
    caption = "Distances of the body to the obstacles, and the body along the path, by the model."
    report.figure("obstacles", figure, caption)
