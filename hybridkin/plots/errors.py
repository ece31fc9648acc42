"""Errors of models: histograms, boxes, dots with bars, and predictions against measurements."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin.plots._canvas import (
    COLORS,
    MARKERS,
    axes_or_new,
    distance,
    measured,
    named,
    plain,
    predictions_of,
    scale_of,
    several_axes,
)

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["BarDisplay", "ErrorBoxDisplay", "ErrorHistogramDisplay", "PredictionErrorDisplay"]

_KINDS = ("residual_vs_predicted", "predicted_vs_measured")


class _OfModels:
    """What is made of measured and predicted tips, or of the models that predict."""

    from_predictions: Callable[..., Any]

    @classmethod
    def from_estimator(cls, models: Any, q: ArrayLike, x: ArrayLike) -> Any:
        """Return the display of the errors of fitted models on measured rows.

        Parameters
        ----------
        models : mapping of str to estimator, or estimator
            Fitted estimators, or chains, by name. A single `HybridForwardModel` shows its
            mechanical part and itself.
        q : array-like of shape (N, n)
            Actuator vectors, best of motions that the models have not seen.
        x : array-like of shape (N, m)
            Measured tips [m].

        Returns
        -------
        Display
            Not drawn yet.
        """
        return cls.from_predictions(measured(models, x), predictions_of(models, q))


class _ErrorDisplay(_OfModels):
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
            Measured tips [m].
        predictions : mapping of str to array-like of shape (N, m)
            Predicted tips of each model [m].

        Returns
        -------
        Display
            Not drawn yet.
        """
        x, predictions = _compared(x, predictions)
        return cls({name: distance(p, x) for name, p in predictions.items()})

    def _known(self, unit: str) -> dict[str, NDArray]:
        scale = scale_of(unit)
        return {name: scale * e[np.isfinite(e)] for name, e in self.errors.items()}


class ErrorHistogramDisplay(_ErrorDisplay):
    """Histogram of tip errors, one outline per model (Fig. 2, right, of the paper).

    Parameters
    ----------
    errors : mapping of str to array-like of shape (N,)
        Tip distances of each model [m]; NaN is left out.

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
    >>> display = plots.ErrorHistogramDisplay.from_estimator(model, data.q[400:], data.x[400:])
    >>> display.plot(ax).ax_.get_xlabel()
    'tip error [cm]'
    >>> [*display.errors]
    ['mechanical', 'hybrid']
    """

    def plot(self, ax: Any = None, *, unit: str = "cm", bins: int = 40) -> Self:
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
        known, ax = self._known(unit), axes_or_new(ax)
        top = max(float(values.max()) for values in known.values()) or 1e-3
        edges = np.linspace(0.0, top, bins + 1)
        for i, (name, values) in enumerate(known.items()):
            color = COLORS[i % 8]
            label = f"{name}: mean {values.mean():.2f}, max {values.max():.1f} {unit}"
            ax.hist(values, edges, histtype="stepfilled", color=color, alpha=0.25)
            look = {"color": color, "linewidth": 1.5, "linestyle": ("-", "--", "-.", ":")[i % 4]}
            ax.hist(values, edges, histtype="step", label=label, **look)
            ax.axvline(values.mean(), color=color, linestyle="--", linewidth=1.0)
        ax.set(xlabel=f"tip error [{unit}]", ylabel="configurations", xlim=(0.0, top))
        ax.legend(frameon=False)
        self.ax_, self.figure_ = ax, ax.figure
        return self


class ErrorBoxDisplay(_ErrorDisplay):
    """Spread of tip errors side by side: box from quartile to quartile, whiskers to 5 and 95 %.

    Parameters
    ----------
    errors : mapping of str to array-like of shape (N,)
        Tip distances of each model [m]; NaN is left out.

    Attributes
    ----------
    errors : dict of str to ndarray of shape (N,)
        As given [m].
    ax_, figure_ : matplotlib Axes and Figure
        Where it was drawn.
    """

    def plot(self, ax: Any = None, *, unit: str = "cm") -> Self:
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
            patch.set(facecolor=COLORS[(len(names) - 1 - i) % 8], alpha=0.35)
        places = np.arange(1, len(names) + 1)
        ax.plot([v.mean() for v in values], places, "o", color="black", label="mean")
        ax.plot([v.max() for v in values], places, "x", color="black", label="maximum")
        ax.set_yticks(places, names)
        ax.set(xlabel=f"tip error [{unit}]")
        ax.set_xlim(left=0.0)
        ax.legend(frameon=False)
        self.ax_, self.figure_ = ax, ax.figure
        return self


class BarDisplay:
    """Named values with their spread, as dots with bars.

    Parameters
    ----------
    names : sequence of str
        One per value.
    values, spreads : array-like of shape (K,)
        Values, and half the length of each bar.

    Attributes
    ----------
    ax_, figure_ : matplotlib Axes and Figure
        Where it was drawn.
    """

    def __init__(self, names: Sequence[str], values: ArrayLike, spreads: ArrayLike) -> None:
        self.names = list(names)
        self.values, self.spreads = plain(values, "values"), plain(spreads, "spreads")
        need = (len(self.names),)
        for name, array in (("values", self.values), ("spreads", self.spreads)):
            if array.shape != need:
                raise ValueError(f"`{name}` must have shape {need}, got {array.shape}.")

    def plot(self, ax: Any = None, *, label: str = "") -> Self:
        """Draw one row per name, the first on top, and return self.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: those of a new figure of pyplot.
        label : str, default=""
            Of the values' axis, with its unit.

        Returns
        -------
        BarDisplay
            Itself, drawn.
        """
        ax = axes_or_new(ax)
        places = np.arange(len(self.names))[::-1]
        below = np.minimum(self.spreads, self.values)
        bars = np.stack([below, self.spreads])
        ax.errorbar(self.values, places, xerr=bars, fmt="o", color=COLORS[1], capsize=3)
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
        self.ax_, self.figure_ = ax, ax.figure
        return self


