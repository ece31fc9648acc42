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
_SINGULAR = 1e-3  # of a Jacobian: no steps along smaller singular values, relative to the largest
_REACHED = 1e-6  # largest distance of a drawn tip from its place [m]


@runtime_checkable
class Predictor(Protocol):
    """A fitted estimator."""

    def predict(self, X: object, /) -> Any:
        """Return tips (N, m) for actuator vectors (N, n)."""
        ...


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
    drawn = np.asarray(np.isfinite(q).all(axis=1))
    ends = None
    predicted_tips = None
    leads = False
    if tips is not None:
        ends = shaped(tips, "tips", "K3", len(q))
        drawn = drawn & np.isfinite(ends).all(axis=1)
    elif isinstance(model, Predictor):
        predicted_tips = _spread(_predicted_tips(model, chain, q[drawn]), drawn)
        leads = cast(
            Any, model
        ).fitted_module_.corrects_inside  # of a HybridForwardModel
        if leads:
            ends = predicted_tips
    rows = torch.from_numpy(q[drawn])
    if ends is not None:
        rows = _led_to(chain, rows, torch.from_numpy(ends[drawn]))
    with torch.no_grad():
        body: dict[str, Any] = {
            "frames": _spread(chain.poses(rows), drawn),
            "tips": _spread(chain.tip_model(rows), drawn),
        }
        if isinstance(chain, ArcChain):
            arcs = _Arcs(chain, rows, n_points)
            body["points"] = _spread(arcs.backbone, drawn)
            body["actuators"] = [_spread(path, drawn) for path in arcs.actuators()]
            body["disks"] = _spread(arcs.disks(), drawn)
            body["segments"] = np.repeat(
                range(chain.n_segments), chain.actuators_per_segment
            )
        else:
            body["points"] = _spread(chain.backbone(rows), drawn)
            body["rigid"] = True
    if predicted_tips is not None:
        way = np.abs(body["tips"] - predicted_tips)
        if not leads or np.nanmax(way, initial=0.0) > _REACHED:
            body["predicted"] = predicted_tips
    return body


def _spread(values: torch.Tensor | NDArray, drawn: NDArray[np.bool_]) -> NDArray:
    """Return values of drawn configurations among rows of NaN for the others."""
    spread = np.full((len(drawn), *values.shape[1:]), np.nan)
    spread[drawn] = values
    return spread


def _predicted_tips(model: Predictor, chain: Chain, q: NDArray) -> NDArray:
    """Return the tips (K, 3) that a hybrid of the chain predicts, of poses and markers too."""
    if not len(q):
        return np.empty((0, 3))
    x = plain(model.predict(q), "x")
    return x[:, :3] if chain.n_outputs == 3 else x[:, -3:]


def _led_to(chain: Chain, q: torch.Tensor, tips: torch.Tensor) -> torch.Tensor:
    """Return configurations near q (K, n) at which the chain's tips are the given ones (K, 3).

    Gauss-Newton steps, the shortest in q; of tips out of reach as near as they come.
    """
    for _ in range(_STEPS):
        x, J = chain.tip_model.forward_and_jacobian(q)
        step = torch.linalg.pinv(J, rtol=_SINGULAR) @ (tips - x)[..., None]
        q = q + step[..., 0]
    return q.detach()


class _Arcs:
    """The segments of a chain in K configurations: points, and orientations along them."""

    def __init__(self, chain: ArcChain, q: torch.Tensor, n_points: int) -> None:
        self.chain = chain
        self.radii = plain(chain.radii)
        frames = plain(chain.poses(q))
        bending = plain(chain.arcs(q)[1])
        if chain.stage is not None:  # in the frames that turn with the stage
            turned = frames[:, 0, :3, :3].swapaxes(1, 2) @ frames[:, 1, :3, :3]
            bending = bending @ turned[:, :2, :2]
        self.backbone = plain(chain.backbone(q, n_points))
        offsets = plain(chain.offsets)
        along = np.linspace(0.0, 1.0, n_points + 1)[:, None]
        self.centres = []  # (K, P, 3) of each segment
        self.turns = []  # (K, P, 3, 3)
        for s in range(chain.n_segments):
            centre = self.backbone[:, s * n_points : (s + 1) * n_points + 1].copy()
            # The backbone includes the rigid offset, the actuators do not.
            centre[:, -1] -= offsets[s] * frames[:, s + 1, :3, 2]
            # An arc turns evenly about the normal of its bending direction.
            normal = np.zeros((len(q), 1, 3))
            normal[:, 0, 0] = -bending[:, s, 1]
            normal[:, 0, 1] = bending[:, s, 0]
            turn = Rotation.from_rotvec((along * normal).reshape(-1, 3)).as_matrix()
            turn = turn.reshape(len(q), len(along), 3, 3)
            self.centres.append(centre)
            self.turns.append(frames[:, s, None, :3, :3] @ turn)

    def actuators(self) -> list[NDArray]:
        """Return the points of every actuator, each (K, P_i, 3)."""
        chain = self.chain
        segments = np.repeat(range(chain.n_segments), chain.actuators_per_segment)
        paths = []
        for s, angle in zip(segments, plain(chain.angles), strict=True):
            at = self.radii[s] * np.array([np.cos(angle), np.sin(angle), 0.0])
            crossed = range(chain.starts[s], s + 1)
            path = [self.centres[k] + self.turns[k] @ at for k in crossed]
            paths.append(np.concatenate(path, axis=1))
        return paths

    def disks(self) -> NDArray:
        """Return the rims of the disks (K, S + 1, C, 3): at the base and at every segment's end."""
        based = self.chain.routing == "base"
        disks = [self._disk(0, 0, self.radii[0])]
        for s, radius in enumerate(self.radii):
            disks.append(self._disk(s, -1, self.radii[s:].max() if based else radius))
        return np.stack(disks, axis=1)

    def _disk(self, s: int, point: int, radius: float) -> NDArray:
        corner = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
        rim = _RIM * radius * np.stack([np.cos(corner), np.sin(corner), 0.0 * corner])
        turned = (self.turns[s][:, point] @ rim).swapaxes(-1, -2)
        return self.centres[s][:, point, None] + turned
