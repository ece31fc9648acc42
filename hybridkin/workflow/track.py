"""The commands that follow a path with a model, as a file to send to the robot."""

from __future__ import annotations

import csv
import math
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.units import METRES
from hybridkin.chains import robots
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.datasets import Log, load_log
from hybridkin.ik import trajectories
from hybridkin.ik.results import IKStatus, Track, score
from hybridkin.ik.solver import InverseKinematics
from hybridkin.ik.trajectories import Trajectory
from hybridkin.plots import ActuatorDisplay, TrackAnimation, TrackingDisplay, new_figure
from hybridkin.workflow._places import better_place
from hybridkin.workflow._reach import check_reach
from hybridkin.workflow.domain import Domain, PathLimits, path_limits
from hybridkin.workflow.model import LoadedModel
from hybridkin.workflow.report import Progress, Report, check_out, millimetres, quiet

TARGET = ("target_x", "target_y", "target_z")
TIME = "t"
LEAD_IN = "LEAD_IN"  # status of the rows before the path
_STEP = 0.002  # largest tip step between two solutions, relative to the extent of the workspace
_PEAK = 1.875  # largest speed of `min_jerk`
_PUSH = 10.0 / math.sqrt(3.0)  # its largest acceleration
_MOST_OUTSIDE = 0.05  # share of the points outside the domain that is not worth a word
_SLOW = 0.1  # share of the range per second, without known limits
_DT = 0.02  # period of a path of one point [s]
_PULLS = (0.2, 0.0)  # pull to the preferred configuration, in each attempt


def track_path(
    loaded: LoadedModel,
    path: Trajectory,
    out: str | Path,
    *,
    limits: PathLimits | None = None,
    start: ArrayLike | str = "rest",
    tol: float = 1e-4,
    force: bool = False,
    progress: Progress = quiet,
) -> tuple[Report, list[Path]]:
    """Compute the commands that move the tip along a path, write them and return a report.

    ``track.csv`` has one row per point in the units, names and sign of the robot's logs: time,
    commands, the model's tip, the target, the error and its status. Figures and a report are
    written beside it. Points far apart are connected by several steps on a straight line. If points
    are not reached, other starts and postures are tried, and the track that reaches most points in
    the domain is kept. Rows with the status LEAD_IN move from `start` to the path, below ``dq_max``
    (default: a tenth of the largest range per second) and ``ddq_max``. With backlash, columns
    ``effective_NAME`` hold the motion of the actuators, half the backlash from the commands.

    Parameters
    ----------
    loaded : LoadedModel
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
    force : bool, default=False
        If points of the path are out of reach, track them as closely as possible; and replace files
        of `out` that `track` did not write.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    report : Report
        Its ``record`` holds "errors" [m], "statuses", "reached", "in_domain" (share of the points,
        None without a learned part), "limits", "lead_in" (rows, duration_s and start [m]) and
        "play" (width [m]).
    paths : list of Path
        The written files.

    Raises
    ------
    ValueError
        If points of the path are out of reach; the message gives the largest scale in reach.
    """
    check_out(out, "track", ["track.csv", "track.png", "commands.png"], force=force)
    log_format = loaded.log_format()
    if limits is None:
        limits = path_limits(loaded)
    domain = Domain(loaded, limits)
    stands = _start(domain, start)
    check_reach(domain, path, tol, force, progress)
    track = best_track(domain, path, tol, progress)
    names = [IKStatus(int(code)).name for code in track.status]
    whole, n_lead = _with_lead_in(track, stands, domain)
    sent = whole.q if loaded.play is None else loaded.play.command(whole.q)[0]
    speeds = np.abs(np.diff(whole.q, axis=0) / np.diff(whole.t)[:, None])
    inside = loaded.domain_distance(track.q) <= 1.0
    promised = loaded.promised_errors(track.q[inside])
    report = Report(f"{loaded.name}: a path of {len(path)} points")
    report.record.update(
        command="track",
        model=str(loaded.path),
        n=len(path),
        duration_s=path.duration,
        reached=score(track)[1],
        errors={
            "mean": track.mean_error,
            "p95": track.p95_error,
            "max": track.max_error,
        },
        tol=tol,
        in_domain=None if loaded.hybrid is None else float(inside.mean()),
        expected={
            name: errors.mean() for name, errors in promised.items() if len(errors)
        },
        play=loaded.play_width,
        statuses=dict(Counter(names)),
        lead_in={
            "rows": n_lead,
            "duration_s": whole.t[n_lead] - whole.t[0],
            "start": stands,
        },
        limits=dict(vars(limits)),
        largest_speed=speeds.max(initial=0.0),
        columns=dict(vars(log_format)),
    )
    outside = None
    if loaded.hybrid is not None and inside.mean() < 1.0 - _MOST_OUTSIDE:
        outside = better_place(domain, path, tol)
    _write_summary(report, loaded.plane_in_words(), outside)
    _add_path(report, loaded, track)
    if loaded.play is None:
        shown = {"command": sent}
    else:
        shown = {"command": sent, "actuator": whole.q}
    _add_commands(report, domain, whole.t, shown, n_lead)
    statuses = [*[LEAD_IN] * n_lead, *names]
    report.file("track.csv", partial(_write_track, whole, shown, statuses, log_format))
    return report, report.write(out)


