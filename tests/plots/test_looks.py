"""What a reader sees: colours that mean the same, legends off the data, bodies that end at tips."""

import numpy as np
import pytest
import torch
from matplotlib.colors import to_hex
from matplotlib.text import Text

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
    assert {*names} <= {line.label for line in film.lines()}
    np.testing.assert_array_equal(film.error, expected)
    assert film.caption(2, "mm") == "step 2, expected error 3.00 mm"
    with pytest.raises(ValueError, match="`names` must hold 9 names"):
        plots.TrackAnimation.from_estimator(chain, q, names=names[:3])


# Everything that a legend names has a look of its own


def look_of(artist):
    """Return what a reader tells a line by: colour, dashes, width and marker."""
    dashes = artist._unscaled_dash_pattern
    color = to_hex(artist.get_color())
    return color, str(dashes), artist.get_linewidth(), artist.get_marker()


def looks_in(ax):
    return [look_of(line) for line in ax.lines if line.get_label()[0] != "_"]


@pytest.mark.parametrize("counts", [(3, 3, 3), (4, 4, 4, 4), (2, 3), (3,) * 8, (6,)])
def test_actuators_target_tip_and_error_look_different(counts):
    lengths = len(counts) * [0.1]
    radii = len(counts) * [0.02]
    chain = ConstantCurvatureChain(radii, n_actuators=counts, lengths=lengths, routing="base")
    q = np.random.default_rng(0).uniform(-0.003, 0.003, (6, sum(counts)))
    names = [f"q{k}" for k in range(sum(counts))]
    target = np.zeros((6, 3))
    for labels in (names, ()):
        film = plots.TrackAnimation.from_estimator(chain, q, target=target, names=labels)
        _, ax = plots.new_figure(4, 4, subplot_kw={"projection": "3d"})
        looks = looks_in(film.plot(ax).ax_)
        assert len(looks) == sum(counts) + 6  # target, path, backbone, error, target now, tip
        assert len({*looks}) == len(looks)
        colors = [line.color for line in film.lines() if line.label.startswith("q")]
        kept = {to_hex("black"), *(to_hex(line.get_color()) for line in ax.lines[:2])}
        assert not kept & {*map(to_hex, colors)}


@pytest.mark.parametrize("models", [("command",), ("command", "actuator"), ("a", "b", "c")])
@pytest.mark.parametrize("names", [None, ["p", "q", "r", "s", "t", "u"]])
def test_commands_look_different_and_the_legend_names_them_all(models, names):
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 6))
    limits = np.stack([q.min(axis=0), q.max(axis=0)])
    display = plots.ActuatorDisplay(
        {name: q + k for k, name in enumerate(models)}, (3, 3), names=names, limits=limits
    )
    _, axes = plots.new_figure(6, 4, 2, 1)
    for ax in axes:
        ax.axvline(0.5, color="0.6", label="start")
    display.plot(axes)
    for k, ax in enumerate(axes):
        looks = looks_in(ax)
        assert len({*looks}) == len(looks)
        words = [text.get_text() for text in ax.get_legend().get_texts()]
        everything = {line.get_label() for line in ax.lines} | {"limits"}
        assert sorted(words) == sorted(everything)  # each once
        if names:
            assert {*names[3 * k : 3 * k + 3]} <= {*words}


# Labels


def oriented_boxes(figure):
    """Return the corners (4, 2) of every text that is drawn last, by text."""
    boxes = {}
    draw = Text.draw

    def noted(text, renderer, *rest, **options):
        draw(text, renderer, *rest, **options)
        if text.get_visible() and text.get_text().strip():
            boxes[text] = corners(text, renderer)

    Text.draw = noted
    try:
        figure.draw_without_rendering()
    finally:
        Text.draw = draw
    return boxes


def corners(text, renderer):
    around = text.get_window_extent(renderer)
    degrees = text.get_rotation()
    text.set_rotation(0.0)
    flat = text.get_window_extent(renderer)
    text.set_rotation(degrees)
    turn = np.exp(1j * np.radians(degrees))
    half = 0.5 * (flat.width + 1j * flat.height)
    middle = complex(around.x0 + around.x1, around.y0 + around.y1) / 2.0
    ends = middle + turn * np.array([-half, half.conjugate(), half, -half.conjugate()])
    return np.stack([ends.real, ends.imag], axis=1)


def overlap(one, other):
    """Return whether two rectangles overlap: no line along a side separates them."""
    for box in (one, other):
        for k in range(2):
            side = box[k + 1] - box[k]
            a, b = one @ side, other @ side
            if a.max() <= b.min() or b.max() <= a.min():
                return False
    return True


def overlapping(figure):
    boxes = [*oriented_boxes(figure).items()]
    pairs = []
    for i, (text, box) in enumerate(boxes):
        for other, its_box in boxes[:i]:
            if overlap(box, its_box):
                pairs.append((text.get_text(), other.get_text()))
    return pairs


def test_two_texts_at_one_place_overlap():
    figure, ax = plots.new_figure(4, 4)
    ax.text(0.5, 0.5, "one", rotation=30.0)
    ax.text(0.5, 0.5, "other")
    assert overlapping(figure) == [("other", "one")]


@pytest.mark.parametrize("unit", ["m", "cm", "mm"])
@pytest.mark.parametrize("size", [0.005, 0.07, 0.9, 20.0])
def test_labels_of_a_workspace_are_clear_of_each_other(size, unit):
    rng = np.random.default_rng(0)
    x = size * rng.uniform((-0.5, -0.4, 0.4), (0.5, 0.6, 1.0), (200, 3))
    body = size * np.linspace((0.0, 0.0, 0.0), (0.1, 0.2, 0.7), 20)
    figure, ax = plots.new_figure(6.4, 5.2, subplot_kw={"projection": "3d"})
    plots.WorkspaceDisplay(x, x + 0.01 * size, body, row=5).plot(ax, unit=unit)
    assert overlapping(figure) == []
    assert all(len(axis.get_majorticklocs()) for axis in (ax.xaxis, ax.yaxis, ax.zaxis))
