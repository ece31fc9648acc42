"""
A rigid arm from a URDF
=======================

The steps from a log to a tracked path are the same for rigid arms. A URDF gives a `RigidChain` with
a closed-form Jacobian. Calibration finds the poses of base and tool. The hybrid model learns the
residual, here the sag of a light arm under its own weight. The measurements are **simulated**.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch
from sklearn.model_selection import cross_val_predict

from hybridkin import (
    HybridForwardModel,
    InverseKinematics,
    RigidChain,
    plots,
    trajectories,
)

URDF = """
<robot name="six_axes">
  <link name="base"/><link name="l1"/><link name="l2"/><link name="l3"/><link name="l4"/>
  <link name="l5"/><link name="flange"/>
  <joint name="j1" type="revolute"><parent link="base"/><child link="l1"/>
    <origin xyz="0 0 0.20"/><axis xyz="0 0 1"/>
    <limit lower="-2.9" upper="2.9" effort="9" velocity="3"/></joint>
  <joint name="j2" type="revolute"><parent link="l1"/><child link="l2"/>
    <origin xyz="0 0 0.15"/><axis xyz="0 1 0"/>
    <limit lower="-1.9" upper="1.9" effort="9" velocity="3"/></joint>
  <joint name="j3" type="revolute"><parent link="l2"/><child link="l3"/>
    <origin xyz="0 0 0.35"/><axis xyz="0 1 0"/>
    <limit lower="-2.4" upper="2.4" effort="9" velocity="3"/></joint>
  <joint name="j4" type="revolute"><parent link="l3"/><child link="l4"/>
    <origin xyz="0 0 0.18"/><axis xyz="0 0 1"/>
    <limit lower="-2.9" upper="2.9" effort="9" velocity="3"/></joint>
  <joint name="j5" type="revolute"><parent link="l4"/><child link="l5"/>
    <origin xyz="0 0 0.17"/><axis xyz="0 1 0"/>
    <limit lower="-2.0" upper="2.0" effort="9" velocity="3"/></joint>
  <joint name="j6" type="revolute"><parent link="l5"/><child link="flange"/>
    <origin xyz="0 0 0.08"/><axis xyz="0 0 1"/>
    <limit lower="-2.9" upper="2.9" effort="9" velocity="3"/></joint>
</robot>
"""

# %%
# The log: 150 configurations. The base of the true arm is 2 cm away from the nominal one, its tool
# is not in the URDF, and shoulder and elbow sag by up to two degrees under the weight.

# at each joint [kg]
MASSES = torch.tensor([0.0, 0.0, 1.4, 0.0, 0.9, 0.6], dtype=torch.float64)
# [rad/Nm]
COMPLIANCE = torch.tensor([0.0, 0.002, 0.003, 0.0, 0.002, 0.0], dtype=torch.float64)

nominal = RigidChain.from_urdf(URDF, "flange")
base = np.eye(4)
base[:3, 3] = 0.02, -0.012, 0.004
real = RigidChain.from_urdf(URDF, "flange", base=base, tool=[0.015, 0.0, 0.11])


def settled(q):
    """Return the joint angles (N, 6) at which the arm comes to rest [rad]."""
    height = torch.func.vmap(torch.func.jacrev(lambda one: nominal.backbone(one)[1:7, 2]))
    torque = -9.81 * (height(q) * MASSES[:, None]).sum(1)
    return q + COMPLIANCE * torque


rng = np.random.default_rng(0)
q = rng.uniform(-1, 1, (150, 6)) * [1.5, 0.8, 1.2, 1.5, 1.2, 1.5] + [
    0,
    0.3,
    0.8,
    0,
    0.5,
    0,
]
with torch.no_grad():
    x = real(settled(torch.from_numpy(q))).numpy() + rng.normal(0.0, 2e-4, (150, 3))

# %%
# Errors on held-out configurations, ten folds. Serial coupling learns the error at the joints,
# where this arm sags; it has the least error.

models = {
    "mechanical, nominal: URDF": HybridForwardModel(nominal, "drop"),
    "mechanical, calibrated": HybridForwardModel(nominal, "drop", calibrate=("base", "tool")),
    "hybrid, error at the tip": HybridForwardModel(
        nominal, "quadratic", calibrate=("base", "tool")
    ),
    "hybrid, serial: error at the joints": HybridForwardModel(
        nominal, "quadratic", coupling="serial", calibrate=("base", "tool")
    ),
}
errors = plots.ErrorBoxDisplay.from_predictions(
    x, {name: cross_val_predict(model, q, x, cv=10) for name, model in models.items()}
)
for name, values in errors.errors.items():
    print(f"{name}: mean {1e3 * values.mean():.1f} mm, largest {1e3 * values.max():.1f} mm")

# %%
# The last model leads the tip along a circle, by default within the limits of the URDF.

model = models["hybrid, serial: error at the joints"].fit(q, x)
circle = trajectories.spiral((0.45, 0.0, 0.45), (0.15, 0.15), turns=1.0, dt=0.1)
ik = InverseKinematics(model, q_pref=[0, 0.3, 0.8, 0, 0.5, 0], dt=0.1)
track = ik.track(circle)
with torch.no_grad():
    reached = real(settled(torch.from_numpy(track.q))).numpy()
    arm = model.mechanical_model_.backbone(torch.from_numpy(track.q[::12]))
error = 1e3 * np.linalg.norm(reached - circle.x, axis=1)
print(f"circle on the simulated arm: mean {error.mean():.1f} mm, largest {error.max():.1f} mm")

figure = plt.figure(figsize=(11, 4.6), layout="constrained")
left, right = figure.subfigures(1, 2, width_ratios=(1.3, 1))
errors.plot(left.subplots(), unit="mm", log=True)
ax = right.add_subplot(projection="3d")
plots.BackboneDisplay(arm).plot(ax)
ax.plot(*(100 * circle.x.T), color="black", linewidth=1)
ax.set_yticks([-10, 0, 10])
plt.show()
