"""Tendons that go slack
=====================

On a real robot with nine tendons a plain constant-curvature chain errs by centimetres where tendons
are slack. `ElasticTendonChain` describes that a tendon can only pull. Every row is predicted by
models that were fitted without its motion. The recording is not part of the package (its source:
``help(hybridkin.datasets.load_ftdcr)``). Without it this example stops, and the picture is that of
:doc:`another run </how_to/slack_tendons>`.

.. image:: /images/slack_tendons.png
   :alt: Tip error of every row of held-out motions, before and after
"""

# sphinx_gallery_thumbnail_path = "images/slack_tendons.png"

import warnings

import matplotlib.pyplot as plt
import numpy as np
import torch
from joblib import Parallel, delayed
from sklearn.base import clone
from sklearn.kernel_ridge import KernelRidge
from sklearn.model_selection import GroupKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    HybridForwardModel,
    calibrate,
    datasets,
)

RADII = np.full(3, 0.0045)
GEOMETRY = {
    "lengths": [0.06, 0.0625, 0.064],
    "angles": np.array([[-3.03], [-2.52], [-2.01]]) + 2 * np.pi / 3 * np.arange(3),
    "routing": "base",
}
STIFFNESS = {"bending_stiffness": 0.15 * RADII**2, "axial_stiffness": 10.0}
PLAIN = ("base", "tool", "radii", "lengths")
ELASTIC = (
    *("base", "tool", "rest_bends"),
    *("bending_stiffness", "axial_stiffness", "tendon_zeros"),
)
NAMES = {"tendon": "one\ntendon", "seg1": "segment\n1", "seg2": "segment\n2"}
NAMES |= {
    "seg3": "segment\n3",
    "pair12": "segments\n1 and 2",
    "pair13": "segments\n1 and 3",
}
NAMES |= {"pair23": "segments\n2 and 3"}
MODELS = ("plain", "plain + kernel", "elastic", "elastic + kernel")
MODELS += ("elastic + play", "elastic + play + kernel")


def fitted(chain, q, x, parameters):
    """Return the calibrated chain."""
    return calibrate(chain, q, x, parameters, loss="soft_l1").chain


def tips(chain, q):
    """Return the tips (N, 3) of a chain [m]."""
    with torch.no_grad():
        return chain(torch.as_tensor(q)).numpy()


def with_kernel(chain, q, x, groups):
    """Return chain + kernel ridge on all displacements, tuned by held-out motions."""
    error, best = x - tips(chain, q), (np.inf, None)
    splits = list(GroupKFold(min(4, len(np.unique(groups)))).split(q, groups=groups))
    for gamma in (0.003, 0.01, 0.03, 0.1, 0.3):
        for alpha in (0.01, 0.1, 1.0, 10.0):
            ridge = make_pipeline(
                StandardScaler(), KernelRidge(kernel="rbf", gamma=gamma, alpha=alpha)
            )
            square = sum(
                ((clone(ridge).fit(q[a], error[a]).predict(q[b]) - error[b]) ** 2).sum()
                for a, b in splits
            )
            best = min(best, (square, ridge), key=lambda pair: pair[0])
    return HybridForwardModel(chain, best[1]).fit(q, x)


