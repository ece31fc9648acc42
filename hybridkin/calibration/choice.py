"""Choice of the parameters to calibrate, by errors inside and outside the range of the fit."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin._core.arrays import Numbers, as_tensor, labels, one_of
from hybridkin._core.directions import in_terms, moved_directions
from hybridkin._core.model import ForwardModel
from hybridkin.calibration._least_squares import LOSSES, ROUGH, Rows, solve
from hybridkin.calibration._search import Start, search, widened
from hybridkin.calibration.calibrate import check_data
from hybridkin.calibration.measured import evenly_spaced, folds, inner_and_outer
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.chain import Chain
from hybridkin.chains.constant_curvature import ConstantCurvatureChain
from hybridkin.chains.elastic_tendons import ElasticTendonChain

# rows and folds for the scores
_MOST = 400
_FOLDS = 3
_FEW = 40  # with fewer rows `io` is not used
# rows per parameter; with fewer rows a set must be clearly better
_ROWS = 7
_CLEARLY = 0.7
_WORSE = (
    1.1  # times the smallest held-out error: sets above are not taken, whatever `io`
)
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
_MOVES = 0.05  # of the largest motion of the tip

_RIVAL = "elastic tendons: "  # prefix of sets that replace those of a plain chain
_STIFF = ("bending_stiffness", "axial_stiffness")
_EXTENSIBLE = (
    ("radii", "base"),
    ("radii", "rest_bends", "base"),
    ("radii", "turns", "offsets", "rest_bends", "base"),
    ("radii", "angles", "rest_bends", "offsets", "actuator_zeros", "base"),
)
_TENDONS = (
    ("radii", "base"),
    ("radii", "turns", "rest_bends", "base"),
    ("radii", "turns", "rest_bends", "lengths", "tool", "base"),
)
_ELASTIC = (
    ("base", *_STIFF),
    ("turns", "rest_bends", "tool", "base", *_STIFF, "tendon_zeros"),
    (
        "turns",
        "rest_bends",
        "tool",
        "base",
        *_STIFF,
        "tendon_zeros",
        "radii",
        "lengths",
    ),
)


class Errors(NamedTuple):
    """Mean tip distances of a set of parameters [m]; NaN if they were not needed."""

    cv: float  # held-out motions, or rows
    io: float = np.nan  # the outer rows, after a fit to the inner ones

    def known(self) -> dict[str, float]:
        """Return the errors by name, without those that were not computed."""
        return {
            name: error for name, error in self._asdict().items() if not np.isnan(error)
        }


@dataclass(frozen=True)
class GeometryChoice:
    """The chosen parameters, and the start of their fit.

    Attributes
    ----------
    chain : Chain
        The given chain, or elastic tendons with its geometry.
    parameters : tuple of str
        The parameters to calibrate; may be empty.
    start : Start or None
        Start of their fit, for `fit_geometry`; None without parameters.
    name : str
        Name of the set in `errors`.
    errors : dict of str to Errors
        Errors of all sets that were tried; empty if there was no choice.
    messages : tuple of str
        Warnings about the log.
    rivals : tuple of GeometryChoice
        The other sets whose errors are at most a tenth above those of the chosen one.
    """

    chain: Chain
    parameters: tuple[str, ...]
    start: Start | None
    name: str
    errors: dict[str, Errors]
    messages: tuple[str, ...] = ()
    rivals: tuple[GeometryChoice, ...] = ()


class _Rung(NamedTuple):
    """One set of parameters."""

    name: str
    chain: Chain
    parameters: tuple[str, ...]


def choose_geometry(
    chain: Chain,
    q: Numbers,
    x: Numbers,
    *,
    groups: ArrayLike | None = None,
    weights: Numbers | None = None,
    loss: str = "linear",
    outside: bool = True,
    parameters: Sequence[str] | None = None,
) -> GeometryChoice:
    """Return the parameters with the smallest calibration error on new motions and extrapolation.

    The sets grow from nothing, the base and the radii to the whole geometry; for a chain with gains
    their common factor is free wherever the radii are. If tendons of a
    `ConstantCurvatureChain` contradict each other, elastic tendons of the same geometry follow.
    The score of a set is ``(cv * io**2)**(1/3)``: `cv` is the mean tip distance on held-out
    motions, `io` that on the outer 35 % of the rows after a fit to the inner 40 %. Among sets with
    a `cv` at most a tenth above the smallest, the smallest one with nearly the best score is taken.
    A set with more than one parameter per 7 rows must be clearly better, except base and radii.
    For a set with more than one parameter per 7 inner rows `io` is at most that of the last smaller
    set, times the ratio of their `cv`. Below 40 rows the score is `cv`.

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
        How often each row counts.
    loss : str, default="linear"
        As in `calibrate`.
    outside : bool, default=True
        Whether the score uses `io`, because a correction will be learned; else it is `cv`.
    parameters : sequence of str, optional
        The set to calibrate. The only choice is then whether the tendons are elastic.

    Returns
    -------
    GeometryChoice
        The parameters to calibrate, and the errors of all sets.
    """
    one_of(loss, "loss", LOSSES)
    nominal = chain
    chain = copy.deepcopy(chain).cpu()
    q, x, _ = check_data(chain, q, x)
    if groups is not None:
        groups = labels(groups, len(q))
    if groups is None:
        chosen_rows = np.arange(len(q))
    else:
        chosen_rows = np.argsort(groups, kind="stable")
    chosen_rows = np.sort(chosen_rows[evenly_spaced(len(q), _MOST)])
    if weights is None:
        counts = q.new_ones(len(q))
    else:
        counts = as_tensor(weights, "weights").to(q)
    rows = Rows(q[chosen_rows], x[chosen_rows], counts[chosen_rows])
    with torch.no_grad():
        rungs = _rungs(chain, q, parameters)
        tied = () if parameters is not None else unmoved(chain, q)
    starts = _starts(rungs, rows, loss)
    best = 0
    errors = {}
    near = []
    if len(rungs) > 1:
        motions = None if groups is None else groups[chosen_rows]
        splits = [(1, *split) for split in _splits(rows, motions)]
        if outside and len(chosen_rows) >= _FEW:
            splits.append((0, *inner_and_outer(rows.q.numpy())))
        rung_errors = [
            _errors(rung, at, rows, splits, loss)
            for rung, at in zip(rungs, starts, strict=True)
        ]
        free = np.array([0 if at is None else at.theta.size for at in starts])
        sure = (free <= len(chosen_rows) / _ROWS) | [
            rung.name in _USUAL for rung in rungs
        ]
        enough = free <= len(splits[-1][1]) / _ROWS
        table = np.maximum(rung_errors, _EXACT * float(chain.reach))
        best = _best(table, sure, enough)
        errors = {rung.name: one for rung, one in zip(rungs, rung_errors, strict=True)}
        near = np.flatnonzero(~(table > _WORSE * table[best]).any(axis=1)).tolist()

    def choice(k: int) -> GeometryChoice:
        name, chosen, names = rungs[k]
        if chosen is chain:
            chosen = nominal
        return GeometryChoice(chosen, names, starts[k], name, errors, tied)

    rivals = tuple(choice(k) for k in near if k != best and rungs[k].parameters)
    return replace(choice(best), rivals=rivals)


def _best(errors: NDArray, sure: NDArray, enough: NDArray) -> int:
    """Return the index of the chosen one of K sets.

    Parameters
    ----------
    errors : ndarray of shape (K, 2)
        Their `Errors`, smaller sets first.
    sure : ndarray of bool of shape (K,)
        Whether all rows suffice for the parameters of a set; else it must be clearly better.
    enough : ndarray of bool of shape (K,)
        Whether the inner rows suffice; else `io` is at most that of the last set for which they
        do, times the ratio of their `cv`.
    """
    cv, io = errors.T
    last = np.maximum.accumulate(np.where(enough, np.arange(len(cv)), 0))
    io = np.minimum(io, io[last] * cv / cv[last])
    scores = cv if np.isnan(io).any() else np.cbrt(cv * io**2)
    sure = sure | (scores < _CLEARLY * scores[sure].min(initial=np.inf))
    good = sure & (cv <= _WORSE * cv[sure].min())
    return int(np.argmax(good & (scores <= (1.0 + _EQUAL) * scores[good].min())))


def _rungs(chain: Chain, q: Tensor, parameters: Sequence[str] | None) -> list[_Rung]:
    """Return the sets to choose from, the smaller ones first."""
    elastic = None
    if isinstance(chain, ConstantCurvatureChain) and not any(chain.extensible):
        if chain.contradictory(q).any():
            elastic = ElasticTendonChain.from_chain(chain)
    if parameters is not None:
        names = tuple(parameters)
        rungs = [_Rung(_name(names), chain, names)]
        if elastic is not None:
            elastic_names = elastic.default_parameters
            # Lengths and radii of a plain chain compensate for slack; elastic tendons keep them.
            not_elastic = [
                name
                for name in names
                if name not in ("radii", "lengths", "actuator_zeros")
            ]
            if names != chain.default_parameters:
                elastic_names = (
                    *not_elastic,
                    *(
                        name
                        for name in elastic_names
                        if name not in ("radii", "lengths", *not_elastic)
                    ),
                )
            rungs.append(_Rung(_RIVAL + _name(elastic_names), elastic, elastic_names))
        return rungs
    if not isinstance(chain, ArcChain):
        sets = ((), chain.default_parameters)
    elif isinstance(chain, ElasticTendonChain):
        sets = ((), ("base",), *_ELASTIC)
    else:
        sets = ((), ("base",), *(_EXTENSIBLE if chain.lengths is None else _TENDONS))
    rungs = [_Rung(_name(names), chain, names) for names in _with_gain(sets, chain)]
    if elastic is not None:
        sets = _with_gain(_ELASTIC, chain)
        rungs += [_Rung(_RIVAL + _name(names), elastic, names) for names in sets]
    return rungs


def _with_gain(
    sets: Sequence[tuple[str, ...]], chain: Chain
) -> Sequence[tuple[str, ...]]:
    """Return the sets with the gain beside the radii, if the chain has gains.

    Tips of tendons determine only their ratio: without the gain, its error moves into the radii.
    """
    if not isinstance(chain, ArcChain) or chain.in_metres:
        return sets
    return [(*names, "gain") if "radii" in names else names for names in sets]


def _name(names: tuple[str, ...]) -> str:
    words = [name for name in names if name not in _STIFF]
    words += ["stiffnesses"] if len(words) < len(names) else []
    return " + ".join(words) or "nothing"


def _starts(rungs: Sequence[_Rung], rows: Rows, loss: str) -> list[Start | None]:
    """Return the start of the fit of every set; initial guesses are searched if rings become free.

    Other sets start from the previous one; elastic tendons also from a plain chain with the same
    free rings.
    """
    starts: list[Start | None] = []
    for chain, names, free in (
        (rung.chain, rung.parameters, _rings(rung)) for rung in rungs
    ):
        stds = dict.fromkeys(names, 0.5)
        near = None
        far = None
        enough = False
        for one, start in zip(rungs, starts, strict=False):
            if start is not None and one.chain is chain:
                near = start
                enough = free <= _rings(one)
            elif start is not None and ("angles" in free) == ("angles" in _rings(one)):
                far = start
        if not names:
            starts.append(None)
        elif near and enough:
            starts.append(_refitted([widened(near, names, stds)], rows, loss))
        elif far is not None:
            tried = [
                widened(start, names, stds, True) for start in (near, far) if start
            ]
            starts.append(_refitted(tried, rows, loss))
        else:
            starts.append(search(chain, rows, names, loss, {}, stds))
    return starts


def _rings(rung: _Rung) -> set[str]:
    """Return the free parameters of the actuator rings that require a search."""
    free = {"angles" if name == "turns" else name for name in rung.parameters}
    return free & (
        {"angles"}
        if isinstance(rung.chain, ElasticTendonChain)
        else {"angles", "radii"}
    )


def _refitted(starts: list[Start], rows: Rows, loss: str) -> Start:
    """Return the start with the smallest error of a rough fit; the first one if nearly equal."""
    fits = [solve(start.problem, rows, start.theta, loss, ROUGH) for start in starts]
    best = min(range(len(fits)), key=lambda k: fits[k].rmse * (1.0 + (k > 0) * _ALIKE))
    return starts[best]._replace(theta=fits[best].theta)


def _splits(rows: Rows, groups: NDArray | None) -> list[tuple[NDArray, NDArray]]:
    """Return folds of motions or rows; for a single motion, of parts of it."""
    n = len(rows.q)
    if groups is not None and len(np.unique(groups)) < 2:
        groups = np.arange(n) * 10 // n
    return folds(rows.q, groups, _FOLDS, shuffle=True)


def _errors(
    rung: _Rung,
    start: Start | None,
    rows: Rows,
    splits: list[tuple[int, NDArray, NDArray]],
    loss: str,
) -> Errors:
    """Return the errors of a set; splits are (1, ...) of held-out rows, (0, ...) of outer rows."""
    totals = np.zeros((2, 2))  # of io and cv: weighted distances, and weights
    for kind, train, test in splits:
        chain = rung.chain
        training = rows.take(train)
        new = rows.take(test)
        if start is not None:
            chain = solve(start.problem, training, start.theta, loss, ROUGH).chain()
        residual = new.residual(chain)
        weight = new.weights
        totals[kind] += weight @ np.linalg.norm(residual, axis=1), weight.sum()
    with np.errstate(invalid="ignore"):
        io, cv = (totals[:, 0] / totals[:, 1]).tolist()
    return Errors(cv, io)


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


def split_by_effect(
    model: ForwardModel, q: Tensor, directions: NDArray
) -> tuple[NDArray, NDArray]:
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
