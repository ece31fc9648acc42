"""A scene as one interactive page, with a mouse to turn it, a play button and a time slider."""

from __future__ import annotations

import base64
import gzip
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
# The script of plotly has 5 MB, and its package has no smaller one; compressed it has 1.8 MB.
_PAGE = """<!DOCTYPE html>
<html><head><meta charset="utf-8"><title>Track</title>
<style>body { margin: 0; overflow: hidden; } #track { height: 100vh; }</style></head>
<body><div id="track" class="plotly-graph-div"></div><script>
const packed = "PACKED", size = SIZE;
const order = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz" +
  "!#$%&()*+-;<=>?@^_`{|}~";
const values = new Uint8Array(128);
[...order].forEach((letter, i) => { values[letter.charCodeAt(0)] = i; });
const words = new DataView(new ArrayBuffer(packed.length / 5 * 4));
for (let i = 0; i < packed.length; i += 5) {
  let word = 0;
  for (let k = i; k < i + 5; k++) word = word * 85 + values[packed.charCodeAt(k)];
  words.setUint32(i / 5 * 4, word);
}
const unpacked = new Blob([words.buffer.slice(0, size)]).stream()
  .pipeThrough(new DecompressionStream("gzip"));
new Response(unpacked).text().then(async (text) => {
  const [code, figure] = text.split("\\0");
  (0, eval)(code);
  const {data, layout, frames, config} = JSON.parse(figure);
  await Plotly.newPlot("track", data, layout, config);
  await Plotly.addFrames("track", frames);
});
</script></body></html>
"""


def page(
    scene: Scene, fps: float, view: tuple[float, float], progress: Callable[[int, int], None] | None
) -> str:
    """Return the page as HTML that needs no other file."""
    try:
        import plotly.graph_objects as go
        import plotly.io
        import plotly.offline
    except ImportError as error:
        raise ImportError(
            '`path` ends in .html, which needs plotly: pip install "hybridkin[interactive]", or '
            "save as .gif or .mp4."
        ) from error
    digits = max(0, int(np.ceil(np.log10(_FINEST / (scene.high - scene.low).max()))))
    steps, error = _numbers(scene.steps, 4), None
    still = [_path("path reached", scene.x, digits, color=COLORS[0], dash="dash")]
    if scene.target is not None:
        still.insert(0, _path("target", scene.target, digits, color="black"))
    if scene.error is not None:
        # Rounded by its own size, which is far below that of the robot.
        error = _numbers(scene.error, decimals(scene.error) + 2)
        curve = {"type": "scatter", "mode": "lines", "line": {"color": COLORS[0], "width": 2}}
        curve |= {"x": steps, "y": error, "name": scene.error_name}
        still.append({**curve, "showlegend": False})
    frames = []
    for k, row in enumerate(scene.rows):
        parts: list[dict[str, Any]] = [_xyz(line.points[k], digits) for line in scene.moving]
        if error is not None:
            parts.append({"x": [steps[row]], "y": [error[row]]})
        places = [*range(len(still), len(still) + len(parts))]
        frames.append({"name": str(k), "data": parts, "traces": places})
        if progress is not None:
            progress(k + 1, len(scene.rows))
    looks = [_look(line) for line in scene.moving]
    if error is not None:
        dot = {"type": "scatter", "mode": "markers", "marker": {"color": "black"}}
        looks.append({**dot, "showlegend": False})
    first = [{**look, **part} for look, part in zip(looks, frames[0]["data"], strict=True)]
    figure = go.Figure(still + first, _layout(scene, fps, view)).to_dict()
    figure["frames"] = frames  # as plain dicts: plotly's checks take a second per frame
    figure["config"] = {"responsive": True, "displaylogo": False}
    text = plotly.io.to_json(figure, validate=False)
    packed = gzip.compress(f"{plotly.offline.get_plotlyjs()}\0{text}".encode(), mtime=0)
    letters = base64.b85encode(packed, pad=True).decode()
    return _PAGE.replace("SIZE", str(len(packed))).replace("PACKED", letters)


