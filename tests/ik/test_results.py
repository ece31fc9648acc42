from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from hybridkin import InverseKinematics, robots
from hybridkin.ik.results import IKSolution, IKStatus, Step, Track

TRUNK = robots.bionic_handling_assistant()


def a_track(q, error):
    x, status = np.zeros((len(error), 3)), np.full(len(error), IKStatus.CONVERGED.value)
    ones = np.ones(len(error))
    return Track(ones, np.array(q), x, None, x, np.array(error), status, ones, ones)


def test_figures_of_a_track_leave_out_what_is_not_known():
    track = a_track([[0.0, 0.0], [0.1, -0.3], [0.2, -0.3]], [1e-3, np.nan, 3e-3])
    assert track.mean_error == pytest.approx(2e-3)
    assert track.max_error == 3e-3
    assert track.p95_error == pytest.approx(np.quantile([1e-3, 3e-3], 0.95))
    assert track.largest_step == pytest.approx(0.3)
    text = "Track(3 targets: 3 CONVERGED; error mean 0.002 m, max 0.003 m; largest step 0.3)"
    assert repr(track) == text
    empty = a_track(np.empty((0, 2)), [])
    assert repr(empty) == "Track(0 targets; no error known; largest step 0)"


@pytest.mark.parametrize("target", [[0.1, 0.0, 0.7], [[0.1, 0.0, 0.7]] * 2])
def test_a_step_has_its_fields_and_no_others(target):
    ik = InverseKinematics(TRUNK, q_min=0.1, q_max=0.26, dq_max=2.0)
    q, target = np.full((*np.shape(target)[:-1], 9), 0.25), np.array(target)
    step = ik.step(q, target)
    held = int(step.saturated.sum())
    np.testing.assert_array_equal(step.saturated, (q + step.dq >= 0.26) | (step.dq <= -0.02))
    assert held > 0
    distance = np.linalg.norm(TRUNK_TIP - target, axis=-1)
    figures = f"error mean {distance.mean():.3g} m, max {distance.max():.3g} m"
    assert repr(step) == f"Step(dq of shape {q.shape}, {held} saturated, {figures})"
    with pytest.raises(AttributeError, match="velocity"):
        _ = step.velocity
    assert isinstance(step, Step)


TRUNK_TIP = TRUNK(TRUNK.base.new_full((9,), 0.25)).numpy()


def test_results_are_frozen():
    ik = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4)
    q, target = np.full(9, 0.25), TRUNK_TIP
    for result in (ik.solve(target), ik.track(target[None], q0=q), ik.step(q, target)):
        with pytest.raises(FrozenInstanceError):
            result.error = 0.0


def test_numbers_of_statuses_are_those_that_logs_hold():
    names = "CONVERGED AT_LIMITS UNREACHABLE SINGULAR MAX_ITER OUT_OF_DOMAIN INVALID_INPUT"
    assert [status.name for status in IKStatus] == [*names.split(), "NO_FURTHER"]
    assert [status.value for status in IKStatus] == list(range(8))


def test_a_solution_says_how_many_starts_there_were_if_more_than_one():
    x, ones = np.zeros((2, 3)), np.ones(2)
    texts = []
    for starts in ([1, 1], [1, 2], [9, 1]):
        status = np.full(2, IKStatus.MAX_ITER.value)
        solution = IKSolution(x, x, 1e-3 * ones, status, ones, np.array(starts), ones, ones)
        texts.append(repr(solution).removeprefix("IKSolution(2 targets: 2 MAX_ITER; "))
    end = "error mean 0.001 m, max 0.001 m)"
    assert texts == [end, f"up to 2 starts; {end}", f"up to 9 starts; {end}"]
