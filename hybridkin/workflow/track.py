"""A model and a path: the commands that follow it, as a file to send to the robot."""

from __future__ import annotations

import csv
import math
import os
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin._core.units import METRES
from hybridkin.chains import robots
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.datasets import load_log
from hybridkin.ik.results import IKStatus, Track
from hybridkin.ik.solver import InverseKinematics
from hybridkin.ik.trajectories import Trajectory
from hybridkin.plots import ActuatorDisplay, TrackAnimation, TrackingDisplay, new_figure
from hybridkin.workflow._domain import PathLimits, path_limits, preferred_posture, sample_domain
from hybridkin.workflow.model import LoadedModel
from hybridkin.workflow.report import Progress, Report, check_out, millimetres, quiet

TARGET = ("target_x", "target_y", "target_z")
TIME = "t"
_COLUMNS = ("q", "q_unit", "q_sign", "q_scale", "x", "x_unit")  # of a log format, in the record
_REACHED = (IKStatus.CONVERGED, IKStatus.OUT_OF_DOMAIN)
_STEP = 0.002  # of the tip between two solutions, over the extent of the workspace
_GUESSES = 16
_PULLS = (0.2, 0.0, 0.0, 0.2)  # to the preferred configuration, one attempt at the path each


def track_path(
    loaded: LoadedModel,
    path: Trajectory,
    out: str | Path,
    *,
    limits: PathLimits | None = None,
    tol: float = 1e-4,
    progress: Progress = quiet,
) -> tuple[Report, list[Path]]:
    """Compute the commands that lead the tip along a path, and write them.

    ``track.csv`` has one row per point in the units, names and sign of the robot's logs: time,
    commands, the model's tip, the target, the error and its status. Figures and the report come
    with it. Points far apart are passed in several steps on a straight line; where points are
    missed, other starts and postures are tried, and the track that reaches most within the domain
    is kept. Of a model with play the commands are those to send, which lead or trail what the
    actuators do by half its width, and further columns ``effective_NAME`` hold the latter.

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
    tol : float, default=1e-4
        As for `InverseKinematics.track` [m].
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    report : Report
        Its ``record`` holds "errors" [m], "statuses", "reached", "in_domain" (share of the points,
        None without a learned part), "limits" and "play" (width [m]).
    paths : list of Path
        What was written.
    """
    check_out(out)
    log_format = loaded.log_format()
    limits = path_limits(loaded) if limits is None else limits
    track = _best_track(loaded, path, limits, tol, progress)
    sent = track.q if loaded.play is None else loaded.play.command(track.q)[0]
    names = [IKStatus(int(code)).name for code in track.status]
    speeds = np.abs(np.diff(track.q, axis=0) / np.diff(path.t)[:, None])
    inside = loaded.module.in_domain(torch.from_numpy(track.q)).double().mean()
    report = Report(f"{loaded.name}: a path of {len(path)} points")
    report.record.update(
        model=str(loaded.path),
        n=len(path),
        duration_s=path.duration,
        reached=_score(track)[1],
        errors={"mean": track.mean_error, "p95": track.p95_error, "max": track.max_error},
        tol=tol,
        in_domain=None if loaded.hybrid is None else float(inside),
        play=loaded.play_width,
        statuses=dict(Counter(names)),
        limits=dict(vars(limits)),
        largest_speed=speeds.max(initial=0.0),
        columns={name: vars(log_format)[name] for name in _COLUMNS},
    )
    _write_summary(report)
    _add_figures(report, loaded, track, sent)
    effective = None if loaded.play is None else track.q
    write = partial(_write_track, track, sent, effective, names, log_format)
    report.file("track.csv", write)
    return report, report.write(out)


