"""The comparison of mechanical, data-driven and hybrid models on held-out motions of a log."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from joblib import Parallel, delayed, effective_n_jobs
from numpy.typing import ArrayLike, NDArray
from sklearn.linear_model import LinearRegression

from hybridkin import (
    CalibrationResult,
    Chain,
    Commands,
    ForwardModel,
    HybridForwardModel,
    Hysteresis,
    robots,
)
from hybridkin._core.turns import one_thread
from hybridkin.app.workflow.calibrated import CalibratedParameter, calibrated_parameters
from hybridkin.app.workflow.choices import (
    auto_in_short,
    choice_in_words,
    memory_in_words,
)
from hybridkin.app.workflow.errors import marker_distances
from hybridkin.app.workflow.log import MeasuredLog
from hybridkin.app.workflow.report import Progress, quiet
from hybridkin.arguments import whole
from hybridkin.calibration.calibrate import fit_geometry
from hybridkin.calibration.choice import GeometryChoice, choose_geometry
from hybridkin.calibration.measured import folds
from hybridkin.hybrid.estimator import prepared, with_fit
from hybridkin.hybrid.held_out import HeldOut, Predictions, chosen_blend
from hybridkin.hybrid.log_distance import held_out_distances
from hybridkin.hybrid.log_fit import FitStart, HybridFit, fit_to_log
from hybridkin.learning.elm_cv import growing_network
from hybridkin.learning.regressor_modules import error_module
from hybridkin.native import evaluate

NOMINAL = "mechanical, nominal"
CALIBRATED = "mechanical, calibrated"
BACKLASH = "mechanical, with backlash"
DATA_LINEAR = "data-driven, linear"
DATA_QUADRATIC = "data-driven, quadratic"
DATA_ELM = "data-driven, ELM"
HYBRID_ELM = "hybrid, ELM"
AUTO = "hybrid, auto"
_KINDS = ("mechanical", "data-driven", "hybrid")  # in the order of the table
# With and without auto; fewer are not worth a start.
_ROWS_PER_PROCESS = {True: 150, False: 1500}


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
    hysteresis : float, Hysteresis, "auto" or "detect"
        Hysteresis of the actuators in that hybrid, see `HybridForwardModel`. It requires `auto`,
        and named motions in order of time. "detect": "auto" if the log allows it and shows some,
        else none.
    max_rows : int or None
        Largest number of rows whose measurements count; of a longer log some motions are used, and
        some rows of each. All rows of these motions move the actuators. None: all rows count.
    """

    loss: str = "linear"
    coverage: float | None = None
    n_folds: int = 5
    auto: bool = True
    hysteresis: ArrayLike | Hysteresis | str = "detect"
    max_rows: int | None = 2000

    def __post_init__(self) -> None:
        """Check the counts."""
        whole(self.n_folds, "n_folds", 2, 1000)
        if self.max_rows is not None:
            whole(self.max_rows, "max_rows", 2)
        if not isinstance(self.auto, bool):
            raise ValueError(f"`auto` must be True or False, got {self.auto!r:.80}.")

    @property
    def follows_order(self) -> bool:
        """Whether the order of the rows counts for the hybrid: there may be a hysteresis."""
        return HybridForwardModel(hysteresis=self.hysteresis).follows_order


DEFAULTS = FitSettings()


@dataclass(frozen=True, eq=False)
class Comparison:
    """Errors of models on held-out motions.

    Attributes
    ----------
    tips : dict of str to ndarray of shape (N, 3 K)
        Predicted markers of each row when its motion was held out, by model [m].
    measured : ndarray of shape (N, 3 K)
        Measured markers [m], NaN if missing.
    fold : ndarray of shape (N,)
        Fold in which a row was held out.
    distance : ndarray of shape (N,)
        Distance of each row from the rows of the other folds [half ranges of an actuator].
    choices : list of dict
        Settings that were chosen in each fold.
    """

    tips: dict[str, NDArray]
    measured: NDArray
    fold: NDArray
    distance: NDArray
    choices: list[dict[str, str]]

    @cached_property
    def markers(self) -> dict[str, NDArray]:
        """Error of every marker of each row (N, K) by model [m], NaN if it was not measured."""
        return {
            name: marker_distances(tips, self.measured)
            for name, tips in self.tips.items()
        }

    @cached_property
    def errors(self) -> dict[str, NDArray]:
        """Tip error of each row (N,) by model [m]; for several markers their mean."""
        return {name: np.nanmean(e, axis=1) for name, e in self.markers.items()}


