"""
From a log of measurements to a tracked path
============================================

Fit a hybrid model to a log, check it on rows it has not seen, and turn a figure eight into the
chamber lengths to send to the robot. The log is that of the **simulated** trunk which comes with
the package.
"""

import matplotlib.pyplot as plt
import numpy as np

from hybridkin import HybridForwardModel, InverseKinematics, datasets, plots, robots, trajectories

# %%
# A log holds actuator vectors q (N, 9) and tip positions x (N, 3), all in metres. Your own comes
# from ``datasets.load_log("log.csv", q=[...], x=[...], q_unit="mm", groups="motion")``.

data = datasets.load_trunk()
train, test = datasets.paper_split(data, random_state=0)

# %%
# The radii of the rings and the pose of the base are calibrated first; the network learns what is
# left. Judge both on rows that had no part in it.

model = HybridForwardModel(robots.bionic_handling_assistant(), calibrate="default", random_state=0)
model.fit(data.q[train], data.x[train])
predictions = {
    "calibrated mechanics": model.predict_mechanical(data.q[test]),
    "hybrid": model.predict(data.q[test]),
}
for name, x in predictions.items():
    error = 100 * np.linalg.norm(x - data.x[test], axis=1)
    print(f"{name}: mean {error.mean():.2f} cm, largest {error.max():.1f} cm")

# %%
# Null-space inverse kinematics keeps every chamber within its limits and near 25 cm.

path = trajectories.figure_eight(center=(0.0, 0.0, 0.70), size=(0.50, 0.25), dt=0.05)
ik = InverseKinematics(model, q_min=0.1, q_max=0.4, q_pref=0.25, dt=0.05)
track = ik.track(path)  # track.q holds the chamber lengths to send to the robot
print(track)

# %%
# Left: what the model gets wrong. Right: what to send, segment by segment.

figure = plt.figure(figsize=(10, 4.6), layout="constrained")
left, right = figure.subfigures(1, 2, width_ratios=(1, 1.1))
display = plots.ErrorBoxDisplay.from_predictions(data.x[test], predictions)
display.plot(left.subplots())
axes = right.subplots(3, 1, sharex=True)
plots.ActuatorDisplay({"chambers": track.q}, [3, 3, 3], t=track.t).plot(axes)
axes[0].get_legend().remove()
axes[0].set_title("chamber lengths for the figure eight", fontsize="medium")
plt.show()
