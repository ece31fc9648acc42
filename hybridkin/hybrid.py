"""A mechanical model plus a learned model of its error, trusted only where it was learned."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin, clone
from sklearn.utils.validation import (
    _check_sample_weight,
    check_is_fitted,
    has_fit_parameter,
    validate_data,
)
from torch import Tensor, nn

from hybridkin._auto import choose
from hybridkin._couplings import COUPLINGS, READOUTS, Readout, fit_coupled
from hybridkin._drift import Drift
from hybridkin._error_modules import error_module
from hybridkin._hybrid_modules import HybridModule
from hybridkin._pose_hybrid import PoseHybridModule, check_pose_settings, pose_errors
from hybridkin._radius import Radius, conformal_radius
from hybridkin._realtime import NumpyFunction
from hybridkin.calibration import CalibrationResult, calibrate
from hybridkin.elm import ELMRegressor
from hybridkin.elm_cv import ELMRegressorCV
from hybridkin.guards import GUARDS, fit_guard

__all__ = ["HybridForwardModel"]

_BLOCK = 65536
_HIDDEN_LAYERS = (ELMRegressor, ELMRegressorCV)
_NAMED = (str, Readout)


class HybridForwardModel(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Forward kinematics f_hyb(q) = f_mech(q) + eps(q), with eps learned on the model's errors.

    A scikit-learn regressor from actuator vectors to tip positions, or poses. The fitted `module_`
    is a torch module with a closed-form Jacobian, ready for `InverseKinematics`.

    Parameters
    ----------
    mechanical_model : nn.Module, optional
        Maps q (..., n) to x (..., m), a `ConstantCurvatureChain` for example. It is copied, never
        changed. None: there is no mechanical part, the data alone decide (f^dat of the paper).
    error_model : estimator, str or None, default=None
        Any scikit-learn regressor with as many outputs as x has; or by name "linear" or "quadratic"
        features of all actuators, or "pose", features of a chain's shape that loads act by, linear
        and other parts penalised apart by errors on rows, or groups, left out, down to no
        correction at all; "drop" is the mechanical model alone. None is
        ``ELMRegressor()``, with serial coupling "quadratic". "auto" tries these in
        both couplings, an `ELMRegressorCV` and, up to 2000 rows, kernel ridge, and takes what errs
        least on groups, or rows, left out. Let the groups be what will be new at work.
    coupling : {"parallel", "serial"}, default="parallel"
        Where the error acts. "parallel": at the tip, f_mech(q) + eps(q), eq. (2). "serial": inside
        the robot, f_mech(z(q) + delta(q)), with z the lengths and bendings of a chain's segments, q
        itself for other mechanical models; delta is linear in features of q, so a regressor must
        be an ELMRegressor (its hidden layer and `alpha` are used) or an ELMRegressorCV. It needs
        less data where what is missing in the model is simple inside.
    calibrate : sequence of str or "default", default=()
        Geometry of the mechanical model to fit first, see `hybridkin.calibrate`; it is refitted
        in every fold of a cross-validation. "default": the chain's own list.
    guard : {"leverage", "box", None}, default="leverage"
        Where eps is trusted. "leverage": where the inputs are as close to the training rows, in
        the error model's features, as these are to each other; "box": within the training range;
        None: everywhere. Beyond, eps fades out and f_mech remains. With a guard f_hyb is nowhere
        farther from f_mech than 1.5 times the longest correction of a training row.
    coverage : float, optional
        Share of tips, 0.9 for example, that shall lie within the radius of
        ``predict(Q, return_radius=True)``. It costs five more fits, each with a fifth of the
        groups held out. Default: no radius.
    output : {"position", "pose"}, default="position"
        What y holds. "pose": rows of tip position [m] and rotation vector [rad] of the tip's frame
        in the measuring frame. The errors of both are learned as six numbers [m], a radian as the
        reach of the chain, and set p = p_mech + eps_p and R = exp(eps_r / reach) R_mech. For chains
        and regressors, parallel, without `coverage`; a calibration looks at the positions.
    random_state : int, RandomState or None, default=None
        Seed of the default error model; one that is given brings its own.

    Attributes
    ----------
    module_ : nn.Module
        q -> x in torch, with ``jacobian``, ``forward_and_jacobian`` and ``in_domain``; of poses q
        -> tip position, with ``pose``, ``pose_jacobian`` and ``tip_transform`` as well.
    mechanical_model_ : nn.Module or None
        The mechanical part, calibrated when asked.
    error_model_ : estimator, SerialFit or None
        The fitted error model. Of serial coupling, "linear" and "quadratic" it tells the
        ``alphas`` chosen and the ``residual`` of every row from a fit without it or its group [m].
    cv_results_ : dict or None
        Of error_model="auto": by candidate the mean distance on rows left out, its spread over the
        folds [m] and the CPU time [s]; the smallest is ``chosen``. As a choice among several by
        these very rows it is a little optimistic, and new motions that resemble none in the log
        are harder than those left out.
    calibration_ : CalibrationResult or None
        What the calibration found.
    radius_ : Radius or None
        Where a coverage was asked for: the radii ``inside`` and ``outside`` the domain [m].
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

    n_features_in_: int
    feature_names_in_: NDArray

    def __init__(
        self,
        mechanical_model: nn.Module | None = None,
        error_model: Any = None,
        *,
        coupling: str = "parallel",
        calibrate: Sequence[str] | str = (),
        guard: str | None = "leverage",
        coverage: float | None = None,
        output: str = "position",
        random_state: int | np.random.RandomState | None = None,
    ) -> None:
        self.mechanical_model = mechanical_model
        self.error_model = error_model
        self.coupling = coupling
        self.calibrate = calibrate
        self.guard = guard
        self.coverage = coverage
        self.output = output
        self.random_state = random_state

    def set_params(self, **params: Any) -> HybridForwardModel:
        """Set parameters; ``error_model__*`` reach the default ELM as well."""
        nested = any(name.startswith("error_model__") for name in params)
        if nested and self.error_model is None and params.get("error_model") is None:
            self.error_model = ELMRegressor()
        return super().set_params(**params)

    def fit(
        self,
        X: Any,
        y: Any,
        sample_weight: ArrayLike | None = None,
        groups: ArrayLike | None = None,
    ) -> HybridForwardModel:
        """Calibrate the mechanical model when asked, and learn its error.

        Parameters
        ----------
        X : array-like of shape (N, n)
            Actuator vectors q [m], of revolute joints [rad].
        y : array-like of shape (N, m) or (N,)
            Measured tip positions x [m]; of poses (N, 6), see `output`.
        sample_weight : array-like of shape (N,), optional
            How many times each row counts.
        groups : array-like of shape (N,), optional
            Motion of every row: what is held out together, by the calibration
            (``calibration_.cv_rmse``), by error models that choose by groups, and for the radius.

        Returns
        -------
        HybridForwardModel
            This estimator, fitted.

        Raises
        ------
        ValueError
            For parameters out of their set, shapes that do not fit the mechanical model, and
            data that are not finite.

        Warns
        -----
        UserWarning
            Where tendons of a ConstantCurvatureChain contradict each other, as slack does; so do
            `predict` and the Jacobians.
        """
        self._check_settings()
        X, y = validate_data(self, X, y=y, multi_output=True, dtype=[np.float64, np.float32])
        y = np.asarray(y, dtype=np.float64)
        weights = None
        if sample_weight is not None:
            weights = _check_sample_weight(
                sample_weight, X, dtype=np.float64, ensure_non_negative=True
            )
        q = torch.from_numpy(X.astype(np.float64))
        mechanical: Any = copy.deepcopy(self.mechanical_model)
        if hasattr(mechanical, "check_actuators"):
            mechanical.check_actuators(q, "X")
        self.calibration_: CalibrationResult | None = None
        build = PoseHybridModule if self.output == "pose" else HybridModule
        names = self.calibrate
        if isinstance(names, str) and names == "default":
            names = getattr(mechanical, "default_parameters", ())
        if mechanical is not None and len(names):
            tips = y.reshape(len(y), -1)[:, :3] if self.output == "pose" else y
            self.calibration_ = calibrate(
                mechanical, q, torch.from_numpy(tips), names, groups=groups, sample_weight=weights
            )
            mechanical = self.calibration_.chain
        else:
            _warn_contradictory(mechanical, q)
        self.mechanical_model_ = mechanical
        error = self._errors(q, y)
        coupling, model = self.coupling, self.error_model
        if model is None:
            model = self._default_error_model()
        self.cv_results_ = None
        if isinstance(model, str) and model == "auto":
            coupling, model, self.cv_results_ = choose(self, mechanical, X, y, weights, groups)
        if isinstance(model, str) and model == "drop":
            self.error_model_, self.module_ = None, build(mechanical, None)
        elif mechanical is not None and (coupling == "serial" or isinstance(model, _NAMED)):
            tips = torch.from_numpy(y.reshape(len(y), -1))
            self.error_model_, self.module_ = fit_coupled(
                model, coupling, mechanical, q, tips, weights, groups, self.guard
            )
        else:
            self.error_model_ = _fit_regressor(clone(model), X, error, weights, groups)
            error_part = error_module(self.error_model_, q)
            kept = q if weights is None else q[torch.from_numpy(weights > 0)]
            guard = None  # without a mechanical model there is nothing to fall back on
            if mechanical is not None:
                guard = fit_guard(self.guard, error_part, kept)
            self.module_ = build(mechanical, error_part, guard)
        self._single_output = y.ndim == 1
        n_outputs = 1 if y.ndim == 1 else y.shape[1]
        self._drift = Drift.of_range(q.amin(0).numpy(), q.amax(0).numpy(), n_outputs)
        self.radius_: Radius | None = None
        if self.coverage is not None:
            self.radius_ = conformal_radius(self, X, y, weights, groups, self.coverage)
        return self

    def partial_fit(
        self,
        X: Any,
        y: Any,
        sample_weight: ArrayLike | None = None,
        *,
        decay: float = 0.98,
        alpha: float = 1.0,
    ) -> HybridForwardModel:
        """Follow a change of the robot, a payload or wear, by new measurements in order of time.

        Mechanical model and error model stay as they were fitted. What they now miss is learned as
        an affine function of q that old measurements leave again: ``f_hyb(q) + B [1, q]``.

        Parameters
        ----------
        X : array-like of shape (N, n)
            Actuator vectors, a single row too.
        y : array-like of shape (N, m) or (N,)
            Measured tips [m].
        sample_weight : array-like of shape (N,), optional
            How many times each row counts.
        decay : float, default=0.98
            Factor in (0, 1] on the weight of all earlier rows with every row: 0.98 forgets within
            some fifty measurements.
        alpha : float, default=1.0
            Penalty on B, in measurements: how soon a single one is believed.

        Returns
        -------
        HybridForwardModel
            This estimator; fitted by `fit`, if it was not yet.
        """
        if not hasattr(self, "module_"):
            return self.fit(X, y, sample_weight)
        if not hasattr(self, "_drift"):
            raise ValueError(
                "`partial_fit` needs the range of the fit, which this model was saved without by "
                "an earlier version; call `fit` first."
            )
        for name, value, high in (("decay", decay, 1.0), ("alpha", alpha, np.inf)):
            if not 0.0 < value <= high:
                raise ValueError(f"`{name}` must lie in (0, {high:g}], got {value!r}.")
        X, y = validate_data(
            self, X, y=y, multi_output=True, dtype=[np.float64, np.float32], reset=False
        )
        q, y = torch.from_numpy(X.astype(np.float64)), np.asarray(y, dtype=np.float64)
        weights = _check_sample_weight(sample_weight, X, dtype=np.float64, ensure_non_negative=True)
        module = copy.copy(self.module_)  # what was handed out before stays as it was
        module._modules = {**self.module_._modules, "drift": None}
        with torch.no_grad():
            error = self._errors(q, y).reshape(len(y), -1)
            residual = error - module.error_part(q).numpy()
        self._drift = self._drift.learned(q.numpy(), residual, weights, decay)
        module.drift = self._drift.correction(alpha)
        self.module_ = module
        return self

    def predict(self, X: Any, return_radius: bool = False) -> Any:
        """Return tip positions f_mech(q) + w(q) eps(q).

        Parameters
        ----------
        X : array-like of shape (N, n)
            Actuator vectors.
        return_radius : bool, default=False
            Whether to return how far off the tips may be as well; needs `coverage`.

        Returns
        -------
        x : ndarray of shape (N, m), or (N,) as in `fit`
            Tips [m]; of poses rotation vectors up to pi long, too [rad].
        radius : ndarray of shape (N,)
            Only if `return_radius`: a share `coverage` of the tips lies within [m], of motions like
            those of the fit; wider where the error model is not trusted.
        """
        if not return_radius:
            return self._by_blocks(lambda module, q: (module(q),), X)[0]
        check_is_fitted(self)
        if self.radius_ is None:
            raise ValueError(
                "`return_radius` needs a model that was fitted with `coverage`, for example "
                "HybridForwardModel(..., coverage=0.9)."
            )
        x, weight = self._by_blocks(lambda module, q: (module(q), module.error_weight(q)), X)
        return x, self.radius_.at(weight.astype(np.float64)).astype(x.dtype)

    def predict_mechanical(self, X: Any) -> NDArray:
        """Return the mechanical part f_mech(q), shaped like `predict` [m]."""
        return self._by_blocks(lambda module, q: (module.mechanical_part(q),), X)[0]

    def predict_error(self, X: Any) -> NDArray:
        """Return the learned part w(q) eps(q), shaped like `predict` [m], of turns [rad]."""
        return self._by_blocks(lambda module, q: (module.error_part(q),), X, mechanical=False)[0]

    def jacobian(self, X: Any) -> NDArray:
        """Return the full Jacobian dx/dq of the sum, shape (N, m, n) or, for 1-D y, (N, n).

        Of poses the last three rows give the angular velocity in the measuring frame.
        """
        return self._by_blocks(lambda module, q: (module.jacobian(q),), X)[0]

    def predict_and_jacobian(self, X: Any) -> tuple[NDArray, NDArray]:
        """Return `predict(X)` and `jacobian(X)` in one pass."""
        x, J = self._by_blocks(lambda module, q: module.forward_and_jacobian(q), X)
        return x, J

    def numpy_function(self) -> NumpyFunction:
        """Return a NumPy function of one configuration, for control loops.

        Returns
        -------
        function
            Maps q of shape (n,) to `predict` (m,) [m] and its Jacobian (m, n), in float64 and some
            ten times faster. It is not told by a later `fit`.
        """
        return self._rows().numpy_function()

    def in_domain(self, X: Any) -> NDArray[np.bool_]:
        """Return whether eps is fully trusted at each row, shape (N,)."""
        return self._by_blocks(lambda module, q: (module.in_domain(q),), X, mechanical=False)[0]

    def error_weight(self, X: Any) -> NDArray:
        """Return the weight w(q) in [0, 1] of the error model at each row, shape (N,)."""
        return self._by_blocks(lambda module, q: (module.error_weight(q),), X, mechanical=False)[0]

    def _errors(self, q: Tensor, y: NDArray) -> NDArray:
        """Return what the mechanical model lacks to y, in the rows that an error model learns."""
        mechanical = self.mechanical_model_
        if mechanical is None:
            return y
        if self.output == "pose":
            return pose_errors(mechanical, q, y)
        with torch.no_grad():
            tips = mechanical(q).numpy()
        if tips.shape != (y.shape if y.ndim == 2 else (len(y), 1)):
            raise ValueError(
                f"`y` must have {tips.shape[1]} columns, as many as `mechanical_model` gives, got "
                f"shape {y.shape}."
            )
        return y - tips.reshape(y.shape)

    def _rows(self) -> Any:
        """Return the fitted module whose outputs are the columns of y."""
        check_is_fitted(self)
        return getattr(self.module_, "rows", self.module_)

    def _by_blocks(
        self,
        function: Callable[[Any, Tensor], tuple[Tensor, ...]],
        X: Any,
        mechanical: bool = True,
    ) -> list[NDArray]:
        module = self._rows()
        X = validate_data(self, X, dtype=[np.float64, np.float32], reset=False)
        if mechanical:
            _warn_contradictory(self.mechanical_model_, torch.from_numpy(X.astype(np.float64)))
        blocks = []
        with torch.no_grad():
            for start in range(0, len(X), _BLOCK):
                q = torch.from_numpy(X[start : start + _BLOCK].astype(np.float64))
                blocks.append(function(module, q))
        results = []
        for parts in zip(*blocks, strict=True):
            array = torch.cat(parts).numpy()
            if array.dtype != bool:
                array = array.astype(X.dtype, copy=False)
            results.append(array[:, 0] if self._single_output and array.ndim > 1 else array)
        return results

    def _default_error_model(self) -> Any:
        if self.coupling == "serial":
            return "quadratic"
        return ELMRegressor(random_state=self.random_state)

    def _check_settings(self) -> None:
        if self.coupling not in COUPLINGS:
            raise ValueError(f"`coupling` must be one of {[*COUPLINGS]}, got {self.coupling!r}.")
        if self.coverage is not None and not 0.0 < self.coverage < 1.0:
            raise ValueError(f"`coverage` must lie in (0, 1) or be None, got {self.coverage!r}.")
        if self.output not in ("position", "pose"):
            raise ValueError(f"`output` must be 'position' or 'pose', got {self.output!r}.")
        if self.output == "pose":
            check_pose_settings(self)
        if self.guard not in GUARDS:
            raise ValueError(f"`guard` must be one of {GUARDS}, got {self.guard!r}.")
        named, names = isinstance(self.error_model, _NAMED), ("auto", "drop", *READOUTS)
        if isinstance(self.error_model, str) and self.error_model not in names:
            raise ValueError(
                f"`error_model` must be an estimator, None or one of {[*names]}, got "
                f"{self.error_model!r}."
            )
        serial = self.coupling == "serial" and self.error_model != "drop"
        if serial and not (
            named or self.error_model is None or isinstance(self.error_model, _HIDDEN_LAYERS)
        ):
            raise TypeError(
                f"`error_model` must give features that can act inside the robot with "
                f"coupling='serial': None, one of {[*READOUTS]}, an ELMRegressor or an "
                f"ELMRegressorCV, got {type(self.error_model).__name__}; use coupling='parallel'."
            )
        if self.mechanical_model is None:
            if named or serial:
                raise ValueError(
                    f"`mechanical_model` must be given with coupling={self.coupling!r} and "
                    f"error_model={self.error_model!r}: the error is that of a mechanical model. "
                    "For the data alone give an estimator as `error_model`."
                )
        elif not isinstance(self.mechanical_model, nn.Module):
            raise TypeError(
                "`mechanical_model` must be a torch module q -> x or None, got "
                f"{type(self.mechanical_model).__name__}; wrap a function in an nn.Module."
            )


def _fit_regressor(
    regressor: Any, X: Any, error: NDArray, weights: NDArray | None, groups: Any
) -> Any:
    given: dict[str, Any] = {} if weights is None else {"sample_weight": weights}
    if groups is not None and has_fit_parameter(regressor, "groups"):
        given["groups"] = groups
    return regressor.fit(X, error, **given)


def _warn_contradictory(mechanical: Any, q: Tensor) -> None:
    if hasattr(mechanical, "warn_contradictory"):
        mechanical.warn_contradictory(q, "X", stacklevel=5)
