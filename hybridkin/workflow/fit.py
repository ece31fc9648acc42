"""A measured log: calibrate, compare by motions held out, choose, fit and save."""

from __future__ import annotations

import contextlib
import shutil
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed, effective_n_jobs
from numpy.typing import NDArray
from sklearn.model_selection import GroupKFold
from threadpoolctl import threadpool_limits

from hybridkin import robots
from hybridkin.calibration.calibrate import calibrate
from hybridkin.chains.elastic_tendons import ElasticTendonChain
from hybridkin.hybrid.estimator import GUARDS
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.learning.elm import ELMRegressor
from hybridkin.saving.saved_model import save_model
from hybridkin.workflow._fit_report import (
    auto_entry,
    auto_in_short,
    write_auto,
    write_calibration,
    write_check,
    write_comparison,
)
from hybridkin.workflow.log import (
    MeasuredLog,
    OnCheck,
    check,
    not_told,
    read_log,
)
from hybridkin.workflow.report import (
    Progress,
    Report,
    check_out,
    distance,
    linear,
    quadratic,
    quiet,
)

ALPHAS = tuple(10.0**k for k in range(-5, 4))
"""Ridge weights to choose from."""

AUTO = "hybrid, auto"
ELM = "hybrid, ELM"
_SAVED = ("mechanical, calibrated", "hybrid, linear", ELM, AUTO)  # what a file can hold
_N_HIDDEN = 100
_INNER_FOLDS = 4
_ROWS_PER_PROCESS = {True: 150, False: 1500}  # with and without auto: fewer do not pay for a start


class Choice(NamedTuple):
    """An error model by its ridge weight and guard; no ridge weight: no correction at all."""

    alpha: float | None
    guard: str | None

    def __str__(self) -> str:
        if self.alpha is None:
            return "no correction"
        return f"alpha = {self.alpha:g}, guard: {self.guard or 'none'}"


class _Settings(NamedTuple):
    parameters: tuple[str, ...]
    loss: str
    n_seeds: int
    auto: bool = True
    play: float | str | None = None


_DATA_CHOICES = tuple(Choice(alpha, None) for alpha in ALPHAS)
_HYBRID_CHOICES = (Choice(None, None), *(Choice(a, g) for g in GUARDS for a in ALPHAS))


