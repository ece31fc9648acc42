import numpy as np
import pytest
import torch
from compiled import random_settings

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    HybridForwardModel,
    InverseKinematics,
    datasets,
    robots,
)
from hybridkin._core.plan import NoKernel, Plan
from hybridkin.ik.results import IKStatus
from hybridkin.ik.tasks import PointsTask, PoseTask, PositionTask

pytestmark = pytest.mark.needs_core

BHA = robots.bionic_handling_assistant()
TENDONS = ConstantCurvatureChain([0.02] * 3, lengths=[0.1] * 3, routing="base")
CHAINS = {
    "trunk": (BHA, 0.1, 0.4),
    "two segments": (ConstantCurvatureChain([0.1, 0.093]), 0.1, 0.4),
    "one segment": (ConstantCurvatureChain([0.1]), 0.1, 0.4),
    "four chambers": (ConstantCurvatureChain([0.1, 0.09, 0.08], n_actuators=4), 0.1, 0.4),
    "tendons": (TENDONS, -0.02, 0.02),
    "elastic tendons": (ElasticTendonChain([0.02] * 2, [0.1] * 2), -0.02, 0.02),
}
# The singular values are good to the root of the precision.
ATOL = {"dq": 1e-9, "x": 1e-12, "error": 1e-12, "sigma_min": 1e-5, "damping": 1e-5}


def random_rows(draw, chain, low, high, rows, settings):
    """Rows inside, outside and at the limits, bent and nearly straight, and some not finite."""
    n = chain.n_actuators
    q = draw.uniform(low, high, (rows, n))
    q[::4] += 0.3 * (high - low) * draw.standard_normal((len(q[::4]), n))
    q[1::4] = np.where(draw.random((len(q[1::4]), n)) < 0.4, settings["q_min"], q[1::4])
    q[2::8] = q[2::8, :1] + 1e-4 * (high - low) * draw.standard_normal((len(q[2::8]), n))
    near = torch.from_numpy(np.where(draw.random((rows, 1)) < 0.5, q, draw.uniform(low, high, n)))
    x = chain(near).numpy() + 10.0 ** draw.uniform(-4, -1) * draw.standard_normal((rows, 3))
    q[5, 0], q[13, 1], x[21, 2], x[29, 0] = np.nan, np.inf, np.nan, -np.inf
    return q, x


def in_torch(*arrays):
    return [None if a is None else torch.from_numpy(a) for a in arrays]


@pytest.mark.slow
@pytest.mark.parametrize("name", CHAINS)
def test_steps_are_those_of_torch(name):
    chain, low, high = CHAINS[name]
    draw, held = np.random.default_rng(0), 0
    for _ in range(12):
        limits = (np.full(chain.n_actuators, bound) for bound in (low, high))
        settings = random_settings(*limits, draw)
        settings["damping"] = settings["damping"] or 0.01  # without any, rounding is as large
        ik = InverseKinematics(chain, **settings)
        q, x = random_rows(draw, chain, low, high, 160, settings)
        dx = draw.choice([0.0, 0.1]) * draw.standard_normal(x.shape)
        tip = x + 0.01 * draw.standard_normal(x.shape) if draw.random() < 0.3 else None
        ours = ik.step(q, x, dx, x_measured=tip)
        q_torch, x_torch, dx_torch, tip_torch = in_torch(q, x, dx, tip)
        theirs = ik.step(q_torch, x_torch, dx_torch, x_measured=tip_torch)
        for field, atol in ATOL.items():
            a, b = getattr(ours, field), getattr(theirs, field).numpy()
            np.testing.assert_allclose(a, b, rtol=1e-7, atol=atol, err_msg=field)
        # At a bound to the last bit or beside it.
        assert (ours.saturated != theirs.saturated.numpy()).mean() < 2e-3
        held += int(ours.saturated.sum())
        ends = [settings[end] for end in ("q_min", "q_max")]
        rows = ((q >= ends[0]) & (q <= ends[1])).all(1) & ("limits" not in settings)
        new = q[rows] + ours.dq[rows]
        assert ((new >= ends[0]) & (new <= ends[1])).all()
    assert held > 800


