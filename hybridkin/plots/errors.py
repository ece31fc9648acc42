"""Histograms and boxes of tip errors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin._core.texts import plot_label
from hybridkin.plots._arrays import distance, named, plain, positions
from hybridkin.plots._canvas import (
    Display,
    axes_or_new,
    legend_below,
    looks_of,
    scale_of,
)

_BINS = 40  # of a histogram, from zero to the largest error


class _ErrorDisplay(Display):
    """Tip errors by model."""

    def __init__(self, errors: Mapping[str, ArrayLike]) -> None:
        self.errors: dict[str, NDArray] = {}
        for name, values in named(errors, "errors").items():
            values = plain(values, "errors")
            if values.ndim != 1 or not np.isfinite(values).any():
                raise ValueError(
                    f"`errors` must hold arrays of shape (N,) with a number in them, got shape "
                    f"{values.shape} for {name!r}."
                )
            self.errors[name] = values

    @classmethod
    def from_predictions(cls, x: ArrayLike, predictions: Mapping[str, ArrayLike]) -> Self:
        """Return the display of the distances from predicted to measured tips.

        Parameters
        ----------
        x : array-like of shape (N, m)
            Measured tips [m]; of poses (N, 6) the position is compared.
        predictions : mapping of str to array-like of shape (N, m)
            Predicted tips of each model [m].

        Returns
        -------
        Display
            Not drawn yet.
        """
        x = positions(x)
        errors = {}
        for name, values in named(predictions, "predictions").items():
            p = positions(values)
            if p.shape != x.shape:
                raise ValueError(
                    f"`predictions` must have the shape of `x`, {x.shape}, got {p.shape} for "
                    f"{name!r}."
                )
            errors[name] = distance(p, x)
        return cls(errors)

    def _known(self, unit: str) -> dict[str, NDArray]:
        scale = scale_of(unit)
        return {name: scale * e[np.isfinite(e)] for name, e in self.errors.items()}


class ErrorHistogramDisplay(_ErrorDisplay):
    """Histogram of tip errors, one outline per model (Fig. 2, right, of the paper).

    Parameters
    ----------
    errors : mapping of str to array-like of shape (N,)
        Tip distances of each model [m]; NaN is ignored.

    Attributes
    ----------
    errors : dict of str to ndarray of shape (N,)
        As given [m].
    ax_, figure_ : matplotlib Axes and Figure
        Where it was drawn last.

    Examples
    --------
    >>> from hybridkin import HybridForwardModel, datasets, plots, robots
    >>> data = datasets.load_trunk()
    >>> model = HybridForwardModel(robots.bionic_handling_assistant(), "quadratic")
    >>> model = model.fit(data.q[:400], data.x[:400])
    >>> figure, ax = plots.new_figure(5.0, 3.5)
    >>> found = {"hybrid": model.predict(data.q[400:])}
    >>> display = plots.ErrorHistogramDisplay.from_predictions(data.x[400:], found)
    >>> display.plot(ax).ax_.get_xlabel()
    'tip error [cm]'
    """

    def plot(self, ax: Axes | None = None, *, unit: str = "cm") -> Self:
        """Draw the histograms, the mean of each model marked, and return self.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm"}, default="cm"
            Unit of the error.

        Returns
        -------
        ErrorHistogramDisplay
            Itself, drawn.
        """
        finite = self._known(unit)
        ax = axes_or_new(ax)
        top = max(float(errors.max()) for errors in finite.values()) or 1e-3
        edges = np.linspace(0.0, top, _BINS + 1).tolist()
        for look, (name, values) in zip(looks_of(finite), finite.items(), strict=True):
            color = look["color"]
            label = f"{plot_label(name)}: mean {values.mean():.2f}, max {values.max():.1f} {unit}"
            ax.hist(values, edges, histtype="stepfilled", color=color, alpha=0.25)
            ax.hist(values, edges, histtype="step", label=label, **look)
            ax.axvline(values.mean(), color=color, linestyle="--", linewidth=1.0)
        ax.set(xlabel=f"tip error [{unit}]", ylabel="configurations", xlim=(0.0, top))
        legend_below(ax)
        return self._drawn(ax)


class ErrorBoxDisplay(_ErrorDisplay):
    """Spread of tip errors side by side: box from quartile to quartile, whiskers to 5 and 95 %.

    Parameters
    ----------
    errors : mapping of str to array-like of shape (N,)
        Tip distances of each model [m]; NaN is ignored.

    Attributes
    ----------
    errors : dict of str to ndarray of shape (N,)
        As given [m].
    ax_, figure_ : matplotlib Axes and Figure
        Where it was drawn last.
    """

    def plot(self, ax: Axes | None = None, *, unit: str = "cm", log: bool = False) -> Self:
        """Draw horizontal boxes with the mean (dot) and the maximum (cross) and return self.

        A linear axis shows most models up to their 95 %. Larger means and maxima are numbers at
        its end.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm"}, default="cm"
            Unit of the error.
        log : bool, default=False
            Whether the error's axis is logarithmic and shows everything.

        Returns
        -------
        ErrorBoxDisplay
            Itself, drawn.
        """
        finite = self._known(unit)
        ax = axes_or_new(ax)
        values = [*finite.values()]
        places = np.arange(len(values), 0, -1)
        box = ax.boxplot(
            values,
            positions=places.tolist(),
            orientation="horizontal",
            whis=(5, 95),
            showfliers=False,
            widths=0.6,
            patch_artist=True,
            medianprops={"color": "black"},
        )
        for patch, look in zip(box["boxes"], looks_of(finite), strict=True):
            patch.set(facecolor=look["color"], alpha=0.5)
        means = np.array([errors.mean() for errors in values])
        largest = np.array([errors.max() for errors in values])
        ax.plot(means, places, "o", color="black", label="mean")
        ax.plot(largest, places, "x", color="black", label="maximum")
        ax.set_yticks(places, [*map(plot_label, finite)])
        ax.set(xlabel=f"tip error [{unit}]")
        if log:
            most = largest.max()
            low = min(float(np.percentile(errors, 5)) for errors in values)
            low = max(low, 1e-6 * most)
            ax.set(xscale="log", xlim=(0.7 * low, 1.5 * most))
        else:
            upper = np.median([np.percentile(errors, 95) for errors in values])
            # A few bad models do not extend a linear axis.
            end = 1.05 * float(min(largest.max(), 3.0 * upper)) or 1e-3
            ax.set_xlim(0.0, end)
            for row in np.flatnonzero(largest > end):
                words = f"max {largest[row]:.0f}"
                if means[row] > end:
                    words = f"mean {means[row]:.0f}, {words}"
                ax.annotate(
                    f"▸ {words}",
                    (end, places[row]),
                    xytext=(4, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize="small",
                )
        legend_below(ax, 2)
        return self._drawn(ax)
