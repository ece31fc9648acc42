"""Choice of the parameters to calibrate, by errors inside and outside the range of the fit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin._core.arrays import Numbers, as_tensor, one_of
from hybridkin._core.directions import in_terms, moved_directions
from hybridkin._core.distinct import distinct_rows, targets_that_count
from hybridkin._core.groups import Groups
from hybridkin._core.model import ForwardModel
from hybridkin._core.simplest import simplest_within
from hybridkin.calibration._least_squares import COMPARED, LOSSES, ROUGH, TipRows, solve
from hybridkin.calibration._search import NO_START, Start, search, widened
from hybridkin.calibration.calibrate import (
    CalibrationResult,
    check_data,
    check_parameters,
    fit_geometry,
    refitted,
)
from hybridkin.calibration.measured import evenly_spaced, inner_and_outer
from hybridkin.chains.chain import Chain

__all__ = ["GeometryChoice", "choose_geometry"]

Starts = tuple[Start, ...]
"""Starts of the fits of all sets of parameters."""

# rows and folds for the scores
_MOST = 400
_FOLDS = 3
_FEW = 40  # with fewer rows `io` is not used
_CLEARLY = 0.7  # of the score of sets with enough rows: a set with too few must be better
_WORSE = 1.1  # times the smallest held-out error: sets above are not taken, whatever `io`
# Also from few rows.
_USUAL = (
    "nothing",
    "base",
    "radii + base",
    "radii + base + gain",
)
_EQUAL = 0.007  # of the score: within it the smaller set is taken
_ALIKE = 0.01  # of the error: within it the first of two starts is taken
_EXACT = 1e-6  # of the reach: smaller errors are equal
_NEAR = 1.3  # times the score of the chosen set: a learned correction may make others the best
_MOST_NEAR = 5
_MOVES = 0.05  # of the largest motion of the tip

_RIVAL = "elastic tendons: "  # prefix of sets that replace those of a plain chain
_STIFF = ("bending_stiffness", "axial_stiffness")


class SetErrors(NamedTuple):
    """Mean tip distances of a set of parameters [m]; NaN if they were not needed."""

    cv: float  # held-out motions, or rows
    io: float = np.nan  # the outer rows, after a fit to the inner ones

    def known(self) -> dict[str, float]:
        """Return the errors by name, without those that were not computed."""
        if np.isnan(self.io):
            return {"cv": self.cv}
        return {"cv": self.cv, "io": self.io}


@dataclass(frozen=True)
class GeometryChoice:
    """The chosen parameters, and the start of their fit.

    Attributes
    ----------
    chain : Chain
        The given chain, or elastic tendons with its geometry.
    parameters : tuple of str
        The parameters to calibrate; may be empty.
    start : Start
        Start of their fit. Default: it is searched.
    name : str
        Name of the set in `errors`.
    errors : dict of str to SetErrors
        Errors of all sets that were tried; empty if there was no choice.
    messages : tuple of str
        Warnings about the log.
    rivals : tuple of GeometryChoice
        The other sets whose errors are at most a tenth above those of the chosen one.
    starts : tuple of Start
        Starts of the fits of all sets.
    near : tuple of GeometryChoice
        The sets that a learned correction can make the best, the smaller ones first: those with a
        score at most 1.3 times that of the chosen one, which is among them; at most five.
    usual : tuple of GeometryChoice
        The sets that suit few rows: nothing, the base, and base and radii of the given chain.
    corrected : dict of str to SetErrors
        Errors that remain below quick corrections, by what was compared; empty if nothing was.
    """

    chain: Chain
    parameters: tuple[str, ...]
    start: Start = NO_START
    name: str = ""
    errors: Mapping[str, SetErrors] = field(default_factory=dict)
    messages: tuple[str, ...] = ()
    rivals: tuple[GeometryChoice, ...] = ()
    starts: Starts = ()
    near: tuple[GeometryChoice, ...] = ()
    usual: tuple[GeometryChoice, ...] = ()
    corrected: Mapping[str, SetErrors] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return a one-line summary."""
        kind = type(self.chain).__name__
        return f"GeometryChoice({kind}, {self.parameters}, {len(self.errors)} sets compared)"

    def __bool__(self) -> bool:
        """Return whether there was a choice, maybe of nothing to calibrate."""
        return self.chain.n_actuators > 0

    def __iter__(self) -> Iterator[str]:
        """Return an iterator over the parameters to calibrate."""
        return iter(self.parameters)

    def started(self, q: Tensor, x: Tensor, weights: Tensor) -> GeometryChoice:
        """Return the choice with a start of its fit, which is searched if there is none."""
        if self.start.n_free or not self.parameters:
            return self
        chain = self.chain.frozen().cpu()
        like = chain.geometry()["base"]
        rows = TipRows(q.to(like), x.to(like), weights.to(like))
        return replace(self, start=search(chain, rows, self.parameters, "linear"))

    def calibrate(self, q: Numbers, x: Numbers, *, loss: str = "linear") -> CalibrationResult:
        """Return the calibration of the chosen parameters, which must not be empty.

        Parameters
        ----------
        q, x, loss
            As for `hybridkin.calibrate`, whose search of initial guesses is not repeated.

        Returns
        -------
        CalibrationResult
            Its warnings are not issued: they are its `messages`.
        """
        return fit_geometry(self.chain, q, x, self.parameters, loss, start=self.start)

    def fitted(self, q: Numbers, x: Numbers, *, loss: str = "linear") -> Chain:
        """Return only the chain of `calibrate`, in a part of the time.

        It is for errors of held-out rows, which do not need all its digits.

        Parameters
        ----------
        q, x, loss
            As for `calibrate`; the rows are not checked.
        """
        if not self.parameters:
            return self.chain
        q = as_tensor(q, "q")
        x = as_tensor(x, "x")
        weights = q.new_ones(len(q))
        return refitted(self.started(q, x, weights).start, q, x, weights, loss)


