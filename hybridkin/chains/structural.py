"""A chain of arcs with errors of its structure: zeros, maps of its rings, twist and sag."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hybridkin._core.arrays import identity
from hybridkin._core.blocks import in_blocks
from hybridkin._core.model import ForwardModel
from hybridkin._core.plan import Plan
from hybridkin._core.stored import Layout, Stored
from hybridkin.chains.arc_chain import (
    ArcChain,
    Frames,
    each_marker,
    frame_numbers,
    write_whole_chain,
)

_BLOCK = 2048  # rows, whose temporaries stay in the cache


class Weights(NamedTuple):
    """Errors of the structure of S segments, in natural units.

    Attributes
    ----------
    zeros : Tensor of shape (S, 3)
        Constant strain [-] and bending [rad].
    maps : Tensor of shape (S, 3, 3)
        Strain and bending that follow linearly from the segment's own strain and bending.
    twists : Tensor of shape (S, 3)
        Twist of a segment by the torque of a load along each axis of the base [rad].
    sags : Tensor of shape (S, 3)
        Bending of a segment, which the next one takes back, by the same loads [rad].
    """

    zeros: Tensor
    maps: Tensor
    twists: Tensor
    sags: Tensor


class Loads(NamedTuple):
    """What loads along the axes e_j of the base do to S segments; the batch N comes last.

    Attributes
    ----------
    strain : Tensor of shape (S, N)
        l / lbar - 1; zero for a segment of no length.
    torques : Tensor of shape (S, 3, N)
        e_j . (a x d) / L, the mean over both ends of the segment: the tangent a, the lever d to the
        robot's end, and the length L of the robot.
    sideways : Tensor of shape (2, S, 3, N)
        e_j along the x- and the y-axis of the segment, the mean over both ends.
    """

    strain: Tensor
    torques: Tensor
    sideways: Tensor

    @classmethod
    def of(cls, frames: Frames, lengths: Tensor) -> Loads:
        """Return the loads at rows; `lengths` (S,) are the mean lengths of the segments [m]."""
        torques, sideways = _at_ends(frames, lengths.sum())
        return cls(
            _strain(frames.arcs, lengths),
            _between(torques).transpose(0, 1),
            _between(sideways).permute(0, 2, 1, 3),
        )


def change_of(loads: Loads, arcs: Tensor, lengths: Tensor, weights: Weights) -> Tensor:
    """Return the change (3 S, N) of arcs (3 S, N); it is linear in the weights."""
    _, x, y = arcs.unflatten(0, (3, -1))
    own = torch.stack([loads.strain, x, y])
    linear = torch.einsum("kij,jkn->ikn", weights.maps, own)
    strain, by_x, by_y = weights.zeros.mT[..., None] + linear
    angle = _turned((1.0 + loads.strain) * _along(weights.twists, loads.torques))
    sag = (1.0 + 2.0 * loads.strain) * _along(weights.sags, loads.sideways)
    sag_x, sag_y = _taken_back(sag, 1)
    by_x = by_x - angle * y + sag_x
    by_y = by_y + angle * x + sag_y
    return torch.cat([lengths[:, None] * strain, by_x, by_y])


def _write_plan(plan: Plan, stored: Stored) -> int:
    """Write the node of a chain: its frame, moved by T, then numbers of its segments."""
    chain = stored.part("chain")
    tips = each_marker(chain)
    if len(tips) > 1:
        return plan.stack([replace(stored, parts={"chain": tip}) for tip in tips])
    base = stored.array("motion") @ chain.array("base")
    moved = replace(chain, arrays={**chain.arrays, "base": base})
    lengths = stored.array("lengths")
    reach = lengths.sum()
    frame, parts = frame_numbers(plan, moved, reach)
    robot = write_whole_chain(plan, chain)

    n_segments = len(lengths)
    has_length = lengths > 0.0
    by_length = has_length / np.where(has_length, lengths, 1.0)
    changes = np.dstack([stored.array("zeros"), stored.array("maps")])
    changes[:, 0] *= lengths[:, None]
    # Loads are means over the two ends of a segment; torques are relative to the robot's length.
    twists = 0.5 / reach * stored.array("twists")
    sags = 0.5 * stored.array("sags")
    up_to_tip = np.append(parts, np.zeros(n_segments - len(parts)))
    segments = [by_length, has_length, chain.array("offsets"), changes[:, :, 0]]
    segments += [changes[:, :, 1:].reshape(n_segments, 9), twists, sags, up_to_tip]
    numbers = [frame, np.column_stack(segments)]
    n, _ = plan.lengths(robot)
    return plan.node("structural", n, 3, numbers, len(parts), robot, n_segments)


class StructuralChain(ForwardModel):
    """A chain of arcs with errors of its structure, x = T F(z + delta(z)).

    z are the arcs of a chain: the length l_k and the bending b_k of every segment. With the strain
    e_k = l_k / lbar_k - 1 and J b = (-b_y, b_x), the errors of segment k are::

        delta l_k = lbar_k [zeros_k + maps_k (e_k, b_k)]_0
        delta b_k = [zeros_k + maps_k (e_k, b_k)]_12 + Phi_k J b_k + s_k - s_(k-1)
        Phi_k     = phi_1 + ... + phi_(k-1) + phi_k / 2,   phi_k = (1 + e_k) twists_k . tau_k
        s_k       = (1 + 2 e_k) (x_k . sags_k, y_k . sags_k)

    A load at the robot's end, such as its own weight, twists every segment by its torque tau_k
    about the segment's axis. The twist turns the bending of all later segments, and half of it that
    of the segment itself. The same load moves the end of a segment sideways, along its axes x_k and
    y_k, without turning it: the segment bends, and the next one bends back. tau_k, x_k and y_k are
    means over the two ends of the segment, see `Loads`. The three entries of `twists` and `sags`
    belong to loads along the axes of the base, so the direction of gravity is learned. T moves the
    base.

    Parameters
    ----------
    chain : ArcChain
        The chain, whose arcs are one for each segment.
    lengths : Tensor of shape (S,)
        Mean length lbar of every segment in the log [m]; 0 for a segment without one.
    zeros, maps, twists, sags : Tensor
        The errors, see `Weights`.
    motion : Tensor of shape (4, 4)
        T, a rigid motion in the measuring frame.
    """

    layout = Layout(
        "structural_chain",
        {
            "lengths": "s",
            "zeros": "sc",
            "maps": "scc",
            "twists": "sc",
            "sags": "sc",
            "motion": "rr",
        },
        parts=("chain",),
        write_plan=_write_plan,
    )

    def __init__(
        self,
        chain: ArcChain,
        lengths: Tensor,
        zeros: Tensor,
        maps: Tensor,
        twists: Tensor,
        sags: Tensor,
        motion: Tensor,
    ) -> None:
        super().__init__()
        self.chain = chain
        self.register_buffer("lengths", lengths)
        self.register_buffer("zeros", zeros)
        self.register_buffer("maps", maps)
        self.register_buffer("twists", twists)
        self.register_buffer("sags", sags)
        self.register_buffer("motion", motion)
        self.n_actuators = chain.n_actuators
        self.n_outputs = chain.n_outputs

    @property
    def robot(self) -> ArcChain:
        """The chain without these errors."""
        return self.chain

    def each_tip(self) -> list[StructuralChain]:
        """Return one model per marker, each mapping q (..., n) to x (..., 3)."""
        weights = self.lengths, *self._weights(self.lengths)
        return [
            StructuralChain(tip, *weights, self.motion) for tip in self.chain.each_tip()
        ]

    def forward(self, q: Tensor) -> Tensor:
        """Return the tip (..., 3), or all markers (..., 3 K) [m]."""
        return in_blocks(
            lambda rows: (self.from_coordinates(self._arcs(rows)),), q, _BLOCK
        )[0]

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip (..., 3) [m] and its Jacobian (..., 3, n) in closed form."""
        x, J = in_blocks(self._rows_and_jacobian, q, _BLOCK)
        return x, J

    def coordinates(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the arcs z + delta(z) up to the tip (N, 3 m), and their derivative (N, 3 m, n)."""
        frames = self.chain.frames_and_moves(q)
        slope = self._slope(frames)
        return self._up_to_tip(self._changed(frames)).mT, self._up_to_tip(
            slope
        ).permute(2, 0, 1)

    def from_coordinates(self, z: Tensor) -> Tensor:
        """Return the tip (N, 3), or all markers, at arcs (N, 3 m)."""
        return self._moved(self.chain.from_coordinates(z))

    def from_coordinates_and_jacobian(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return `from_coordinates` and its derivative (N, 3 K, 3 m) by the arcs."""
        return self.moved(*self.chain.from_coordinates_and_jacobian(z))

    def moved(self, x: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Return points (N, 3 K) and their derivatives (N, 3 K, C), moved by T."""
        turn = self.motion[:3, :3].to(columns)
        turned = turn @ columns.unflatten(1, (-1, 3))
        return self._moved(x), turned.flatten(1, 2)

    def has_shape(self, q: Tensor) -> Tensor:
        """Return whether the chain has a shape at q, shape (...), bool."""
        return self.chain.has_shape(q)

    def _weights(self, like: Tensor) -> Weights:
        return Weights(
            self.zeros.to(like),
            self.maps.to(like),
            self.twists.to(like),
            self.sags.to(like),
        )

    def _rows_and_jacobian(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        z, slope = self.coordinates(rows)
        x, columns = self.from_coordinates_and_jacobian(z)
        return x, columns @ slope

    def _arcs(self, rows: Tensor) -> Tensor:
        """Return the arcs z + delta(z) up to the tip (N, 3 m) of rows (N, n)."""
        return self._up_to_tip(self._changed(self.chain.frames_and_moves(rows))).mT

    def _changed(self, frames: Frames) -> Tensor:
        """Return the arcs z + delta(z) (3 S, N)."""
        arcs = frames.arcs
        lengths = self.lengths.to(arcs)
        loads = Loads.of(frames, lengths)
        return arcs + change_of(loads, arcs, lengths, self._weights(arcs))

    def _up_to_tip(self, arcs: Tensor) -> Tensor:
        """Return arcs (3 S, ...) up to the tip, or all of them for several markers."""
        if len(self.chain.markers) > 1:
            return arcs
        return self.chain.up_to_tip(arcs)

    def _moved(self, x: Tensor) -> Tensor:
        """Return points (N, 3 K) moved by T."""
        motion = self.motion.to(x)
        points = x.unflatten(1, (-1, 3)) @ motion[:3, :3].mT + motion[:3, 3]
        return points.flatten(1)

    def _slope(self, frames: Frames) -> Tensor:
        """Return the derivative (3 S, n, N) of z + delta(z) by q."""
        arcs = frames.arcs
        lengths = self.lengths.to(arcs)
        weights = self._weights(arcs)
        loads = Loads.of(frames, lengths)
        by_arcs = _derivative(frames, loads, lengths, weights)
        S = len(lengths)
        whole = by_arcs.reshape(3 * S, 3 * S, -1) + identity(3 * S, arcs)[..., None]
        slope = frames.slope
        if slope.ndim == 2:
            return torch.einsum("abn,bi->ain", whole, slope)
        return torch.einsum("abn,bin->ain", whole, slope)


def without_errors(model: ForwardModel) -> ForwardModel:
    """Return the chain of a StructuralChain, any other model as it is."""
    return model.chain if isinstance(model, StructuralChain) else model


def _derivative(
    frames: Frames, loads: Loads, lengths: Tensor, weights: Weights
) -> Tensor:
    """Return the derivative (3, S, 3, S, N) of `change_of` by the arcs, kind by kind."""
    S = len(lengths)
    _, x, y = frames.arcs.unflatten(0, (3, -1))
    strain_of = _strain(identity(S, lengths), lengths) - _strain(
        torch.zeros_like(lengths)[:, None], lengths
    )
    torques, sideways = _slopes_at_ends(frames, lengths.sum())
    # The own strain, x- and y-bending (3, S) by all arcs (3, S): constant.
    own = torch.stack([strain_of, identity(S, lengths), identity(S, lengths)])
    kinds = identity(3, lengths)
    by_own = torch.einsum("kij,jkl->ikjl", weights.maps, own)
    # Twists.
    twist = _along(weights.twists, loads.torques)
    by_twist = torch.einsum("kj,jkpln->kpln", weights.twists, _between(torques))
    by_twist = (1.0 + loads.strain)[:, None, None] * by_twist
    by_twist = by_twist + torch.einsum("p,kl,kn->kpln", kinds[0], strain_of, twist)
    angle = _turned((1.0 + loads.strain) * twist)
    by_angle = _turned(by_twist)
    # Sags.
    sag = _along(weights.sags, loads.sideways)
    by_sag = torch.einsum("kj,ajkpln->akpln", weights.sags, _between(sideways))
    by_sag = (1.0 + 2.0 * loads.strain)[:, None, None] * by_sag
    by_sag = by_sag + 2.0 * torch.einsum("p,kl,akn->akpln", kinds[0], strain_of, sag)
    by_sag = _taken_back(by_sag, 1)
    diagonal = torch.einsum("kl,kn->kln", identity(S, lengths), angle)
    by_x = by_sag[0] - y[:, None, None] * by_angle
    by_x = by_x - kinds[2][:, None, None] * diagonal[:, None]
    by_y = by_sag[1] + x[:, None, None] * by_angle
    by_y = by_y + kinds[1][:, None, None] * diagonal[:, None]
    none = torch.zeros_like(by_x)
    change = torch.stack([none, by_x, by_y]) + by_own[..., None]
    return torch.cat([lengths[:, None, None, None] * change[:1], change[1:]])


def _strain(arcs: Tensor, lengths: Tensor) -> Tensor:
    """Return l / lbar - 1 (S, N) of arcs (3 S, N); zero for segments of no length."""
    has_length = lengths > 0.0
    safe = torch.where(has_length, lengths, 1.0)[:, None]
    strain = arcs[: len(lengths)] / safe - 1.0
    return torch.where(has_length[:, None], strain, 0.0)


def _at_ends(frames: Frames, length: Tensor) -> tuple[Tensor, Tensor]:
    """Return a x d / L (3, S + 1, N) and the x- and y-axes (2, 3, S + 1, N) of all frames.

    The first frame is that of the base.
    """
    axes, points = _with_base(frames)
    lever = (points[:, -1:] - points) / length
    return torch.linalg.cross(axes[2], lever, dim=0), axes[:2]


def _with_base(frames: Frames) -> tuple[Tensor, Tensor]:
    """Return axes (3, 3, S + 1, N) and origins (3, S + 1, N) of all frames and of the base."""
    at_base = identity(3, frames.axes)[..., None, None].expand_as(frames.axes[:, :, :1])
    axes = torch.cat([at_base, frames.axes], dim=2)
    origin = torch.zeros_like(frames.points[:, :1])
    return axes, torch.cat([origin, frames.points], dim=1)


def _slopes_at_ends(frames: Frames, length: Tensor) -> tuple[Tensor, Tensor]:
    """Return the derivatives of `_at_ends` by the arcs (3, S) of all segments.

    Shapes (3, S + 1, 3, S, N) and (2, 3, S + 1, 3, S, N). An arc before a frame turns the frame and
    its lever; an arc after it moves the end of the lever.
    """
    axes, _ = _with_base(frames)
    torque, _ = _at_ends(frames, length)
    S = frames.points.shape[1]
    steps = torch.arange(S + 1, device=torque.device)
    before = (steps[None, :S] < steps[:, None])[:, None, :, None]  # (S + 1, 1, S, 1)
    spins = frames.spins[:, None]  # (3, 1, 3, S, N)
    turned = torch.linalg.cross(*_shaped(spins, torque[:, :, None, None]), dim=0)
    moves = frames.moves[:, None] / length
    moved = torch.linalg.cross(*_shaped(axes[2][:, :, None, None], moves), dim=0)
    sideways = []
    for axis in axes[:2]:
        spun = torch.linalg.cross(*_shaped(spins, axis[:, :, None, None]), dim=0)
        sideways.append(torch.where(before, spun, 0.0))
    return torch.where(before, turned, moved), torch.stack(sideways)


def _shaped(a: Tensor, b: Tensor) -> tuple[Tensor, ...]:
    return torch.broadcast_tensors(a, b)


def _between(ends: Tensor) -> Tensor:
    """Return the mean over both ends of every segment, from values at S + 1 ends.

    The ends are the second-last axis of loads, and that before the arcs of derivatives.
    """
    at = 2 if ends.ndim in (4, 6) else 1
    S = ends.shape[at] - 1
    return 0.5 * (ends.narrow(at, 0, S) + ends.narrow(at, 1, S))


def _along(weights: Tensor, loads: Tensor) -> Tensor:
    """Return the sum over loads (..., S, 3, N) times weights (S, 3), shape (..., S, N)."""
    return (weights[..., None] * loads).sum(-2)


def _turned(twist: Tensor) -> Tensor:
    """Return the angle of every segment: the twists (S, ...) before it, and half its own."""
    return twist.cumsum(0) - 0.5 * twist


def _taken_back(sag: Tensor, at: int) -> Tensor:
    """Return the sag of every segment minus that of the one before it, along an axis."""
    first = torch.zeros_like(sag.narrow(at, 0, 1))
    previous = torch.cat([first, sag.narrow(at, 0, sag.shape[at] - 1)], dim=at)
    return sag - previous
