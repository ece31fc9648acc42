"""The errors of a chain's structure from rows: prior, optimum, held-out residuals."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ForceTendonChain,
    HybridForwardModel,
    datasets,
    robots,
)
from hybridkin._core.groups import Groups
from hybridkin.calibration.natural_scales import STRUCTURE
from hybridkin.chains.structural import StructuralChain
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._structure import Blocks, fit_structure

TRUNK = robots.bionic_handling_assistant()
TENDONS = ConstantCurvatureChain([0.01, 0.008], lengths=[0.12, 0.1])
ELASTIC = ElasticTendonChain([0.01, 0.008], [0.12, 0.1], routing="base")
MIXED = ConstantCurvatureChain([0.05, 0.01], lengths=[None, 0.1])
CHAINS = [TRUNK, TENDONS, ELASTIC, MIXED]


def motions(chain, n, seed=0):
    """Return actuator vectors of a chain (n, n_actuators)."""
    unit = torch.rand(n, chain.n_actuators, generator=torch.manual_seed(seed), dtype=torch.float64)
    chambers = 0.25 + 0.06 * (2.0 * unit - 1.0)
    return torch.where(chain.absolute, chambers, 0.004 * (2.0 * unit - 1.0))


def with_errors(chain, q, seed=1, scale=1.0):
    """Return a chain whose errors are drawn from the prior."""
    S = chain.n_segments
    lengths = chain.frames_and_moves(q).arcs[:S]
    varies = lengths.std(1) > 1e-9
    blocks = Blocks.of(varies)
    drawn = torch.randn(len(blocks.names), generator=torch.manual_seed(seed), dtype=torch.float64)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, 3] = 0.01 * chain.reach
    weights = blocks.weights(scale * drawn)
    return StructuralChain(chain, lengths.mean(1), *weights, motion)


def rows_of(model, q, noise=0.0, seed=2, groups=None):
    x = model(q).detach().numpy()
    rng = np.random.default_rng(seed)
    return Rows.of(q.numpy(), x + noise * rng.standard_normal(x.shape), groups=groups)


@pytest.mark.parametrize("chain", CHAINS)
def test_a_chain_without_errors_stays_as_it_is(chain):
    q = motions(chain, 30)
    fit = fit_structure(chain, rows_of(chain, q))
    assert_close(fit.model(q), chain(q), atol=1e-12, rtol=0.0)
    assert np.abs(fit.parameters).max() < 1e-9


@pytest.mark.parametrize("chain", CHAINS)
def test_errors_drawn_from_the_prior_are_found(chain):
    q = motions(chain, 400)
    true = with_errors(chain, q)
    fit = fit_structure(chain, rows_of(true, q), factor=3.0)
    other = motions(chain, 100, seed=5)
    before = (chain(other) - true(other)).norm(dim=1).mean()
    after = (fit.model(other) - true(other)).norm(dim=1).mean()
    assert after < 0.05 * before


def test_few_rows_halve_the_error():
    q = motions(TRUNK, 12)
    true = with_errors(TRUNK, motions(TRUNK, 100))
    rows = rows_of(true, q, noise=0.001)
    other = motions(TRUNK, 100, seed=5)
    fit = fit_structure(TRUNK, rows)
    before = (TRUNK(other) - true(other)).norm(dim=1).mean()
    after = (fit.model(other) - true(other)).norm(dim=1).mean()
    assert after < 0.5 * before


@pytest.mark.parametrize("size", [0.01, 3.0])
def test_the_errors_are_relative_to_the_robot(size):
    small = ConstantCurvatureChain(0.1 * size * torch.ones(2, dtype=torch.float64))
    unit = torch.rand(20, 6, generator=torch.manual_seed(0), dtype=torch.float64)
    q = 0.25 + 0.05 * unit
    x = robots.bionic_handling_assistant()(torch.cat([q, q[:, :3]], dim=1))
    first = ConstantCurvatureChain([0.1, 0.1])
    near = first(q) + 0.01 * x
    fit = fit_structure(first, Rows.of(q.numpy(), near.numpy()))
    scaled = fit_structure(small, Rows.of((size * q).numpy(), (size * near).numpy()))
    assert_close(fit.parameters, scaled.parameters, atol=1e-6, rtol=0.0)


def test_a_turned_measuring_frame_turns_the_model():
    q = motions(TRUNK, 30)
    rows = rows_of(with_errors(TRUNK, q), q)
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.linalg.matrix_exp(
        torch.tensor([[0.0, -0.3, 0.5], [0.3, 0.0, 0.2], [-0.5, -0.2, 0.0]], dtype=torch.float64)
    )
    turned = TRUNK.with_geometry(base=turn @ TRUNK.base)
    x = rows.tips @ turn[:3, :3].numpy().T
    fit = fit_structure(TRUNK, rows)
    fit_turned = fit_structure(turned, replace(rows, y=x))
    expected = fit.model(q) @ turn[:3, :3].mT
    assert_close(fit_turned.model(q), expected, atol=1e-7, rtol=0.0)


def test_held_out_residuals_are_those_of_fits_without_the_rows():
    q = motions(TRUNK, 40)
    true = with_errors(TRUNK, q, scale=0.1)
    rows = rows_of(true, q, noise=0.001)
    fit = fit_structure(TRUNK, rows)
    groups = np.arange(40) // 8
    by_group = fit_structure(TRUNK, replace(rows, groups=Groups(groups)))
    without = fit_structure(TRUNK, rows.take(np.arange(1, 40)), left_out=False)
    alone = rows.tips[0] - without.model(q[:1])[0].numpy()
    # Units of the noise change by the row; the errors are small, and nearly linear.
    assert_close(fit.residual[0], alone, atol=2e-4, rtol=0.0)
    without = fit_structure(TRUNK, rows.take(np.flatnonzero(groups != 2)))
    of_group = rows.tips[groups == 2] - without.model(q[groups == 2]).numpy()
    assert_close(by_group.residual[groups == 2], of_group, atol=3e-4, rtol=0.0)


def test_a_weight_of_two_is_the_row_twice():
    q = motions(TRUNK, 20)
    rows = rows_of(with_errors(TRUNK, q), q, noise=0.001)
    twice = np.append(np.arange(20), 3)
    weighted = replace(rows, counts=np.where(np.arange(20) == 3, 2.0, 1.0))
    repeated = rows.take(twice)
    fit = fit_structure(TRUNK, weighted).model(q)
    # The spread of the actuators, which sets their noise, counts every row once.
    assert_close(fit, fit_structure(TRUNK, repeated).model(q), atol=2e-4, rtol=0.0)


def test_missing_markers_teach_nothing():
    chain = TRUNK.with_markers([(1, 1.0), (2, 1.0)])
    q = motions(chain, 30)
    rows = rows_of(with_errors(chain, q), q)
    x = rows.tips.copy()
    x[::2, :3] = np.nan
    fit = fit_structure(chain, replace(rows, y=x))
    assert np.isfinite(fit.parameters).all()
    before = np.linalg.norm(rows.tips - chain(q).numpy())
    assert np.linalg.norm(rows.tips - fit.model(q).numpy()) < 0.2 * before


@pytest.mark.parametrize("name", sorted(STRUCTURE))
def test_a_block_of_scale_zero_is_left_out(name):
    q = motions(TRUNK, 20)
    rows = rows_of(with_errors(TRUNK, q), q)
    fit = fit_structure(TRUNK, rows, scales={**STRUCTURE, name: 0.0})
    if name.startswith("base"):
        part = slice(0, 3) if name == "base turn" else slice(3, 6)
        assert not fit.parameters[part].any()
    else:
        assert name not in fit.blocks


def test_inputs_are_not_changed():
    q = motions(TRUNK, 20)
    rows = rows_of(with_errors(TRUNK, q), q)
    X = rows.X.copy()
    y = rows.y.copy()
    fit_structure(TRUNK, rows)
    np.testing.assert_array_equal(rows.X, X)
    np.testing.assert_array_equal(rows.y, y)


def test_numbers_too_large_are_named():
    q = 1e29 * motions(TRUNK, 20)
    with pytest.raises(ValueError, match="too large"):
        fit_structure(TRUNK, Rows.of(q.numpy(), np.ones((20, 3))))


def test_structural_hybrid_of_the_shipped_trunk():
    data = datasets.load_trunk()
    rows = np.random.default_rng(0).permutation(len(data.q))
    train = rows[:25]
    test = rows[25:500]
    model = HybridForwardModel(TRUNK, "structural", coupling="serial", calibrate=("radii", "base"))
    model.fit(data.q[train], data.x[train])
    calibrated = model.predict_mechanical(data.q[test]) - data.x[test]
    error = model.predict(data.q[test]) - data.x[test]
    learned = model.predict_error(data.q[test])
    assert_close(error, calibrated + learned)
    assert np.linalg.norm(error, axis=1).mean() < 0.95 * np.linalg.norm(calibrated, axis=1).mean()
    x, J = model.predict_and_jacobian(data.q[test[:3]])
    step = 1e-6
    for k in range(9):
        moved = data.q[test[:3]].copy()
        moved[:, k] += step
        slope = (model.predict(moved) - x) / step
        assert_close(J[..., k], slope, atol=1e-4, rtol=0.0)


@pytest.mark.slow
def test_auto_stands_on_the_structure_where_it_helps():
    q = motions(TRUNK, 30)
    true = with_errors(TRUNK, q)
    rows = rows_of(true, q, noise=0.0005)
    model = HybridForwardModel(TRUNK, "auto", random_state=0).fit(rows.X, rows.y)
    assert model.cv_results_["candidate"][0] == "structural"
    assert isinstance(model.fitted_module_.mechanical, StructuralChain)
    assert isinstance(model.mechanical_model_, ConstantCurvatureChain)


def test_structural_errors_need_a_chain_of_arcs_and_serial_coupling():
    q = motions(TRUNK, 30).numpy()
    x = TRUNK(torch.from_numpy(q)).numpy()
    with pytest.raises(TypeError, match="coupling"):
        HybridForwardModel(TRUNK, "structural").fit(q, x)
    chain = ForceTendonChain([0.02], [0.3], bending_stiffness=[0.05], axial_stiffness=[100.0])
    forces = np.abs(np.random.default_rng(0).random((30, chain.n_actuators)))
    with pytest.raises(TypeError, match="one for each segment"):
        HybridForwardModel(chain, "structural", coupling="serial").fit(
            forces, chain(torch.from_numpy(forces)).numpy()
        )
