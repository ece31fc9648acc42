"""Robot descriptions in TOML files: checks of all keys and values, and the described chain."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hybridkin._core.arrays import shaped
from hybridkin._core.rotations import rotation
from hybridkin._core.text_rows import DECIMALS
from hybridkin._core.toml_files import (
    Need,
    Test,
    among,
    check_keys,
    is_number,
    is_positive,
    is_table,
    is_text,
    many,
    one_or_many,
    read_toml,
)
from hybridkin._core.units import FRAMES, METRES, SECONDS, UNITS
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.constant_curvature import ConstantCurvatureChain
from hybridkin.chains.elastic_tendons import ElasticTendonChain
from hybridkin.chains.force_tendons import ForceTendonChain

_STIFFNESS = ("bending_stiffness", "axial_stiffness")
_PLAIN = "constant-curvature"
_ELASTIC = "elastic-tendon"
_FORCES = "force-tendon"
_CHAINS: dict[str, type[ArcChain]] = {
    _PLAIN: ConstantCurvatureChain,
    _ELASTIC: ElasticTendonChain,
    _FORCES: ForceTendonChain,
}
# Keys of a segment that only some models have.
_MODELS = {
    "stage": (_PLAIN,),
    **dict.fromkeys(_STIFFNESS, (_ELASTIC, _FORCES)),
    **dict.fromkeys(("weight", "taper"), (_FORCES,)),
    **dict.fromkeys(("zeros", "spool_radius"), (_PLAIN, _ELASTIC)),
}
_NEEDED = {_ELASTIC: ("length",), _FORCES: ("length", *_STIFFNESS)}
_MOST = 64  # segments of a robot, actuators of a segment

_TABLE = ("be a table of keys", is_table)
_TEXT = ("be text", is_text)
_POSITIVE = ("be positive, or a list of positive numbers", one_or_many(is_positive))
_WHOLE = (
    f"be a whole number from 1 to {_MOST}",
    lambda v: type(v) is int and 0 < v <= _MOST,
)
# Tables, their keys, and the requirement on the value of a key, in words and as a test.
_ROWS: list[tuple[str, str, str, Test]] = [
    ("file", "name", *_TEXT),
    ("file", "model", *among(*_CHAINS)),
    ("file", "routing", *among("segment", "base")),
    (
        "file",
        "calibrate",
        'be a list of names, "auto" or "default"',
        lambda v: v in ([], "auto", "default") or many(is_text)(v),
    ),
    (
        "file",
        "segment",
        "hold tables, each under the heading [[segment]]",
        many(is_table),
    ),
    ("file", "base log limits", *_TABLE),
    (
        "segment",
        "radius length " + " ".join(_STIFFNESS),
        "be a positive number",
        is_positive,
    ),
    ("segment", "angle_deg offset", "be a number", is_number),
    ("segment", "weight", "be zero or more", lambda v: is_number(v) and v >= 0),
    ("segment", "taper", "lie in [0, 1)", lambda v: is_number(v) and 0 <= v < 1),
    ("segment", "angles_deg", "hold numbers", many(is_number)),
    (
        "segment",
        "zeros",
        "be a number, or a list of numbers",
        one_or_many(is_number),
    ),
    ("segment", "gain spool_radius", *_POSITIVE),
    ("segment", "rest_bend_deg", "hold 2 numbers", many(is_number, 2)),
    ("segment", "stage", *among("insertion", "rotation")),
    ("segment", "clockwise", "be true or false", lambda value: isinstance(value, bool)),
    ("segment", "actuators repeat", *_WHOLE),
    (
        "base",
        "position rotation_vector_deg gravity",
        "hold 3 numbers",
        many(is_number, 3),
    ),
    ("log", "q", "hold names of columns", many(is_text)),
    ("log", "x", "hold names of columns", many(is_text)),
    (
        "log",
        "markers",
        "hold lists [segment, fraction, x, y, z]",
        many(many(is_number, 5)),
    ),
    ("log", "q_unit groups runs time", *_TEXT),
    (
        "log",
        "unwrap",
        "be true or false, a positive period, or a table of columns and their periods",
        lambda v: isinstance(v, (bool, dict)) or is_positive(v),
    ),
    ("log", "group_suffix", "be text", lambda value: isinstance(value, str)),
    ("log", "x_unit", *among(*METRES)),
    ("log", "header_line", *_WHOLE),
    ("log", "decimal", *among(*DECIMALS)),
    ("log", "missing", "hold numbers", many(is_number)),
    ("log", "time_unit", *among(*SECONDS, FRAMES)),
    ("log", "rate", "be a positive number", is_positive),
    ("log", "q_sign", "be 1 or -1, or a list of them", one_or_many(among(1, -1)[1])),
    (
        "limits",
        "q_min q_max",
        "be a number, or a list of numbers",
        one_or_many(is_number),
    ),
    ("limits", "dq_max ddq_max", *_POSITIVE),
    ("limits", "unit", *among("m", "log")),
]


def read_tables(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file; a ValueError names a wrong key."""
    content = read_toml(path, "a robot description")
    _check(content, "file", "the file")
    for k, table in enumerate(content.get("segment", ())):
        _check(table, "segment", f"[[segment]] {k + 1}")
    for name in {"base", "log", "limits"} & content.keys():
        _check(content[name], name, f"[{name}]")
    return content


