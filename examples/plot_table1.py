"""
Table 1 of the paper
====================

Mechanical, data-driven and hybrid models of the tip, with the learners of Reinhart & Steil (2016).
The trunk is **simulated**, the paper's robot is real: compare the order of the models and the
factors between them, not the centimetres. ``python examples/paper`` computes the whole table;
this example has 4 random test sets and 2 hidden layers for each.
"""

import matplotlib.pyplot as plt
import numpy as np

from hybridkin import datasets, plots
from paper import table1

table = table1(datasets.load_trunk(), n_splits=4, n_seeds=2, n_jobs=1)

# %%
# Every model is fitted to 1500 rows of one moving segment and 400 random rows, and tested on the
# other 100 random rows.

PAPER = {
    "mechanical, nominal": 2.5,
    "data-driven, linear": 9.8,
    "data-driven, ELM": 3.4,
}
# Test error [cm]
PAPER |= {
    "hybrid on nominal, linear": 1.8,
    "hybrid on nominal, ELM": 1.3,
}

names = [f"{row['model']}, {row['learner']}".removesuffix(", -") for row in table]
for name, row in zip(names, table, strict=True):
    train, test = (100 * row[part]["mean"] for part in ("train", "test"))
    print(f"{name:28s} train {train:5.2f} cm, test {test:5.2f} cm")

# %%
# A short line shows a model that generalises. The data-driven models generalise worst, because they
# must also learn the geometry of the robot, which the mechanical model contains.

figure, ax = plt.subplots(figsize=(8.5, 4.6), layout="constrained")
places = np.arange(len(names))[::-1]
train, test = (100 * np.array([row[part]["mean"] for row in table]) for part in ("train", "test"))
tints = [plots.model_color(name) for name in names]
ax.hlines(places, train, test, color=tints, linewidth=2.5, alpha=0.5)
ax.scatter(
    train,
    places,
    facecolor="white",
    edgecolor=tints,
    s=45,
    zorder=3,
    label="training rows",
)
ax.scatter(test, places, color=tints, s=45, zorder=3, label="test rows")
known = [k for k, name in enumerate(names) if name in PAPER]
published = [PAPER[names[k]] for k in known]
ax.scatter(
    published,
    places[known],
    marker="x",
    color="black",
    label="paper, real robot, test rows",
)
ax.set_yticks(places, names)
ax.set(xlabel="mean tip error [cm]", xlim=(0, None))
ax.grid(axis="x", color="0.92")
ax.legend(frameon=False, loc="lower right")
plt.show()
