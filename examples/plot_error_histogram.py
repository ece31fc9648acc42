"""
Where a model errs, and by how much
===================================

The error histogram of the paper (Fig. 2), before and after learning, and the same errors where they
occur in the workspace. **Simulated** trunk; test rows that had no part in the fit.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch

from hybridkin import HybridForwardModel, datasets, plots, robots

data = datasets.load_trunk()
random = np.flatnonzero(data.part == 3)  # rows with all nine chambers at random
train = np.flatnonzero(data.part != 3)
train, test = np.concatenate([train, random[::2]]), random[1::2]
chain = robots.bionic_handling_assistant()
models = {
    "mechanical, nominal": HybridForwardModel(chain, "drop"),
    "mechanical, calibrated": HybridForwardModel(chain, "drop", calibrate="default"),
    "hybrid, serial": HybridForwardModel(chain, "quadratic", coupling="serial", calibrate="default"),
}
found = {
    name: model.fit(data.q[train], data.x[train]).predict(data.q[test])
    for name, model in models.items()
}

# %%
# Calibration takes away what radii and base explain, learning a good part of the rest.

display = plots.ErrorHistogramDisplay.from_predictions(data.x[test], found)
for name, errors in display.errors.items():
    print(f"{name}: mean {100 * errors.mean():.2f} cm, largest {100 * errors.max():.1f} cm")
figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
display.plot(ax)
plt.show()

# %%
# Where they occur, both on one scale: the nominal model errs by centimetres all over the workspace,
# most on one side, for the trunk is tilted and weighs something; the line joins the worst pair.

worst = int(display.errors["mechanical, nominal"].argmax())
with torch.no_grad():
    backbone = chain.backbone(torch.from_numpy(data.q[test][worst]))
figure = plt.figure(figsize=(11, 4.8), layout="constrained")
for k, name in enumerate(("mechanical, nominal", "hybrid, serial"), 1):
    ax = figure.add_subplot(1, 2, k, projection="3d")
    plots.WorkspaceDisplay(data.x[test], found[name], backbone, worst).plot(ax)
    ax.collections[0].set_clim(0, 6)
    ax.set_title(name)
plt.show()
