import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from safetensors.numpy import load_file, save_file
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import LinearRegression

from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressor,
    HybridForwardModel,
    load_model,
    robots,
    save_model,
)


@pytest.fixture(scope="module")
def log():
    rng = np.random.default_rng(0)
    q = 0.25 + 0.06 * rng.uniform(-1, 1, (200, 9))
    x = robots.bionic_handling_assistant()(torch.from_numpy(q)).numpy() + 0.02 * np.sin(
        20 * q[:, :3]
    )
    return q, x


def tendon_chain():
    return ConstantCurvatureChain(
        [0.005, 0.004],
        n_actuators=[3, 4],
        lengths=[0.06, 0.05],
        routing="base",
        offsets=[0.0, 0.01],
        base=np.diag([1.0, -1.0, -1.0, 1.0]),
    )


@pytest.mark.parametrize("chain", [robots.bionic_handling_assistant(0.1), tendon_chain()])
def test_chain_comes_back(tmp_path, chain):
    save_model(chain, tmp_path / "chain.safetensors")
    twin = load_model(tmp_path / "chain.safetensors")
    q = torch.full((chain.n_actuators,), 0.2, dtype=torch.float64)
    assert torch.equal(twin(q), chain(q))


@pytest.mark.parametrize("guard", ["leverage", "box", None])
@pytest.mark.parametrize("error_model", [None, "drop", LinearRegression()])
def test_hybrid_comes_back_in_another_process(tmp_path, log, error_model, guard):
    q, x = log
    model = HybridForwardModel(
        robots.bionic_handling_assistant(),
        error_model,
        calibrate=("radii",),
        guard=guard,
        random_state=0,
    ).fit(q, x)
    path = tmp_path / "model.safetensors"
    save_model(model, path)
    twin = load_model(path)
    far = 0.25 + 4 * (q - 0.25)
    for points in (q, far):
        for was, came in zip(
            model.predict_and_jacobian(points), twin.predict_and_jacobian(points), strict=True
        ):
            # arrays come back in C order, which may change the last bit of a matrix product
            assert_allclose(came, was, rtol=1e-13, atol=1e-14)
    assert_array_equal(model.in_domain(far), twin.in_domain(far))
    assert_allclose(twin.fit(q, x).predict(q).mean(), model.predict(q).mean(), rtol=1e-3)
    code = f"import hybridkin; print(repr(hybridkin.load_model({str(path)!r}).n_features_in_))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "9"


def test_a_loaded_network_can_learn_on(tmp_path, log):
    q, x = log
    model = HybridForwardModel(None, ELMRegressor(random_state=0)).fit(q[:100], x[:100])
    save_model(model, tmp_path / "m")
    twin = load_model(tmp_path / "m")
    was = model.error_model_.partial_fit(q[100:], x[100:]).predict(q)
    assert_array_equal(twin.error_model_.partial_fit(q[100:], x[100:]).predict(q), was)


def test_what_needs_code_is_refused_and_nothing_is_written(tmp_path, log):
    path = tmp_path / "model"
    with pytest.raises(TypeError, match="only be stored as code"):
        save_model(HybridForwardModel(None, KernelRidge()).fit(*log), path)
    with pytest.raises(TypeError, match="ConstantCurvatureChain"):
        save_model(HybridForwardModel(torch.nn.Linear(9, 3).double(), "drop").fit(*log), path)
    with pytest.raises(TypeError, match="must be fitted"):
        save_model(HybridForwardModel(), path)
    with pytest.raises(TypeError, match="got int"):
        save_model(3, path)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(FileNotFoundError, match="folder that exists"):
        save_model(tendon_chain(), tmp_path / "none" / "model")


def test_foreign_and_damaged_files(tmp_path, log):
    path = tmp_path / "model"
    with pytest.raises(FileNotFoundError, match="no such file"):
        load_model(path)
    for content in (b"", b"hello", b"\x80\x04cos\nsystem\n"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="is not a model"):
            load_model(path)
    save_file({"a": np.zeros(3)}, path)
    with pytest.raises(ValueError, match="is not a model"):
        load_model(path)

    save_model(HybridForwardModel(None, random_state=0).fit(*log), path)
    arrays = load_file(path)
    from safetensors import safe_open

    with safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()["hybridkin"])

    def rewrite(arrays, **changes):
        save_file(arrays, path, metadata={"hybridkin": json.dumps({**header, **changes})})

    rewrite(arrays, version=99)
    with pytest.raises(ValueError, match="install a newer one"):
        load_model(path)
    rewrite(arrays, kind="something")
    with pytest.raises(ValueError, match="unknown kind"):
        load_model(path)
    rewrite({k: v for k, v in arrays.items() if k != "error.input_weights_"})
    with pytest.raises(ValueError, match="is damaged"):
        load_model(path)
    rewrite({**arrays, "error.input_weights_": np.zeros((5, 5))})
    with pytest.raises(ValueError, match="is damaged"):
        load_model(path)
    rewrite(arrays, error={"kind": "os.system"})
    with pytest.raises(ValueError, match="is damaged"):
        load_model(path)
