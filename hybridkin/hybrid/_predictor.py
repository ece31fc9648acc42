"""The predictions of a fitted hybrid model: tips, Jacobians, their parts and the domain."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.metrics import r2_score
from sklearn.utils.validation import check_is_fitted
from typing_extensions import Self

from hybridkin._core.arrays import check_shape, labels, real_array, shaped
from hybridkin._core.commands import Commands
from hybridkin._core.digests import row_digests
from hybridkin._core.distinct import targets_that_count
from hybridkin._core.html import html_table
from hybridkin._core.model import ForwardModel, as_forward_model
from hybridkin._core.other_units import check_commands
from hybridkin._core.plausible import PlausibleRows, UnknownRows
from hybridkin.calibration.calibrate import CalibrationResult
from hybridkin.hybrid._adapt import Change
from hybridkin.hybrid._drift import Drift
from hybridkin.hybrid._hysteresis import NO_PAST, Past
from hybridkin.hybrid._module import Hybrid
from hybridkin.hybrid._pace import each_pace
from hybridkin.hybrid._radius import Radius
from hybridkin.hybrid._range import TrainingRange
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._wrapped import in_columns, pose_difference
from hybridkin.hybrid.cv_results import CvResults
from hybridkin.hybrid.log_fit import HybridFit
from hybridkin.hybrid.model_description import ModelDescription
from hybridkin.hysteresis.value import Hysteresis
from hybridkin.learning.hidden_layer import check_inputs
from hybridkin.native.library import evaluate

_FLOAT64 = np.dtype(np.float64)


class HybridPredictor(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """The prediction methods of a `HybridForwardModel`; they use only the results of `fit`."""

    error_model: object
    coupling: str
    calibrate: Iterable[str] | str | None
    guard: str | None
    output: str
    n_features_in_: int
    module_: ForwardModel
    change_: Change
    mechanical_model_: ForwardModel | None
    description_: ModelDescription
    _fit: HybridFit
    _past: Past
    _drift: Drift
    _plausible_rows: PlausibleRows = UnknownRows.of(0)
    # Those that need no other check, and do not change by hysteresis.
    _plain_rows: PlausibleRows = UnknownRows.of(0)

    @property
    def fitted_module_(self) -> Hybrid:
        """The module of the fit, without what has changed since."""
        return self._fit.module

    @property
    def error_model_(self) -> object:
        """The fitted error model."""
        return self._fit.error.result

    @property
    def calibration_(self) -> CalibrationResult | None:
        """The result of the calibration."""
        return self._fit.calibration

    @property
    def cv_results_(self) -> CvResults | None:
        """The comparison of the candidates of error_model="auto"."""
        return self._fit.error.comparison

    @property
    def candidates_(self) -> dict[str, Hybrid] | None:
        """The candidates of error_model="auto", fitted to all rows."""
        return self._fit.candidates

    @property
    def radius_(self) -> Radius | None:
        """The estimated error radius."""
        return self._fit.radius

    def structure_in_words(self) -> list[str]:
        """Return the errors of the structure, and a forecast for more rows; none without them."""
        return self._fit.error.structure_in_words()

    def predict(
        self,
        X: object,
        return_radius: bool = False,
        groups: ArrayLike | None = None,
    ) -> Any:
        """Return tip positions f_mech(q) + w(q) eps(q).

        Parameters
        ----------
        X : array-like of shape (N, n) or Commands
            Actuator vectors; with `hysteresis` in order of time, as `Commands` for several runs or
            times.
        return_radius : bool, default=False
            Whether to return the estimated error radius as well; requires `coverage`.
        groups : array-like of shape (N,), optional
            Motion of every row, only used with `hysteresis`: as in a fit, each motion is a run.

        Returns
        -------
        x : ndarray of shape (N, m), or (N,) as in `fit`
            Tips [m]; for poses also rotation vectors with a length of at most pi [rad]. NaN where
            numbers overflow.
        radius : ndarray of shape (N,)
            Only if `return_radius`: estimated error radius [m]. It covers a share `coverage` of
            the tips if the groups of the fit and the new ones are exchangeable. Infinite outside
            the domain (`in_domain`), and everywhere if the fit had too few groups.
        """
        if groups is not None:
            commands = Commands.of(X)
            runs = labels(groups, len(commands))
            X = Commands(commands.q, runs, commands.time)
        if not return_radius:
            return self._evaluated(self._tips, X)[0]
        check_is_fitted(self)
        if self.radius_ is None:
            raise ValueError(
                "`return_radius` needs a model that was fitted with `coverage`, for example "
                "HybridForwardModel(..., coverage=0.9); this one was fitted without."
            )
        x, distance = self._evaluated(partial(self._tips, distance=True, enough=1.0), X)
        has_tip = np.isfinite(x).reshape(len(x), -1).all(axis=1)
        inside = (distance <= 1.0) & has_tip & self._are_states_seen(X)
        return x, self.radius_.at(inside).astype(x.dtype)

    def predict_mechanical(self, X: object) -> NDArray:
        """Return the mechanical part f_mech(q), shaped like `predict` [m]."""
        return self._evaluated(self._mechanical_tips, X)[0]

    def predict_error(self, X: object) -> NDArray:
        """Return the learned part w(q) eps(q), shaped like `predict` [m], rotations [rad]."""
        return self._evaluated(self._tip_errors, X, warn=False)[0]

    def score(
        self, X: object, y: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> float:
        """Return R^2 of `predict`, averaged over the columns of y, without missing markers.

        Of rows of weight 0, y is ignored; with `hysteresis` they move the actuators.
        """
        x = self.predict(X)
        y = targets_that_count(y, sample_weight, "y")
        measured = np.asarray(y, dtype=float).reshape(len(x), -1)
        predicted = x.reshape(measured.shape)
        weights = np.ones(len(x))
        if sample_weight is not None:
            weights = np.asarray(sample_weight)
        scores = []
        for column, expected in zip(measured.T, predicted.T, strict=True):
            rows = ~np.isnan(column)
            score = r2_score(column[rows], expected[rows], sample_weight=weights[rows])
            scores.append(score)
        return float(np.mean(scores))

    def jacobian(self, X: object) -> NDArray:
        """Return the full Jacobian dx/dq of the sum, shape (N, m, n) or, for 1-D y, (N, n).

        For poses, the last three rows give the angular velocity in the measuring frame.
        """
        return self._evaluated(partial(self._tips, jacobian=True), X)[1]

    def predict_and_jacobian(self, X: object) -> tuple[NDArray, NDArray]:
        """Return `predict(X)` and `jacobian(X)` in one pass."""
        x, J = self._evaluated(partial(self._tips, jacobian=True), X)
        return x, J

    def in_domain(self, X: object) -> NDArray[np.bool_]:
        """Return whether each row lies in the domain, close to the training rows (see `guard`).

        After a fit with groups, a row must also be as close to the nearest training row as 98 % of
        these are to rows of other groups: held-out groups have tested the model only so far. Along
        directions that no training row moved, the domain ends after a tenth of the range. The
        errors of rows outside the domain are not known, even where eps has its full weight.

        Friction and creep have states, which follow from the commands of a run. A row is outside if
        its states are farther from those of the log than a tenth of the range, and than groups of
        the log are from each other: for example in a run that begins where no run of the log was,
        or after a long rest. With creep a row is outside as well if its run
        moves faster or slower than the log did, over any time constant of creep.

        Parameters
        ----------
        X : array-like of shape (N, n) or Commands
            Actuator vectors, as for `predict`.

        Returns
        -------
        inside : ndarray of bool of shape (N,)
            Without a guard all True, except along those directions.
        """
        inside = self._evaluated(self._distances, X, warn=False)[0] <= 1.0
        return inside & self._are_states_seen(X)

    def described(self, description: ModelDescription) -> Self:
        """Return this estimator with another `description_`."""
        self.description_ = description
        return self

    def was_fitted(self, X: object, y: ArrayLike) -> NDArray[np.bool_]:
        """Return which rows are rows of the fit, to a micrometre, shape (N,).

        Parameters
        ----------
        X : array-like of shape (N, n) or Commands
            Actuator vectors, as for `fit`.
        y : array-like of shape (N, m)
            Measured tips [m].

        Returns
        -------
        ndarray of bool of shape (N,)
            All False for a nominal model, which no rows were fitted to.
        """
        check_is_fitted(self, "module_")
        q = shaped(Commands.of(X).q, "X", ("N", self.n_features_in_))
        measured = real_array(y, "y")
        check_shape(measured, "y", (len(q), "m"), "one row for each row of `X`")
        return np.isin(row_digests(q, measured), self._fit.fitted_rows)

    def effective(self, X: object) -> NDArray:
        """Return what the actuators do for commands X [unit of q]; without `hysteresis`, X itself.

        Parameters
        ----------
        X : array-like of shape (N, n) or Commands
            Commands, as for `predict`.

        Returns
        -------
        ndarray of shape (N, n)
            The input of `module_`.

        Raises
        ------
        ValueError
            If the actuators creep, and these rows have no times.
        """
        check_is_fitted(self, "module_")
        commands = Commands.of(X)
        rows = check_inputs(self, commands.q)
        if not self.hysteresis_ or not len(rows):
            return rows
        return self.hysteresis_.apply_by_group(
            rows, commands.run_of_rows, commands.time
        )

    def error_weight(self, X: object) -> NDArray:
        """Return the weight w(q) in [0, 1] of the error model at each row, shape (N,)."""
        weight = as_forward_model(self.fitted_module_.error_weight)
        return self._evaluated(
            lambda q: evaluate(weight, q + self.change_.shift), X, warn=False
        )[0]

    @property
    def hysteresis_(self) -> Hysteresis:
        """The hysteresis between the commands and what the actuators do; maybe none."""
        return self._fit.hysteresis

    @property
    def training_range_(self) -> TrainingRange:
        """The range of q in the fit, where it lies after `adapt` [unit of q]."""
        return self._fit.training_range.shifted(-self.change_.shift)

    @property
    def _repr_html_(self) -> Callable[[], str]:
        """What scikit-learn shows in a notebook, and below it what the fit found.

        As in scikit-learn there is none where its `display` is "text".
        """
        shown = super()._repr_html_
        return lambda: shown() + self._fit_html()

    def _repr_mimebundle_(self, **kwargs: object) -> dict[str, str]:
        bundle = super()._repr_mimebundle_(**kwargs)
        if "text/html" in bundle:
            bundle["text/html"] += self._fit_html()
        return bundle

    def _fit_html(self) -> str:
        if "module_" not in vars(self):
            return ""
        title = f"{type(self).__name__}: what the fit found"
        return html_table(title, self.html_rows())

    @abstractmethod
    def html_rows(self) -> dict[str, object]:
        """Return names and values of what the fit found, which a notebook shows."""

    @property
    def _robot(self) -> ForwardModel:
        """The mechanical model; without one the module, which knows no robot either."""
        return (
            self.module_ if self.mechanical_model_ is None else self.mechanical_model_
        )

    def _check_commands(self, rows: Rows) -> None:
        """Raise if actuator vectors have another unit than those of the fit."""
        turns = torch.as_tensor(self._robot.turns, device="cpu")
        low, high = self.training_range_
        check_commands(rows.X, low, high, bool(turns.all()))

    def _warn_of_units(self, rows: Rows) -> None:
        """Warn if measured tips span far more than the robot, so they cannot be in metres."""
        if not rows.counts.any():
            return
        rows = rows.take(np.flatnonzero(rows.counts))
        tips = torch.from_numpy(rows.tips)
        for message in self._robot.tip_messages(rows.q, tips, "y", calibrated=True):
            warnings.warn(message, stacklevel=3)

    def _doubts(self, q: NDArray) -> list[str]:
        """Return warnings about units and contradictions of finite rows q (N, n).

        Negative lengths are extrapolation, no error.
        """
        if self._plausible_rows.hold(q):
            return []
        robot = self._robot
        rows = torch.tensor(q, device="cpu")
        return [*robot.unit_messages(rows, "X"), *robot.contradictions(rows, "X")]

    def _distances(self, q: NDArray) -> tuple[NDArray]:
        """Return the distance from the domain of rows q (N, n): infinite without a shape."""
        (distance,) = self._tips(q, value=False, distance=True, enough=1.0)
        if not self._plausible_rows.hold(q):
            has_shape = self._robot.has_shape(torch.tensor(q, device="cpu"))
            distance = np.where(has_shape.numpy(), distance, np.inf)
        return (distance,)

    def _are_states_seen(self, X: object) -> NDArray[np.bool_]:
        """Return whether the log had the states inside of the hysteresis, and such a pace (N,)."""
        commands = Commands.of(X)
        states_of_log = self._fit.state_range
        if not self.hysteresis_ or states_of_log is None:
            return np.ones(len(commands), dtype=bool)
        rows = check_inputs(self, commands.q)
        low, high = states_of_log.shifted(-self.change_.shift)
        seen = np.ones(len(commands), dtype=bool)
        states = self.hysteresis_.each_inner_state(
            rows, commands.run_of_rows, commands.time
        )
        for k, state in enumerate(states):
            seen &= ((low[k] <= state) & (state <= high[k])).all(axis=1)
        if self._fit.pace is not None and commands.time is not None:
            paces = each_pace(
                rows,
                commands.run_of_rows,
                commands.time,
                self.hysteresis_.time_constants,
            )
            seen &= self._fit.pace.holds(paces, len(rows))
        return seen

    def take_fit(self, fit: HybridFit) -> None:
        """Become the model of a fit; the robot has not changed since."""
        self._fit = fit
        self.change_ = Change.none(self.n_features_in_)
        self._drift = fit.no_drift
        self._past = NO_PAST
        self._follow_robot()
        self.description_ = ModelDescription.of(self.module_, self.n_features_in_)

    def count_as_fitted(self, q: NDArray, x: NDArray) -> None:
        """Count rows q (N, n) with tips x (N, m) as fitted: those of a log that was thinned."""
        digests = np.unique(row_digests(q, x))
        self._fit = replace(self._fit, fitted_rows=digests)

    def _follow_robot(self) -> None:
        """Set the module and its mechanical model after the change and the drift of the robot."""
        hybrid = self.fitted_module_
        mechanical = hybrid.mechanical
        drift = self._drift.correction()
        if drift is not None:
            hybrid = hybrid.with_drift(drift)
        self.module_ = self.change_.after(hybrid)
        if mechanical is not None:
            mechanical = self.change_.after(mechanical.without_errors)
        self.mechanical_model_ = mechanical
        self._plausible_rows = self._robot.plausible_rows()
        self._plain_rows = UnknownRows.of(self.n_features_in_)
        if not self.hysteresis_ and "feature_names_in_" not in vars(self):
            self._plain_rows = self._plausible_rows

    def _tips(
        self, q: NDArray, enough: float = 0.0, **results: bool
    ) -> tuple[NDArray, ...]:
        """Return the tips of rows q (N, n), or other `results` of `evaluate`."""
        model = in_columns(self.module_, self.output)
        return evaluate(model, q, enough=enough, **results)

    def _mechanical_tips(self, q: NDArray) -> tuple[NDArray, ...]:
        """Return f_mech(q) of rows q (N, n), zero without a mechanical model."""
        if self.mechanical_model_ is None:
            return (0.0 * self._tips(q)[0],)
        return evaluate(in_columns(self.mechanical_model_, self.output), q)

    def _tip_errors(self, q: NDArray) -> tuple[NDArray, ...]:
        """Return the way from f_mech(q) to the tips of rows q (N, n)."""
        before = self._mechanical_tips(q)[0]
        after = self._tips(q)[0]
        if self.output == "pose":
            ways = pose_difference(torch.from_numpy(before), torch.from_numpy(after))
            return (ways.numpy(),)
        return (after - before,)

    def _evaluated(
        self,
        function: Callable[[NDArray], Sequence[NDArray]],
        X: object,
        warn: bool = True,
    ) -> list[NDArray]:
        """Return the results of a function of rows q for the rows of X, in the dtype of X."""
        if self._plain_rows.hold_row(X):
            rows = X
            q = X
        else:
            rows = self.effective(X)
            q = rows.astype(np.float64, copy=False)
            if warn:
                for message in self._doubts(q):
                    warnings.warn(message, stacklevel=3)
        arrays = [*function(q)]
        if rows.dtype != _FLOAT64:
            with np.errstate(over="ignore"):  # too large for float32
                arrays = [array.astype(rows.dtype) for array in arrays]
        if self._fit.single_output:
            arrays = [array[:, 0] if array.ndim > 1 else array for array in arrays]
        return arrays
