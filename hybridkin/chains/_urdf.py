"""Rigid arms in URDF: read the joints from a root to an end link, and write them back."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from hybridkin.chains._arm_files import (
    Joint,
    JointLimits,
    check_link,
    offset_origin,
    source_of,
)

_KINDS = ("revolute", "continuous", "prismatic", "fixed")
_FREE = {
    "floating": ("x", "y", "z", "yaw", "pitch", "roll"),
    "planar": ("x", "y", "yaw"),
}
_AXES = {"x": 0, "y": 1, "z": 2, "roll": 0, "pitch": 1, "yaw": 2}
_MOST = 64  # joints that mimic each other in a row
_SAME = 1e-12  # [m] or [-]: smaller changes of an origin are not written


class Urdf:
    """A URDF, and the joints from one link to another.

    The reader of pytorch_kinematics is no help: it has single precision and another default axis,
    knows no mimic, planar and floating joints, and refuses limits without effort.

    Attributes
    ----------
    robot : lxml Element
        The <robot>.
    path : list of (lxml Element, list of Joint)
        The <joint> elements from root to end, and what they are in an arm.
    """

    def __init__(
        self, text_or_path: str | PathLike[str], end_link: str, root_link: str | None
    ) -> None:
        self.robot = _robot(text_or_path)
        links = [link.get("name", "") for link in self.robot.findall("link")]
        check_link(end_link, links, "end_link")
        if root_link is not None:
            check_link(root_link, links, "root_link")
        joints = self.robot.findall("joint")
        self._by_name = _distinct("joint", (joint.get("name", "") for joint in joints), joints)
        children = [_attribute(joint, "child", "link") for joint in joints]
        by_child = _distinct("<child>", children, joints)
        self.path: list[tuple[etree._Element, list[Joint]]] = []
        link = end_link
        while link != root_link and link in by_child:
            if len(self.path) == len(joints):
                raise ValueError(f"the links of a URDF must be a tree, got a cycle to {link!r}.")
            joint = by_child[link]
            self.path.append((joint, self._joints(joint)))
            link = _attribute(joint, "parent", "link")
        if root_link not in (None, link):
            raise ValueError(f"`root_link` must lead to {end_link!r}, but {root_link!r} does not.")
        self.path.reverse()
        self.joints = [joint for _, joints in self.path for joint in joints]

    def placed(self, names: Sequence[str], origins: NDArray, axes: NDArray) -> str:
        """Return the XML with new origins (n, 4, 4) and unit axes (n, 3) of the moving joints.

        They are those of an arm, whose origins include fixed joints and offsets of mimic joints.
        """
        moving = [joint.name for joint in self.joints if joint.kind != "fixed"]
        if [*dict.fromkeys(moving)] != [*names] or len(moving) != len(origins):
            raise ValueError(
                f"`text_or_path` must be the URDF of this arm, whose actuators are {[*names]}, "
                f"got {moving}."
            )
        wanted = zip(origins, axes, strict=True)
        before = np.eye(4)
        for element, (joint, *free) in self.path:
            if free:
                raise ValueError(f"joint {free[0].name!r} is free; use a `root_link` after it.")
            if joint.kind == "fixed":
                before = before @ joint.origin
                continue
            # Exclude the fixed joints before it and the offset of a mimic joint.
            origin, axis = next(wanted)
            ahead = np.linalg.solve(before, origin)
            _, _, offset = self._mimicked(element)
            at_offset = offset_origin(np.eye(4), joint.kind, axis, offset)
            placed = ahead @ np.linalg.inv(at_offset)
            before = np.eye(4)
            if np.abs(placed - _origin(element)).max() > _SAME:
                _write_origin(element, placed)
            if np.abs(axis - joint.axis / np.linalg.norm(joint.axis)).max() > _SAME:
                _write_axis(element, axis)
        return etree.tostring(self.robot.getroottree(), encoding="unicode")

    def _joints(self, element: etree._Element) -> list[Joint]:
        """Return what a joint does: a free one moves along and about several axes."""
        origin = _origin(element)
        name = element.get("name", "")
        kind = element.get("type", "")
        mimics = _has(element, "mimic")
        if kind in _FREE and not mimics:
            return [Joint(origin), *_free_joints(name, kind)]
        actuator, factor, offset = self._mimicked(element)
        unknown = etree.Element("joint", name=actuator, type=kind)
        driver = self._by_name.get(actuator, unknown)
        driver_kind = driver.get("type", "")
        if not {kind, driver_kind} <= {*_KINDS}:
            raise ValueError(
                f"`type` of joint {name!r} and of the joint that it mimics must be one of "
                f"{_KINDS}, or without <mimic> one of {[*_FREE]}, got {kind!r}, {driver_kind!r}."
            )
        if kind == "fixed":
            return [Joint(origin)]
        axis = np.array(_numbers(element, "axis", "xyz", "1 0 0"))
        origin = offset_origin(origin, kind, axis, offset)
        if driver_kind == "fixed":
            return [Joint(origin)]
        limits = _limits(driver)
        kind = "prismatic" if kind == "prismatic" else "revolute"
        return [Joint(origin, kind, axis, actuator, actuator, limits, factor)]

    def _mimicked(self, element: etree._Element) -> tuple[str, float, float]:
        """Return the joint that a joint follows, at last itself, and its factor and offset.

        The joint is at ``factor * q + offset``, where q is the position of the joint followed.
        """
        name = element.get("name", "")
        followed = [name]
        factor = 1.0
        offset = 0.0
        while _has(element, "mimic"):
            offset += factor * _numbers(element, "mimic", "offset", "0")[0]
            factor *= _numbers(element, "mimic", "multiplier", "1")[0]
            name = _attribute(element, "mimic", "joint")
            if name in followed or len(followed) > _MOST:
                raise ValueError(
                    f"joints must not mimic each other in a circle, nor more than {_MOST} in a "
                    f"row, got {followed[:9]}."
                )
            followed.append(name)
            element = self._by_name.get(name, etree.Element("joint"))
        return name, factor, offset


def _robot(text_or_path: str | PathLike[str]) -> etree._Element:
    """Return the root of a URDF. Entities are not expanded, and nothing else is loaded."""
    source = source_of(text_or_path)
    data = source.read_bytes() if isinstance(source, Path) else source.encode()
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
    try:
        robot = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        raise ValueError(f"`text_or_path` must be a valid URDF: {error}.") from error
    if robot.tag != "robot":
        raise ValueError(
            f"`text_or_path` must be a URDF, with the outermost tag <robot>, got <{robot.tag}>."
        )
    doctype = robot.getroottree().docinfo.doctype
    if doctype:
        raise ValueError(
            "`text_or_path` must be a URDF without DOCTYPE, whose entities can fill the memory, "
            f"got {doctype!r:.80}; remove it."
        )
    return robot


def _distinct(
    what: str, names: Iterable[str], joints: Sequence[etree._Element]
) -> dict[str, etree._Element]:
    """Return the joints by names, each of which may occur once."""
    by_name: dict[str, etree._Element] = {}
    for name, joint in zip(names, joints, strict=True):
        if name in by_name:
            raise ValueError(f"every {what} of a URDF must occur once, got {name!r} repeatedly.")
        by_name[name] = joint
    return by_name


def _has(element: etree._Element, tag: str) -> bool:
    """Return whether an element has a part with this tag."""
    return bool(element.findall(tag))


def _attribute(joint: etree._Element, tag: str, key: str, default: str = "") -> str:
    """Return an attribute of the part of a joint with this tag, if it has both."""
    for part in joint.findall(tag)[:1]:
        return part.get(key, default)
    return default


def _numbers(joint: etree._Element, tag: str, key: str, default: str) -> list[float]:
    """Return the numbers of an attribute, as many as the default has."""
    text = _attribute(joint, tag, key, default)
    n = len(default.split())
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != n:
        raise ValueError(
            f"`{key}` of <{tag}> of joint {joint.get('name')!r} must be {n} numbers, got "
            f"{text!r}; correct the URDF."
        )
    return numbers


def _limits(joint: etree._Element) -> JointLimits:
    """Return the limits of a joint; a speed or an acceleration of 0 means no limit."""
    name = joint.get("name")
    speed = _numbers(joint, "limit", "velocity", "0")[0]
    # URDF 1.2; a joint that brakes less than it accelerates must keep to the smaller one.
    acceleration = _numbers(joint, "limit", "acceleration", "0")[0] or math.inf
    deceleration = _numbers(joint, "limit", "deceleration", "0")[0] or math.inf
    limits = JointLimits(speed=speed or math.inf, acceleration=min(acceleration, deceleration))
    if joint.get("type") == "continuous":
        return limits
    if not _has(joint, "limit"):
        _warn(
            f"joint {name!r} has no <limit>, which URDF requires; it is unlimited. Add <limit>, or "
            'set type="continuous" if it turns without limits.'
        )
        return limits
    low = _numbers(joint, "limit", "lower", "0")[0]
    high = _numbers(joint, "limit", "upper", "0")[0]
    if low == high == 0.0:
        _warn(
            f"joint {name!r} is locked at 0: both limits are 0, the default of URDF. Give `lower` "
            "and `upper` if it moves."
        )
    if low > high:
        _warn(f"limits of joint {name!r} are swapped; they are used in order.")
        return limits._replace(low=high, high=low)
    return limits._replace(low=low, high=high)


def _warn(message: str) -> None:
    warnings.warn(message, stacklevel=6)  # the caller of `from_urdf`


def _free_joints(name: str, kind: str) -> list[Joint]:
    joints: list[Joint] = []
    for part in _FREE[kind]:
        move = "prismatic" if part in "xyz" else "revolute"
        axis = np.eye(3)[_AXES[part]]
        joints.append(Joint(np.eye(4), move, axis, (name, part), f"{name}_{part}"))
    return joints


def _origin(joint: etree._Element) -> NDArray:
    """Return the pose of a joint; it is rotated by angles or, since URDF 1.1, a quaternion."""
    position = _numbers(joint, "origin", "xyz", "0 0 0")
    quaternion = _numbers(joint, "origin", "quat_xyzw", "0 0 0 1")
    angles = _numbers(joint, "origin", "rpy", "0 0 0")
    if not _attribute(joint, "origin", "quat_xyzw"):
        return _matrix(Rotation.from_euler("xyz", angles), position)
    if _attribute(joint, "origin", "rpy") or not np.any(quaternion):
        raise ValueError(
            f"<origin> of joint {joint.get('name')!r} must have either `rpy` or `quat_xyzw`, a "
            f"quaternion that is not zero, got {dict(joint.find('origin').attrib)}; correct the "
            "URDF."
        )
    return _matrix(Rotation.from_quat(quaternion), position)


def _matrix(turn: Rotation, position: ArrayLike) -> NDArray:
    matrix = np.eye(4)
    matrix[:3, :3] = turn.as_matrix()
    matrix[:3, 3] = position
    return matrix


def _write_origin(joint: etree._Element, placed: NDArray) -> None:
    """Write the <origin> of a joint; its angles are exact at a pitch of 90 degrees too."""
    R = placed[:3, :3]
    yaw = math.atan2(R[1, 0], R[0, 0])
    # What is left without the yaw is a roll, then a pitch.
    level = Rotation.from_euler("z", -yaw).as_matrix() @ R
    pitch = math.atan2(-level[2, 0], level[0, 0])
    roll = math.atan2(-level[1, 2], level[1, 1])
    if not _has(joint, "origin"):
        etree.SubElement(joint, "origin")
    element = joint.find("origin")
    element.attrib.pop("quat_xyzw", None)
    element.set("xyz", _text(placed[:3, 3]))
    element.set("rpy", _text([roll, pitch, yaw]))


def _write_axis(joint: etree._Element, axis: NDArray) -> None:
    """Write the <axis> of a joint."""
    if not _has(joint, "axis"):
        etree.SubElement(joint, "axis")
    joint.find("axis").set("xyz", _text(axis))


def _text(numbers: Iterable[float]) -> str:
    return " ".join(repr(float(number) + 0.0) for number in numbers)  # no -0.0
