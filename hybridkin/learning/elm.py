"""Extreme learning machine: a random hidden layer with a ridge readout."""

import warnings
from functools import partial
from numbers import Integral, Real

import numpy as np
import torch
from scipy import linalg
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin, _fit_context
from sklearn.utils._param_validation import Interval, StrOptions
from sklearn.utils.validation import check_is_fitted

from hybridkin._core.arrays import copied, real_array
from hybridkin._core.blocks import in_blocks_of, rows_at_once
from hybridkin._core.distinct import targets_that_count
from hybridkin._core.estimators import estimator_of, params_of, restore_columns
from hybridkin._core.stored import Stored
from hybridkin.learning._ridge import (
    BLOCK_ELEMENTS,
    Statistics,
    fit_readout,
    gather,
    merge,
)
from hybridkin.learning.hidden_layer import (
    check_inputs,
    check_rows,
    device_named,
    draw_layer,
)
from hybridkin.learning.network import ACTIVATIONS, ELM, LAYER, READOUT
from hybridkin.native.library import program_of


class FittedNetwork(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Predictions of a fitted network, their Jacobian, standard deviation and leverage."""

    module_: ELM
    noise_variance_: np.ndarray
    block_size: int | None
    _y_ndim: int

    def predict(self, X, return_std=False):
        """Return the prediction for `X`, in the dtype of `X`.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_inputs)
            Inputs.
        return_std : bool, default=False
            Whether to also return the standard deviation of a new measurement.

        Returns
        -------
        y : ndarray of shape (n_samples,) or (n_samples, n_outputs)
            Predictions, one-dimensional if the targets were.
        std : ndarray of the shape of y
            Only if `return_std`: ``sqrt(noise_variance_ * (1 + leverage(X)))``, the posterior
            predictive of the Bayesian ridge with prior ``N(0, noise_variance_ / alpha)``.
        """
        y = self._evaluated(X)[0]
        if not return_std:
            return y
        std = np.sqrt(np.multiply.outer(1 + self.leverage(X), self.noise_variance_))
        return y, std.reshape(y.shape).astype(y.dtype)

    def score(self, X, y, sample_weight=None):
        """Return R^2 of `predict`; of rows of weight 0, `y` is ignored."""
        y = targets_that_count(y, sample_weight, "y")
        return super().score(X, y, sample_weight)

    def jacobian(self, X):
        """Return the derivative of the prediction with respect to the inputs, in closed form.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_inputs)
            Inputs.

        Returns
        -------
        J : ndarray of shape (n_samples, n_inputs) or (n_samples, n_outputs, n_inputs)
            Jacobians [unit of y per unit of X]; gradients if the targets were one-dimensional.
        """
        return self._evaluated(X, jacobian=True)[1]

    def predict_and_jacobian(self, X):
        """Return ``predict(X), jacobian(X)`` from one evaluation of the hidden layer.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_inputs)
            Inputs.

        Returns
        -------
        y, J : ndarray of their shapes
            The results of `predict` and `jacobian`.
        """
        return self._evaluated(X, jacobian=True)

    def leverage(self, X):
        """Return ``phi' (G + alpha 1)^-1 phi``, at most 1 on the training rows.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_inputs)
            Inputs.

        Returns
        -------
        leverage : ndarray of shape (n_samples,)
            Influence of a training row of weight 1 at `X` on its own prediction [-]. With an
            intercept the features are centred, and 1 / n is added.
        """
        return self._map(X, lambda elm, q: (elm.leverage(q)[:, None],))[0].ravel()

    def _evaluated(self, X, jacobian=False):
        """Return the prediction and, if `jacobian`, its derivative."""
        check_is_fitted(self, "module_")
        program = program_of(self.module_)
        if program is not None:
            X = check_inputs(self, X)
            return self._shaped(X, program.evaluate(X, jacobian))
        if jacobian:
            return self._map(X, ELM.forward_and_jacobian)
        return self._map(X, lambda elm, q: (elm(q),))

    def _map(self, X, function):
        """Return the arrays of `function(module, q)`, computed in blocks of rows."""
        check_is_fitted(self, "module_")
        X = check_inputs(self, X)
        elm = self.module_
        size = BLOCK_ELEMENTS // max(elm.output_weights.shape[0], len(elm.input_bias))
        with torch.no_grad():
            q = copied(X, elm.input_center.device, np.float64)
            block_size = self.block_size or rows_at_once(max(1, size), q.device)
            parts = in_blocks_of(int(block_size), partial(function, elm), q)
        return self._shaped(X, [part.cpu().numpy() for part in parts])

    def _shaped(self, X, arrays):
        """Return arrays in the dtype of X; for a one-dimensional y without the output axis."""
        with np.errstate(over="ignore"):  # overflow of float32
            outputs = [array.astype(X.dtype, copy=False) for array in arrays]
        if self._y_ndim == 1:
            outputs = [array[:, 0] if array.ndim > 1 else array for array in outputs]
        return tuple(outputs)


class ELMRegressor(FittedNetwork):
    """Extreme learning machine of the paper; for other work than its results use `ELMRegressorCV`.

    A fixed random hidden layer with a readout by ridge regression:
    ``f(x) = W_out sigma(W u + b)`` with the inputs u mapped to [-1, 1], random W and b, and
    ``W_out = (H' H + alpha 1)^-1 H' T`` (eq. 3 of [1]_). The defaults are those of [1]_: 100
    neurons and a fixed penalty of 0.1. `ELMRegressorCV` chooses both from the data.

    The state is the mean of features and targets and the scatter about it, always in float64. Rows
    can be added (`partial_fit`) and two models can be merged (`merge`), exactly.

    Parameters
    ----------
    n_hidden : int, default=100
        Number of hidden neurons H.
    alpha : float or array-like of shape (n_outputs,), default=0.1
        Weight of the penalty on the readout (lambda of [1]_), for all outputs or for each. With 0,
        a singular system gives the readout of minimum norm.
    activation : {"logistic", "tanh", "sin"}, default="logistic"
        Activation function sigma.
    input_scaling : {"minmax", "standard"}, None or array of shape (2, n_inputs), default="minmax"
        Affine map of the inputs: the training range to [-1, 1], the training mean and standard
        deviation to 0 and 1, none, or the given bounds [low, high] [unit of X] to [-1, 1]. The
        first call of `partial_fit` fixes it, so give bounds for streamed data or to merge models.
    weight_scale : float, default=1.0
        W and b are uniform in [-weight_scale, weight_scale].
    fit_intercept : bool, default=False
        Whether to fit an output bias, which is not penalised.
    direct_link : bool, default=False
        Whether the scaled inputs are additional features, after the hidden neurons.
    block_size : int, default=None
        Rows computed at a time; None means about 4 MB of features, on a GPU 128 MB.
    device : str or torch.device, default=None
        Where to compute; None means the CPU. A model is unpickled to the CPU if it is missing.
    random_state : int, RandomState instance or None, default=None
        Seed of W and b. Models to be merged need the same int.

    Attributes
    ----------
    input_weights_, input_bias_ : ndarray of shape (n_hidden, n_inputs) and (n_hidden,)
        Hidden layer W and b.
    input_center_, input_scale_ : ndarray of shape (n_inputs,)
        ``u = (x - input_center_) / input_scale_`` [unit of X].
    output_weights_, intercept_ : ndarray of shape (n_features, n_outputs) and (n_outputs,)
        Readout [unit of y]; `n_features` is `n_hidden`, plus `n_inputs` with a direct link.
    leverage_center_, leverage_factor_, leverage_offset_ : ndarray of the shapes in `module_`
        As in `module_`; for the smallest `alpha` if each output has its own.
    noise_variance_ : ndarray of shape (n_outputs,)
        Residual sum of squares over ``n - tr(G (G + alpha 1)^-1) - fit_intercept`` [unit of y^2],
        with the features' Gram matrix G and the sum n of the sample weights. NaN if that is 0.
    n_samples_seen_ : float
        Sum of the sample weights so far.
    solver_ : {"cholesky", "eigh"}
        Solver of the readout: "eigh" if the system was singular.
    module_ : nn.Module
        The fitted network as a torch module q -> eps.
    n_features_in_ : int
        Number of inputs.
    feature_names_in_ : ndarray of shape (n_inputs,)
        Names of the columns, if `X` had any.

    References
    ----------
    .. [1] Reinhart, R. F., & Steil, J. J. (2016). Hybrid mechanical and data-driven modeling
       improves inverse kinematic control of a soft robot. Procedia Technology, 26.
    .. [2] Huang, G.-B., Zhu, Q.-Y., & Siew, C.-K. (2006). Extreme learning machine: theory and
       applications. Neurocomputing, 70, 489-501.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import ELMRegressor
    >>> q = np.random.default_rng(0).uniform(0.1, 0.3, (500, 3))
    >>> error = 0.01 * np.sin(20 * q[:, :2])
    >>> elm = ELMRegressor(alpha=1e-6, random_state=0).fit(q, error)
    >>> round(elm.score(q, error), 2)
    1.0
    >>> elm.jacobian(q).shape
    (500, 2, 3)
    """

    _parameter_constraints = {  # noqa: RUF012
        "n_hidden": [Interval(Integral, 1, None, closed="left")],
        "alpha": [Interval(Real, 0, None, closed="left"), "array-like"],
        "activation": [StrOptions(set(ACTIVATIONS))],
        "input_scaling": [StrOptions({"minmax", "standard"}), None, "array-like"],
        "weight_scale": [Interval(Real, 0, None, closed="neither")],
        "fit_intercept": ["boolean"],
        "direct_link": ["boolean"],
        "block_size": [Interval(Integral, 1, None, closed="left"), None],
        "device": [str, torch.device, None],
        "random_state": ["random_state"],
    }

    def __init__(
        self,
        n_hidden=100,
        alpha=0.1,
        *,
        activation="logistic",
        input_scaling="minmax",
        weight_scale=1.0,
        fit_intercept=False,
        direct_link=False,
        block_size=None,
        device=None,
        random_state=None,
    ):
        self.n_hidden = n_hidden
        self.alpha = alpha
        self.activation = activation
        self.input_scaling = input_scaling
        self.weight_scale = weight_scale
        self.fit_intercept = fit_intercept
        self.direct_link = direct_link
        self.block_size = block_size
        self.device = device
        self.random_state = random_state

    @_fit_context(prefer_skip_nested_validation=True)
    def fit(self, X, y, sample_weight=None):
        """Draw the hidden layer, fit the readout without earlier rows, and return self.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_inputs)
            Inputs.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Targets.
        sample_weight : array-like of shape (n_samples,), default=None
            How often each row counts: 2 is the same as the row twice, 0 drops it.

        Returns
        -------
        self : ELMRegressor
            The fitted estimator.
        """
        return self._learn(X, y, sample_weight, first=True)._warned()

    @_fit_context(prefer_skip_nested_validation=True)
    def partial_fit(self, X, y, sample_weight=None, decay=1.0):
        """Add rows and return self; the result equals one `fit` to all rows so far.

        The first call draws the hidden layer and fixes the input scaling; later calls keep them.

        Parameters
        ----------
        X, y, sample_weight : array-like of the shapes as for `fit`
            The new rows, as for `fit`.
        decay : float, default=1.0
            Factor in (0, 1] on the weights of all earlier rows, to follow drift.

        Returns
        -------
        self : ELMRegressor
            The fitted estimator.
        """
        if not isinstance(decay, Real) or not 0.0 < decay <= 1.0:
            raise ValueError(
                f"`decay` must lie in (0, 1], got {decay!r}; 1 keeps the weight of earlier rows, "
                f"0.99 reduces it by 1 %."
            )
        first = "module_" not in vars(self)
        return self._learn(X, y, sample_weight, first, decay)._warned()

    def merge(self, other):
        """Add the training rows of `other` and return self; equals one `fit` to all rows.

        Parameters
        ----------
        other : ELMRegressor
            A model with the same hidden layer and input scaling; it is not changed.

        Returns
        -------
        self : ELMRegressor
            The fitted estimator.
        """
        if not isinstance(other, ELMRegressor):
            raise TypeError(f"`other` must be a fitted ELMRegressor, got {type(other).__name__}.")
        check_is_fitted(self, "module_")
        check_is_fitted(other, "module_")
        for name in (*(f"{name}_" for name in LAYER), "feature_names_in_"):
            ours = vars(self).get(name, ())
            if not np.array_equal(ours, vars(other).get(name, ())):
                self._refuse(name.rstrip("_"))
        if self.module_.activation != other.module_.activation:
            self._refuse("activation")
        shape = self.module_.output_weights.shape
        if shape != other.module_.output_weights.shape:
            self._refuse("shape of output_weights_ (`direct_link`, columns of `y`)")
        return self._solve(merge(self._stats, other._stats), self.module_)._warned()

    def _refuse(self, what):
        raise ValueError(
            f"`other` must have this model's hidden layer, input scaling and columns, but its "
            f"{what} differs; give both models the same int as `random_state`, the same "
            f"parameters, and bounds as `input_scaling`."
        )

    def _learn(self, X, y, sample_weight, first, decay=1.0):
        X, y, sample_weight = check_rows(self, X, y, sample_weight, reset=first)
        counted = sample_weight > 0.0
        if not counted.all():
            X = X[counted]
            y = y[counted]
            sample_weight = sample_weight[counted]
        y_ndim = y.ndim
        y = y.reshape(len(y), -1)
        if first:
            elm = draw_layer(self, X, sample_weight)
            stats = Statistics.none(len(elm.output_weights) + y.shape[1])
        else:
            elm = self.module_
            n, mean, scatter = self._stats
            if y.shape[1] != elm.n_outputs:
                raise ValueError(
                    f"`y` must have {elm.n_outputs} columns as in earlier calls, got "
                    f"{y.shape[1]}; call `fit` to start again."
                )
            stats = Statistics(decay * n, mean, decay * scatter)
            y_ndim = self._y_ndim
        elm = elm.to(device_named(self.device))
        stats = gather(stats, elm, X, y, sample_weight, self.block_size)
        self._solve(stats, elm)
        self._y_ndim = y_ndim
        return self

    def _solve(self, stats, elm):
        """Fit the readout to statistics of the features of `elm`."""
        n_features = len(elm.output_weights)
        n_outputs = len(stats.mean) - n_features
        alpha = self.alpha
        if np.ndim(alpha):
            alpha = real_array(alpha, "alpha").astype(np.float64)
            fits = alpha.shape == (n_outputs,) and np.isfinite(alpha).all()
            if not fits or (alpha < 0.0).any():
                raise ValueError(
                    f"`alpha` must be a number >= 0, or {n_outputs} of them, one for each column "
                    f"of `y`, got {self.alpha!r}."
                )
        readout, self.noise_variance_, self.solver_ = fit_readout(
            stats, n_features, alpha, self.fit_intercept
        )
        layer = {name: getattr(elm, name).detach().cpu() for name in LAYER}
        module = ELM(elm.activation, **layer, **readout)
        return self._hold(module.to(device_named(self.device)), stats)

    def _warned(self):
        """Warn if the system was singular, and return self."""
        if self.solver_ == "eigh":
            n_features = len(self.module_.output_weights)
            warnings.warn(
                f"The system of {n_features} features is singular at alpha={self.alpha}; it was "
                f"solved with eigenvectors. Increase `alpha` or reduce `n_hidden`.",
                linalg.LinAlgWarning,
                stacklevel=3,
            )
        return self

    def _hold(self, module, stats):
        """Store a fitted network, and its arrays as learned attributes."""
        self.module_ = module
        self._stats = stats
        self.n_samples_seen_ = stats.n
        for name in LAYER + READOUT:
            setattr(self, f"{name}_", getattr(module, name).numpy(force=True))
        return self

    def stored(self):
        """Return the description of the fitted network, with the state of `partial_fit`."""
        check_is_fitted(self, "module_")
        arrays = {"mean": self._stats.mean, "scatter": self._stats.scatter}
        return Stored.of(
            "elm_regressor",
            {**arrays, "noise_variance": self.noise_variance_},
            {"network": self.module_.stored()},
            params=params_of(self),
            solver=self.solver_,
            n_samples_seen=self.n_samples_seen_,
            y_ndim=self._y_ndim,
            feature_names_in=vars(self).get("feature_names_in_", []),
        )

    @classmethod
    def from_stored(cls, stored, restore):
        """Return the fitted network built from a description; `restore` builds its module."""
        elm = estimator_of(cls, stored.value("params", dict))
        elm._validate_params()
        network = restore(stored.part("network"))
        n_both = sum(network.output_weights.shape)
        mean = stored.array("mean", (n_both,))
        scatter = stored.array("scatter", (n_both, n_both))
        shape = (network.n_outputs,)
        elm.noise_variance_ = stored.array("noise_variance", shape, finite=False)
        elm.solver_ = stored.value("solver", str)
        elm._y_ndim = stored.value("y_ndim", int)
        restore_columns(elm, stored, network.n_actuators)
        return elm._hold(network, Statistics(stored.value("n_samples_seen", float), mean, scatter))
