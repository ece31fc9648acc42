"""Kinematics of a rigid serial arm, as a torch module q -> x, from arrays, URDF or MJCF."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from hybridkin._core.arrays import Numbers, Transform
from hybridkin._core.constants import constant
from hybridkin._core.derived import derived
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.stored import Layout, Restore, Stored
from hybridkin._core.units import degrees_message, length_message, warn_length
from hybridkin.chains._arm_files import (
    Joint,
    Options,
    chain_path,
    without_fixed,
)
from hybridkin.chains._checks import (
    filled,
    float_dtype,
    joint_limits,
    numeric,
    place_on_body,
    pose,
    rigid_pose,
)
from hybridkin.chains._joint_motions import (
    as_poses,
    carried_tip,
    joint_coefficients,
    joint_motions,
    moving_frames,
)
from hybridkin.chains._mjcf import mjcf_path
from hybridkin.chains.calibratable import Part, Scale
from hybridkin.chains.chain import Chain

if TYPE_CHECKING:
    from pytorch_kinematics.chain import Chain as KinematicsChain
    from typing_extensions import Unpack

__all__ = ["RigidChain"]

_FAR = 10.0  # [m]; a joint that slides further is more likely in millimetres
_LINK = 0.3  # [m]; a usual link
_KINDS = ("revolute", "prismatic")
# What is calibrated, what is mostly wrong first: each set of a choice has one more.
_CALIBRATED = ("base", "tool", "joint_zeros", "links", "axes")
_GEAR = 5.0  # largest factor on the gain of an actuator


def _write_plan(plan: Plan, stored: Stored) -> int:
    """Write the node of an arm up to its tip: frames of joints relative to those before."""
    couplings = stored.derived["couplings_to_tip"]
    n_joints, n = couplings.shape
    slides = [kind == "prismatic" for kind in stored.list_of(str, "kinds")][:n_joints]
    if not slides:
        raise NoKernel("an arm without moving joints is a constant")
    plan.limit("actuators", n_joints)
    before = stored.array("base")
    numbers = []
    origins = stored.derived["origins_to_tip"]
    axes = stored.derived["unit_axes"][:n_joints]
    for origin, axis in zip(origins, axes, strict=True):
        farthest = np.eye(3)[np.abs(axis).argmin()]
        side = np.cross(axis, farthest)
        side = side / np.linalg.norm(side)
        turn = np.eye(4)  # turns the joint's axis to z
        turn[:3, :3] = np.column_stack([side, np.cross(axis, side), axis])
        frame = before @ origin @ turn
        numbers += [frame[:3, :3], frame[:3, 3]]
        before = turn.T
    end = before @ stored.derived["end"]
    numbers += [end[:3, 3], end[:3, :3]]
    coupled = not np.array_equal(couplings, np.eye(n_joints))
    if coupled:
        numbers.append(couplings)
    return plan.node("rigid", n, 3, numbers, n_joints, coupled, *slides)


class _Links(NamedTuple):
    """What `forward` needs of the joints and of the tip, derived from the geometry."""

    motions: Tensor  # (n_joints, 3, 4, 4), see `joint_motions`
    axes: Tensor  # (n_joints, 3), of length 1
    end: Tensor  # (4, 4)
    slides: Tensor  # (n_joints,), bool

    def to(self, like: Tensor) -> _Links:
        """Return it in the dtype and on the device of a tensor."""
        return _Links(
            self.motions.to(like),
            self.axes.to(like),
            self.end.to(like),
            self.slides.to(like.device),
        )

    def columns(self, frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the tip (3, N), its derivatives and the joint axes (n_joints, 3, N).

        `frames` are those of `moving_frames`.
        """
        tip = torch.tensordot(self.end[:, 3], frames[-1], 1)
        axes = (self.axes[..., None, None] * frames[1:, :3]).sum(1)
        turning = torch.linalg.cross(axes, tip - frames[1:, 3], dim=1)
        sliding = axes + (tip - tip)  # NaN in a row of NaN
        return tip, torch.where(self.slides[:, None, None], sliding, turning), axes


