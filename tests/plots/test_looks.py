"""What a reader sees: colours that mean the same, legends off the data, bodies that end at tips."""

import numpy as np
import pytest
import torch
from matplotlib.colors import to_hex

from hybridkin import ConstantCurvatureChain, HybridForwardModel, plots, robots

NAMES = (
    *("mechanical, nominal", "mechanical, calibrated", "data-driven, ELM"),
    *("hybrid, ELM", "hybrid, serial", "hybrid, auto"),
)
TRACK = np.random.default_rng(0).normal(0.0, 0.2, (20, 3))


def errors(names):
    rng = np.random.default_rng(1)
    return {name: 0.01 * rng.lognormal(size=200) for name in names}


def boxes(names, ax):
    plots.ErrorBoxDisplay(errors(names)).plot(ax)
    return [to_hex(patch.get_facecolor()).upper() for patch in ax.patches]


def outlines(names, ax):
    plots.ErrorHistogramDisplay(errors(names)).plot(ax)
    return [to_hex(patch.get_edgecolor()).upper() for patch in ax.patches[1::2]]


def paths(names, ax):
    plots.TrackingDisplay(TRACK, {name: TRACK + 0.01 for name in names}).plot(ax)
    return [to_hex(line.get_color()).upper() for line in ax.lines[: len(names)]]


@pytest.mark.parametrize("draw", [boxes, outlines, paths])
def test_a_model_has_the_same_colour_in_every_figure(draw):
    expected = [plots.model_color(name) for name in NAMES]
    assert len({*expected}) == len(NAMES)
    _, axes = plots.new_figure(8, 4, 1, 2)
    assert draw(NAMES, axes[0]) == expected
    assert draw(NAMES[::-2], axes[1]) == expected[::-2]  # whatever stands beside it


# Bodies


@pytest.fixture(scope="module")
def bent_inside():
    """Return a chain whose error acts inside, rows of it, and its fitted serial hybrid."""
    chain = ConstantCurvatureChain([0.02, 0.018], lengths=[0.1, 0.1], routing="base")
    q = np.random.default_rng(0).uniform(-0.006, 0.006, (80, 2, 3))
    q = (q - q.mean(axis=2, keepdims=True)).reshape(80, 6)
    with torch.no_grad():
        x = chain(torch.from_numpy(1.5 * q)).numpy()
    model = HybridForwardModel(chain, "quadratic", coupling="serial", guard=None).fit(q, x)
    return chain, q, model


def test_a_serial_body_ends_where_the_model_puts_the_tip(bent_inside):
    chain, q, model = bent_inside
    predicted = model.predict(q[:5])
    with torch.no_grad():
        away = np.linalg.norm(chain(torch.from_numpy(q[:5])).numpy() - predicted, axis=1)
    assert away.max() > 5e-3
    body = plots.BackboneDisplay.from_estimator(model, q[:5])
    np.testing.assert_allclose(body.points[:, -1], predicted, atol=1e-7)
    np.testing.assert_allclose(body.tips, predicted, atol=1e-7)
    assert "learned correction" not in [line.label for line in body.lines()]
    film = plots.TrackAnimation.from_estimator(model, q[:5])
    (backbone,) = [line for line in film.lines() if line.label == "backbone"]
    np.testing.assert_allclose(backbone.points[:, -1], film.x, atol=1e-7)


def test_films_show_names_of_actuators_and_the_error_to_expect():
    chain = robots.bionic_handling_assistant()
    q, names = np.full((4, 9), 0.25), [f"chamber {i}" for i in range(9)]
    expected = 1e-3 * np.arange(1.0, 5.0)
    target = np.zeros((4, 3))
    film = plots.TrackAnimation.from_estimator(
        chain, q, target=target, expected=expected, names=names
    )
    shown = {line.label: line.color for line in film.lines()}
    assert {*names} <= {*shown}
    assert len({shown[name] for name in names}) == 8
    np.testing.assert_array_equal(film.error, expected)
    assert film.caption(2, "mm") == "step 2, expected error 3.00 mm"
    with pytest.raises(ValueError, match="`names` must hold 9 names"):
        plots.TrackAnimation.from_estimator(chain, q, names=names[:3])
