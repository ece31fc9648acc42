"""What a robot looks like in given configurations, as plain arrays: read off its chain."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sklearn.utils.validation import check_is_fitted

from hybridkin.plots._canvas import plain, predicted

_POINTS = 12  # per segment: a quarter circle then looks round
_RIM = 1.15  # of the actuator circle
_CORNERS = 25


class Body(NamedTuple):
    """A robot in K configurations, all in the measuring frame [m]."""

    points: NDArray  # (K, P, 3) along the backbone
    frames: NDArray  # (K, F, 4, 4): base, ends of the segments or links
    actuators: tuple[NDArray, ...]  # each (K, P_i, 3)
    segments: tuple[int, ...]  # that the actuators bend, one per actuator
    disks: NDArray  # (K, D, C, 3): rims of the base's and the segments' end disks
    rigid: bool  # straight links between the points
    tips: NDArray  # (K, 3) that the chain gives
    predicted: NDArray | None  # (K, 3) with what was learned


def mechanical_part(model: Any) -> Any:
    """Return the model itself, or what a fitted hybrid model has as mechanical model."""
    if not hasattr(model, "predict"):
        return model
    check_is_fitted(model)
    return getattr(model, "mechanical_model_", None)


def body_of(model: Any, q: Any, n_points: int = _POINTS) -> Body:
    """Return the robot in the configurations q (K, n) or (n,)."""
    chain = mechanical_part(model)
    if not (hasattr(chain, "backbone") and hasattr(chain, "poses")):
        raise TypeError(
            "`model` must be a chain, or a HybridForwardModel fitted on one, whose backbone can be "
            f"drawn; got {type(model).__name__} with {type(chain).__name__} as mechanical part. "
            "Give the points along the robot to the display yourself."
        )
    q = np.atleast_2d(plain(q, "q"))
    n = chain.n_actuators
    if q.ndim != 2 or q.shape[1] != n:
        raise ValueError(f"`q` must have shape (K, {n}) or ({n},), got {q.shape}.")
    known = np.isfinite(q).all(axis=1)
    rows = torch.from_numpy(q[known])
    with torch.no_grad():
        frames = plain(chain.poses(rows))
        arcs = hasattr(chain, "arcs")
        points = plain(chain.backbone(rows, n_points) if arcs else chain.backbone(rows))
        shape = _on_arcs(chain, rows, frames, points, n_points) if arcs else None
        tips = plain(chain(rows))
    actuators, segments, disks = shape or ((), (), np.empty((len(rows), 0, _CORNERS, 3)))
    learned = None
    if chain is not model:
        learned = predicted(model, q[known])[:, :3] if known.any() else np.empty((0, 3))
    return Body(
        _spread(points, known),
        _spread(frames, known),
        tuple(_spread(path, known) for path in actuators),
        segments,
        _spread(disks, known),
        not arcs,
        _spread(tips, known),
        None if learned is None else _spread(learned, known),
    )


def _spread(rows: NDArray, known: NDArray) -> NDArray:
    """Return rows of known configurations among rows of NaN for the others."""
    full = np.full((len(known), *rows.shape[1:]), np.nan)
    full[known] = rows
    return full


def _on_arcs(
    chain: Any, q: torch.Tensor, frames: NDArray, points: NDArray, n_points: int
) -> tuple[tuple[NDArray, ...], tuple[int, ...], NDArray]:
    """Return actuators, their segments and disks beside the backbone of a chain of arcs."""
    _, bending = (plain(part) for part in chain.arcs(q))
    radii, offsets = plain(chain.radii), plain(chain.offsets)
    counts = chain.actuators_per_segment
    angles = np.split(plain(chain.angles), np.cumsum(counts)[:-1])
    S = len(counts)
    t = np.linspace(0.0, 1.0, n_points + 1)
    centres, turns = [], []
    for s in range(S):
        centre = points[:, s * n_points : (s + 1) * n_points + 1].copy()
        # The backbone ends behind the rigid offset, the actuators before it.
        centre[:, -1] -= offsets[s] * frames[:, s + 1, :3, 2]
        # An arc turns about the normal of its bending direction, evenly along the way.
        about = np.stack([-bending[:, s, 1], bending[:, s, 0], 0.0 * bending[:, s, 0]], axis=-1)
        turn = Rotation.from_rotvec((t[:, None] * about[:, None]).reshape(-1, 3)).as_matrix()
        centres.append(centre)
        turns.append(frames[:, s, None, :3, :3] @ turn.reshape(len(q), -1, 3, 3))
    actuators, segments = [], []
    for s in range(S):
        first = 0 if chain.routing == "base" else s
        for angle in angles[s]:
            at = radii[s] * np.array([np.cos(angle), np.sin(angle), 0.0])
            path = [centres[k] + turns[k] @ at for k in range(first, s + 1)]
            actuators.append(np.concatenate(path, axis=1))
            segments.append(s)
    corner = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    rim = _RIM * np.stack([np.cos(corner), np.sin(corner), 0.0 * corner])
    disks = [centres[0][:, 0, None] + radii[0] * (turns[0][:, 0] @ rim).swapaxes(-1, -2)]
    for s in range(S):
        widest = radii[s:].max() if chain.routing == "base" else radii[s]
        disks.append(centres[s][:, -1, None] + widest * (turns[s][:, -1] @ rim).swapaxes(-1, -2))
    return tuple(actuators), tuple(segments), np.stack(disks, axis=1)
