"""Mistakes in logs: which of them the check names, and which nothing finds.

The figures of the docs page "Results", section "Mistakes in logs"::

    python examples/studies/log_mistakes.py --out results/log_mistakes

About ten minutes on one core. Every robot is drawn at random (seed k for robot k): extensible
segments, tendons or elastic tendons; 1 to 3 segments of 3 or 4 actuators; 0.1 to 1 m long. Its log
is simulated: circular arcs, a smooth error that the model lacks, and noise. Every mistake
is made in a copy of that log, which is checked (`check_log`), and fitted where the check found
nothing: geometry and an error model with linear features. A mistake is

- *flagged* by any error or warning, of the check or of the fit;
- *named* if a finding has one of the kinds that belong to it and, for signs and orders of columns,
  if the advised columns make the nominal model as good as it is on the clean log;
- *silently wrong* if nothing is said and the mean test error is more than twice that of the clean
  log. Mistakes in how a log is read (units, signs, orders) are made in the test rows as well, as a
  user would go on making them; mistakes of a recording (drift, outliers) are in the fitted rows
  only.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sklearn.linear_model import LinearRegression

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, HybridForwardModel
from hybridkin.app import check_log
from hybridkin.app.workflow.report import Report
from hybridkin.datasets import Log
from hybridkin.hybrid.log_fit import fit_to_log

N_MOTIONS, N_ROWS = 12, 16  # of the fitted log
N_TEST = 6  # motions
STEP = 0.1  # of time [s]
ERROR, NOISE = 0.012, 0.002  # of the length: smooth error and noise of the tip

Chain = ConstantCurvatureChain | ElasticTendonChain


@dataclass(frozen=True, eq=False)
class Case:
    """A described robot, its log and test rows, before or after a mistake."""

    chain: Chain  # nominal
    base_is_free: bool
    log: Log
    test: Log

    def both(self, change: Callable[[Log], Log]) -> Case:
        """Return the case with a mistake that is made in the test rows too."""
        return replace(self, log=change(self.log), test=change(self.test))

    def only(self, **columns: NDArray) -> Case:
        """Return the case with a mistake in the fitted rows only."""
        return replace(self, log=replace(self.log, **columns))

    @property
    def parts(self) -> list[NDArray]:
        """The columns of every segment."""
        counts = self.chain.actuators_per_segment
        return np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])


def random_case(seed: int) -> Case:
    """Return a robot drawn at random, its description (a few per cent off) and its log."""
    rng = np.random.default_rng(seed)
    n_segments = int(rng.integers(1, 4))
    kind = ("extensible", "tendons", "elastic")[seed % 3]
    size = float(np.exp(rng.uniform(np.log(0.1), np.log(1.0))))
    lengths = size * rng.dirichlet(np.full(n_segments, 20.0))
    radii = size * rng.uniform(0.03, 0.08) * rng.uniform(0.85, 1.15, n_segments)
    counts = [int(n) for n in rng.integers(3, 5, n_segments)]
    turns = rng.uniform(0.0, 2 * np.pi / 3, n_segments) if rng.random() < 0.5 else 0 * radii
    angles = [a + 2 * np.pi * np.arange(n) / n for a, n in zip(turns, counts, strict=True)]
    base_is_free = bool(rng.random() < 0.75)
    base = np.eye(4)
    if base_is_free:
        base[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.05, 3)).as_matrix()
        base[:3, 3] = 0.05 * size * rng.standard_normal(3)
    routing = "base" if kind == "elastic" else ("segment", "base")[int(rng.integers(2))]

    def build(radii: NDArray, lengths: NDArray, base: NDArray) -> Chain:
        given: dict[str, Any] = {"angles": angles, "routing": routing, "base": base}
        if kind == "elastic":
            return ElasticTendonChain(radii, lengths, n_actuators=counts, **given)
        given["n_actuators"] = counts
        return ConstantCurvatureChain(
            radii, lengths=None if kind == "extensible" else lengths, **given
        )

    truth = build(radii, lengths, base)
    off = rng.uniform(0.95, 1.05, (2, n_segments))
    nominal = build(off[0] * radii, off[1] * lengths, np.eye(4) if base_is_free else base)
    q = _commands(rng, truth, lengths, kind)
    x = _tips(truth, q)
    x += ERROR * size * _smooth(rng, (q - q.mean(axis=0)) / q.std(axis=0))
    x += NOISE * size / np.sqrt(3) * rng.standard_normal(x.shape)
    groups = np.repeat(np.arange(N_MOTIONS + N_TEST), N_ROWS)
    names = tuple(f"a{i + 1}" for i in range(q.shape[1]))
    log = Log(
        q,
        x,
        groups,
        STEP * np.arange(len(q)),
        q_names=names,
        x_names=("tx", "ty", "tz"),
    )
    n = N_MOTIONS * N_ROWS
    return Case(nominal, base_is_free, log.rows(slice(n)), log.rows(slice(n, None)))


def _commands(rng: np.random.Generator, chain: Chain, lengths: NDArray, kind: str) -> NDArray:
    """Return the commands of smooth motions, (N, n) [m]."""
    radii, angles = (
        chain.radii.numpy(),
        np.split(chain.angles.numpy(), np.cumsum(chain.actuators_per_segment)[:-1]),
    )
    bend = rng.uniform(0.6, 1.2) / len(radii) ** 0.5  # [rad], rms of a segment about
    rows = []
    s = np.linspace(0.0, 1.0, N_ROWS)[:, None]
    for _ in range(N_MOTIONS + N_TEST):
        along, total = [], np.zeros((N_ROWS, 2))
        for k, around in enumerate(angles):
            way = rng.standard_normal((3, 2)) * bend
            b = way[0] + way[1] * np.sin(np.pi * s) + way[2] * np.sin(2 * np.pi * s)
            total = total + b
            seen = total if chain.routing == "base" else b
            part = -radii[k] * (seen @ np.stack([np.cos(around), np.sin(around)]))
            if kind == "extensible":
                stretch = 1.0 + 0.08 * rng.standard_normal() + 0.04 * np.sin(np.pi * s)
                whole = lengths[: k + 1].sum() if chain.routing == "base" else lengths[k]
                part = part + whole * stretch
            elif kind == "elastic":
                part = part - 0.1 * radii[k] * bend * abs(rng.standard_normal())
            along.append(part)
        rows.append(np.hstack(along))
    q = np.concatenate(rows)
    return np.maximum(q, 0.05 * lengths.min()) if kind == "extensible" else q


def _tips(chain: Chain, q: NDArray) -> NDArray:
    with torch.no_grad():
        return chain(torch.from_numpy(q)).numpy()


def _smooth(rng: np.random.Generator, z: NDArray) -> NDArray:
    """Return a smooth function (N, 3) of unit size."""
    weights, phases = rng.standard_normal((z.shape[1], 8)), rng.uniform(0, 2 * np.pi, 8)
    y = np.sin(0.5 * z @ weights / z.shape[1] ** 0.5 + phases) @ rng.standard_normal((8, 3))
    y -= y.mean(axis=0)
    return y / np.sqrt((y**2).sum(axis=1).mean())


# the mistakes: what is made of a clean case, and the kinds of findings that name it

Mistake = Callable[[Case, np.random.Generator], "Case | None"]


def _scaled(which: str, factor: float) -> Mistake:
    return lambda case, rng: case.both(
        lambda log: replace(log, **{which: factor * vars(log)[which]})
    )


def _permuted(case: Case, order: Sequence[int] | NDArray) -> Case:
    return case.both(lambda log: replace(log, q=log.q[:, np.asarray(order)]))


def _one_sign(case: Case, rng: np.random.Generator) -> Case:
    sign = np.ones(case.chain.n_actuators)
    sign[rng.integers(len(sign))] = -1.0
    return case.both(lambda log: replace(log, q=sign * log.q))


def _within(case: Case, rng: np.random.Generator) -> Case:
    order = np.arange(case.chain.n_actuators)
    a, b = rng.choice(case.parts[int(rng.integers(len(case.parts)))], 2, replace=False)
    order[[a, b]] = order[[b, a]]
    return _permuted(case, order)


def _segments(case: Case, rng: np.random.Generator) -> Case | None:
    parts = case.parts
    pairs = [(i, j) for i in range(len(parts)) for j in range(i) if len(parts[i]) == len(parts[j])]
    if not pairs:
        return None
    order = np.arange(case.chain.n_actuators)
    i, j = pairs[int(rng.integers(len(pairs)))]
    order[np.r_[parts[i], parts[j]]] = np.r_[parts[j], parts[i]]
    return _permuted(case, order)


def _between(case: Case, rng: np.random.Generator) -> Case | None:
    if len(case.parts) == 1:
        return None
    order = np.arange(case.chain.n_actuators)
    i, j = rng.choice(len(case.parts), 2, replace=False)
    a, b = rng.choice(case.parts[i]), rng.choice(case.parts[j])
    order[[a, b]] = order[[b, a]]
    return _permuted(case, order)


def _shuffled(case: Case, rng: np.random.Generator) -> Case:
    return _permuted(case, rng.permutation(case.chain.n_actuators))


def _reversed(case: Case, rng: np.random.Generator) -> Case:
    order = np.concatenate([np.r_[part[:1], part[:0:-1]] for part in case.parts])
    return _permuted(case, order)


def _tip_axes(case: Case, rng: np.random.Generator) -> Case:
    order = [[1, 0, 2], [2, 1, 0], [0, 2, 1]][int(rng.integers(3))]
    return case.both(lambda log: replace(log, x=log.x[:, order]))


def _left_handed(case: Case, rng: np.random.Generator) -> Case:
    sign = np.ones(3)
    sign[rng.integers(3)] = -1.0
    return case.both(lambda log: replace(log, x=sign * log.x))


def _absolute(case: Case, rng: np.random.Generator) -> Case:
    """Return absolute lengths where changes are meant, or the reverse."""
    if case.chain.lengths is None:
        rest = case.log.q.mean(axis=0)
        return case.both(lambda log: replace(log, q=log.q - rest))
    whole = case.chain.lengths.numpy()
    whole = np.cumsum(whole) if case.chain.routing == "base" else whole
    return case.both(
        lambda log: replace(log, q=log.q + np.repeat(whole, case.chain.actuators_per_segment))
    )


def _gap(case: Case, rng: np.random.Generator) -> Case:
    t = np.array(case.log.time)
    t[int(rng.integers(5, N_ROWS - 5)) + N_ROWS * int(rng.integers(N_MOTIONS)) :] += 30 * STEP
    return case.only(time=t)


def _clock(case: Case, rng: np.random.Generator) -> Case:
    t = np.array(case.log.time)
    t[int(rng.integers(50, 150)) :] -= 20 * STEP
    return case.only(time=t)


def _duplicated(case: Case, rng: np.random.Generator) -> Case:
    rows = np.arange(len(case.log.q))
    first = int(rng.integers(100))
    return replace(case, log=case.log.rows(np.r_[rows, rows[first : first + 40]]))


def _q_drift(case: Case, rng: np.random.Generator) -> Case:
    q, i = np.array(case.log.q), int(rng.integers(case.chain.n_actuators))
    q[:, i] += rng.choice([-1, 1]) * np.linspace(0.0, 1.5 * q[:, i].std(), len(q))
    return case.only(q=q)


def _x_drift(case: Case, rng: np.random.Generator) -> Case:
    way = rng.standard_normal(3)
    way *= 0.6 * np.sqrt(case.log.x.var(axis=0).sum()) / np.linalg.norm(way)
    return case.only(x=case.log.x + np.linspace(0.0, 1.0, len(case.log.x))[:, None] * way)


def _camera(case: Case, rng: np.random.Generator) -> Case:
    """Return a log whose camera was pushed half way through."""
    way = rng.standard_normal(3)
    way *= 0.5 * np.sqrt(case.log.x.var(axis=0).sum()) / np.linalg.norm(way)
    later = np.arange(len(case.log.x)) >= N_ROWS * int(rng.integers(4, 9))
    return case.only(x=case.log.x + later[:, None] * way)


def _frozen_actuator(case: Case, rng: np.random.Generator) -> Case:
    q, i = np.array(case.log.q), int(rng.integers(case.chain.n_actuators))
    first = int(rng.integers(20, 120))
    q[first : first + 60, i] = q[first, i]
    return case.only(q=q)


def _frozen_marker(case: Case, rng: np.random.Generator) -> Case:
    x, first = np.array(case.log.x), int(rng.integers(20, 150))
    x[first : first + 40] = x[first]
    return case.only(x=x)


def _dead(case: Case, rng: np.random.Generator) -> Case:
    """Return a log in which one actuator's column is constant."""
    i, value = int(rng.integers(case.chain.n_actuators)), case.log.q[0]
    return case.both(lambda log: replace(log, q=np.where(np.arange(len(value)) == i, value, log.q)))


