"""Pictures: Display classes that hold plain arrays and draw them (the only user of matplotlib)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "ActuatorDisplay",
    "BackboneDisplay",
    "BarDisplay",
    "ErrorBoxDisplay",
    "ErrorHistogramDisplay",
    "TrackingDisplay",
    "WorkspaceDisplay",
    "new_figure",
]

_UNITS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
# Okabe & Ito: told apart by colour-blind readers too.
_COLORS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#F0E442")
_STYLES = ("--", "-", "-.", ":")


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **options: Any
) -> tuple[Figure, Any]:
    """Return a figure outside pyplot's list, for files rather than windows, and its axes.

    Parameters
    ----------
    width, height : float
        Size [inch].
    rows, columns : int, default=1
        Grid of axes.
    **options
        Handed to ``Figure.subplots``.

    Returns
    -------
    figure : matplotlib Figure
        To be saved with ``figure.savefig``.
    axes : Axes or ndarray of Axes
        One, or the grid.
    """
    figure = Figure(figsize=(width, height), layout="constrained", dpi=200)
    return figure, figure.subplots(rows, columns, **options)


class _ErrorDisplay:
    def __init__(self, errors: Mapping[str, ArrayLike]) -> None:
        self.errors = {name: np.asarray(values, dtype=float) for name, values in errors.items()}

    @classmethod
    def from_predictions(cls, x: ArrayLike, predictions: Mapping[str, ArrayLike]) -> Any:
        """Return the display for measured tips `x` (N, 3) and predicted ones by model [m]."""
        x = np.asarray(x)
        return cls({name: _distance(np.asarray(p), x) for name, p in predictions.items()})


class ErrorHistogramDisplay(_ErrorDisplay):
    """Histogram of tip errors, one outline per model (Fig. 2, right, of the paper).

    Parameters
    ----------
    errors : mapping of str to array-like of shape (N,)
        Tip distances of each model [m].
    """

    def plot(self, ax: Any = None, *, unit: str = "cm", bins: int = 40) -> Any:
        """Draw the histograms, the mean of each model marked, and return self."""
        ax = _axes(ax)
        scale = _UNITS[unit]
        top = scale * max(float(values.max()) for values in self.errors.values())
        edges = np.linspace(0.0, top, bins + 1)
        for i, (name, values) in enumerate(self.errors.items()):
            color, values = _COLORS[i % 8], scale * values
            label = f"{name}: mean {values.mean():.2f}, max {values.max():.1f} {unit}"
            ax.hist(values, edges, histtype="stepfilled", color=color, alpha=0.25)
            ax.hist(values, edges, histtype="step", color=color, linewidth=1.5, label=label)
            ax.axvline(values.mean(), color=color, linestyle="--", linewidth=1.0)
        ax.set(xlabel=f"tip error [{unit}]", ylabel="configurations", xlim=(0.0, top))
        ax.legend(frameon=False)
        self.ax_ = ax
        return self


class ErrorBoxDisplay(_ErrorDisplay):
    """Spread of tip errors side by side: box from quartile to quartile, whiskers to 5 and 95 %.

    Parameters
    ----------
    errors : mapping of str to array-like of shape (N,)
        Tip distances of each model [m].
    """

    def plot(self, ax: Any = None, *, unit: str = "cm") -> Any:
        """Draw horizontal boxes with the mean (dot) and the maximum (cross) and return self."""
        ax = _axes(ax)
        scale = _UNITS[unit]
        names = [*self.errors][::-1]
        values = [scale * self.errors[name] for name in names]
        box = ax.boxplot(
            values,
            orientation="horizontal",
            whis=(5, 95),
            showfliers=False,
            widths=0.6,
            patch_artist=True,
            medianprops={"color": "black"},
        )
        for i, patch in enumerate(box["boxes"]):
            patch.set(facecolor=_COLORS[(len(names) - 1 - i) % 8], alpha=0.35)
        places = np.arange(1, len(names) + 1)
        ax.plot([v.mean() for v in values], places, "o", color="black", label="mean")
        ax.plot([v.max() for v in values], places, "x", color="black", label="maximum")
        ax.set_yticks(places, names)
        ax.set(xlabel=f"tip error [{unit}]")
        ax.set_xlim(left=0.0)
        ax.legend(frameon=False)
        self.ax_ = ax
        return self


class BarDisplay:
    """Named values with their spread, as dots with bars.

    Parameters
    ----------
    names : sequence of str
        One per value.
    values, spreads : array-like of shape (K,)
        Values, and half the length of each bar.
    """

    def __init__(self, names: Sequence[str], values: ArrayLike, spreads: ArrayLike) -> None:
        self.names = list(names)
        self.values = np.asarray(values, dtype=float)
        self.spreads = np.asarray(spreads, dtype=float)

    def plot(self, ax: Any = None, *, label: str = "") -> Any:
        """Draw one row per name, the first on top, and return self."""
        ax = _axes(ax)
        places = np.arange(len(self.names))[::-1]
        below = np.minimum(self.spreads, self.values)
        bars = np.stack([below, self.spreads])
        ax.errorbar(self.values, places, xerr=bars, fmt="o", color=_COLORS[1], capsize=3)
        for place, value in zip(places, self.values, strict=True):
            ax.annotate(
                f"{value:.2f}",
                (value, place),
                (0, 5),
                textcoords="offset points",
                ha="center",
                fontsize="small",
            )
        ax.set_yticks(places, self.names)
        ax.set(xlabel=label, ylim=(-0.7, len(self.names) - 0.3))
        ax.set_xlim(left=0.0)
        self.ax_ = ax
        return self


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
    """

    def __init__(
        self,
        x: ArrayLike,
        predicted: ArrayLike,
        backbone: ArrayLike | None = None,
        row: int | None = None,
    ) -> None:
        self.x = np.asarray(x, dtype=float)
        self.predicted = np.asarray(predicted, dtype=float)
        self.backbone = None if backbone is None else np.asarray(backbone, dtype=float)
        self.row = row

    def plot(self, ax: Any = None, *, unit: str = "cm") -> Any:
        """Draw into a 3-D axes and return self."""
        ax = _axes(ax, projection="3d")
        scale = _UNITS[unit]
        errors = scale * _distance(self.predicted, self.x)
        dots = ax.scatter(*(scale * self.x.T), c=errors, s=6, cmap="cividis", alpha=0.8)
        ax.figure.colorbar(dots, ax=ax, label=f"tip error [{unit}]", shrink=0.7, pad=0.12)
        if self.backbone is not None:
            ax.plot(
                *(scale * self.backbone.T), color=_COLORS[0], linewidth=5, label="robot (model)"
            )
        if self.row is not None:
            ends = scale * np.stack([self.x[self.row], self.predicted[self.row]])
            ax.plot(*ends.T, color="black", linewidth=1.5)
            ax.scatter(*ends[:1].T, color="black", s=30, label="measured tip")
            ax.scatter(*ends[1:].T, color=_COLORS[0], s=30, label="predicted tip")
        if self.backbone is not None or self.row is not None:
            ax.legend(frameon=False, loc="upper left")
        _label_space(ax, unit)
        self.ax_ = ax
        return self


