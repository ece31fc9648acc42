"""Units of length and angle, and warnings if numbers seem to be in another unit."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:  # the command line imports this module without loading torch
    from torch import Tensor

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
"""Metres per unit, for the units of length that logs, paths and options accept."""

UNITS = {**METRES, "rad": 1.0, "deg": math.pi / 180, "1": 1.0}
"""Metres or radians per unit of actuators; "1" keeps the values as they are."""


class LogUnit(NamedTuple):
    """The unit of the actuators in the files of a robot, for texts."""

    name: str  # "mm" in place of "m"
    size: float  # in the unit of q of the model: metres, radians, or one

    @classmethod
    def of(cls, q_unit: str) -> LogUnit:
        """Return the unit that a log names; "1" is one without a name."""
        if q_unit in ("m", "1"):
            return {"m": cls("mm", METRES["mm"]), "1": cls("(unit of q)", 1.0)}[q_unit]
        return cls(q_unit, UNITS.get(q_unit, 1.0))

    def in_words(self, change: float) -> str:
        """Return a change of q in this unit."""
        return f"{change / self.size:.3g} {self.name}"

    def named_in(self, text: str) -> str:
        """Return a text with the name of this unit for "unit of q", where q has no other unit."""
        if self.size != 1.0 or self.name.startswith("("):
            return text
        return text.replace("unit of q", self.name)


SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds per unit, for the units of time that logs accept beside frames."""

FRAMES = "frames"
"""The unit of times that count frames; their rate is given besides."""

LONGEST_PULL = 4.0
"""Largest plausible tendon displacement, in backbone lengths."""

_TURNS = 4.0 * math.pi  # [rad]; larger joint angles are more likely in degrees
_SPANS = 10.0  # tips span at most 2 robot lengths; in millimetres it would be 2000
_MOVED = 20.0  # times what a model predicts, tips move only in another unit
_NEAR = 3.0  # a ratio of sizes this near to that of a unit names the unit
_MOVES = 0.2  # of a robot; a smaller span that a model predicts can be rest


class Unit(NamedTuple):
    """A unit in which numbers seem to be, where metres or radians are needed."""

    name: str
    symbol: str
    ratio: float  # of numbers in it to metres or radians
    way_out: str

    @property
    def in_words(self) -> str:
        """What numbers look like, and the way out."""
        return f"{self.name}: {self.way_out}"


_CENTIMETRES = Unit("centimetres", "cm", 100.0, "divide by 100")
_INCHES = Unit("inches", "in", 1.0 / METRES["in"], "divide by 39.37")
_LARGE = (
    Unit("millimetres", "mm", 1000.0, "divide by 1000"),
    Unit("micrometres", "um", 1e6, "divide by 1e6"),
)
_KILOMETRES = Unit("kilometres", "km", 1e-3, "multiply by 1000")
# Of rough ratios up to 170.
_BOTH = Unit("centimetres or inches", "cm", 30.0, "divide by 100, or by 39.37")
_DEGREES = Unit("degrees", "deg", 180.0 / math.pi, "take numpy.radians of them")


_DURATIONS = (  # seconds from which a name is used, and seconds per unit of that name
    (0.0, 1e-6, "us"),
    (1e-3, 1e-3, "ms"),
    (1.0, 1.0, "s"),
    (180.0, 60.0, "min"),
    (3.0 * 3600.0, 3600.0, "h"),
    (72.0 * 3600.0, 86400.0, "days"),
)
_YEAR = 365.25 * 86400.0  # [s]


def duration_in_words(seconds: float) -> str:
    """Return a duration [s] in a unit that reads well; more than a year is doubted."""
    if seconds == 0.0:
        return "0 s"
    if seconds > _YEAR:
        return f"{seconds:.3g} s ({seconds / _YEAR:.3g} years: are these seconds?)"
    for least, unit, name in reversed(_DURATIONS):
        if abs(seconds) >= least:
            return f"{seconds / unit:.4g} {name}"
    return f"{seconds:.4g} s"


def _nearest(ratio: float, *units: Unit) -> Unit:
    return min(units, key=lambda unit: abs(math.log(ratio / unit.ratio)))


def rough_unit(ratio: float) -> Unit:
    """Return the unit of lengths that are about `ratio` times too large; `ratio` is a guess."""
    return _nearest(ratio, _BOTH, *_LARGE)


def other_unit(ratio: float, *, angle: bool = False) -> Unit | None:
    """Return the unit of numbers that are `ratio` times as large as known ones, None if none fits.

    Parameters
    ----------
    ratio : float
        Size of the numbers, over the size of a like motion in metres or radians.
    angle : bool, default=False
        Whether the numbers are angles.
    """
    if not 0.0 < ratio < math.inf:
        return None
    units = (_CENTIMETRES, _INCHES, *_LARGE, _KILOMETRES)
    if angle:
        units = (_DEGREES,)
    unit = _nearest(ratio, *units)
    off = abs(math.log(ratio / unit.ratio))
    return unit if off < math.log(_NEAR) else None


def span_message(
    name: str, tips: Tensor, reach: float, spans: float = _SPANS, usual: float = 0.0
) -> str | None:
    """Return a warning if tips (N, 3) span more than `spans` times the reach of the robot.

    `usual` is the span that a model predicts, if it moves [m].
    """
    span = _span(tips)
    if span <= spans * reach:
        return None
    unit = rough_unit(span / reach)
    if usual > _MOVES * reach:
        unit = other_unit(span / usual)
    looks = "check its unit"
    if unit is not None:
        looks = f"this looks like {unit.in_words}, or read the log with x_unit='{unit.symbol}'"
    return (
        f"`{name}` spans {span:.4g} m, but the robot is only {reach:.3g} m long; hybridkin works "
        f"in metres: {looks}."
    )


def motion_message(name: str, tips: Tensor, predicted: Tensor, reach: float) -> str | None:
    """Return a warning if tips (N, 3) span 20 times what a model predicts, and two reaches."""
    usual = _span(predicted)
    spans = min(_SPANS, max(2.0, _MOVED * usual / reach))
    return span_message(name, tips, reach, spans, usual)


def _span(tips: Tensor) -> float:
    """Return the largest side of the box around tips (N, 3) [m]."""
    sides = tips.amax(dim=0) - tips.amin(dim=0)
    return float(sides.detach().max())


def length_message(name: str, value: Tensor, limit: float, usual: Tensor | float) -> str | None:
    """Return a warning if lengths are too large to be metres; `usual` are usual ones [m]."""
    if not (value > limit).any():
        return None
    place = value.argmax()
    largest = float(value.flatten()[place])
    known = (value.new_ones(value.shape) * usual).flatten()[place]
    unit = rough_unit(largest / float(known))
    looks = f"which looks like {unit.name}; hybridkin works in metres"
    return f"`{name}` reaches {largest:.4g}, {looks}: {unit.way_out}."


def warn_length(name: str, value: Tensor, limit: float, usual: float) -> None:
    """Warn if lengths are too large to be metres."""
    message = length_message(name, value, limit, usual)
    if message is not None:
        warnings.warn(message, stacklevel=3)


def degrees_message(name: str, turns: Tensor, factor: float = 1.0) -> str | None:
    """Return a warning if joint angles are too large to be radians."""
    if not (turns > factor * _TURNS).any():
        return None
    return (
        f"`{name}` reaches {float(turns.max()):.4g} on a revolute joint, which looks like degrees; "
        "hybridkin works in radians: give numpy.radians of it."
    )
