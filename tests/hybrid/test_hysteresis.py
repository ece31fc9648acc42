"""Hybrid models of robots whose actuators have hysteresis with smooth loops."""

import copy

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from hybridkin import (
    Commands,
    HybridForwardModel,
    Hysteresis,
    as_forward_model,
    load_model,
    robots,
    save_model,
)

CHAIN = robots.bionic_handling_assistant()


def motions(n, seed):
    """Return commands of n motions of 40 rows, back and forth [m], and their groups."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 2.0 * np.pi, 40)
    waves = np.stack([np.sin(time), np.sin(2.0 * time), np.cos(time) - 1.0])
    q = 0.25 + (rng.uniform(-0.03, 0.03, (n, 9, 3)) @ waves).transpose(0, 2, 1).reshape(-1, 9)
    return q, np.repeat(np.arange(n), 40)


def smooth_friction(q, groups):
    """Return the sum of 25 plays of all widths up to 8 cm."""
    half = np.linspace(0.0, 0.04, 25)
    density = np.exp(-half / 0.012)
    parts = [Hysteresis.backlash(2.0 * r).apply_by_group(q, groups) for r in half]
    return np.tensordot(density / density.sum(), parts, 1)


def tips(y):
    with torch.no_grad():
        bent = torch.from_numpy(y) + 0.03 * torch.from_numpy(y[:, ::-1] - 0.25).square()
        return CHAIN(bent).numpy()


@pytest.fixture(scope="module")
def fitted():
    q, groups = motions(16, seed=0)
    x = tips(smooth_friction(q, groups))
    x += 5e-4 * np.random.default_rng(1).standard_normal(x.shape)
    model = HybridForwardModel(CHAIN, "quadratic", coupling="serial", hysteresis="auto")
    return model.fit(q, x, groups=groups)


@pytest.mark.slow
def test_smooth_loops_take_more_than_one_play(fitted):
    q, groups = motions(6, seed=2)
    x = tips(smooth_friction(q, groups))
    assert fitted.hysteresis_.kind == "friction"
    error = np.linalg.norm(fitted.predict(Commands(q, groups)) - x, axis=1).mean()
    train, train_groups = motions(16, seed=0)
    single = HybridForwardModel(CHAIN, "quadratic", coupling="serial", hysteresis=0.02)
    single.fit(train, tips(smooth_friction(train, train_groups)), groups=train_groups)
    before = np.linalg.norm(single.predict(Commands(q, groups)) - x, axis=1).mean()
    assert error < 0.25 * before


@pytest.mark.slow
def test_commands_of_the_fitted_operator(fitted):
    y, _ = motions(1, seed=3)
    q, _ = fitted.hysteresis_.command(y)
    assert_allclose(fitted.hysteresis_.apply(q)[0], y, rtol=0.0, atol=1e-9)
    reached = [tips(smooth_friction(sent, np.zeros(len(y)))) for sent in (q, y)]
    with torch.no_grad():
        promised = fitted.module_(torch.from_numpy(y)).numpy()
    errors = [np.linalg.norm(x - promised, axis=1).mean() for x in reached]
    assert errors[0] < 0.2 * errors[1]


@pytest.mark.slow
def test_a_file_holds_the_value(fitted, tmp_path):
    q, groups = motions(2, seed=4)
    save_model(fitted, tmp_path / "model.safetensors")
    loaded = load_model(tmp_path / "model.safetensors")
    assert loaded.hysteresis_ == fitted.hysteresis_
    expected = fitted.predict(Commands(q, groups))
    assert_array_equal(loaded.predict(Commands(q, groups)), expected)


@pytest.mark.slow
def test_measurements_go_on_where_the_last_ones_ended(fitted):
    q, groups = motions(1, seed=5)
    x = tips(smooth_friction(q, groups)) - 0.01
    at_once = copy.deepcopy(fitted).partial_fit(q, x)
    rows = copy.deepcopy(fitted)
    for row, tip in zip(q, x, strict=True):
        rows.partial_fit(row[None], tip[None])
    assert_allclose(rows.predict(q), at_once.predict(q), rtol=0.0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["markers", "pose", "function", "exact"])
def test_every_kind_of_model_can_have_it(kind):
    q, groups = motions(10, seed=0)
    y = smooth_friction(q, groups)
    chain = CHAIN
    options = {}
    if kind == "markers":
        chain = CHAIN.with_markers([(1, 1.0), (2, 1.0)])
    with torch.no_grad():
        x = chain(torch.from_numpy(y)).numpy()
        turns = CHAIN.pose(torch.from_numpy(y))[:, :3, :3].numpy()
    if kind != "exact":
        x = x + 5e-4 * np.random.default_rng(1).standard_normal(x.shape)
    if kind == "markers":
        x[::7, :3] = np.nan
    if kind == "pose":
        x = np.hstack([x, Rotation.from_matrix(turns).as_rotvec()])
        options = {"output": "pose"}
    if kind == "function":
        chain = as_forward_model(lambda q: CHAIN(q))
    model = HybridForwardModel(chain, "drop", hysteresis="auto", **options).fit(q, x, groups=groups)
    assert model.hysteresis_.kind == "friction"
    assert np.nanmax(np.abs(model.predict(Commands(q, groups)) - x)) < 0.1


@pytest.mark.slow
def test_a_backlash_stays_one_backlash():
    q, groups = motions(12, seed=0)
    x = tips(Hysteresis.backlash(0.02).apply_by_group(q, groups))
    x += 5e-4 * np.random.default_rng(1).standard_normal(x.shape)
    model = HybridForwardModel(CHAIN, "linear", coupling="serial", hysteresis="auto")
    error = np.linalg.norm(model.fit(q, x, groups=groups).predict(Commands(q, groups)) - x, axis=1)
    given = HybridForwardModel(CHAIN, "linear", coupling="serial", hysteresis=0.02)
    least = np.linalg.norm(given.fit(q, x, groups=groups).predict(Commands(q, groups)) - x, axis=1)
    assert error.mean() < 1.05 * least.mean()
