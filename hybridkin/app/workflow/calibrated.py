"""The result of a calibration, parameter by parameter, and what in it contradicts a ruler."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridkin import CalibrationResult, Chain
from hybridkin.app.workflow.report import Report, millimetres
from hybridkin.formats import LogUnit

IDENTIFIED = 10.0
"""A parameter is identified by the data if they narrow its prior at least this many times, and if
it and the others of its kind stay physical."""

_Unit = tuple[float, str]  # factor from SI, and name
_MILLIMETRES: _Unit = (1e3, "mm")
_DEGREES: _Unit = (180.0 / np.pi, "deg")
_SHOWN = {"m": _MILLIMETRES, "rad": _DEGREES, "m²/rad²": (1e6, "mm²/rad²")}
_PER_UNIT = "/unit of q"
_SIZES = ("radii", "lengths", "gain", "gains")
_RESOLVED = ("mm", "deg", "-")  # two decimals are enough
_FAR = 0.15  # of a size; more than the error of a ruler
# [deg]
_TURN = 30.0
_TILT = 45.0


@dataclass(frozen=True)
class CalibratedParameter:
    """One free parameter of a calibration.

    Attributes
    ----------
    name : str
        As in `CalibrationResult.names`.
    unit : str
        "mm", "deg", "mm²/rad²", "-" or another one, for gains e.g. "mm/counts".
    start, value, std_error : float
        Before and after the calibration, in that unit; of the base its rotation from the start and
        its position.
    narrowing : float
        How many times the data narrow the prior.
    physical : bool
        Whether this parameter and the others of its kind have possible values.
    identified : bool
        Whether the data determine it.
    alone : bool
        Whether they do so without the value of another parameter.
    """

    name: str
    unit: str
    start: float
    value: float
    std_error: float
    narrowing: float
    physical: bool
    identified: bool
    alone: bool

    @property
    def answer(self) -> str:
        """Whether the data determine it, in words."""
        if not self.physical:
            return "not physical"
        if not self.identified:
            return "no"
        return "yes" if self.alone else "not alone"

    def digits(self, number: float) -> str:
        """Return a number in the unit of the parameter, to what a ruler or a gauge resolves."""
        if self.unit in _RESOLVED:
            return f"{number:.2f}"
        return f"{number:.3g}"

    def checked(self, others: Sequence[CalibratedParameter]) -> CalibratedParameter:
        """Return the parameter, not identified where other calibrations contradict it.

        They contradict it if they change its value by more than a tenth of its prior.
        """
        prior = self.narrowing * self.std_error
        largest = 0.0
        for other in others:
            if other.name == self.name:
                change = abs(other.value - self.value)
                if self.unit == "deg":
                    change = min(change, abs(360.0 - change))  # angles repeat
                largest = max(largest, change)
        agrees = bool(IDENTIFIED * largest <= prior)
        return replace(self, identified=self.identified and agrees)


def calibrated_parameters(
    start: Chain, result: CalibrationResult, q_unit: LogUnit
) -> list[CalibratedParameter]:
    """Return the free parameters of a calibration from `start`, in the order of its `names`.

    Gains and zeros are shown in the unit of the log.
    """
    labels = zip(result.names, result.narrowing.tolist(), strict=True)
    parameters = []
    for name in result.values:
        physical = name not in result.unphysical
        before, after = _before_and_after(start, result.chain, name)
        errors = np.ravel(result.std_errors[name])
        for k, std_error in enumerate(errors):
            label, narrowing = next(labels)
            scale, unit = _unit(start, name, k, q_unit)
            parameters.append(
                CalibratedParameter(
                    name=label,
                    unit=unit,
                    start=scale * before[k],
                    value=scale * after[k],
                    std_error=scale * std_error,
                    narrowing=narrowing,
                    physical=physical,
                    identified=physical and narrowing >= IDENTIFIED,
                    alone=label not in result.together,
                )
            )
    return parameters


def _before_and_after(start: Chain, chain: Chain, name: str) -> tuple[NDArray, NDArray]:
    """Return the numbers (k,) of a parameter before and after its calibration."""
    before = _shown_value(start, start, name)
    calibrated = _shown_value(start, chain, name)
    if name != "base":
        return before, calibrated
    turn = Rotation.from_matrix(calibrated[:3, :3] @ before[:3, :3].T).as_rotvec()
    return np.append(np.zeros(3), before[:3, 3]), np.append(turn, calibrated[:3, 3])


def _shown_value(start: Chain, chain: Chain, name: str) -> NDArray:
    """Return the numbers (k,) of a chain that `calibrate` shows of a parameter; of the base all."""
    part = start.part_of(name)
    entry = chain.geometry()[part.entry].numpy(force=True)
    if name == "base":
        return entry
    return entry.ravel()[part.shown]


def _unit(start: Chain, name: str, k: int, q_unit: LogUnit) -> _Unit:
    """Return the unit of the k-th number of a parameter."""
    if name == "base" and k < 3:
        return _DEGREES
    unit = start.unit_of(name)
    if unit.endswith(_PER_UNIT):
        of_what = unit.removesuffix(_PER_UNIT)
        scale, symbol = _SHOWN.get(of_what, (1.0, of_what))
        return scale * q_unit.size, f"{symbol}/{q_unit.name}"
    if unit == "unit of q":
        return 1.0 / q_unit.size, q_unit.name
    return _SHOWN.get(unit, (1.0, unit))


def write_parameters(report: Report, parameters: Sequence[CalibratedParameter]) -> None:
    """Add a table of calibrated parameters to a report."""
    rows = []
    for parameter in parameters:
        rows.append(
            [
                f"{parameter.name} [{parameter.unit}]",
                parameter.digits(parameter.start),
                parameter.digits(parameter.value),
                parameter.digits(parameter.std_error),
                f"{parameter.narrowing:.3g}",
                parameter.answer,
            ]
        )
    header = "parameter,start,calibrated,standard error,prior narrowed by,identified"
    report.table(header.split(","), rows)


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a fit reports of a calibration: its free parameters, and what is not identified."""

    rmse: float
    unidentified: Sequence[str]
    warnings: Sequence[str]
    entries: Sequence[CalibratedParameter]

    @classmethod
    def of(
        cls,
        start: Chain,
        result: CalibrationResult,
        q_unit: LogUnit,
        warnings: Sequence[str] = (),
        others: Sequence[CalibratedParameter] = (),
    ) -> Calibration:
        """Return the calibration of `start`; `others` are of sets with nearly the same errors."""
        entries = []
        for parameter in calibrated_parameters(start, result, q_unit):
            entries.append(parameter.checked(others))
        return cls(
            rmse=result.rmse,
            unidentified=[q_unit.named_in(text) for text in result.unidentified],
            warnings=warnings,
            entries=entries,
        )

    def write(self, report: Report) -> None:
        """Add the calibration, and what the log does not identify, to a report."""
        report.text(
            f"Root mean square tip error {millimetres(self.rmse, '.2f')} (training rows). Standard "
            "errors assume independent rows and are too small for rows close in time. A parameter "
            f"is identified if the data narrow its prior at least {IDENTIFIED:.0f} times, and if "
            "sets of parameters with nearly the same errors give values that differ by less than a "
            'tenth of the prior; other values are assumptions. "Not alone": it takes part in a '
            'direction below that the log does not identify. "Not physical": this parameter, or '
            "another of its kind, has an impossible value, because it compensates an effect that "
            "the model does not describe. The base is given by its rotation from the start and its "
            "position.",
        )
        write_parameters(report, self.entries)
        for message in self.warnings:
            report.text("Warning: {message}", message=message)
        if self.unidentified:
            report.text("What the log does not identify:")
            report.items(self.unidentified)


