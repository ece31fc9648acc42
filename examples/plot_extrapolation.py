"""
Outside the data: what the guard does
=====================================

A network knows nothing where it has seen nothing, and says something all the same. The guard of
`HybridForwardModel` fades the learned error out there, and the mechanical model remains. The models
below learn from rows in which one segment moves at a time, and are asked about rows in which all
three do (**simulated** trunk): inside the range of every chamber, and yet far from the data.
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


guards = {"no guard": None, "box": "box", "leverage (default)": "leverage"}
models = {name: hybrid(guard) for name, guard in guards.items()}

# %%
# What the models make of the test rows. The box trusts the range of every chamber, which these rows
# hardly leave; the leverage knows which combinations have been seen.

predictions = {"mechanics alone": models["no guard"].predict_mechanical(data.q[test])}
predictions |= {name: model.predict(data.q[test]) for name, model in models.items()}
errors = plots.ErrorBoxDisplay.from_predictions(data.x[test], predictions)
for name, values in errors.errors.items():
    print(f"{name}: mean {1e3 * values.mean():.1f} mm, largest {1e3 * values.max():.0f} mm")

# %%
# On the way from training rows to test rows: how long the learned correction is, median and middle
# 80 % of 60 such ways.

rng = np.random.default_rng(0)
start, end = data.q[rng.choice(train, 60)], data.q[rng.choice(test, 60)]
share = np.linspace(0.0, 1.0, 41)
ways = (start + share[:, None, None] * (end - start)).reshape(-1, 9)

figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), width_ratios=(1, 1.1), layout="constrained")
for (name, model), color in zip(models.items(), ("#0072B2", "#009E73", "#CC79A7"), strict=True):
    length = 1e3 * np.linalg.norm(model.predict_error(ways), axis=1).reshape(41, 60)
    low, median, high = np.quantile(length, [0.1, 0.5, 0.9], axis=1)
    axes[0].plot(100 * share, median, color=color, label=name, linewidth=2)
    axes[0].fill_between(100 * share, low, high, color=color, alpha=0.15, linewidth=0)
axes[0].set(xlabel="way from a training row to a test row [%]", xlim=(0, 100))
axes[0].set(ylabel="learned correction [mm]", ylim=(0, None))
axes[0].legend(frameon=False, loc="upper left")
errors.plot(axes[1], unit="mm")
axes[1].set_title("rows in which all segments move", fontsize="medium")
plt.show()
