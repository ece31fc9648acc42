"""Learning curves: error on held-out motions against the number of training rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy.typing import ArrayLike, NDArray
from sklearn.model_selection import GroupKFold, KFold, check_cv, learning_curve
from sklearn.utils import check_random_state
from sklearn.utils.validation import has_fit_parameter
from typing_extensions import Self

from hybridkin._core.arrays import labels
from hybridkin._core.texts import plot_label
from hybridkin.plots._arrays import distance, named, plain, positions
from hybridkin.plots._canvas import (
    MARKERS,
    Display,
    axes_or_new,
    legend_below,
    looks_of,
    scale_of,
)
from hybridkin.plots.models import Predictor, predicted

_MOST_TICKS = 8


class LearningCurveDisplay(Display):
    """Mean tip error against the number of training rows, one curve per model.

    Parameters
    ----------
    sizes : array-like of shape (K,)
        Training rows, increasing.
    errors : mapping of str to array-like of shape (K,) or (K, n_splits)
        Mean tip distance of each model with that many rows, on every split [m]; NaN where there
        is none.

    Attributes
    ----------
    sizes : ndarray of shape (K,)
        Training rows.
    errors : dict of str to ndarray of shape (K, n_splits)
        Mean tip distances [m].
    ax_, figure_ : matplotlib Axes and Figure
        Where it was drawn.

    Examples
    --------
    >>> from hybridkin import plots
    >>> curve = {"hybrid": [[0.02, 0.03], [0.01, 0.012]]}
    >>> display = plots.LearningCurveDisplay([50, 100], curve)
    >>> display.plot(plots.new_figure(4.0, 3.0)[1], unit="mm").ax_.get_ylabel()
    'mean tip error [mm]'
    """

    def __init__(self, sizes: ArrayLike, errors: Mapping[str, ArrayLike]) -> None:
        self.sizes = plain(sizes, "sizes")
        if self.sizes.ndim != 1 or not (np.diff(self.sizes, prepend=0.0) > 0.0).all():
            raise ValueError(
                f"`sizes` must be positive and increase, got {self.sizes.tolist()}."
            )
        self.errors: dict[str, NDArray] = {}
        for name, values in named(errors, "errors").items():
            array = plain(values, "errors")
            if array.ndim == 1:
                array = array[:, None]
            if array.ndim != 2 or len(array) != len(self.sizes):
                raise ValueError(
                    f"`errors` must hold arrays of shape ({len(self.sizes)},) or "
                    f"({len(self.sizes)}, n_splits), got {array.shape} for {name!r}."
                )
            self.errors[name] = array

    @classmethod
    def from_estimator(
        cls,
        models: Predictor | Mapping[str, Predictor],
        q: ArrayLike,
        x: ArrayLike,
        *,
        groups: ArrayLike | None = None,
        sizes: Iterable[int] | None = None,
        cv: object = 5,
        random_state: int | np.random.RandomState | None = None,
    ) -> Self:
        """Return the curves of models fitted to more and more rows of a log.

        Parameters
        ----------
        models : mapping of str to estimator, or estimator
            Cloned before each fit.
        q : array-like of shape (N, n)
            Actuator vectors.
        x : array-like of shape (N, m)
            Measured tips [m].
        groups : array-like of shape (N,), optional
            Motion of every row. Whole motions are then held out, and fewer rows are fewer motions
            (in random order, the last one cut), as in a shorter recording. Models that accept
            groups get them. Without groups the errors on a log of motions are too small, because
            neighbouring rows are alike. Default: independent rows.
        sizes : iterable of int, optional
            Training rows. Default: six sizes from 25 to all rows, evenly in logarithms.
        cv : int, splitter or iterable of (train, test), default=5
            How to hold out; a number is that of random parts of the groups, or of the rows.
        random_state : int, RandomState or None, default=None
            Seed of the parts and of the order.

        Returns
        -------
        LearningCurveDisplay
            Not drawn yet.

        Raises
        ------
        ValueError
            For sizes above the rows of the smallest training part, and fewer than two groups.

        Examples
        --------
        >>> from sklearn.linear_model import Ridge
        >>> from hybridkin import datasets, plots
        >>> data = datasets.load_trunk()
        >>> display = plots.LearningCurveDisplay.from_estimator(
        ...     {"ridge": Ridge(1e-6)}, data.q, data.x, sizes=[25, 100, 400], random_state=0
        ... )
        >>> display.errors["ridge"].shape
        (3, 5)
        """
        if not isinstance(models, Mapping):
            models = {type(models).__name__: models}
        rng = check_random_state(random_state)
        if groups is not None:
            groups = labels(groups, np.shape(q)[0])
        splits = _splits(cv, q, groups, rng)
        splits = [
            (_ordered(np.asarray(train), groups, rng), test) for train, test in splits
        ]
        most = min(len(train) for train, _ in splits)
        chosen = np.unique(_sizes(sizes, most))
        options: dict[str, Any] = {
            "train_sizes": chosen,
            "cv": splits,
            "error_score": "raise",
        }
        errors = {}
        for name, model in named(models, "models").items():
            takes = groups is not None and has_fit_parameter(model, "groups")
            params = {"groups": groups} if takes else None
            scores = learning_curve(
                model, q, x, scoring=_mean_distance, params=params, **options
            )
            errors[name] = scores[2]
        return cls(chosen, errors)

    def plot(
        self,
        ax: Axes | None = None,
        *,
        unit: str = "cm",
        styles: Mapping[str, tuple[str, str]] | None = None,
    ) -> Self:
        """Draw means over the splits, and bands from the best to the worst split; return self.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: those of a new figure of pyplot. Both its scales become logarithmic.
        unit : {"m", "cm", "mm"}, default="cm"
            Unit of the error.
        styles : mapping of str to (color, format), optional
            Look of some models, as ("#0072B2", "o-").

        Returns
        -------
        LearningCurveDisplay
            Itself, drawn.
        """
        scale = scale_of(unit)
        ax = axes_or_new(ax)
        looks = looks_of(self.errors)
        for i, (name, errors) in enumerate(self.errors.items()):
            style = (looks[i]["color"], MARKERS[i % 8] + looks[i]["linestyle"])
            color, form = (styles or {}).get(name, style)
            finite = np.isfinite(errors).any(axis=1)
            sizes = self.sizes[finite]
            values = scale * errors[finite]
            ax.plot(
                sizes,
                np.nanmean(values, axis=1),
                form,
                color=color,
                markersize=4,
                label=plot_label(name),
            )
            if values.shape[1] > 1:
                low = np.nanmin(values, axis=1)
                high = np.nanmax(values, axis=1)
                ax.fill_between(
                    sizes, low, high, color=color, alpha=0.15, linewidth=0.0
                )
        ax.set(xscale="log", yscale="log")
        ax.set(xlabel="training rows", ylabel=f"mean tip error [{unit}]")
        if len(self.sizes) <= _MOST_TICKS:
            ax.set_xticks(self.sizes, [f"{n:g}" for n in self.sizes], fontsize="small")
            ax.xaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.grid(alpha=0.3)
        legend_below(ax, 2)
        return self._drawn(ax)


def _splits(
    cv: Any, q: ArrayLike, groups: NDArray | None, rng: np.random.RandomState
) -> list[tuple[NDArray, NDArray]]:
    """Return pairs of training and held-out rows."""
    if not isinstance(cv, int):
        splitter: Any = check_cv(cv)
        return [*splitter.split(q, groups=groups)]
    if groups is None:
        return [*KFold(cv, shuffle=True, random_state=rng).split(q)]
    n_groups = len(np.unique(groups))
    if n_groups < 2:
        raise ValueError(
            "`groups` must name at least 2 motions, got 1; one must be held out. Record another "
            "motion, or split the log where it comes to rest."
        )
    splitter = GroupKFold(min(cv, n_groups), shuffle=True, random_state=rng)
    return [*splitter.split(q, groups=groups)]


def _ordered(
    train: NDArray, groups: NDArray | None, rng: np.random.RandomState
) -> NDArray:
    """Return the training rows in random order, motion by motion."""
    if groups is None:
        return rng.permutation(train)
    train_groups = groups[train]
    return np.concatenate(
        [
            train[train_groups == group]
            for group in rng.permutation(np.unique(train_groups))
        ]
    )


def _sizes(sizes: Iterable[int] | None, most: int) -> NDArray:
    if sizes is None:
        return np.geomspace(min(25, most), most, 6).round().astype(int)
    chosen = np.array([*sizes])
    if (
        chosen.size == 0
        or chosen.dtype.kind not in "iu"
        or chosen.min() < 1
        or chosen.max() > most
    ):
        raise ValueError(
            f"`sizes` must be whole numbers from 1 to {most}, the rows of the smallest training "
            f"part, got {chosen.tolist()}."
        )
    return chosen


def _mean_distance(model: Predictor, q: ArrayLike, x: ArrayLike) -> float:
    return float(distance(predicted(model, q), positions(x)).mean())