def _best_track(
    loaded: LoadedModel, path: Trajectory, limits: PathLimits, tol: float, progress: Progress
) -> Track:
    """Return of several attempts the track that reaches most points within the domain."""
    commands, tips = sample_domain(loaded, limits)
    way = np.linalg.norm(np.diff(path.x, axis=0), axis=1).max(initial=0.0)
    extent = np.linalg.norm(np.ptp(tips, axis=0))
    fine, every = _in_steps(path, max(1, math.ceil(way / (_STEP * extent))))
    dt = float(np.diff(fine.t).max()) if len(fine) > 1 else 0.01
    bounds: Any = {name: vars(limits)[name] for name in ("q_min", "q_max", "dq_max")}
    tracks: list[Track] = []
    for attempt, pull in enumerate(_PULLS):
        posture = preferred_posture(loaded, limits, pull)
        options = {"q_pref": posture, "beta": min(1.0, 1.0 / dt), "dt": dt}
        ik = InverseKinematics(loaded.module, **bounds, **options)

        def report(done: int, total: int, what: str = f"tracking, attempt {attempt + 1}") -> None:
            progress(what, done + 1, total)

        first = _initial_guesses(ik, path.x[0], commands, tips, 0.1 * tol)[attempt % 2]
        found: Any = ik.track(fine, q0=first, tol=tol, progress=report)
        # Of the steps between the points only the points are kept.
        rows = {k: v[::every] for k, v in vars(found).items() if v is not None}
        tracks.append(replace(found, **rows))
        if _score(tracks[-1]) == (len(path), len(path)):
            break
    return max(tracks, key=_score)  # of equals the first


def _in_steps(path: Trajectory, n: int) -> tuple[Trajectory, int]:
    """Return the path with every way between two points cut into n, and n."""
    if n == 1 or len(path) < 2:
        return path, 1
    places = np.arange((len(path) - 1) * n + 1) / n
    columns = np.column_stack([path.t, path.x])
    t, *x = (np.interp(places, np.arange(len(path)), column) for column in columns.T)
    return Trajectory(t, np.stack(x, axis=1)), n


def _initial_guesses(
    ik: InverseKinematics, target: NDArray, commands: NDArray, tips: NDArray, tol: float
) -> list[NDArray]:
    """Return two configurations (n,) to start from, at the target.

    One that the first of the commands, near the preferred one, leads to; and of those from the
    commands whose tips are nearest to the target, in the domain if possible, the one with the
    largest singular value sigma_min.
    """
    near = np.argsort(np.linalg.norm(tips[1:] - target, axis=1))[:_GUESSES] + 1
    near = np.concatenate([[0], near])
    targets = np.broadcast_to(target, (len(near), 3)).copy()
    found = ik.solve(targets, q0=commands[near], tol=tol, max_iter=200)
    for wanted in _REACHED:
        rows = np.flatnonzero(found.status[1:] == wanted) + 1
        if len(rows):
            return [found.q[0], found.q[rows[found.sigma_min[rows].argmax()]]]
    free = ik.solve(target, tol=tol, max_iter=200, restarts=_GUESSES)
    return [found.q[0], free.q]


def _score(track: Track) -> tuple[int, int]:
    """Return how many points were reached within the domain, and how many at all."""
    statuses = np.asarray(track.status)
    return int((statuses == IKStatus.CONVERGED).sum()), int(np.isin(statuses, _REACHED).sum())


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
    """Write a film or an interactive page of a robot that runs through a file of commands.

    Parameters
    ----------
    loaded : LoadedModel
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
        Called with (what, done, total).

    Returns
    -------
    dict
        "frames", "duration_s", "fps", "path" and "bytes" of what was written.
    """
    if loaded.chain is None:
        raise ValueError(
            f"`model` {loaded.path} has no body to draw; animate one with a chain as its "
            "mechanical part."
        )
    file = Path(path)
    if file.is_dir():
        file = file / "track.csv"
    q, target, t = _read_track(file, loaded.log_format())
    out = Path(out)
    if not out.absolute().parent.is_dir():
        raise FileNotFoundError(f"`out` must lie in a folder that exists, got {out}.")
    q = loaded.effective(q)
    with torch.no_grad():
        tips = loaded.module(torch.from_numpy(q)).numpy()
    film = TrackAnimation.from_estimator(
        loaded.chain, q, target=target, t=t, x=tips, n_frames=n_frames
    )
    film.name = "tip (model)"
    staging = out.with_name(f".{out.stem}-unfinished{out.suffix}")
    try:
        film.save(staging, unit=unit, speed=speed, progress=partial(progress, "drawing frames"))
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
    has_targets = set(TARGET) <= set(header)
    columns = dict(vars(log_format), groups=None)
    del columns["group_suffix"]
    columns["time"] = next((name for name in (TIME, log_format.time) if name in header), None)
    if has_targets:
        columns["x"] = TARGET
    log = load_log(file, **columns)
    return log.q, log.x if has_targets else None, log.time


