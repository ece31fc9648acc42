from math import inf

import pytest
import torch
from saved_models import arm
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, robots
from hybridkin._core.groups import Groups
from hybridkin.hybrid._features import Features, HiddenFeatures, QuadraticFeatures, Readout
from hybridkin.hybrid._linearised import (
    Linearised,
    design,
)
from hybridkin.hybrid._module import HybridModule, InnerCorrection, TipCorrection
from hybridkin.hybrid._readout_fit import _ReadoutProblem, fit_readout
from hybridkin.hybrid._rows import Rows


def read_out(chain, features, q, x, sample_weight=None, groups=None, **options):
    """Return the readout that is fitted to the different ones of rows q and x."""
    weights = None if sample_weight is None else sample_weight.numpy()
    labels = None if groups is None else groups.numpy()
    rows = Rows.of(q.detach().numpy(), x.detach().numpy(), weights, labels).distinct()
    return fit_readout(chain, features, rows, **options)


def hybrid(chain, readout, coupling="serial"):
    """Return the chain with an unguarded readout, inside or at the tip."""
    inside = coupling == "serial"
    correction = InnerCorrection(readout) if inside else TipCorrection(readout)
    return HybridModule(chain, [correction], torch.ones(1, dtype=torch.float64))


def uniform(rng, *shape):
    return 2.0 * torch.rand(*shape, generator=rng, dtype=torch.float64) - 1.0


def trunk():
    return robots.bionic_handling_assistant(), 0.25, 0.05


def tendons():
    options = dict(routing="base", bending_stiffness=[4e-7, 3e-7, 2e-7], axial_stiffness=5.0)
    chain = ElasticTendonChain([0.005] * 3, [0.06, 0.06, 0.06], tendon_zeros=0.001, **options)
    return chain, 0.0, 0.002


ROBOTS = {
    "trunk": trunk,
    "cables": lambda: (ConstantCurvatureChain([0.01], lengths=[0.1]), 0.0, 0.005),
    "tendons": tendons,
    "arm": lambda: (arm(), 0.3, 0.5),
}


def some_features(kind, q, rng):
    if kind == "hidden":
        shape = 12, q.shape[1]
        return HiddenFeatures.of_range(q, uniform(rng, *shape), uniform(rng, 12))
    return {"linear": Features, "quadratic": QuadraticFeatures}[kind].of_range(q)


def rows_of(robot, rng, n):
    chain, middle, width = ROBOTS[robot]()
    return chain, middle + width * uniform(rng, n, chain.n_actuators)


def disturbed(chain, q, rng, size=0.02, noise=0.0):
    """Return a chain whose coordinates are off, each by some `size` at the tip [m], and its log."""
    features = QuadraticFeatures.of_range(q)
    z = chain.coordinates(q)[0]
    moved = chain.from_coordinates_and_jacobian(z)[1].square().sum(1).mean(0).sqrt()
    weights = size * uniform(rng, len(moved), features(q).shape[1]) / (1.0 + moved[:, None])
    truth = hybrid(chain, Readout(features, weights))
    x = truth(q)
    return truth, x + noise * torch.randn(x.shape, generator=rng, dtype=x.dtype)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["trunk", "cables", "arm"])
def test_planted_correction_is_recovered(robot, rng):
    chain, q = rows_of(robot, rng, 500)
    truth, x = disturbed(chain, q, rng)
    fit = read_out(chain, QuadraticFeatures.of_range(q), q, x, alphas=(1e-9, 1e-9))
    q_new = rows_of(robot, rng, 200)[1].clamp(q.amin(0), q.amax(0))
    assert (chain(q_new) - truth(q_new)).norm(dim=1).mean() > 1e-3
    assert_close(hybrid(chain, fit.readout)(q_new), truth(q_new), atol=1e-5, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["trunk", "tendons", "arm"])
@pytest.mark.parametrize("kind", ["linear", "quadratic", "hidden"])
def test_gradient_is_zero_at_the_optimum(robot, kind, rng):
    chain, q = rows_of(robot, rng, 80)
    x = disturbed(chain, q, rng, noise=0.003)[1]
    weight = torch.rand(80, generator=rng, dtype=torch.float64)
    fit = read_out(
        chain, some_features(kind, q, rng), q, x, sample_weight=weight, alphas=(0.03, 0.3)
    )
    assert fit.gradient < 1e-7
    # By autograd, in the problem's own variables, and no neighbour is better.
    problem = _ReadoutProblem(chain, fit.readout.features, q, x, weight, Groups.rows(80), True)
    penalty = problem.penalty((0.03, 0.3))
    readout, _ = problem.minimum(problem.nothing, penalty)

    def objective(readout):
        z = problem.z + problem.units * (problem.phi @ readout.mT)
        distance = (x - chain.from_coordinates_and_jacobian(z)[0]).square().sum(1)
        return (weight * distance).sum() + (penalty * readout.square()).sum()

    gradient = torch.func.grad(objective)
    assert gradient(readout).norm() < 1e-7 * gradient(problem.nothing).norm()
    for _ in range(3):
        move = 1e-3 * uniform(rng, *readout.shape)
        assert objective(readout + move) > objective(readout)


