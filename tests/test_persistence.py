import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from sklearn.exceptions import NotFittedError
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import LinearRegression
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
    RigidChain,
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


def tendon_chain(**options):
    return ConstantCurvatureChain(
        [0.005, 0.004],
        n_actuators=[3, 4],
        lengths=[0.06, 0.05],
        routing="base",
        offsets=[0.0, 0.01],
        base=np.diag([1.0, -1.0, -1.0, 1.0]),
        **options,
    )


def bent_chain(**options):
    """A chain that uses all that a chain can hold."""
    zeros = 1e-4 * np.arange(7)
    return tendon_chain(rest_bends=[[0.1, 0.2], [0.0, -0.3]], actuator_zeros=zeros, **options)


def elastic_chain(**options):
    """An elastic chain that uses all that it can hold."""
    return ElasticTendonChain(
        [0.005, 0.004],
        [0.06, 0.05],
        n_tendons=[3, 4],
        routing="segment",
        bending_stiffness=[2e-7, 3e-7],
        axial_stiffness=[3.0, 4.0],
        tendon_zeros=1e-4 * np.arange(7),
        rest_bends=[[0.1, 0.2], [0.0, -0.3]],
        offsets=[0.0, 0.01],
        base=np.diag([1.0, -1.0, -1.0, 1.0]),
        **options,
    )


def arm(**options):
    origins = np.stack([np.eye(4)] * 3)
    origins[1:, 0, 3] = 0.3, 0.2
    options = {
        "kinds": ["revolute", "prismatic", "revolute"],
        "names": ["turn", "slide", "wrist"],
        "q_min": [-2.0, 0.0, -np.inf],
        "q_max": [2.5, 0.4, np.inf],
        "tip": np.diag([-1.0, -1.0, 1.0, 1.0]),
        "tool": [0.1, 0.0, 0.02],
        "base": np.diag([1.0, -1.0, -1.0, 1.0]),
        **options,
    }
    return RigidChain(origins, [[0, 0, 1], [1, 0, 2], [0, 1, 0]], **options)


def header_of(path):
    with safe_open(path, framework="numpy") as file:
        return json.loads(file.metadata()["hybridkin"])


def rewrite(path, arrays, **changes):
    """Write a saved model again with other arrays and a changed header."""
    header = {**header_of(path), **changes}
    save_file(arrays, path, metadata={"hybridkin": json.dumps(header)})


@pytest.mark.parametrize(
    "chain",
    [
        robots.bionic_handling_assistant(0.1),
        tendon_chain(),
        bent_chain(),
        bent_chain().with_tip(1.5),
        bent_chain(dtype=torch.float32).with_tip(0.5),
        elastic_chain(),
        elastic_chain(dtype=torch.float32, smoothing=1e-4).with_tip(1.5),
    ],
)
def test_chain_comes_back(tmp_path, chain):
    save_model(chain, tmp_path / "chain.safetensors")
    twin = load_model(tmp_path / "chain.safetensors")
    assert type(twin) is type(chain)
    q = torch.full((chain.n_actuators,), 0.2, dtype=torch.float64)
    for was, came in zip(chain.forward_and_jacobian(q), twin.forward_and_jacobian(q), strict=True):
        assert torch.equal(came, was)
    assert repr(twin) == repr(chain)
    assert getattr(twin, "smoothing", None) == getattr(chain, "smoothing", None)
    assert {k: v.dtype for k, v in twin.named_buffers()} == {
        k: v.dtype for k, v in chain.named_buffers()
    }


@pytest.mark.parametrize("chain", [arm(), arm(dtype=torch.float32), arm(q_min=None, q_max=None)])
def test_rigid_arm_comes_back(tmp_path, chain):
    save_model(chain, tmp_path / "arm.safetensors")
    twin = load_model(tmp_path / "arm.safetensors")
    assert (twin.kinds, twin.names) == (chain.kinds, chain.names)
    # Axes and rotations are made orthonormal anew, which may change the last bit.
    was, came = dict(chain.named_buffers()), dict(twin.named_buffers())
    eps = torch.finfo(chain.base.dtype).eps
    assert_close(came, was, rtol=0, atol=2 * eps)


