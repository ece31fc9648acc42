"""A chain of arcs with errors of its structure: zeros, maps of its rings, twist and sag."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import degrees
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from hybridkin._core.arrays import identity
from hybridkin._core.frames import Frames
from hybridkin._core.model import ForwardModel
from hybridkin._core.plan import Plan
from hybridkin._core.stored import Layout, Restore, Stored
from hybridkin.chains._checks import pose
from hybridkin.chains.arc_chain import (
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
        length, _, _ = frames.arcs.unflatten(0, (3, -1))
        has_length = (lengths > 0.0).to(lengths)[:, None]
        at_ends = _Ends.of(frames, lengths)
        return cls(
            _per_length(lengths)[:, None] * length - has_length,
            _between_ends(at_ends.torques, 1).transpose(0, 1),
            _between_ends(at_ends.axes[:2], 2).transpose(1, 2),
        )


def change_of(loads: Loads, arcs: Tensor, lengths: Tensor, weights: Weights) -> Tensor:
    """Return the change (3 S, N) of arcs (3 S, N); it is linear in the weights."""
    _, x, y = arcs.unflatten(0, (3, -1))
    own = torch.stack([loads.strain, x, y])
    linear = torch.einsum("kij,jkn->ikn", weights.maps, own)
    strain, by_x, by_y = weights.zeros.mT[..., None] + linear
    twist = (1.0 + loads.strain) * _along(weights.twists, loads.torques)
    angle = _turned(twist)
    sag = (1.0 + 2.0 * loads.strain) * _along(weights.sags, loads.sideways)
    sag_x, sag_y = _taken_back(sag)
    return torch.cat(
        [
            lengths[:, None] * strain,
            by_x - angle * y + sag_x,
            by_y + angle * x + sag_y,
        ]
    )


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
    chain : ForwardModel
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
        chain: ForwardModel,
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
        self.markers = chain.markers

    def extra_repr(self) -> str:
        """Return the sizes of the errors: the largest segment's, and the motion of the base."""

        def largest(entries: Tensor) -> float:
            return float(entries.flatten(1).norm(dim=1).max())

        turn = 2.0 * torch.asin((self.motion[:3, :3] - identity(3, self.motion)).norm() / 8**0.5)
        origin = self.chain.origin.to(self.motion)
        move = self.motion[:3, :3] @ origin + self.motion[:3, 3] - origin
        sizes = {
            "twist": (degrees(largest(self.twists)), "deg"),
            "sag": (degrees(largest(self.sags)), "deg"),
            "ring maps": (100.0 * largest(self.maps), "%"),
            "zero strain": (100.0 * largest(self.zeros[:, :1]), "%"),
            "zero bend": (degrees(largest(self.zeros[:, 1:])), "deg"),
            "base turn": (degrees(float(turn)), "deg"),
            "base move": (1e3 * float(move.norm()), "mm"),
        }
        return ", ".join(f"{name} {size:.2g} {unit}" for name, (size, unit) in sizes.items())

    @property
    def robot(self) -> ForwardModel:
        """The chain without these errors."""
        return self.chain

    @property
    def without_errors(self) -> ForwardModel:
        """The chain without these errors."""
        return self.chain

    @property
    def tip_model(self) -> StructuralChain:
        """The model of the last marker alone."""
        return self.each_tip()[-1]

    def with_tip(self, at: float) -> StructuralChain:
        """Return a model of another point of the same robot, see `MarkedChain.with_tip`."""
        return self._around(self.chain.with_tip(at))

    def body_lengths(self, q: Tensor) -> Tensor:
        """Return the length (..., S + 1) of the backbone up to the end of every segment [m]."""

        def longer(rows: Tensor) -> tuple[Tensor]:
            frames = self.chain.frames_and_moves(rows)
            change, _, _ = (self._changed(frames) - frames.arcs).chunk(3)
            return (change.mT,)

        (change,) = self.chain.by_rows(longer, q, _BLOCK)
        up_to_end = nn.functional.pad(change.cumsum(-1), (1, 0))
        return self.chain.body_lengths(q) + up_to_end

    def at_length(self, length: float, q: Tensor) -> StructuralChain:
        """Return the model of the point after a length of the body of the chain [m]."""
        return self._around(self.chain.at_length(length, q))

    @property
    def body_radii(self) -> Tensor:
        """Radius of the circle of all actuators in every segment, shape (S,) [m]."""
        return self.chain.body_radii

    def each_tip(self) -> list[StructuralChain]:
        """Return one model per marker, each mapping q (..., n) to x (..., 3)."""
        return [self._around(tip) for tip in self.chain.each_tip()]

    def forward(self, q: Tensor) -> Tensor:
        """Return the tip (..., 3), or all markers (..., 3 K) [m]."""
        (x,) = self.chain.by_rows(self._x_of_rows, q, _BLOCK)
        return x

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip (..., 3) [m] and its Jacobian (..., 3, n) in closed form."""
        x, J = self.chain.by_rows(self._x_and_jacobian, q, _BLOCK)
        return x, J

    def coordinates(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the arcs z + delta(z) up to the tip (N, 3 m), and their derivative (N, 3 m, n).

        With several markers these are the arcs of all segments.
        """
        frames = self.chain.frames_and_moves(q)
        arcs = self._up_to_tip(self._changed(frames))
        slope = self._up_to_tip(self._slope(frames))
        return arcs.mT, slope.permute(2, 0, 1)

    def from_coordinates(self, z: Tensor) -> Tensor:
        """Return the tip (N, 3), or all markers (N, 3 K), at arcs (N, 3 m)."""
        return self._moved(self.chain.from_coordinates(z))

    def from_coordinates_and_jacobian(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return `from_coordinates` and its derivative (N, 3 K, 3 m) by the arcs."""
        return self.placed(*self.chain.from_coordinates_and_jacobian(z))

    def tips_by_coordinates(self) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
        """Return `from_coordinates_and_jacobian` for many calls without derivatives."""
        of_chain = self.chain.tips_by_coordinates()
        return lambda z: self.placed(*of_chain(z))

    def placed(self, x: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Return points (N, 3 K) and their derivatives (N, 3 K, C), moved by T."""
        turn = self.motion[:3, :3].to(columns)
        turned = turn @ columns.unflatten(1, (-1, 3))
        return self._moved(x), turned.flatten(1, 2)

    def has_shape(self, q: Tensor) -> Tensor:
        """Return whether the chain has a shape at q, shape (...), bool."""
        return self.chain.has_shape(q)

    @classmethod
    def from_stored(cls, stored: Stored, restore: Restore) -> StructuralChain:
        """Return the model built from a description."""
        model = super().from_stored(stored, restore)
        n_arcs = model.chain.n_arcs
        if not n_arcs:
            need = "must be a chain of arcs"
            raise ValueError(f"`chain` {need}, got {type(model.chain).__name__}")
        lengths = model.lengths.tolist()
        if len(lengths) != n_arcs or min(lengths) < 0.0 or max(lengths) == 0.0:
            need = f"must hold the lengths of {n_arcs} arcs, zero or more and not all zero"
            raise ValueError(f"`lengths` {need}, got {lengths}")
        pose(model.motion, "motion", model.motion.dtype)
        return model

    def _around(self, chain: ForwardModel) -> StructuralChain:
        """Return a model of another chain with the same errors."""
        weights = self._weights(self.lengths)
        return StructuralChain(chain, self.lengths, *weights, self.motion)

    def joined(self, tips: list[ForwardModel]) -> StructuralChain:
        """Return the model of all markers of models of one marker each."""
        return self._around(self.chain.joined(tips))

    def _weights(self, like: Tensor) -> Weights:
        weights = self.zeros, self.maps, self.twists, self.sags
        return Weights(*[weight.to(like) for weight in weights])

    def _x_of_rows(self, rows: Tensor) -> tuple[Tensor]:
        arcs = self._changed(self.chain.frames_and_moves(rows))
        return (self.from_coordinates(self._up_to_tip(arcs).mT),)

    def _x_and_jacobian(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        z, slope = self.coordinates(rows)
        x, columns = self.from_coordinates_and_jacobian(z)
        return x, columns @ slope

    def _changed(self, frames: Frames) -> Tensor:
        """Return the arcs z + delta(z) (3 S, N)."""
        arcs = frames.arcs
        lengths = self.lengths.to(arcs)
        loads = Loads.of(frames, lengths)
        return arcs + change_of(loads, arcs, lengths, self._weights(arcs))

    def _slope(self, frames: Frames) -> Tensor:
        """Return the derivative (3 S, n, N) of z + delta(z) by q."""
        lengths = self.lengths.to(frames.arcs)
        by_arcs = _derivative(frames, lengths, self._weights(frames.arcs))
        whole = identity(len(by_arcs), by_arcs)[..., None] + by_arcs
        if frames.slope.ndim == 2:
            return torch.einsum("abn,bi->ain", whole, frames.slope)
        return torch.einsum("abn,bin->ain", whole, frames.slope)

    def _up_to_tip(self, arcs: Tensor) -> Tensor:
        """Return arcs (3 S, ...) up to the tip, or all of them for several markers."""
        if len(self.markers) > 1:
            return arcs
        return self.chain.up_to_tip(arcs)

    def _moved(self, x: Tensor) -> Tensor:
        """Return points (N, 3 K) moved by T."""
        motion = self.motion.to(x)
        points = x.unflatten(1, (-1, 3)) @ motion[:3, :3].mT + motion[:3, 3]
        return points.flatten(1)


class _Ends(NamedTuple):
    """The frame of the base and those after all segments, S + 1, in the base frame."""

    axes: Tensor  # (3, 3, S + 1, N): axis, component
    torques: Tensor  # a x d / L, (3, S + 1, N)

    @classmethod
    def of(cls, frames: Frames, lengths: Tensor) -> _Ends:
        """Return the ends for mean lengths (S,) of the segments [m]."""
        axes, points = frames.axes, frames.points
        at_base = identity(3, axes)[..., None, None].expand_as(axes[:, :, :1])
        axes = torch.cat([at_base, axes], dim=2)
        points = torch.cat([torch.zeros_like(points[:, :1]), points], dim=1)
        levers = (points[:, -1:] - points) / lengths.sum()
        return cls(axes, _cross(axes[2], levers))

    def slopes(self, frames: Frames, lengths: Tensor) -> tuple[Tensor, Tensor]:
        """Return the derivatives of the torques and of the x- and y-axes by arcs (3, S).

        Shapes (3, S + 1, 3, S, N) and (2, 3, S + 1, 3, S, N). An arc before a frame turns the frame
        and its lever; an arc after it moves the end of the lever.
        """
        S = len(lengths)
        place = torch.arange(S + 1, device=lengths.device)
        before = (place[:S] < place[:, None])[:, None, :, None]  # (S + 1, 1, S, 1)
        x_axis, y_axis, tangent = self.axes[:, :, :, None, None]
        spins = frames.spins[:, None]
        moves = frames.moves[:, None] / lengths.sum()
        turned = _cross(spins, self.torques[:, :, None, None])
        torques = torch.where(before, turned, _cross(tangent, moves))
        axes = torch.stack([_cross(spins, x_axis), _cross(spins, y_axis)])
        return torques, torch.where(before, axes, 0.0)


def _derivative(frames: Frames, lengths: Tensor, weights: Weights) -> Tensor:
    """Return the derivative (3 S, 3 S, N) of `change_of` by the arcs.

    In the subscripts, segment k has its strain or bending i, by the length or bending p of segment
    l; j are the directions of loads, a those of sags.
    """
    loads = Loads.of(frames, lengths)
    torques, axes = _Ends.of(frames, lengths).slopes(frames, lengths)
    torques = _between_ends(torques, 1)
    axes = _between_ends(axes, 2)
    _, x, y = frames.arcs.unflatten(0, (3, -1))
    kinds = identity(3, x)
    segments = identity(len(lengths), x)

    ones = torch.ones_like(lengths)
    rates = torch.stack([_per_length(lengths), ones, ones])
    linear = torch.einsum("kip,pk,kl->ikpl", weights.maps, rates, segments)
    strain = torch.einsum("p,k,kl->kpl", kinds[0], rates[0], segments)[..., None]

    twist = _along(weights.twists, loads.torques)
    by_torques = torch.einsum("kj,jkpln->kpln", weights.twists, torques)
    by_twist = (1.0 + loads.strain)[:, None, None] * by_torques
    by_twist = _turned(by_twist + strain * twist[:, None, None])
    angle = _turned((1.0 + loads.strain) * twist)
    rotated = torch.einsum("kl,kn->kln", segments, angle)

    sag = _along(weights.sags, loads.sideways)
    by_axes = torch.einsum("kj,ajkpln->akpln", weights.sags, axes)
    by_sag = (1.0 + 2.0 * loads.strain)[:, None, None] * by_axes
    by_sag = _taken_back(by_sag + 2.0 * strain * sag[:, :, None, None])

    by_x = by_sag[0] - y[:, None, None] * by_twist
    by_y = by_sag[1] + x[:, None, None] * by_twist
    by_x = by_x - kinds[2][:, None, None] * rotated[:, None]
    by_y = by_y + kinds[1][:, None, None] * rotated[:, None]
    change = torch.stack([torch.zeros_like(by_x), by_x, by_y]) + linear[..., None]
    sizes = torch.stack([lengths, ones, ones])
    return (sizes[..., None, None, None] * change).flatten(0, 1).flatten(1, 2)


def _per_length(lengths: Tensor) -> Tensor:
    """Return 1 / lbar (S,); zero for segments of no length."""
    has_length = lengths > 0.0
    return torch.where(has_length, 1.0 / torch.where(has_length, lengths, 1.0), 0.0)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Return a x b along the first axis."""
    return torch.linalg.cross(a, b, dim=0)


def _between_ends(ends: Tensor, dim: int) -> Tensor:
    """Return the mean over both ends of every segment, from S + 1 ends along `dim`."""
    S = ends.shape[dim] - 1
    return 0.5 * (ends.narrow(dim, 0, S) + ends.narrow(dim, 1, S))


def _along(weights: Tensor, loads: Tensor) -> Tensor:
    """Return the sum over loads (..., S, 3, N) times weights (S, 3), shape (..., S, N)."""
    return (weights[..., None] * loads).sum(-2)


def _turned(twist: Tensor) -> Tensor:
    """Return the angle of every segment: the twists (S, ...) before it, and half its own."""
    return twist.cumsum(0) - 0.5 * twist


def _taken_back(sag: Tensor) -> Tensor:
    """Return the sag (2, S, ...) of every segment minus that of the one before it."""
    before = torch.cat([torch.zeros_like(sag[:, :1]), sag[:, :-1]], dim=1)
    return sag - before
