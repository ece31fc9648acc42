"""Learned corrections, guards and hybrids in the compiled core against the same in torch."""

import copy
import pickle

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from saved_models import FOLDER

from hybridkin import ConstantCurvatureChain, load_model
from hybridkin.hybrid._features import (
    Features,
    HiddenFeatures,
    PoseFeatures,
    QuadraticFeatures,
    Readout,
)
from hybridkin.hybrid._guards import GroupDistance, LeverageGuard, QuadraticLeverage
from hybridkin.hybrid._module import HybridModule, InnerCorrection, TipCorrection
from hybridkin.learning.network import ELM
from hybridkin.learning.regressor_modules import AffineModule, KernelModule
from hybridkin.native import backend
from hybridkin.native.library import evaluate, program_of

pytestmark = pytest.mark.needs_core

N = 6
CENTER, HALF = 0.2 + 0.01 * np.arange(N), 0.03 + 0.005 * np.arange(N)
WITHOUT_KERNEL = ("pose_output", "adapted_pose")
STORED = [path for path in sorted(FOLDER.glob("*.safetensors")) if path.stem not in WITHOUT_KERNEL]
NETWORKS = ("logistic", "tanh", "sin", "centred", "full", "low rank")
TIP = (*NETWORKS, "affine", "kernel", "linear", "quadratic", "hidden", "pose")
INNER = ("linear", "quadratic", "hidden", "pose")


def chain():
    return ConstantCurvatureChain([0.05, 0.06], offsets=[0.02, 0.03])


def draw(*shape, seed=0):
    return np.random.default_rng([seed, *shape]).normal(size=shape)


def network(kind, m=3, n=N, n_hidden=21):
    """A network; "centred" has an intercept and a direct link, "full" a full leverage factor.

    That of "low rank" has a prior, and less columns than features.
    """
    direct = kind != "logistic"
    f = n_hidden + n * direct
    factor, prior = draw(f, f) if kind == "full" else np.triu(draw(f, f)), 0.0
    if kind == "low rank":
        factor, prior = np.linalg.qr(draw(f, f))[0][:, : f - 7], 0.0101
    return ELM(
        kind if kind in ("tanh", "sin") else "logistic",
        input_weights=draw(n_hidden, n),
        input_bias=draw(n_hidden),
        input_center=np.resize(CENTER, n),
        input_scale=np.resize(HALF, n),
        output_weights=0.002 * draw(f, m),
        intercept=0.001 * draw(m),
        leverage_center=0.3 * draw(f, seed=1) if kind == "centred" else np.zeros(f),
        leverage_factor=0.1 * factor,
        leverage_offset=0.02 if kind == "centred" else 0.0,
        leverage_prior=prior,
    )


def readout(kind, m):
    center, scale = torch.from_numpy(CENTER), torch.from_numpy(HALF)
    hidden = torch.from_numpy(draw(10, N)), torch.from_numpy(draw(10, seed=2))
    features = {
        "linear": lambda: Features(center, scale),
        "quadratic": lambda: QuadraticFeatures(center, scale),
        "hidden": lambda: HiddenFeatures(center, scale, *hidden, activation="tanh"),
        "pose": lambda: PoseFeatures(center, scale, chain().with_tip(1.5)),
    }[kind]()
    size = features(center).shape[-1]
    return Readout(features, torch.from_numpy(0.002 * draw(m, size)))


def regressor(kind, m=3):
    if kind in NETWORKS:
        return network(kind, m)
    if kind == "affine":
        return AffineModule(0.05 * draw(m, N), 0.002 * draw(m))
    if kind == "kernel":
        return KernelModule(0.6 * draw(21, N), 0.004 * draw(21, m), 0.001 * draw(m), CENTER, HALF)
    return readout(kind, m)


def guard(kind, module, largest=0.01):
    longest = torch.tensor(largest).double()
    if kind is None:
        return None
    rows = torch.from_numpy(inputs(1.0, 40))
    model = module if kind == "own" else QuadraticLeverage.fit(rows)
    return LeverageGuard(model, model.leverage(rows).quantile(0.9).detach(), longest)


def drift(m=3):
    return AffineModule(0.02 * draw(m, N, seed=3), 0.001 * draw(m, seed=3))