@dataclass(frozen=True, eq=False)
class Mechanical:
    """The mechanical model of a robot, calibrated to rows.

    Attributes
    ----------
    model : ForwardModel
        The calibrated chain; for a robot without segments a linear model of the rows.
    start : Chain or None
        The chain before its calibration.
    result : CalibrationResult or None
        None if nothing is calibrated.
    geometry : GeometryChoice or None
        How the parameters were chosen, if the robot says "auto".
    messages : list of str
        Warnings.
    """

    model: ForwardModel
    start: Chain | None
    result: CalibrationResult | None
    geometry: GeometryChoice | None
    messages: list[str]

    @property
    def parameters(self) -> str:
        """Name of the set of parameters that is calibrated, if the robot says "auto"."""
        return "" if self.geometry is None else self.geometry.name

    @property
    def tried(self) -> dict[str, dict[str, float]]:
        """Errors of the sets that were tried, "cv" and "io" [m]."""
        errors = {} if self.geometry is None else self.geometry.errors
        return {name: error.known() for name, error in errors.items()}

    @classmethod
    def of(
        cls,
        robot: robots.RobotDescription,
        rows: MeasuredLog,
        loss: str,
        of_all: Mechanical | None = None,
    ) -> Mechanical:
        """Return the mechanical model of a robot; that of all rows gives starts of its fits."""
        chain = robot.chain
        if chain is None:
            linear = LinearRegression().fit(rows.q, rows.x)
            model = error_module(linear, torch.from_numpy(rows.q))
            return cls(model, None, None, None, [])
        names = robot.calibrate
        geometry = None
        start = None
        messages = []
        if names == "auto":
            starts = ()
            if of_all is not None and of_all.geometry is not None:
                starts = of_all.geometry.starts
            geometry = choose_geometry(
                chain,
                rows.q,
                rows.x,
                groups=rows.motions,
                loss=loss,
                starts=starts,
            )
            chain = geometry.chain
            names = geometry.parameters
            start = geometry.start
            messages = [*geometry.messages]
        if not names:
            return cls(chain, chain, None, geometry, messages)
        result, of_fit = fit_geometry(chain, rows.q, rows.x, names, loss, start=start)
        return cls(result.chain, chain, result, geometry, messages + of_fit)

    def rivals(self, rows: MeasuredLog, loss: str) -> Iterator[CalibratedParameter]:
        """Yield the parameters of all other sets with nearly the same errors, calibrated."""
        rivals = () if self.geometry is None else self.geometry.rivals
        for rival in rivals:
            result, _ = fit_geometry(
                rival.chain, rows.q, rows.x, rival.parameters, loss, start=rival.start
            )
            yield from calibrated_parameters(rival.chain, result, rows.q_unit)


def models_to_save(
    robot: robots.RobotDescription, mechanical: Mechanical, settings: FitSettings
) -> dict[str, HybridForwardModel]:
    """Return the unfitted models of the comparison by name."""
    model = mechanical.model
    without_error_model = DATA_LINEAR if robot.chain is None else CALIBRATED
    models = {
        without_error_model: HybridForwardModel(model, "drop"),
        DATA_QUADRATIC: HybridForwardModel(None, "quadratic"),
    }
    network = growing_network(0)
    if settings.auto:
        models[DATA_ELM] = HybridForwardModel(None, network)
        models[AUTO] = _auto(robot, model, settings)
        return models
    if robot.chain is not None:
        models["hybrid, linear"] = HybridForwardModel(model, "linear")
    models["hybrid, quadratic"] = HybridForwardModel(model, "quadratic")
    models[HYBRID_ELM] = HybridForwardModel(model, network)
    return models


def _auto(
    robot: robots.RobotDescription, calibrated: ForwardModel, settings: FitSettings
) -> HybridForwardModel:
    """Return the hybrid with error_model="auto".

    It calibrates by least squares in each of its own folds. For another loss, which bounds
    outliers, it gets the calibrated chain and does not calibrate.
    """
    model = HybridForwardModel(
        calibrated, "auto", hysteresis=settings.hysteresis, random_state=0
    )
    if settings.loss == "linear" and robot.chain is not None:
        model.set_params(mechanical_model=robot.chain, calibrate=robot.calibrate)
    return model


def with_hysteresis_detected(
    settings: FitSettings, rows: MeasuredLog, mechanical: Mechanical
) -> FitSettings:
    """Return settings whose `hysteresis` is not "detect"."""
    if settings.hysteresis != "detect":
        return settings
    hysteresis = 0.0
    in_order = rows.named and not rows.n_late
    if mechanical.start is not None and settings.auto and in_order:
        model = HybridForwardModel(mechanical.model, "drop", hysteresis="auto")
        fitted = fit_to_log(*prepared(model, *columns_to_fit(model, rows)))
        hysteresis = "auto" if fitted.hysteresis else 0.0
    return replace(settings, hysteresis=hysteresis)