def _rebuilt(case: Case, **changes: Any) -> Case:
    chain = case.chain
    given: dict[str, Any] = {
        "radii": chain.radii,
        "angles": list(chain.angles.split(chain.actuators_per_segment)),
        "routing": chain.routing,
        "base": chain.base,
        "lengths": chain.lengths,
    }
    given["n_actuators"] = chain.actuators_per_segment
    return replace(case, chain=type(chain)(**{**given, **changes}))


def _segment_count(case: Case, rng: np.random.Generator) -> Case:
    more = [*range(len(case.chain.radii)), len(case.chain.radii) - 1]
    counts = [case.chain.actuators_per_segment[i] for i in more]
    angles = case.chain.angles.split(case.chain.actuators_per_segment)
    lengths = case.chain.lengths
    return _rebuilt(
        case,
        radii=case.chain.radii[more],
        lengths=None if lengths is None else lengths[more],
        angles=[angles[i] for i in more],
        n_actuators=counts,
    )


def _radius(case: Case, rng: np.random.Generator) -> Case:
    return _rebuilt(case, radii=case.chain.radii * rng.choice([0.5, 2.0]))


def _clockwise(case: Case, rng: np.random.Generator) -> Case:
    parts = case.chain.angles.split(case.chain.actuators_per_segment)
    return _rebuilt(case, angles=[2 * part[0] - part for part in parts])


