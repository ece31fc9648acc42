"""Base class of all chains of circular arcs: tip, poses and derivatives from the arcs."""

from __future__ import annotations

import itertools
import math
from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hybridkin._core.actuators import ActuatorLayout
from hybridkin._core.arrays import as_array, identity, whole
from hybridkin._core.constants import constant
from hybridkin._core.frames import Frames
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.stored import Restore, Stored
from hybridkin.chains._arcs import (
    Segments,
    rolled,
    segments_of,
    tip,
    tip_and_columns,
    transforms,
)
from hybridkin.chains._arcs_program import program_of_arcs
from hybridkin.chains._checks import arc_geometry
from hybridkin.chains._paths import bend_matrix, path_starts, reading_matrix
from hybridkin.chains.body import Body, actuator_path, disk
from hybridkin.chains.calibratable import Part, Scale
from hybridkin.chains.markers import MarkedChain
from hybridkin.native.library import Program, program_of

if TYPE_CHECKING:
    from typing_extensions import Self

Change = Callable[[Tensor], Tensor]
_SlopesOf = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
_RANK = 1e-9  # of the largest singular value: smaller ones are zero
_FACTOR = 5.0  # by which sizes can grow or shrink in a calibration
_SHORTEST = -0.1  # of the robot's length: a marker may sit a little before the end
_FACTORS = ("radii", "lengths", "gains")
_TURNS = Scale(1.0, "rad")
_BENDS = Scale(1.0, "rad", -math.pi, math.pi)
STRUCTURE = {"actuators_per_segment": list, "markers": list, "routing": str}
"""Settings of every chain of arcs in files."""


def frame_numbers(plan: Plan, stored: Stored, reach: float) -> tuple[NDArray, NDArray]:
    """Return the numbers of the frame of a chain, and the parts (m,) of its arcs up to the tip.

    The frame is the rotation and position of the base, the reach, and the rigid offsets.
    """
    base = stored.array("base")
    offsets = stored.array("offsets")
    markers = stored.value("markers", list)
    tip_at, x, y, z = markers[0]
    if x or y:
        raise NoKernel("a marker beside the backbone has no kernel")
    plan.limit("segments", len(offsets))
    parts = np.ones(math.ceil(tip_at))
    parts[-1] += tip_at - len(parts)
    rigid = offsets[: len(parts)] * (parts == 1)
    rigid[-1] += z
    turn = base[:3, :3].ravel()
    position = base[:3, 3]
    return np.concatenate([turn, position, [reach], rigid]), parts


def each_marker(stored: Stored) -> list[Stored]:
    """Return the descriptions of the chains of all markers, one for each."""
    tips = []
    for marker in stored.value("markers", list):
        settings = {**stored.settings, "markers": [marker]}
        tips.append(replace(stored, settings=settings))
    return tips


def write_whole_chain(plan: Plan, stored: Stored) -> int:
    """Write the node of a chain of arcs up to the robot's end, wherever its tip is."""
    end = float(len(stored.array("offsets")))
    settings = {**stored.settings, "markers": [[end, 0.0, 0.0, 0.0]]}
    return plan.node_of(replace(stored, settings=settings))


