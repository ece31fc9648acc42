"""The report on a model: geometry, training, domain, errors and the choices of its fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridkin._core.arrays import real_array
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.chain import Chain
from hybridkin.chains.robots import Limits, LogFormat
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.workflow.choices import AutoChoice, RadiusEntry
from hybridkin.workflow.errors import HeldOutErrors
from hybridkin.workflow.model import LoadedModel, play_widths
from hybridkin.workflow.report import Report, listed, millimetres, point_in_millimetres

_PER_TIME = {"dq_max": "/s", "ddq_max": "/s^2"}


@dataclass(frozen=True, eq=False)
class Segment:
    """A segment of a chain of arcs: sizes [m], angles [deg], and relative stiffnesses."""

    radius: float
    length: float | None  # None: extensible
    offset: float
    angles_deg: NDArray
    rest_bend_deg: NDArray
    gain: NDArray | None  # [m per unit of q]; None: q is in metres
    bending_stiffness: float | None
    axial_stiffness: float | None


@dataclass(frozen=True, eq=False)
class Base:
    """Position [m] and rotation vector [deg] of a base."""

    position: NDArray
    rotation_vector_deg: NDArray


@dataclass(frozen=True, eq=False)
class Geometry:
    """The geometry of a chain; what chains of arcs alone have is None or empty for others."""

    kind: str
    base: Base
    stage: str | None
    routing: str | None
    segments: Sequence[Segment]

    @classmethod
    def of(cls, chain: Chain) -> Geometry:
        """Return the geometry of a chain."""
        pose = real_array(chain.base, "base")
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec(degrees=True)
        base = Base(pose[:3, 3], turn)
        kind = type(chain).__name__
        if not isinstance(chain, ArcChain):
            return cls(kind, base, None, None, ())
        return cls(kind, base, chain.stage, chain.routing, _segments(chain))

    def _write(self, report: Report[Any]) -> None:
        """Add the geometry to a report."""
        words = self.kind
        if self.stage is not None:
            words += f", stage {self.stage}"
        if self.routing is not None:
            words += f", routing {self.routing}"
        report.text(f"Mechanical model: {words}.")
        rows = []
        for k, segment in enumerate(self.segments, start=1):
            length = "extensible"
            if segment.length is not None:
                length = f"{1e3 * segment.length:.2f}"
            rows.append(
                [
                    str(k),
                    f"{1e3 * segment.radius:.3f}",
                    length,
                    f"{1e3 * segment.offset:.2f}",
                    listed(segment.angles_deg, ".1f"),
                ]
            )
        if rows:
            sizes = ("segment", "radius [mm]", "length [mm]", "offset [mm]")
            report.table([*sizes, "actuators at [deg]"], rows)
        position = point_in_millimetres(self.base.position)
        turn = listed(self.base.rotation_vector_deg, ".1f")
        report.text(f"Base at {position}, rotation vector ({turn}) deg.")


def _segments(chain: ArcChain) -> list[Segment]:
    values = {name: real_array(value, name) for name, value in chain.geometry().items()}
    ends = np.cumsum(chain.actuators_per_segment)[:-1]
    n = len(values["radii"])
    lengths = iter(values.get("lengths", ()))
    angles = np.split(np.degrees(values["angles"]), ends)
    rest_bends = np.degrees(values["rest_bends"].reshape(-1, 2))
    gains = [None] * n if chain.in_metres else np.split(values["gains"], ends)
    stiffnesses = {}
    for name in ("bending_stiffness", "axial_stiffness"):
        stiffnesses[name] = values[name].ravel() if name in values else [None] * n
    segments = []
    for k in range(n):
        segments.append(
            Segment(
                radius=values["radii"][k],
                length=None if chain.extensible[k] else next(lengths),
                offset=values["offsets"][k],
                angles_deg=angles[k],
                rest_bend_deg=rest_bends[k],
                gain=gains[k],
                bending_stiffness=stiffnesses["bending_stiffness"][k],
                axial_stiffness=stiffnesses["axial_stiffness"][k],
            )
        )
    return segments


@dataclass(frozen=True)
class ErrorModelEntry:
    """The error model of a hybrid: its kind, coupling and guard, and what was calibrated."""

    kind: str
    coupling: str | None
    guard: str | None
    calibrated: Sequence[str]

    @classmethod
    def of(cls, model: HybridForwardModel, auto: AutoChoice | None) -> ErrorModelEntry:
        """Return the error model of a hybrid and its choices."""
        calibrated = [*(model.calibrate or ())]
        if isinstance(model.calibrate, str):
            calibrated = [model.calibrate]
        if auto is not None:
            calibrated = calibrated or [auto.taken]
            return cls(auto.in_short, None, model.guard, calibrated)
        kind = model._learned.kind or "none"
        return cls(kind, model.coupling, model.guard, calibrated)


@dataclass(frozen=True, eq=False)
class Description:
    """What a model is, in SI units and degrees; entries that are not known are None.

    Attributes
    ----------
    name, path, kind : str
        Name of the robot, file and class of the model.
    n_actuators : int
        Size of q.
    geometry : Geometry or None
        Its chain.
    error_model : ErrorModelEntry or None
        Its error model.
    play : list of float or None
        Backlash of every actuator [m].
    auto, radius
        The choices of "auto", and the estimated error radius.
    domain : Limits or None
        Training range.
    log_format : LogFormat or None
        Format of the robot's logs.
    limits : Limits or None
        Limits of its actuators.
    training : dict or None
        Notes of the fit in the file.
    created, versions
        When and by which packages the file was written.
    """

    name: str
    path: str
    kind: str
    n_actuators: int
    geometry: Geometry | None
    error_model: ErrorModelEntry | None
    play: list[float] | None
    auto: AutoChoice | None
    radius: RadiusEntry | None
    domain: Limits | None
    log_format: LogFormat | None
    limits: Limits | None
    training: dict[str, Any] | None
    created: str | None
    versions: dict[str, str] | None

    def _write(self, report: Report[Any], log_format: LogFormat) -> None:
        """Add the description to a report; ranges are in unit and sign of `log_format`."""
        if self.geometry is None:
            report.text("No mechanical model.")
        else:
            self.geometry._write(report)
        if self.error_model is not None:
            model = self.error_model
            parts = [model.kind, model.coupling, f"guard {model.guard or 'none'}"]
            report.text(f"Error model: {', '.join(filter(None, parts))}.")
        if self.radius is not None:
            report.text(self.radius.words)
        if self.play is not None:
            report.text(
                f"Backlash (play) of the actuators: {millimetres(max(self.play))}."
            )
        ranges = {"Training range": self.domain, "Limits": self.limits}
        for title, limits in ranges.items():
            if limits is not None:
                _write_limits(report, title, limits, log_format)
        if self.log_format is not None:
            log = self.log_format
            report.text(
                f"Logs: q in {log.q_unit}, q_sign {log.q_sign} ({', '.join(log.q)}), x in "
                f"{log.x_unit} ({', '.join(log.x)})."
            )
        self._write_training(report, self.training or {})

    def _write_training(self, report: Report[Any], training: dict[str, Any]) -> None:
        """Add the notes in the file; a model that was saved by hand may have few."""
        if "log" in training:
            rows = f"{training['rows']}"
            if training["n_whole"] != training["rows"]:
                rows += f" of {training['n_whole']}"
            report.text(
                f"Fitted to {training['log']}: {rows} rows, {training['n_motions']} motions. "
                f"Model: {training['saved']}, {training['chosen']}. Errors on held-out motions:"
            )
            errors = {}
            for name, entry in training["held_out"].items():
                errors[name] = HeldOutErrors.read(entry)
            report.errors(errors, ("mean", "p95", "max"))
        elif "rows" in training:
            report.text(f"Fitted to {training['rows']} rows.")
        if self.auto is not None:
            report.text(" ".join(self.auto.words))
        if self.versions is not None:
            words = [f"{name} {version}" for name, version in self.versions.items()]
            report.text(f"Saved on {self.created} by {', '.join(words)}.")


def describe(loaded: LoadedModel) -> Report[Description]:
    """Return a report on a model.

    Parameters
    ----------
    loaded : LoadedModel
        The model, as from `open_model`.

    Returns
    -------
    Report of Description
        Geometry, training, domain, errors and choices.
    """
    header = loaded.header or {}
    robot = loaded.description
    hybrid = loaded.hybrid
    kind = type(loaded.model).__name__
    auto = None if hybrid is None else AutoChoice.of(hybrid)
    record = Description(
        name=loaded.name,
        path=str(loaded.path),
        kind=kind,
        n_actuators=loaded.n_actuators,
        geometry=None if loaded.chain is None else Geometry.of(loaded.chain),
        error_model=None if hybrid is None else ErrorModelEntry.of(hybrid, auto),
        play=play_widths(hybrid),
        auto=auto,
        radius=RadiusEntry.of(hybrid),
        domain=loaded.trained_range,
        log_format=None if robot is None else robot.log,
        limits=None if robot is None else robot.limits,
        training=header.get("training"),
        created=header.get("created"),
        versions=header.get("versions"),
    )
    report = Report(f"{loaded.name}: {kind}, {loaded.n_actuators} actuators", record)
    in_metres = isinstance(loaded.chain, ArcChain) and loaded.chain.in_metres
    log_format = record.log_format or LogFormat((), (), "mm" if in_metres else "1")
    record._write(report, log_format)
    return report


def _write_limits(
    report: Report[Any], title: str, limits: Limits, log_format: LogFormat
) -> None:
    """Add limits in the unit and sign of the logs."""
    unit = "" if log_format.q_unit == "1" else f" {log_format.q_unit}"
    for name, values in vars(limits.scaled(1 / log_format.q_factor)).items():
        if values is not None:
            numbers = listed(values, ".4g")
            per_time = _PER_TIME.get(name, "")
            report.text(f"{title}: {name} = {numbers}{unit}{per_time}.")
