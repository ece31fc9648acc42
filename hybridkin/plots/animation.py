"""A track as a film, mp4 or gif, or as an interactive page to turn and scrub."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import animation
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from hybridkin.plots._canvas import (
    COLORS,
    axes_or_new,
    decimals,
    distance,
    label_space,
    plain,
    predicted,
    scale_of,
    times,
    tips,
)
from hybridkin.plots._page import page
from hybridkin.plots.space import BackboneDisplay, Line

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["TrackAnimation"]

_FORMATS = (".mp4", ".gif", ".html")
_PACE = 20.0  # frames per second where there are no times
_SIZE = (9.0, 4.5)  # [inch]
_DPI = {".mp4": 160, ".gif": 80}


class TrackAnimation:
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
        What `x` is called in the legend.

    Attributes
    ----------
    x, target : ndarray of shape (T, 3)
        Reached and wanted tips [m]; `target` may be None.
    error : ndarray of shape (T,) or None
        Distance from the target [m].
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
    >>> film = plots.TrackAnimation.from_track(chain, track, n_frames=3)
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
    ) -> None:
        self.x = tips(x, "x")
        T = len(self.x)
        self.target = None if target is None else tips(target, "target", T)
        self.error = None if self.target is None else distance(self.x, self.target)
        self.t = times(t, T)
        self.rows = np.arange(T) if rows is None else np.array(rows, dtype=int)
        K = len(self.rows)
        inside = K > 0 and self.rows[0] >= 0 and self.rows[-1] < T
        if not (inside and (np.diff(self.rows) > 0).all()):
            raise ValueError(f"`rows` must increase within the {T} rows of `x`, got {self.rows}.")
        if body is not None and len(body.points) != K:
            raise ValueError(
                f"`body` must hold {K} configurations, one per frame, got {len(body.points)}."
            )
        self.body, self.name = body, name

    @classmethod
    def from_estimator(
        cls,
        model: Any,
        q: ArrayLike,
        *,
        target: ArrayLike | None = None,
        t: ArrayLike | None = None,
        x: ArrayLike | None = None,
        n_frames: int = 150,
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
        n_frames : int, default=150
            Frames at most, evenly in time.

        Returns
        -------
        TrackAnimation
            Nothing is drawn yet.
        """
        if n_frames < 1:
            raise ValueError(f"`n_frames` must be at least 1, got {n_frames}.")
        q = plain(q, "q")
        if q.ndim != 2 or len(q) == 0:
            raise ValueError(f"`q` must have shape (T, n) with T >= 1, got {q.shape}.")
        rows = _evenly(times(t, len(q)), len(q), n_frames)
        body = BackboneDisplay.from_estimator(model, q[rows])
        name = "tip (model)" if x is None else "tip (measured)"
        if x is None:
            known = np.isfinite(q).all(axis=1)
            x = np.full((len(q), 3), np.nan)
            x[known] = predicted(model, q[known])
        return cls(x, target=target, t=t, body=body, rows=rows, name=name)

    @classmethod
    def from_track(cls, model: Any, track: Any, *, n_frames: int = 150) -> Self:
        """Return the film of a result of `InverseKinematics.track`.

        Parameters
        ----------
        model : chain or HybridForwardModel
            The robot that was steered, or its model.
        track : Track
            Of tip positions. The measured tips are shown where a plant was there, else those of
            the model.
        n_frames : int, default=150
            Frames at most, evenly in time.

        Returns
        -------
        TrackAnimation
            Nothing is drawn yet.
        """
        return cls.from_estimator(
            model, track.q, target=track.target, t=track.t, x=track.x_measured, n_frames=n_frames
        )

    @property
    def fps(self) -> float:
        """Frames per second at which the film takes as long as the motion [1/s]."""
        if self.t is None or len(self.rows) < 2:
            return _PACE
        return (len(self.rows) - 1) / float(self.t[self.rows[-1]] - self.t[self.rows[0]])

    def plot(self, ax: Any = None, *, unit: str = "cm", frame: int = -1) -> Self:
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
        ax = axes_or_new(ax, projection="3d")
        _Stage(self, ax, None, unit).show(range(len(self.rows))[frame])
        self.ax_, self.figure_ = ax, ax.figure
        return self

    def save(
        self,
        path: str | PathLike[str],
        *,
        unit: str = "cm",
        speed: float = 1.0,
        view: tuple[float, float] = (30.0, -60.0),
        dpi: float | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Path:
        """Write a film or a page, and return where.

        Parameters
        ----------
        path : path-like
            Its ending chooses: ".mp4" needs ffmpeg; ".gif" is larger and needs nothing else;
            ".html" is one page that needs no network, to turn the robot, play, and scrub the time.
            It needs plotly, ``pip install "hybridkin[interactive]"``.
        unit : {"m", "cm", "mm"}, default="cm"
            Of the axes and of the error.
        speed : float, default=1.0
            Of the film over that of the motion.
        view : (float, float), default=(30.0, -60.0)
            Elevation and azimuth of the eye [deg], of a page at the start.
        dpi : float, optional
            Pixels per inch of a film of 9 x 4.5 inches. Default: 160, of a gif 80.
        progress : callable, optional
            Handed (done, total), in frames.

        Returns
        -------
        Path
            The file written.

        Raises
        ------
        ImportError
            For a page without plotly.
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
        if kind == ".html":
            path.write_text(page(self, unit, speed, view, progress), encoding="utf-8")
        else:
            writer = _writer(kind, speed * self.fps)
            self._film(path, writer, _DPI[kind] if dpi is None else dpi, unit, view, progress)
        return path

    def lines(self) -> list[Line]:
        """Return all strokes that move, as `BackboneDisplay.lines` [m].

        Those of the body, and with a target the error: a line from the tip to where it should be.
        """
        x = self.x[self.rows]
        found = [] if self.body is None else self.body.lines(tip=False)
        if self.target is not None:
            way = np.stack([self.target[self.rows], x], axis=1)
            found.append(Line("tip error", way, "black", 2.0))
            found.append(Line("", way[:, :1], "black", 1.0, marker="x", style="none"))
        found.append(Line(self.name, x[:, None], COLORS[0], 1.0, marker="o", style="none"))
        return found

    def limits(self) -> tuple[NDArray, NDArray]:
        """Return the corners (3,) of the box in which everything happens, with a margin [m]."""
        parts = [self.x, *(line.points.reshape(-1, 3) for line in self.lines())]
        everything = np.concatenate(parts if self.target is None else [*parts, self.target])
        known = everything[np.isfinite(everything).all(axis=1)]
        if len(known) == 0:
            raise ValueError("`x` must hold a known tip at least; all rows are NaN.")
        low, high = known.min(axis=0), known.max(axis=0)
        margin = 0.04 * float((high - low).max()) or 1e-3
        return low - margin, high + margin

    def caption(self, k: int, unit: str) -> str:
        """Return what is to be said of a frame: the time, and the error [unit]."""
        row = self.rows[k]
        when = f"step {row}" if self.t is None else f"t = {self.t[row]:.2f} s"
        if self.error is None:
            return when
        error, places = scale_of(unit) * self.error[row], decimals(scale_of(unit) * self.error)
        told = f"{error:.{places}f} {unit}" if np.isfinite(error) else "not known"
        return f"{when}, error {told}"

    def _film(
        self, path: Path, writer: Any, dpi: float, unit: str, view: Any, progress: Any
    ) -> None:
        figure = Figure(figsize=_SIZE, layout="constrained")
        if self.error is None:
            ax, error_ax = figure.add_subplot(projection="3d"), None
        else:
            grid = figure.add_gridspec(1, 2, width_ratios=(1.5, 1.0))
            ax, error_ax = figure.add_subplot(grid[0], projection="3d"), figure.add_subplot(grid[1])
        ax.view_init(*view)
        stage = _Stage(self, ax, error_ax, unit)
        stage.show(0)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # or the picture would tremble
        K = len(self.rows)
        with writer.saving(figure, str(path), dpi):
            for k in range(K):
                stage.show(k)
                writer.grab_frame()
                if progress is not None:
                    progress(k + 1, K)


class _Stage:
    """Artists that show one frame after another."""

    def __init__(self, film: TrackAnimation, ax: Any, error_ax: Any, unit: str) -> None:
        self.film, self.unit, self.scale = film, unit, scale_of(unit)
        self.ax, self.error_ax = ax, error_ax
        low, high = film.limits()
        for bounds, setter in zip(
            np.stack([low, high], axis=1), (ax.set_xlim, ax.set_ylim, ax.set_zlim), strict=True
        ):
            setter(self.scale * bounds)
        label_space(ax, unit)
        if film.target is not None:
            ax.plot(*(self.scale * film.target.T), color="black", linewidth=1.0, label="target")
        self.trail = ax.plot([], [], [], color=COLORS[0], linewidth=1.2, linestyle="--")[0]
        self.moving = []
        for line in film.lines():
            look = {"color": line.color, "linewidth": line.width, "alpha": line.alpha}
            look |= {"linestyle": line.style, "marker": line.marker, "markersize": 6}
            self.moving.append((ax.plot([], [], [], label=line.label or None, **look)[0], line))
        ax.legend(frameon=False, fontsize="small", loc="upper left", bbox_to_anchor=(-0.25, 1.0))
        if error_ax is not None:
            self._draw_error()

    def _draw_error(self) -> None:
        film, ax = self.film, self.error_ax
        self.error = self.scale * np.asarray(film.error)
        self.steps = np.arange(len(film.x)) if film.t is None else film.t
        ax.plot(self.steps, self.error, color=COLORS[0], linewidth=1.5)
        ax.set(xlabel="time step" if film.t is None else "time [s]")
        ax.set(ylabel=f"tip error [{self.unit}]")
        ax.set_ylim(bottom=0.0)
        self.cursor = ax.axvline(self.steps[0], color="black", linewidth=1.0)
        self.dot = ax.plot([], [], "o", color=COLORS[0])[0]

    def show(self, k: int) -> None:
        """Move everything to frame k."""
        film, row = self.film, self.film.rows[k]
        self.trail.set_data_3d(*(self.scale * film.x[: row + 1].T))
        for artist, line in self.moving:
            artist.set_data_3d(*(self.scale * line.points[k].T))
        if self.error_ax is None:
            self.ax.set_title(film.caption(k, self.unit), fontsize="medium")
            return
        self.error_ax.set_title(film.caption(k, self.unit), fontsize="medium")
        self.cursor.set_xdata([self.steps[row]] * 2)
        self.dot.set_data([self.steps[row]], [self.error[row]])


def _evenly(t: NDArray | None, n_rows: int, most: int) -> NDArray:
    """Return the rows nearest to even times, increasing."""
    t = np.arange(n_rows) if t is None else t
    wanted = np.linspace(t[0], t[-1], min(most, n_rows))
    after = np.searchsorted(t, wanted).clip(1, max(1, n_rows - 1))
    before = after - 1
    after = after.clip(max=n_rows - 1)
    return np.unique(np.where(wanted - t[before] <= t[after] - wanted, before, after))


def _writer(kind: str, fps: Any) -> Any:
    if kind == ".gif":
        return animation.PillowWriter(fps=fps)
    if not animation.writers.is_available("ffmpeg"):
        raise RuntimeError(
            "`path` ends in .mp4, which needs the program ffmpeg, and none was found; install it "
            "(apt install ffmpeg, brew install ffmpeg, conda install ffmpeg), or save as .gif or "
            ".html."
        )
    return animation.FFMpegWriter(fps=fps, bitrate=2000)