NOT_CHOSEN = GeometryChoice(NO_START.problem.chain, ())
"""No choice of parameters; it is falsy."""


class _Candidate(NamedTuple):
    """One set of parameters to choose from."""

    name: str
    chain: Chain
    parameters: tuple[str, ...]

    @property
    def free_rings(self) -> set[str]:
        """The free parameters of the actuator rings that require a search."""
        return self.chain.free_rings(self.parameters)


class _Split(NamedTuple):
    """Rows to fit, and rows to predict: held-out motions, or the outer rows."""

    fitted: NDArray
    predicted: NDArray


def choose_geometry(
    chain: Chain,
    q: Numbers,
    x: Numbers,
    *,
    groups: ArrayLike | Groups | None = None,
    weights: Numbers | None = None,
    loss: str = "linear",
    outside: bool = True,
    parameters: Sequence[str] | None = None,
    starts: Sequence[Start] = (),
) -> GeometryChoice:
    """Return the parameters with the smallest calibration error on new motions and extrapolation.

    The sets grow from nothing, the base and the radii to the whole geometry; for a chain with gains
    their common factor is free wherever the radii are. If tendons of a
    `ConstantCurvatureChain` contradict each other, elastic tendons of the same geometry follow.
    The score of a set is ``(cv * io**2)**(1/3)``: `cv` is the mean tip distance on held-out
    motions, `io` that on the outer 35 % of the rows after a fit to the inner 40 %. Among sets with
    a `cv` at most a tenth above the smallest, the smallest one with nearly the best score is taken.
    A set with more than one parameter per 7 rows (per row for a `RigidChain`) must be clearly
    better, except base and radii. For a set with more of them than the inner rows suffice for, `io`
    is at most that of the last smaller set, times the ratio of their `cv`. Below 40 rows the score
    is `cv`.

    Parameters
    ----------
    chain : Chain
        The nominal chain; it is not changed.
    q : array or Tensor of shape (N, n_actuators)
        Actuator vectors [m or rad].
    x : array or Tensor of shape (N, 3) or (N, 3 K)
        Measured tip positions [m], as in `calibrate`.
    groups : array-like of shape (N,), optional
        Motion of every row. Parts of a single motion are held out; without groups, rows.
    weights : array-like of shape (N,), optional
        How often each row counts. Equal rows are held out together.
    loss : str, default="linear"
        As in `calibrate`.
    outside : bool, default=True
        Whether the score uses `io`, because a correction will be learned; else it is `cv`.
    parameters : sequence of str, optional
        The set to calibrate. The only choice is then whether the tendons are elastic.
    starts : sequence of Start, optional
        Starts of the fits from a choice on more rows of the same log. Default: they are searched.

    Returns
    -------
    GeometryChoice
        The parameters to calibrate, and the errors of all sets. A `HybridForwardModel` takes it as
        `calibrate`, so that several models share one choice.

    Raises
    ------
    ValueError
        As for `calibrate`.

    Examples
    --------
    >>> import torch
    >>> from hybridkin import ConstantCurvatureChain, choose_geometry
    >>> q = 0.25 + 0.05 * torch.rand(60, 3, generator=torch.manual_seed(0), dtype=torch.float64)
    >>> truth = ConstantCurvatureChain([0.05])
    >>> choice = choose_geometry(ConstantCurvatureChain([0.06]), q, truth(q))
    >>> choice.parameters
    ('radii', 'base')
    >>> choice.calibrate(q, truth(q)).values["radii"]
    tensor([0.0500], dtype=torch.float64)
    """
    one_of(loss, "loss", LOSSES)
    nominal = chain
    chain = chain.frozen().cpu()
    x = targets_that_count(x, weights, "x")
    q, x, _ = check_data(chain, q, x)
    motions = Groups.of(groups, len(q))
    if weights is None:
        weights = np.ones(len(q))
    weights = as_tensor(weights, "weights").to(q)
    names = tuple(parameters or ())
    if names:
        names = check_parameters(chain, names)
    first, counts, _ = distinct_rows(q, x, weights, motions.apart)
    motions = motions.take(first)
    order = np.argsort(motions.labels, kind="stable")
    chosen = np.sort(order[evenly_spaced(len(first), _MOST)])
    rows = TipRows(q[first], x[first], torch.from_numpy(counts).to(q)).take(chosen)
    motions = motions.take(chosen)
    with torch.no_grad():
        candidates = _candidates(chain, q, names)
        messages = () if names else unmoved(chain, q)
    if len(starts) < len(candidates):
        starts = _starts(candidates, rows, loss)
    starts = starts[: len(candidates)]
    best = 0
    near = [0]
    close = [0]
    errors = {}
    if len(candidates) > 1:
        splits = _splits(motions)
        outer = []
        if outside and len(chosen) >= _FEW:
            outer = [_Split(*inner_and_outer(rows.q.numpy()))]
        for candidate, start in zip(candidates, starts, strict=True):
            cv = _mean_distance(start, rows, splits, loss)
            io = np.nan
            if outer:
                io = _mean_distance(start, rows, outer, loss)
            errors[candidate.name] = SetErrors(cv, io)
        n_inner = len([*splits, *outer][-1].fitted)
        table = np.maximum([*errors.values()], _EXACT * float(chain.reach))
        best = _best(table, candidates, starts, len(chosen), n_inner)
        close = np.flatnonzero(~(table > _WORSE * table[best]).any(axis=1)).tolist()
        near = _near(_scores(table), best)

    def choice(k: int) -> GeometryChoice:
        name, chosen_chain, names = candidates[k]
        if chosen_chain is chain:
            chosen_chain = nominal
        return GeometryChoice(chosen_chain, names, starts[k], name, errors, messages)

    def among_others(k: int) -> GeometryChoice:
        others = [choice(j) for j in close if j != k and candidates[j].parameters]
        return replace(choice(k), rivals=tuple(others), starts=tuple(starts))

    usual = [k for k, candidate in enumerate(candidates) if candidate.name in _USUAL]
    return replace(
        among_others(best),
        near=tuple(among_others(k) for k in near),
        usual=tuple(among_others(k) for k in usual),
    )