def _late(case: Case, rng: np.random.Generator) -> Case:
    """Return a log whose tips come some rows late (another clock)."""
    n = int(rng.integers(3, 6))
    log = replace(case.log.rows(slice(n, None)), x=case.log.x[:-n])
    return replace(case, log=log)


def _outliers(case: Case, rng: np.random.Generator) -> Case:
    x = np.array(case.log.x)
    rows = rng.choice(len(x), 6, replace=False)
    x[rows] += 2.0 * np.sqrt(x.var(axis=0).sum()) * rng.standard_normal((6, 3))
    return case.only(x=x)


def _nan(case: Case, rng: np.random.Generator) -> Case:
    x = np.array(case.log.x)
    x[rng.choice(len(x), 10, replace=False)] = np.nan
    return case.only(x=x)


def _doubled(case: Case, rng: np.random.Generator) -> Case:
    a, b = rng.choice(case.chain.n_actuators, 2, replace=False)
    order = np.arange(case.chain.n_actuators)
    order[a] = b
    return _permuted(case, order)


def _offset(case: Case, rng: np.random.Generator) -> Case:
    shift = np.zeros(case.chain.n_actuators)
    i = int(rng.integers(len(shift)))
    shift[i] = rng.choice([-1, 1]) * 1.5 * case.log.q[:, i].std()
    return case.both(lambda log: replace(log, q=log.q + shift))


