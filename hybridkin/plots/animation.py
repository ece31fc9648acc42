"""A track as a film, mp4 or gif, or as an interactive page."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from matplotlib import animation
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin._core.arrays import whole
from hybridkin._core.files import MARK, write_file
from hybridkin._core.progress import quiet
from hybridkin.plots._arrays import (
    distance,
    plain,
    shaped,
    shaped_or_empty,
    times,
)
from hybridkin.plots._canvas import (
    ERROR,
    TARGET,
    TIP,
    Display,
    decimals,
    scale_of,
    space_or_new,
    steps_of,
)
from hybridkin.plots._obstacles import Convex, extent, solids
from hybridkin.plots._page import page
from hybridkin.plots._scene import Line, Scene, Stage
from hybridkin.plots.models import Model, predicted
from hybridkin.plots.space import BackboneDisplay

_FORMATS = (".mp4", ".gif", ".html")
_PACE = 20.0  # frames per second without times
_SIZE = (9.0, 4.5)  # [inch]
_DPI = {".mp4": 160, ".gif": 80}


class TrackAnimation(Display):
    """A robot that follows a path: target, reached tips, moving body and error over time.

    Parameters
    ----------
    x : array-like of shape (T, 3)
        Tips reached [m], NaN where they are not known.
    target : array-like of shape (T, 3), optional
        Path to follow [m].
    t : array-like of shape (T,), optional
        Times [s]. Default: time steps.
    body : BackboneDisplay of K configurations, optional
        The robot in every frame.
    rows : array-like of shape (K,), optional
        The rows of `x` that become frames, increasing. Default: all.
    name : str, default="tip"
        Name of `x` in the legend.
    expected : array-like of shape (T,), optional
        Error of the robot to expect [m]. Default: the distance from the target is shown.
    obstacles : sequence of Obstacle, default=()
        Obstacles around the robot, from `hybridkin.obstacles`.

    Attributes
    ----------
    x, target : ndarray of shape (T, 3)
        Tips reached and targets [m]; without a target `target` has no rows.
    error : ndarray of shape (T,)
        Error that is shown, expected or the distance from the target [m]; empty without both.
    rows : ndarray of shape (K,)
        Rows that are frames.
    fps : float
        Frames per second at which the film takes as long as the motion [1/s].
    ax_, figure_ : matplotlib Axes and Figure
        Where a frame was drawn last by `plot`.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from hybridkin import InverseKinematics, plots, robots, trajectories
    >>> chain = robots.bionic_handling_assistant()
    >>> path = trajectories.figure_eight([0.0, 0.0, 0.75], (0.2, 0.1), duration=2.0, dt=0.05)
    >>> track = InverseKinematics(chain, q_min=0.1, q_max=0.4, dt=0.05).track(path.x, path.t)
    >>> film = plots.TrackAnimation.from_estimator(
    ...     chain, track.q, target=track.target, t=track.t, n_frames=3
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     film.save(Path(folder) / "track.gif").stat().st_size > 10_000
    True
    """

    def __init__(
        self,
        x: ArrayLike,
        *,
        target: ArrayLike | None = None,
        t: ArrayLike | None = None,
        body: BackboneDisplay | None = None,
        rows: ArrayLike | None = None,
        name: str = "tip",
        expected: ArrayLike | None = None,
        obstacles: Sequence[Convex] = (),
    ) -> None:
        self.x = shaped(x, "x", "T3")
        T = len(self.x)
        self.target = shaped_or_empty(target, "target", "T3", T)
        self.error = shaped_or_empty(expected, "expected", "T", T)
        self.error_name = "expected error"
        if not len(self.error):
            self.error_name = "error"
            if len(self.target):
                self.error = distance(self.x, self.target)
        self.t = times(t, T)
        shown = shaped(np.arange(T) if rows is None else rows, "rows", "K")
        K = len(shown)
        inside = K > 0 and shown[0] >= 0 and shown[-1] < T
        if not (inside and (np.diff(shown) > 0).all()):
            raise ValueError(f"`rows` must increase within the {T} rows of `x`, got {shown}.")
        self.rows = shown.astype(int)
        if body is not None and len(body.points) != K:
            raise ValueError(f"`body` must hold {K} configurations, got {len(body.points)}.")
        self.body = body
        self.name = str(name)
        self.obstacles = solids(obstacles)

    @classmethod
    def from_estimator(
        cls,
        model: Model,
        q: ArrayLike,
        *,
        target: ArrayLike | None = None,
        t: ArrayLike | None = None,
        x: ArrayLike | None = None,
        tips: ArrayLike | None = None,
        expected: ArrayLike | None = None,
        names: Sequence[str] = (),
        n_frames: int = 150,
        obstacles: Sequence[Convex] = (),
    ) -> Self:
        """Return the film of a robot that runs through given configurations.

        Parameters
        ----------
        model : chain or HybridForwardModel
            A chain, or a fitted hybrid model; the body is that of its mechanical part.
        q : array-like of shape (T, n)
            Actuator vectors.
        target : array-like of shape (T, 3), optional
            Path to follow [m].
        t : array-like of shape (T,), optional
            Times [s].
        x : array-like of shape (T, 3), optional
            Tips measured at `q` [m]. Default: those that the model predicts.
        tips : array-like of shape (T, 3), optional
            Tips that the model predicts [m], where they depend on more than `q`. The body ends
            there. Default: see `BackboneDisplay.from_estimator`.
        expected : array-like of shape (T,), optional
            Error of the robot to expect [m].
        names : sequence of str, optional
            Names of the actuators, see `BackboneDisplay`.
        n_frames : int, default=150
            Frames at most, evenly in time.
        obstacles : sequence of Obstacle, default=()
            Obstacles around the robot, from `hybridkin.obstacles`.

        Returns
        -------
        TrackAnimation
            Nothing is drawn yet.
        """
        n_frames = whole(n_frames, "n_frames")
        q = plain(q, "q")
        if q.ndim != 2 or len(q) == 0:
            raise ValueError(f"`q` must have shape (T, n) with T >= 1, got {q.shape}.")
        rows = _evenly(times(t, len(q)), len(q), n_frames)
        ends = None
        if tips is not None:
            tips = shaped(tips, "tips", "T3", len(q))
            ends = tips[rows]
        body = BackboneDisplay.from_estimator(model, q[rows], tips=ends, names=names)
        name = "tip (measured)"
        if x is None:
            name = "tip (model)"
            x = tips
        if x is None:
            finite = np.isfinite(q).all(axis=1)
            x = np.full((len(q), 3), np.nan)
            x[finite] = predicted(model, q[finite])
        return cls(
            x,
            target=target,
            t=t,
            body=body,
            rows=rows,
            name=name,
            expected=expected,
            obstacles=obstacles,
        )

    @property
    def fps(self) -> float:
        """Frames per second at which the film takes as long as the motion [1/s]."""
        if self.t is None or len(self.rows) < 2:
            return _PACE
        t = self.t[self.rows]
        return (len(t) - 1) / float(t[-1] - t[0])

    def plot(self, ax: Axes | None = None, *, unit: str = "cm", frame: int = -1) -> Self:
        """Draw one frame into a 3-D axes and return self.

        Parameters
        ----------
        ax : matplotlib 3-D Axes, optional
            Default: those of a new figure of pyplot.
        unit : {"m", "cm", "mm"}, default="cm"
            Of the axes.
        frame : int, default=-1
            Which of the K frames; the last by default.

        Returns
        -------
        TrackAnimation
            Itself, drawn.
        """
        space = space_or_new(ax)
        K = len(self.rows)
        frame = whole(frame, "frame", -K, K - 1)
        Stage(self._scene(unit), space).show(frame % K)
        return self._drawn(space)

    def save(
        self,
        path: str | PathLike[str],
        *,
        unit: str = "cm",
        speed: float = 1.0,
        dpi: float | None = None,
        title: str = "",
        progress: Callable[[int, int], None] = quiet,
    ) -> Path:
        """Write a film or a page, and return where.

        Parameters
        ----------
        path : path-like
            Its ending is the format: ".mp4" needs ffmpeg; ".gif" is larger and needs nothing else;
            ".html" is one page of about 1.5 MB that needs no network, to turn the robot, play, and
            scrub the time. To write it needs viser, ``pip install "hybridkin[view]"``.
        unit : {"m", "cm", "mm"}, default="cm"
            Of the axes and of the error.
        speed : float, default=1.0
            Speed of the film over that of the motion.
        dpi : float, optional
            Pixels per inch of a film of 9 x 4.5 inches. Default: 160, of a gif 80.
        title : str, optional
            Title of a page, in the tab of the browser. Default: the name of the file.
        progress : callable, optional
            Called with (done, total), in frames.

        Returns
        -------
        Path
            The file written.

        Raises
        ------
        ImportError
            For a page without viser.
        RuntimeError
            For mp4 without ffmpeg.
        ValueError
            For another ending.
        """
        path = Path(path)
        kind = path.suffix.lower()
        if kind not in _FORMATS:
            raise ValueError(f"`path` must end in one of {_FORMATS}, got {path.name!r}.")
        if not 0.0 < speed < np.inf:
            raise ValueError(f"`speed` must be positive, got {speed!r}.")
        scene = self._scene(unit)
        fps = speed * self.fps
        if kind == ".html":
            html = page(scene, str(title) or path.stem, fps, progress)
            text = html.encode() + b"\n<!-- %s -->\n" % MARK
            write_file(path, lambda staging: staging.write_bytes(text))
            return path
        writer = _writer(kind, fps)
        figure = Figure(figsize=_SIZE, layout="constrained")
        stage = _stage(figure, scene)
        if dpi is None:
            dpi = _DPI[kind]

        def draw(staging: Path) -> None:
            with writer.saving(figure, str(staging), dpi):
                for k in range(len(self.rows)):
                    stage.show(k)
                    writer.grab_frame()
                    progress(k + 1, len(self.rows))
            if kind == ".gif":
                _mark(staging)

        write_file(path, draw)
        return path

    def lines(self) -> list[Line]:
        """Return all strokes that move, as `BackboneDisplay.lines` [m].

        Those of the body, and with a target the error: a line from the tip to its target.
        """
        x = self.x[self.rows]
        lines = []
        if self.body is not None:
            lines += self.body.lines(tip=False)
        if len(self.target):
            way = np.stack([self.target[self.rows], x], axis=1)
            lines.append(Line("tip error", way, ERROR, 2.5))
            lines.append(Line("target now", way[:, :1], TARGET, 1.0, marker="x", style="none"))
        tip = Line(self.name, x[:, None], TIP, 1.0, marker="o", style="none")
        return [*lines, tip]

    def limits(self) -> tuple[NDArray, NDArray]:
        """Return the corners (3,) of a box around all points, with a margin [m]."""
        parts = [self.x, *(line.points.reshape(-1, 3) for line in self.lines())]
        if len(self.target):
            parts.append(self.target)
        everything = np.concatenate(parts)
        finite = everything[np.isfinite(everything).all(axis=1)]
        if len(finite) == 0:
            raise ValueError("`x` must hold at least one known tip; all rows are NaN.")
        finite = np.concatenate([finite, extent(self.obstacles)])
        low = finite.min(axis=0)
        high = finite.max(axis=0)
        margin = 0.04 * float((high - low).max()) or 1e-3
        return low - margin, high + margin

    def caption(self, k: int, unit: str) -> str:
        """Return the title of frame k: the time, and the error [unit]."""
        row = self.rows[k]
        if self.t is None:
            when = f"step {row}"
        else:
            when = f"t = {self.t[row]:.2f} s"
        error = scale_of(unit) * self.error
        if not len(error):
            return when
        if not np.isfinite(error[row]):
            return f"{when}, {self.error_name} not known"
        return f"{when}, {self.error_name} {error[row]:.{decimals(error)}f} {unit}"

    def _scene(self, unit: str) -> Scene:
        scale = scale_of(unit)
        low, high = self.limits()
        steps, when = steps_of(self.t, len(self.x))
        return Scene(
            unit=unit,
            low=scale * low,
            high=scale * high,
            x=scale * self.x,
            target=scale * self.target,
            error=scale * self.error,
            error_name=f"{self.error_name} [{unit}]",
            steps=steps,
            when=when,
            rows=self.rows,
            moving=[line._replace(points=scale * line.points) for line in self.lines()],
            captions=[self.caption(k, unit) for k in range(len(self.rows))],
            obstacles=[solid.scaled(scale) for solid in self.obstacles],
        )


def _evenly(t: NDArray | None, n_rows: int, most: int) -> NDArray:
    """Return the rows nearest to even times, increasing."""
    if t is None:
        t = np.arange(n_rows)
    wanted = np.linspace(t[0], t[-1], min(most, n_rows))
    rows = np.interp(wanted, t, np.arange(n_rows))
    return np.unique(np.rint(rows).astype(int))


def _stage(figure: Figure, scene: Scene) -> Stage:
    """Return the robot on the left of a figure, and the error, if there is one, on the right."""
    grid = figure.add_gridspec(1, 2, width_ratios=(1.5, 1.0))
    place = grid[0] if len(scene.error) else grid[:]
    space = figure.add_subplot(place, projection="3d")
    error_ax = None
    if len(scene.error):
        error_ax = figure.add_subplot(grid[1])
    stage = Stage(scene, space, error_ax)
    stage.show(0)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # keeps the axes in place
    return stage


def _mark(path: Path) -> None:
    """Add a comment to a gif, before the byte that ends it."""
    with open(path, "rb+") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"!\xfe" + bytes([len(MARK)]) + MARK + b"\0;")


def _writer(kind: str, fps: float) -> animation.AbstractMovieWriter:
    if kind == ".gif":
        return animation.PillowWriter(fps=fps)  # pyright: ignore[reportArgumentType]
    if not animation.writers.is_available("ffmpeg"):
        raise RuntimeError(
            "`path` (--out) ends in .mp4, which needs the program ffmpeg, and none was found; "
            "install it (apt, brew or conda install ffmpeg), or save as .gif or .html."
        )
    about = {"comment": MARK.decode()}
    return animation.FFMpegWriter(fps=fps, bitrate=2000, metadata=about)  # pyright: ignore[reportArgumentType]
