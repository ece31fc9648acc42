"""Start of the least squares of a calibration: the best of rough fits from several guesses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin.calibration._initial_guesses import Guess, initial_guesses
from hybridkin.calibration._least_squares import ROUGH, Fit, Rows, solve
from hybridkin.calibration._parameters import Problem
from hybridkin.calibration.natural_scales import GEOMETRY
from hybridkin.chains.chain import Chain

_EQUAL = 1.0 - 1e-4  # among guesses with nearly equal errors the given chain is taken
_BETTER = 0.8  # a mirror image must lower the error to this fraction,
_FAR_BETTER = 0.5  # and to this fraction if no angles are free


class Start(NamedTuple):
    """Result of a rough search, and a warning if the robot is mirrored."""

    problem: Problem
    theta: NDArray
    message: str | None = None


def search(
    chain: Chain,
    rows: Rows,
    names: tuple[str, ...],
    loss: str,
    prior: float = GEOMETRY,
) -> Start:
    """Return the best start of a fit of the parameters with these names."""
    with torch.no_grad():
        guesses = initial_guesses(chain, rows, names)
    starts = []
    for guess in guesses:
        problem = Problem.of(guess.chain, names, prior)
        starts.append(Start(problem, problem.start(guess.scale)))
    if len(starts) == 1:
        return starts[0]
    fits = [solve(start.problem, rows, start.theta, loss, ROUGH) for start in starts]
    free_angles = "angles" in names or "turns" in names
    return _best(fits, guesses, free_angles)


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
    return Start(problem, theta, start.message)


def _best(fits: list[Fit], guesses: list[Guess], free_angles: bool) -> Start:
    """Return the best fit, with a warning if it is a mirror image although no angles are free.

    Among equal fits the first is taken; a mirror image is taken only if it is clearly better.
    """
    best = fits[0]
    image = None
    for fit, guess in zip(fits[1:], guesses[1:], strict=True):
        if not guess.mirrored:
            if fit.rmse < _EQUAL * best.rmse:
                best = fit
        elif image is None or fit.rmse < image.rmse:
            image = fit
    better = _BETTER if free_angles else _FAR_BETTER
    if image is None or image.rmse >= better * best.rmse:
        return Start(best.problem, best.theta)
    message = None
    if not free_angles:
        message = (
            "the actuators run in the opposite direction to `chain`: its mirror image has an "
            f"error of {1e3 * image.rmse:.3g} mm rms, the given chain {1e3 * best.rmse:.3g} mm. "
            "The mirror image is returned; negate `angles` of the chain, or list 'turns' in "
            "`parameters`."
        )
    return Start(image.problem, image.theta, message)
