import numpy as np
import pandas as pd
import pytest
import torch

from hybridkin import ConstantCurvatureChain, HybridForwardModel

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


@pytest.mark.filterwarnings("ignore:`coverage`")
def test_a_radius_from_too_few_groups_is_not_known():
    model = HybridForwardModel(CHAIN, "linear", coverage=0.9)
    html = shown(model.fit(*log(), groups=np.arange(60) // 10))
    assert "not known: 90 % of the tips need at least 9 groups" in html


def test_names_of_columns_are_escaped():
    q, x = log()
    frame = pd.DataFrame(q, columns=[HOSTILE, "b", "c"])
    html = shown(HybridForwardModel(CHAIN, "linear").fit(frame, x))
    assert HOSTILE not in html
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in html
