import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, calibrate, datasets

RADII = [0.100, 0.093, 0.079]


def planted_base():
    base = torch.eye(4, dtype=torch.float64)
    rotation = Rotation.from_rotvec([0.5, -1.2, 2.0]).as_matrix()
    base[:3, :3] = torch.from_numpy(rotation)
    base[:3, 3] = torch.tensor([0.3, -0.2, 1.0])
    return base


def chambers(rng, n=100):
    return 0.25 + 0.06 * (2 * torch.rand(n, 9, generator=rng, dtype=torch.float64) - 1)


def test_planted_geometry_is_recovered_from_exact_data(rng):
    q = chambers(rng)
    truth = ConstantCurvatureChain(RADII, base=planted_base(), offsets=[0.0, 0.0, 0.12])
    nominal = ConstantCurvatureChain([0.11, 0.08, 0.09])
    result = calibrate(nominal, q, truth(q), ("radii", "base", "tool"))
    assert result.converged
    assert_close(result.chain.radii, truth.radii, rtol=0, atol=1e-9)
    assert_close(result.chain.base, truth.base, rtol=0, atol=1e-9)
    assert_close(result.chain.offsets, truth.offsets, rtol=0, atol=1e-9)
    assert_close(nominal.radii, torch.tensor([0.11, 0.08, 0.09], dtype=torch.float64))
    assert all(flag.all() for flag in result.identifiable.values())


def test_planted_tendon_geometry_is_recovered(rng):
    q = 0.006 * torch.rand(150, 9, generator=rng, dtype=torch.float64)
    q = q - q.unflatten(1, (3, 3)).mean(-1).repeat_interleave(3, 1)
    third = 2 * math.pi / 3

    def chain(radii, lengths, turns, base=None):
        angles = [[turn + third * i for i in range(3)] for turn in turns]
        return ConstantCurvatureChain(
            radii, lengths=lengths, angles=angles, routing="base", base=base
        )

    truth = chain([0.005, 0.0045, 0.004], [0.06, 0.07, 0.05], [0.0, 0.3, 0.8], planted_base())
    nominal = chain([0.0045] * 3, [0.06] * 3, [0.0, 0.0, 0.5])
    result = calibrate(nominal, q, truth(q), ("radii", "lengths", "turns", "base"))
    assert_close(result.chain(q), truth(q), rtol=0, atol=1e-9)
    assert_close(result.chain.radii, truth.radii, rtol=0, atol=1e-9)
    # A common turn of all rings is a turn of the base about its axis: only differences are known.
    turns = result.chain.angles[::3]
    assert_close(turns - turns[0], torch.tensor([0.0, 0.3, 0.8]).double(), rtol=0, atol=1e-7)
    assert not result.identifiable["turns"].any()
    assert result.identifiable["radii"].all()


def test_standard_errors_are_honest(rng):
    q = chambers(rng)
    truth = ConstantCurvatureChain(RADII)
    nominal = ConstantCurvatureChain([0.09, 0.09, 0.09])
    inside = total = 0
    for _ in range(20):
        x = truth(q) + 0.002 * torch.randn(len(q), 3, generator=rng, dtype=torch.float64)
        result = calibrate(nominal, q, x, ("radii",))
        z = (result.chain.radii - truth.radii) / result.std_errors["radii"]
        inside += int((z.abs() < 1.96).sum())
        total += 3
    # 57 of 60 expected; fewer than 50 or all 60 with tiny z would mean wrong standard errors.
    assert inside >= 50
    assert float(z.abs().max()) > 0.05


def test_prior_keeps_what_the_data_do_not_tell(rng):
    q = chambers(rng, 60)
    q[:, 6:] = 0.25  # the last segment never bends: its radius cannot be seen
    x = ConstantCurvatureChain(RADII)(q)
    x = x + 0.001 * torch.randn(60, 3, generator=rng, dtype=torch.float64)
    result = calibrate(ConstantCurvatureChain([0.09, 0.09, 0.09]), q, x, ("radii",))
    assert result.identifiable["radii"].tolist() == [True, True, False]
    assert abs(result.chain.radii[2] - 0.09) < 1e-6
    assert "radii[2] +1 % moves the tips by" in repr(result)


def test_without_a_prior_what_the_data_do_not_tell_is_still_told_apart(rng):
    q = chambers(rng, 60)
    q[:, 6:] = 0.25
    x = ConstantCurvatureChain(RADII)(q)
    x = x + 0.001 * torch.randn(60, 3, generator=rng, dtype=torch.float64)
    nominal = ConstantCurvatureChain([0.09, 0.09, 0.09])
    result = calibrate(nominal, q, x, ("radii",), prior=float("inf"))
    assert result.identifiable["radii"].tolist() == [True, True, False]
    assert (result.chain.radii[:2] - torch.tensor(RADII[:2])).abs().max() < 0.005


