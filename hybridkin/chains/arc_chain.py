"""Base class of all chains of circular arcs: tip, poses and derivatives from the arcs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.arrays import as_array, identity, whole
from hybridkin._core.blocks import check_vectors, in_blocks
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.plausible import PlausibleRows
from hybridkin._core.stored import Restore, Stored
from hybridkin._core.stumpff import stumpff
from hybridkin._core.units import LONGEST_PULL, millimetres_message
from hybridkin.chains._arcs import (
    levers,
    reading_matrix,
    rolled,
    tip,
    tip_and_columns,
    transforms,
)
from hybridkin.chains._checks import arc_geometry, path_starts, stored_arguments
from hybridkin.chains.markers import MarkedChain

if TYPE_CHECKING:
    from typing_extensions import Self

ALIASES = {"turns": "angles", "tool": "offsets", "gain": "gains"}
"""Parameters of `calibrate` that change a part of an entry of the geometry, and that entry."""

Change = Callable[[Tensor, Mapping[str, Tensor]], Tensor]
_LONGEST = 10.0  # largest plausible length of an extensible segment [m]
STRUCTURE = {
    "actuators_per_segment": list,
    "tip_at": float,
    "markers": list,
    "routing": str,
}


def frame_numbers(plan: Plan, stored: Stored, reach: float) -> tuple[NDArray, NDArray]:
    """Return the numbers of the frame of a chain, and the parts (m,) of its arcs up to the tip.

    The frame is the rotation and position of the base, the reach, and the rigid offsets.
    """
    base = stored.array("base")
    offsets = stored.array("offsets")
    tip_at = stored.value("tip_at", float)
    markers = stored.settings.get("markers", [[tip_at, 0.0, 0.0, 0.0]])
    _, x, y, z = markers[0]
    if len(markers) > 1 or x or y:
        raise NoKernel(
            "several markers, or a marker beside the backbone, have no kernel"
        )
    plan.limit("segments", len(offsets))
    m = math.ceil(tip_at)
    parts = np.append(np.ones(m - 1), tip_at - m + 1)
    rigid = offsets[:m] * (parts == 1)
    rigid[-1] += z
    return np.concatenate([base[:3, :3].ravel(), base[:3, 3], [reach], rigid]), parts


def write_whole_chain(plan: Plan, stored: Stored) -> int:
    """Write the node of a chain of arcs up to the robot's end, wherever its tip is."""
    end = float(len(stored.array("offsets")))
    settings = {**stored.settings, "tip_at": end, "markers": [[end, 0.0, 0.0, 0.0]]}
    return plan.node_of(replace(stored, settings=settings))


class Frames(NamedTuple):
    """Frames after all segments and their offsets, in the base frame; the batch N comes last."""

    axes: Tensor  # (3, 3, S, N): axis, component
    points: Tensor  # (3, S, N) origins [m]
    moves: (
        Tensor  # (3, 3, S, N): velocity of the robot's end per length, x- and y-bending
    )
    spins: Tensor  # (3, 3, S, N): its angular velocity per the same
    slope: Tensor  # d arcs / dq, (3 S, n) or (3 S, n, N)


