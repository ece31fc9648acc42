"""Kinematics of a rigid serial arm, as a torch module q -> x, from arrays, URDF or MJCF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from hybridkin._core.arrays import Numbers, Transform, identity
from hybridkin._core.blocks import check_vectors, in_blocks
from hybridkin._core.stored import Layout, Restore, Stored
from hybridkin._core.units import degrees_message, millimetres_message, warn_millimetres
from hybridkin.chains import _joint_motions
from hybridkin.chains._arm_files import chain_path, mjcf_path, moving_joints, urdf_path
from hybridkin.chains._checks import float_dtype, pose, rigid_pose, shaped
from hybridkin.chains.chain import Chain

if TYPE_CHECKING:
    from pytorch_kinematics.chain import Chain as KinematicsChain

__all__ = ["RigidChain"]

_KINDS = ("revolute", "prismatic")
_FAR = 10.0  # [m]; a joint that slides further is more likely in millimetres


class RigidChain(Chain):
    """Tip position of a rigid serial arm, from its joint positions.

    Every joint moves by an affine function of sin q and cos q (Rodrigues' formula), of q where it
    is prismatic. Tip and Jacobian follow in one pass from base to tip, without autograd.

    Parameters
    ----------
    origins : array-like of shape (n, 4, 4)
        Pose of every joint's frame at q = 0 in the frame that the joint before it moves; of the
        first one in the base.
    axes : array-like of shape (n, 3)
        Joint axes in the joints' frames, normalised here.
    kinds : sequence of n {"revolute", "prismatic"}, optional
        What every joint does about or along its axis. Default: all revolute.
    names : sequence of n str, optional
        Names of the joints. Default: "joint_1", ...
    q_min, q_max : array-like of shape (n,), optional
        Joint limits [rad] or [m], the defaults of `InverseKinematics`; the arm itself ignores them.
        Default: none, infinite.
    dq_max : array-like of shape (n,), optional
        Largest speeds of the joints [rad/s] or [m/s], likewise. Default: none, infinite.
    tip : array-like of shape (4, 4), optional
        Pose of the end link in the frame that the last joint moves. Default: identity.
    tool : array-like of shape (3,), default=(0, 0, 0)
        The point steered, in the end link's frame [m].
    base : array-like of shape (4, 4) or pytorch_kinematics Transform3d, optional
        Pose of the arm's base in the measuring frame. Default: identity.
    dtype : torch.dtype, default=torch.float64
        Precision in which the geometry is held. Results come in the dtype of q.

    References
    ----------
    Lynch & Park, Modern Robotics (2017), sections 3.2 (Rodrigues) and 5.1 (Jacobian).

    Examples
    --------
    Two links of 0.3 m and 0.2 m in a plane:

    >>> import numpy as np
    >>> import torch
    >>> from hybridkin import RigidChain
    >>> origins = np.stack([np.eye(4), np.eye(4)])
    >>> origins[1, 0, 3] = 0.3
    >>> arm = RigidChain(origins, [[0, 0, 1], [0, 0, 1]], tool=[0.2, 0, 0])
    >>> arm(torch.tensor([torch.pi / 2, -torch.pi / 2]))
    tensor([0.2000, 0.3000, 0.0000])
    """

    _entries = ("base", "tool")
    _structure = ("n_actuators", "kinds", "names")
    _arrays = ("origins", "axes", "tip", "tool", "q_min", "q_max", "dq_max", "base")
    layout = Layout("rigid", dict.fromkeys(_arrays, ""), {"kinds": list, "names": list})

    def __init__(
        self,
        origins: Numbers,
        axes: Numbers,
        *,
        kinds: Sequence[str] | None = None,
        names: Sequence[str] | None = None,
        q_min: Numbers | None = None,
        q_max: Numbers | None = None,
        dq_max: Numbers | None = None,
        tip: Numbers | None = None,
        tool: Numbers = (0.0, 0.0, 0.0),
        base: Numbers | Transform | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        dtype = float_dtype(dtype)
        axes = shaped(axes, "axes", "n3")
        n = len(axes)
        lengths = axes.norm(dim=1, keepdim=True)
        if n == 0 or not (lengths > 0).all():
            raise ValueError(
                f"`axes` must hold at least one axis, none of zero length, got {axes.tolist()}."
            )
        axes = axes / lengths
        origins = shaped(origins, "origins", "n44", n)
        origins = torch.stack([rigid_pose(origins[k], f"origins[{k}]") for k in range(n)])
        self.n_actuators = n
        self.kinds = ("revolute",) * n if kinds is None else tuple(map(str, kinds))
        default = [f"joint_{k + 1}" for k in range(n)]
        self.names = tuple(map(str, default if names is None else names))
        if len(self.kinds) != n or not set(self.kinds) <= set(_KINDS):
            raise ValueError(f"`kinds` must hold {n} of {_KINDS}, one per joint, got {self.kinds}.")
        if len(self.names) != n:
            raise ValueError(f"`names` must hold {n} names, one per joint, got {self.names}.")
        limits = {"q_min": q_min, "q_max": q_max, "dq_max": dq_max}
        for name, value in limits.items():
            none = np.full(n, -np.inf if name == "q_min" else np.inf)
            limits[name] = shaped(none if value is None else value, name, "n", n, finite=False)
        low, high, speed = limits.values()
        if not (low <= high).all():
            raise ValueError(
                f"`q_min` must not exceed `q_max`, got {low.tolist()} and {high.tolist()}."
            )
        if not (speed > 0.0).all():
            raise ValueError(f"`dq_max` must be positive, got {speed.tolist()}.")
        slides = torch.tensor([kind == "prismatic" for kind in self.kinds], device=axes.device)
        motions = _joint_motions.joint_motions(origins, axes, slides)
        geometry = {
            "origins": origins,
            "axes": axes,
            **limits,
            "tip": rigid_pose(np.eye(4) if tip is None else tip, "tip"),
            "tool": shaped(tool, "tool", "3"),
            "base": pose(base, "base", dtype),
            "motions": motions,
            "carriers": _joint_motions.column_carriers(motions, origins, axes),
        }
        geometry = {name: value.to(axes.device, dtype) for name, value in geometry.items()}
        self._set_geometry({**geometry, "slides": slides})
        warn_millimetres("origins", self.origins[:, :3, 3].abs(), _FAR)

    @classmethod
    def from_urdf(
        cls,
        text_or_path: str | PathLike[str],
        end_link: str,
        *,
        root_link: str | None = None,
        **options: Any,
    ) -> RigidChain:
        """Return the arm from one link of a URDF to another.

        Parameters
        ----------
        text_or_path : str or path
            XML text, or the file that holds it.
        end_link : str
            The link whose frame carries the tool.
        root_link : str, optional
            The link that is the base. Default: the root of the tree that `end_link` is in.
        **options
            `tool`, `base` and `dtype`, as for `RigidChain`.

        Returns
        -------
        RigidChain
            Its actuators are the moving joints of the path, in order. Equal limits lock a joint;
            continuous joints, and with a warning joints without <limit>, have infinite ones.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            For text that is no URDF, links that are not one tree, a path without moving joint,
            limits that are swapped or NaN, and joints that are floating, planar or mimic another.

        Warns
        -----
        UserWarning
            Of joints without <limit>, and of joints whose limits are both zero.
        """
        return cls(**moving_joints(urdf_path(text_or_path, end_link, root_link)), **options)

    @classmethod
    def from_mjcf(
        cls,
        text_or_path: str | PathLike[str],
        end_link: str,
        *,
        root_link: str | None = None,
        **options: Any,
    ) -> RigidChain:
        """Return the arm from one body of a MuJoCo model to another body or site.

        Parameters
        ----------
        text_or_path : str or path
            XML text, or the file that holds it.
        end_link : str
            The body, or else the site, whose frame carries the tool.
        root_link : str, optional
            The body that is the base. Default: the world.
        **options
            `tool`, `base` and `dtype`, as for `RigidChain`.

        Returns
        -------
        RigidChain
            Its actuators are the hinges and slides of the path, in order; q is MuJoCo's qpos.
            Limits are those of `range`, infinite without one or with ``limited="false"``.

        Raises
        ------
        ImportError
            Without mujoco.
        FileNotFoundError
            If there is no such file.
        ValueError
            For text that is no MJCF, bodies that are not there or not connected, a path without
            moving joint, a `range` that is no interval, and free or ball joints.
        """
        return cls(**moving_joints(mjcf_path(text_or_path, end_link, root_link)), **options)

    @classmethod
    def from_chain(cls, chain: KinematicsChain, **options: Any) -> RigidChain:
        """Return the arm of a pytorch_kinematics chain without branches.

        Parameters
        ----------
        chain : pytorch_kinematics SerialChain
            Starts at the base and ends at the end link. It is not changed.
        **options
            `tool`, `base` and `dtype`, as for `RigidChain`.

        Returns
        -------
        RigidChain
            Rotations are made orthonormal to double precision; pytorch_kinematics reads files in
            single precision.

        Raises
        ------
        ValueError
            For chains that branch or have no moving joint.
        """
        return cls(**moving_joints(chain_path(chain)), **options)

    @property
    def limits(self) -> dict[str, Any]:
        """The limits of the joints, as tensors of shape (n,)."""
        return {name: self.get_buffer(name) for name in ("q_min", "q_max", "dq_max")}

    @property
    def default_parameters(self) -> tuple[str, ...]:
        """The geometry that a calibration fits by default."""
        return ("base",)

    @property
    def reach(self) -> Tensor:
        """The natural size of the arm, shape () [m]: links, finite strokes and tool end to end."""
        strokes = torch.maximum(self.q_min.abs(), self.q_max.abs())
        strokes = torch.where(self.slides & torch.isfinite(strokes), strokes, 0.0)
        links = torch.linalg.vector_norm(self.origins[:, :3, 3], dim=1).sum()
        ends = torch.linalg.vector_norm(torch.stack([self.tip[:3, 3], self.tool]), dim=1).sum()
        reach = links + strokes.sum() + ends
        return torch.where(reach > 0, reach, 1.0)

    def _set_geometry(self, geometry: Mapping[str, Tensor | None]) -> None:
        for name, value in geometry.items():
            self.register_buffer(name, value)

    def forward(self, q: Tensor) -> Tensor:
        """Return the tip position.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Joint positions [rad], of prismatic joints [m].

        Returns
        -------
        Tensor of shape (..., 3)
            Tip position in the measuring frame [m].
        """
        check_vectors(q, self.n_actuators, "q", self._why_shape())
        return in_blocks(self._tip, q)[0]

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip (..., 3) [m] and its Jacobian dx/dq (..., 3, n) in one pass.

        In closed form, in [m/rad] for revolute joints and [-] for prismatic ones.
        """
        check_vectors(q, self.n_actuators, "q", self._why_shape())
        x, J = in_blocks(self._forward_and_jacobian, q)
        return x, J

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip's pose (..., 4, 4) in the measuring frame, and `pose_jacobian(q)`."""
        tip, linear, axes, frame = self._columns(q)
        slides = self.slides.to(q.device)[:, None, None]
        angular = torch.where(slides, torch.zeros_like(axes), axes)
        columns = [self._in_measuring_frame(part, q) for part in (linear, angular)]
        turned = (self.tip.to(q)[:, :3].T @ frame.flatten(1)).unflatten(1, (3, -1))
        local = torch.cat([turned, tip[None]]).permute(2, 1, 0)  # (N, 3, 4): axes and tip
        last = identity(4, q)[3].expand(len(local), 1, 4)
        pose = (self.base.to(q) @ torch.cat([local, last], 1)).reshape(*q.shape[:-1], 4, 4)
        return pose, torch.cat(columns, dim=-2)

    def poses(self, q: Tensor) -> Tensor:
        """Return the pose of the base and of the link that every joint moves.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Joint positions [rad], of prismatic joints [m].

        Returns
        -------
        Tensor of shape (..., n_actuators + 1, 4, 4)
            Homogeneous transforms into the measuring frame; the last one is the tip: the end link
            moved to its tool.
        """
        frames, base = self._frames(q), self.base.to(q)
        frames = base @ frames
        end = torch.cat([self.tip.to(q)[:, :3], self._end(q)[:, None]], dim=1)
        first = base.expand(*q.shape[:-1], 1, 4, 4)
        last = frames[..., -1:, :, :] @ end
        return torch.cat([first, frames[..., :-1, :, :], last], dim=-3)

    def pose(self, q: Tensor) -> Tensor:
        """Return the tip's pose in the measuring frame, shape (..., 4, 4)."""
        return self.poses(q)[..., -1, :, :]

    def backbone(self, q: Tensor, n_points: int = 1) -> Tensor:
        """Return points along the straight lines from the base through all joints to the tip.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Joint positions [rad], of prismatic joints [m].
        n_points : int, default=1
            Points per line; the last of each is its end.

        Returns
        -------
        Tensor of shape (..., (n_actuators + 1) * n_points + 1, 3)
            Positions in the measuring frame [m].
        """
        if n_points < 1:
            raise ValueError(f"`n_points` must be at least 1, got {n_points}.")
        frames, base = self._frames(q), self.base.to(q)[:3]
        joints = (base @ frames[..., 3:])[..., 0]
        first = base[:, 3].expand(*q.shape[:-1], 1, 3)
        corners = torch.cat([first, joints, self(q)[..., None, :]], dim=-2)
        start, end = corners[..., :-1, None, :], corners[..., 1:, None, :]
        t = torch.linspace(0.0, 1.0, n_points + 1, dtype=q.dtype, device=q.device)[1:, None]
        return torch.cat([corners[..., :1, :], torch.lerp(start, end, t).flatten(-3, -2)], dim=-2)

    def unit_messages(self, q: Tensor, name: str, factor: float = 1.0) -> list[str]:
        """Return warnings where joints turn by more than two turns, or slide far."""
        turned = degrees_message(name, q[:, ~self.slides].abs(), factor)
        slid = millimetres_message(name, q[:, self.slides].abs(), factor * _FAR)
        return [message for message in (turned, slid) if message is not None]

    def extra_repr(self) -> str:
        """Return the summary shown by repr()."""
        return f"{self.n_actuators} joints: {', '.join(self.names)}"

    def _why_shape(self) -> str:
        return f"this arm has {self.n_actuators} moving joints"

    def _shares(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return u_1 and u_2 of every joint, in rows of shape (N, n)."""
        check_vectors(q, self.n_actuators, "q", self._why_shape())
        slides = self.slides if "prismatic" in self.kinds else None
        return _joint_motions.shares(q.reshape(-1, self.n_actuators), slides)

    def _frames(self, q: Tensor) -> Tensor:
        """Return every joint's moving frame in the base frame, shape (..., n, 4, 4)."""
        return _joint_motions.frames(*self._shares(q), self.motions.to(q)).reshape(*q.shape, 4, 4)

    def _tip(self, q: Tensor) -> tuple[Tensor]:
        p = _joint_motions.carried_tip(*self._shares(q), self.motions.to(q), self._end(q))
        return ((self.base.to(q)[:3] @ p).T.reshape(*q.shape[:-1], 3),)

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        tip, linear, _, _ = self._columns(q)
        base = self.base.to(q)
        x = (base[:3, :3] @ tip + base[:3, 3:]).T
        return x.reshape(*q.shape[:-1], 3), self._in_measuring_frame(linear, q)

    def _columns(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return tip (3, N), its derivatives and the joint axes (n, 3, N), and the last frame.

        All are in the base frame; of the last joint's moving frame (4, 3, N) these are the three
        axes and the origin.
        """
        shares, carriers = self._shares(q), self.carriers.to(q)
        frame, axes, points = _joint_motions.last_frame_and_joints(*shares, carriers)
        tip = (self._end(q) @ frame.flatten(1)).unflatten(0, (3, -1))
        columns = torch.linalg.cross(axes, tip - points, dim=1)
        if "prismatic" in self.kinds:
            slides = self.slides.to(q.device)[:, None, None]
            columns = torch.where(slides, axes, columns)
        return tip, columns, axes, frame

    def _in_measuring_frame(self, columns: Tensor, q: Tensor) -> Tensor:
        """Return columns (n, 3, N) of the base frame as a Jacobian (..., 3, n)."""
        J = self.base.to(q)[:3, :3] @ columns
        return J.permute(2, 1, 0).reshape(*q.shape[:-1], 3, self.n_actuators)

    def _end(self, q: Tensor) -> Tensor:
        """Return the tool in the last joint's moving frame, homogeneous, shape (4,)."""
        return self.tip.to(q) @ nn.functional.pad(self.tool.to(q), (0, 1), value=1.0)

    @classmethod
    def from_stored(cls, stored: Stored, restore: Restore) -> RigidChain:
        """Return the arm of a description."""
        settings = {key: stored.list_of(str, key) for key in cls.layout.settings}
        arrays = {
            name: stored.array(name, finite=not name.startswith(("q_", "dq_")))
            for name in cls.layout.arrays
            if name in stored.arrays  # older files know no speeds
        }
        return cls(**arrays, **settings, dtype=torch.from_numpy(arrays["base"]).dtype)
