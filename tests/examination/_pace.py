"""How the time of equal pieces of work changes in a long run."""

from __future__ import annotations

import math
import time

import numpy as np

FEW = 4  # pieces, at least, at each end


class Pace:
    """The CPU time of equal pieces of work, and its ratio to that of a fixed piece beside each.

    A busy machine slows both, so that the ratio shows what the work itself has become.
    """

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.ratios: list[float] = []

    def add(self, seconds: float) -> None:
        """Note the time of a piece that has just ended."""
        self.seconds.append(seconds)
        self.ratios.append(seconds / fixed_work())

    def slowdown(self) -> float:
        """Return the last tenth of the ratios over the first, each as its lower quartile.

        It is NaN, which is below no bound, if the ends would overlap.
        """
        n = max(FEW, len(self.ratios) // 10)
        if len(self.ratios) < 2 * n:
            return math.nan
        first, last = np.quantile([self.ratios[:n], self.ratios[-n:]], 0.25, axis=1)
        return float(last / first)

    def is_steady(self) -> bool:
        """Return whether the slowdown counts as none: few times are noisy."""
        return self.slowdown() < (1.25 if len(self.ratios) >= 1000 else 1.6)


def fixed_work() -> float:
    """Return the CPU time [s] of small steps of NumPy, a few milliseconds."""
    row = np.linspace(0.0, 1.0, 9)
    start = time.process_time()
    for _ in range(2000):
        row = np.sin(row) + 0.1
    return time.process_time() - start