def _exchanged(case: Case, rng: np.random.Generator) -> Case:
    """Return a log in which an actuator's column and one of the tip are exchanged."""
    i, j = int(rng.integers(case.chain.n_actuators)), int(rng.integers(3))

    def change(log: Log) -> Log:
        q, x = np.array(log.q), np.array(log.x)
        q[:, i], x[:, j] = log.x[:, j], log.q[:, i]
        return replace(log, q=q, x=x)

    return case.both(change)


def _degrees(case: Case, rng: np.random.Generator) -> Case:
    spool = float(case.chain.radii.mean()) * rng.uniform(0.5, 2.0)
    return _scaled("q", 180 / np.pi / spool)(case, rng)  # type: ignore[return-value]


def _mixed(case: Case, rng: np.random.Generator) -> Case:
    return case.only(x=case.log.x[rng.permutation(len(case.log.x))])


ORDER = ("order", "sign", "numbering")
MISTAKES: dict[str, tuple[Mistake, tuple[str, ...]]] = {
    "q in millimetres": (_scaled("q", 1e3), ("units",)),
    "q in centimetres": (_scaled("q", 1e2), ("units",)),
    "q in degrees of a spool": (_degrees, ("units", "geometry")),
    "x in millimetres": (_scaled("x", 1e3), ("units",)),
    "x in centimetres": (_scaled("x", 1e2), ("units",)),
    "sign of all q": (_scaled("q", -1.0), ORDER),
    "sign of one actuator": (_one_sign, ORDER),
    "two columns of a segment swapped": (_within, ORDER),
    "two columns of different segments swapped": (_between, ORDER),
    "two segments swapped": (_segments, ORDER),
    "all columns shuffled": (_shuffled, ORDER),
    "numbered clockwise in the log": (_reversed, ORDER),
    "clockwise wrong in the description": (_clockwise, ORDER),
    "two axes of the tip swapped": (_tip_axes, ("numbering", "axes", "order")),
    "tip axes left-handed": (_left_handed, ("numbering", "axes", "order")),
    "absolute lengths for changes, or the reverse": (_absolute, ("geometry",)),
    "an actuator column twice": (_doubled, ("same column",)),
    "an actuator and a tip column exchanged": (
        _exchanged,
        ("exchanged", "geometry", "units"),
    ),
    "constant offset of one actuator": (_offset, ("offset", "geometry")),
    "one segment too many described": (_segment_count, ("actuators",)),
    "radii half or twice": (_radius, ("size", "calibration")),
    "gap in time": (_gap, ("time",)),
    "clock set back": (_clock, ("time",)),
    "rows twice": (_duplicated, ("duplicates",)),
    "drift of an actuator sensor": (_q_drift, ("drift",)),
    "drift of the camera": (_x_drift, ("drift",)),
    "camera pushed": (_camera, ("drift", "jumps")),
    "frozen actuator sensor": (_frozen_actuator, ("frozen actuator",)),
    "frozen marker": (_frozen_marker, ("frozen tip",)),
    "dead actuator column": (_dead, ("constant",)),
    "tips 3 to 5 rows late": (_late, ("lag",)),
    "tips of other rows": (_mixed, ("geometry",)),
    "outliers of the tip": (_outliers, ("jumps", "outliers")),
    "rows with NaN": (_nan, ("invalid",)),
}


