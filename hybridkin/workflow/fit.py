"""The fit to a measured log: check, compare models on held-out motions, fit the best, report."""

from __future__ import annotations

import shutil
import warnings
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from joblib import Parallel, delayed, effective_n_jobs
from numpy.typing import NDArray
from sklearn.linear_model import LinearRegression

from hybridkin._core.arrays import whole
from hybridkin._core.model import ForwardModel
from hybridkin._core.turns import one_thread
from hybridkin.calibration.calibrate import CalibrationResult, fit_geometry
from hybridkin.calibration.choice import GeometryChoice, choose_geometry
from hybridkin.calibration.measured import distances, folds
from hybridkin.chains import robots
from hybridkin.chains.chain import Chain
from hybridkin.datasets import Log
from hybridkin.hybrid.estimator import HybridForwardModel, fit_quietly
from hybridkin.hybrid.log_distance import held_out_distances
from hybridkin.learning.elm_cv import ELMRegressorCV
from hybridkin.learning.regressor_modules import error_module
from hybridkin.native.library import evaluate
from hybridkin.saving.saved_model import save_model
from hybridkin.workflow._deviations import deviations
from hybridkin.workflow._fit_report import (
    auto_entry,
    auto_in_short,
    write_calibration,
    write_check,
    write_choice,
    write_comparison,
    write_elastic_calibration,
    write_markers,
    write_model,
)
from hybridkin.workflow._promise import Promise
from hybridkin.workflow.log import MeasuredLog, checked
from hybridkin.workflow.model import LoadedModel
from hybridkin.workflow.report import (
    Progress,
    Report,
    check_out,
    geometry_entries,
    quadratic,
    quiet,
)