def _start(domain: Domain, start: ArrayLike | str) -> NDArray | None:
    """Return the configuration (n,) before the path; None: its first command."""
    low = domain.limits.q_min
    high = domain.limits.q_max
    if isinstance(start, str):
        if start not in ("rest", "path"):
            raise ValueError(
                f'`start` must be "rest", "path" or numbers, got {start!r}.'
            )
        if start == "path":
            return None
        zero = domain.tendons or ((low <= 0) & (high >= 0)).all()
        return domain.rest if zero else domain.preferred
    q = np.array(start, dtype=float)
    if (
        q.shape != low.shape
        or (np.abs(q - 0.5 * (low + high)) > 1.5 * (high - low)).any()
    ):
        raise ValueError(
            f"`start` must be {len(low)} values in or near the limits, {low.round(4)} to "
            f"{high.round(4)} m, got {q} m; check its unit and sign."
        )
    return q


def _with_lead_in(
    track: Track, start: NDArray | None, domain: Domain
) -> tuple[Track, int]:
    """Return a track that begins at `start`, and the number of rows from there to the path.

    These rows begin and end at rest; their targets are the tips of the model.
    """
    limits = domain.limits
    way = np.zeros_like(track.q[0]) if start is None else track.q[0] - start
    dt = float(track.t[1] - track.t[0]) if len(track.t) > 1 else _DT
    widest = max((limits.q_max - limits.q_min).max(), np.abs(way).max())
    speed = _SLOW * widest if limits.dq_max is None else limits.dq_max
    moves = math.ceil((_PEAK * np.abs(way) / (speed * dt)).max())
    n = moves
    if limits.ddq_max is not None:
        seconds = np.sqrt(_PUSH * np.abs(way) / limits.ddq_max).max()
        moves = max(moves, math.ceil(seconds / dt))
        n = moves + 1  # the path begins at rest
    q = (
        track.q[0]
        - (1.0 - trajectories.min_jerk(np.arange(n) / max(moves, 1)))[:, None] * way
    )
    x = domain.loaded.tips(q)
    before = {"q": q, "x": x, "target": x, "error": np.zeros(n)}
    rows = {
        name: np.concatenate([rows, vars(track)[name]]) for name, rows in before.items()
    }
    t = np.concatenate([track.t[0] + dt * np.arange(n), track.t + n * dt])
    return replace(track, t=t, **rows), n


def best_track(
    domain: Domain, path: Trajectory, tol: float, progress: Progress
) -> Track:
    """Return the track of several attempts that reaches most points in the domain."""
    commands, tips = domain.sample
    way = np.linalg.norm(np.diff(path.x, axis=0), axis=1).max(initial=0.0)
    extent = np.linalg.norm(np.ptp(tips, axis=0))
    every = max(1, math.ceil(way / (_STEP * extent)))
    fine = _in_steps(path, every)
    dt = float(np.diff(fine.t).max()) if len(fine) > 1 else 0.01
    bounds: Any = {k: v for k, v in vars(domain.limits).items() if k != "source"}
    tracks: list[Track] = []
    for attempt, pull in enumerate(_PULLS):
        options = {"q_pref": domain.posture(pull), "dt": dt}
        ik = InverseKinematics(domain.loaded.module, **bounds, **options)

        def report(
            done: int, total: int, what: str = f"tracking, attempt {attempt + 1}"
        ) -> None:
            progress(what, done + 1, total)

        track: Any = ik.track(fine, q0=commands, tol=tol, progress=report)
        # Only the points are kept, not the steps between them.
        rows = {k: v[::every] for k, v in vars(track).items() if v is not None}
        tracks.append(replace(track, **rows))
        if score(tracks[-1]) == (len(path), len(path)):
            break
    return max(tracks, key=score)  # of equal tracks the first


