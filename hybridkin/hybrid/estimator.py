"""A mechanical model plus a learned model of its error, trusted only where it was learned."""

from __future__ import annotations

import contextlib
import copy
import warnings
from collections.abc import Callable, Iterator, Sequence
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

from hybridkin._core.model import as_forward_model
from hybridkin._core.units import warn_span
from hybridkin.calibration.calibrate import CalibrationResult, calibrate
from hybridkin.chains.play import PlayState
from hybridkin.hybrid._couplings import blended, fit_coupled
from hybridkin.hybrid._drift import Drift
from hybridkin.hybrid._guards import fit_guard
from hybridkin.hybrid._module import HybridModule
from hybridkin.hybrid._play import play_of
from hybridkin.hybrid._pose import PoseHybridModule, pose_errors
from hybridkin.hybrid._radius import Radius, conformal_radius
from hybridkin.hybrid._selection import choose, choose_mechanics, rivals
from hybridkin.hybrid._settings import NAMED, check_settings
from hybridkin.ik._realtime import NumpyFunction
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.regressor_modules import error_module

__all__ = ["HybridForwardModel"]

_BLOCK = 65536


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
        both couplings, an `ELMRegressorCV` and, up to 2000 rows, kernel ridge, and takes the blend
        of them that errs least on groups, or rows, left out. Where tendons of a
        `ConstantCurvatureChain` contradict each other and its geometry is calibrated, it tries an
        `ElasticTendonChain` first. Let the groups be what will be new at work.
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
    play : float, array-like of shape (n,) or "auto", optional
        Play of the actuators, backlash and dry friction [unit of q]: rows are taken as commands in
        the order of time, and the model is one of what they do, see `PlayOperator`. "auto" takes
        the width with which an `ELMRegressorCV` errs least on motions left out, or none. Each group
        starts without a past; the inverse kinematics finds what the actuators are to do, and
        ``play_.command`` what to send for it. Default: no play, rows in any order.
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
    error_model_ : estimator, SerialFit, Blend or None
        The fitted error model; of a blend its ``weights`` and ``error_models``. Of serial
        coupling, "linear" and "quadratic" it tells the ``alphas`` chosen and the ``residual`` of
        every row from a fit without it or its group [m].
    cv_results_ : dict or None
        Of error_model="auto": by candidate, the last of which is the blend, the mean distance on
        rows left out, its spread over the folds [m] and the CPU time [s]; the ``weights`` of the
        blend, what is ``chosen`` ("blend", or the only one of weight), and how the mechanical
        models did, without play (``mechanical_model``). A blend is judged by weights that do not
        know the fold. New motions that resemble none in the log are harder than those left out.
    calibration_ : CalibrationResult or None
        What the calibration found.
    play_ : PlayOperator or None
        The play; None where there is none, and where "auto" found none worth its while.
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
        play: ArrayLike | str | None = None,
        coverage: float | None = None,
        output: str = "position",
        random_state: int | np.random.RandomState | None = None,
    ) -> None:
        self.mechanical_model = mechanical_model
        self.error_model = error_model
        self.coupling = coupling
        self.calibrate = calibrate
        self.guard = guard
        self.play = play
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
        check_settings(self)
        X, y = validate_data(self, X, y=y, multi_output=True, dtype=[np.float64, np.float32])
        X = X if X.flags.writeable else X.copy()  # torch warns of columns of a data frame
        y = np.asarray(y, dtype=np.float64)
        groups = None if groups is None else _checked_groups(groups, len(X))
        weights = None
        if sample_weight is not None:
            weights = _check_sample_weight(
                sample_weight, X, dtype=np.float64, ensure_non_negative=True
            )
        mechanical: Any = copy.deepcopy(self.mechanical_model)
        if mechanical is not None:
            mechanical = as_forward_model(mechanical)
        if hasattr(mechanical, "check_actuators"):
            for message in mechanical.check_actuators(torch.from_numpy(X), "X"):
                warnings.warn(message, stacklevel=2)
        names = self.calibrate
        if isinstance(names, str) and names == "default":
            names = getattr(mechanical, "default_parameters", ())
        names = () if mechanical is None else tuple(names)
        mechanics, counts = None, np.ones(len(X)) if weights is None else weights
        if isinstance(self.error_model, str) and self.error_model == "auto":
            with _silence():
                candidates = rivals(mechanical, names, X)
                mechanics = choose_mechanics(self, candidates, X, y, counts, groups)
            mechanical, names = copy.deepcopy(mechanics.model), mechanics.names
        self.play_ = play_of(self.play, mechanical, names, X, y, weights, groups)
        self._play_state: PlayState | None = None
        if self.play_ is not None:
            X = self._effective(X, groups)
            if mechanics is not None:
                with _silence():
                    again = choose_mechanics(self, [(mechanical, names)], X, y, counts, groups)
                mechanics = again._replace(scores=mechanics.scores)  # of all, without play
        q = torch.from_numpy(X.astype(np.float64))
        self.calibration_: CalibrationResult | None = None
        if len(names):
            tips = y.reshape(len(y), -1)[:, :3] if self.output == "pose" else y
            held_out = groups if mechanics is None else None  # else it has been done
            self.calibration_ = calibrate(
                mechanical, q, torch.from_numpy(tips), names, groups=held_out, sample_weight=weights
            )
            mechanical = self.calibration_.chain
        else:
            _warn_contradictory(mechanical, q)
            reach = getattr(mechanical, "reach", None)
            if reach is not None and y.ndim == 2:
                warn_span("y", torch.from_numpy(y[:, :3]), float(reach))
        self.mechanical_model_ = mechanical
        self.cv_results_ = None
        if mechanics is None:
            model = self._default_error_model() if self.error_model is None else self.error_model
            found = self._learned(self.coupling, model, X, y, weights, groups)
        else:
            with _silence():
                parts, self.cv_results_ = choose(self, mechanical, mechanics, X, y, counts, groups)
            fits = [self._learned(*part[1:], X, y, weights, groups) for part in parts]
            found = blended([part.weight for part in parts], fits)
        self.error_model_, self.module_ = found
        self._single_output = y.ndim == 1
        n_outputs = 1 if y.ndim == 1 else y.shape[1]
        self._drift = Drift.of_range(q.amin(0).numpy(), q.amax(0).numpy(), n_outputs)
        self.radius_: Radius | None = None
        if self.coverage is not None:
            with _silence():
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
        if self.play_ is not None:
            X, self._play_state = self.play_.apply(X, self._play_state)
        q, y = torch.from_numpy(X.astype(np.float64)), np.asarray(y, dtype=np.float64)
        weights = _check_sample_weight(sample_weight, X, dtype=np.float64, ensure_non_negative=True)
        with torch.no_grad():
            error = self._errors(q, y).reshape(len(y), -1)
            residual = error - self.module_.with_drift(None).error_part(q).numpy()
        self._drift = self._drift.learned(q.numpy(), residual, weights, decay)
        # What was handed out before stays as it was.
        self.module_ = self.module_.with_drift(self._drift.correction(alpha))
        return self

    def predict(self, X: Any, return_radius: bool = False, groups: ArrayLike | None = None) -> Any:
        """Return tip positions f_mech(q) + w(q) eps(q).

        Parameters
        ----------
        X : array-like of shape (N, n)
            Actuator vectors; with `play` those of a motion in the order of time.
        return_radius : bool, default=False
            Whether to return how far off the tips may be as well; needs `coverage`.
        groups : array-like of shape (N,), optional
            Motion of every row, which matters with `play` alone. Default: one motion.

        Returns
        -------
        x : ndarray of shape (N, m), or (N,) as in `fit`
            Tips [m]; of poses rotation vectors up to pi long, too [rad].
        radius : ndarray of shape (N,)
            Only if `return_radius`: a share `coverage` of the tips lies within [m], of motions like
            those of the fit; wider where the error model is not trusted.
        """
        if not return_radius:
            return self._by_blocks(lambda module, q: (module(q),), X, groups)[0]
        check_is_fitted(self)
        if self.radius_ is None:
            raise ValueError(
                "`return_radius` needs a model that was fitted with `coverage`, for example "
                "HybridForwardModel(..., coverage=0.9)."
            )
        both = self._by_blocks(lambda module, q: (module(q), module.error_weight(q)), X, groups)
        x, weight = both
        return x, self.radius_.at(weight.astype(np.float64)).astype(x.dtype)

    def predict_mechanical(self, X: Any, groups: ArrayLike | None = None) -> NDArray:
        """Return the mechanical part f_mech(q), shaped like `predict` [m]."""
        return self._by_blocks(lambda module, q: (module.mechanical_part(q),), X, groups)[0]

    def predict_error(self, X: Any, groups: ArrayLike | None = None) -> NDArray:
        """Return the learned part w(q) eps(q), shaped like `predict` [m], of turns [rad]."""
        return self._by_blocks(
            lambda module, q: (module.error_part(q),), X, groups, mechanical=False
        )[0]

    def jacobian(self, X: Any, groups: ArrayLike | None = None) -> NDArray:
        """Return the full Jacobian dx/dq of the sum, shape (N, m, n) or, for 1-D y, (N, n).

        Of poses the last three rows give the angular velocity in the measuring frame.
        """
        return self._by_blocks(lambda module, q: (module.jacobian(q),), X, groups)[0]

    def predict_and_jacobian(
        self, X: Any, groups: ArrayLike | None = None
    ) -> tuple[NDArray, NDArray]:
        """Return `predict(X)` and `jacobian(X)` in one pass."""
        x, J = self._by_blocks(lambda module, q: module.forward_and_jacobian(q), X, groups)
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

    def in_domain(self, X: Any, groups: ArrayLike | None = None) -> NDArray[np.bool_]:
        """Return whether eps is fully trusted at each row, shape (N,)."""
        return self._by_blocks(
            lambda module, q: (module.in_domain(q),), X, groups, mechanical=False
        )[0]

    def error_weight(self, X: Any, groups: ArrayLike | None = None) -> NDArray:
        """Return the weight w(q) in [0, 1] of the error model at each row, shape (N,)."""
        return self._by_blocks(
            lambda module, q: (module.error_weight(q),), X, groups, mechanical=False
        )[0]

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
        groups: Any,
        mechanical: bool = True,
    ) -> list[NDArray]:
        module = self._rows()
        X = validate_data(self, X, dtype=[np.float64, np.float32], reset=False)
        X = self._effective(X, groups)
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

    def _learned(
        self, coupling: str, model: Any, X: NDArray, y: NDArray, weights: Any, groups: Any
    ) -> tuple[Any, Any]:
        """Return the error model fitted to what the mechanical model lacks, and the hybrid."""
        q, mechanical = torch.from_numpy(X.astype(np.float64)), self.mechanical_model_
        build = PoseHybridModule if self.output == "pose" else HybridModule
        error = self._errors(q, y)
        if isinstance(model, str) and model == "drop":
            return None, build(mechanical, None)
        if mechanical is not None and (coupling == "serial" or isinstance(model, NAMED)):
            tips = torch.from_numpy(y.reshape(len(y), -1))
            return fit_coupled(model, coupling, mechanical, q, tips, weights, groups, self.guard)
        fitted = _fit_regressor(clone(model), X, error, weights, groups)
        error_part = error_module(fitted, q)
        kept = q if weights is None else q[torch.from_numpy(weights > 0)]
        guard = None  # without a mechanical model there is nothing to fall back on
        if mechanical is not None:
            guard = fit_guard(self.guard, error_part, kept)
        return fitted, build(mechanical, error_part, guard)

    def _effective(self, X: NDArray, groups: Any) -> NDArray:
        """Return what the actuators do, where there is play."""
        if self.play_ is None or not len(X):
            return X
        return self.play_.apply_by_group(X, np.zeros(len(X)) if groups is None else groups)

    def _default_error_model(self) -> Any:
        if self.coupling == "serial":
            return "quadratic"
        return ELMRegressor(random_state=self.random_state)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Leave unsaid of parts of the data what is said of all of them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def _checked_groups(groups: ArrayLike, n: int) -> NDArray:
    groups = np.asarray(groups)
    if groups.shape != (n,):
        raise ValueError(
            f"`groups` must have shape ({n},), one entry for each row of `X`, got {groups.shape}."
        )
    return groups


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
