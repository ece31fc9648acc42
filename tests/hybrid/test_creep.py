"""Hybrid models of robots that creep, and hysteresis that goes on from group to group."""

import copy

import numpy as np
import pandas as pd
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.metrics import r2_score
from sklearn.model_selection import GroupKFold, cross_validate

from hybridkin import (
    Commands,
    HybridForwardModel,
    Hysteresis,
    load_model,
    robots,
    save_model,
)

CHAIN = robots.bionic_handling_assistant()
CREEP = Hysteresis.creep([0.15, 0.25], [3.0, 40.0])
SLIDE = Hysteresis.backlash(0.02) | CREEP


def motions(n, seed, rows=40):
    """Return commands of n motions back and forth [m], their groups and irregular times [s]."""
    rng = np.random.default_rng(seed)
    turn = np.linspace(0.0, 2.0 * np.pi, rows)
    waves = np.stack([np.sin(turn), np.sin(2.0 * turn), np.cos(turn) - 1.0])
    q = 0.25 + (rng.uniform(-0.03, 0.03, (n, 9, 3)) @ waves).transpose(0, 2, 1).reshape(-1, 9)
    return q, np.repeat(np.arange(n), rows), np.cumsum(rng.uniform(0.5, 4.0, n * rows))


def tips(y):
    with torch.no_grad():
        bent = torch.from_numpy(y) + 0.03 * torch.from_numpy(y[:, ::-1] - 0.25).square()
        return CHAIN(bent).numpy()


def log(operator, n, seed, runs=None):
    """Return commands, tips with noise, groups and times."""
    q, groups, time = motions(n, seed)
    y = operator.apply_by_group(q, groups if runs is None else runs, time)
    noise = 5e-4 * np.random.default_rng(1).standard_normal((len(q), 3))
    return q, tips(y) + noise, groups, time


def mean_error(model, operator):
    """Return the mean error of predictions on new motions [m]."""
    q, groups, time = motions(6, seed=2)
    x = tips(operator.apply_by_group(q, groups, time))
    return np.linalg.norm(model.predict(Commands(q, groups, time)) - x, axis=1).mean()


@pytest.fixture(scope="module")
def fitted():
    q, x, groups, time = log(SLIDE, 16, seed=0)
    model = HybridForwardModel(CHAIN, "quadratic", coupling="serial", hysteresis="auto")
    return model.fit(Commands(q, groups, time), x, groups=groups)


@pytest.mark.slow
def test_creep_behind_a_backlash_is_found(fitted):
    assert fitted.hysteresis_.kind == "backlash and creep"
    q, x, groups, _ = log(SLIDE, 16, seed=0)
    single = HybridForwardModel(CHAIN, "quadratic", coupling="serial", hysteresis=0.02)
    single.fit(q, x, groups=groups)
    assert mean_error(fitted, SLIDE) < 0.2 * mean_error(single, SLIDE)
    assert "backlash and creep" in fitted.html_rows()


@pytest.mark.slow
def test_creep_alone_is_found_and_nothing_where_nothing_is():
    q, x, groups, time = log(CREEP, 16, seed=0)
    model = HybridForwardModel(CHAIN, "quadratic", coupling="serial", hysteresis="auto")
    assert model.fit(Commands(q, groups, time), x, groups=groups).hysteresis_.kind == "creep"
    assert mean_error(model, CREEP) < 1e-3
    q, x, groups, time = log(Hysteresis(), 16, seed=0)
    assert not model.fit(Commands(q, groups, time), x, groups=groups).hysteresis_


@pytest.mark.slow
def test_a_file_holds_friction_and_creep(fitted, tmp_path):
    save_model(fitted, tmp_path / "model.safetensors")
    loaded = load_model(tmp_path / "model.safetensors")
    assert repr(loaded.hysteresis_) == repr(fitted.hysteresis_)
    q, groups, time = motions(2, seed=4)
    expected = fitted.predict(Commands(q, groups, time))
    assert_array_equal(loaded.predict(Commands(q, groups, time)), expected)


def test_hysteresis_goes_on_within_a_run_and_starts_anew_with_the_next():
    wide = Hysteresis.backlash(0.03)
    q, groups, _ = motions(8, seed=0)
    runs = groups // 4
    x = tips(wide.apply_by_group(q, runs))
    model = HybridForwardModel(CHAIN, "linear", hysteresis=0.03)
    model.fit(Commands(q, runs), x, groups=groups)
    still = HybridForwardModel(CHAIN, "linear")
    still.fit(wide.apply_by_group(q, runs), x, groups=groups)
    expected = still.predict(wide.apply_by_group(q, runs))
    assert_array_equal(model.predict(Commands(q, runs)), expected)
    assert np.abs(model.predict(Commands(q, groups)) - expected).max() > 1e-3
    # The change since the fit is found from rows of such runs as well.
    moved = model.adapt(
        Commands(q, runs), x + np.array([0.0, 0.0, 0.1]), parameters=["base"], groups=groups
    )
    assert_allclose(moved.change_.motion[2, 3], 0.1, rtol=0.0, atol=1e-3)


@pytest.mark.slow
def test_the_choice_uses_the_runs():
    # Each group is too short to know its start: only with runs is the backlash found well.
    q, groups, _ = motions(8, seed=0, rows=160)
    parts = np.arange(len(q)) // 20
    x = tips(Hysteresis.backlash(0.02).apply_by_group(q, groups))
    x += 5e-4 * np.random.default_rng(1).standard_normal(x.shape)
    model = HybridForwardModel(CHAIN, "linear", coupling="serial", hysteresis="auto")
    model.fit(Commands(q, groups), x, groups=parts)
    assert abs(model.hysteresis_.width - 0.02) < 0.001
    error = np.linalg.norm(model.predict(Commands(q, groups)) - x, axis=1).mean()
    model.fit(q, x, groups=parts)
    alone = np.linalg.norm(model.predict(Commands(q, groups)) - x, axis=1).mean()
    assert error < 0.9 * alone


