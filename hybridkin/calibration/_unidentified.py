"""Sentences about directions that calibration data do not identify: few parameters, advice."""

from __future__ import annotations

from typing import NamedTuple

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
_STEPS = {
    "m": (1e-3, "mm"),
    "rad": (np.pi / 180.0, "deg"),
    "-": (0.01, "%"),
    "q": (1.0, "of q"),
}


class _Term(NamedTuple):
    """A part of a direction: one free direction, or all of a parameter that change equally."""

    label: str
    size: float  # in steps of its unit
    place: int  # of its (first) free direction


def sentences(
    fit: Fit, directions: NDArray, covariance: NDArray, n_rows: float
) -> tuple[str, ...]:
    """Return a sentence for each direction that hardly moves the tips, in few parameters.

    `directions` (K, P) are orthonormal changes in units of the prior; `covariance` (P, P) is that
    of the free parameters.
    """
    problem = fit.problem
    units = np.concatenate([part.units for part in problem.parameters])
    steps = [_STEPS[kind] for part in problem.parameters for kind in part.kind]
    to_steps = problem.prior_std * units / np.array([size for size, _ in steps])
    columns = 1e3 * fit.jacobian * problem.prior_std / np.sqrt(n_rows)  # [mm] of tip
    texts = []
    for move in few_terms(directions):
        # The first parameter with a fair part is named first and changes by one step.
        lead = int(np.argmax(np.abs(move) > _FAIR * np.abs(move).max()))
        move = move / (move[lead] * to_steps[lead])
        tips = float(np.linalg.norm(columns @ move))
        by_one = np.abs(move) * np.linalg.norm(columns, axis=0)
        noticed = by_one > max(_SMALL * tips, _SLIGHT * by_one.max(), _STILL)
        terms = _terms(problem, move * to_steps, lead)
        shown = [term for term in terms if abs(term.size) > _SMALL][:_N_TERMS]
        n_hidden = sum(noticed[term.place] for term in terms if term not in shown)
        if tips >= _STILL:
            effect = f"moves the tips by {tips:.2g} mm rms"
        else:
            effect = _NO_EFFECT
        words = [
            f"{label} {size:+.3g} {steps[place][1]}" for label, size, place in shown
        ]
        advice = _advice(fit, covariance, move * to_steps, shown)
        texts.append(f"{_joined(words, n_hidden)} {effect}: {advice}")
    return tuple(texts)


def _joined(words: list[str], n_hidden: int) -> str:
    """Return the first part of a direction "with" the others."""
    middle = [", ".join(words[1:])] if len(words) > 1 else []
    if n_hidden:
        middle.append(f"{n_hidden} smaller")
    return " with ".join([words[0], " and ".join(middle)]) if middle else words[0]


def _advice(fit: Fit, covariance: NDArray, move: NDArray, shown: list[_Term]) -> str:
    """Return what to leave out or measure, and what the data identify nevertheless."""
    name_of = [part.name for part in fit.problem.parameters for _ in part.labels]
    labels = [term.label.removeprefix("all ") for term in shown]
    if len(shown) == 1:
        return f"leave {labels[0]} out or measure it."
    second = 1
    for k in range(1, len(shown)):
        if name_of[shown[k].place] != name_of[shown[0].place]:
            second = k
            break
    determined = _determined(fit, covariance, move, shown[0].place, shown[second].place)
    return f"leave out or measure {labels[0]} or {labels[second]}.{determined}"


def _determined(fit: Fit, covariance: NDArray, move: NDArray, i: int, j: int) -> str:
    """Return a sentence if the data identify the ratio or product of two parameters.

    They do if both change by the same factor and the standard error of the logarithm is small.
    """
    parts = fit.problem.parameters
    labels = fit.problem.labels
    geometry = fit.chain().geometry()
    kinds = [kind for part in parts for kind in part.kind]
    if not kinds[i] == kinds[j] == "-" or abs(
        abs(move[i]) - abs(move[j])
    ) > _ALIKE * abs(move[i]):
        return ""
    i, j = sorted((i, j), key=labels.__getitem__)
    way = 1 if move[i] * move[j] > 0 else -1
    error = np.sqrt(covariance[i, i] + covariance[j, j] - 2 * way * covariance[i, j])
    values = [
        v
        for part in parts
        for v in part.value(geometry[part.entry]).flatten()[: part.size]
    ]
    value = float(values[i] / values[j] ** way)
    combination = f"{labels[i]} {'/' if way > 0 else '*'} {labels[j]}"
    shown = f" The data identify {combination} = {value:.4g} (std. error {abs(value) * error:.2g})."
    return shown if error < _DETERMINED else ""


def _terms(problem: Problem, move: NDArray, lead: int) -> list[_Term]:
    """Return the parts of a direction: the leading one, then the largest first."""
    terms = []
    row = 0
    for part in problem.parameters:
        sizes = move[row : row + part.size]
        if part.size > 1 and np.ptp(sizes) < _ALIKE * np.abs(sizes).max():
            leads = row <= lead < row + part.size
            terms.append((leads, _Term(f"all {part.name}", float(sizes[0]), row)))
        else:
            for index, (label, size) in enumerate(
                zip(part.labels, sizes, strict=True), row
            ):
                terms.append((index == lead, _Term(label, float(size), index)))
        row += part.size
    terms.sort(key=lambda pair: (not pair[0], -abs(pair[1].size), pair[1]))
    return [term for _, term in terms]