def _in_steps(path: Trajectory, n: int) -> Trajectory:
    """Return the path with every segment between two points cut into n."""
    places = np.arange((len(path) - 1) * n + 1) / n
    columns = np.column_stack([path.t, path.x])
    t, *x = (np.interp(places, np.arange(len(path)), column) for column in columns.T)
    return Trajectory(t, np.stack(x, axis=1))


def animate_track(
    loaded: LoadedModel,
    path: str | Path,
    out: str | Path,
    *,
    unit: str = "cm",
    speed: float = 1.0,
    n_frames: int = 150,
    progress: Progress = quiet,
) -> dict[str, Any]:
    """Write a film or an interactive page of a robot that follows a file of commands.

    Parameters
    ----------
    loaded : LoadedModel
        A model with a chain as its mechanical model.
    path : str or Path
        ``track.csv`` of `track_path`, its folder, or any log of commands in the robot's format. The
        film begins where the path begins, after the lead-in.
    out : str or Path
        File that ends in ".mp4", ".gif" or ".html".
    unit : {"m", "cm", "mm"}, default="cm"
        Unit of the axes.
    speed : float, default=1.0
        Speed of the film relative to the motion.
    n_frames : int, default=150
        Largest number of frames.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    dict
        "frames", "duration_s", "fps", "path" and "bytes" of the written file.
    """
    if loaded.chain is None:
        raise ValueError(
            f"`model` {loaded.path} has no body to draw; give a model with a chain as its "
            "mechanical model."
        )
    log = read_track(path, loaded.log_format())
    out = Path(out)
    q = loaded.effective(log.q)
    if log.groups is not None:  # the way to the path is no part of it
        on_path = log.groups != LEAD_IN
        log = log.rows(on_path)
        q = q[on_path]
    target = log.x if tuple(log.x_names) == TARGET else None
    film = TrackAnimation.from_estimator(
        loaded.chain,
        q,
        target=target,
        t=log.time,
        tips=loaded.tips(q),
        expected=loaded.promised_errors(q).get("mean"),
        names=loaded.log_format().q if isinstance(loaded.chain, ArcChain) else (),
        n_frames=n_frames,
    )
    try:
        film.save(
            out, unit=unit, speed=speed, progress=partial(progress, "drawing frames")
        )
    except RuntimeError as error:  # no program to write films with
        raise ValueError(str(error)) from error
    return {
        "path": str(out),
        "bytes": out.stat().st_size,
        "frames": len(film.rows),
        "fps": speed * film.fps,
        "duration_s": None if log.time is None else float(np.ptp(log.time)),
    }


def read_track(path: str | Path, log_format: robots.LogFormat) -> Log:
    """Return commands and times of a file, or of the track in a folder.

    The tips of a track are its targets, and its groups are the statuses.
    """
    file = Path(path)
    if file.is_dir():
        file = file / "track.csv"
    if not file.is_file():
        raise FileNotFoundError(
            f"`track` must be a file of commands, there is none at {file}."
        )
    with open(file, encoding="utf-8-sig", newline="") as lines:
        header = [name.strip() for name in next(csv.reader(lines), [])]
    columns: dict[str, Any] = {**log_format.reading, "groups": None}
    columns["time"] = next(
        (name for name in (TIME, log_format.time) if name in header), None
    )
    if {*TARGET} <= {*header}:
        columns |= {"x": TARGET, "groups": "status"}
    return load_log(file, **columns)


def _write_track(
    track: Track,
    shown: dict[str, NDArray],
    statuses: list[str],
    log: robots.LogFormat,
    file: Path,
) -> None:
    """Write commands, and with backlash the motion of the actuators, point by point."""
    lengths = np.column_stack([track.x, track.target, track.error]) / METRES[log.x_unit]
    head = [TIME, *log.q, *log.x, *TARGET, "error", "status"]
    columns = [
        _text(track.t),
        *_text(log.to_log(shown["command"])),
        *_text(lengths),
        statuses,
    ]
    if "actuator" in shown:
        head += [f"effective_{name}" for name in log.q]
        columns += [*_text(log.to_log(shown["actuator"]))]
    with open(file, "w", encoding="utf-8", newline="") as lines:
        csv.writer(lines, lineterminator="\n").writerows(
            [head, *zip(*columns, strict=True)]
        )


