"""
A payload half-way
==================

A hybrid model is fitted once to a log of the simulated trunk. Then the trunk follows a figure
eight, feed-forward, and half-way somebody hangs 300 g more on its tip. One controller keeps the
fitted model; the other hands every measured tip to `HybridForwardModel.partial_fit`, which learns
what has changed as an affine function of the actuators and leaves the fitted model as it is.
Everything here is simulated (MuJoCo).
"""

# %%
# The model, from the log that comes with the package, and the path: two laps in 20 s.

import importlib.util

import matplotlib.pyplot as plt
import numpy as np

from hybridkin import HybridForwardModel, InverseKinematics, datasets, robots, trajectories

data = datasets.load_trunk()
path = trajectories.figure_eight(center=(0.0, 0.0, 0.70), size=(0.50, 0.25), dt=0.1)
targets = np.concatenate([path.x, path.x])
payload_from = len(path.x)


def fitted():
    """Return the hybrid model, serial: the error acts inside the robot."""
    chain = robots.bionic_handling_assistant()
    model = HybridForwardModel(chain, "quadratic", coupling="serial", calibrate="default")
    return model.fit(data.q, data.x)


# %%
# At every tick one step of the inverse kinematics, one command to the plant, one measurement. The
# measurement is not fed back to the controller but, in one of two runs, to the model.


def run(learn):
    """Return the measured tips [m]."""
    from hybridkin.simulation import TrunkPlant

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
# The payload takes the error of the fitted model from 2 to 6.5 mm; the one that learns comes to
# 4.7 mm, with a new lag wherever the path goes on to where nothing has been measured yet.

if importlib.util.find_spec("mujoco") is None:
    print('Skipped: this example needs MuJoCo; pip install "hybridkin[sim]".')
else:
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), width_ratios=[1, 1.5])
    axes[0].plot(100 * targets[:, 0], 100 * targets[:, 1], "k:", label="path")
    time = 0.1 * np.arange(len(targets))
    for learn, color, name in ((False, "#D55E00", "fitted once"), (True, "#0072B2", "partial_fit")):
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
        axes[1].plot(time[2:-2], smooth[2:-2], color=color, label=name)
    axes[0].set(xlabel="x [cm]", ylabel="y [cm]", title="second lap, with payload", aspect="equal")
    axes[1].axvline(time[payload_from], color="0.6", linewidth=1)
    axes[1].text(time[payload_from], 0, " payload", color="0.4", va="bottom")
    axes[1].set(xlabel="time [s]", ylabel="tip error [mm]", ylim=(0, None))
    axes[1].legend(frameon=False)
    figure.tight_layout()
    plt.show()
