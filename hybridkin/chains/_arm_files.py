"""Rigid arms as files describe them: the joints from a root to an end, of URDF, MJCF and chains."""

from __future__ import annotations

import difflib
import math
import warnings
from collections.abc import Sequence
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from pytorch_kinematics.chain import Chain

_UNLIMITED = (-math.inf, math.inf)
_MISSING = (
    "have no <limit>, which URDF requires; they are taken as unlimited. Add <limit>, or set "
    'type="continuous" if they turn without end.'
)
_LOCKED = (
    "are locked at 0: their limits are 0 and 0, as URDF has it where `lower` and `upper` are left "
    "out. Give both if they move."
)
_MJCF_KINDS = {2: "prismatic", 3: "revolute"}  # mjJNT_SLIDE, mjJNT_HINGE


class Joint(NamedTuple):
    """A joint of a robot description, fixed or moving, and its pose in the link before it."""

    origin: NDArray
    kind: str = "fixed"
    axis: NDArray | tuple[float, float, float] = (0.0, 0.0, 1.0)
    name: str = ""
    limits: Sequence[float] | None = None


def moving_joints(path: list[Joint]) -> dict[str, Any]:
    """Return the arguments of a `RigidChain`, fixed joints folded into the poses of the others."""
    moving: list[Joint] = []
    pending = np.eye(4)
    for joint in path:
        pending = pending @ joint.origin
        if joint.kind != "fixed":
            moving.append(joint._replace(origin=pending))
            pending = np.eye(4)
    if not moving:
        raise ValueError("the path from the root to `end_link` must have a moving joint.")
    limits = np.array([_limits(joint) for joint in moving])
    return {
        "origins": np.stack([joint.origin for joint in moving]),
        "axes": [joint.axis for joint in moving],
        "kinds": [joint.kind for joint in moving],
        "names": [joint.name or f"joint_{k + 1}" for k, joint in enumerate(moving)],
        "q_min": limits[:, 0],
        "q_max": limits[:, 1],
        "tip": pending,
    }


def _limits(joint: Joint) -> tuple[float, float]:
    """Return the limits of a joint: infinite without any; equal ones lock it."""
    low, high = _UNLIMITED if joint.limits is None else map(float, joint.limits)
    if not low <= high or math.inf in (low, -high):
        raise ValueError(
            f"joint {joint.name!r} must have a lower and an upper limit, the smaller first, got "
            f"{low:g} and {high:g}; correct them in the robot description."
        )
    return low, high


def _source(text_or_path: str | PathLike[str]) -> str | Path:
    """Return XML text as it is, else the path of an existing file."""
    if isinstance(text_or_path, str) and text_or_path.lstrip().startswith("<"):
        return text_or_path.strip()
    path = Path(text_or_path)
    if not path.is_file():
        raise FileNotFoundError(
            f"`text_or_path` must be XML text, starting with '<', or an existing file, got {path}."
        )
    return path


def _one_of(name: str, known: Sequence[str], what: str) -> str:
    if name not in known:
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {close[0]!r}? It has" if close else "it has"
        raise ValueError(f"{what} {name!r} is not in the robot; {hint} {list(known)}.")
    return name


def urdf_path(text_or_path: Any, end_link: str, root_link: str | None) -> list[Joint]:
    """Return the joints of a URDF from one link to another."""
    from pytorch_kinematics.urdf import URDF  # takes a second and loads pyplot

    source = _source(text_or_path)
    text = source.read_bytes() if isinstance(source, Path) else source.encode()
    try:
        robot: Any = URDF.from_xml_string(text)
    except Exception as error:  # the reader has no exception of its own for all its failures
        raise ValueError(f"`text_or_path` must be a valid URDF: {error}.") from error
    known = [link.name for link in robot.links]
    _check_tree(known, robot.joints)
    by_child = {joint.child: joint for joint in robot.joints}
    link = _one_of(end_link, known, "`end_link`")
    root = None if root_link is None else _one_of(root_link, known, "`root_link`")
    path: list[Joint] = []
    while link != root and link in by_child:
        path.insert(0, _urdf_joint(by_child[link]))
        link = by_child[link].parent
    if root is not None and link != root:
        raise ValueError(f"`root_link` must lead to {end_link!r}, but {root!r} does not.")
    for limits, what in ((None, _MISSING), ((0.0, 0.0), _LOCKED)):
        names = [joint.name for joint in path if joint.kind != "fixed" and joint.limits == limits]
        if names:
            warnings.warn(f"joints {names} {what}", stacklevel=3)
    return path


def _check_tree(links: list[str], joints: Sequence[Any]) -> None:
    """Raise unless links and joints are one tree, with names that occur once."""
    children = [joint.child for joint in joints]
    names = {"link": links, "joint": [joint.name for joint in joints], "<child>": children}
    for what, given in names.items():
        doubled = sorted({name for name in given if given.count(name) > 1})
        if doubled:
            raise ValueError(f"every {what} of a URDF must occur once, got {doubled} more often.")
    for joint in joints:
        _one_of(joint.parent, links, f"<parent> of joint {joint.name!r}")
        _one_of(joint.child, links, f"<child> of joint {joint.name!r}")
    try:
        TopologicalSorter({joint.child: [joint.parent] for joint in joints}).prepare()
    except CycleError as error:
        loop = " -> ".join(error.args[1])
        raise ValueError(f"the links of a URDF must be a tree, got a cycle: {loop}.") from error
    roots = [link for link in links if link not in children]
    if len(roots) > 1:
        raise ValueError(
            f"a URDF must have one root, but no joint leads to any of {roots}; connect them by a "
            "joint, or remove all but one."
        )