class RigidChain(Chain):
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
    ddq_max : array-like of shape (n,), optional
        Largest accelerations of the joints [rad/s^2] or [m/s^2], used likewise. Default: infinite.
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

    kinds: tuple[str, ...]
    names: tuple[str, ...]
    tip_at: float

    _entries = ("base", "joint_zeros", "tool")
    _zeros = "joint_zeros"
    _units: ClassVar[dict[str, str]] = {**Chain._units, "axes": "-", "couplings": "-"}
    aliases: ClassVar[dict[str, str]] = {"gains": "couplings"}
    # A rigid arm is what its model says; a third of the parameters are redundant.
    rows_per_parameter: ClassVar[float] = 1.0
    _structure = ("n_actuators", "kinds", "names", "tip_at")
    _limits = ("q_min", "q_max", "dq_max", "ddq_max")
    _arrays = ("origins", "axes", "tip", "tool", *_limits, "base")
    _arrays += ("joint_zeros", "couplings")
    layout = Layout(
        "rigid",
        dict.fromkeys(_arrays, ""),
        {"kinds": list, "names": list, "tip_at": float},
        derived=("origins_to_tip", "unit_axes", "end", "couplings_to_tip"),
        write_plan=_write_plan,
    )
    computed = ("origins_at_zero", "end", "motions", "slides")

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
        ddq_max: Numbers | None = None,
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
        if couplings is None:
            couplings = np.eye(n_joints)
        couplings = numeric(couplings, "couplings", need="nm", length=n_joints)
        n = couplings.shape[1]
        self.n_actuators = n
        self.kinds = _strings(kinds, "kinds", ["revolute"] * n_joints)
        self.names = _strings(names, "names", [f"joint_{k + 1}" for k in range(n)])
        self.tip_at = float(n_joints)
        if not set(self.kinds) <= set(_KINDS):
            raise ValueError(f"`kinds` must be among {_KINDS}, got {self.kinds}.")
        if tip is None:
            tip = np.eye(4)
        geometry = {
            "origins": origins,
            "axes": axes,
            **joint_limits(n, q_min, q_max, dq_max, ddq_max),
            "tip": rigid_pose(tip, "tip"),
            "tool": numeric(tool, "tool", need="3"),
            "base": pose(base, "base", torch.float64),
            "joint_zeros": filled(joint_zeros, "joint_zeros", torch.float64, (n,)),
            "couplings": couplings,
        }
        self._set_geometry(geometry)
        self.to(dtype)
        warn_length("origins", self.origins[:, :3, 3].abs(), _FAR, _LINK)

    @classmethod
    def from_urdf(
        cls,
        text_or_path: str | PathLike[str],
        end_link: str,
        *,
        root_link: str | None = None,
        **options: Unpack[Options],
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
            `tool`, `base`, `joint_zeros` and `dtype`, as for `RigidChain`.

        Returns
        -------
        RigidChain
            Its actuators are the moving joints of the path, in order. A mimic joint is replaced by
            the joint it mimics, on the path or not, with that joint's limits. A floating joint
            becomes six (x, y, z, yaw, pitch, roll), a planar one three (x, y, yaw, in the frame of
            the joint). Equal limits lock a joint. Continuous joints have infinite limits, and so
            have, with a warning, joints without <limit>. A velocity of 0 means no speed limit. An
            acceleration or a deceleration (URDF 1.2), the smaller one, is `ddq_max`.
            Without moving joints the tip is constant. Tags that are not part of URDF are ignored.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            For text that is not a URDF or has a DOCTYPE, links that are missing or not connected,
            invalid numbers, and joints that mimic each other in a circle.

        Warns
        -----
        UserWarning
            For joints without <limit>, with swapped limits, and with limits that are both zero.
        """
        from hybridkin.chains._urdf import Urdf  # loads lxml

        return cls._of_joints(Urdf(text_or_path, end_link, root_link).joints, options)

    def to_urdf(
        self,
        text_or_path: str | PathLike[str],
        end_link: str,
        *,
        root_link: str | None = None,
    ) -> str:
        """Return a URDF with the calibrated geometry of this arm: links, joint zeros and axes.

        Parameters
        ----------
        text_or_path : str or path
            The XML text, or the path of the file, from which the arm was read.
        end_link, root_link : str
            As for `from_urdf`.

        Returns
        -------
        str
            The same XML with new <origin> and <axis> tags for moving joints whose origin or axis
            has changed. Reading it gives this arm with zero `joint_zeros`. A URDF does not contain
            `base`, `tool` and calibrated gains.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            If the URDF is not that of this arm, or has a floating or planar joint on the path.

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
        from hybridkin.chains._urdf import Urdf  # loads lxml

        origins = self.origins_at_zero.double().numpy(force=True)
        axes = self.unit_axes.double().numpy(force=True)
        return Urdf(text_or_path, end_link, root_link).placed(self.names, origins, axes)

    @classmethod
    def from_mjcf(
        cls,
        text_or_path: str | PathLike[str],
        end_link: str,
        *,
        root_link: str | None = None,
        **options: Unpack[Options],
    ) -> RigidChain:
        """Return the arm from one body of a MuJoCo model to another body or site.

        Parameters
        ----------
        text_or_path : str or path
            XML text, or the path of a file with it. Files that it includes are read too.
        end_link : str
            The body or site whose frame carries the tool.
        root_link : str, optional
            The base body. Default: the world.
        **options
            `tool`, `base`, `joint_zeros` and `dtype`, as for `RigidChain`.

        Returns
        -------
        RigidChain
            Its actuators are the hinges and slides of the path, in order, with the limits that
            MuJoCo uses. q = 0 is MuJoCo's ``qpos`` = 0. A joint that an <equality> holds at
            ``a + b q`` of another joint is replaced by that joint, on the path or not, with that
            joint's limits; one that it holds at a constant is fixed.

        Raises
        ------
        ImportError
            If MuJoCo is not installed.
        FileNotFoundError
            If there is no such file.
        ValueError
            For text that is not an MJCF, bodies that are missing or not connected, free or ball
            joints, joints that an <equality> couples otherwise or in a circle, and a driven fixed
            tendon that moves several joints which nothing else drives.

        Warns
        -----
        UserWarning
            If <connect> or <weld> ties a body of the path to another one, which is ignored.
        """
        path = mjcf_path(text_or_path, end_link, root_link)
        return cls._of_joints(path, options)

    @classmethod
    def from_chain(cls, chain: KinematicsChain, **options: Unpack[Options]) -> RigidChain:
        """Return the arm of a pytorch_kinematics chain without branches.

        Parameters
        ----------
        chain : pytorch_kinematics SerialChain
            A chain from the base to the end link. It is not changed.
        **options
            `tool`, `base`, `joint_zeros` and `dtype`, as for `RigidChain`.

        Returns
        -------
        RigidChain
            Rotations are made orthonormal to double precision; pytorch_kinematics reads files in
            single precision.

        Raises
        ------
        ValueError
            For chains that branch.
        """
        return cls._of_joints(chain_path(chain), options)

    @classmethod
    def _of_joints(cls, path: Sequence[Joint], options: Options) -> RigidChain:
        """Return the arm of the joints from its base to its end link, fixed ones included."""
        joints, tip = without_fixed(path)
        n = len(joints)
        # The last joint of an actuator stands for all: they have the same name and limits.
        actuators = {joint.actuator: joint for joint in joints}
        columns = [*actuators]
        couplings = np.zeros((n, len(columns)))
        for k, joint in enumerate(joints):
            couplings[k, columns.index(joint.actuator)] = joint.factor
        limits = np.array([joint.limits for joint in actuators.values()])
        q_min, q_max, dq_max, ddq_max = limits.reshape(-1, 4).T
        return cls(
            np.reshape([joint.origin for joint in joints], (n, 4, 4)),
            np.reshape([joint.axis for joint in joints], (n, 3)),
            kinds=[joint.kind for joint in joints],
            couplings=couplings,
            names=[joint.name for joint in actuators.values()],
            q_min=q_min,
            q_max=q_max,
            dq_max=dq_max,
            ddq_max=ddq_max,
            tip=tip,
            **options,
        )

    @classmethod
    def from_stored(cls, stored: Stored, restore: Restore) -> RigidChain:
        """Return the arm built from a description."""
        settings = {key: stored.list_of(str, key) for key in ("kinds", "names")}
        arrays = {}
        for name in cls.layout.arrays:
            if name in stored.arrays:
                arrays[name] = stored.array(name, finite=name not in cls._limits)
        dtype = torch.from_numpy(arrays["base"]).dtype
        arm = cls(**arrays, **settings, dtype=dtype)
        # The constructor rounds poses and axes; the state is what the file holds.
        for name, array in arrays.items():
            arm._set_geometry({name: torch.tensor(array, dtype=dtype, device="cpu")})
        if not arm.kinds or "tip_at" not in stored.settings:  # an earlier file
            return arm
        return arm.with_tip(stored.value("tip_at", float))

    def geometry(self) -> dict[str, Tensor]:
        """Return the geometry by name.

        Besides arguments of the constructor this has "links", shape (n_joints, 3) [m]: the origin
        of every joint in the moving frame of the previous joint. The last link is the `tool`.
        """
        links = self.origins[:, :3, 3]
        geometry = {**super().geometry(), "links": links}
        return {**geometry, "axes": self.axes, "couplings": self.couplings}

    def _set_geometry(self, geometry: Mapping[str, Tensor | None]) -> None:
        entries = dict(geometry)
        links = entries.pop("links", None)
        if links is not None:
            entries["origins"] = _with_positions(self.origins, links)
        super()._set_geometry(entries)

    def _links(self) -> _Links:
        """Return the joints up to the tip."""
        return self._links_to(self.tip_at)

    @derived("origins", "axes", "tip", "tool")
    def _links_to(self, tip_at: float) -> _Links:
        m = self._joints_to_tip
        slides = self.slides[:m]
        axes = self.unit_axes[:m]
        motions = joint_motions(self.origins[:m], axes, slides)
        return _Links(motions, axes, self.end, slides)

    @property
    def slides(self) -> Tensor:
        """Which joints (n_joints,) are prismatic, bool."""
        slides = tuple(kind == "prismatic" for kind in self.kinds)
        return constant(slides, self.axes, torch.bool)

    @property
    def unit_axes(self) -> Tensor:
        """The axes of the joints (n_joints, 3) of length 1, in the joints' frames."""
        return self.axes / self.axes.norm(dim=1, keepdim=True)

    @property
    def end(self) -> Tensor:
        """Pose of the tip in the moving frame of the last joint before it, shape (4, 4)."""
        m = self._joints_to_tip
        if m < len(self.kinds):
            turned, link = self.origins[m], self.origins[m, :3, 3]
        else:
            turned, link = self.tip, self.tip[:3, :3] @ self.tool + self.tip[:3, 3]
        return _with_positions(turned, self._part_of_link * link)

    @property
    def origins_at_zero(self) -> Tensor:
        """Poses of the frames of the joints at q = 0, shape (n_joints, 4, 4)."""
        return self._whole.origins_to_tip

    @property
    def origins_to_tip(self) -> Tensor:
        """Poses of the frames of the m joints before the tip at q = 0, shape (m, 4, 4)."""
        motions, _, _, slides = self._links()
        z = -self.couplings_to_tip @ self.joint_zeros
        u1, u2 = joint_coefficients(z[:, None, None], slides[:, None, None])
        still, by_u1, by_u2 = motions.unbind(1)
        return still + u1 * by_u1 + u2 * by_u2

    def with_tip(self, at: float) -> RigidChain:
        """Return an arm whose tip is another point of the same arm.

        Parameters
        ----------
        at : float
            Place on the straight lines from joint to joint, in joints: 0.5 is the middle between
            the origins of the first and of the second joint, 1.0 the origin of the second joint,
            n_joints (the default) the arm's end. The origin of a prismatic joint does not slide
            with it.

        Returns
        -------
        RigidChain
            Tip, Jacobians and tip transform belong to that point, which turns like the end of its
            link; actuators, poses and backbone still belong to the whole arm.

        Raises
        ------
        ValueError
            For a place that is not on the arm.

        Examples
        --------
        The middle of the second of two links of 0.3 m and 0.2 m:

        >>> import numpy as np
        >>> import torch
        >>> from hybridkin import RigidChain
        >>> origins = np.stack([np.eye(4), np.eye(4)])
        >>> origins[1, 0, 3] = 0.3
        >>> arm = RigidChain(origins, [[0, 0, 1], [0, 0, 1]], tool=[0.2, 0, 0])
        >>> arm.with_tip(1.5)(torch.tensor([0.0, torch.pi / 2]))
        tensor([0.3000, 0.1000, 0.0000])
        """
        arm = self.with_geometry()  # shares the buffers
        arm.tip_at = place_on_body(at, len(self.kinds))
        return arm

    @property
    def _whole(self) -> RigidChain:
        """The arm up to its end."""
        end = float(len(self.kinds))
        return self if self.tip_at == end else self.with_tip(end)

    @property
    def _joints_to_tip(self) -> int:
        """Number of joints before the tip."""
        return math.ceil(self.tip_at)

    @property
    def _part_of_link(self) -> float:
        """The part of the link with the tip that lies before it."""
        return 1.0 + self.tip_at - self._joints_to_tip

    @property
    def couplings_to_tip(self) -> Tensor:
        """Motion of the m joints before the tip per motion of every actuator, shape (m, n)."""
        m = self._joints_to_tip
        if self._part_of_link == 1.0:
            return self.couplings[:m]
        reached = torch.ones_like(self.couplings[:m])
        if self.kinds[m - 1] == "prismatic":  # the stroke is a part of the link
            reached[-1] = self._part_of_link
        return reached * self.couplings[:m]

    def body_lengths(self, q: Tensor) -> Tensor:
        """Return the length (..., n_joints + 1) of the lines up to every joint and the end [m].

        The first joint is at 0. The places are those of `with_tip`.
        """
        arm = self._whole
        frames = arm._joint_poses(q)[..., :3, :]
        next_joints = torch.cat([arm.origins[:, :, 3], arm.end[None, :, 3]]).to(q)
        places = (frames @ next_joints[..., None])[..., 0]
        links = places.diff(dim=-2).norm(dim=-1)
        return nn.functional.pad(links.cumsum(-1), (1, 0))

    @property
    def body_radii(self) -> Tensor:
        """Infinite radii of the links, shape (n_joints,) [m]: a description does not hold them."""
        return torch.full_like(self.axes[:, 0], torch.inf)

    @property
    def default_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that a calibration fits by default: all but gains."""
        return self.parameter_sets[-1]

    @property
    def parameter_sets(self) -> list[tuple[str, ...]]:
        """Sets of parameters that ``calibrate="auto"`` compares, the smaller ones first."""
        n_sets = len(_CALIBRATED) if self.kinds else 1  # of a constant, the base is all
        return [_CALIBRATED[:k] for k in range(n_sets + 1)]

    @property
    def parameter_names(self) -> list[str]:
        """Names that `calibrate` accepts: of the couplings only the "gains"."""
        return [name for name in super().parameter_names if name != "couplings"]

    @property
    def reversible(self) -> tuple[int, ...]:
        """Actuators whose motors may count in the opposite direction: all."""
        return tuple(range(self.n_actuators))

    def with_reversed(self, actuators: Sequence[int]) -> RigidChain:
        """Return the arm with some actuators, and their limits, in the opposite direction."""
        if not np.iterable(actuators) or not set(actuators) <= set(self.reversible):
            raise ValueError(
                f"`actuators` must hold places from 0 to {self.n_actuators - 1}, got "
                f"{actuators!r:.80}; this arm has {self.n_actuators} actuators."
            )
        flipped = set(actuators)
        signs = self.q_min.new_tensor([-1.0 if k in flipped else 1.0 for k in self.reversible])
        low = torch.where(signs < 0, -self.q_max, self.q_min)
        high = torch.where(signs < 0, -self.q_min, self.q_max)
        arm = self.with_geometry(couplings=self.couplings * signs)
        arm._set_geometry({"q_min": low, "q_max": high})
        return arm

    @property
    def limits(self) -> dict[str, Tensor]:
        """The limits of the joints, as tensors of shape (n,)."""
        return {name: getattr(self, name) for name in self._limits}

    @property
    def reach(self) -> Tensor:
        """Size of the arm, shape () [m]: the sum of links, finite strokes and tool."""
        farthest = torch.maximum(self.q_min.abs(), self.q_max.abs())
        farthest = torch.where(torch.isfinite(farthest), farthest, 0.0)
        links = self.origins[:, :3, 3].norm(dim=1).sum()
        end_link = self.tip[:3, 3].norm() + self.tool.norm()
        reach = links + self._strokes(farthest) + end_link
        return torch.where(reach > 0, reach, 1.0)

    def longest(self, largest: Tensor) -> Tensor:
        """Return the reach plus the strokes of prismatic joints within ``|q| <= largest``."""
        return self.reach + self._strokes(largest + self.joint_zeros.abs())

    def _strokes(self, largest: Tensor) -> Tensor:
        """Return the sum of the strokes of prismatic joints for ``|q| <= largest``."""
        sliding = tuple(k for k, kind in enumerate(self.kinds) if kind == "prismatic")
        joints = constant(sliding, self.couplings, torch.long)
        couplings = self.couplings.index_select(0, joints).to(largest)
        return (couplings.abs() @ largest).sum()

    @property
    def turns(self) -> Tensor:
        """Which actuators are angles with a period of one turn, shape (n,), bool."""
        whole_turns = torch.where(self.slides[:, None], 0.0, self.couplings.round())
        return (self.couplings == whole_turns).all(0)

    @property
    def unit_of_q(self) -> list[str]:
        """The unit of every actuator: "rad" if it turns a joint, else "m"."""
        turns = (self.couplings[~self.slides] != 0.0).any(0)
        return ["rad" if turn else "m" for turn in turns.tolist()]

    def scale_of(self, entry: str) -> Scale:
        """Return the natural scale of the numbers of an entry of the geometry."""
        if entry == "axes":
            return Scale.of_unit_vectors()
        if entry == "couplings":
            return Scale.factor(_GEAR)
        if entry != "joint_zeros":
            return super().scale_of(entry)
        kinds = self.unit_of_q
        units = np.where(np.array(kinds) == "m", float(self.reach), 1.0)
        return Scale(units, kinds)

    def part_of(self, name: str) -> Part:
        """Return what a parameter of `calibrate` changes of the geometry."""
        if name == "axes":
            return Part.unit_vectors(name, self.unit_axes.numpy(force=True).astype(float))
        if name != "gains":
            return super().part_of(name)
        n_joints, n = self.couplings.shape
        columns = np.tile(np.eye(n), (n_joints, 1))
        driven = (self.couplings != 0.0).numpy(force=True)
        first = driven.argmax(axis=0)
        return Part("couplings", columns, first * n + np.arange(n), (n,))

    def coordinates(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions of the m joints before the tip at rows q (N, n), and dz/dq (m, n).

        They are counted from the origins.
        """
        couplings = self.couplings_to_tip.to(q)
        moved = q - self.joint_zeros.to(q)
        return moved @ couplings.mT, couplings

    def from_coordinates(self, z: Tensor) -> Tensor:
        """Return the tip (N, 3) at joint positions z (N, m)."""
        links = self._links().to(z)
        u1, u2 = joint_coefficients(z, links.slides)
        return carried_tip(u1, u2, links.motions, links.end[:, 3], self.base.to(z)).T

    def from_coordinates_and_jacobian(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip (N, 3) and its Jacobian by the joint positions (N, 3, m)."""
        links = self._links().to(z)
        tip, linear, _ = links.columns(self._frames(z, links))
        return tip.T, linear.permute(2, 1, 0)

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
        (x,) = self.by_rows(lambda rows: (self.from_coordinates(self._joints(rows)),), q)
        return x

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip (..., 3) [m] and its Jacobian dx/dq (..., 3, n) in one pass.

        In closed form, in [m/rad] for revolute joints and [-] for prismatic ones.
        """
        x, J = self.by_rows(lambda rows: self.from_coordinates_and_jacobian(self._joints(rows)), q)
        return x, J @ self.couplings_to_tip.to(q)

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip's pose (..., 4, 4) in the measuring frame, and `pose_jacobian(q)`."""
        pose, J = self.by_rows(self._pose_and_columns, q)
        return pose, J @ self.couplings_to_tip.to(q)

    def _pose_and_columns(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        z = self._joints(rows)
        links = self._links().to(z)
        frames = self._frames(z, links)
        _, linear, axes = links.columns(frames)
        angular = torch.where(links.slides[:, None, None], 0.0, axes)
        columns = torch.cat([linear, angular], dim=1)
        pose = as_poses(frames[-1:])[:, 0] @ links.end
        return pose, columns.permute(2, 1, 0)

    def poses(self, q: Tensor) -> Tensor:
        """Return the pose of the base and of the link moved by each joint.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Joint positions [rad]; [m] for prismatic joints.

        Returns
        -------
        Tensor of shape (..., n_joints + 1, 4, 4)
            Homogeneous transforms into the measuring frame; the last one is that of the arm's end:
            the end link's frame, shifted to the tool.
        """
        arm = self._whole
        *links, last = arm._joint_poses(q).unbind(-3)
        return torch.stack([*links, last @ arm.end.to(q)], dim=-3)

    def _joint_poses(self, q: Tensor) -> Tensor:
        """Return the poses (..., m + 1, 4, 4) of the base and of joints' frames up to the tip."""

        def of_rows(rows: Tensor) -> tuple[Tensor]:
            z = self._joints(rows)
            return (as_poses(self._frames(z, self._links().to(z))),)

        (poses,) = self.by_rows(of_rows, q)
        return poses

    def pose(self, q: Tensor) -> Tensor:
        """Return the tip's pose in the measuring frame, shape (..., 4, 4)."""
        return self._joint_poses(q)[..., -1, :, :] @ self.end.to(q)

    def backbone(self, q: Tensor, n_points: int = 1) -> Tensor:
        """Return points along the straight lines from the base through all joints to the end.

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
        arm = self._whole
        joints = arm._joint_poses(q)[..., :3, 3]
        corners = torch.cat([joints, arm(q)[..., None, :]], dim=-2)
        start = corners[..., :-1, None, :]
        end = corners[..., 1:, None, :]
        places = torch.arange(1, n_points + 1, dtype=q.dtype, device=q.device)
        points = torch.lerp(start, end, places[:, None] / n_points)
        return torch.cat([corners[..., :1, :], points.flatten(-3, -2)], dim=-2)

    def unit_messages(self, q: Tensor, name: str, factor: float = 1.0) -> list[str]:
        """Return warnings if joints turn by more than two turns, or slide too far."""
        # The motion of every joint by each actuator alone: an actuator may have a gear.
        joints = (q[:, None] * self.couplings.to(q)).abs()
        slides = self.slides.to(q.device)
        turned = degrees_message(name, joints[:, ~slides], factor)
        reach = float(self.reach.detach())
        slid = length_message(name, joints[:, slides], factor * _FAR, 0.5 * min(reach, 1.0))
        return [message for message in (turned, slid) if message is not None]

    def extra_repr(self) -> str:
        """Return the summary shown by repr()."""
        summary = f"{len(self.kinds)} joints: {', '.join(self.names)}"
        if self.tip_at == len(self.kinds):
            return summary
        return f"{summary}, tip at {self.tip_at:g}"

    def _why_shape(self) -> str:
        return f"this arm has {self.n_actuators} moving joints"

    def _joints(self, rows: Tensor) -> Tensor:
        """Return positions (N, m) of the joints before the tip from the origins, at rows (N, n)."""
        z, _ = self.coordinates(rows)
        return z

    def _frames(self, z: Tensor, links: _Links) -> Tensor:
        """Return the `moving_frames` at joint positions (N, m), (m + 1, 4, 3, N)."""
        u1, u2 = joint_coefficients(z, links.slides)
        return moving_frames(u1, u2, links.motions, self.base.to(z))


def _with_positions(poses: Tensor, positions: Tensor) -> Tensor:
    """Return poses (..., 4, 4) with other positions (..., 3)."""
    column = nn.functional.pad(positions, (0, 1), value=1.0)
    return torch.cat([poses[..., :3], column[..., None]], dim=-1)


def _strings(strings: Sequence[str] | None, name: str, default: Sequence[str]) -> tuple[str, ...]:
    """Return a caller's strings, as many as the default has."""
    if strings is None:
        return tuple(default)
    if not np.iterable(strings):
        raise TypeError(f"`{name}` must be a sequence of strings, got {strings!r:.80}.")
    if len(strings) != len(default):
        raise ValueError(f"`{name}` must hold {len(default)} strings, got {strings}.")
    return tuple(map(str, strings))
