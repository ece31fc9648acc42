import numpy as np
import pytest

from hybridkin.ik.results import IKStatus, Track


def a_track(q, error):
    x, status = np.zeros((len(error), 3)), np.full(len(error), IKStatus.CONVERGED.value)
    ones = np.ones(len(error))
    return Track(
        ones, np.array(q), np.array(q), x, None, x, np.array(error), status, ones, ones, ones
    )


def test_figures_of_a_track_leave_out_what_is_not_known():
    track = a_track([[0.0, 0.0], [0.1, -0.3], [0.2, -0.3]], [1e-3, np.nan, 3e-3])
    assert track.largest_step == pytest.approx(0.3)
    text = "Track(3 targets: 3 CONVERGED; error mean 0.002 m, max 0.003 m; largest step 0.3)"
    assert repr(track) == text
    empty = a_track(np.empty((0, 2)), [])
    assert repr(empty) == "Track(0 targets; no error known; largest step 0)"


def test_a_track_in_the_domain_is_better_than_a_longer_one_outside():
    def of(*names):
        track = a_track(np.zeros((4, 2)), np.zeros(4))
        track.status[:] = [IKStatus[name] for name in names]
        return track.score

    inside = of("CONVERGED", "CONVERGED", "MAX_ITER", "AT_LIMITS")
    outside = of("CONVERGED", "OUT_OF_DOMAIN", "OUT_OF_DOMAIN", "OUT_OF_DOMAIN")
    assert (inside, outside) == ((2, 2), (1, 4))
    assert max(outside, inside) == inside
    # Of equally many inside, the one that reaches more.
    assert of("CONVERGED", "OUT_OF_DOMAIN", "MAX_ITER", "MAX_ITER") < outside
