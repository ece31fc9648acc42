"""
Choosing a model with scikit-learn
==================================

`HybridForwardModel` is a scikit-learn regressor: cross-validation, grid search, pipelines and
``clone`` accept it, and every fold calibrates anew. The log of the **simulated** trunk holds single
configurations, no motions. Here neighbouring configurations form a group, so that a model is tested
on configurations unlike those of its fit.
"""

import warnings

import matplotlib.pyplot as plt
import numpy as np
from sklearn.cluster import KMeans
from sklearn.linear_model import LinearRegression
from sklearn.metrics import make_scorer
from sklearn.model_selection import GridSearchCV, GroupKFold, cross_val_score

from hybridkin import ELMRegressor, HybridForwardModel, datasets, plots, robots

data = datasets.load_trunk()
rows = np.flatnonzero(data.part == 3)[:300]
q, x = data.q[rows], data.x[rows]
groups = KMeans(30, n_init=1, random_state=0).fit_predict(q)


def mean_distance(x_true, x_predicted):
    """Return the mean tip error [mm]."""
    return 1e3 * np.linalg.norm(x_true - x_predicted, axis=1).mean()


score = make_scorer(mean_distance, greater_is_better=False)
folds = GroupKFold(3)

# %%
# Any regressor can be the error model. ``cross_val_score`` with groups tests the sum.

chain = robots.bionic_handling_assistant()
candidates = {
    "mechanical": HybridForwardModel(chain, "drop", calibrate="default"),
    "linear error": HybridForwardModel(chain, LinearRegression(), calibrate="default"),
    "ELM error": HybridForwardModel(chain, calibrate="default", random_state=0),
}
for name, model in candidates.items():
    errors = -cross_val_score(model, q, x, groups=groups, cv=folds, scoring=score)
    print(f"{name}: {errors.mean():.1f} mm, folds {errors.min():.1f} to {errors.max():.1f}")

# %%
# A grid over the coupling and over parameters of the network. With small penalties, networks make
# the mechanical model worse, and each such fit warns; here the scores show it.

warnings.filterwarnings("ignore", "`error_model` makes the mechanical model worse")
model = HybridForwardModel(chain, ELMRegressor(random_state=0), calibrate="default")
grid = {
    "coupling": ["parallel", "serial"],
    "error_model__n_hidden": [25, 100],
    "error_model__alpha": np.geomspace(1e-4, 10.0, 4),
}
search = GridSearchCV(model, grid, cv=folds, scoring=score).fit(q, x, groups=groups)
print("best:", search.best_params_, f"{-search.best_score_:.1f} mm")

# %%
# The coupling matters most. The penalty matters more than the size of the network.

results = search.cv_results_
coupling = np.array(results["param_coupling"], dtype=str)
size = np.array(results["param_error_model__n_hidden"], dtype=int)
alpha = np.array(results["param_error_model__alpha"], dtype=float)
figure, ax = plt.subplots(figsize=(8, 4.4), layout="constrained")
for where in ("parallel", "serial"):
    color = plots.model_color(where)
    for n_hidden, style in ((25, "o--"), (100, "s-")):
        some = (coupling == where) & (size == n_hidden)
        mean, spread = (
            -results["mean_test_score"][some],
            results["std_test_score"][some],
        )
        ax.plot(alpha[some], mean, style, color=color, label=f"{where}, {n_hidden} neurons")
        if n_hidden == 100:
            ax.fill_between(
                alpha[some],
                mean - spread,
                mean + spread,
                color=color,
                alpha=0.15,
                linewidth=0,
            )
ax.set(
    xscale="log",
    xlabel="penalty of the network",
    ylabel="mean tip error, held-out groups [mm]",
)
ax.legend(frameon=False)
ax.set_ylim(bottom=0)
plt.show()
