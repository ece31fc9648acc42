"""Rigid arms from other formats: the joints from a root to an end, of MJCF and of chains."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.parsers.expat import ExpatError, ParserCreate

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from pytorch_kinematics.chain import Chain

UNLIMITED = (-math.inf, math.inf)
_BYTES = 4_000_000  # largest size of a robot description
_MOST = 1000  # moving joints
_SIZES = ("count", "nrow", "ncol", "width", "height")
_MOST_COPIES = 4e6
_MJCF_KINDS = {2: "prismatic", 3: "revolute"}  # mjJNT_SLIDE, mjJNT_HINGE


class Joint(NamedTuple):
    """A joint of a robot description, fixed or moving, and its pose in the link before it."""

    origin: NDArray
    kind: str = "fixed"
    axis: ArrayLike = (0.0, 0.0, 1.0)
    name: str = ""  # of its actuator; for a mimic joint, of the joint that it mimics
    limits: Sequence[float] | None = None  # of that actuator
    speed: float = math.inf
    factor: float = 1.0  # joint position per actuator position


def moving_joints(path: list[Joint]) -> dict[str, Any]:
    """Return the arguments of a `RigidChain`, with fixed joints merged into the other poses."""
    moving: list[Joint] = []
    pending = np.eye(4)
    named = {joint.name for joint in path}
    for joint in path:
        pending = pending @ joint.origin
        if joint.kind != "fixed":
            name = joint.name or unused(f"joint_{len(moving) + 1}", named)
            moving.append(joint._replace(origin=pending, name=name))
            pending = np.eye(4)
    if len(moving) > _MOST:
        raise ValueError(
            f"an arm must have at most {_MOST} moving joints, got {len(moving)}."
        )
    drivers = {joint.name: joint for joint in moving}
    factors = [
        joint.factor * (joint.name == name) for joint in moving for name in drivers
    ]
    couplings = np.reshape(factors, (len(moving), len(drivers)))
    limits = np.array([_limits(joint) for joint in drivers.values()]).reshape(-1, 2)
    return {
        "origins": np.array([joint.origin for joint in moving]).reshape(-1, 4, 4),
        "axes": np.array([joint.axis for joint in moving]).reshape(-1, 3),
        "kinds": [joint.kind for joint in moving],
        "couplings": None
        if np.array_equal(couplings, np.eye(len(moving)))
        else couplings,
        "names": [*drivers],
        "q_min": limits[:, 0],
        "q_max": limits[:, 1],
        "dq_max": [joint.speed for joint in drivers.values()],
        "tip": pending,
    }


def unused(name: str, names: Collection[str]) -> str:
    """Return a name that none of the others has: joints of equal names move together."""
    while name in names:
        name += "_"
    return name


def _limits(joint: Joint) -> tuple[float, float]:
    """Return the limits of a joint: infinite if it has none; equal limits lock it."""
    low, high = UNLIMITED if joint.limits is None else map(float, joint.limits)
    if not low <= high or math.inf in (low, -high):
        raise ValueError(
            f"joint {joint.name!r} must have a lower and an upper limit, the smaller first, got "
            f"{low:g} and {high:g}; correct them in the robot description."
        )
    return low, high


def source_of(text_or_path: str | PathLike[str]) -> str | Path:
    """Return XML text unchanged, or the path of an existing file."""
    if isinstance(text_or_path, str) and text_or_path.lstrip().startswith("<"):
        return text_or_path.lstrip()
    path = Path(text_or_path)
    if not path.is_file():
        raise FileNotFoundError(
            f"`text_or_path` must be XML text, starting with '<', or an existing file, got "
            f"{str(path)!r:.200}."
        )
    if path.stat().st_size > _BYTES:
        raise ValueError(
            f"`text_or_path` must be at most {_BYTES} bytes long, {path} is longer."
        )
    return path


def in_robot(name: str, known: Collection[str], what: str) -> str:
    if name not in known:
        close = difflib.get_close_matches(name, list(known)[:_MOST], n=1)
        hint = f"did you mean {close[0]!r}? It has" if close else "it has"
        raise ValueError(
            f"{what} {name!r} is not in the robot; {hint} {[*known]!s:.1000}."
        )
    return name


def mjcf_path(text_or_path: Any, end_link: str, root_link: str | None) -> list[Joint]:
    """Return the joints of a MuJoCo model from one body to another body or site."""
    try:
        mujoco: Any = import_module("mujoco")
    except ImportError as error:
        raise ImportError(
            "RigidChain.from_mjcf needs MuJoCo: pip install 'hybridkin[sim]'."
        ) from error
    source = source_of(text_or_path)
    _check_sizes(source.encode() if isinstance(source, str) else source.read_bytes())
    try:
        if isinstance(source, Path):
            model = mujoco.MjModel.from_xml_path(str(source))
        else:
            model = mujoco.MjModel.from_xml_string(source)
    except (ValueError, RuntimeError, MemoryError) as error:
        raise ValueError(
            f"`text_or_path` must be a valid MJCF: {error!s:.400}."
        ) from error
    bodies = {model.body(i).name: i for i in range(model.nbody) if model.body(i).name}
    sites = {model.site(i).name: i for i in range(model.nsite) if model.site(i).name}
    in_robot(end_link, [*bodies, *sites], "`end_link`")
    if root_link is None:
        root = 0
    else:
        root = bodies[in_robot(root_link, list(bodies), "`root_link`")]
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
        raise ValueError(
            f"`root_link` must lead to {end_link!r}, but {root_link!r} does not."
        )
    return path


def _check_sizes(data: bytes) -> None:
    """Raise if an MJCF requests too many copies or too large arrays, or has NaN.

    MuJoCo checks neither, and writes a file for NaN. Included files are not checked here.
    """
    parser = ParserCreate()
    copies = [1.0]

    def start(tag: str, attributes: dict[str, str]) -> None:
        costly = any(name == "count" or name.startswith("nuser") for name in attributes)
        size = copies[-1] * (1000.0 if costly else 1.0)
        for name, value in attributes.items():
            words = value.lower().split()
            if name in _SIZES or name.startswith("nuser"):
                size *= math.prod(
                    float(word) for word in words if re.fullmatch(r"\d+", word)
                )
            if "nan" in words or size > _MOST_COPIES:
                need = f"numbers, and sizes within bounds ({_MOST_COPIES:.0g} in all)"
                raise ValueError(
                    f"`text_or_path` must have {need}, got {name}={value!r:.60}."
                )
        copies.append(size if tag == "replicate" else copies[-1])

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: copies.pop()
    with suppress(ExpatError):  # MuJoCo reports other errors
        parser.Parse(data, True)


def _mjcf_joints(model: Any, body: int) -> list[Joint]:
    """Return the joints of one body: its fixed pose, then every joint about its own anchor."""
    steps = [Joint(_mjcf_pose(model.body_pos[body], model.body_quat[body]))]
    first = model.body_jntadr[body]
    for j in range(first, first + model.body_jntnum[body]):
        name = model.joint(j).name
        kind = int(model.jnt_type[j])
        if kind not in _MJCF_KINDS:
            raise ValueError(
                f"joint {name!r} of body {model.body(body).name!r} is free or a ball; only hinges "
                "and slides are supported on the path to `end_link`; use a `root_link` after it."
            )
        axis = model.jnt_axis[j]
        anchor = model.jnt_pos[j]
        zero = model.qpos0[model.jnt_qposadr[j]]
        # MuJoCo ignores a range that is not in order; the default, two zeros, means no limits.
        limits = tuple(model.jnt_range[j].tolist())
        if not model.jnt_limited[j] and (limits[0] < limits[1] or not any(limits)):
            limits = None
        elif limits[0] == limits[1]:
            raise ValueError(
                f"`range` of joint {name!r} must be an interval, got {limits}: MuJoCo would ignore "
                'it. Remove the joint to lock it, or set limited="false".'
            )
        # from MuJoCo's reference to q = 0
        back = -zero * axis
        slides = kind == 2
        origin = matrix_of(
            Rotation.from_rotvec((not slides) * back), anchor + slides * back
        )
        steps.append(Joint(origin, _MJCF_KINDS[kind], axis, name, limits))
        steps.append(Joint(matrix_of(Rotation.identity(), -anchor)))
    return steps


def _mjcf_pose(position: NDArray, quaternion: NDArray) -> NDArray:
    # w comes first.
    return matrix_of(Rotation.from_quat(np.roll(quaternion, -1)), position)


def matrix_of(turn: Rotation | None = None, position: ArrayLike = 0.0) -> NDArray:
    matrix = np.eye(4)
    matrix[:3, 3] = position
    if turn is not None:
        matrix[:3, :3] = turn.as_matrix()
    return matrix


def chain_path(chain: Chain) -> list[Joint]:
    """Return the joints of a pytorch_kinematics chain without branches."""
    path: list[Joint] = []
    for name in chain.get_frame_names(exclude_fixed=False):
        frame: Any = chain.find_frame(name)
        if len(frame.children) > 1:
            raise ValueError(
                f"`chain` must be serial, but {name!r} has {len(frame.children)} children; choose "
                "one end with pytorch_kinematics.SerialChain(chain, end_frame_name)."
            )
        origin = np.eye(4)
        for offset in (frame.link.offset, frame.joint.offset):
            if offset is not None:
                origin = origin @ offset.get_matrix()[0].detach().cpu().double().numpy()
        joint = frame.joint
        if joint.name in (earlier.name for earlier in path):
            joint_name = ""
        else:
            joint_name = joint.name
        axis = joint.axis.detach().cpu().double().numpy()
        # Two zeros mean none.
        limits = joint.limits if any(joint.limits or ()) else None
        path.append(Joint(origin, joint.joint_type, axis, joint_name, limits))
    return path
