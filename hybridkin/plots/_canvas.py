"""Common parts of all figures: axes, units, colours, legends."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin._core.arrays import one_of

Space: TypeAlias = Any  # Axes3D, whose annotations lack methods and arguments

LENGTHS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
# Okabe & Ito: colour-blind readers can distinguish them.
COLORS = (
    "#D55E00",
    "#0072B2",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
    "#F0E442",
)
TARGET = COLORS[6]
TIP = COLORS[0]
ERROR = COLORS[3]
"""Colours of what robots of all kinds have: a path to follow, what a tip reaches, and between."""
STYLES = ("-", "--", "-.", ":")
DASHED_TARGET = (0, (5.0, 3.0))  # drawn over a track, which is seen in its gaps
# Of segments, dark and light in turn for prints without colour; not those of target, tip and error.
_OF_SEGMENTS = (COLORS[1], COLORS[4], COLORS[2], COLORS[5])
NAMED = (*_OF_SEGMENTS, COLORS[3], COLORS[0])
"""Colours of actuators that a legend names."""
# Of the actuators of a segment, the first solid: dashes and gaps in widths of the line.
_OF_ACTUATORS = (
    "-",
    (0, (4.0, 1.6)),
    (0, (1.0, 1.6)),
    (0, (6.0, 1.6, 1.0, 1.6)),
    (0, (6.0, 1.6, 1.0, 1.6, 1.0, 1.6)),
    (0, (8.0, 4.0)),
    (0, (1.0, 4.0)),
    (0, (2.5, 2.5)),
)
# Words in the name of a model, its colour and line style; the first that fit count.
_MODELS = (
    (r"^(?!mechanic).*\bauto\b", "#009E73", "-"),
    (r"\bserial\b", "#56B4E9", "-"),
    (r"\bhybrid\b|\bparallel\b", "#0072B2", "-"),
    (r"\bdata\b", "#CC79A7", ":"),
    (r"^mechanic.*\b(calibrated|auto)\b", "#E69F00", "-."),
    (r"\bmechanical\b|\bnominal\b", "#D55E00", "--"),
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
# Parts of the axes of space without ticks, below and above: for an eye at the usual place, x ends
# where y begins, and y ends where z begins.
_CORNERS = ((0.0, 0.12), (0.12, 0.12), (0.0, 0.0))
_PAD = 6.0  # of the names of axes [pt]
_PADS = (1.2, 1.8, 2.6)  # the same for each letter of the numbers of x, y and z [pt]
_HANDLE = 2.4  # length of a line in a legend, in sizes of its letters
_MOST_HANDLES = 4  # in one entry of a legend


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **options: Any
) -> tuple[Figure, Any]:
    """Return a figure to save, which pyplot does not manage, and its axes.

    Parameters
    ----------
    width, height : float
        Size [inch].
    rows, columns : int, default=1
        Grid of axes.
    **options
        Arguments of ``Figure.subplots``.

    Returns
    -------
    figure : matplotlib Figure
        Save it with ``figure.savefig``.
    axes : Axes or ndarray of Axes
        One axes, or the grid.

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
    """Base class of all displays, which remember their last axes."""

    def _drawn(self, ax: Axes) -> Self:
        self.ax_ = ax
        self.figure_ = ax.figure
        return self


def axes_or_new(ax: Axes | None) -> Axes:
    """Return the axes given, or those of a new figure of pyplot, which ``plt.show()`` shows."""
    if ax is None:
        ax = plt.figure(layout="constrained").add_subplot()
    return ax


def space_or_new(ax: Axes | None) -> Space:
    """Return the 3-D axes given, or those of a new figure of pyplot."""
    if ax is None:
        ax = plt.figure(layout="constrained").add_subplot(projection="3d")
    if not isinstance(ax, Axes3D):
        raise TypeError(
            '`ax` must be a 3-D axes, got a plane one; make it with projection="3d", as in '
            'plots.new_figure(5, 4, subplot_kw={"projection": "3d"}).'
        )
    return ax


def model_color(name: str, default: str = "#000000") -> str:
    """Return the colour of a model in every figure, by the words of its name.

    Parameters
    ----------
    name : str
        Of the model, such as "hybrid, ELM".
    default : str, default="#000000"
        Colour of a name without a known word.

    Returns
    -------
    str
        Vermilion of a mechanical model, orange if it is calibrated; pink of a "data-driven" model;
        blue of a "hybrid" or "parallel" model, light blue of a "serial" one, green of "auto".

    Examples
    --------
    >>> from hybridkin import plots
    >>> plots.model_color("hybrid, ELM") == plots.model_color("hybrid on nominal")
    True
    """
    for words, color, _ in _MODELS:
        if re.search(words, str(name)):
            return color
    return default


def looks_of(names: Iterable[str]) -> list[dict[str, Any]]:
    """Return the looks of the lines of models, see `model_color`; no two are the same.

    Names without a known word get the colours that are left.
    """
    colors = [model_color(name, "") for name in names]
    left = itertools.cycle([color for color in COLORS if color not in colors] or COLORS)
    first_styles = {color: style for _, color, style in _MODELS}
    looks = []
    counts = Counter[str]()
    for color in colors:
        color = color or next(left)
        first = STYLES.index(first_styles.get(color, "-"))
        style = STYLES[(first + counts[color]) % len(STYLES)]
        looks.append({"color": color, "linestyle": style, "linewidth": 1.5})
        counts[color] += 1
    return looks