def _urdf_joint(joint: Any) -> Joint:
    mimic, known = joint.mimic, ("revolute", "continuous", "prismatic", "fixed")
    if joint.type not in known or mimic is not None:
        does = f"is {joint.type}" if mimic is None else f"mimics {mimic.joint!r}"
        raise ValueError(
            f"joint {joint.name!r} {does}; only {known} joints that mimic no other are supported "
            "on the way to `end_link`; choose a `root_link` after it."
        )
    origin = np.eye(4)
    if joint.origin is not None:
        turn = Rotation.from_euler("xyz", joint.origin.rpy or [0, 0, 0])
        origin = _matrix(turn, joint.origin.xyz or [0, 0, 0])
    axis = np.array(joint.axis or [1.0, 0.0, 0.0])  # the URDF default
    if joint.type == "continuous":
        return Joint(origin, "revolute", axis, joint.name, _UNLIMITED)
    limits = None if joint.limit is None else (joint.limit.lower, joint.limit.upper)
    return Joint(origin, joint.type, axis, joint.name, limits)


def mjcf_path(text_or_path: Any, end_link: str, root_link: str | None) -> list[Joint]:
    """Return the joints of a MuJoCo model from one body to another body or site."""
    try:
        mujoco: Any = import_module("mujoco")
    except ImportError as error:
        raise ImportError(
            "RigidChain.from_mjcf needs MuJoCo: pip install 'hybridkin[sim]'."
        ) from error
    source = _source(text_or_path)
    try:
        if isinstance(source, Path):
            model = mujoco.MjModel.from_xml_path(str(source))
        else:
            model = mujoco.MjModel.from_xml_string(source)
    except ValueError as error:
        raise ValueError(f"`text_or_path` must be a valid MJCF: {error}.") from error
    bodies = {model.body(i).name: i for i in range(model.nbody) if model.body(i).name}
    sites = {model.site(i).name: i for i in range(model.nsite) if model.site(i).name}
    _one_of(end_link, [*bodies, *sites], "`end_link`")
    root = 0 if root_link is None else bodies[_one_of(root_link, list(bodies), "`root_link`")]
    path: list[Joint] = []
    body = bodies.get(end_link, -1)
    if body < 0:
        site = sites[end_link]
        path.append(Joint(_mjcf_pose(model.site_pos[site], model.site_quat[site])))
        body = model.site_bodyid[site]
    while body not in (root, 0):
        path = [*_mjcf_joints(model, body), *path]
        body = model.body_parentid[body]
    if body != root:
        raise ValueError(f"`root_link` must lead to {end_link!r}, but {root_link!r} does not.")
    return path


def _mjcf_joints(model: Any, body: int) -> list[Joint]:
    """Return the steps of one body: its pose, then every joint about its own anchor."""
    steps = [Joint(_mjcf_pose(model.body_pos[body], model.body_quat[body]))]
    first = model.body_jntadr[body]
    for j in range(first, first + model.body_jntnum[body]):
        name, kind = model.joint(j).name, int(model.jnt_type[j])
        if kind not in _MJCF_KINDS:
            raise ValueError(
                f"joint {name!r} of body {model.body(body).name!r} is free or a ball; only hinges "
                "and slides are supported on the way to `end_link`; choose a `root_link` after it."
            )
        axis, anchor, zero = model.jnt_axis[j], model.jnt_pos[j], model.qpos0[model.jnt_qposadr[j]]
        # MuJoCo ignores a range that is not in order; the default, two zeros, stands for none.
        limits = tuple(model.jnt_range[j].tolist())
        if not model.jnt_limited[j] and (limits[0] < limits[1] or not any(limits)):
            limits = None
        elif limits[0] == limits[1]:
            raise ValueError(
                f"`range` of joint {name!r} must be an interval, got {limits}: MuJoCo would ignore "
                'it. Remove the joint to lock it, or set limited="false".'
            )
        back, slides = -zero * axis, kind == 2  # from MuJoCo's reference to q = 0
        origin = _matrix(Rotation.from_rotvec((not slides) * back), anchor + slides * back)
        steps.append(Joint(origin, _MJCF_KINDS[kind], axis, name, limits))
        steps.append(Joint(_matrix(Rotation.identity(), -anchor)))
    return steps


def _mjcf_pose(position: NDArray, quaternion: NDArray) -> NDArray:
    return _matrix(Rotation.from_quat(np.roll(quaternion, -1)), position)  # w comes first


def _matrix(turn: Rotation, position: ArrayLike) -> NDArray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), position
    return matrix


def chain_path(chain: Chain) -> list[Joint]:
    """Return the joints of a pytorch_kinematics chain without branches."""
    path: list[Joint] = []
    for name in chain.get_frame_names(exclude_fixed=False):
        frame: Any = chain.find_frame(name)
        if len(frame.children) > 1:
            raise ValueError(
                f"`chain` must be serial, but {name!r} has {len(frame.children)} children; choose "
                "one end by pytorch_kinematics.SerialChain(chain, end_frame_name)."
            )
        origin = np.eye(4)
        for offset in (frame.link.offset, frame.joint.offset):
            if offset is not None:
                origin = origin @ offset.get_matrix()[0].detach().cpu().double().numpy()
        joint = frame.joint
        axis = joint.axis.detach().cpu().double().numpy()
        limits = joint.limits if any(joint.limits or ()) else None  # two zeros: none in an MJCF
        path.append(Joint(origin, joint.joint_type, axis, joint.name, limits))
    return path
