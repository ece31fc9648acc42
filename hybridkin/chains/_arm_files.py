"""Joints of rigid arms as descriptions hold them: what they have in common, and other chains."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Hashable, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridkin._core.arrays import Numbers, Transform

if TYPE_CHECKING:
    from pytorch_kinematics.chain import Chain

_BYTES = 4_000_000  # largest size of a robot description
_MOST = 1000  # moving joints


class Options(TypedDict, total=False):
    """Arguments of a `RigidChain` that a description does not contain."""

    tool: Numbers
    base: Numbers | Transform | None
    joint_zeros: Numbers
    dtype: torch.dtype


class JointLimits(NamedTuple):
    """Limits of an actuator: of its position, speed and acceleration."""

    low: float = -math.inf
    high: float = math.inf
    speed: float = math.inf
    acceleration: float = math.inf


class Joint(NamedTuple):
    """A joint of a robot description, fixed or moving, and its pose in the link before it."""

    origin: NDArray
    kind: str = "fixed"
    axis: NDArray = np.array([0.0, 0.0, 1.0])
    actuator: Hashable = None  # joints of the same actuator move together
    name: str = ""  # of the actuator
    limits: JointLimits = JointLimits()  # of the actuator
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
        raise ValueError(f"an arm must have at most {_MOST} moving joints, got {len(moving)}.")
    return moving, pending


def offset_origin(origin: NDArray, kind: str, axis: NDArray, offset: float) -> NDArray:
    """Return the pose (4, 4) of a joint that stands at `offset` where its actuator is at zero."""
    step = offset * axis / (np.linalg.norm(axis) or 1.0)
    motion = np.eye(4)
    if kind == "prismatic":
        motion[:3, 3] = step
    else:
        motion[:3, :3] = Rotation.from_rotvec(step).as_matrix()
    return origin @ motion


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
        raise ValueError(f"`text_or_path` must be at most {_BYTES} bytes long, {path} is longer.")
    return path


def check_link(link: str, links: Collection[str], argument: str) -> None:
    """Raise if the robot has no such link."""
    if link not in links:
        close = difflib.get_close_matches(link, links, n=1)
        hint = f"did you mean {close[0]!r}? It has" if close else "it has"
        raise ValueError(f"`{argument}` {link!r} is not in the robot; {hint} {[*links]!s:.1000}.")


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
        limits = JointLimits()
        if joint.limits and any(joint.limits):
            limits = JointLimits(*joint.limits)
        name = joint.name or ""
        path.append(Joint(origin, joint.joint_type, axis, place, name, limits))
    return path