def inputs(spread, n_rows, seed=0):
    u = np.random.default_rng(seed).uniform(-1, 1, (n_rows, N))
    return CENTER + spread * HALF * u


def assert_close_rows(found, expected, tol=1e-12):
    """The largest error over the largest number; NaN at the same rows."""
    assert_array_equal(np.isnan(found), np.isnan(expected))
    scale = np.nanmax(np.abs(expected), initial=1e-12)
    assert_allclose(found, expected, rtol=0, atol=tol * scale)


def in_torch(module, q):
    """Value, Jacobian, distance and its slope by torch."""
    rows = torch.from_numpy(q).requires_grad_()
    distance = module.domain_distance(rows)
    total = distance.sum()
    slope = torch.autograd.grad(total, rows)[0] if total.requires_grad else torch.zeros_like(rows)
    with torch.no_grad():
        x, J = module.forward_and_jacobian(rows)
    return [part.detach().numpy() for part in (x, J, distance, slope)]


def assert_as_in_torch(module, q, tol=1e-12):
    """Batches and single rows; a row of NaN changes no other."""
    program = program_of(module)
    assert program is not None, backend(module)
    expected = in_torch(module, q)
    found = *program.evaluate(q, True, True), program.domain(q, slope=True)[1]
    for ours, theirs in zip(found, expected, strict=True):
        assert_close_rows(ours, theirs, tol)
    # Without the distance, an upper bound of it may be enough.
    for ours, theirs in zip(program.evaluate(q, True)[:2], expected, strict=False):
        assert_close_rows(ours, theirs, tol)
    for k in range(0, len(q), 5):
        row = *program.evaluate(q[k], True, True), program.domain(q[k], slope=True)[1]
        row += program.evaluate(q[k], True)[:2]
        for ours, theirs in zip(row, (*found, *found[:2]), strict=True):
            size = np.abs(theirs).max()
            assert_allclose(ours, theirs[k], rtol=0, atol=tol * size)
    broken = q.copy()
    broken[3, 2] = np.nan
    nan = *program.evaluate(broken, True, True), program.domain(broken, slope=True)[1]
    assert np.isnan(nan[0][3]).all()
    for ours, theirs in zip(nan, found, strict=True):
        assert_array_equal(np.delete(ours, 3, 0), np.delete(theirs, 3, 0))


def hybrid(kind, coupling="parallel", trust=None, drifting=False, weight=1.0):
    mechanical = chain()
    if coupling == "serial":
        module = regressor(kind, 6)
        correction = InnerCorrection(module, guard(trust, module))
    else:
        module = regressor(kind)
        correction = TipCorrection(module, guard(trust, module))
    weights = torch.tensor([weight], dtype=torch.float64)
    return HybridModule(mechanical, [correction], weights, drift() if drifting else None)


ALL = [
    *(("parallel", kind, trust) for kind in TIP for trust in (None, "leverage")),
    *(("parallel", kind, "own") for kind in NETWORKS),
    *(("serial", kind, trust) for kind in INNER for trust in (None, "leverage")),
]


@pytest.mark.parametrize(("coupling", "kind", "trust"), ALL)
@pytest.mark.parametrize(("drifting", "weight"), [(False, 1.0), (True, 0.6)])
def test_hybrids_are_those_of_torch(coupling, kind, trust, drifting, weight):
    module = hybrid(kind, coupling, trust, drifting, weight)
    for spread in (0.3, 1.2, 20.0):
        assert_as_in_torch(module, inputs(spread, 19), tol=2e-12 if spread > 10 else 1e-12)


@pytest.mark.parametrize("coupling", ["parallel", "serial"])
def test_corrections_beside_the_limits_of_domain_and_weight(coupling):
    """Rows within the domain, outside it but in full, and faded, also side by side in a block."""
    module = hybrid("quadratic", coupling, "leverage", drifting=True)
    module.corrections[0].guard.largest.fill_(1.0)
    q = inputs(1.5, 200)
    distance = module.domain_distance(torch.from_numpy(q)).detach().numpy()
    inside, full = distance <= 1.0, (distance > 1.0) & (distance <= 3.0)
    faded = (distance > 3.0) & (distance < 6.0)
    assert min(inside.sum(), full.sum(), faded.sum()) > 5
    free = hybrid("quadratic", coupling, None, drifting=True)
    whole, found = (program_of(m).evaluate(q, True) for m in (free, module))
    for ours, theirs in zip(found[:2], whole[:2], strict=True):
        assert_close_rows(ours[inside | full], theirs[inside | full], 1e-12)
        assert np.abs(ours[faded] - theirs[faded]).max() > 1e-4
    for rows in (inside, full, faded, inside | faded):
        assert_as_in_torch(module, q[rows])


