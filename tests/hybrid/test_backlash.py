"""Hybrid models of robots with play: what the past tells, and what it does not."""

import contextlib
import copy

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin import Commands, HybridForwardModel, Hysteresis, InverseKinematics, robots
from hybridkin.hybrid._error_models import NoCorrection
from hybridkin.hybrid._hysteresis import choose_hysteresis
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import Spec

WIDTH = 0.02
CHAIN = robots.bionic_handling_assistant()


def tips(y):
    """Return tips of effective lengths [m], with an error to be learned; simulated."""
    with torch.no_grad():
        bent = torch.from_numpy(y) + 0.03 * torch.from_numpy(y[:, ::-1] - 0.25).square()
        return CHAIN(bent).numpy()


@pytest.fixture(scope="module")
def log():
    """Twelve motions, back and forth, of actuators with play."""
    rng = np.random.default_rng(0)
    time = np.linspace(0.0, 2.0 * np.pi, 40)
    swing = rng.uniform(-0.05, 0.05, (12, 9, 2))
    waves = np.stack([np.sin(time), np.sin(2.0 * time)])
    q = 0.25 + (swing @ waves).transpose(0, 2, 1).reshape(-1, 9)
    groups = np.repeat(np.arange(12), 40)
    y = Hysteresis.backlash(WIDTH).apply_by_group(q, groups)
    return q, tips(y) + 2e-4 * rng.standard_normal((len(q), 3)), groups


def split(log):
    test = log[2] >= 8
    return [part[~test] for part in log], [part[test] for part in log]


@pytest.mark.slow
def test_the_width_is_found_where_a_marker_is_missing(log):
    q, _, groups = log
    chain = CHAIN.with_markers([(1, 1.0), (2, 1.0)])
    with torch.no_grad():
        x = chain(torch.from_numpy(Hysteresis.backlash(WIDTH).apply_by_group(q, groups))).numpy()
    x += 2e-4 * np.random.default_rng(1).standard_normal(x.shape)
    x[::3, :3] = np.nan
    rows = Rows.of(q, x, groups=groups)
    assert abs(choose_hysteresis(Spec(chain, NoCorrection()), rows).width - WIDTH) < 0.1 * WIDTH
    nowhere = Rows.of(q, np.where(np.arange(6) < 3, np.nan, x), groups=groups)
    of_the_other = choose_hysteresis(Spec(chain, NoCorrection()), nowhere)
    assert abs(of_the_other.width - WIDTH) < 0.1 * WIDTH
    parts = np.arange(len(q)) // 20  # two of each run
    fitted = HybridForwardModel(chain, "drop", calibrate=("radii",), hysteresis=WIDTH)
    fitted.fit(Commands(q, groups), x, groups=parts)
    assert fitted.calibration_.rmse < 5e-4
    alone = HybridForwardModel(chain, "drop", calibrate=("radii",), hysteresis=WIDTH)
    alone.fit(q, x, groups=parts)
    assert alone.calibration_.rmse > 2.0 * fitted.calibration_.rmse


def test_a_given_width_is_that_of_the_value(log):
    (q, x, groups), (q_new, _, groups_new) = split(log)
    model = HybridForwardModel(CHAIN, "linear", hysteresis=WIDTH).fit(q, x, groups=groups)
    y = Hysteresis.backlash(WIDTH).apply_by_group(q, groups)
    still = HybridForwardModel(CHAIN, "linear").fit(y, x, groups=groups)
    y = Hysteresis.backlash(WIDTH).apply_by_group(q_new, groups_new)
    for method in ("predict", "jacobian", "predict_mechanical", "in_domain"):
        found = getattr(model, method)(Commands(q_new, groups_new))
        assert_array_equal(found, getattr(still, method)(y), err_msg=method)
    by_motion = model.predict(q_new, groups=groups_new)
    assert_array_equal(by_motion, model.predict(Commands(q_new, groups_new)))
    first = groups_new == groups_new[0]
    assert_array_equal(model.predict(q_new[first]), still.predict(y[first]))  # one motion