def _write_track(
    track: Track,
    sent: NDArray,
    effective: NDArray | None,
    statuses: list[str],
    log_format: robots.LogFormat,
    file: Path,
) -> None:
    """Write commands, and what the actuators do where that is something else, point by point."""
    unit, scale = 1 / log_format.q_factor, 1 / METRES[log_format.x_unit]
    columns = np.column_stack([track.t, unit * sent, scale * track.x, scale * track.target])
    head = [TIME, *log_format.q, *log_format.x, *TARGET, "error", "status"]
    cells = [*_text("%.9g", columns).T, _text("%.6g", scale * track.error), statuses]
    if effective is not None:
        head += [f"effective_{name}" for name in log_format.q]
        cells += [*_text("%.9g", unit * effective).T]
    with open(file, "w", encoding="utf-8", newline="") as lines:
        writer = csv.writer(lines, lineterminator="\n")
        writer.writerows([head, *zip(*cells, strict=True)])


def _text(form: str, values: NDArray) -> NDArray:
    return np.char.mod(form, values + 0.0)  # no -0


def _add_figures(report: Report, loaded: LoadedModel, track: Track, sent: NDArray) -> None:
    figure, axes = new_figure(11.0, 4.2, 1, 3)
    display = TrackingDisplay.from_tracks({"model": track})
    i, j = sorted(np.argsort(np.ptp(track.target, axis=0))[1:])  # the plane of the largest moves
    display.plot(axes[0], unit="mm", plane="xyz"[i] + "xyz"[j])
    display.plot_time(axes[1], unit="mm")
    display.plot_error(axes[2], unit="mm")
    axes[2].get_legend().remove()
    report.figure("track", figure, "Path, tip by the model, and its error.")
    chain = loaded.chain
    shares = chain.actuators_per_segment if isinstance(chain, ArcChain) else (loaded.n_actuators,)
    n = len(shares)
    figure, axes = new_figure(7.0, 1.0 + 1.8 * n, n, 1, sharex=True, squeeze=False)
    shown = {"commands": replace(track, q=sent)}
    if loaded.play is not None:
        shown["what the actuators do"] = track
    ActuatorDisplay.from_tracks(shown, shares).plot(axes[:, 0], unit="mm")
    if len(shown) == 1:
        axes[0, 0].get_legend().remove()
    report.figure("commands", figure, "Commands as the model counts them.")


def _write_summary(report: Report) -> None:
    record = report.record
    columns, source = record["columns"], record["limits"]["source"]
    mean, most, largest = (f"{1e3 * record['errors'][key]:.3g}" for key in ("mean", "p95", "max"))
    report.text(
        f"{record['reached']} of {record['n']} points reached to within {1e3 * record['tol']:g} "
        f"mm, by the model. Error in mm: mean {mean}, 95 % {most}, max {largest}. Limits: {source}."
    )
    report.table(["status", "points"], [[k, str(v)] for k, v in record["statuses"].items()])
    if record["in_domain"] is not None:
        report.text(f"{100 * record['in_domain']:.0f} % of the points lie in the model's domain.")
    sign = ", shortening positive" if np.all(np.less(columns["q_sign"], 0)) else ""
    units = f"q in {columns['q_unit']}{sign}; x, target and error in {columns['x_unit']}; t in s."
    report.text(f"track.csv: {units}")
    if record["play"] is not None:
        report.text(
            f"Backlash (play) {millimetres(record['play'])}: a command jumps by that where its "
            "actuator turns back. q is what to send, effective_... what the actuators do."
        )
