"""Features phi(q) of the actuators, linear ones first, and their readouts W phi(q)."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.blocks import check_vectors, in_blocks
from hybridkin._core.frames import Frames
from hybridkin._core.kernel_numbers import HK_POSE_FEATURES, HK_QUADRATIC_FEATURES
from hybridkin._core.model import ForwardModel
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.portable import PortableModule
from hybridkin._core.stored import Layout, Stored
from hybridkin.chains.arc_chain import write_whole_chain
from hybridkin.learning.network import ACTIVATIONS, write_units

_POSE_BLOCK = 2048  # rows of pose features, whose temporaries stay in the cache
_BLOCK = 2**18  # numbers in the features of a block of rows, which stay in the cache


def center_and_scale(q: Tensor) -> tuple[Tensor, Tensor]:
    """Return center and scale that map the range of rows q (N, n) to [-1, 1].

    Columns that are constant, up to rounding, get the scale 1.
    """
    low = q.amin(0)
    high = q.amax(0)
    scale = 0.5 * (high - low)
    flat = scale <= 4.0 * torch.finfo(q.dtype).eps * q.abs().amax(0)
    return 0.5 * (low + high), torch.where(flat, torch.ones_like(scale), scale)


class Features(PortableModule):
    """Features phi(q) = [1, u], with u = (q - center) / scale.

    Subclasses append more features. The two parts have separate penalties.

    Parameters
    ----------
    center, scale : Tensor of shape (n,)
        Map of the training range to [-1, 1] [unit of q].
    """

    layout = Layout("linear_features", {"center": "n", "scale": "n"})

    def __init__(self, center: Tensor, scale: Tensor) -> None:
        super().__init__()
        self.register_buffer("center", center)
        self.register_buffer("scale", scale)

    @classmethod
    def of_range(cls, q: Tensor, *args: Any) -> Self:
        """Return the features for the range of rows q (N, n); constant columns get scale 1."""
        return cls(*center_and_scale(q), *args)

    @property
    def n_linear(self) -> int:
        """Number of linear features, which come first: the constant, then u."""
        return 1 + len(self.center)

    def forward(self, q: Tensor) -> Tensor:
        """Return phi(q), shape (..., P)."""
        u = self._scaled(q)
        return torch.cat([torch.ones_like(u[..., :1]), u, *self._bent(u)], dim=-1)

    def readout(self, q: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Return W phi(q) (..., C) for weights W (C, P), and its derivative by q (..., C, n)."""
        u = self._scaled(q)
        linear, bent = weights.tensor_split([self.n_linear], dim=1)
        value = u @ linear[:, 1:].mT + linear[:, 0]
        slope = linear[:, 1:].expand(*u.shape[:-1], *linear[:, 1:].shape)
        if bent.shape[1]:
            nonlinear, slope_more = self._bent_readout(u, bent)
            value = value + nonlinear
            slope = slope + slope_more
        return value, slope / self.scale.to(q)

    def _scaled(self, q: Tensor) -> Tensor:
        n = len(self.center)
        check_vectors(q, n, "q", f"these features were made for {n} inputs")
        return (q - self.center.to(q)) / self.scale.to(q)

    def _bent(self, u: Tensor) -> tuple[Tensor, ...]:
        return ()

    def _bent_readout(self, u: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Return W phi(u) for the features after the linear ones, and its derivative by u."""
        raise NotImplementedError


class QuadraticFeatures(Features):
    """The linear features, then u_i u_j for i < j and (3 u_i^2 - 1) / 2.

    The squares have zero mean over the range, so their penalty does not act on the constant.
    """

    layout = Layout("quadratic_features", {"center": "n", "scale": "n"})

    def _bent(self, u: Tensor) -> tuple[Tensor, ...]:
        i, j = torch.triu_indices(len(self.center), len(self.center), 1, device=u.device)
        return u[..., i] * u[..., j], 1.5 * u.square() - 0.5

    def _bent_readout(self, u: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        n = len(self.center)
        i, j = torch.triu_indices(n, n, 1, device=u.device)
        crossed = weights[:, : len(i)]
        squared = weights[:, len(i) :]
        hessian = weights.new_zeros(len(weights), n, n)
        hessian[:, i, j] = crossed
        hessian = hessian + hessian.mT + torch.diag_embed(3.0 * squared)
        slope = (u @ hessian.flatten(0, 1).mT).unflatten(-1, hessian.shape[:2])
        value = 0.5 * (slope @ u[..., None])[..., 0] - 0.5 * squared.sum(1)
        return value, slope


class HiddenFeatures(Features):
    """The linear features, then a hidden layer sigma(A u + b).

    Parameters
    ----------
    center, scale : Tensor of shape (n,)
        Map of the training range to [-1, 1] [unit of q].
    input_weights : Tensor of shape (H, n)
        A.
    input_bias : Tensor of shape (H,)
        b.
    activation : {"logistic", "tanh", "sin"}, default="logistic"
        The function sigma.
    """

    layout = Layout(
        "hidden_features",
        {"center": "n", "scale": "n", "input_weights": "hn", "input_bias": "h"},
        {"activation": str},
    )

    def __init__(
        self,
        center: Tensor,
        scale: Tensor,
        input_weights: Tensor,
        input_bias: Tensor,
        activation: str = "logistic",
    ) -> None:
        super().__init__(center, scale)
        self.activation = activation
        self.register_buffer("input_weights", input_weights)
        self.register_buffer("input_bias", input_bias)

    def _bent(self, u: Tensor) -> tuple[Tensor, ...]:
        return (self._hidden(u)[1],)

    def _bent_readout(self, u: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        a, s = self._hidden(u)
        tangent = weights[:, None] * self.input_weights.to(u).mT  # (C, n, H)
        slope = ACTIVATIONS[self.activation][1](a, s) @ tangent.flatten(0, 1).mT
        return s @ weights.mT, slope.unflatten(-1, tangent.shape[:2])

    def _hidden(self, u: Tensor) -> tuple[Tensor, Tensor]:
        a = u @ self.input_weights.to(u).mT + self.input_bias.to(u)
        return a, ACTIVATIONS[self.activation][0](a)


class PoseFeatures(Features):
    """The linear features, then axes of the segments and moments of loads about the segments.

    Besides its actuators, mostly loads bend a soft robot: its own weight and a payload. A load of
    direction g at the robot's end acts on the frame after segment s with the moment d x g, where d
    is the lever from that frame to the end. In the axes a_i of this frame, the moment has the
    components a_i . (d x g) = g . (a_i x d), and the load has the components g . a_i. For S
    segments, with all vectors in the base frame, the features are

    - the lever from the base to the end, 3 numbers, for the moments at the base;
    - for each segment the axes a_i of the frame after it, 9 numbers, and except for the last
      segment the moments a_i x d about that frame, 9 numbers; a frame includes the rigid offset.

    These are 18 S - 6 features. Levers are divided by the reach of the chain, so all features are
    unitless and of order one. The direction of gravity is not needed: the weights learn it. The
    pose of the base has no effect. Levers end at the robot's end, also if the model's tip is
    another point.

    Parameters
    ----------
    center, scale : Tensor of shape (n,)
        Map of the training range to [-1, 1] [unit of q].
    chain : ForwardModel
        The robot, made of arcs. The features share its parameters and buffers.
    """

    layout = Layout("pose_features", {"center": "n", "scale": "n"}, parts=("chain",))

    def __init__(self, center: Tensor, scale: Tensor, chain: ForwardModel) -> None:
        super().__init__(center, scale)
        self.chain = chain

    def _bent(self, u: Tensor) -> tuple[Tensor, ...]:
        return in_blocks(self._rows_bent, u, _POSE_BLOCK)

    def _bent_readout(self, u: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        value, slope = in_blocks(partial(self._rows_readout, weights=weights), u, _POSE_BLOCK)
        return value, slope

    def _rows_bent(self, u: Tensor) -> tuple[Tensor]:
        vectors, lever, _ = self._vectors(u)
        return (torch.cat([lever, *vectors]).mT,)

    def _rows_readout(self, u: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        # Virtual work: the weights are forces on vectors. Each segment before a frame rotates all
        # vectors of that frame; each segment after it moves the end of its lever.
        vectors, lever, frames = self._vectors(u)
        moves = frames.moves / self.chain.reach.to(u)
        spins = frames.spins
        slope = frames.slope
        C = len(weights)
        at_base, *forces = weights.split([3, *(len(part) for part in vectors)], dim=1)
        value = at_base @ lever
        # Forces on the end, from the frames before a segment.
        pulls = [at_base[:, :, None]]
        turns = []  # moments, from the frames after a segment
        for force, part in zip(forces, vectors, strict=True):
            value = value + force @ part
            turning = _turning(force)
            turns.append((turning @ part).unflatten(0, (C, 3)))
            if len(turns) < len(vectors):
                pulls.append(pulls[-1] - (turning[:, 9:] @ part[:9]).unflatten(0, (C, 3)))
        work = []
        for k in reversed(range(len(turns))):
            if k + 1 < len(turns):
                turns[k] += turns[k + 1]
            weighted = pulls[k][:, 0, None] * moves[0, :, k]
            for axis in (1, 2):
                weighted.addcmul_(pulls[k][:, axis, None], moves[axis, :, k])
            for axis in (0, 1, 2):  # a length rotates nothing
                weighted[:, 1:].addcmul_(turns[k][:, axis, None], spins[axis, 1:, k])
            work.append(weighted)
        by_arcs = torch.stack(work[::-1], 2).flatten(1, 2)  # (C, 3 S, N)
        scale = self.scale.to(u)
        if slope.ndim == 2:
            by_inputs = ((slope * scale).mT @ by_arcs).flatten(0, 1)
            return value.mT, by_inputs.mT.contiguous().unflatten(1, (C, -1))
        return value.mT, by_arcs.permute(2, 0, 1) @ slope.permute(2, 0, 1) * scale

    def _vectors(self, u: Tensor) -> tuple[list[Tensor], Tensor, Frames]:
        """Return the features of every frame, the lever from the base, and the frames.

        The features are axes and moments (18, N) of every frame, for the last one axes only (9, N).
        The lever is (3, N), relative to the reach.
        """
        frames = self.chain.frames_and_moves(u * self.scale.to(u) + self.center.to(u))
        reach = self.chain.reach.to(u)
        a, b, c = (frames.points[:, -1:] - frames.points) / reach
        x, y, z = frames.axes.unbind(1)
        moments = torch.stack([y * c - z * b, z * a - x * c, x * b - y * a], 1)
        vectors = torch.cat([frames.axes, moments]).flatten(0, 1).unbind(1)
        return [*vectors[:-1], vectors[-1][:9]], frames.points[:, -1] / reach, frames


def _turning(forces: Tensor) -> Tensor:
    """Return the map (3 C, 3 Y) of vectors y to the moments sum y x f of forces f (C, 3 Y)."""
    fx, fy, fz = forces.unflatten(1, (-1, 3)).unbind(2)
    zero = torch.zeros_like(fx)
    rows = [zero, fz, -fy, -fz, zero, fx, fy, -fx, zero]  # derivative of y x f by y
    return torch.stack(rows, -1).unflatten(-1, (3, 3)).permute(0, 2, 1, 3).reshape(3 * len(fx), -1)


def _write_readout(plan: Plan, stored: Stored) -> int:
    """Write the node of W phi(q), by the kind of its features."""
    features = stored.part("features")
    weights = stored.array("weights")
    center = features.array("center")
    scale = features.array("scale")
    n = len(center)
    m = len(weights)
    constant, linear, bent = np.split(weights, [1, 1 + n], axis=1)
    readout = constant, linear, bent
    if features.kind == "linear_features":
        none = np.zeros((0, n)), np.zeros(0)
        return write_units(plan, "elm", "sin", (center, scale), readout, none)
    if features.kind == "hidden_features":
        hidden = features.array("input_weights"), features.array("input_bias")
        activation = features.value("activation", str)
        return write_units(plan, "elm", activation, (center, scale), readout, hidden)
    if features.kind == "quadratic_features":
        i, j = np.triu_indices(n, 1)
        crossed, squared = np.split(bent, [len(i)], axis=1)
        hessian = np.zeros((m, n, n))
        hessian[:, i, j] = hessian[:, j, i] = crossed
        hessian[:, range(n), range(n)] = 3.0 * squared
        constant = constant - 0.5 * squared.sum(1, keepdims=True)
        numbers = [
            center,
            1.0 / scale,
            np.column_stack([constant, linear, hessian.reshape(m, -1)]),
        ]
        return plan.node("readout", n, m, numbers, HK_QUADRATIC_FEATURES)
    if features.kind == "pose_features":
        chain = write_whole_chain(plan, features.part("chain"))
        return plan.node("readout", n, m, [center, 1.0 / scale, *readout], HK_POSE_FEATURES, chain)
    raise NoKernel(f"a readout of {features.kind!r} has no kernel")


class Readout(ForwardModel):
    """The readout W phi(q) as a torch module q (..., n) -> (..., C).

    Parameters
    ----------
    features : Features
        phi, with its derivative.
    weights : Tensor of shape (C, P)
        W [unit of the outputs].
    """

    layout = Layout("readout", {"weights": "cp"}, parts=("features",), write_plan=_write_readout)

    def __init__(self, features: Features, weights: Tensor) -> None:
        super().__init__()
        self.features = features
        self.register_buffer("weights", weights)
        self.n_actuators = len(features.center)
        self.n_outputs = len(weights)

    def up_to_tip_of(self, robot: ForwardModel) -> Readout:
        """Return the readout for the arcs up to the tip of a robot, from that for all arcs."""
        return Readout(self.features, robot.up_to_tip(self.weights))

    def forward(self, q: Tensor) -> Tensor:
        """Return W phi(q), shape (..., C)."""
        return self.features(q) @ self.weights.to(q).mT

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return W phi(q) (..., C) and its derivative (..., C, n)."""
        rows = min(4096, max(256, _BLOCK // self.weights.shape[1]))
        readout = partial(self.features.readout, weights=self.weights.to(q))
        value, slope = in_blocks(readout, q, rows)
        return value, slope


def _write_projected(plan: Plan, stored: Stored) -> int:
    model = plan.node_of(stored.part("model"))
    numbers = [stored.array("matrix").T, stored.array("offset")]
    return plan.node("projected", *plan.lengths(model), numbers, model)


class Projected(ForwardModel):
    """A model of the part of q that its rows moved: model(q @ matrix + offset).

    It is constant along the other directions, in which the rows show nothing.

    Parameters
    ----------
    model : ForwardModel
        Maps q (..., n) to (..., m).
    matrix, offset : Tensor of shape (n, n) and (n,)
        See `Directions.projection`.
    """

    layout = Layout(
        "projected",
        {"matrix": "nn", "offset": "n"},
        parts=("model",),
        write_plan=_write_projected,
    )

    def __init__(self, model: ForwardModel, matrix: Tensor, offset: Tensor) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("matrix", matrix)
        self.register_buffer("offset", offset)
        self.n_actuators = len(offset)
        self.n_outputs = model.n_outputs

    def inner(self, q: Tensor) -> Tensor:
        """Return the part of q (..., n) along the directions that the rows moved."""
        return q @ self.matrix.to(q) + self.offset.to(q)

    def forward(self, q: Tensor) -> Tensor:
        """Return the output of the model, shape (..., m)."""
        return self.model(self.inner(q))

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the output of the model (..., m) and its derivative by q (..., m, n)."""
        x, J = self.model.forward_and_jacobian(self.inner(q))
        return x, J @ self.matrix.to(q).mT
