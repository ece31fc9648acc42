"""Robots by name, and robot descriptions read from TOML files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.actuators import ActuatorLayout
from hybridkin._core.arrays import Numbers, as_path, shaped
from hybridkin._core.reading import Reading
from hybridkin._core.units import METRES, UNITS
from hybridkin.chains._robot_files import chain_of, each, read_tables
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.constant_curvature import ConstantCurvatureChain

__all__ = [
    "BHA_LENGTH_LIMITS",
    "ActuatorLayout",
    "Limits",
    "LogFormat",
    "RobotDescription",
    "bionic_handling_assistant",
    "read_description",
]

BHA_LENGTH_LIMITS = (0.10, 0.40)
"""Shortest and longest chamber of the Bionic Handling Assistant [m]."""

_COLUMNS = ("groups", "runs", "time")


def bionic_handling_assistant() -> ConstantCurvatureChain:
    """Return the nominal chain of Festo's Bionic Handling Assistant.

    Three segments of three chambers at 0, 120 and 240 degrees; q holds the nine chamber lengths,
    segment by segment from the base.

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
    return ConstantCurvatureChain([0.100, 0.093, 0.079])


@dataclass(frozen=True)
class LogFormat(Reading):
    """Format of a robot's logs: columns, units and sign.

    Attributes
    ----------
    q, x : tuple of str
        Columns of the actuator vector and of the tip position, in the chain's order; with several
        markers three for each, in the order of ``chain.markers``.
    q_unit : str
        Unit of q. For a chain with `gains` it is any name; for a robot without segments it may also
        be "rad", "deg" or "1".
    q_sign : int or tuple of int
        -1 if the log counts a pulled (shortened) tendon as positive.
    group_suffix : str
        A motion whose name ends in this suffix belongs to the motion named without it.
    groups, runs, time, time_unit, rate, x_unit, missing, unwrap
        As for `datasets.load_log`.
    delimiter, header_line, decimal, drop_invalid
        As for `datasets.load_log`.
    """

    _: KW_ONLY
    group_suffix: str = ""

    @property
    def q_factor(self) -> NDArray:
        """Units of the model per unit of the log, including the sign, shape () or (n,)."""
        return np.multiply(self.q_sign, UNITS.get(self.q_unit, 1.0))

    def to_log(self, q: Numbers) -> NDArray:
        """Return actuator vectors (..., n) of the model in the unit and with the sign of the log.

        The columns are those of `q`; commands for the robot that wrote the log are such numbers.
        """
        return shaped(q, "q", ("...", len(self.q))) / self.q_factor + 0.0  # no -0

    def from_log(self, q: Numbers) -> NDArray:
        """Return actuator vectors (..., n) of the log in unit and sign of the model."""
        return shaped(q, "q", ("...", len(self.q))) * self.q_factor

    def of_tracks(self, target: tuple[str, ...]) -> LogFormat:
        """Return the format of a track.csv, which has the columns of q and targets as tips."""
        return LogFormat(
            self.q,
            target,
            "status",
            runs=self.runs,
            time=self.time,
            q_unit=self.q_unit,
            x_unit=self.x_unit,
            q_sign=self.q_sign,
            group_suffix=self.group_suffix,
        )

    @property
    def reading(self) -> dict[str, Any]:
        """The arguments of `datasets.load_log` for this format."""
        unit = self.q_unit if self.q_unit in UNITS else "1"
        return replace(self, q_unit=unit).keywords


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of the actuators, infinite where there are none.

    Attributes
    ----------
    q_min, q_max : float or ndarray of shape (n,)
        Smallest and largest value of every actuator, with the chain's sign [unit of q].
    dq_max, ddq_max : float or ndarray of shape (n,)
        Largest speed [unit of q per s] and acceleration [unit of q per s^2].
    """

    q_min: NDArray | float = -math.inf
    q_max: NDArray | float = math.inf
    dq_max: NDArray | float = math.inf
    ddq_max: NDArray | float = math.inf

    @property
    def are_finite(self) -> bool:
        """Whether every actuator has a finite range."""
        return bool(np.isfinite(self.q_min).all() and np.isfinite(self.q_max).all())

    def intersect(self, other: Limits) -> Limits:
        """Return the intersection of two limits."""
        return Limits(
            np.maximum(self.q_min, other.q_min),
            np.minimum(self.q_max, other.q_max),
            np.minimum(self.dq_max, other.dq_max),
            np.minimum(self.ddq_max, other.ddq_max),
        )

    def scaled(self, factor: float | np.ndarray) -> Limits:
        """Return the limits in other units; a negative `factor` swaps low and high."""
        low = np.multiply(factor, self.q_min)
        high = np.multiply(factor, self.q_max)
        size = np.abs(factor)
        return Limits(
            np.minimum(low, high),
            np.maximum(low, high),
            np.multiply(size, self.dq_max),
            np.multiply(size, self.ddq_max),
        )

    def narrowed(self, by: float | np.ndarray) -> Limits:
        """Return the limits with the range of every actuator reduced by `by` at both ends [m]."""
        return replace(self, q_min=self.q_min + by, q_max=self.q_max - by)


@dataclass(frozen=True)
class RobotDescription:
    """Content of a robot's TOML file.

    Attributes
    ----------
    name : str
        Name of the robot.
    chain : ConstantCurvatureChain, ElasticTendonChain, ForceTendonChain or None
        Its nominal model; None for a robot without segments (a model of data alone).
    calibrate : tuple of str or "auto"
        Parameters to fit to data; "auto": chosen by errors on held-out data.
    log : LogFormat or None
        Format of its logs.
    limits : Limits
        Limits of its actuators, as far as known.
    path : Path or None
        The file it was read from.
    """

    name: str
    chain: ArcChain | None
    calibrate: tuple[str, ...] | str
    log: LogFormat | None
    limits: Limits = Limits()
    path: Path | None = None

    @property
    def n_actuators(self) -> int:
        """Size of q."""
        if self.chain is not None:
            return self.chain.n_actuators
        return 0 if self.log is None else len(self.log.q)

    @property
    def has_segments(self) -> bool:
        """Whether it has a mechanical model; else its model is learned from data alone."""
        return self.chain is not None

    def to_log(self, q: Numbers) -> NDArray:
        """Return actuator vectors (..., n) in unit and sign of the logs, see `LogFormat`."""
        return self._known_log().to_log(q)

    def from_log(self, q: Numbers) -> NDArray:
        """Return actuator vectors (..., n) of a log as the model takes them."""
        return self._known_log().from_log(q)

    def _known_log(self) -> LogFormat:
        if self.log is None:
            raise ValueError(
                f"{self.path or self.name} must have a table [log] with the unit of q."
            )
        return self.log

    @property
    def base_is_free(self) -> bool:
        """Whether the pose of the base is fitted to data."""
        return self.calibrate == "auto" or "base" in self.calibrate


def read_description(path: str | Path) -> RobotDescription:
    r"""Return the robot that a TOML file describes.

    Parameters
    ----------
    path : str or Path
        A file like this one::

            name = "my trunk"
            model = "constant-curvature"    # the default, or "elastic-tendon", or "force-tendon"
                                            # where q holds tendon forces
            routing = "base"                # or "segment" (default for constant curvature)
            calibrate = ["radii", "base"]   # optional, else "auto": chosen by cross-validated
                                            # errors; "default": the chain's own list

            [[segment]]                     # base to tip
            radius = 0.0045                 # of the actuator circle [m]
            length = 0.060                  # [m]; leave out for extensible segments
            stage = "rotation"              # only in the first segment, or "insertion": a rigid
                                            # stage with one actuator; only offset, zeros and gain
            actuators = 3                   # the default; 2 at opposite angles bend in a plane
            angle_deg = 0.0                 # of the first actuator; or angles_deg = [0, 120, 240]
            clockwise = false               # direction in which the others follow
            offset = 0.0                    # rigid length after the segment [m]
            rest_bend_deg = [0.0, 0.0]      # its pre-curvature: a bending vector
            zeros = [0.0, 0.0, 0.0]         # offset of the sensor of each actuator, in metres or,
                                            # with a gain, in the unit of the log; for elastic
                                            # tendons the `tendon_zeros` [m]
            gain = 2.7e-5                   # for counts, pressures ...: metres per unit of the log,
                                            # one number or one each; in all segments or in none
            spool_radius = 0.006            # or for motors [m], with a q_unit of "deg" or "rad"
            bending_stiffness = 2.0e-7      # elastic tendons only, in all segments or in none
            axial_stiffness = 10.0          # likewise; units and defaults: `ElasticTendonChain`.
                                            # With forces both are needed: [N m^2] and [N]
            weight = 2.0                    # with forces only: of the body [N/m], see
            taper = 0.5                     # `ForceTendonChain`, as for the next key
            repeat = 2                      # number of segments like this one

            [base]                          # optional
            position = [0.0, 0.0, 0.0]      # [m]
            rotation_vector_deg = [0.0, 0.0, 0.0]
            gravity = [0.0, 0.0, -1.0]      # its direction in the measuring frame, with forces only

            [log]                           # format of its logs, optional
            q = ["servo_1", "servo_2", "servo_3"]
            x = ["tip_x", "tip_y", "tip_z"] # with several markers three columns each, the tip last,
                                            # and their places: segment (counted from 0), fraction
                                            # of its arc, and offset in the frame there [m]:
                                            # markers = [[0, 1.0, 0, 0, 0], [1, 1.0, 0, 0, 0.01]]
            q_unit = "mm"                   # "m", "cm", "mm", "um", "in"; with a gain or forces
                                            # another name
            x_unit = "mm"
            q_sign = -1                     # -1: a pulled tendon counts as positive; or one each
            groups = "motion"               # column with the motion of each row, optional
            group_suffix = "_hold"          # rows of motion "a_hold" belong to motion "a"
            runs = "session"                # column with the run of each row: motions that follow
                                            # each other without a break; optional
            time = "t"                      # column of the time stamp [s], optional; for creep
            header_line = 7                 # line of the header of a text file, from 1; optional:
                                            # blocks of Motive, Vicon and Qualisys are known
            decimal = ","                   # decimal sign of a text file; default "."
            missing = [9999.999]            # numbers that stand for missing values, optional; 0:
                                            # the 0, 0, 0 of a lost marker

            [limits]                        # of the actuators, optional; one number or one each
            q_min = -0.010                  # with the chain's sign: shortening < 0 [m]
            q_max = 0.010
            dq_max = 0.020                  # [m/s]
            ddq_max = 0.200                 # [m/s^2]
            unit = "m"                      # the default; "log": in unit and sign of [log]; with a
                                            # gain it must be "log"

        A file with only [log], and optionally [limits], describes a robot whose model is learned
        from data alone. Its `q_unit` may also be "deg", "rad" or "1" (values unchanged).

    Returns
    -------
    RobotDescription
        The nominal chain and the other entries of the file.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not TOML, lacks a key, or has an unknown key or a wrong value; the message
        names the key.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from hybridkin import robots
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "robot.toml"
    ...     _ = path.write_text("[[segment]]\nradius = 0.005\nlength = 0.1\nrepeat = 2\n")
    ...     robot = robots.read_description(path)
    >>> robot.chain.n_actuators
    6
    """
    path = as_path(path)
    if not path.is_file():
        raise FileNotFoundError(f"`path` must be a robot description, got {path}: no such file.")
    try:
        return replace(_description(read_tables(path), path.stem), path=path)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _description(tables: Mapping[str, Any], stem: str) -> RobotDescription:
    chain = chain_of(tables) if "segment" in tables else None
    of_chains = {"model", "routing", "calibrate", "base"} & {*tables}
    if chain is None and ("log" not in tables or of_chains):
        raise ValueError(
            "`segment` is missing; describe each segment in a [[segment]] table. For a model of "
            "data alone give [log] without `model`, `routing`, `calibrate` and `base`."
        )
    if chain is not None and tables.get("log", {}).get("markers"):
        places = tables["log"]["markers"]
        chain = chain.with_markers([(k, at, beside) for k, at, *beside in places])
    log = None
    if "log" in tables:
        log = _log_format(tables["log"], chain)
    names: tuple[str, ...] | str = ()
    if chain is not None:
        names = _calibrated(tables.get("calibrate", "auto"), chain)
    robot = RobotDescription(tables.get("name", stem), chain, names, log)
    return replace(robot, limits=_limits(tables.get("limits", {}), robot))


def _calibrated(names: list[str] | str, chain: ArcChain) -> tuple[str, ...] | str:
    """Return the parameters of the chain to fit to data, or "auto"."""
    if names == "auto":
        return "auto"
    if names == "default":
        return chain.default_parameters
    known = (*chain.parameter_names,)
    if not {*names} <= {*known} or len({*names}) < len(names):
        raise ValueError(
            f'`calibrate` must name different entries of {known}, or be "auto" or "default", '
            f"got {names}."
        )
    return tuple(names)


def _log_format(table: Mapping[str, Any], chain: ArcChain | None) -> LogFormat:
    if not {"q", "x"} <= {*table}:
        raise ValueError("`q` or `x` is missing in [log]; name the columns of actuators and tip.")
    if chain is not None and len(table["q"]) != chain.n_actuators:
        raise ValueError(
            f"`q` in [log] must name {chain.n_actuators} columns, one for each actuator of the "
            f"[[segment]] tables, got {len(table['q'])}: {table['q']}."
        )
    n_outputs = 3 if chain is None else chain.n_outputs
    if len(table["x"]) != n_outputs:
        raise ValueError(
            f"`x` in [log] must hold 3 column names, or 3 for each of `markers`, got {table['x']}."
        )
    columns = [*table["q"], *table["x"]]
    columns += [table[key] for key in _COLUMNS if key in table]
    if len({*columns}) < len(columns):
        raise ValueError(f"[log] must name every column once, got {columns}.")
    settings = dict(table)
    settings.pop("markers", None)
    for key, value in settings.items():
        if isinstance(value, list):
            settings[key] = tuple(value)
    in_metres = chain is None or chain.in_metres
    unit = settings.setdefault("q_unit", "m" if in_metres else "1")
    units = [*UNITS] if chain is None else [*METRES]
    if chain is not None and not chain.takes_lengths and unit in METRES:
        raise ValueError(
            f'`q_unit` in [log] must not be a length, as q holds forces, got {unit!r}; give "N", '
            "or another name with a `gain` [N per unit] in every [[segment]]."
        )
    if in_metres and unit not in units:
        raise ValueError(
            f'`q_unit` in [log] must be one of {units}; for motors "deg" or "rad", with a '
            "`spool_radius` [m] in every [[segment]]; for pressures or other units any name, with "
            f"a `gain` [m per unit] instead; got {unit!r}."
        )
    each(table, "q_sign", "[log]", len(table["q"]))
    return LogFormat(**settings)


def _limits(table: Mapping[str, Any], robot: RobotDescription) -> Limits:
    values = {key: value for key, value in table.items() if key != "unit"}
    unit = table.get("unit", "m")
    log = robot.log
    plain = robot.chain is not None and robot.chain.in_metres
    if log is None:
        need = "m"
        why = "without [log]"
    else:
        need = unit if plain else "log"
        why = "without [[segment]]" if robot.chain is None else "with gains"
    if values and unit != need:
        raise ValueError(f'`unit` in [limits] must be "{need}" {why}, got "{unit}".')
    arrays = {key: each(values, key, "[limits]", robot.n_actuators) for key in values}
    limits = Limits(**arrays)
    if np.greater(limits.q_min, limits.q_max).any():
        raise ValueError("`q_min` in [limits] must not exceed `q_max`; swap them.")
    return limits if log is None or unit == "m" else limits.scaled(log.q_factor)
