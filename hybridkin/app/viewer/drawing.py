"""What is drawn of a robot: its body, and the backbone of another model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin import ForwardModel, obstacles
from hybridkin.app.viewer.steered import SteeredRobot
from hybridkin.app.workflow.model import is_fitted, tips_at
from hybridkin.datasets import Log
from hybridkin.formats import visible
from hybridkin.plots import BackboneDisplay, obstacle_surface
from hybridkin.plots.page_server import dashes

Color: TypeAlias = tuple[int, int, int]

GREEN = (40, 160, 80)
ORANGE = (235, 150, 30)
RED = (210, 50, 50)
BLUE = (40, 90, 200)
GREY = (150, 150, 150)
BROWN = (166, 124, 82)
YELLOW = (250, 215, 70)
GHOSTS = {
    "nominal model": ((90, 90, 90), 30, "dotted"),
    "calibrated model": ((150, 90, 190), 15, "dashed"),
}
"""Colour of the backbone of another model, number of its dashes, and both in words."""
_POINTS = 10  # drawn along a segment
_MOST_ROWS = 2000  # of a log, drawn as a cloud
_LABEL = 0.03  # height of a name above its obstacle, relative to what is shown
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)
_CLICK = 2.0  # distance of a click from a row, relative to the size of its dot


class Body:
    """The robot: backbone, actuators and disks.

    Attributes
    ----------
    points : ndarray of shape (N, 3)
        Its points at the start [m].
    """

    def __init__(self, scene: Any, robot: SteeredRobot) -> None:
        self._chain = robot.model.module_.robot
        body = _steered_body(robot)
        self.points = _points_of(body)
        self._thick = 0.015 * robot.size
        least = robot.model.module_.tip_model.robot.least_radius
        self._thick = min(self._thick, 0.4 * least)
        self._backbone = scene.add_spline_catmull_rom(
            "/robot/backbone",
            body.points[0],
            thickness=self._thick,
            color=(60, 60, 60),
        )
        self._tip = scene.add_icosphere("/robot/tip", 0.012 * robot.size, (20, 20, 20))
        self._actuators = [
            scene.add_spline_catmull_rom(
                f"/robot/actuator {k + 1}", path[0], thickness=0.4 * self._thick
            )
            for k, path in enumerate(body.actuators)
        ]
        self._markers = None
        if self._chain is not None and self._chain.n_outputs > 3:
            self._markers = scene.add_point_cloud(
                "/robot/markers",
                self._marked(robot),
                BLUE,
                point_size=2.0 * self._thick,
                point_shape="circle",
            )
        self._disks = None
        if body.disks is not None and body.disks.size:
            self._disks = scene.add_line_segments(
                "/robot/disks",
                _rims(body.disks),
                GREY,
                thickness=0.3 * self._thick,
            )

    def move(self, robot: SteeredRobot) -> None:
        """Draw the robot where it is."""
        body = _steered_body(robot)
        if not np.isfinite(body.points).all():
            return
        self._backbone.points = body.points[0]
        self._tip.position = robot.x
        if self._disks is not None and body.disks is not None:
            self._disks.points = _rims(body.disks)
        if self._markers is not None:
            self._markers.points = self._marked(robot)
        colors, slack = self._tensions(robot)
        for k, handle in enumerate(self._actuators):
            handle.points = body.actuators[k][0]
            color = tuple(colors[k].tolist())
            thickness = (0.12 if slack[k] else 0.4) * self._thick
            if tuple(handle.color) != color:
                handle.color = color
            if handle.thickness != thickness:
                handle.thickness = thickness

    def _marked(self, robot: SteeredRobot) -> NDArray:
        """Return the markers (K, 3) as the model predicts them."""
        with torch.no_grad():
            return robot.model.module_(torch.from_numpy(robot.q)).reshape(-1, 3).numpy()

    def _tensions(self, robot: SteeredRobot) -> tuple[NDArray, NDArray]:
        """Return colours (n, 3) of the actuators, and which are slack (n,)."""
        model = robot.model.module_.tip_model.robot
        q = torch.from_numpy(robot.q)
        low = torch.from_numpy(robot.limits.q_min)
        with torch.no_grad():
            pulled = model.pulled(q, low, low + torch.from_numpy(robot.span))
            slack = model.slack(q)
        return between(BLUE, RED, pulled.numpy()), slack.numpy()


def _points_of(body: BackboneDisplay) -> NDArray:
    """Return all points (N, 3) of a body [m]."""
    parts = [body.points, *body.actuators]
    if body.disks is not None:
        parts.append(body.disks)
    points = np.concatenate([part.reshape(-1, 3) for part in parts])
    return points[np.isfinite(points).all(axis=1)]


def _body_of(chain: ForwardModel, robot: SteeredRobot) -> BackboneDisplay:
    """Return the body of a chain at the configuration of a robot."""
    return BackboneDisplay.from_estimator(chain, robot.q, n_points=_POINTS)


def _steered_body(robot: SteeredRobot) -> BackboneDisplay:
    """Return the body of a robot, which ends at its tip if the model corrects it inside."""
    model = robot.model
    chain = model.module_.robot
    if not model.fitted_module_.corrects_inside:
        return _body_of(chain, robot)
    tips = robot.x[None]
    return BackboneDisplay.from_estimator(chain, robot.q, n_points=_POINTS, tips=tips)


class DraggedObstacle:
    """An obstacle with arrows, by which it is dragged.

    Parameters
    ----------
    scene : viser scene
        Where it is drawn.
    name : str
        Name of its node.
    obstacle : Obstacle
        The obstacle.
    corners : ndarray of shape (2, 3)
        Least and largest corner of what is shown [m]; a half-space is cut there.
    drag : callable
        Called with its new center (3,) [m] when the page drags it.

    Attributes
    ----------
    points : ndarray of shape (N, 3)
        Points of its surface [m]; none of an obstacle without an end.
    """

    def __init__(
        self,
        scene: Any,
        name: str,
        obstacle: obstacles.Obstacle,
        corners: NDArray,
        drag: Callable[[NDArray], None],
    ) -> None:
        center = obstacle.center.numpy()
        surface = obstacle_surface(obstacle, *corners)
        middle = center
        top = 0.0
        if len(surface.faces):
            ends = np.stack([surface.vertices.min(axis=0), surface.vertices.max(axis=0)])
            middle = ends.mean(axis=0)
            top = 0.5 * float(np.ptp(ends[:, 2]))
        self.points = np.empty((0, 3))
        if obstacle.low.isfinite().all() and obstacle.high.isfinite().all():
            self.points = surface.vertices
        self._to_center = center - middle
        self._drag = drag
        size = float(np.ptp(corners, axis=0).max())
        self._arrows = scene.add_transform_controls(
            name, scale=0.1 * size, disable_rotations=True, position=middle
        )
        self._arrows.on_update(self._dragged)
        if len(surface.faces):
            scene.add_mesh_simple(
                f"{name}/surface",
                surface.vertices - middle,
                surface.faces,
                color=BROWN,
                opacity=0.5,
                side="double",
            )
        if obstacle.name:
            above = (0.0, 0.0, top + _LABEL * size)
            scene.add_label(f"{name}/label", visible(obstacle.name), position=above)

    def _dragged(self, event: Any) -> None:
        if event.client is not None:  # not one of our own
            self._drag(np.array(self._arrows.position) + self._to_center)

    def place(self, obstacle: obstacles.Obstacle) -> None:
        """Draw it where it is, if the page has it elsewhere; obstacles are not turned."""
        there = obstacle.center.numpy() - self._to_center
        if not np.allclose(self._arrows.position, there, rtol=0.0, atol=1e-9):
            self._arrows.position = there
        if not np.array_equal(self._arrows.wxyz, _UPRIGHT):
            self._arrows.wxyz = _UPRIGHT


class Balls:
    """The balls along the body that keep clear of obstacles."""

    def __init__(self, scene: Any, robot: SteeredRobot) -> None:
        self.frame = scene.add_frame("/balls", show_axes=False, visible=False)
        self._balls = []
        for k, radius in enumerate(robot.balls[1].tolist()):
            ball = scene.add_icosphere(f"/balls/{k + 1}", radius, BLUE, opacity=0.15)
            self._balls.append(ball)

    def move(self, robot: SteeredRobot) -> None:
        """Draw them where they are, if they are shown."""
        if not self.frame.visible:
            return
        for ball, point in zip(self._balls, robot.balls[0], strict=True):
            ball.position = point


class Ghost:
    """The backbone of another model at the same command, as a broken line.

    Attributes
    ----------
    look : str
        How it is drawn, in words.
    line : viser node
        Where it is drawn.
    """

    def __init__(self, scene: Any, name: str, chain: ForwardModel, robot: SteeredRobot) -> None:
        self._chain = chain
        color, self._pieces, self.look = GHOSTS[name]
        self.line = scene.add_line_segments(
            f"/{name}",
            self._dashes(robot),
            color,
            thickness=0.008 * robot.size,
            visible=False,
        )

    def move(self, robot: SteeredRobot) -> None:
        """Draw it, if it is shown."""
        if self.line.visible:
            dashes = self._dashes(robot)
            if np.isfinite(dashes).all():
                self.line.points = dashes

    def _dashes(self, robot: SteeredRobot) -> NDArray:
        return dashes(_body_of(self._chain, robot).points[0], self._pieces)


class LogCloud:
    """Rows of a log: measured tips coloured by the error of the model, which can be clicked.

    Attributes
    ----------
    tips : ndarray of shape (N, 3)
        Those that are drawn [m].
    name : str
        What is drawn, in words.
    dots, learned : viser nodes
        The tips; and lines from the mechanical to the hybrid tips, None without a fit.
    """

    def __init__(self, scene: Any, robot: SteeredRobot, log: Log) -> None:
        model = robot.model
        (commands, tips) = robot.measured_rows(log)
        every = 1 + len(tips) // _MOST_ROWS
        self._commands = commands[::every]
        self.tips = tips[::every]
        error = np.linalg.norm(tips_at(model, self._commands) - self.tips, axis=1)
        largest = 1.0
        if len(error):
            largest = float(np.percentile(error, 95))
        self._size = 0.005 * robot.size
        worst = float(f"{1e3 * largest:.2g}")
        self.name = f"measured (dots), red: error of {worst:g} mm or more"
        self.dots = scene.add_point_cloud(
            "/log",
            self.tips,
            between(YELLOW, RED, error / max(largest, 1e-12)),
            point_size=self._size,
            point_shape="circle",
        )
        self.learned = None
        if is_fitted(model):
            mechanical = tips_of(model.module_.robot, self._commands)
            hybrid = tips_of(model.module_, self._commands)
            self.learned = scene.add_line_segments(
                "/learned",
                np.stack([mechanical, hybrid], axis=1),
                ORANGE,
                thickness=0.3 * self._size,
                visible=False,
            )

    def row_at(self, origin: NDArray, direction: NDArray) -> tuple[NDArray, NDArray] | None:
        """Return the command (n,) and the tip (3,) of the first row that a ray meets, or None."""
        ways = self.tips - origin
        along = ways @ direction
        distance = np.linalg.norm(ways - along[:, None] * direction, axis=1)
        hit = (distance < _CLICK * self._size) & (along > 0.0)
        if not hit.any():
            return None
        first = np.argmin(np.where(hit, along, np.inf))
        return self._commands[first], self.tips[first]


def tips_of(model: ForwardModel, q: NDArray) -> NDArray:
    """Return the tips (N, 3) of a model for rows of q (N, n)."""
    with torch.no_grad():
        return model.tip_model(torch.from_numpy(q)).numpy()


def _rims(disks: NDArray) -> NDArray:
    """Return the rims of the disks (1, D, C, 3) as segments (L, 2, 3)."""
    rims = disks[0]
    strokes = np.stack([rims[:, :-1], rims[:, 1:]], axis=2)
    return strokes.reshape(-1, 2, 3)


def between(low: Color, high: Color, fraction: NDArray) -> NDArray:
    """Return colours (N, 3) from low to high for fractions (N,) from 0 to 1."""
    part = np.clip(fraction, 0.0, 1.0)[:, None]
    colors = (1.0 - part) * np.array(low) + part * np.array(high)
    return colors.astype(np.uint8)
