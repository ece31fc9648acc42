"""The comparison of mechanical, data-driven and hybrid models on held-out motions of a log."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.linear_model import LinearRegression

from hybridkin import (
    CalibrationResult,
    Chain,
    CrossFit,
    ELMRegressorCV,
    ForwardModel,
    GeometryChoice,
    HybridForwardModel,
    Hysteresis,
    choose_geometry,
    cross_fit,
    robots,
)
from hybridkin.app.workflow.calibrated import (
    Calibration,
    calibrated_parameters,
    deviations,
)
from hybridkin.app.workflow.log import MeasuredLog
from hybridkin.app.workflow.report import Progress, quiet
from hybridkin.arguments import whole

NOMINAL = "mechanical, nominal"
CALIBRATED = "mechanical, calibrated"
BACKLASH = "mechanical, with backlash"
DATA_LINEAR = "data-driven, linear"
DATA_QUADRATIC = "data-driven, quadratic"
DATA_ELM = "data-driven, ELM"
HYBRID_ELM = "hybrid, ELM"
AUTO = "hybrid, auto"
_KINDS = ("mechanical", "data-driven", "hybrid")  # in the order of the table

Starts = tuple[Any, ...]
"""Starts of the searches of parameters to calibrate, see `choose_geometry`."""


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
class Mechanical:
    """The model below the hybrids: without segments of the robot, a linear model of the rows.

    Attributes
    ----------
    model : ForwardModel
        The calibrated chain, or the linear model.
    messages : tuple of str
        Warnings.
    calibrate : GeometryChoice, tuple of str, str or None
        The parameters that "auto" calibrates, see `HybridForwardModel`.
    parameters : str
        Name of the set of parameters that is calibrated, if the robot says "auto".
    tried : dict of str to dict
        Errors of the sets that were tried, "cv" and "io" [m].
    starts : tuple
        Starts of the fits of these sets.
    """

    model: ForwardModel
    messages: tuple[str, ...] = ()
    calibrate: GeometryChoice | tuple[str, ...] | str | None = None
    parameters: str = ""
    tried: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    starts: Starts = ()

    @property
    def alone(self) -> dict[str, HybridForwardModel]:
        """The unfitted models without error model, by name."""
        return {DATA_LINEAR: HybridForwardModel(self.model, "drop")}

    def suspicions(self, rows: MeasuredLog) -> list[str]:
        """Return what the calibration says against the log and the description."""
        return []

    def calibration(
        self, rows: MeasuredLog, loss: str, messages: Sequence[str]
    ) -> Calibration | None:
        """Return what a report says about the calibration; None if nothing is calibrated."""
        return None


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibratedChain(Mechanical):
    """The chain of a robot, calibrated to rows.

    Attributes
    ----------
    nominal : Chain
        The described chain, with a fitted base if the base is calibrated.
    geometry : GeometryChoice
        The chain before its calibration, and its parameters.
    result : CalibrationResult or None
        None if nothing is calibrated.
    """

    nominal: Chain
    geometry: GeometryChoice
    result: CalibrationResult | None

    @property
    def alone(self) -> dict[str, HybridForwardModel]:
        """The unfitted models without error model, by name."""
        return {
            NOMINAL: HybridForwardModel(self.nominal, "drop"),
            CALIBRATED: HybridForwardModel(self.model, "drop"),
        }

    def suspicions(self, rows: MeasuredLog) -> list[str]:
        """Return what the calibration says against the log and the description."""
        if self.result is None:
            return []
        misread = rows.misread(self.result.chain)
        return [*misread, *deviations(self.geometry.chain, self.result, rows.q_unit)]

    def calibration(
        self, rows: MeasuredLog, loss: str, messages: Sequence[str]
    ) -> Calibration | None:
        """Return what a report says about the calibration; None if nothing is calibrated.

        All other sets with nearly the same errors are calibrated, to see which values they change.
        """
        if self.result is None:
            return None
        others = []
        for rival in self.geometry.rivals:
            result = rival.calibrate(rows.q, rows.x, loss=loss)
            others += calibrated_parameters(rival.chain, result, rows.q_unit)
        start = self.geometry.chain
        return Calibration.of(start, self.result, rows.q_unit, messages, others)


def mechanical_of(robot: robots.RobotDescription, rows: MeasuredLog, loss: str) -> Mechanical:
    """Return the mechanical model of a robot for rows.

    Parameters
    ----------
    robot : robots.RobotDescription
        The robot.
    rows : MeasuredLog
        The rows.
    loss : str
        Loss of the calibration.
    """
    chain = robot.chain
    if chain is None:
        linear = HybridForwardModel(None, LinearRegression(), guard=None)
        with warnings.catch_warnings():  # the models above it give them
            warnings.simplefilter("ignore")
            linear.fit(rows.q, rows.x)
        module: Any = linear.module_  # of one correction, without mechanical model
        (correction,) = module.corrections
        return Mechanical(correction.module)
    nominal: Chain = chain
    if robot.base_is_free:
        base = GeometryChoice(chain, ("base",))
        nominal = base.calibrate(rows.q, rows.x, loss=loss).chain
    geometry = _geometry_of(chain, robot, rows, loss)
    result = None
    messages = geometry.messages
    calibrated = geometry.chain
    if geometry.parameters:
        result = geometry.calibrate(rows.q, rows.x, loss=loss)
        messages = (*messages, *result.messages)
        calibrated = result.chain
    return CalibratedChain(
        calibrated,
        messages,
        _calibrated_by_auto(robot, geometry),
        geometry.name,
        {name: errors.known() for name, errors in geometry.errors.items()},
        geometry.starts,
        nominal=nominal,
        geometry=geometry,
        result=result,
    )


def _mechanical_of_part(
    robot: robots.RobotDescription, rows: MeasuredLog, loss: str, starts: Starts
) -> Mechanical:
    """Return the mechanical model for a part of the rows, of which only the predictions count."""
    chain = robot.chain
    if chain is None:
        return mechanical_of(robot, rows, loss)
    nominal = chain
    if robot.base_is_free:
        nominal = GeometryChoice(chain, ("base",)).fitted(rows.q, rows.x, loss=loss)
    geometry = _geometry_of(chain, robot, rows, loss, starts)
    return CalibratedChain(
        geometry.fitted(rows.q, rows.x, loss=loss),
        calibrate=_calibrated_by_auto(robot, geometry),
        nominal=nominal,
        geometry=geometry,
        result=None,
    )


def _geometry_of(
    chain: Chain,
    robot: robots.RobotDescription,
    rows: MeasuredLog,
    loss: str,
    starts: Starts = (),
) -> GeometryChoice:
    """Return what is calibrated: the parameters that the robot names, or those of a choice."""
    if robot.calibrate != "auto":
        return GeometryChoice(chain, tuple(robot.calibrate))
    return choose_geometry(chain, rows.q, rows.x, groups=rows.motions, loss=loss, starts=starts)


def _calibrated_by_auto(
    robot: robots.RobotDescription, geometry: GeometryChoice
) -> GeometryChoice | tuple[str, ...]:
    """Return what "auto" gets as `calibrate`."""
    return geometry if robot.calibrate == "auto" else geometry.parameters


def models_of(
    robot: robots.RobotDescription, mechanical: Mechanical, settings: FitSettings
) -> dict[str, HybridForwardModel]:
    """Return the unfitted models of the comparison by name."""
    model = mechanical.model
    models = mechanical.alone
    models[DATA_QUADRATIC] = HybridForwardModel(None, "quadratic")
    if settings.auto:
        models[DATA_ELM] = HybridForwardModel(None, _network())
        models[AUTO] = _auto(robot, mechanical, settings)
    else:
        if robot.has_segments:
            models["hybrid, linear"] = HybridForwardModel(model, "linear")
        models["hybrid, quadratic"] = HybridForwardModel(model, "quadratic")
        models[HYBRID_ELM] = HybridForwardModel(model, _network())
    for of_comparison in models.values():
        of_comparison.set_params(coverage=settings.coverage)
    return models


def _network() -> ELMRegressorCV:
    """Return the network of the comparison, the same as that of "auto"."""
    return ELMRegressorCV(
        250,
        weight_scales=(0.1, 0.4, 1.6),
        relevance_rounds=3,
        max_hidden=1000,
        random_state=0,
    )


def _auto(
    robot: robots.RobotDescription, mechanical: Mechanical, settings: FitSettings
) -> HybridForwardModel:
    """Return the hybrid with error_model="auto".

    It calibrates by least squares in each of its own folds. For another loss, which bounds
    outliers, it gets the calibrated chain and does not calibrate.
    """
    model = mechanical.model
    calibrate = None
    if settings.loss == "linear" and robot.has_segments:
        model = robot.chain
        calibrate = mechanical.calibrate
    return HybridForwardModel(
        model,
        "auto",
        calibrate=calibrate,
        hysteresis=settings.hysteresis,
        random_state=0,
    )


def with_hysteresis_detected(
    settings: FitSettings,
    rows: MeasuredLog,
    robot: robots.RobotDescription,
    mechanical: Mechanical,
) -> FitSettings:
    """Return settings whose `hysteresis` is not "detect"."""
    if settings.hysteresis != "detect":
        return settings
    hysteresis = 0.0
    in_order = rows.named and not rows.n_late
    if robot.has_segments and settings.auto and in_order:
        model = HybridForwardModel(mechanical.model, "drop", hysteresis="auto")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model.fit(rows.commands, rows.x, rows.counts, rows.motions)
        hysteresis = "auto" if model.hysteresis_ else 0.0
    return replace(settings, hysteresis=hysteresis)


def compare(
    rows: MeasuredLog,
    robot: robots.RobotDescription,
    settings: FitSettings,
    mechanical: Mechanical,
    *,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> CrossFit:
    """Return every model, fitted to all rows, and its errors on held-out motions.

    Whole motions are held out. In each fold, the set of geometric parameters, their values, the
    hysteresis and the settings of every model are chosen on the training motions, in searches that
    start at those of all motions. The candidates of ``error_model="auto"`` are models of the table.

    Parameters
    ----------
    rows : MeasuredLog
        The rows to compare on.
    robot : robots.RobotDescription
        Nominal kinematics, and the parameters to calibrate.
    settings : FitSettings
        Loss, folds and models, see `with_hysteresis_detected`.
    mechanical : Mechanical
        That of all rows.
    n_jobs, progress
        As for `hybridkin.cross_fit`.

    Returns
    -------
    CrossFit
        The models by kind, without the calibrated model with backlash if there is no hysteresis.
    """
    with warnings.catch_warnings():  # the report and the mechanical model say what matters
        warnings.simplefilter("ignore")
        compared = cross_fit(
            models_of(robot, mechanical, settings),
            rows,
            settings.n_folds,
            sample_weight=rows.counts,
            models_for=partial(_models_for, robot, settings, mechanical),
            n_jobs=n_jobs,
            progress=progress,
        )
    tips = dict(zip(compared.names, compared.tips, strict=True))
    if settings.auto:
        candidates = compared.tables[AUTO]
        for name, of_candidate in zip(candidates.names, candidates.tips, strict=True):
            tips[_in_table(name)] = of_candidate
        tips[AUTO] = tips.pop(AUTO)
    if not settings.follows_order:  # it is the calibrated model
        tips.pop(BACKLASH, None)
    names = sorted(tips, key=lambda name: _KINDS.index(name.partition(",")[0]))
    return replace(compared, names=tuple(names), tips=np.array([tips[name] for name in names]))


def _models_for(
    robot: robots.RobotDescription,
    settings: FitSettings,
    of_all: Mechanical,
    rows: MeasuredLog,
) -> dict[str, HybridForwardModel]:
    """Return the models of the comparison for training rows."""
    mechanical = _mechanical_of_part(robot, rows, settings.loss, of_all.starts)
    return models_of(robot, mechanical, settings)


def _in_table(candidate: str) -> str:
    """Return the name of a candidate of "auto" in the table."""
    return BACKLASH if candidate == "mechanical" else f"hybrid, {candidate}"
