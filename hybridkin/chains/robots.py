"""Robots by name, and robot descriptions read from TOML files."""

from __future__ import annotations

import difflib
import functools
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybridkin._core.units import METRES
from hybridkin.chains.constant_curvature import ConstantCurvatureChain
from hybridkin.chains.elastic_tendons import ElasticTendonChain

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

__all__ = [
    "BHA_LENGTH_LIMITS",
    "Limits",
    "LogFormat",
    "RobotDescription",
    "bionic_handling_assistant",
    "from_toml",
    "read_description",
]

BHA_LENGTH_LIMITS = (0.10, 0.40)
"""Shortest and longest chamber of the Bionic Handling Assistant [m]."""

_MODELS = {"constant-curvature": ConstantCurvatureChain, "elastic-tendon": ElasticTendonChain}
_STIFFNESS = ("bending_stiffness", "axial_stiffness")


def bionic_handling_assistant(tool: float = 0.0) -> ConstantCurvatureChain:
    """Return the nominal chain of Festo's Bionic Handling Assistant.

    Three segments of three chambers at 0, 120 and 240 degrees; q holds the nine chamber lengths,
    segment by segment from the base.

    Parameters
    ----------
    tool : float, default=0.0
        Rigid length after the last segment [m].

    Returns
    -------
    ConstantCurvatureChain
        With the published radii 0.100, 0.093 and 0.079 m.

    References
    ----------
    Reinhart & Steil (2016), section 2; Rolf & Steil (2012), Constant curvature continuum
    kinematics as fast approximate model for the Bionic Handling Assistant, IROS.

    Examples
    --------
    >>> from hybridkin import robots
    >>> robots.bionic_handling_assistant().n_actuators
    9
    """
    return ConstantCurvatureChain([0.100, 0.093, 0.079], offsets=[0.0, 0.0, tool])


@dataclass(frozen=True)
class LogFormat:
    """How a robot's log is written: columns, units and sign.

    Attributes
    ----------
    q, x : tuple of str
        Columns of the actuator vector and of the tip position, in the chain's order.
    q_unit, x_unit : {"m", "cm", "mm"}
        Units of these columns.
    q_sign : int
        -1 where the log counts a pulled (shortened) tendon as positive.
    group_suffix : str
        Rows whose motion ends in this belong to the motion named without it.
    groups, time : str or None
        Columns of the motion that a row belongs to, and of its time stamp [s].
    """

    q: tuple[str, ...]
    x: tuple[str, ...]
    q_unit: str = "m"
    x_unit: str = "m"
    q_sign: int = 1
    group_suffix: str = ""
    groups: str | None = None
    time: str | None = None


@dataclass(frozen=True, eq=False)
class Limits:
    """What the actuators can do.

    Attributes
    ----------
    q_min, q_max : ndarray of shape (n,) or None
        Least and largest value of every actuator, as the chain counts them [m].
    dq_max : ndarray of shape (n,) or None
        Largest speed [m/s].
    """

    q_min: np.ndarray | None = None
    q_max: np.ndarray | None = None
    dq_max: np.ndarray | None = None

    def intersect(self, other: Limits) -> Limits:
        """Return the limits that keep to both; what one does not know the other decides."""
        found = {}
        for name, mine in vars(self).items():
            given = [limit for limit in (mine, vars(other)[name]) if limit is not None]
            tighter = np.maximum if name == "q_min" else np.minimum
            found[name] = functools.reduce(tighter, given) if given else None
        return Limits(**found)

    def narrowed(self, by: float | np.ndarray) -> Limits:
        """Return the limits with the range of every actuator smaller by `by` at both ends [m]."""
        low, high = self.q_min, self.q_max
        return Limits(
            None if low is None else low + by, None if high is None else high - by, self.dq_max
        )


@dataclass(frozen=True)
class RobotDescription:
    """A robot as its TOML file describes it.

    Attributes
    ----------
    name : str
        What to call it.
    chain : ConstantCurvatureChain or ElasticTendonChain
        Its nominal kinematics.
    calibrate : tuple of str
        Geometry that should be fitted to data.
    log : LogFormat or None
        How its logs are written.
    limits : Limits
        What its actuators can do, as far as it is known.
    path : Path or None
        The file it was read from.
    """

    name: str
    chain: ConstantCurvatureChain | ElasticTendonChain
    calibrate: tuple[str, ...]
    log: LogFormat | None
    limits: Limits = Limits()
    path: Path | None = None


def from_toml(path: str | Path) -> ConstantCurvatureChain | ElasticTendonChain:
    r"""Return the chain that a TOML file describes.

    Parameters
    ----------
    path : str or Path
        A robot description; `read_description` has its format, and returns the rest of it too.

    Returns
    -------
    ConstantCurvatureChain or ElasticTendonChain
        The nominal kinematics, lengths in metres.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not TOML, lacks a key, or has one that is not known; the message names it.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from hybridkin import robots
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "robot.toml"
    ...     _ = path.write_text("[[segment]]\nradius = 0.005\nlength = 0.1\nrepeat = 2\n")
    ...     chain = robots.from_toml(path)
    >>> chain.n_actuators
    6
    """
    return read_description(path).chain


