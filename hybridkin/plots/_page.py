"""A scene as one interactive page, with a mouse to turn it, a play button and a time slider."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hybridkin.plots._canvas import COLORS, decimals
from hybridkin.plots._scene import Line, Scene

_DASHES = {"-": "solid", "--": "dash", ":": "dot", "-.": "dashdot"}
_MARKERS = {"o": ("circle", 5), "x": ("x", 4), ".": ("circle", 3)}
_FAR = 1.6  # the eye from the scene's middle, in longest sides of the scene
_FINEST = 2000.0  # steps of a coordinate along the longest side, at least
_WIDTH = 0.66  # of the scene beside the curve of the error
_AT_ONCE = {"mode": "immediate", "transition": {"duration": 0}}

Trace = dict[str, Any]


def page(
    scene: Scene,
    fps: float,
    view: tuple[float, float],
    progress: Callable[[int, int], None] | None,
) -> str:
    """Return the page as HTML that needs no other file."""
    try:
        import plotly.graph_objects as go
        import plotly.io
    except ImportError as error:
        raise ImportError(
            '`path` ends in .html, which needs plotly: pip install "hybridkin[interactive]", or '
            "save as .gif or .mp4."
        ) from error
    still = _paths(scene)
    looks = [_look(line) for line in scene.moving]
    if scene.error is not None:
        still.append(_error_curve(scene))
        looks.append(
            {"type": "scatter", "mode": "markers", "marker": {"color": "black"}}
        )
        looks[-1]["showlegend"] = False
    moving = [*range(len(still), len(still) + len(looks))]
    frames = []
    for k in range(len(scene.rows)):
        frames.append({"name": str(k), "data": _moved(scene, k), "traces": moving})
        if progress is not None:
            progress(k + 1, len(scene.rows))
    first = [
        look | points for look, points in zip(looks, frames[0]["data"], strict=True)
    ]
    figure = go.Figure(still + first, _layout(scene, fps, view)).to_dict()
    figure["frames"] = frames  # as plain dicts: plotly's checks take a second per frame
    return plotly.io.to_html(
        figure,
        config={"responsive": True, "displaylogo": False},
        auto_play=False,
        default_height="96vh",
        validate=False,
    )


def _paths(scene: Scene) -> list[Trace]:
    """Return the target, if there is one, and the path reached."""
    reached = {
        "name": "path reached",
        "line": {"color": COLORS[0], "dash": "dash", "width": 3},
    }
    paths = [reached | _xyz(scene, scene.x)]
    if scene.target is not None:
        target = {"name": "target", "line": {"color": "black", "width": 3}}
        paths.insert(0, target | _xyz(scene, scene.target))
    return [
        {"type": "scatter3d", "mode": "lines", "hoverinfo": "skip", **path}
        for path in paths
    ]


def _error_curve(scene: Scene) -> Trace:
    """Return the error over time."""
    return {
        "type": "scatter",
        "mode": "lines",
        "line": {"color": COLORS[0], "width": 2},
        "name": scene.error_name,
        "showlegend": False,
        **_error_at(scene, slice(None)),
    }


def _error_at(scene: Scene, rows: slice) -> Trace:
    """Return times and errors of rows, rounded by the size of the error, not of the robot."""
    assert scene.error is not None
    digits = decimals(scene.error) + 2
    return {
        "x": _numbers(scene.steps[rows], 4),
        "y": _numbers(scene.error[rows], digits),
    }


def _moved(scene: Scene, k: int) -> list[Trace]:
    """Return the points of everything that moves in frame k."""
    points = [_xyz(scene, line.points[k]) for line in scene.moving]
    if scene.error is not None:
        row = int(scene.rows[k])
        points.append(_error_at(scene, slice(row, row + 1)))
    return points


def _look(line: Line) -> Trace:
    """Return a moving line without its points."""
    trace: Trace = {"type": "scatter3d", "name": line.label, "hoverinfo": "skip"}
    trace["showlegend"] = bool(line.label)
    trace["mode"] = "lines"
    if line.style != "none":
        dash = _DASHES[line.style]
        trace["line"] = {"color": line.color, "width": 2.0 * line.width, "dash": dash}
    if line.marker:
        trace["mode"] = "markers" if line.style == "none" else "lines+markers"
        symbol, size = _MARKERS[line.marker]
        trace["marker"] = {"color": line.color, "size": size, "symbol": symbol}
    return trace


def _layout(scene: Scene, fps: float, view: tuple[float, float]) -> dict[str, Any]:
    """Return axes, camera, buttons and slider."""
    layout = {
        "template": "plotly_white",
        "scene": _space(scene, view),
        "updatemenus": [_buttons(fps)],
        "sliders": [_slider(scene)],
        "margin": {"l": 20, "r": 20, "t": 20, "b": 110, "autoexpand": False},
        "legend": {"x": 0.0, "y": 1.0, "bgcolor": "rgba(255, 255, 255, 0.6)"},
        "uirevision": "kept",  # frames do not reset the view
    }
    if scene.error is not None:
        layout["xaxis"] = {
            "domain": [_WIDTH + 0.06, 1.0],
            "title": {"text": scene.when},
        }
        layout["yaxis"] = {
            "title": {"text": scene.error_name},
            "rangemode": "tozero",
            "domain": [0.15, 0.9],
        }
    return layout


def _space(scene: Scene, view: tuple[float, float]) -> dict[str, Any]:
    """Return the axes of space and the camera."""
    sides = (scene.high - scene.low) / (scene.high - scene.low).max()
    elevation, azimuth = np.radians(view)
    level = np.cos(elevation)
    eye = np.array(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
    )
    space = {
        "aspectmode": "manual",
        "aspectratio": _point(sides),
        "domain": {"x": [0.0, 1.0 if scene.error is None else _WIDTH]},
        "camera": {
            "eye": _point(_FAR * eye),
            "center": {"x": 0.0, "y": 0.0, "z": -0.05},
        },
    }
    for letter, side, low, high in zip(
        "xyz", sides, scene.low, scene.high, strict=True
    ):
        # Fewer ticks on short sides, or their numbers cover each other.
        ticks = MaxNLocator(max(2, round(5 * side))).tick_values(low, high)
        space[f"{letter}axis"] = {
            "title": {"text": f"{letter} [{scene.unit}]"},
            "range": [low, high],
            "tickvals": [*map(float, ticks)],
        }
    return space


def _buttons(fps: float) -> dict[str, Any]:
    """Return the buttons that play and pause."""
    frame = {"duration": 1000.0 / fps, "redraw": True}
    play = {**_AT_ONCE, "frame": frame, "fromcurrent": True}
    return {
        "type": "buttons",
        "direction": "left",
        "buttons": [_animate("Play", None, play), _animate("Pause", [None], _jump())],
        "showactive": False,
        "x": 0.0,
        "xanchor": "left",
        "y": 0.0,
        "yanchor": "top",
        "pad": {"t": 40},
    }


def _slider(scene: Scene) -> dict[str, Any]:
    """Return the slider of the time."""
    steps = [
        _animate(caption, [str(k)], _jump()) for k, caption in enumerate(scene.captions)
    ]
    return {
        "steps": steps,
        "x": 0.14,
        "len": 0.84,
        "y": 0.0,
        "pad": {"t": 30},
        "ticklen": 0,
        "minorticklen": 0,
        "font": {"color": "rgba(0, 0, 0, 0)"},
        "currentvalue": {"font": {"size": 16, "color": "black"}, "xanchor": "left"},
    }


def _animate(label: str, *frames_and_way: Any) -> dict[str, Any]:
    return {"label": label, "method": "animate", "args": [*frames_and_way]}


def _jump() -> dict[str, Any]:
    return {**_AT_ONCE, "frame": {"duration": 0, "redraw": True}}


def _point(values: NDArray) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))


def _xyz(scene: Scene, points: NDArray) -> dict[str, list[float | None]]:
    """Return the coordinates of points (P, 3), rounded by the size of the scene."""
    longest = (scene.high - scene.low).max()
    digits = max(0, int(np.ceil(np.log10(_FINEST / longest))))
    return {letter: _numbers(points[:, i], digits) for i, letter in enumerate("xyz")}


def _numbers(values: NDArray, digits: int) -> list[float | None]:
    """Return rounded numbers, None for unknown ones."""
    return [v if np.isfinite(v) else None for v in values.round(digits).tolist()]
