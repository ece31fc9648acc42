"""Sentences about directions that calibration data do not identify: few parameters, advice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.directions import few_terms
from hybridkin.calibration._least_squares import Fit
from hybridkin.calibration._parameters import Problem

_N_TERMS = 6  # parameters in a sentence
_FAIR = 0.5  # of the largest entry: a parameter with more can be named first
_SMALL = 0.05  # of a step, or of the motion of the tips: not mentioned
_SLIGHT = 0.01  # of the largest motion of the tips by one parameter alone
_ALIKE = 0.02
_STILL = 1e-6  # [mm]
_NO_EFFECT = "does not move the tips"
_DETERMINED = 0.05  # largest standard error of the logarithm
_STEPS = {"m": (1e-3, "mm"), "rad": (np.pi / 180.0, "deg"), "-": (0.01, "%"), "q": (1.0, "of q")}


def sentences(fit: Fit, directions: NDArray, covariance: NDArray, n_rows: float) -> tuple[str, ...]:
    """Return a sentence for each direction that hardly moves the tips, in few parameters.

    `directions` (K, P) are orthonormal changes in units of the prior; `covariance` (P, P) is that
    of the free parameters.
    """
    problem = fit.problem
    units = np.concatenate([part.units for part in problem.parameters])
    steps = [_STEPS[kind] for part in problem.parameters for kind in part.kind]
    to_steps = problem.prior_std * units / np.array([size for size, _ in steps])
    columns = 1e3 * fit.jacobian * problem.prior_std / np.sqrt(n_rows)  # [mm] of tip
    found = []
    for move in few_terms(directions):
        # The first parameter with a fair share is named first and changes by one step.
        lead = int(np.argmax(np.abs(move) > _FAIR * np.abs(move).max()))
        move = move / (move[lead] * to_steps[lead])
        tips = float(np.linalg.norm(columns @ move))
        alone = np.abs(move) * np.linalg.norm(columns, axis=0)
        counts = alone > max(_SMALL * tips, _SLIGHT * alone.max(), _STILL)
        effect = f"moves the tips by {tips:.2g} mm rms" if tips >= _STILL else _NO_EFFECT
        terms = _terms(problem, move * to_steps, lead)
        shown = [term for term in terms if abs(term[1]) > _SMALL][:_N_TERMS]
        hidden = sum(counts[term[2]] for term in terms if term not in shown)
        words = [f"{label} {at:+.3g} {steps[i][1]}" for label, at, i in shown]
        rest = [", ".join(words[1:]), f"{hidden} smaller" if hidden else ""]
        moved = " with ".join(filter(None, [words[0], " and ".join(filter(None, rest))]))
        name_of = [part.name for part in problem.parameters for _ in part.labels]
        first, *others = [(label.removeprefix("all "), name_of[i], i) for label, _, i in shown]
        advice, known = f"leave {first[0]} out or measure it", ""
        if others:
            second = next((other for other in others if other[1] != first[1]), others[0])
            advice = f"leave out or measure {first[0]} or {second[0]}"
            known = _determined(fit, covariance, move * to_steps, first[2], second[2])
        found.append(f"{moved} {effect}: {advice}.{known}")
    return tuple(found)


def _determined(fit: Fit, covariance: NDArray, move: NDArray, i: int, j: int) -> str:
    """Return a sentence if the data identify the ratio or product of two parameters.

    They do if both change by the same factor and the standard error of the logarithm is small.
    """
    parts, labels, geometry = fit.problem.parameters, fit.problem.labels, fit.chain().geometry()
    kinds = [kind for part in parts for kind in part.kind]
    if not kinds[i] == kinds[j] == "-" or abs(abs(move[i]) - abs(move[j])) > _ALIKE * abs(move[i]):
        return ""
    i, j = sorted((i, j), key=labels.__getitem__)
    way = 1 if move[i] * move[j] > 0 else -1
    error = np.sqrt(covariance[i, i] + covariance[j, j] - 2 * way * covariance[i, j])
    values = [v for part in parts for v in part.value(geometry[part.entry]).flatten()[: part.size]]
    value = float(values[i] / values[j] ** way)
    what = f"{labels[i]} {'/' if way > 0 else '*'} {labels[j]}"
    shown = f" The data identify {what} = {value:.4g} (std. error {abs(value) * error:.2g})."
    return shown if error < _DETERMINED else ""


def _terms(problem: Problem, shown: NDArray, lead: int) -> list[tuple[str, float, int]]:
    """Return a change as (label, size, index): the leading one, then the largest first.

    Entries of one name that all change equally count as one.
    """
    terms, row = [], 0
    for part in problem.parameters:
        own = shown[row : row + part.size]
        alike = part.size > 1 and np.ptp(own) < _ALIKE * np.abs(own).max()
        for i, at in enumerate(own[:1] if alike else own):
            label = f"all {part.name}" if alike else part.labels[i]
            leads = row <= lead < row + part.size if alike else row + i == lead
            terms.append((not leads, -abs(at), (label, float(at), row + i)))
        row += part.size
    return [term for *_, term in sorted(terms)]
