import motion
import pytest


@pytest.mark.slow
def test_tracks_keep_to_the_plane_and_jumps_stop_at_the_target():
    passed, share = motion.beyond_plane(0.04)
    assert passed < 1e-5
    assert share == pytest.approx(0.3, abs=0.03)
    assert motion.overshoot(5.0, duration=1.0) < 1e-3
