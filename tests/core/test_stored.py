import numpy as np

from hybridkin import ELMRegressor
from hybridkin._core.stored import estimator_of, params_of


def test_parameters_keep_numbers_and_lose_devices_and_generators():
    params = params_of(ELMRegressor(7, random_state=3, device="cpu"))
    assert params["random_state"] == 3
    assert params["device"] is None
    assert estimator_of(ELMRegressor, params).get_params() == params
    generator = np.random.RandomState(0)
    assert params_of(ELMRegressor(random_state=generator))["random_state"] is None