def test_files_from_before_rest_bends_and_tips(tmp_path):
    path = tmp_path / "old"
    header = {
        "format": "hybridkin-model",
        "version": 1,
        "kind": "chain",
        "actuators_per_segment": [3, 4],
        "routing": "base",
    }
    chain = tendon_chain()
    new = ("rest_bends", "actuator_zeros")
    arrays = {k: v.numpy() for k, v in chain.geometry().items() if k not in new}
    save_file(arrays, path, metadata={"hybridkin": json.dumps(header)})
    twin = load_model(path)
    q = torch.full((7,), 0.002, dtype=torch.float64)
    assert torch.equal(twin(q), chain(q))
    assert twin.tip_at == 2.0
    for name in new:
        assert not getattr(twin, name).any()


def test_hybrid_of_a_rigid_arm_comes_back(tmp_path, rng):
    q = 2 * torch.rand(80, 3, generator=rng, dtype=torch.float64) - 1
    x = arm()(q) - torch.cat([0.0 * q[:, :2], 0.01 * q[:, 1:2].cos()], 1)
    model = HybridForwardModel(arm(), random_state=0).fit(q.numpy(), x.numpy())
    save_model(model, tmp_path / "model")
    twin = load_model(tmp_path / "model")
    for was, came in zip(
        model.predict_and_jacobian(q.numpy()), twin.predict_and_jacobian(q.numpy()), strict=True
    ):
        assert_allclose(came, was, rtol=1e-13, atol=1e-14)
    assert isinstance(twin.mechanical_model, RigidChain)


def test_hybrid_of_an_elastic_chain_comes_back(tmp_path):
    rng = np.random.default_rng(0)
    q = 0.003 * rng.uniform(-1, 1, (100, 7))
    x = elastic_chain()(torch.from_numpy(q)).numpy() + 0.001 * np.sin(300 * q[:, :3])
    names = ("base", "rest_bends")
    model = HybridForwardModel(elastic_chain(), calibrate=names, random_state=0).fit(q, x)
    save_model(model, tmp_path / "model")
    twin = load_model(tmp_path / "model")
    for points in (q, 3 * q):
        for was, came in zip(
            model.predict_and_jacobian(points), twin.predict_and_jacobian(points), strict=True
        ):
            assert_allclose(came, was, rtol=1e-12, atol=1e-13)
    assert isinstance(twin.mechanical_model_, ElasticTendonChain)
    assert twin.calibrate == names
    assert header_of(tmp_path / "model")["mechanical"]["kind"] == "elastic_tendon_chain"


@pytest.mark.parametrize("guard", ["leverage", "box", None])
@pytest.mark.parametrize(
    "error_model", [None, "drop", LinearRegression(), KernelRidge(0.1, kernel="rbf", gamma=20.0)]
)
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


@pytest.mark.parametrize(
    "elm",
    [
        ELMRegressor(20, [0.1, 1.0, 10.0], direct_link=True, random_state=0),
        ELMRegressor(20, input_scaling=np.array([[0.1] * 9, [0.4] * 9]), random_state=0),
        ELMRegressorCV(20, relevance_rounds=1, random_state=np.random.RandomState(0)),
    ],
    ids=["penalties", "bounds", "chosen"],
)
def test_network_comes_back_and_can_learn_on(tmp_path, log, elm):
    q, x = log
    frame = pd.DataFrame(q, columns=[f"c{i}" for i in range(9)])
    elm.fit(frame[:100], x[:100])
    save_model(elm, tmp_path / "elm.safetensors")
    back = load_model(tmp_path / "elm.safetensors")
    assert_array_equal(back.predict(frame), elm.predict(frame))
    assert_array_equal(back.predict(frame, return_std=True)[1], elm.predict(frame, True)[1])
    assert_array_equal(back.feature_names_in_, frame.columns)
    chosen = getattr(elm, "best_estimator_", elm)
    again = ELMRegressor(**chosen.get_params()).fit(q[:100], x[:100])
    assert_allclose(
        back.partial_fit(frame[100:], x[100:]).predict(frame),
        again.partial_fit(q[100:], x[100:]).predict(q),
        rtol=1e-10,
    )


