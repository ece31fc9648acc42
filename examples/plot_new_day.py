"""
Another day
===========

A hybrid model was fitted yesterday. Today the base of the robot has moved, and the zeros of its
actuators have shifted. `HybridForwardModel.adapt` finds both from five rows that are spread over
the workspace. This example compares it with the model as it was, with `partial_fit`, which learns
the new residual as an affine function of the actuators, and with a fit to the five rows alone. The
rows are those of the **simulated** trunk; the changes are computed.
"""

# %%
# Yesterday: a fit to 1600 rows. Of today's 400 rows, 80 are candidates for the fit and 320 test it.

import copy
import warnings

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from hybridkin import HybridForwardModel, datasets, robots

data = datasets.load_trunk()
chain = robots.bionic_handling_assistant()
fitted = HybridForwardModel(chain, "pose", coupling="serial", calibrate="default")
order = np.random.default_rng(0).permutation(len(data.q))
q, x = data.q[order], data.x[order]
fitted.fit(q[:1600], x[:1600])
q_pool, x_pool, q_test, x_test = q[1600:1680], x[1600:1680], q[1680:], x[1680:]


def spread(x, n, first):
    """Return n rows that are far from each other, by the farthest-point rule."""
    rows = [first]
    while len(rows) < n:
        rows.append(int(np.linalg.norm(x[:, None] - x[rows], axis=2).min(1).argmax()))
    return rows


# %%
# Today, in ten random draws: the zeros have shifted by 6 mm (rms), the base has turned by 3 degrees
# and moved by 2 cm. Shifted zeros change the readings at the same tips; a moved base changes the
# tips.


def change(rng, what):
    """Return what has changed: the shift of the readings, and the motion of the tips."""
    shift, turn, way = (
        rng.standard_normal(9),
        rng.standard_normal(3),
        rng.standard_normal(3),
    )
    shift *= 0.006 / np.sqrt(np.mean(shift**2)) * (what in ("zeros", "both"))
    turn *= np.deg2rad(3.0) / np.linalg.norm(turn) * (what in ("base", "both"))
    way *= 0.02 / np.linalg.norm(way) * (what in ("base", "both"))
    return lambda q: q - shift, lambda x: Rotation.from_rotvec(turn).apply(x) + way


def errors(what, seed):
    """Return the mean errors on test rows by method [mm]."""
    rng = np.random.default_rng(seed)
    read, move = change(rng, what)
    rows = spread(x_pool, 5, rng.integers(len(x_pool)))
    today = read(q_pool[rows]), move(x_pool[rows])
    again = copy.deepcopy(fitted)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # five rows are few to learn from
        again.fit(*today)
    models = {
        "as it was": fitted,
        "partial_fit": copy.deepcopy(fitted).partial_fit(*today),
        "adapt": copy.deepcopy(fitted).adapt(*today),
        "fitted anew": again,
    }
    misses = {name: m.predict(read(q_test)) - move(x_test) for name, m in models.items()}
    return {name: 1e3 * np.linalg.norm(miss, axis=1).mean() for name, miss in misses.items()}


CHANGES = ("nothing", "zeros", "base", "both")
table = {what: [errors(what, seed) for seed in range(10)] for what in CHANGES}

# %%
# The error after `adapt` is near that of the fit. If nothing has changed, it stays as it was.

figure, axes = plt.subplots(figsize=(7, 3.6))
colors = {
    "as it was": "0.7",
    "partial_fit": "#56B4E9",
    "adapt": "#0072B2",
    "fitted anew": "black",
}
for k, (name, color) in enumerate(colors.items()):
    means = {what: np.mean([draw[name] for draw in table[what]]) for what in CHANGES}
    print(f"{name:12}", "  ".join(f"{what} {mean:.1f} mm" for what, mean in means.items()))
    axes.bar(np.arange(4) + 0.2 * (k - 1.5), means.values(), 0.18, color=color, label=name)
axes.set_xticks(range(4), CHANGES)
axes.set(xlabel="what has changed", ylabel="mean tip error [mm]", ylim=(0, 80))
axes.legend(frameon=False, ncols=4, loc="upper left")
figure.tight_layout()
plt.show()
