"""Error models that were fitted before, for example to a stream: they are used as they are."""

import pickle

import numpy as np
import pytest
import torch
from sklearn.exceptions import NotFittedError
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LinearRegression
from sklearn.neural_network import MLPRegressor

from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressor,
    HybridForwardModel,
    InverseKinematics,
    load_model,
    save_model,
)

CHAIN = ConstantCurvatureChain([0.06])
LIMITS = [[0.2] * 3, [0.3] * 3]
NETWORK = {"n_hidden": 20, "alpha": 1e-3, "input_scaling": LIMITS, "random_state": 0}


def log(n=200, seed=0):
    rng = np.random.default_rng(seed)
    q = 0.25 + 0.05 * rng.uniform(-1, 1, (n, 3))
    x = CHAIN(torch.from_numpy(q)).numpy() + 0.02 * np.sin(20 * q)
    return q, x


def streamed(seeds=range(5)):
    """Return the network of the residuals of several logs, chunk after chunk."""
    chain = HybridForwardModel(CHAIN, "drop").fit(*log())
    network = ELMRegressor(**NETWORK)
    for seed in seeds:
        q, x = log(seed=seed)
        network.partial_fit(q, x - chain.predict(q))
    return network


def test_a_stream_gives_the_model_of_a_fit_to_all_its_rows():
    q, x = map(np.concatenate, zip(*(log(seed=seed) for seed in range(5)), strict=True))
    whole = HybridForwardModel(CHAIN, ELMRegressor(**NETWORK)).fit(q, x)
    model = HybridForwardModel(CHAIN, FrozenEstimator(streamed())).fit(q, x)
    new = log(seed=9)[0]
    np.testing.assert_allclose(model.predict(new), whole.predict(new), rtol=0, atol=1e-9)
    np.testing.assert_allclose(model.jacobian(new), whole.jacobian(new), rtol=0, atol=1e-7)
    np.testing.assert_array_equal(model.in_domain(new), whole.in_domain(new))


def test_few_rows_suffice_for_the_rest_and_the_regressor_does_not_change():
    network = streamed()
    before = pickle.dumps(network)
    q, x = log(60, seed=9)
    model = HybridForwardModel(CHAIN, FrozenEstimator(network)).fit(q, x)
    assert pickle.dumps(network) == before
    inside = model.error_weight(q) == 1.0
    assert inside.all()
    expected = model.predict_mechanical(q) + network.predict(q)
    np.testing.assert_allclose(model.predict(q), expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(model.error_model_.predict(q), network.predict(q))
    network.partial_fit(q, 1.0 + x)  # the stream goes on
    np.testing.assert_allclose(model.predict(q), expected, rtol=0, atol=1e-12)
    error = np.sqrt(np.mean((model.predict(q) - x) ** 2))
    assert model._fit.error.noise == pytest.approx(error, rel=1e-9)


def test_the_file_and_the_tracker_of_a_frozen_network(tmp_path):
    q, x = log(60, seed=9)
    model = HybridForwardModel(CHAIN, FrozenEstimator(streamed())).fit(q, x)
    save_model(model, tmp_path / "model.safetensors")
    loaded = load_model(tmp_path / "model.safetensors")
    np.testing.assert_array_equal(loaded.predict(q), model.predict(q))
    assert isinstance(loaded.error_model, ELMRegressor)
    assert InverseKinematics(model, q_min=0.1).tracker(q[0]).backend == "compiled"


@pytest.mark.parametrize(
    "regressor",
    [
        LinearRegression(),
        MLPRegressor(hidden_layer_sizes=(5,), solver="lbfgs", max_iter=20, random_state=0),
    ],
    ids=["linear", "network"],
)
@pytest.mark.filterwarnings("ignore:lbfgs failed")
def test_other_regressors_predict_metres_as_they_do(regressor):
    """Not scaled residuals, as those that are fitted here."""
    q, x = log()
    regressor.fit(q, 0.03 * np.sin(20 * q))
    model = HybridForwardModel(CHAIN, FrozenEstimator(regressor), guard=None).fit(q, x)
    expected = model.predict_mechanical(q) + regressor.predict(q)
    np.testing.assert_allclose(model.predict(q), expected, rtol=0, atol=1e-12)


def test_clear_errors():
    q, x = log(40)
    with pytest.raises(NotFittedError, match="ELMRegressor"):
        HybridForwardModel(CHAIN, FrozenEstimator(ELMRegressor())).fit(q, x)
    fewer = ELMRegressor(5).fit(q[:, :2], x)
    with pytest.raises(ValueError, match=r"`error_model` must take 3 actuators.*2 inputs"):
        HybridForwardModel(CHAIN, FrozenEstimator(fewer)).fit(q, x)
    single = ELMRegressor(5).fit(q, x[:, 0])
    with pytest.raises(ValueError, match=r"`error_model` must predict 3 columns.*predicts 1"):
        HybridForwardModel(CHAIN, FrozenEstimator(single)).fit(q, x)
    with pytest.raises(TypeError, match="coupling='serial'"):
        HybridForwardModel(CHAIN, FrozenEstimator(streamed()), coupling="serial").fit(q, x)