class ArcChain(MarkedChain):
    """A chain of circular arcs; subclasses define how the actuators shape them.

    A subclass defines `_arcs_and_slope` and `_arcs_and_change`.
    """

    _structure = (
        *STRUCTURE,
        "n_segments",
        "n_actuators",
        "n_outputs",
        "extensible",
        "starts",
    )

    actuators_per_segment: tuple[int, ...]
    routing: str
    extensible: tuple[bool, ...]  # for each segment; the others have lengths
    starts: tuple[int, ...]  # first segment that each segment's actuators run through
    stage: str | None = None  # "rotation" if the first segment is a rotation stage
    radii: Tensor  # (S,)
    angles: Tensor  # (n,)
    offsets: Tensor  # (S,)
    rest_bends: Tensor  # (S, 2)
    gains: Tensor  # (n,) metres per unit of q
    lengths: Tensor | None  # of the inextensible segments; None if there are none

    @property
    def reach(self) -> Tensor:
        """Size of the robot, shape () [m]: its backbone length, or 10 mean radii without one."""
        return 10.0 * self.radii.mean() if self.lengths is None else self.lengths.sum()

    @property
    def rigid_length(self) -> Tensor:
        """Upper bound of the length of rigid offsets and of the way to a marker, shape () [m]."""
        beside = self.offsets.new_tensor(self.markers)[:, 1:]
        return self.offsets.abs().sum() + beside.abs().sum()

    @property
    def absolute(self) -> Tensor:
        """Which actuators (n,) have absolute lengths: those of extensible segments, bool."""
        absolute = np.repeat(self.extensible, self.actuators_per_segment)
        absolute[: self.stage is not None] = False
        return torch.from_numpy(absolute).to(self.radii.device)

    @property
    def in_metres(self) -> bool:
        """Whether q is in metres: all gains are 1."""
        return bool((self.gains == 1.0).all())

    @property
    def rest(self) -> Tensor:
        """The q (n,) at which tendons are not displaced and chambers have length 0."""
        zeros = self._buffers.get("actuator_zeros")
        return 0.0 * self.gains if zeros is None else zeros

    def metres(self, q: Tensor) -> Tensor:
        """Return q (..., n) in metres: lengths, or changes of length."""
        check_vectors(q, self.n_actuators, "q", self._why_shape())
        return self.gains.to(q) * (q - self.rest.to(q))

    def _checked(self, routing: str, *given: Any) -> dict[str, Tensor]:
        """Set the structure of the chain, and return the `arc_geometry` of the arguments."""
        counts, self.extensible, geometry = arc_geometry(*given)
        self.actuators_per_segment = counts
        self.starts = path_starts(routing, counts, self.extensible)
        self.n_segments = len(geometry["radii"])
        self.n_actuators = len(geometry["angles"])
        self.routing = routing
        self._set_markers([(self.n_segments, 0.0, 0.0, 0.0)])
        return geometry

    def _set_geometry(self, geometry: Mapping[str, Tensor | None]) -> None:
        for name in self._entries:
            self.register_buffer(name, geometry.get(name))

    def forward(self, q: Tensor) -> Tensor:
        """Return the tip position.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].

        Returns
        -------
        Tensor of shape (..., 3)
            Tip position in the measuring frame [m].
        """
        return in_blocks(self._forward, q, 8192)[0]

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip (..., 3) [m] and its Jacobian (..., 3, n_actuators) [-] in one pass."""
        check_vectors(q, self.n_actuators, "q", self._why_shape())
        x, J = in_blocks(self._forward_and_jacobian, q)
        return x, J

    def pose_jacobian(self, q: Tensor) -> Tensor:
        """Return the tip's linear [-] and angular [rad/m] Jacobian, shape (..., 6, n_actuators).

        The angular rows give the angular velocity in the measuring frame.
        """
        arcs, slope = self._arcs_and_slope(self._rows(q))
        _, columns = tip_and_columns(
            *self._to_point(self.up_to_tip(arcs)), angular=True
        )
        parts = [self._by_actuators(part, slope, q) for part in columns.chunk(2, dim=1)]
        J = torch.cat(parts, dim=-2)
        if self.stage is not None:  # the stage turns the tip's frame too
            J[..., 3:, 0] = (self.gains[0] * self.base[:3, 2]).to(q)
        return J

    def geometry_jacobian(self, q: Tensor, tangents: Mapping[str, Tensor]) -> Tensor:
        """Return the derivative of the tip along changes of the geometry, in closed form.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].
        tangents : dict of str to Tensor of shape (P, ...)
            P changes of entries of `geometry()`, stacked; other entries do not change.

        Returns
        -------
        Tensor of shape (..., 3, P)
            Derivative of the tip along every change [m per unit of the change].

        Examples
        --------
        >>> import torch
        >>> from hybridkin import ConstantCurvatureChain
        >>> chain = ConstantCurvatureChain([0.01], lengths=[0.1])
        >>> longer = {"lengths": torch.ones(1, 1, dtype=torch.float64)}
        >>> chain.geometry_jacobian(torch.zeros(3, dtype=torch.float64), longer).flatten()
        tensor([0., 0., 1.], dtype=torch.float64)
        """
        self._check_tangents(tangents)
        self._rows(q)  # checks it
        tangents = {name: value.to(q) for name, value in tangents.items()}
        tips = self.tips()

        def along(rows: Tensor) -> tuple[Tensor]:
            arcs, change = self._arcs_and_change(rows)
            return (
                torch.cat([one._along(arcs, change, tangents) for one in tips], dim=1),
            )

        return in_blocks(along, q)[0]

    def _along(
        self, arcs: Tensor, change: Change, tangents: Mapping[str, Tensor]
    ) -> Tensor:
        """Return the derivative (N, 3, P) of the tip along P changes, at arcs (3 S, N)."""
        place = self._to_point(self.up_to_tip(arcs))
        tail, columns = tip_and_columns(*place, rigid=True)
        columns = self._turned(columns).permute(2, 0, 1).contiguous()
        S = len(place[0])
        by_arcs, by_offsets = columns.split([3 * S, S], dim=2)
        J = change(
            by_arcs @ self.up_to_tip(identity(3 * self.n_segments, arcs)), tangents
        )
        if "offsets" in tangents:
            J = J + by_offsets @ self._tip_offsets(tangents["offsets"]).T
        if "base" in tangents:
            turned = tail.T @ tangents["base"][:, :3, :3].permute(2, 1, 0).flatten(1)
            J = J + turned.unflatten(1, J.shape[1:]) + tangents["base"][:, :3, 3].T
        return J

    def arcs(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the arc of every segment.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].

        Returns
        -------
        length : Tensor of shape (..., S)
            Centre-line lengths [m].
        bending : Tensor of shape (..., S, 2)
            Bending vectors [rad]: the norm is the bend angle, the direction is that of the bend.
            A rotation stage turns them too.
        """
        return self._leading(self._arcs(q), q)

    def poses(self, q: Tensor) -> Tensor:
        """Return the pose of the base and of the end of every segment, after its offset.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].

        Returns
        -------
        Tensor of shape (..., S + 1, 4, 4)
            Homogeneous transforms into the measuring frame; the last one is the robot's end.
        """
        return self._poses(*self.arcs(q), self.offsets, q)

    def pose(self, q: Tensor) -> Tensor:
        """Return the tip's pose in the measuring frame, shape (..., 4, 4)."""
        arcs = self._leading(self.up_to_tip(self._arcs(q)), q)
        beside = identity(4, q)
        beside[:3, 3] = q.new_tensor(self.markers[-1][1:])
        return (
            self._poses(*arcs, self._tip_offsets(self.offsets), q)[..., -1, :, :]
            @ beside
        )

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return `pose(q)` and `pose_jacobian(q)`."""
        return self.pose(q), self.pose_jacobian(q)

    def frames_and_moves(self, rows: Tensor) -> Frames:
        """Return the frames after all segments at rows q (N, n), with derivatives of the end."""
        arcs, slope = self._arcs_and_slope(rows)
        length, bending = self._split(arcs)
        S = len(length)
        offsets = self.offsets.to(arcs)
        columns = tip_and_columns(length, bending, offsets, angular=True, rigid=True)[1]
        moves, spins, z = columns.split([3 * S, 3 * S, S], dim=1)
        # An arc of length l and bending b moves the end by l c, where c is its derivative with
        # respect to the length, and changes the transverse axes by -b c.
        along = moves[:, :S]
        x, y = identity(3, arcs)[:2, :, None, None] - (bending[:, None] * along).cumsum(
            2
        )
        points = (length * along + offsets[:, None] * z).cumsum(1)
        moves, spins = (part.unflatten(1, (3, S)) for part in (moves, spins))
        return Frames(torch.stack([x, y, z]), points, moves, spins, slope)

    def backbone(self, q: Tensor, n_points: int = 20) -> Tensor:
        """Return points along the whole backbone, base to end.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].
        n_points : int, default=20
            Points per segment; the last one is the segment's end after its offset.

        Returns
        -------
        Tensor of shape (..., S * n_points + 1, 3)
            Positions in the measuring frame [m].
        """
        n_points = whole(n_points, "n_points", most=10**6)
        length, bending = self.arcs(q)
        poses = self._poses(length, bending, self.offsets)
        t = torch.linspace(0.0, 1.0, n_points + 1, dtype=q.dtype, device=q.device)[
            1:, None
        ]
        f, g = stumpff((t * bending[..., None, :]).square().sum(-1))[1:3]
        bend = (g[..., None] * t) * bending[..., None, :]
        arc = (t * length[..., None, None]) * torch.cat([bend, f[..., None]], dim=-1)
        start = poses[..., :-1, :, :]
        end = poses[..., 1:, None, :3, 3]
        points = arc @ start[..., :3, :3].mT + start[..., None, :3, 3]
        points = torch.cat([points[..., :-1, :], end], dim=-2)
        return torch.cat([poses[..., 0, None, :3, 3], points.flatten(-3, -2)], dim=-2)

    def extra_repr(self) -> str:
        """Return the summary shown by repr()."""
        where = "" if self.tip_at == self.n_segments else f", tip at {self.tip_at:g}"
        if len(self.markers) > 1:
            where = f", markers at {', '.join(f'{at:g}' for at, *_ in self.markers)}"
        size = f"{self.n_segments} segments, {self.n_actuators} actuators"
        return f"{size}{where}, routing {self.routing!r}"

    def unit_messages(self, q: Tensor, name: str, factor: float = 1.0) -> list[str]:
        """Return a warning if lengths exceed 10 m, or length changes 4 backbone lengths."""
        if not self.in_metres:
            name = f"{name}` times `gains"
        # Also test q itself, without zeros: `q` may hold speeds, or limits that are absent.
        gains = self.gains.to(q)
        (metres,) = in_blocks(
            lambda rows: (
                torch.minimum((gains * rows).abs(), self.metres(rows).abs()),
            ),
            q,
        )
        beyond = metres > factor * self._largest_metres.to(q)
        beyond[..., : self.stage is not None] = False  # an angle
        message = millimetres_message(name, metres[beyond], 0.0)
        return [] if message is None else [message]

    @property
    def _largest_metres(self) -> Tensor:
        """Largest plausible length or change of length (n,) [m]."""
        pull = LONGEST_PULL * self.reach.detach()
        return torch.where(self.absolute, _LONGEST, pull)

    def plausible_rows(self) -> PlausibleRows:
        """Return bounds of rows that need no warning about their units."""
        weights = torch.diag(self.gains.detach() / self._largest_metres)
        first = int(self.stage is not None)  # the angle of a stage has no bound
        return PlausibleRows(as_array(self.rest), as_array(weights[first:]))

    def _arcs_and_slope(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return arcs (3 S, N) of rows (N, n) and d arcs / dq, (3 S, n) or (3 S, n, N).

        Arcs are the lengths of all segments, then the x-, then the y-bendings.
        """
        raise NotImplementedError

    def _arcs_and_change(self, rows: Tensor) -> tuple[Tensor, Change]:
        """Return arcs (3 S, N), and a function from slopes (N, 3, 3 S) by arcs to (N, 3, P)."""
        raise NotImplementedError

    def _changes(
        self, rows: Tensor, tangents: Mapping[str, Tensor]
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Return the changes (P, ...) of all entries, and of the actuator paths.

        The latter are changes of d path / d bending, for all segments, (P, n, 2 S).
        """
        counts = self.actuators_per_segment
        P = len(next(iter(tangents.values())))
        change = {
            name: tangents.get(
                name, torch.zeros_like(value).expand(P, *value.shape)
            ).to(rows)
            for name, value in self.geometry().items()
        }
        at = levers(self.radii, self.angles, counts).to(rows)
        turned = torch.stack([-at[1], at[0]]) * change["angles"][:, None]
        moved = turned + levers(change["radii"], self.angles.to(rows), counts)
        return change, reading_matrix(moved, counts, self.starts)[
            ..., self.n_segments :
        ]

    def coordinates(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the arcs (N, 3 m) up to the tip and d arcs / dq, (3 m, n) or (N, 3 m, n).

        Lengths [m], then x-, then y-bendings [rad] of the m segments up to the tip. With several
        markers these are the arcs of all segments.
        """
        arcs, slope = self._arcs_and_slope(q)
        if len(self.markers) == 1:
            arcs = self.up_to_tip(arcs)
            slope = self.up_to_tip(slope)
        return arcs.mT, slope if slope.ndim == 2 else slope.permute(2, 0, 1)

    def from_coordinates(self, z: Tensor) -> Tensor:
        """Return the tip (N, 3), or all markers (N, 3 K), at `coordinates` (N, C)."""
        if len(self.markers) == 1:
            return self._tip_of(z.mT, z)
        tips = [one.from_coordinates(one.up_to_tip(z.mT).mT) for one in self.tips()]
        return torch.cat(tips, dim=-1)

    def from_coordinates_and_jacobian(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return `from_coordinates` (N, 3 K) and its derivative (N, 3 K, C)."""
        if len(self.markers) == 1:
            tail, columns = tip_and_columns(*self._to_point(z.mT))
            return self._in_measuring_frame(tail, z), self._turned(columns).permute(
                2, 0, 1
            )
        pairs = []
        for one in self.tips():
            to_tip = one.up_to_tip(identity(3 * self.n_segments, z))
            x, J = one.from_coordinates_and_jacobian(z @ to_tip.mT)
            pairs.append((x, J @ to_tip))
        x, J = (torch.cat(part, dim=1) for part in zip(*pairs, strict=True))
        return x, J

    def _rows(self, q: Tensor) -> Tensor:
        check_vectors(q, self.n_actuators, "q", self._why_shape())
        return q.reshape(-1, self.n_actuators)

    def _why_shape(self) -> str:
        per_segment = " + ".join(str(n) for n in self.actuators_per_segment)
        return f"this chain has {self.n_segments} segments of {per_segment} actuators"

    def _arcs(self, q: Tensor) -> Tensor:
        return self._arcs_and_slope(self._rows(q))[0]

    def _to_point(self, arcs: Tensor) -> tuple[Tensor, Tensor, Tensor, Sequence[float]]:
        """Return lengths, bendings and rigid offsets up to the tip, and the tip's own offset."""
        offsets = self._tip_offsets(self.offsets).to(arcs)
        return *self._split(arcs), offsets, self.markers[-1][1:]

    @staticmethod
    def _split(arcs: Tensor) -> tuple[Tensor, Tensor]:
        """Return lengths (S, N) and bending vectors (2, S, N)."""
        parts = arcs.unflatten(0, (3, -1))
        return parts[0], parts[1:]

    def _leading(self, arcs: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return lengths (..., S) and bending vectors (..., S, 2)."""
        parts = arcs.unflatten(0, (3, -1)).permute(2, 1, 0)
        parts = parts.reshape(*q.shape[:-1], *parts.shape[1:])
        return parts[..., 0], parts[..., 1:]

    def _poses(
        self, length: Tensor, bending: Tensor, offsets: Tensor, q: Tensor | None = None
    ) -> Tensor:
        """Return the poses of the base and after all arcs; with q, turned by the stage."""
        steps = transforms(length, bending, offsets.to(length))
        base = self.base.to(length).expand(*length.shape[:-1], 4, 4)
        poses = itertools.accumulate(steps.unbind(-3), torch.matmul, initial=base)
        poses = torch.stack([*poses], dim=-3)
        turned = None if self.stage is None else q
        return poses if turned is None else rolled(poses, self.metres(turned)[..., :1])

    def _forward(self, q: Tensor) -> tuple[Tensor]:
        arcs = self._arcs(q)
        tips = [one._tip_of(one.up_to_tip(arcs), q) for one in self.tips()]
        return (tips[0] if len(tips) == 1 else torch.cat(tips, dim=-1),)

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        arcs, slope = self._arcs_and_slope(self._rows(q))
        pairs = []
        for one in self.tips():
            tail, columns = tip_and_columns(*one._to_point(one.up_to_tip(arcs)))
            tip = one._in_measuring_frame(tail, q)
            pairs.append((tip, one._by_actuators(columns, slope, q)))
        if len(pairs) == 1:
            return pairs[0]
        x, J = zip(*pairs, strict=True)
        return torch.cat(x, dim=-1), torch.cat(J, dim=-2)

    def _tip_of(self, arcs: Tensor, q: Tensor) -> Tensor:
        """Return the tips (..., 3) of arcs (3 m, N) up to the tip, in the batch shape of q."""
        return self._in_measuring_frame(tip(*self._to_point(arcs)), q)

    def _turned(self, columns: Tensor) -> Tensor:
        """Return columns (3, k, N), given in the base frame, in the measuring frame."""
        base = self.base.to(columns)[:3, :3]
        return (base @ columns.flatten(1)).unflatten(1, columns.shape[1:])

    def _in_measuring_frame(self, tail: Tensor, q: Tensor) -> Tensor:
        base = self.base.to(q)
        return (base[:3, :3] @ tail + base[:3, 3:]).T.reshape(*q.shape[:-1], 3)

    def _by_actuators(self, columns: Tensor, slope: Tensor, q: Tensor) -> Tensor:
        """Return the Jacobian by q from columns (3, 3 m, N) by arcs and the slope of the arcs."""
        columns = self._turned(columns)
        slope = self.up_to_tip(slope)
        if slope.ndim == 3:
            J = torch.matmul(columns.permute(2, 0, 1), slope.permute(2, 0, 1))
            return J.reshape(*q.shape[:-1], 3, self.n_actuators)
        J = torch.matmul(slope.T, columns)  # (3, n, N)
        return J.permute(2, 0, 1).reshape(*q.shape[:-1], 3, self.n_actuators)

    @classmethod
    def from_stored(cls, stored: Stored, restore: Restore) -> Self:
        """Return the chain built from a description."""
        arguments = stored_arguments(stored, cls._entries)
        chain = cls(**arguments, dtype=torch.from_numpy(arguments["base"]).dtype)
        angles = stored.array("angles").astype(arguments["base"].dtype, copy=False)
        chain = chain.with_geometry(angles=torch.from_numpy(angles))
        tip_at = stored.value("tip_at", float)
        places = stored.list_of(list, "markers")
        if any([type(number) for number in place] != 4 * [float] for place in places):
            raise ValueError(
                f"`markers` must hold lists of four numbers, got {places!r:.60}"
            )
        markers = []
        for at, *beside in [*places[:-1], [tip_at, *places[-1][1:]]]:
            segment = math.ceil(at) - 1
            markers.append((segment, at - segment, beside))
        return chain.with_markers(markers)
