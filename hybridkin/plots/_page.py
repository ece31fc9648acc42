"""A track as one interactive page: turned with the mouse, played, and scrubbed by a slider."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybridkin.plots._canvas import COLORS, decimals, scale_of

if TYPE_CHECKING:
    from hybridkin.plots.animation import TrackAnimation

_DASHES = {"-": "solid", "--": "dash", ":": "dot", "-.": "dashdot"}
_SYMBOLS = {"o": "circle", "x": "x", ".": "circle"}
_SIZES = {"o": 5, "x": 4, ".": 3}
_FAR = 1.6  # the eye from the scene's middle, in longest sides of the scene


def page(
    film: TrackAnimation,
    unit: str,
    speed: float,
    view: tuple[float, float],
    progress: Callable[[int, int], None] | None,
) -> str:
    """Return the page as HTML that holds everything it needs."""
    try:
        import plotly.graph_objects as go
        import plotly.io
    except ImportError as error:
        raise ImportError(
            '`path` ends in .html, which needs plotly: pip install "hybridkin[interactive]", or '
            "save as .gif or .mp4."
        ) from error
    scale = scale_of(unit)
    low, high = (scale * corner for corner in film.limits())
    digits = max(0, 4 - int(np.floor(np.log10((high - low).max()))))  # a hair's breadth
    still, moving = _still(film, scale, digits, unit), film.lines()
    data = still + [_trace(line, scale * line.points[0], digits) for line in moving]
    if film.error is not None:
        data.append({**_on_error_axes(film, scale, 0), "marker": {"color": "black"}})
    layout = _layout(film, unit, speed, low, high)
    layout["scene"]["camera"] = _camera(*view)
    figure = go.Figure(data, layout).to_dict()
    K, frames = len(film.rows), []
    places = [*range(len(still), len(data))]
    for k in range(K):
        parts = [_coordinates(scale * line.points[k], digits) for line in moving]
        if film.error is not None:
            own = _on_error_axes(film, scale, k)
            parts.append({"x": own["x"], "y": own["y"]})
        frames.append({"name": str(k), "data": parts, "traces": places})
        if progress is not None:
            progress(k + 1, K)
    figure["frames"] = frames  # plain, or each number would be checked at a second per frame
    html = plotly.io.to_html(
        figure,
        include_plotlyjs=True,
        auto_play=False,
        validate=False,
        default_height="100vh",
        config={"responsive": True, "displaylogo": False},
    )
    head = "<head><title>Track</title><style>body { margin: 0; overflow: hidden; }</style>"
    return html.replace("<head>", head, 1)


def _still(film: TrackAnimation, scale: float, digits: int, unit: str) -> list[dict[str, Any]]:
    """Return what does not move: the paths and the error over time."""
    look: dict[str, Any] = {"type": "scatter3d", "mode": "lines", "hoverinfo": "skip"}
    reached = _coordinates(scale * film.x, digits)
    dashed = {"color": COLORS[0], "width": 3, "dash": "dash"}
    found = [{**look, **reached, "line": dashed, "name": "path reached"}]
    if film.target is not None:
        target = _coordinates(scale * film.target, digits)
        line = {"color": "black", "width": 3}
        found.insert(0, {**look, **target, "line": line, "name": "target"})
    if film.error is not None:
        steps = np.arange(len(film.x)) if film.t is None else film.t
        error = {"x": _numbers(steps, 4), "y": _errors(film, scale)}
        name, line = f"tip error [{unit}]", {"color": COLORS[0], "width": 2}
        more = {"type": "scatter", "mode": "lines", "name": name, "line": line}
        found.append({**more, **error, "showlegend": False})
    return found


def _trace(line: Any, points: NDArray, digits: int) -> dict[str, Any]:
    trace: dict[str, Any] = {"type": "scatter3d", "name": line.label, "hoverinfo": "skip"}
    trace |= {"showlegend": bool(line.label), "opacity": line.alpha, "mode": "lines"}
    if line.style != "none":
        look = {"color": line.color, "width": 2.0 * line.width, "dash": _DASHES[line.style]}
        trace["line"] = look
    if line.marker:
        trace["mode"] = "markers" if line.style == "none" else "lines+markers"
        symbol, size = _SYMBOLS[line.marker], _SIZES[line.marker]
        trace["marker"] = {"color": line.color, "size": size, "symbol": symbol}
    return {**trace, **_coordinates(points, digits)}


def _on_error_axes(film: TrackAnimation, scale: float, k: int) -> dict[str, Any]:
    """Return the dot that runs along the error over time."""
    assert film.error is not None
    row = film.rows[k]
    when = float(row if film.t is None else film.t[row])
    error = _errors(film, scale)[row : row + 1]
    return {"type": "scatter", "mode": "markers", "x": [when], "y": error, "showlegend": False}


def _errors(film: TrackAnimation, scale: float) -> list[float | None]:
    """Return the error of every row, rounded by its own size: it is far below the robot's."""
    assert film.error is not None
    error = scale * film.error
    return _numbers(error, decimals(error) + 2)


