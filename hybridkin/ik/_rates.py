"""Rates of the law of a step, of its feedback and its posture, and the way to a stop."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.arrays import number
from hybridkin._core.kernel_numbers import IK_BRAKED


class Rate(NamedTuple):
    """A rate of decay [1/s]: the fraction that one period removes is at most 1."""

    name: str
    per_second: float
    given: bool = True  # a rate that nobody gave follows the period

    @classmethod
    def of(cls, value: object, name: str, usual: float) -> Rate:
        """Return the rate that an argument gives; None gives the usual one."""
        if value is None:
            return cls(name, usual, given=False)
        return cls(name, number(value, name))

    def fraction(self, seconds: float) -> float:
        """Return the fraction that a period removes."""
        fraction = self.per_second * seconds
        if self.given and not fraction <= 1.0 + 1e-9:
            raise ValueError(
                f"`{self.name}` times the period must be at most 1, got "
                f"{self.per_second:.6g} 1/s x {seconds:.6g} s; use a {self.name} up to "
                f"{1.0 / seconds:.4g} 1/s or a shorter period."
            )
        return min(fraction, 1.0)

    def __repr__(self) -> str:
        """Return the argument that gives this rate."""
        return repr(self.per_second) if self.given else "None"


def gain_of(value: object) -> Rate:
    """Return the feedback gain; without one the whole error is removed in one period."""
    gain = Rate.of(value, "gain", math.inf)
    if not gain.per_second > 0.0:
        raise ValueError(f"`gain` must be positive [1/s], got {gain.per_second!r}.")
    return gain


def beta_of(value: object) -> Rate:
    """Return the rate of the posture; without one it is 1 per second."""
    beta = Rate.of(value, "beta", 1.0)
    if not beta.per_second >= 0.0:
        raise ValueError(f"`beta` must not be negative [1/s], got {beta.per_second!r}.")
    return beta


def stopping(way: Tensor, change: Tensor) -> Tensor:
    """Return the largest first step for which steps that shrink by `change` stop within `way`."""
    n_changes = way.clamp_min(0.0) / change
    stops = way / (0.5 + 0.5 * (1.0 + 2.0 * n_changes).sqrt())
    return torch.where((way > 0.0) & torch.isfinite(way), stops, way)


def places_to_stop() -> list[float]:
    """Return after how many periods a way to a stop is looked at: 1, ..., 16, 18, ...

    The later ones are an eighth apart.
    """
    places = [1.0]
    while len(places) < IK_BRAKED:
        places.append(places[-1] + max(1.0, places[-1] // 8.0))
    return places


def way_to_stop(dq: Tensor, change: Tensor, periods: float = math.inf) -> Tensor:
    """Return what follows steps dq (N, n) when every actuator stops, (N, n), or in some periods.

    Every step is then shorter by `change`, until it is zero; infinite: nothing follows.
    """
    size = dq.abs()
    n_steps = torch.floor(size / change).clamp_max(periods)
    n_steps = torch.where(torch.isfinite(n_steps), n_steps, 0.0)
    less = 0.5 * n_steps * (n_steps + 1.0) * change
    way = n_steps * size - torch.where(n_steps > 0.0, less, 0.0)
    return torch.copysign(way, dq)
