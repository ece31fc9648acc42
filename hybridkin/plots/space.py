"""The robot in space: its workspace coloured by error, and its body with all that moves it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import ArrayLike, NDArray

from hybridkin.plots._body import body_of, mechanical_part
from hybridkin.plots._canvas import (
    COLORS,
    axes_or_new,
    distance,
    label_space,
    measured,
    plain,
    predicted,
    scale_of,
    tips,
)

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["BackboneDisplay", "WorkspaceDisplay"]

_BODY = "#404040"
# Of the segments' actuators: dark and light take turns, for prints without colour.
_SEGMENTS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9")
_AXES = ("#D55E00", "#009E73", "#0072B2")
_AXIS_LENGTH = 0.1  # of the backbone
_TOP = 0.99  # share of the errors within the colour scale: one outlier would darken the rest


class Line(NamedTuple):
    """One part of a body in all configurations, several strokes with NaN between them."""

    label: str
    points: NDArray  # (K, M, 3)
    color: str
    width: float
    alpha: float = 1.0
    marker: str = ""
    style: str = "-"


class WorkspaceDisplay:
    """Measured tips coloured by the model's error, with one robot among them (Fig. 2, left).

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
        Where it was drawn.

    Examples
    --------
    >>> from hybridkin import datasets, plots, robots
    >>> data = datasets.load_trunk()
    >>> chain = robots.bionic_handling_assistant()
    >>> display = plots.WorkspaceDisplay.from_estimator(chain, data.q[:200], data.x[:200])
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
        self.x = tips(x, "x")
        self.predicted = tips(predicted, "predicted", len(self.x))
        self.backbone = None if backbone is None else tips(backbone, "backbone")
        self.row = row
        if row is not None and not -len(self.x) <= row < len(self.x):
            raise ValueError(f"`row` must be one of the {len(self.x)} rows of `x`, got {row}.")

    @classmethod
    def from_estimator(
        cls, model: Any, q: ArrayLike, x: ArrayLike, *, row: int | None = None
    ) -> Self:
        """Return the display of a fitted model, or a chain, on measured rows.

        Parameters
        ----------
        model : estimator or nn.Module
            A fitted estimator or a chain. Where it has a backbone, its own or its mechanical
            part's, the robot is shown in one configuration.
        q : array-like of shape (N, n)
            Actuator vectors.
        x : array-like of shape (N, 3)
            Measured tips [m].
        row : int, optional
            The sample shown in full. Default: one that only 5 % of the rows err more than.

        Returns
        -------
        WorkspaceDisplay
            Not drawn yet.
        """
        x, p, q = tips(measured(model, x), "x"), predicted(model, q), plain(q, "q")
        errors = distance(tips(p, "predicted", len(x)), x)
        if row is None:
            ranks = np.argsort(errors)[: np.isfinite(errors).sum()]
            row = int(ranks[int(0.95 * len(ranks))]) if len(ranks) else None
        backbone = None
        if row is not None and hasattr(mechanical_part(model), "backbone"):
            backbone = body_of(model, q[row]).points[0]
        return cls(x, p, backbone, row)

    def plot(self, ax: Any = None, *, unit: str = "cm") -> Self:
        """Draw into a 3-D axes and return self; the colours end where 1 % of the errors is larger.

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
        scale, ax = scale_of(unit), axes_or_new(ax, projection="3d")
        errors = scale * distance(self.predicted, self.x)
        known = np.isfinite(errors)
        order = np.flatnonzero(known)[np.argsort(errors[known])]  # the worst in front
        top = float(np.quantile(errors[order], _TOP)) if len(order) else 1.0
        look = {"c": errors[order], "s": 7, "cmap": "cividis", "vmin": 0.0, "vmax": top}
        look |= {"depthshade": False, "linewidths": 0.0, "alpha": 0.8, "rasterized": True}
        ax.computed_zorder = False  # the robot in front of the cloud
        dots = ax.scatter(*(scale * self.x[order].T), **look)
        bar = {"label": f"tip error [{unit}]", "shrink": 0.7, "pad": 0.12, "extend": "max"}
        ax.figure.colorbar(dots, ax=ax, **bar)
        if self.backbone is not None:
            ax.plot(*(scale * self.backbone.T), color=COLORS[0], linewidth=5, label="robot (model)")
        if self.row is not None:
            ends = scale * np.stack([self.x[self.row], self.predicted[self.row]])
            ax.plot(*ends.T, color="black", linewidth=1.5)
            ax.scatter(*ends[:1].T, color="black", s=30, label="measured tip", zorder=3)
            ax.scatter(*ends[1:].T, color=COLORS[0], s=30, label="predicted tip", zorder=3)
        if self.backbone is not None or self.row is not None:
            ax.legend(frameon=False, loc="upper left")
        label_space(ax, unit)
        self.ax_, self.figure_ = ax, ax.figure
        return self


class BackboneDisplay:
    """A robot's body in space: backbone, actuators, end disks, frames; one or more configurations.

    Parameters
    ----------
    points : array-like of shape (K, P, 3) or (P, 3)
        Points along each backbone, as from ``chain.backbone(q)`` [m]; of a row of NaN nothing is
        drawn.
    actuators : sequence of array-like of shape (K, P_i, 3), optional
        Points along every chamber or tendon [m].
    segments : sequence of int, optional
        The segment that each actuator bends, from 0; it gives the colour. Default: all one.
    disks : array-like of shape (K, D, C, 3), optional
        Rims of the disks, C points each [m].
    frames : array-like of shape (K, F, 4, 4), optional
        Poses whose axes are shown.
    tips : array-like of shape (K, 3), optional
        The points that are steered [m]. Default: the ends of the backbones.
    predicted : array-like of shape (K, 3), optional
        Where a learned model puts these tips [m]; the learned correction is dotted.
    rigid : bool, default=False
        Whether the points are joints with straight links between.

    Attributes
    ----------
    points : ndarray of shape (K, P, 3)
        As given [m]; likewise the others.
    ax_, figure_ : matplotlib Axes and Figure
        Where it was drawn.

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
        disks: ArrayLike | None = None,
        frames: ArrayLike | None = None,
        tips: ArrayLike | None = None,
        predicted: ArrayLike | None = None,
        rigid: bool = False,
    ) -> None:
        points = plain(points, "points")
        self.points = _shaped(points[None] if points.ndim == 2 else points, "points", "KP3")
        K = len(self.points)
        self.actuators = tuple(_shaped(path, "actuators", "KP3", K) for path in actuators)
        self.segments = (0,) * len(self.actuators) if segments is None else tuple(segments)
        if len(self.segments) != len(self.actuators):
            raise ValueError(
                f"`segments` must hold {len(self.actuators)} numbers, one per actuator, got "
                f"{len(self.segments)}."
            )
        self.disks = None if disks is None else _shaped(disks, "disks", "KDC3", K)
        self.frames = None if frames is None else _shaped(frames, "frames", "KF44", K)
        self.tips = self.points[:, -1] if tips is None else _shaped(tips, "tips", "K3", K)
        self.predicted = None if predicted is None else _shaped(predicted, "predicted", "K3", K)
        self.rigid = rigid

    @classmethod
    def from_estimator(cls, model: Any, q: ArrayLike, *, n_points: int = 12) -> Self:
        """Return the body of a chain, or of a fitted hybrid model, in given configurations.

        Parameters
        ----------
        model : chain or HybridForwardModel
            A chain of arcs shows chambers or tendons, at their angles and radii, and disks at the
            ends of its segments; a `RigidChain` its links. A fitted hybrid model shows its
            mechanical part, calibrated when asked, and where it predicts the tip.
        q : array-like of shape (K, n) or (n,)
            Actuator vectors; of a row with NaN nothing is drawn.
        n_points : int, default=12
            Points per segment.

        Returns
        -------
        BackboneDisplay
            Not drawn yet.
        """
        return cls(**body_of(model, q, n_points)._asdict())

    def plot(
        self,
        ax: Any = None,
        *,
        unit: str = "cm",
        actuators: bool = True,
        disks: bool = True,
        frames: bool | None = None,
    ) -> Self:
        """Draw into a 3-D axes and return self.

        Parameters
        ----------
        ax : matplotlib 3-D Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm"}, default="cm"
            Of the axes.
        actuators, disks : bool, default=True
            Whether to draw them, where there are any.
        frames : bool, optional
            Likewise. Default: for a single configuration.

        Returns
        -------
        BackboneDisplay
            Itself, drawn.
        """
        scale, ax = scale_of(unit), axes_or_new(ax, projection="3d")
        several = len(self.points) > 1
        frames = not several if frames is None else frames
        lines = self.lines(actuators=actuators, disks=disks)
        for k in np.flatnonzero(np.isfinite(self.points).all(axis=(1, 2))):
            for line in lines:
                color = COLORS[k % 8] if several else line.color
                label = "" if several else line.label
                look = {"color": color, "linewidth": line.width, "alpha": line.alpha}
                look |= {"linestyle": line.style, "marker": line.marker, "markersize": 6}
                ax.plot(*(scale * line.points[k].T), **look, label=label or None)
            if disks and not several and self.disks is not None and self.disks.size:
                ax.add_collection3d(
                    Poly3DCollection(scale * self.disks[k], alpha=0.15, facecolor="0.5", lw=0.0)
                )
            if frames and self.frames is not None:
                self._draw_frames(ax, self.frames[k], scale)
        if ax.get_legend_handles_labels()[1]:
            ax.legend(frameon=False, loc="upper left", fontsize="small")
        label_space(ax, unit)
        self.ax_, self.figure_ = ax, ax.figure
        return self

    def lines(self, *, actuators: bool = True, disks: bool = True, tip: bool = True) -> list[Line]:
        """Return all strokes of the body, to be drawn by any means.

        Parameters
        ----------
        actuators, disks, tip : bool, default=True
            Whether to return those as well, where there are any.

        Returns
        -------
        list of Line
            Named tuples (label, points, color, width, alpha, marker, style), points of shape
            (K, M, 3) [m] with NaN between strokes.
        """
        name, marker = ("links and joints", "o") if self.rigid else ("backbone", "")
        found = [Line(name, self.points, _BODY, 4.0, marker=marker)]
        for s in sorted(set(self.segments)) if actuators else ():
            own = [p for p, of in zip(self.actuators, self.segments, strict=True) if of == s]
            label = f"actuators of segment {s + 1}"
            found.append(Line(label, _joined(own), _SEGMENTS[s % len(_SEGMENTS)], 1.6, 0.9))
        if disks and self.disks is not None and self.disks.size:
            found.append(Line("", _joined(self.disks.swapaxes(0, 1)), "#808080", 1.0))
        if tip:
            found.append(Line("tip", self.tips[:, None], "black", 1.0, marker="o", style="none"))
        if self.predicted is not None:
            way = np.stack([self.tips, self.predicted], axis=1)
            found.append(Line("learned correction", way, COLORS[0], 1.5, style=":", marker="."))
        return found

    def _draw_frames(self, ax: Any, frames: NDArray, scale: float) -> None:
        steps = np.linalg.norm(np.diff(self.points, axis=1), axis=-1)
        size = _AXIS_LENGTH * float(np.nanmax(steps.sum(axis=-1)))
        for axis, (letter, color) in enumerate(zip("xyz", _AXES, strict=True)):
            ends = frames[:, :3, 3] + size * frames[:, :3, axis]
            strokes = np.stack([frames[:, :3, 3], ends], axis=1)
            ax.plot(*(scale * _joined(strokes).T), color=color, linewidth=1.5)
            ax.text(*(scale * ends[-1]), letter, color=color, fontsize="small")


def _joined(paths: Iterable[NDArray]) -> NDArray:
    """Return paths (..., P_i, 3) one after another with a row of NaN between, as one line."""
    parts = []
    for path in paths:
        parts += [path, np.full((*path.shape[:-2], 1, 3), np.nan)]
    return np.concatenate(parts[:-1], axis=-2)


def _shaped(value: ArrayLike, name: str, letters: str, n_rows: int | None = None) -> NDArray:
    """Return an array whose shape agrees with letters, digits being sizes; K is `n_rows`."""
    array = plain(value, name)
    need = [str(n_rows) if x == "K" and n_rows is not None else x for x in letters]
    fits = array.ndim == len(need)
    if not fits or any(x.isdigit() and int(x) != n for x, n in zip(need, array.shape, strict=True)):
        raise ValueError(f"`{name}` must have shape ({', '.join(need)}), got {array.shape}.")
    return array
