"""A measured log: calibrate, compare by motions held out, choose, fit and save."""

from __future__ import annotations

import contextlib
import fnmatch
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray
from sklearn.model_selection import GroupKFold
from threadpoolctl import threadpool_limits

from hybridkin import datasets, plots, robots
from hybridkin.calibration import CalibrationResult, calibrate
from hybridkin.elm import ELMRegressor
from hybridkin.experiments._report import (
    GEOMETRY_HEADER,
    TOLD,
    Progress,
    Report,
    check_out,
    distance,
    geometry_entries,
    geometry_rows,
    linear,
    quadratic,
    quiet,
)
from hybridkin.guards import GUARDS
from hybridkin.hybrid import HybridForwardModel
from hybridkin.persistence import save_model

ALPHAS = tuple(10.0**k for k in range(-5, 4))
"""Ridge weights to choose from."""

_N_HIDDEN = 100
_INNER_FOLDS = 4
_BLOCKS = 10


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
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> tuple[dict[str, NDArray], NDArray, list[dict[str, str]]]:
    """Return the errors of every model on motions that it has not seen.

    Whole groups are held out. Within the training groups of each fold the ridge weight and the
    guard of the networks are chosen by groups held out once more, with the geometry calibrated
    anew, so that nothing of a test motion enters its own prediction.

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
    n_jobs, progress
        Processes, and a callable handed (what, done, total).

    Returns
    -------
    errors : dict of str to ndarray of shape (N,)
        Tip distance of each row when its motion was held out [m].
    fold : ndarray of shape (N,)
        Fold in which a row was held out.
    choices : list of dict
        What was chosen in each fold.
    """
    settings = _Settings(tuple(parameters), loss, n_seeds)
    folds = list(GroupKFold(min(n_folds, len(np.unique(groups)))).split(q, groups=groups))
    jobs = (delayed(_one_fold)(chain, q, x, groups, *fold, settings) for fold in folds)
    errors: dict[str, NDArray] = {}
    fold_of_row = np.empty(len(q), dtype=int)
    choices = []
    results: Any = Parallel(n_jobs=n_jobs, return_as="generator")(jobs)
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
    groups: str | None = None,
    exclude: Sequence[str] = (),
    loss: str = "linear",
    n_folds: int = 5,
    n_seeds: int = 5,
    drop_invalid: bool = False,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> tuple[Report, list[Path]]:
    """Calibrate and fit a hybrid model to a measured log, and write it with its report.

    Parameters
    ----------
    log : str or Path
        CSV file with the columns that the robot description names.
    robot : str or Path
        Robot description, see `robots.read_description`; it needs a [log] table.
    out : str or Path
        Folder to write into.
    groups : str, optional
        Column that names the motion of every row. Without it the log is cut into 10 stretches.
    exclude : sequence of str, optional
        Patterns of motions to leave out, ``"*tendon*"`` for example.
    loss, n_folds, n_seeds, n_jobs, progress
        As in `compare_by_group`.
    drop_invalid : bool, default=False
        Leave out rows with missing or infinite values instead of stopping there.

    Returns
    -------
    report : Report
        Its ``record`` holds every number.
    paths : list of Path
        What was written, the model among it.
    """
    check_out(out)
    description = robots.read_description(robot)
    data, motions = _read(log, robot, description.log, groups, exclude, drop_invalid)
    chain, names = description.chain, description.calibrate
    errors, fold, choices = compare_by_group(
        chain,
        data.q,
        data.x,
        motions,
        parameters=names,
        loss=loss,
        n_folds=n_folds,
        n_seeds=n_seeds,
        n_jobs=n_jobs,
        progress=progress,
    )
    progress("fitting the model to all motions", 0, 1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = calibrate(chain, data.q, data.x, names, loss=loss)
    for warning in caught:
        warnings.warn(warning.message, stacklevel=2)
    settings = _Settings(names, loss, n_seeds)
    with _silence():  # all that is to say has been said of the whole log
        choice = _choose(chain, data.q, data.x, motions, _HYBRID_CHOICES, settings)
        model = _elm_model(result.chain, choice, 0).fit(data.q, data.x)
    progress("fitting the model to all motions", 1, 1)
    report = Report(f"{description.name}: hybrid model of {Path(log).name}")
    report.record.update(
        log=Path(log).name,
        n=len(data.q),
        n_motions=len(np.unique(motions)),
        excluded=list(exclude),
        n_seeds=n_seeds,
        loss=loss,
        choice=choice._asdict(),
        choices_by_fold=choices,
    )
    _write_comparison(report, errors, fold, motions, groups)
    report.text(
        f"Chosen for the saved model, by the same cross-validation on all motions: **{choice}**. "
        f"Chosen in the folds: " + "; ".join(c["hybrid, ELM"] for c in choices) + "."
    )
    _write_calibration(report, chain, result, [str(warning.message) for warning in caught])
    report.file("model.safetensors", lambda path: save_model(model, path))
    report.text("The model: `hybridkin.load_model('model.safetensors')`.")
    return report, report.write(out)


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
        "hybrid, ELM": with_elm(calibrated, hybrid_choice),
    }
    return errors, {"data-driven, ELM": str(data_choice), "hybrid, ELM": str(hybrid_choice)}


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


