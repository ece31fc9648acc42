"""From a log of measurements to a tracked path
=============================================

Fit a hybrid model to a log, check it on rows it has not seen, and follow a figure eight with it.
The log is that of the simulated trunk which comes with the package.
"""

import numpy as np

from hybridkin import HybridForwardModel, InverseKinematics, datasets, plots, robots, trajectories

data = datasets.load_trunk()  # simulated; your own: datasets.load_csv("log.csv", q=..., x=...)
train, test = datasets.paper_split(data, random_state=0)

model = HybridForwardModel(robots.bionic_handling_assistant(), calibrate="default", random_state=0)
model.fit(data.q[train], data.x[train])
for name, predict in (("mechanical", model.predict_mechanical), ("hybrid", model.predict)):
    error = np.linalg.norm(predict(data.q[test]) - data.x[test], axis=1)
    print(f"{name:10s}: mean {100 * error.mean():.2f} cm, max {100 * error.max():.1f} cm")

path = trajectories.figure_eight(center=(0.0, 0.0, 0.70), size=(0.50, 0.25), dt=0.05)
ik = InverseKinematics(model, q_min=0.1, q_max=0.4, q_pref=0.25, dt=0.05)
track = ik.track(path)  # track.q holds the chamber lengths to send to the robot
print(track)

figure, ax = plots.new_figure(5, 3.5)
plots.TrackingDisplay(path.x, {"hybrid model": track.x}).plot(ax)
