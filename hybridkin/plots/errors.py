"""Errors of models: histograms and boxes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin._core.arrays import whole
from hybridkin.plots._arrays import distance, named, plain, positions
from hybridkin.plots._canvas import COLORS, Display, axes_or_new, look_of, scale_of


class _ErrorDisplay(Display):
    """Tip errors by model, however they are drawn."""

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
        Where it was drawn.

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

    def plot(self, ax: Axes | None = None, *, unit: str = "cm", bins: int = 40) -> Self:
        """Draw the histograms, the mean of each model marked, and return self.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm"}, default="cm"
            Of the error's axis.
        bins : int, default=40
            From zero to the largest error of all.

        Returns
        -------
        ErrorHistogramDisplay
            Itself, drawn.
        """
        known, ax, bins = self._known(unit), axes_or_new(ax), whole(bins, "bins", most=10_000)
        top = max(float(values.max()) for values in known.values()) or 1e-3
        edges = np.linspace(0.0, top, bins + 1).tolist()
        for i, (name, values) in enumerate(known.items()):
            look = look_of(i)
            color = look["color"]
            label = f"{name}: mean {values.mean():.2f}, max {values.max():.1f} {unit}"
            ax.hist(values, edges, histtype="stepfilled", color=color, alpha=0.25)
            ax.hist(values, edges, histtype="step", label=label, **look)
            ax.axvline(values.mean(), color=color, linestyle="--", linewidth=1.0)
        ax.set(xlabel=f"tip error [{unit}]", ylabel="configurations", xlim=(0.0, top))
        ax.legend(frameon=False)
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
        Where it was drawn.
    """

    def plot(self, ax: Axes | None = None, *, unit: str = "cm") -> Self:
        """Draw horizontal boxes with the mean (dot) and the maximum (cross) and return self.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm"}, default="cm"
            Of the error's axis.

        Returns
        -------
        ErrorBoxDisplay
            Itself, drawn.
        """
        known, ax = self._known(unit), axes_or_new(ax)
        names = [*known][::-1]
        values = [known[name] for name in names]
        look = {"widths": 0.6, "patch_artist": True, "medianprops": {"color": "black"}}
        options = {"orientation": "horizontal", "whis": (5, 95), "showfliers": False}
        box = ax.boxplot(values, **options, **look)
        for i, patch in enumerate(box["boxes"]):
            patch.set(facecolor=COLORS[(len(names) - 1 - i) % 8], alpha=0.35)
        places = np.arange(1, len(names) + 1)
        ax.plot([v.mean() for v in values], places, "o", color="black", label="mean")
        ax.plot([v.max() for v in values], places, "x", color="black", label="maximum")
        ax.set_yticks(places, names)
        ax.set(xlabel=f"tip error [{unit}]")
        ax.set_xlim(left=0.0)
        ax.legend(frameon=False)
        return self._drawn(ax)
