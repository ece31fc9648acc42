"""The commands that follow a path with a model, as a file to send to the robot."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import hybridkin
from hybridkin import HybridForwardModel, IKStatus, Track, obstacles, robots, trajectories
from hybridkin.app.workflow.counts import Counts
from hybridkin.app.workflow.domain import Domain, PathLimits, path_limits
from hybridkin.app.workflow.errors import Errors
from hybridkin.app.workflow.model import (
    domain_distance,
    expected_errors,
    hysteresis_in_words,
    is_fitted,
    kind_of,
    plane_in_words,
    promised_errors,
    tips_at,
    widths_in_log,
)
from hybridkin.app.workflow.reach import better_place, check_reach
from hybridkin.app.workflow.report import (
    Progress,
    Report,
    check_out,
    error_in_millimetres,
    lengths_for_table,
    millimetres,
    percent,
    quiet,
)
from hybridkin.app.workflow.surroundings import (
    ObstacleDistance,
    Surroundings,
    add_bodies,
    add_distances,
    nearest_distances,
)
from hybridkin.datasets import Log, load_log, log_columns
from hybridkin.formats import duration_in_words

TARGET = ("target_x", "target_y", "target_z")
TIME = "t"
_REACHED = (IKStatus.CONVERGED, IKStatus.OUT_OF_DOMAIN)
_FINAL = (IKStatus.CONVERGED, IKStatus.BLOCKED)  # smaller steps change nothing
LEAD_IN = "LEAD_IN"  # status of the rows before the path
_STEP = 0.002  # largest tip step between two solutions, relative to the extent of the workspace
_PEAK = 1.875  # largest speed of `min_jerk`
_PUSH = 10.0 / math.sqrt(3.0)  # its largest acceleration
_MOST_OUTSIDE = 0.05  # share of the points outside the domain that is not worth a word
_SLOW = 0.1  # share of the range per second, without known limits
_DT = 0.02  # period of a path of one point [s]
_ANY_NUMBER = Counts()
_HALF_A_STEP = 0.5 + 1e-6  # of the nearest number, with the rounding of floats
_FINER = (1, 4)  # times as many steps, in each attempt
_SHOWN = 100  # times that a track reports its progress


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackRecord:
    """What `track_path` found.

    Attributes
    ----------
    command, model : str
        "track", and the file of the model.
    n : int
        Number of points of the path.
    reached, missed : int
        Number of points that are reached within `tol`, or within the rounding of commands, and of
        the others.
    missed_by : float
        Largest error of the solver at a missed point [m], 0 if none is missed.
    errors : Errors
        Errors of the solver at all points [m].
    statuses : dict of str to int
        How many points have each status.
    in_domain : float or None
        Share of the points in the domain of the model, None without a learned part.
    expected : dict of str to float
        "mean" and "p95" of the errors to expect of the robot at all points [m], also at those that
        are missed or outside the domain; empty if not known.
    expected_inside : dict of str to float
        The same at the points that are reached in the domain.
    rounded : dict of str to float or None
        "before" and "after": mean error of the solver before and after commands were rounded [m].
        "n": number of points that are reached within the rounding, not within `tol`; "largest":
        largest error at these [m].
    backend : str
        What computed the steps: "compiled", or "torch: " and the reason.
    hysteresis : list of float or None
        Widths of the hysteresis of one or all actuators, in the unit of the robot's logs.
    lead_in : int
        Number of rows that lead from the robot's configuration to the path.
    limits : PathLimits
        The limits that were kept.
    delay : float
        How much later than its command a tip will be read [s], for `verify_track`.
    period : float
        Time from row to row that the commands are computed for [s].
    blocked : int
        Number of points that an obstacle keeps the robot from.
    clearance : float
        Least distance between body and obstacles that was asked for [m].
    obstacles : list of ObstacleDistance
        By obstacle its "name" and the least distances of the body by the model [m]: along the
        "path", and on the "lead_in", the way to it. Empty without obstacles.
    """

    command: str = "track"
    model: str
    n: int
    reached: int
    missed: int
    missed_by: float
    errors: Errors
    statuses: dict[str, int]
    in_domain: float | None
    expected: Mapping[str, float]
    expected_inside: Mapping[str, float]
    rounded: Mapping[str, float] | None
    backend: str
    hysteresis: list[float] | None
    lead_in: int
    limits: PathLimits
    delay: float = 0.0
    period: float = _DT
    blocked: int = 0
    clearance: float = 0.0
    obstacles: list[ObstacleDistance] = field(default_factory=list)


def _write(report: Report[TrackRecord], model: HybridForwardModel, better: str) -> None:
    """Add the record to a report, in words; `better` says where the path would lie better."""
    record = report.record
    errors = record.errors
    report.text(
        f"In the model, {record.reached} of {record.n} points are reached. Error of the solver: "
        f"mean {error_in_millimetres(errors.mean)}, 95 % quantile "
        f"{error_in_millimetres(errors.p95)}, max {error_in_millimetres(errors.max)}. Limits: "
        f"{record.limits.source}. Computed by {{backend}}.",
        backend=_backend_in_words(record.backend),
    )
    rows = [[status, str(count)] for status, count in record.statuses.items()]
    report.table(["status", "points"], rows)
    log = model.description_.log
    sign = ", shortening positive" if np.all(np.less(log.q_sign, 0)) else ""
    report.text(
        f"track.csv: q in {{unit}}{sign}; x, target and error in {log.x_unit}; t in s. Its first "
        f"{record.lead_in} rows, with the status LEAD_IN, move from the start of the robot to the "
        "path.",
        unit=log.q_unit,
    )
    report.text(
        f"Period: {duration_in_words(record.period)} from row to row. Send the commands at these "
        "times: lag and creep are those of this pace."
    )
    if model.hysteresis_:
        report.text(
            f"The actuators have {hysteresis_in_words(model)}: a command crosses the "
            "width when its actuator reverses, and leads where they creep. Send q; effective_... "
            "is the motion of the actuators."
        )
    if plane_in_words(model):
        report.text("{plane}", plane=plane_in_words(model))
    report.text(*_about_counts(record, Counts.read(model.description_.training)))
    add_distances(report, record.obstacles, record.clearance, record.blocked)
    report.text(_outcome(record, better))


def _backend_in_words(backend: str) -> str:
    """Return what computed the steps."""
    name, colon, reason = backend.partition(": ")
    if name == "compiled":
        return "the compiled core"
    return f"PyTorch{colon}{reason}"


def _about_counts(record: TrackRecord, counts: Counts) -> list[str]:
    """Return what rounding costs, or that it is possible."""
    if record.rounded is not None:
        before = error_in_millimetres(record.rounded["before"])
        after = error_in_millimetres(record.rounded["after"])
        words = (
            f"Commands are rounded to whole steps of the actuators. Mean error of the solver: "
            f"{before} before, {after} after."
        )
        if record.rounded["n"]:
            largest = millimetres(record.rounded["largest"], ".2g")
            words += (
                f" {record.rounded['n']:.0f} points are reached within this rounding alone, which "
                f"moves the tip by up to {largest} there."
            )
        return [words]
    if counts and counts.whole.all():
        return [
            "The columns of the log hold whole numbers; these commands are not rounded: --round."
        ]
    return []


def _outcome(record: TrackRecord, better: str) -> str:
    """Return what is reached and missed, and the error to expect of the robot."""
    words = f"Reached: {record.reached} of {record.n} points"
    if record.missed:
        by = millimetres(record.missed_by, ".2g")
        words += f"; missed: {record.missed}, by up to {by}"
    if not record.expected:
        unknown = "The error of the robot is not known: the model has no held-out errors"
        return f"{words}. {unknown}{better}."
    mean = millimetres(record.expected["mean"], ".2g")
    p95 = millimetres(record.expected["p95"], ".2g")
    words += f". Expect {mean} (95 % below {p95}) of the robot on this path"
    if record.in_domain == 1.0 and not record.missed:
        return f"{words}."
    words += ", over all points"
    if record.expected_inside:
        inside = millimetres(record.expected_inside["mean"], ".2g")
        words += f", {inside} at those reached inside the log"
    if record.in_domain is not None and record.in_domain < 1.0:
        outside = percent(1.0 - record.in_domain)
        words += f"; {outside} of the path is outside, where errors can be larger"
    return f"{words}{better}."


def track_path(
    model: HybridForwardModel,
    path: trajectories.Trajectory,
    out: str | Path,
    *,
    limits: PathLimits | None = None,
    start: ArrayLike | str = "rest",
    tol: float = 1e-4,
    delay: float = 0.0,
    counts: Counts = _ANY_NUMBER,
    out_of_reach: bool = False,
    obstacles: Sequence[obstacles.Obstacle] = (),
    clearance: float = 0.0,
    force: bool = False,
    progress: Progress = quiet,
) -> Report[TrackRecord]:
    """Compute the commands that move the tip along a path, write them and return a report.

    ``track.csv`` has one row per point in the units, names and sign of the robot's logs: time,
    commands, the model's tip, the target, the error and its status. Figures and a report are
    written beside it. Points far apart are connected by several steps on a straight line. If points
    are not reached, another start and smaller steps are tried, and the track that reaches most
    points in the domain is kept. Errors and statuses are those of the commands in the file, which
    are all that the robot gets. Rows with the status LEAD_IN move from `start` to the path, below
    ``dq_max`` (default: a tenth of the largest range per second) and ``ddq_max``. With backlash,
    columns ``effective_NAME`` hold the motion of the actuators, half its width from the commands.
    With obstacles the column ``distance`` is that of the body to the nearest one.

    Parameters
    ----------
    model : HybridForwardModel
        The model, as from `open_model`.
    path : Trajectory
        Points [m] and times [s].
    out : str or Path
        Folder to write into.
    limits : PathLimits, optional
        As from `path_limits`, which is also the default.
    start : array-like of shape (n,), "rest" or "path", default="rest"
        Configuration of the robot before the path [m]. "rest": no tendon pulled; for robots without
        tendons zero, or the middle of the range if zero lies outside the limits. "path": the first
        command of the path, without a lead-in.
    tol : float, default=1e-4
        As for `InverseKinematics.track` [m].
    delay : float, default=0.0
        How much later than its command a tip will be read [s]. It is noted for `verify_track`; the
        commands do not depend on it.
    counts : Counts, optional
        Whole numbers to which commands are rounded. Default: not rounded. A step can then exceed
        ``dq_max`` by one number.
    out_of_reach : bool, default=False
        If points of the path are out of reach, track them as closely as possible.
    obstacles : sequence of Obstacle, default=()
        What the whole body keeps clear of on the path, from `hybridkin.obstacles`. The lead-in goes
        straight; the report says where it does not keep clear.
    clearance : float, default=0.0
        Least distance between body and obstacles [m], to which the error to expect of the model
        comes where it is known.
    force : bool, default=False
        Replace files of `out` that `track` did not write.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    Report of TrackRecord
        What is reached within which limits, and what to expect of the robot.

    Raises
    ------
    ValueError
        If more than a tenth of the checked points of the path are out of reach; the message gives
        the largest scale in reach.
    """
    check_out(out, "track", ["track.csv", "track.png", "commands.png"], force=force)
    surroundings = Surroundings(obstacles, clearance)
    domain = Domain(model, limits or path_limits(model), surroundings)
    stands = _start(domain, start)
    free = replace(domain, surroundings=Surroundings())
    check_reach(free, path, tol, out_of_reach, progress)
    attempts = Attempts(progress)
    if not model.hysteresis_ or stands is None:
        track = best_track(domain, path, tol, attempts)
        lead_in = _lead_in(track, stands, domain)
    else:
        # The state of the hysteresis after the lead-in decides the commands of the path.
        first = best_track(domain, path, tol, attempts, finest=_FINER[0])
        lead_in = _lead_in(first, stands, domain)
        track = best_track(domain, path, tol, attempts, lead_in)
    n_lead = len(lead_in) - 1
    rounded = None
    if counts:
        exact = track
        lead_in = _rounded(lead_in, counts, domain)
        track = _with_commands(
            track,
            _rounded(track.q, counts, domain),
            domain,
            tol,
            _state_after(lead_in, track, domain),
        )
        by_rounding = _missed_by_rounding(track, exact, counts, domain)
        track = _with_reached(track, by_rounding, domain)
        rounded = {
            "before": float(exact.error.mean()),
            "after": float(track.error.mean()),
            "n": int(by_rounding.sum()),
            "largest": float(track.error[by_rounding].max(initial=0.0)),
        }
    whole = _with_lead_in(track, lead_in[:-1], model)
    statuses = [IKStatus(int(code)).name for code in track.status]
    inside = domain_distance(model, track.effective) <= 1.0
    _, reached = track.score
    missed = np.isin(track.status, _REACHED, invert=True)
    better = ""
    if is_fitted(model) and inside.mean() < 1.0 - _MOST_OUTSIDE:
        better = f": {better_place(free, path, tol)}"
    ik = domain.solver()
    distances = surroundings.distances(ik, whole.effective)
    record = TrackRecord(
        model=str(model.description_.path),
        n=len(path),
        reached=reached,
        missed=len(path) - reached,
        missed_by=float(track.error[missed].max(initial=0.0)),
        errors=Errors.of(track.error),
        statuses=dict(Counter(statuses)),
        in_domain=None if not is_fitted(model) else float(inside.mean()),
        expected=_expected(model, track),
        expected_inside=_expected(model, track, track.status == IKStatus.CONVERGED),
        rounded=rounded,
        backend=ik.tracker(track.q[0]).backend,
        hysteresis=widths_in_log(model),
        lead_in=n_lead,
        limits=domain.limits,
        delay=delay,
        period=_period(whole),
        blocked=statuses.count(IKStatus.BLOCKED.name),
        clearance=clearance,
        obstacles=nearest_distances(surroundings, distances, n_lead),
    )
    report = Report(f"{model.description_.name}: a path of {len(path)} points", record)
    _write(report, model, better)
    commands = {"command": whole.q}
    if model.hysteresis_:
        commands["actuator"] = whole.effective
    _add_path(report, model, track)
    _add_commands(report, domain, whole.t, commands, n_lead)
    add_bodies(report, surroundings, model, track, distances[n_lead:])
    statuses = [LEAD_IN] * n_lead + statuses
    digits = 15 if counts else 9
    _add_track(report, whole, commands, statuses, distances, model.description_.log, digits)
    report.write(out)
    return report


def _expected(
    model: HybridForwardModel, track: Track, rows: NDArray | slice = slice(None)
) -> dict[str, float]:
    """Return the mean errors to expect at rows of a track; empty if not known.

    The directions in which the solver and the model miss a point do not depend on each other.
    """
    promised = promised_errors(model, track.effective[rows])
    if not promised.known:
        return {}
    missed = track.error[rows]
    means = np.hypot(promised.mean, missed)
    # Where some points are missed by far, these are the largest errors of the path.
    p95 = max(np.hypot(promised.p95, missed).mean(), np.quantile(means, 0.95))
    return {"mean": float(means.mean()), "p95": float(p95)}


def _start(domain: Domain, start: ArrayLike | str) -> NDArray | None:
    """Return the configuration (n,) before the path; None: its first command."""
    low = domain.limits.q_min
    high = domain.limits.q_max
    if isinstance(start, str):
        if start == "path":
            return None
        if start == "rest":
            if domain.all_tendons or ((low <= 0) & (high >= 0)).all():
                return domain.rest
            return domain.preferred
        raise ValueError(f'`start` must be "rest", "path" or numbers, got {start!r}.')
    q = np.array(start, dtype=float)
    middle = 0.5 * (low + high)
    if q.shape != low.shape or (np.abs(q - middle) > 1.5 * (high - low)).any():
        raise ValueError(
            f"`start` must be {len(low)} values in or near the limits, {low.round(4)} to "
            f"{high.round(4)} m, got {q} m; check its unit and sign."
        )
    return q


def _lead_in(track: Track, start: NDArray | None, domain: Domain) -> NDArray:
    """Return the commands (N + 1, n) from `start` to a track, of which the last is its first.

    They begin and end at rest.
    """
    if start is None:
        return track.q[:1]
    limits = domain.limits
    end = track.effective[0]
    hysteresis = domain.model.hysteresis_
    if hysteresis:
        # With creep only a start: the track then begins with the state after these commands.
        led, _ = hysteresis.command(np.stack([start, end]), dt=1.0)
        end = led[1].clip(*domain.limits.commands)
    way = end - start
    dt = _period(track)
    usual = _SLOW * max(limits.span.max(), np.abs(way).max())
    speed = np.where(np.isfinite(limits.dq_max), limits.dq_max, usual)
    moves = math.ceil((_PEAK * np.abs(way) / (speed * dt)).max())
    n = moves
    if np.isfinite(limits.ddq_max).any():
        seconds = np.sqrt(_PUSH * np.abs(way) / limits.ddq_max).max()
        moves = max(moves, math.ceil(seconds / dt))
        n = moves + 1  # the path begins at rest
    left = 1.0 - trajectories.min_jerk(np.arange(n + 1) / max(moves, 1))
    left[n] = 0.0
    return end - left[:, None] * way


def _period(points: Track | trajectories.Trajectory) -> float:
    """Return the time between two points [s]."""
    return float(points.t[1] - points.t[0]) if len(points.t) > 1 else _DT


def _with_lead_in(track: Track, lead_in: NDArray, model: HybridForwardModel) -> Track:
    """Return a track after other commands (N, n); the targets of these are the model's tips."""
    n = len(lead_in)
    dt = _period(track)
    effective = lead_in
    if model.hysteresis_ and n > 0:
        effective, _ = model.hysteresis_.apply(lead_in, None, dt)
    x = tips_at(model, effective)
    return replace(
        track,
        t=np.concatenate([track.t[0] + dt * np.arange(n), track.t + n * dt]),
        q=np.concatenate([lead_in, track.q]),
        effective=np.concatenate([effective, track.effective]),
        x=np.concatenate([x, track.x]),
        target=np.concatenate([x, track.target]),
        error=np.concatenate([np.zeros(n), track.error]),
        clearance=np.concatenate([np.full(n, np.nan), track.clearance]),
    )