def _read(
    log: str | Path,
    robot: str | Path,
    log_format: robots.LogFormat | None,
    groups: str | None,
    exclude: Sequence[str],
    drop_invalid: bool,
) -> tuple[Any, NDArray]:
    if log_format is None:
        raise ValueError(
            f"{robot} has no [log] table; name the columns of q and x there, as in "
            "help(hybridkin.robots.read_description)."
        )
    data = datasets.load_csv(
        log,
        log_format.q,
        log_format.x,
        groups,
        q_unit=log_format.q_unit,
        x_unit=log_format.x_unit,
        q_sign=log_format.q_sign,
        drop_invalid=drop_invalid,
    )
    if groups is None:
        if exclude:
            raise ValueError("`exclude` needs `groups`, the column that names the motions.")
        return data, np.arange(len(data.q)) * _BLOCKS // len(data.q)
    motions = np.array([str(name).removesuffix(log_format.group_suffix) for name in data.groups])
    kept = np.array([not any(fnmatch.fnmatch(m, p) for p in exclude) for m in motions])
    if len(np.unique(motions[kept])) < 2:
        raise ValueError(
            f"`groups` must name at least 2 motions to hold one out, but column {groups!r} has "
            f"{len(np.unique(motions))}, of which {len(np.unique(motions[kept]))} are kept."
        )
    data.q, data.x = data.q[kept], data.x[kept]
    return data, motions[kept]


def _write_comparison(
    report: Report,
    errors: dict[str, NDArray],
    fold: NDArray,
    motions: NDArray,
    groups: str | None,
) -> None:
    n_folds = int(fold.max()) + 1
    split = (
        f"motions of column `{groups}`"
        if groups
        else f"{_BLOCKS} stretches of the log (no column of motions was named: give `--groups`)"
    )
    report.text(
        "## On motions it has not seen",
        f"{len(motions)} rows, {len(np.unique(motions))} {split}, held out whole in {n_folds} "
        f"folds; ELM with {_N_HIDDEN} neurons, ridge weight and guard chosen by motions held out "
        f"within the training part, {report.record['n_seeds']} random hidden layers. "
        '"Nominal" has the geometry of the robot description with only the base pose fitted, '
        "when that is among the calibrated. Tip error in mm.",
    )
    rows, record = [], {}
    for name, values in errors.items():
        by_fold = np.array([values[fold == k].mean() for k in range(n_folds)])
        record[name] = {
            "mean": values.mean(),
            "std": values.std(),
            "p95": np.percentile(values, 95),
            "max": values.max(),
            "std_folds": by_fold.std(),
            "by_fold": by_fold,
        }
        columns = ("mean", "std", "p95", "max", "std_folds")
        rows.append([name, *(f"{1000 * record[name][column]:.2f}" for column in columns)])
    report.record["held_out"] = record
    report.table(["model", "mean", "std over rows", "95 %", "max", "std over folds"], rows)
    best = min(record, key=lambda name: record[name]["mean"])
    calibrated, hybrid = (record[f"{m}"]["mean"] for m in ("mechanical, calibrated", "hybrid, ELM"))
    report.text(
        f"Calibrated mechanical model over hybrid ELM: **{calibrated / hybrid:.2f}**. Least mean "
        f"error: {best}."
    )
    figure, ax = plots.new_figure(7.0, 3.6)
    plots.ErrorBoxDisplay(errors).plot(ax, unit="mm")
    ax.set_xlim(0.0, 1100 * float(np.percentile(errors["mechanical, nominal"], 99)))
    report.figure(
        "held_out",
        figure,
        "Tip error on motions held out: quartiles, 5 and 95 %; larger errors lie beyond the axis.",
    )
    figure, ax = plots.new_figure(5.5, 3.4)
    shown = ("mechanical, calibrated", "hybrid, ELM")
    plots.ErrorHistogramDisplay({name: errors[name] for name in shown}).plot(ax, unit="mm")
    ax.set(ylabel="rows")
    report.figure("error_histogram", figure, "Tip errors on motions held out.")
    names = np.unique(motions)
    means = {n: [1000 * errors[n][motions == name].mean() for name in names] for n in shown}
    worst = np.argsort(means["hybrid, ELM"])[::-1][:5]
    report.text("The five motions that the hybrid ELM predicts worst:")
    report.table(
        ["motion", "rows", *shown],
        [
            [
                str(names[i]),
                str((motions == names[i]).sum()),
                *(f"{means[n][i]:.1f}" for n in shown),
            ]
            for i in worst
        ],
    )


def _write_calibration(
    report: Report, chain: Any, result: CalibrationResult, warned: list[str]
) -> None:
    entries = geometry_entries(chain, result)
    report.text(
        "## Calibration on all motions",
        f"Root mean square tip error {1000 * result.rmse:.2f} mm. Standard errors count every row "
        "as independent and are too small where rows follow each other closely. What narrows the "
        f"prior of a parameter less than {TOLD:.0f} times does not tell it: its value is an "
        "assumption. The base by its turn from the start and its position.",
    )
    report.table(GEOMETRY_HEADER, geometry_rows(entries))
    report.text(*(f"Warning: {message}" for message in warned))
    if result.unidentified:
        report.text("What the log leaves open:", *(f"- {line}" for line in result.unidentified))
    report.record["calibration"] = {
        "values": result.values,
        "std_errors": result.std_errors,
        "rmse": result.rmse,
        "warnings": warned,
        "identifiable": result.identifiable,
        "entries": entries,
        "unidentified": result.unidentified,
    }
