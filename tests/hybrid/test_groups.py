"""Groups: rows of one motion are held out together by every choice, whatever the motions' names."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.linear_model import Ridge

from hybridkin import ConstantCurvatureChain, ELMRegressorCV, HybridForwardModel, calibrate
from hybridkin.calibration.measured import inner_and_outer
from hybridkin.hybrid._candidates import Settled
from hybridkin.hybrid._error_models import (
    LinearModel,
    NoCorrection,
    QuadraticModel,
    RegressorModel,
)
from hybridkin.hybrid._fit import fit_hybrid
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._selection import Auto
from hybridkin.hybrid._spec import Spec
from hybridkin.hybrid.log_fit import fit_once

CHAIN = ConstantCurvatureChain([0.05])
NETWORK = ELMRegressorCV(40, weight_scales=(0.4,), relevance_rounds=0, max_hidden=0, random_state=0)
CHOICES = {
    "linear": ("linear", "parallel"),
    "linear inside": ("linear", "serial"),
    "quadratic": ("quadratic", "parallel"),
    "quadratic inside": ("quadratic", "serial"),
    "pose": ("pose", "parallel"),
    "pose inside": ("pose", "serial"),
    "network": (NETWORK, "parallel"),
    "network inside": (NETWORK, "serial"),
    "kernel": ("kernel", "parallel"),
}


def repeated_motions(seed=0):
    """Return 16 motions at one place each, whose 4 rows have the same noise; nothing to learn."""
    rng = np.random.default_rng(seed)
    motions = np.repeat(np.arange(16), 4)
    q = 0.25 + 0.05 * rng.uniform(-1, 1, (16, 3))
    q = q[motions] + 1e-6 * rng.uniform(-1, 1, (len(motions), 3))
    noise = 0.005 * rng.standard_normal((16, 3))
    return q, CHAIN(torch.from_numpy(q)).numpy() + noise[motions], motions


def correction(tips, q):
    """Return the rms length of what a model adds to the chain [m]."""
    off = np.asarray(tips) - CHAIN(torch.from_numpy(q)).numpy()
    return np.sqrt(np.square(off).sum(1).mean())


@pytest.mark.slow
@pytest.mark.parametrize("choice", CHOICES)
def test_rows_of_a_motion_do_not_vouch_for_each_other(choice):
    """Without groups the noise of a row predicts that of its neighbours, and is learned."""
    kind, coupling = CHOICES[choice]
    q, x, motions = repeated_motions(2 if kind == "pose" else 0)  # not where the choice is close
    model = HybridForwardModel(CHAIN, kind, coupling=coupling, guard=None, random_state=0)
    alone = correction(model.fit(q, x).predict(q), q)
    assert alone > 2.5e-3
    assert correction(model.fit(q, x, groups=motions).predict(q), q) < 0.4 * alone


class Few(Auto):
    """The choice of "auto" among two models."""

    def _candidates(self, spec, n_rows):
        return {"mechanical": NoCorrection(), "quadratic": QuadraticModel("parallel")}


@pytest.mark.slow
@pytest.mark.parametrize("part", [False, True])
def test_the_candidates_of_auto_hold_out_motions(part):
    """So do those of a fit to a part of a log, and the comparison itself."""
    q, x, motions = repeated_motions()
    spec = Spec(CHAIN, Few(0), guard=None)
    fits = [fit_hybrid(spec, Rows.of(q, x, groups=groups)) for groups in (None, motions)]
    rows = Rows.of(q, x, groups=motions)
    settled = Settled.of(fits[1], rows)
    assert settled.table(settled.outer(), settled.folds).results()["chosen"] == "mechanical"
    if part:  # with a start that suits the noise
        near = spec.starting_at(fits[0].error.settled, ())
        fits[1] = fit_hybrid(near, rows)
    corrections = []
    for fitted in fits:
        with torch.no_grad():
            tips = fitted.error.candidates["quadratic"].module(torch.from_numpy(q))
        corrections.append(correction(tips, q))
    assert corrections[0] > 5e-3
    assert corrections[1] < 0.4 * corrections[0]


def test_the_gain_of_a_blend_is_that_of_whole_motions():
    """Its score has every row in the fold of its motion, outer rows again, and the motion."""
    q, x, motions, _ = learnable()
    rows = Rows.of(q, x, groups=motions)
    settled = Settled.of(fit_hybrid(Spec(CHAIN, FewAtTip(0), guard=None), rows), rows)
    table = settled.table(settled.outer(), settled.folds)
    assert_array_equal(table.groups.labels, motions)
    scored = table._all_rows
    outer = inner_and_outer(q)[1]
    assert_array_equal(scored.y, np.concatenate([x, x[outer]]))
    fold_of_motion = [np.unique(table.fold[motions == k]) for k in range(8)]
    assert sorted(np.concatenate(fold_of_motion)) == list(range(8))
    assert_array_equal(
        scored.fold, np.concatenate(fold_of_motion)[np.append(motions, motions[outer])]
    )


@pytest.mark.slow
def test_the_set_of_parameters_to_calibrate_is_chosen_by_motions():
    """Without groups the radii and the base follow the noise, by 5 mm."""
    q, x, motions = repeated_motions()
    model = HybridForwardModel(CHAIN, "drop", calibrate="auto")
    assert model.fit(q, x, groups=motions).calibration_ is None


def test_the_error_of_a_calibration_is_that_of_motions():
    q, x, motions = repeated_motions()
    model = HybridForwardModel(CHAIN, "drop", calibrate=("base",)).fit(q, x, groups=motions)
    alone = calibrate(CHAIN, q, x, parameters=("base",), groups=np.arange(len(q)))
    assert model.calibration_.cv_rmse > 1.1 * alone.cv_rmse


@pytest.mark.slow
def test_the_fits_of_the_radius_choose_by_motions():
    """They learn nothing, so the radius is that of the chain; else it is twice as large."""
    q, x, motions = repeated_motions()
    radii = []
    for kind in ("drop", "quadratic"):
        model = HybridForwardModel(CHAIN, kind, guard=None, coverage=0.8)
        radii.append(model.fit(q, x, groups=motions).radius_.inside)
    assert radii[1] == pytest.approx(radii[0], rel=0.1)


def test_equal_rows_of_two_motions_stay_apart():
    """As if they differed by a nanometre: each motion is predicted by the other one."""
    q, x, motions, new = learnable()
    twice = np.append(np.arange(len(q)), np.flatnonzero(motions < 3))
    names = motions[twice].copy()
    names[len(q) :] += 10
    apart = x[twice] + 1e-9 * np.random.default_rng(1).standard_normal((len(twice), 3))
    model = HybridForwardModel(CHAIN, "quadratic")
    residuals = []
    for tips in (x[twice], apart):
        model.fit(q[twice], tips, groups=names)
        residuals.append((model.error_model_.residual, model.predict(new)))
    for found, expected in zip(*residuals, strict=True):
        assert_allclose(found, expected, rtol=0, atol=3e-8)


def learnable():
    """Return motions of different lengths of a robot with an error to be learned, and new rows."""
    rng = np.random.default_rng(0)
    motions = np.repeat(np.arange(8), rng.integers(3, 8, 8))
    q, new = 0.25 + 0.05 * rng.uniform(-1, 1, (2, len(motions), 3))
    x = CHAIN(torch.from_numpy(q)).numpy() + 0.02 * np.sin(20 * q)
    return q, x + 1e-3 * rng.standard_normal(x.shape), motions, new


class FewAtTip(Auto):
    """The choice of "auto" among three models."""

    def _candidates(self, spec, n_rows):
        models = {"mechanical": NoCorrection(), "linear": LinearModel("parallel")}
        return {**models, "ridge": RegressorModel(Ridge(1e-3))}


@pytest.mark.parametrize(
    "choice",
    [
        "linear",
        "quadratic inside",
        "network",
        "kernel",
        pytest.param("auto", marks=pytest.mark.slow),
    ],
)
def test_names_of_motions_and_the_order_of_rows_do_not_matter(choice, monkeypatch):
    """Folds take motions in the order of their names; what leaves out each one needs no order."""
    monkeypatch.setattr(Auto, "_candidates", FewAtTip._candidates)
    q, x, motions, new = learnable()
    rng = np.random.default_rng(1)
    names = 7 * rng.permutation(8)[motions] - 30
    if choice in ("kernel", "auto"):
        names = np.array([f"motion {k}" for k in motions])
    kind, coupling = CHOICES.get(choice, ("auto", "parallel"))
    options = {"coupling": coupling, "calibrate": (), "random_state": 0}
    one = HybridForwardModel(CHAIN, kind, **options).fit(q, x, groups=motions)
    order = rng.permutation(len(q))
    other = HybridForwardModel(CHAIN, kind, **options).fit(q[order], x[order], groups=names[order])
    assert_allclose(other.predict(new), one.predict(new), rtol=0, atol=1e-8)
    assert_array_equal(other.in_domain(new), one.in_domain(new))
    assert other._fit.error.noise == pytest.approx(one._fit.error.noise, rel=1e-6)
    assert np.abs(one.predict_error(new)).max() > 5e-3


def test_a_fit_tells_how_many_candidates_are_fitted():
    q, x, _, _ = learnable()
    told = []
    fit_once(Spec(CHAIN, FewAtTip(0), guard=None), Rows.of(q, x), lambda *of: told.append(of))
    assert told == [(1, 3), (2, 3), (3, 3)]