@pytest.mark.slow
@pytest.mark.parametrize("log_of", ["markers", "gains", "repeated", "few", "still"])
def test_logs_as_they_come(log_of):
    q, x, groups, time = log(SLIDE, 10, seed=0)
    chain = CHAIN
    weights = None
    if log_of == "markers":
        chain = CHAIN.with_markers([(1, 1.0), (2, 1.0)])
        with torch.no_grad():
            y = SLIDE.apply_by_group(q, groups, time)
            x = chain(torch.from_numpy(y)).numpy()
        x[::3, :3] = np.nan
        x[1::3, 3:] = np.nan
    elif log_of == "gains":
        chain = CHAIN.with_geometry(gains=torch.full((9,), 2e-3, dtype=torch.float64))
        q = q / 2e-3
    elif log_of == "repeated":
        keep = np.repeat(np.arange(len(q)), 2)
        q, x, groups, time = q[keep], x[keep], groups[keep], time[keep]
    elif log_of == "few":
        weights = (np.arange(len(q)) % 3 > 0).astype(float)
    elif log_of == "still":
        time = np.zeros(len(q))  # of a log without a clock: no creep, but friction
    model = HybridForwardModel(chain, "linear", coupling="serial", hysteresis="auto")
    model.fit(Commands(q, groups, time), x, weights, groups=groups)
    if log_of == "still":
        assert "creep" not in model.hysteresis_.kind
        return
    assert "creep" in model.hysteresis_.kind
    error = np.nanmean(np.abs(model.predict(Commands(q, groups, time)) - x))
    assert error < 0.01


def test_wrong_runs_and_times_are_named():
    q, x, groups, time = log(CREEP, 4, seed=0)
    model = HybridForwardModel(CHAIN, "linear", hysteresis=0.02)
    with pytest.raises(ValueError, match="`runs` must"):
        Commands(q, groups[:-1])
    with pytest.raises(ValueError, match="`time` must have shape"):
        Commands(q, time=time[:-1])
    with pytest.raises(ValueError, match="`time` must not decrease within a motion"):
        model.fit(Commands(q, time=time[::-1]), x)
    model.fit(Commands(q, -groups, time), x, groups=groups)
    with pytest.raises(ValueError, match="`time` must be finite"):
        model.predict(Commands(q, groups, np.full(len(q), np.nan)))


@pytest.mark.parametrize("as_frame", [False, True])
def test_scikit_learn_splits_runs_and_times(as_frame):
    q, x, groups, time = log(SLIDE, 6, seed=0)
    commands = Commands(pd.DataFrame(q).add_prefix("q") if as_frame else q, groups, time)
    model = HybridForwardModel(CHAIN, "linear", hysteresis=SLIDE)
    results = cross_validate(model, commands, x, groups=groups, cv=GroupKFold(3))
    scores = []
    for train, test in GroupKFold(3).split(q, x, groups):
        model.fit(commands[train], x[train])
        y = SLIDE.apply_by_group(q[test], groups[test], time[test])
        scores.append(r2_score(x[test], model.module_(torch.from_numpy(y)).detach()))
    assert_allclose(results["test_score"], scores, rtol=1e-12)


def test_a_model_of_creep_needs_times(tmp_path):
    q, x, groups, time = log(CREEP, 4, seed=0)
    fitted = HybridForwardModel(CHAIN, "linear", hysteresis=CREEP)
    with pytest.raises(ValueError, match=r"times .* must be given, .*Commands"):
        fitted.fit(Commands(q, groups), x)
    fitted.fit(Commands(q, groups, time), x, groups=groups)
    save_model(fitted, tmp_path / "model.safetensors")
    for model in (fitted, load_model(tmp_path / "model.safetensors")):
        with pytest.raises(ValueError, match=r"times .* must be given, .*Commands"):
            model.predict(Commands(q, groups))
        with pytest.raises(ValueError, match=r"times .* must be given"):
            model.partial_fit(q[:2], x[:2])
        with pytest.raises(ValueError, match=r"times .* must be given"):
            model.adapt(q[:5], x[:5])
        assert model.predict(q[:1]).shape == (1, 3)  # one row needs no times


@pytest.mark.slow
def test_creep_is_not_looked_for_without_times():
    q, x, groups, _ = log(SLIDE, 10, seed=0)
    model = HybridForwardModel(CHAIN, "linear", coupling="serial", hysteresis="auto")
    assert not model.fit(Commands(q, groups), x, groups=groups).hysteresis_.needs_time


def test_partial_fits_go_on_within_a_run():
    q, x, groups, time = log(SLIDE, 6, seed=0)
    x = x + np.array([0.0, 0.0, 0.02])  # a load
    whole = HybridForwardModel(CHAIN, "linear", hysteresis=SLIDE)
    whole.fit(Commands(q, groups, time), x, groups=groups)
    parts = copy.deepcopy(whole)
    runs = groups // 3
    whole.partial_fit(Commands(q, runs, time), x + 0.01)
    for rows in (slice(0, 50), slice(50, 130), slice(130, 240)):
        parts.partial_fit(Commands(q[rows], runs[rows], time[rows]), x[rows] + 0.01)
    assert_allclose(parts.predict(q[:1]), whole.predict(q[:1]), rtol=1e-9)
    with pytest.raises(ValueError, match="`time` must not decrease within a run"):
        parts.partial_fit(Commands(q[:3], runs[-3:], time[:3]), x[:3])
    y = whole.effective(Commands(q, runs, time))
    assert_array_equal(y, SLIDE.apply_by_group(q, runs, time))
