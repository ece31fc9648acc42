"""A NaN of any bits stays in its row: R's NA, negative and signalling ones."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from saved_models import FOLDER

from hybridkin import ELMRegressor, as_forward_model, load_model
from hybridkin.native.library import program_of

pytestmark = pytest.mark.needs_core
BITS = (0x7FF00000000007A2, 0xFFF8000000000000, 0x7FF0000000000001, 0xFFFFFFFFFFFFFFFF)
NANS = np.array(BITS, np.uint64).view(np.float64)
ACTIVATIONS = ("logistic", "tanh", "sin")
SAVED = (
    "chain",
    "elastic_chain",
    "structural_chain",
    "rigid",
    "parallel_elm",
    "parallel_kernel",
    "parallel_regression",
    "serial_pose",
    "data_only",
    "drift_and_radius",
    "rigid_hybrid",
)


def elm(activation):
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 3))
    regressor = ELMRegressor(9, activation=activation, random_state=0)
    return as_forward_model(regressor.fit(q, np.sin(q))), q


def saved(name):
    q = np.load(FOLDER / "predictions.npz")[f"{name}.q"]
    return as_forward_model(load_model(FOLDER / f"{name}.safetensors")), np.tile(q, (20, 1))


@pytest.mark.parametrize("name", [*ACTIVATIONS, *SAVED])
def test_a_row_of_any_nan_has_nan_and_others_do_not(name):
    model, q = (elm if name in ACTIVATIONS else saved)(name)
    q, program = q[:11], program_of(model)
    clean = program.evaluate(q, jacobian=True, distance=True)
    for j, nan in zip(
        np.arange(4 * q.shape[1]) % q.shape[1], np.tile(NANS, q.shape[1]), strict=True
    ):
        rows, row = q.copy(), 3 + j
        rows[row, j] = nan
        results = program.evaluate(rows, jacobian=True, distance=True)
        assert np.isnan(results[0][row]).all()
        assert np.isnan(results[1][row]).any()
        rows[row, j] = np.nan
        expected = program.evaluate(rows, jacobian=True, distance=True)
        with torch.no_grad():
            J = model.forward_and_jacobian(torch.from_numpy(rows))[1].numpy()
        assert_array_equal(np.isnan(results[1]), np.isnan(J))
        single = program.evaluate(rows[row], jacobian=True, distance=True)
        for array, right, alone, before in zip(results, expected, single, clean, strict=True):
            assert_array_equal(array, right)
            assert_array_equal(np.isnan(array[row]), np.isnan(alone))
            assert_array_equal(np.delete(array, row, 0), np.delete(before, row, 0))
