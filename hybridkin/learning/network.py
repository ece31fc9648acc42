"""A random hidden layer with a readout as a torch module, with closed-form derivatives."""

from dataclasses import replace

import numpy as np
import torch
from torch import nn

from hybridkin._core.arrays import one_of
from hybridkin._core.blocks import check_vectors, in_blocks
from hybridkin._core.derived import derived
from hybridkin._core.kernel_numbers import ACTIVATIONS as KERNELS
from hybridkin._core.kernel_numbers import HK_GROUP
from hybridkin._core.model import ForwardModel
from hybridkin._core.stored import Layout

# Numbers in the hidden layer of a block of rows: 1 MB, which fits the cache.
_BLOCK = 2**17

# name -> sigma(a), and sigma'(a) from a and s = sigma(a)
ACTIVATIONS = {
    "logistic": (torch.sigmoid, lambda a, s: torch.addcmul(s, s, s, value=-1)),
    "tanh": (torch.tanh, lambda a, s: 1 - s * s),
    "sin": (torch.sin, lambda a, s: torch.cos(a)),
}


def _write_tanh(a):
    """Replace rows a by tanh a: a CPU computes 2 logistic(2 a) - 1 in a quarter of the time.

    Its error is below 2 eps, relative to 1. A GPU takes as long for each pass over the rows.
    """
    if a.device.type == "cpu":
        a.mul_(2.0).sigmoid_().mul_(2.0).sub_(1.0)
    else:
        a.tanh_()


_WRITE = {"logistic": torch.sigmoid_, "tanh": _write_tanh, "sin": torch.sin_}

LAYER = ("input_weights", "input_bias", "input_center", "input_scale")
READOUT = ("output_weights", "intercept")
READOUT += ("leverage_center", "leverage_factor", "leverage_offset")


