"""What tracks promise: errors that grow with the distance from the log, and where paths lie."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridkin import ConstantCurvatureChain, HybridForwardModel, IKStatus
from hybridkin.app import workflow
from hybridkin.app.workflow.domain import Domain
from hybridkin.app.workflow.errors import Promise
from hybridkin.app.workflow.model import promised_errors
from hybridkin.app.workflow.reach import better_place, placed
from hybridkin.ik import trajectories

rng = np.random.default_rng(0)


def test_errors_that_grow_with_the_distance_are_found():
    far = rng.uniform(0.0, 2.0, 4000)
    errors = (2e-3 + 3e-3 * far) * rng.exponential(size=4000)
    promise = Promise.of(errors, far)
    assert promise.at_rows == pytest.approx(2e-3, rel=0.1)
    assert promise.per_distance == pytest.approx(3e-3, rel=0.1)
    assert promise.p95 == pytest.approx(-np.log(0.05), rel=0.1)
    assert np.mean(errors < promise.at(far).p95) == pytest.approx(0.95, abs=0.01)


def test_no_promise_is_nothing_at_the_rows_of_the_log():
    """Where a line through the errors starts at 0, the ratio of error and promise was infinite."""
    far = np.repeat([1.0, 2.0, 3.0], 40)
    errors = 3e-3 * far - 2.9e-3
    promise = Promise.of(errors, far)
    assert promise.at(far).mean == pytest.approx(np.full(120, errors.mean()))
    assert promise.p95 == pytest.approx(6.1e-3 / errors.mean())


def test_errors_that_grow_faster_than_the_distance_are_promised_near_the_log_as_well():
    """A line that the far rows decide started at 6 % of the errors at commands of the log."""
    rows = np.random.default_rng(0)
    far = np.where(np.arange(4000) % 5 > 0, rows.uniform(0.0, 1.3, 4000), 0.0)
    errors = (3e-4 + 1e-3 * far**4) * rows.gamma(8.0, 0.125, 4000)
    promise = Promise.of(errors, far)
    ratios = errors / promise.at(far).mean
    assert ratios.mean() == pytest.approx(1.0, abs=1e-5)
    assert promise.at(np.zeros(1)).mean == pytest.approx(3e-4, rel=0.3)
    assert promise.p95 < 2.5
    near = far < 0.3
    assert np.mean(errors[near] < promise.at(far[near]).p95) > 0.9


def test_rows_of_the_log_without_errors_are_no_line_from_zero():
    """An exact straight robot weighs without limit; a promise of 0 there is not credible."""
    far = np.repeat([0.0, 1.0, 2.0], 40)
    errors = 2e-3 * far
    promise = Promise.of(errors, far)
    assert promise.at(far).mean == pytest.approx(np.full(120, errors.mean()))
    assert Promise.of(np.zeros(9), np.arange(9.0)) == Promise(0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def domain():
    chain = ConstantCurvatureChain([0.05, 0.05])
    q = 0.25 + 0.05 * rng.uniform(-1.0, 1.0, (300, 6))
    x = chain(torch.from_numpy(q)).numpy()
    model = HybridForwardModel(chain, "linear").fit(q, x + 1e-3 * q[:, :3])
    return Domain(model, workflow.path_limits(model))


def test_a_path_outside_is_moved_to_where_it_lies_inside(domain):
    tips = domain.sample[1]
    center = tips.mean(axis=0) + np.array([0.6, 0.0, 0.0])
    far = trajectories.figure_eight(center, [0.04, 0.02], dt=0.1)
    moved, share = placed(domain, far, 1e-4)
    assert share == 1.0
    np.testing.assert_allclose(np.diff(moved.x, axis=0), np.diff(far.x, axis=0), atol=1e-12)
    assert "move its centre to (" in better_place(domain, far, 1e-4)
    stays, share = placed(domain, moved, 1e-4)
    assert share == 1.0
    np.testing.assert_array_equal(stays.x, moved.x)


def test_a_path_is_placed_where_its_promise_is_least(domain):
    training = {
        "saved": "h",
        "held_out": {"h": {"mean": 2e-3, "p95": 5e-3}},
        "promise": {"at_rows": 1e-3, "per_distance": 5e-3, "p95": 2.0},
    }
    chain = domain.model.mechanical_model
    model = HybridForwardModel(chain, "linear")
    q = domain.sample[0][:200]
    x = chain(torch.from_numpy(q)).numpy() + 1e-3 * q[:, :3]
    model.fit(q, x, groups=np.arange(200) // 10)
    model.described(replace(model.description_, training=training))
    promising = Domain(model, workflow.path_limits(model))
    tips = promising.sample[1]
    path = trajectories.figure_eight(tips.mean(axis=0), [0.01, 0.01], dt=0.1)
    moved, share = placed(promising, path, 1e-4)
    assert share == 1.0

    def promise(shift):
        solution = promising.solver().solve(path.x + shift, restarts=0)
        if not (solution.status == IKStatus.CONVERGED).all():
            return np.inf
        return promised_errors(model, solution.q).mean.mean()

    least = promise(moved.x[0] - path.x[0])
    elsewhere = np.array([promise(tip - tips.mean(axis=0)) for tip in tips[::25]])
    assert np.isfinite(elsewhere).sum() > 5
    assert least < 0.8 * np.median(elsewhere[np.isfinite(elsewhere)])
    assert least < 1.1 * elsewhere.min()
