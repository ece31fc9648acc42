import json
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal, assert_equal
from safetensors.numpy import load_file, save_file
from saved_models import (
    arm,
    bent_chain,
    predictions,
    tendon_chain,
    trunk,
    trunk_log,
)
from sklearn.base import clone
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import LinearRegression

import hybridkin
from hybridkin import (
    ConstantCurvatureChain,
    HybridForwardModel,
    load_model,
    robots,
    save_model,
)
from hybridkin.saving._file import write
from hybridkin.saving.header import model_header

KINDS = (
    *("chain", "chain_of_all_parts", "elastic_chain", "rigid", "elm", "elm_cv", "mechanical"),
    *("parallel_elm", "parallel_kernel", "parallel_regression", "parallel_linear"),
    *("parallel_quadratic", "serial_quadratic", "serial_pose", "serial_elm", "pose_output"),
    *("data_only", "drift_and_radius", "rigid_hybrid", "elastic_hybrid", "blend", "play"),
    *("adapted", "adapted_pose", "structural_chain"),
)


@pytest.fixture(scope="module")
def log():
    rng = np.random.default_rng(0)
    q = 0.25 + 0.06 * rng.uniform(-1, 1, (200, 9))
    x = robots.bionic_handling_assistant()(torch.from_numpy(q)).numpy() + 0.02 * np.sin(
        20 * q[:, :3]
    )
    return q, x


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


def test_folder_of_a_fit_stands_for_the_model_in_it(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"folder with a model\.safetensors, .* is no file"):
        load_model(tmp_path)
    save_model(tendon_chain(), tmp_path / "model.safetensors")
    assert repr(load_model(tmp_path)) == repr(tendon_chain())
    assert model_header(str(tmp_path)) == model_header(tmp_path / "model.safetensors")


def test_foreign_and_damaged_files(tmp_path, log):
    path = tmp_path / "model"
    with pytest.raises(FileNotFoundError, match="is no file"):
        load_model(path)
    for content in (b"", b"hello", b"\x80\x04cos\nsystem\n"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="is not a model"):
            load_model(path)
    save_file({"a": np.zeros(3)}, path)
    with pytest.raises(ValueError, match="is not a model"):
        load_model(path)

    save_model(HybridForwardModel(None, random_state=0).fit(*log), path)
    arrays, header = load_file(path), model_header(path)
    weights = "module.corrections.0.module.input_weights"
    parts = header["parts"]
    damage = [
        ("install the hybridkin that wrote it", arrays, {"version": 99}),
        ("unknown kind", arrays, {"kind": "something"}),
        ("is damaged", {k: v for k, v in arrays.items() if k != weights}, {}),
        ("is damaged", {**arrays, weights: np.zeros((5, 5))}, {}),
        ("is damaged", arrays, {"parts": {**parts, "error_model": {"kind": "os.system"}}}),
        ("is damaged", arrays, {"parts": {**parts, "nominal": {"kind": "hybrid"}}}),
        ("is damaged", arrays, {"parts": {**parts, "nominal": [1]}}),
        ("is damaged", arrays, {"parts": {**parts, "nominal": header}}),
    ]
    for message, parts, changes in damage:
        write(path, {**header, **changes}, parts)
        with pytest.raises(ValueError, match=message):
            load_model(path)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_comes_back_with_its_settings(tmp_path, kind, fitted):
    model, q = fitted[kind]
    save_model(model, tmp_path / "model")
    twin = load_model(tmp_path / "model")
    for name, was in predictions(model, q).items():
        assert_allclose(predictions(twin, q)[name], was, rtol=1e-12, atol=1e-13)
    if isinstance(model, HybridForwardModel):
        assert_equal(settings(twin), settings(model))
        assert_equal(twin.cv_results_, model.cv_results_)
        assert_array_equal(twin._drift.moment, model._drift.moment)
        for name in ("noise", "rejected", "held_out"):  # what adapt and notebooks read
            assert_equal(getattr(twin._fit.error, name), getattr(model._fit.error, name))
        for name in ("radius_", "training_range_"):
            assert_equal(getattr(twin, name), getattr(model, name))


def test_a_file_knows_that_no_correction_was_taken(tmp_path):
    q, _, groups = trunk_log()
    chain = trunk()
    noise = 1e-3 * np.random.default_rng(0).standard_normal((len(q), 3))
    model = HybridForwardModel(chain, "linear")
    model.fit(q, chain(torch.from_numpy(q)).numpy() + noise, groups=groups)
    save_model(model, tmp_path / "model")
    assert model._fit.error.rejected
    assert load_model(tmp_path / "model")._fit.error.rejected


def test_a_loaded_model_of_one_output_is_adapted_without_its_drift(tmp_path):
    q, x, groups = trunk_log()
    model = HybridForwardModel(None, LinearRegression())
    model.fit(q, x[:, 0], groups=groups)
    model.partial_fit(q[:9], x[:9, 0] + 0.03, alpha=1e-3)
    save_model(model, tmp_path / "model")
    twin = load_model(tmp_path / "model")
    assert_array_equal(twin.predict(q), model.predict(q))
    assert twin.predict(q).shape == (len(q),)
    for followed in (model, twin):
        followed.adapt(q, x[:, 0], parameters=["actuator_zeros"])
    assert_array_equal(twin.predict(q), model.predict(q))
    assert model._drift.alpha == np.inf