def deviations(start: Chain, result: CalibrationResult, q_unit: LogUnit) -> Iterator[str]:
    """Yield what the calibration moved far from the description, and what else may be wrong."""
    far = []
    for parameter in calibrated_parameters(start, result, q_unit):
        is_size = parameter.name.partition("[")[0] in _SIZES and parameter.physical
        if is_size and abs(parameter.value / parameter.start - 1.0) > _FAR:
            far.append(
                f"{parameter.name} from {parameter.start:.4g} to {parameter.value:.4g} "
                f"{parameter.unit}"
            )
    if far:
        yield (
            f"the calibration moved {', '.join(far)}: if a ruler contradicts, `gain`, "
            "`spool_radius` or `routing` may be wrong, the marker is not at the tip, or tendons "
            "are slack."
        )
    if "turns" in result.values or "angles" in result.values:
        before = start.geometry()["angles"]
        after = result.chain.geometry()["angles"]
        change = (after - before).numpy(force=True)
        turned = (change - change[0] + np.pi) % (2.0 * np.pi) - np.pi
        most = np.degrees(np.abs(turned).max())
        if most > _TURN:
            yield (
                f"the calibration turned actuators by up to {most:.0f} degrees about the backbone "
                "relative to the first: if they are not attached so, `angle_deg`, `clockwise`, or "
                "the order or signs of the columns of q may be wrong."
            )
    cosine = float(start.base[:3, 2] @ result.chain.base[:3, 2])
    tilt = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    if tilt > _TILT and start.actuator_layout.tendons.any():
        yield (
            f"the calibrated base is tilted by {tilt:.0f} degrees from the description: a wrong "
            "sign of all tendons, which turns the base by 180 degrees about its axis, is then not "
            "noticed. Check `q_sign` by pulling a tendon, or describe the mounting in [base]."
        )
