"""Tracks: target and tips in a plane and over time, errors and actuators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin._core.arrays import one_of, whole
from hybridkin._core.texts import plot_label
from hybridkin.plots._arrays import (
    distance,
    named,
    plain,
    shaped,
    shaped_or_empty,
    times,
)
from hybridkin.plots._canvas import (
    DASHED_TARGET,
    LENGTHS,
    NAMED,
    STYLES,
    TARGET,
    Display,
    actuator_looks,
    axes_or_new,
    decimals,
    legend_below,
    looks_of,
    pale,
    scale_of,
    small_legend,
    steps_of,
)

_ACTUATOR_UNITS = {**LENGTHS, "rad": 1.0, "deg": 180.0 / np.pi}
_TARGET = {"color": TARGET, "linewidth": 1.0, "linestyle": DASHED_TARGET, "label": "target"}
_LIMITS = (0, (1.0, 5.0))  # style of their lines, which no actuator has
_PLANES = ("xy", "xz", "yx", "yz", "zx", "zy")


class _Followed(Protocol):
    """A result of `InverseKinematics.track`."""

    @property
    def t(self) -> ArrayLike: ...
    @property
    def q(self) -> ArrayLike: ...
    @property
    def x(self) -> ArrayLike: ...
    @property
    def x_measured(self) -> ArrayLike | None: ...
    @property
    def target(self) -> ArrayLike: ...


class TrackingDisplay(Display):
    """A target path and the tracks of models (Fig. 3).

    Parameters
    ----------
    target : array-like of shape (T, 3)
        Path to follow [m].
    tracks : mapping of str to array-like of shape (T, 3)
        Tip positions reached with each model [m], NaN where they are not known.
    t : array-like of shape (T,), optional
        Times [s]. Default: time steps.

    Attributes
    ----------
    target : ndarray of shape (T, 3)
        The path [m].
    tracks : dict of str to ndarray of shape (T, 3)
        Tips [m].
    ax_, figure_ : matplotlib Axes and Figure
        Where it was drawn last.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import InverseKinematics, plots, robots, trajectories
    >>> path = trajectories.figure_eight([0.0, 0.0, 0.75], (0.2, 0.1), duration=2.0, dt=0.05)
    >>> ik = InverseKinematics(robots.bionic_handling_assistant(), q_min=0.1, q_max=0.4, dt=0.05)
    >>> track = ik.track(path.x, path.t)
    >>> figure, axes = plots.new_figure(8.0, 3.0, 1, 2)
    >>> display = plots.TrackingDisplay.from_tracks({"mechanical model": track})
    >>> display.plot(axes[0]).plot_error(axes[1], unit="mm").ax_.get_ylabel()
    'tip error [mm]'
    """

    def __init__(
        self,
        target: ArrayLike,
        tracks: Mapping[str, ArrayLike],
        t: ArrayLike | None = None,
    ) -> None:
        self.target = shaped(target, "target", "T3")
        T = len(self.target)
        self.tracks = {
            name: shaped(x, f"tracks[{name!r}]", "T3", T)
            for name, x in named(tracks, "tracks").items()
        }
        self.t = times(t, T)

    @classmethod
    def from_tracks(cls, tracks: Mapping[str, _Followed]) -> Self:
        """Return the display of results of `InverseKinematics.track`.

        Parameters
        ----------
        tracks : mapping of str to Track
            Of the same path. With a plant the measured tips are shown, else those of the model.

        Returns
        -------
        TrackingDisplay
            Not drawn yet.
        """
        first = next(iter(named(tracks, "tracks").values()))
        target = shaped(first.target, "target", "T3")
        reached = {}
        for name, track in tracks.items():
            if not np.array_equal(plain(track.target), target, equal_nan=True):
                raise ValueError("`tracks` must follow one path, got different targets.")
            reached[name] = track.x if track.x_measured is None else track.x_measured
        return cls(target, reached, first.t)

    def plot(self, ax: Axes | None = None, *, unit: str = "cm", plane: str = "xy") -> Self:
        """Draw the paths in one plane of the task space and return self.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm"}, default="cm"
            Of the axes.
        plane : {"xy", "xz", "yz", "yx", "zx", "zy"}, default="xy"
            Horizontal, then vertical axis.

        Returns
        -------
        TrackingDisplay
            Itself, drawn.
        """
        one_of(plane, "plane", _PLANES)
        scale = scale_of(unit)
        ax = axes_or_new(ax)
        columns = [*map("xyz".index, plane)]
        for name, x, look in self._looks():
            label = self._summary(name, scale, unit)
            ax.plot(*(scale * x[:, columns].T), label=label, **look)
        target = scale * self.target[:, columns]
        ax.plot(*target.T, **_TARGET)
        ax.set(xlabel=f"{plane[0]} [{unit}]", ylabel=f"{plane[1]} [{unit}]")
        ax.set_aspect("equal", adjustable="datalim")
        legend_below(ax)
        return self._drawn(ax)

    def plot_time(self, ax: Axes | None = None, *, unit: str = "cm") -> Self:
        """Draw the three coordinates over time and return self; parameters as of `plot`."""
        scale = scale_of(unit)
        ax = axes_or_new(ax)
        steps, when = steps_of(self.t, len(self.target))
        for name, x, look in self._looks():
            lines = ax.plot(steps, scale * x, **{**look, "linewidth": 1.2})
            lines[0].set_label(plot_label(name))
        lines = ax.plot(steps, scale * self.target, **_TARGET)
        for line in lines[1:]:
            line.set_label("")
        for letter, values in zip("xyz", scale * self.target.T, strict=True):
            if np.isfinite(values).any():
                top = int(np.nanargmax(values))
                ax.annotate(
                    letter,
                    (steps[top], values[top]),
                    (0, 3),
                    textcoords="offset points",
                )
        ax.margins(y=0.08)
        ax.set(xlabel=when, ylabel=f"tip [{unit}]")
        legend_below(ax)
        return self._drawn(ax)

    def plot_error(
        self,
        ax: Axes | None = None,
        *,
        unit: str = "cm",
        expected: Mapping[str, ArrayLike] | None = None,
    ) -> Self:
        """Draw the distances to the target over time and return self.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm"}, default="cm"
            Unit of the error.
        expected : mapping of str to float or array-like of shape (T,), optional
            Expected errors of the robot [m], such as the error on held-out motions. They make the
            axis logarithmic, because the error of the solver on a model is far smaller.

        Returns
        -------
        TrackingDisplay
            Itself, drawn.
        """
        scale = scale_of(unit)
        ax = axes_or_new(ax)
        steps, when = steps_of(self.t, len(self.target))
        for name, x, look in self._looks():
            error = scale * distance(x, self.target)
            ax.plot(steps, error, label=self._summary(name, scale, unit), **look)
        ax.set(xlabel=when, ylabel=f"tip error [{unit}]")
        if len(steps) > 1:
            ax.set_xlim(steps[0], steps[-1])
        levels = dict(expected or {})
        least = []
        for (label, level), style in zip(levels.items(), STYLES * 2, strict=False):
            level = np.broadcast_to(scale * plain(level, "expected"), len(steps))
            finite = level[np.isfinite(level)]
            if finite.size:
                least.append(finite.min())
                label = f"{label}: {finite.mean():.3g} {unit}"
            ax.plot(steps, level, color="black", linestyle=style, label=plot_label(label))
        if least:
            ax.set_yscale("log")
            ax.set_ylim(bottom=max(ax.get_ylim()[0], 1e-4 * min(least)))
        else:
            ax.set_ylim(bottom=0.0)
        legend_below(ax)
        return self._drawn(ax)

    def _looks(self) -> list[tuple[str, NDArray, dict[str, Any]]]:
        """Return name, tips and look of every track."""
        return [*zip(self.tracks, self.tracks.values(), looks_of(self.tracks), strict=True)]

    def _summary(self, name: str, scale: float, unit: str) -> str:
        error = scale * distance(self.tracks[name], self.target)
        finite = error[np.isfinite(error)]
        mean = finite.mean() if finite.size else np.nan
        return f"{plot_label(name)}: mean error {mean:.{decimals(mean)}f} {unit}"


class ActuatorDisplay:
    """Actuator lengths over time, one panel per segment (Fig. 4, right).

    Models differ in colour, and the actuators of a segment in line style, the first solid. With
    names actuators differ in both, and the second model is pale and wide, the third more so.

    Parameters
    ----------
    paths : mapping of str to array-like of shape (T, n)
        Commanded actuator vectors of each model [m], of revolute joints [rad].
    actuators_per_segment : sequence of int
        Number of actuators of each segment.
    t : array-like of shape (T,), optional
        Times [s]. Default: time steps.
    names : sequence of n str, optional
        Names of the actuators, for the legend.
    limits : array-like of shape (2, n), optional
        Least and largest value of every actuator [m], of revolute joints [rad].

    Attributes
    ----------
    paths : dict of str to ndarray of shape (T, n)
        As given.
    axes_, figure_ : ndarray of shape (S,) of Axes, and Figure
        Where it was drawn last.
    """

    def __init__(
        self,
        paths: Mapping[str, ArrayLike],
        actuators_per_segment: Sequence[int],
        t: ArrayLike | None = None,
        *,
        names: Sequence[str] | None = None,
        limits: ArrayLike | None = None,
    ) -> None:
        counts = np.ravel(np.asarray(actuators_per_segment, dtype=object))
        self.actuators_per_segment = tuple(whole(k, "actuators_per_segment") for k in counts)
        n = sum(self.actuators_per_segment)
        self.paths = {name: plain(q, "paths") for name, q in named(paths, "paths").items()}
        rows = next(iter(self.paths.values())).shape[:1]
        for name, q in self.paths.items():
            if q.shape != (*rows, n):
                raise ValueError(
                    f"`paths` must hold arrays of one shape (T, {n}), as `actuators_per_segment` "
                    f"says, got {q.shape} for {name!r}; the first has {rows} rows."
                )
        self.t = times(t, *rows)
        self.names: list[str] = []
        if names is not None:
            self.names = [*map(str, np.ravel(np.asarray(names, dtype=object)))]
            if len(self.names) != n:
                raise ValueError(
                    f"`names` must hold {n} names, one per actuator, got {names!r:.80}."
                )
        self.limits = shaped_or_empty(limits, "limits", ("2", n))

    @classmethod
    def from_tracks(
        cls, tracks: Mapping[str, _Followed], actuators_per_segment: Sequence[int]
    ) -> Self:
        """Return the display of results of `InverseKinematics.track`.

        Parameters
        ----------
        tracks : mapping of str to Track
            With the same times.
        actuators_per_segment : sequence of int
            As ``chain.actuators_per_segment``.

        Returns
        -------
        ActuatorDisplay
            Not drawn yet.
        """
        first = next(iter(named(tracks, "tracks").values()))
        paths = {name: track.q for name, track in tracks.items()}
        return cls(paths, actuators_per_segment, first.t)

    def plot(
        self,
        axes: Sequence[Axes] | NDArray | None = None,
        *,
        unit: str = "cm",
        per_unit: ArrayLike | None = None,
    ) -> Self:
        """Draw one axes per segment, sharing time, and return self.

        Parameters
        ----------
        axes : sequence of S matplotlib Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm", "rad", "deg"}, default="cm"
            Unit of the actuators.
        per_unit : float or array-like of shape (n,), optional
            Divisor in place of the size of `unit`, which is then only a name [m]: -0.001 for
            millimetres of pulled tendons.

        Returns
        -------
        ActuatorDisplay
            Itself, drawn.
        """
        counts = self.actuators_per_segment
        n = len(counts)
        if per_unit is None:
            scale = scale_of(unit, _ACTUATOR_UNITS)
        else:
            size = plain(per_unit, "per_unit")
            if size.shape not in ((), (sum(counts),)) or not size.all():
                raise ValueError(f"`per_unit` must be one or (n,) numbers, not 0, got {per_unit}.")
            scale = 1.0 / size
        if axes is None:
            size = (6.0, 1.0 + 1.6 * n)
            _, axes = plt.subplots(n, 1, figsize=size, sharex=True, layout="constrained")
        axes = np.ravel(np.asarray(axes, dtype=object))
        if len(axes) != n:
            raise ValueError(f"`axes` must hold {n} axes, got {len(axes)}.")
        steps, when = steps_of(self.t, len(next(iter(self.paths.values()))))
        parts = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
        for k, (ax, columns) in enumerate(zip(axes, parts, strict=True)):
            self._draw_segment(ax, steps, columns, scale)
            ax.set(ylabel=f"segment {k + 1} [{plot_label(unit)}]")
        self._add_legends(axes)
        axes[-1].set(xlabel=when)
        self.axes_ = axes
        self.figure_ = axes[0].figure
        return self

    def _add_legends(self, axes: NDArray) -> None:
        """Add a legend beside every segment where it has names, else one above all."""
        if self.names or len(self.limits):
            for ax in axes:
                small_legend(ax, loc="center left", bbox_to_anchor=(1.0, 0.5))
        else:
            small_legend(
                axes[0], loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(self.paths)
            )

    def _draw_segment(
        self, ax: Any, steps: NDArray, columns: NDArray, scale: float | NDArray
    ) -> None:
        """Draw the actuators of a segment and their limits."""
        of_models = [look["color"] for look in looks_of(self.paths)]
        for i, color in enumerate(of_models):
            if color in of_models[:i]:
                of_models[i] = pale(color)
        styles = [style for _, style in actuator_looks([0] * len(columns))]
        colors = len(columns) * [TARGET]
        if self.names:
            colors = [NAMED[j % len(NAMED)] for j in range(len(columns))]
        for i, (model, q) in enumerate(self.paths.items()):
            values = (scale * q)[:, columns].T
            for column, of_one, color, style in zip(columns, values, colors, styles, strict=True):
                label = model
                width = 1.2
                if not self.names:
                    color = of_models[i]
                elif i == 0:
                    label = self.names[column]
                else:
                    color = pale(color, 0.5**i)
                    width += 1.8 * i
                ax.plot(
                    steps,
                    of_one,
                    color=color,
                    linestyle=style,
                    linewidth=width,
                    label=plot_label(label),
                    zorder=2.0 - 0.1 * i,
                )
        if len(self.limits):
            values = (scale * self.limits)[:, columns]
            for color in dict.fromkeys(colors):
                of_color = [values[:, j] for j in range(len(columns)) if colors[j] == color]
                ax.hlines(
                    np.ravel(of_color),
                    steps[0],
                    steps[-1],
                    colors=color,
                    linestyles=[_LIMITS],
                    linewidth=1.2,
                    label="limits",
                )
