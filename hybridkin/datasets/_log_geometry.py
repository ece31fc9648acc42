"""Does a log fit the robot? Units, sign and numbering of the actuators, by the nominal chain."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin.datasets._log_report import LogFinding
from hybridkin.datasets._logs import METRES

_FACTORS = (1e-3, 1e-2, 1e-1, 10.0, 100.0, 1000.0)
_ROWS = 500  # enough to tell one robot from its mirror image
_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
# Of the tip's spread over the robot's reach, of strokes over radii (a bend, in rad) and of
# chamber lengths over radii: what cannot be, what is usual.
_REACH, _USUAL_REACH = 5.0, 0.7
_SMALL_SHARE = 0.04  # of the way that the model predicts
_BEND, _USUAL_BEND, _SMALL_BEND = 15.0, 1.0, 0.02
_LONG, _USUAL_LONG, _SHORT = 100.0, 3.0, 0.05
_EXPLAINED, _FAR_BETTER = 0.7, 0.6


class Declared(NamedTuple):
    """What the log was declared to hold: units and sign of its columns."""

    q_unit: str
    x_unit: str
    q_sign: float | None


def geometry_findings(
    q: NDArray, x: NDArray, chain: Any, declared: Declared, base_is_free: bool
) -> list[LogFinding]:
    """Return what contradicts the chain; units first, since all else rests on them."""
    found = _unit_findings(q, x, chain, declared)
    return found or _orientation_findings(q, x, chain, declared, base_is_free)


def _unit_findings(q: NDArray, x: NDArray, chain: Any, declared: Declared) -> list[LogFinding]:
    radii = chain.radii.detach().cpu().double().numpy()
    offsets = np.abs(chain.offsets.detach().cpu().double().numpy()).sum()
    extensible = chain.lengths is None
    if extensible and (q <= 0).any():
        return [_not_lengths(q)]
    if extensible:
        stroke = float(np.median(q)) / radii.mean()
        limits = _SHORT, _LONG, _USUAL_LONG
        # As long as q says; in which unit is asked next.
        length = sum(part.mean() for part in np.split(q, _ends(chain), axis=1))
    else:
        stroke = float(np.abs(q).max()) / radii.sum()
        limits = _SMALL_BEND, _BEND, _USUAL_BEND
        length = chain.lengths.detach().cpu().double().numpy().sum()
    low, high, usual = limits
    q_factor = _factor(stroke, usual) if stroke > high else None
    if extensible:
        length = length / (q_factor or (_factor(stroke, usual) if stroke < low else 1.0))
    spread = float(np.linalg.norm(np.ptp(x, axis=0)))
    reach = spread / (length + offsets)
    if q_factor is None and stroke < low and (extensible or reach > 0.1 or stroke < low / 4):
        q_factor = _factor(stroke, usual)
    x_factor = _factor(reach, _USUAL_REACH) if reach > _REACH else None
    if x_factor is None:
        tips = _tips(chain, _some(q) / (q_factor or 1.0))
        share = spread / max(float(np.linalg.norm(np.ptp(tips, axis=0))), np.finfo(float).tiny)
        x_factor = _factor(share, 1.0) if 0.0 < share < _SMALL_SHARE else None
    found = []
    if q_factor is not None:
        what = (
            f"the chambers are {1e3 * np.median(q):.4g} mm long, {stroke:.3g} times the radius"
            if extensible
            else f"the longest stroke is {1e3 * np.abs(q).max():.4g} mm, for tendons at "
            f"{1e3 * radii.mean():.4g} mm from the backbone a bend of {stroke:.3g} rad"
        )
        found.append(_unit_finding("q", what, declared.q_unit, q_factor))
    if x_factor is not None:
        what = f"the tip moves within {1e3 * spread:.4g} mm, {reach:.3g} of the robot's reach"
        found.append(_unit_finding("x", what, declared.x_unit, x_factor))
    return found


def _unit_finding(name: str, what: str, unit: str, factor: float) -> LogFinding:
    true = next((u for u in _NAMES if np.isclose(METRES[u] * factor, METRES.get(unit, 0.0))), None)
    looks = f"these look like {_NAMES[true]}" if true else f"they are off by about {factor:g}"
    remedy = f"`{name}_unit`" if true is None else f'{name}_unit = "{true}"'
    return LogFinding(
        "units",
        "error",
        f"columns of {name} are declared as {unit}, but {what}; {looks}.",
        f"set {remedy} in [log] of the robot description or --{name}-unit"
        + (f" {true}" if true else "")
        + "; or correct the radii and lengths of the description, which are metres.",
    )


def _not_lengths(q: NDArray) -> LogFinding:
    if (q < 0).all():
        remedy = "all are negative: set q_sign = 1."
    else:
        remedy = (
            "add the length at rest to each, or, for a robot with tendons on a backbone of fixed "
            "length, give `length` in every [[segment]]."
        )
    return LogFinding(
        "geometry",
        "error",
        f"the robot is described with chambers, whose q are positive actuator lengths, but q "
        f"goes down to {1e3 * q.min():.4g} mm.",
        f"if the log holds changes of length, {remedy}" if "add" in remedy else remedy,
    )


def _orientation_findings(
    q: NDArray, x: NDArray, chain: Any, declared: Declared, base_is_free: bool
) -> list[LogFinding]:
    tendons = chain.lengths is not None
    found = []
    if tendons and q.max() > 20 * max(-q.min(), 0.0) and q.max() > 0:
        found.append(
            LogFinding(
                "sign",
                "warning",
                "the tendons are only ever lengthened; shortening must be negative.",
                _sign_advice(declared),
            )
        )
    rows = np.linspace(0, len(q) - 1, min(len(q), _ROWS)).astype(int)
    part, tips = q[rows], x[rows]
    spread = np.sqrt(((tips - tips.mean(axis=0)) ** 2).sum(axis=1).mean())
    if spread == 0 or len(rows) < 10:
        return found
    ways = {"as declared": part, "numbering": _renumbered(part, chain)}
    if tendons:
        ways |= {"sign": -part, "sign and numbering": -ways["numbering"]}
    missed = {
        name: _missed(_tips(chain, some), tips, base_is_free) / spread
        for name, some in ways.items()
    }
    as_declared, best = missed["as declared"], min(missed, key=lambda name: missed[name])
    # The simplest of those that are about as good.
    best = next(name for name in missed if missed[name] < 1.1 * missed[best])
    if missed[best] < _FAR_BETTER * as_declared and 1 - missed[best] ** 2 > _EXPLAINED:
        told = (
            f"the nominal model explains {_share(as_declared)} of the tip's motion as declared, "
            f"but {_share(missed[best])} "
        )
        if "sign" in best and not any(f.kind == "sign" for f in found):
            other = " and the numbering" if "numbering" in best else ""
            found.append(
                LogFinding(
                    "sign",
                    "warning",
                    f"{told}with the sign of q{other} flipped.",
                    _sign_advice(declared),
                )
            )
        if "numbering" in best:
            found.append(
                LogFinding(
                    "numbering",
                    "warning",
                    f"{told}with the actuators numbered the other way round.",
                    "set clockwise = true in every [[segment]] (or negate angles_deg); check that "
                    "the axes of the tip are right-handed.",
                )
            )
    elif 1 - as_declared**2 < 0.3:
        found.append(
            LogFinding(
                "geometry",
                "warning",
                f"the nominal model explains only {_share(as_declared)} of the tip's motion, "
                f"whatever the sign and the numbering{'' if base_is_free else ' of q'}.",
                "check the order of the columns of q (segment by segment from the base), the "
                "angles, the routing"
                + (" and the lengths." if base_is_free else ", the lengths and [base]."),
            )
        )
    return found


def _sign_advice(declared: Declared) -> str:
    if declared.q_sign is None:
        return "flip the sign of q: set q_sign = -1 in [log] of the description or --q-sign=-1."
    flipped = -1 if declared.q_sign > 0 else 1
    return f"set q_sign = {flipped} in [log] of the robot description, or --q-sign={flipped}."


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


def _renumbered(q: NDArray, chain: Any) -> NDArray:
    """Return q of actuators counted the other way round, from the same first one."""
    parts = np.split(q, _ends(chain), axis=1)
    return np.hstack([np.hstack([part[:, :1], part[:, :0:-1]]) for part in parts])


def _ends(chain: Any) -> NDArray:
    return np.cumsum(chain.actuators_per_segment)[:-1]


def _tips(chain: Any, q: NDArray) -> NDArray:
    with torch.no_grad():
        return chain(torch.from_numpy(np.ascontiguousarray(q, dtype=float))).cpu().numpy()


def _some(q: NDArray) -> NDArray:
    return q[:: max(1, len(q) // _ROWS)]


def _factor(ratio: float, usual: float) -> float:
    """Return how many times too large (small) a value is, as a power of ten."""
    return min(_FACTORS, key=lambda f: abs(np.log(max(ratio, 1e-300) / f / usual)))


def _share(missed: float) -> str:
    return f"{100 * max(1 - missed**2, 0.0):.0f} %"