def write_units(plan, kind, activation, scaling, readout, hidden, lever=()):
    """Write the node of ``x = c + D u + V sigma(W u + b)``, and return its place.

    Parameters
    ----------
    plan : Plan
        The plan.
    kind, activation : str
        Kind of the node, and name of sigma; the kernels know "gaussian" too.
    scaling : tuple of ndarray of shape (n,)
        Center and scale of u.
    readout : tuple of ndarray of shape (m,), (m, n) and (m, H)
        c, D and V.
    hidden : tuple of ndarray of shape (H, n) and (H,)
        W and b.
    lever : tuple of ndarray, default=()
        Arguments of `lever_numbers`, if the node also gives a leverage.
    """
    center, scale = scaling
    intercept, direct, output = readout
    W, b = hidden
    m, n = direct.shape
    n_hidden = len(b)
    units = np.zeros((-(-n_hidden // HK_GROUP) * HK_GROUP, n + 1 + m))
    units[:n_hidden] = np.column_stack([W, b, output.T])
    groups = units.reshape(-1, HK_GROUP, n + 1 + m).swapaxes(1, 2)
    numbers = [center, 1.0 / scale, intercept, direct, groups]
    entries = [n_hidden, KERNELS.index(activation)]
    columns = None
    if lever:
        sizes, leverage, columns = lever_numbers(plan, *lever)
        numbers += leverage
        entries += sizes
    return plan.node(kind, n, m, numbers, *entries, aligned=True, last=columns)


def lever_numbers(plan, offset, prior, center, factor):
    """Return sizes and numbers of the leverage, see `ELM`.

    Parameters
    ----------
    plan : Plan
        The plan.
    offset, prior : ndarray of shape ()
        Offset and prior.
    center : ndarray of shape (f,)
        The features' center.
    factor : ndarray of shape (f, k)
        The factor R. If it is upper triangular, kernels skip the zeros.

    Returns
    -------
    sizes : tuple of int
        f, k, and whether R is full.
    numbers : list of ndarray
        All but R.
    columns : ndarray of shape (k, f)
        The columns of R, the last numbers.
    """
    n_features, n_columns = factor.shape
    plan.limit("features", n_features)
    full = n_columns < n_features or np.tril(factor, -1).any()
    return (n_features, n_columns, full), [offset, prior, center], factor.T


def write_network(plan, stored, leverage=False):
    """Write the node of an `ELM`, with its leverage if a guard needs it, and return its place."""
    W = stored.array("input_weights")
    b = stored.array("input_bias")
    weights = stored.array("output_weights")
    n_hidden = len(b)
    direct = np.zeros((W.shape[1], weights.shape[1]))
    if len(weights) > n_hidden:
        direct = weights[n_hidden:]
    scaling = stored.array("input_center"), stored.array("input_scale")
    readout = stored.array("intercept"), direct.T, weights[:n_hidden].T
    lever = ()
    if leverage:
        names = "offset", "prior", "center", "factor"
        lever = [stored.array(f"leverage_{name}") for name in names]
    activation = stored.value("activation", str)
    return write_units(plan, "elm", activation, scaling, readout, (W, b), lever)


class LeverageModule(ForwardModel):
    """A model that can return the leverage of any row with respect to its training rows."""

    def leverage(self, q):
        """Return the leverage of `q`, shape (...): smooth, at most 1 on the training rows."""
        raise NotImplementedError

    def leverage_and_gradient(self, q):
        """Return the leverage (N,) of rows `q` (N, n_inputs), and its derivative (N, n_inputs)."""
        raise NotImplementedError

    def forward_jacobian_and_leverage(self, q):
        """Return ``forward(q)``, ``jacobian(q)`` and ``leverage(q)``."""
        return *self.forward_and_jacobian(q), self.leverage(q)


class ELM(LeverageModule):
    """A fitted network ``eps = phi(q) @ output_weights + intercept`` as a torch module.

    ``phi(q) = sigma(W u + b)`` with the scaled input ``u = (q - input_center) / input_scale``,
    followed by `u` itself if there is a direct link. Batch dimensions lead. The module is twice
    differentiable and computes in the dtype and on the device of `q`.

    Parameters
    ----------
    activation : {"logistic", "tanh", "sin"}, default="logistic"
        The function sigma.
    **arrays
        The entries of the state dict, so ``ELM(elm.activation, **elm.state_dict())`` is a copy:

        - input_weights (n_hidden, n_inputs), input_bias (n_hidden,): the hidden layer W, b;
        - input_center, input_scale (n_inputs,): affine map of the inputs [unit of q];
        - output_weights (n_features, n_outputs), intercept (n_outputs,): the readout [unit of
          eps], where `n_features` is `n_hidden`, plus `n_inputs` with a direct link;
        - leverage_center (n_features,), leverage_factor (n_features, k), leverage_offset (),
          leverage_prior (): with v = phi - leverage_center, the leverage is
          ``|v @ leverage_factor|^2 + leverage_offset``. If the prior is not 0, it is
          ``leverage_prior |v|^2 - |v @ leverage_factor|^2 + leverage_offset``: the leverage without
          training rows, less what these rows reduce it by. Missing: 0.
    """

    layout = Layout(
        "elm",
        {
            "input_weights": "hn",
            "input_bias": "h",
            "input_center": "n",
            "input_scale": "n",
            "output_weights": "fm",
            "intercept": "m",
            "leverage_offset": "",
            "leverage_center": "f",
            "leverage_factor": "fk",
            "leverage_prior": "",
        },
        {"activation": str},
        write_plan=write_network,
    )
    computed = ("tangent",)

    def __init__(self, activation="logistic", **arrays):
        super().__init__()
        self.activation = activation
        one_of(activation, "activation", ACTIVATIONS)
        arrays = {"leverage_prior": np.zeros(()), **arrays}
        for name in (*LAYER, *READOUT, "leverage_prior"):
            array = np.asarray(arrays[name], order="C")
            self.register_buffer(name, torch.tensor(array, device="cpu"))
        # Kernels read column by column.
        self.leverage_factor = self.leverage_factor.T.contiguous().T
        n_hidden, self.n_actuators = self.input_weights.shape
        n_features, self.n_outputs = self.output_weights.shape
        if n_features not in (n_hidden, n_hidden + self.n_actuators):
            raise ValueError(f"{n_hidden} hidden neurons cannot have {n_features} features")

    @classmethod
    def from_stored(cls, stored, restore):
        """Return the module built from a description; that of an old file has no prior."""
        arrays = {"leverage_prior": np.zeros(()), **stored.arrays}
        return super().from_stored(replace(stored, arrays=arrays), restore)

    @derived("input_weights", "input_scale", "output_weights")
    def _tangent(self):
        w_in = self.input_weights / self.input_scale
        w_out = self.output_weights[: len(w_in)]
        return ((w_out.T[:, None] * w_in.T).flatten(0, 1).contiguous(),)

    @property
    def tangent(self):
        """T (m n, H) of the Jacobian T @ sigma', with T = w_out (x) w_in."""
        return self._tangent()[0]

    def extra_repr(self):
        """Return the layer sizes and the activation, for printing."""
        n_hidden = len(self.input_weights)
        return f"{self.n_actuators} -> {n_hidden} {self.activation} -> {self.n_outputs}"

    def _scaled(self, q):
        n_inputs = len(self.input_center)
        check_vectors(q, n_inputs, "q", f"this ELM was fitted on {n_inputs} inputs")
        # Merging the scaling into W and b would lose digits if the range is narrow.
        u = (q - self.input_center.to(q)) / self.input_scale.to(q)
        return u + 0.0 * u  # NaN where infinite, as in the kernels

    def _hidden(self, q):
        u = self._scaled(q)
        a = nn.functional.linear(u, self.input_weights.to(q), self.input_bias.to(q))
        return u, a, ACTIVATIONS[self.activation][0](a)

    def write_features(self, q, out):
        """Write the features of rows `q` (N, n_inputs) into `out` (N, n_features)."""
        # In place: large temporary arrays would fragment the heap by hundreds of megabytes.
        n_hidden = len(self.input_weights)
        hidden = out[:, :n_hidden]
        u = self._scaled(q)
        torch.addmm(self.input_bias, u, self.input_weights.T, out=hidden)
        _WRITE[self.activation](hidden)
        if len(self.output_weights) > n_hidden:
            out[:, n_hidden:] = u

    def _features(self, u, s):
        if len(self.output_weights) > s.shape[-1]:
            return torch.cat((s, u), -1)
        return s

    def _readout(self, u, s):
        weights = self.output_weights.to(s)
        intercept = self.intercept.to(s)
        return nn.functional.linear(self._features(u, s), weights.T, intercept)

    def _slope(self, a, s):
        slope = ACTIVATIONS[self.activation][1](a, s)
        columns = (self.tangent.to(s) @ slope.T).T
        J = columns.unflatten(-1, (len(self.intercept), -1))
        weights = self.output_weights
        if len(weights) > s.shape[-1]:  # with a direct link
            direct = weights[s.shape[-1] :]
            J = J + (direct.T / self.input_scale).to(s)
        return J

    def features(self, q):
        """Return the features `phi`, shape (..., n_features), of `q`, shape (..., n_inputs)."""
        u, _, s = self._hidden(q)
        return self._features(u, s)

    def forward(self, q):
        """Return the output `eps`, shape (..., n_outputs), at `q`, shape (..., n_inputs)."""
        u, _, s = self._hidden(q)
        return self._readout(u, s)

    def forward_and_jacobian(self, q):
        """Return ``forward(q)`` and ``jacobian(q)`` from one evaluation of the hidden layer."""

        def rows(u, a, s):
            return self._readout(u, s), self._slope(a, s)

        x, J = self._in_blocks(q, rows)
        return x, J

    def forward_jacobian_and_leverage(self, q):
        """Return ``forward(q)``, ``jacobian(q)`` and ``leverage(q)`` from the same features."""

        def rows(u, a, s):
            leverage = self._leverage(self._features(u, s))
            return self._readout(u, s), self._slope(a, s), leverage[..., None]

        x, J, leverage = self._in_blocks(q, rows)
        return x, J, leverage[..., 0]

    def _in_blocks(self, q, function):
        size = max(1, _BLOCK // len(self.input_weights))
        return in_blocks(lambda rows: function(*self._hidden(rows)), q, size)

    def leverage(self, q):
        """Return the leverage of `q`, shape (...): smooth, at most 1 on the training rows."""
        return self._leverage(self.features(q))

    def leverage_and_gradient(self, q):
        """Return the leverage (N,) of rows `q` (N, n_inputs), and its derivative (N, n_inputs)."""

        def rows(u, a, s):
            phi = self._features(u, s)
            v = phi - self.leverage_center.to(phi)
            factor = self.leverage_factor.to(phi)
            by_squares = 2.0 * (v @ factor) @ factor.T
            prior = self.leverage_prior.to(phi)
            by_phi = torch.where(prior > 0.0, 2.0 * prior * v - by_squares, by_squares)
            slope = ACTIVATIONS[self.activation][1](a, s)
            by_hidden, by_direct = by_phi.tensor_split([s.shape[-1]], dim=-1)
            by_u = (by_hidden * slope) @ self.input_weights.to(s)
            if by_direct.shape[-1] > 0:
                by_u = by_u + by_direct
            return self._leverage(phi)[..., None], by_u / self.input_scale.to(s)

        leverage, gradient = self._in_blocks(q, rows)
        return leverage[..., 0], gradient

    def _leverage(self, phi):
        v = phi - self.leverage_center.to(phi)
        prior = self.leverage_prior.to(phi)
        squares = (v @ self.leverage_factor.to(phi)).square().sum(-1)
        reduced = prior * v.square().sum(-1) - squares
        return torch.where(prior > 0.0, reduced, squares) + self.leverage_offset.to(phi)