class BackboneDisplay:
    """Backbones in space, one curve per configuration.

    Parameters
    ----------
    points : array-like of shape (K, P, 3) or (P, 3)
        Points along each backbone, as from ``chain.backbone(q)`` [m].
    """

    def __init__(self, points: ArrayLike) -> None:
        points = np.asarray(points, dtype=float)
        self.points = points[None] if points.ndim == 2 else points

    def plot(self, ax: Any = None, *, unit: str = "cm") -> Any:
        """Draw into a 3-D axes and return self."""
        ax = _axes(ax, projection="3d")
        for i, curve in enumerate(_UNITS[unit] * self.points):
            ax.plot(*curve.T, color=_COLORS[i % 8], linewidth=3)
            ax.scatter(*curve[-1:].T, color=_COLORS[i % 8], s=25)
        _label_space(ax, unit)
        self.ax_ = ax
        return self


class TrackingDisplay:
    """A target path and how each model followed it (Fig. 3).

    Parameters
    ----------
    target : array-like of shape (T, 3)
        Path to follow [m].
    tracks : mapping of str to array-like of shape (T, 3)
        Tip positions reached with each model [m].
    t : array-like of shape (T,), optional
        Times [s]. Default: time steps.
    """

    def __init__(
        self, target: ArrayLike, tracks: Mapping[str, ArrayLike], t: ArrayLike | None = None
    ) -> None:
        self.target = np.asarray(target, dtype=float)
        self.tracks = {name: np.asarray(x, dtype=float) for name, x in tracks.items()}
        self.t = None if t is None else np.asarray(t, dtype=float)

    def plot(self, ax: Any = None, *, unit: str = "cm", plane: str = "xy") -> Any:
        """Draw the paths in one plane of the task space and return self."""
        ax = _axes(ax)
        i, j = ("xyz".index(letter) for letter in plane)
        scale = _UNITS[unit]
        for (name, x), color, style in self._styled():
            mean = scale * np.nanmean(_distance(x, self.target))
            label = f"{name}: mean error {mean:.2f} {unit}"
            ax.plot(scale * x[:, i], scale * x[:, j], style, color=color, label=label)
        target = scale * self.target
        ax.plot(target[:, i], target[:, j], color="black", linewidth=1.0, label="target")
        ax.set(xlabel=f"{plane[0]} [{unit}]", ylabel=f"{plane[1]} [{unit}]")
        ax.set_aspect("equal", adjustable="datalim")
        ax.legend(frameon=False, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.16))
        self.ax_ = ax
        return self

    def plot_time(self, ax: Any = None, *, unit: str = "cm") -> Any:
        """Draw the three coordinates over time and return self."""
        ax = _axes(ax)
        scale = _UNITS[unit]
        steps = np.arange(len(self.target)) if self.t is None else self.t
        for (_, x), color, style in self._styled():
            ax.plot(steps, scale * x, style, color=color, linewidth=1.2)
        ax.plot(steps, scale * self.target, color="black", linewidth=1.0)
        for letter, values in zip("xyz", scale * self.target.T, strict=True):
            top = int(values.argmax())
            ax.annotate(letter, (steps[top], values[top]), (0, 3), textcoords="offset points")
        ax.margins(y=0.08)
        ax.set(xlabel="time step" if self.t is None else "time [s]", ylabel=f"tip [{unit}]")
        self.ax_ = ax
        return self

    def _styled(self) -> list[tuple[tuple[str, NDArray], str, str]]:
        items = enumerate(self.tracks.items())
        return [(item, _COLORS[k % 8], _STYLES[k % 4]) for k, item in items]


