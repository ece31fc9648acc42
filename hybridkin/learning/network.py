"""A random hidden layer with a readout as a torch module, with closed-form derivatives."""

import numpy as np
import torch
from torch import nn

from hybridkin._core.arrays import one_of
from hybridkin._core.blocks import check_vectors, in_blocks
from hybridkin._core.model import ForwardModel
from hybridkin._core.stored import Layout

_BLOCK = 2**17  # numbers in the hidden layer of a block of rows: 1 MB, which fits the cache

# name -> sigma(a), and sigma'(a) from a and s = sigma(a)
ACTIVATIONS = {
    "logistic": (torch.sigmoid, lambda a, s: torch.addcmul(s, s, s, value=-1)),
    "tanh": (torch.tanh, lambda a, s: 1 - s * s),
    "sin": (torch.sin, lambda a, s: torch.cos(a)),
}

LAYER = ("input_weights", "input_bias", "input_center", "input_scale")
READOUT = ("output_weights", "intercept")
READOUT += ("leverage_center", "leverage_factor", "leverage_offset")


class LeverageModule(ForwardModel):
    """A model that can return the leverage of any row with respect to its training rows."""

    def leverage(self, q):
        """Return the leverage of `q`, shape (...): smooth, at most 1 on the training rows."""
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
        - leverage_center (n_features,), leverage_factor (n_features, n_features), leverage_offset
          (): ``leverage = |(phi - leverage_center) @ leverage_factor|^2 + leverage_offset``.
    """

    layout = Layout(
        "elm",
        {"input_weights": "hn", "input_bias": "h", "input_center": "n", "input_scale": "n"}
        | {"output_weights": "fm", "intercept": "m", "leverage_offset": ""}
        | {"leverage_center": "f", "leverage_factor": "ff"},
        {"activation": str},
    )

    def __init__(self, activation="logistic", **arrays):
        super().__init__()
        self.activation = activation
        one_of(activation, "activation", ACTIVATIONS)
        for name in LAYER + READOUT:
            array = np.asarray(arrays[name], order="C")
            self.register_buffer(name, torch.tensor(array, device="cpu"))
        n_hidden, self.n_actuators = self.input_weights.shape
        n_features, self.n_outputs = self.output_weights.shape
        if n_features not in (n_hidden, n_hidden + self.n_actuators):
            raise ValueError(f"{n_hidden} hidden neurons cannot have {n_features} features")
        # J = T @ sigma' with T = w_out (x) w_in
        w_in, w_out = self.input_weights / self.input_scale, self.output_weights[:n_hidden]
        self.register_buffer("tangent", (w_out.T[:, None] * w_in.T).flatten(0, 1))

    def extra_repr(self):
        """Return the layer sizes and the activation, for printing."""
        n_hidden = len(self.input_weights)
        return f"{self.n_actuators} -> {n_hidden} {self.activation} -> {self.n_outputs}"

    def _hidden(self, q, out=None):
        n_inputs = len(self.input_center)
        check_vectors(q, n_inputs, "q", f"this ELM was fitted on {n_inputs} inputs")
        # Merging the scaling into W and b would lose digits if the range is narrow.
        u = (q - self.input_center.to(q)) / self.input_scale.to(q)
        W, b = self.input_weights.to(q), self.input_bias.to(q)
        a = nn.functional.linear(u, W, b) if out is None else torch.addmm(b, u, W.T, out=out)
        return u, a, ACTIVATIONS[self.activation][0](a, out=out)

    def _write_features(self, q, out):
        # In place: large temporary arrays would fragment the heap by hundreds of megabytes.
        n_hidden = len(self.input_weights)
        u, _, _ = self._hidden(q, out[:, :n_hidden])
        if len(self.output_weights) > n_hidden:
            out[:, n_hidden:] = u

    def _features(self, u, s):
        return torch.cat((s, u), -1) if len(self.output_weights) > s.shape[-1] else s

    def _readout(self, u, s):
        weights, intercept = self.output_weights.to(s), self.intercept.to(s)
        return nn.functional.linear(self._features(u, s), weights.T, intercept)

    def _slope(self, a, s):
        slope = ACTIVATIONS[self.activation][1](a, s)
        J = (self.tangent.to(s) @ slope.T).T.unflatten(-1, (len(self.intercept), -1))
        if len(self.output_weights) > s.shape[-1]:
            J = J + (self.output_weights[s.shape[-1] :].T / self.input_scale).to(s)
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
        x, J = self._in_blocks(q, lambda u, a, s: (self._readout(u, s), self._slope(a, s)))
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

    def _leverage(self, phi):
        r = (phi - self.leverage_center.to(phi)) @ self.leverage_factor.to(phi)
        return (r * r).sum(-1) + self.leverage_offset.to(phi)