@dataclass(frozen=True)
class Outcome:
    """What was said of a log, and the mean test error [m] of what was fitted to it."""

    # of the findings, errors first; "calibration" of a fit's warning.
    kinds: tuple[str, ...]
    advice: str
    error: float | None

    @property
    def flagged(self) -> bool:
        """Whether anything was said."""
        return bool(self.kinds)


def examined(case: Case, fit: bool | None = None) -> Outcome:
    """Return what is said of a case; it is fitted where the check finds nothing, or as asked."""
    try:
        report = check_log(case.log, chain=case.chain, base_is_free=case.base_is_free)
    except ValueError as error:
        return Outcome(("actuators",) if "actuators" in str(error) else (), str(error), None)
    found = [f for f in report.findings if f.severity != "note"]
    kinds, advice = tuple(f.kind for f in found), " ".join(f.advice for f in found)
    if not (not kinds if fit is None else fit):
        return Outcome(kinds, advice, None)
    # What data decide at once; lengths and stiffnesses stay nominal, as many users leave them.
    names = ("radii", "base") if case.base_is_free else ("radii",)
    model = HybridForwardModel(case.chain, LinearRegression(), calibrate=names)
    fitted = fit_to_log(*model.prepared(case.log.q, case.log.x, groups=case.log.groups))
    messages = fitted.messages
    kinds += ("calibration",) * bool(messages)
    with torch.no_grad():
        tips = fitted.module(torch.from_numpy(case.test.q)).numpy()
    error = float(np.linalg.norm(tips - case.test.x, axis=1).mean())
    return Outcome(kinds, " ".join([advice, *messages]), error)


def advised(case: Case, advice: str) -> Case | None:
    """Return the case with the columns and signs that an advice names, None without any."""
    changed, names = case, list(case.log.q_names or ())
    for key, text in re.findall(r"\b(q|q_sign) = (\[[^\]]*\]|-?1)", advice):
        value = json.loads(text)
        if key == "q":
            changed = _permuted(changed, [names.index(name) for name in value])
    for key, text in re.findall(r"\b(q|q_sign) = (\[[^\]]*\]|-?1)", advice):
        if key == "q_sign":
            changed = _scaled("q", np.array(json.loads(text)))(changed, np.random.default_rng(0))
    if "clockwise = true" in advice or "clockwise = false" in advice:
        changed = _clockwise(changed, np.random.default_rng(0))
    return None if changed is case or changed is None else changed