def _scores(errors: NDArray) -> NDArray:
    """Return the scores (K,) of sets with `SetErrors` (K, 2)."""
    cv, io = errors.T
    if np.isnan(io).any():
        return cv
    return np.cbrt(cv * io**2)


def _near(scores: NDArray, best: int) -> list[int]:
    """Return the sets whose scores (K,) are near that of the chosen one, which is among them."""
    near = [k for k in np.argsort(scores, kind="stable").tolist() if k != best]
    near = [k for k in near if scores[k] <= _NEAR * scores[best]]
    return sorted([best, *near[: _MOST_NEAR - 1]])


def _best(
    errors: NDArray,
    candidates: Sequence[_Candidate],
    starts: Sequence[Start],
    n_rows: int,
    n_inner: int,
) -> int:
    """Return the index of the chosen one of K sets, with `SetErrors` (K, 2), smaller sets first."""
    needed = np.zeros(len(starts))
    for k, (candidate, start) in enumerate(zip(candidates, starts, strict=True)):
        needed[k] = candidate.chain.rows_per_parameter * start.n_free
    usual = np.array([candidate.name in _USUAL for candidate in candidates])
    cv, io = errors.T
    # Where the inner rows do not suffice, `io` is at most that of the last set for which they do.
    enough = needed <= n_inner
    last = np.maximum.accumulate(np.where(enough, np.arange(len(cv)), 0))
    io = np.minimum(io, io[last] * cv / cv[last])
    scores = _scores(np.column_stack([cv, io]))
    # Sets for which all rows do not suffice must be clearly better.
    sure = usual | (needed <= n_rows)
    sure = sure | (scores < _CLEARLY * scores[sure].min(initial=np.inf))
    good = sure & (cv <= _WORSE * cv[sure].min())
    return simplest_within(np.where(good, scores, np.inf), _EQUAL)


