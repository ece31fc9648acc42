"""The page: what viser shows of a robot, and what the mouse changes."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from functools import partial
from threading import Event, Thread
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from typing_extensions import Self

from hybridkin import (
    Chain,
    ForwardModel,
    HybridForwardModel,
    as_forward_model,
    obstacles,
    open_model,
    trajectories,
)
from hybridkin.app.viewer.drawing import (
    BLUE,
    GREEN,
    ORANGE,
    RED,
    Balls,
    Body,
    DraggedObstacle,
    Ghost,
    LogCloud,
)
from hybridkin.app.viewer.first_look import FirstLook, first_camera
from hybridkin.app.viewer.motions import (
    Loop,
    Motion,
    Replay,
    Wiggle,
    circle,
    figure_eight,
)
from hybridkin.app.viewer.placed import with_fitted_base
from hybridkin.app.viewer.sliders import Scale
from hybridkin.app.viewer.steered import RATE, SteeredRobot
from hybridkin.app.workflow.domain import path_limits
from hybridkin.app.workflow.model import check_columns, expected_errors, has_body, is_fitted
from hybridkin.datasets import Log
from hybridkin.formats import METRES, csv_table, markdown, visible
from hybridkin.plots.page_server import page_server, stop

__all__ = ["LiveView", "view"]

_ARROWS = 0.15  # length of the arrows of the target, relative to the robot's size
_BESIDE = 0.25  # how far from robot and log obstacles are seen, relative to these
_SHORT = 0.1  # lengths that sliders show in millimetres [m]
_PAUSE = 0.1  # between two updates of the words [s]
_MARGIN = 0.1  # of what is shown of half-spaces, relative to the robot's size


def view(
    model: HybridForwardModel | Chain,
    log: Log | None = None,
    *,
    path: trajectories.Trajectory | None = None,
    q_min: ArrayLike = -np.inf,
    q_max: ArrayLike = np.inf,
    dq_max: ArrayLike = np.inf,
    ddq_max: ArrayLike = np.inf,
    obstacles: Sequence[obstacles.Obstacle] = (),
    clearance: float = 0.0,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> LiveView:
    """Open a live 3D view of a robot: a page on which its target can be dragged.

    Parameters
    ----------
    model : HybridForwardModel or Chain
        A model with a mechanical part that can be drawn; from a file by `open_model`.
    log : Log, optional
        Measured rows to show, from `datasets.load_log` or `workflow.read_log`. A click on a row
        moves the robot there. The base of a robot description is fitted to them if it is not known,
        that is, if the description calibrates it.
    path : Trajectory, optional
        A path that a button starts, in a loop; from `trajectories`.
    q_min, q_max, dq_max, ddq_max : float or array-like of shape (n,), optional
        Limits of position, speed and acceleration [unit of q, s]. Default: those of the model and
        its description; else the range of the log, and one second for the whole range.
    obstacles : sequence of Obstacle, default=()
        Obstacles around the robot, from `hybridkin.obstacles`, which can be dragged. While the
        robot follows a target its whole body keeps clear of them.
    clearance : float, default=0.0
        Least distance between body and obstacles [m].
    host : str, default="127.0.0.1"
        Address to listen to. The default can be reached from this machine alone, and by no page
        but this one.
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
    RuntimeError
        If this version of viser cannot be kept from pages of others.
    TypeError
        If the model has no mechanical part that can be drawn.
    ValueError
        If the range of the actuators is not known.

    Examples
    --------
    >>> import hybridkin.app
    >>> chain = hybridkin.robots.bionic_handling_assistant()
    >>> with hybridkin.app.view(chain, q_min=0.1, q_max=0.4) as shown:  # doctest: +SKIP
    ...     print(shown.address)
    http://127.0.0.1:8080
    """
    if not isinstance(model, HybridForwardModel):
        model = open_model(as_forward_model(model))
    if not has_body(model):
        raise TypeError(
            "`model` must be a chain, or a hybrid fitted on one, so that its body can be drawn; "
            f"got a model without a mechanical part, {model.description_.name}."
        )
    described = model
    if log is not None:
        check_columns(model, log.q)
        model = with_fitted_base(model, log)
    if log is not None and not _has_range(model):
        q_min = np.where(np.isfinite(q_min), q_min, np.nanmin(log.q, axis=0))
        q_max = np.where(np.isfinite(q_max), q_max, np.nanmax(log.q, axis=0))
    limits = path_limits(model, q_min=q_min, q_max=q_max, dq_max=dq_max, ddq_max=ddq_max)
    robot = SteeredRobot(model, limits, obstacles, clearance)
    return LiveView(robot, log, path, host, port, base_is_fitted=model is not described)


def _has_range(model: HybridForwardModel) -> bool:
    """Return whether the model or its description gives a range of the actuators."""
    return is_fitted(model) or model.description_.limits.are_finite


class LiveView:
    """A running view, made by `view`: a server, and a thread that moves the robot.

    Attributes
    ----------
    robot : SteeredRobot
        The robot that is shown.
    address : str
        Address of the page.
    base_is_fitted : bool
        Whether the base of a description was fitted to the log that is shown.
    ticks_per_second : float
        Rate while the robot moved, averaged over some ticks.
    """

    def __init__(
        self,
        robot: SteeredRobot,
        log: Log | None,
        path: trajectories.Trajectory | None,
        host: str,
        port: int,
        *,
        base_is_fitted: bool = False,
    ) -> None:
        try:
            self._server = page_server(
                host, port, f"{robot.model.description_.name} - hybridkin", label="hybridkin"
            )
        except ImportError as error:
            raise ImportError('a live view needs viser: pip install "hybridkin[view]".') from error
        self.robot = robot
        self.base_is_fitted = base_is_fitted
        self.ticks_per_second = RATE
        self.address = f"http://{host}:{self._server.get_port()}"
        self._wake = Event()
        self._closed = False
        self._failure: Exception | None = None
        self._motion: Motion | None = None
        self._last_words = 0.0
        try:
            self._draw_scene(log)
            self._add_panel(log, path)
            self._show()
        except BaseException:
            stop(self._server)
            raise
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def _draw_scene(self, log: Log | None) -> None:
        """Draw the robot, its target, and what can be shown beside it."""
        robot = self.robot
        scene = self._server.scene
        scene.set_up_direction("+z")
        reachable = robot.domain.sample[1]
        corners = np.vstack([reachable, robot.base[:3, 3]])
        margin = _MARGIN * robot.size
        ends = np.stack([corners.min(axis=0) - margin, corners.max(axis=0) + margin])
        self._obstacles = []
        for k, obstacle in enumerate(robot.obstacles):
            drag = partial(self.move_obstacle, k)
            name = f"/obstacle {k + 1}"
            self._obstacles.append(DraggedObstacle(scene, name, obstacle, ends, drag))
        x, y, z, w = Rotation.from_matrix(robot.base[:3, :3]).as_quat()
        scene.add_frame(
            "/base",
            axes_length=0.15 * robot.size,
            axes_radius=0.004 * robot.size,
            wxyz=(w, x, y, z),
            position=robot.base[:3, 3],
        )
        self._body = Body(scene, robot)
        self._aim = scene.add_transform_controls(
            "/target",
            scale=_ARROWS * robot.size,
            disable_rotations=True,
            position=robot.target,
        )
        self._aim.on_update(self._dragged)
        self._ball = scene.add_icosphere("/target/ball", 0.02 * robot.size, GREEN)
        self._measured = scene.add_box(
            "/measured", (0, 0, 0), dimensions=3 * (0.025 * robot.size,), visible=False
        )
        above = (0.0, 0.0, 0.03 * robot.size)
        scene.add_label("/measured/label", "measured tip", position=above)
        self._radius = scene.add_icosphere("/radius", 1.0, color=ORANGE, opacity=0.2, visible=False)
        self._switched: dict[str, Any] = {}
        self._switched["reachable (diamonds)"] = scene.add_point_cloud(
            "/reachable",
            reachable,
            BLUE,
            point_size=0.005 * robot.size,
            point_shape="diamond",
            visible=False,
        )
        self._rows: LogCloud | None = None
        if log is not None:
            self._rows = LogCloud(scene, robot, log)
            self._switched[self._rows.name] = self._rows.dots
            if self._rows.learned is not None:
                self._switched["learned error (lines)"] = self._rows.learned
            scene.on_click()(self._clicked)
        self._moving: list[Ghost | Balls] = []
        for name, chain in _other_models(robot.model).items():
            ghost = Ghost(scene, name, chain, robot)
            self._moving.append(ghost)
            self._switched[f"{name} ({ghost.look})"] = ghost.line
        if robot.obstacles:
            balls = Balls(scene, robot)
            self._moving.append(balls)
            self._switched["body that keeps clear"] = balls.frame
        if self._expected() > 0.0:
            self._switched["expected error (ball)"] = self._radius
        self._seen = self._everything(reachable)
        first_camera(self._seen).aim(self._server.initial_camera)
        self._server.on_client_connect(self._fit)

    def _everything(self, reachable: NDArray) -> NDArray:
        """Return the points (N, 3) that the first look shows [m].

        They are those of the robot with its target, and of the log, else the reachable tips; and
        obstacles where they are near these.
        """
        points = [self._body.points, self._aim_ends(), reachable]
        if self._rows is not None:
            points[-1] = self._rows.tips
        around = np.concatenate(points)
        low = around.min(axis=0)
        high = around.max(axis=0)
        beside = _BESIDE * float((high - low).max())
        for obstacle in self._obstacles:
            points.append(np.clip(obstacle.points, low - beside, high + beside))
        return np.concatenate(points)

    def _aim_ends(self) -> NDArray:
        """Return the ends (3, 3) of the arrows by which the target is dragged [m]."""
        return self.robot.target + _ARROWS * self.robot.size * np.eye(3)

    def _fit(self, client: Any) -> None:
        """Show everything on the page of a client, until its user turns the robot."""
        client.camera.min_orbit_distance = 1e-3 * self.robot.size
        look = FirstLook(client, self._seen)
        look.fit(client.camera)
        client.camera.on_update(look.fit)

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
            stop(self._server)

    def wait(self) -> None:
        """Wait until the view is closed, or Ctrl-C; an error of the drawing is raised here."""
        self._thread.join()
        if self._failure is not None:
            raise self._failure

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

    def move_obstacle(self, k: int, center: NDArray) -> None:
        """Move an obstacle to a center (3,) [m], as if it was dragged there."""
        self.robot.move_obstacle(k, center)
        self._obstacles[k].place(self.robot.obstacles[k])
        self._wake.set()

    def _add_panel(self, log: Log | None, path: trajectories.Trajectory | None) -> None:
        """Add words, sliders and buttons."""
        gui = self._server.gui
        robot = self.robot
        gui.configure_theme(show_share_button=False)  # it would not be heard
        gui.main_panel.dock_right()  # beside the robot, not over it
        self._words = gui.add_markdown("")
        self._add_sliders()
        with gui.add_folder("Show", expand_by_default=len(self._switched) > 1):
            for name, handle in self._switched.items():
                self._switch(name, handle)
        with gui.add_folder("Motion"):
            self._button("Wiggle every actuator", lambda: Wiggle(robot))
            self._button("Circle", lambda: Loop(robot, circle(robot)))
            self._button("Figure eight", lambda: Loop(robot, figure_eight(robot)))
            if path is not None:
                self._button("Follow the path", lambda: Loop(robot, path))
            if log is not None:
                self._button("Play the log", lambda: Replay(robot, log, self._measured))
            self._button("Stop", lambda: None)
            button = gui.add_button("Download the commands")
            button.on_click(self._download)

    def _add_sliders(self) -> None:
        """Add a slider for every actuator, in the names and the unit of the log."""
        robot = self.robot
        log_format = robot.model.description_.log
        unit = log_format.q_unit
        self._factor = np.broadcast_to(log_format.q_factor, robot.q.shape)
        limits = np.stack([robot.limits.q_min, robot.limits.q_max])
        if unit == "m" and np.abs(limits).max() < _SHORT:
            unit = "mm"  # three digits are short
            self._factor = self._factor * METRES[unit]
        low, high = np.sort(limits / self._factor, axis=0)
        start = robot.q / self._factor
        self._sliders = []
        self._scales = []
        with self._server.gui.add_folder(f"Actuators [{visible(unit)}]"):
            for k, name in enumerate(map(visible, log_format.q)):
                scale = Scale(float(low[k]), float(high[k]))
                slider = self._server.gui.add_slider(
                    name,
                    scale.low,
                    scale.high,
                    scale.step,
                    scale.shown(float(start[k])),
                    marks=scale.marks,
                )
                slider.on_update(partial(self._slid, k))
                self._sliders.append(slider)
                self._scales.append(scale)

    def _button(self, name: str, motion: Callable[[], Motion | None]) -> None:
        def start(_: object) -> None:
            self._motion = motion()
            self._wake.set()

        self._server.gui.add_button(name).on_click(start)

    def _switch(self, name: str, handle: Any) -> None:
        box = self._server.gui.add_checkbox(name, handle.visible)

        def switch(_: object) -> None:
            handle.visible = box.value
            self._show()

        box.on_update(switch)

    def _clicked(self, event: Any) -> None:
        """Go to the row of the log that was clicked."""
        origin = np.array(event.ray_origin)
        if self._rows is None or not self._rows.dots.visible:
            return
        row = self._rows.row_at(origin, np.array(event.ray_direction))
        if row is not None:
            q, tip = row
            self._measured.position = tip
            self._measured.visible = True
            self.go_to(q)

    def _dragged(self, event: Any) -> None:
        if event.client is not None:  # not one of our own
            self.follow(np.array(self._aim.position))

    def _slid(self, k: int, event: Any) -> None:
        if event.client is not None:
            q = self.robot.goal.copy()
            q[k] = self._scales[k].meant(self._sliders[k].value) * self._factor[k]
            self.go_to(q)

    def _download(self, event: Any) -> None:
        rows = []
        for k, row in enumerate(self.robot.commands()):
            rows.append([f"{k / RATE:.2f}", *(f"{value:.9g}" for value in row)])
        text = csv_table(["t", *self.robot.model.description_.log.q], rows)
        event.client.send_file_download("commands.csv", text.encode())

    def _expected(self) -> float:
        """Return the error to expect of the robot here [m], 0 if it is not known."""
        expected = expected_errors(self.robot.model, self.robot.q[None])
        for errors in expected.values():
            return float(errors[0])
        return 0.0

    def _run(self) -> None:
        try:
            self._tick_until_closed()
        except Exception as error:
            self._failure = error
            self._words.content = f"**The view has stopped: {markdown(error)}**"

    def _tick_until_closed(self) -> None:
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
            late = max(now - due, 0.0)
            rate = 1.0 / (1.0 / RATE + late)
            self.ticks_per_second += 0.1 * (rate - self.ticks_per_second)
            if late > 0.0:
                due = now
            else:
                time.sleep(due - now)

    def _show(self) -> None:
        """Draw the robot as it is."""
        robot = self.robot
        with self._server.atomic():
            self._body.move(robot)
            for part in self._moving:
                part.move(robot)
            if self._radius.visible:
                self._radius.position = robot.x
                self._radius.scale = self._expected()
            if not np.array_equal(self._aim.position, robot.target):
                self._aim.position = robot.target
        if time.perf_counter() - self._last_words > _PAUSE:
            self._say()

    def _say(self) -> None:
        """Write words and sliders, a few times a second."""
        self._last_words = time.perf_counter()
        robot = self.robot
        situation = robot.situation
        color = ORANGE
        if situation.out_of_reach:
            color = RED
        elif situation.reached and situation.in_domain:
            color = GREEN
        if tuple(self._ball.color) != color:
            self._ball.color = color
        names = map(markdown, robot.model.description_.log.q)
        at_limits = itertools.compress(names, robot.held)
        lines = [f"**{situation.words}**"]
        if np.isfinite(situation.error):
            lines.append(f"{1e3 * situation.error:.2f} mm from the target")
        if self._measured.visible:
            away = np.linalg.norm(self._measured.position - robot.x)
            lines.append(f"measured tip (cube): {1e3 * away:.3g} mm from that of the model")
        if robot.is_contradictory:
            lines.append("tendons pull against each other: a real robot is compressed")
        lines += self._about_obstacles()
        lines.append("at limits: " + (", ".join(at_limits) or "none"))
        lines.append(f"{self.ticks_per_second:.0f} steps per second")
        motion = self._motion
        if motion is not None:
            lines.append(f"moving: {markdown(motion.label)}")
        self._words.content = "<br>".join(lines)
        values = robot.q / self._factor
        for slider, scale, value in zip(self._sliders, self._scales, values, strict=True):
            shown = scale.shown(float(value))
            if slider.value != shown:
                slider.value = shown

    def _about_obstacles(self) -> list[str]:
        """Return how far the nearest obstacle is, in words; nothing without obstacles."""
        robot = self.robot
        if not robot.obstacles:
            return []
        distances = robot.distances
        nearest = int(distances.argmin())
        name = markdown(robot.obstacles[nearest].name or f"obstacle {nearest + 1}")
        return [f"nearest obstacle: {1e3 * distances[nearest]:.1f} mm, {name}"]


def _other_models(model: HybridForwardModel) -> dict[str, ForwardModel]:
    """Return the mechanical models behind a fitted model, by name."""
    models = {}
    nominal = model.description_.robot.chain
    if is_fitted(model):
        models["calibrated model"] = model.module_.robot
        if nominal is not None:
            models["nominal model"] = nominal
    return models
