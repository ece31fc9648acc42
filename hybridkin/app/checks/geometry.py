"""Checks of a log against the nominal chain: units, order and signs of the columns, geometry."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin.app.checks.causes.alignment import Alignment, FreeBase, FreeOrigin
from hybridkin.app.checks.causes.commands import (
    FirstRow,
    OneActuator,
    Reading,
    Size,
    Zero,
    ZeroDrift,
)
from hybridkin.app.checks.causes.comparison import (
    READINGS,
    VALUES,
    CauseComparison,
    Explanation,
    compare_causes,
)
from hybridkin.app.checks.causes.evidence import Actuators, Evidence
from hybridkin.app.checks.causes.motion import Motion
from hybridkin.app.checks.order import (
    SIMPLE,
    base_turn,
    better_way,
    misses,
    other_direction,
    segment_columns,
)
from hybridkin.app.checks.report import LogFinding
from hybridkin.datasets import Log
from hybridkin.formats import METRES, in_terms
from hybridkin.native import evaluate

if TYPE_CHECKING:
    from hybridkin import LengthDrivenChain, robots

_FACTORS = (1e-3, 1e-2, 1e-1, 10.0, 100.0, 1000.0)
_ROWS = 500  # enough to distinguish a robot from its mirror image
_FEW = 150  # for many changes
_FEWEST = 10
_CONVERT = (
    "set `spool_radius` (of motors) or `gain` (of pressures or steps: metres per unit) in every "
    "[[segment]] of the robot description (`gains` of a chain)"
)
_TURNS = (
    "If these are encoders, read with `unwrap` or not, `zeros` can be whole turns off: add or "
    "subtract turns there."
)
_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
_REACH = 5.0  # impossible range of the tip over the reach of the robot
_USUAL_REACH = 0.7
# Too small, usual, too large: strokes over radii (a bend, in rad); chamber lengths over radii.
_BEND = (0.02, 1.0, 15.0)
_LONG = (0.05, 3.0, 100.0)
_LONGEST = 10.0  # [m] a longer robot, or one with radii of a tenth, is described in millimetres
_SMALL_RANGE = 0.04  # range of the tip relative to that of the model
_FAR_BETTER = 0.6  # error of another reading relative to that of the declared one
_GOOD = 0.55  # relative error of another reading
_ENOUGH = 0.85  # explained part of the variance
_TWIST = 120.0  # [deg] least rotation of a base about its axis
_TILT = 45.0  # [deg] largest tilt of a base
_FAR_FEWER = 0.6  # error of many changes relative to that of one, from which they are named
_WORTH = 0.3  # relative error from which columns of q and x may be exchanged
_UNBALANCED = 0.1  # the same, from which tendons are not in balance
_MOST_FLIPPED = 3  # signs that balance can correct
_BALANCED = 0.02  # of the spread of the tendons: motion along a direction that counts as none
_SHIFTED = 0.87  # relative error; for clean logs, simulated and real, it was above 0.89
# Fewer rows need a far lower one: of 16 draws of 25 rows by `choose_rows` from the simulated trunk
# three were below 0.87, of 50 rows none was below 0.9.
_FEW_ROWS = 50
_ADVICE = {
    "axes": "check order and signs of the columns of x, which must be right-handed, and [base] of "
    'the description; or list "base" in `calibrate`.',
    "size": "check `radius` of every [[segment]], half the diameter of the circle on which the "
    'actuators lie, and the unit of q; or list "radii" in `calibrate`.',
    "offset": "correct its zero, or list the zeros (`actuator_zeros` or `tendon_zeros`) in "
    "`calibrate`.",
    "zeros": "set `zeros` in every [[segment]] to the values of the straight robot; `hybridkin "
    "init` proposes them.",
    "drift": "look for a slipping spool or sensor; fit the parts of the log separately.",
    "geometry": "check which columns are q and x, their order, the zero of each actuator, the "
    "angles, the routing, the lengths and, if it is not fitted, [base].",
    "whole": "subtract from each column its value at the straight robot, or give these values as "
    "`zeros` of every [[segment]], which `hybridkin init` proposes; or, for chambers that stretch, "
    "remove `length` from every [[segment]].",
    "changes": "if the log holds changes of length, add the length at rest to each; or, for a "
    "robot with tendons on a backbone of fixed length, give `length` in every [[segment]].",
}


def geometry_findings(log: Log, chain: LengthDrivenChain, base_is_free: bool) -> list[LogFinding]:
    """Return contradictions to the chain: those of the first check that finds any."""
    findings = [*_negated_zeros(log, chain)]
    if findings:
        return findings
    layout = chain.actuator_layout
    rest = chain.metres(torch.from_numpy(layout.rest)).detach().cpu().numpy()
    layout = layout._replace(rest=rest)
    log, chain = _in_metres(log, chain)
    layout = layout._replace(balance=chain.actuator_layout.balance)
    comparison = _Comparison(log, chain, layout, base_is_free)
    checks = _CHECKS_OF_VALUES
    if comparison.comparable:
        checks += _CHECKS_OF_MOTION
    for check in checks:
        findings = [*check(comparison)]
        if findings:
            break
    return findings


def _in_metres(log: Log, chain: LengthDrivenChain) -> tuple[Log, LengthDrivenChain]:
    """Return the log and the chain with q in metres."""
    if chain.in_metres:
        return log, chain
    q = chain.metres(torch.from_numpy(log.q)).detach().cpu().numpy()
    plain = {"gains": torch.ones_like(chain.gains)}
    if "actuator_zeros" in chain.geometry():
        plain["actuator_zeros"] = torch.zeros_like(chain.gains)
    return replace(log, q=q, units={**log.units, "q": "m"}), chain.with_geometry(**plain)


class _Comparison:
    """A log and its nominal chain, both in metres, and numbers that several checks need.

    Relative errors are those of `misses`.
    """

    def __init__(
        self,
        log: Log,
        chain: LengthDrivenChain,
        layout: robots.ActuatorLayout,
        base_is_free: bool,
    ) -> None:
        self.log = log
        self.chain = chain
        self.layout = layout
        self.base_is_free = base_is_free
        self.q_names = log.column_names("q")
        self.radii = chain.radii.detach().cpu().double().numpy()
        self.all_extensible = chain.lengths is None
        self.length = 0.0
        if chain.lengths is not None:
            self.length = float(chain.lengths.detach().sum())
        counts = chain.actuators_per_segment
        self.absolute = chain.absolute.cpu().numpy()
        self.pulled = ~np.repeat(chain.extensible, counts)
        self.segments = segment_columns(counts)
        rows = np.linspace(0, len(log.q) - 1, min(len(log.q), _ROWS)).astype(int)
        self.q = log.q[rows]
        self.x = log.x[rows]
        few = slice(None, None, -(-len(rows) // _FEW))
        self.few_q = self.q[few]
        self.few_x = self.x[few]

    @property
    def comparable(self) -> bool:
        """Whether there are enough rows, and tips that move."""
        return len(self.q) >= _FEWEST and bool(np.ptp(self.x, axis=0).any())

    def error(self, q: NDArray, x: NDArray, base_is_free: bool = True) -> float:
        """Return the relative error of the chain on rows q and x."""
        return float(misses(self.chain, q[None], x, base_is_free)[0])

    @cached_property
    def declared_error(self) -> float:
        """The relative error on the log as declared."""
        return self.error(self.q, self.x, self.base_is_free)

    @property
    def good_error(self) -> float:
        """Errors of other readings below this one are far better."""
        return min(_FAR_BETTER * self.declared_error, _GOOD)

    @cached_property
    def better_way(self) -> tuple[NDArray, float]:
        """A better way to read the columns of q, and its relative error."""
        return better_way(self.chain, self.q, self.x, self.base_is_free)

    def _evidence(self, alignment: Alignment) -> Evidence:
        """Return the few rows as evidence."""
        n_rows = len(self.few_q)
        q = self.few_q
        per_unit = np.full(q.shape[1], 1e-3)
        return Evidence(
            motion=Motion.of(q, None, None),
            rows=np.arange(n_rows),
            x=self.few_x,
            model=self.chain,
            path=evaluate(self.chain, q)[0],
            bodies=[self.chain],
            actuators=Actuators(self.q_names, "mm", per_unit, self.layout),
            inside=np.ones(n_rows, dtype=bool),
            off_plane=np.zeros_like(q),
            promised=0.0,
            low=q.min(axis=0),
            high=q.max(axis=0),
            alignment=alignment,
        )

    def imbalance(self, q: NDArray) -> float:
        """Return how far rows q (N, n) move where tendons in balance do not, of all motion."""
        balance = self.layout.balance
        moved = q - q.mean(axis=0)
        size = max(float(np.linalg.norm(moved)), np.finfo(float).tiny)
        return float(np.linalg.norm(moved @ balance)) / size

    def keeps_balance(self, way: NDArray) -> bool:
        """Return whether tendons are as much in balance with another way to read the columns."""
        declared = max(self.imbalance(self.q), _BALANCED)
        return self.imbalance(self.q @ way) < 2.0 * declared

    def read(self, q: NDArray, way: NDArray) -> NDArray:
        """Return rows q (N, n) that are read in another way; rest stays rest."""
        return self.layout.rest + (q - self.layout.rest) @ way

    @cached_property
    def reading(self) -> tuple[NDArray, float]:
        """The best single change of how the columns are read, and its relative error."""
        alignment = FreeBase() if self.base_is_free else FreeOrigin()
        compared = compare_causes(self._evidence(alignment), READINGS)
        best = np.eye(self.q.shape[1], dtype=int)
        least = self.declared_error
        for explanation in compared.explanations:
            assert isinstance(explanation.cause, Reading)
            way = explanation.cause.way(compared.evidence).astype(int)
            error = self.error(self.read(self.q, way), self.x, self.base_is_free)
            if error * SIMPLE < least and self.keeps_balance(way):
                best = way
                least = error
        return best, least

    @cached_property
    def values(self) -> CauseComparison:
        """Wrong values compared: the size of the bends, zeros, drifts."""
        return compare_causes(self._evidence(FreeBase()), VALUES)

    @property
    def better_values(self) -> float:
        """The error with the best wrong value, relative to that without."""
        return self.values.best.mean / self.values.nothing.mean

    def better(self, error: float, reading: str) -> str:
        """Return a message that another reading explains more of the motion."""
        declared = _explained(self.declared_error)
        return (
            f"the nominal model explains {declared} of the tip's motion as declared, but "
            f"{_explained(error)} with {reading}."
        )


def _explained(error: float) -> str:
    return f"{100 * max(1 - error**2, 0.0):.0f} %"


def _negated_zeros(log: Log, chain: LengthDrivenChain) -> Iterator[LogFinding]:
    """Yield a finding if no row is near the zeros of tendons, but rows are near their negatives."""
    tendons = (~chain.absolute & (chain.rest != 0.0)).cpu().numpy()
    rest = chain.rest.detach().cpu().numpy()[tendons]
    low = log.q[:, tendons].min(axis=0)
    high = log.q[:, tendons].max(axis=0)
    beyond = np.maximum(low - rest, rest - high) > 0.5 * (high - low)
    if tendons.any() and (beyond & (low <= -rest) & (-rest <= high)).all():
        message = "no row is near the `zeros` of the tendons, but rows are near their negatives."
        advice = "negate `zeros` (`actuator_zeros` of a chain): their sign is that after `q_sign`."
        yield LogFinding("sign", "error", message, advice)


def _no_lengths(comparison: _Comparison) -> Iterator[LogFinding]:
    """Yield a finding if q holds no lengths, lengths instead of changes, or the reverse."""
    log = comparison.log
    if log.units["q"] != "m":
        message = f"the actuators of the robot are lengths, but q is in {log.file_units['q']}."
        yield LogFinding("units", "error", message, f"{_CONVERT}.")
        return
    low = log.q.min(axis=0)
    high = log.q.max(axis=0)
    kind = "geometry"
    columns = comparison.absolute
    pulled = comparison.pulled
    if not (low > 0)[columns].all():
        needed = "chambers, whose q are positive lengths"
        advice = _ADVICE["changes"]
        negative = columns & (high < 0)
        if ((low > 0) | negative)[columns].all():
            kind = "sign"
            advice = _sign_advice(log, np.diag(np.where(negative, -1, 1)))
    elif pulled.any() and (low > 0.1 * high)[pulled].all():
        needed = "tendons, whose q are changes of length"
        columns = pulled
        advice = _ADVICE["whole"] + _about_turns(log.file_units["q"])
    else:
        return
    span = f"{1e3 * low[columns].min():.4g} and {1e3 * high[columns].max():.4g} mm"
    message = f"the robot is described with {needed}, but q lies between {span}."
    yield LogFinding(kind, "error", message, advice)


def _wrong_units(comparison: _Comparison) -> Iterator[LogFinding]:
    """Yield a finding if lengths of actuators or the range of the tip are impossible."""
    log = comparison.log
    radii = comparison.radii
    length = comparison.length
    for columns in comparison.segments:
        length += (comparison.absolute * log.q)[:, columns].mean()
    if comparison.all_extensible:
        subject = "the chambers are"
        size = float(np.median(log.q[:, comparison.absolute]))
        radius = radii.mean()
        low, usual, high = _LONG
        if not low <= size / radius <= high:
            # The length is that of q; its unit is checked next.
            length /= _factor(size / radius, usual)
    else:
        subject = "the longest stroke is"
        size, radius = _longest_stroke(comparison)
        low, usual, high = _BEND
    stroke = size / radius
    tip_range = float(np.linalg.norm(np.ptp(log.x, axis=0)))
    reach = tip_range / (length + float(comparison.chain.offsets.detach().abs().sum()))
    q_factor = None
    may_be_small = comparison.all_extensible or reach > 0.1 or stroke < low / 4
    if stroke > high or (stroke < low and may_be_small):
        q_factor = _factor(stroke, usual)
    x_factor = None
    if reach > _REACH:
        x_factor = _factor(reach, _USUAL_REACH)
    else:
        relative_range = tip_range / _model_range(comparison, q_factor or 1.0)
        if 0.0 < relative_range < _SMALL_RANGE:
            x_factor = _factor(relative_range, 1.0)
    if q_factor is None and x_factor is None:
        return
    if max(comparison.length, 10.0 * radii.max()) > _LONGEST:
        message = (
            f"the robot is described with a length of {comparison.length:g} m and radii up to "
            f"{radii.max():g} m, which look like millimetres; q and x do not fit to them."
        )
        advice = (
            "give radii, lengths and offsets of the description in metres: divide them by 1000."
        )
        yield LogFinding("units", "error", message, advice)
        return
    if q_factor is not None:
        radius_text = f"{stroke:.3g} times the radii ({1e3 * radius:.4g} mm)"
        problem = f"{subject} {1e3 * size:.4g} mm, {radius_text}"
        yield _unit_finding("q", problem, log.file_units["q"], q_factor)
    if x_factor is not None:
        problem = f"the tip moves within {1e3 * tip_range:.4g} mm, {reach:.3g} of the robot's reach"
        yield _unit_finding("x", problem, log.file_units["x"], x_factor)


def _longest_stroke(comparison: _Comparison) -> tuple[float, float]:
    """Return the stroke of the tendon that bends most, and its radius times its segments [m].

    A tendon bends its own segment and, with routing "base", all segments before it.
    """
    chain = comparison.chain
    n_bent = 1 + np.arange(chain.n_segments) - np.array(chain.starts)
    radii = np.repeat(n_bent * comparison.radii, chain.actuators_per_segment)
    radii = radii[comparison.pulled]
    strokes = np.abs(comparison.log.q).max(axis=0)[comparison.pulled]
    longest = int(np.argmax(strokes / radii))
    return strokes[longest], radii[longest]


def _model_range(comparison: _Comparison, q_factor: float) -> float:
    """Return the range of the chain's tips with q divided by a factor [m]."""
    q = comparison.log.q
    few = torch.from_numpy(q[:: max(1, len(q) // _ROWS)] / q_factor)
    with torch.no_grad():
        tips = comparison.chain(few).cpu().numpy()
    return max(float(np.linalg.norm(np.ptp(tips, axis=0))), np.finfo(float).tiny)


def _factor(ratio: float, usual: float) -> float:
    """Return the factor by which a value is too large or too small, as a power of ten."""
    off = [abs(np.log(max(ratio, 1e-300) / factor / usual)) for factor in _FACTORS]
    return _FACTORS[int(np.argmin(off))]


def _unit_finding(name: str, what: str, unit: str, factor: float) -> LogFinding:
    where = f"in [log] of the robot description or --{name}-unit"
    looks = f"they are off by about {factor:g}"
    remedy = f"check `{name}_unit` {where}"
    if name == "q":
        remedy = f"if these are not lengths, {_CONVERT}"
    for other, words in _NAMES.items():
        if np.isclose(METRES[other] * factor, METRES.get(unit, 0.0)):
            looks = f"these look like {words}"
            remedy = f'set {name}_unit = "{other}" {where} {other}'
    message = f"columns of {name} are declared as {unit}, but {what}; {looks}."
    advice = f"{remedy}; or correct the radii and lengths of the description, in metres."
    if name == "q":
        advice += _about_turns(unit)
    return LogFinding("units", "error", message, advice)


def _about_turns(unit: str) -> str:
    """Return what else can be wrong if q is in the unit of an encoder; of lengths nothing."""
    return "" if unit in METRES else f" {_TURNS}"


def _only_lengthened(comparison: _Comparison) -> Iterator[LogFinding]:
    pulls = comparison.log.q[:, comparison.pulled]
    if not comparison.all_extensible and pulls.max() > 20 * max(-pulls.min(), 0.0):
        message = "the tendons are only lengthened, never shortened; shortening must be negative."
        yield LogFinding("sign", "warning", message, _flip_advice(comparison))


def _turned_axes(comparison: _Comparison) -> Iterator[LogFinding]:
    """Yield a finding if the axes of the tip are rotated or mirrored, for a fixed base."""
    if comparison.base_is_free:
        return
    q = comparison.q
    x = comparison.x
    way, _ = comparison.better_way
    rotated = comparison.error(q, x)
    mirrored = comparison.error(q, x * [-1.0, 1.0, 1.0])
    reread = comparison.error(q @ way, x)
    if min(rotated, mirrored) < min(comparison.good_error, _FAR_BETTER * reread):
        how = "rotated"
        if mirrored < rotated:
            how = "rotated, and one of them mirrored"
        reading = f"the axes of the tip {how}"
        message = comparison.better(min(rotated, mirrored), reading)
        yield LogFinding("axes", "warning", message, _ADVICE["axes"])


def _exchanged_columns(comparison: _Comparison) -> Iterator[LogFinding]:
    """Yield a column of q and one of x that explain far more if they are exchanged."""
    least = comparison.better_way[1]
    if least < _WORTH:
        return
    exchanges = []
    for i, j in itertools.product(range(comparison.q.shape[1]), range(3)):
        q = comparison.few_q.copy()
        x = comparison.few_x.copy()
        q[:, i] = comparison.few_x[:, j]
        x[:, j] = comparison.few_q[:, i]
        exchanges.append((comparison.error(q, x), i, j))
    error, i, j = min(exchanges)
    if error < min(comparison.good_error, _FAR_BETTER * least):
        axis = comparison.log.column_names("x")[j]
        reading = f"columns {comparison.q_names[i]!r} and {axis!r} exchanged"
        message = comparison.better(error, reading)
        yield LogFinding("exchanged", "warning", message, "exchange these two columns.")


def _unbalanced(comparison: _Comparison) -> Iterator[LogFinding]:
    """Yield the fewest changes with which the tendons of a log are in balance, as never without."""
    if comparison.imbalance(comparison.q) < _UNBALANCED:
        return
    for ways in _few_changes(comparison.layout):
        balanced = []
        for way in ways:
            if comparison.imbalance(comparison.few_q @ way) < _BALANCED:
                error = comparison.error(comparison.few_q @ way, comparison.few_x)
                balanced.append((error, len(balanced), way))
        if balanced:
            break
    else:
        return
    way = min(balanced)[-1]
    names = comparison.q_names
    of_log = in_terms(way @ comparison.layout.balance, names).split("; ")
    of_tendons = in_terms(comparison.layout.balance, names).split("; ")
    never = "; ".join(term for term in of_log if term not in of_tendons)
    wanted = "; ".join(term for term in of_tendons if term not in of_log)
    kind, causes, advice = _reading_in_words(comparison, way)
    message = (
        f"the log has no motion along {never}, but tendons that do not pull against each other "
        f"have none along {wanted}, as with {causes}."
    )
    yield LogFinding(kind, "warning", message, advice)


def _few_changes(layout: robots.ActuatorLayout) -> Iterator[list[NDArray]]:
    """Yield the ways with one change that balance can show, then those with more signs."""
    n = len(layout.rest)
    declared = np.eye(n, dtype=int)
    single = []
    for one, other in itertools.combinations(layout.segments, 2):
        for i, j in itertools.product(one, other):
            order = np.arange(n)
            order[[i, j]] = [j, i]
            single.append(declared[:, order])
    for n_flipped in range(1, _MOST_FLIPPED + 1):
        ways = single if n_flipped == 1 else []
        for flipped in itertools.combinations(range(n), n_flipped):
            signs = np.ones(n, dtype=int)
            signs[[*flipped]] = -1
            ways = [*ways, np.diag(signs)]
        yield ways


def _misread_columns(comparison: _Comparison) -> Iterator[LogFinding]:
    """Yield another numbering, order or signs of the columns of q that explain far more."""
    way, error = comparison.reading
    limit = min(comparison.good_error, comparison.better_values * comparison.declared_error)
    many, error_of_many = comparison.better_way
    if error_of_many < _FAR_FEWER * error and comparison.keeps_balance(many):
        way = many
        error = error_of_many
    if error >= limit:
        return
    kind, causes, advice = _reading_in_words(comparison, way)
    yield LogFinding(kind, "warning", comparison.better(error, causes), advice)


def _reading_in_words(comparison: _Comparison, way: NDArray) -> tuple[str, str, str]:
    """Return the kind of another way to read the columns of q, what is wrong, and advice."""
    log = comparison.log
    chain = comparison.chain
    order = np.abs(way).argmax(axis=0).tolist()
    sign = way.sum(axis=0)
    names = [comparison.q_names[i] for i in order]
    kind = "sign"
    causes = []
    advice = []
    if order == other_direction(chain.actuators_per_segment):
        kind = "numbering"
        causes.append("the actuators numbered in the other direction")
        first, second = chain.angles[:2].tolist()
        clockwise = str(np.sin(second - first) > 0).lower()
        advice.append(
            f"set clockwise = {clockwise} in every [[segment]] (or negate angles_deg); the axes "
            "of the tip must be right-handed."
        )
    elif names != comparison.q_names:
        kind = "order"
        causes.append(f"the columns of q in the order {', '.join(names)}")
        if log.q_names:
            listed = json.dumps(names)
            advice.append(f"set q = {listed} in [log] of the robot description.")
        else:
            advice.append(f"use q[:, {order}].")
    if min(sign) < 0:
        flipped = "q"
        if max(sign) > 0:
            flipped = ", ".join(repr(names[i]) for i in np.flatnonzero(sign < 0))
        causes.append(f"the sign of {flipped} flipped")
        advice.append(_sign_advice(log, way))
    return kind, " and ".join(causes), " ".join(advice)


def _turned_base(comparison: _Comparison) -> Iterator[LogFinding]:
    """Yield a finding if the base must turn by half a turn, as after a wrong sign of tendons."""
    if comparison.all_extensible or not comparison.base_is_free:
        return
    twist, tilt = base_turn(comparison.chain, comparison.q, comparison.x)
    if abs(twist) > _TWIST and tilt < _TILT:
        message = (
            f"the base must be rotated by {twist:.0f} degrees about its axis to fit the tips, but "
            f"only by {twist - np.copysign(180, twist):.0f} degrees with the sign of q flipped."
        )
        mounted = "Or, if the robot is mounted so, give the rotation in [base] (`base` of a chain)."
        advice = f"{_flip_advice(comparison)} {mounted}"
        yield LogFinding("sign", "warning", message, advice)


def _changed_values(comparison: _Comparison) -> Iterator[LogFinding]:
    """Yield wrong radii, zeros or the drift of one actuator, that explain far more."""
    compared = comparison.values
    eligible = []
    for explanation in compared.explanations:
        largest = _VALUES[type(explanation.cause)][1]
        if len(comparison.few_q) < _FEW_ROWS:
            largest = min(largest, _FAR_BETTER)
        if explanation.mean < largest * compared.nothing.mean:
            eligible.append(explanation)
    if not eligible:
        return
    best = compared.simplest(eligible)
    kind, _, words = _VALUES[type(best.cause)]
    ratio = best.mean / compared.nothing.mean
    message = (
        f"the error of the nominal model falls to {100 * ratio:.0f} % if {words(comparison, best)}."
    )
    advice = _ADVICE[kind]
    if kind in ("offset", "zeros"):
        advice += _about_turns(comparison.log.file_units["q"])
    yield LogFinding(kind, "warning", message, advice)


def _in_words(comparison: _Comparison, best: Explanation) -> str:
    """Return how large a wrong value is."""
    return best.cause.amount(comparison.values.evidence, best.parameters)


def _shift_in_words(comparison: _Comparison, best: Explanation) -> str:
    """Return the actuator with another zero, and how far it is off or drifts."""
    assert isinstance(best.cause, OneActuator)
    verb = "is off" if isinstance(best.cause, Zero) else "drifts"
    far = 1e3 * abs(float(best.parameters[0]))
    return f"actuator {comparison.q_names[best.cause.actuator]!r} {verb} by about {far:.1g} mm"


def _unexplained(comparison: _Comparison) -> Iterator[LogFinding]:
    """Yield a finding if the chain explains little of the motion of the tip."""
    error = comparison.declared_error
    if 1 - error**2 < _ENOUGH:
        explained = f"{_explained(error)} of the tip's motion, in any order and sign of q"
        message = f"the nominal model explains only {explained}."
        yield LogFinding("geometry", "warning", message, _ADVICE["geometry"])


def _flip_advice(comparison: _Comparison) -> str:
    """Return the advice to flip the signs of all tendons."""
    flipped = np.diag(np.where(comparison.pulled, -1, 1))
    return _sign_advice(comparison.log, flipped)


def _sign_advice(log: Log, way: NDArray) -> str:
    """Return the advice to set the signs of a way of reading the columns."""
    sign = np.broadcast_to(log.q_sign, len(way)) @ way
    if np.ptp(sign) > 0:
        return f"set q_sign = {sign.tolist()} in [log] of the robot description."
    return f"set q_sign = {sign[0]} in [log] of the robot description, or --q-sign={sign[0]}."


_VALUES = {
    Size: ("size", _FAR_BETTER, _in_words),
    Zero: ("offset", _SHIFTED, _shift_in_words),
    ZeroDrift: ("drift", _SHIFTED, _shift_in_words),
    FirstRow: ("zeros", _SHIFTED, _in_words),
}
"""Kind of the finding, largest relative error that is worth a word, and words of a wrong value."""

_Check = Callable[[_Comparison], Iterator[LogFinding]]
_CHECKS_OF_VALUES: tuple[_Check, ...] = (_no_lengths, _wrong_units, _only_lengthened)
_CHECKS_OF_MOTION: tuple[_Check, ...] = (
    _turned_axes,
    _exchanged_columns,
    _unbalanced,
    _misread_columns,
    _turned_base,
    _changed_values,
    _unexplained,
)
