"""Sentences about directions that calibration data do not identify: few parameters, advice."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.directions import few_terms, leading_part
from hybridkin.calibration._least_squares import Fit
from hybridkin.calibration._parameters import Problem
from hybridkin.chains.chain import Chain

_N_TERMS = 6  # parameters in a sentence
_DIGITS = 9  # of changes, in steps
_SMALL = 0.05  # of a step, or of the motion of the tips: not mentioned
_SLIGHT = 0.01  # of the largest motion of the tips by one parameter alone
_ALIKE = 0.02
_STILL = 1e-6  # [mm]
_SHOWN = 1e-3  # least motion of the tips that is given in digits [mm]
_TINY = 1e-12  # standard error of a ratio that is not less
_DETERMINED = 0.05  # largest standard error of the logarithm
# Steps in which changes are given, and their names, for each kind of unit.
_STEPS = {"m": 1e-3, "rad": np.pi / 180.0, "-": 0.01, "q": 1.0}
_STEP_NAMES = {"m": "mm", "rad": "deg", "-": "%", "q": "of q"}


class Unidentified(NamedTuple):
    """A direction that the data do not identify: a sentence, and the parameters that it names."""

    sentence: str
    labels: tuple[str, ...]


class _Term(NamedTuple):
    """A part of a direction: one free direction, or all of a parameter that change equally."""

    label: str
    size: float  # in steps of its unit
    place: int  # of its (first) free direction
    name: str  # of the parameter
    leads: bool  # whether it is named first
    labels: tuple[str, ...]  # of all free directions


def in_sentences(
    fit: Fit, directions: NDArray, covariance: NDArray, n_rows: float
) -> list[Unidentified]:
    """Return a sentence for each direction that hardly moves the tips, in few parameters.

    `directions` (K, P) are orthonormal changes in units of the prior; `covariance` (P, P) is that
    of the free parameters.
    """
    problem = fit.problem
    units = np.concatenate([part.units for part in problem.parameters])
    steps = np.array([_STEPS[kind] for kind in problem.kinds])
    to_steps = problem.prior_std * units / steps
    columns = 1e3 * fit.jacobian * problem.prior_std / np.sqrt(n_rows)  # [mm] of tip
    described = []
    for direction in few_terms(directions):
        # The first parameter with a fair part is named first and changes by one step.
        lead = leading_part(np.abs(direction))
        direction = direction / (direction[lead] * to_steps[lead])
        change = np.round(direction * to_steps, _DIGITS)  # equal changes are equal numbers
        tips = float(np.linalg.norm(columns @ direction))
        effect = f"does not move {fit.rows.moved}"
        if tips >= _STILL:
            amount = f"{tips:.2g} mm" if tips >= _SHOWN else f"less than {_SHOWN:g} mm"
            effect = f"moves {fit.rows.moved} by {amount} rms"
        terms = _terms(problem, change, lead)
        shown = [term for term in terms if abs(term.size) > _SMALL][:_N_TERMS]
        alone = np.abs(direction) * np.linalg.norm(columns, axis=0)
        noticed = alone > max(_SMALL * tips, _SLIGHT * alone.max(), _STILL)
        n_hidden = 0
        for term in terms:
            n_hidden += bool(term not in shown and noticed[term.place])
        advice = _advice(fit, covariance, shown)
        sentence = f"{_in_words(problem, shown, n_hidden)} {effect}: {advice}"
        labels = itertools.chain.from_iterable(term.labels for term in shown)
        described.append(Unidentified(sentence, tuple(labels)))
    return described


def _in_words(problem: Problem, terms: list[_Term], n_hidden: int) -> str:
    """Return the first part of a direction "with" the others."""
    words = []
    for term in terms:
        unit = _STEP_NAMES[problem.kinds[term.place]]
        words.append(f"{term.label} {term.size:+.3g} {unit}")
    first, *following = words
    parts = [", ".join(following)] if following else []
    if n_hidden:
        parts.append(f"{n_hidden} smaller")
    if not parts:
        return first
    return f"{first} with {' and '.join(parts)}"


def _advice(fit: Fit, covariance: NDArray, terms: list[_Term]) -> str:
    """Return what to leave out or measure, and what the data identify nevertheless."""
    first = terms[0]
    label = first.label.removeprefix("all ")
    if len(terms) == 1:
        return f"leave {label} out or measure it."
    second = terms[1]
    for term in terms[1:]:
        if term.name != first.name:
            second = term
            break
    other_label = second.label.removeprefix("all ")
    determined = _determined(fit, covariance, first, second)
    return f"leave out or measure {label} or {other_label}.{determined}"


def _determined(fit: Fit, covariance: NDArray, first: _Term, second: _Term) -> str:
    """Return a sentence if the data identify the ratio or product of two parameters.

    They do if both change by the same factor and the standard error of the logarithm is small.
    """
    problem = fit.problem
    if {problem.kinds[first.place], problem.kinds[second.place]} != {"-"}:
        return ""
    if abs(abs(first.size) - abs(second.size)) > _ALIKE * abs(first.size):
        return ""
    labels = problem.labels
    i, j = sorted((first.place, second.place), key=labels.__getitem__)
    power = 1
    operator = "*"
    if first.size * second.size > 0:
        power = -1
        operator = "/"
    variance = covariance[i, i] + covariance[j, j] + 2 * power * covariance[i, j]
    error = np.sqrt(variance)
    if error >= _DETERMINED:
        return ""
    geometry = fit.chain().geometry()
    values = np.zeros(len(labels))
    for part, place in problem.places():
        value = part.value(geometry[part.entry]).flatten()
        values[place] = value[: part.size]
    product = values[i] * values[j] ** power
    std_error = abs(product) * error
    decimals = max(0, 1 - math.floor(math.log10(max(std_error, _TINY))))  # two digits of the error
    unit = _unit_of_both(fit.chain(), labels[i], operator, labels[j])
    return (
        f" The data identify {labels[i]} {operator} {labels[j]} = {product:.{decimals}f}{unit} "
        f"(std. error {std_error:.{decimals}f})."
    )


def _unit_of_both(chain: Chain, label: str, operator: str, other_label: str) -> str:
    """Return the unit of a ratio or product of two parameters, after a space; "" of a number."""
    unit = chain.unit_of(label.partition("[")[0])
    other = chain.unit_of(other_label.partition("[")[0])
    top, _, below = unit.partition("/")
    if operator == "/" and top == other:
        return f" per {below}" if below else ""
    other_top, _, other_below = other.partition("/")
    if operator == "/" and other_top == unit:
        return f" {other_below}"
    return f" [{unit} {operator} {other}]"


def _terms(problem: Problem, change: NDArray, lead: int) -> list[_Term]:
    """Return the parts of a direction: the leading one, then the largest first."""
    terms = []
    for part, place in problem.places():
        sizes = change[place].tolist()
        first = place.start
        if part.size > 1 and np.ptp(sizes) < _ALIKE * np.abs(sizes).max():
            leads = first <= lead < place.stop
            label = f"all {part.name}"
            labels = tuple(part.labels)
            terms.append(_Term(label, sizes[0], first, part.name, leads, labels))
            continue
        for k, label in enumerate(part.labels):
            leads = first + k == lead
            terms.append(_Term(label, sizes[k], first + k, part.name, leads, (label,)))
    return sorted(terms, key=lambda term: (not term.leads, -abs(term.size), term))
