"""Checks of a log against the nominal chain: units, signs and numbering of the actuators."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin._core.units import METRES
from hybridkin.datasets._log_order import Way, base_turn, better_way, changes, misses
from hybridkin.datasets._log_report import LogFinding
from hybridkin.datasets._logs import Log, column_names

_FACTORS = (1e-3, 1e-2, 1e-1, 10.0, 100.0, 1000.0)
_ROWS = 500  # enough to distinguish a robot from its mirror image
_FEW = 150  # for many changes
_CONVERT = (
    "set `spool_radius` (of motors) or `gain` (of pressures or steps: metres per unit) in every "
    "[[segment]] of the robot description (`gains` of a chain)"
)
_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
_REACH = 5.0  # impossible range of the tip over the reach of the robot
_USUAL_REACH = 0.7
# Too small, usual, too large: strokes over radii (a bend, in rad); chamber lengths over radii.
_BEND = (0.02, 1.0, 15.0)
_LONG = (0.05, 3.0, 100.0)
_LONGEST = 10.0  # [m] a longer robot, or one with radii of a tenth, is described in millimetres
_SMALL_SHARE = 0.04  # range of the tip relative to that of the model
_FAR_BETTER = (
    0.6  # missed motion of another reading relative to that of the declared one
)
_GOOD = 0.55  # missed motion of another reading
_ENOUGH = 0.85  # explained share of the variance
_TWIST = 120.0  # [deg] least rotation of a base about its axis
_TILT = 45.0  # [deg] largest tilt of a base
# Factors on all bends that are tried.
_BENDS = (
    0.25,
    0.4,
    0.5,
    0.65,
    1.5,
    2.0,
    2.5,
    4.0,
)
# Offsets, in standard deviations.
_SHIFTS = (
    -2.0,
    -1.0,
    -0.5,
    -0.25,
    0.25,
    0.5,
    1.0,
    2.0,
)
_SHIFTED = 0.87  # relative missed motion; for clean logs, simulated and real, it was above 0.89
_SIMPLE = 1.1  # an earlier change in the list is chosen if it is nearly as good
_ADVICE = {
    "axes": "check order and signs of the columns of x, which must be right-handed, and [base] of "
    'the description; or list "base" in `calibrate`.',
    "size": "check `radius` of every [[segment]], half the diameter of the circle on which the "
    'actuators lie, and the unit of q; or list "radii" in `calibrate`.',
    "offset": "correct its zero, or list the zeros (`actuator_zeros` or `tendon_zeros`) in "
    "`calibrate`.",
    "drift": "look for a slipping spool or sensor; fit the parts of the log separately.",
    "geometry": "check which columns are q and x, their order, the zero of each actuator, the "
    "angles, the routing, the lengths and, if it is not fitted, [base].",
    "whole": "subtract from each column its value at the straight robot; or, for chambers that "
    "stretch, remove `length` from every [[segment]].",
    "changes": "if the log holds changes of length, add the length at rest to each; or, for a "
    "robot with tendons on a backbone of fixed length, give `length` in every [[segment]].",
}


class _Robot:
    """The numbers of a nominal chain, for the comparison with a log."""

    def __init__(self, chain: Any) -> None:
        self.chain = chain
        self.radii = chain.radii.detach().cpu().double().numpy()
        self.offsets = float(chain.offsets.detach().abs().sum())
        self.extensible = chain.lengths is None
        self.length = 0.0 if self.extensible else float(chain.lengths.detach().sum())
        self.ends = np.cumsum(chain.actuators_per_segment)[:-1]
        self.absolute = chain.absolute.cpu().numpy()
        self.pulled = ~np.repeat(chain.extensible, chain.actuators_per_segment)

    def tips(self, q: NDArray) -> NDArray:
        """Return the tips (N, 3) of rows q [m]."""
        with torch.no_grad():
            return (
                self.chain(torch.from_numpy(np.ascontiguousarray(q, dtype=float)))
                .cpu()
                .numpy()
            )

    def changed(self, q: NDArray) -> dict[tuple[str, float, float], NDArray]:
        """Return rows q after each tried change of their values.

        The changes are a factor on all bends, as from wrong radii, and an offset or a drift of one
        actuator, in standard deviations.
        """
        straight = np.zeros_like(q)
        for columns in np.split(np.arange(q.shape[1]), self.ends):
            straight[:, columns] = q[:, columns].mean(axis=1, keepdims=True)
        straight[:, self.pulled] = 0.0
        changed = {}
        for factor in _BENDS:
            changed["size", factor, 0.0] = straight + factor * (q - straight)
        growth = {"offset": np.ones(len(q)), "drift": np.linspace(0.0, 1.0, len(q))}
        for kind, shape in growth.items():
            for i, by in itertools.product(range(q.shape[1]), _SHIFTS):
                shifted = q.copy()
                shifted[:, i] += by * q[:, i].std() * shape
                changed[kind, i, by] = shifted
        return changed


def in_metres(log: Log, chain: Any) -> tuple[Log, Any]:
    """Return the log and the chain with q in metres, if the chain has gains."""
    if chain is None or chain.in_metres:
        return log, chain
    q = chain.metres(torch.from_numpy(log.q.astype(float))).detach().cpu().numpy()
    plain = {"gains": chain.gains / chain.gains}
    if "actuator_zeros" in chain.geometry():
        plain["actuator_zeros"] = 0.0 * chain.gains
    return replace(log, q=q, units={**log.units, "q": "m"}), chain.with_geometry(
        **plain
    )


def geometry_findings(log: Log, chain: object, base_is_free: bool) -> list[LogFinding]:
    """Return contradictions to the chain; units first, because the other checks need them."""
    robot = _Robot(chain)
    findings = [*_kind_findings(log, robot)] or [*_unit_findings(log, robot)]
    return findings or [*_orientation_findings(log, robot, base_is_free)]


def zero_findings(log: Log, chain: Any) -> Iterator[LogFinding]:
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


def _kind_findings(log: Log, robot: _Robot) -> Iterator[LogFinding]:
    """Yield a finding if q holds no lengths, lengths instead of changes, or the reverse."""
    if log.units["q"] != "m":
        message = f"the actuators of the robot are lengths, but q is in {log.file_units['q']}."
        yield LogFinding("units", "error", message, f"{_CONVERT}.")
        return
    low = log.q.min(axis=0)
    high = log.q.max(axis=0)
    kind = "geometry"
    if not (low > 0)[robot.absolute].all():
        needed = "chambers, whose q are positive lengths"
        columns = robot.absolute
        advice = _ADVICE["changes"]
        negative = columns & (high < 0)
        if ((low > 0) | negative)[columns].all():
            kind = "sign"
            advice = _sign_advice(log, _signs(np.where(negative, -1, 1)))
    elif robot.pulled.any() and (low > 0.1 * high)[robot.pulled].all():
        needed = "tendons, whose q are changes of length"
        columns = robot.pulled
        advice = _ADVICE["whole"]
    else:
        return
    span = f"{1e3 * low[columns].min():.4g} and {1e3 * high[columns].max():.4g} mm"
    message = f"the robot is described with {needed}, but q lies between {span}."
    yield LogFinding(kind, "error", message, advice)


def _unit_findings(log: Log, robot: _Robot) -> Iterator[LogFinding]:
    q = log.q
    radii = robot.radii
    lengths = np.split(robot.absolute * q, robot.ends, axis=1)
    length = robot.length + sum(part.mean() for part in lengths)
    if robot.extensible:
        size = float(np.median(q[:, robot.absolute]))
        radius = radii.mean()
        low, usual, high = _LONG
        if not low <= size / radius <= high:
            # The length is that of q; its unit is checked next.
            length /= _factor(size / radius, usual)
    else:
        size, radius = _longest_stroke(q, robot)
        low, usual, high = _BEND
    stroke = size / radius
    spread = float(np.linalg.norm(np.ptp(log.x, axis=0)))
    reach = spread / (length + robot.offsets)
    small = stroke < low and (robot.extensible or reach > 0.1 or stroke < low / 4)
    q_factor = _factor(stroke, usual) if stroke > high or small else None
    x_factor = _factor(reach, _USUAL_REACH) if reach > _REACH else None
    if x_factor is None:
        tips = robot.tips(q[:: max(1, len(q) // _ROWS)] / (q_factor or 1.0))
        relative_spread = spread / max(
            float(np.linalg.norm(np.ptp(tips, axis=0))), np.finfo(float).tiny
        )
        if 0.0 < relative_spread < _SMALL_SHARE:
            x_factor = _factor(relative_spread, 1.0)
        else:
            x_factor = None
    if max(robot.length, 10.0 * radii.max()) > _LONGEST and (q_factor or x_factor):
        message = (
            f"the robot is described with a length of {robot.length:g} m and radii up to "
            f"{radii.max():g} m, which look like millimetres; q and x do not fit to them."
        )
        advice = (
            "give radii, lengths and offsets of the description in metres: "
            "divide them by 1000."
        )
        yield LogFinding("units", "error", message, advice)
        return
    if q_factor is not None:
        problem = "the chambers are" if robot.extensible else "the longest stroke is"
        problem += f" {1e3 * size:.4g} mm, {stroke:.3g} times the radii ({1e3 * radius:.4g} mm)"
        yield _unit_finding("q", problem, log.file_units["q"], q_factor)
    if x_factor is not None:
        problem = f"the tip moves within {1e3 * spread:.4g} mm, {reach:.3g} of the robot's reach"
        yield _unit_finding("x", problem, log.file_units["x"], x_factor)


def _longest_stroke(q: NDArray, robot: _Robot) -> tuple[float, float]:
    """Return the stroke of the tendon that bends most, and the radius that it has there [m].

    A tendon bends its own segment and, with routing "base", all segments before it.
    """
    spans = np.cumsum(robot.radii) if robot.chain.routing == "base" else robot.radii
    spans = np.repeat(spans, robot.chain.actuators_per_segment)[robot.pulled]
    strokes = np.abs(q).max(axis=0)[robot.pulled]
    most = int(np.argmax(strokes / spans))
    return strokes[most], spans[most]


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
    advice = (
        f"{remedy}; or correct the radii and lengths of the description, in metres."
    )
    return LogFinding("units", "error", message, advice)


def _signs(sign: NDArray) -> Way:
    return Way((*range(len(sign)),), tuple(sign.tolist()))


def _sign_advice(log: Log, way: Way) -> str:
    """Return the advice to set the signs of a way of reading the columns."""
    sign = (
        np.array(way.sign) * np.broadcast_to(log.q_sign, len(way.sign))[list(way.order)]
    )
    if np.ptp(sign) > 0:
        return f"set q_sign = {sign.tolist()} in [log] of the robot description."
    return f"set q_sign = {sign[0]} in [log] of the robot description, or --q-sign={sign[0]}."


def _orientation_findings(
    log: Log, robot: _Robot, base_is_free: bool
) -> Iterator[LogFinding]:
    chain = robot.chain
    flip = _sign_advice(log, _signs(np.where(robot.pulled, -1, 1)))
    pulls = log.q[:, robot.pulled]
    if not robot.extensible and pulls.max() > 20 * max(-pulls.min(), 0.0):
        message = "the tendons are only lengthened, never shortened; shortening must be negative."
        yield LogFinding("sign", "warning", message, flip)
        return
    rows = np.linspace(0, len(log.q) - 1, min(len(log.q), _ROWS)).astype(int)
    q = log.q[rows]
    x = log.x[rows]
    if len(rows) < 10 or not np.ptp(x, axis=0).any():
        return
    missed = float(misses(chain, q[None], x, base_is_free)[0])
    free = float(misses(chain, q[None], x, True)[0])
    image = float(misses(chain, q[None], x * [-1.0, 1.0, 1.0], True)[0])
    turned = min(free, image)
    good = min(_FAR_BETTER * missed, _GOOD)
    compared = f"the nominal model explains {_share(missed)} of the tip's motion as declared, but "
    way, least = better_way(chain, q, x, base_is_free)
    reread = float(misses(chain, way.of(q)[None], x, True)[0])
    if not base_is_free and turned < min(good, _FAR_BETTER * reread):
        how = "rotated, and one of them mirrored" if image < free else "rotated"
        message = f"{compared}{_share(turned)} with the axes of the tip {how}."
        yield LogFinding("axes", "warning", message, _ADVICE["axes"])
        return
    few = slice(None, None, -(-len(q) // _FEW))
    exchanged, i, j = _exchanged(chain, q[few], x[few])
    if exchanged < min(good, _FAR_BETTER * least):
        name = column_names(log, "q")[i]
        axis = column_names(log, "x")[j]
        message = f"{compared}{_share(exchanged)} with columns {name!r} and {axis!r} exchanged."
        yield LogFinding("exchanged", "warning", message, "exchange these two columns.")
        return
    changed = robot.changed(q[few])
    scores = misses(chain, np.stack([*changed.values()]), x[few], True)
    kind, i, by = [*changed][int(np.argmax(scores < _SIMPLE * scores.min()))]
    gain = float(scores.min() / misses(chain, q[few][None], x[few], True)[0])
    twist, tilt = base_turn(chain, q, x)
    if least < good and least < gain * missed:
        yield _way_finding(log, robot, way, f"{compared}{_share(least)} with ")
    elif base_is_free and not robot.extensible and abs(twist) > _TWIST and tilt < _TILT:
        message = (
            f"the base must be rotated by {twist:.0f} degrees about its axis to fit the tips, but "
            f"only by {twist - np.copysign(180, twist):.0f} degrees with the sign of q flipped."
        )
        mounted = "Or, if the robot is mounted so, give the rotation in [base] (`base` of a chain)."
        yield LogFinding("sign", "warning", message, f"{flip} {mounted}")
    elif gain < (_FAR_BETTER if kind == "size" else _SHIFTED):
        problem = f"its bends are {i:g} times as large"
        if kind != "size":
            name = column_names(log, "q")[int(i)]
            far = 1e3 * abs(by) * q[:, int(i)].std()
            does = "is off" if kind == "offset" else "drifts"
            problem = f"actuator {name!r} {does} by about {far:.1g} mm"
        message = (
            f"the error of the nominal model falls to {100 * gain:.0f} % if {problem}."
        )
        yield LogFinding(kind, "warning", message, _ADVICE[kind])
    elif 1 - missed**2 < _ENOUGH:
        explained = f"{_share(missed)} of the tip's motion, in any order and sign of q"
        message = f"the nominal model explains only {explained}."
        yield LogFinding("geometry", "warning", message, _ADVICE["geometry"])


def _exchanged(chain: object, q: NDArray, x: NDArray) -> tuple[float, int, int]:
    """Return the error after the best exchange of a column of q with one of x, and the columns."""
    exchanges = []
    for i, j in itertools.product(range(q.shape[1]), range(3)):
        other_q = q.copy()
        other_q[:, i] = x[:, j]
        other_x = x.copy()
        other_x[:, j] = q[:, i]
        missed = float(misses(chain, other_q[None], other_x, True)[0])
        exchanges.append((missed, i, j))
    return min(exchanges)


def _way_finding(log: Log, robot: _Robot, way: Way, compared: str) -> LogFinding:
    """Return a finding with a better way to read the columns of q."""
    declared = column_names(log, "q")
    names = [declared[i] for i in way.order]
    clockwise = next(changes(robot.chain.actuators_per_segment, False)).order
    kind = "sign"
    causes = []
    advice = []
    if names != declared and way.order == clockwise:
        kind = "numbering"
        causes = ["the actuators numbered in the other direction"]
        first, second = robot.chain.angles[:2].tolist()
        counted = f"set clockwise = {str(np.sin(second - first) > 0).lower()} in every [[segment]]"
        advice = [
            f"{counted} (or negate angles_deg); the axes of the tip must be right-handed."
        ]
    elif names != declared:
        kind = "order"
        causes = [f"the columns of q in the order {', '.join(names)}"]
        listed = f"set q = {json.dumps(names)} in [log] of the robot description."
        advice = [listed if log.q_names else f"use q[:, {[*way.order]}]."]
    if min(way.sign) < 0:
        flipped = "q"
        if max(way.sign) > 0:
            flipped = ", ".join(
                repr(names[i]) for i in np.flatnonzero(np.less(way.sign, 0))
            )
        causes.append(f"the sign of {flipped} flipped")
        advice.append(_sign_advice(log, way))
    return LogFinding(
        kind, "warning", f"{compared}{' and '.join(causes)}.", " ".join(advice)
    )


def _factor(ratio: float, usual: float) -> float:
    """Return the factor by which a value is too large or too small, as a power of ten."""
    return min(_FACTORS, key=lambda f: abs(np.log(max(ratio, 1e-300) / f / usual)))


def _share(missed: float) -> str:
    return f"{100 * max(1 - missed**2, 0.0):.0f} %"
