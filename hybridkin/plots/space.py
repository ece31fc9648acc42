"""The robot in space: its workspace coloured by error, and its body with its actuators."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin._core.arrays import whole
from hybridkin._core.texts import plot_label
from hybridkin.plots._arrays import distance, plain, shaped, shaped_or_empty
from hybridkin.plots._canvas import (
    ERROR,
    Display,
    Space,
    actuator_looks,
    label_space,
    scale_of,
    small_legend,
    space_or_new,
)
from hybridkin.plots._obstacles import Convex, extent, solids
from hybridkin.plots._scene import Line, add_obstacles
from hybridkin.plots.models import Model, body_of

_BODY = "#404040"
_AXES = ("#D55E00", "#009E73", "#0072B2")
_AXIS_LENGTH = 0.1  # of the backbone
_TOP = 0.99  # share of the errors within the colour scale, which outliers do not extend


class WorkspaceDisplay(Display):
    """Measured tips coloured by the model's error, and one robot (Fig. 2, left).

    Parameters
    ----------
    x : array-like of shape (N, 3)
        Measured tip positions [m].
    predicted : array-like of shape (N, 3)
        Predicted tip positions [m].
    backbone : array-like of shape (P, 3), optional
        Points along the robot in one configuration [m].
    row : int, optional
        The sample whose measured and predicted tip are joined by a line.

    Attributes
    ----------
    x, predicted : ndarray of shape (N, 3)
        Measured and predicted tips [m].
    ax_, figure_ : matplotlib Axes and Figure
        Where it was drawn last.

    Examples
    --------
    >>> import torch
    >>> from hybridkin import datasets, plots, robots
    >>> data = datasets.load_trunk()
    >>> chain = robots.bionic_handling_assistant()
    >>> predicted = chain(torch.from_numpy(data.q[:200]))
    >>> display = plots.WorkspaceDisplay(data.x[:200], predicted)
    >>> figure, ax = plots.new_figure(5.0, 4.0, subplot_kw={"projection": "3d"})
    >>> display.plot(ax).ax_.get_zlabel()
    'z [cm]'
    """

    def __init__(
        self,
        x: ArrayLike,
        predicted: ArrayLike,
        backbone: ArrayLike | None = None,
        row: int | None = None,
    ) -> None:
        self.x = shaped(x, "x", "N3")
        self.predicted = shaped(predicted, "predicted", "N3", len(self.x))
        self.backbone = shaped_or_empty(backbone, "backbone", "P3")
        self.row = row
        if row is not None:
            whole(row, "row", -len(self.x), len(self.x) - 1)

    def plot(self, ax: Axes | None = None, *, unit: str = "cm") -> Self:
        """Draw into a 3-D axes and return self; the colour scale ends at 99 % of the errors.

        Parameters
        ----------
        ax : matplotlib 3-D Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm"}, default="cm"
            Of the axes and of the errors.

        Returns
        -------
        WorkspaceDisplay
            Itself, drawn.
        """
        scale = scale_of(unit)
        space = space_or_new(ax)
        space.computed_zorder = False  # the robot in front of the cloud
        dots = self._draw_tips(space, scale)
        space.figure.colorbar(
            dots,
            ax=space,
            label=f"tip error [{unit}]",
            shrink=0.75,
            pad=0.1,
            extend="max",
        )
        if len(self.backbone):
            line = scale * self.backbone.T
            space.plot(*line, color=_BODY, linewidth=4, label="robot (model)")
        if self.row is not None:
            self._draw_row(space, scale, self.row)
        if len(self.backbone) or self.row is not None:
            small_legend(space, loc="upper center", bbox_to_anchor=(0.5, 0.03), ncols=3)
        label_space(space, unit)
        return self._drawn(space)

    def _draw_row(self, space: Space, scale: float, row: int) -> None:
        """Draw the measured and the predicted tip of a sample, joined by a line."""
        measured = scale * self.x[row]
        predicted = scale * self.predicted[row]
        ends = np.stack([measured, predicted], axis=1)
        space.plot(*ends, color="black", linewidth=1.5)
        space.scatter(*measured, color="black", s=30, label="measured tip", zorder=3)
        space.scatter(
            *predicted,
            s=30,
            label="predicted tip",
            zorder=3,
            facecolor="white",
            edgecolor="black",
            depthshade=False,
        )

    def _draw_tips(self, space: Space, scale: float) -> PathCollection:
        """Draw the measured tips, coloured by error, the worst in front."""
        errors = scale * distance(self.predicted, self.x)
        order = np.argsort(errors)
        order = order[np.isfinite(errors[order])]
        top = 1.0
        if len(order):
            top = float(np.quantile(errors[order], _TOP))
        tips = scale * self.x[order]
        return space.scatter(
            *tips.T,
            c=errors[order],
            s=7,
            cmap="cividis",
            vmin=0.0,
            vmax=top,
            depthshade=False,
            linewidths=0.0,
            alpha=0.8,
            rasterized=True,
        )


class BackboneDisplay(Display):
    """A robot's body in space: backbone, actuators, end disks, frames; one or more configurations.

    Parameters
    ----------
    points : array-like of shape (K, P, 3) or (P, 3)
        Points along each backbone, as from ``chain.backbone(q)`` [m]; of a row of NaN nothing is
        drawn.
    actuators : sequence of array-like of shape (K, P_i, 3), optional
        Points along every chamber or tendon [m].
    segments : sequence of int, optional
        The segment that each actuator bends, from 0; it gives the colour. Within a segment the
        first actuator is solid, the others are dashed and dotted. Default: all one.
    names : sequence of str, optional
        Names of the actuators, for the legend. Default: it names the segments.
    disks : array-like of shape (K, D, C, 3), optional
        Rims of the disks, C points each [m].
    frames : array-like of shape (K, F, 4, 4), optional
        Poses whose axes are shown.
    tips : array-like of shape (K, 3), optional
        Tips [m]. Default: the ends of the backbones.
    predicted : array-like of shape (K, 3), optional
        Tips that a learned model predicts [m]; the learned correction is dotted.
    rigid : bool, default=False
        Whether the points are joints with straight links between.
    obstacles : sequence of Obstacle, default=()
        Obstacles around the robot, from `hybridkin.obstacles`; one without an end, such as a
        half-space, is cut at the picture.

    Attributes
    ----------
    points : ndarray of shape (K, P, 3)
        As given [m]; likewise the others, without rows if they are absent.
    ax_, figure_ : matplotlib Axes and Figure
        Where it was drawn last.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import plots, robots
    >>> chain = robots.bionic_handling_assistant()
    >>> q = np.array([0.25, 0.3, 0.3, 0.25, 0.25, 0.3, 0.2, 0.25, 0.25])
    >>> display = plots.BackboneDisplay.from_estimator(chain, q)
    >>> len(display.actuators), display.disks.shape[1]
    (9, 4)
    >>> figure, ax = plots.new_figure(4.0, 5.0, subplot_kw={"projection": "3d"})
    >>> display.plot(ax, unit="mm").ax_.get_xlabel()
    'x [mm]'
    """

    def __init__(
        self,
        points: ArrayLike,
        *,
        actuators: Sequence[ArrayLike] = (),
        segments: Sequence[int] | None = None,
        names: Sequence[str] = (),
        disks: ArrayLike | None = None,
        frames: ArrayLike | None = None,
        tips: ArrayLike | None = None,
        predicted: ArrayLike | None = None,
        rigid: bool = False,
        obstacles: Sequence[Convex] = (),
    ) -> None:
        points = plain(points, "points")
        if points.ndim == 2:
            points = points[None]
        self.points = shaped(points, "points", "KP3")
        K = len(self.points)
        if not isinstance(actuators, Iterable):
            raise ValueError(f"`actuators` must hold arrays (K, P, 3), got {actuators!r:.80}.")
        self.actuators = tuple(shaped(path, "actuators", "KP3", K) for path in actuators)
        n = len(self.actuators)
        if segments is None:
            segments = (0,) * n
        self.segments = tuple(segments)
        if len(self.segments) != n:
            raise ValueError(f"`segments` must hold {n} numbers, one per actuator.")
        self.names = tuple(names)
        if len(self.names) not in (0, n):
            raise ValueError(f"`names` must hold {n} names, one per actuator, got {names!r:.80}.")
        self.disks = shaped_or_empty(disks, "disks", "KDC3", K)
        self.frames = shaped_or_empty(frames, "frames", "KF44", K)
        self.tips = shaped(self.points[:, -1] if tips is None else tips, "tips", "K3", K)
        self.predicted = shaped_or_empty(predicted, "predicted", "K3", K)
        self.rigid = rigid
        self.obstacles = solids(obstacles)

    @classmethod
    def from_estimator(
        cls,
        model: Model,
        q: ArrayLike,
        *,
        n_points: int = 12,
        tips: ArrayLike | None = None,
        names: Sequence[str] = (),
        obstacles: Sequence[Convex] = (),
    ) -> Self:
        """Return the body of a chain, or of a fitted hybrid model, in given configurations.

        Parameters
        ----------
        model : chain or HybridForwardModel
            A chain of arcs shows chambers or tendons, at their angles and radii, and disks at the
            ends of its segments; a `RigidChain` its links. A fitted hybrid model shows its
            mechanical part, calibrated when asked, and where it predicts the tip. With a serial
            correction the body ends at this tip, if the mechanical part can reach it.
        q : array-like of shape (K, n) or (n,)
            Actuator vectors; of a row with NaN nothing is drawn.
        n_points : int, default=12
            Points per segment.
        tips : array-like of shape (K, 3), optional
            Where the body ends [m], in the nearest configuration of the mechanical part that
            reaches it. Default: see `model`.
        names : sequence of str, optional
            Names of the actuators, see `BackboneDisplay`.
        obstacles : sequence of Obstacle, default=()
            Obstacles around the robot, see `BackboneDisplay`.

        Returns
        -------
        BackboneDisplay
            Not drawn yet.
        """
        return cls(**body_of(model, q, n_points, tips), names=names, obstacles=obstacles)

    def plot(self, ax: Axes | None = None, *, unit: str = "cm") -> Self:
        """Draw into a 3-D axes and return self.

        One configuration is drawn with all parts, several with backbones and tips only.

        Parameters
        ----------
        ax : matplotlib 3-D Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm"}, default="cm"
            Of the axes.

        Returns
        -------
        BackboneDisplay
            Itself, drawn.
        """
        scale = scale_of(unit)
        space = space_or_new(ax)
        drawn = np.flatnonzero(np.isfinite(self.points).all(axis=(1, 2)))
        if len(self.points) > 1:
            for k in drawn.tolist():
                self._draw_outline(space, k, scale)
        elif len(drawn):
            self._draw_body(space, scale)
        if space.get_legend_handles_labels()[1]:
            small_legend(space, loc="upper left")
        surroundings = [solid.scaled(scale) for solid in self.obstacles]
        space.auto_scale_xyz(*extent(surroundings).T, had_data=True)
        label_space(space, unit)
        add_obstacles(space, surroundings)
        return self._drawn(space)

    def lines(self, *, body: bool = True, tip: bool = True) -> list[Line]:
        """Return all strokes of the robot.

        Parameters
        ----------
        body, tip : bool, default=True
            Whether to return actuators and disks, where there are any, and the tip.

        Returns
        -------
        list of Line
            Named tuples (label, points, color, width, marker, style), points of shape
            (K, M, 3) [m] with NaN between strokes.
        """
        if self.rigid:
            lines = [Line("links and joints", self.points, _BODY, 4.0, marker="o")]
        else:
            lines = [Line("backbone", self.points, _BODY, 4.0)]
        if body:
            lines += self._actuator_lines()
        if body and self.disks.size:
            lines.append(Line("", _joined(self.disks.swapaxes(0, 1)), "#808080", 1.0))
        if tip:
            lines.append(Line("tip", self.tips[:, None], "black", 1.0, marker="o", style="none"))
        if len(self.predicted):
            way = np.stack([self.tips, self.predicted], axis=1)
            lines.append(Line("learned correction", way, ERROR, 1.5, style=":", marker="."))
        return lines

    def _actuator_lines(self) -> list[Line]:
        """Return the actuators, with the label of their name or their segment."""
        labels = self.names
        if not labels:
            labels = [f"actuators of segment {segment + 1}" for segment in self.segments]
        looks = actuator_looks(self.segments)
        lines = []
        for label, path, (color, style) in zip(labels, self.actuators, looks, strict=True):
            lines.append(Line(label, path, color, 1.6, style=style))
        return lines

    def _draw_outline(self, space: Space, k: int, scale: float) -> None:
        """Draw backbone and tip of one of several configurations."""
        color = colormaps["cividis"](k / len(self.points))
        for line in self.lines(body=False):
            points = scale * line.points[k]
            space.plot(*points.T, **line.look() | {"color": color})

    def _draw_body(self, space: Space, scale: float) -> None:
        """Draw all parts of the only configuration."""
        for line in self.lines():
            points = scale * line.points[0]
            space.plot(*points.T, label=plot_label(line.label) or None, **line.look())
        if self.disks.size:
            disks = scale * self.disks[0]
            space.add_collection3d(Poly3DCollection(disks, alpha=0.15, facecolor="0.5", lw=0.0))
        if len(self.frames):
            self._draw_frames(space, self.frames[0], scale)

    def _draw_frames(self, ax: Space, frames: NDArray, scale: float) -> None:
        steps = np.linalg.norm(np.diff(self.points, axis=1), axis=-1)
        size = _AXIS_LENGTH * float(np.nanmax(steps.sum(axis=-1)))
        origins = frames[:, :3, 3]
        for axis, (letter, color) in enumerate(zip("xyz", _AXES, strict=True)):
            ends = origins + size * frames[:, :3, axis]
            strokes = np.stack([origins, ends], axis=1)
            ax.plot(*(scale * _joined(strokes).T), color=color, linewidth=1.5)
            ax.text(*(scale * ends[-1]), letter, color=color, fontsize="small")


def _joined(paths: Iterable[NDArray]) -> NDArray:
    """Return paths (..., P_i, 3) one after another with a row of NaN between, as one line."""
    parts = []
    for path in paths:
        parts += [path, np.full((*path.shape[:-2], 1, 3), np.nan)]
    return np.concatenate(parts[:-1], axis=-2)
