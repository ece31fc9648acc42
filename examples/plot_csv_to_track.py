"""
From a log of measurements to a tracked path
============================================

Fit a hybrid model to a log, test it on held-out rows, and compute the chamber lengths that lead the
tip along a figure eight. The log of a **simulated** trunk comes with the package.
"""

# sphinx_gallery_thumbnail_number = 2

import matplotlib.pyplot as plt
import numpy as np

from hybridkin import (
    HybridForwardModel,
    InverseKinematics,
    datasets,
    plots,
    robots,
    trajectories,
)

# %%
# A log holds actuator vectors q (N, 9) and tip positions x (N, 3), all in metres. Your own comes
# from ``datasets.load_log("log.csv", q=[...], x=[...], q_unit="mm", groups="motion")``.

data = datasets.load_trunk()
train, test = datasets.paper_split(data, random_state=0)

# %%
# `fit` first calibrates the radii of the rings and the pose of the base. The network then learns
# the residual. The errors are those of held-out rows.

model = HybridForwardModel(robots.bionic_handling_assistant(), calibrate="default", random_state=0)
model.fit(data.q[train], data.x[train])
predictions = {
    "mechanical, calibrated": model.predict_mechanical(data.q[test]),
    "hybrid, ELM": model.predict(data.q[test]),
}
for name, x in predictions.items():
    error = 100 * np.linalg.norm(x - data.x[test], axis=1)
    print(f"{name}: mean {error.mean():.2f} cm, largest {error.max():.1f} cm")

# %%
# Inverse kinematics keeps every chamber within its limits and, in the null space, near 25 cm.

path = trajectories.figure_eight(center=(0.0, 0.0, 0.70), size=(0.50, 0.25), dt=0.05)
ik = InverseKinematics(model, q_min=0.1, q_max=0.4, q_pref=0.25, dt=0.05)
track = ik.track(path)  # track.q holds the chamber lengths to send to the robot
print(track)

# %%
# Left: tip errors on held-out rows. Right: the commands, one panel for each segment.

figure = plt.figure(figsize=(10, 4.6), layout="constrained")
left, right = figure.subfigures(1, 2, width_ratios=(1, 1.1))
display = plots.ErrorBoxDisplay.from_predictions(data.x[test], predictions)
display.plot(left.subplots())
axes = right.subplots(3, 1, sharex=True)
plots.ActuatorDisplay({"hybrid, ELM": track.q}, [3, 3, 3], t=track.t).plot(axes)
axes[0].get_legend().remove()
axes[0].set_title("chamber lengths for the figure eight", fontsize="medium")
plt.show()

# %%
# The robot, as the model describes it, at one point of the path.

figure = plt.figure(figsize=(6, 4.6), layout="constrained")
chain = model.mechanical_model_
film = plots.TrackAnimation.from_estimator(chain, track.q, target=path.x, t=path.t, tips=track.x)
film.plot(figure.add_subplot(projection="3d"), frame=60)
plt.show()
