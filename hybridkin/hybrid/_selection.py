"""Choice of the error model by errors on held-out motions, and on rows outside the fitted ones."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgWarning
from sklearn.linear_model import LinearRegression
from typing_extensions import Self

from hybridkin._core.model import ForwardModel
from hybridkin._core.turns import TURNS
from hybridkin.calibration.choice import GeometryChoice
from hybridkin.calibration.measured import distance, inner_and_outer
from hybridkin.hybrid._error_models import (
    Blend,
    KernelModel,
    LinearModel,
    NetworkModelCV,
    NoCorrection,
    QuadraticModel,
    RegressorModel,
    ShapeModel,
)
from hybridkin.hybrid._fit import FittedHybrid, fit_hybrid
from hybridkin.hybrid._kernel import folds_of
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import (
    UNREFINED,
    ErrorModel,
    FittedError,
    Refinement,
    Seed,
    Spec,
    residuals,
)
from hybridkin.hybrid._structural_model import ENOUGH, best_refinement
from hybridkin.hybrid._structure import fit_structure
from hybridkin.hybrid.held_out import (
    MEAN_LENGTH,
    HeldOut,
    Predictions,
    chosen_blend,
)
from hybridkin.hybrid.structure_fit import StructureFit
from hybridkin.learning.elm_cv import growing_network

_MOST = 2000  # rows for kernel ridge, whose cost grows with the cube of their number
# With fewer, penalties that were chosen on all rows suit them.
_FEW_MOTIONS = 40
_FEW_ROWS = 100
_ANEW = 3  # folds, without each of which penalties are then chosen once more


class Part(NamedTuple):
    """Rows of a log to fit to, with the mechanical model calibrated on them, and test rows."""

    spec: Spec
    rows: Rows
    train: NDArray
    test: NDArray

    @classmethod
    def of(cls, spec: Spec, rows: Rows, train: NDArray, test: NDArray) -> Part:
        """Return the part of a log with these rows."""
        # A single held-out motion has similar ones in training; folds are a harder test.
        training_rows = replace(rows, groups=None).take(train)
        return cls(spec.recalibrated(training_rows), training_rows, train, test)

    def predicted(self, model: ErrorModel, rows: Rows) -> NDArray:
        """Return the predictions (M, m) of an error model for the test rows."""
        with TURNS.filters, warnings.catch_warnings():  # the full fit gives them
            warnings.simplefilter("ignore", LinAlgWarning)
            fitted = fit_hybrid(replace(self.spec, error_model=model), self.rows)
        return fitted.predict(rows.X[self.test])


class Auto(ErrorModel):
    """The blend of error models with the least error on held-out groups, or rows.

    Every candidate is fitted to all rows, which fixes its penalties. Then it is fitted to all folds
    but one, and to the inner rows, each time with the mechanical model calibrated on the same rows.
    The predictions for the held-out and the outer rows give the weights of the blend. It can be a
    single candidate.

    Parameters
    ----------
    random_state : int, RandomState or None
        Seed of the network.
    """

    chooses = True
    needs_mechanical = False

    def __init__(self, random_state: Seed) -> None:
        self.random_state = random_state

    @classmethod
    def of(cls, coupling: str, random_state: Seed) -> Self:
        """Return the error model for these settings of a HybridForwardModel."""
        return cls(random_state)

    def refinement(
        self, spec: Spec, geometry: GeometryChoice, rows: Rows
    ) -> Refinement:
        """Return the errors of the structure, if they lower the errors on held-out rows."""
        if spec.output == "pose":
            return UNREFINED
        return best_refinement(spec, geometry, rows)

    def starting_at(self, settled: ErrorModel) -> ErrorModel:
        """Return the candidates without their blend; their choices start at settled ones."""
        return settled

    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the blend, fitted to all rows, and the comparison of the candidates."""
        spec, rows = _refined(spec, rows)
        folds = folds_of(rows.X, rows.groups)
        fold = _fold_of_rows(folds)
        parts = [Part.of(spec, rows, train, test) for train, test in folds]
        outer = inner_and_outer(rows.X)[1]
        candidates = self._candidates(spec, len(rows))
        fits, on_outer = _fitted(candidates, rows, spec, fold)
        settled = [fitted.error.settled for fitted in fits.values()]
        predicted = np.empty((len(settled), *rows.tips.shape), rows.tips.dtype)
        for k, model in enumerate(settled):
            for part in parts:
                predicted[k, part.test] = part.predicted(model, rows)
        on_folds = Predictions(predicted, rows.tips, rows.counts, rows.groups)
        held_out = HeldOut.of(on_folds, on_outer, np.append(fold, fold[outer]))
        weights, comparison = chosen_blend([*candidates], held_out, spec.geometry)
        near = {}
        for (name, candidate), model in zip(candidates.items(), settled, strict=True):
            near[name] = candidate.starting_at(model)
        alone = spec.held_out and not spec.compared
        if alone and weights[0] < 1.0 and _is_small(rows):
            blended = np.tensordot(weights, predicted, 1)
            comparison["expected_distance"] *= _optimism(
                blend_of(near.values(), weights),
                parts,
                _by_fold(rows, fold),
                blended,
            )
        return replace(
            blend_of(settled, weights).fit(rows, spec),
            settled=Candidates(near),
            noise=comparison["expected_distance"] / MEAN_LENGTH,
            held_out=True,
            comparison=comparison,
            refined=_errors_of_structure(spec),
            structure=_structure_of(spec, rows),
            candidates={name: fitted.module for name, fitted in fits.items()},
        )

    def _candidates(self, spec: Spec, n_rows: int) -> dict[str, ErrorModel]:
        """Return the error models by name; of equal candidates the first, simplest one wins."""
        network = growing_network(copy.deepcopy(self.random_state))
        candidates: dict[str, ErrorModel] = {}
        at_tip = ""
        if spec.mechanical is None:
            candidates["linear"] = RegressorModel(LinearRegression())
        else:
            first = "mechanical"
            if spec.mechanical.without_errors is not spec.mechanical:
                first = "structural"
            candidates[first] = NoCorrection()
            candidates["serial linear"] = LinearModel("serial")
            candidates["serial quadratic"] = QuadraticModel("serial")
            at_tip = "parallel "
            if spec.mechanical.robot.n_arcs:
                candidates["serial pose"] = ShapeModel("serial")
                candidates["parallel pose"] = ShapeModel("parallel")
            else:
                candidates["parallel quadratic"] = QuadraticModel("parallel")
        candidates[f"{at_tip}ELM"] = NetworkModelCV(network)
        if n_rows <= _MOST:
            candidates[f"{at_tip}kernel"] = KernelModel()
        return candidates