@pytest.mark.parametrize("n_rows", [2, 8, 21, 400])
def test_distance_from_other_groups(n_rows):
    """Rows where the guard decides beside rows where the groups do; also for balanced tendons."""
    module = hybrid("quadratic", "serial", "leverage", drifting=True)
    rows, groups = torch.from_numpy(inputs(1.0, n_rows, seed=7)), np.arange(n_rows) % 7
    q = inputs(1.2, 38)
    at = torch.from_numpy(q)
    for balance in (torch.eye(N), torch.eye(N) - 1 / N):
        module.tested = tested = GroupDistance.fit(rows @ balance.double(), groups)
        own = tested.domain_distance(at)
        middle = (own / module.corrections[0].guard.domain_distance(at)).median()
        tested.farthest *= 1.01 * middle.sqrt()  # no row in between
        decided = (module.domain_distance(at) == tested.domain_distance(at)).sum()
        assert 0 < decided < len(q)
        for spread in (0.3, 1.2, 20.0):
            assert_as_in_torch(module, inputs(spread, 38))


@pytest.mark.parametrize("path", STORED, ids=lambda path: path.stem)
def test_stored_models_of_every_kind(path):
    model = load_model(path)
    module = getattr(model, "module_", model).double()
    with np.load(FOLDER / "predictions.npz") as said:
        near, far = said[f"{path.stem}.q"]
    rng = np.random.default_rng(0)
    for spread in (0.1, 0.6, 3.0):
        q = near + spread * np.abs(far - near) * rng.uniform(-1, 1, (19, len(near)))
        program = program_of(module)
        assert program is not None, backend(module)
        x, J, distance = in_torch(module, q)[:3]
        found = program.evaluate(q, True, True)
        for ours, theirs in zip(found, (x, J, distance), strict=True):
            assert_close_rows(ours, theirs, 2e-11)


def test_writes_to_a_large_factor_are_seen():
    """The core reads it where it is; what needs a copy of its own gets another program."""
    large = network("low rank", n_hidden=90)
    rows = inputs(3.0, 19)
    module = HybridModule(None, [TipCorrection(large, guard("own", large))], torch.ones(1).double())
    shared = program_of(module)
    (columns,) = shared.plan.shared.values()
    assert columns.ctypes.data == large.leverage_factor.data_ptr()
    for change in (
        lambda: large.leverage_factor.numpy().__imul__(0.9),
        lambda: setattr(large.leverage_factor, "data", 0.7 * large.leverage_factor),
        lambda: setattr(large, "leverage_factor", 0.6 * large.leverage_factor),
        lambda: large.leverage_factor.data.mul_(0.5),
        lambda: setattr(large.leverage_factor, "data", (0.9 * large.leverage_factor).contiguous()),
    ):
        before = evaluate(module, rows, distance=True)
        change()
        found = evaluate(module, rows, distance=True)
        assert np.abs(found[1] - before[1]).max() > 0.0
        expected = in_torch(module, rows)
        assert_close_rows(found[0], expected[0])
        assert_close_rows(found[1], expected[2])
        assert program_of(module) is not shared
        shared = program_of(module)
    for copied in (copy.deepcopy(shared), pickle.loads(pickle.dumps(shared))):
        assert_array_equal(copied.evaluate(rows, False, True)[1], shared.domain(rows)[0])


def test_parts_without_kernel_leave_the_model_to_torch():
    large = network("full", n_hidden=3000, n=1)
    corrections = [TipCorrection(large, LeverageGuard(large, torch.ones(()), torch.ones(())))]
    module = HybridModule(None, corrections, torch.ones(1))
    assert program_of(module) is None
    assert "features" in backend(module)
