"""Sliders in three digits."""

from __future__ import annotations

import math

_DIGITS = 3
_STEPS = 100  # least number of them from one end to the other


class Scale:
    """The scale of a slider: its ends and values in three digits.

    A range that is small beside its values has more digits, so that it has a hundred steps.

    Parameters
    ----------
    low, high : float
        Limits of the actuator, in the unit of the slider.

    Attributes
    ----------
    low, high, step : float
        Ends and step of the slider.
    marks : tuple of two (float, str)
        The ends and their labels.
    """

    def __init__(self, low: float, high: float) -> None:
        self._limits = (low, high)
        largest = max(abs(low), abs(high)) or 1.0
        power = math.floor(math.log10(largest)) + 1 - _DIGITS
        if high > low:
            power = min(power, math.floor(math.log10((high - low) / _STEPS)))
        self._decimals = -power
        self.step = 10.0**power
        self.low = self._rounded(low)
        self.high = max(self._rounded(high), self._rounded(self.low + self.step))
        self.marks = ((self.low, self._label(self.low)), (self.high, self._label(self.high)))

    def shown(self, value: float) -> float:
        """Return where the slider stands for a value of the actuator."""
        return min(max(self._rounded(value), self.low), self.high)

    def meant(self, value: float) -> float:
        """Return the value of the actuator where the slider stands; its ends are the limits."""
        if value <= self.low:
            return self._limits[0]
        if value >= self.high:
            return self._limits[1]
        return value

    def _rounded(self, value: float) -> float:
        return round(value, self._decimals)

    def _label(self, value: float) -> str:
        return f"{value:.{max(self._decimals, 0)}f}"
