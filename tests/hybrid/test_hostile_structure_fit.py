"""What a fitted structure says: sizes of its errors, and the error to expect with more rows."""

import inspect
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from hybridkin import (
    HybridForwardModel,
    calibrate,
    load_model,
    robots,
    save_model,
)
from hybridkin.calibration.natural_scales import GEOMETRY, STRUCTURE
from hybridkin.chains.structural import StructuralChain
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._structure import StructureDesign, fit_structure
from hybridkin.hybrid.held_out import MEAN_LENGTH

TRUNK = robots.bionic_handling_assistant()


def motions(n, seed=0):
    unit = torch.rand(n, 9, generator=torch.manual_seed(seed), dtype=torch.float64)
    return 0.19 + 0.12 * unit


def fitted(n, seed=0, noise=0.002, scale=0.5, **options):
    """Return a fit to n rows of a trunk with errors drawn from the prior, and these parameters."""
    q = motions(n, seed)
    design = StructureDesign(TRUNK, q)
    drawn = torch.randn(len(design.names), generator=torch.manual_seed(seed + 1)).double()
    with torch.no_grad():
        x = design.model(scale * drawn)(q).numpy()
    x += noise * np.random.default_rng(seed).standard_normal(x.shape)
    return fit_structure(TRUNK, Rows.of(q.numpy(), x), **options), scale * drawn.numpy()


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.02])
def test_the_forecast_agrees_with_the_held_out_error_and_falls_to_the_noise(noise):
    fit, _ = fitted(25, noise=noise)
    now = MEAN_LENGTH * fit.rmse / 3**0.5
    assert_allclose(fit.expected_distance(25), now, rtol=1e-12)
    assert_allclose(fit.expected_distance(25, 0.02), 0.02, rtol=1e-12)
    distances = [fit.expected_distance(n) for n in (1, 10, 25, 100, 1e9)]
    assert (np.diff(distances) <= 0.0).all()
    of_few = fit.distance_by_few_rows(25)
    rest = max(now**2 - of_few**2, 0.0) ** 0.5
    assert_allclose(distances[-1], rest, rtol=1e-4, atol=1e-5)
    assert fit.distance_by_few_rows(1e12) < 1e-6


def test_rows_that_count_four_times_leave_the_error_of_the_forecast():
    q = motions(30)  # without errors both are linearised at zero
    with torch.no_grad():
        rows = Rows.of(q.numpy(), TRUNK(q).numpy())
    fit = fit_structure(TRUNK, rows)
    four = fit_structure(TRUNK, replace(rows, counts=np.full(30, 4.0)))
    assert_allclose(fit.distance_by_few_rows(120), four.distance_by_few_rows(30), rtol=1e-9)
    assert_allclose(fit.spread, four.spread, rtol=1e-9, atol=1e-15)


@pytest.mark.slow
def test_the_forecast_is_the_error_of_more_rows():
    """Drawn robots: the error that few rows leave, root mean square over eight robots."""
    q = motions(500, 99)
    forecast, later = [], []
    for seed in range(8):
        fit, truth = fitted(25, 10 * seed, left_out=False)
        more, _ = fitted(100, 10 * seed, left_out=False)
        design = StructureDesign(TRUNK, motions(100, 10 * seed))
        with torch.no_grad():
            right = design.model(torch.from_numpy(truth))(q)
            later.append(float((more.model(q) - right).square().sum(1).mean()))
        forecast.append(fit.distance_by_few_rows(100) ** 2)
    ratio = (np.mean(later) / np.mean(forecast) * MEAN_LENGTH**2 / 3.0) ** 0.5
    assert 0.3 < ratio < 2.0, ratio


def test_the_sizes_of_blocks_are_those_of_the_errors():
    fit, truth = fitted(300, noise=1e-6)
    names = np.array(fit.blocks)
    sizes = {size.name: size for size in fit.sizes()}
    assert {*sizes} == {*fit.blocks}
    moved = 0.0375 * float(TRUNK.reach) * np.linalg.norm(truth[names == "base move"])
    assert_allclose(sizes["base move"].size, moved, atol=6.0 * sizes["base move"].std_error)
    stretch = STRUCTURE["ring stretch"] * truth[names == "ring stretch"]
    size = sizes["ring stretch"]
    assert_allclose(size.size, np.sqrt(np.mean(stretch**2)), atol=6.0 * size.std_error)
    ranks = [size.in_priors for size in fit.sizes()]
    assert ranks == sorted(ranks, reverse=True)


def test_the_report_of_a_fit_names_blocks_with_units():
    fit, _ = fitted(25)
    for words in ("25 rows", " deg", " mm", " %", "twist by a load", "held-out rmse"):
        assert words in repr(fit)
    assert fit.in_words(1).count("+-") == 1
    assert "held-out" not in repr(fitted(25, left_out=False)[0])


def test_a_chain_says_the_sizes_of_its_errors():
    zeros = torch.zeros(3, 3, dtype=torch.float64)
    twists = zeros.clone()
    twists[1, 0] = np.radians(10.0)
    motion = torch.eye(4, dtype=torch.float64)
    turn = np.radians(3.0)
    motion[:2, :2] = torch.tensor([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    motion[2, 3] = 0.004
    maps = torch.zeros(3, 3, 3, dtype=torch.float64)
    lengths = torch.full((3,), 0.25, dtype=torch.float64)
    words = repr(StructuralChain(TRUNK, lengths, zeros, maps, twists, zeros, motion))
    for part in ("twist 10 deg", "sag 0 deg", "base turn 3 deg", "base move 4 mm", "maps 0 %"):
        assert part in words


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["structural", "auto"])
def test_a_hybrid_says_what_few_rows_leave(kind, tmp_path):
    q = motions(25)
    design = StructureDesign(TRUNK, q)
    drawn = torch.randn(len(design.names), generator=torch.manual_seed(4)).double()
    with torch.no_grad():
        x = design.model(drawn)(q).numpy()
    coupling = "serial" if kind == "structural" else "parallel"
    model = HybridForwardModel(TRUNK, kind, coupling=coupling, calibrate=["base"])
    words = str(model.fit(q.numpy(), x).html_rows()["structure"])
    for part in ("25 rows: structural model", "100 rows like these", "Structure: "):
        assert part in words
    expected = MEAN_LENGTH * model._fit.error.noise
    assert f"expect {1e3 * expected:.2g} mm" in words
    path = tmp_path / "model.safetensors"
    save_model(model, path)
    loaded = load_model(path)
    assert "structure" not in loaded.html_rows()  # files keep no posterior
    assert_allclose(loaded.predict(q.numpy()), model.predict(q.numpy()), atol=1e-12)


def test_an_error_model_without_structure_says_nothing():
    q = motions(30)
    with torch.no_grad():
        x = TRUNK(q).numpy()
    model = HybridForwardModel(TRUNK, "linear", coupling="serial").fit(q.numpy(), x)
    assert "structure" not in model.html_rows()


def test_the_prior_of_a_calibration_is_that_of_the_table():
    assert inspect.signature(calibrate).parameters["prior"].default == GEOMETRY