def _path(name: str, points: NDArray, digits: int, **look: str) -> dict[str, Any]:
    """Return a path that does not move."""
    trace = {"type": "scatter3d", "mode": "lines", "hoverinfo": "skip", "name": name}
    return {**trace, **_xyz(points, digits), "line": {"width": 3, **look}}


def _look(line: Line) -> dict[str, Any]:
    """Return a moving line without its points."""
    trace: dict[str, Any] = {"type": "scatter3d", "name": line.label, "hoverinfo": "skip"}
    trace |= {"showlegend": bool(line.label), "mode": "lines"}
    if line.style != "none":
        look = {"color": line.color, "width": 2.0 * line.width, "dash": _DASHES[line.style]}
        trace["line"] = look
    if line.marker:
        trace["mode"] = "markers" if line.style == "none" else "lines+markers"
        symbol, size = _MARKERS[line.marker]
        trace["marker"] = {"color": line.color, "size": size, "symbol": symbol}
    return trace


def _layout(scene: Scene, fps: float, view: tuple[float, float]) -> dict[str, Any]:
    """Return axes, camera, buttons and slider."""
    at_once = {"mode": "immediate", "transition": {"duration": 0}}
    frame = {"duration": 1000.0 / fps, "redraw": True}
    play = {**at_once, "frame": frame, "fromcurrent": True}
    jump = {**at_once, "frame": {**frame, "duration": 0}}

    def animate(label: str, *args: Any) -> dict[str, Any]:
        return {"label": label, "method": "animate", "args": [*args]}

    buttons = [animate("Play", None, play), animate("Pause", [None], jump)]
    steps = [animate(caption, [str(k)], jump) for k, caption in enumerate(scene.captions)]
    slider = {"steps": steps, "x": 0.14, "len": 0.84, "y": 0.0, "pad": {"t": 30}, "ticklen": 0}
    slider |= {"minorticklen": 0, "font": {"color": "rgba(0, 0, 0, 0)"}}
    slider["currentvalue"] = {"font": {"size": 16, "color": "black"}, "xanchor": "left"}
    menu = {"type": "buttons", "direction": "left", "buttons": buttons, "showactive": False}
    menu |= {"x": 0.0, "xanchor": "left", "y": 0.0, "yanchor": "top", "pad": {"t": 40}}
    width = 1.0 if scene.error is None else 0.66
    sides = (scene.high - scene.low) / (scene.high - scene.low).max()
    up, around = np.radians(view)
    eye = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    space = {"aspectmode": "manual", "aspectratio": _point(sides), "domain": {"x": [0.0, width]}}
    space["camera"] = {"eye": _point(_FAR * eye), "center": {"x": 0.0, "y": 0.0, "z": -0.05}}
    for letter, side, *corners in zip("xyz", sides, scene.low, scene.high, strict=True):
        title = {"text": f"{letter} [{scene.unit}]"}
        # Fewer ticks on short sides, or their numbers cover each other.
        ticks = MaxNLocator(max(2, round(5 * side))).tick_values(*corners)
        space[f"{letter}axis"] = {
            "title": title,
            "range": corners,
            "tickvals": [*map(float, ticks)],
        }
    layout = {
        **{"template": "plotly_white", "scene": space, "updatemenus": [menu], "sliders": [slider]},
        "margin": {"l": 20, "r": 20, "t": 20, "b": 110, "autoexpand": False},
        "legend": {"x": 0.0, "y": 1.0, "bgcolor": "rgba(255, 255, 255, 0.6)"},
        "uirevision": "kept",  # frames do not reset the view
    }
    if scene.error is not None:
        error = {"title": {"text": scene.error_name}, "rangemode": "tozero"}
        layout["xaxis"] = {"domain": [width + 0.06, 1.0], "title": {"text": scene.when}}
        layout["yaxis"] = {**error, "domain": [0.15, 0.9]}
    return layout


def _point(values: NDArray) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))


def _xyz(points: NDArray, digits: int) -> dict[str, list[float | None]]:
    return {letter: _numbers(points[:, i], digits) for i, letter in enumerate("xyz")}


def _numbers(values: NDArray, digits: int) -> list[float | None]:
    """Return rounded numbers, None for unknown ones."""
    return [v if np.isfinite(v) else None for v in values.round(digits).tolist()]
