"""Does a log fit the robot? Units, sign and numbering of the actuators, by the nominal chain."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin._core.units import METRES
from hybridkin.datasets._log_report import LogFinding
from hybridkin.datasets._logs import Log

_FACTORS = (1e-3, 1e-2, 1e-1, 10.0, 100.0, 1000.0)
_ROWS = 500  # enough to tell one robot from its mirror image
_CONVERT = (
    "set `spool_radius` (of motors) or `q_scale` (of pressures or steps: metres per unit) in [log] "
    "of the robot description"
)
_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
# Of the tip's spread over the robot's reach, of strokes over radii (a bend, in rad) and of
# chamber lengths over radii: what cannot be, what is usual.
_REACH, _USUAL_REACH = 5.0, 0.7
_SMALL_SHARE = 0.04  # of the way that the model predicts
_BEND, _USUAL_BEND, _SMALL_BEND = 15.0, 1.0, 0.02
_LONG, _USUAL_LONG, _SHORT = 100.0, 3.0, 0.05
_EXPLAINED, _FAR_BETTER = 0.7, 0.6


class _Robot:
    """The numbers of a nominal chain that a log is compared with."""

    def __init__(self, chain: Any) -> None:
        self.chain = chain
        self.radii = chain.radii.detach().cpu().double().numpy()
        self.offsets = float(chain.offsets.detach().abs().sum())
        self.extensible = chain.lengths is None
        self.length = 0.0 if self.extensible else float(chain.lengths.detach().sum())
        self.ends = np.cumsum(chain.actuators_per_segment)[:-1]

    def tips(self, q: NDArray) -> NDArray:
        """Return the tips (N, 3) of rows q [m]."""
        with torch.no_grad():
            return self.chain(torch.from_numpy(np.ascontiguousarray(q, dtype=float))).cpu().numpy()

    def renumbered(self, q: NDArray) -> NDArray:
        """Return q of actuators counted the other way round, from the same first one."""
        parts = np.split(q, self.ends, axis=1)
        return np.hstack([np.hstack([part[:, :1], part[:, :0:-1]]) for part in parts])


def geometry_findings(log: Log, chain: Any, base_is_free: bool) -> list[LogFinding]:
    """Return what contradicts the chain; units first, since all else rests on them."""
    robot = _Robot(chain)
    return [*_unit_findings(log, robot)] or [*_orientation_findings(log, robot, base_is_free)]


def _unit_findings(log: Log, robot: _Robot) -> Iterator[LogFinding]:
    q, radii = log.q, robot.radii
    if log.units["q"] != "m":
        message = f"the actuators of the robot are lengths, but q is in {log.file_units['q']}."
        yield LogFinding("units", "error", message, f"{_CONVERT}.")
        return
    if robot.extensible and (q <= 0).any():
        yield _not_lengths(q)
        return
    if robot.extensible:
        stroke = float(np.median(q)) / radii.mean()
        low, high, usual = _SHORT, _LONG, _USUAL_LONG
        # As long as q says; in which unit is asked next.
        length = sum(part.mean() for part in np.split(q, robot.ends, axis=1))
        off = stroke > high or stroke < low
        length /= _factor(stroke, usual) if off else 1.0
        what = f"the chambers are {1e3 * np.median(q):.4g} mm long, {stroke:.3g} times the radius"
    else:
        stroke, length = float(np.abs(q).max()) / radii.sum(), robot.length
        low, high, usual = _SMALL_BEND, _BEND, _USUAL_BEND
        what = (
            f"the longest stroke is {1e3 * np.abs(q).max():.4g} mm, for tendons at "
            f"{1e3 * radii.mean():.4g} mm from the backbone a bend of {stroke:.3g} rad"
        )
    spread = float(np.linalg.norm(np.ptp(log.x, axis=0)))
    reach = spread / (length + robot.offsets)
    small = stroke < low and (robot.extensible or reach > 0.1 or stroke < low / 4)
    q_factor = _factor(stroke, usual) if stroke > high or small else None
    x_factor = _factor(reach, _USUAL_REACH) if reach > _REACH else None
    if x_factor is None:
        tips = robot.tips(q[:: max(1, len(q) // _ROWS)] / (q_factor or 1.0))
        share = spread / max(float(np.linalg.norm(np.ptp(tips, axis=0))), np.finfo(float).tiny)
        x_factor = _factor(share, 1.0) if 0.0 < share < _SMALL_SHARE else None
    if q_factor is not None:
        yield _unit_finding("q", what, log.file_units["q"], q_factor)
    if x_factor is not None:
        what = f"the tip moves within {1e3 * spread:.4g} mm, {reach:.3g} of the robot's reach"
        yield _unit_finding("x", what, log.file_units["x"], x_factor)


def _unit_finding(name: str, what: str, unit: str, factor: float) -> LogFinding:
    true = next((u for u in _NAMES if np.isclose(METRES[u] * factor, METRES.get(unit, 0.0))), None)
    looks = f"these look like {_NAMES[true]}" if true else f"they are off by about {factor:g}"
    where = f"in [log] of the robot description or --{name}-unit"
    remedy = (
        f'set {name}_unit = "{true}" {where} {true}' if true else f"check `{name}_unit` {where}"
    )
    if name == "q" and true is None:
        remedy = f"where these are no lengths, {_CONVERT}"
    return LogFinding(
        "units",
        "error",
        f"columns of {name} are declared as {unit}, but {what}; {looks}.",
        f"{remedy}; or correct the radii and lengths of the description, which are metres.",
    )


def _not_lengths(q: NDArray) -> LogFinding:
    if (q < 0).all():
        advice = "all are negative: set q_sign = 1."
    else:
        advice = (
            "if the log holds changes of length, add the length at rest to each, or, for a robot "
            "with tendons on a backbone of fixed length, give `length` in every [[segment]]."
        )
    message = (
        "the robot is described with chambers, whose q are positive actuator lengths, but q goes "
        f"down to {1e3 * q.min():.4g} mm."
    )
    return LogFinding("geometry", "error", message, advice)


def _orientation_findings(log: Log, robot: _Robot, base_is_free: bool) -> Iterator[LogFinding]:
    q, flipped = log.q, (-np.asarray(log.q_sign)).tolist()
    sign_advice = (
        f"set q_sign = {flipped} in [log] of the robot description, or --q-sign={flipped}."
    )
    released = not robot.extensible and q.max() > 20 * max(-q.min(), 0.0) and q.max() > 0
    if released:
        message = "the tendons are only ever lengthened; shortening must be negative."
        yield LogFinding("sign", "warning", message, sign_advice)
    rows = np.linspace(0, len(q) - 1, min(len(q), _ROWS)).astype(int)
    spread = np.sqrt(((log.x[rows] - log.x[rows].mean(axis=0)) ** 2).sum(axis=1).mean())
    if spread == 0 or len(rows) < 10:
        return
    ways = {"as declared": q[rows], "numbering": robot.renumbered(q[rows])}
    if not robot.extensible:
        ways |= {"sign": -q[rows], "sign and numbering": -ways["numbering"]}
    missed = {
        name: _missed(robot.tips(way), log.x[rows], base_is_free) / spread
        for name, way in ways.items()
    }
    as_declared, best = missed["as declared"], min(missed, key=lambda name: missed[name])
    # The simplest of those that are about as good.
    best = next(name for name in missed if missed[name] < 1.1 * missed[best])
    if missed[best] < _FAR_BETTER * as_declared and 1 - missed[best] ** 2 > _EXPLAINED:
        compared = (
            f"the nominal model explains {_share(as_declared)} of the tip's motion as declared, "
            f"but {_share(missed[best])} "
        )
        if "sign" in best and not released:
            other = " and the numbering" if "numbering" in best else ""
            message = f"{compared}with the sign of q{other} flipped."
            yield LogFinding("sign", "warning", message, sign_advice)
        if "numbering" in best:
            message = f"{compared}with the actuators numbered the other way round."
            advice = (
                "set clockwise = true in every [[segment]] (or negate angles_deg); check that the "
                "axes of the tip are right-handed."
            )
            yield LogFinding("numbering", "warning", message, advice)
    elif 1 - as_declared**2 < 0.3:
        of_q, more = ("", "") if base_is_free else (" of q", " and [base]")
        message = (
            f"the nominal model explains only {_share(as_declared)} of the tip's motion, whatever "
            f"the sign and the numbering{of_q}."
        )
        advice = (
            "check the order of the columns of q (segment by segment from the base), the angles, "
            f"the routing, the lengths{more}."
        )
        yield LogFinding("geometry", "warning", message, advice)


def _missed(predicted: NDArray, x: NDArray, base_is_free: bool) -> float:
    """Return the rms distance after the best shift and, of a free base, turn and scale.

    References
    ----------
    Umeyama, IEEE PAMI 13 (1991): least squares over turns that are none of mirror images.
    """
    a, b = predicted - predicted.mean(axis=0), x - x.mean(axis=0)
    if base_is_free:
        u, s, vt = np.linalg.svd(b.T @ a)
        flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        a = a @ (u * flip @ vt).T * ((s * flip).sum() / max((a**2).sum(), np.finfo(float).tiny))
    return float(np.sqrt(((a - b) ** 2).sum(axis=1).mean()))


def _factor(ratio: float, usual: float) -> float:
    """Return how many times too large (small) a value is, as a power of ten."""
    return min(_FACTORS, key=lambda f: abs(np.log(max(ratio, 1e-300) / f / usual)))


def _share(missed: float) -> str:
    return f"{100 * max(1 - missed**2, 0.0):.0f} %"
