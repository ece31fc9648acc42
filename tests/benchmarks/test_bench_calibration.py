"""Calibration with exact derivatives against the same least squares by finite differences."""

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from hybridkin import calibrate


@pytest.mark.slow
def test_against_finite_differences(race, chain, draw, timed):
    q = draw(1500 if timed else 60)
    truth = chain.with_geometry(
        radii=chain.radii * chain.radii.new_tensor([1.1, 0.95, 1.05]),
        base=_pose(np.array([0.1, -0.05, 0.2, 0.02, 0.01, -0.03])),
    )
    noise = torch.randn(len(q), 3, dtype=q.dtype, generator=torch.Generator().manual_seed(1))
    x = truth(q) + 1e-3 * noise

    def residual(theta):
        radii = chain.radii * torch.from_numpy(np.exp(theta[:3]))
        moved = chain.with_geometry(radii=radii, base=_pose(theta[3:]))
        return (moved(q) - x).flatten().numpy()

    def by_differences():
        return least_squares(residual, np.zeros(9), xtol=1e-12, ftol=1e-12, gtol=1e-12)

    result = calibrate(chain, q, x, ("radii", "base"))
    theirs = chain.radii.numpy() * np.exp(by_differences().x[:3])
    np.testing.assert_allclose(result.values["radii"], theirs, rtol=1e-3)
    race(
        "calibrate: radii + base",
        "scipy, finite differences",
        lambda: calibrate(chain, q, x, ("radii", "base")),
        by_differences,
        rows=len(q),
    )


def _pose(theta):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(theta[:3]).as_matrix()
    pose[:3, 3] = theta[3:]
    return torch.from_numpy(pose)