def _candidates(chain: Chain, q: Tensor, names: tuple[str, ...]) -> list[_Candidate]:
    """Return the sets to choose from, the smaller ones first; of named parameters one."""
    sets = [names] if names else chain.parameter_sets
    candidates = [_Candidate(_name(names), chain, names) for names in sets]
    for elastic in chain.rivals(q):
        elastic_sets = [names for names in elastic.parameter_sets if len(names) > 1]
        if names:
            elastic_sets = [_elastic_parameters(chain, elastic, sets[0])]
        for names in elastic_sets:
            candidates.append(_Candidate(_RIVAL + _name(names), elastic, names))
    return candidates


def _elastic_parameters(chain: Chain, elastic: Chain, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the parameters of elastic tendons in place of those of a plain chain.

    Lengths and radii of a plain chain compensate for slack; elastic tendons keep them.
    """
    if names == chain.default_parameters:
        return elastic.default_parameters
    both = dict.fromkeys((*names, *elastic.default_parameters))
    plain = ("radii", "lengths", "actuator_zeros")
    return tuple(name for name in both if name not in plain)


def _name(names: tuple[str, ...]) -> str:
    words = [name for name in names if name not in _STIFF]
    if len(words) < len(names):
        words.append("stiffnesses")
    return " + ".join(words) or "nothing"


def _starts(candidates: Sequence[_Candidate], rows: TipRows, loss: str) -> list[Start]:
    """Return the start of the fit of every set; initial guesses are searched if rings become free.

    Other sets start from the previous one; elastic tendons also from a plain chain with the same
    free rings.
    """
    starts: list[Start] = []
    for candidate in candidates:
        names = candidate.parameters
        free = candidate.free_rings
        previous: list[Start] = []
        plain: list[Start] = []
        searched = False
        for other, start in zip(candidates, starts, strict=False):
            if not start.n_free:
                continue
            if other.chain is candidate.chain:
                previous = [start]
                searched = free <= other.free_rings
            elif ("angles" in free) == ("angles" in other.free_rings):
                plain = [start]
        if not names:
            starts.append(Start.fixed(candidate.chain))
        elif searched or plain:
            tried = [widened(start, names) for start in previous]
            if not searched:
                tried += [widened(start, names, elastic=True) for start in plain]
            starts.append(_refitted(tried, rows, loss))
        else:
            starts.append(search(candidate.chain, rows, names, loss))
    return starts


def _refitted(starts: list[Start], rows: TipRows, loss: str) -> Start:
    """Return the start with the smallest error of a rough fit; the first one if nearly equal."""
    fits = [solve(start.problem, rows, start.theta, loss, ROUGH) for start in starts]
    best = simplest_within([fit.rmse for fit in fits], _ALIKE)
    return starts[best]._replace(theta=fits[best].theta)


def _splits(motions: Groups) -> list[_Split]:
    """Return folds of motions or rows; for a single motion, of parts of it."""
    splits = motions.in_parts().folds(_FOLDS, shuffle=True)
    return [_Split(*split) for split in splits]


def _mean_distance(
    start: Start,
    rows: TipRows,
    splits: Sequence[_Split],
    loss: str,
) -> float:
    """Return the mean tip distance of a set on the predicted rows of splits [m]."""
    total = 0.0
    total_weight = 0.0
    for split in splits:
        chain = start.fitted(rows.take(split.fitted), loss, COMPARED)
        predicted = rows.take(split.predicted)
        weights = predicted.weights
        total += weights @ np.linalg.norm(predicted.residual(chain), axis=1)
        total_weight += weights.sum()
    return float(total / total_weight)


def unmoved(model: ForwardModel | None, q: Tensor) -> tuple[str, ...]:
    """Return a warning if rows q (N, n) do not move directions that move the tip of the model.

    N rows move at most N - 1 directions; that they are few is no reason for this warning. Without a
    model, what moves the tip is not known.
    """
    directions = moved_directions(q.numpy())
    if not directions.moved.size:
        return (
            "the log holds a single configuration: nothing is learned about others, and "
            "`in_domain` is false for them. Record rows that move every actuator.",
        )
    if model is None or directions.moved.shape[1] >= min(q.shape[1], len(q) - 1):
        return ()
    normals = directions.normals()
    still = normals @ split_by_effect(model, q, normals)[0]
    if not still.size:
        return ()
    names = [f"q[{k}]" for k in range(q.shape[1])]
    return (
        f"the log has no motion along {in_terms(still, names)} (directions of q that move the "
        "tip): a learned correction is constant there, and `in_domain` is false beyond a tenth of "
        "the range. Record rows that move the actuators independently.",
    )


def split_by_effect(model: ForwardModel, q: Tensor, directions: NDArray) -> tuple[NDArray, NDArray]:
    """Return combinations (k, a) and (k, k - a) of directions of q (n, k).

    Along the first ones the tip of the model moves at some of the rows q (N, n), along the others
    it hardly moves.
    """
    with torch.enable_grad():
        jacobians = model.forward_and_jacobian(q[:: max(1, len(q) // 50)])[1]
    J = jacobians.detach().flatten(0, 1).numpy()
    effects, turned = np.linalg.eigh((J @ directions).T @ (J @ directions))
    moving = effects > (_MOVES * np.linalg.norm(J, 2)) ** 2
    return turned[:, moving], turned[:, ~moving]
