"""
Hold out motions, not rows
==========================

The rows of a log are not independent: neighbours belong to one motion and are millimetres apart. A
test on random held-out rows is therefore a test on rows nearly like those of the fit, and its error
is too small. This example tests the same models both ways, on the recording *ftdcr_v4* of a real
robot with nine tendons (66 motions) if it is available, else on a **simulated** log of the same
kind.
"""

import warnings

import matplotlib.pyplot as plt
import numpy as np
import torch
from sklearn.base import clone
from sklearn.kernel_ridge import KernelRidge
from sklearn.model_selection import GridSearchCV, GroupKFold, KFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils import Bunch

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    HybridForwardModel,
    datasets,
    plots,
)

RADII, LENGTHS = np.full(3, 0.0045), [0.06, 0.0625, 0.064]
ANGLES = np.array([[-3.03], [-2.52], [-2.01]]) + 2 * np.pi / 3 * np.arange(3)


def simulated_log(n_motions=60, n_rows=25, seed=0):
    """Return a log of tendons that go slack, with 0.3 mm noise on the tip."""
    rng = np.random.default_rng(seed)
    robot = ElasticTendonChain(
        RADII,
        LENGTHS,
        angles=ANGLES,
        bending_stiffness=0.15 * RADII**2,
        rest_bends=0.05,
    )
    bends = rng.normal(0.0, 0.5, (n_motions, 1, 3, 2)) * (rng.random((n_motions, 1, 3, 1)) < 0.6)
    way = np.sin(np.linspace(0.0, np.pi, n_rows))[None, :, None, None]
    # Out and back.
    bends = way * bends + rng.normal(0.0, 0.01, (n_motions, n_rows, 3, 2))
    towards = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)
    pull = np.einsum("mrsc,sac->mrsa", np.cumsum(bends, axis=2), towards)
    q = -RADII[:, None] * pull - 0.0003
    q = q.reshape(-1, 9)
    with torch.no_grad():
        x = robot(torch.from_numpy(q)).numpy() + rng.normal(0.0, 3e-4, (len(q), 3))
    return Bunch(q=q, x=x, groups=np.repeat(np.arange(n_motions), n_rows))


try:
    data, source = datasets.load_ftdcr(), "ftdcr_v4, a real robot"
except FileNotFoundError:
    data, source = simulated_log(), "a simulated robot"
q, x, groups = data.q[::2], data.x[::2], data.groups[::2]  # half of it, to be quick
print(f"{source}: {len(q)} rows, {len(np.unique(groups))} motions")

# %%
# A mechanical, a data-driven and a hybrid model. A search that holds out random rows chooses width
# and penalty of the kernel.

search = GridSearchCV(
    make_pipeline(StandardScaler(), KernelRidge(kernel="rbf")),
    {"kernelridge__gamma": [0.01, 0.1, 1.0], "kernelridge__alpha": [1e-4, 1e-3, 1e-2]},
    cv=KFold(5, shuffle=True, random_state=0),
).fit(q, x)
print("chosen by random rows:", search.best_params_)
kernel_ridge = search.best_estimator_
chain = ConstantCurvatureChain(RADII, angles=ANGLES, lengths=LENGTHS, routing="base")
parameters = ("base", "tool", "radii", "lengths")
models = {
    "mechanical, calibrated": HybridForwardModel(chain, "drop", calibrate=parameters),
    "data-driven, kernel ridge": HybridForwardModel(None, kernel_ridge, guard=None),
    "hybrid, kernel ridge": HybridForwardModel(chain, kernel_ridge, calibrate=parameters),
}


def held_out(model, folds):
    """Return the tip error (N,) of every row when it was held out [m]."""
    errors = np.empty(len(q))
    for train, test in folds:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of the slack in this log
            predicted = clone(model).fit(q[train], x[train]).predict(q[test])
        errors[test] = np.linalg.norm(predicted - x[test], axis=1)
    return errors


# %%
# Five folds, once of random rows and once of whole motions.

ways = {
    "held-out random rows": list(KFold(5, shuffle=True, random_state=0).split(q)),
    "held-out motions": list(GroupKFold(5).split(q, groups=groups)),
}
figure, axes = plt.subplots(1, 2, figsize=(11, 3.4), sharex=True, sharey=True, layout="constrained")
for ax, (way, folds) in zip(axes, ways.items(), strict=True):
    errors = {name: held_out(model, folds) for name, model in models.items()}
    for name, values in errors.items():
        print(f"{way}, {name}: mean {1e3 * values.mean():.1f} mm, max {1e3 * values.max():.0f}")
    plots.ErrorBoxDisplay(errors).plot(ax, unit="mm", log=True)
    ax.set_title(way)
axes[0].set_xlim(0.3, 300)
axes[0].set_xticks([1, 10, 100], ["1", "10", "100"])
axes[1].set_ylabel("")
plt.show()
