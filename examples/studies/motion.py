"""How far a track along a plane leaves it, and how far a jump passes its target.

For limits of the tip and of acceleration in the docs page "Theory"; the trunk has no noise::

    python examples/studies/motion.py

Ten seconds. Nothing is drawn at random.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin import InverseKinematics, robots

LIMITS = {"q_min": 0.1, "q_max": 0.4}
HOME = np.full(9, 0.25) + 0.01 * np.cos(np.arange(9))
NORMAL, DISTANCE = np.array([1.0, 0.3, 0.2]), 0.05  # of the plane before the tip [m]
JUMP = np.array([0.1, 0.05, -0.02])


def loop(dt: float, duration: float = 8.0) -> NDArray:
    """Return a loop with a radius of 15 cm, from the tip at HOME."""
    phase = 2.0 * np.pi * np.arange(0.0, 1.0, dt / duration)
    way = np.stack([np.sin(phase), np.cos(phase) - 1.0, 0.4 * np.sin(2.0 * phase)], axis=1)
    return _tip() + 0.15 * way


def beyond_plane(dt: float, **options: float) -> tuple[float, float]:
    """Return how far a track passes the plane [m], and the share of the path behind it."""
    normal = NORMAL / np.linalg.norm(NORMAL)
    offset, path = normal @ _tip() + DISTANCE, loop(dt)
    trunk = robots.bionic_handling_assistant()
    planes = ([normal], [offset])
    ik = InverseKinematics(trunk, **LIMITS, **options, dt=dt, tip_limits=planes)
    track = ik.track(path, q0=HOME)
    return float((track.x @ normal).max() - offset), float((path @ normal > offset).mean())


def overshoot(ddq_max: float, dt: float = 0.01, duration: float = 4.0) -> float:
    """Return how far a jump passes its target, over its length."""
    trunk = robots.bionic_handling_assistant()
    tracker = InverseKinematics(trunk, **LIMITS, ddq_max=ddq_max, dt=dt).tracker(HOME)
    shares = []
    for _ in range(round(duration / dt)):
        tracker.step(_tip() + JUMP)
        shares.append((tracker.x - _tip()) @ JUMP / (JUMP @ JUMP))
    return max(shares) - 1.0


def _tip() -> NDArray:
    return InverseKinematics(robots.bionic_handling_assistant()).tracker(HOME).x


if __name__ == "__main__":
    for dt in (0.02, 0.01, 0.005):
        passed, share = beyond_plane(dt)
        print(f"dt = {dt} s: {1e6 * passed:.2f} um beyond the plane, {100 * share:.0f} % behind it")
    for ddq_max in (0.05, 0.5, 5.0):
        print(f"ddq_max = {ddq_max} m/s^2: overshoot {100 * overshoot(ddq_max):.4f} %")
