"""Kinematics of a rigid serial arm, as a torch module q -> x, from arrays, URDF or MJCF."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hybridkin._core.blocks import check_vectors, in_blocks
from hybridkin._core.units import millimetres_message, warn_millimetres
from hybridkin.chains._arm_files import Joint, chain_path, limits_of, mjcf_path, urdf_path
from hybridkin.chains._checks import check_replacements, pose
from hybridkin.chains.chain import Chain

if TYPE_CHECKING:
    from pytorch_kinematics.chain import Chain as KinematicsChain

__all__ = ["RigidChain"]

_KINDS = ("revolute", "prismatic")
_MANY_TURNS = 4.0 * math.pi  # [rad]; a joint that winds further is more likely in degrees
_FEW_ROWS = 64  # up to here the number of calls decides, not the work
_FAR = 10.0  # [m]; a joint that slides further is more likely in millimetres


class RigidChain(Chain):
    """Tip position of a rigid serial arm, from its joint positions.

    Every joint moves by T(q) = B_0 + u_1(q) B_1 + u_2(q) B_2 with three constant matrices: u_1,
    u_2 are sin q and cos q of a revolute joint (Rodrigues' formula), q and nothing of a prismatic
    one. Tip and Jacobian follow in one pass from base to tip, without autograd.

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
        Joint limits [rad] or [m], kept for `InverseKinematics`; the arm itself knows no limits.
        Default: none, infinite.
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

    origins: Tensor
    axes: Tensor
    q_min: Tensor
    q_max: Tensor
    tip: Tensor
    tool: Tensor
    slides: Tensor
    motions: Tensor
    carriers: Tensor

    def __init__(
        self,
        origins: Any,
        axes: Any,
        *,
        kinds: Sequence[str] | None = None,
        names: Sequence[str] | None = None,
        q_min: Any = None,
        q_max: Any = None,
        tip: Any = None,
        tool: Any = (0.0, 0.0, 0.0),
        base: Any = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        axes = _array(axes, "axes", (None, 3))
        n = len(axes)
        lengths = axes.norm(dim=1, keepdim=True)
        if n == 0 or not (lengths > 0).all():
            raise ValueError(
                f"`axes` must hold at least one axis, none of zero length, got {axes.tolist()}."
            )
        axes = axes / lengths
        origins = _array(origins, "origins", (n, 4, 4))
        origins = torch.stack([_rigid(origins[k], f"origins[{k}]") for k in range(n)])
        kinds = ("revolute",) * n if kinds is None else tuple(str(kind) for kind in kinds)
        names = (
            tuple(f"joint_{k + 1}" for k in range(n))
            if names is None
            else tuple(str(k) for k in names)
        )
        if len(kinds) != n or not set(kinds) <= set(_KINDS):
            raise ValueError(f"`kinds` must hold {n} of {_KINDS}, one per joint, got {kinds}.")
        if len(names) != n:
            raise ValueError(f"`names` must hold {n} names, one per joint, got {names}.")
        low = _array(np.full(n, -np.inf) if q_min is None else q_min, "q_min", (n,), finite=False)
        high = _array(np.full(n, np.inf) if q_max is None else q_max, "q_max", (n,), finite=False)
        if not (low <= high).all():
            raise ValueError(
                f"`q_min` must not exceed `q_max`, got {low.tolist()} and {high.tolist()}."
            )
        self.n_actuators = n
        self.kinds, self.names = kinds, names
        slides = torch.tensor([kind == "prismatic" for kind in kinds], device=axes.device)
        motions = _motions(origins, axes, slides)
        directions = torch.nn.functional.pad(origins[:, :3, :3] @ axes[..., None], (0, 0, 0, 1))
        buffers = {
            "origins": origins,
            "axes": axes,
            "q_min": low,
            "q_max": high,
            "tip": _rigid(torch.eye(4) if tip is None else tip, "tip"),
            "tool": _array(tool, "tool", (3,)),
            "base": pose(base, "base", dtype),
            "motions": motions,
            # From the columns of one frame to those of the next, times 1, u_1, u_2, and its axis.
            "carriers": torch.cat([motions.mT.flatten(1, 2), directions.mT], dim=1),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value.to(axes.device, dtype))
        self.register_buffer("slides", slides)
        warn_millimetres("origins", self.origins[:, :3, 3].abs(), _FAR)

    @classmethod
    def from_urdf(
        cls,
        text_or_path: str | PathLike[str],
        end_link: str,
        *,
        root_link: str | None = None,
        tool: Any = (0.0, 0.0, 0.0),
        base: Any = None,
        dtype: torch.dtype = torch.float64,
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
        tool, base, dtype
            As for `RigidChain`.

        Returns
        -------
        RigidChain
            Its actuators are the moving joints of the path, in order. Limits that are missing or
            empty (lower = upper) are infinite.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            For text that is no URDF, links that are not there or not connected, a path without
            moving joint, and joints that are floating, planar or mimic another one.
        """
        path = urdf_path(text_or_path, end_link, root_link)
        return cls._from_path(path, tool=tool, base=base, dtype=dtype)

    @classmethod
    def from_mjcf(
        cls,
        text_or_path: str | PathLike[str],
        end_link: str,
        *,
        root_link: str | None = None,
        tool: Any = (0.0, 0.0, 0.0),
        base: Any = None,
        dtype: torch.dtype = torch.float64,
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
        tool, base, dtype
            As for `RigidChain`.

        Returns
        -------
        RigidChain
            Its actuators are the hinges and slides of the path, in order; q is MuJoCo's qpos.

        Raises
        ------
        ImportError
            Without mujoco.
        FileNotFoundError
            If there is no such file.
        ValueError
            For text that is no MJCF, bodies that are not there or not connected, a path without
            moving joint, and free or ball joints.
        """
        path = mjcf_path(text_or_path, end_link, root_link)
        return cls._from_path(path, tool=tool, base=base, dtype=dtype)

    @classmethod
    def from_chain(
        cls,
        chain: KinematicsChain,
        *,
        tool: Any = (0.0, 0.0, 0.0),
        base: Any = None,
        dtype: torch.dtype = torch.float64,
    ) -> RigidChain:
        """Return the arm of a pytorch_kinematics chain without branches.

        Parameters
        ----------
        chain : pytorch_kinematics SerialChain
            Starts at the base and ends at the end link. It is not changed.
        tool, base, dtype
            As for `RigidChain`.

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
        return cls._from_path(chain_path(chain), tool=tool, base=base, dtype=dtype)

    @classmethod
    def _from_path(cls, path: Iterable[Joint], **options: Any) -> RigidChain:
        """Return the arm of the moving joints, the fixed ones folded into their poses."""
        moving: list[Joint] = []
        pending = np.eye(4)
        for joint in path:
            pending = pending @ joint.origin
            if joint.kind != "fixed":
                moving.append(joint._replace(origin=pending))
                pending = np.eye(4)
        if not moving:
            raise ValueError("the path from the root to `end_link` must have a moving joint.")
        limits = [limits_of(joint) for joint in moving]
        return cls(
            np.stack([joint.origin for joint in moving]),
            [joint.axis for joint in moving],
            kinds=[joint.kind for joint in moving],
            names=[joint.name or f"joint_{k + 1}" for k, joint in enumerate(moving)],
            q_min=[low for low, _ in limits],
            q_max=[high for _, high in limits],
            tip=pending,
            **options,
        )

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

    def geometry(self) -> dict[str, Tensor]:
        """Return the geometry by name: base, tool."""
        return {"base": self.base, "tool": self.tool}

    def with_geometry(self, **geometry: Tensor) -> RigidChain:
        """Return an arm with some of the geometry replaced, differentiable in the new values.

        Parameters
        ----------
        **geometry : Tensor of the shape that it has
            Entries of `geometry()`, in the same units. Their values are not checked.

        Returns
        -------
        RigidChain
            A new arm; this one is left as it was.
        """
        check_replacements(geometry, self.geometry())
        chain = type(self).__new__(type(self))
        nn.Module.__init__(chain)
        chain.n_actuators, chain.kinds, chain.names = self.n_actuators, self.kinds, self.names
        for name, value in {**dict(self.named_buffers()), **geometry}.items():
            chain.register_buffer(name, value)
        return chain

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

    def jacobian(self, q: Tensor) -> Tensor:
        """Return the position Jacobian dx/dq, shape (..., 3, n_actuators), in closed form."""
        return self.forward_and_jacobian(q)[1]

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip position [m] and its Jacobian in one pass.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Joint positions [rad], of prismatic joints [m].

        Returns
        -------
        x : Tensor of shape (..., 3)
            Tip position [m].
        J : Tensor of shape (..., 3, n_actuators)
            Closed-form Jacobian dx/dq [m/rad], of prismatic joints [-].
        """
        check_vectors(q, self.n_actuators, "q", self._why_shape())
        x, J = in_blocks(self._forward_and_jacobian, q)
        return x, J

    def numpy_function(self) -> Callable[[NDArray], tuple[NDArray, NDArray]]:
        """Return a NumPy function for one configuration at a time, without torch's overhead.

        Returns
        -------
        function
            Maps q of shape (n_actuators,) to the tip position (3,) [m] and its Jacobian
            (3, n_actuators), in float64. It keeps the arm's present geometry.

        Examples
        --------
        >>> import numpy as np
        >>> from hybridkin import RigidChain
        >>> arm = RigidChain([np.eye(4)], [[0, 0, 1]], tool=[0.2, 0, 0])
        >>> x, J = arm.numpy_function()(np.zeros(1))
        >>> J[:, 0]
        array([0. , 0.2, 0. ])
        """
        buffers = (self.motions, self.axes, self._end(self.motions), self.base)
        motions, axes, end, base = (part.detach().cpu().double().numpy() for part in buffers)
        # Moving frames turned so that every joint's axis is their z-axis: it can then be read off.
        turns = np.stack([_frame_along(axis) for axis in axes])
        motions = motions @ turns[:, None]
        motions[1:] = turns[:-1, None].swapaxes(-1, -2) @ motions[1:]
        still, by_u1, by_u2 = (np.ascontiguousarray(part) for part in motions.swapaxes(0, 1))
        end = turns[-1].T @ end
        # Rows x, y, z, x, y: a cross product is then two products of slices.
        first = base[[0, 1, 2, 0, 1]]
        slides = self.slides.cpu().numpy()
        sliding = bool(slides.any())

        def tip_and_jacobian(q: NDArray) -> tuple[NDArray, NDArray]:
            u1 = np.where(slides, q, np.sin(q)) if sliding else np.sin(q)
            steps = still + u1[:, None, None] * by_u1 + np.cos(q)[:, None, None] * by_u2
            frame, frames = first, []
            for step in steps:
                frame = frame.dot(step)
                frames.append(frame)
            tip = frame.dot(end)
            columns = np.array(frames)
            z, lever = columns[:, :, 2].T, tip[:, None] - columns[:, :, 3].T
            J = z[1:4] * lever[2:5] - z[2:5] * lever[1:4]
            return tip[:3], np.where(slides, z[:3], J) if sliding else J

        return tip_and_jacobian

    def pose_jacobian(self, q: Tensor) -> Tensor:
        """Return the tip's linear and angular Jacobian, shape (..., 6, n_actuators).

        The first three rows are `jacobian(q)`, the others give the angular velocity in the
        measuring frame: [-] for revolute joints, zero for prismatic ones.
        """
        return self.pose_and_jacobian(q)[1]

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip's pose (..., 4, 4) in the measuring frame, and `pose_jacobian(q)`."""
        tip, linear, axes, frame = self._columns(q)
        slides = self.slides.to(q.device)[:, None, None]
        angular = torch.where(slides, torch.zeros_like(axes), axes)
        columns = [self._in_measuring_frame(part, q) for part in (linear, angular)]
        turned = (self.tip.to(q)[:, :3].T @ frame.flatten(1)).unflatten(1, (3, -1))
        local = torch.cat([turned, tip[None]]).permute(2, 1, 0)  # (N, 3, 4): axes and tip
        last = torch.eye(4).to(q)[3].expand(len(local), 1, 4)
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
        base = self.base.to(q)
        frames = base @ self._frames(q)
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
        base = self.base.to(q)[:3]
        joints = (base @ self._frames(q)[..., 3:])[..., 0]
        first = base[:, 3].expand(*q.shape[:-1], 1, 3)
        corners = torch.cat([first, joints, self(q)[..., None, :]], dim=-2)
        start, end = corners[..., :-1, None, :], corners[..., 1:, None, :]
        t = torch.linspace(0.0, 1.0, n_points + 1, dtype=q.dtype, device=q.device)[1:, None]
        return torch.cat([corners[..., :1, :], torch.lerp(start, end, t).flatten(-3, -2)], dim=-2)

    def _check_rows(self, rows: Tensor, name: str) -> list[str | None]:
        return [
            _degrees_message(name, rows[:, ~self.slides].abs()),
            millimetres_message(name, rows[:, self.slides].abs(), _FAR),
        ]

    def extra_repr(self) -> str:
        """Return the summary shown by repr()."""
        return f"{self.n_actuators} joints: {', '.join(self.names)}"

    def _why_shape(self) -> str:
        return f"this arm has {self.n_actuators} moving joints"

    def _parts(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return u_1 and u_2 of every joint, in rows of shape (N, n)."""
        check_vectors(q, self.n_actuators, "q", self._why_shape())
        rows = q.reshape(-1, self.n_actuators)
        first = rows.sin()
        if "prismatic" in self.kinds:
            first = torch.where(self.slides.to(q.device), rows, first)
        return first, rows.cos()

    def _tip(self, q: Tensor) -> tuple[Tensor]:
        """Return the tip, carried from the last joint's frame to the first's, batch last."""
        u1, u2 = (part.T.unbind() for part in self._parts(q))
        motions = self.motions.to(q).flatten(1, 2).unbind()
        end, base = self._end(q), self.base.to(q)
        p = end[:, None].expand(4, q.shape[:-1].numel())
        for k in range(self.n_actuators - 1, -1, -1):
            still, by_u1, by_u2 = (motions[k] @ p).split(4)
            p = torch.addcmul(torch.addcmul(still, u1[k], by_u1), u2[k], by_u2)
        return ((base[:3] @ p).T.reshape(*q.shape[:-1], 3),)

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
        few = q.shape[:-1].numel() <= _FEW_ROWS
        frame, axes, points = self._by_frames(q) if few else self._by_columns(q)
        tip = (self._end(q) @ frame.flatten(1)).unflatten(0, (3, -1))
        columns = torch.linalg.cross(axes, tip - points, dim=1)
        if "prismatic" in self.kinds:
            slides = self.slides.to(q.device)[:, None, None]
            columns = torch.where(slides, axes, columns)
        return tip, columns, axes, frame

    def _by_columns(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the last frame (4, 3, N), joint axes and joint positions (n, 3, N)."""
        parts = self._parts(q)
        n_rows = len(parts[0])
        # Three coordinates of every row side by side, so that a joint costs one small product.
        u1, u2 = (part.T.repeat(1, 3).unbind() for part in parts)
        frame = torch.eye(4, dtype=q.dtype, device=q.device)[:, :3].repeat_interleave(n_rows, 1)
        axes, points = [], []
        for k, carrier in enumerate(self.carriers.to(q).unbind()):
            still, by_u1, by_u2, axis = (carrier @ frame).split((4, 4, 4, 1))
            frame = torch.addcmul(torch.addcmul(still, u1[k], by_u1), u2[k], by_u2)
            axes.append(axis)
            points.append(frame[3:])
        shape = (self.n_actuators, 3, n_rows)
        axes, points = (torch.cat(part).reshape(shape) for part in (axes, points))
        return frame.unflatten(1, (3, n_rows)), axes, points

    def _by_frames(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the same as `_by_columns`; fewer calls, more work in each row."""
        frames = self._frames(q.reshape(-1, self.n_actuators))[..., :3, :]
        axes = (frames[..., :3] @ self.axes.to(q)[..., None])[..., 0]
        points = frames[..., 3].permute(1, 2, 0)
        return frames[:, -1].permute(2, 1, 0), axes.permute(1, 2, 0), points

    def _in_measuring_frame(self, columns: Tensor, q: Tensor) -> Tensor:
        """Return columns (n, 3, N) of the base frame as a Jacobian (..., 3, n)."""
        J = self.base.to(q)[:3, :3] @ columns
        return J.permute(2, 1, 0).reshape(*q.shape[:-1], 3, self.n_actuators)

    def _end(self, q: Tensor) -> Tensor:
        """Return the tool in the last joint's moving frame, homogeneous, shape (4,)."""
        return self.tip.to(q) @ torch.nn.functional.pad(self.tool.to(q), (0, 1), value=1.0)

    def _frames(self, q: Tensor) -> Tensor:
        """Return every joint's moving frame in the base frame, shape (..., n, 4, 4)."""
        u1, u2 = (part.reshape(q.shape)[..., None, None] for part in self._parts(q))
        still, by_u1, by_u2 = self.motions.to(q).unbind(1)
        steps = torch.addcmul(torch.addcmul(still, u1, by_u1), u2, by_u2).unbind(-3)
        frames = [steps[0]]
        for step in steps[1:]:
            frames.append(frames[-1] @ step)
        return torch.stack(frames, dim=-3)


def _motions(origins: Tensor, axes: Tensor, slides: Tensor) -> Tensor:
    """Return B_0, B_1, B_2 of every joint, its origin included, shape (n, 3, 4, 4)."""
    motions = origins.new_zeros(len(axes), 3, 4, 4)
    motions[:, 0, 3, 3] = 1.0
    eye = torch.eye(3, dtype=axes.dtype, device=axes.device)
    along = axes[:, :, None] * axes[:, None, :]
    slide = slides[:, None, None]
    motions[:, 0, :3, :3] = torch.where(slide, eye, along)
    motions[:, 1, :3, :3] = torch.where(slide, 0.0, torch.linalg.cross(eye[None], axes[:, None]))
    motions[:, 2, :3, :3] = torch.where(slide, 0.0, eye - along)
    motions[:, 1, :3, 3] = torch.where(slides[:, None], axes, 0.0)
    return origins[:, None] @ motions


def _frame_along(axis: NDArray) -> NDArray:
    """Return a rotation (4, 4) whose z-axis is the given one."""
    frame, order = np.eye(4), np.argsort(np.abs(axis))
    frame[:3, 2] = axis
    x = np.cross(np.eye(3)[order[0]], axis)  # across, and the least of the axis
    frame[:3, 0] = x / np.linalg.norm(x)
    frame[:3, 1] = np.cross(axis, frame[:3, 0])
    return frame


def _array(value: Any, name: str, shape: tuple[int | None, ...], *, finite: bool = True) -> Tensor:
    """Return an array as a float64 tensor of the given shape, checked."""
    try:
        array = value.detach() if isinstance(value, Tensor) else np.asarray(value)
        tensor = torch.as_tensor(array).to(torch.float64).clone()
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{name}` must be numeric, got {value!r}.") from error
    fits = tensor.ndim == len(shape)
    if not fits or any(b not in (None, a) for a, b in zip(tensor.shape, shape, strict=True)):
        need = ", ".join("n" if size is None else str(size) for size in shape)
        need = f"({need},)" if len(shape) == 1 else f"({need})"
        raise ValueError(f"`{name}` must have shape {need}, got {tuple(tensor.shape)}.")
    if (not torch.isfinite(tensor).all() and finite) or torch.isnan(tensor).any():
        raise ValueError(f"`{name}` must be finite, got {tensor.tolist()}.")
    return tensor


def _rigid(value: Any, name: str) -> Tensor:
    """Return a pose whose rotation is orthonormal to the last bit, checked."""
    matrix = pose(value, name, torch.float64)
    u, _, vh = torch.linalg.svd(matrix[:3, :3])
    matrix[:3, :3] = u @ vh
    matrix[3] = matrix.new_tensor([0.0, 0.0, 0.0, 1.0])
    return matrix


def _degrees_message(name: str, turns: Tensor) -> str | None:
    """Return a warning where angles are too large to be radians."""
    if not turns.numel() or float(turns.max()) <= _MANY_TURNS:
        return None
    return (
        f"`{name}` reaches {float(turns.max()):.4g} on a revolute joint, which looks like "
        "degrees; hybridkin works in radians."
    )