@pytest.mark.parametrize("n", [150, 1500])
def test_down_to_the_noise_held_out_rows_are_predicted_as_well(n, rng):
    """The search takes part of the steps; of many rows every second one chooses the penalties."""
    chain, q = rows_of("trunk", rng, n + 300)
    truth, x = disturbed(chain, q, rng, noise=0.003)
    features = QuadraticFeatures.of_range(q[:n])
    errors = []
    for exact in (True, False):
        fit = read_out(chain, features, q[:n], x[:n], exact=exact)
        predicted = hybrid(chain, fit.readout)(q[n:])
        errors.append(float((predicted - truth(q[n:])).norm(dim=1).mean()))
        assert (fit.gradient < 1e-7) == exact
        assert bool(fit.scores) == (exact or n == 150)  # of few rows all choose
    assert errors[1] < 1.05 * errors[0]
    assert errors[1] < 0.2 * float((chain(q[n:]) - truth(q[n:])).norm(dim=1).mean())


def test_no_motion_is_missing_among_the_rows_that_choose_penalties(rng):
    """The second row is not among the evenly spaced ones: as a motion it makes all rows choose."""
    chain, q = rows_of("cables", rng, 2200)
    x = disturbed(chain, q, rng, noise=0.003)[1]
    row = torch.arange(2200)
    for groups, all_choose in ((row % 2, False), ((row == 1).long(), True)):
        fit = read_out(chain, Features.of_range(q), q, x, groups=groups, exact=False)
        assert bool(fit.scores) == all_choose
        assert not torch.from_numpy(fit.residual).isnan().any()


def ridge(rng, unused, n=30, m=3, C=4, K=7, n_linear=0):
    rows = uniform(rng, n, m, C), uniform(rng, n, K), uniform(rng, n, m)
    linear = Linearised(*rows, n_linear=n_linear)
    penalty = torch.rand(K, generator=rng, dtype=torch.float64) + 0.1
    penalty[unused] = inf
    return linear, penalty


def solved(linear, penalty, rows):
    """The plain ridge solution of some rows, from scratch."""
    A = design(linear.J, linear.phi)[rows].flatten(0, 1)
    kept = torch.isfinite(penalty).repeat(linear.J.shape[2])
    weights = torch.zeros(A.shape[1], dtype=A.dtype)
    A = A[:, kept]
    size = penalty.repeat(linear.J.shape[2])[kept].diag()
    weights[kept] = torch.linalg.solve(A.mT @ A + size, A.mT @ linear.y[rows].flatten())
    return weights.reshape(linear.J.shape[2], -1)


@pytest.mark.parametrize("n_linear", [0, 2, 3, 7])
@pytest.mark.parametrize("sizes", [None, [1] * 30, [3] * 10, [2, 28], [15, 14, 1]])
@pytest.mark.parametrize("unused", [[], [2]])
def test_rows_left_out_equal_fits_without_them(unused, sizes, n_linear, rng):
    linear, penalty = ridge(rng, unused, n_linear=n_linear)
    groups = (
        torch.arange(30)
        if sizes is None
        else torch.arange(len(sizes)).repeat_interleave(torch.tensor(sizes))
    )
    groups = groups[torch.randperm(30, generator=rng)]
    motions = Groups(groups.numpy(), sizes is not None)
    linear.left_out(2.0 * penalty, motions)  # another penalty before changes nothing
    found = linear.left_out(penalty, motions)
    for label in groups.unique():
        out = groups == label
        expected = linear.residual(solved(linear, penalty, ~out))[out]
        assert_close(found[out], expected, atol=1e-10, rtol=1e-10)


@pytest.mark.parametrize("coupling", ["serial", "parallel"])
def test_no_correction_is_the_mechanical_model(coupling, rng):
    chain, q = rows_of("trunk", rng, 40)
    x = disturbed(chain, q, rng, noise=0.003)[1]
    features = QuadraticFeatures.of_range(q)
    fit = read_out(chain, features, q, x, coupling=coupling, alphas=(inf, inf))
    assert_close(hybrid(chain, fit.readout, coupling)(q), chain(q))
    assert_close(hybrid(chain, fit.readout, coupling).jacobian(q), chain.jacobian(q))
    assert_close(torch.from_numpy(fit.residual), x - chain(q))
    near = read_out(chain, features, q, x, coupling=coupling, alphas=(1e12, 1e12))
    assert_close(hybrid(chain, near.readout, coupling)(q), chain(q), atol=1e-9, rtol=0)
    linear = read_out(chain, features, q, x, coupling=coupling, alphas=(0.1, inf))
    plain = read_out(chain, Features.of_range(q), q, x, coupling=coupling, alphas=(0.1, 1.0))
    assert_close(
        hybrid(chain, linear.readout, coupling)(q),
        hybrid(chain, plain.readout, coupling)(q),
        atol=1e-9,
        rtol=0,
    )


def test_at_the_tip_it_is_ridge_regression_on_the_error(rng):
    chain, q = rows_of("trunk", rng, 50)
    x = disturbed(chain, q, rng, noise=0.003)[1]
    features = Features.of_range(q)
    fit = read_out(chain, features, q, x, coupling="parallel", alphas=(0.5, inf))
    phi = features(q)
    expected = torch.linalg.solve(phi.mT @ phi + 0.5 * torch.eye(10), phi.mT @ (x - chain(q)))
    assert_close(fit.readout.weights, expected.mT)


def test_pure_noise_chooses_no_correction(rng):
    chain, q = rows_of("trunk", rng, 120)
    x = chain(q) + 0.005 * torch.randn(120, 3, generator=rng, dtype=torch.float64)
    fit = read_out(chain, QuadraticFeatures.of_range(q), q, x)
    assert (hybrid(chain, fit.readout)(q) - chain(q)).norm(dim=1).mean() < 5e-4
    assert fit.scores[inf, inf] <= 1.01 * min(fit.scores.values())