def compare_by_group(
    chain: Any,
    q: NDArray,
    x: NDArray,
    groups: NDArray,
    *,
    parameters: Sequence[str] = ("radii", "base"),
    loss: str = "linear",
    n_folds: int = 5,
    n_seeds: int = 5,
    auto: bool = True,
    play: float | str | None = None,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> tuple[dict[str, NDArray], NDArray, list[dict[str, str]]]:
    """Return the errors of every model on motions that it has not seen.

    Whole groups are held out. Within the training groups of each fold the ridge weight and the
    guard of the networks, and all that ``error_model="auto"`` chooses, are chosen by groups held
    out once more, with the geometry calibrated anew, so that nothing of a test motion enters its
    own prediction.

    Parameters
    ----------
    chain : ConstantCurvatureChain or ElasticTendonChain
        Nominal kinematics.
    q, x : ndarray of shape (N, n) and (N, 3)
        Log [m].
    groups : ndarray of shape (N,)
        Motion of every row.
    parameters, loss
        As for `calibrate`.
    n_folds : int, default=5
        Folds of groups.
    n_seeds : int, default=5
        Random hidden layers; the errors are their average per row.
    auto : bool, default=True
        Whether ``error_model="auto"`` is among the models; it takes most of the time.
    play : float or "auto", optional
        Play of the actuators [m] that this hybrid knows, see `HybridForwardModel`; the rows of a
        motion are in the order of time then.
    n_jobs, progress
        Processes at most, and a callable handed (what, done, total).

    Returns
    -------
    errors : dict of str to ndarray of shape (N,)
        Tip distance of each row when its motion was held out [m].
    fold : ndarray of shape (N,)
        Fold in which a row was held out.
    choices : list of dict
        What was chosen in each fold.
    """
    settings = _Settings(tuple(parameters), loss, n_seeds, auto, play)
    folds = list(GroupKFold(min(n_folds, len(np.unique(groups)))).split(q, groups=groups))
    jobs = (delayed(_one_fold)(chain, q, x, groups, *fold, settings) for fold in folds)
    errors: dict[str, NDArray] = {}
    fold_of_row = np.empty(len(q), dtype=int)
    choices = []
    most = min(effective_n_jobs(n_jobs or 1), len(folds), max(1, len(q) // _ROWS_PER_PROCESS[auto]))
    # Else torch and BLAS start threads in every process, and these wait for each other.
    workers = Parallel(n_jobs=most, backend="loky", inner_max_num_threads=1, return_as="generator")
    results: Any = workers(jobs)
    for i, ((_, test), (found, chosen)) in enumerate(zip(folds, results, strict=True)):
        for name, values in found.items():
            errors.setdefault(name, np.empty(len(q)))[test] = values
        fold_of_row[test] = i
        choices.append(chosen)
        progress("cross-validation by motion", i + 1, len(folds))
    return errors, fold_of_row, choices


def fit_log(
    log: str | Path,
    robot: str | Path,
    out: str | Path,
    *,
    log_format: robots.LogFormat | None = None,
    groups: str | None = None,
    exclude: Sequence[str] = (),
    loss: str = "linear",
    coverage: float | None = None,
    n_folds: int = 5,
    n_seeds: int = 5,
    auto: bool = True,
    play: float | str | None = None,
    max_rows: int | None = 2000,
    drop_invalid: bool = False,
    drop_frozen: bool = False,
    delimiter: str | None = None,
    force: bool = False,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
    on_check: OnCheck = not_told,
) -> tuple[Report, list[Path]]:
    """Calibrate and fit a hybrid model to a measured log, and write it with its report.

    Saved is the model with the least mean error on motions held out, of the calibrated mechanical
    model and the hybrids with a linear error model, an ELM, and what ``error_model="auto"`` takes.

    Parameters
    ----------
    log : str or Path
        CSV, npz or parquet file with the columns that the robot description names.
    robot : str or Path
        Robot description, see `robots.read_description`.
    out : str or Path
        Folder to write into.
    log_format : LogFormat, optional
        How the log is written. Default: the [log] table of the description.
    groups : str, optional
        Column that names the motion of every row, in place of the format's. Without any the log
        is cut into 10 stretches.
    exclude : sequence of str, optional
        Patterns of motions to leave out, ``"*tendon*"`` for example.
    loss, n_folds, n_seeds, auto, play, n_jobs, progress
        As in `compare_by_group`. `play` needs `auto`, and named motions in the order of time.
    coverage : float, optional
        As for `HybridForwardModel`: the saved model tells a radius for this share of tips.
    max_rows : int or None, default=2000
        Of a longer log every k-th row is taken, so that at most so many remain; None: all rows.
    drop_invalid, drop_frozen : bool, default=False
        Leave out rows with missing or infinite values, and rows whose tip is frozen, instead of
        stopping there.
    delimiter : str, optional
        As for `datasets.load_log`.
    force : bool, default=False
        Fit in spite of errors that the check of the log finds.
    on_check : callable, optional
        Handed the `datasets.LogReport` before the work begins.

    Returns
    -------
    report : Report
        Its ``record`` holds every number.
    paths : list of Path
        What was written, the model among it.

    Raises
    ------
    ValueError
        If the log, the description or what they hold together is no good; of a log that does not
        pass its check with that ``report``.
    """
    check_out(out)
    if play is not None and not auto:
        raise ValueError('`play` is known to the hybrid "auto" alone; leave out --no-auto.')
    description = robots.read_description(robot)
    log_format = log_format or described_format(description, robot)
    if groups is not None:
        log_format = replace(log_format, groups=groups)
    chain, names = description.chain, description.calibrate
    whole = read_log(
        log,
        log_format,
        chain=chain,
        base_is_free="base" in names,
        exclude=exclude,
        drop_invalid=drop_invalid,
        drop_frozen=drop_frozen,
        delimiter=delimiter,
    )
    n_motions = len(np.unique(whole.motions))
    if n_motions < 2:
        raise ValueError(
            f"`groups` must name at least 2 motions to hold one out, but column "
            f"{log_format.groups!r} leaves {n_motions}."
        )
    if play is not None:
        if not whole.named:
            raise ValueError(
                "`play` needs motions, their rows in the order of time; name the column that tells "
                "them apart: --groups COLUMN, or groups = in [log]."
            )
        whole.check_order("`play`")
    check(whole, on_check, force)
    data = whole.thinned(max_rows)
    errors, fold, choices = compare_by_group(
        chain,
        data.q,
        data.x,
        data.motions,
        parameters=names,
        loss=loss,
        n_folds=n_folds,
        n_seeds=n_seeds,
        auto=auto,
        play=play,
        n_jobs=n_jobs,
        progress=progress,
    )
    saved = min(errors.keys() & set(_SAVED), key=lambda name: (errors[name].mean(), name))
    progress(f"fitting {saved} to all motions", 0, 1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = calibrate(chain, data.q, data.x, names, loss=loss)
    for warning in caught:
        warnings.warn(warning.message, stacklevel=2)
    settings = _Settings(names, loss, n_seeds, auto, play)
    with _silence():  # all that is to say has been said of the whole log
        model, why = _final(saved, chain, result.chain, data, settings, coverage)
    progress(f"fitting {saved} to all motions", 1, 1)
    report = Report(f"{description.name}: hybrid model of {Path(log).name}")
    report.record.update(
        log=Path(log).name,
        robot=description.name,
        n=len(data.q),
        n_whole=len(whole.q),
        n_motions=n_motions,
        excluded=list(exclude),
        n_seeds=n_seeds,
        loss=loss,
        saved=saved,
        chosen=why,
        choices_by_fold=choices,
    )
    write_check(report, whole)
    write_comparison(report, errors, fold, data, len(whole.q), _N_HIDDEN)
    report.text(
        f"Saved is the model with the least mean error here: **{saved}** ({why}), fitted to all "
        f"motions. Chosen in the folds: " + "; ".join(c.get(saved, "-") for c in choices) + "."
    )
    if saved == AUTO:
        write_auto(report, auto_entry(model))
    write_calibration(report, chain, result, [str(warning.message) for warning in caught])
    if isinstance(model.mechanical_model_, ElasticTendonChain) and model.calibration_ is not None:
        start = chain
        if not isinstance(chain, ElasticTendonChain):
            start = ElasticTendonChain.from_chain(chain)
        title = "Calibration of the elastic tendons that auto took"
        write_calibration(report, start, model.calibration_, [], title, "calibration_of_saved")
    kept = ("log", "robot", "n_whole", "n_motions", "excluded", "loss", "saved", "chosen")
    training = {key: report.record[key] for key in (*kept, "held_out")}
    training |= {"rows": len(data.q), "split": whole.split}
    report.file("model.safetensors", lambda path: save_model(model, path, training=training))
    report.file("robot.toml", lambda path: shutil.copyfile(robot, path))
    report.text(
        "The model: `hybridkin.load_model('model.safetensors')`. `robot.toml` is the description "
        "it was made from."
    )
    return report, report.write(out)


def described_format(description: robots.RobotDescription, path: str | Path) -> robots.LogFormat:
    """Return how the robot's logs are written, or raise where its description does not say."""
    if description.log is None:
        raise ValueError(
            f"{path} has no [log] table; name the columns of q and x there, as in "
            "help(hybridkin.robots.read_description)."
        )
    return description.log


def _final(
    saved: str,
    chain: Any,
    calibrated: Any,
    data: MeasuredLog,
    settings: _Settings,
    coverage: float | None,
) -> tuple[HybridForwardModel, str]:
    """Return the model to save, fitted to all rows, and what was chosen for it."""
    if saved == AUTO:
        model = _auto_model(chain, calibrated, settings)
        why = ""
    elif saved == ELM:
        choice = _choose(chain, data.q, data.x, data.motions, _HYBRID_CHOICES, settings)
        model, why = _elm_model(calibrated, choice, 0), str(choice)
    else:
        error_model, why = ("drop", "no correction")
        if saved == "hybrid, linear":
            error_model, why = linear(), "linear"
        model = HybridForwardModel(calibrated, error_model)
    model.set_params(coverage=coverage).fit(data.q, data.x, groups=data.motions)
    if saved == AUTO and model.cv_results_ is not None:
        why = auto_in_short(auto_entry(model))
    return model, why


def _auto_model(chain: Any, calibrated: Any, settings: _Settings) -> HybridForwardModel:
    """Return the hybrid that chooses for itself.

    It calibrates anew in every fold of its own, by least squares; a loss that bounds outliers is
    kept by starting from the chain so calibrated.
    """
    names = settings.parameters if settings.loss == "linear" else ()
    start = chain if settings.loss == "linear" else calibrated
    return HybridForwardModel(start, "auto", calibrate=names, play=settings.play, random_state=0)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keep back what would be said of every part of the log: the whole log has its say."""
    with warnings.catch_warnings():
        for message in (
            "calibration left what is physical",
            "the actuators run the other way",
            r"\d+ of \d+ rows of `\w+` pull the tendons of a segment together",
        ):
            warnings.filterwarnings("ignore", message)
        yield


@_silence()
@threadpool_limits.wrap(limits=1)  # the processes share the cores already
def _one_fold(
    chain: Any,
    q: NDArray,
    x: NDArray,
    groups: NDArray,
    train: NDArray,
    test: NDArray,
    settings: _Settings,
) -> tuple[dict[str, NDArray], dict[str, str]]:
    rows = q[train], x[train]

    def held_out(*models: HybridForwardModel) -> NDArray:
        errors = [distance(model.fit(*rows).predict(q[test]), x[test]) for model in models]
        return np.mean(errors, axis=0)

    def with_elm(fitted: Any, choice: Choice) -> NDArray:
        return held_out(*(_elm_model(fitted, choice, seed) for seed in range(settings.n_seeds)))

    calibrated = _calibrated(chain, *rows, settings.parameters, settings.loss)
    nominal = chain
    if "base" in settings.parameters:
        nominal = _calibrated(chain, *rows, ("base",), settings.loss)
    data_choice, hybrid_choice = (
        _choose(start, *rows, groups[train], candidates, settings)
        for start, candidates in ((None, _DATA_CHOICES), (chain, _HYBRID_CHOICES))
    )
    errors = {
        "mechanical, nominal": held_out(HybridForwardModel(nominal, "drop")),
        "mechanical, calibrated": held_out(HybridForwardModel(calibrated, "drop")),
        "data-driven, linear": held_out(HybridForwardModel(None, linear())),
        "data-driven, quadratic": held_out(HybridForwardModel(None, quadratic())),
        "data-driven, ELM": with_elm(None, data_choice),
        "hybrid, linear": held_out(HybridForwardModel(calibrated, linear())),
        "hybrid, quadratic": held_out(HybridForwardModel(calibrated, quadratic())),
        ELM: with_elm(calibrated, hybrid_choice),
    }
    chosen = {"data-driven, ELM": str(data_choice), ELM: str(hybrid_choice)}
    if settings.auto:
        auto: Any = _auto_model(chain, calibrated, settings).fit(*rows, groups=groups[train])
        errors[AUTO] = distance(auto.predict(q[test], groups=groups[test]), x[test])
        chosen[AUTO] = auto_in_short(auto_entry(auto))
    return errors, chosen


def _choose(
    chain: Any,
    q: NDArray,
    x: NDArray,
    groups: NDArray,
    candidates: Sequence[Choice],
    settings: _Settings,
) -> Choice:
    """Return the candidate with the least mean error on groups held out, calibrated anew."""
    errors = np.zeros(len(candidates))
    folds = GroupKFold(min(_INNER_FOLDS, len(np.unique(groups))))
    for train, test in folds.split(q, groups=groups):
        fitted = chain
        if chain is not None and settings.parameters:
            fitted = _calibrated(chain, q[train], x[train], settings.parameters, settings.loss)
        for i, candidate in enumerate(candidates):
            model = _elm_model(fitted, candidate, 0).fit(q[train], x[train])
            errors[i] += distance(model.predict(q[test]), x[test]).sum()
    return candidates[int(errors.argmin())]


def _calibrated(chain: Any, q: NDArray, x: NDArray, parameters: tuple[str, ...], loss: str) -> Any:
    return calibrate(chain, q, x, parameters, loss=loss).chain


def _elm_model(chain: Any, choice: Choice, seed: int) -> HybridForwardModel:
    if choice.alpha is None:
        return HybridForwardModel(chain, "drop")
    elm = ELMRegressor(_N_HIDDEN, choice.alpha, random_state=seed)
    return HybridForwardModel(chain, elm, guard=choice.guard)
