"""A model and a path: the commands that follow it, as a file to send to the robot."""

from __future__ import annotations

import csv
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin import datasets, plots, robots
from hybridkin.experiments._opened import OpenedModel
from hybridkin.experiments._report import Report, check_out
from hybridkin.ik import IKStatus, InverseKinematics
from hybridkin.trajectories import Trajectory, from_csv

TARGET = ("target_x", "target_y", "target_z")
TIME = "t"
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_REACHED = (IKStatus.CONVERGED, IKStatus.OUT_OF_DOMAIN)


def track_path(
    opened: OpenedModel,
    path: Trajectory,
    out: str | Path,
    *,
    q_min: ArrayLike | None = None,
    q_max: ArrayLike | None = None,
    dq_max: ArrayLike | None = None,
    beta: float = 1.0,
    tol: float = 1e-4,
    log_format: robots.LogFormat | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> tuple[Report, list[Path]]:
    """Compute the commands that lead the tip along a path, and write them.

    Written are ``track.csv``, with one row per point in the units, names and sign of the robot's
    logs: time, commands, the model's tip, the target, the error and its status; a figure, and the
    report.

    Parameters
    ----------
    opened : OpenedModel
        The model, as from `open_model`.
    path : Trajectory
        Points [m] and times [s].
    out : str or Path
        Folder to write into.
    q_min, q_max, dq_max : array-like of shape (n,), optional
        Limits [m], speeds [m/s]. Default: those of the robot's description, else the range that
        the model was fitted on.
    beta, tol
        As for `InverseKinematics` and its `track`.
    log_format : LogFormat, optional
        Names, units and sign of what is written. Default: those of the robot's logs.
    progress : callable, optional
        Handed (what, done, total).

    Returns
    -------
    report : Report
        Its ``record`` holds "errors" [m], "statuses", "reached" and "limits".
    paths : list of Path
        What was written.
    """
    check_out(out)
    log_format = log_format or opened.log_format()
    limits = path_limits(opened, q_min, q_max, dq_max)
    periods = np.diff(path.t)
    dt = float(periods.max()) if len(periods) else 0.01
    posture = preferred(opened, limits)
    ik = InverseKinematics(
        opened.model,
        q_min=limits["q_min"],
        q_max=limits["q_max"],
        dq_max=limits["dq_max"],
        q_pref=posture,
        beta=min(beta, 1.0 / dt),
        dt=dt,
    )

    def told(done: int, total: int) -> None:
        if progress is not None:
            progress("tracking", done + 1, total)

    first = ik.solve(path.x[0], tol=0.1 * tol, max_iter=200, restarts=16, random_state=0)
    track = ik.track(path, q0=first.q, tol=tol, progress=told)
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
        statuses={name: names.count(name) for name in dict.fromkeys(names)},
        limits={**limits, "source": limits["source"]},
        largest_speed=np.abs(np.diff(track.q, axis=0) / periods[:, None]).max(initial=0.0),
        columns={"q": log_format.q, "q_unit": log_format.q_unit, "q_sign": log_format.q_sign},
    )
    report.record["columns"] |= {"x": log_format.x, "x_unit": log_format.x_unit}
    _write_summary(report)
    _add_figures(report, opened, track)
    report.file("track.csv", lambda file: _write_track(file, track, names, log_format))
    return report, report.write(out)


def path_limits(
    opened: OpenedModel,
    q_min: ArrayLike | None = None,
    q_max: ArrayLike | None = None,
    dq_max: ArrayLike | None = None,
) -> dict[str, Any]:
    """Return the limits of the actuators: those given, the description's, the fitted range."""
    found = {"q_min": q_min, "q_max": q_max, "dq_max": dq_max}
    source = "given"
    if opened.description is not None:
        own = opened.description.limits
        for name in found:
            if found[name] is None and getattr(own, name) is not None:
                found[name], source = getattr(own, name), "robot description"
    trained = opened.trained_range
    if trained is not None:
        for name, value in zip(("q_min", "q_max"), trained, strict=True):
            if found[name] is None:
                found[name], source = value, "range of the fit"
    if found["q_min"] is None or found["q_max"] is None:
        raise ValueError(
            "`q_min` and `q_max` must be given (--q-min, --q-max), or stand as [limits] in the "
            "robot description: this model does not know the range of its actuators."
        )
    sized = {
        name: None if value is None else np.broadcast_to(value, opened.n_actuators).astype(float)
        for name, value in found.items()
    }
    return {**sized, "source": source}


def preferred(opened: OpenedModel, limits: dict[str, Any]) -> NDArray:
    """Return the configuration to keep near (n,), within the limits.

    It is the middle of the fit's range, near the rows that the model learned from; without a fit
    where no tendon is pulled, else the middle of the limits.
    """
    low, high = opened.trained_range or (limits["q_min"], limits["q_max"])
    tendons = getattr(opened.chain, "lengths", None) is not None
    at_rest = tendons and opened.trained_range is None
    middle = np.zeros(opened.n_actuators) if at_rest else 0.5 * (low + high)
    return np.clip(middle, limits["q_min"], limits["q_max"])


def middle_tip(opened: OpenedModel, limits: dict[str, Any]) -> NDArray:
    """Return a place (3,) in the midst of the workspace [m].

    It is the tip of random commands that is nearest to their mean: some robots reach only a
    surface.
    """
    low, high = opened.trained_range or (limits["q_min"], limits["q_max"])
    low, high = np.maximum(low, limits["q_min"]), np.minimum(high, limits["q_max"])
    q = np.random.default_rng(0).uniform(low, high, (256, opened.n_actuators))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"\d+ of \d+ rows of `\w+` pull the tendons")
        tips = opened.predict(q)
    tips = tips[np.isfinite(tips).all(axis=1)]
    return tips[np.linalg.norm(tips - tips.mean(axis=0), axis=1).argmin()]


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
    log_format: robots.LogFormat | None = None,
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
    log_format : LogFormat, optional
        How the file is written. Default: as the robot's logs are.
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
    file, log_format = Path(path), log_format or opened.log_format()
    if file.is_dir():
        file = file / "track.csv"
    q, target, t = _read_track(file, log_format)
    out = Path(out)
    if not out.absolute().parent.is_dir():
        raise FileNotFoundError(f"`out` must lie in a folder that exists, got {out}.")
    film = plots.TrackAnimation.from_estimator(
        opened.model, q, target=target, t=t, n_frames=n_frames
    )

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


def _write_track(file: Path, track: Any, statuses: list[str], log_format: robots.LogFormat) -> None:
    q = track.q * log_format.q_sign / _METRES[log_format.q_unit]
    scale = 1.0 / _METRES[log_format.x_unit]
    columns = np.column_stack([track.t, q, scale * track.x, scale * track.target])
    with open(file, "w", encoding="utf-8", newline="") as lines:
        writer = csv.writer(lines, lineterminator="\n")
        writer.writerow([TIME, *log_format.q, *log_format.x, *TARGET, "error", "status"])
        for row, error, status in zip(columns, scale * track.error, statuses, strict=True):
            writer.writerow([*(f"{v + 0.0:.9g}" for v in row), f"{error:.6g}", status])


def _add_figures(report: Report, opened: OpenedModel, track: Any) -> None:
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
    plots.ActuatorDisplay.from_tracks({"commands": track}, shares).plot(axes[:, 0], unit="mm")
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
