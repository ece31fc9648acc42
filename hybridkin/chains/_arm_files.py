"""Joints of rigid arms as descriptions hold them: what they have in common, MJCF, other chains."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Hashable, Sequence
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin._core.arrays import Numbers, Transform

if TYPE_CHECKING:
    from mujoco import MjModel  # pyright: ignore[reportAttributeAccessIssue]
    from pytorch_kinematics.chain import Chain

UNLIMITED = (-math.inf, math.inf, math.inf)
_BYTES = 4_000_000  # largest size of a robot description
_MOST = 1000  # moving joints
_MJCF_KINDS = {2: "prismatic", 3: "revolute"}  # mjJNT_SLIDE, mjJNT_HINGE


class Options(TypedDict, total=False):
    """Arguments of a `RigidChain` that a description does not contain."""

    tool: Numbers
    base: Numbers | Transform | None
    joint_zeros: Numbers
    dtype: torch.dtype


class Joint(NamedTuple):
    """A joint of a robot description, fixed or moving, and its pose in the link before it."""

    origin: NDArray
    kind: str = "fixed"
    axis: NDArray = np.array([0.0, 0.0, 1.0])
    actuator: Hashable = None  # joints of the same actuator move together
    name: str = ""  # of the actuator
    limits: tuple[float, float, float] = UNLIMITED  # of the actuator: low, high, speed
    factor: float = 1.0  # joint position per actuator position


def without_fixed(path: Sequence[Joint]) -> tuple[list[Joint], NDArray]:
    """Return the moving joints and the tip, with fixed joints merged into their poses."""
    moving: list[Joint] = []
    pending = np.eye(4)
    for joint in path:
        pending = pending @ joint.origin
        if joint.kind != "fixed":
            moving.append(joint._replace(origin=pending))
            pending = np.eye(4)
    if len(moving) > _MOST:
        raise ValueError(
            f"an arm must have at most {_MOST} moving joints, got {len(moving)}."
        )
    return moving, pending


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


def check_link(link: str, links: Collection[str], argument: str) -> None:
    """Raise if the robot has no such link."""
    if link not in links:
        close = difflib.get_close_matches(link, links, n=1)
        hint = f"did you mean {close[0]!r}? It has" if close else "it has"
        raise ValueError(
            f"`{argument}` {link!r} is not in the robot; {hint} {[*links]!s:.1000}."
        )


def mjcf_path(
    text_or_path: str | PathLike[str], end_link: str, root_link: str | None
) -> list[Joint]:
    """Return the joints of a MuJoCo model from one body to another body or site."""
    try:
        mujoco = import_module("mujoco")
    except ImportError as error:
        raise ImportError(
            "RigidChain.from_mjcf needs MuJoCo: pip install 'hybridkin[sim]'."
        ) from error
    source = source_of(text_or_path)
    try:
        if isinstance(source, Path):
            model = mujoco.MjModel.from_xml_path(str(source))
        else:
            model = mujoco.MjModel.from_xml_string(source)
    except (ValueError, RuntimeError, MemoryError) as error:
        raise ValueError(
            f"`text_or_path` must be a valid MJCF: {error!s:.400}."
        ) from error
    bodies = {model.body(i).name: i for i in range(model.nbody)}
    sites = {model.site(i).name: i for i in range(model.nsite)}
    check_link(end_link, [*bodies, *sites], "end_link")
    # MuJoCo's own kinematics at q = 0: global poses, anchors and axes.
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    if end_link in bodies:
        body = bodies[end_link]
        end = data.body(body)
    else:
        body = model.site_bodyid[sites[end_link]]
        end = data.site(sites[end_link])
    root = 0
    if root_link is not None:
        check_link(root_link, [*bodies], "root_link")
        root = bodies[root_link]
    joints = _joints_between(model, root, body)
    if joints is None:
        raise ValueError(
            f"`root_link` must lead to {end_link!r}, but {root_link!r} does not."
        )
    path: list[Joint] = []
    before = _pose(data.xpos[root], data.xmat[root])
    for j in joints:
        carried = data.body(model.jnt_bodyid[j])
        kind = _kind(model, j)
        placed = _pose(carried.xpos, carried.xmat)
        if kind == "revolute":
            placed[:3, 3] = data.xanchor[j]
        limits = UNLIMITED
        if model.jnt_limited[j]:
            low, high = model.jnt_range[j].tolist()
            limits = (low, high, math.inf)
        origin = np.linalg.solve(before, placed)
        axis = placed[:3, :3].T @ data.xaxis[j]
        name = model.joint(j).name or f"joint_{len(path) + 1}"
        path.append(Joint(origin, kind, axis, j, name, limits))
        before = placed
    path.append(Joint(np.linalg.solve(before, _pose(end.xpos, end.xmat))))
    return path


def _joints_between(model: MjModel, root: int, body: int) -> list[int] | None:
    """Return the joints that move one body and not the other; None if it does not carry it."""
    joints: list[int] = []
    while body != root:
        if body == 0:
            return None
        first = model.body_jntadr[body]
        joints = [*range(first, first + model.body_jntnum[body]), *joints]
        body = model.body_parentid[body]
    return joints


def _kind(model: MjModel, joint: int) -> str:
    kind = int(model.jnt_type[joint])
    if kind not in _MJCF_KINDS:
        body = model.body(model.jnt_bodyid[joint]).name
        raise ValueError(
            f"a joint of body {body!r} is free or a ball; only hinges and slides are supported "
            "on the path to `end_link`; use a `root_link` after it."
        )
    return _MJCF_KINDS[kind]


def _pose(position: NDArray, turn: NDArray) -> NDArray:
    pose = np.eye(4)
    pose[:3, :3] = np.reshape(turn, (3, 3))
    pose[:3, 3] = position
    return pose


def chain_path(chain: Chain) -> list[Joint]:
    """Return the joints of a pytorch_kinematics chain without branches."""
    path: list[Joint] = []
    for place, frame_name in enumerate(chain.get_frame_names(exclude_fixed=False)):
        frame = chain.find_frame(frame_name)
        assert frame is not None
        if len(frame.children) > 1:
            raise ValueError(
                f"`chain` must be serial, but {frame_name!r} has {len(frame.children)} children; "
                "choose one end with pytorch_kinematics.SerialChain(chain, end_frame_name)."
            )
        joint = frame.joint
        origin = np.eye(4)
        for offset in (frame.link.offset, joint.offset):
            if offset is not None:
                origin = origin @ offset.get_matrix()[0].double().numpy(force=True)
        axis = joint.axis.double().numpy(force=True)
        limits = UNLIMITED
        if joint.limits and any(joint.limits):
            low, high = joint.limits
            limits = (low, high, math.inf)
        name = joint.name or ""
        path.append(Joint(origin, joint.joint_type, axis, place, name, limits))
    return path
