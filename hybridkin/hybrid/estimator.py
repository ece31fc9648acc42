"""The hybrid model as a scikit-learn regressor: a mechanical model plus its learned residual."""

from __future__ import annotations

import copy
import warnings
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
from torch import Tensor, nn
from typing_extensions import Self

from hybridkin._core.arrays import (
    check_shape,
    labels,
    number,
    real_array,
    shaped,
    table,
)
from hybridkin._core.clock import check_seconds
from hybridkin._core.commands import Commands
from hybridkin._core.digests import row_digests
from hybridkin._core.distinct import targets_that_count
from hybridkin._core.finite_rows import LEAVE_OUT, check_entries
from hybridkin._core.html import html_table
from hybridkin._core.model import ForwardModel, as_forward_model
from hybridkin._core.other_units import check_commands, check_tips
from hybridkin._core.plausible import PlausibleRows, UnknownRows
from hybridkin.calibration.calibrate import CalibrationResult
from hybridkin.calibration.choice import NOT_CHOSEN, GeometryChoice
from hybridkin.calibration.measured import (
    WEIGH_ZERO,
    check_finite,
    check_unscaled,
    with_missing_markers,
)
from hybridkin.hybrid._adapt import (
    PARAMETERS,
    Change,
    check_parameters,
    likeliest_change,
)
from hybridkin.hybrid._drift import Drift
from hybridkin.hybrid._html import fitted_rows
from hybridkin.hybrid._hysteresis import NO_PAST, Past, choice_of, continued
from hybridkin.hybrid._module import Hybrid
from hybridkin.hybrid._pace import each_pace
from hybridkin.hybrid._radius import Radius
from hybridkin.hybrid._range import TrainingRange
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._settings import CONSTRAINTS, error_model_of
from hybridkin.hybrid._spec import ErrorModel, Spec, residuals
from hybridkin.hybrid._wrapped import in_columns, pose_difference
from hybridkin.hybrid.cv_results import CvResults
from hybridkin.hybrid.log_fit import HybridFit, fit_to_log
from hybridkin.hybrid.model_description import ModelDescription
from hybridkin.hysteresis.value import Hysteresis, checked_times
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.hidden_layer import check_inputs, check_rows
from hybridkin.native.library import evaluate

_FLOAT64 = np.dtype(np.float64)


