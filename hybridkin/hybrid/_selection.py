"""Choice of the error model by errors on held-out motions, and on rows outside the fitted ones."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import starmap
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgWarning
from sklearn.linear_model import LinearRegression
from typing_extensions import Self

from hybridkin._core.model import ForwardModel
from hybridkin._core.progress import Progress, quiet
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
    blended,
)
from hybridkin.hybrid._fit import fit_hybrid, module_of
from hybridkin.hybrid._kernel import folds_of
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import (
    UNREFINED,
    ErrorModel,
    FittedError,
    FittedHybrid,
    Refinement,
    Seed,
    Spec,
    residuals,
)
from hybridkin.hybrid._structural_model import ENOUGH, best_refinement
from hybridkin.hybrid._structure import fit_structure
from hybridkin.hybrid.held_out import (
    MEAN_LENGTH,
    CrossFit,
    Outer,
    Predictions,
    fold_of_rows,
)
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
        Called with the number of candidates that are fitted, and of all of them.
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

    def refinement(self, spec: Spec, geometry: GeometryChoice, rows: Rows) -> Refinement:
        """Return the errors of the structure, if they lower the errors on held-out rows."""
        if spec.output == "pose":
            return UNREFINED
        return best_refinement(spec, geometry, rows)

    def starting_at(self, settled: ErrorModel) -> ErrorModel:
        """Return the candidates, whose choices start at settled ones."""
        return settled

    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the candidates fitted to all rows, which fixes their penalties."""
        spec, rows = _refined(spec, rows)
        return _side_by_side(self._candidates(spec, len(rows)), rows, spec, self._progress)

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
    """Error models that are fitted side by side; the first, simplest one counts.

    Parameters
    ----------
    models : dict of str to ErrorModel
        The candidates by name.
    refined : Refinement
        How the mechanical model is refined below all of them.
    """

    chooses = True
    needs_mechanical = False

    def __init__(self, models: dict[str, ErrorModel], refined: Refinement) -> None:
        self.models = models
        self.refined = refined

    def refinement(self, spec: Spec, geometry: GeometryChoice, rows: Rows) -> Refinement:
        """Return the refinement that was chosen with the candidates."""
        return self.refined

    def without_errors(self) -> ErrorModel:
        """Return the candidates for fits of which only the predictions count."""
        models = {name: model.without_errors() for name, model in self.models.items()}
        candidates = Candidates(models, self.refined)
        candidates.tells_errors = False
        return candidates

    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the fits of all candidates."""
        spec, rows = _refined(spec, rows)
        return _side_by_side(self.models, rows, spec)


def _refined(spec: Spec, rows: Rows) -> tuple[Spec, Rows]:
    """Return the specification with the refined mechanical model, and the rows' residuals of it."""
    spec = spec.refined(rows)
    residual = residuals(spec.mechanical, rows.q, rows.y, spec.output)
    return spec, replace(rows, residual=residual)


def _side_by_side(
    models: Mapping[str, ErrorModel],
    rows: Rows,
    spec: Spec,
    progress: Progress = quiet,
) -> FittedError:
    """Return the fits of all candidates, with penalties chosen on folds of the rows."""
    by_fold = _by_fold(rows, fold_of_rows(folds_of(rows.groups)))
    fits = {}
    near = {}
    for name, model in models.items():
        error = model.fit(by_fold, spec)
        module = module_of(spec, rows, error)
        fits[name] = FittedHybrid(replace(spec, error_model=model), error, module)
        near[name] = model.starting_at(error.settled)
        progress(len(fits), len(models))
    return replace(
        fits[next(iter(fits))].error,
        settled=Candidates(near, spec.refinement),
        refined=_errors_of_structure(spec),
        candidates=fits,
    )


class Settled(NamedTuple):
    """Models whose choices are those for all rows, for fits to some of the rows.

    Attributes
    ----------
    spec : Spec
        The settings, with the chosen geometry.
    rows : Rows
        The rows.
    models : dict of str to ErrorModel
        The error models with their choices, by name.
    """

    spec: Spec
    rows: Rows
    models: dict[str, ErrorModel]

    @classmethod
    def of(cls, fitted: FittedHybrid, rows: Rows) -> Settled:
        """Return the candidates of a fit to rows, or the one model that it has."""
        fits = fitted.error.candidates or {"model": fitted}
        models = {}
        for name, fit in fits.items():
            models[name] = fit.error.settled.without_errors()
        return cls(fitted.spec, rows, models)

    def part(self, train: NDArray) -> tuple[Spec, Rows]:
        """Return the specification calibrated on training rows, and these rows."""
        # A single held-out motion has similar ones in training; folds are a harder test.
        rows = self.rows.ungrouped().take(train).distinct()
        return self.spec.recalibrated(rows), rows

    def held_out(self, train: NDArray, test: NDArray) -> Predictions:
        """Return what the models predict for test rows after fits to training rows."""
        spec, rows = self.part(train)
        test_rows = self.rows.take(test)
        tips = []
        for model in self.models.values():
            with TURNS.filters, warnings.catch_warnings():  # the full fit gives them
                warnings.simplefilter("ignore", LinAlgWarning)
                fitted = fit_hybrid(replace(spec, error_model=model), rows)
            tips.append(fitted.predict(test_rows.X))
        # Choices that know the rows give no domain that held-out rows have tested.
        inside = np.ones((len(tips), len(test)), dtype=bool)
        return Predictions(np.array(tips), inside)

    def outer(self) -> Outer:
        """Return the outer rows, predicted by fits to the inner ones."""
        inner, outer = inner_and_outer(self.rows.X)
        test = self.rows.take(outer)
        return Outer(self.held_out(inner, outer).tips, test.tips, test.counts, outer)

    def table(self, outer: Outer) -> CrossFit:
        """Return the held-out predictions of folds of groups or rows, with those of `outer`."""
        splits = folds_of(self.rows.groups)
        held_out = starmap(self.held_out, splits)
        return CrossFit.of([*self.models], self.rows, splits, held_out, outer)


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
        training_rows = _by_fold(rows, table.fold).take(train)
        anew = fit_hybrid(replace(spec, error_model=model), training_rows)
        test_rows = rows.take(test)
        before += test_rows.counts @ distance(tips[test], test_rows.tips)
        after += test_rows.counts @ distance(anew.predict(test_rows.X), test_rows.tips)
    return table.expected_error * float(after / before)


def _errors_of_structure(spec: Spec) -> ForwardModel | None:
    """Return the refined mechanical model, if it is refined."""
    model = spec.mechanical
    if model is None or model.without_errors is model:
        return None
    return model


def _structure_of(model: ForwardModel | None, rows: Rows) -> StructureFit | None:
    """Return the fit of a refined mechanical model, if more rows could help."""
    if model is None or len(rows) > ENOUGH:
        return None
    return fit_structure(model.without_errors, rows, left_out=False)


def _by_fold(rows: Rows, fold: NDArray) -> Rows:
    """Return rows whose groups, if there are any, are folds (N,): fewer take less time."""
    return replace(rows, groups=rows.groups.named(fold))


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