class ArcChain(MarkedChain):
    """A chain of circular arcs; subclasses define how the actuators shape them.

    A subclass defines `_arcs_and_slope` and `_arcs_and_change`.

    Attributes
    ----------
    actuators_per_segment : tuple of int
        Number of actuators of each of the S segments.
    extensible : tuple of bool
        Which segments change their length; the others have `lengths`.
    takes_lengths : bool
        Whether q holds lengths or their changes; else it holds forces.
    radii, offsets : Tensor of shape (S,)
        Radius of the circle of actuators, and rigid length after the segment [m].
    angles, gains : Tensor of shape (n,)
        Angles of the actuators about the backbone [rad], and metres per unit of q [m].
    rest_bends : Tensor of shape (S, 2)
        Bending of the segments at rest [rad].
    lengths : Tensor of shape (S - E,) or None
        Lengths of the segments but for E extensible ones [m]; None if all are.
    """

    _structure = (
        *STRUCTURE,
        "n_segments",
        "n_actuators",
        "n_outputs",
        "extensible",
        "starts",
    )

    aliases: ClassVar[dict[str, str]] = {
        "turns": "angles",
        "tool": "offsets",
        "gain": "gains",
    }

    actuators_per_segment: tuple[int, ...]
    routing: str
    extensible: tuple[bool, ...]  # for each segment; the others have lengths
    starts: tuple[int, ...]  # first segment that each segment's actuators run through
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
        beside = constant(self.markers, self.offsets)[:, 1:]
        return self.offsets.abs().sum() + beside.abs().sum()

    @property
    def arc_offsets(self) -> Tensor:
        """Rigid length after each arc (A,) [m]; only the last arc of a segment has one."""
        none = self.offsets.new_zeros(self.n_segments, self.arcs_per_segment - 1)
        return torch.cat([none, self.offsets[:, None]], dim=1).flatten()

    @property
    def absolute(self) -> Tensor:
        """Which actuators (n,) have absolute lengths: those of extensible segments, bool."""
        absolute = []
        for stretches, count in zip(self.extensible, self.actuators_per_segment, strict=True):
            absolute += [stretches] * count
        absolute[: self.n_stages] = [False] * self.n_stages
        return constant(tuple(absolute), self.radii, torch.bool)

    @property
    def n_arcs(self) -> int:
        """Number of arcs of the body."""
        return self.n_segments * self.arcs_per_segment

    @property
    def has_one_arc_per_segment(self) -> bool:
        """Whether every segment is one arc."""
        return self.arcs_per_segment == 1

    @property
    def least_radius(self) -> float:
        """Smallest radius of an actuator circle [m]."""
        return float(self.radii.detach().min())

    def body_lengths(self, q: Tensor) -> Tensor:
        """Return the length (..., S + 1) of the backbone up to the end of every segment [m].

        Rigid offsets count.
        """
        arcs, _ = self.arcs(q)
        with_offsets = arcs + self.arc_offsets.to(arcs)
        segments = with_offsets.unflatten(-1, (self.n_segments, -1)).sum(-1)
        return nn.functional.pad(segments.cumsum(-1), (1, 0))

    def at_length(self, length: float, q: Tensor) -> Self:
        """Return the chain of the point after a length of the body [m], on an arc or an offset."""
        ends = self.body_lengths(q).tolist()
        segment = max(bisect_left(ends, length, hi=len(ends) - 1), 1) - 1
        before_end = length - ends[segment + 1]
        arc = ends[segment + 1] - ends[segment] - float(self.offsets[segment])
        place = segment + (length - ends[segment]) / arc
        if place < segment + 1:
            return self.with_tip(place)
        return self._marked([(segment + 1.0, 0.0, 0.0, min(before_end, 0.0))])

    @property
    def body_radii(self) -> Tensor:
        """Radius of the circle of all actuators in every segment, shape (S,) [m]."""
        if self.routing == "segment":
            return self.radii
        largest, _ = self.radii.flip(0).cummax(0)  # actuators of later segments run through
        return largest.flip(0)

    @property
    def rest(self) -> Tensor:
        """The q (n,) at which tendons are not displaced and chambers have length 0."""
        return torch.zeros_like(self.gains)

    @property
    def actuator_layout(self) -> ActuatorLayout:
        """Rest, kind and segment of every actuator; pressures have no effect at zero."""
        absolute = self.absolute.cpu().numpy()
        signed = ~absolute
        rest = as_array(self.rest.detach())
        if not self.in_metres:
            signed = np.ones_like(absolute)
            rest = np.where(absolute, 0.0, rest)
        segments = [[*range(ring.start, ring.stop)] for ring in self.rings]
        balance = self._still_directions()
        return ActuatorLayout(rest, absolute, signed, segments, balance, self._tendons)

    @property
    def _tendons(self) -> NDArray[np.bool_]:
        """Which actuators (n,) are tendons of given length."""
        return np.zeros(self.n_actuators, dtype=bool)

    @property
    def rings(self) -> tuple[slice, ...]:
        """The actuators of every segment."""
        rings = []
        first = 0
        for count in self.actuators_per_segment:
            rings.append(slice(first, first + count))
            first += count
        return tuple(rings)

    def _still_directions(self) -> NDArray:
        """Return the directions of q (n, k) that no arcs of the robot move, in orthonormal columns.

        The backbone of an inextensible segment keeps its length.
        """
        if self.n_stages:
            return np.zeros((self.n_actuators, 0))
        readings = as_array(self._readings().detach())
        fixed = np.append(~np.array(self.extensible), np.zeros(2 * self.n_segments))
        moved = readings[:, fixed == 0.0]
        axes, sizes, _ = np.linalg.svd(moved)
        rank = int((sizes > _RANK * sizes[0]).sum())
        still = as_array(self.gains.detach())[:, None] * axes[:, rank:]
        balance, _ = np.linalg.qr(still)
        return balance

    def part_of(self, name: str) -> Part:
        """Return what a parameter of `calibrate` changes of the geometry."""
        if name not in self.aliases:
            return super().part_of(name)
        entry = self.aliases[name]
        whole = super().part_of(entry)
        if name == "turns":
            counts = np.array(self.actuators_per_segment)
            directions = np.repeat(np.eye(len(counts)), counts, axis=0)
            first = np.cumsum(counts) - counts
            return Part(entry, directions, first, (len(counts),))
        if name == "gain":
            return Part(entry, np.ones((len(whole.shown), 1)), whole.shown[:1], ())
        return Part(entry, whole.directions[:, -1:], whole.shown[-1:], ())

    def scale_of(self, entry: str) -> Scale:
        """Return the natural scale of the numbers of an entry of the geometry."""
        if entry in _FACTORS:
            return Scale.factor(_FACTOR)
        if entry == "angles":
            return _TURNS
        if entry == "rest_bends":
            return _BENDS
        if entry == "offsets":
            reach = float(self.reach)
            return Scale(reach, "m", low=_SHORTEST * reach)
        return super().scale_of(entry)

    def free_rings(self, names: tuple[str, ...]) -> set[str]:
        """Return which of "angles" and "radii" these parameters free."""
        parts = {self.aliases.get(name, name) for name in names}
        return parts & {"angles", "radii"}

    def _checked(
        self, routing: str, *, without_lengths: bool = True, **arguments: Any
    ) -> dict[str, Tensor]:
        """Set the structure of the chain, and return the `arc_geometry` of the arguments."""
        counts, self.extensible, geometry = arc_geometry(**arguments)
        if any(self.extensible) and not without_lengths:
            raise ValueError("`lengths` must hold the backbone length of every segment, got None.")
        self.actuators_per_segment = counts
        self.starts = path_starts(routing, counts, self.extensible)
        self.n_segments = len(counts)
        self.n_actuators = sum(counts)
        self.routing = routing
        self._set_markers([(float(self.n_segments), 0.0, 0.0, 0.0)])
        return geometry

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
        (x,) = self.by_rows(self._tips_of_rows, q, 8192)
        return x

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip (..., 3) [m] and its Jacobian (..., 3, n_actuators) [-] in one pass."""
        x, J = self.by_rows(self._tips_and_jacobians, q)
        return x, J

    def _tips_of_rows(self, rows: Tensor) -> tuple[Tensor]:
        arcs = self._arcs_of_rows(rows)
        return (self._x_of(self.up_to_markers(arcs)),)

    def _tips_and_jacobians(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        arcs, slope = self._arcs_and_slope(rows)
        x, columns = self._x_and_columns(self.up_to_markers(arcs))
        J = self._along(self.by_arcs(columns), slope)
        return self._in_measuring_frame(x), J

    def pose_jacobian(self, q: Tensor) -> Tensor:
        """Return the tip's linear [-] and angular [rad/m] Jacobian, shape (..., 6, n_actuators).

        The angular rows give the angular velocity in the measuring frame.
        """
        if len(self.markers) > 1:
            return self.tip_model.pose_jacobian(q)
        arcs, slope = self._arcs_and_slope(self._rows(q))
        segments = self._segments(self.up_to_markers(arcs))
        _, columns = tip_and_columns(segments, self._beside(arcs), angular=True)
        linear, angular = columns.chunk(2, dim=1)
        both = torch.cat([self.by_arcs(linear), self.by_arcs(angular)], dim=2)
        J = self._along(both, slope)
        if self.n_stages:  # the stage turns the tip's frame too
            spin = self.gains[0] * self.base[:3, 2]
            J[:, 3:, 0] = spin.to(q)
        return J.reshape(*q.shape[:-1], 6, self.n_actuators)

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
        self._check_shape(q)
        changes = {name: value.to(q) for name, value in tangents.items()}
        along = partial(self._along_geometry, tangents=changes, slopes_of=self._points_and_slopes)
        (J,) = self.by_rows(along, q)
        return J

    def slopes_once(self, q: Tensor, tangents: Mapping[str, Tensor]) -> Tensor:
        """Return `geometry_jacobian` (N, m, P), from the compiled core if available."""
        program = self._program_of_arcs()
        if program is None:
            return self.geometry_jacobian(q, tangents)
        chain = self._once()
        slopes_of = partial(chain._compiled_points_and_slopes, program)
        along = partial(chain._along_geometry, tangents=tangents, slopes_of=slopes_of)
        (J,) = self.by_rows(along, q)
        return J

    def _once(self) -> Self:
        """Return the chain for a single evaluation, without tables that serve many."""
        return self

    def _along_geometry(
        self, rows: Tensor, tangents: Mapping[str, Tensor], slopes_of: _SlopesOf
    ) -> tuple[Tensor]:
        """Return the derivative (N, 3 K, P) of x along P changes of the geometry."""
        arcs, change = self._arcs_and_change(rows, tangents)
        points, by_arcs, by_offsets = slopes_of(arcs)
        J = change(by_arcs)
        if "offsets" in tangents:
            J = J + by_offsets @ tangents["offsets"].T
        if "base" in tangents:
            turn, move = tangents["base"][:, :3].split([3, 1], dim=2)
            turned = torch.einsum("pij,nkj->nkip", turn, points)
            J = J + (turned + move[..., 0].T).flatten(1, 2)
        if "marker_offsets" in tangents:
            axes = self._axes_at_markers(self.up_to_markers(arcs))
            turns = self._turned(axes).unflatten(1, (-1, 3))
            moved = torch.einsum("nkij,pkj->nkip", turns, tangents["marker_offsets"])
            J = J + moved.flatten(1, 2)
        return (J,)

    def _points_and_slopes(self, arcs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the markers (N, K, 3) in the base frame at arcs (3 A, N), and derivatives of x.

        These are the derivatives (N, 3 K, 3 A) by the arcs and (N, 3 K, S) by the offsets.
        """
        arcs = self.up_to_markers(arcs)
        points, columns = self._x_and_columns(arcs, rigid=True)
        by_arcs, by_offsets = columns.split([len(arcs), len(arcs) // 3], dim=1)
        k = self.arcs_per_segment  # an offset follows the last arc of a segment
        by_offsets = self.by_offsets(by_offsets)[:, k - 1 :: k]
        # Products of row-major derivatives are much faster than those of transposed ones.
        by_arcs = self._turned(self.by_arcs(by_arcs)).contiguous()
        return points.permute(2, 1, 0), by_arcs, self._turned(by_offsets).contiguous()

    def _compiled_points_and_slopes(
        self, program: Program, arcs: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return `_points_and_slopes` from the program of arcs."""
        results = program.evaluate(self._arcs_and_offsets(arcs.mT), jacobian=True)
        points, J = map(torch.from_numpy, results)
        turned = self.base[:3, :3].to(J) @ J.unflatten(1, (-1, 3))
        by_arcs, by_offsets = turned.flatten(1, 2).split([len(arcs), self.n_segments], dim=2)
        return points.unflatten(1, (-1, 3)), by_arcs, by_offsets

    def _program_of_arcs(self) -> Program | None:
        """Return the program of arcs; a class that inherits its layout may compute others."""
        if "layout" not in vars(type(self)):
            return None
        return program_of_arcs(self.n_segments, self.arcs_per_segment, self.markers)

    def _arcs_and_offsets(self, arcs: Tensor) -> NDArray:
        """Return rows (N, 3 A + S) of `program_of_arcs` from arcs (N, 3 A)."""
        offsets = self.offsets.detach().to(arcs).expand(len(arcs), -1)
        return torch.cat([arcs, offsets], dim=1).numpy()

    def _axes_at_markers(self, arcs: Tensor) -> Tensor:
        """Return x, y, z of the axes of the frames at markers in the base frame, (3, 3, K, N)."""
        segments = self._segments(arcs)
        no_length = torch.zeros_like(segments.length)
        turns = segments._replace(length=no_length, offset=no_length)
        axes = identity(3, arcs)[..., None, None]
        return torch.stack([tip(turns, axis) for axis in axes], dim=1)

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
        return self._leading(self._arcs_of_rows(self._rows(q)), q)

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
        after_arcs = self._poses(*self.arcs(q), self.arc_offsets, q)
        return after_arcs[..., :: self.arcs_per_segment, :, :]

    def pose(self, q: Tensor) -> Tensor:
        """Return the tip's pose in the measuring frame, shape (..., 4, 4)."""
        arcs = self.up_to_tip(self._arcs_of_rows(self._rows(q)))
        length, bending = self._leading(arcs, q)
        offsets = self.offsets_to_markers(self.arc_offsets)[:, -1]
        poses = self._poses(length, bending, offsets, q)
        beside = identity(4, q)
        beside[:3, 3] = self._beside(q)[:, -1, 0]
        return poses[..., -1, :, :] @ beside

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return `pose(q)` and `pose_jacobian(q)`."""
        return self.pose(q), self.pose_jacobian(q)

    def frames_and_moves(self, rows: Tensor) -> Frames:
        """Return the frames after all segments at rows q (N, n), with derivatives of the end."""
        arcs, slope = self._arcs_and_slope(rows)
        S = self.n_segments * self.arcs_per_segment
        segments = segments_of(arcs, self.arc_offsets.to(arcs)[:, None])
        at_end = arcs.new_zeros(3, 1)
        _, columns = tip_and_columns(segments, at_end, angular=True, rigid=True)
        moves, spins, tangents = columns.split([3 * S, 3 * S, S], dim=1)
        # An arc of length l and bending b moves the end by l c, where c is its derivative with
        # respect to the length, and changes the transverse axes by -b c.
        by_length = moves[:, :S]
        steps = segments.length * by_length + segments.offset * tangents
        x_axis, y_axis, _ = identity(3, arcs)[..., None, None]
        x_axes = x_axis - (segments.x * by_length).cumsum(1)
        y_axes = y_axis - (segments.y * by_length).cumsum(1)
        return Frames(
            axes=torch.stack([x_axes, y_axes, tangents]),
            points=steps.cumsum(1),
            moves=moves.unflatten(1, (3, S)),
            spins=spins.unflatten(1, (3, S)),
            arcs=arcs,
            slope=slope,
        )

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
        places = []
        for segment in range(self.n_segments):
            for point in range(1, n_points + 1):
                places.append((segment + point / n_points, 0.0, 0.0, 0.0))
        points = self._marked(places)(q).unflatten(-1, (-1, 3))
        start = self.base[:3, 3].to(points).expand(*q.shape[:-1], 1, 3)
        return torch.cat([start, points], dim=-2)

    def body(self, q: Tensor, n_points: int) -> Body:
        """Return what can be drawn of the robot at rows q (K, n), with points per segment."""
        of_arc = max(2, n_points // self.arcs_per_segment)
        frames = as_array(self.frames(q, of_arc))  # (K, S, P, 4, 4)
        radii = self.radii.tolist()
        segments = np.repeat(range(self.n_segments), self.actuators_per_segment)
        actuators = []
        for s, angle in zip(segments.tolist(), self.angles.tolist(), strict=True):
            passed = slice(self.starts[s], s + 1)
            actuators.append(actuator_path(frames, passed, radii[s], angle))
        disks = [disk(frames[:, 0, 0], radii[0])]
        for s, radius in enumerate(self.body_radii.tolist()):
            disks.append(disk(frames[:, s, -1], radius))
        return Body(
            points=as_array(self.backbone(q, n_points)),
            actuators=actuators,
            segments=segments.tolist(),
            disks=np.stack(disks, axis=1),
            is_rigid=False,
        )

    def frames(self, q: Tensor, n_points: int) -> Tensor:
        """Return frames along all segments, shape (..., S, P, 4, 4), without the rigid offsets.

        They are `n_points` + 1 on every arc, from its start to its end.
        """
        length, bending = self.arcs(q)
        poses = self._poses(length, bending, self.arc_offsets, q)
        if self.n_stages:  # in the frames that turn with the stage
            turned = poses[..., 0, :3, :3].mT @ poses[..., 1, :3, :3]
            bending = bending @ turned[..., :2, :2]
        # A part of an arc is an arc of that part of its length and of its bending.
        part = torch.linspace(0.0, 1.0, n_points + 1, dtype=q.dtype, device=q.device)
        lengths = part * length[..., None]
        bendings = part[:, None] * bending[..., None, :]
        steps = transforms(lengths, bendings, torch.zeros_like(part))
        frames = poses[..., :-1, None, :, :] @ steps
        return frames.unflatten(-4, (self.n_segments, -1)).flatten(-4, -3)

    def extra_repr(self) -> str:
        """Return the summary shown by repr()."""
        words = [f"{self.n_segments} segments", f"{self.n_actuators} actuators"]
        if len(self.markers) > 1:
            places = [f"{at:g}" for at, *_ in self.markers]
            words.append(f"markers at {', '.join(places)}")
        elif self.tip_at != self.n_segments:
            words.append(f"tip at {self.tip_at:g}")
        words.append(f"routing {self.routing!r}")
        return ", ".join(words)

    def _arcs_and_slope(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return arcs (3 S, N) of rows (N, n) and d arcs / dq, (3 S, n) or (3 S, n, N).

        Arcs are the lengths of all segments, then the x-, then the y-bendings.
        """
        raise NotImplementedError

    def _arcs_and_change(
        self, rows: Tensor, tangents: Mapping[str, Tensor]
    ) -> tuple[Tensor, Change]:
        """Return arcs (3 S, N), and what P changes of the geometry change through the arcs.

        That is a function from derivatives by the arcs (N, 3 K, 3 S) to those along the changes
        (N, 3 K, P).
        """
        raise NotImplementedError

    def _all_changes(self, tangents: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the changes (P, ...) of all entries of the geometry, zero if not given."""
        first = next(iter(tangents.values()))
        changes = {}
        for name, entry in self.geometry().items():
            none = first.new_zeros(len(first), *entry.shape)
            changes[name] = tangents.get(name, none)
        return changes

    def _readings(self) -> Tensor:
        return reading_matrix(self.radii, self.angles, self.actuators_per_segment, self.starts)

    def _changes_of_bends(self, changes: Mapping[str, Tensor]) -> Tensor:
        """Return the changes (P, n, 2 S) of the readings of the bendings."""
        radii = self.radii.to(changes["radii"])
        angles = self.angles.to(radii)
        paths = self.actuators_per_segment, self.starts
        along_radii = bend_matrix(changes["radii"], angles, *paths)
        by_angle = bend_matrix(radii, angles + 0.5 * math.pi, *paths)
        along_angles = by_angle * changes["angles"][..., None]
        return along_radii + along_angles

    def coordinates(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the arcs (N, 3 m) up to the tip and d arcs / dq, (3 m, n) or (N, 3 m, n).

        Lengths [m], then x-, then y-bendings [rad] of the m segments up to the tip. With several
        markers these are the arcs of all segments.
        """
        arcs, slope = self._arcs_and_slope(q)
        if len(self.markers) == 1:
            arcs = self.up_to_tip(arcs)
            slope = self.up_to_tip(slope)
        if slope.ndim == 3:
            slope = slope.permute(2, 0, 1)
        return arcs.mT, slope

    def from_coordinates(self, z: Tensor) -> Tensor:
        """Return the tip (N, 3), or all markers (N, 3 K), at `coordinates` (N, C)."""
        return self._x_of(self._coordinates_to_markers(z.mT))

    def from_coordinates_and_jacobian(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return `from_coordinates` (N, 3 K) and its derivative (N, 3 K, C)."""
        x, columns = self._x_and_columns(self._coordinates_to_markers(z.mT))
        if len(self.markers) > 1:
            columns = self.by_arcs(columns)
        return self._in_measuring_frame(x), self._turned(columns)

    def tips_by_coordinates(self) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
        """Return `from_coordinates_and_jacobian`, from the compiled core if available."""
        if self.n_outputs > 3 or program_of(self) is None:
            return self.from_coordinates_and_jacobian
        m = math.ceil(self.tip_at)
        offsets = self.offsets[:m].numpy(force=True).copy()
        offsets[-1] *= self.tip_at == m
        arrays = {
            "base": self.base.numpy(force=True),
            "offsets": offsets,
            "radii": np.ones(m),
        }
        # q are the arcs.
        derived = {"arc_matrix": np.eye(3 * m), "arc_offset": np.zeros(3 * m)}
        markers = [[float(m), *self.markers[-1][1:]]]
        settings = {"markers": markers, "stage": None}
        stored = Stored("constant_curvature", settings, arrays, derived=derived)
        program = Program(Plan(stored))

        def tips(z: Tensor) -> tuple[Tensor, Tensor]:
            x, J = program.evaluate(z.numpy(), jacobian=True)
            return torch.from_numpy(x), torch.from_numpy(J)

        return tips

    def compliance_columns(self, q: Tensor) -> Tensor:
        """Return A (N, 3 K, 2 m) at rows q (N, n): a force w at the tip moves it along A A' w.

        The bendings of the m arcs give way by the moment times their length.
        """
        arcs, _ = self.coordinates(q)
        _, columns = self.from_coordinates_and_jacobian(arcs)
        m = arcs.shape[1] // 3
        roots = arcs[:, :m].abs().sqrt().repeat(1, 2)
        return columns[..., m:] * roots[:, None]

    def _coordinates_to_markers(self, z: Tensor) -> Tensor:
        """Return coordinates (C, ...) as arcs up to each marker, (3 m, K, ...)."""
        return z[:, None] if len(self.markers) == 1 else self.up_to_markers(z)

    def _rows(self, q: Tensor) -> Tensor:
        self._check_shape(q)
        return q.reshape(-1, self.n_actuators)

    def _why_shape(self) -> str:
        per_segment = " + ".join(map(str, self.actuators_per_segment))
        return f"this chain has {self.n_segments} segments of {per_segment} actuators"

    def _arcs_of_rows(self, rows: Tensor) -> Tensor:
        """Return the arcs (3 S, N) of rows (N, n)."""
        arcs, _ = self._arcs_and_slope(rows)
        return arcs

    def _segments(self, arcs: Tensor) -> Segments:
        """Return the segments (m, K, N) of arcs (3 m, K, N) up to the markers."""
        offsets = self.offsets_to_markers(self.arc_offsets).to(arcs)
        return segments_of(arcs, offsets[..., None])

    def _beside(self, like: Tensor) -> Tensor:
        """Return the offsets (3, K, 1) of the markers from the backbone [m]."""
        beside = tuple(tuple(offset) for _, *offset in self.markers)
        return constant(beside, like).mT[..., None]

    def _leading(self, arcs: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return lengths (..., S) and bending vectors (..., S, 2)."""
        parts = arcs.unflatten(0, (3, -1)).permute(2, 1, 0)
        parts = parts.reshape(*q.shape[:-1], *parts.shape[1:])
        return parts[..., 0], parts[..., 1:]

    def _poses(self, length: Tensor, bending: Tensor, offsets: Tensor, q: Tensor) -> Tensor:
        """Return the poses of the base and after all arcs, turned by the stage."""
        steps = transforms(length, bending, offsets.to(length))
        base = self.base.to(length).expand(*length.shape[:-1], 4, 4)
        frames = itertools.accumulate(steps.unbind(-3), torch.matmul, initial=base)
        poses = torch.stack([*frames], dim=-3)
        if not self.n_stages:
            return poses
        angle = self.gains[:1].to(q) * (q[..., :1] - self.rest[:1].to(q))
        return rolled(poses, angle)

    def _x_of(self, arcs: Tensor) -> Tensor:
        """Return x (N, 3 K) at arcs (3 m, K, N) up to the markers."""
        points = tip(self._segments(arcs), self._beside(arcs))
        return self._in_measuring_frame(points)

    def _x_and_columns(self, arcs: Tensor, rigid: bool = False) -> tuple[Tensor, Tensor]:
        """Return the markers (3, K, N) in the base frame at arcs up to them, and derivatives."""
        return tip_and_columns(self._segments(arcs), self._beside(arcs), rigid=rigid)

    def _in_measuring_frame(self, points: Tensor) -> Tensor:
        """Return points (3, K, N) of the base frame in the measuring frame, (N, 3 K)."""
        base = self.base.to(points)
        turned = torch.tensordot(base[:3, :3], points, 1)
        placed = turned + base[:3, 3, None, None]
        return placed.permute(2, 1, 0).flatten(1)

    def _along(self, columns: Tensor, slope: Tensor) -> Tensor:
        """Return the derivative (N, 3 K, P) of x along changes of the arcs, (3 S, P[, N])."""
        if slope.ndim == 3:
            return self._turned(columns) @ slope.permute(2, 0, 1)
        moved = slope.mT @ columns.flatten(2)
        return self._turned(moved.unflatten(2, columns.shape[2:]))

    def _turned(self, columns: Tensor) -> Tensor:
        """Return derivatives (3, C, K, N) of points in the base frame as (N, 3 K, C), measured."""
        turn = self.base.to(columns)[:3, :3]
        turned = torch.tensordot(turn, columns, 1)
        return turned.permute(3, 2, 0, 1).flatten(1, 2)

    @classmethod
    def _arguments(cls, stored: Stored) -> dict[str, Any]:
        """Return the constructor's arguments, except dtype, from a description."""
        arguments: dict[str, Any] = {}
        for name in cls._entries:
            if name != "lengths" or name in stored.arrays:
                arguments[name] = stored.array(name)
        counts = stored.list_of(int, "actuators_per_segment")
        ends = np.cumsum(counts)
        arguments["n_actuators"] = counts
        arguments["angles"] = np.split(arguments["angles"], ends[:-1])
        arguments["routing"] = stored.value("routing", str)
        return arguments

    @classmethod
    def from_stored(cls, stored: Stored, restore: Restore) -> Self:
        """Return the chain built from a description."""
        dtype = torch.from_numpy(stored.array("base")).dtype
        chain = cls(**cls._arguments(stored), dtype=dtype)
        angles = torch.tensor(stored.array("angles"), dtype=dtype, device="cpu")
        chain = chain.with_geometry(angles=angles)
        markers = []
        for at, *beside in stored.list_of(list, "markers"):
            if any(isinstance(number, bool) for number in (at, *beside)):
                raise ValueError("`markers` must hold numbers")
            segment = math.ceil(at) - 1
            markers.append((segment, at - segment, beside))
        return chain.with_markers(markers)
