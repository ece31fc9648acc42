"""The specification of a fit: mechanical model, calibration, and the interface of error models."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import nan
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.arrays import countable
from hybridkin._core.groups import Groups
from hybridkin._core.model import ForwardModel
from hybridkin._core.progress import Progress
from hybridkin.calibration.calibrate import CalibrationResult, fit_geometry, refitted
from hybridkin.calibration.choice import (
    NOT_CHOSEN,
    GeometryChoice,
    Starts,
    choose_geometry,
)
from hybridkin.chains.chain import Chain
from hybridkin.chains.structural import StructuralChain
from hybridkin.hybrid._drift import too_far
from hybridkin.hybrid._module import Hybrid, TipCorrection
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._wrapped import pose_errors
from hybridkin.hybrid.cv_results import CvResults
from hybridkin.hybrid.held_out import MEAN_LENGTH
from hybridkin.hybrid.structure_fit import StructureFit
from hybridkin.hysteresis.value import NO_HYSTERESIS, Hysteresis

Seed = int | np.random.RandomState | None
Weighted = list[tuple[float, TipCorrection]]  # weights and corrections, without guards


class ErrorModel(ABC):
    """A way to learn the residual, measured minus mechanical model."""

    learns = True
    chooses = False  # whether it compares models, elastic tendons among them
    couplings: tuple[str, ...] = ("parallel", "serial")
    for_poses = False  # whether it learns the six numbers of a pose
    needs_mechanical = True
    tells_errors = True  # whether a fit computes errors of held-out rows

    @classmethod
    def of(cls, coupling: str, random_state: Seed) -> Self:
        """Return the error model for these settings of a HybridForwardModel."""
        return cls()

    def starting_at(self, settled: ErrorModel) -> ErrorModel:
        """Return this model for other rows; its choice may start at the settled settings."""
        return self

    def without_errors(self) -> ErrorModel:
        """Return this model for fits of which only the predictions count."""
        model = copy.copy(self)
        model.tells_errors = False
        return model

    def reporting(self, progress: Progress) -> ErrorModel:
        """Return this model for a fit that tells how many of its candidates are fitted."""
        return self

    def mechanics(self, spec: Spec, geometry: GeometryChoice, rows: Rows) -> Mechanics:
        """Return what is calibrated and refined before this model learns the residual.

        By default it is the set of parameters that was chosen by the errors of the mechanics alone.
        """
        return Mechanics(geometry)

    @abstractmethod
    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the error model fitted to rows with their residuals; it does not change itself.

        Parameters
        ----------
        rows : Rows
            Different rows, with the residuals of the mechanical model.
        spec : Spec
            The calibrated mechanical model.
        """


class HysteresisChoice:
    """How a fit gets the hysteresis of the actuators: by default there is none."""

    def __bool__(self) -> bool:
        """Return whether there may be one."""
        return False

    def of(self, spec: Spec, rows: Rows) -> tuple[Hysteresis, list[str]]:
        """Return the hysteresis, and warnings about it.

        Parameters
        ----------
        spec : Spec
            The mechanical model, and its parameters to calibrate first.
        rows : Rows
            The log, with the rows of each run in order of time.
        """
        return NO_HYSTERESIS, []


NO_CHOICE = HysteresisChoice()


@dataclass(frozen=True)
class FittedError:
    """A fitted error model.

    Attributes
    ----------
    result : estimator, ReadoutFit, FittedBlend, tuple or None
        What `HybridForwardModel.error_model_` shows; a tuple holds one for each marker.
    corrections : list of list of (float, TipCorrection)
        Weights and corrections of every marker.
    settled : ErrorModel
        The error model with the settings that were chosen, for fits to other rows.
    noise : float
        Standard deviation of one coordinate of the residual that remains [m]. NaN: not computed.
    rejected : bool
        Whether the errors on held-out rows were least without a correction.
    held_out : bool
        Whether `noise` is that of held-out rows, not of the training rows.
    comparison : CvResults or None
        Of "auto": `HybridForwardModel.cv_results_`.
    refined : StructuralChain or None
        The refined mechanical model that the corrections are added to. None: the calibrated one.
    structure : StructureFit or None
        The fit of the refined model to the same rows. None: not refined, or of a part of a log.
    candidates : dict of str to FittedHybrid
        Of "auto": every candidate, fitted to all rows; else none.
    """

    result: object
    corrections: list[Weighted]
    settled: ErrorModel
    noise: float = nan
    rejected: bool = False
    held_out: bool = False
    comparison: CvResults | None = None
    refined: StructuralChain | None = None
    structure: StructureFit | None = None
    candidates: Mapping[str, FittedHybrid] = field(default_factory=dict)

    @property
    def kind(self) -> str | None:
        """Class of the fitted error model, for files; None without one."""
        result = self.result
        if type(result) is tuple:
            result = result[0]
        return None if result is None else type(result).__name__

    def structure_in_words(self) -> list[str]:
        """Return the errors of the structure, and a forecast for more rows; nothing without one."""
        if self.structure is None:
            return []
        forecast = self.structure.forecast_in_words(MEAN_LENGTH * self.noise)
        return [forecast, f"{self.structure.in_words()}."]


