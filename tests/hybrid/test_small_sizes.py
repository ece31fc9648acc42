"""One actuator, one output, and few rows."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
)

NETWORK = ELMRegressorCV(12, weight_scales=(0.4,), relevance_rounds=0, max_hidden=0, random_state=0)
MODELS = {"elm": ELMRegressor(12, 1e-3, random_state=0), "network": NETWORK}
MODELS |= {name: name for name in ("linear", "quadratic", "kernel", "drop")}
SLOW = {"marks": pytest.mark.slow}
PAIRS = [("parallel", name) for name in MODELS if name != "kernel"]
PAIRS += [("serial", name) for name in ("elm", "network", "linear", "quadratic")]
PAIRS += [pytest.param("parallel", "kernel", **SLOW)]


class Bent(torch.nn.Module):
    """A mechanical model of n actuators and m outputs, one to one in each of these."""

    def __init__(self, n, m):
        super().__init__()
        self.A = torch.linspace(0.4, 1.0, n * m, dtype=torch.float64).reshape(n, m)

    def forward(self, q):
        return 0.1 * torch.sin(q @ self.A.to(q))


def log_of(n, m, n_rows=50):
    rng = np.random.default_rng(0)
    q = rng.uniform(-1, 1, (n_rows, n))
    x = Bent(n, m)(torch.from_numpy(1.2 * q + 0.1 * q**2)).numpy()
    return q, x + 1e-4 * rng.normal(size=x.shape)


@pytest.mark.parametrize(("coupling", "name"), PAIRS)
@pytest.mark.parametrize(
    ("n", "m", "options"),
    [
        (1, 1, {}),
        (3, 1, {}),
        (1, 3, {}),
        pytest.param(3, 1, {"hysteresis": 0.01, "coverage": 0.8}, **SLOW),
    ],
)
def test_a_single_coordinate_or_output(coupling, name, n, m, options):
    q, x = log_of(n, m)
    y = x[:, 0] if m == 1 and "hysteresis" in options else x  # one-dimensional targets too
    model = HybridForwardModel(Bent(n, m), MODELS[name], coupling=coupling, **options).fit(q, y)
    mechanical = Bent(n, m)(torch.from_numpy(q)).numpy().reshape(y.shape)
    if name != "drop":
        most = 0.95 if name == "linear" else 0.65  # of tips that bend
        assert np.std(model.predict(q) - y) < most * np.std(mechanical - y)
    assert model.predict(q).shape == y.shape
    module, rows = model.module_, torch.from_numpy(0.5 * q[:5])
    expected = torch.func.vmap(torch.func.jacrev(module))(rows)
    assert expected.shape == (5, m, n)
    assert_allclose(module.jacobian(rows), expected, rtol=1e-6, atol=1e-8)
    assert model.jacobian(q).shape == (*y.shape, n)
    if "coverage" in options:
        assert model.predict(q, return_radius=True)[1].shape == (len(q),)
    assert np.isfinite(model.partial_fit(q[:1], y[:1]).predict(q)).all()


@pytest.mark.slow
@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 3)])
def test_a_single_coordinate_or_output_in_the_selection(n, m):
    q, x = log_of(n, m)
    model = HybridForwardModel(Bent(n, m), "auto", random_state=0).fit(q, x)
    without = np.std(x - model.predict_mechanical(q))
    assert np.std(x - model.predict(q)) < 0.1 * without
    assert model.jacobian(q).shape == (len(q), m, n)


@pytest.mark.slow
@pytest.mark.parametrize(("coupling", "name"), PAIRS)
def test_one_row_is_refused_and_few_rows_warn(coupling, name):
    q, x = log_of(3, 2)
    model = HybridForwardModel(Bent(3, 2), MODELS[name], coupling=coupling)
    same = np.zeros(4, dtype=int)
    if name == "drop":
        assert_allclose(model.fit(q[:1], x[:1]).predict(q), model.predict_mechanical(q))
        return
    for rows in ([0], same):  # equal rows are one
        with pytest.raises(ValueError, match=r"at least 2 different rows .* n_samples=1; record"):
            model.fit(q[rows], x[rows])
    with pytest.raises(ValueError, match="at least 3 different rows"):
        HybridForwardModel(Bent(3, 2), MODELS[name], coverage=0.5).fit(q[:2], x[:2])
    for n_rows in (2, 3, 5, 19):
        with pytest.warns(UserWarning, match=rf"holds {n_rows} different rows of 3 .* least 40"):
            model.fit(q[:n_rows], x[:n_rows])
        assert np.isfinite(model.predict(q)).all()
    model.fit(q[:20], x[:20])  # without a warning


def test_few_rows_of_many_actuators_warn():
    q, x = log_of(12, 2, 26)
    with pytest.warns(UserWarning, match="an affine function alone has 13 coefficients"):
        HybridForwardModel(Bent(12, 2), "linear").fit(q[:25], x[:25])
    HybridForwardModel(Bent(12, 2), "linear").fit(q, x)


def test_few_rows_of_a_calibration_warn():
    rng = np.random.default_rng(0)
    q = 0.25 + 0.05 * rng.uniform(-1, 1, (7, 3))
    x = ConstantCurvatureChain([0.05])(torch.from_numpy(q)).numpy()
    model = HybridForwardModel(ConstantCurvatureChain([0.06]), "drop", calibrate=("radii", "base"))
    with pytest.warns(UserWarning, match="holds 6 different rows for 7 free parameters"):
        model.fit(q[:6], x[:6])
    model.fit(q, x)