def fits(case: Case) -> float:
    """Return the rms distance of the nominal model, its base turned to the tips where free [m]."""
    tips, x = _tips(case.chain, case.log.q), case.log.x
    if case.base_is_free:
        a, b = tips - tips.mean(axis=0), x - x.mean(axis=0)
        tips, x = Rotation.align_vectors(b, a)[0].apply(a), b
    return float(np.sqrt(((tips - x) ** 2).sum(axis=1).mean()))


def named(mistake: str, case: Case, outcome: Outcome, clean: float) -> bool:
    """Return whether the outcome names the mistake, and its advice mends it where it can."""
    kinds = MISTAKES[mistake][1]
    if not set(kinds) & set(outcome.kinds):
        return False
    if kinds != ORDER:
        return True
    mended = advised(case, outcome.advice)
    return mended is not None and fits(mended) < 1.3 * clean


def study(
    n_robots: int = 200, mistakes: Sequence[str] | None = None, first: int = 0
) -> dict[str, Any]:
    """Return the counts: of clean logs with an alarm, and of every mistake.

    Parameters
    ----------
    n_robots : int
        Robots; robot k has the seed k.
    mistakes : sequence of str, optional
        Of `MISTAKES`; default: all.
    first : int
        Seed of the first robot.
    """
    alarms, clean_errors = [], []
    counts: dict[str, Counter[str]] = {name: Counter() for name in mistakes or MISTAKES}
    silent, missed = [], []
    for seed in range(first, first + n_robots):
        case = random_case(seed)
        clean, alone = examined(case, fit=True), fits(case)
        assert clean.error is not None
        clean_errors.append(clean.error)
        if clean.flagged:
            alarms.append([seed, *clean.kinds])
        for i, (name, count) in enumerate(counts.items()):
            made = MISTAKES[name][0](case, np.random.default_rng([seed, i]))
            if made is None:
                continue
            outcome = examined(made)
            count["n"] += 1
            count["flagged"] += outcome.flagged
            right = named(name, made, outcome, alone)
            count["named"] += right
            if not right:
                missed.append([seed, name, *outcome.kinds])
            ratio = 0.0 if outcome.error is None else outcome.error / clean.error
            count["harmless"] += not outcome.flagged and ratio <= 2.0
            if not outcome.flagged and ratio > 2.0:
                count["silent"] += 1
                silent.append([seed, name, round(ratio, 1)])
    return {
        "n": n_robots,
        "seeds": [first, first + n_robots - 1],
        "clean_alarms": alarms,
        "mistakes": {name: dict(count) for name, count in counts.items()},
        "silent": silent,
        "missed": missed,
    }


def write(found: dict[str, Any], seconds: float) -> Report:
    """Return the report of a study."""
    n, alarms = found["n"], found["clean_alarms"]
    report = Report("Mistakes in logs (simulated robots)", {})
    report.record |= found | {"seconds": seconds}
    report.text(
        f"{n} simulated robots, seeds {found['seeds'][0]} to {found['seeds'][1]}; {seconds:.0f} s. "
        f"Clean logs with a warning: {len(alarms)} of {n} ({100 * len(alarms) / n:.1f} %)."
    )
    columns = ("n", "flagged", "named", "harmless", "silent")
    rows = [
        [name, *(str(count.get(key, 0)) for key in columns)]
        for name, count in found["mistakes"].items()
    ]
    total = [sum(count.get(key, 0) for count in found["mistakes"].values()) for key in columns]
    rows.append(["all", *map(str, total)])
    report.table(["mistake", *columns], rows)
    report.text(
        "flagged: something was said. named: the right thing, with a remedy that works. harmless: "
        "nothing was said, and the test error is at most twice that of the clean log. silent: "
        "nothing was said, and it is larger."
    )
    return report


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description="Make mistakes in logs and count the named ones.")
    parser.add_argument("--n", type=int, default=200, help="robots")
    parser.add_argument("--first", type=int, default=0, help="seed of the first robot")
    parser.add_argument("--only", nargs="*", help="mistakes")
    parser.add_argument("--out", type=Path, help="folder for report.md and report.json")
    arguments = parser.parse_args()
    start = time.perf_counter()
    found = study(arguments.n, arguments.only, arguments.first)
    report = write(found, time.perf_counter() - start)
    print(report.plain())
    for what in ("clean_alarms", "silent", "missed"):
        print(what, *found[what], sep="\n  ")
    if arguments.out is not None:
        report.write(arguments.out)


if __name__ == "__main__":
    main()
