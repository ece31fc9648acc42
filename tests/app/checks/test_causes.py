"""Causes recover planted amounts, and the simplest that explains the error is named."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from hybridkin import ConstantCurvatureChain, Hysteresis
from hybridkin.app.checks.causes.alignment import Alignment, FreeBase, FreeOrigin
from hybridkin.app.checks.causes.comparison import CAUSES, compare_causes
from hybridkin.app.checks.causes.evidence import Actuators, Evidence
from hybridkin.app.checks.causes.motion import Motion
from hybridkin.app.checks.causes.separation import separating_motion

CHAIN = ConstantCurvatureChain([0.03, 0.03], lengths=None)
TENDONS = ConstantCurvatureChain([0.005, 0.006], lengths=[0.1, 0.08], routing="base")
NAMES = [f"m{i + 1}" for i in range(6)]
N, PERIOD = 240, 0.1


def smooth(low, high, seed=0, n=N):
    """Return smooth motions of six actuators within a range."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, n)[:, None]
    waves = sum(
        np.sin(2.0 * np.pi * (k * t + rng.random(6))) * rng.uniform(0.3, 1.0, 6) for k in (1, 2, 3)
    )
    return 0.5 * (low + high) + 0.5 * (high - low) * waves / np.abs(waves).max()


Q = smooth(0.08, 0.14)


def tips(q, chain=CHAIN):
    with torch.no_grad():
        return chain(torch.from_numpy(np.ascontiguousarray(q))).numpy()


def evidence(x, q=Q, chain=CHAIN, alignment=None, noise=2e-5, seed=1):
    """Return the evidence of tips measured along q, with noise."""
    x = x + noise * np.random.default_rng(seed).standard_normal(x.shape)
    n_rows = len(q)
    return Evidence(
        motion=Motion.of(q, PERIOD * np.arange(n_rows), None),
        rows=np.arange(n_rows),
        x=x,
        model=chain,
        path=tips(q, chain),
        bodies=[chain],
        actuators=Actuators(NAMES, "mm", np.full(6, 1e-3), chain.actuator_layout),
        inside=np.ones(n_rows, dtype=bool),
        off_plane=np.zeros_like(q),
        promised=1.6 * noise,
        low=q.min(axis=0),
        high=q.max(axis=0),
        alignment=alignment or Alignment(),
    )


def with_column(i, change):
    q = Q.copy()
    q[:, i] = change(q[:, i])
    return tips(q)


