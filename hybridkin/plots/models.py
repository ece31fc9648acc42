"""Predictions of models, and bodies of robots in given configurations, as plain arrays."""

from __future__ import annotations

from functools import partial
from typing import Protocol, TypeAlias, TypedDict, runtime_checkable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Required

from hybridkin._core.commands import Commands
from hybridkin.chains.chain import Chain
from hybridkin.plots._arrays import plain, positions, shaped

_STEPS = 12  # to the tips that a model predicts
_SINGULAR = 1e-3  # of a Jacobian: no steps along smaller singular values, relative to the largest
_REACHED = 1e-6  # largest distance of a drawn tip from its place [m]


@runtime_checkable
class Predictor(Protocol):
    """A fitted estimator."""

    def predict(self, X: object, /) -> NDArray:
        """Return tips (N, m) for actuator vectors (N, n)."""
        ...


class _Corrected(Protocol):
    corrects_inside: bool


@runtime_checkable
class _Hybrid(Predictor, Protocol):
    """A fitted hybrid model of a chain."""

    mechanical_model_: Chain
    fitted_module_: _Corrected


class Body(TypedDict, total=False):
    """The arguments of `BackboneDisplay`."""

    points: Required[NDArray]
    actuators: Required[list[NDArray]]
    frames: Required[NDArray]
    tips: Required[NDArray]
    segments: Required[list[int]]
    disks: Required[NDArray]
    rigid: Required[bool]
    predicted: NDArray


Model: TypeAlias = Predictor | torch.nn.Module


def predicted(model: Model, q: ArrayLike) -> NDArray:
    """Return the tips (N, m) that an estimator or a chain gives for rows of q [m]."""
    if isinstance(model, Predictor):
        return positions(model.predict(q))
    with torch.no_grad():
        return positions(model(torch.from_numpy(plain(q, "q"))))


def body_of(model: Model, q: ArrayLike, n_points: int, tips: ArrayLike | None = None) -> Body:
    """Return the arguments of `BackboneDisplay` for a robot in configurations q (K, n) or (n,).

    Where `tips` (K, 3) are given, or the model corrects its robot inside, the body ends there.
    """
    chain = getattr(model, "mechanical_model_", model)
    # The public entry: whatever a caller draws; a body needs the geometry of a chain.
    if not isinstance(chain, Chain):
        raise TypeError(
            "`model` must be a chain, or a HybridForwardModel fitted on one, whose backbone can be "
            f"drawn; got {type(model).__name__} with {type(chain).__name__} as mechanical part. "
            "Give the points along the robot to the display yourself."
        )
    q = shaped(np.atleast_2d(plain(q, "q")), "q", ("K", chain.n_actuators))
    drawn = np.asarray(np.isfinite(q).all(axis=1))

    # Where the body ends: at given tips, or at those of a model that corrects its robot inside.
    ends = None
    predicted_tips = None
    corrects_inside = False
    if tips is not None:
        ends = shaped(tips, "tips", "K3", len(q))
        drawn = drawn & np.isfinite(ends).all(axis=1)
    elif isinstance(model, _Hybrid):
        predicted_tips = _spread(drawn, _predicted_tips(model, chain, q[drawn]))
        corrects_inside = model.fitted_module_.corrects_inside
        if corrects_inside:
            ends = predicted_tips
    rows = torch.from_numpy(q[drawn])
    if ends is not None:
        rows = _led_to(chain, rows, torch.from_numpy(ends[drawn]))

    spread = partial(_spread, drawn)
    with torch.no_grad():
        tip = spread(chain.tip_model(rows))
        drawing = chain.body(rows, n_points)
        body: Body = {
            "points": spread(drawing.points),
            "actuators": [*map(spread, drawing.actuators)],
            "segments": drawing.segments,
            "disks": spread(drawing.disks),
            "frames": spread(chain.poses(rows)),
            "tips": tip,
            "rigid": drawing.is_rigid,
        }

    # The learned correction is shown where the body does not end at the predicted tip.
    if predicted_tips is not None:
        largest = np.nanmax(np.abs(tip - predicted_tips), initial=0.0)
        if not corrects_inside or largest > _REACHED:
            body["predicted"] = predicted_tips
    return body


def _spread(drawn: NDArray[np.bool_], values: torch.Tensor | NDArray) -> NDArray:
    """Return values of drawn configurations among rows of NaN for the others."""
    spread = np.full((len(drawn), *values.shape[1:]), np.nan)
    spread[drawn] = values
    return spread


def _predicted_tips(model: Predictor, chain: Chain, q: NDArray) -> NDArray:
    """Return the tips (K, 3) that a hybrid of the chain predicts, of poses and markers too."""
    if not len(q):
        return np.empty((0, 3))
    each_alone = Commands(q, np.arange(len(q)))  # no row is the past of another one
    x = plain(model.predict(each_alone), "x")
    if chain.n_outputs == 3:
        return x[:, :3]
    return x[:, -3:]


def _led_to(chain: Chain, q: torch.Tensor, tips: torch.Tensor) -> torch.Tensor:
    """Return configurations near q (K, n) at which the chain's tips are the given ones (K, 3).

    Gauss-Newton steps, the shortest in q; of tips out of reach as near as they come.
    """
    for _ in range(_STEPS):
        x, J = chain.tip_model.forward_and_jacobian(q)
        inverse = torch.linalg.pinv(J, rtol=_SINGULAR)
        step = inverse @ (tips - x)[..., None]
        q = q + step[..., 0]
    return q.detach()