def log_with(share, motions=8, rows=20):
    """Return a log of the trunk whose play is a share of the stroke, its groups and the width."""
    rng = np.random.default_rng(1)
    time = np.linspace(0.0, 2.0 * np.pi, rows)
    swing = rng.uniform(-0.05, 0.05, (motions, 9, 2))
    waves = np.stack([np.sin(time), np.sin(2.0 * time)])
    q = 0.25 + (swing @ waves).transpose(0, 2, 1).reshape(-1, 9)
    groups = np.repeat(np.arange(motions), rows)
    width = share * np.median(np.subtract(*np.percentile(q, (95, 5), axis=0)))
    y = Hysteresis.backlash(width).apply_by_group(q, groups)
    return q, tips(y) + 2e-4 * rng.standard_normal((len(q), 3)), groups, width


def play_found(q, x, groups):
    model = HybridForwardModel(CHAIN, "drop", hysteresis="auto").fit(q, x, groups=groups)
    return model.hysteresis_.width


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.05, 0.37, 1.3])
def test_any_width_up_to_the_range_is_found(share):
    q, x, groups, width = log_with(share)
    is_coarse = share == 0.05  # a reversal lies between two rows that are farther apart
    context = contextlib.nullcontext()
    if is_coarse:
        context = pytest.warns(UserWarning, match="reverses about .* beyond the recorded rows")
    with context:
        assert play_found(q, x, groups) == pytest.approx(width, rel=0.05, abs=1e-12)


@pytest.mark.slow
def test_play_of_the_whole_range_warns():
    q, x, groups, _ = log_with(2.0)  # only the first row of each motion has an effect
    with pytest.warns(UserWarning, match="hysteresis='auto' found a backlash of .* no upper limit"):
        assert play_found(q, x, groups) > 0.95 * np.ptp(q, axis=0).max()


@pytest.mark.slow
def test_play_of_a_log_without_several_motions():
    q, x, _, _ = log_with(0.3, 1, 160)
    width = 0.3 * np.median(np.subtract(*np.percentile(q, (95, 5), axis=0)))
    for groups in (None, np.zeros(len(q))):
        assert play_found(q, x, groups) == pytest.approx(width, rel=0.05)


@pytest.mark.slow
def test_commands_for_a_path(log):
    q, x, groups = log
    model = HybridForwardModel(CHAIN, "quadratic", coupling="serial", hysteresis=WIDTH)
    model.fit(q, x, groups=groups)
    turn = np.linspace(0.0, 4.0 * np.pi, 200)
    path = np.stack([0.06 * np.cos(turn), 0.06 * np.sin(turn), np.full(200, 0.75)], axis=1)
    track = InverseKinematics(model, q_min=0.17, q_max=0.33, dt=0.05).track(path)
    np.testing.assert_allclose(model.hysteresis_.apply(track.q)[0], track.effective, atol=1e-12)
    reached = [tips(Hysteresis.backlash(WIDTH).apply(q)[0]) for q in (track.q, track.effective)]
    errors = [np.linalg.norm(x - path, axis=1).mean() for x in reached]
    assert errors[0] < 1e-3
    assert errors[1] > 5e-3  # what the play does where it is not made up for


def test_measurements_go_on_where_the_last_ones_ended(log):
    train, (q, x, _) = split(log)
    model = HybridForwardModel(CHAIN, "linear", hysteresis=WIDTH).fit(*train[:2], groups=train[2])
    rows = copy.deepcopy(model)
    model.partial_fit(q[:40], x[:40] - 0.01)
    for row, tip in zip(q[:40], x[:40] - 0.01, strict=True):
        rows.partial_fit(row[None], tip[None])
    assert_allclose(model.predict(q[:40]), rows.predict(q[:40]), atol=1e-12)


def test_clear_errors(log):
    q, x, groups = log
    for width in (-1.0, "some", [0.01, 0.02], None):
        with pytest.raises(ValueError, match=r"hysteresis|width"):
            HybridForwardModel(CHAIN, "drop", hysteresis=width).fit(q, x)
    with pytest.warns(UserWarning, match="less than the range"):
        HybridForwardModel(CHAIN, "drop", hysteresis=0.5).fit(q, x)
    model = HybridForwardModel(CHAIN, "drop", hysteresis=WIDTH).fit(q, x, groups=groups)
    with pytest.raises(ValueError, match="`runs`"):
        model.predict(Commands(q, groups[:3]))
