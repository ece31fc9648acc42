"""What all pictures share: figures, units, colours, and arrays checked as they come in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin._core.arrays import one_of

LENGTHS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
# Okabe & Ito: colour-blind readers can distinguish them.
COLORS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#F0E442")
STYLES = ("--", "-", "-.", ":")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")


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

    Examples
    --------
    >>> from hybridkin import plots
    >>> figure, axes = plots.new_figure(6.0, 3.0, 1, 2, sharey=True)
    >>> axes.shape
    (2,)
    """
    figure = Figure(figsize=(width, height), layout="constrained", dpi=200)
    return figure, figure.subplots(rows, columns, **options)


class Display:
    """What all displays share: they remember where they were drawn last."""

    def _drawn(self, ax: Axes) -> Self:
        self.ax_, self.figure_ = ax, ax.figure
        return self


def axes_or_new(ax: Axes | None) -> Axes:
    """Return the axes given, or those of a new figure of pyplot, which ``plt.show()`` shows."""
    return plt.figure(layout="constrained").add_subplot() if ax is None else ax


def space_or_new(ax: Axes | None) -> Any:
    """Return the 3-D axes given, or those of a new figure of pyplot."""
    if ax is None:
        return plt.figure(layout="constrained").add_subplot(projection="3d")
    if not isinstance(ax, Axes3D):
        raise TypeError(
            '`ax` must be a 3-D axes, got a plane one; make it with projection="3d", as in '
            'plots.new_figure(5, 4, subplot_kw={"projection": "3d"}).'
        )
    return ax


def look_of(i: int) -> dict[str, Any]:
    """Return the look of the line of model i: models differ in colour and in style."""
    return {"color": COLORS[i % 8], "linestyle": STYLES[i % 4], "linewidth": 1.5}


def steps_of(t: NDArray | None, n_rows: int) -> tuple[NDArray, str]:
    """Return the values and the name of a time axis: times [s], or steps where they are absent."""
    return (np.arange(n_rows), "time step") if t is None else (t, "time [s]")


def scale_of(unit: str, known: Mapping[str, float] = LENGTHS) -> float:
    """Return how many of a unit one metre has, or one radian."""
    return known[one_of(unit, "unit", known)]


def decimals(values: ArrayLike) -> int:
    """Return how many decimals show the largest of the values with two digits, 2 to 6."""
    values = np.asarray(values, dtype=float)
    largest = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
    return 2 if largest == 0.0 else int(np.clip(1 - np.floor(np.log10(largest)), 2, 6))


def label_space(ax: Any, unit: str) -> None:
    """Name the axes of space and scale them equally, none too short, on white panes."""
    ax.set(xlabel=f"x [{unit}]", ylabel=f"y [{unit}]", zlabel=f"z [{unit}]")
    low, high = np.array([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()]).T
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    half = half.clip(min=0.25 * half.max())
    ax.set(**{f"{k}lim": (m - h, m + h) for k, m, h in zip("xyz", middle, half, strict=True)})
    for axis, share in zip((ax.xaxis, ax.yaxis, ax.zaxis), half / half.max(), strict=True):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.set_major_locator(MaxNLocator(max(2, round(5 * share))))
    ax.patch.set_visible(False)  # or it hides the labels of the axes beside it
    ax.set_aspect("equal")
    ax.set_box_aspect(half, zoom=0.92)  # space for the z-axis' name, which layouts do not see
