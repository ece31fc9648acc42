"""A film or an interactive page of a robot that follows a file of commands."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import hybridkin
from hybridkin import Commands, HybridForwardModel, obstacles
from hybridkin.app.workflow.model import has_body, promised_errors, tips_at
from hybridkin.app.workflow.report import Progress, Report, quiet
from hybridkin.app.workflow.track import LEAD_IN, TARGET, read_track
from hybridkin.formats import check_outputs


def animate_track(
    model: HybridForwardModel,
    path: str | Path,
    out: str | Path,
    *,
    unit: str = "cm",
    speed: float = 1.0,
    n_frames: int = 150,
    obstacles: Sequence[obstacles.Obstacle] = (),
    force: bool = False,
    progress: Progress = quiet,
) -> Report[dict[str, object]]:
    """Write a film or an interactive page of a robot that follows a file of commands.

    Parameters
    ----------
    model : HybridForwardModel
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
    obstacles : sequence of Obstacle, default=()
        Obstacles to show, from `hybridkin.obstacles`.
    force : bool, default=False
        Replace a file that `animate` did not write.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    Report of dict
        Number of "frames" and "bytes", frames per second "fps".
    """
    if not has_body(model):
        raise ValueError(
            f"`model` {model.description_.path} has no body to draw; give a model with a chain as "
            "its mechanical model."
        )
    out = Path(out)
    check_outputs([out], "animate", force=force)
    log = read_track(path, model.description_.log)
    q = model.effective(Commands(log.q, time=log.time))
    if log.groups is not None:  # the way to the path is no part of it
        on_path = log.groups != LEAD_IN
        log = log.rows(on_path)
        q = q[on_path]
    promised = promised_errors(model, q)
    film = hybridkin.plots.TrackAnimation.from_estimator(
        model.module_.robot,
        q,
        target=log.x if tuple(log.x_names) == TARGET else None,
        t=log.time,
        tips=tips_at(model, q),
        expected=promised.mean if promised.known else None,
        names=model.description_.log.q if model.module_.robot.rings else (),
        n_frames=n_frames,
        obstacles=obstacles,
    )
    title = f"{model.description_.name}: {Path(path).name} - hybridkin"
    options = {"unit": unit, "speed": speed, "title": title}
    try:
        film.save(out, **options, progress=partial(progress, "drawing frames"))
    except RuntimeError as error:  # no program to write films with
        raise ValueError(str(error)) from error
    fps = speed * film.fps
    size = out.stat().st_size
    record = {"frames": len(film.rows), "fps": fps, "bytes": size}
    report = Report(f"{model.description_.name}: film of {path}", record)
    report.text(f"{len(film.rows)} frames, {fps:.3g} a second, {size / 1e6:.2f} MB")
    report.paths = [out]
    return report