def actuator_looks(segments: Sequence[int]) -> list[tuple[str, Any]]:
    """Return colour and line style of every actuator: colours by segment, styles within it.

    Eight segments of four actuators all look different.
    """
    n_colors = len(_OF_SEGMENTS)
    looks = []
    counts = Counter[int]()
    for segment in segments:
        style = counts[segment] + 4 * (segment // n_colors)
        counts[segment] += 1
        color = _OF_SEGMENTS[segment % n_colors]
        looks.append((color, _OF_ACTUATORS[style % len(_OF_ACTUATORS)]))
    return looks


def pale(color: str, strength: float = 0.5) -> str:
    """Return a colour on the way to white, which is that of no strength."""
    red, green, blue = to_rgb(color)
    white = 1.0 - strength
    return to_hex((white + strength * red, white + strength * green, white + strength * blue))


def small_legend(ax: Axes, **place: Any) -> None:
    """Add a small legend without a frame; `place` are arguments of ``Axes.legend``.

    What has the same label shares an entry, which shows the looks of all of it.
    """
    looks: dict[str, list[Artist]] = {}
    for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
        looks.setdefault(label, []).append(handle)
    handles: list[Any] = []
    most = 1
    for of_label in looks.values():
        together = of_label[:_MOST_HANDLES]
        most = max(most, len(together))
        handles.append(together[0] if len(together) == 1 else tuple(together))
    ax.legend(
        handles,
        [*looks],
        frameon=False,
        fontsize="small",
        handler_map={tuple: HandlerTuple(ndivide=None, pad=0.4)},
        handlelength=_HANDLE * (1 + 0.5 * (most - 1)),
        **place,
    )


def legend_below(ax: Axes, n_columns: int = 1) -> None:
    """Put the legend under the axis' name, off the data."""
    down = ScaledTranslation(0.0, -0.5, ax.figure.dpi_scale_trans)
    small_legend(
        ax,
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        bbox_transform=ax.transAxes + down,
        borderaxespad=0.0,
        ncols=n_columns,
    )


def steps_of(t: NDArray | None, n_rows: int) -> tuple[NDArray, str]:
    """Return the values and the name of a time axis: times [s], or steps without times."""
    if t is None:
        return np.arange(n_rows), "time step"
    return t, "time [s]"


def scale_of(unit: str, known: Mapping[str, float] = LENGTHS) -> float:
    """Return the number of units in a metre or a radian."""
    return known[one_of(unit, "unit", known)]


def decimals(values: ArrayLike) -> int:
    """Return the decimals, 2 to 6, that show two digits of the largest value."""
    values = np.asarray(values, dtype=float)
    largest = np.abs(values[np.isfinite(values)]).max(initial=0.0)
    if largest == 0.0:
        return 2
    power = np.floor(np.log10(largest))
    return int(np.clip(1 - power, 2, 6))


class _InnerLocator(MaxNLocator):
    """Ticks that keep away from the ends of an axis, where its neighbour has ticks, too.

    Parameters
    ----------
    n : int
        Most ticks.
    below, above : float
        Parts of the axis without ticks.
    """

    def __init__(self, n: int, below: float, above: float) -> None:
        super().__init__(n)
        self._below = below
        self._above = above

    def tick_values(self, vmin: float, vmax: float) -> Any:
        """Return the places of ticks."""
        ticks = np.asarray(super().tick_values(vmin, vmax))
        part = (ticks - vmin) / (vmax - vmin)
        is_inner = (part >= self._below) & (part <= 1.0 - self._above)
        if not is_inner.any():
            is_inner[np.abs(part - 0.5).argmin()] = True
        return ticks[is_inner]


def label_space(ax: Space, unit: str) -> None:
    """Label the axes of space and scale them equally, none too short, on white panes."""
    ax.set(xlabel=f"x [{unit}]", ylabel=f"y [{unit}]", zlabel=f"z [{unit}]")
    low, high = np.array([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()]).T
    middle = 0.5 * (low + high)
    half = 0.5 * (high - low)
    half = half.clip(min=0.25 * half.max())
    xlim, ylim, zlim = np.stack([middle - half, middle + half], axis=1)
    ax.set(xlim=xlim, ylim=ylim, zlim=zlim)
    n_ticks = np.maximum(2, np.rint(5.0 * half / half.max()).astype(int))
    axes = (ax.xaxis, ax.yaxis, ax.zaxis)
    ax.tick_params(labelsize="small")
    for axis, n, ends, pad in zip(axes, n_ticks.tolist(), _CORNERS, _PADS, strict=True):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        locator = _InnerLocator(n, *ends)
        axis.set_major_locator(locator)
        numbers = axis.get_major_formatter().format_ticks(locator())
        axis.label.set_size("small")
        axis.labelpad = _PAD + pad * max(map(len, numbers), default=0)
    ax.patch.set_visible(False)  # it would hide the labels of the axes beside it
    ax.set_aspect("equal")
    ax.set_box_aspect(half, zoom=0.8)  # space for the z label, which layouts ignore