def read_description(path: str | Path) -> RobotDescription:
    """Return the robot that a TOML file describes.

    Parameters
    ----------
    path : str or Path
        A file like this one::

            name = "my trunk"
            model = "constant-curvature"    # the default, or "elastic-tendon"
            routing = "base"                # or "segment", the default; of elastic tendons "base"
            calibrate = ["radii", "base"]   # optional, else the chain's own list

            [[segment]]                     # base to tip
            radius = 0.0045                 # of the actuator circle [m]
            length = 0.060                  # [m]; leave out for extensible segments
            actuators = 3                   # the default
            angle_deg = 0.0                 # of the first actuator; or angles_deg = [0, 120, 240]
            clockwise = false               # which way the others follow
            offset = 0.0                    # rigid length after the segment [m]
            rest_bend_deg = [0.0, 0.0]      # its pre-curvature: a bending vector
            zeros = [0.0, 0.0, 0.0]         # offset of the sensor of each actuator [m]
                                            # of elastic tendons their `tendon_zeros`
            bending_stiffness = 2.0e-7      # of elastic tendons only, in all segments or in none
            axial_stiffness = 10.0          # likewise; units and defaults: `ElasticTendonChain`
            repeat = 2                      # as many segments like this one

            [base]                          # optional
            position = [0.0, 0.0, 0.0]      # [m]
            rotation_vector_deg = [0.0, 0.0, 0.0]

            [log]                           # how its logs are written, optional
            q = ["servo_1", "servo_2", "servo_3"]
            x = ["tip_x", "tip_y", "tip_z"]
            q_unit = "mm"
            x_unit = "mm"
            q_sign = -1                     # -1: the log counts a pulled tendon as positive
            groups = "motion"               # column that names the motion of a row, optional
            group_suffix = "_hold"          # rows of motion "a_hold" belong to motion "a"
            time = "t"                      # column of the time stamp [s], optional

            [limits]                        # of the actuators, optional; one number or one each
            q_min = -0.010                  # as the chain counts them: shortening < 0 [m]
            q_max = 0.010
            dq_max = 0.020                  # [m/s]

    Returns
    -------
    RobotDescription
        The nominal chain and the other entries of the file.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not TOML, lacks a key, or has one that is not known; the message names it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"`path` must name a robot description, got {path}: no such file.")
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not a TOML file: {error}.") from error
    try:
        return replace(_description(content, path.stem), path=path)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def _description(content: Mapping[str, Any], stem: str) -> RobotDescription:
    top = {"name", "model", "routing", "calibrate", "segment", "base", "log", "limits"}
    _known(content, top, "the file")
    chain = _chain(content)
    calibrate = content.get("calibrate", chain.default_parameters)
    if not isinstance(calibrate, (list, tuple)):
        raise ValueError(f"`calibrate` must be a list of names, got {calibrate!r}.")
    log = _log_format(content["log"], chain.n_actuators) if "log" in content else None
    limits = _limits(content.get("limits", {}), chain.n_actuators)
    return RobotDescription(str(content.get("name", stem)), chain, tuple(calibrate), log, limits)


def _chain(content: Mapping[str, Any]) -> ConstantCurvatureChain | ElasticTendonChain:
    model = content.get("model", "constant-curvature")
    if model not in _MODELS:
        raise ValueError(f"`model` must be one of {(*_MODELS,)}, got {model!r}.")
    tables = content.get("segment", [])
    if not isinstance(tables, list) or not tables:
        raise ValueError("`segment` is missing; describe each segment in a [[segment]] table.")
    segments: list[dict[str, Any]] = []
    for i, table in enumerate(tables):
        segments += _segments(table, f"[[segment]] {i + 1}")
    given: dict[str, Any] = {key: [segment[key] for segment in segments] for key in segments[0]}
    elastic = model == "elastic-tendon"
    for key in ("length", *_STIFFNESS):
        missing = [i + 1 for i, value in enumerate(given[key]) if value is None]
        if elastic and key == "length" and missing:
            raise ValueError(
                f"`length` is missing for segment {missing[0]}; model 'elastic-tendon' needs the "
                "backbone length [m] in every [[segment]]."
            )
        if not elastic and key != "length" and len(missing) < len(segments):
            raise ValueError(
                f"`{key}` in [[segment]] is not known to model 'constant-curvature'; leave it "
                'out, or set model = "elastic-tendon".'
            )
        if 0 < len(missing) < len(segments):
            kinds = " (tendons) or in none (chambers)" if key == "length" else " or in none"
            raise ValueError(f"`{key}` must stand in every [[segment]]{kinds}.")
        given[key] = None if missing else given[key]
    build, lengths, zeros = _MODELS[model], given.pop("length"), given.pop("zeros")
    counts = [len(angles) for angles in given["angles"]]
    if elastic:
        given |= {"n_tendons": counts, "tendon_zeros": zeros}
    else:
        given = {key: value for key, value in given.items() if key not in _STIFFNESS}
        given |= {"n_actuators": counts, "actuator_zeros": zeros}
    given |= {"routing": content["routing"]} if "routing" in content else {}
    return build(lengths=lengths, base=_base(content.get("base", {})), **given)


def _segments(table: Mapping[str, Any], where: str) -> list[dict[str, Any]]:
    keys = {"radius", "length", "actuators", "angle_deg", "angles_deg", "clockwise", "offset"}
    _known(table, keys | {"rest_bend_deg", "zeros", "repeat", *_STIFFNESS}, where)
    if "radius" not in table:
        raise ValueError(f"`radius` is missing in {where}; give the actuator circle's radius [m].")
    if "angles_deg" in table:
        for other in ("angle_deg", "actuators", "clockwise"):
            if other in table:
                raise ValueError(f"`{other}` cannot stand beside `angles_deg` in {where}.")
        angles = np.radians(np.asarray(table["angles_deg"], dtype=float))
    else:
        n = _number(table, "actuators", where, 3)
        step = (-2.0 if table.get("clockwise", False) else 2.0) * math.pi / n
        angles = math.radians(_number(table, "angle_deg", where, 0.0)) + step * np.arange(n)
    segment = {
        "radii": _number(table, "radius", where),
        "offsets": _number(table, "offset", where, 0.0),
        "angles": angles,
        "rest_bends": np.radians(_numbers(table, "rest_bend_deg", where, 2)),
        "zeros": _numbers(table, "zeros", where, len(angles)),
    }
    for key in ("length", *_STIFFNESS):
        segment[key] = _number(table, key, where) if key in table else None
    return [segment] * int(_number(table, "repeat", where, 1))


def _base(table: Mapping[str, Any]) -> np.ndarray:
    _known(table, {"position", "rotation_vector_deg"}, "[base]")
    pose = np.eye(4)
    pose[:3, 3] = _numbers(table, "position", "[base]", 3)
    turn = _numbers(table, "rotation_vector_deg", "[base]", 3)
    pose[:3, :3] = Rotation.from_rotvec(turn, degrees=True).as_matrix()
    return pose


def _log_format(table: Mapping[str, Any], n_actuators: int) -> LogFormat:
    _known(table, set(LogFormat.__dataclass_fields__), "[log]")
    given = dict(table)
    for key, size in (("q", n_actuators), ("x", 3)):
        value = table.get(key, [])
        if not isinstance(value, list) or len(value) != size:
            raise ValueError(f"`{key}` in [log] must name {size} columns, got {value!r}.")
        given[key] = tuple(str(name) for name in value)
    for key, allowed in (("q_unit", [*METRES]), ("x_unit", [*METRES]), ("q_sign", [1, -1])):
        if key in table and table[key] not in allowed:
            raise ValueError(f"`{key}` in [log] must be one of {allowed}, got {table[key]!r}.")
    for key in ("group_suffix", "groups", "time"):
        if not isinstance(table.get(key, ""), str):
            raise ValueError(f"`{key}` in [log] must be text, got {table[key]!r}.")
    return LogFormat(**given)


def _limits(table: Mapping[str, Any], n_actuators: int) -> Limits:
    _known(table, set(Limits.__dataclass_fields__), "[limits]")
    each = {key: v if isinstance(v, list) else [v] * n_actuators for key, v in table.items()}
    limits = Limits(**{key: _numbers(each, key, "[limits]", n_actuators) for key in each})
    low, high = limits.q_min, limits.q_max
    if low is not None and high is not None and (low > high).any():
        raise ValueError("`q_min` in [limits] must not exceed `q_max`; swap them.")
    if limits.dq_max is not None and not (limits.dq_max > 0).all():
        raise ValueError(f"`dq_max` in [limits] must be positive, got {table['dq_max']!r}.")
    return limits


def _number(table: Mapping[str, Any], key: str, where: str, default: float | None = None) -> Any:
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"`{key}` in {where} must be a number, got {value!r}.")
    return value


def _numbers(table: Mapping[str, Any], key: str, where: str, size: int) -> np.ndarray:
    value = table.get(key, [0.0] * size)
    wrong = not isinstance(value, list) or len(value) != size
    if wrong or not all(type(v) in (int, float) and math.isfinite(v) for v in value):
        raise ValueError(f"`{key}` in {where} must hold {size} numbers, got {value!r}.")
    return np.array(value, dtype=float)


def _known(table: Mapping[str, Any], keys: set[str], where: str) -> None:
    for key in table:
        if key not in keys:
            close = difflib.get_close_matches(key, keys, n=1)
            hint = f"did you mean `{close[0]}`?" if close else f"known: {sorted(keys)}."
            raise ValueError(f"`{key}` in {where} is not known; {hint}")
