"""
In a notebook
=============

In Jupyter the last line of a cell shows its object. Chains, models, inverse kinematics and tracks
show a table: what was calibrated, which error model was learned, how large its held-out error is
and where it holds. This page runs as a notebook: download it with the link at its end. The log is
that of the **simulated** trunk which comes with the package.
"""

# sphinx_gallery_thumbnail_number = 1

import matplotlib.pyplot as plt

from hybridkin import (
    HybridForwardModel,
    InverseKinematics,
    datasets,
    plots,
    robots,
    trajectories,
)

chain = robots.bionic_handling_assistant()
chain

# %%
# A model shows its parameters as every scikit-learn estimator does. After the fit a second table
# follows. Click on a line to unfold it: the calibration with its standard errors, the geometry
# of the mechanical model, and the training range of every actuator. With `coverage` the model also
# estimates an error radius. Every fourth row of the log is enough here.

data = datasets.load_trunk()
model = HybridForwardModel(chain, "pose", coupling="serial", calibrate="default", coverage=0.9)
model.fit(data.q[::4], data.x[::4])

# %%
# Inverse kinematics shows its settings, the default ones too, and the model that it inverts.

path = trajectories.figure_eight(center=(0.0, 0.0, 0.70), size=(0.50, 0.25), dt=0.05)
ik = InverseKinematics(model, q_min=0.1, q_max=0.4, q_pref=0.25, dt=0.05)
ik

# %%
# A track shows whether every point was reached. Its distances are those of the model's tip. The
# error of the robot is the held-out error of the model.

track = ik.track(path)
track

# %%
# Displays draw below their cell.

plots.TrackingDisplay.from_tracks({"model": track}).plot()
plt.show()
