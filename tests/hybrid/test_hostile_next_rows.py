"""Rows to measure next for the errors of a structure: derivatives, chosen against random rows."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    HybridForwardModel,
    choose_rows,
    robots,
)
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._structure import StructureDesign, fit_structure
from hybridkin.hybrid.choose_rows import _StructuralErrors

TRUNK = robots.bionic_handling_assistant()
ELASTIC = ElasticTendonChain([0.01, 0.008], [0.12, 0.1], routing="base")


def motions(chain, n, seed=0):
    """Return actuator vectors of a chain (n, n_actuators)."""
    unit = torch.rand(n, chain.n_actuators, generator=torch.manual_seed(seed), dtype=torch.float64)
    chambers = 0.25 + 0.06 * (2.0 * unit - 1.0)
    return torch.where(chain.absolute, chambers, 0.004 * (2.0 * unit - 1.0))


def drawn(design, seed):
    """Return errors of a structure, drawn from the prior."""
    n = len(design.names)
    return torch.randn(n, generator=torch.manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("chain", [TRUNK, ELASTIC, TRUNK.with_markers([(0, 1.0), (2, 1.0)])])
@pytest.mark.parametrize("with_errors", [False, True])
def test_the_design_is_the_derivative_of_the_tips(chain, with_errors):
    q = motions(chain, 8)
    with torch.no_grad():
        design = StructureDesign(chain, q)
        at = 0.5 * drawn(design, 1) if with_errors else torch.zeros(len(design.names)).to(q)
        at[:6] = 0.0  # turns do not add up
        step = 1e-6 * drawn(design, 2)
        slope = (design.model(at + step)(q) - design.model(at - step)(q)) / 2e-6
        model = design.model(at) if with_errors else chain
        A = _StructuralErrors(chain, model, q).design(q)
    expected = A[..., : len(step)] @ (step / 1e-6)
    assert_close(expected, slope, atol=1e-6 * float(slope.abs().max()), rtol=0.0)


@pytest.mark.slow
def test_chosen_rows_find_the_errors_of_a_structure_better_than_random_rows():
    """Errors drawn from the prior: the mean squared error over six robots, with noise."""
    q = motions(TRUNK, 300)
    squares = {"chosen": 0.0, "random": 0.0}
    for seed in range(6):
        design = StructureDesign(TRUNK, q)
        rng = np.random.default_rng(seed)
        with torch.no_grad():
            truth = design.model(0.5 * drawn(design, seed))
            x = truth(q).numpy() + 0.002 * rng.standard_normal((300, 3))
        orders = {"chosen": choose_rows(TRUNK, q, 15)[0], "random": rng.permutation(300)[:15]}
        for name, rows in orders.items():
            fit = fit_structure(TRUNK, Rows.of(q.numpy()[rows], x[rows]), left_out=False)
            with torch.no_grad():
                squares[name] += float((fit.model(q) - truth(q)).square().sum(1).mean())
    assert squares["chosen"] < 0.7 * squares["random"], squares


@pytest.mark.slow
def test_a_hybrid_is_linearised_at_the_errors_that_it_learned():
    q = motions(TRUNK, 120)
    with torch.no_grad():
        design = StructureDesign(TRUNK, q)
        x = design.model(drawn(design, 3))(q).numpy()
    hybrid = HybridForwardModel(TRUNK, "structural", coupling="serial").fit(q.numpy(), x)
    learned = hybrid.fitted_module_.mechanical
    rows, error = choose_rows(hybrid, q, 8)
    same_rows, same_error = choose_rows(hybrid.module_, q, 8)
    np.testing.assert_array_equal(rows, same_rows)
    np.testing.assert_allclose(error, same_error)
    nominal = choose_rows(TRUNK, q, 8)[1]
    assert np.abs(error / nominal - 1.0).max() > 1e-4
    with torch.no_grad():
        errors = _StructuralErrors(TRUNK, learned, torch.cat([q, q]))
        before = errors.gram(q).trace() / len(q)
    assert error[0] < before**0.5


def test_measured_rows_lower_the_expected_error():
    q = motions(TRUNK, 80)
    first, error = choose_rows(TRUNK, q, 12)
    later, rest = choose_rows(TRUNK, q, 4, measured=q[torch.from_numpy(first)])
    assert rest[0] < error[-1]
    assert not {*later} & {*first[:4]}


def test_a_segment_that_does_not_move_leaves_finite_errors():
    chain = ConstantCurvatureChain([0.05, 0.01], lengths=[None, 0.1])
    q = motions(chain, 40)
    q[:, 3:] = 0.0
    _, error = choose_rows(chain, q, 5)
    assert np.isfinite(error).all()
    assert (np.diff(error) < 0.0).all()
