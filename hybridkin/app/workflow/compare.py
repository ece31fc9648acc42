"""The comparison of mechanical, data-driven and hybrid models on held-out motions of a log."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import ArrayLike
from sklearn.linear_model import LinearRegression

from hybridkin import (
    CalibrationResult,
    Chain,
    CrossFit,
    ForwardModel,
    HybridForwardModel,
    Hysteresis,
    cross_fit,
    robots,
)
from hybridkin.app.workflow.calibrated import CalibratedParameter, calibrated_parameters
from hybridkin.app.workflow.log import MeasuredLog
from hybridkin.app.workflow.report import Progress, quiet
from hybridkin.arguments import whole
from hybridkin.calibration.calibrate import fit_geometry
from hybridkin.calibration.choice import GeometryChoice, choose_geometry
from hybridkin.learning.elm_cv import growing_network
from hybridkin.learning.regressor_modules import error_module

NOMINAL = "mechanical, nominal"
CALIBRATED = "mechanical, calibrated"
BACKLASH = "mechanical, with backlash"
DATA_LINEAR = "data-driven, linear"
DATA_QUADRATIC = "data-driven, quadratic"
DATA_ELM = "data-driven, ELM"
HYBRID_ELM = "hybrid, ELM"
AUTO = "hybrid, auto"
_KINDS = ("mechanical", "data-driven", "hybrid")  # in the order of the table


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
    """The mechanical model of a robot, calibrated to rows.

    Attributes
    ----------
    model : ForwardModel
        The calibrated chain; for a robot without segments a linear model of the rows.
    start : Chain or None
        The chain before its calibration.
    nominal : Chain or None
        The described chain, with a fitted base if the base is calibrated.
    result : CalibrationResult or None
        None if nothing is calibrated.
    geometry : GeometryChoice or None
        How the parameters were chosen, if the robot says "auto".
    messages : list of str
        Warnings.
    """

    model: ForwardModel
    start: Chain | None
    nominal: Chain | None
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
            return cls(model, None, None, None, None, [])
        nominal = _nominal(robot, chain, rows, loss)
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
            return cls(chain, chain, nominal, None, geometry, messages)
        result, of_fit = fit_geometry(chain, rows.q, rows.x, names, loss, start=start)
        messages += of_fit
        return cls(result.chain, chain, nominal, result, geometry, messages)

    def rivals(self, rows: MeasuredLog, loss: str) -> Iterator[CalibratedParameter]:
        """Yield the parameters of all other sets with nearly the same errors, calibrated."""
        rivals = () if self.geometry is None else self.geometry.rivals
        for rival in rivals:
            result, _ = fit_geometry(
                rival.chain, rows.q, rows.x, rival.parameters, loss, start=rival.start
            )
            yield from calibrated_parameters(rival.chain, result, rows.q_unit)


def models_of(
    robot: robots.RobotDescription, mechanical: Mechanical, settings: FitSettings
) -> dict[str, HybridForwardModel]:
    """Return the unfitted models of the comparison by name."""
    model = mechanical.model
    models = {}
    without_error_model = DATA_LINEAR
    if mechanical.nominal is not None:
        without_error_model = CALIBRATED
        models[NOMINAL] = HybridForwardModel(mechanical.nominal, "drop")
    models[without_error_model] = HybridForwardModel(model, "drop")
    models[DATA_QUADRATIC] = HybridForwardModel(None, "quadratic")
    network = growing_network(0)
    if settings.auto:
        models[DATA_ELM] = HybridForwardModel(None, network)
        models[AUTO] = _auto(robot, mechanical, settings)
    else:
        if robot.chain is not None:
            models["hybrid, linear"] = HybridForwardModel(model, "linear")
        models["hybrid, quadratic"] = HybridForwardModel(model, "quadratic")
        models[HYBRID_ELM] = HybridForwardModel(model, network)
    for of_comparison in models.values():
        of_comparison.set_params(coverage=settings.coverage)
    return models


def _auto(
    robot: robots.RobotDescription, mechanical: Mechanical, settings: FitSettings
) -> HybridForwardModel:
    """Return the hybrid with error_model="auto".

    It calibrates by least squares in each of its own folds. For another loss, which bounds
    outliers, it gets the calibrated chain and does not calibrate.
    """
    chain = mechanical.model
    calibrate = None
    if settings.loss == "linear" and robot.chain is not None:
        chain = robot.chain
        calibrate = mechanical.geometry or robot.calibrate
    return HybridForwardModel(
        chain,
        "auto",
        calibrate=calibrate,
        hysteresis=settings.hysteresis,
        random_state=0,
    )


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
    with (
        warnings.catch_warnings()
    ):  # the report and the mechanical model say what matters
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
    return replace(
        compared, names=tuple(names), tips=np.array([tips[name] for name in names])
    )


def _models_for(
    robot: robots.RobotDescription,
    settings: FitSettings,
    of_all: Mechanical,
    rows: MeasuredLog,
) -> dict[str, HybridForwardModel]:
    """Return the models of the comparison for training rows."""
    mechanical = Mechanical.of(robot, rows, settings.loss, of_all)
    return models_of(robot, mechanical, settings)


def _in_table(candidate: str) -> str:
    """Return the name of a candidate of "auto" in the table."""
    return BACKLASH if candidate == "mechanical" else f"hybrid, {candidate}"


def _nominal(
    robot: robots.RobotDescription, chain: Chain, rows: MeasuredLog, loss: str
) -> Chain:
    """Return the described chain, with a fitted base if the base is calibrated."""
    if not robot.base_is_free:
        return chain
    result, _ = fit_geometry(chain, rows.q, rows.x, ("base",), loss)
    return result.chain