AFTER = np.arange(N) >= 130
TURN = Rotation.from_rotvec([0.02, -0.03, 0.01])
SHIFT = np.array([0.004, -0.002, 0.003])
FAULTS = {
    "unit": (10.0 * tips(Q), "unit of the tips", "10 times"),
    "inches": (tips(Q) / 25.4, "unit of the tips", "inches were read as millimetres"),
    "swapped axes": (tips(Q)[:, [1, 0, 2]], "axes of the tips", "y, x, z"),
    "mirror": (tips(Q) * [1, 1, -1], "axes of the tips", "x, y, -z"),
    "late": (np.concatenate([tips(Q)[:1]] * 4 + [tips(Q)[:-4]]), "lag", "4 rows after"),
    "early": (np.concatenate([tips(Q)[3:]] + [tips(Q)[-1:]] * 3), "lag", "3 rows before"),
    "base": (TURN.apply(tips(Q)) + SHIFT, "moved base", "2.14 degrees"),
    "bump": (
        np.where(AFTER[:, None], TURN.apply(tips(Q)) + SHIFT, tips(Q)),
        "bump",
        "at row 130: turned by 2.14 degrees",
    ),
    "zero": (with_column(3, lambda q: q + 2e-3), "zero of one actuator", "m4 is off by +2 mm"),
    "slip": (
        with_column(4, lambda q: q - 3e-3 * AFTER),
        "slip of one actuator",
        "m5 by -3 mm at row 130",
    ),
    "gain": (with_column(1, lambda q: 0.8 * q), "gain of one actuator", "m2 moves 0.8 times"),
    "all gains": (tips(0.93 * Q), "gain of all actuators", "0.93 times"),
    "dead": (with_column(2, lambda q: 0.11 + 0.0 * q), "dead actuator", "m3 stands at +110 mm"),
    "swap": (tips(Q[:, [0, 4, 2, 3, 1, 5]]), "two actuators swapped", "m2 and m5"),
    "numbering": (tips(Q[:, [0, 2, 1, 3, 5, 4]]), "numbering in the other direction", ""),
    "backlash": (tips(Hysteresis.backlash(4e-3).apply(Q)[0]), "backlash", "4 mm wide"),
    "creep": (
        tips(Hysteresis.creep([0.3], [2.0]).apply(Q, dt=np.full(N, PERIOD))[0]),
        "creep",
        "30 % of every change comes with a time constant of 2 s",
    ),
    "misread": (tips(Q) + 0.05 * (np.abs(np.arange(N) - 60.0) < 8)[:, None], "misread rows", "53"),
    "drift": (tips(Q) + np.linspace(0, 1, N)[:, None] * SHIFT, "drift", "mm from begin to end"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_cause_is_named_with_its_amount(fault):
    x, name, words = FAULTS[fault]
    given = evidence(x)
    compared = compare_causes(given)
    likely = compared.likely
    assert likely.name == name
    assert words in likely.cause.amount(given, likely.parameters)
    assert compared.shares[name] > 0.95
    assert likely.mean < 5e-5  # the noise


def test_a_load_at_the_tip_is_named():
    """Of a robot whose segments bend by the moment of a force times their lengths."""
    rows = torch.from_numpy(Q)
    force = torch.tensor([0.5, -0.2, 1.0]).double()
    z, _ = CHAIN.coordinates(rows)
    for _ in range(30):
        _, columns = CHAIN.from_coordinates_and_jacobian(z)
        start, _ = CHAIN.coordinates(rows)
        moment = columns[:, :, 2:].mT @ force
        z = torch.cat([start[:, :2], start[:, 2:] + 2.0 * start[:, [0, 1, 0, 1]] * moment], dim=1)
    given = evidence(CHAIN.from_coordinates(z).detach().numpy())
    likely = compare_causes(given).likely
    assert likely.name == "payload"
    direction = likely.parameters / np.linalg.norm(likely.parameters)
    assert direction @ (force / force.norm()).numpy() > 0.99


def test_nothing_is_named_without_a_fault():
    for seed in range(10):
        compared = compare_causes(evidence(tips(Q), seed=seed))
        assert compared.likely is compared.nothing
        assert max(compared.shares.values()) < 0.2


def test_noise_is_no_cause():
    rng = np.random.default_rng(3)
    for rows in (3, 5, 20, 240):
        q = Q[:rows]
        x = tips(q) + 5e-3 * rng.standard_normal((rows, 3))
        compared = compare_causes(evidence(x, q))
        assert compared.likely is compared.nothing


def test_an_error_of_the_model_is_the_last_resort():
    z = (Q - Q.mean(axis=0)) / np.ptp(Q, axis=0)
    error = 0.02 * np.stack([z[:, 0] * z[:, 1], z[:, 2] * z[:, 3], z[:, 4] * z[:, 5]], axis=1)
    assert compare_causes(evidence(tips(Q) + error)).likely.name == "the model"


def test_what_cannot_be_told_apart_is_said_with_the_motion_that_can():
    """Where one actuator moves alone at one speed, backlash and a late camera are alike."""
    q = np.repeat(Q[:1], N, axis=0)
    q[:, 2] += 0.02 * np.linspace(0.0, 1.0, N)  # never reversed
    x = tips(Hysteresis.backlash(2e-3).apply(q)[0])
    compared = compare_causes(evidence(x, q))
    names = {compared.likely.name, *(e.name for e in compared.also)}
    assert {"backlash", "lag"} <= names
    by_name = {e.name: e for e in compared.explanations}
    given = compared.evidence
    separation = separating_motion(given, by_name["lag"], by_name["backlash"])
    assert "alone, out and back" in separation.words
    assert separation.difference > 1e-4


def test_a_cause_cannot_be_told_from_itself():
    compared = compare_causes(evidence(FAULTS["zero"][0]))
    likely = compared.likely
    separation = separating_motion(compared.evidence, likely, likely)
    assert (separation.words, separation.difference) == ("", 0.0)


@pytest.mark.parametrize("alignment", [FreeBase(), FreeOrigin()])
def test_what_is_unknown_of_the_frame_does_not_count(alignment):
    moved = tips(Q) + SHIFT
    if isinstance(alignment, FreeBase):
        moved = 1.1 * TURN.apply(moved)
    weights = np.ones(N)
    assert_allclose(alignment.aligned(tips(Q), moved, weights), moved, atol=1e-12)
    given = evidence(moved, alignment=alignment)
    assert (
        compare_causes(given, [c for c in CAUSES if c.name != "unit of the tips"]).nothing.mean
        < 1e-4
    )


def test_times_that_do_not_increase_are_not_used():
    t = PERIOD * np.arange(N)
    assert Motion.of(Q, t, None).clock == "s"
    assert Motion.of(Q, t[::-1], None).clock == "rows"
    assert Motion.of(Q, None, None).clock == "rows"
    runs = np.arange(N) // 60
    again = Motion.of(Q, t - t[60 * runs], runs)  # each run has a clock of its own
    assert again.clock == "s"
    assert again.duration == pytest.approx(59 * PERIOD)


@pytest.mark.parametrize("delay", [0.0, 0.25, -0.4, 100.0])
def test_earlier_values_are_those_of_the_same_run(delay):
    runs = np.arange(N) // 60
    t = PERIOD * (np.arange(N) % 60)
    motion = Motion.of(Q, t, runs)
    found = motion.earlier(Q, np.arange(N), delay)
    for run in range(4):
        rows = runs == run
        for column, expected in zip(found[rows].T, Q[rows].T, strict=True):
            assert_allclose(column, np.interp(t[rows] - delay, t[rows], expected), atol=1e-12)


def test_softer_robots_bend_alike_in_balance():
    """And go slack where a single tendon is let go."""
    q = smooth(-1e-3, 1e-3)
    q -= q.reshape(-1, 2, 3).mean(axis=2).repeat(3, axis=1)
    loose = q.copy()
    loose[:, 0] += 5e-3
    for soft in TENDONS.softer():
        assert np.abs(tips(q, soft) - tips(q, TENDONS)).max() < 0.3 * np.ptp(tips(q, TENDONS))
        assert soft.slack(torch.from_numpy(loose))[:, 0].all()
    assert CHAIN.softer() == []


def test_balanced_tendons_have_no_motion_along_the_balance():
    balance = TENDONS.actuator_layout.balance
    assert balance.shape == (6, 2)
    bends = np.random.default_rng(0).standard_normal((20, 4))
    readings = TENDONS._readings().numpy()[:, 2:]
    assert_allclose(bends @ readings.T @ balance, 0.0, atol=1e-12)
    assert CHAIN.actuator_layout.balance.shape == (6, 0)
