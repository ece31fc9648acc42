"""Draw docs/images/trunk.gif: the simulated trunk follows a path, once by each of two models.

The commands come from the nominal mechanical model, and from a hybrid model that was fitted to the
rows of the package. No measurement is fed back. The pictures show the tips that the simulated trunk
reaches (MuJoCo, ``hybridkin[sim]``); its body is that of the chain, led to these tips::

    python examples/studies/trunk_gif.py docs/images/trunk.gif

About 20 seconds on one core.
"""

from __future__ import annotations

import io
import sys

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from simulated_trunk import TrunkPlant

from hybridkin import (
    HybridForwardModel,
    InverseKinematics,
    datasets,
    plots,
    robots,
    trajectories,
)

FPS, N_COLORS = 12, 48
DURATION, PERIOD = 6.0, 1.0 / FPS  # of the path, and between its points [s]
SIZE = (7.0, 3.9)  # [inch], at 100 dots each
LIMITS = {"xlim": (-30, 30), "ylim": (-25, 25), "zlim": (0, 75)}  # [cm]


def followed(path: trajectories.Trajectory) -> dict[str, tuple[NDArray, NDArray]]:
    """Return by model the commands (T, 9) and the tips (T, 3) of the simulated trunk [m]."""
    data, chain = datasets.load_trunk(), robots.bionic_handling_assistant()
    train, _ = datasets.paper_split(data, random_state=0)
    models = {
        "nominal model": HybridForwardModel(chain, "drop"),
        "hybrid model": HybridForwardModel(
            chain, "quadratic", coupling="serial", calibrate="default"
        ),
    }
    found = {}
    for name, model in models.items():
        model.fit(data.q[train], data.x[train])
        plant = TrunkPlant(**data.parameters["plant"], random_state=0)
        ik = InverseKinematics(model, q_min=0.1, q_max=0.4, q_pref=0.25, dt=PERIOD)
        track = ik.track(path, plant=plant)
        found[name] = track.q, track.x_measured
    return found


def frames(path: trajectories.Trajectory) -> list[Image.Image]:
    """Return the pictures, one for each point of the path."""
    chain = robots.bionic_handling_assistant()
    figure, axes = plots.new_figure(*SIZE, 1, 2, subplot_kw={"projection": "3d"})
    figure.set_layout_engine("none")  # or the picture would tremble
    moving = []
    for left, ax, (name, (q, tips)) in zip((0.0, 0.5), axes, followed(path).items(), strict=True):
        mean = 100 * np.linalg.norm(tips - path.x, axis=1).mean()
        color = plots.model_color(name)
        ax.set(**LIMITS)
        ax.set_axis_off()
        ax.set_position((left, -0.02, 0.5, 0.96))
        ax.set_box_aspect((60, 50, 75), zoom=1.27)
        ax.view_init(48, -70)
        ax.computed_zorder = False
        title = f"{name}, mean error {mean:.1f} cm"
        figure.text(left + 0.25, 0.93, title, ha="center", fontsize=13, color=color)
        lines = []
        for line in plots.BackboneDisplay.from_estimator(chain, q, tips=tips).lines(tip=False):
            look = line.look() | ({} if line.label == "backbone" else {"color": "0.7"})
            lines.append((line, ax.plot([], [], [], **look)[0]))
        ax.plot(*(100 * path.x.T), color="black", linewidth=1.5)
        trail = ax.plot([], [], [], color=color, linewidth=2.5)[0]
        moving.append((100 * tips, trail, lines))
    note = "simulated; black: path, 50 cm wide; coloured: tip, without feedback"
    figure.text(0.5, 0.03, note, ha="center", fontsize=11, color="0.3")
    pictures = []
    for k in range(len(path)):
        for tips, trail, lines in moving:
            trail.set_data_3d(*tips[: k + 1].T)
            for line, artist in lines:
                artist.set_data_3d(*(100 * line.points[k].T))
        memory = io.BytesIO()
        figure.savefig(memory, format="png", dpi=100)
        pictures.append(Image.open(memory).convert("RGB"))
    return pictures


if __name__ == "__main__":
    path = trajectories.figure_eight((0.0, 0.0, 0.70), (0.50, 0.25), duration=DURATION, dt=PERIOD)
    pictures = frames(path)
    # One of all, or the colours would flicker.
    palette = pictures[-1].quantize(N_COLORS)
    first, *others = [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    shown = [round(1000 * PERIOD)] * len(others) + [1000]  # [ms]
    options = {"duration": shown, "loop": 0, "optimize": True}
    first.save(sys.argv[1], save_all=True, append_images=others, **options)
