"""A model and a path: the commands that follow it, as a file to send to the robot."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from hybridkin import datasets, plots, robots
from hybridkin.ik.solver import IKStatus, InverseKinematics, Track
from hybridkin.ik.trajectories import Trajectory, from_csv
from hybridkin.workflow._domain import homeward, known_commands, path_limits
from hybridkin.workflow.model import OpenedModel
from hybridkin.workflow.report import Report, check_out

TARGET = ("target_x", "target_y", "target_z")
TIME = "t"
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_REACHED = (IKStatus.CONVERGED, IKStatus.OUT_OF_DOMAIN)
_STEP = 0.002  # of the tip between two solutions, over the extent of the workspace
_STARTS = 16
_PULLS = (0.2, 0.0, 0.0, 0.2)  # to the preferred configuration, one attempt at the path each


def track_path(
    opened: OpenedModel,
    path: Trajectory,
    out: str | Path,
    *,
    q_min: ArrayLike | None = None,
    q_max: ArrayLike | None = None,
    dq_max: ArrayLike | None = None,
    tol: float = 1e-4,
    progress: Callable[[str, int, int], None] | None = None,
) -> tuple[Report, list[Path]]:
    """Compute the commands that lead the tip along a path, and write them.

    Written are ``track.csv``, with one row per point in the units, names and sign of the robot's
    logs: time, commands, the model's tip, the target, the error and its status; a figure, and the
    report. Points far apart are passed in several steps on a straight line; where points are
    missed, other starts and postures are tried, and the track that reaches most within the domain
    is kept. Of a model with play
    the commands are those to send, which lead or trail what the actuators do by half its width, and
    further columns ``effective_NAME`` hold the latter.

    Parameters
    ----------
    opened : OpenedModel
        The model, as from `open_model`.
    path : Trajectory
        Points [m] and times [s].
    out : str or Path
        Folder to write into.
    q_min, q_max, dq_max : array-like of shape (n,), optional
        Limits [m], speeds [m/s]. Default: those of the robot's description within the range that
        the model was fitted on, or that range, see `path_limits`. With play `dq_max` holds for what
        the actuators do.
    tol : float, default=1e-4
        As for `InverseKinematics.track` [m].
    progress : callable, optional
        Handed (what, done, total).

    Returns
    -------
    report : Report
        Its ``record`` holds "errors" [m], "statuses", "reached", "in_domain" (share of the points,
        None without a learned part), "limits" and "play" (width [m]).
    paths : list of Path
        What was written.
    """
    check_out(out)
    log_format = opened.log_format()
    limits = path_limits(opened, q_min, q_max, dq_max)
    periods = np.diff(path.t)
    commands, tips = known_commands(opened, limits)
    way = np.linalg.norm(np.diff(path.x, axis=0), axis=1).max(initial=0.0)
    extent = np.linalg.norm(np.ptp(tips, axis=0))
    fine, every = _in_steps(path, max(1, math.ceil(way / (_STEP * extent))))
    dt = float(np.diff(fine.t).max()) if len(fine) > 1 else 0.01
    track: Any = None
    for attempt, pull in enumerate(_PULLS):
        ik = InverseKinematics(
            opened.module,
            q_min=limits["q_min"],
            q_max=limits["q_max"],
            dq_max=limits["dq_max"],
            q_pref=homeward(opened, limits, pull),
            beta=min(1.0, 1.0 / dt),
            dt=dt,
        )

        def told(done: int, total: int, attempt: int = attempt) -> None:
            if progress is not None:
                progress(f"tracking, attempt {attempt + 1}", done + 1, total)

        first = _starts(ik, path.x[0], commands, tips, 0.1 * tol)[attempt % 2]
        found = _rows(ik.track(fine, q0=first, tol=tol, progress=told), slice(None, None, every))
        if track is None or _score(found) > _score(track):
            track = found
        if _score(track) == (len(path), len(path)):
            break
    sent = track.q if opened.play is None else opened.play.command(track.q)[0]
    inside = opened.module.in_domain(torch.from_numpy(track.q)) if opened.is_hybrid else None
    names = [IKStatus(int(code)).name for code in track.status]
    reached = np.isin(track.status, _REACHED)
    report = Report(f"{opened.name}: a path of {len(path)} points")
    report.record.update(
        model=str(opened.path),
        n=len(path),
        duration_s=path.duration,
        reached=int(reached.sum()),
        errors={"mean": track.mean_error, "p95": track.p95_error, "max": track.max_error},
        tol=tol,
        in_domain=None if inside is None else float(inside.double().mean()),
        play=None if opened.play is None else np.ravel(opened.play.width).tolist(),
        statuses={name: names.count(name) for name in dict.fromkeys(names)},
        limits=limits,
        largest_speed=np.abs(np.diff(track.q, axis=0) / periods[:, None]).max(initial=0.0),
        columns={"q": log_format.q, "q_unit": log_format.q_unit, "q_sign": log_format.q_sign},
    )
    report.record["columns"] |= {"x": log_format.x, "x_unit": log_format.x_unit}
    _write_summary(report)
    _add_figures(report, opened, track, sent)
    effective = None if opened.play is None else track.q
    report.file(
        "track.csv", lambda file: _write_track(file, track, sent, effective, names, log_format)
    )
    return report, report.write(out)


def _in_steps(path: Trajectory, n: int) -> tuple[Trajectory, int]:
    """Return the path with every way between two points cut into n, and n."""
    if n == 1 or len(path) < 2:
        return path, 1
    places = np.arange((len(path) - 1) * n + 1) / n
    columns = np.column_stack([path.t, path.x])
    t, *x = (np.interp(places, np.arange(len(path)), column) for column in columns.T)
    return Trajectory(t, np.stack(x, axis=1)), n


def _starts(
    ik: InverseKinematics, target: NDArray, commands: NDArray, tips: NDArray, tol: float
) -> list[NDArray]:
    """Return two configurations (n,) to start from, at the target.

    One that the first of the commands, near the preferred one, leads to; and of those from the
    commands whose tips are nearest to the target, in the domain if possible, the one with the
    largest singular value sigma_min.
    """
    near = np.argsort(np.linalg.norm(tips[1:] - target, axis=1))[:_STARTS] + 1
    near = np.concatenate([[0], near])
    targets = np.broadcast_to(target, (len(near), 3)).copy()
    found = ik.solve(targets, q0=commands[near], tol=tol, max_iter=200)
    for wanted in (IKStatus.CONVERGED, IKStatus.OUT_OF_DOMAIN):
        rows = np.flatnonzero(found.status[1:] == wanted) + 1
        if len(rows):
            return [found.q[0], found.q[rows[found.sigma_min[rows].argmax()]]]
    free = ik.solve(target, tol=tol, max_iter=200, restarts=_STARTS, random_state=0)
    return [found.q[0], free.q]


def _score(track: Track) -> tuple[int, int]:
    """Return how many points were reached within the domain, and how many at all."""
    statuses = np.asarray(track.status)
    return int((statuses == IKStatus.CONVERGED).sum()), int(np.isin(statuses, _REACHED).sum())


def _rows(track: Track, kept: slice) -> Track:
    """Return some rows of a track."""
    parts = {f.name: getattr(track, f.name) for f in fields(track)}
    return replace(track, **{k: v[kept] for k, v in parts.items() if v is not None})


def read_path(path: str | Path, *, unit: str = "m", dt: float | None = None) -> Trajectory:
    """Return a path from a CSV file of t, x, y, z or x, y, z.

    Parameters
    ----------
    path : str or Path
        The file; with three columns `dt` is needed.
    unit : {"m", "cm", "mm"}, default="m"
        Of the positions.
    dt : float, optional
        Time between points [s]; a file with times is read at this period, straight in between.

    Returns
    -------
    Trajectory
        Points [m] and times [s].

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it has no times and `dt` is not given, or is not a table of numbers.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"`path` must be a CSV file of points, there is none at {file}.")
    with open(file, encoding="utf-8-sig") as lines:
        columns = max(
            (len(line.split(",")) for line in lines if line.strip() and line[0] != "#"), default=0
        )
    if columns == 3:
        if dt is None:
            raise ValueError(f"{file} has no times: give the time between its points (--dt 0.02).")
        return from_csv(file, dt=dt, unit=unit)
    timed = from_csv(file, unit=unit)
    if dt is None:
        return timed
    t = timed.t[0] + dt * np.arange(int(timed.duration / dt + 1e-9) + 1)
    return Trajectory(t, np.stack([np.interp(t, timed.t, c) for c in timed.x.T], axis=1))


