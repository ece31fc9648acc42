"""Predictions of models, and bodies of robots in given configurations, as plain arrays."""

from __future__ import annotations

from typing import Any, Protocol, TypeAlias, cast, runtime_checkable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.chain import Chain
from hybridkin.plots._arrays import plain, positions, shaped

_RIM = 1.15  # radius of a drawn disk over that of the actuator circle
_CORNERS = 17  # points of a disk's rim
_STEPS = 12  # to the tips that a model predicts


@runtime_checkable
class Predictor(Protocol):
    """A fitted estimator."""

    def predict(self, X: Any, /) -> Any: ...


Model: TypeAlias = Predictor | torch.nn.Module


def predicted(model: Model, q: ArrayLike) -> NDArray:
    """Return the tips (N, m) that an estimator or a chain gives for rows of q [m]."""
    if isinstance(model, Predictor):
        return positions(model.predict(q))
    with torch.no_grad():
        return positions(model(torch.from_numpy(plain(q, "q"))))


def body_of(
    model: Model, q: ArrayLike, n_points: int, tips: ArrayLike | None = None
) -> dict[str, Any]:
    """Return the arguments of `BackboneDisplay` for a robot in configurations q (K, n) or (n,).

    Where `tips` (K, 3) are given, or the model corrects its robot inside, the body ends there.
    """
    chain = getattr(model, "mechanical_model_", model)
    if not isinstance(chain, Chain):
        raise TypeError(
            "`model` must be a chain, or a HybridForwardModel fitted on one, whose backbone can be "
            f"drawn; got {type(model).__name__} with {type(chain).__name__} as mechanical part. "
            "Give the points along the robot to the display yourself."
        )
    q = shaped(np.atleast_2d(plain(q, "q")), "q", ("K", chain.n_actuators))
    ends = None if tips is None else shaped(tips, "tips", "K3", len(q))
    known = np.isfinite(q).all(axis=1) & (True if ends is None else np.isfinite(ends).all(axis=1))
    rows, learned = torch.from_numpy(q[known]), None

    def spread(values: torch.Tensor | NDArray) -> NDArray:
        """Return rows of known configurations among rows of NaN for the others."""
        full = np.full((len(q), *values.shape[1:]), np.nan)
        full[known] = values
        return full

    if ends is None and isinstance(model, Predictor):
        tip = slice(3) if chain.n_outputs == 3 else slice(-3, None)  # of poses, or of markers
        learned = plain(model.predict(q[known]), "x")[:, tip] if known.any() else np.empty((0, 3))
        if cast(Any, model).module_.fitted.corrects_inside:  # of a HybridForwardModel
            ends, learned = spread(learned), None
    if ends is not None:
        rows = _led_to(chain, rows, torch.from_numpy(ends[known]))
    with torch.no_grad():
        body: dict[str, Any] = {"frames": spread(chain.poses(rows))}
        body["tips"] = spread(chain.tip_model(rows))
        if isinstance(chain, ArcChain):
            points = chain.backbone(rows, n_points)
            actuators, disks = _around_arcs(chain, rows, points.numpy())
            body |= {"actuators": [*map(spread, actuators)], "disks": spread(disks)}
            body["segments"] = np.repeat(range(chain.n_segments), chain.actuators_per_segment)
        else:
            points, body["rigid"] = chain.backbone(rows), True
    body["points"] = spread(points)
    if learned is not None:
        body["predicted"] = spread(learned)
    return body


def _led_to(chain: Chain, q: torch.Tensor, tips: torch.Tensor) -> torch.Tensor:
    """Return configurations near q (K, n) at which the chain's tips are the given ones (K, 3).

    Damped Gauss-Newton steps, the shortest in q; of tips out of reach as near as they come.
    """
    for _ in range(_STEPS):
        x, J = chain.tip_model.forward_and_jacobian(q)
        gram = J @ J.mT
        damping = 1e-6 * gram.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)
        gram = gram + torch.diag_embed(damping.expand(-1, 3))
        q = q + (J.mT @ torch.linalg.solve(gram, (tips - x)[..., None]))[..., 0]
    return q.detach()


def _around_arcs(
    chain: ArcChain, q: torch.Tensor, points: NDArray
) -> tuple[list[NDArray], NDArray]:
    """Return the actuators, each (K, P_i, 3), and the rims of the disks (K, S + 1, C, 3)."""
    bending, frames, offsets = map(plain, (chain.arcs(q)[1], chain.poses(q), chain.offsets))
    radii, S = plain(chain.radii), chain.n_segments
    if chain.stage is not None:  # in the frames that turn with the stage
        bending = bending @ (frames[:, 0, :3, :3].swapaxes(1, 2) @ frames[:, 1, :3, :3])[:, :2, :2]
    n_points = (points.shape[1] - 1) // S
    angles = np.split(plain(chain.angles), np.cumsum(chain.actuators_per_segment)[:-1])
    t = np.linspace(0.0, 1.0, n_points + 1)
    centres, turns = [], []  # positions and orientations along each segment
    for s in range(S):
        centre = points[:, s * n_points : (s + 1) * n_points + 1].copy()
        # The backbone includes the rigid offset, the actuators do not.
        centre[:, -1] -= offsets[s] * frames[:, s + 1, :3, 2]
        # An arc turns evenly about the normal of its bending direction.
        about = np.stack([-bending[:, s, 1], bending[:, s, 0], 0.0 * bending[:, s, 0]], axis=-1)
        turn = Rotation.from_rotvec((t[:, None] * about[:, None]).reshape(-1, 3)).as_matrix()
        centres.append(centre)
        turns.append(frames[:, s, None, :3, :3] @ turn.reshape(len(q), len(t), 3, 3))
    corner = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    rim = _RIM * np.stack([np.cos(corner), np.sin(corner), 0.0 * corner])

    def disk(s: int, k: int, radius: float) -> NDArray:
        return centres[s][:, k, None] + radius * (turns[s][:, k] @ rim).swapaxes(-1, -2)

    actuators, disks = [], [disk(0, 0, radii[0])]
    for s in range(S):
        for angle in angles[s]:
            at = radii[s] * np.array([np.cos(angle), np.sin(angle), 0.0])
            path = [centres[k] + turns[k] @ at for k in range(chain.starts[s], s + 1)]
            actuators.append(np.concatenate(path, axis=1))
        disks.append(disk(s, -1, radii[s:].max() if chain.routing == "base" else radii[s]))
    return actuators, np.stack(disks, axis=1)