def columns_to_fit(
    model: HybridForwardModel, rows: MeasuredLog
) -> tuple[Commands, NDArray, NDArray, NDArray]:
    """Return commands, tips, motions and counts of the rows of a log that a model needs.

    Rows that do not count move the actuators; a model without hysteresis does not need them.
    """
    if not model.follows_order:
        rows = rows.measured
    return rows.commands, rows.x, rows.motions, rows.counts


class FittedModels(NamedTuple):
    """The models that can be saved, and their fits to all rows."""

    mechanical: Mechanical
    models: dict[str, HybridForwardModel]
    fits: dict[str, HybridFit]


def fit_to_all(
    rows: MeasuredLog,
    robot: robots.RobotDescription,
    settings: FitSettings,
    mechanical: Mechanical,
    progress: Progress = quiet,
) -> FittedModels:
    """Return every model that can be saved, fitted to all rows.

    Parameters
    ----------
    rows, robot, settings
        As for `compare_by_group`.
    mechanical : Mechanical
        That of all rows.
    progress : callable, optional
        Called with (what, done, total).
    """
    models = models_to_save(robot, mechanical, settings)
    fits = {}
    for name, model in models.items():
        progress_of_fit = partial(progress, f"fitting {name} to all motions")
        progress_of_fit(0, 1)
        if name == AUTO:  # it will be saved
            model.set_params(coverage=settings.coverage)
        spec, log = prepared(model, *columns_to_fit(model, rows))
        spec = replace(spec, progress=progress_of_fit, compared=True)
        fits[name] = fit_to_log(spec, log, mechanical.geometry)
    return FittedModels(mechanical, models, fits)