def without_warnings(*args):
    """Return `predictions` without warnings: the plain chain warns of slack tendons."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return predictions(*args)


def predictions(data, train, test, models=MODELS, angles=True, thin=1):
    """Return the tips (len(test), 3) that each model predicts, slack rows, and the play [m]."""
    turns = ("angles",) if angles else ()
    q, x, groups = data.q, data.x, data.groups
    some, found = train[::thin], {}
    plain = elastic = ElasticTendonChain(RADII, **GEOMETRY, **STIFFNESS)
    if "plain" in models:
        plain = ConstantCurvatureChain(RADII, **GEOMETRY)
        plain = fitted(plain, q[some], x[some], (*PLAIN, *turns))
        found["plain"] = tips(plain, q[test])
    elastic = fitted(elastic, q[some], x[some], (*ELASTIC, *turns))
    found["elastic"] = tips(elastic, q[test])
    found["slack"] = elastic.slack(torch.as_tensor(q[test])).numpy()
    for name, chain in (("plain + kernel", plain), ("elastic + kernel", elastic)):
        if name in models:
            model = with_kernel(chain, q[train], x[train], groups[train])
            found[name] = model.predict(q[test])
    if "elastic + play" in models:
        search = HybridForwardModel(elastic, "drop", hysteresis="auto")
        search.fit(q[train], x[train], groups=groups[train])
        hysteresis = search.hysteresis_
        y = hysteresis.apply_by_group(q, groups)
        chain = fitted(elastic, y[train], x[train], ELASTIC)
        found["elastic + play"] = tips(chain, y[test])
        found["play"] = float(np.max(hysteresis.width))
        model = with_kernel(chain, y[train], x[train], groups[train])
        found["elastic + play + kernel"] = model.predict(y[test])
    return found


def splits_of(data, seeds=5):
    """Return the ways to hold motions out: name -> list of (train, test) rows."""
    motions, rows = np.unique(data.groups), np.arange(len(data.q))
    single, pair = (np.char.find(data.groups, word) >= 0 for word in ("_seg", "_pair"))
    ways = {
        "5 folds": list(GroupKFold(5).split(data.q, groups=data.groups)),
        "pairs from single segments": [(rows[single], rows[pair])],
        "pairs from single segments and tendons": [(rows[~pair], rows[pair])],
    }
    for n in (20, 10):
        drawn = [np.random.default_rng(k).permutation(motions)[:n] for k in range(seeds)]
        known = [np.isin(data.groups, some) for some in drawn]
        ways[f"{n} motions"] = [(rows[k], rows[~k]) for k in known]
    return ways


def compare_tendon_models(
    data_home=None,
    ways=("5 folds",),
    models=MODELS,
    *,
    angles=True,
    thin=1,
    seeds=5,
    n_jobs=1,
):
    """Return for each way of holding motions out the list of (test rows, predictions) by split."""
    data, found = datasets.load_ftdcr(data_home), {}
    for way in ways:
        splits = splits_of(data, seeds)[way]
        jobs = (delayed(without_warnings)(data, *split, models, angles, thin) for split in splits)
        results = Parallel(n_jobs=n_jobs)(jobs)
        found[way] = [(test, one) for (_, test), one in zip(splits, results, strict=True)]
    return data, found


def draw(data, results):
    """Return the figure: tip error of every row, held out, before and after."""
    slack, errors = np.zeros(len(data.q), int), np.zeros((2, len(data.q)))
    for test, found in results:
        slack[test] = found["slack"].sum(1)
        for k, name in enumerate(("plain", "elastic")):
            errors[k, test] = 1e3 * np.linalg.norm(found[name] - data.x[test], axis=1)
    kinds = np.array([label.split("_")[1] for label in data.groups])
    kinds[np.char.startswith(kinds, "tendon")] = "tendon"
    edges = np.flatnonzero(kinds[1:] != kinds[:-1]) + 1
    parts = np.split(np.arange(len(kinds)), edges)
    figure, axes = plt.subplots(
        2, figsize=(8.0, 5.4), layout="constrained", sharex=True, sharey=True
    )
    titles = (
        "Constant-curvature chain, calibrated",
        "Elastic chain, tendons that can only pull",
    )
    for ax, error, title in zip(axes, errors, titles, strict=True):
        for part in parts[::2]:
            ax.axvspan(part[0], part[-1] + 1, color="0.92", linewidth=0)
        for many, color, label in (
            (slack < 4, "#56B4E9", "at most 3 of 9 tendons slack"),
            ((slack >= 4) & (slack < 7), "#0072B2", "4 to 6 slack"),
            (slack >= 7, "#D55E00", "7 or more slack"),
        ):
            rows = np.flatnonzero(many)
            ax.plot(rows, error[rows], ".", markersize=3.5, color=color, label=label)
        ax.axhline(error.mean(), color="black", linewidth=1.0, linestyle="--", label="mean")
        title = f"{title}: mean {error.mean():.1f} mm, largest {error.max():.0f} mm"
        ax.set_title(title, loc="left", fontsize="medium")
        ax.set(ylabel="tip error, motion held out [mm]", yscale="log", xlim=(0, len(kinds)))
        ax.set(ylim=(0.08, 130))
        ax.set_yticks([0.3, 1, 3, 10, 30, 100], ["0.3", "1", "3", "10", "30", "100"])
        ax.minorticks_off()
    for part in parts:
        axes[1].text(part.mean(), 0.095, NAMES[kinds[part[0]]], ha="center", fontsize="small")
    axes[0].legend(ncols=4, fontsize="small", loc="upper right", markerscale=2.5)
    axes[1].set(xlabel="row, in the order of time")
    return figure


try:
    data, found = compare_tendon_models(models=("plain", "elastic"), angles=False, thin=2)
except FileNotFoundError as missing:
    print(f"Skipped: {missing}")
else:
    figure = draw(data, found["5 folds"])
    plt.show()
