"""Candidates of "auto": fitted side by side, then with their choices to parts of the rows."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import starmap
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgWarning

from hybridkin._core.model import ForwardModel
from hybridkin._core.progress import Progress, quiet
from hybridkin._core.turns import TURNS
from hybridkin.calibration.measured import inner_and_outer
from hybridkin.hybrid._fit import fit_hybrid, module_of
from hybridkin.hybrid._kernel import folds_of
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import ErrorModel, FittedError, FittedHybrid, Spec, residuals
from hybridkin.hybrid.held_out import CrossFit, Outer, Predictions, Split, fold_of_rows


class Candidates(ErrorModel):
    """Error models that are fitted side by side; the first, simplest one counts.

    Parameters
    ----------
    models : dict of str to ErrorModel
        The candidates by name.
    progress : callable, optional
        Called with the number of candidates that are fitted, and of all of them.
    """

    chooses = True
    needs_mechanical = False

    def __init__(self, models: Mapping[str, ErrorModel], progress: Progress = quiet) -> None:
        self.models = models
        self._progress = progress

    def without_errors(self) -> ErrorModel:
        """Return the candidates for fits of which only the predictions count."""
        models = {name: model.without_errors() for name, model in self.models.items()}
        candidates = type(self)(models)
        candidates.tells_errors = False
        return candidates

    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the fits of all candidates to all rows, which fixes their penalties."""
        spec = spec.refined(rows)
        residual = residuals(spec.mechanical, rows.q, rows.y, spec.output)
        rows = replace(rows, residual=residual)
        by_fold = by_folds(rows, fold_of_rows(folds_of(rows.groups)))
        fits = {}
        near = {}
        for name, model in self.models.items():
            error = model.fit(by_fold, spec)
            module = module_of(spec, rows, error)
            fits[name] = FittedHybrid(replace(spec, error_model=model), error, module)
            near[name] = model.starting_at(error.settled)
            self._progress(len(fits), len(self.models))
        return replace(
            fits[next(iter(fits))].error,
            settled=type(self)(near),
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

    @property
    def folds(self) -> list[Split]:
        """The folds whose penalties were chosen: training and held-out rows."""
        return folds_of(self.rows.groups)

    def table(self, outer: Outer, splits: Sequence[Split]) -> CrossFit:
        """Return the held-out predictions of folds of groups or rows, with those of `outer`."""
        held_out = starmap(self.held_out, splits)
        return CrossFit.of([*self.models], self.rows, splits, held_out, outer)


def _errors_of_structure(spec: Spec) -> ForwardModel | None:
    """Return the refined mechanical model, if it is refined."""
    model = spec.mechanical
    if model is None or model.without_errors is model:
        return None
    return model


def by_folds(rows: Rows, fold: NDArray) -> Rows:
    """Return rows whose groups, if there are any, are folds (N,): fewer take less time."""
    return replace(rows, groups=rows.groups.named(fold))