def compare_by_group(
    rows: MeasuredLog,
    robot: robots.RobotDescription,
    settings: FitSettings,
    fitted: FittedModels,
    *,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> Comparison:
    """Return the errors of every model on held-out motions.

    Whole motions are held out. In each fold, the set of geometric parameters, their values, the
    hysteresis and the settings of every model are chosen on the training motions, in searches that
    start at those of all motions. All candidates of ``error_model="auto"`` are fitted in this way.
    The weights of its blend in a fold are chosen by the errors on the motions of the other folds,
    and by those on the outer rows of the training motions, as `chosen_blend` does.

    Parameters
    ----------
    rows : MeasuredLog
        The rows to compare on.
    robot : RobotDescription
        Nominal kinematics, and the parameters to calibrate.
    settings : FitSettings
        Loss, folds and models, see `with_hysteresis_detected`.
    fitted : FittedModels
        The models fitted to all rows, see `fit_to_all`.
    n_jobs : int, optional
        Largest number of processes.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    Comparison
        Errors [m] by model and row, the fold of each row, and the choices of each fold.
    """
    measured = rows.measured
    parts = folds(measured.q, measured.motions, settings.n_folds)
    starts = {name: fit.start for name, fit in fitted.fits.items()}
    jobs = []
    for train, test in parts:
        jobs.append(
            delayed(_one_fold)(
                robot,
                settings,
                rows,
                rows.counted[train],
                rows.counted[test],
                fitted.mechanical,
                starts,
            )
        )
    most = max(1, len(measured.q) // _ROWS_PER_PROCESS[settings.auto])
    # Otherwise torch and BLAS start threads in every process, which wait for each other.
    workers = Parallel(
        n_jobs=min(effective_n_jobs(n_jobs or 1), len(parts), most),
        backend="loky",
        inner_max_num_threads=1,
        return_as="generator",
    )
    stage = "cross-validation by motion"
    progress(stage, 0, len(parts))
    results: list[_FoldResult] = []
    from_workers: Any = workers(jobs)
    for result in from_workers:
        results.append(result)
        progress(stage, len(results), len(parts))
    places = np.argsort(np.concatenate([test for _, test in parts]))
    fold = np.repeat(np.arange(len(parts)), [len(test) for _, test in parts])[places]
    distance = np.concatenate([result.distance for result in results])[places]
    tips = {}
    for name in results[0].tips:
        tips[name] = np.concatenate([result.tips[name] for result in results])[places]
    choices = [result.choices for result in results]
    autos = [result.auto for result in results if result.auto is not None]
    if autos:
        candidates = np.array([tips[_in_table(name)] for name in autos[0].names])
        tips[AUTO], words = _blended(measured, fold, candidates, autos)
        for of_fold, chosen in zip(choices, words, strict=True):
            of_fold[AUTO] = chosen
    if not settings.follows_order:  # it is the calibrated model
        tips.pop(BACKLASH, None)
    in_order = {}
    for name in sorted(tips, key=lambda name: _KINDS.index(name.partition(",")[0])):
        in_order[name] = tips[name]
    return Comparison(in_order, measured.x, fold, distance, choices)


class _AutoOfFold(NamedTuple):
    """What a fold gives of error_model="auto" besides the predictions of its candidates."""

    names: list[str]
    outside: Predictions
    geometry: GeometryChoice | None
    hysteresis: str  # in words


class _FoldResult(NamedTuple):
    """Predictions (N, m) of every model for held-out rows, the rows' distances (N,), choices."""

    tips: dict[str, NDArray]
    distance: NDArray
    choices: dict[str, str]
    auto: _AutoOfFold | None


@one_thread()  # the processes share the cores already
def _one_fold(
    robot: robots.RobotDescription,
    settings: FitSettings,
    rows: MeasuredLog,
    training_rows: NDArray,
    test_rows: NDArray,
    of_all: Mechanical,
    starts: dict[str, FitStart],
) -> _FoldResult:
    """Return the predictions of every model for test rows after a fit to training rows."""
    train = rows.counting(training_rows)
    test = rows.counting(test_rows)
    trained = train.measured
    tested = test.measured
    mechanical = Mechanical.of(robot, trained, settings.loss, of_all)
    tips = {}
    if robot.chain is not None:
        nominal = _nominal(robot, robot.chain, trained, settings.loss)
        tips[NOMINAL] = evaluate(nominal, tested.q)[0]
    choices = {}
    auto = None
    for name, model in models_to_save(robot, mechanical, settings).items():
        spec, log = prepared(model, *columns_to_fit(model, train))
        spec = spec.starting_at(starts[name])
        fitted = fit_to_log(spec, log, mechanical.geometry)
        model = with_fit(model, fitted)
        candidates = fitted.error.candidates
        outside = fitted.error.outside
        if outside is None or candidates is None:
            tips[name] = evaluate(model.module_, tested.q)[0]
            if name in (DATA_ELM, HYBRID_ELM):
                choices[name] = choice_in_words(model, train.q_unit)
            continue
        q = model.effective(test.commands)[test.counted]
        for candidate, module in candidates.items():
            tips[_in_table(candidate)] = evaluate(module, q)[0]
        auto = _AutoOfFold(
            [*candidates],
            outside,
            fitted.geometry,
            memory_in_words(model, train.q_unit),
        )
    distance = held_out_distances(trained.q, trained.motions, tested.q)
    return _FoldResult(tips, distance, choices, auto)


def _in_table(candidate: str) -> str:
    """Return the name of a candidate of "auto" in the table."""
    return BACKLASH if candidate == "mechanical" else f"hybrid, {candidate}"


def _blended(
    rows: MeasuredLog, fold: NDArray, predicted: NDArray, autos: list[_AutoOfFold]
) -> tuple[NDArray, list[str]]:
    """Return the predictions (N, m) of error_model="auto", and its choices in each fold.

    Predictions (K, N, m) of the other folds choose the weights of a fold.
    """
    labels = fold
    if len(autos) == 2:
        # A fold has only one other; the motions of that one take the place of folds.
        _, labels = np.unique(rows.motions, return_inverse=True)
    motions, first = np.unique(rows.motions, return_index=True)
    blend = np.empty_like(rows.x)
    words = []
    for k, auto in enumerate(autos):
        others = fold != k
        counts = np.ones(others.sum())
        held_out = Predictions(
            predicted[:, others], rows.x[others], counts, rows.motions[others]
        )
        outer = labels[first[np.searchsorted(motions, np.asarray(auto.outside.groups))]]
        both = HeldOut.of(held_out, auto.outside, np.append(labels[others], outer))
        weights, results = chosen_blend(auto.names, both, auto.geometry)
        blend[~others] = np.tensordot(weights, predicted[:, ~others], 1)
        words.append(auto_in_short(results, auto.hysteresis))
    return blend, words


def _nominal(
    robot: robots.RobotDescription, chain: Chain, rows: MeasuredLog, loss: str
) -> Chain:
    """Return the described chain, with a fitted base if the base is calibrated."""
    if not robot.base_is_free:
        return chain
    result, _ = fit_geometry(chain, rows.q, rows.x, ("base",), loss)
    return result.chain