def animate_track(
    opened: OpenedModel,
    path: str | Path,
    out: str | Path,
    *,
    unit: str = "cm",
    speed: float = 1.0,
    n_frames: int = 150,
    progress: Callable[[str, int, int], None] | None = None,
) -> dict[str, Any]:
    """Write a film or an interactive page of a robot that runs through a file of commands.

    Parameters
    ----------
    opened : OpenedModel
        A model with a mechanical part.
    path : str or Path
        ``track.csv`` of `track_path`, its folder, or any log of commands in the robot's format.
    out : str or Path
        File that ends in ".mp4", ".gif" or ".html".
    unit : {"m", "cm", "mm"}, default="cm"
        Of the axes.
    speed : float, default=1.0
        Of the film over that of the motion.
    n_frames : int, default=150
        Frames at most.
    progress : callable, optional
        Handed (what, done, total).

    Returns
    -------
    dict
        "frames", "duration_s", "fps", "path" and "bytes" of what was written.
    """
    if not hasattr(opened.chain, "backbone"):
        raise ValueError(
            f"`model` {opened.path} has no body to draw; animate one with a chain as its "
            "mechanical part."
        )
    file = Path(path)
    if file.is_dir():
        file = file / "track.csv"
    q, target, t = _read_track(file, opened.log_format())
    out = Path(out)
    if not out.absolute().parent.is_dir():
        raise FileNotFoundError(f"`out` must lie in a folder that exists, got {out}.")
    q = opened.effective(q)
    with torch.no_grad():
        tips = opened.module(torch.from_numpy(q)).numpy()
    film = plots.TrackAnimation.from_estimator(
        opened.chain, q, target=target, t=t, x=tips, n_frames=n_frames
    )
    film.name = "tip (model)"

    def told(done: int, total: int) -> None:
        if progress is not None:
            progress("drawing frames", done, total)

    staging = out.with_name(f".{out.stem}-unfinished{out.suffix}")
    try:
        film.save(staging, unit=unit, speed=speed, progress=told)
        os.replace(staging, out)
    except RuntimeError as error:  # no program to write films with
        raise ValueError(str(error)) from error
    finally:
        staging.unlink(missing_ok=True)
    return {
        "path": str(out),
        "bytes": out.stat().st_size,
        "frames": len(film.rows),
        "fps": speed * film.fps,
        "duration_s": None if t is None else float(t[-1] - t[0]),
    }


