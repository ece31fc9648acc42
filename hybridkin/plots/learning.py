"""Learning curves: the error on held-out motions against the rows learned from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy.typing import ArrayLike, NDArray
from sklearn.model_selection import GroupKFold, KFold, learning_curve
from sklearn.utils import check_random_state
from sklearn.utils.validation import has_fit_parameter

from hybridkin.plots._canvas import (
    COLORS,
    MARKERS,
    axes_or_new,
    distance,
    measured,
    named,
    plain,
    predicted,
    scale_of,
)

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["LearningCurveDisplay"]

_LINES = ("-", "--", "-.", ":")
_MOST_TICKS = 8
_curve: Any = learning_curve  # its types know no error_score="raise"


class LearningCurveDisplay:
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
            raise ValueError(f"`sizes` must be positive and increase, got {self.sizes.tolist()}.")
        self.errors: dict[str, NDArray] = {}
        for name, values in named(errors, "errors").items():
            array = plain(values, "errors")
            array = array[:, None] if array.ndim == 1 else array
            if array.ndim != 2 or len(array) != len(self.sizes):
                raise ValueError(
                    f"`errors` must hold arrays of shape ({len(self.sizes)},) or "
                    f"({len(self.sizes)}, n_splits), got {array.shape} for {name!r}."
                )
            self.errors[name] = array

    @classmethod
    def from_estimator(
        cls,
        models: Any,
        q: Any,
        x: ArrayLike,
        *,
        groups: ArrayLike | None = None,
        sizes: Iterable[int] | None = None,
        cv: Any = 5,
        random_state: int | np.random.RandomState | None = None,
        n_jobs: int | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Self:
        """Return the curves of models fitted to more and more rows of a log.

        Parameters
        ----------
        models : mapping of str to estimator, or estimator
            They are cloned, never changed.
        q : array-like of shape (N, n)
            Actuator vectors.
        x : array-like of shape (N, m)
            Measured tips [m].
        groups : array-like of shape (N,), optional
            Motion of every row. Whole motions are then held out, and fewer rows are fewer motions
            (in an order of chance, the last one cut), as a shorter recording would have them;
            models that take groups are given them. Rows of a motion log without groups flatter
            every model: neighbours in time are alike. Default: rows that stand alone.
        sizes : iterable of int, optional
            Training rows. Default: six, from 25 to as many as there are, evenly in logarithms.
        cv : int, splitter or iterable of (train, test), default=5
            How to hold out; a number means groups, or else rows, in so many parts by chance.
        random_state : int, RandomState or None, default=None
            Seed of parts and order.
        n_jobs : int, optional
            Processes.
        progress : callable, optional
            Handed (done, total), in models.

        Returns
        -------
        LearningCurveDisplay
            Not drawn yet.

        Raises
        ------
        ValueError
            For sizes that the smallest training part has not, and fewer than two groups.

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
        models = named(models, "models")
        rng = check_random_state(random_state)
        groups = None if groups is None else np.asarray(groups)
        splits = _splits(cv, q, groups, rng)
        splits = [(_ordered(np.asarray(train), groups, rng), test) for train, test in splits]
        most = min(len(train) for train, _ in splits)
        chosen = np.unique(_sizes(sizes, most))
        errors = {}
        for done, (name, model) in enumerate(models.items()):
            if progress is not None:
                progress(done, len(models))
            takes = groups is not None and has_fit_parameter(model, "groups")
            errors[name] = _curve(
                model,
                q,
                x,
                train_sizes=chosen,
                cv=splits,
                scoring=_mean_distance,
                n_jobs=n_jobs,
                error_score="raise",
                params={"groups": groups} if takes else None,
            )[2]
        if progress is not None:
            progress(len(models), len(models))
        return cls(chosen, errors)

    def plot(
        self,
        ax: Any = None,
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
            Of the error's axis.
        styles : mapping of str to (color, format), optional
            Look of some models, as ("#0072B2", "o-").

        Returns
        -------
        LearningCurveDisplay
            Itself, drawn.
        """
        scale, ax = scale_of(unit), axes_or_new(ax)
        styles = {} if styles is None else styles
        for i, (name, errors) in enumerate(self.errors.items()):
            own = (COLORS[i % 8], MARKERS[i % 8] + _LINES[i % 4])
            color, form = styles.get(name, own)
            known = np.isfinite(errors).any(axis=1)
            sizes, values = self.sizes[known], scale * errors[known]
            ax.plot(sizes, np.nanmean(values, axis=1), form, color=color, markersize=4, label=name)
            if values.shape[1] > 1:
                low, high = np.nanmin(values, axis=1), np.nanmax(values, axis=1)
                ax.fill_between(sizes, low, high, color=color, alpha=0.15, linewidth=0.0)
        ax.set(xscale="log", yscale="log")
        ax.set(xlabel="training rows", ylabel=f"mean tip error [{unit}]")
        if len(self.sizes) <= _MOST_TICKS:
            ax.set_xticks(self.sizes, [f"{n:g}" for n in self.sizes], fontsize="small")
            ax.xaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.grid(alpha=0.3)
        ax.legend(frameon=False)
        self.ax_, self.figure_ = ax, ax.figure
        return self


def _splits(cv: Any, q: Any, groups: NDArray | None, rng: Any) -> list[tuple[Any, Any]]:
    if hasattr(cv, "split"):
        return [*cv.split(q, groups=groups)]
    if not isinstance(cv, int):
        return [*cv]
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


def _ordered(train: NDArray, groups: NDArray | None, rng: Any) -> NDArray:
    """Return the training rows in the order in which they are learned: motion by motion."""
    if groups is None:
        return rng.permutation(train)
    own = groups[train]
    return np.concatenate([train[own == group] for group in rng.permutation(np.unique(own))])


def _sizes(sizes: Iterable[int] | None, most: int) -> NDArray:
    if sizes is None:
        return np.geomspace(min(25, most), most, 6).round().astype(int)
    chosen = np.array([*sizes])
    if chosen.size == 0 or chosen.dtype.kind not in "iu" or chosen.min() < 1 or chosen.max() > most:
        raise ValueError(
            f"`sizes` must be whole numbers from 1 to {most}, the rows of the smallest training "
            f"part, got {chosen.tolist()}."
        )
    return chosen


def _mean_distance(model: Any, q: Any, x: ArrayLike) -> float:
    return float(distance(predicted(model, q), measured(model, x)).mean())
