"""A scene as one interactive page, with a mouse to turn it, a play button and a time slider."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from hybridkin._core.texts import visible
from hybridkin.plots._camera import fitted_camera
from hybridkin.plots._canvas import DASHED_TARGET, TARGET, TIP
from hybridkin.plots._dashes import dashes
from hybridkin.plots._obstacles import COLOR, OPACITY, surface_of
from hybridkin.plots._scene import Line, Scene
from hybridkin.plots.page_server import page_server, stop

# From the scene to the eye; as the axes of matplotlib at the start.
_EYE = (0.433, -0.75, 0.5)
_WIDTH = 0.003  # of a line of width 1, in the same unit
_DOT = 0.016  # size of a marker
_SHAPES = {"x": "sparkle"}  # of markers, a target among them; circles else
_MOST_DASHES = 24  # of a line


def page(
    scene: Scene,
    title: str,
    fps: float,
    progress: Callable[[int, int], None],
) -> str:
    """Return the page as HTML that needs no other file."""
    try:
        server = page_server("127.0.0.1", 0, title)
    except ImportError as error:
        raise ImportError(
            '`path` ends in .html, which needs viser: pip install "hybridkin[view]", or '
            "save as .gif or .mp4."
        ) from error
    try:
        return _recorded(server, scene, fps, progress)
    finally:
        stop(server)


def _recorded(
    server: Any,
    scene: Scene,
    fps: float,
    progress: Callable[[int, int], None],
) -> str:
    """Draw all frames on a server that nobody looks at, and return what it recorded."""
    longest = float((scene.high - scene.low).max())
    above = 0.5 * (scene.low + scene.high) / longest
    above[2] = scene.high[2] / longest + 0.08
    seen = [above * longest, scene.low, scene.high]
    seen += [line.points.reshape(-1, 3) for line in scene.moving]
    server.scene.set_up_direction("+z")
    fitted_camera(np.vstack(seen) / longest, _EYE).aim(server.initial_camera)
    server.scene.add_frame("/base", axes_length=0.15, axes_radius=0.004)
    paths = [Line("path reached", scene.x[None], TIP, 1.6)]
    if len(scene.target):
        paths.append(Line("target", scene.target[None], TARGET, 1.0, style=DASHED_TARGET))
    for line in paths:
        _Stroke(server.scene, line.label, line, longest).show(0)
    _add_obstacles(server.scene, scene, longest)
    strokes = []
    seen_names = Counter[str]()
    for line in scene.moving:
        name = _node(line.label or "part")
        seen_names[name] += 1
        if seen_names[name] > 1:
            name += f" {seen_names[name]}"
        strokes.append(_Stroke(server.scene, name, line, longest))
    caption = server.scene.add_label("/caption", "", position=above)
    recording = server.get_scene_serializer()
    for k, words in enumerate(scene.captions):
        with server.atomic():
            caption.text = words
            for stroke in strokes:
                stroke.show(k)
        recording.insert_sleep(1.0 / fps)
        progress(k + 1, len(scene.rows))
    return recording.as_html()


def _node(name: str) -> str:
    """Return a name of a part of the page, which is no path."""
    return visible(name).replace("/", "\u2215")


def _add_obstacles(page: Any, scene: Scene, longest: float) -> None:
    """Draw the obstacles of a scene."""
    for k, solid in enumerate(scene.obstacles):
        surface = surface_of(solid, scene.low, scene.high)
        if len(surface.faces):
            page.add_mesh_simple(
                f"/obstacle {k + 1} {_node(solid.name)}".rstrip(),
                surface.vertices / longest,
                surface.faces,
                color=to_rgb(COLOR),
                opacity=OPACITY,
                side="double",
            )


class _Stroke:
    """A line of a scene, with its markers; what is not known is left out."""

    def __init__(self, scene: Any, name: str, line: Line, longest: float) -> None:
        self._points = line.points / longest
        self._parts = []
        color = to_rgb(line.color)
        if line.style != "none":
            strokes = scene.add_line_segments(
                f"/{name}", np.zeros((1, 2, 3)), color, thickness=_WIDTH * line.width
            )
            self._parts.append((strokes, partial(_pieces, line=line)))
        if line.marker:
            dots = scene.add_point_cloud(
                f"/{name}/marks",
                np.zeros((1, 3)),
                color,
                point_size=_DOT,
                point_shape=_SHAPES.get(line.marker, "circle"),
                precision="float32",
            )
            self._parts.append((dots, lambda points: points))

    def show(self, k: int) -> None:
        """Draw it as it is in frame k."""
        for handle, parts_of in self._parts:
            parts = parts_of(self._points[k])
            known = np.isfinite(parts).reshape(len(parts), -1).all(axis=1)
            handle.visible = bool(known.any())
            if handle.visible:
                handle.points = parts[known]


def _pieces(points: NDArray, line: Line) -> NDArray:
    """Return the pieces (K, 2, 3) of a line through points (P, 3), with the gaps of its style."""
    if line.style == "-":
        return np.stack([points[:-1], points[1:]], axis=1)
    points = points[np.isfinite(points).all(axis=1)]
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    _, pattern = line.style
    period = _WIDTH * line.width * sum(pattern)
    return dashes(points, int(np.clip(length / period, 1, _MOST_DASHES)), pattern)
