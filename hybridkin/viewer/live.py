"""The page: what viser shows of a robot, and what the mouse changes."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin.chains.chain import Chain
from hybridkin.datasets import Log
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.viewer.drawing import (
    BLUE,
    GREEN,
    ORANGE,
    RED,
    YELLOW,
    Body,
    Ghost,
    between,
)
from hybridkin.viewer.motions import Loop, Motion, Replay, Wiggle
from hybridkin.viewer.steered import RATE, SteeredRobot
from hybridkin.workflow.domain import path_limits
from hybridkin.workflow.model import LoadedModel

__all__ = ["LiveView", "view"]

_MOST_ROWS = 2000  # of a log, drawn as a cloud
_CAMERA = np.array([0.9, -1.1, 0.4])  # from the middle, relative to the robot's size
_SAID = 0.1  # between two updates of the words [s]


def view(
    model: LoadedModel | HybridForwardModel | Chain,
    log: Log | None = None,
    *,
    q_min: Any = None,
    q_max: Any = None,
    dq_max: Any = None,
    ddq_max: Any = None,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> LiveView:
    """Open a live 3D view of a robot: a page on which its target can be dragged.

    Parameters
    ----------
    model : LoadedModel, HybridForwardModel or Chain
        A model with a mechanical part that can be drawn; from a file by `workflow.open_model`.
    log : Log, optional
        Measured rows to show, from `datasets.load_log` or `workflow.read_log`.
    q_min, q_max, dq_max, ddq_max : float or array-like of shape (n,), optional
        Limits of position, speed and acceleration [unit of q, s]. Default: those of the model and
        its description; else the range of the log, and one second for the whole range.
    host : str, default="127.0.0.1"
        Address to listen to. The default can be reached from this machine alone.
    port : int, default=8080
        Port; the next free one if it is taken.

    Returns
    -------
    LiveView
        The running view; `close` ends it, as does the end of a ``with`` block.

    Raises
    ------
    ImportError
        Without viser.
    TypeError
        If the model has no mechanical part that can be drawn.
    ValueError
        If the range of the actuators is not known.

    Examples
    --------
    >>> import hybridkin
    >>> chain = hybridkin.robots.bionic_handling_assistant()
    >>> with hybridkin.view(chain, q_min=0.1, q_max=0.4) as shown:  # doctest: +SKIP
    ...     print(shown.address)
    http://127.0.0.1:8080
    """
    if not isinstance(model, LoadedModel):
        model = LoadedModel(type(model).__name__, Path(), model)
    if model.chain is None:
        raise TypeError(
            "`model` must be a chain, or a hybrid fitted on one, so that its body can be drawn; "
            f"got a model without a mechanical part, {model.name}."
        )
    bounds = {"q_min": q_min, "q_max": q_max}
    if log is not None and not _has_range(model):
        ends = {"q_min": np.nanmin(log.q, axis=0), "q_max": np.nanmax(log.q, axis=0)}
        bounds = {k: ends[k] if v is None else v for k, v in bounds.items()}
    limits = path_limits(model, **bounds, dq_max=dq_max, ddq_max=ddq_max)
    return LiveView(SteeredRobot(model, limits), log, host, port)


def _has_range(model: LoadedModel) -> bool:
    """Return whether the model or its description gives a range of the actuators."""
    described = (
        model.description is not None and model.description.limits.q_min is not None
    )
    return described or model.trained_range is not None


class LiveView:
    """A running view, made by `view`: a server, and a thread that moves the robot.

    Attributes
    ----------
    robot : SteeredRobot
        The robot that is shown.
    address : str
        Address of the page.
    ticks_per_second : float
        Rate while the robot moved, averaged over some ticks.
    """

    def __init__(
        self, robot: SteeredRobot, log: Log | None, host: str, port: int
    ) -> None:
        try:
            import viser
        except ImportError as error:
            raise ImportError(
                'a live view needs viser: pip install "hybridkin[view]".'
            ) from error
        self.robot = robot
        self.ticks_per_second = 0.0
        with redirect_stdout(io.StringIO()):  # it prints, also if not verbose
            self._server = viser.ViserServer(
                host, port, verbose=False, label="hybridkin"
            )
        self.address = f"http://{host}:{self._server.get_port()}"
        self._wake = Event()
        self._closed = False
        self._motion: Motion | None = None
        self._said = 0.0
        scene = self._server.scene
        loaded = robot.loaded
        scene.set_up_direction("+z")
        ends = np.vstack([robot.domain.sample[1], np.zeros(3)])
        middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
        self._server.initial_camera.look_at = middle
        self._server.initial_camera.position = middle + robot.size * _CAMERA
        scene.add_frame(
            "/base", axes_length=0.15 * robot.size, axes_radius=0.004 * robot.size
        )
        self._body = Body(scene, loaded.model, robot)
        self._ghosts = {
            name: Ghost(scene, name, chain, robot)
            for name, chain in _other_models(loaded).items()
        }
        self._radius = scene.add_icosphere(
            "/radius", 1.0, color=ORANGE, opacity=0.2, visible=False
        )
        self._aim = scene.add_transform_controls(
            "/target",
            scale=0.15 * robot.size,
            disable_rotations=True,
            position=robot.target,
        )
        self._aim.on_update(self._dragged)
        self._ball = scene.add_icosphere("/target/ball", 0.02 * robot.size, GREEN)
        self._add_clouds(log)
        self._add_panel(log)
        self._show()
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the robot and the server; the port is free afterwards."""
        if not self._closed:
            self._closed = True
            self._wake.set()
            self._thread.join()
            with redirect_stdout(io.StringIO()):
                self._server.stop()

    def wait(self) -> None:
        """Wait until the view is closed, or Ctrl-C."""
        self._thread.join()

    def follow(self, target: NDArray) -> None:
        """Follow a target (3,) [m], as if it was dragged there."""
        self._motion = None
        self.robot.follow(target)
        self._wake.set()

    def go_to(self, q: NDArray) -> None:
        """Move the actuators to q (n,), as if their sliders were moved."""
        self._motion = None
        self.robot.go_to(q)
        self._wake.set()

    def _add_clouds(self, log: Log | None) -> None:
        """Add what the log holds and what the robot can reach."""
        scene, robot = self._server.scene, self.robot
        size = 0.007 * robot.size
        reach = robot.domain.sample[1]
        self._clouds: dict[str, list[Any]] = {
            "reachable": [
                scene.add_point_cloud(
                    "/reachable",
                    reach,
                    BLUE,
                    point_size=size,
                    point_shape="circle",
                    visible=False,
                )
            ]
        }
        self._log = log
        if log is None:
            return
        rows = np.arange(0, len(log.q), 1 + len(log.q) // _MOST_ROWS)
        tips = np.asarray(log.x)[:, -3:]
        predicted = robot.loaded.predict(log.q, log.groups)[:, -3:]
        error = np.linalg.norm(predicted - tips, axis=1)[rows]
        drawn = np.isfinite(error)
        rows, error = rows[drawn], error[drawn]
        largest = float(np.percentile(error, 95)) if len(error) else 1.0
        name = f"log, red: error of {1e3 * largest:.3g} mm or more"
        colors = between(YELLOW, RED, error / max(largest, 1e-12))
        self._clouds[name] = [
            scene.add_point_cloud(
                "/log", tips[rows], colors, point_size=size, point_shape="circle"
            )
        ]
        self._measured = scene.add_icosphere(
            "/measured", 0.015 * robot.size, (0, 0, 0), visible=False
        )
        if robot.loaded.hybrid is None or robot.loaded.chain is None:
            return
        effective = robot.loaded.effective(log.q, log.groups)
        from_, to = (
            LoadedModel(m.__class__.__name__, Path(), m).tips(effective[rows])
            for m in (robot.loaded.chain, robot.loaded.hybrid)
        )
        self._clouds["learned error: mechanical to hybrid tip"] = [
            scene.add_line_segments(
                "/learned",
                np.stack([from_, to], 1),
                ORANGE,
                thickness=0.3 * size,
                visible=False,
            )
        ]

    def _add_panel(self, log: Log | None) -> None:
        """Add words, sliders and buttons."""
        gui, robot = self._server.gui, self.robot
        log_format = robot.loaded.log_format()
        self._words = gui.add_markdown("")
        self._factor = np.broadcast_to(log_format.q_factor, robot.q.shape)
        ends = [robot.limits.q_min / self._factor, robot.limits.q_max / self._factor]
        self._sliders = []
        with gui.add_folder(f"Actuators [{log_format.q_unit}]"):
            for name, low, high, at in zip(
                log_format.q,
                *np.sort(ends, axis=0),
                robot.q / self._factor,
                strict=True,
            ):
                step = max((high - low) / 1000.0, 1e-12)
                slider = gui.add_slider(name, low, max(high, low + step), step, at)
                slider.on_update(self._slid)
                self._sliders.append(slider)
        with gui.add_folder("Show", expand_by_default=len(self._clouds) > 1):
            for name, handles in self._clouds.items():
                self._switch(name, handles)
            for name, ghost in self._ghosts.items():
                self._switch(name, [ghost.line])
            if self._expected() > 0.0:
                self._switch("expected error", [self._radius])
        with gui.add_folder("Motion"):
            self._button("Wiggle every actuator", lambda: Wiggle(self.robot))
            self._button("Circle", lambda: Loop(self.robot, np.array([1.0, 0.0])))
            self._button("Figure eight", lambda: Loop(self.robot, np.array([0.0, 1.0])))
            if log is not None:
                self._button(
                    "Play the log", lambda: Replay(self.robot, log, self._measured)
                )
            self._button("Stop", lambda: None)
            button = gui.add_button("Download the commands")
            button.on_click(self._download)

    def _button(self, name: str, motion: Callable[[], Motion | None]) -> None:
        def start(_: object) -> None:
            self._motion = motion()
            self._wake.set()

        self._server.gui.add_button(name).on_click(start)

    def _switch(self, name: str, handles: list[Any]) -> None:
        box = self._server.gui.add_checkbox(name, handles[0].visible)

        def switch(_: object) -> None:
            for handle in handles:
                handle.visible = box.value
            self._show()

        box.on_update(switch)

    def _dragged(self, event: Any) -> None:
        if event.client is not None:  # not one of our own
            self.follow(np.array(self._aim.position))

    def _slid(self, event: Any) -> None:
        if event.client is not None:
            values = np.array([slider.value for slider in self._sliders])
            self.go_to(values * self._factor)

    def _download(self, event: Any) -> None:
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(["t", *self.robot.loaded.log_format().q])
        for k, row in enumerate(self.robot.commands()):
            writer.writerow([f"{k / RATE:.2f}", *(f"{value:.9g}" for value in row)])
        event.client.send_file_download("commands.csv", text.getvalue().encode())

    def _expected(self) -> float:
        """Return the error to expect of the robot here [m], 0 if it is not known."""
        expected = [*self.robot.loaded.expected_errors(self.robot.q[None]).values()]
        return float(expected[0][0]) if expected else 0.0

    def _run(self) -> None:
        """Tick while something moves, else wait."""
        due = time.perf_counter()
        while not self._closed:
            motion = self._motion
            going = motion is not None and motion()
            if motion is not None and not going and self._motion is motion:
                self._motion = None
            moves = self.robot.tick()
            if moves or going:
                self._show()
            else:
                self._say()
                self._wake.wait()
                self._wake.clear()
                due = time.perf_counter()
            due += 1.0 / RATE
            now = time.perf_counter()
            late = now - due
            self.ticks_per_second += 0.1 * (
                min(RATE, 1.0 / (1.0 / RATE + max(late, 0.0))) - self.ticks_per_second
            )
            if late > 0.0:
                due = now
            else:
                time.sleep(-late)

    def _show(self) -> None:
        """Draw the robot as it is."""
        robot = self.robot
        with self._server.atomic():
            self._body.move(robot)
            for ghost in self._ghosts.values():
                ghost.move(robot)
            if self._radius.visible:
                self._radius.position = robot.x
                self._radius.scale = self._expected()
            if not np.array_equal(self._aim.position, robot.target):
                self._aim.position = robot.target
        if time.perf_counter() - self._said > _SAID:
            self._say()

    def _say(self) -> None:
        """Write words and sliders, a few times a second."""
        self._said = time.perf_counter()
        robot = self.robot
        situation = robot.situation
        if not situation.reached:
            color = RED if situation.words.startswith("Out") else ORANGE
        else:
            color = GREEN if situation.in_domain else ORANGE
        if tuple(self._ball.color) != color:
            self._ball.color = color
        names = robot.loaded.log_format().q
        held = [name for name, at in zip(names, robot.held, strict=True) if at]
        lines = [f"**{situation.words}**"]
        if np.isfinite(situation.error):
            lines.append(f"error {1e3 * situation.error:.2f} mm")
        lines.append("at limits: " + (", ".join(held) or "none"))
        lines.append(f"{self.ticks_per_second:.0f} ticks/s")
        if (motion := self._motion) is not None:
            lines.append(f"moving: {motion.label}")
        self._words.content = "<br>".join(lines)
        for slider, value in zip(self._sliders, robot.q / self._factor, strict=True):
            if abs(slider.value - value) > 0.5 * slider.step:
                slider.value = float(np.clip(value, slider.min, slider.max))


def _other_models(loaded: LoadedModel) -> dict[str, Chain]:
    """Return the mechanical models behind a model, by name."""
    models = {}
    if loaded.description is not None and loaded.description.chain is not None:
        models["nominal model"] = loaded.description.chain
    if loaded.hybrid is not None and loaded.chain is not None:
        models["calibrated model"] = loaded.chain
    return {name: m for name, m in models.items() if m is not loaded.model}
