"""Rigid arms in URDF: read the joints from a root to an end link, and write them back."""

from __future__ import annotations

import math
import re
import warnings
from collections import Counter, defaultdict
from collections.abc import Sequence
from graphlib import CycleError, TopologicalSorter
from typing import Any, TypeAlias
from xml.parsers.expat import ExpatError, ParserCreate

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridkin.chains._arm_files import (
    UNLIMITED,
    Joint,
    in_robot,
    matrix_of,
    source_of,
    unused,
)

_MISSING = (
    "have no <limit>, which URDF requires; they are treated as unlimited. Add <limit>, or set "
    'type="continuous" if they turn without limits.'
)
_LOCKED = (
    "are locked at 0: both limits are 0, the default of URDF if `lower` and `upper` are missing. "
    "Give both if the joints move."
)
_ONE_AXIS = ("revolute", "continuous", "prismatic")
_FREE = {
    "floating": ("x", "y", "z", "yaw", "pitch", "roll"),
    "planar": ("x", "y", "yaw"),
}
_AXES = {"x": 0, "y": 1, "z": 2, "roll": 0, "pitch": 1, "yaw": 2}
_MOST = 64  # joints that mimic each other in a row
_SAME = 1e-12  # [m] or [-]: smaller changes of an origin are not written
_TAG = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""")


class _Tag(dict[str, str]):
    """The attributes of a tag, and its position in the file [bytes]."""

    place = -1


_Element: TypeAlias = defaultdict[str, _Tag]  # the first tag of every name in a <joint>


def _read(text: str) -> tuple[list[str], list[_Element]]:
    """Return the links and the joints of a <robot>; other tags, e.g. of vendors, are ignored."""
    links: list[str] = []
    joints: list[_Element] = []
    path: list[str] = []
    parser = ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        path.append(tag)
        if path[0] != "robot":
            raise ValueError(f"the outermost tag must be <robot>, got <{tag}>")
        if len(path) == 2 and tag == "link":
            links.append(attributes.get("name", ""))
        if len(path) == 2 and tag == "joint":
            joints.append(defaultdict(_Tag))
        if path[1:2] == ["joint"] and len(path) < 4 and tag not in joints[-1]:
            joints[-1][tag] = _Tag(attributes)
            joints[-1][tag].place = parser.CurrentByteIndex

    def refuse(*_: Any) -> None:
        raise ValueError("it declares entities, which can grow without bound")

    parser.StartElementHandler = start
    parser.EntityDeclHandler = refuse
    parser.EndElementHandler = lambda tag: path.pop()
    try:
        parser.Parse(_bytes(text), True)
    except (ExpatError, ValueError) as error:
        raise ValueError(f"`text_or_path` must be a valid URDF: {error}.") from error
    return links, joints


def urdf_text(text_or_path: Any) -> str:
    """Return the text of a URDF; `_bytes` restores bytes that are not UTF-8."""
    source = source_of(text_or_path)
    data = source if isinstance(source, str) else source.read_bytes()
    if isinstance(data, str):
        return data
    return data.decode("utf-8-sig", "surrogateescape")


def _bytes(text: str) -> bytes:
    return text.encode(errors="surrogateescape")


def _numbers(element: _Element, tag: str, key: str, default: str) -> list[float]:
    """Return the numbers of an attribute, as many as the default has."""
    text = element[tag].get(key, default)
    numbers = []
    try:
        numbers = [float(part) for part in text.split()]
    except ValueError:
        pass
    if len(numbers) != (n := len(default.split())):
        where = f"`{key}` of <{tag}> of joint {element['joint'].get('name', '')!r}"
        raise ValueError(
            f"{where} must be {n} numbers, got {text!r}; correct the URDF."
        )
    return numbers


def _elements(
    text: str, end_link: str, root_link: str | None
) -> list[tuple[_Element, list[Joint]]]:
    """Return the <joint> elements from one link to another, each with its joints."""
    links, joints = _read(text)
    _check_tree(links, joints)
    by_child = {joint["child"].get("link", ""): joint for joint in joints}
    by_name = {joint["joint"].get("name", ""): joint for joint in joints}
    link = in_robot(end_link, links, "`end_link`")
    root = None if root_link is None else in_robot(root_link, links, "`root_link`")
    path: list[tuple[_Element, list[Joint]]] = []
    while link != root and link in by_child:
        element = by_child[link]
        path.append((element, _joints(element, by_name)))
        link = element["parent"].get("link", "")
    if root is not None and link != root:
        raise ValueError(
            f"`root_link` must lead to {end_link!r}, but {root!r} does not."
        )
    return path[::-1]


def urdf_path(
    text_or_path: object, end_link: str, root_link: str | None
) -> list[Joint]:
    """Return the joints of a URDF from one link to another."""
    elements = _elements(urdf_text(text_or_path), end_link, root_link)
    path = [joint for _, joints in elements for joint in joints]
    moving = {joint.name: joint for joint in path if joint.kind != "fixed"}
    for limits, what in ((None, _MISSING), ((0.0, 0.0), _LOCKED)):
        names = [name for name, joint in moving.items() if joint.limits == limits]
        if names:
            warnings.warn(f"joints {names} {what}", stacklevel=3)
    return path


def _check_tree(links: list[str], joints: list[_Element]) -> None:
    """Raise unless links and joints form one tree with unique names."""
    named = [joint["joint"].get("name", "") for joint in joints]
    parents, children = (
        [joint[tag].get("link", "") for joint in joints] for tag in ("parent", "child")
    )
    for what, given in {"link": links, "joint": named, "<child>": children}.items():
        doubled = sorted(name for name, times in Counter(given).items() if times > 1)
        if doubled:
            raise ValueError(
                f"every {what} of a URDF must occur once, got {doubled} repeatedly."
            )
    reached = dict.fromkeys(links)
    for name, parent, child in zip(named, parents, children, strict=True):
        in_robot(parent, reached, f"<parent> of joint {name!r}")
        in_robot(child, reached, f"<child> of joint {name!r}")
    try:
        tree = zip(children, parents, strict=True)
        TopologicalSorter({child: [parent] for child, parent in tree}).prepare()
    except CycleError as error:
        loop = " -> ".join(map(repr, error.args[1]))[:400]
        raise ValueError(
            f"the links of a URDF must be a tree, got a cycle: {loop}."
        ) from error
    roots = sorted({*links} - {*children})
    if len(roots) > 1:
        raise ValueError(
            f"a URDF must have one root, but no joint leads to any of {roots}; connect them with "
            "joints, or remove all but one."
        )


def _origin(element: _Element) -> NDArray:
    turn = Rotation.from_euler("xyz", _numbers(element, "origin", "rpy", "0 0 0"))
    return matrix_of(turn, _numbers(element, "origin", "xyz", "0 0 0"))


def _joints(element: _Element, by_name: dict[str, _Element]) -> list[Joint]:
    """Return what a joint does: a free one moves along and about several axes."""
    origin = _origin(element)
    name = element["joint"].get("name", "")
    kind = element["joint"].get("type", "")
    if kind in _FREE and not element["mimic"]:
        path = [Joint(origin)]
        names = {*by_name, *(other["mimic"].get("joint") for other in by_name.values())}
        for part in _FREE[kind]:
            move = "prismatic" if len(part) == 1 else "revolute"
            actuator = unused(f"{name}_{part}", names)
            path.append(
                Joint(matrix_of(), move, np.eye(3)[_AXES[part]], actuator, UNLIMITED)
            )
        return path
    driver = element
    factor = 1.0
    offset = 0.0
    followed = [name]
    while mimic := driver["mimic"]:
        # The joint is at factor * (multiplier * q + its offset) + offset.
        offset += factor * _numbers(driver, "mimic", "offset", "0")[0]
        factor *= _numbers(driver, "mimic", "multiplier", "1")[0]
        name = mimic.get("joint", "")
        if name in followed:
            raise ValueError(
                f"joints must not mimic each other in a circle, got {followed}."
            )
        followed.append(name)
        if len(followed) > _MOST:
            raise ValueError(
                f"joint {followed[0]!r} must mimic via at most {_MOST} other joints."
            )
        # Not in the file.
        driver = by_name.get(name) or defaultdict(_Tag, joint=_Tag(type=kind))
    driven_by = driver["joint"].get("type", "")
    if not {kind, driven_by} <= {*_ONE_AXIS, "fixed"}:
        kinds = (*_ONE_AXIS, "fixed", *_FREE)
        raise ValueError(
            f"`type` of joint {followed[0]!r} must be one of {kinds}, or one of the first four "
            f"if it mimics another joint, got {kind!r}"
            + f" that mimics {driven_by!r}."
            * bool(element["mimic"])
        )
    kind = kind.replace("continuous", "revolute")
    axis = _numbers(element, "axis", "xyz", "1 0 0")
    step = offset * np.array(axis) / (np.linalg.norm(axis) or 1.0)
    turn = Rotation.from_rotvec((kind == "revolute") * step)
    origin = origin @ matrix_of(turn, (kind == "prismatic") * step)
    if "fixed" in (kind, driven_by):
        return [Joint(origin)]
    limits = UNLIMITED if driven_by == "continuous" else None
    if driver["limit"] and limits is None:
        low, high = (
            _numbers(driver, "limit", side, "0")[0] for side in ("lower", "upper")
        )
        limits = (low, high)
        if math.inf > low > high > -math.inf:
            limits = (high, low)
            warnings.warn(
                f"limits of joint {name!r} are swapped; they are used in order: {high:g}, {low:g}.",
                stacklevel=5,
            )
    speed = _numbers(driver, "limit", "velocity", "0")[0]
    return [Joint(origin, kind, axis, name, limits, speed or math.inf, factor)]


def placed_urdf(
    text: str,
    end_link: str,
    root_link: str | None,
    names: Sequence[str],
    origins: NDArray,
) -> str:
    """Return a URDF whose moving joints have new origins (n, 4, 4); the rest is not changed."""
    path = _elements(text, end_link, root_link)
    data = _bytes(text)
    moving = [
        joint.name for _, joints in path for joint in joints if joint.kind != "fixed"
    ]
    if [*dict.fromkeys(moving)] != [*names] or len(moving) != len(origins):
        need = f"`text_or_path` must be the URDF of this arm, whose actuators are {[*names]}"
        raise ValueError(f"{need}, got {moving} up to {end_link!r}.")
    wanted = iter(origins)
    before = matrix_of()
    changes = []
    for element, (joint, *free) in path:
        origin = _origin(element)
        if free:
            raise ValueError(
                f"joint {free[0].name!r} is free; use a `root_link` after it."
            )
        if joint.kind == "fixed":
            before = before @ joint.origin
            continue
        # Exclude the fixed joints before it and the offset of a mimic joint.
        ahead = np.linalg.solve(before, next(wanted))
        placed = ahead @ np.linalg.solve(joint.origin, origin)
        before = matrix_of()
        if np.abs(placed - origin).max() > _SAME:
            changes.append((element["origin"].place, element["joint"].place, placed))
    for own, around, placed in sorted(
        changes, key=lambda change: change[1], reverse=True
    ):
        tag = _TAG.match(data, max(own, around))
        assert tag is not None
        end = b">" if own >= 0 and not tag[0].endswith(b"/>") else b"/>"
        start = tag.start() if own >= 0 else tag.end()
        data = data[:start] + _origin_tag(placed) + end + data[tag.end() :]
    return data.decode(errors="surrogateescape")


def _origin_tag(placed: NDArray) -> bytes:
    """Return the beginning of an <origin>; its angles are exact at a pitch of 90 degrees too."""
    a, b, c = placed[:3, :3]
    position = placed[:3, 3]
    yaw = math.atan2(b[0], a[0])
    sine = math.sin(yaw)
    cosine = math.cos(yaw)
    pitch = math.atan2(-c[0], cosine * a[0] + sine * b[0])
    roll = math.atan2(sine * a[2] - cosine * b[2], cosine * b[1] - sine * a[1])
    rows = position, (roll, pitch, yaw)
    # no -0.0.
    xyz, rpy = (" ".join(repr(float(number) + 0.0) for number in row) for row in rows)
    return f'<origin xyz="{xyz}" rpy="{rpy}"'.encode()