@pytest.mark.parametrize("memory", [np.inf, 0.05])
def test_a_stream_is_that_of_torch(memory):
    """With readings that come and go, and targets that are not known."""
    draw = np.random.default_rng(2)
    ik = InverseKinematics(BHA, q_min=0.1, q_max=0.4, dq_max=3.0, weights=np.arange(1.0, 10.0))
    q = 0.25 + 0.05 * draw.standard_normal(9)
    ours, theirs = ik.tracker(q, memory=memory), ik.tracker(torch.from_numpy(q), memory=memory)
    assert ours.backend == "compiled"
    assert theirs.backend == "torch: `q0` is no float64 array of NumPy"
    seen = set()
    for i in range(60):
        x = np.array([0.1 * np.sin(0.1 * i), 0.05, 0.75]) * draw.choice([1.0, 1.0, np.nan, 1.6])
        tip = ours.x + 0.01 if i % 3 else np.full(3, np.nan)
        given = (x, np.full(3, 0.01 * (i % 2))), {"x_measured": tip if i % 4 else None}
        np.testing.assert_allclose(
            ours.step(*given[0], **given[1]), theirs.step(*given[0], **given[1]).numpy(), atol=1e-9
        )
        assert ours.status is theirs.status
        assert ours.error == pytest.approx(theirs.error, abs=1e-9, nan_ok=True)
        seen.add(ours.status)
    assert seen >= {IKStatus.INVALID_INPUT, IKStatus.AT_LIMITS}


@pytest.mark.slow
@pytest.mark.parametrize("name", CHAINS)
def test_solutions_are_those_of_torch(name):
    chain, low, high = CHAINS[name]
    draw, n = np.random.default_rng(3), chain.n_actuators
    q = draw.uniform(low, high, (500, n))
    q[::2] = np.where(draw.random((250, n)) < 0.7, np.where(q[::2] < q.mean(), low, high), q[::2])
    x = chain(torch.from_numpy(q)).numpy() * np.where(np.arange(500) % 10, 1.0, 2.5)[:, None]
    x[7] = np.nan
    ik = InverseKinematics(chain, q_min=low, q_max=high, weights=1.0 + np.arange(n) / n)
    ours, theirs = ik.solve(x, restarts=8), ik.solve(torch.from_numpy(x), restarts=8)
    np.testing.assert_array_equal(ours.status, theirs.status.numpy())
    np.testing.assert_array_equal(ours.n_starts, theirs.n_starts.numpy())
    far = ours.status != IKStatus.CONVERGED
    np.testing.assert_allclose(ours.error[far], theirs.error.numpy()[far], rtol=1e-3, atol=1e-6)
    assert (ours.error[~far] <= 1e-4).all()
    known = np.arange(500) != 7
    assert ((ours.q[known] >= low) & (ours.q[known] <= high)).all()
    assert (far.sum() > 20) & ((~far).sum() > 300)


def test_a_track_is_that_of_torch():
    ik = InverseKinematics(BHA, q_min=0.1, q_max=0.4, dq_max=1.0, ddq_max=20.0, dt=0.02)
    phase = np.linspace(0.0, 2.0 * np.pi, 60)
    path = np.stack([0.1 * np.sin(phase), 0.06 * np.sin(2 * phase), 0.75 + 0 * phase], axis=1)
    path[20], t = np.nan, np.cumsum(0.01 + 0.01 * (np.arange(60) % 2))

    def plant(q):
        reading = BHA(torch.as_tensor(1.02 * np.asarray(q))).numpy()
        return reading if abs(q[0] - 0.26) > 0.002 else np.full(3, np.nan)

    given = {"plant": plant, "feedback": "measured", "memory": 0.1}
    ours = ik.track(path, t, q0=np.full(9, 0.25), **given)
    theirs = ik.track(*in_torch(path, t), q0=torch.full((9,), 0.25).double(), **given)
    for field in vars(ours):
        a, b = getattr(ours, field), getattr(theirs, field).numpy()
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-8, err_msg=field)


