"""
Autograd: train a geometry, a network and a place
=================================================

Chains and fitted models are torch modules, and solutions of the inverse kinematics are
differentiable. Three losses that `calibrate` and `fit` do not know, on **simulated** trunks: a
geometry trained by Adam, pressures in front of a hybrid model, and the place of a path.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import nn

from hybridkin import (
    HybridForwardModel,
    InverseKinematics,
    calibrate,
    datasets,
    plots,
    robots,
)

torch.manual_seed(0)
data = datasets.load_trunk()
train, test = datasets.paper_split(data, random_state=0)
q, x = torch.from_numpy(data.q), torch.from_numpy(data.x)
chain = robots.bionic_handling_assistant()

# %%
# A robot whose radii differ from its drawing, measured with 1 mm of noise. Its radii are
# parameters of a chain, which Adam trains. The least squares of `calibrate` need no rate and no
# number of steps.

N_STEPS = 120
real = chain.with_geometry(radii=chain.radii * torch.tensor([1.08, 0.94, 1.05]).double())
rows = q[train[:300]]
tips = real(rows) + 1e-3 * torch.randn(len(rows), 3).double()

robot = chain.with_geometry(radii=nn.Parameter(chain.radii.clone()))
adam = torch.optim.Adam(robot.parameters(), lr=1e-3)
losses = []
for _ in range(N_STEPS):
    loss = (robot(rows) - tips).square().sum(-1).mean()
    losses.append(1e3 * loss.item() ** 0.5)
    adam.zero_grad()
    loss.backward()
    adam.step()
calibrated = calibrate(chain, rows, tips, parameters=("radii",))
print(f"Adam: {losses[-1]:.2f} mm; calibrate: {1e3 * calibrated.rmse:.2f} mm")

# %%
# The log of another trunk has pressures in place of lengths. A small network learns the lengths
# behind them: its outputs go through the fitted hybrid model, and only tips are compared.


class Chambers(nn.Module):
    """Pressures (..., 9) [bar] -> lengths (..., 9) [m], one curve for all chambers."""

    def __init__(self):
        super().__init__()
        self.curve = nn.Sequential(nn.Linear(1, 8), nn.Tanh(), nn.Linear(8, 1)).double()

    def forward(self, p):
        return 0.25 + 0.1 * self.curve(p[..., None] - 0.6)[..., 0]


def minimise(loss_of, parameters, n_steps):
    """Minimise a loss by L-BFGS."""
    lbfgs = torch.optim.LBFGS(parameters, max_iter=n_steps, line_search_fn="strong_wolfe")

    def evaluate():
        lbfgs.zero_grad()
        loss = loss_of()
        loss.backward()
        return loss

    lbfgs.step(evaluate)


model = HybridForwardModel(chain, calibrate="default", random_state=0)
hybrid = model.fit(data.q[train], data.x[train]).module_
pressures = -torch.log(1 - (q - 0.1) / 0.35)
network = nn.Sequential(Chambers(), hybrid)
few = train[::5]
before = network[0](pressures).detach()
minimise(
    lambda: 1e4 * (network(pressures[few]) - x[few]).square().mean(),
    network.parameters(),
    100,
)
with torch.no_grad():
    lengths = network[0](pressures)
    for name, tip in {"network": network(pressures[test]), "true lengths": hybrid(q[test])}.items():
        error = (tip - x[test]).norm(dim=-1)
        print(f"{name}: {1e2 * error.mean():.2f} cm on {len(test)} test rows")

# %%
# Where should a circle lie, so that the chambers stay near 0.25 m? The graph of the solutions leads
# back to their targets.

N_POINTS = 24
ik = InverseKinematics(model, q_min=0.1, q_max=0.4, q_pref=0.25)
angle = torch.arange(N_POINTS).double() * (2 * torch.pi / N_POINTS)
circle = torch.stack([0.05 + 0.1 * angle.cos(), 0.1 * angle.sin(), 0.68 + 0 * angle], dim=-1)
shift = nn.Parameter(torch.zeros(3).double())


def effort():
    """Return the mean square of the changes of the chambers [m^2]."""
    solution = ik.solve(circle + shift, differentiable=True)
    return (solution.q - 0.25).square().mean()


places = [circle]
minimise(lambda: 1e4 * effort(), [shift], 10)
places.append((circle + shift).detach())
solved = [ik.solve(place).q for place in places]
for name, found in zip(("first", "best"), solved, strict=True):
    change = 1e3 * (found - 0.25).square().mean() ** 0.5
    print(f"{name} place: chambers {change:.0f} mm from 0.25 m (root mean square)")

# %%
# Left: the loss falls to the noise, where `calibrate` is. Middle: the curve of the network after
# the training is that of the simulated chambers, and was never shown. Right: the first place of the
# circle and the best one, each with four postures of the trunk.

figure = plt.figure(figsize=(12, 4.4), layout="constrained")
left, middle, right = figure.subfigures(1, 3, width_ratios=(1, 1, 0.9))
ax = left.subplots()
blue, orange = plots.model_color("hybrid"), plots.model_color("mechanical")
ax.plot(losses, color=blue, label="Adam on the radii")
ax.axhline(1e3 * calibrated.rmse, color="black", linestyle="--", label="calibrate")
ax.set(yscale="log", xlabel="step", ylabel="tip error, root mean square [mm]")
ax.set_yticks([2, 5, 10, 20], ["2", "5", "10", "20"])
ax.minorticks_off()
ax.legend(frameon=False)

ax = middle.subplots()
order = np.argsort(pressures[few].flatten().numpy())
for values, color, style, label in (
    (q, "black", "-", "simulated chambers"),
    (before, orange, ":", "before training"),
    (lengths, blue, "--", "network"),
):
    ax.plot(
        pressures[few].flatten().numpy()[order],
        1e2 * values[few].flatten().numpy()[order],
        style,
        color=color,
        linewidth=2,
        label=label,
    )
ax.set(xlabel="pressure [bar]", ylabel="length of a chamber [cm]")
ax.legend(frameon=False)

ax = right.add_subplot(projection="3d")
for place, found, color, label in zip(
    places, solved, (orange, blue), ("first place", "best place"), strict=True
):
    for backbone in 100 * model.mechanical_model_.backbone(found[:: N_POINTS // 4]).numpy():
        ax.plot(*backbone.T, color=color, linewidth=1, alpha=0.6)
    closed = 100 * torch.cat([place, place[:1]]).numpy()
    ax.plot(*closed.T, color=color, label=label)
ax.set(xlabel="x [cm]", ylabel="y [cm]", zlabel="z [cm]")
ax.set(xlim=(-20, 20), ylim=(-20, 20), zlim=(0, 80))
ax.set_xticks([-10, 0, 10])
ax.set_yticks([-10, 0, 10])
ax.view_init(elev=12)
ax.set_box_aspect((1, 1, 2), zoom=0.9)
right.legend(*ax.get_legend_handles_labels(), frameon=False, loc="upper left")
plt.show()