AUTO = "hybrid, auto"
CALIBRATED = "mechanical, calibrated"
_NOMINAL = "mechanical, nominal"
_BACKLASH = "mechanical, with backlash"
_DATA_LINEAR = "data-driven, linear"
_DATA_QUADRATIC = "data-driven, quadratic"
_DATA_ELM = "data-driven, ELM"
_HYBRID_ELM = "hybrid, ELM"
_FILES = ("model.safetensors", "robot.toml", "held_out.png", "error_histogram.png")
# With and without auto; fewer are not worth a start.
_ROWS_PER_PROCESS = {
    True: 150,
    False: 1500,
}


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit and of the comparison of models.

    Attributes
    ----------
    loss : str
        Loss of the calibration, see `calibrate`.
    coverage : float or None
        Share of tips that the estimated error radius of the saved model covers, see
        `HybridForwardModel`. None: no radius.
    n_folds : int
        Number of folds of motions that are held out, one after the other.
    auto : bool
        Whether to compare and save ``error_model="auto"``; it takes most of the time. Without it,
        the comparison has fewer hybrids, and the best of them or the calibrated model is saved.
    play : float, "auto", "detect" or None
        Backlash (also called play) of the actuators [m] in that hybrid, see `HybridForwardModel`.
        It requires `auto`, and named motions in order of time. "detect": "auto" if the log allows
        it and backlash lowers the held-out errors of a network, else None.
    max_rows : int or None
        Largest number of rows; of a longer log every k-th row is used. None: all rows.
    """

    loss: str = "linear"
    coverage: float | None = None
    n_folds: int = 5
    auto: bool = True
    play: float | str | None = "detect"
    max_rows: int | None = 2000

    def __post_init__(self) -> None:
        """Check the counts."""
        whole(self.n_folds, "n_folds", 2, 1000)
        whole(2 if self.max_rows is None else self.max_rows, "max_rows", 2)
        if not isinstance(self.auto, bool):
            raise ValueError(f"`auto` must be True or False, got {self.auto!r:.80}.")


class Comparison(NamedTuple):
    """Errors of models on held-out motions.

    Attributes
    ----------
    errors : dict of str to ndarray of shape (N,)
        Tip error of each row when its motion was held out [m]; for several markers their mean.
    markers : dict of str to ndarray of shape (N, K)
        Error of every marker [m], NaN if it was not measured.
    fold : ndarray of shape (N,)
        Fold in which a row was held out.
    distance : ndarray of shape (N,)
        Distance of each row from the rows of the other folds [half ranges of an actuator].
    choices : list of dict
        Settings that were chosen in each fold.
    """

    errors: dict[str, NDArray]
    markers: dict[str, NDArray]
    fold: NDArray
    distance: NDArray
    choices: list[dict[str, str]]


class _Rows(NamedTuple):
    """Rows of a log, with the robot and the settings of a fit to them."""

    q: NDArray
    x: NDArray
    groups: NDArray
    robot: robots.RobotDescription
    settings: FitSettings
    geometry: GeometryChoice | None = None

    def of(self, rows: NDArray) -> _Rows:
        return self._replace(q=self.q[rows], x=self.x[rows], groups=self.groups[rows])

    def with_geometry_chosen(self) -> _Rows:
        """Return the rows with the parameters to calibrate, chosen if the robot says "auto"."""
        robot = self.robot
        if robot.chain is None or robot.calibrate != "auto":
            return self
        chosen = choose_geometry(
            robot.chain, self.q, self.x, groups=self.groups, loss=self.settings.loss
        )
        return self._replace(geometry=chosen)

    def calibrated(self) -> tuple[Chain | None, CalibrationResult | None, list[str]]:
        """Return the chain before its calibration, the result, and its warnings."""
        geometry = self.geometry
        chain = self.robot.chain
        names = self.robot.calibrate
        start = None
        messages = []
        if geometry is not None:
            chain = geometry.chain
            names = geometry.parameters
            start = geometry.start
            messages = [*geometry.messages]
        if chain is None or not names:
            return chain, None, messages
        result, of_fit = fit_geometry(
            chain, self.q, self.x, names, self.settings.loss, start=start
        )
        return chain, result, messages + of_fit

    def rival_entries(self) -> list[dict[str, Any]]:
        """Return the `geometry_entries` of all sets of parameters with nearly the same errors."""
        entries = []
        for rival in () if self.geometry is None else self.geometry.rivals:
            chain, result, _ = self._replace(geometry=rival).calibrated()
            if chain is not None and result is not None:
                entries += geometry_entries(chain, result)
        return entries

    def nominal(self, chain: Chain) -> Chain:
        """Return the described chain, with a fitted base if the base is calibrated."""
        if not self.robot.base_is_free:
            return chain
        return fit_geometry(chain, self.q, self.x, ("base",), self.settings.loss)[
            0
        ].chain

    def mechanical(self) -> ForwardModel:
        """Return the calibrated chain; for a robot without segments a linear model of the rows."""
        chain, result, _ = self.calibrated()
        if chain is None:
            linear = LinearRegression().fit(self.q, self.x)
            return error_module(linear, torch.from_numpy(self.q))
        return chain if result is None else result.chain

    def with_play_detected(
        self, log: MeasuredLog, calibrated: ForwardModel | None
    ) -> _Rows:
        """Return the rows with a setting `play` that is not "detect"."""
        settings = self.settings
        if settings.play != "detect":
            return self
        play = None
        if calibrated is not None and settings.auto and log.named and not log.n_late:
            model = HybridForwardModel(calibrated, "drop", play="auto")
            fit_quietly(model, self.q, self.x, self.groups)
            play = None if model.play_ is None else "auto"
        return self._replace(settings=replace(settings, play=play))

    def auto_model(self, calibrated: ForwardModel) -> HybridForwardModel:
        """Return the hybrid with error_model="auto".

        It calibrates by least squares in each of its own folds. For another loss, which bounds
        outliers, it gets the calibrated chain and does not calibrate.
        """
        anew = self.settings.loss == "linear" and self.robot.chain is not None
        return HybridForwardModel(
            self.robot.chain if anew else calibrated,
            "auto",
            calibrate=self.robot.calibrate if anew else (),
            play=self.settings.play,
            random_state=0,
        )


def compare_by_group(
    log: Log,
    robot: robots.RobotDescription,
    settings: FitSettings = FitSettings(),
    *,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> Comparison:
    """Return the errors of every model on held-out motions.

    Whole motions are held out. In each fold, the geometry is chosen and calibrated on the training
    motions, and every model is fitted to them. ``error_model="auto"`` is fitted once; the table has
    each of its candidates, ``candidates_``, and itself. The prediction for a motion therefore never
    uses data of this motion. With `play` "detect" one choice is made on all motions: whether the
    folds look for backlash.

    Parameters
    ----------
    log : Log
        As from `read_log` or `datasets.load_log`; without groups it is cut into 10 parts.
    robot : RobotDescription
        Nominal kinematics, and the parameters to calibrate.
    settings : FitSettings, optional
        Loss, folds and models.
    n_jobs : int, optional
        Largest number of processes.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    Comparison
        Errors [m] by model and row, the fold of each row, and the choices of each fold.
    """
    log = checked(log, robot.chain, robot.base_is_free)
    parts = folds(log.q, log.motions, settings.n_folds)
    rows = _Rows(log.q, log.x, log.motions, robot, settings)
    if settings.play == "detect":
        if robot.chain is None:
            chain = None
        else:
            chain = rows.with_geometry_chosen().mechanical()
        rows = rows.with_play_detected(log, chain)
    jobs = (delayed(_one_fold)(rows.of(train), rows.of(test)) for train, test in parts)
    fold = np.empty(len(log.q), dtype=int)
    distance = np.empty(len(log.q))
    comparison = Comparison({}, {}, fold, distance, [])
    most = max(1, len(log.q) // _ROWS_PER_PROCESS[settings.auto])
    most = min(effective_n_jobs(n_jobs or 1), len(parts), most)
    # Otherwise torch and BLAS start threads in every process, which wait for each other.
    workers = Parallel(
        n_jobs=most, backend="loky", inner_max_num_threads=1, return_as="generator"
    )
    results: Any = workers(jobs)
    progress("cross-validation by motion", 0, len(parts))
    fitted_folds = []
    for i, ((train, test), (errors, chosen)) in enumerate(
        zip(parts, results, strict=True)
    ):
        fitted_folds.append(errors)
        comparison.fold[test] = i
        held_out = held_out_distances(log.q[train], log.motions[train], log.q[test])
        comparison.distance[test] = held_out
        comparison.choices.append(chosen)
        progress("cross-validation by motion", i + 1, len(parts))
    for name in sorted(fitted_folds[0], key=_kind_of_model):
        if any(
            name not in errors for errors in fitted_folds
        ):  # kernel ridge: up to 2000 rows
            continue
        comparison.markers[name] = np.empty((len(log.q), log.x.shape[1] // 3))
        for (_, test), errors in zip(parts, fitted_folds, strict=True):
            comparison.markers[name][test] = errors[name]
    comparison.errors.update(
        (name, np.nanmean(values, 1)) for name, values in comparison.markers.items()
    )
    return comparison


def fit_log(
    log: Log,
    robot: robots.RobotDescription,
    out: str | Path,
    settings: FitSettings = FitSettings(),
    *,
    force: bool = False,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> tuple[Report, list[Path]]:
    """Check a log, compare models on held-out motions, fit the best to all of it, and report.

    The hybrid with ``error_model="auto"`` is saved, which chooses among the other hybrids. Without
    it (`auto` of the settings) the calibrated model or the hybrid with the least mean error on
    held-out motions is saved. For a robot without segments, a linear model of the data takes the
    place of the mechanical model.

    Parameters
    ----------
    log : Log
        As from `read_log` or `datasets.load_log`.
    robot : RobotDescription
        As from `robots.read_description`.
    out : str or Path
        Folder to write into.
    settings : FitSettings, optional
        Settings of the fit and of the comparison.
    force : bool, default=False
        Fit even if the check of the log finds errors, and replace files of `out` that `fit` did
        not write.
    n_jobs, progress
        As in `compare_by_group`.

    Returns
    -------
    report : Report
        Its ``record`` holds every number.
    paths : list of Path
        The written files, including the model.

    Raises
    ------
    LogError
        If the log does not pass its check.
    ValueError
        If the log or the settings do not allow the comparison.
    """
    check_out(out, "fit", _FILES, force=force)
    if robot.chain is None and settings.play not in (None, "detect"):
        raise ValueError(
            "`play` requires a robot with segments: its width is a length."
        )
    complete = checked(log, robot.chain, robot.base_is_free)
    _check(complete, settings, force)
    data = complete.thinned(settings.max_rows)
    progress("calibration", 0, 1)
    rows = _Rows(data.q, data.x, data.motions, robot, settings).with_geometry_chosen()
    start, result, messages = rows.calibrated()
    if start is not None and result is not None:
        messages += [*complete.misread(result.chain), *deviations(start, result)]
    for message in messages:
        warnings.warn(message, stacklevel=2)
    chain = start if result is None else result.chain
    rows = rows.with_play_detected(complete, chain)
    compared = compare_by_group(
        data, robot, rows.settings, n_jobs=n_jobs, progress=progress
    )
    saved = AUTO if settings.auto else _best_to_save(compared)
    report_fit = partial(progress, f"fitting {saved} to all motions")
    report_fit(0, 1)
    mechanical = rows.mechanical() if result is None else result.chain
    model = _models(rows, mechanical)[saved]
    model.set_params(coverage=settings.coverage)
    fit_quietly(
        model,
        rows.q,
        rows.x,
        rows.groups,
        geometry=rows.geometry,
        progress=report_fit,
        log=(complete.q, complete.x),
    )
    progress("writing the report", 0, 1)
    report = Report(f"{robot.name}: hybrid model of {Path(log.source).name}")
    report.record.update(
        command="fit",
        n=len(data.q),
        saved=saved,
        chosen=_chosen(model),
        log=Path(log.source).name,
        robot=robot.name,
        n_whole=len(complete.q),
        n_motions=len(np.unique(complete.motions)),
        excluded=list(complete.excluded),
        loss=settings.loss,
        choices_by_fold=compared.choices,
    )
    promise = Promise.of(compared.errors[saved], compared.distance)
    report.record["promise"] = vars(promise)
    write_check(report, complete)
    write_comparison(report, compared.errors, compared.fold, data)
    write_markers(report, compared.markers[saved], f"{saved}, on held-out motions")
    write_model(report, model)
    if plane := LoadedModel(robot.name, Path(out), model, robot).plane_in_words():
        report.text(plane)
    if rows.geometry is not None:
        write_choice(report, rows.geometry)
    if start is not None and result is not None:
        write_calibration(report, start, result, messages, others=rows.rival_entries())
    if robot.chain is not None and rows.geometry is None:
        write_elastic_calibration(report, robot.chain, model)
    _add_model(report, model, robot, complete)
    return report, report.write(out)


def _check(log: MeasuredLog, settings: FitSettings, force: bool) -> None:
    """Raise if the log or the settings do not allow a comparison by motions."""
    n_motions = len(np.unique(log.motions))
    if n_motions < 2:
        raise ValueError(
            "`groups` must name at least 2 motions to hold one out, but the log has "
            f"{n_motions}; name another column: --groups COLUMN."
        )
    if settings.play not in (None, "detect"):
        if not settings.auto:
            raise ValueError("`play` requires `auto=True`; remove --no-auto.")
        if not log.named:
            raise ValueError(
                "`play` needs motions with rows in order of time; name the column of the motions: "
                "--groups COLUMN, or groups = in [log]."
            )
        log.check_order("`play`")
    log.check(force)


def _add_model(
    report: Report,
    model: HybridForwardModel,
    robot: robots.RobotDescription,
    log: MeasuredLog,
) -> None:
    """Add the model and the description of its robot to the files of the report."""
    entries = (
        "log",
        "robot",
        "n_whole",
        "n_motions",
        "excluded",
        "loss",
        "saved",
        "chosen",
    )
    training = {key: report.record[key] for key in (*entries, "held_out", "promise")}
    training |= {"rows": report.record["n"], "split": log.split}
    report.file(
        "model.safetensors", lambda path: save_model(model, path, training=training)
    )
    report.text("The model: `hybridkin.load_model('model.safetensors')`.")
    if robot.path is not None:  # the description it was made from
        report.file("robot.toml", partial(shutil.copyfile, robot.path))


@one_thread()  # the processes share the cores already
def _one_fold(train: _Rows, test: _Rows) -> tuple[dict[str, NDArray], dict[str, str]]:
    """Return the errors of every model on test rows after a fit to training rows, and choices."""
    train = train.with_geometry_chosen()
    errors = {}
    choices = {}
    for name, model in _models(train, train.mechanical()).items():
        geometry = train.geometry
        fit_quietly(
            model, train.q, train.x, train.groups, geometry=geometry, held_out=False
        )
        for candidate, module in (model.candidates_ or {}).items():
            if candidate != "mechanical":
                errors[f"hybrid, {candidate}"] = _held_out(model, module, test)
            elif train.settings.play is not None:  # else it is the calibrated model
                errors[_BACKLASH] = _held_out(model, module, test)
        errors[name] = _held_out(model, model.module_, test)
        if name in (_DATA_ELM, _HYBRID_ELM, AUTO):
            choices[name] = _chosen(model)
    return errors, choices


def _kind_of_model(name: str) -> int:
    """Return the place of the kind of a model in the table."""
    return ("mechanical", "data-driven", "hybrid").index(name.partition(",")[0])


def _models(rows: _Rows, mechanical: ForwardModel) -> dict[str, HybridForwardModel]:
    """Return the unfitted models of the comparison by name.

    For a robot without segments `mechanical` is a linear model of the data.
    """
    chain = rows.robot.chain
    models = {}
    if chain is None:
        models[_DATA_LINEAR] = HybridForwardModel(mechanical, "drop")
    else:
        models[_NOMINAL] = HybridForwardModel(rows.nominal(chain), "drop")
        models[CALIBRATED] = HybridForwardModel(mechanical, "drop")
    models[_DATA_QUADRATIC] = HybridForwardModel(None, quadratic())
    network = ELMRegressorCV(250, max_hidden=1000, random_state=0)  # as in auto
    if rows.settings.auto:
        models[_DATA_ELM] = HybridForwardModel(None, network)
        models[AUTO] = rows.auto_model(mechanical)
        return models
    if chain is not None:
        models["hybrid, linear"] = HybridForwardModel(mechanical, "linear")
    models["hybrid, quadratic"] = HybridForwardModel(mechanical, "quadratic")
    models[_HYBRID_ELM] = HybridForwardModel(mechanical, network)
    return models


def _best_to_save(compared: Comparison) -> str:
    """Return the model of least mean error that stays near a mechanical or linear model."""
    unsaved = (_NOMINAL, _DATA_QUADRATIC)
    errors = {name: values.mean() for name, values in compared.errors.items()}
    return min((name for name in errors if name not in unsaved), key=errors.__getitem__)


def _chosen(model: HybridForwardModel) -> str:
    """Return the chosen settings of a fitted model in words."""
    if model.cv_results_ is not None:
        return auto_in_short(auto_entry(model))
    network = model.error_model_
    if isinstance(network, ELMRegressorCV):
        return (
            f"{network.best_params_['n_hidden']} neurons, alpha = {network.alpha_:.3g}"
        )
    if not isinstance(model.error_model, str):
        return "a network for each marker"
    return "no correction" if model.error_model == "drop" else model.error_model


def _held_out(model: HybridForwardModel, module: ForwardModel, test: _Rows) -> NDArray:
    """Return the errors (N, K) of the markers on test rows by a module of the fitted model."""
    if model.play_ is None:
        q = test.q
    else:
        q = model.play_.apply_by_group(test.q, test.groups)
    return distances(evaluate(module, np.array(q, dtype=float))[0], test.x)
