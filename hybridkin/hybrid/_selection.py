"""Choice of the error model by errors on held-out motions, and on rows outside the fitted ones."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LinearRegression
from typing_extensions import Self

from hybridkin._core.model import ForwardModel
from hybridkin._core.progress import Progress, quiet
from hybridkin.calibration.choice import GeometryChoice
from hybridkin.calibration.measured import distance
from hybridkin.hybrid._candidates import Candidates, Settled, by_folds
from hybridkin.hybrid._error_models import (
    Blend,
    KernelModel,
    LinearModel,
    NetworkModelCV,
    NoCorrection,
    QuadraticModel,
    RegressorModel,
    ShapeModel,
    blended,
)
from hybridkin.hybrid._fit import fit_hybrid, module_of
from hybridkin.hybrid._mechanics import best_mechanics
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import (
    ErrorModel,
    FittedError,
    FittedHybrid,
    Mechanics,
    Seed,
    Spec,
)
from hybridkin.hybrid._structural_model import ENOUGH
from hybridkin.hybrid._structure import fit_structure
from hybridkin.hybrid.held_out import MEAN_LENGTH, CrossFit
from hybridkin.hybrid.structure_fit import StructureFit
from hybridkin.learning.elm_cv import growing_network

_MOST = 2000  # rows for kernel ridge, whose cost grows with the cube of their number
# With fewer, penalties that were chosen on all rows suit them.
_FEW_MOTIONS = 40
_FEW_ROWS = 100
_ANEW = 3  # folds, without each of which penalties are then chosen once more


class Auto(ErrorModel):
    """The candidates of which a table of held-out predictions chooses one, or a blend.

    Parameters
    ----------
    random_state : int, RandomState or None
        Seed of the network.
    progress : callable, optional
        See `reporting`.
    """

    chooses = True
    needs_mechanical = False

    def __init__(self, random_state: Seed, progress: Progress = quiet) -> None:
        self.random_state = random_state
        self._progress = progress

    @classmethod
    def of(cls, coupling: str, random_state: Seed) -> Self:
        """Return the error model for these settings of a HybridForwardModel."""
        return cls(random_state)

    def reporting(self, progress: Progress) -> ErrorModel:
        """Return this model for a fit that tells how many of its candidates are fitted."""
        return type(self)(self.random_state, progress)

    def mechanics(self, spec: Spec, geometry: GeometryChoice, rows: Rows) -> Mechanics:
        """Return the mechanics of least error below corrections."""
        return best_mechanics(spec, geometry, rows)

    def starting_at(self, settled: ErrorModel) -> ErrorModel:
        """Return the candidates, whose choices start at settled ones."""
        return settled

    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the candidates fitted to all rows, which fixes their penalties."""
        models = self._candidates(spec.refined(rows), len(rows))
        return ChosenCandidates(models, self._progress).fit(rows, spec)

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
            candidates["serial linear"] = LinearModel("serial").down_to_noise()
            candidates["serial quadratic"] = QuadraticModel("serial").down_to_noise()
            at_tip = "parallel "
            if spec.mechanical.robot.n_arcs:
                candidates["serial pose"] = ShapeModel("serial").down_to_noise()
                candidates["parallel pose"] = ShapeModel("parallel").down_to_noise()
            else:
                candidates["parallel quadratic"] = QuadraticModel("parallel").down_to_noise()
        candidates[f"{at_tip}ELM"] = NetworkModelCV(network)
        if n_rows <= _MOST:
            candidates[f"{at_tip}kernel"] = KernelModel()
        return candidates


class ChosenCandidates(Candidates):
    """The candidates of "auto" with settings; their mechanics are chosen anew for other rows."""

    def mechanics(self, spec: Spec, geometry: GeometryChoice, rows: Rows) -> Mechanics:
        """Return the mechanics of least error below corrections."""
        return best_mechanics(spec, geometry, rows)


def decided(fitted: FittedHybrid, rows: Rows, table: CrossFit) -> FittedHybrid:
    """Return the fit of the candidates that a table chose: one, or a blend.

    Parameters
    ----------
    fitted : FittedHybrid
        The fit of all candidates.
    rows : Rows
        The rows of the fit.
    table : CrossFit
        The held-out predictions of the candidates.
    """
    spec = fitted.spec
    error = fitted.error
    parts = []
    weights = []
    for part, weight in zip(error.candidates.values(), table.weights, strict=True):
        if weight > 0.0:
            parts.append(part.error)
            weights.append(float(weight))
    blend = replace(
        blended(parts, weights),
        settled=error.settled,
        noise=table.expected_error / MEAN_LENGTH,
        held_out=True,
        comparison=table.results(spec.geometry),
        refined=error.refined,
        candidates=error.candidates,
    )
    blend = replace(blend, structure=_structure_of(error.refined, rows))
    return FittedHybrid(spec, blend, module_of(spec, rows, blend))


def expected_with_new_choices(fitted: FittedHybrid, rows: Rows, table: CrossFit) -> float:
    """Return the mean distance to expect if penalties are chosen without the held-out rows [m].

    Of few rows or motions, penalties that suit the held-out rows would make it too small. The ratio
    of both errors comes from the fits without each of three folds.
    """
    weights = table.weights
    if weights[0] == 1.0 or not _is_small(rows):
        return table.expected_error
    settled = Settled.of(fitted, rows)
    near = fitted.error.settled
    assert isinstance(near, Candidates)
    model = blend_of(near.models.values(), weights).without_errors()
    tips = np.tensordot(weights, table.tips, 1)
    before = 0.0
    after = 0.0
    for fold in range(_ANEW):
        test = np.flatnonzero(table.fold == fold)
        train = np.flatnonzero(table.fold != fold)
        spec, _ = settled.part(train)
        training_rows = by_folds(rows, table.fold).take(train)
        anew = fit_hybrid(replace(spec, error_model=model), training_rows)
        test_rows = rows.take(test)
        before += test_rows.counts @ distance(tips[test], test_rows.tips)
        after += test_rows.counts @ distance(anew.predict(test_rows.X), test_rows.tips)
    return table.expected_error * float(after / before)


def _structure_of(model: ForwardModel | None, rows: Rows) -> StructureFit | None:
    """Return the fit of a refined mechanical model, if more rows could help."""
    if model is None or len(rows) > ENOUGH:
        return None
    return fit_structure(model.without_errors, rows, left_out=False)


def _is_small(rows: Rows) -> bool:
    """Return whether penalties chosen on all rows suit held-out ones, and folds can be refitted."""
    few = _FEW_MOTIONS if rows.groups.whole else _FEW_ROWS
    return 2 < rows.groups.number < few


def blend_of(models: Iterable[ErrorModel], weights: NDArray) -> ErrorModel:
    """Return the models of positive weight as one."""
    positive = []
    chosen = []
    for model, weight in zip(models, weights.tolist(), strict=True):
        if weight > 0.0:
            positive.append(weight)
            chosen.append(model)
    return chosen[0] if len(chosen) == 1 else Blend(positive, chosen)
