"""Which mechanics stand below corrections: chosen by the errors that remain with corrections."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    GeometryChoice,
    HybridForwardModel,
    RigidChain,
    choose_geometry,
)
from hybridkin.hybrid._mechanics import _best, best_mechanics
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._selection import Auto
from hybridkin.hybrid._spec import Mechanics, Spec
from hybridkin.hybrid.held_out import HeldOutError

NOMINAL = ConstantCurvatureChain([0.05, 0.05])
MIDDLE = 0.25


def bent_by_products(q):
    """Tips of a robot of exact geometry whose bendings have an error quadratic in q."""
    lengths = torch.from_numpy(q)
    z, _ = NOMINAL.coordinates(lengths)
    u = (lengths - MIDDLE) / 0.03
    error = torch.zeros_like(z)
    error[:, 1] = u[:, 0] * u[:, 1]
    error[:, 2] = u[:, 1] ** 2
    error[:, 4] = u[:, 3] * u[:, 0]
    return NOMINAL.from_coordinates(z + 0.05 * error).numpy()


def lengths(n, spread, seed):
    return MIDDLE + np.random.default_rng(seed).uniform(-spread, spread, (n, 6))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:calibration gave unphysical values")
@pytest.mark.parametrize("seed", [0, 1])
def test_a_correction_makes_a_larger_geometry_needless(seed):
    """More parameters imitate the error inside the log, and are wrong outside."""
    q = lengths(120, 0.03, seed)
    x = bent_by_products(q) + 2e-4 * np.random.default_rng(seed).standard_normal((120, 3))
    of_mechanics = choose_geometry(NOMINAL, q, x)
    assert "offsets" in of_mechanics.parameters
    model = HybridForwardModel(NOMINAL, "auto", random_state=0).fit(q, x)
    results = model.cv_results_
    chosen = results["parameters"]
    assert chosen in ("nothing", "base")  # both are exact here
    assert results["corrected"][chosen]["cv"] < results["mechanical_model"][chosen]["cv"] / 5
    assert [*results["corrected"]][:5] == [near.name for near in of_mechanics.near]
    larger = HybridForwardModel(
        NOMINAL, "auto", calibrate=of_mechanics.parameters, random_state=0
    ).fit(q, x)
    outside = lengths(500, 0.05, 9)
    tips = bent_by_products(outside)
    errors = []
    for fitted in (model, larger):
        errors.append(np.linalg.norm(fitted.predict(outside) - tips, axis=1).mean())
    assert errors[0] < 0.85 * errors[1]


def test_sets_are_near_by_their_score_and_the_chosen_one_is_among_them():
    q = lengths(60, 0.03, 0)
    choice = choose_geometry(NOMINAL, q, bent_by_products(q))
    scores = {}
    for name, errors in choice.errors.items():
        scores[name] = (errors.cv * errors.io**2) ** (1 / 3)
    names = [near.name for near in choice.near]
    ranked = sorted(scores, key=scores.__getitem__)
    within = [name for name in ranked[:5] if scores[name] <= 1.3 * scores[choice.name]]
    assert 1 < len(within) < len(scores)
    assert names == [name for name in scores if name in within]
    assert choice.name in names
    for near in choice.near:
        assert near.errors == choice.errors
        assert near.name not in [rival.name for rival in near.rivals]


def arm_with_a_moved_base():
    """An arm of two joints, and rows of it that only another base explains."""
    origins = np.stack([np.eye(4), np.eye(4)])
    origins[1, 0, 3] = 0.3
    arm = RigidChain(origins, [[0, 0, 1], [0, 1, 0]], tool=[0.2, 0.0, 0.0])
    base = torch.eye(4, dtype=torch.float64)
    base[:3, 3] = torch.tensor([0.3, -0.2, 0.1])
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 2))
    return arm, Rows.of(q, arm.with_geometry(base=base)(torch.from_numpy(q)).numpy())


def test_a_single_set_is_not_compared():
    arm, rows = arm_with_a_moved_base()
    choice = choose_geometry(arm, rows.q, rows.y, parameters=("base",))
    assert [near.name for near in choice.near] == ["base"]
    mechanics = best_mechanics(Spec(arm, Auto(0), calibrate="auto"), choice, rows)
    assert mechanics == Mechanics(choice.near[0])
    assert not mechanics.geometry.corrected


def test_poses_keep_the_set_that_suits_the_mechanics():
    q = lengths(60, 0.03, 0)
    rows = Rows.of(q, bent_by_products(q))
    choice = choose_geometry(NOMINAL, rows.q, rows.y)
    spec = Spec(NOMINAL, Auto(0), calibrate="auto", output="pose")
    assert best_mechanics(spec, choice, rows).geometry is choice


@dataclass
class Table:
    """The errors of a table; those of held-out rows are about the mean."""

    expected_error: float
    outer_error: float
    spread: float = 0.0
    n: int = 100

    @property
    def y(self):
        return np.zeros((self.n, 3))

    def excess_over(self, other):
        each = self.expected_error - other.expected_error
        return HeldOutError.of(
            each + self.spread * np.resize([1.0, -1.0], self.n), np.arange(self.n), np.ones(self.n)
        )


def best(*tables, enough=True, handicap=1.0):
    each = np.ones(len(tables))
    return _best(tables, each * enough > 0, each * handicap)


def test_errors_outside_decide_among_mechanics_that_are_equal_inside():
    assert best(Table(1.0, 3.0), Table(1.05, 2.0), Table(1.02, 2.5)) == 1


def test_mechanics_that_are_worse_inside_are_not_taken_for_their_errors_outside():
    assert best(Table(1.2, 1.0), Table(1.0, 3.0)) == 1
    # Unless the difference may be chance.
    assert best(Table(1.2, 1.0, spread=2.0), Table(1.0, 3.0)) == 0
    assert best(Table(1.2, 1.0, spread=0.5), Table(1.0, 3.0)) == 1


def test_the_first_of_nearly_equal_mechanics_is_taken():
    assert best(Table(1.0, 2.08), Table(1.0, 2.0)) == 0
    assert best(Table(1.0, 2.1), Table(1.0, 2.0)) == 1


def test_a_handicap_is_made_good_by_smaller_errors():
    assert best(Table(1.0, 2.1), Table(1.0, 2.0), handicap=[1.0, 1.03]) == 0
    assert best(Table(1.0, 2.2), Table(1.0, 2.0), handicap=[1.0, 1.03]) == 1
    # Of few rows only held-out errors count, and the structure holds where there are no rows.
    few = Table(1.05, 1.0, n=25), Table(1.0, 1.0, n=25)
    assert best(*few, handicap=[1.0, 1.03]) == 1


def test_errors_outside_count_only_as_far_as_the_inner_rows_suffice():
    tables = Table(1.0, 2.0), Table(0.95, 3.0)
    assert best(*tables) == 0
    # 3.0 counts as 1.9, twice the error inside, as for the mechanics with enough rows.
    assert best(*tables, enough=[True, False]) == 1
    assert best(Table(1.0, 1.0), *tables, enough=[False, False, False]) == 2


def test_errors_outside_do_not_count_for_few_rows():
    assert best(Table(1.0, 3.0, n=39), Table(1.05, 2.0, n=39)) == 0
    assert best(Table(1.0, 3.0, n=40), Table(1.05, 2.0, n=40)) == 1


def test_mechanics_without_predictions_of_some_rows_are_not_taken():
    assert best(Table(np.nan, np.nan), Table(1.0, 3.0)) == 1
    assert best(Table(1.0, np.nan), Table(1.05, 3.0)) == 1
    assert best(Table(np.nan, np.nan), Table(np.nan, np.nan)) == 0


def test_rounding_does_not_decide_among_exact_mechanics():
    assert best(Table(0.0, 0.0), Table(0.0, 0.0)) == 0
    assert best(Table(2e-17, 1e-16), Table(1e-17, 3e-17)) == 0
    assert best(Table(1e-3, 2e-3), Table(0.0, 1e-17)) == 1


@pytest.mark.parametrize("error_model", ["auto", "drop"])
def test_a_choice_of_the_caller_is_calibrated_in_every_fold(error_model):
    """It has no start and no sets near it: the start is searched, the set is not replaced."""
    arm, rows = arm_with_a_moved_base()
    choice = GeometryChoice(arm, ("base",), name="base")
    model = HybridForwardModel(arm, error_model, calibrate=choice, coverage=0.9, random_state=0)
    model.fit(rows.X, rows.y)
    assert model.radius_.inside < 1e-6
    assert_close(model.mechanical_model_.base[:3, 3], torch.tensor([0.3, -0.2, 0.1]).double())


def test_a_choice_of_the_caller_can_do_without_errors_of_the_structure():
    q = lengths(40, 0.03, 0)
    rows = Rows.of(q, NOMINAL(torch.from_numpy(q)).numpy())
    choice = GeometryChoice(NOMINAL, ("base",), name="base")
    mechanics = best_mechanics(Spec(NOMINAL, Auto(0), calibrate="auto"), choice, rows)
    assert mechanics.name == "base"
    assert [*mechanics.geometry.corrected] == ["base", "base, structure"]
