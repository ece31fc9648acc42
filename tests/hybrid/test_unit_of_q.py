"""The same robot in metres and in counts: the same hybrid, domain, and inverse kinematics."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin import (
    Commands,
    ConstantCurvatureChain,
    HybridForwardModel,
    InverseKinematics,
    choose_rows,
)

GAIN, ZEROS = 2.5e-5, np.array([500.0, -200.0, 0.0, 30.0, 1000.0, 2048.0])
PLAIN = ConstantCurvatureChain([0.01, 0.008], lengths=[0.1, 0.08])
COUNTED = ConstantCurvatureChain(
    [0.01, 0.008], lengths=[0.1, 0.08], gains=GAIN, actuator_zeros=ZEROS
)
NAMES = ["elm", "pose", "kernel"]


@pytest.fixture(scope="module")
def log():
    """Eight motions of tendons [m] and tips of a robot that differs; simulated."""
    rng = np.random.default_rng(0)
    t = np.linspace(0, 2 * np.pi, 20)
    waves = rng.uniform(-0.35, 0.35, (8, 4, 2)) @ np.stack([np.sin(t), np.cos(2 * t)])
    bends = waves.transpose(0, 2, 1).reshape(-1, 2, 2)
    at = 2 * np.pi * np.arange(3) / 3
    q = -(np.array([0.01, 0.008])[:, None] * (bends @ np.stack([np.cos(at), np.sin(at)])))
    q = q.reshape(-1, 6) + 3e-4 * rng.standard_normal((len(q), 6))
    truth = ConstantCurvatureChain([0.0092, 0.0086], lengths=[0.1, 0.08], rest_bends=0.06)
    bent = torch.from_numpy(q + 3.0 * q[:, ::-1] ** 2)
    x = truth(bent).numpy() + 2e-4 * rng.standard_normal((len(q), 3))
    return q, x, np.repeat(np.arange(8), 20)


def counts(q):
    return q / GAIN + ZEROS


def both(log, **options):
    q, x, groups = log
    pair = [
        HybridForwardModel(chain, random_state=0, **options).fit(rows, x, groups=groups)
        for chain, rows in ((PLAIN, q), (COUNTED, counts(q)))
    ]
    return [*pair, np.random.default_rng(1).uniform(0.5, 1.6, (40, 6)) * q[:80:2]]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* pull the tendons of a segment together")
@pytest.mark.parametrize("name", NAMES)
def test_every_error_model(log, name):
    plain, counted, rows = both(log, error_model=name, calibrate=("radii", "base"))
    x, J = plain.predict_and_jacobian(rows)
    y, slope = counted.predict_and_jacobian(counts(rows))
    assert_allclose(y, x, atol=1e-8)
    assert_allclose(slope / GAIN, J, atol=1e-6)
    assert_array_equal(counted.in_domain(counts(rows)), plain.in_domain(rows))
    assert not plain.in_domain(rows).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* pull the tendons of a segment together")
def test_serial_coupling_and_play(log):
    options = {"error_model": "quadratic", "coupling": "serial"}
    plain, counted, rows = both(log, **options)
    assert_allclose(counted.predict(counts(rows)), plain.predict(rows), atol=1e-8)
    q, x, groups = log
    plain = HybridForwardModel(PLAIN, hysteresis="auto", random_state=0).fit(q, x, groups=groups)
    counted = HybridForwardModel(COUNTED, hysteresis="auto", random_state=0)
    counted.fit(counts(q), x, groups=groups)
    assert (not plain.hysteresis_) == (not counted.hysteresis_)
    found = [
        HybridForwardModel(chain, hysteresis=width, random_state=0).fit(rows, x, groups=groups)
        for chain, width, rows in ((PLAIN, 5e-4, q), (COUNTED, 5e-4 / GAIN, counts(q)))
    ]
    x, y = (m.predict(Commands(r, groups)) for m, r in zip(found, (q, counts(q)), strict=True))
    assert_allclose(y, x, atol=1e-8)


def test_adaptation_and_rows_to_measure(log):
    q, x, groups = log
    plain, counted, _ = both(log, error_model="elm")
    moved = x[:40] + np.array([0.01, -0.005, 0.002])
    for model, rows in ((plain, q), (counted, counts(q))):
        model.adapt(rows[:40], moved, groups=groups[:40])
    assert_allclose(counted.predict(counts(q)), plain.predict(q), atol=1e-8)
    chosen = [choose_rows(chain, rows, 5)[0] for chain, rows in ((PLAIN, q), (COUNTED, counts(q)))]
    assert_array_equal(*chosen)


@pytest.mark.parametrize("learned", [False, True])
def test_inverse_kinematics(log, learned):
    q, x, _ = log
    limit, fast = 0.006, 0.02
    models = both(log, error_model="elm")[:2] if learned else (PLAIN, COUNTED)
    iks = [
        InverseKinematics(model, q_min=low, q_max=high, dq_max=speed, q_pref=home)
        for model, low, high, speed, home in (
            (models[0], -limit, limit, fast, np.zeros(6)),
            (models[1], counts(-limit), counts(limit), fast / GAIN, ZEROS),
        )
    ]
    start = q[:5]
    steps = [ik.step(rows, x[5:10]) for ik, rows in zip(iks, (start, counts(start)), strict=True)]
    assert_allclose(steps[1].dq * GAIN, steps[0].dq, atol=1e-10)
    solved = [ik.solve(x[:20], restarts=3) for ik in iks]
    assert_array_equal(solved[0].status, solved[1].status)
    assert_allclose((solved[1].q - ZEROS) * GAIN, solved[0].q, atol=1e-7)
    tracks = [ik.track(x[:20], q0=rows) for ik, rows in zip(iks, (q[0], counts(q[0])), strict=True)]
    assert_allclose((tracks[1].q - ZEROS) * GAIN, tracks[0].q, atol=1e-8)
    trackers = [ik.tracker(rows) for ik, rows in zip(iks, (q[0], counts(q[0])), strict=True)]
    one = other = np.zeros(6)
    for target in x[:10]:
        one, other = (tracker.step(target) for tracker in trackers)
    assert_allclose((other - ZEROS) * GAIN, one, atol=1e-8)
