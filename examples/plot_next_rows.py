"""
Which configurations to measure next
====================================

A measured row costs robot time, and most rows of a random log repeat what other rows contain.
`choose_rows` chooses the rows with the least expected error before anything is measured. The pool
are 380 configurations of the **simulated** trunk with all nine lengths at random. A hybrid model is
fitted to some of them and tested on 120 others, at the commanded lengths, which have no noise.
"""

# %%
# The pool, and the order in which to measure it. It takes the nominal robot and the lengths only.

import matplotlib.pyplot as plt
import numpy as np

from hybridkin import HybridForwardModel, choose_rows, datasets, robots

data = datasets.load_trunk()
rows = np.random.default_rng(0).permutation(np.flatnonzero(data.part == 3))
pool, test = rows[:380], rows[380:]
chain = robots.bionic_handling_assistant()
sizes = (25, 50, 100)
chosen, expected = choose_rows(chain, data.q_target[pool], max(sizes))

# %%
# Chosen rows against five random draws, each fitted with the errors of the robot's structure.


def errors(measured):
    """Return the mean and the largest tip error [mm] of a model fitted to these rows."""
    model = HybridForwardModel(chain, "structural", coupling="serial", calibrate="default")
    model.fit(data.q[measured], data.x[measured])
    distance = np.linalg.norm(model.predict(data.q_target[test]) - data.x[test], axis=1)
    return 1e3 * distance.mean(), 1e3 * distance.max()


draws = [np.random.default_rng(seed).permutation(pool) for seed in range(5)]
by_choice = np.array([errors(pool[chosen[:n]]) for n in sizes])
by_chance = np.array([[errors(draw[:n]) for n in sizes] for draw in draws])
for n, (mean, largest), several in zip(sizes, by_choice, by_chance.swapaxes(0, 1), strict=True):
    average, spread = several.mean(0), several.std(0)
    print(
        f"{n} rows, mean (largest) error in mm: chosen {mean:.1f} ({largest:.0f}), "
        f"random {average[0]:.1f} +- {spread[0]:.1f} ({average[1]:.0f} +- {spread[1]:.0f}), "
        f"expected {1e3 * expected[n - 1]:.1f}"
    )

# %%
# The mean error decreases; the largest one need not. The expected error follows from the
# size of the robot alone: compare rows by it. It is too large here, because the trunk has smaller
# errors than its prior allows.

figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
for k, (ax, what) in enumerate(zip(axes, ("mean", "largest"), strict=True)):
    average, spread = by_chance[..., k].mean(0), by_chance[..., k].std(0)
    ax.plot(sizes, by_choice[:, k], "o-", color="#0072B2", label="chosen rows")
    ax.plot(sizes, average, "s--", color="0.4", label="random rows, five draws")
    ax.fill_between(sizes, average - spread, average + spread, color="0.4", alpha=0.2, linewidth=0)
    ax.set(
        xscale="log",
        xticks=sizes,
        xlabel="measured rows",
        ylabel=f"{what} tip error [mm]",
    )
    ax.set_xticklabels(map(str, sizes))
    ax.minorticks_off()
    ax.set_ylim(bottom=0)
axes[0].plot(
    np.arange(11, 100) + 1,
    1e3 * expected[11:],
    ":",
    color="black",
    label="expected, chosen rows",
)
axes[0].legend(frameon=False)
plt.show()
