"""Kinematics of a rigid serial arm, as a torch module q -> x, from arrays, URDF or MJCF."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from hybridkin._core.arrays import Numbers, Transform
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.stored import Layout, Restore, Stored
from hybridkin._core.units import warn_millimetres
from hybridkin.chains._arm_files import chain_path, mjcf_path, moving_joints
from hybridkin.chains._checks import (
    filled,
    float_dtype,
    joint_limits,
    numeric,
    pose,
    rigid_pose,
)
from hybridkin.chains._joint_motions import FAR, JointChain
from hybridkin.chains._urdf import placed_urdf, urdf_path, urdf_text

if TYPE_CHECKING:
    from pytorch_kinematics.chain import Chain as KinematicsChain

__all__ = ["RigidChain"]

_KINDS = ("revolute", "prismatic")


def _write_plan(plan: Plan, stored: Stored) -> int:
    """Write the node of an arm: the frame of every joint relative to the one before."""
    slides = [kind == "prismatic" for kind in stored.list_of(str, "kinds")]
    n_joints = len(slides)
    if not slides:
        raise NoKernel("an arm without moving joints is a constant")
    plan.limit("actuators", n_joints)
    before = stored.array("base")
    numbers = []
    motions = stored.derived["motions"]
    origins = motions[:, 0] + motions[:, 2]
    for origin, axis in zip(origins, stored.array("axes"), strict=True):
        side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        side = side / np.linalg.norm(side)
        turn = np.eye(4)  # turns the joint's axis to z
        turn[:3, :3] = np.stack([side, np.cross(axis, side), axis], 1)
        frame = before @ origin @ turn
        numbers += [frame[:3, :3], frame[:3, 3]]
        before = turn.T
    before = before @ stored.array("tip")
    tip = before @ np.append(stored.array("tool"), 1.0)
    couplings = stored.arrays.get("couplings", np.zeros((0, n_joints)))
    numbers += [tip[:3], before[:3, :3], couplings]
    return plan.node(
        "rigid", couplings.shape[1], 3, numbers, n_joints, len(couplings) > 0, *slides
    )


class RigidChain(JointChain):
    """Tip position of a rigid serial arm, from its joint positions.

    The motion of a revolute joint is affine in sin q and cos q (Rodrigues' formula), that of a
    prismatic joint in q. One pass from base to tip gives tip and Jacobian, without autograd.

    Parameters
    ----------
    origins : array-like of shape (n_joints, 4, 4)
        Pose of every joint's frame at q = 0 in the moving frame of the previous joint; of the
        first one in the base. Without joints the tip is constant.
    axes : array-like of shape (n_joints, 3)
        Joint axes in the joints' frames; they are normalised.
    kinds : sequence of n_joints {"revolute", "prismatic"}, optional
        Type of every joint. Default: all revolute.
    couplings : array-like of shape (n_joints, n), optional
        Motion of every joint per motion of every actuator [-], for differentials and mimic
        joints: joint positions are ``couplings @ q``. Default: one actuator per joint.
    names : sequence of n str, optional
        Names of the actuators. Default: "joint_1", ...
    joint_zeros : float or array-like of shape (n,), default=0.0
        Value of q at which the joints are at their `origins` [rad] or [m].
    q_min, q_max : array-like of shape (n,), optional
        Joint limits [rad] or [m], the defaults of `InverseKinematics`; the arm itself ignores them.
        Default: infinite.
    dq_max : array-like of shape (n,), optional
        Largest joint speeds [rad/s] or [m/s], used likewise. Default: infinite.
    tip : array-like of shape (4, 4), optional
        Pose of the end link in the moving frame of the last joint. Default: identity.
    tool : array-like of shape (3,), default=(0, 0, 0)
        The controlled point (the tip), in the end link's frame [m].
    base : array-like of shape (4, 4) or pytorch_kinematics Transform3d, optional
        Pose of the arm's base in the measuring frame. Default: identity.
    dtype : torch.dtype, default=torch.float64
        Precision of the stored geometry. Results have the dtype of q.

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

    _entries = ("base", "joint_zeros", "tool")
    _arrays = ("origins", "axes", "tip", "tool", "q_min", "q_max", "dq_max", "base")
    _arrays += ("joint_zeros", "couplings")
    layout = Layout(
        "rigid",
        dict.fromkeys(_arrays, ""),
        {"kinds": list, "names": list},
        derived=("motions",),
        write_plan=_write_plan,
    )

    def __init__(
        self,
        origins: Numbers,
        axes: Numbers,
        *,
        kinds: Sequence[str] | None = None,
        couplings: Numbers | None = None,
        names: Sequence[str] | None = None,
        joint_zeros: Numbers = 0.0,
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
        axes = numeric(axes, "axes", need="n3")
        n_joints = len(axes)
        lengths = axes.norm(dim=1, keepdim=True)
        if not (lengths > 0).all():
            raise ValueError(f"`axes` must not have zero length, got {axes.tolist()}.")
        axes = axes / lengths
        origins = numeric(origins, "origins", need="n44", length=n_joints)
        for k in range(n_joints):
            origins[k] = rigid_pose(origins[k], f"origins[{k}]")
        if couplings is not None:
            couplings = numeric(couplings, "couplings", need="nm", length=n_joints)
        self.n_actuators = n = n_joints if couplings is None else couplings.shape[1]
        for name, value in (("kinds", kinds), ("names", names)):
            if value is not None and not np.iterable(value):
                raise TypeError(
                    f"`{name}` must be a sequence of strings, got {value!r:.80}."
                )
        if kinds is None:
            self.kinds = ("revolute",) * n_joints
        else:
            self.kinds = tuple(map(str, kinds))
        default = [f"joint_{k + 1}" for k in range(n)]
        self.names = tuple(map(str, default if names is None else names))
        if len(self.kinds) != n_joints or not set(self.kinds) <= set(_KINDS):
            need = f"must hold {n_joints} of {_KINDS}, one per joint"
            raise ValueError(f"`kinds` {need}, got {self.kinds}.")
        if len(self.names) != n:
            raise ValueError(
                f"`names` must hold {n} names, one per actuator, got {self.names}."
            )
        slides = [kind == "prismatic" for kind in self.kinds]
        geometry = {
            "origins": origins,
            "axes": axes,
            **joint_limits(n, q_min, q_max, dq_max),
            "tip": rigid_pose(np.eye(4) if tip is None else tip, "tip"),
            "tool": numeric(tool, "tool", need="3"),
            "base": pose(base, "base", torch.float64),
            "joint_zeros": filled(joint_zeros, "joint_zeros", torch.float64, (n,)),
            "couplings": couplings,
            "slides": torch.tensor(slides, dtype=torch.bool, device=axes.device),
        }
        self._set_geometry(geometry)
        self.to(dtype)
        warn_millimetres("origins", self.origins[:, :3, 3].abs(), FAR)

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
            XML text, or the path of a file with it.
        end_link : str
            The link whose frame carries the tool.
        root_link : str, optional
            The base link. Default: the root of the tree of `end_link`.
        **options
            `tool`, `base` and `dtype`, as for `RigidChain`.

        Returns
        -------
        RigidChain
            Its actuators are the moving joints of the path, in order. A mimic joint is replaced by
            the joint it mimics, on the path or not, with that joint's limits. A floating joint
            becomes six (x, y, z, yaw, pitch, roll), a planar one three (x, y, yaw, in the frame of
            the joint); their names end in "_" where another joint has the name. Equal limits lock
            a joint. Continuous joints have infinite limits, and so have, with a warning, joints
            without <limit>. A velocity of 0 means no speed limit. Without moving joints the tip is
            constant. Tags that are not part of URDF are ignored.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            For text that is not a URDF or declares entities, links that are not one tree, invalid
            numbers, and joints that mimic each other in a circle.

        Warns
        -----
        UserWarning
            For joints without <limit>, with swapped limits, and with limits that are both zero.
        """
        return cls(
            **moving_joints(urdf_path(text_or_path, end_link, root_link)), **options
        )

    def to_urdf(
        self,
        text_or_path: str | PathLike[str],
        end_link: str,
        *,
        root_link: str | None = None,
    ) -> str:
        """Return a URDF with the calibrated geometry of this arm: links and joint zeros.

        Parameters
        ----------
        text_or_path : str or path
            The XML text, or the path of the file, from which the arm was read.
        end_link, root_link : str
            As for `from_urdf`.

        Returns
        -------
        str
            The same text with new <origin> tags for moving joints whose origin has changed. Reading
            it gives this arm with zero `joint_zeros`. A URDF does not contain `base` and `tool`.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            If the URDF is not that of this arm, or if links or zeros have moved within a floating
            or planar joint.

        Examples
        --------
        >>> import torch
        >>> from hybridkin import RigidChain
        >>> text = '''<robot name="one"> <link name="a"/> <link name="b"/>
        ... <joint name="j" type="continuous"> <parent link="a"/> <child link="b"/> <!-- 1 -->
        ... <origin xyz="0 0 0.3"/> </joint> </robot>'''
        >>> arm = RigidChain.from_urdf(text, "b")
        >>> arm = arm.with_geometry(links=torch.tensor([[0.0, 0.0, 0.25]], dtype=torch.float64))
        >>> print(arm.to_urdf(text, "b"))
        <robot name="one"> <link name="a"/> <link name="b"/>
        <joint name="j" type="continuous"> <parent link="a"/> <child link="b"/> <!-- 1 -->
        <origin xyz="0.0 0.0 0.25" rpy="0.0 0.0 0.0"/> </joint> </robot>
        """
        origins = (self.motions[:, 0] + self.motions[:, 2]).double().numpy(force=True)
        return placed_urdf(
            urdf_text(text_or_path), end_link, root_link, self.names, origins
        )

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
            XML text, or the path of a file with it.
        end_link : str
            The body, or else the site, whose frame carries the tool.
        root_link : str, optional
            The base body. Default: the world.
        **options
            `tool`, `base` and `dtype`, as for `RigidChain`.

        Returns
        -------
        RigidChain
            Its actuators are the hinges and slides of the path, in order; q is MuJoCo's qpos.
            Limits are those of `range`; without it or with ``limited="false"`` they are infinite.

        Raises
        ------
        ImportError
            If mujoco is not installed.
        FileNotFoundError
            If there is no such file.
        ValueError
            For text that is not an MJCF, bodies that are missing or not connected, a path without
            a moving joint, a `range` that is not an interval, and free or ball joints.
        """
        return cls(
            **moving_joints(mjcf_path(text_or_path, end_link, root_link)), **options
        )

    @classmethod
    def from_chain(cls, chain: KinematicsChain, **options: Any) -> RigidChain:
        """Return the arm of a pytorch_kinematics chain without branches.

        Parameters
        ----------
        chain : pytorch_kinematics SerialChain
            A chain from the base to the end link. It is not changed.
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
        """Names of the parameters that a calibration fits by default."""
        return ("base",)

    @classmethod
    def from_stored(cls, stored: Stored, restore: Restore) -> RigidChain:
        """Return the arm built from a description."""
        settings = {key: stored.list_of(str, key) for key in cls.layout.settings}
        arrays = {
            name: stored.array(name, finite=not name.startswith(("q_", "dq_")))
            for name in cls.layout.arrays
            if name in stored.arrays
        }
        return cls(**arrays, **settings, dtype=torch.from_numpy(arrays["base"]).dtype)