class ActuatorDisplay:
    """Actuator lengths over time, one panel per segment (Fig. 4, right).

    Parameters
    ----------
    paths : mapping of str to array-like of shape (T, n)
        Commanded actuator vectors of each model [m].
    actuators_per_segment : sequence of int
        How the n actuators share out over the segments.
    t : array-like of shape (T,), optional
        Times [s]. Default: time steps.
    """

    def __init__(
        self,
        paths: Mapping[str, ArrayLike],
        actuators_per_segment: Sequence[int],
        t: ArrayLike | None = None,
    ) -> None:
        self.paths = {name: np.asarray(q, dtype=float) for name, q in paths.items()}
        self.actuators_per_segment = tuple(actuators_per_segment)
        self.t = None if t is None else np.asarray(t, dtype=float)

    def plot(self, axes: Any = None, *, unit: str = "cm") -> Any:
        """Draw one axes per segment, sharing time, and return self."""
        n = len(self.actuators_per_segment)
        if axes is None:
            axes = plt.subplots(n, 1, sharex=True, squeeze=False)[1][:, 0]
        ends = np.cumsum(self.actuators_per_segment)
        for k, ax in enumerate(axes):
            for i, (name, q) in enumerate(self.paths.items()):
                steps = np.arange(len(q)) if self.t is None else self.t
                part = _UNITS[unit] * q[:, ends[k] - self.actuators_per_segment[k] : ends[k]]
                style = _STYLES[i % 4]
                lines = ax.plot(steps, part, style, color=_COLORS[i % 8], linewidth=1.2)
                lines[0].set_label(name)
            ax.set(ylabel=f"segment {k + 1} [{unit}]")
        axes[0].legend(frameon=False, fontsize="small", ncols=len(self.paths))
        axes[-1].set(xlabel="time step" if self.t is None else "time [s]")
        self.axes_ = axes
        return self


def _axes(ax: Any, projection: str | None = None) -> Any:
    return ax if ax is not None else plt.figure().add_subplot(projection=projection)


def _label_space(ax: Any, unit: str) -> None:
    ax.set(xlabel=f"x [{unit}]", ylabel=f"y [{unit}]", zlabel=f"z [{unit}]")
    ax.set_aspect("equal")


def _distance(a: NDArray, b: NDArray) -> NDArray:
    return np.linalg.norm(a - b, axis=-1)
