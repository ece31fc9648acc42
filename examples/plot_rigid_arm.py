"""
A rigid arm from a URDF
=======================

Nothing in the way from a log to a tracked path asks for a soft robot. A URDF gives a `RigidChain`,
with closed-form Jacobian; calibration finds where its base and its tool are, and the hybrid model
learns what is left, here the sag of a light arm under its own weight. The measurements are
**simulated**.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch
from sklearn.model_selection import cross_val_predict

from hybridkin import HybridForwardModel, InverseKinematics, RigidChain, plots, trajectories

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
# The log: 150 postures. The real arm stands 2 cm aside, carries a tool nobody has measured, and its
# shoulder and elbow give way by up to a degree or two under the weight of what they hold.

MASSES = torch.tensor([0.0, 0.0, 1.4, 0.0, 0.9, 0.6], dtype=torch.float64)  # at each joint [kg]
COMPLIANCE = torch.tensor([0.0, 0.002, 0.003, 0.0, 0.002, 0.0], dtype=torch.float64)  # [rad/Nm]

nominal = RigidChain.from_urdf(URDF, "flange")
base = np.eye(4)
base[:3, 3] = 0.02, -0.012, 0.004
real = RigidChain.from_urdf(URDF, "flange", base=base, tool=[0.015, 0.0, 0.11])


def settled(q):
    """Return the joint angles (N, 6) that the arm comes to rest at [rad]."""
    height = torch.func.vmap(torch.func.jacrev(lambda one: nominal.backbone(one)[1:7, 2]))
    torque = -9.81 * (height(q) * MASSES[:, None]).sum(1)
    return q + COMPLIANCE * torque


rng = np.random.default_rng(0)
q = rng.uniform(-1, 1, (150, 6)) * [1.5, 0.8, 1.2, 1.5, 1.2, 1.5] + [0, 0.3, 0.8, 0, 0.5, 0]
with torch.no_grad():
    x = real(settled(torch.from_numpy(q))).numpy() + rng.normal(0.0, 2e-4, (150, 3))

# %%
# Errors on postures held out, ten folds. Learning at the joints (serial coupling) is what this arm
# asks for: that is where it gives way.

models = {
    "URDF as it is": HybridForwardModel(nominal, "drop"),
    "base and tool calibrated": HybridForwardModel(nominal, "drop", calibrate=("base", "tool")),
    "+ error at the tip": HybridForwardModel(nominal, "quadratic", calibrate=("base", "tool")),
    "+ error at the joints": HybridForwardModel(
        nominal, "quadratic", coupling="serial", calibrate=("base", "tool")
    ),
}
errors = plots.ErrorBoxDisplay.from_predictions(
    x, {name: cross_val_predict(model, q, x, cv=10) for name, model in models.items()}
)
for name, values in errors.errors.items():
    print(f"{name}: mean {1e3 * values.mean():.1f} mm, largest {1e3 * values.max():.1f} mm")

# %%
# A circle, drawn with the last model within the limits of the URDF, which are
# the default.

model = models["+ error at the joints"].fit(q, x)
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
errors.plot(left.subplots(), unit="mm")
left.axes[0].set_xscale("log")
left.axes[0].set_xlim(0.1, 300)
ax = right.add_subplot(projection="3d")
plots.BackboneDisplay(arm).plot(ax)
ax.plot(*(100 * circle.x.T), color="black", linewidth=1)
ax.set_yticks([-10, 0, 10])
plt.show()