def _layout(
    film: TrackAnimation, unit: str, speed: float, low: NDArray, high: NDArray
) -> dict[str, Any]:
    wait = 1000.0 / (speed * film.fps)
    at_once = {"mode": "immediate", "transition": {"duration": 0}}
    play = {**at_once, "frame": {"duration": wait, "redraw": True}, "fromcurrent": True}
    jump = {**at_once, "frame": {"duration": 0, "redraw": True}}
    buttons = [
        {"label": "Play", "method": "animate", "args": [None, play]},
        {"label": "Pause", "method": "animate", "args": [[None], jump]},
    ]
    steps = [
        {"label": film.caption(k, unit), "method": "animate", "args": [[str(k)], jump]}
        for k in range(len(film.rows))
    ]
    slider = {
        **{"steps": steps, "x": 0.14, "len": 0.84, "y": 0.0, "pad": {"t": 30}, "ticklen": 0},
        "minorticklen": 0,
        "currentvalue": {"font": {"size": 16, "color": "black"}, "xanchor": "left"},
        "font": {"color": "rgba(0, 0, 0, 0)"},
    }
    menu = {
        **{"type": "buttons", "direction": "left", "buttons": buttons, "showactive": False},
        **{"x": 0.0, "xanchor": "left", "y": 0.0, "yanchor": "top", "pad": {"t": 40}},
    }
    axes = {
        f"{letter}axis": {"title": {"text": f"{letter} [{unit}]"}, "range": [a, b]}
        for letter, a, b in zip("xyz", low.tolist(), high.tolist(), strict=True)
    }
    width = 1.0 if film.error is None else 0.66
    sides = dict(zip("xyz", ((high - low) / (high - low).max()).tolist(), strict=True))
    scene = {**axes, "aspectmode": "manual", "aspectratio": sides}
    scene |= {"domain": {"x": [0.0, width], "y": [0.0, 1.0]}}
    layout: dict[str, Any] = {
        **{"template": "plotly_white", "scene": scene, "updatemenus": [menu], "sliders": [slider]},
        "margin": {"l": 20, "r": 20, "t": 20, "b": 110, "autoexpand": False},
        "legend": {"x": 0.0, "y": 1.0, "bgcolor": "rgba(255, 255, 255, 0.6)"},
        "uirevision": "kept",  # the view stays as it was turned
    }
    if film.error is not None:
        when = "time step" if film.t is None else "time [s]"
        layout["xaxis"] = {"domain": [width + 0.06, 1.0], "title": {"text": when}}
        layout["yaxis"] = {"title": {"text": f"tip error [{unit}]"}, "rangemode": "tozero"}
        layout["yaxis"]["domain"] = [0.15, 0.9]
    return layout


def _camera(elevation: float, azimuth: float) -> dict[str, Any]:
    up, around = np.radians([elevation, azimuth])
    eye = _FAR * np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    center = {"x": 0.0, "y": 0.0, "z": -0.05}
    return {"eye": dict(zip("xyz", eye.tolist(), strict=True)), "center": center}


def _coordinates(points: NDArray, digits: int) -> dict[str, list[float | None]]:
    return {letter: _numbers(points[:, i], digits) for i, letter in enumerate("xyz")}


def _numbers(values: NDArray, digits: int) -> list[float | None]:
    """Return rounded numbers, None for what is not known."""
    return [v if np.isfinite(v) else None for v in values.round(digits).tolist()]
