"""What the figures of the commands show, in the words and units of the user."""

import warnings

import numpy as np
import pytest
import torch

from hybridkin import HybridForwardModel, open_model, robots, save_model
from hybridkin.app.workflow.model import expected_errors, kind_of
from hybridkin.app.workflow.report import error_in_millimetres, lengths_for_table

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
    chain = robots.read_description(tmp_path / "robot.toml").chain
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
    assert kind_of(loaded) == "hybrid, linear"
    expected = expected_errors(loaded, np.zeros((3, 6)))
    assert [*expected] == ["expected on this path", "95 % below, on this path"]
    np.testing.assert_allclose([*expected.values()], [[0.004] * 3, [0.009] * 3])
    nominal = open_model(tmp_path / "robot.toml")
    assert kind_of(nominal) == "mechanical, nominal"
    assert expected_errors(nominal, np.zeros((3, 6))) == {}


@pytest.mark.parametrize(
    ("unit", "cells"),
    [
        ("mm", ["22.563168", "0", "0.000001", "nan", "100"]),
        ("m", ["0.022563168", "0", "0.000000001", "nan", "0.1"]),
    ],
)
def test_files_give_lengths_to_a_millionth_of_a_millimetre(unit, cells):
    lengths = np.array([0.0225631683123, -1e-13, 9.93567519e-10, np.nan, 0.1])
    assert lengths_for_table(lengths, unit).tolist() == cells


def test_an_error_of_a_solver_below_a_micrometre_has_no_digits():
    shown = [error_in_millimetres(error) for error in (0.0, 5.14e-10, 1.23e-6, 4.5678e-3)]
    assert shown == ["0 mm", "below 0.001 mm", "0.00123 mm", "4.57 mm"]
