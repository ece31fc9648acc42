"""Kinematics of rigid arms: tips, frames and Jacobian columns from the motions of the joints.

Every joint moves by T(q) = B_0 + u_1(q) B_1 + u_2(q) B_2 with three constant matrices. (u_1, u_2)
is (sin q, cos q) for a revolute joint (Rodrigues' formula) and (q, unused) for a prismatic one.
The batch comes last in the results: vectors are (3, N), in the base frame.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from hybridkin._core.arrays import identity
from hybridkin._core.blocks import check_vectors, in_blocks
from hybridkin._core.units import degrees_message, millimetres_message
from hybridkin.chains.chain import Chain

FAR = 10.0  # [m]; a joint that slides further is more likely in millimetres


def joint_motions(
    origins: Tensor, axes: Tensor, slides: Tensor, zeros: Tensor
) -> Tensor:
    """Return B_0, B_1, B_2 of every joint, including its origin, shape (n, 3, 4, 4).

    `zeros` (n,) are the positions at which the joints are at their origins.
    """
    motions = origins.new_zeros(len(axes), 3, 4, 4)
    motions[:, 0, 3, 3] = 1.0
    eye = torch.eye(3, dtype=axes.dtype, device=axes.device)
    along = axes[:, :, None] * axes[:, None, :]
    slide = slides[:, None, None]
    motions[:, 0, :3, :3] = torch.where(slide, eye, along)
    motions[:, 1, :3, :3] = torch.where(
        slide, 0.0, torch.linalg.cross(eye[None], axes[:, None])
    )
    motions[:, 2, :3, :3] = torch.where(slide, 0.0, eye - along)
    motions[:, 1, :3, 3] = torch.where(slides[:, None], axes, 0.0)
    # T(q - zero), from the sine and cosine of a difference of angles.
    still, by_u1, by_u2 = motions.unbind(1)
    zero = zeros[:, None, None]
    turn = torch.where(slide, 0.0, zero)
    still = still - torch.where(slide, zero, 0.0) * by_u1
    ahead = turn.cos()
    aside = turn.sin()
    parts = [still, ahead * by_u1 + aside * by_u2, ahead * by_u2 - aside * by_u1]
    return origins[:, None] @ torch.stack(parts, 1)


def column_carriers(motions: Tensor, origins: Tensor, axes: Tensor) -> Tensor:
    """Return the matrices that `last_frame_and_joints` applies at every joint, shape (n, 13, 4).

    They map the columns of a frame to the next frame's parts times 1, u_1, u_2, and to the axis.
    """
    directions = nn.functional.pad(origins[:, :3, :3] @ axes[..., None], (0, 0, 0, 1))
    return torch.cat([motions.mT.flatten(1, 2), directions.mT], dim=1)


def shares(rows: Tensor, slides: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return u_1, u_2 of all joints in rows q (N, n); `slides` is None without prismatic ones."""
    first = rows.sin()
    if slides is not None:
        first = torch.where(slides.to(rows.device), rows, first)
    return first, rows.cos()


def carried_tip(u1: Tensor, u2: Tensor, motions: Tensor, end: Tensor) -> Tensor:
    """Return the homogeneous tip (4, N), transformed from the last joint's frame to the base."""
    p = end[:, None].expand(4, len(u1))
    joints = zip(
        motions.flatten(1, 2).unbind(), u1.T.unbind(), u2.T.unbind(), strict=True
    )
    for motion, of_u1, of_u2 in reversed([*joints]):
        still, by_u1, by_u2 = (motion @ p).split(4)
        p = torch.addcmul(torch.addcmul(still, of_u1, by_u1), of_u2, by_u2)
    return p


def frames(u1: Tensor, u2: Tensor, motions: Tensor) -> Tensor:
    """Return the identity and every joint's moving frame, shape (N, n + 1, 4, 4)."""
    first = identity(4, u1).expand(len(u1), 4, 4)
    u1, u2 = (part[..., None, None] for part in (u1, u2))
    still, by_u1, by_u2 = motions.unbind(1)
    steps = torch.addcmul(torch.addcmul(still, u1, by_u1), u2, by_u2).unbind(1)
    return torch.stack(
        [*itertools.accumulate(steps, torch.matmul, initial=first)], dim=1
    )