class HybridForwardModel(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Forward kinematics f_hyb(q) = f_mech(q) + eps(q), with eps learned from the residual.

    A scikit-learn regressor from actuator vectors to tip positions, or poses. The fitted `module_`
    is a torch module with a closed-form Jacobian, ready for `InverseKinematics`.

    Parameters
    ----------
    mechanical_model : nn.Module, optional
        Maps q (..., n) to x (..., m), for example a `ConstantCurvatureChain`. It is copied, never
        changed. None: no mechanical model, everything is learned (f^dat of the paper).
    error_model : estimator, str or None, default=None
        Any scikit-learn regressor with as many outputs as x has (others in a
        ``MultiOutputRegressor``), or a name. A regressor of another library sees q as given, or as
        its own pipeline scales it, and residuals with mean zero and unit spread: its penalties and
        tolerances are relative to that spread, and lengths can be in any unit.
        (``LinearRegression``, ``Ridge``, ``RidgeCV`` and ``KernelRidge`` give the same at any
        scale, and see metres.) A fitted regressor in a ``sklearn.frozen.FrozenEstimator`` is used
        as it is, for example an `ELMRegressor` that has learned the residuals of a stream [m] by
        `partial_fit`; X and y then only give its guard and its errors. Names:

        - "elm", the same as None: ``ELMRegressor(random_state=random_state)``;
        - "structural": the errors of a chain's structure, which are a moved base, zeros and rings
          of the segments, and twist and sag under a load. Their prior is in natural units, so a
          dozen rows are enough; from 60 rows held-out errors choose its width. For chains of arcs,
          coupling="serial";
        - "linear" or "quadratic": features of all actuators; "pose": features of a chain's shape
          on which loads act. Linear and other features have separate penalties, chosen by the
          leave-one-out error of rows, or of groups; an infinite penalty means no correction;
        - "kernel": Gaussian kernel ridge tuned on 5 folds, for up to 10 000 rows;
        - "drop": the mechanical model alone;
        - "auto": the blend of these models with the least error on held-out groups, or rows; rows
          outside the fitted ones have a small weight in it. What is calibrated below all of them,
          and whether they stand on the errors of the structure, is chosen by the errors that remain
          below quick corrections. Linear and quadratic features are serial, pose features in both
          couplings; mechanical models without a shape have parallel quadratic features instead.
          Kernel ridge takes part up to 2000 rows. If the gain over the model without further
          corrections is within its standard error, twice that over errors of the structure, nothing
          is added. Group rows by what will be new in use. Without a mechanical model: a linear
          function, a network and kernel ridge.
    coupling : {"parallel", "serial"}, default="parallel"
        Where the correction acts. "parallel": at the tip, f_mech(q) + eps(q), eq. (2). "serial":
        inside the robot, f_mech(z(q) + delta(q)). z holds the lengths and bendings of a chain's
        segments; for other mechanical models it is q. delta is linear in features of q, so a
        regressor must be an ELMRegressor (its hidden layer and `alpha` are used) or an
        ELMRegressorCV. Serial needs less data if the error has a simple cause inside the robot.
    calibrate : sequence of str, "auto", "default" or None, default=None
        Parameters of the mechanical model to calibrate first, see `hybridkin.calibrate`. Every
        fold of a cross-validation repeats this. "auto" chooses among sets of parameters, from none
        to the whole geometry, by the errors on held-out groups, or rows, and on the outer rows
        after a fit to the inner ones (for error_model="drop" by the first errors only); for
        error_model="auto" by these errors with corrections. If tendons of a
        `ConstantCurvatureChain` contradict each other, it also tries an `ElasticTendonChain`. So
        does error_model="auto" with a list. "default": the chain's own list. None: "auto" for a
        chain with error_model="auto", else nothing.
    guard : {"leverage", None}, default="leverage"
        Where eps is used. "leverage": the domain is where inputs are as close to the training rows
        as these are to each other, in the hidden features of a network at the tip, or in the inputs
        and their squares for other error models. From three times this distance eps fades out and
        f_mech remains. None: everywhere. With `groups`, the domain (`in_domain`) also excludes rows
        where no held-out group has tested the model. With a guard, f_hyb differs from f_mech by at
        most 1.5 times the longest correction of a training row. f_mech has the errors of its
        structure, if these are learned; they have no guard.
    hysteresis : float, array-like of shape (n,), Hysteresis or "auto", default=0.0
        Backlash (also called play) of the actuators [unit of q]. Rows are then commands in order of
        time, see `Commands`, and the model maps the motion of the actuators. "auto" chooses by the
        error on held-out groups: nothing, backlash, friction, or creep, alone or after one of them.
        Each run of the log starts without hysteresis, see `fit`. A `Hysteresis` is taken as it is.
        Trackers send commands that lead by it. Default: none, rows in any order.
    coverage : float, optional
        Share of tips, 0.9 for example, within the radius of ``predict(Q, return_radius=True)``, if
        new groups are like those of the log. It needs ``coverage / (1 - coverage)`` groups, 9 for
        0.9, and five more fits, each with a fifth of them held out. Default: no radius.
    output : {"position", "pose"}, default="position"
        What y holds. "pose": rows of tip position [m] and rotation vector [rad] of the tip frame
        in the measuring frame. The errors of both are learned as six numbers [m]: one radian counts
        as the reach of the chain, p = p_mech + eps_p and R = exp(eps_r / reach) R_mech. It needs a
        ``PoseModel``, a regressor, parallel coupling and no `coverage`. Positions calibrate it.
    random_state : int, RandomState or None, default=None
        Seed of the named error models, and of an ELM without one; other regressors have their own.

    Attributes
    ----------
    module_ : nn.Module
        q -> x in torch, with ``jacobian``, ``forward_and_jacobian`` and ``in_domain``. For poses:
        q -> tip position, also with ``pose``, ``pose_jacobian`` and ``tip_transform``.
    mechanical_model_ : ForwardModel or None
        The mechanical model, calibrated if asked, without errors of its structure; `adapt` moves
        its base and its actuator zeros.
    fitted_module_ : nn.Module
        `module_` of the fit, without what `adapt` and `partial_fit` have learned since.
    change_ : Change
        What `adapt` has found: the ``shift`` of the actuator zeros (n,) [unit of q], and the
        ``motion`` of the base (4, 4); zero and the identity after a fit.
    error_model_ : estimator, ReadoutFit, StructureFit, FittedBlend, tuple or None
        The fitted error model; a tuple has one for each marker. A regressor that sees scaled
        residuals is the ``regressor_`` of a ``TransformedTargetRegressor``, which predicts [m], as
        does its ``module_``. A blend has ``weights`` and ``error_models``. With serial coupling or
        named features it holds the chosen ``alphas`` and the ``residual`` of every row from a fit
        without that row or its group [m]. A model from a file has none.
    cv_results_ : dict or None
        For error_model="auto". By candidate, of which the first has no further correction
        ("structural" with errors of the structure, else "mechanical") and the last is the blend:
        the mean distance on held-out rows and its standard deviation over the folds [m], and
        ``io_distance``, the mean distance on the outer 35 % of the rows after a fit to the inner
        40 % [m]. ``weights`` of the blend; ``chosen``: "blend", or the only candidate with a
        weight. ``parameters``: the set that was calibrated; ``mechanical_model``: the same two
        errors of every set without corrections, "cv" and "io", without backlash [m];
        ``corrected``: these errors with quick corrections, of the sets that were compared with
        them, also on errors of the structure [m]. On each fold the blend has weights chosen
        without that fold. ``expected_distance``: the mean distance to expect on new motions like
        those of the log [m]. With few groups or rows, the penalties are for this chosen without
        each of three folds.
    candidates_ : dict of str to nn.Module, or None
        For error_model="auto": every candidate of ``cv_results_``, fitted to all rows; a module
        from q to x as ``module_``, with `hysteresis` from the motion of the actuators. `adapt` and
        `partial_fit` do not change them. A model from a file has none.
    calibration_ : CalibrationResult or None
        The result of the calibration.
    hysteresis_ : Hysteresis
        The hysteresis; empty and falsy if there is none, or if "auto" found no significant gain.
    radius_ : Radius or None
        With `coverage`: the radius ``inside`` the domain [m], infinite with too few groups.
        `adapt` and `partial_fit` do not change it.
    description_ : ModelDescription
        Robot, log and file of the model; of one from `open_model`, what these say. `fit` makes a
        new model, of which no file and no notes tell.
    training_range_ : TrainingRange
        ``low`` and ``high`` (n,), the least and the largest q of the fit [unit of q]; with
        `hysteresis` of the motion of the actuators. `adapt` moves it with the actuator zeros.
    n_features_in_ : int
        Number of actuators n.
    feature_names_in_ : ndarray of shape (n,)
        Column names, when fitted on a data frame.

    References
    ----------
    Reinhart & Steil (2016), section 3, eqs. (2) and (3).

    Examples
    --------
    >>> from hybridkin import HybridForwardModel, datasets, robots
    >>> data = datasets.load_trunk()
    >>> model = HybridForwardModel(robots.bionic_handling_assistant(), calibrate="default")
    >>> model.fit(data.q, data.x).predict(data.q[:2]).shape
    (2, 3)
    """

    _parameter_constraints = CONSTRAINTS
    feature_names_in_: NDArray
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

    def __init__(
        self,
        mechanical_model: nn.Module | None = None,
        error_model: object = None,
        *,
        coupling: str = "parallel",
        calibrate: Iterable[str] | str | None = None,
        guard: str | None = "leverage",
        hysteresis: ArrayLike | Hysteresis | str = 0.0,
        coverage: float | None = None,
        output: str = "position",
        random_state: int | np.random.RandomState | None = None,
    ) -> None:
        self.mechanical_model = mechanical_model
        self.error_model = error_model
        self.coupling = coupling
        self.calibrate = calibrate
        self.guard = guard
        self.hysteresis = hysteresis
        self.coverage = coverage
        self.output = output
        self.random_state = random_state

    def set_params(self, **params: Any) -> HybridForwardModel:
        """Set parameters; ``error_model__*`` reach the default ELM as well, also by its name."""
        nested = [name for name in params if name.startswith("error_model__")]
        if nested:
            error_model = params.get("error_model", self.error_model)
            params["error_model"] = _estimator_with(nested[0], error_model)
        return super().set_params(**params)

    def fit(
        self,
        X: object,
        y: object,
        sample_weight: ArrayLike | None = None,
        groups: ArrayLike | None = None,
    ) -> HybridForwardModel:
        """Calibrate the mechanical model if asked, learn its residual, and return this estimator.

        Parameters
        ----------
        X : array-like of shape (N, n) or Commands
            Actuator vectors q [m]; for revolute joints [rad]. `Commands` have runs and times: with
            `hysteresis`, hysteresis goes on within a run, also from group to group.
        y : array-like of shape (N, m) or (N,)
            Measured tip positions x [m]; poses (N, 6); K markers (N, 3 K), NaN if missing.
        sample_weight : array-like of shape (N,), optional
            How many times each row counts: a weight of 2 is the same row twice, 0 leaves it out,
            whatever y holds there, also NaN. With `hysteresis`, rows of weight 0
            still move actuators. Equal rows are held out together.
        groups : array-like of shape (N,), optional
            Motion of every row. Whole motions are held out by the calibration
            (``calibration_.cv_rmse``), by error models that choose by groups, and for the radius.
            Rows farther from the log than its groups are from each other are not `in_domain`.

        Returns
        -------
        HybridForwardModel
            This estimator, fitted.

        Raises
        ------
        ValueError
            For settings that are not allowed, shapes that do not fit the mechanical model, data
            that are not finite or that a scaler has made unitless, fewer than two different rows
            to learn from (three with `coverage`), and creep without times.

        Warns
        -----
        UserWarning
            If there are fewer different rows than 20, or than twice the coefficients of an affine
            function of q; if tendons of a ConstantCurvatureChain contradict each other, as slack
            tendons do (`predict` and the Jacobians warn too); if no row moves along directions of X
            that move the tip, in which corrections are then constant; if numbers look like
            another unit; if there are too few groups for `coverage`; and the warnings of
            `calibrate`.
            If a regressor makes the mechanical model worse: on the training rows, or else on a
            fifth of the groups, runs or rows, held out, which takes one more fit of the regressor
            to the others (none for an ELMRegressorCV, or an ELMRegressor without groups, which know
            their held-out errors; and none below 20 rows). The mean square must exceed that of the
            mechanical model by more than the standard error of the latter over rows, or groups.
        """
        fit = fit_to_log(*self.prepared(X, y, sample_weight, groups))
        for message in fit.messages:
            warnings.warn(message, stacklevel=2)
        self.take_fit(fit)
        return self

    def partial_fit(
        self,
        X: object,
        y: object,
        sample_weight: ArrayLike | None = None,
        *,
        decay: float = 0.98,
        alpha: float | None = None,
    ) -> HybridForwardModel:
        """Update the model with new measurements in order of time, after a payload or wear.

        Hysteresis goes on from the last call; a new run of `Commands` starts anew.

        The mechanical model and the error model do not change. The new residual is learned as an
        affine function of q in which old measurements fade: ``f_hyb(q) + B [1, q]``. This follows
        one motion. If the base or the actuator zeros have changed since the fit, use `adapt`.

        Parameters
        ----------
        X : array-like of shape (N, n) or Commands
            Actuator vectors; a single row is allowed.
        y : array-like of shape (N, m) or (N,)
            Measured tips [m].
        sample_weight : array-like of shape (N,), optional
            How many times each row counts: a weight of 2 is the same row twice, 0 leaves it out,
            whatever y holds there. With `hysteresis`, rows of weight 0 still move the actuators.
        decay : float, default=0.98
            Factor in (0, 1] by which every new row multiplies the weights of all earlier rows. 0.98
            forgets within about fifty measurements.
        alpha : float, optional
            Penalty on B, in measurements; with a small one B follows single measurements. Default:
            the one of largest evidence, given the held-out errors of the fit; B stays zero unless
            the evidence for a change is clear.

        Returns
        -------
        HybridForwardModel
            This estimator. If it was not fitted, `fit` fits it.
        """
        if not hasattr(self, "module_"):
            return self.fit(X, y, sample_weight)
        _check_positive("decay", decay, 1.0)
        if alpha is not None:
            _check_positive("alpha", alpha, np.inf)
        rows = self._checked_rows(X, y, sample_weight, reset=False)
        self._check_commands(rows)
        if self.hysteresis_:
            moved, self._past = continued(self.hysteresis_, rows, self._past)
            rows = replace(rows, X=moved)
        self._warn_of_units(rows)
        rows = self.change_.before(rows, self.output)
        fitted = self.fitted_module_
        with torch.no_grad():
            error = residuals(fitted.mechanical, rows.q, rows.y, self.output)
            learned = fitted.error_part(rows.q).numpy()
        residual = error.reshape(rows.tips.shape) - learned
        drift = self._drift.learned(rows.q.numpy(), residual, rows.counts, decay)
        if alpha is None:
            alpha = drift.likeliest_alpha(self._fit.error.noise)
        self._drift = drift._replace(alpha=float(alpha))
        self._follow_robot()
        return self

    def adapt(
        self,
        X: object,
        y: object,
        *,
        parameters: Sequence[str] = PARAMETERS,
        groups: ArrayLike | None = None,
    ) -> HybridForwardModel:
        """Adapt the model to a robot that has changed since the fit, from a few new rows.

        On another day the base may have moved and the actuator zeros may have shifted. Five rows
        spread over the workspace identify both: ``x = T f_hyb(q + shift)``, with a rigid motion T.
        The learned residual is kept. The model does not change (`change_` is then an identity and
        zeros) if the robot has not changed, or by less than the new rows can show: few rows do not
        show a motion of the base that is smaller than the held-out error of the fit.

        The change always counts from the fit: `adapt` replaces an earlier `adapt` and all that
        `partial_fit` has learned. A payload or softer segments are another kind of change; record
        a new log for these.

        Parameters
        ----------
        X : array-like of shape (k, n) or Commands
            New actuator vectors, one or more; with `hysteresis` in order of time, as for `fit`.
        y : array-like of shape (k, m) or (k,)
            Measured tips [m]; poses (k, 6), see `output`.
        parameters : sequence of str, default=("base", "actuator_zeros")
            What may have changed.
        groups : array-like of shape (k,), optional
            Motion of every row. Rows of one motion have similar errors and count as fewer rows.

        Returns
        -------
        HybridForwardModel
            This estimator. `mechanical_model_` changes as well; `calibration_` and `radius_` stay
            those of the fit.

        Raises
        ------
        ValueError
            If X or y has another unit than the fit: X by its size, y by how far the tips of several
            postures lie apart. For other `parameters`, and for "base" if the outputs are neither
            tips in space nor poses.

        Warns
        -----
        UserWarning
            If the errors on the new rows stay far larger than the held-out errors of the fit.

        Examples
        --------
        >>> from hybridkin import HybridForwardModel, datasets, robots
        >>> data = datasets.load_trunk()
        >>> model = HybridForwardModel(robots.bionic_handling_assistant(), "linear")
        >>> model = model.fit(data.q[:200], data.x[:200])
        >>> today = data.q[200:205], data.x[200:205] + [0.05, 0.0, 0.0]  # the base has moved
        >>> bool(model.adapt(*today, parameters=["base"]).change_.motion[0, 3] > 0.04)
        True
        """
        check_is_fitted(self, "module_")
        rows = self._checked_rows(X, y, None, groups, reset=False, weighted=False)
        check_parameters(parameters, rows.tips.shape[1] % 3 == 0)
        if self.hysteresis_:
            rows = rows.effective(self.hysteresis_)
        self._check_commands(rows)
        with torch.no_grad():
            predicted = self.fitted_module_(rows.q).numpy()
        check_tips(rows.tips[:, : predicted.shape[1]], predicted, "y")
        measured = torch.from_numpy(rows.tips[:, : self._robot.n_outputs])
        for message in self._robot.far_messages(measured, "y"):  # wherever its base is
            warnings.warn(message, stacklevel=2)
        self.change_, messages = likeliest_change(
            self.fitted_module_,
            rows,
            self._fit.error.noise,
            self._drift.scale,
            parameters,
        )
        for message in messages:
            warnings.warn(message, stacklevel=2)
        self._drift = self._fit.no_drift
        self._past = NO_PAST
        self._follow_robot()
        return self

    def prepared(
        self,
        X: object,
        y: object,
        sample_weight: ArrayLike | None = None,
        groups: ArrayLike | None = None,
    ) -> tuple[Spec, Rows]:
        """Return the checked settings and the checked rows of a log, as for `fit`."""
        error_model = self._checked_error_model()
        log = self._checked_rows(X, y, sample_weight, groups)
        return self._spec(error_model, log), log

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

    def score(self, X: object, y: ArrayLike, sample_weight: ArrayLike | None = None) -> float:
        """Return R^2 of `predict`, averaged over the columns of y, without missing markers.

        Of rows of weight 0, y is ignored; with `hysteresis` they move the actuators.
        """
        x = self.predict(X)
        y = targets_that_count(y, sample_weight, "y")
        measured = np.asarray(y, dtype=float)
        if measured.size != x.size:
            raise ValueError(
                f"`y` must have shape {x.shape}, as what `predict` returns, got {measured.shape}."
            )
        measured = measured.reshape(len(x), -1)
        check_entries(~np.isinf(measured), "y")
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
        return self.hysteresis_.apply_by_group(rows, commands.run_of_rows, commands.time)

    def error_weight(self, X: object) -> NDArray:
        """Return the weight w(q) in [0, 1] of the error model at each row, shape (N,)."""
        weight = as_forward_model(self.fitted_module_.error_weight)
        return self._evaluated(lambda q: evaluate(weight, q + self.change_.shift), X, warn=False)[0]

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

    @property
    def _robot(self) -> ForwardModel:
        """The mechanical model; without one the module, which knows no robot either."""
        return self.module_ if self.mechanical_model_ is None else self.mechanical_model_

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
        """Return whether the log had the states inside of the hysteresis, and such a pace, (N,).

        Without states one True, of shape (), stands for all rows.
        """
        states_of_log = self._fit.state_range
        if not self.hysteresis_ or states_of_log is None:
            return np.ones((), dtype=bool)
        commands = Commands.of(X)
        rows = check_inputs(self, commands.q)
        low, high = states_of_log.shifted(-self.change_.shift)
        is_tested = np.ones(len(commands), dtype=bool)
        states = self.hysteresis_.each_inner_state(rows, commands.run_of_rows, commands.time)
        for k, state in enumerate(states):
            is_tested &= ((low[k] <= state) & (state <= high[k])).all(axis=1)
        if self._fit.pace is not None and commands.time is not None:
            paces = each_pace(
                rows,
                commands.run_of_rows,
                commands.time,
                self.hysteresis_.time_constants,
            )
            is_tested &= self._fit.pace.holds(paces, len(rows))
        return is_tested

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
        if self._drift:
            hybrid = hybrid.with_drift(self._drift.correction())
        self.module_ = self.change_.after(hybrid)
        if mechanical is not None:
            mechanical = self.change_.after(mechanical.without_errors)
        self.mechanical_model_ = mechanical
        self._plausible_rows = self._robot.plausible_rows()
        self._plain_rows = UnknownRows.of(self.n_features_in_)
        if not self.hysteresis_ and "feature_names_in_" not in vars(self):
            self._plain_rows = self._plausible_rows

    def _tips(self, q: NDArray, enough: float = 0.0, **results: bool) -> tuple[NDArray, ...]:
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

    @property
    def follows_order(self) -> bool:
        """Whether the order of the rows of a fit counts: there may be a `hysteresis`."""
        return bool(choice_of(self.hysteresis))

    def html_rows(self) -> dict[str, object]:
        """Return names and values of what the fit found, which a notebook shows."""
        return fitted_rows(self, self._fit)

    def _checked_error_model(self) -> ErrorModel:
        """Return the error model of the settings; raise if they are not allowed."""
        self._validate_params()
        mechanical = self.mechanical_model
        error_model = error_model_of(self.error_model, self.coupling, self.random_state)
        if self.output == "pose":
            self._check_pose_settings(error_model)
        inside = self.coupling == "serial" and error_model.learns
        if mechanical is None and (inside or error_model.needs_mechanical):
            raise ValueError(
                f"`mechanical_model` must be given with coupling={self.coupling!r} and "
                f"error_model={self.error_model!r}, which correct a mechanical model. "
                "To learn without one, give an estimator as `error_model`."
            )
        names = self.calibrate
        if names is None or isinstance(names, str):
            return error_model
        if [*names] and not _geometry(mechanical):
            raise TypeError(
                f"`mechanical_model` must be a chain to `calibrate` {self.calibrate!r}, got "
                f"{type(mechanical).__name__}, which has no geometry."
            )
        return error_model

    def _check_pose_settings(self, error_model: ErrorModel) -> None:
        mechanical = self.mechanical_model
        if mechanical is None or not as_forward_model(mechanical).has_pose:
            raise TypeError(
                "`mechanical_model` must be a PoseModel with pose_and_jacobian(q) for "
                f"output='pose'; all chains are. Got {type(self.mechanical_model).__name__}; for "
                "positions use output='position'."
            )
        inside = self.coupling == "serial" and error_model.learns
        if inside or not error_model.for_poses:
            raise ValueError(
                "`coupling` must be 'parallel' and `error_model` a regressor, None, 'elm', "
                f"'kernel' or 'drop' with output='pose', got {self.coupling!r} and "
                f"{self.error_model!r}; use ELMRegressorCV(), which chooses its penalties, or "
                "output='position'."
            )
        if self.coverage is not None:
            raise ValueError(
                f"`coverage` must be None with output='pose', got {self.coverage!r}: the radius "
                "is for tip positions. Fit a model with output='position' to y[:, :3]."
            )

    def _checked_rows(
        self,
        X: Any,
        y: Any,
        weights: ArrayLike | None,
        groups: Any = None,
        reset: bool = True,
        weighted: bool = True,
    ) -> Rows:
        """Return the measured rows, checked; `weighted`: whether the caller may give weights."""
        commands = Commands.of(X)
        X = commands.q
        y = table(targets_that_count(y, weights, "y"), "y")
        advice = LEAVE_OUT
        if weighted and self.follows_order:
            advice = WEIGH_ZERO
        missing = self._missing_markers(y, advice)
        y = None if y is None else np.where(missing, 0.0, y)
        check_finite(X=X)
        check_finite(advice, y=y)
        X, y, weights = check_rows(self, X, y, weights, reset)
        y = np.where(missing, np.nan, y)
        # Torch warns of columns of a data frame.
        if not X.flags.writeable:
            X = X.copy()
        rows = Rows.of(X, y, weights, groups, commands.runs, commands.time)
        if rows.timed and self.follows_order:
            times = checked_times(rows.time, rows.runs)
            if reset:  # a fit may find creep, which depends on the unit of time
                check_seconds(times, rows.runs)
        return rows

    def _missing_markers(self, y: Any, advice: str) -> NDArray[np.bool_]:
        """Return which entries of y (N, 3 K) are missing markers; each row must keep a marker."""
        mechanical = self.mechanical_model
        allowed = mechanical is None or as_forward_model(mechanical).markers
        if not allowed or self.output == "pose" or np.ndim(y) != 2 or y.shape[1] % 3:
            return np.zeros(np.shape(y), dtype=bool)
        return np.isnan(with_missing_markers(y, "y", advice))

    def _spec(self, error_model: ErrorModel, rows: Rows) -> Spec:
        """Return the settings as a specification, with a copy of the mechanical model."""
        mechanical = self.mechanical_model
        names = ()
        geometry = NOT_CHOSEN
        if mechanical is not None:
            mechanical = as_forward_model(copy.deepcopy(mechanical)).frozen()
            # A function does not tell how many, but its rows do.
            mechanical.n_actuators = mechanical.n_actuators or rows.X.shape[1]
            if mechanical.geometry():
                check_unscaled("X", rows.X, "actuator vectors [m or rad]")
                check_unscaled("y", rows.tips[rows.counts > 0.0], "tip positions [m]")
                mechanical.check_actuators(rows.q, "X")
                if isinstance(self.calibrate, GeometryChoice):
                    geometry = self.calibrate
                    names = geometry.parameters
                else:
                    names = self._names_to_calibrate(mechanical, error_model)
        return Spec(
            mechanical,
            error_model,
            names,
            self.guard,
            self.output,
            choice_of(self.hysteresis),
            self.coverage,
            geometry=geometry,
        )

    def _names_to_calibrate(
        self, mechanical: ForwardModel, error_model: ErrorModel
    ) -> tuple[str, ...] | str:
        """Return the parameters of a chain to calibrate, or "auto"."""
        names = self.calibrate
        if names is None:
            return "auto" if error_model.chooses else ()
        if names == "default":
            return mechanical.default_parameters
        return names if isinstance(names, str) else tuple(names)


def _geometry(mechanical: object) -> dict[str, Tensor]:
    """Return the geometry of a mechanical model; empty if there is none."""
    return {} if mechanical is None else as_forward_model(mechanical).geometry()


def _estimator_with(parameter: str, error_model: object) -> object:
    """Return the estimator of which a nested parameter, ``error_model__*``, is."""
    if error_model is None or error_model == "elm":
        return ELMRegressor()
    if isinstance(error_model, str):
        raise ValueError(
            f"`{parameter}` needs an estimator as `error_model`, got {error_model!r}, a name "
            "without parameters; set error_model=ELMRegressor(), for example, or leave it out."
        )
    return error_model


def _check_positive(name: str, value: object, high: float) -> None:
    if not 0.0 < number(value, name) <= high:
        raise ValueError(f"`{name}` must lie in (0, {high:g}], got {value!r}.")