def test_what_has_no_kernel_runs_in_torch():
    q, limits = np.full(9, 0.25), {"q_min": 0.1, "q_max": 0.4}
    assert InverseKinematics(BHA, **limits).tracker(q).backend == "compiled"
    others = [
        InverseKinematics(BHA, q_pref=lambda q: 0.9 * q, **limits),
        InverseKinematics(PositionTask(lambda q: BHA(q)), **limits),
        InverseKinematics(PoseTask(BHA.with_markers([(2, 1.0, (0.01, 0.0, 0.0))])), **limits),
        InverseKinematics(PointsTask(BHA, np.linspace(0.1, 3.0, 9)), **limits),
    ]
    for ik in others:
        assert ik.tracker(q).backend.startswith("torch: ")
        with pytest.raises((TypeError, NoKernel)):
            Plan(ik.settings.write_plan)
    single = InverseKinematics(BHA, **limits).tracker(q.astype(np.float32))
    assert single.backend == "torch: `q0` is no float64 array of NumPy"


@pytest.mark.parametrize("limits", [{}, {"dq_max": 0.05}, {"ddq_max": 1.0}, {"weights": 2.0}])
def test_what_is_infinite_or_overflows_holds_still(limits):
    ik = InverseKinematics(BHA, q_min=0.1, q_max=0.4, **limits)
    q, x = np.tile(np.full(9, 0.25), (6, 1)), np.tile([0.05, 0.05, 0.75], (6, 1))
    q[0, 0], q[1, 1], x[2, 0], x[3, 0], x[4] = np.inf, -np.inf, np.inf, 1e300, 1e308
    for step in (ik.step(q, x), ik.step(*in_torch(q, x))):
        dq, sigma_min = np.asarray(step.dq), np.asarray(step.sigma_min)
        np.testing.assert_array_equal(dq[:5], 0.0)
        assert np.isfinite(dq[5]).all()
        assert dq[5].any()
        assert np.isnan(sigma_min).tolist() == [True] * 5 + [False]
    for i in range(5):
        np.testing.assert_array_equal(ik.step(q[i], x[i]).dq, 0.0)
    for tracker in (ik.tracker(q[5]), ik.tracker(torch.from_numpy(q[5]))):
        for target in x[2:5]:
            np.testing.assert_array_equal(tracker.step(target), q[5])
            assert tracker.status is IKStatus.INVALID_INPUT
    # A row that is not known in part leads the others back into the limits.
    q[0, 3] = 0.5
    dq = ik.step(q[0], x[0]).dq
    assert dq[3] < 0.0
    np.testing.assert_array_equal(np.delete(dq, 3), 0.0)


def test_steps_see_writes_to_large_buffers_and_trackers_keep_what_was():
    """Steps read the factor of the leverage where it is; a tracker has a copy of its own."""
    data = datasets.load_trunk()
    module = HybridForwardModel(BHA, random_state=0).fit(data.q[:500], data.x[:500]).module_
    low, high = data.q.min(0), data.q.max(0)
    q = low + (high - low) * np.array([1.6, -0.6, 0.5] * 3)  # where the guard fades
    assert 3.0 < float(module.domain_distance(torch.from_numpy(q))) < 300.0
    x = module(torch.from_numpy(q)).detach().numpy() + 0.01
    ik = InverseKinematics(module)
    before = ik.step(q, x).dq
    tracker, right = ik.tracker(q), ik.tracker(q)
    assert tracker.backend == "compiled"
    expected = [right.step(x) for _ in range(3)]
    factor = module.corrections[0].guard.model.leverage_factor
    factor.data.mul_(0.999)
    after = ik.step(q, x).dq
    assert np.abs(after - before).max() > 1e-9
    np.testing.assert_allclose(after, ik.step(*in_torch(q, x)).dq, rtol=0, atol=1e-9)
    for command in expected:
        np.testing.assert_array_equal(tracker.step(x), command)
    assert np.abs(ik.tracker(q).step(x) - expected[0]).max() > 1e-9