def last_frame_and_joints(
    u1: Tensor, u2: Tensor, carriers: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the last moving frame (4, 3, N), joint axes and joint positions (n, 3, N).

    The frame is given by its three axes and its origin.
    """
    n_rows, n = u1.shape
    # With the three coordinates of all rows side by side, a joint costs one small product.
    u1, u2 = (part.T.repeat(1, 3) for part in (u1, u2))
    frame = torch.eye(4, dtype=u1.dtype, device=u1.device)[:, :3].repeat_interleave(
        n_rows, 1
    )
    axes = [frame[:0]]
    points = [frame[:0]]
    for carrier, of_u1, of_u2 in zip(
        carriers.unbind(), u1.unbind(), u2.unbind(), strict=True
    ):
        still, by_u1, by_u2, axis = (carrier @ frame).split((4, 4, 4, 1))
        frame = torch.addcmul(torch.addcmul(still, of_u1, by_u1), of_u2, by_u2)
        axes.append(axis)
        points.append(frame[3:])
    joint_axes, joint_points = (
        torch.cat(part).reshape(n, 3, n_rows) for part in (axes, points)
    )
    return frame.unflatten(1, (3, n_rows)), joint_axes, joint_points


class JointChain(Chain):
    """The kinematics of a rigid arm, from the buffers that its constructor checks."""

    _structure = ("n_actuators", "kinds", "names")
    kinds: tuple[str, ...]
    names: tuple[str, ...]
    couplings: Tensor | None

    @property
    def reach(self) -> Tensor:
        """Size of the arm, shape () [m]: the sum of links, finite strokes and tool."""
        strokes = torch.maximum(self.q_min.abs(), self.q_max.abs())
        strokes = self._strokes(torch.where(torch.isfinite(strokes), strokes, 0.0))
        links = torch.linalg.vector_norm(self.origins[:, :3, 3], dim=1).sum()
        ends = torch.linalg.vector_norm(
            torch.stack([self.tip[:3, 3], self.tool]), dim=1
        ).sum()
        reach = links + strokes.sum() + ends
        return torch.where(reach > 0, reach, 1.0)

    def longest(self, largest: Tensor) -> Tensor:
        """Return the reach plus the strokes of prismatic joints within ``|q| <= largest``."""
        return self.reach + self._strokes(largest + self.joint_zeros.abs()).sum()

    def _strokes(self, largest: Tensor) -> Tensor:
        """Return the strokes of all joints for ``|q| <= largest``; 0 for revolute joints."""
        if self.couplings is not None:
            largest = self.couplings.abs() @ largest
        return torch.where(self.slides, largest, 0.0)

    def geometry(self) -> dict[str, Tensor]:
        """Return the geometry by name.

        Besides arguments of the constructor this has "links", shape (n_joints, 3) [m]: the origin
        of every joint in the moving frame of the previous joint. The last link is the `tool`.
        """
        return {**super().geometry(), "links": self.origins[:, :3, 3]}

    def _set_geometry(self, geometry: Mapping[str, Tensor | None]) -> None:
        buffers = dict(geometry)
        links = buffers.pop("links", None)
        for name, value in buffers.items():
            self.register_buffer(name, value)
        if links is not None:
            column = nn.functional.pad(links, (0, 1), value=1.0)[..., None]
            self.origins = torch.cat([self.origins[..., :3], column], dim=-1)
        if self.couplings is None:
            zeros = self.joint_zeros
        else:
            zeros = self.couplings @ self.joint_zeros
        motions = joint_motions(self.origins, self.axes, self.slides, zeros)
        self.register_buffer("motions", motions)
        carriers = column_carriers(motions, self.origins, self.axes)
        self.register_buffer("carriers", carriers)

    @property
    def turns(self) -> Tensor:
        """Which actuators are angles with a period of one turn, shape (n,), bool."""
        if self.couplings is None:
            return ~self.slides
        still = torch.where(self.slides[:, None], 0.0, self.couplings.round())
        return (self.couplings == still).all(0)

    @property
    def units(self) -> list[str]:
        """The unit of every actuator: "rad" if it turns a joint, else "m"."""
        turns = ~self.slides
        if self.couplings is not None:
            turns = (self.couplings[turns] != 0.0).any(0)
        return ["rad" if turn else "m" for turn in turns.tolist()]

    def coordinates(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the joint positions at rows q (N, n), and their derivative (n_joints, n)."""
        if self.couplings is None:
            return super().coordinates(q)
        return q @ self.couplings.to(q).mT, self.couplings.to(q)

    def from_coordinates(self, z: Tensor) -> Tensor:
        """Return the tip (N, 3) at joint positions z (N, n_joints)."""
        p = carried_tip(*self._shares(z), self.motions.to(z), self._end(z))
        return (self.base.to(z)[:3] @ p).T

    def from_coordinates_and_jacobian(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip (N, 3) and its Jacobian by the joint positions (N, 3, n_joints)."""
        tip, linear, _, _ = self._columns(z)
        base = self.base.to(z)
        return (base[:3, :3] @ tip + base[:3, 3:]).T, self._in_measuring_frame(
            linear, z
        )

    def forward(self, q: Tensor) -> Tensor:
        """Return the tip position.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Joint positions [rad]; [m] for prismatic joints.

        Returns
        -------
        Tensor of shape (..., 3)
            Tip position in the measuring frame [m].
        """
        check_vectors(q, self.n_actuators, "q", self._why_shape())
        return in_blocks(lambda rows: (self.from_coordinates(self._joints(rows)),), q)[
            0
        ]

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip (..., 3) [m] and its Jacobian dx/dq (..., 3, n) in one pass.

        In closed form, in [m/rad] for revolute joints and [-] for prismatic ones.
        """
        check_vectors(q, self.n_actuators, "q", self._why_shape())
        x, J = in_blocks(self._forward_and_jacobian, q)
        return x, J

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip's pose (..., 4, 4) in the measuring frame, and `pose_jacobian(q)`."""
        tip, linear, axes, frame = self._columns(self._joints(q))
        slides = self.slides.to(q.device)[:, None, None]
        angular = torch.where(slides, torch.zeros_like(axes), axes)
        columns = [self._in_measuring_frame(part, q) for part in (linear, angular)]
        J = self._by_actuators(torch.cat(columns, dim=-2)).reshape(
            *q.shape[:-1], 6, self.n_actuators
        )
        turned = (self.tip.to(q)[:, :3].T @ frame.flatten(1)).unflatten(1, (3, -1))
        # (N, 3, 4): axes and tip.
        local = torch.cat([turned, tip[None]]).permute(2, 1, 0)
        last = identity(4, q)[3].expand(len(local), 1, 4)
        pose = (self.base.to(q) @ torch.cat([local, last], 1)).reshape(
            *q.shape[:-1], 4, 4
        )
        return pose, J

    def poses(self, q: Tensor) -> Tensor:
        """Return the pose of the base and of the link moved by each joint.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Joint positions [rad]; [m] for prismatic joints.

        Returns
        -------
        Tensor of shape (..., n_joints + 1, 4, 4)
            Homogeneous transforms into the measuring frame; the last one is that of the tip: the
            end link's frame, shifted to the tool.
        """
        frames = self._frames(q)
        end = torch.cat([self.tip.to(q)[:, :3], self._end(q)[:, None]], dim=1)
        return torch.cat([frames[..., :-1, :, :], frames[..., -1:, :, :] @ end], dim=-3)

    def pose(self, q: Tensor) -> Tensor:
        """Return the tip's pose in the measuring frame, shape (..., 4, 4)."""
        return self.poses(q)[..., -1, :, :]

    def backbone(self, q: Tensor, n_points: int = 1) -> Tensor:
        """Return points along the straight lines from the base through all joints to the tip.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Joint positions [rad]; [m] for prismatic joints.
        n_points : int, default=1
            Points per line; the last one is the end of the line.

        Returns
        -------
        Tensor of shape (..., (n_joints + 1) * n_points + 1, 3)
            Positions in the measuring frame [m].
        """
        if n_points < 1:
            raise ValueError(f"`n_points` must be at least 1, got {n_points}.")
        corners = torch.cat(
            [self._frames(q)[..., :3, 3], self(q)[..., None, :]], dim=-2
        )
        start = corners[..., :-1, None, :]
        end = corners[..., 1:, None, :]
        t = torch.linspace(0.0, 1.0, n_points + 1, dtype=q.dtype, device=q.device)[
            1:, None
        ]
        return torch.cat(
            [corners[..., :1, :], torch.lerp(start, end, t).flatten(-3, -2)], dim=-2
        )

    def unit_messages(self, q: Tensor, name: str, factor: float = 1.0) -> list[str]:
        """Return warnings if joints turn by more than two turns, or slide too far."""
        turns = torch.tensor([unit == "rad" for unit in self.units], device=q.device)
        turned = degrees_message(name, q[:, turns].abs(), factor)
        slid = millimetres_message(name, q[:, ~turns].abs(), factor * FAR)
        return [message for message in (turned, slid) if message is not None]

    def extra_repr(self) -> str:
        """Return the summary shown by repr()."""
        joints = f"{len(self.kinds)} joints" + ", coupled" * (
            self.couplings is not None
        )
        return f"{joints}: {', '.join(self.names)}"

    def _why_shape(self) -> str:
        return f"this arm has {self.n_actuators} moving joints"

    def _joints(self, q: Tensor) -> Tensor:
        """Return the joint positions at q (..., n), as rows (N, n_joints)."""
        check_vectors(q, self.n_actuators, "q", self._why_shape())
        return self.coordinates(q.reshape(math.prod(q.shape[:-1]), self.n_actuators))[0]

    def _by_actuators(self, J: Tensor) -> Tensor:
        """Return Jacobians by q from Jacobians by the joint positions (N, m, n_joints)."""
        return J if self.couplings is None else J @ self.couplings.to(J)

    def _shares(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return u_1 and u_2 of every joint at joint positions (N, n_joints)."""
        return shares(z, self.slides if "prismatic" in self.kinds else None)

    def _frames(self, q: Tensor) -> Tensor:
        """Return the base and every joint's moving frame, shape (..., n_joints + 1, 4, 4)."""
        poses = frames(*self._shares(self._joints(q)), self.motions.to(q))
        return self.base.to(q) @ poses.reshape(*q.shape[:-1], *poses.shape[1:])

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        x, J = self.from_coordinates_and_jacobian(self._joints(q))
        return x, self._by_actuators(J)

    def _columns(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return tip (3, N), its derivatives and the joint axes (n_joints, 3, N), and a frame.

        All are in the base frame, at joint positions (N, n_joints). The frame (4, 3, N) holds the
        three axes and the origin of the last joint's moving frame.
        """
        shares = self._shares(z)
        carriers = self.carriers.to(z)
        frame, axes, points = last_frame_and_joints(*shares, carriers)
        tip = (self._end(z) @ frame.flatten(1)).unflatten(0, (3, -1))
        columns = torch.linalg.cross(axes, tip - points, dim=1)
        if "prismatic" in self.kinds:
            slides = self.slides.to(z.device)[:, None, None]
            # NaN in a row of NaN.
            columns = torch.where(slides, axes + (tip - tip), columns)
        return tip, columns, axes, frame

    def _in_measuring_frame(self, columns: Tensor, q: Tensor) -> Tensor:
        """Return columns (n_joints, 3, N), in the base frame, as a Jacobian (N, 3, n_joints)."""
        return (self.base.to(q)[:3, :3] @ columns).permute(2, 1, 0)

    def _end(self, q: Tensor) -> Tensor:
        """Return the tool in the last joint's moving frame, homogeneous, shape (4,)."""
        return self.tip.to(q) @ nn.functional.pad(self.tool.to(q), (0, 1), value=1.0)
