"""What the figures of the commands show, in the words and units of the user."""

import warnings

import numpy as np
import pytest
import torch

from hybridkin import HybridForwardModel, plots, robots, save_model
from hybridkin.workflow import open_model, path_limits, shape_path, track_path

ROBOT = """name = "arm"
routing = "base"
[[segment]]
radius = 0.01
length = 0.1
repeat = 2
[log]
q = ["left", "right", "up", "a", "b", "c"]
x = ["x", "y", "z"]
q_unit = "mm"
x_unit = "mm"
q_sign = -1
[limits]
q_min = -0.008
q_max = 0.006
"""


def folder(tmp_path, held_out):
    (tmp_path / "robot.toml").write_text(ROBOT, encoding="utf-8")
    chain = robots.from_toml(tmp_path / "robot.toml")
    q = np.random.default_rng(0).uniform(-0.007, 0.007, (60, 2, 3))
    q = (q - q.mean(axis=2, keepdims=True)).reshape(60, 6).clip(-0.008, 0.006)
    with torch.no_grad():
        x = chain(torch.from_numpy(q)).numpy()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of tendons that contradict each other
        model = HybridForwardModel(chain, "linear").fit(q, x + np.array([0.0, 0.003, 0.0]))
    promise = {"at_rows": held_out["mean"], "per_distance": 0.0, "p95": 2.25}
    training = {"saved": "hybrid, linear", "promise": promise}
    save_model(model, tmp_path / "model.safetensors", training=training)
    return open_model(tmp_path)


def test_a_model_says_what_it_is_and_what_error_to_expect(tmp_path):
    loaded = folder(tmp_path, {"mean": 0.004, "p95": 0.009})
    assert loaded.kind == "hybrid, linear"
    expected = loaded.expected_errors(np.zeros((3, 6)))
    assert [*expected] == ["held-out motions, mean", "held-out motions, 95 %"]
    np.testing.assert_allclose([*expected.values()], [[0.004] * 3, [0.009] * 3])
    nominal = open_model(tmp_path / "robot.toml")
    assert nominal.kind == "mechanical, nominal"
    assert nominal.expected_errors(np.zeros((3, 6))) == {}


@pytest.mark.slow
def test_figures_of_a_track_are_in_the_words_of_the_user(tmp_path, monkeypatch):
    loaded, figures = folder(tmp_path, {"mean": 0.004, "p95": 0.009}), []

    def kept(*args, **options):
        figures.append(new_figure(*args, **options))
        return figures[-1]

    new_figure = plots.new_figure
    monkeypatch.setattr(plots, "new_figure", kept)
    path = shape_path(loaded, path_limits(loaded), "figure-eight", (0.02, 0.01), dt=0.5)
    track_path(loaded, path, tmp_path / "out")
    (_, track), (_, commands) = figures
    labels = [text.get_text() for text in track[2].get_legend().get_texts()]
    assert labels[0].startswith("solver on hybrid, linear: mean error")
    assert labels[1:] == [
        "robot, held-out motions, mean: 4 mm",
        "robot, held-out motions, 95 %: 9 mm",
    ]
    first = commands[0, 0]
    labels = [text.get_text() for text in first.get_legend().get_texts()]
    assert labels == ["left", "right", "up", "limits"]
    assert first.get_ylabel() == "segment 1 [mm]"
    sent = np.genfromtxt(
        tmp_path / "out" / "track.csv", delimiter=",", names=True, encoding="utf-8", dtype=None
    )["left"]
    np.testing.assert_allclose(first.lines[0].get_ydata(), sent, atol=1e-6)
    ends = {round(float(s[0, 1]), 6) for s in first.collections[0].get_segments()}
    assert min(ends) >= -6.0  # of pulled tendons as positive numbers of millimetres
    assert max(ends) <= 8.0
    assert max(ends) > 7.0
