from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from hybridkin import InverseKinematics, robots
from hybridkin.ik.results import IKSolution, IKStatus, Track

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