def settings(model):
    """Return all parameters, those of the error model among them."""
    params = model.get_params()
    chain = params.pop("mechanical_model")
    error = params["error_model"]
    return {**params, "error_model": type(error) if error else error, "chain": repr(chain)}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["serial_elm", "parallel_elm", "parallel_kernel", "blend"])
def test_a_loaded_hybrid_is_fitted_again_as_what_it_was(tmp_path, kind, fitted):
    model, q = fitted[kind]
    _, x, groups = trunk_log(len(q))
    save_model(model, tmp_path / "model")
    twin = load_model(tmp_path / "model").fit(q, x, groups=groups)
    fresh: Any = clone(model)
    again = fresh.fit(q, x, groups=groups)
    assert_allclose(twin.predict(q), again.predict(q), rtol=1e-12)


def test_the_header_describes_the_model(tmp_path, fitted):
    path = tmp_path / "model"
    model, q = fitted["serial_quadratic"]
    save_model(model, path, training={"log": "log.csv", "motions": np.int64(4)})
    header = model_header(path)
    assert header["version"] == 3
    assert {*header["versions"]} == {"hybridkin", "python", "torch", "numpy", "scikit-learn"}
    assert header["versions"]["hybridkin"] == hybridkin.__version__
    assert header["created"].count("-") == 2
    assert header["units"] == {"q": "m", "x": "m"}
    assert header["domain"]["guard"] == "leverage"
    assert_allclose(header["domain"]["q_low"], q.min(0))
    assert_allclose(header["domain"]["q_high"], q.max(0))
    assert header["training"] == {"rows": 24, "log": "log.csv", "motions": 4}
    save_model(fitted["parallel_elm"][0], path)
    found = model_header(path)["training"]
    assert found["rows"] == 24
    calibration = fitted["parallel_elm"][0].calibration_
    assert found["calibration"]["rmse"] == calibration.rmse
    assert found["calibration"]["held_out_rmse"] == calibration.cv_rmse > calibration.rmse
    save_model(fitted["blend"][0], path)
    chosen = model_header(path)["training"]["cv_results"]["chosen"]
    assert chosen == fitted["blend"][0].cv_results_["chosen"]
    adapted = fitted["adapted"][0]
    save_model(adapted, path)
    assert np.abs(adapted.change_.shift).min() > 1e-6
    low, high = adapted._fit.training_range
    assert_allclose(model_header(path)["domain"]["q_low"], low - adapted.change_.shift)
    assert_allclose(model_header(path)["domain"]["q_high"], high - adapted.change_.shift)
    save_model(arm(), path)
    assert model_header(path)["units"] == {"q": ["rad", "m", "rad"], "x": "m"}
    chambers, tendons = [0.02, 0.01], {"lengths": [None, 0.1], "n_actuators": [1, 3]}
    save_model(ConstantCurvatureChain(chambers, **tendons, stage="rotation"), path)
    assert model_header(path)["units"]["q"] == ["rad", "m", "m", "m"]
    save_model(ConstantCurvatureChain([0.01], lengths=[0.1], gains=2e-5), path)
    assert model_header(path)["units"]["q"] == "as in training"
    save_model(fitted["pose_output"][0], path)
    assert model_header(path)["units"]["x"] == ["m", "m", "m", "rad", "rad", "rad"]
    with pytest.raises(TypeError, match="`training` must map names"):
        save_model(arm(), path, training={"a": object()})


@pytest.mark.parametrize("kind", ["chain", "parallel_elm", "serial_pose", "elm"])
def test_devices(tmp_path, kind, fitted):
    model, q = fitted[kind]
    save_model(model, tmp_path / "model")
    twin = load_model(tmp_path / "model", device="cpu")
    assert_allclose(predictions(twin, q)["x"], predictions(model, q)["x"], rtol=1e-12)
    with pytest.raises(RuntimeError, match="`device` must name a device"):
        load_model(tmp_path / "model", device="cuda:99")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("kind", ["chain", "parallel_elm", "serial_pose", "elm"])
def test_a_model_is_loaded_onto_the_gpu(tmp_path, kind, fitted):
    model, q = fitted[kind]
    save_model(model, tmp_path / "model")
    twin = load_model(tmp_path / "model", device="cuda")
    module = getattr(twin, "module_", twin)
    assert {buffer.device.type for buffer in module.buffers()} == {"cuda"}
    if module is not twin:
        assert_allclose(twin.predict(q), model.predict(q), rtol=1e-12)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity"])
def test_numbers_that_json_does_not_know_are_refused(tmp_path, number):
    path = tmp_path / "chain"
    save_model(bent_chain(), path)
    header = json.dumps(model_header(path)).replace("[[2.0, ", f"[[{number}, ")
    save_file(load_file(path), path, metadata={"hybridkin": header})
    with pytest.raises(ValueError, match=f"is not a model .*{number} is no JSON value"):
        load_model(path)
