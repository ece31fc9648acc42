"""Choice of the mechanical model by the errors that remain below corrections."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.simplest import simplest_within
from hybridkin.calibration.choice import GeometryChoice, SetErrors
from hybridkin.calibration.measured import inner_and_outer
from hybridkin.hybrid._candidates import Candidates, Settled
from hybridkin.hybrid._error_models import (
    KernelModel,
    NoCorrection,
    QuadraticModel,
)
from hybridkin.hybrid._fit import fit_hybrid
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import ErrorModel, Mechanics, Spec
from hybridkin.hybrid._structural_model import Structure
from hybridkin.hybrid.held_out import CrossFit

_MOST = 400  # rows by which the mechanics are chosen
_FOLDS = 3
_FEW = 40  # with fewer rows the outer ones do not count
# Mechanics are not taken whose held-out error exceeds the least one by more than this part of it,
# and by more than this many standard errors of the difference.
_WORSE = 0.1
_SURE = 2.0
_EXACT = 1e-9  # [m]; smaller errors are equal
_EQUAL = 0.03  # of the score: within it the simpler mechanics are taken


def best_mechanics(spec: Spec, geometry: GeometryChoice, rows: Rows) -> Mechanics:
    """Return the mechanics of least error below corrections.

    Mechanics are a set of calibrated parameters, with or without the errors of the structure. For
    each, a blend of few, quick corrections predicts the rows of three folds, and the outer rows
    after a fit to the inner ones. Taken are those with nearly the least ``(cv * io**2)**(1/3)``,
    with the held-out error `cv` and the error `io` of the outer rows; of few rows those with the
    least `cv`. Mechanics that are clearly worse on held-out rows are left out.
    """
    options = [*_options(spec, geometry)]
    if len(options) < 2:
        return options[0]
    rows = rows.thinned(_MOST)
    rows = replace(rows, groups=rows.groups.divided())
    models = _quick_corrections(spec.with_mechanics(Mechanics(geometry)), rows)
    tables = []
    for mechanics in options:
        calibrated = replace(spec.with_mechanics(mechanics), calibrate=())  # by every part itself
        settled = Settled(calibrated, rows, models)
        folds = rows.groups.folds(_FOLDS, shuffle=True)
        tables.append(settled.table(settled.outer(), folds))
    inner, _ = inner_and_outer(rows.X)
    enough = np.array([option.rows_needed <= len(inner) for option in options])
    handicap = np.array([option.refinement.handicap for option in options])
    chosen = options[_best(tables, enough, handicap)]
    errors = {}
    for mechanics, table in zip(options, tables, strict=True):
        errors[mechanics.name] = SetErrors(table.expected_error, table.outer_error)
    return chosen._replace(geometry=replace(chosen.geometry, corrected=errors))


def _best(tables: Sequence[CrossFit], enough: NDArray[np.bool_], handicap: NDArray) -> int:
    """Return the place of the best of K tables, those of simpler mechanics first.

    With outer rows the score of each is multiplied by its `handicap` (K,).

    Mechanics for which the inner rows are not `enough` (K,) would have too large errors of outer
    rows: these count at most as large, relative to held-out errors, as those of the others. If they
    suffice for none, only held-out errors count.
    """
    cv = _comparable([table.expected_error for table in tables])
    io = _comparable([table.outer_error for table in tables])
    known = enough & np.isfinite(cv) & np.isfinite(io)
    largest = (io[known] / cv[known]).min(initial=np.inf) * cv
    io = np.where(enough, io, np.minimum(io, largest))
    scores = cv.copy()
    if len(tables[0].y) >= _FEW and enough.any():
        scores = handicap * np.cbrt(cv * io**2)
    least = tables[int(np.argmin(cv))]
    for k, table in enumerate(tables):
        excess = table.excess_over(least)
        if excess.mean > max(_WORSE * cv.min(), _SURE * excess.std_error):
            scores[k] = np.inf
    return simplest_within(scores, _EQUAL)


def _comparable(errors: Sequence[float]) -> NDArray:
    """Return mean errors (K,) [m]: infinite if rows have no prediction; rounding is no error."""
    return np.where(np.isnan(errors), np.inf, np.maximum(errors, _EXACT))


def _quick_corrections(spec: Spec, rows: Rows) -> dict[str, ErrorModel]:
    """Return corrections with the penalties that suit these mechanics."""
    corrections = Candidates(
        {"none": NoCorrection(), "quadratic": QuadraticModel("serial"), "kernel": KernelModel()}
    )
    quick = replace(spec, error_model=corrections).without_errors()
    return Settled.of(fit_hybrid(quick, rows), rows).models


def _options(spec: Spec, geometry: GeometryChoice) -> Iterator[Mechanics]:
    """Yield the mechanics to compare, the simpler ones first."""
    if spec.output == "pose":
        yield Mechanics(geometry)
        return
    for near in geometry.near or (geometry,):  # a choice of the caller has no others
        yield Mechanics(near)
    bases = {base.name: base for base in (*geometry.usual[-1:], geometry)}
    for base in bases.values():
        if base.chain.has_one_arc_per_segment:
            yield Mechanics(base, Structure())