class Attempts:
    """Progress of tracks that are computed one after another, each under its number."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._number = 0

    def __call__(self, done: int, total: int) -> None:
        """Report that point `done` of a track begins."""
        if done == 0:
            self._number += 1
        if done % max(1, total // _SHOWN) and done + 1 < total:
            return
        what = "tracking"
        if self._number > 1:
            what = f"tracking, attempt {self._number}"
        self._progress(what, done + 1, total)


def best_track(
    domain: Domain,
    path: trajectories.Trajectory,
    tol: float,
    attempts: Attempts,
    lead_in: NDArray | None = None,
    finest: int = _FINER[-1],
) -> Track:
    """Return the track of several attempts that reaches most points in the domain.

    Each attempt has smaller steps, up to `finest` times as many; it starts where the one before
    did. After the commands `lead_in` (N + 1, n) it starts at the last of them, with its hysteresis.
    """
    commands, tips = domain.sample
    state = None
    if lead_in is not None and domain.model.hysteresis_:
        commands = lead_in[-1]
        _, state = domain.model.hysteresis_.apply(lead_in, None, _period(path))
    way = np.linalg.norm(np.diff(path.x, axis=0), axis=1).max(initial=0.0)
    extent = np.linalg.norm(np.ptp(tips, axis=0))
    least = max(1, math.ceil(way / (_STEP * extent)))
    tracks: list[Track] = []
    for finer in _FINER:
        if finer > finest:
            break
        every = finer * least
        fine = _in_steps(path, every)
        dt = float(np.diff(fine.t).max()) if len(fine) > 1 else 0.01
        ik = domain.solver(dt)
        track = ik.track(fine, q0=commands, tol=tol, progress=attempts, state=state)
        # Only the points are kept, not the steps between them.
        tracks.append(_alone(_thinned(track, every), domain, tol, state))
        if np.isin(tracks[-1].status, _FINAL).all():
            break
        commands = track.q[0]
    return max(tracks, key=attrgetter("score"))  # of equal tracks the first


def _in_steps(path: trajectories.Trajectory, n: int) -> trajectories.Trajectory:
    """Return the path with every segment between two points cut into n."""
    places = np.arange((len(path) - 1) * n + 1) / n
    return trajectories.interpolated(path, np.interp(places, np.arange(len(path)), path.t))


def _thinned(track: Track, every: int) -> Track:
    """Return every k-th row of a track."""
    rows = {name: a[::every] for name, a in vars(track).items() if a is not None}
    return replace(track, **rows)


def _alone(track: Track, domain: Domain, tol: float, state: Any) -> Track:
    """Return a track whose commands are sent without those between its points.

    With hysteresis other commands can do the same at the points: what an actuator does between
    them, such as a reversal, depends on all commands. The better ones of both are kept.
    """
    hysteresis = domain.model.hysteresis_
    if not hysteresis:
        return track
    commands = [track.q]
    exact, _ = hysteresis.command(track.effective, state, _steps(track))
    exact = _within_speeds(exact.clip(*domain.limits.commands), track, domain)
    if exact is not None:
        commands.append(exact)
    tracks = [_with_commands(track, q, domain, tol, state) for q in commands]
    return max(tracks, key=attrgetter("score"))


def _within_speeds(q: NDArray, track: Track, domain: Domain) -> NDArray | None:
    """Return commands (N, n) within the limits of speed; None if they accelerate too much."""
    limits = domain.limits
    seconds = _steps(track)[:, None]
    if np.isfinite(limits.dq_max).any():
        q = q.copy()
        for k in range(1, len(q)):
            most = limits.dq_max * seconds[k]
            q[k] = q[k - 1] + (q[k] - q[k - 1]).clip(-most, most)
    speed = np.diff(q, axis=0, prepend=q[:1]) / np.where(seconds > 0.0, seconds, 1.0)
    change = np.abs(np.diff(speed, axis=0)) / seconds[1:]
    if (change > limits.ddq_max * (1.0 + 1e-9)).any():
        return None
    return q


def _steps(track: Track) -> NDArray:
    """Return the time before every point of a track (N,) [s]; before the first: 0."""
    return np.diff(track.t, prepend=track.t[0])


def _with_commands(track: Track, q: NDArray, domain: Domain, tol: float, state: Any) -> Track:
    """Return a track with commands q (N, n) that are sent alone, and what they do."""
    model = domain.model
    effective = q
    if model.hysteresis_:
        effective, _ = model.hysteresis_.apply(q, state, _steps(track))
    x = tips_at(model, effective)
    sent = replace(track, q=q, effective=effective, x=x)
    return domain.solver().judged(sent, tol=tol)


def _rounded(q: NDArray, counts: Counts, domain: Domain) -> NDArray:
    """Return commands (N, n) rounded to the numbers of the log, within the limits."""
    log = domain.model.description_.log
    low, high = np.sort(log.to_log(np.stack(domain.limits.commands)), axis=0)
    return log.from_log(counts.rounded(log.to_log(q), low, high))


def _missed_by_rounding(
    track: Track, exact: Track, counts: Counts, domain: Domain
) -> NDArray[np.bool_]:
    """Return which points (N,) are missed because commands are the nearest whole numbers."""
    log = domain.model.description_.log
    moved = np.abs(log.to_log(track.q) - log.to_log(exact.q))
    nearest = (moved <= _HALF_A_STEP * np.array(counts.steps)).all(axis=1)
    missed = np.isin(track.status, _REACHED, invert=True)
    return missed & nearest & np.isin(exact.status, _REACHED)


def _with_reached(track: Track, rows: NDArray[np.bool_], domain: Domain) -> Track:
    """Return a track in which any error counts as reached at some rows (N,)."""
    reached = domain.solver().judged(track, tol=np.inf)
    return replace(track, status=np.where(rows, reached.status, track.status))


def _state_after(lead_in: NDArray, track: Track, domain: Domain) -> Any:
    """Return the state of the hysteresis after the commands of a lead-in, None without."""
    hysteresis = domain.model.hysteresis_
    if not hysteresis or len(lead_in) < 2:
        return None
    return hysteresis.apply(lead_in, None, _period(track))[1]


def read_track(path: str | Path, log_format: robots.LogFormat) -> Log:
    """Return commands and times of a file, or of the track in a folder.

    The tips of a track are its targets, and its groups are the statuses.
    """
    file = Path(path)
    if file.is_dir():
        file = file / "track.csv"
    if not file.is_file():
        raise FileNotFoundError(f"`track` must be a file of commands, there is none at {file}.")
    columns = replace(log_format, groups=None)
    with open(file, encoding="utf-8", errors="replace") as text:
        first_line = text.readline().rstrip("\n")
    if {*TARGET} <= {*first_line.split(",")}:
        columns = log_format.of_tracks(TARGET)
    header = log_columns(file, header_line=columns.header_line, decimal=columns.decimal)
    time = None
    for name in (TIME, log_format.time):
        if time is None and name in header:
            time = name
    columns = replace(columns, time=time)
    return load_log(file, **columns.reading)


def _add_track(
    report: Report[TrackRecord],
    track: Track,
    commands: Mapping[str, NDArray],
    statuses: Sequence[str],
    distances: NDArray,
    log: robots.LogFormat,
    digits: int,
) -> None:
    """Add commands with so many digits, and with backlash what actuators do, point by point.

    With distances (T, K) of the body to obstacles also the least of them.
    """
    lengths = np.column_stack([track.x, track.target, track.error])
    head = [TIME, *log.q, *log.x, *TARGET, "error", "status"]
    columns = [
        _text(track.t),
        *_text(log.to_log(commands["command"]), digits),
        *lengths_for_table(lengths, log.x_unit).T,
        statuses,
    ]
    if "actuator" in commands:
        head += [f"effective_{name}" for name in log.q]
        columns += [*_text(log.to_log(commands["actuator"]))]
    if distances.size:
        head.append("distance")
        columns.append(lengths_for_table(distances.min(axis=1), log.x_unit))
    report.table_file("track.csv", head, zip(*columns, strict=True))


def _text(values: NDArray, digits: int = 9) -> NDArray:
    return np.char.mod(f"%.{digits}g", values + 0.0).T  # no -0


def _add_path(report: Report[TrackRecord], model: HybridForwardModel, track: Track) -> None:
    plots = hybridkin.plots
    figure, axes = plots.new_figure(11.0, 4.6, 1, 3)
    display = plots.TrackingDisplay.from_tracks({f"solver on {kind_of(model)}": track})
    # The plane of the largest moves.
    i, j = sorted(np.argsort(np.ptp(track.target, axis=0))[1:])
    display.plot(axes[0], unit="mm", plane="xyz"[i] + "xyz"[j])
    display.plot_time(axes[1], unit="mm")
    errors = expected_errors(model, track.effective)
    expected = {f"robot, {name}": values for name, values in errors.items()}
    display.plot_error(axes[2], unit="mm", expected=expected)
    caption = "Path and tip by the model; error of the solver"
    if errors:
        caption += ", and expected error of the robot."
    report.figure("track", figure, caption)


def _add_commands(
    report: Report[TrackRecord],
    domain: Domain,
    t: NDArray,
    commands: Mapping[str, NDArray],
    n_lead: int,
) -> None:
    """Add the commands and their limits, in names, unit and sign of the robot's logs."""
    model = domain.model
    log_format = model.description_.log
    rings = model.module_.tip_model.robot.rings or (slice(0, model.n_features_in_),)
    counts = [ring.stop - ring.start for ring in rings]
    n = len(counts)
    figure, axes = hybridkin.plots.new_figure(7.0, 1.0 + 1.8 * n, n, 1, sharex=True, squeeze=False)
    low, high = domain.limits.commands
    display = hybridkin.plots.ActuatorDisplay(
        commands, counts, t, names=log_format.q, limits=np.stack([low, high])
    )
    caption = "Commands and their limits, with the names, unit and sign of the robot's logs."
    if n_lead:
        for ax in axes[:, 0]:
            ax.axvline(t[n_lead], color="0.6", linewidth=1.0, label="start of the path")
        caption += " The path begins at the grey line."
    display.plot(axes[:, 0], unit=log_format.q_unit, per_unit=log_format.q_factor)
    report.figure("commands", figure, caption)