def test_hybrid_with_a_chosen_network_comes_back(tmp_path, log):
    q, x = log
    chain = robots.bionic_handling_assistant()
    model = HybridForwardModel(chain, ELMRegressorCV(20, relevance_rounds=0, random_state=0))
    model.fit(q, x)
    save_model(model, tmp_path / "model.safetensors")
    back = load_model(tmp_path / "model.safetensors")
    assert_array_equal(back.predict(q), model.predict(q))
    assert isinstance(back.error_model_, ELMRegressor)


def test_damaged_networks(tmp_path, log):
    path = tmp_path / "elm.safetensors"
    with pytest.raises(NotFittedError):
        save_model(ELMRegressor(), path)
    save_model(ELMRegressor(5, random_state=0).fit(*log), path)
    arrays = load_file(path)
    arrays["output_weights_"] = arrays["output_weights_"][:3]
    save_file(arrays, path, metadata={"hybridkin": json.dumps(header_of(path))})
    with pytest.raises(ValueError, match="is damaged"):
        load_model(path)


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
    arrays, header = load_file(path), header_of(path)
    damage = [
        ("install a newer one", arrays, {"version": 99}),
        ("unknown kind", arrays, {"kind": "something"}),
        ("is damaged", {k: v for k, v in arrays.items() if k != "error.input_weights_"}, {}),
        ("is damaged", {**arrays, "error.input_weights_": np.zeros((5, 5))}, {}),
        ("is damaged", arrays, {"error": {"kind": "os.system"}}),
        ("is damaged", arrays, {"mechanical": {"kind": "hybrid"}}),
        ("is damaged", arrays, {"mechanical": [1]}),
    ]
    for message, parts, changes in damage:
        rewrite(path, parts, **{**header, **changes})
        with pytest.raises(ValueError, match=message):
            load_model(path)


@pytest.mark.parametrize("header", ["[]", "3", "null", "{", "[" * 100_000, '{"format": 1}'])
def test_foreign_headers(tmp_path, header):
    path = tmp_path / "model"
    save_file({"a": np.zeros(3)}, path, metadata={"hybridkin": header})
    with pytest.raises(ValueError, match="is not a model"):
        load_model(path)


@pytest.mark.parametrize(
    ("chain", "changes", "arrays"),
    [
        (bent_chain(), {"tip_at": 3.0}, {}),
        (bent_chain(), {"tip_at": float("nan")}, {}),
        (bent_chain(), {"tip_at": "end"}, {}),
        (bent_chain(), {"routing": ["base"]}, {}),
        (bent_chain(), {"kind": "rigid"}, {}),
        (bent_chain(), {"kind": ["chain"]}, {}),
        (bent_chain(), {"actuators_per_segment": [3, 10**12]}, {}),
        (bent_chain(), {"actuators_per_segment": [3, float("inf")]}, {}),
        (bent_chain(), {}, {"rest_bends": np.zeros((2, 3))}),
        (bent_chain(), {}, {"actuator_zeros": np.full(7, np.nan)}),
        (bent_chain(), {}, {"base": np.eye(4, dtype=np.int64)}),
        (bent_chain(), {}, {"offsets": None}),
        (bent_chain(), {"kind": "elastic_tendon_chain"}, {}),
        (elastic_chain(), {}, {"tendon_zeros": None}),
        (elastic_chain(), {}, {"rest_bends": None}),
        (elastic_chain(), {}, {"bending_stiffness": -np.ones(2)}),
        (elastic_chain(), {"actuators_per_segment": [3, 5]}, {}),
        (arm(), {"kind": "chain"}, {}),
        (arm(), {"kinds": ["revolute"] * 2}, {}),
        (arm(), {"kinds": 3}, {}),
        (arm(), {"names": None}, {"origins": None}),
        (arm(), {}, {"tool": None}),
        (arm(), {}, {"axes": np.zeros((3, 3))}),
        (arm(), {}, {"origins": np.ones((3, 4, 4))}),
        (arm(), {}, {"q_min": np.full(3, 9.0)}),
    ],
)
def test_damaged_chains(tmp_path, chain, changes, arrays):
    path = tmp_path / "chain"
    save_model(chain, path)
    whole = {**load_file(path), **arrays}
    rewrite(path, {k: v for k, v in whole.items() if v is not None}, **changes)
    with pytest.raises(ValueError, match="is damaged"):
        load_model(path)
