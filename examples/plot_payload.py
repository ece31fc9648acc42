"""
A payload half-way
==================

A hybrid model is fitted once to a log of the trunk. Then the trunk follows a figure eight twice,
without feedback, and before the second lap its tip gets 300 g of payload. One controller keeps the
fitted model. The other one calls `HybridForwardModel.partial_fit` with every measured tip, which
learns the change as an affine function of the actuators and does not change the fitted model.
Everything is **simulated** (MuJoCo).
"""

# %%
# The log comes with the package. The path has two laps of 10 s.

import importlib.util

import matplotlib.pyplot as plt
import numpy as np

from hybridkin import (
    HybridForwardModel,
    InverseKinematics,
    datasets,
    robots,
    trajectories,
)

data = datasets.load_trunk()
path = trajectories.figure_eight(center=(0.0, 0.0, 0.70), size=(0.50, 0.25), dt=0.1)
targets = np.concatenate([path.x, path.x])
payload_from = len(path.x)


def fitted():
    """Return the serial hybrid model: the error acts inside the robot."""
    chain = robots.bionic_handling_assistant()
    model = HybridForwardModel(chain, "quadratic", coupling="serial", calibrate="default")
    return model.fit(data.q, data.x)


# %%
# Every period has one step of the inverse kinematics, one command to the plant and one measurement.
# The controller does not use the measurement; in one of two runs the model does.
#
# The start: `solve` finds the command of the first target, so both runs begin on the path, with the
# error of the fitted model. During the first lap the robot is that of the log. There is no change
# to learn, and the two curves differ by less than the noise: 1 mm on the lengths, 0.5 mm on the
# tips.


def run(learn):
    """Return the measured tips [m]."""
    from paper import TrunkPlant

    model = fitted()
    plants = [
        TrunkPlant(tip_mass=mass, cable_noise=1e-3, mocap_noise=5e-4, random_state=0)
        for mass in (0.3, 0.6)
    ]
    settings = {"q_min": 0.15, "q_max": 0.35, "q_pref": 0.25, "dt": 0.1}
    q = InverseKinematics(model, **settings).solve(targets[0]).q
    tips = []
    for i, target in enumerate(targets):
        q = q + InverseKinematics(model, **settings).step(q, target).dq
        q_measured, pose = plants[int(i >= payload_from)].settle(q)
        tips.append(pose[:3, 3])
        if learn:
            model.partial_fit(q_measured[None], tips[-1:])
    return np.array(tips)


# %%
# The payload increases the error of the fitted model from 2 to 6.5 mm. The model that learns
# improves after 3 s with payload and reaches 4.7 mm on average. Its error grows again from 15 s on,
# where the path enters a region without measurements.

if importlib.util.find_spec("mujoco") is None:
    print('Skipped: this example needs MuJoCo; pip install "hybridkin[sim]".')
else:
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), width_ratios=[1, 1.5], layout="constrained")
    axes[0].plot(100 * targets[:, 0], 100 * targets[:, 1], "k:", label="path")
    time = 0.1 * np.arange(len(targets))
    for learn, color, name in (
        (False, "0.4", "fitted once"),
        (True, "#56B4E9", "partial_fit"),
    ):
        tips = run(learn)
        error = 1e3 * np.linalg.norm(tips - targets, axis=1)
        after = slice(payload_from + 20, None)
        print(
            f"{name}: {error[10:payload_from].mean():.1f} mm before the payload, "
            f"{error[after].mean():.1f} mm from two seconds after it on"
        )
        axes[0].plot(*100 * tips[payload_from:, :2].T, color=color, label=name)
        smooth = np.convolve(error, np.ones(5) / 5, "same")
        axes[1].plot(time, error, ".", color=color, alpha=0.3, markersize=3)
        style = "-" if learn else "--"
        axes[1].plot(time[2:-2], smooth[2:-2], style, color=color, label=name, zorder=3 - learn)
    axes[0].set(
        xlabel="x [cm]",
        ylabel="y [cm]",
        title="second lap, with payload",
        aspect="equal",
    )
    axes[1].axvline(time[payload_from], color="0.6", linewidth=1)
    for share, words in (
        (0.25, "first lap, robot of the log"),
        (0.75, "second lap, payload"),
    ):
        place = {"transform": axes[1].transAxes, "ha": "center", "va": "bottom"}
        axes[1].text(share, 0.01, words, color="0.4", fontsize="small", **place)
    axes[1].set(xlabel="time [s]", ylabel="tip error [mm]", xlim=(0, time[-1]))
    axes[1].set_ylim(bottom=-1.0)
    axes[1].legend(frameon=False, loc="upper left")
    plt.show()
