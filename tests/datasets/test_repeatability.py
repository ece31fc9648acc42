"""The floor of the errors of functions of q, from a log that comes back to the same q."""

import numpy as np
import pytest

from hybridkin import Hysteresis
from hybridkin.datasets import repeatability

MEAN_LENGTH = np.sqrt(8.0 / np.pi)  # of a normal vector in space with unit deviations


def log(n_motions, seed, spread=1e-4):
    """Return smooth motions, each recorded twice with a small difference, and their motions."""
    rng = np.random.default_rng(seed)
    turn = np.linspace(0.0, 2.0 * np.pi, 40)
    waves = np.stack([np.sin(turn), np.sin(2.0 * turn), np.cos(turn) - 1.0])
    q = (rng.uniform(-1.0, 1.0, (n_motions, 6, 3)) @ waves).transpose(0, 2, 1)
    q = q + rng.uniform(-1.0, 1.0, (n_motions, 1, 6))
    q = np.concatenate([q, q + spread * rng.standard_normal(q.shape)])
    return q.reshape(-1, 6), np.repeat(np.arange(len(q)), 40)


def tips(q):
    return 0.05 * np.stack([np.sin(q[:, 0] + q[:, 3]), q[:, 1] * q[:, 4], np.cos(q[:, 2])], axis=1)


@pytest.mark.parametrize("noise", [2e-5, 5e-4, 5e-3])
@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_noise_is_found(noise, unit):
    for seed in range(3):
        q, motions = log(20, seed)
        x = tips(q) + noise * np.random.default_rng(seed).standard_normal((len(q), 3))
        x[::50] += 0.1  # outliers
        assert repeatability(unit * q, x, motions) == pytest.approx(MEAN_LENGTH * noise, rel=0.1)


def test_units_names_and_order_of_rows_do_not_matter():
    """Near in q is relative to the range of every actuator, e.g. a stage [rad] and tendons [m]."""
    q, motions = log(20, seed=0)
    x = tips(q) + 5e-4 * np.random.default_rng(0).standard_normal((len(q), 3))
    expected = repeatability(q, x, motions)
    order = np.random.default_rng(1).permutation(len(q))
    names = np.char.add("m", motions.astype(str))
    unit = np.array([1.0, 1e-3, 1e3, 1.0, 30.0, 1.0])
    shift = np.array([0.0, 10.0, -5.0, 0.0, 1.0, 2.0])
    assert repeatability(unit * (q + shift), x, motions) == pytest.approx(expected, rel=1e-6)
    assert repeatability(q[order], x[order], names[order]) == pytest.approx(expected, rel=1e-6)
    assert repeatability(q, 1e3 * x, motions) == pytest.approx(1e3 * expected, rel=1e-6)


def test_a_log_that_never_comes_back_cannot_tell():
    q, motions = log(20, seed=0)
    once = motions < 20
    x = tips(q) + 1e-4 * np.random.default_rng(0).standard_normal((len(q), 3))
    assert repeatability(q, x, motions) is not None
    assert repeatability(q[once], x[once], motions[once]) is None
    assert repeatability(q, x, np.zeros(len(q))) is None
    assert repeatability(q[:3], x[:3], motions[:3]) is None


def test_a_robot_that_waits_is_compared_with_other_motions():
    """Rows beside each other share the error of their motion, which counts."""
    q, motions = (np.repeat(rows, 3, axis=0) for rows in log(60, seed=0))
    rng = np.random.default_rng(1)
    of_motions = 1e-3 * rng.standard_normal((120, 3))
    x = tips(q) + of_motions[motions] + 1e-5 * rng.standard_normal((len(q), 3))
    # 60 pairs of motions: their median is within 20 %.
    assert repeatability(q, x, motions) == pytest.approx(MEAN_LENGTH * 1e-3, rel=0.2)


def test_hysteresis_counts_where_the_past_differs():
    q, motions = log(20, seed=0)
    reverse = np.concatenate(
        [np.arange(800), np.arange(800, 1600).reshape(20, 40)[:, ::-1].ravel()]
    )
    q = q[reverse]
    play = Hysteresis.backlash(0.2)
    y = play.apply_by_group(q, motions)
    noise = 1e-4 * np.random.default_rng(0).standard_normal((len(q), 3))
    floor = repeatability(q, tips(y) + noise, motions)
    assert floor > 5.0 * MEAN_LENGTH * 1e-4
    # Behind the backlash only the noise is left; a median of hundreds of pairs is within 10 %.
    left = repeatability(y, tips(y) + noise, motions)
    assert left == pytest.approx(MEAN_LENGTH * 1e-4, rel=0.1)
