"""Actuators that count in the opposite direction to the chain: a guess from measured tips."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from hybridkin._core.simplest import simplest_within
from hybridkin.calibration._initial_guesses import aligned
from hybridkin.calibration._least_squares import COMPARED, TipRows, solve
from hybridkin.calibration._parameters import Problem
from hybridkin.calibration.measured import evenly_spaced, points
from hybridkin.chains.chain import Chain

_ROWS = 100  # enough to compare signs
_ENOUGH = 1.5  # coordinates for each free number; with fewer, wrong signs may fit as well
_EXPLAINED = 0.02  # of the motion of the tips: with this error the given signs are right
_FAR_BETTER = 0.5  # other signs must lower the error to this fraction,
_LEFT = 0.25  # and to this part of the motion of the tips
_MANY = 8  # of more actuators, at most three are reversed
_MOST_OF_MANY = 3
_FITTED = 12  # the most likely signs, by the alignment of the tips alone
_EQUAL = 0.1  # of errors: the fewest reversed actuators are taken
# What is fitted for each set of signs, as far as a chain has it.
_FREE = ("base", "tool", "joint_zeros")


def with_likely_signs(
    chain: Chain, rows: TipRows, free_base: bool
) -> tuple[Chain, tuple[str, ...]]:
    """Return the chain with those actuators reversed that count in the opposite direction.

    They are reversed only if the tips then fit clearly better. A warning says so; there is
    none if nothing is reversed.
    """
    names = tuple(name for name in _FREE if free_base or name != "base")
    measured = rows.measured
    few = measured.take(evenly_spaced(len(measured.q), _ROWS))
    tips = points(few.x.numpy())[few.seen]
    n_free = len(Problem.of(chain, names).low)
    if tips.size < _ENOUGH * n_free:
        return chain, ()
    motion = float(np.sqrt(np.square(tips - tips.mean(axis=0)).sum(axis=1).mean()))

    def placed(reversed_ones: tuple[int, ...]) -> Chain:
        arm = chain.with_reversed(reversed_ones)
        return aligned(arm, few) if free_base else arm

    def error(reversed_ones: tuple[int, ...]) -> float:
        problem = Problem.of(placed(reversed_ones), names)
        return solve(problem, few, np.zeros(len(problem.low)), "linear", COMPARED).rmse

    as_given = error(())
    if as_given <= _EXPLAINED * motion:
        return chain, ()
    ways = sorted(_ways(chain.reversible), key=lambda way: few.rmse(placed(way)))
    likely = sorted(ways[:_FITTED], key=len)
    errors = [error(way) for way in likely]
    best = simplest_within(errors, _EQUAL)
    if errors[best] > min(_FAR_BETTER * as_given, _LEFT * motion):
        return chain, ()
    message = _message(likely[best], errors[best], as_given)
    return chain.with_reversed(likely[best]), (message,)


def _ways(actuators: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Yield sets of actuators to reverse, at least one of them."""
    most = len(actuators) if len(actuators) <= _MANY else _MOST_OF_MANY
    for n_reversed in range(1, most + 1):
        yield from combinations(actuators, n_reversed)


def _message(actuators: tuple[int, ...], error: float, as_given: float) -> str:
    columns = ", ".join(f"q[{k}]" for k in actuators)
    return (
        f"actuators run in the opposite direction to `chain`: with the sign of {columns} flipped, "
        f"base, tool and zeros leave an error of {1e3 * error:.3g} mm rms, with the given signs "
        f"{1e3 * as_given:.3g} mm. The chain with these actuators reversed is returned; negate "
        "these columns of `q` and of the `couplings` of the chain."
    )
