"""Distances of a body to obstacles over time."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy.typing import ArrayLike
from typing_extensions import Self

from hybridkin._core.arrays import number
from hybridkin._core.texts import plot_label
from hybridkin.plots._arrays import named, shaped, times
from hybridkin.plots._canvas import (
    Display,
    axes_or_new,
    legend_below,
    looks_of,
    scale_of,
    steps_of,
)

_DEEP = 1e9  # in an obstacle, deeper than any axes


class ClearanceDisplay(Display):
    """Distances of a robot's body to obstacles over time, and the clearance it must keep.

    Parameters
    ----------
    distances : mapping of str to array-like of shape (T,)
        Distances by obstacle, or by what promises or measures them [m]; negative inside, infinite
        or NaN where there are none.
    t : array-like of shape (T,), optional
        Times [s]. Default: time steps.
    clearance : float, default=0.0
        Least distance that the body must keep [m].

    Attributes
    ----------
    distances : dict of str to ndarray of shape (T,)
        As given [m].
    ax_, figure_ : matplotlib Axes and Figure
        Where it was drawn last.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import InverseKinematics, obstacles, plots, robots
    >>> wall = obstacles.HalfSpace([-1.0, 0.0, 0.0], -0.3)
    >>> trunk = robots.bionic_handling_assistant()
    >>> ik = InverseKinematics(trunk, q_min=0.1, q_max=0.4, obstacles=[wall], clearance=0.01)
    >>> q = np.linspace(np.full(9, 0.25), np.full(9, 0.3), 5)
    >>> display = plots.ClearanceDisplay({"wall": ik.body_distances(q)[:, 0]}, clearance=0.01)
    >>> figure, ax = plots.new_figure(4.0, 3.0)
    >>> display.plot(ax, unit="mm").ax_.get_ylabel()
    'distance of the body [mm]'
    """

    def __init__(
        self,
        distances: Mapping[str, ArrayLike],
        t: ArrayLike | None = None,
        *,
        clearance: float = 0.0,
    ) -> None:
        entries = named(distances, "distances")
        T = len(shaped(next(iter(entries.values())), "distances", "T"))
        self.distances = {
            name: shaped(values, f"distances[{name!r}]", "T", T) for name, values in entries.items()
        }
        self.t = times(t, T)
        self.clearance = number(clearance, "clearance")

    def plot(self, ax: Axes | None = None, *, unit: str = "cm") -> Self:
        """Draw the distances and return self; what is nearer than zero is shaded.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm"}, default="cm"
            Of the distances.

        Returns
        -------
        ClearanceDisplay
            Itself, drawn.
        """
        scale = scale_of(unit)
        ax = axes_or_new(ax)
        steps, when = steps_of(self.t, len(next(iter(self.distances.values()))))
        looks = looks_of(self.distances)
        for (name, values), look in zip(self.distances.items(), looks, strict=True):
            ax.plot(steps, scale * values, label=plot_label(name), **look)
        if self.clearance:
            level = scale * self.clearance
            ax.axhline(level, color="black", linewidth=1.0, linestyle=":", label="clearance")
        ax.update_datalim([(steps[0], 0.0)])
        ax.autoscale_view()
        # Without effect on the limits of the axes, which others may share.
        inside = Rectangle((0.0, -_DEEP), 1.0, _DEEP, color="0.9", zorder=0.0)
        inside.set_transform(ax.get_yaxis_transform())
        ax.add_artist(inside)
        ax.set(xlabel=when, ylabel=f"distance of the body [{unit}]")
        if len(steps) > 1:
            ax.set_xlim(steps[0], steps[-1])
        legend_below(ax)
        return self._drawn(ax)
