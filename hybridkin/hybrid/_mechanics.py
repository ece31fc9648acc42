"""Choice of the mechanical model by the errors that remain below corrections."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hybridkin._core.simplest import simplest_within
from hybridkin.calibration.choice import GeometryChoice
from hybridkin.hybrid._candidates import Candidates, Settled
from hybridkin.hybrid._error_models import (
    KernelModel,
    NoCorrection,
    QuadraticModel,
)
from hybridkin.hybrid._fit import fit_hybrid
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import ErrorModel, FittedHybrid, Mechanics, Spec
from hybridkin.hybrid._structural_model import Structure
from hybridkin.hybrid.held_out import CrossFit

_MOST = 400  # rows by which the mechanics are chosen
_FOLDS = 3
_FEW = 40  # with fewer rows the outer ones do not count
_WORSE = 1.15  # times the least held-out error: mechanics above are not taken
_EQUAL = 0.01  # of the score: within it the simpler mechanics are taken


def best_mechanics(spec: Spec, geometry: GeometryChoice, rows: Rows) -> Mechanics:
    """Return the mechanics of least error below corrections.

    Mechanics are a set of calibrated parameters, with or without the errors of the structure. For
    each, a blend of few, quick corrections predicts the rows of three folds, and the outer rows
    after a fit to the inner ones. Among those with a held-out error at most a tenth above the
    least, the simplest one with nearly the least ``(cv * io**2)**(1/3)`` is taken.
    """
    options = [*_options(spec, geometry)]
    if len(options) < 2:
        return options[0]
    rows = rows.thinned(_MOST)
    rows = replace(rows, groups=rows.groups.divided())
    corrections: ErrorModel = Candidates(
        {"none": NoCorrection(), "quadratic": QuadraticModel("serial"), "kernel": KernelModel()}
    )
    cv = []
    io = []
    for mechanics in options:
        of_option = replace(spec.with_mechanics(mechanics), error_model=corrections)
        fitted = fit_hybrid(of_option.without_errors(), rows)
        corrections = fitted.error.settled  # the next search of penalties starts at these
        table = _table(fitted, rows)
        cv.append(table.expected_error)
        io.append(table.outer_error)
    scores = np.array(cv)
    if len(rows) >= _FEW:
        scores = np.cbrt(scores * np.square(io))
    good = np.array(cv) <= _WORSE * min(cv)
    return options[simplest_within(np.where(good, scores, np.inf), _EQUAL)]


def _options(spec: Spec, geometry: GeometryChoice) -> Iterator[Mechanics]:
    """Yield the mechanics to compare, the simpler ones first."""
    bases = []
    for near in geometry.near:
        yield Mechanics(near)
        if near.name == geometry.name:
            bases.append(near)
    if spec.output == "pose":
        return
    for usual in geometry.usual[-1:]:
        if usual.name != geometry.name:
            bases.insert(0, usual)
    for base in bases:
        if base.chain.has_one_arc_per_segment:
            yield Mechanics(base, Structure())


def _table(fitted: FittedHybrid, rows: Rows) -> CrossFit:
    """Return what the candidates of a fit predict for held-out and for outer rows."""
    settled = Settled.of(fitted, rows)
    return settled.table(settled.outer(), rows.groups.folds(_FOLDS, shuffle=True))
