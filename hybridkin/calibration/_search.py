"""Start of the least squares of a calibration: the best of rough fits from several guesses."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin._core.model import ZeroModel
from hybridkin.calibration._initial_guesses import Guess, initial_guesses
from hybridkin.calibration._least_squares import ROUGH, Accuracy, Fit, TipRows, solve
from hybridkin.calibration._parameters import Problem
from hybridkin.calibration._signs import with_likely_signs
from hybridkin.calibration.natural_scales import GEOMETRY
from hybridkin.chains.chain import Chain

_EQUAL = 1.0 - 1e-4  # among guesses with nearly equal errors the given chain is taken
_BETTER = 0.8  # a mirror image must lower the error to this fraction,
_FAR_BETTER = 0.5  # and to this fraction if no angles are free


class Start(NamedTuple):
    """Result of a rough search, and a warning if the robot is mirrored."""

    problem: Problem
    theta: NDArray
    messages: tuple[str, ...] = ()

    @classmethod
    def fixed(cls, chain: Chain) -> Start:
        """Return the start of a fit of no parameters."""
        return cls(Problem.of(chain, ()), np.empty(0))

    @property
    def n_free(self) -> int:
        """Number of free numbers."""
        return self.theta.size

    def fitted(self, rows: TipRows, loss: str, accuracy: Accuracy) -> Chain:
        """Return the chain of a fit to rows; the chain itself if nothing is free."""
        if not self.n_free:
            return self.problem.chain
        return solve(self.problem, rows, self.theta, loss, accuracy).chain()


_NO_CHAIN = cast(Chain, ZeroModel(0, 0))
NO_START = Start.fixed(_NO_CHAIN)
"""No start of any fit."""


def search(
    chain: Chain,
    rows: TipRows,
    names: tuple[str, ...],
    loss: str,
    prior: float = GEOMETRY,
) -> Start:
    """Return the best start of a fit of the parameters with these names."""
    messages = ()
    free_base = "base" in names
    if chain.reversible and (free_base or "gains" in names):
        chain, messages = with_likely_signs(chain, rows, free_base)
    with torch.no_grad():
        guesses = initial_guesses(chain, rows.measured, names)
    starts = []
    for guess in guesses:
        problem = Problem.of(guess.chain, names, prior)
        starts.append(Start(problem, problem.start(guess.scale), messages))
    if len(starts) == 1:
        return starts[0]
    fits = [solve(start.problem, rows, start.theta, loss, ROUGH) for start in starts]
    free_angles = "angles" in names or "turns" in names
    best = _best(fits, guesses, free_angles)
    return best._replace(messages=messages + best.messages)


def widened(
    start: Start,
    names: tuple[str, ...],
    elastic: bool = False,
) -> Start:
    """Return the start of a fit of more parameters, or of elastic tendons, from another start."""
    chain = start.problem.chain
    if elastic:
        chain = chain.with_elastic_tendons()
    problem = Problem.of(chain, names)
    values = {}
    for part, place in start.problem.places():
        values[part.name] = start.theta[place]
    theta = np.zeros(len(problem.prior_std))
    for part, place in problem.places():
        theta[place] = values.get(part.name, 0.0)
    return Start(problem, theta, start.messages)


def _best(fits: list[Fit], guesses: list[Guess], free_angles: bool) -> Start:
    """Return the best fit, with a warning if it is a mirror image although no angles are free.

    Among equal fits the first is taken; a mirror image is taken only if it is clearly better.
    """
    best = fits[0]
    images = []
    for fit, guess in zip(fits[1:], guesses[1:], strict=True):
        if guess.mirrored:
            images.append(fit)
        elif fit.rmse < _EQUAL * best.rmse:
            best = fit
    better = _BETTER if free_angles else _FAR_BETTER
    clearly_better = [fit for fit in images if fit.rmse < better * best.rmse]
    if not clearly_better:
        return Start(best.problem, best.theta)
    image = min(clearly_better, key=lambda fit: fit.rmse)
    messages = ()
    if not free_angles:
        messages = (
            "the actuators run in the opposite direction to `chain`: its mirror image has an "
            f"error of {1e3 * image.rmse:.3g} mm rms, the given chain {1e3 * best.rmse:.3g} mm. "
            "The mirror image is returned; negate `angles` of the chain, or list 'turns' in "
            "`parameters`.",
        )
    return Start(image.problem, image.theta, messages)