class PredictionErrorDisplay(_OfModels):
    """Predicted against measured coordinates, or what is left of the error, axis by axis.

    Parameters
    ----------
    x : array-like of shape (N, m)
        Measured tips [m].
    predictions : mapping of str to array-like of shape (N, m)
        Predicted tips of each model [m].

    Attributes
    ----------
    x : ndarray of shape (N, m)
        Measured tips [m].
    predictions : dict of str to ndarray of shape (N, m)
        Predicted tips [m].
    axes_, figure_ : ndarray of shape (m,) of Axes, and Figure
        Where it was drawn.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import plots
    >>> x = np.zeros((5, 3))
    >>> figure, axes = plots.new_figure(9.0, 3.0, 1, 3)
    >>> display = plots.PredictionErrorDisplay(x, {"shifted": x + [0.01, 0.0, 0.0]})
    >>> display = display.plot(axes, unit="mm")
    >>> axes[0].get_title()
    'shifted: -10.00 ± 0.00 mm'
    """

    def __init__(self, x: ArrayLike, predictions: Mapping[str, ArrayLike]) -> None:
        self.x, self.predictions = _compared(x, predictions)

    @classmethod
    def from_predictions(cls, x: ArrayLike, predictions: Mapping[str, ArrayLike]) -> Self:
        """Return the display of arrays, as the constructor does."""
        return cls(x, predictions)

    def plot(
        self, axes: Any = None, *, unit: str = "cm", kind: str = "residual_vs_predicted"
    ) -> Self:
        """Draw one axes per coordinate and return self.

        Parameters
        ----------
        axes : sequence of m matplotlib Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm"}, default="cm"
            Of the axes.
        kind : {"residual_vs_predicted", "predicted_vs_measured"}
            Measured minus predicted over predictions, whose mean and standard deviation are written
            above; or predictions over measurements, with the line on which both agree.

        Returns
        -------
        PredictionErrorDisplay
            Itself, drawn.
        """
        if kind not in _KINDS:
            raise ValueError(f"`kind` must be one of {_KINDS}, got {kind!r}.")
        scale, m = scale_of(unit), self.x.shape[1]
        axes = several_axes(axes, m, 3.2 * m, 3.4)
        letters = "xyz" if m == 3 else [f"output {k + 1} " for k in range(m)]
        for k, (ax, letter) in enumerate(zip(axes, letters, strict=True)):
            self._draw(ax, k, scale, unit, kind)
            if kind == "predicted_vs_measured":
                ax.axline((scale * np.nanmean(self.x[:, k]),) * 2, slope=1.0, color="black", lw=1.0)
                ax.set_aspect("equal", adjustable="datalim")
                ax.set(xlabel=f"measured {letter} [{unit}]", ylabel=f"predicted {letter} [{unit}]")
            else:
                ax.axhline(0.0, color="black", linewidth=1.0)
                ax.set(xlabel=f"predicted {letter} [{unit}]")
                ax.set(ylabel=f"measured - predicted {letter} [{unit}]")
        if kind == "predicted_vs_measured":
            axes[0].legend(frameon=False, markerscale=2.0)
        self.axes_, self.figure_ = axes, axes[0].figure
        return self

    def _draw(self, ax: Any, k: int, scale: float, unit: str, kind: str) -> None:
        titles = []
        for i, (name, predicted) in enumerate(self.predictions.items()):
            look: dict[str, Any] = {"color": COLORS[i % 8], "markersize": 2.5, "alpha": 0.5}
            look |= {"marker": MARKERS[i % 8], "linestyle": "", "mec": "none", "rasterized": True}
            x, p = scale * self.x[:, k], scale * predicted[:, k]
            ax.plot(
                *((x, p) if kind == "predicted_vs_measured" else (p, x - p)), label=name, **look
            )
            titles.append(f"{name}: {np.nanmean(x - p):.2f} ± {np.nanstd(x - p):.2f} {unit}")
        if kind == "residual_vs_predicted":
            ax.set_title("\n".join(titles), fontsize="small")


def _compared(
    x: ArrayLike, predictions: Mapping[str, ArrayLike]
) -> tuple[NDArray, dict[str, NDArray]]:
    x = plain(x, "x")
    if x.ndim != 2:
        raise ValueError(f"`x` must have shape (N, m), got {x.shape}.")
    arrays = {name: plain(p, name) for name, p in named(predictions, "predictions").items()}
    for name, p in arrays.items():
        if p.shape != x.shape:
            raise ValueError(
                f"`predictions` must have the shape of `x`, {x.shape}, got {p.shape} for {name!r}."
            )
    return x, arrays