def _check(table: Mapping[str, Any], kind: str, where: str) -> None:
    needs: dict[str, Need] = {}
    for name, keys, words, fits in _ROWS:
        if name == kind:
            needs |= dict.fromkeys(keys.split(), (words, fits))
    check_keys(table, needs, where)


def chain_of(tables: Mapping[str, Any]) -> ArcChain:
    """Return the chain of a description with segments."""
    model = tables.get("model", _PLAIN)
    base = tables.get("base", {})
    # Without a unit in [log], angles are in radians and others are unknown.
    unit = tables.get("log", {"q_unit": "rad"}).get("q_unit", "1")
    segments: list[dict[str, Any]] = []
    for i, table in enumerate(tables["segment"]):
        where = f"[[segment]] {i + 1}"
        _check_keys_of_model(table, where, model)
        segment = _segment(table, where, model, unit)
        segments += [segment] * table.get("repeat", 1)
    if len(segments) > _MOST:
        raise ValueError(
            f"[[segment]] must describe at most {_MOST} segments in all, got "
            f"{len(segments)}; check `repeat`."
        )
    arguments: dict[str, Any] = {key: [segment[key] for segment in segments] for key in segments[0]}
    for key in ("gains", *_STIFFNESS):
        if key in arguments:
            arguments[key] = _all_or_none(arguments[key], key)
    if arguments["gains"] is None:
        arguments["gains"] = 1.0
    stages = arguments.pop("stage")
    if "rotation" in stages[1:]:
        raise ValueError('`stage` "rotation" is only allowed in the first [[segment]].')
    if stages[0] == "rotation":
        arguments["stage"] = "rotation"
    # The radius of a stage has no effect.
    any_radius = next(filter(None, arguments["radii"]), 1.0)
    arguments["radii"] = [radius or any_radius for radius in arguments["radii"]]
    arguments["base"] = _base(base)
    if "routing" in tables:
        arguments["routing"] = tables["routing"]
    if "gravity" in base:
        if model != _FORCES:
            raise ValueError(f'`gravity` in [base] belongs to model = "{_FORCES}"; remove it.')
        arguments["gravity"] = base["gravity"]
    return _CHAINS[model](**arguments)


def _check_keys_of_model(table: Mapping[str, Any], where: str, model: str) -> None:
    for key in table:
        models = _MODELS.get(key, _CHAINS)
        if model not in models:
            choices = " or ".join(f'"{name}"' for name in models)
            raise ValueError(
                f"`{key}` in {where} belongs to another model; remove it, or set model = {choices}."
            )
    for key in _NEEDED.get(model, ()):
        if key not in table:
            raise ValueError(
                f"`{key}` is missing in {where}; model {model!r} needs it in every [[segment]]."
            )