def _text(values: NDArray) -> NDArray:
    return np.char.mod("%.9g", values + 0.0).T  # no -0


def _add_path(report: Report, loaded: LoadedModel, track: Track) -> None:
    figure, axes = new_figure(11.0, 4.6, 1, 3)
    display = TrackingDisplay.from_tracks({f"solver on {loaded.kind}": track})
    # The plane of the largest moves.
    i, j = sorted(np.argsort(np.ptp(track.target, axis=0))[1:])
    display.plot(axes[0], unit="mm", plane="xyz"[i] + "xyz"[j])
    display.plot_time(axes[1], unit="mm")
    errors = loaded.expected_errors(track.q)
    expected = {f"robot, {name}": values for name, values in errors.items()}
    display.plot_error(axes[2], unit="mm", expected=expected)
    caption = "Path and tip by the model; error of the solver"
    if errors:
        caption += ", and expected error of the robot."
    report.figure("track", figure, caption)


def _add_commands(
    report: Report, domain: Domain, t: NDArray, shown: dict[str, NDArray], n_lead: int
) -> None:
    """Add the commands and their limits, in names, unit and sign of the robot's logs."""
    loaded = domain.loaded
    log_format = loaded.log_format()
    counts: tuple[int, ...] = (loaded.n_actuators,)
    if isinstance(loaded.chain, ArcChain):
        counts = loaded.chain.actuators_per_segment
    n = len(counts)
    figure, axes = new_figure(7.0, 1.0 + 1.8 * n, n, 1, sharex=True, squeeze=False)
    half_play = 0.0 if loaded.play is None else 0.5 * loaded.play.width
    ends = np.stack([domain.limits.q_min - half_play, domain.limits.q_max + half_play])
    display = ActuatorDisplay(shown, counts, t, names=log_format.q, limits=ends)
    display.plot(axes[:, 0], unit=log_format.q_unit, per_unit=log_format.q_factor)
    caption = (
        "Commands and their limits, with the names, unit and sign of the robot's logs."
    )
    if n_lead:
        for ax in axes[:, 0]:
            ax.axvline(t[n_lead], color="0.6", linewidth=1.0)
        caption += " The path begins at the grey line."
    report.figure("commands", figure, caption)


def _write_summary(report: Report, plane: str, better: str | None) -> None:
    record = report.record
    columns = record["columns"]
    errors = {name: f"{1e3 * error:.3g}" for name, error in record["errors"].items()}
    report.text(
        f"In the model, {record['reached']} of {record['n']} points are reached within "
        f"{1e3 * record['tol']:g} mm. Error of the solver in mm: mean {errors['mean']}, 95 % "
        f"quantile {errors['p95']}, max {errors['max']}. Limits: {record['limits']['source']}."
    )
    report.table(
        ["status", "points"], [[k, str(v)] for k, v in record["statuses"].items()]
    )
    if record["lead_in"]["rows"]:
        report.text(
            "Rows with the status LEAD_IN move from the start of the robot to the path: {rows} in "
            "{duration_s:.2f} s.".format(**record["lead_in"])
        )
    sign = ", shortening positive" if np.all(np.less(columns["q_sign"], 0)) else ""
    units = f"q in {columns['q_unit']}{sign}; x, target and error in {columns['x_unit']}; t in s."
    report.text(f"track.csv: {units}")
    if record["play"] is not None:
        report.text(
            f"Backlash (play) {millimetres(record['play'])}: a command jumps by it when its "
            "actuator reverses. Send q; effective_... is the motion of the actuators."
        )
    if plane:
        report.text(plane)
    report.text(_promise_in_words(record, better))


def _promise_in_words(record: dict[str, Any], better: str | None) -> str:
    """Return what to expect of the robot, and where the path would lie better."""
    inside = record["in_domain"]
    words = "The error of the robot is not known: the model has no held-out errors"
    if record["expected"]:
        expected = {
            name: f"{1e3 * error:.2g} mm" for name, error in record["expected"].items()
        }
        words = f"Expect {expected['mean']} (95 % below {expected['p95']}) of the robot inside "
        words += "the log"
    if inside is not None and inside < 1.0:
        words += f"; {100 * (1.0 - inside):.0f} % of the path is outside, where nothing is known"
    return f"{words}: {better}." if better else f"{words}."
