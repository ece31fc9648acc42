"""The moving parts of a film or a page, as plain arrays, and the axes that show them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

from hybridkin._core.texts import plot_label
from hybridkin.plots._canvas import (
    DASHED_TARGET,
    TARGET,
    TIP,
    Space,
    label_space,
    small_legend,
)
from hybridkin.plots._obstacles import COLOR, OPACITY, Solid, surface_of

_TOP = (-0.1, -0.2, 1.0)  # where the name of an obstacle stands, for an eye at the usual place


class Line(NamedTuple):
    """One part of a figure in all configurations, strokes with NaN between them."""

    label: str
    points: NDArray  # (K, M, 3)
    color: str
    width: float
    marker: str = ""
    style: Any = "-"  # of matplotlib, or "none"

    def look(self) -> dict[str, Any]:
        """Return the look as arguments of matplotlib."""
        return {
            "color": self.color,
            "linewidth": self.width,
            "linestyle": self.style,
            "marker": self.marker,
            "markersize": 6,
        }


class Scene(NamedTuple):
    """A motion of T rows, K of them frames, in the unit of the axes."""

    unit: str
    low: NDArray  # (3,) corners of the box around all points
    high: NDArray
    x: NDArray  # (T, 3) path reached
    target: NDArray  # (T, 3), or (0, 3)
    error: NDArray  # (T,), or (0,)
    error_name: str
    steps: NDArray  # (T,) of the time axis
    when: str  # name of the time axis
    rows: NDArray  # (K,) rows that are frames
    moving: list[Line]
    captions: list[str]
    obstacles: list[Solid]


class Stage:
    """Axes that show one frame of a scene after another."""

    def __init__(self, scene: Scene, ax: Space, error_ax: Axes | None = None) -> None:
        self.scene = scene
        self.title_ax = error_ax or ax
        xlim, ylim, zlim = np.stack([scene.low, scene.high], axis=1)
        ax.set(xlim=xlim, ylim=ylim, zlim=zlim)
        label_space(ax, scene.unit)
        add_obstacles(ax, scene.obstacles)
        if len(scene.target):
            target = {"color": TARGET, "linewidth": 1.0, "linestyle": DASHED_TARGET}
            ax.plot(*scene.target.T, label="target", **target)
        trail = ax.plot([], [], [], color=TIP, linewidth=1.6, label="path reached")
        self.trail = trail[0]
        self.artists = []
        for line in scene.moving:
            artists = ax.plot([], [], [], label=plot_label(line.label) or None, **line.look())
            self.artists += artists
        small_legend(ax, loc="upper left", bbox_to_anchor=(-0.25, 1.0))
        self.cursor = None
        if error_ax is not None and len(scene.error):
            error_ax.plot(scene.steps, scene.error, color=TIP, linewidth=1.5)
            error_ax.set(xlabel=scene.when, ylabel=scene.error_name)
            error_ax.set_ylim(bottom=0.0)
            line = error_ax.axvline(scene.steps[0], color="black", linewidth=1.0)
            self.cursor = (line, error_ax.plot([], [], "o", color=TIP)[0])

    def show(self, k: int) -> None:
        """Move everything to frame k."""
        scene = self.scene
        row = scene.rows[k]
        self.trail.set_data_3d(*scene.x[: row + 1].T)
        for artist, line in zip(self.artists, scene.moving, strict=True):
            artist.set_data_3d(*line.points[k].T)
        self.title_ax.set_title(scene.captions[k], fontsize="medium")
        if self.cursor is not None:
            line, dot = self.cursor
            line.set_xdata(np.repeat(scene.steps[row], 2))
            dot.set_data([scene.steps[row]], [scene.error[row]])


def add_obstacles(ax: Space, obstacles: Sequence[Solid]) -> None:
    """Draw obstacles, in the unit of axes that have their limits."""
    low, high = np.array([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()]).T
    for solid in obstacles:
        surface = surface_of(solid, low, high)
        if not len(surface.faces):
            continue
        ax.add_collection3d(
            Poly3DCollection(
                surface.triangles, shade=True, facecolors=COLOR, alpha=OPACITY, linewidths=0.0
            )
        )
        if solid.name:
            place = surface.vertices[(surface.vertices @ _TOP).argmax()]
            ax.text(*place, plot_label(solid.name), fontsize="small")