class Candidates(ErrorModel):
    """The candidates of "auto" for a part of a log; their choices start at those for all rows.

    The fit is that of the first candidate, without a correction or linear. The others, and what all
    predict for the outer rows after a fit to the inner ones, stand beside it.

    Parameters
    ----------
    models : dict of str to ErrorModel
        The candidates by name.
    """

    chooses = True
    needs_mechanical = False

    def __init__(self, models: dict[str, ErrorModel]) -> None:
        self.models = models

    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the fits of all candidates."""
        spec, rows = _refined(spec, rows)
        fold = _fold_of_rows(folds_of(rows.X, rows.groups))
        fits, outside = _fitted(self.models, rows, spec, fold)
        return replace(
            next(iter(fits.values())).error,
            settled=self,
            refined=_errors_of_structure(spec),
            candidates={name: fitted.module for name, fitted in fits.items()},
            outside=outside,
        )


def _refined(spec: Spec, rows: Rows) -> tuple[Spec, Rows]:
    """Return the specification with the refined mechanical model, and the rows' residuals of it."""
    spec = spec.refined(rows)
    residual = residuals(spec.mechanical, rows.q, rows.y, spec.output)
    return spec, replace(rows, residual=residual)


def _errors_of_structure(spec: Spec) -> ForwardModel | None:
    """Return the refined mechanical model, if it is refined."""
    model = spec.mechanical
    if model is None or model.without_errors is model:
        return None
    return model


def _structure_of(spec: Spec, rows: Rows) -> StructureFit | None:
    """Return the fit of the refined mechanical model, if it is refined and more rows could help."""
    model = _errors_of_structure(spec)
    if model is None or len(rows) > ENOUGH:
        return None
    return fit_structure(model.without_errors, rows, left_out=False)


def _fitted(
    models: Mapping[str, ErrorModel], rows: Rows, spec: Spec, fold: NDArray
) -> tuple[dict[str, FittedHybrid], Predictions]:
    """Return error models fitted to rows, and their predictions of the outer rows.

    Folds (N,), if there are groups, are held out for their penalties. The outer rows are predicted
    with these penalties by fits to the inner rows.
    """
    inner, outer = inner_and_outer(rows.X)
    outside = Part.of(spec, rows, inner, outer)
    by_fold = _by_fold(rows, fold)
    fits = {}
    predicted = []
    for name, model in models.items():
        if spec.progress is not None:
            spec.progress(len(fits), len(models))
        fits[name] = fit_hybrid(replace(spec, error_model=model), by_fold)
        predicted.append(outside.predicted(fits[name].error.settled, rows))
    test = rows.take(outer)
    return fits, Predictions(np.array(predicted), test.tips, test.counts, test.groups)


def _by_fold(rows: Rows, fold: NDArray) -> Rows:
    """Return rows whose groups, if there are any, are folds (N,): fewer take less time."""
    return rows if rows.groups is None else replace(rows, groups=fold)


def _fold_of_rows(folds: list[tuple[NDArray, NDArray]]) -> NDArray:
    """Return the fold in which every row is held out (N,)."""
    fold = np.empty(sum(len(test) for _, test in folds), dtype=int)
    for k, (_, test) in enumerate(folds):
        fold[test] = k
    return fold


def _is_small(rows: Rows) -> bool:
    """Return whether penalties chosen on all rows suit held-out ones, and folds can be refitted."""
    if rows.groups is None:
        return 2 < len(rows) < _FEW_ROWS
    return 2 < len(np.unique(rows.groups)) < _FEW_MOTIONS


def _optimism(
    model: ErrorModel, folds: list[Part], rows: Rows, blended: NDArray
) -> float:
    """Return the ratio of held-out errors with penalties chosen without a fold, to those with it.

    Penalties that suit the held-out rows would make the error to expect too small.
    """
    before = after = 0.0
    for fold in folds[:_ANEW]:
        test = rows.take(fold.test)
        anew = fit_hybrid(replace(fold.spec, error_model=model), rows.take(fold.train))
        before += test.counts @ distance(blended[fold.test], test.tips)
        after += test.counts @ distance(anew.predict(test.X), test.tips)
    return float(after / before)


def blend_of(models: Iterable[ErrorModel], weights: NDArray) -> ErrorModel:
    """Return the models of positive weight as one."""
    positive = []
    chosen = []
    for model, weight in zip(models, weights.tolist(), strict=True):
        if weight > 0.0:
            positive.append(weight)
            chosen.append(model)
    return chosen[0] if len(chosen) == 1 else Blend(positive, chosen)
