"""Start of the least squares of a calibration: the best of rough fits from several guesses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin.calibration._initial_guesses import Guess, initial_guesses
from hybridkin.calibration._least_squares import ROUGH, Fit, Rows, solve
from hybridkin.calibration._parameters import Problem
from hybridkin.chains.chain import Chain
from hybridkin.chains.constant_curvature import ConstantCurvatureChain
from hybridkin.chains.elastic_tendons import ElasticTendonChain

_WIDEST = 1e6  # a prior of a million natural units has no effect, and is finite
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
    bounds: Mapping[str, tuple[float, float]],
    prior: Mapping[str, float],
) -> Start:
    """Return the best start of a fit of the parameters with these names."""
    stds = {name: min(std, _WIDEST) for name, std in prior.items()}
    with torch.no_grad():
        guesses = initial_guesses(chain, rows, names)
    problems = [Problem.of(guess.chain, names, bounds, stds) for guess in guesses]
    thetas = [
        problem.start(g.scale) for problem, g in zip(problems, guesses, strict=True)
    ]
    if len(guesses) == 1:
        return Start(problems[0], thetas[0])
    pairs = zip(problems, thetas, strict=True)
    fits = [solve(problem, rows, theta, loss, ROUGH) for problem, theta in pairs]
    best, message = _best(fits, guesses, bool({"angles", "turns"} & {*names}))
    return Start(best.problem, best.theta, message)


def widened(
    start: Start,
    names: tuple[str, ...],
    prior: Mapping[str, float],
    elastic: bool = False,
) -> Start:
    """Return the start of a fit of more parameters, or of elastic tendons, from another start."""
    chain = start.problem.chain
    if elastic and isinstance(chain, ConstantCurvatureChain):
        chain = ElasticTendonChain.from_chain(chain)
    problem = Problem.of(chain, names, {}, prior)
    pairs = zip(start.problem.parameters, start.problem.parts(start.theta), strict=True)
    values = {part.name: theta for part, theta in pairs}
    theta = [values.get(part.name, np.zeros(part.size)) for part in problem.parameters]
    return Start(problem, np.concatenate(theta), start.message)


def _best(
    fits: list[Fit], guesses: list[Guess], free_angles: bool
) -> tuple[Fit, str | None]:
    """Return the best fit, and a warning if it is a mirror image although no angles are free.

    Among equal fits the first is taken; a mirror image is taken only if it is clearly better.
    """
    best = fits[0]
    image = None
    for fit, guess in zip(fits[1:], guesses[1:], strict=True):
        if not any(guess.mirrored):
            if fit.rmse < _EQUAL * best.rmse:
                best = fit
        elif image is None or fit.rmse < image.rmse:
            image = fit
    if (
        image is None
        or image.rmse >= (_BETTER if free_angles else _FAR_BETTER) * best.rmse
    ):
        return best, None
    if free_angles:
        return image, None
    return image, (
        f"the actuators run in the opposite direction to `chain`: its mirror image has an error of "
        f"{1e3 * image.rmse:.3g} mm rms, the given chain {1e3 * best.rmse:.3g} mm. The mirror "
        "image is returned; negate `angles` of the chain, or list 'turns' in `parameters`."
    )