def _read_track(
    file: Path, log_format: robots.LogFormat
) -> tuple[NDArray, NDArray | None, NDArray | None]:
    """Return commands, targets and times of a file, the last two where it has them."""
    if not file.is_file():
        raise FileNotFoundError(f"`track` must be a file of commands, there is none at {file}.")
    with open(file, encoding="utf-8-sig", newline="") as lines:
        header = [name.strip() for name in next(csv.reader(lines), [])]
    time = next((name for name in (TIME, log_format.time) if name in header), None)
    known = set(TARGET) <= set(header)
    data = datasets.load_log(
        file,
        log_format.q,
        TARGET if known else log_format.x,
        time=time,
        q_unit=log_format.q_unit,
        x_unit=log_format.x_unit,
        q_sign=log_format.q_sign,
    )
    return data.q, data.x if known else None, data.time


def _write_track(
    file: Path,
    track: Track,
    sent: NDArray,
    effective: NDArray | None,
    statuses: list[str],
    log_format: robots.LogFormat,
) -> None:
    """Write commands, and what the actuators do where that is something else, point by point."""
    unit, scale = log_format.q_sign / _METRES[log_format.q_unit], 1 / _METRES[log_format.x_unit]
    columns = np.column_stack([track.t, unit * sent, scale * track.x, scale * track.target])
    further = [] if effective is None else [f"effective_{name}" for name in log_format.q]
    tail = np.empty((len(sent), 0)) if effective is None else unit * effective
    with open(file, "w", encoding="utf-8", newline="") as lines:
        writer = csv.writer(lines, lineterminator="\n")
        head = [TIME, *log_format.q, *log_format.x, *TARGET, "error", "status", *further]
        writer.writerow(head)
        rows = zip(columns, scale * track.error, statuses, tail, strict=True)
        for row, error, status, does in rows:
            cells = [f"{v + 0.0:.9g}" for v in row]
            writer.writerow([*cells, f"{error:.6g}", status, *(f"{v + 0.0:.9g}" for v in does)])


def _add_figures(report: Report, opened: OpenedModel, track: Track, sent: NDArray) -> None:
    figure, axes = plots.new_figure(11.0, 4.2, 1, 3)
    display = plots.TrackingDisplay.from_tracks({"model": track})
    i, j = sorted(np.argsort(np.ptp(track.target, axis=0))[1:])  # where most happens
    display.plot(axes[0], unit="mm", plane="xyz"[i] + "xyz"[j])
    display.plot_time(axes[1], unit="mm")
    display.plot_error(axes[2], unit="mm")
    axes[2].get_legend().remove()
    report.figure("track", figure, "Path, tip by the model, and its error.")
    shares = getattr(opened.chain, "actuators_per_segment", (opened.n_actuators,))
    n = len(shares)
    figure, axes = plots.new_figure(7.0, 1.0 + 1.8 * n, n, 1, sharex=True, squeeze=False)
    shown = {"commands": replace(track, q=sent)}
    if opened.play is not None:
        shown["what the actuators do"] = track
    plots.ActuatorDisplay.from_tracks(shown, shares).plot(axes[:, 0], unit="mm")
    if len(shown) == 1:
        axes[0, 0].get_legend().remove()
    report.figure("commands", figure, "Commands as the model counts them.")


def _write_summary(report: Report) -> None:
    record = report.record
    errors = record["errors"]
    report.text(
        f"{record['reached']} of {record['n']} points reached to within {1e3 * record['tol']:g} "
        f"mm, by the model. Error in mm: mean {1e3 * errors['mean']:.3g}, 95 % "
        f"{1e3 * errors['p95']:.3g}, max {1e3 * errors['max']:.3g}. Limits: "
        f"{record['limits']['source']}."
    )
    report.table(["status", "points"], [[k, str(v)] for k, v in record["statuses"].items()])
