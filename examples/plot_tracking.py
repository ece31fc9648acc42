"""
Tracking a path on a plant
==========================

Figures 3 and 4 of the paper: the tip follows a figure eight without feedback. The commands come
from the nominal mechanical model and from two hybrid models. The plant is the **simulated** trunk
(MuJoCo). It has a weight, is tilted, and its base has an error.
"""

# sphinx_gallery_thumbnail_number = 2

import importlib.util

import matplotlib.pyplot as plt

from hybridkin import (
    HybridForwardModel,
    InverseKinematics,
    datasets,
    plots,
    robots,
    trajectories,
)

data = datasets.load_trunk()
train, _ = datasets.paper_split(data, random_state=0)
chain = robots.bionic_handling_assistant()
models = {
    "mechanical, nominal": HybridForwardModel(chain, "drop"),
    "hybrid, ELM": HybridForwardModel(chain, random_state=0),
    "hybrid, serial": HybridForwardModel(
        chain, "quadratic", coupling="serial", calibrate="default"
    ),
}
path = trajectories.figure_eight((0.0, 0.0, 0.70), (0.50, 0.25), dt=0.125)

# %%
# ``track`` takes the plant as a function: a command goes in, the measured tip comes out. With
# ``feedback="model"``, the default, the measurement is only recorded.


def followed(model):
    """Return the track of the plant, commanded on a model."""
    from paper import TrunkPlant

    plant = TrunkPlant(**data.parameters["plant"], random_state=0)
    ik = InverseKinematics(model, q_min=0.1, q_max=0.4, q_pref=0.25, dt=0.125)
    return ik.track(path, plant=plant)


if importlib.util.find_spec("mujoco") is None:
    print('Skipped: this example needs MuJoCo; pip install "hybridkin[sim]".')
else:
    tracks = {}
    for name, model in models.items():
        tracks[name] = followed(model.fit(data.q[train], data.x[train]))
        error = 100 * tracks[name].error
        print(f"{name}: mean {error.mean():.2f} cm, largest {error.max():.2f} cm")

    # Left: the path. Right: the error over time, and the commands to one segment.
    figure = plt.figure(figsize=(11, 5), layout="constrained")
    left, right = figure.subfigures(1, 2)
    tips = {name: track.x_measured for name, track in tracks.items()}
    plots.TrackingDisplay(path.x, tips, t=path.t).plot(left.subplots())
    axes = right.subplots(2, 1, sharex=True)
    for name, track in tracks.items():
        color = plots.model_color(name)
        axes[0].plot(path.t, 100 * track.error, color=color, label=name)
        for chamber, style in enumerate(("-", "--", ":")):
            q = 100 * track.q[:, chamber]
            axes[1].plot(path.t, q, color=color, linestyle=style)
    for chamber, line in enumerate(axes[1].lines[:3], start=1):
        line.set_label(f"chamber {chamber}")
    axes[1].legend(frameon=False, fontsize="small")
    axes[0].set(ylabel="tip error [cm]", ylim=(0, None))
    axes[1].set(ylabel="chambers, segment 1 [cm]", xlabel="time [s]")
    plt.show()

# %%
# The trunk on the commands of the serial hybrid, at six points of the path. Each body ends at the
# measured tip.

if importlib.util.find_spec("mujoco") is not None:
    track = tracks["hybrid, serial"]
    rows = range(0, len(path), len(path) // 6)
    figure = plt.figure(figsize=(6, 4.6), layout="constrained")
    ax = figure.add_subplot(projection="3d")
    ax.plot(*(100 * path.x.T), color="black", linewidth=1)
    bodies = plots.BackboneDisplay.from_estimator(
        chain, track.q[rows], tips=tips["hybrid, serial"][rows]
    )
    bodies.plot(ax)
    plt.show()
