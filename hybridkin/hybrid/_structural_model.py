"""The errors of a chain's structure as an error model, and below the candidates of "auto"."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from hybridkin._core.model import ForwardModel
from hybridkin.calibration.choice import GeometryChoice
from hybridkin.calibration.measured import distance
from hybridkin.hybrid._error_models import named
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import (
    UNREFINED,
    ErrorModel,
    FittedError,
    Refinement,
    Spec,
)
from hybridkin.hybrid._structure import fit_structure

_FACTORS = (1.0, 0.3, 3.0)  # of the prior, to choose from by held-out errors
_FEW = 60  # rows; with fewer the prior is not changed
_BETTER = 0.98  # of the held-out error, for another factor than one
ENOUGH = 5000
"""Rows that determine the few errors below other corrections."""
_MOST = 400  # rows by which the refinement is chosen
_FOLDS = 3
# Of the held-out error of the chain alone. On real robots smaller gains, from slack and friction
# that look like a twist, were lost again below corrections; a twist under load gains twice as much.
_CLEARLY = 0.75


class Structure(Refinement):
    """The errors of a chain's structure below another error model, see `fit_structure`.

    Parameters
    ----------
    geometry : str, default=""
        Name of the calibrated parameters that they stand on. Empty: the chosen ones.
    """

    def __init__(self, geometry: str = "") -> None:
        self.geometry = geometry

    def refine(self, mechanical: ForwardModel, rows: Rows) -> ForwardModel:
        """Return the chain with the errors of its structure."""
        chain = mechanical.without_errors
        if not chain.has_one_arc_per_segment:
            return mechanical
        return fit_structure(chain, rows.thinned(ENOUGH), left_out=False).model


class RefinedGeometry(NamedTuple):
    """A geometry to calibrate, and how the calibrated chain is refined."""

    geometry: GeometryChoice
    refinement: Refinement


def best_refinement(spec: Spec, geometry: GeometryChoice, rows: Rows) -> Refinement:
    """Return the refinement of least error on three folds; none if it gains less than a quarter.

    The errors of the structure can stand on the chosen geometry, or on the smaller ones that suit
    few rows: other parameters may have been chosen because they imitate a twist.
    """
    chain = geometry.chain
    if not chain.has_one_arc_per_segment:
        return UNREFINED
    candidates = [RefinedGeometry(geometry, Structure())]
    for usual in geometry.usual[-1:]:
        if usual.name != geometry.name:
            candidates.append(RefinedGeometry(usual, Structure(usual.name)))
    candidates.append(RefinedGeometry(geometry, UNREFINED))
    rows = rows.thinned(_MOST)
    totals = np.zeros(len(candidates))
    for train, test in rows.groups.divided().folds(_FOLDS, shuffle=True):
        part = rows.take(train).ungrouped()
        held_out = rows.take(test)
        for k, candidate in enumerate(candidates):
            of_candidate = replace(
                spec,
                mechanical=candidate.geometry.chain,
                geometry=candidate.geometry,
                refinement=candidate.refinement,
            )
            model = of_candidate.recalibrated(part).mechanical
            assert model is not None
            with torch.no_grad():
                predicted = model(held_out.q).numpy()
            totals[k] += held_out.counts @ distance(predicted, held_out.tips)
    totals[-1] *= _CLEARLY
    if not np.isfinite(totals).any():
        return UNREFINED
    return candidates[int(np.nanargmin(totals))].refinement


@named("structural")
class StructuralModel(ErrorModel):
    """The errors of a chain's structure: zeros, rings, twist and sag under its load.

    Parameters
    ----------
    factor : float, optional
        Common factor of the prior. Default: 1 below 60 rows, else chosen by held-out errors.
    """

    couplings = ("serial",)

    def __init__(self, factor: float | None = None) -> None:
        self.factors = _FACTORS if factor is None else (factor,)

    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the chain with the errors of its structure; there are no corrections of it."""
        chain = spec.mechanical
        if chain is None or not chain.has_one_arc_per_segment:
            raise TypeError(
                "`mechanical_model` must be a chain of arcs, one for each segment, with "
                f"error_model='structural', got {type(chain).__name__}; use "
                "error_model='quadratic'."
            )
        factors = self.factors if len(rows) >= _FEW else self.factors[:1]
        left_out = self.tells_errors or len(factors) > 1
        fits = [fit_structure(chain, rows, factor, left_out) for factor in factors]
        best = fits[0]
        for fit in fits[1:]:
            if fit.rmse < _BETTER * best.rmse:
                best = fit
        return FittedError(
            best,
            [[] for _ in chain.markers],
            StructuralModel(best.factor),
            best.rmse / 3**0.5,
            held_out=True,
            refined=best.model,
            structure=best,
        )
