"""
Extrapolation: what the guard does
==================================

A network also returns values far from its training data, where nothing supports them. There the
guard of `HybridForwardModel` fades the learned error, and the mechanical model remains. The models
below learn from rows in which one segment moves at a time. The test rows move all three segments:
they lie within the range of every chamber, but far from the training data (**simulated** trunk).
"""

import matplotlib.pyplot as plt
import numpy as np

from hybridkin import ELMRegressor, HybridForwardModel, datasets, plots, robots

data = datasets.load_trunk()
train, test = np.flatnonzero(data.part != 3), np.flatnonzero(data.part == 3)
chain = robots.bionic_handling_assistant()


def hybrid(guard):
    """Return a hybrid with a weakly penalised network, fitted to the training rows."""
    network = ELMRegressor(100, alpha=1e-3, random_state=0)
    model = HybridForwardModel(chain, network, calibrate="default", guard=guard)
    return model.fit(data.q[train], data.x[train])


guards = {
    "hybrid, no guard": None,
    "hybrid, leverage (default)": "leverage",
}
models = {name: hybrid(guard) for name, guard in guards.items()}

# %%
# The test rows hardly leave the range of any chamber. The guard "leverage" also checks which
# combinations of lengths are in the training data.

predictions = {
    "mechanical, calibrated": models["hybrid, no guard"].predict_mechanical(data.q[test])
}
predictions |= {name: model.predict(data.q[test]) for name, model in models.items()}
errors = plots.ErrorBoxDisplay.from_predictions(data.x[test], predictions)
for name, values in errors.errors.items():
    print(f"{name}: mean {1e3 * values.mean():.1f} mm, largest {1e3 * values.max():.0f} mm")

# %%
# Length of the learned correction on straight lines from training rows to test rows: median and
# middle 80 % of 60 lines.

rng = np.random.default_rng(0)
start, end = data.q[rng.choice(train, 60)], data.q[rng.choice(test, 60)]
share = np.linspace(0.0, 1.0, 41)
ways = (start + share[:, None, None] * (end - start)).reshape(-1, 9)

figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), width_ratios=(1, 1.1), layout="constrained")
for (name, model), color in zip(models.items(), ("0.6", plots.model_color("hybrid")), strict=True):
    length = 1e3 * np.linalg.norm(model.predict_error(ways), axis=1).reshape(41, 60)
    low, median, high = np.quantile(length, [0.1, 0.5, 0.9], axis=1)
    axes[0].plot(100 * share, median, color=color, label=name, linewidth=2)
    axes[0].fill_between(100 * share, low, high, color=color, alpha=0.15, linewidth=0)
axes[0].set(xlabel="place between training row and test row [%]", xlim=(0, 100))
axes[0].set(ylabel="learned correction [mm]", ylim=(0, None))
axes[0].legend(frameon=False, loc="upper left")
errors.plot(axes[1], unit="mm")
axes[1].set_title("rows in which all segments move", fontsize="medium")
plt.show()
