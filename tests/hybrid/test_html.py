import numpy as np
import pandas as pd
import pytest
import sklearn
import torch
from sklearn.linear_model import Ridge
from sklearn.utils import estimator_html_repr

from hybridkin import ConstantCurvatureChain, HybridForwardModel, load_model, save_model

CHAIN = ConstantCurvatureChain([0.05])
HOSTILE = "<script>alert(1)</script>"
FOUND = "what the fit found"


def log(n_rows=60):
    rng = np.random.default_rng(0)
    q = rng.uniform(0.2, 0.3, (n_rows, 3))
    x = ConstantCurvatureChain([0.055])(torch.from_numpy(q)).numpy()
    return q, x + 0.02 * (q - 0.25) + 1e-4 * rng.standard_normal(x.shape)


def shown(model):
    """Return what a notebook shows, which is the same both ways that it may ask."""
    html = model._repr_html_()
    bundle = model._repr_mimebundle_()["text/html"]
    assert bundle.count(FOUND) == html.count(FOUND)
    return html


def test_an_unfitted_model_shows_its_parameters_alone():
    html = shown(HybridForwardModel(CHAIN, "linear"))
    assert "Not fitted" in html
    assert FOUND not in html


def test_parameters_of_scikit_learn_come_first():
    model = HybridForwardModel(CHAIN, "linear").fit(*log())
    html = shown(model)
    assert html.count(FOUND) == 1
    assert html.index("sk-top-container") < html.index(FOUND)
    assert FOUND not in estimator_html_repr(model)
    with sklearn.config_context(display="text"):
        assert not hasattr(model, "_repr_html_")
        assert [*model._repr_mimebundle_()] == ["text/plain"]


def test_calibration_error_model_error_and_range():
    q, x = log()
    model = HybridForwardModel(CHAIN, "linear", coupling="serial", calibrate=["radii"])
    html = shown(model.fit(q, x, groups=np.arange(60) // 6))
    found, rmse = model.calibration_, 1e3 * model.error_model_.rmse / 3**0.5
    assert "calibrated</th><td>radii</td>" in html
    assert f"rmse={found.rmse:.3e} m" in html
    assert "<td>&quot;linear&quot;, serial</td>" in html
    assert f"held-out error</th><td>standard deviation of a coordinate {rmse:.3g} mm<" in html
    assert "guard by leverage), as far as held-out groups tested it" in html
    assert f"q[0]</th><td>{q[:, 0].min():.4g}</td><td>{q[:, 0].max():.4g}</td>" in html
    assert "adapted</th>" not in html
    assert "adapted</th>" in shown(model.partial_fit(q[:30], x[:30] + 0.05, alpha=1.0))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"error_model": "drop"}, ["&quot;drop&quot;", "training error"]),
        ({"error_model": Ridge(), "guard": None}, ["<td>Ridge, ", "training error", "everywhere"]),
        ({"mechanical_model": None, "guard": "box"}, ["ELMRegressor", "held-out error"]),
        ({"error_model": "linear", "play": 0.001}, ["backlash</th><td>0.001 (unit of q)"]),
        ({"error_model": "linear", "coverage": 0.9}, [" mm covers 90 % of the tips inside"]),
    ],
    ids=["drop", "regressor", "data", "play", "radius"],
)
def test_other_settings(settings, words):
    html = shown(HybridForwardModel(**{"mechanical_model": CHAIN, **settings}).fit(*log()))
    for word in words:
        assert word in html


@pytest.mark.filterwarnings("ignore:`coverage`")
def test_a_radius_from_too_few_groups_is_not_known():
    model = HybridForwardModel(CHAIN, "linear", coverage=0.9)
    html = shown(model.fit(*log(), groups=np.arange(60) // 10))
    assert "not known: 90 % of the tips need at least 9 groups" in html


@pytest.mark.slow
def test_what_auto_chose_also_of_a_loaded_model(tmp_path):
    model = HybridForwardModel(CHAIN, "auto", random_state=0).fit(*log())
    save_model(model, tmp_path / "model.safetensors")
    for one in (model, load_model(tmp_path / "model.safetensors")):
        html = shown(one)
        assert "(chosen by &quot;auto&quot;)" in html
        results = one.cv_results_
        expected, alone = 1e3 * results["expected_distance"], 1e3 * results["mean_distance"][0]
        assert f"mean {expected:.3g} mm, mechanical model alone {alone:.3g} mm" in html
        assert "calibrated</th><td>radii" in html


def test_names_of_columns_are_escaped():
    q, x = log()
    frame = pd.DataFrame(q, columns=[HOSTILE, "b", "c"])
    html = shown(HybridForwardModel(CHAIN, "linear").fit(frame, x))
    assert HOSTILE not in html
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in html
