"""
How many rows does it take?
===========================

Measured rows cost time at the robot. This example compares models with 20 to 250 training rows of
the **simulated** trunk, all nine chambers at random. The errors are those of 250 other rows. Their
own noise (1 mm on the lengths) keeps every model above about 8 mm.
"""

import warnings

import matplotlib.pyplot as plt
import numpy as np
from sklearn.kernel_ridge import KernelRidge
from sklearn.model_selection import GridSearchCV, LearningCurveDisplay, ShuffleSplit
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from hybridkin import HybridForwardModel, datasets, robots

data = datasets.load_trunk()
rows = np.flatnonzero(data.part == 3)
chain = robots.bionic_handling_assistant()


def kernel_ridge():
    """Return kernel ridge whose width and penalty are chosen by three folds."""
    ridge = make_pipeline(StandardScaler(), KernelRidge(kernel="rbf"))
    grid = {
        "kernelridge__gamma": [0.003, 0.01, 0.03],
        "kernelridge__alpha": [1e-3, 1e-2],
    }
    return GridSearchCV(ridge, grid, scoring="neg_mean_squared_error", cv=3)


def mean_error(model, q, x):
    """Return the mean distance of predicted and measured tips [mm]."""
    return 1e3 * np.linalg.norm(model.predict(q) - x, axis=1).mean()


models = {
    "data-driven, kernel ridge": HybridForwardModel(None, kernel_ridge(), guard=None),
    "mechanical, calibrated": HybridForwardModel(chain, "drop", calibrate="default"),
    "hybrid, kernel ridge at the tip": HybridForwardModel(
        chain, kernel_ridge(), calibrate="default"
    ),
    "hybrid, serial, pose features": HybridForwardModel(
        chain, "pose", coupling="serial", calibrate="default"
    ),
}

# %%
# Every model gets the same rows, three draws of each size, by scikit-learn's learning curves. A fit
# to few rows warns where the regressor makes the mechanical model worse; here the curves show it.

warnings.filterwarnings("ignore", "`error_model` makes the mechanical model worse")
split = ShuffleSplit(3, test_size=250, random_state=0)
figure, ax = plt.subplots(figsize=(8, 5.0), layout="constrained")
for name, model in models.items():
    display = LearningCurveDisplay.from_estimator(
        model,
        data.q[rows],
        data.x[rows],
        train_sizes=[20, 30, 60, 120, 250],
        cv=split,
        scoring=mean_error,
        score_type="test",
        score_name="mean tip error [mm]",
        ax=ax,
    )
    display.lines_[0].set_label(name)
    with_60, with_250 = display.test_scores.mean(axis=1)[[2, 4]]
    print(f"{name}: {with_60:.1f} mm with 60 rows, {with_250:.1f} mm with 250")

# %%
# With few rows the calibrated mechanical model is nearly the best. The serial hybrid, which
# corrects the robot inside, needs the fewest rows to improve on it.

ax.set(xscale="log", yscale="log", xlabel="training rows")
ax.legend()
plt.show()