def _all_or_none(values: list[Any], key: str) -> list[Any] | None:
    """Return the entries of a key that all segments have, or None if none has it."""
    missing = [i + 1 for i, value in enumerate(values) if value is None]
    if len(missing) == len(values):
        return None
    if missing:
        raise ValueError(
            f"`{key}` must be in every [[segment]] or in none, but is missing for segment "
            f"{missing[0]}."
        )
    return values


def _segment(table: Mapping[str, Any], where: str, model: str, unit: str) -> dict[str, Any]:
    """Return the constructor arguments of one segment; None for optional ones."""
    stage = table.get("stage")
    if stage is not None and not {*table} <= {"stage", "offset", "zeros", "gain"}:
        raise ValueError(
            f"`stage` in {where} can only be combined with `offset`, `zeros` and `gain`."
        )
    if "radius" not in table and stage is None:
        raise ValueError(f"`radius` is missing in {where}; give the actuator circle's radius [m].")
    if "angles_deg" in table:
        angles = np.radians(np.array(table["angles_deg"], dtype=float))
        if beside := {"angle_deg", "actuators", "clockwise"} & {*table}:
            raise ValueError(f"`{min(beside)}` cannot be combined with `angles_deg` in {where}.")
    else:
        n = table.get("actuators", 3 if stage is None else 1)
        step = (-2.0 if table.get("clockwise", False) else 2.0) * math.pi / n
        angles = math.radians(table.get("angle_deg", 0.0)) + step * np.arange(n)
    n = len(angles)
    gains = _gains(table, where, n, unit)
    arguments = {
        "radii": table.get("radius"),
        "stage": stage,
        "lengths": table.get("length"),
        "offsets": table.get("offset", 0.0),
        "n_actuators": n,
        "angles": angles,
        "rest_bends": np.radians(table.get("rest_bend_deg", [0.0, 0.0])),
        "gains": gains,
    }
    if model != _PLAIN:
        arguments |= {key: table.get(key) for key in _STIFFNESS}
    if model == _FORCES:
        arguments |= {key: table.get(key, 0.0) for key in ("weight", "taper")}
        return arguments
    zeros = each(table, "zeros", where, n)
    if model == _ELASTIC:
        return arguments | {"tendon_zeros": zeros}
    if gains is not None:  # in the unit of the log
        zeros *= UNITS.get(unit, 1.0)
    return arguments | {"actuator_zeros": zeros}


def _gains(table: Mapping[str, Any], where: str, n: int, unit: str) -> np.ndarray | None:
    """Return metres per unit of q (n,), for angles per radian; None if q is in metres."""
    gains = each(table, "gain", where, n)
    spools = each(table, "spool_radius", where, n)
    spun = spools.any()
    if not spun and not gains.any():
        return None
    wrong_spool = spun and (unit not in ("deg", "rad") or gains.any())
    if unit in METRES or wrong_spool:
        raise ValueError(
            f"`gain` or `spool_radius` in {where} needs a `q_unit` in [log] that is not a "
            f'length, `spool_radius` needs "deg" or "rad" and no `gain`, got {unit!r}.'
        )
    return spools + gains / UNITS.get(unit, 1.0)


def _base(table: Mapping[str, Any]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = table.get("position", 0.0)
    turn = table.get("rotation_vector_deg", [0.0, 0.0, 0.0])
    angles = np.radians(shaped(turn, "rotation_vector_deg", [3]))
    pose[:3, :3] = rotation(torch.from_numpy(angles))[0].numpy()
    return pose


def each(table: Mapping[str, Any], key: str, where: str, size: int) -> np.ndarray:
    """Return `size` numbers, given as a list or as one number for all; zeros by default."""
    value = np.array(table.get(key, 0.0), dtype=float)
    if value.shape not in ((), (size,)):
        raise ValueError(f"`{key}` in {where} must hold {size} numbers, got {table[key]!r}.")
    return np.broadcast_to(value, size).copy()