def test_robust_loss_forgets_outliers(rng):
    q = chambers(rng)
    truth = ConstantCurvatureChain(RADII)
    x = truth(q) + 0.001 * torch.randn(100, 3, generator=rng, dtype=torch.float64)
    x[:8] += 0.3
    nominal = ConstantCurvatureChain([0.09, 0.09, 0.09])
    plain, robust = (
        (calibrate(nominal, q, x, ("radii",), loss=loss).chain.radii - truth.radii).abs().max()
        for loss in ("linear", "cauchy")
    )
    assert robust < 0.001 < plain


def test_weights_are_repetitions(rng):
    q = chambers(rng, 40)
    x = ConstantCurvatureChain(RADII)(q) + 0.01 * torch.randn(40, 3, generator=rng).double()
    weights = torch.arange(40) % 3
    repeated = torch.arange(40).repeat_interleave(weights)
    nominal = ConstantCurvatureChain([0.09, 0.09, 0.09])
    weighted = calibrate(nominal, q, x, sample_weight=weights)
    expanded = calibrate(nominal, q[repeated], x[repeated])
    assert_close(weighted.chain.radii, expanded.chain.radii, rtol=1e-7, atol=0)
    assert_close(weighted.std_errors["base"], expanded.std_errors["base"], rtol=1e-4, atol=0)
    assert weighted.rmse == pytest.approx(expanded.rmse, rel=1e-8)


def test_bounds_hold(rng):
    q = chambers(rng)
    x = ConstantCurvatureChain(RADII)(q)
    nominal = ConstantCurvatureChain([0.09, 0.09, 0.09])
    with pytest.warns(UserWarning, match=r"radii\[2\] ran into its lower bound"):
        result = calibrate(nominal, q, x, ("radii",), bounds={"radii": (0.08, 0.095)})
    assert result.chain.radii.max() <= 0.095 * (1 + 1e-12)


def test_numpy_in_numpy_out_and_groups(rng):
    q = chambers(rng)
    x = ConstantCurvatureChain(RADII)(q) + 0.01 * torch.randn(100, 3, generator=rng).double()
    groups = np.arange(100) // 10
    result = calibrate(ConstantCurvatureChain(RADII), q.numpy(), x.numpy(), groups=groups)
    assert isinstance(result.values["radii"], np.ndarray)
    assert isinstance(result.std_errors["base"], np.ndarray)
    assert result.correlations.shape == (9, 9) == (len(result.names),) * 2
    np.testing.assert_allclose(np.diag(result.correlations), 1.0, rtol=1e-12)
    assert result.rmse < result.cv_rmse < 1.5 * result.rmse


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": ("radius",)}, "`parameters` must name different ones of"),
        ({"parameters": ("lengths",)}, "`parameters` must name different ones of"),
        ({"parameters": ("offsets", "tool")}, "leave 'tool' out"),
        ({"loss": "l1"}, "`loss` must be one of"),
        ({"prior": 0.0}, "`prior` must be positive"),
        ({"prior": {"tool": 1.0}}, "`prior` must name only"),
        ({"bounds": {"radii": (0.2, 0.1)}}, "low < high"),
        ({"q": np.full((5, 9), 0.25)}, r"`x` must have shape \(5, 3\)"),
        ({"q": np.full((10, 8), 0.25)}, r"`q` must have shape \(..., 9\)"),
        ({"q": np.full((10, 9), np.nan)}, "`q` must be finite"),
        ({"x": np.full((10, 3), np.inf)}, "`x` must be finite"),
        ({"q": np.zeros((0, 9)), "x": np.zeros((0, 3))}, "at least one row"),
        ({"groups": [1, 2]}, r"`groups` must have shape \(10,\)"),
        ({"groups": [1] * 10}, "at least 2 motions"),
        ({"sample_weight": [0] * 10}, "`sample_weight` must hold 10 non-negative"),
    ],
)
def test_bad_input_says_what_is_needed(change, message):
    arguments = {"q": np.full((10, 9), 0.25), "x": np.zeros((10, 3)), **change}
    with pytest.raises(ValueError, match=message):
        calibrate(ConstantCurvatureChain(RADII), **arguments)


def test_real_nine_tendon_robot(data_home):
    data = datasets.load_ftdcr(data_home)
    turns = (-3.03, -2.52, -2.01)
    chain = ConstantCurvatureChain(
        [0.0045] * 3,
        lengths=[0.060, 0.0625, 0.064],
        routing="base",
        angles=[[turn + 2 * math.pi / 3 * i for i in range(3)] for turn in turns],
    )
    kept = np.array(["tendon" not in group for group in data.groups])
    result = calibrate(chain, data.q[kept], data.x[kept], ("radii", "base", "tool"))
    with torch.no_grad():
        tips = result.chain(torch.from_numpy(data.q[kept])).numpy()
    assert np.linalg.norm(tips - data.x[kept], axis=1).mean() < 0.006
