"""Which parameters of the geometry a fit calibrates, and what a description of it holds."""

from types import SimpleNamespace

import numpy as np
import pytest

from hybridkin.hybrid._error_models import Blend, NoCorrection
from hybridkin.hybrid._fit import Spec, with_geometry_chosen
from hybridkin.hybrid._readout_fit import ReadoutFit
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid.description import training_of

ROWS = Rows(np.zeros((2, 1)), np.zeros((2, 3)))
DROP = NoCorrection()
GEOMETRY = SimpleNamespace(chain=None, parameters=("radii",), messages=("said",))


@pytest.mark.parametrize(("error_model", "calibrate"), [(None, ()), (DROP, ()), (DROP, ("base",))])
def test_nothing_is_chosen_where_nothing_is_open(error_model, calibrate):
    """Neither without a calibration, nor for given parameters of a given error model."""
    spec = Spec(None, error_model, calibrate)
    assert with_geometry_chosen(spec, ROWS, GEOMETRY) is spec  # pyright: ignore


@pytest.mark.parametrize(
    ("error_model", "calibrate"), [(None, "auto"), (DROP, "auto"), (None, ("base",))]
)
def test_the_chosen_geometry_is_taken_with_its_warnings(error_model, calibrate):
    """With calibrate="auto", and for given parameters if the error model is open."""
    found = with_geometry_chosen(Spec(None, error_model, calibrate), ROWS, GEOMETRY)  # pyright: ignore
    assert found.calibrate == ("radii",)
    assert found.messages == ("said",)
    assert found.geometry is GEOMETRY
    assert found.error_model is error_model


def test_the_held_out_error_of_a_blend_is_that_of_its_first_model():
    first, second = (
        ReadoutFit(None, (1.0, 1.0), np.zeros((2, 3)), {}, 0.0, rmse=rmse) for rmse in (0.1, 0.2)
    )
    model = SimpleNamespace(
        error_model_=Blend((0.5, 0.5), (first, second)),
        _fitted_rows=np.zeros(7),
        calibration_=None,
        cv_results_=None,
    )
    assert training_of(model) == {"rows": 7, "left_out_rmse": 0.1}  # pyright: ignore
