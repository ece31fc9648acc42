"""
Where a model errs, and by how much
===================================

The error histogram of the paper (Fig. 2) before and after learning, and the same errors in the
workspace. The trunk is **simulated**; the rows are held out.
"""

# sphinx_gallery_thumbnail_number = 2

import matplotlib.pyplot as plt
import numpy as np

from hybridkin import HybridForwardModel, datasets, plots, robots

data = datasets.load_trunk()
random = np.flatnonzero(data.part == 3)  # rows with all nine chambers at random
train = np.flatnonzero(data.part != 3)
train, test = np.concatenate([train, random[::2]]), random[1::2]
chain = robots.bionic_handling_assistant()
models = {
    "mechanical, nominal": HybridForwardModel(chain, "drop"),
    "mechanical, calibrated": HybridForwardModel(chain, "drop", calibrate="default"),
    "hybrid, serial": HybridForwardModel(
        chain, "quadratic", coupling="serial", calibrate="default"
    ),
}
found = {
    name: model.fit(data.q[train], data.x[train]).predict(data.q[test])
    for name, model in models.items()
}

# %%
# Calibration removes the error of radii and base. Learning removes a good part of the rest.

display = plots.ErrorHistogramDisplay.from_predictions(data.x[test], found)
for name, errors in display.errors.items():
    print(f"{name}: mean {100 * errors.mean():.2f} cm, largest {100 * errors.max():.1f} cm")
figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
display.plot(ax)
plt.show()

# %%
# Both pictures have one colour scale. The nominal model errs by centimetres in the whole workspace,
# most on one side, because the trunk is tilted and has a weight. The line joins the measured and
# the predicted tip of the row with the largest error. Each robot ends at the tip that its model
# predicts.

worst = int(display.errors["mechanical, nominal"].argmax())
figure = plt.figure(figsize=(11, 5.2), layout="constrained")
for k, name in enumerate(("mechanical, nominal", "hybrid, serial"), 1):
    ax = figure.add_subplot(1, 2, k, projection="3d")
    body = plots.BackboneDisplay.from_estimator(models[name], data.q[test][worst])
    plots.WorkspaceDisplay(data.x[test], found[name], body.points[0], worst).plot(ax)
    ax.collections[0].set_clim(0, 6)
    ax.set_title(name)
plt.show()
