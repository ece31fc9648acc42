"""The errors of a chain's structure as an error model, and below the candidates of "auto"."""

from __future__ import annotations

from hybridkin._core.model import ForwardModel
from hybridkin.hybrid._error_models import named
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import (
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


class Structure(Refinement):
    """The errors of a chain's structure below another error model, see `fit_structure`."""

    suffix = ", structure"
    # Slack and friction look like a twist, too, but not on motions that the log does not contain.
    handicap = 1.03

    def refine(self, mechanical: ForwardModel, rows: Rows) -> ForwardModel:
        """Return the chain with the errors of its structure."""
        chain = mechanical.without_errors
        if not chain.has_one_arc_per_segment:
            return mechanical
        return fit_structure(chain, rows.thinned(ENOUGH), left_out=False).model


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
