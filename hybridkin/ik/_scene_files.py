"""Scene files: the tables of a TOML file that describe obstacles, checked and in metres."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from hybridkin._core.rotations import rotation
from hybridkin._core.toml_files import (
    Need,
    among,
    check_keys,
    is_number,
    is_positive,
    is_table,
    is_text,
    many,
    read_toml,
)
from hybridkin._core.units import METRES

_POINT = ("hold 3 numbers", many(is_number, 3))
_LENGTH = ("be a positive number", is_positive)
_KEYS: dict[str, Need] = {
    "name": ("be text", is_text),
    "center": _POINT,
    "radius": _LENGTH,
    "normal": _POINT,
    "offset": ("be a number", is_number),
    "start": _POINT,
    "end": _POINT,
    "size": ("hold 3 positive numbers", many(is_positive, 3)),
    "rotation_vector_deg": _POINT,
}
_NO_LENGTHS = ("name", "normal", "rotation_vector_deg")
# The keys of every kind of obstacle: those that it needs, and the others.
_KINDS = {
    "sphere": (("center", "radius"), ("name",)),
    "half_space": (("normal", "offset"), ("name",)),
    "capsule": (("start", "end", "radius"), ("name",)),
    "box": (("center", "size"), ("rotation_vector_deg", "radius", "name")),
}
_HOLDS_TABLES = "hold tables, each under a heading in double brackets, such as [[sphere]]"


class DescribedObstacle(NamedTuple):
    """An obstacle of a file: its kind, the arguments that make it, and its place in the file."""

    kind: str
    arguments: dict[str, Any]
    where: str


def described_obstacles(path: Path) -> list[DescribedObstacle]:
    """Return the obstacles of a scene file, kind by kind; a ValueError names a wrong key."""
    content = read_toml(path, "a scene of obstacles")
    needs: dict[str, Need] = dict.fromkeys(_KINDS, (_HOLDS_TABLES, many(is_table)))
    needs["unit"] = among(*METRES)
    check_keys(content, needs, "the file")
    metres = METRES[content.pop("unit", "m")]
    scene = []
    for kind, tables in content.items():
        for k, table in enumerate(tables):
            where = f"[[{kind}]] {k + 1}"
            _check_table(table, kind, where)
            scene.append(DescribedObstacle(kind, _arguments(table, metres), where))
    return scene


def _check_table(table: Mapping[str, Any], kind: str, where: str) -> None:
    needed, others = _KINDS[kind]
    check_keys(table, {key: _KEYS[key] for key in (*needed, *others)}, where)
    for key in needed:
        if key not in table:
            raise ValueError(f"`{key}` is missing in {where}; every [[{kind}]] needs it.")


def _arguments(table: Mapping[str, Any], metres: float) -> dict[str, Any]:
    """Return the arguments of the class of an obstacle, in metres."""
    arguments: dict[str, Any] = {}
    for key, value in table.items():
        if key == "rotation_vector_deg":
            angles = torch.from_numpy(np.radians(np.array(value, dtype=float)))
            arguments["rotation"] = rotation(angles)[0]
        elif key in _NO_LENGTHS:
            arguments[key] = value
        else:
            arguments[key] = (metres * np.array(value, dtype=float)).tolist()
    return arguments