class Refinement:
    """What is learned of a mechanical model before its residual: by default nothing.

    Attributes
    ----------
    suffix : str
        What it adds to the name of a set of calibrated parameters.
    handicap : float
        Factor on its errors where it is compared with other mechanics by outer rows.
    """

    suffix = ""
    handicap = 1.0

    def refine(self, mechanical: ForwardModel, rows: Rows) -> ForwardModel:
        """Return the mechanical model that fits the rows better."""
        return mechanical


UNREFINED = Refinement()


class Mechanics(NamedTuple):
    """A geometry to calibrate, and how the calibrated model is refined."""

    geometry: GeometryChoice
    refinement: Refinement = UNREFINED

    @property
    def name(self) -> str:
        """What is calibrated, and what is learned below corrections."""
        return self.geometry.name + self.refinement.suffix

    @property
    def rows_needed(self) -> float:
        """Number of rows that suffice for the free numbers of the geometry."""
        geometry = self.geometry
        return geometry.start.n_free * geometry.chain.rows_per_parameter


@dataclass(frozen=True)
class Spec:
    """Specification of a fit: the resolved settings of a HybridForwardModel."""

    mechanical: ForwardModel | None
    error_model: ErrorModel
    calibrate: tuple[str, ...] | str = ()  # geometry to calibrate, or "auto"
    guard: str | None = "leverage"
    output: str = "position"
    hysteresis: HysteresisChoice = NO_CHOICE
    coverage: float | None = None
    starts: Starts = ()  # of the choice of what to calibrate
    geometry: GeometryChoice = NOT_CHOSEN  # how `calibrate` was chosen
    # Of the calibrated model, before its residual is learned.
    refinement: Refinement = UNREFINED
    calibration: CalibrationResult | None = None  # how `mechanical` was calibrated
    messages: tuple[str, ...] = ()  # warnings of that choice and calibration

    def without_errors(self) -> Spec:
        """Return the specification of fits of which only the predictions count."""
        return replace(self, error_model=self.error_model.without_errors())

    def starting_at(self, settled: ErrorModel, starts: Starts) -> Spec:
        """Return the specification of a fit to a part of a log, with starts of its choices.

        Parameters
        ----------
        settled : ErrorModel
            The error model with its choices for the whole log.
        starts : tuple of Start
            Where the choice of what to calibrate starts.
        """
        error_model = self.error_model.starting_at(settled).without_errors()
        return replace(self, error_model=error_model, starts=starts)

    def with_geometry_chosen(self, rows: Rows) -> Spec:
        """Return the specification with the parameters to calibrate, chosen on the rows or given.

        For a list and an error model that chooses, a plain chain is compared with elastic tendons.
        """
        geometry = self.geometry
        if not geometry:
            automatic = self.calibrate == "auto"
            if not self.calibrate or not (automatic or self.error_model.chooses):
                return self
            geometry = choose_geometry(
                cast(Chain, self.mechanical),
                rows.q,
                self.positions(rows),
                groups=rows.groups,
                weights=rows.counts,
                outside=self.error_model.learns,
                parameters=None if automatic else self.calibrate,
                starts=self.starts,
            )
        counts = torch.from_numpy(rows.counts)
        geometry = geometry.started(rows.q, self.positions(rows), counts)
        return self.with_mechanics(self.error_model.mechanics(self, geometry, rows))

    def with_mechanics(self, mechanics: Mechanics) -> Spec:
        """Return the specification with a geometry to calibrate and a refinement."""
        geometry = mechanics.geometry
        return replace(
            self,
            refinement=mechanics.refinement,
            mechanical=geometry.chain,
            calibrate=geometry.parameters,
            geometry=geometry,
            messages=geometry.messages,
        )

    def calibrated(self, rows: Rows) -> Spec:
        """Return the specification with the model calibrated; its `cv_rmse` holds out groups."""
        spec = self
        if not spec.geometry:
            spec = self.with_geometry_chosen(rows)
        if not spec.calibrate:
            return spec
        if spec.geometry and not spec.error_model.tells_errors:
            return replace(spec.recalibrated(rows), calibrate=())
        groups = rows.groups
        if spec.error_model.chooses:  # it computes errors of held-out rows itself
            groups = Groups.rows(len(rows))
        result = fit_geometry(
            cast(Chain, spec.mechanical),
            rows.q,
            spec.positions(rows),
            spec.calibrate,
            groups=groups,
            sample_weight=rows.counts,
            start=spec.geometry.start,
        )
        return replace(
            spec,
            mechanical=result.chain,
            calibrate=(),
            calibration=result,
            messages=(*spec.messages, *result.messages),
        )

    def recalibrated(self, rows: Rows) -> Spec:
        """Return the specification calibrated to other rows, without errors of held-out rows."""
        spec = self
        start = self.geometry.start
        if start.n_free:
            counts = torch.from_numpy(rows.counts)
            chain = refitted(start, rows.q, self.positions(rows), counts)
            spec = replace(spec, mechanical=chain)
        return spec.refined(rows)

    def refined(self, rows: Rows) -> Spec:
        """Return the specification with the mechanical model refined by rows."""
        if self.mechanical is None:
            return self
        refined = self.refinement.refine(self.mechanical, rows)
        return replace(self, mechanical=refined)

    def positions(self, rows: Rows) -> Tensor:
        """Return the tip positions (N, 3) of rows, which may be poses [m]."""
        tips = torch.from_numpy(rows.tips)
        if self.output == "pose":
            return tips[:, :3]
        return tips

    def by_marker(self, rows: Rows) -> list[tuple[Rows, Spec]]:
        """Return the rows and the specification of every marker; a single tip is one marker."""
        tips: list[ForwardModel | None] = [None]
        if self.mechanical is not None:
            tips = [*self.mechanical.each_tip()]
        elif np.isnan(rows.tips).any():
            tips = [None] * (rows.tips.shape[1] // 3)
        if len(tips) == 1:
            return [(rows, self)]
        return [(rows.marker(k), replace(self, mechanical=tip)) for k, tip in enumerate(tips)]


class FittedHybrid(NamedTuple):
    """Result of a fit; its warnings are in the messages of `spec` and were not issued."""

    spec: Spec  # with the calibrated mechanical model
    error: FittedError
    module: Hybrid

    def take_low_rank(self, q: Tensor) -> None:
        """Give networks and their guards a leverage of low rank, for training rows q (N, n)."""
        for part in [*self.module.modules()]:
            if isinstance(part, TipCorrection):
                part.take_low_rank(q)

    def predict(self, X: NDArray) -> NDArray:
        """Return the tips (N, m) at actuator vectors (N, n) [m]."""
        with torch.no_grad():
            return self.module(torch.from_numpy(X.astype(np.float64))).numpy()


def residuals(mechanical: ForwardModel | None, q: Tensor, y: NDArray, output: str) -> NDArray:
    """Return the residual, measured minus mechanical model, in the form that is learned [m]."""
    if mechanical is None:
        return y
    if output == "pose":
        return pose_errors(mechanical, q, y)
    with torch.no_grad():
        tips = mechanical(q).numpy()
    if not countable(tips).all():
        raise too_far()
    if tips.shape != y.reshape(len(y), -1).shape:
        raise ValueError(
            f"`y` must have {tips.shape[1]} columns, as many as `mechanical_model` gives, got "
            f"shape {y.shape}."
        )
    return y - tips.reshape(y.shape)
