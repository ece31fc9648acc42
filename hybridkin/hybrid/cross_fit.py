"""Models fitted to a log, and their predictions for each part of it by fits to the others."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from joblib import Parallel, delayed, effective_n_jobs
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import one_of, whole
from hybridkin._core.progress import quiet
from hybridkin._core.turns import one_thread
from hybridkin.calibration.choice import Starts
from hybridkin.datasets.logs import Log
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import ErrorModel, Spec
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.hybrid.held_out import CrossFit, Predictions, Split
from hybridkin.hybrid.log_fit import Anew, FitOnce, fit_once

Models = Mapping[str, HybridForwardModel]
SomeLog = TypeVar("SomeLog", bound=Log)
# Rows for each process, of models that choose and of others; fewer are not worth a start.
_ROWS_PER_PROCESS = {True: 150, False: 1500}


def cross_fit(
    models: Models,
    log: SomeLog,
    folds: int | Sequence[Split] = 5,
    *,
    choices: str = "anew",
    sample_weight: ArrayLike | None = None,
    models_for: Callable[[SomeLog], Models] | None = None,
    n_jobs: int | None = 1,
    progress: Callable[[str, int, int], None] = quiet,
) -> CrossFit:
    """Fit models to a log, and predict each part of it by fits to the others.

    Every model is fitted to all rows. Then it is fitted to all folds but one, which gives tips for
    the rows of that fold. These tips give the error to expect of a model with error_model="auto"
    and the radius of a model with `coverage`. The blend of "auto" is that of its `fit`.

    Parameters
    ----------
    models : dict of str to HybridForwardModel
        Models by name; those of the result are these, fitted.
    log : Log
        The measured log. Whole groups are held out, without groups single rows.
    folds : int or list of (train, test), default=5
        Number of folds, or training and test rows of each, places among the rows that count. Every
        such row must be a test row once.
    choices : {"anew", "settled"}, default="anew"
        Which choices the fits without a fold make: the parameters to calibrate, hysteresis,
        penalties, kernels and networks. "anew": all of them, in searches that start at those for
        all rows. "settled": none; they take those for all rows, which know the held-out rows, so
        the errors compare models, but are too small. Values are always fitted.
    sample_weight : array-like of shape (N,), optional
        How many times each row counts, as in `HybridForwardModel.fit`.
    models_for : callable, optional
        Returns the models for a log of training rows, e.g. after a calibration to them. Default:
        `models`.
    n_jobs : int, optional
        Largest number of processes.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    CrossFit
        The tips of every model for every row, the folds, and the fitted `models`.

    Raises
    ------
    ValueError
        As for `HybridForwardModel.fit`; for poses; and if folds do not hold out every row once.

    Examples
    --------
    >>> from hybridkin import HybridForwardModel, cross_fit, datasets, robots
    >>> data = datasets.load_trunk()
    >>> log = datasets.Log(data.q[:60], data.x[:60], groups=[k // 10 for k in range(60)])
    >>> chain = robots.bionic_handling_assistant()
    >>> models = {"nominal": HybridForwardModel(chain, "drop")}
    >>> models["linear"] = HybridForwardModel(chain, "linear", calibrate="default")
    >>> found = cross_fit(models, log, folds=3)
    >>> nominal, linear = found.errors.values()
    >>> bool(linear.mean + linear.std_error < nominal.mean)
    True
    """
    one_of(choices, "choices", ("anew", "settled"))
    _check_models(models)
    weights = np.ones(len(log.q))
    if sample_weight is not None:
        weights = _numbers_of_rows(sample_weight, len(log.q))
    weighted = _WeightedLog(log, weights)
    fits = {}
    for name, model in models.items():
        of_fit = partial(progress, f"fitting {name} to all motions")
        of_fit(0, 1)
        fits[name] = fit_once(*weighted.prepared(model), of_fit)
    if choices == "settled":
        held_out = partial(_held_out_settled, fits)
    else:
        starts = {}
        for name, fit in fits.items():
            starts[name] = (fit.fitted.error.settled, fit.starts)
        of_fold = models_for or partial(_unchanged, models)
        held_out = partial(_held_out_anew, of_fold, weighted, starts)
    measured = weighted.measured
    splits = _splits(folds, measured)
    chooses = any(fit.spec.error_model.chooses for fit in fits.values())
    most = max(1, len(measured) // _ROWS_PER_PROCESS[chooses])
    n_processes = min(effective_n_jobs(n_jobs or 1), len(splits), most)
    results = []
    progress("cross-validation by motion", 0, len(splits))
    for of_fold in _in_processes(held_out, splits, n_processes):
        results.append(of_fold)
        progress("cross-validation by motion", len(results), len(splits))
    tables = {}
    for name, fit in fits.items():
        predicted = [of_fold[name] for of_fold in results]
        table = CrossFit.of(fit.names, measured, splits, predicted, fit.outer())
        if choices == "settled":
            fit = fit.decided(table)
        else:
            fit = fit.with_settled_blend(table).with_radius(table)
        found = fit.found()
        models[name].take_fit(found)
        for message in found.messages:
            warnings.warn(message, stacklevel=2)
        tables[name] = table
    return CrossFit.of_models(tables, models)


class _WeightedLog(NamedTuple):
    """A log with the number of times (N,) that each row counts."""

    log: Log
    weights: NDArray

    @property
    def counted(self) -> NDArray[np.intp]:
        """The rows that count (K,)."""
        return np.flatnonzero(self.weights)

    @property
    def measured(self) -> Rows:
        """The rows that count."""
        log = self.log.rows(self.counted)
        return Rows.of(log.q, log.x, self.weights[self.counted], log.groups)

    def prepared(self, model: HybridForwardModel) -> tuple[Spec, Rows]:
        """Return the checked settings of a model and the rows that it needs.

        Rows that do not count move the actuators; a model without hysteresis does not need them.
        """
        if model.output == "pose":
            raise ValueError(
                "`models` must predict positions, got one with output='pose'; fit "
                "output='position' to the same log."
            )
        log = self.log
        weights = self.weights
        if not model.follows_order:
            log = log.rows(self.counted)
            weights = weights[self.counted]
        return model.prepared(log.commands, log.x, weights, log.groups)


def _check_models(models: object) -> None:
    """Raise unless these are models by name."""
    if not isinstance(models, Mapping) or not models:
        raise TypeError(
            f"`models` must be a dict of str to HybridForwardModel, got {models!r:.80}."
        )


def _numbers_of_rows(sample_weight: ArrayLike, n_rows: int) -> NDArray:
    """Return how many times each of the rows counts."""
    weights = np.asarray(sample_weight)
    if weights.shape != (n_rows,) or weights.dtype.kind not in "biuf":
        raise ValueError(
            f"`sample_weight` must be {n_rows} numbers, one for each row, got "
            f"{sample_weight!r:.80}."
        )
    if not (np.isfinite(weights).all() and (weights >= 0).all() and weights.any()):
        raise ValueError("`sample_weight` must be finite, not negative, and positive for some row.")
    return weights.astype(float)


def _splits(folds: int | Sequence[Split], measured: Rows) -> list[Split]:
    """Return training and test rows of each fold; raise if a row is not tested once."""
    if isinstance(folds, int):
        most = whole(folds, "folds", 2, 1000)
        return measured.groups.folds(most)
    if not isinstance(folds, Sequence) or isinstance(folds, (str, bytes)):
        raise TypeError(
            f"`folds` must be a number, or a list of pairs (train, test), got {folds!r:.80}."
        )
    try:
        splits = [(np.asarray(train), np.asarray(test)) for train, test in folds]
        tested = np.sort(np.concatenate([test for _, test in splits]))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`folds` must be a list of pairs (train, test) of rows, got {folds!r:.80}."
        ) from error
    if not np.array_equal(tested, np.arange(len(measured))):
        raise ValueError(
            f"`folds` must hold out each of the {len(measured)} rows that count once, got "
            f"{len(tested)} test rows; a number of folds makes such a list."
        )
    return splits


def _unchanged(models: Models, rows: Log) -> Models:
    """Return the same models for all training rows."""
    return models


@one_thread()  # the processes share the cores already
def _held_out_anew(
    models_for: Callable[[Any], Models],
    weighted: _WeightedLog,
    starts: Mapping[str, tuple[ErrorModel, Starts]],
    train: NDArray,
    test: NDArray,
) -> dict[str, Predictions]:
    """Return what models with new choices predict for test rows after fits to training rows."""
    training_log = weighted.log.rows(weighted.counted[train])
    held_out = {}
    for name, model in models_for(training_log).items():
        spec, rows = weighted.prepared(model)
        anew = Anew(spec.starting_at(*starts[name]), rows)
        held_out[name] = anew.held_out(train, test)
    return held_out


@one_thread()
def _held_out_settled(
    fits: Mapping[str, FitOnce], train: NDArray, test: NDArray
) -> dict[str, Predictions]:
    """Return what models with the choices for all rows predict for test rows."""
    return {name: fit.settled().held_out(train, test) for name, fit in fits.items()}


def _in_processes(
    held_out: Callable[[NDArray, NDArray], dict[str, Predictions]],
    splits: Sequence[Split],
    n_processes: int,
) -> Iterator[dict[str, Predictions]]:
    """Yield the predictions of every fold in their order."""
    # Otherwise torch and BLAS start threads in every process, which wait for each other.
    workers = Parallel(
        n_jobs=n_processes,
        backend="loky",
        inner_max_num_threads=1,
        return_as="generator",
    )
    from_workers: Any = workers(delayed(held_out)(*split) for split in splits)
    yield from from_workers
