import math
import re
import warnings

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, RigidChain, calibrate
from hybridkin.calibration._initial_guesses import aligned
from hybridkin.calibration._least_squares import LOSSES, TipRows
from hybridkin.calibration._parameters import Problem
from hybridkin.calibration._search import Start
from hybridkin.calibration.calibrate import fit_geometry, refitted

# The plain chain makes most tips itself here: tendons pulled at random mean no slack.
pytestmark = pytest.mark.filterwarnings("ignore:.* pull the tendons of a segment together")

RADII = [0.100, 0.093, 0.079]
THIRD = 2 * math.pi / 3


def planted_base():
    base = torch.eye(4, dtype=torch.float64)
    rotation = Rotation.from_rotvec([0.5, -1.2, 2.0]).as_matrix()
    base[:3, :3] = torch.from_numpy(rotation)
    base[:3, 3] = torch.tensor([0.3, -0.2, 1.0])
    return base


def uniform(rng, *shape):
    return 2 * torch.rand(*shape, generator=rng, dtype=torch.float64) - 1


def gauss(rng, *shape):
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def chambers(rng, n=100, n_actuators=9):
    return 0.25 + 0.06 * uniform(rng, n, n_actuators)


def tendons(rng, n=100, n_actuators=9):
    return 0.003 * uniform(rng, n, n_actuators)


def trunk(radii=RADII, **geometry):
    return ConstantCurvatureChain(radii, **geometry)


def tendon_robot(radii=(0.005, 0.0045, 0.004), lengths=(0.06, 0.07, 0.05), **geometry):
    return ConstantCurvatureChain(radii, lengths=lengths, **geometry)


def nominal_tendon_robot(**geometry):
    return tendon_robot([0.0045] * 3, [0.06] * 3, **geometry)


def arm(**geometry):
    """Six joints at different places about different axes."""
    places = np.array([[0, 0, 30], [10, 0, 5], [0, 5, 25], [8, 0, 20], [0, 0, 10], [5, 0, 0]])
    axes = [[0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]]
    origins = np.tile(np.eye(4), (6, 1, 1))
    origins[:, :3, 3] = 0.01 * places
    return RigidChain(origins, axes, **geometry)


def rings(turns, clockwise=()):
    """Angles of three actuators per segment; segments in `clockwise` run the other way round."""
    steps = [-THIRD if k in clockwise else THIRD for k in range(len(turns))]
    return [[turn + step * i for i in range(3)] for turn, step in zip(turns, steps, strict=True)]


def difference(angles, others):
    """Differences of angles, in [-pi, pi)."""
    return (angles - others + math.pi).remainder(2 * math.pi) - math.pi


# Truth, start, draw, and parameters.
ZEROS = [0.004, -0.002, 0.001, 0.003, 0.0, -0.005, 0.002, 0.002, -0.003]
RESTS = [[0.1, -0.2], [0.3, 0.05], [-0.1, 0.15]]
ANGLES = [[0.0, 2.0, 4.3], [0.3, 2.5, 4.4], [0.8, 3.0, 4.9]]
PLANTED = {
    "turns": (
        tendon_robot(routing="base", angles=rings([0.1, 0.3, 0.8]), offsets=[0, 0, 0.02]),
        nominal_tendon_robot(routing="base"),
        tendons,
        ("radii", "lengths", "turns", "tool"),
    ),
    "every angle": (
        tendon_robot(angles=ANGLES, routing="base"),
        nominal_tendon_robot(routing="base"),
        tendons,
        ("radii", "lengths", "angles"),
    ),
    "rest bends": (
        tendon_robot(rest_bends=RESTS, base=planted_base()),
        nominal_tendon_robot(),
        tendons,
        ("radii", "lengths", "rest_bends", "base"),
    ),
    "zeros and offsets": (
        trunk(actuator_zeros=ZEROS, offsets=[0.03, 0.02, 0.1]),
        trunk([0.09] * 3),
        chambers,
        ("radii", "actuator_zeros", "offsets"),
    ),
    "arm": (
        arm(base=planted_base(), tool=[0.02, -0.03, 0.15]),
        arm(),
        lambda rng: uniform(rng, 100, 6),
        ("base", "tool"),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", PLANTED)
def test_planted_geometry_is_recovered_from_exact_data(case, rng):
    truth, start, draw, names = PLANTED[case]
    before = {name: value.clone() for name, value in start.geometry().items()}
    q = draw(rng)
    result = calibrate(start, q, truth(q), names)
    assert result.converged
    assert_close(result.chain(q), truth(q), rtol=0, atol=1e-9)
    for name, value in result.chain.geometry().items():
        assert_close(value, truth.geometry()[name], rtol=0, atol=1e-9, msg=name)
    assert all(result.identifiable[name].all() for name in names)
    assert result.unidentified == ()
    for name, value in start.geometry().items():
        assert_close(value, before[name], rtol=0, atol=0)


@pytest.mark.parametrize("lengths", [None, [0.06, 0.05]])
def test_of_four_zeros_what_no_arc_sees_stays_with_the_prior(lengths, rng):
    radii = [0.1, 0.08] if lengths is None else [0.005, 0.004]
    draw, scale = (chambers, 1.0) if lengths is None else (tendons, 0.1)
    q, zeros = draw(rng, n_actuators=8), scale * torch.tensor(ZEROS[:8]).double()
    truth = trunk(radii, n_actuators=4, lengths=lengths, actuator_zeros=zeros)
    start = trunk([1.1 * radii[0], 0.9 * radii[1]], n_actuators=4, lengths=lengths)
    result = calibrate(start, q, truth(q), ("radii", "actuator_zeros"))
    assert_close(result.chain(q), truth(q), rtol=0, atol=1e-9)
    assert_close(result.chain.radii, truth.radii, rtol=0, atol=1e-9)
    assert_close(result.chain.arc_offset, truth.arc_offset, rtol=0, atol=1e-9)
    assert len(result.unidentified) == (2 if lengths is None else 4)
    for sentence in result.unidentified:  # each about one segment alone, and its actuators
        indices = {int(index) for index in re.findall(r"\[(\d)\]", sentence)}
        assert indices
        assert len({index // 4 for index in indices}) == 1
        assert "does not move the tips" in sentence


@pytest.mark.parametrize("lengths", [None, [0.06, 0.05]])
@pytest.mark.parametrize(("routing", "n", "tip"), [("segment", 4, 2.0), ("base", 3, 1.5)])
def test_derivatives_by_the_geometry(lengths, routing, n, tip, rng):
    """On a robot whose geometry is nowhere zero."""
    scale = 1.0 if lengths is None else 0.05
    chain = ConstantCurvatureChain(
        scale * torch.tensor([0.1, 0.08]),
        n_actuators=n,
        angles=[(2 * math.pi / n) * torch.arange(n) + 0.2 * uniform(rng, n) for _ in range(2)],
        lengths=lengths,
        routing=routing,
        offsets=[0.1 * scale, 0.2 * scale],
        rest_bends=0.2 * uniform(rng, 2, 2),
        actuator_zeros=0.01 * scale * uniform(rng, 2 * n),
        base=planted_base(),
    ).with_tip(tip)
    q = (chambers if lengths is None else tendons)(rng, 7, 2 * n)
    for name, value in chain.geometry().items():
        tangents = {name: torch.eye(value.numel()).double().reshape(-1, *value.shape)}
        expected = torch.func.jacfwd(lambda v, n=name: chain.with_geometry(**{n: v})(q))(value)
        J = chain.geometry_jacobian(q, tangents)
        assert_close(J, expected.flatten(2), rtol=1e-9, atol=1e-11, msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize(
    ("turns", "clockwise"),
    [((180, 90), ()), ((120, -150), (0,)), ((0, 180), (0, 1)), ((100, 100, -170), (1,))],
)
def test_turned_and_mirrored_rings_are_found_from_none(turns, clockwise, noise, rng):
    S, turns = len(turns), np.radians(turns)
    q = chambers(rng, 100, 3 * S)
    truth = trunk(RADII[:S], angles=rings(turns, clockwise), base=planted_base())
    x = truth(q) + noise * gauss(rng, 100, 3)
    result = calibrate(trunk([0.09] * S), q, x, ("radii", "turns", "base"))
    assert_close(result.chain(q), truth(q), rtol=0, atol=max(1e-9, 3 * noise))
    between = difference(result.values["turns"].diff(), torch.from_numpy(np.diff(turns)))
    assert between.abs().max() < (1e-9 if noise == 0 else 0.02)
    steps = difference(result.chain.angles[1::3], result.chain.angles[::3])
    expected = [-THIRD if k in clockwise else THIRD for k in range(S)]
    assert_close(steps, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the calibrated model has a median")  # the noise
@pytest.mark.parametrize(("bend", "noise"), [(1.0, 0.02), (0.01, 0.0), (0.01, 0.02)])
@pytest.mark.parametrize("names", [("radii", "base"), ("radii", "turns", "base")])
def test_a_right_handed_robot_stays_so(bend, noise, names, rng):
    """Even where the robot hardly bends or the noise hides all; no warning of a mirror image."""
    q = 0.25 + bend * (chambers(rng) - 0.25)
    x = trunk(base=planted_base())(q) + noise * gauss(rng, 100, 3)
    chain = calibrate(trunk([0.09] * 3), q, x, names).chain
    steps = difference(chain.angles[1::3], chain.angles[::3])
    assert_close(steps, torch.full((3,), THIRD).double(), rtol=0, atol=1e-6)


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


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize(("names", "apart"), [(("radii",), 0.0), (("radii", "base"), 1e-12)])
def test_weights_are_repetitions(loss, names, apart, rng):
    """Equal rows are merged; rows that differ by 1e-12 m are not, and count as often."""
    q = chambers(rng, 40)
    x = ConstantCurvatureChain(RADII)(q) + 0.01 * torch.randn(40, 3, generator=rng).double()
    x[1:4] += 0.2
    weights, motions = torch.arange(40) % 3, np.arange(40) // 20
    repeated = torch.arange(40).repeat_interleave(weights)
    many = x[repeated] + apart * torch.arange(len(repeated))[:, None]
    nominal = ConstantCurvatureChain([0.09, 0.09, 0.09])
    own = {"loss": loss, "groups": motions, "sample_weight": weights}
    weighted = calibrate(nominal, q, x, names, **own)
    own = {"loss": loss, "groups": motions[repeated]}
    expanded = calibrate(nominal, q[repeated], many, names, **own)
    # 40 rows that are up to 4e-11 m apart move the result by less, but the search ends elsewhere.
    rtol = 1e-9 if apart == 0.0 else 1e-6
    for name in names:
        assert_close(weighted.values[name], expanded.values[name], rtol=rtol, atol=rtol)
        found, expected = weighted.std_errors[name], expanded.std_errors[name]
        assert_close(found, expected, rtol=10 * rtol, atol=0)
    assert weighted.rmse == pytest.approx(expanded.rmse, rel=rtol)
    assert weighted.cv_rmse == pytest.approx(expanded.cv_rmse, rel=rtol)


def test_the_effect_of_what_is_not_identified_is_that_on_a_mean_row(rng):
    q = 0.25 + 0.001 * uniform(rng, 12, 9)
    x = trunk()(q) + 0.0015 * gauss(rng, 12, 3)
    thrice = torch.arange(12).repeat(3)
    apart = 1e-12 * torch.arange(36)[:, None]  # or equal rows are merged
    nominal = trunk([0.09, 0.09, 0.09])
    weighted = calibrate(nominal, q, x, ("radii",), sample_weight=[3.0] * 12).unidentified
    assert "mm rms" in weighted[0]
    assert weighted == calibrate(nominal, q[thrice], x[thrice] + apart, ("radii",)).unidentified


@pytest.mark.parametrize("loss", LOSSES)
def test_order_of_rows_and_names_of_motions_do_not_matter(loss, rng):
    q = chambers(rng, 40)
    x = ConstantCurvatureChain(RADII)(q) + 0.01 * torch.randn(40, 3, generator=rng).double()
    motions, order = np.arange(40) // 10, torch.randperm(40, generator=rng).numpy()
    weights = np.arange(40) % 3
    names = np.array(["d", "a", "c", "b"])[motions]
    nominal = ConstantCurvatureChain([0.09, 0.09, 0.09])
    own = {"loss": loss, "groups": motions, "sample_weight": weights}
    as_given = calibrate(nominal, q, x, ("radii",), **own)
    own = {"loss": loss, "groups": names[order], "sample_weight": weights[order]}
    mixed = calibrate(nominal, q[order], x[order], ("radii",), **own)
    assert_close(mixed.values["radii"], as_given.values["radii"], rtol=1e-8, atol=0)
    assert mixed.cv_rmse == pytest.approx(as_given.cv_rmse, rel=1e-8)


@pytest.mark.parametrize("loss", ["linear", "soft_l1"])
def test_motions_are_held_out_as_a_whole_with_their_weights(loss, rng):
    """The error on a motion is that of a calibration without it; its rows count by weight."""
    q = chambers(rng, 40)
    truth = ConstantCurvatureChain(RADII)
    motions = np.arange(40) % 4  # each with an error of its own
    x = truth(q) + 0.02 * torch.randn(4, 3, generator=rng).double()[motions]
    q[5], x[5] = q[4], x[4]  # a row of two motions
    weights = np.arange(40) // 4 % 3
    nominal = ConstantCurvatureChain([0.09, 0.09, 0.09])
    own = {"loss": loss, "groups": motions, "sample_weight": weights}
    found = calibrate(nominal, q, x, ("radii",), **own).cv_rmse
    squares = 0.0
    for motion in range(4):
        kept = motions != motion
        own = {"loss": loss, "sample_weight": weights[kept]}
        chain = calibrate(nominal, q[kept], x[kept], ("radii",), **own).chain
        apart = (chain(q) - x)[~kept].square().sum(1)
        squares += weights[~kept] @ apart.numpy()
    # Held-out fits end at steps of 1e-6.
    assert found == pytest.approx((squares / weights.sum()) ** 0.5, rel=1e-4)


def test_the_guess_of_the_base_ignores_rows_of_no_weight(rng):
    truth = trunk(base=planted_base())
    q = chambers(rng, 20)
    x = truth(q)
    x[::2] += gauss(rng, 10, 3)
    weights = (torch.arange(20) % 2).double()
    base = aligned(trunk(), TipRows(q, x, weights)).geometry()["base"]
    assert_close(base, planted_base(), rtol=0, atol=1e-9)


def test_held_out_fits_count_rows_as_often_as_their_weights(rng):
    q = chambers(rng, 40)
    x = ConstantCurvatureChain(RADII)(q) + 0.01 * torch.randn(40, 3, generator=rng).double()
    weights = torch.arange(40) % 3
    repeated = torch.arange(40).repeat_interleave(weights)
    problem = Problem.of(ConstantCurvatureChain([0.09, 0.09, 0.09]), ("radii",))
    start = Start(problem, problem.start(1.0))
    weighted = refitted(start, q, x, weights).radii
    expanded = refitted(start, q[repeated], x[repeated], torch.ones(len(repeated))).radii
    assert_close(weighted, expanded, rtol=1e-6, atol=0)


def test_leaving_what_is_physical_warns(rng):
    q = chambers(rng)
    x = trunk(offsets=[0.0, 0.0, -0.08])(q)
    with pytest.warns(UserWarning, match="tool is -80 mm"):
        calibrate(trunk(), q, x, ("tool",))
    with pytest.warns(UserWarning, match=r"offsets\[2\] is -80 mm"):
        calibrate(trunk(), q, x, ("offsets",))
    with pytest.warns(UserWarning, match=r"radii\[0\] is 2 times"):
        calibrate(trunk([0.05, 0.093, 0.079]), q, trunk()(q), ("radii",))
    # The start is never wrong: a tool that was behind the end may stay there.
    calibrate(trunk([0.09] * 3, offsets=[0.0, 0.0, -0.08]), q, x, ("radii", "tool"))


def test_tips_in_millimetres_are_noticed(rng):
    chain, q = nominal_tendon_robot(), tendons(rng)
    with torch.no_grad():
        x = chain(q)
    with pytest.warns(UserWarning, match="`x` spans"):
        calibrate(chain, q, 1000 * x, ("base",))
    far = x + torch.tensor([40.0, 0.0, 0.0], dtype=torch.float64)  # a far frame is none
    assert calibrate(chain, q, far, ("base",), prior=math.inf).rmse < 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": ("radius",)}, "mean 'radii'"),
        ({"parameters": ("radii", "zeros")}, "mean 'actuator_zeros'"),
        ({"parameters": "auto"}, "let `choose_geometry` choose"),
        ({"parameters": ("lengths",)}, "`parameters`"),
        ({"parameters": ("offsets", "tool")}, "leave 'tool' out"),
        ({"loss": "l1"}, "`loss`"),
        ({"q": np.full((5, 9), 0.25)}, "`x` must have shape"),
        ({"q": np.zeros((0, 9)), "x": np.zeros((0, 3))}, "at least one row"),
        ({"groups": [1] * 10}, "at least two motions"),
        ({"sample_weight": [0] * 10}, "`sample_weight`"),
    ],
)
def test_bad_input_says_what_is_needed(change, message):
    arguments = {"q": np.full((10, 9), 0.25), "x": np.zeros((10, 3)), **change}
    with pytest.raises(ValueError, match=message):
        calibrate(ConstantCurvatureChain(RADII), **arguments)


def test_tendons_that_contradict_each_other_warn_once(rng):
    truth = nominal_tendon_robot()
    q = tendons(rng)
    parts = q.unflatten(1, (3, 3))
    balanced = (parts - parts.mean(2, keepdim=True)).flatten(1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        calibrate(truth, balanced, truth(balanced), ("radii",))
    balanced[7, 3:6] -= 0.003
    balanced[9, :3] += 0.002
    with pytest.warns(UserWarning, match="row 7, segment 2, 3 mm") as caught:
        calibrate(truth, balanced, truth(balanced), ("radii",))
    assert len(caught) == 1
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the fit itself returns its messages
        result = fit_geometry(truth, balanced, truth(balanced), ("radii",))
    assert result.messages == (str(caught[0].message),)
    assert_close(result.values["radii"], truth.radii, rtol=1e-9, atol=0)


def test_columns_in_a_wrong_order_are_noticed_but_not_outliers(rng):
    chain, q = nominal_tendon_robot(), tendons(rng)
    with torch.no_grad():
        x = chain(q)
    shuffled = q[:, torch.randperm(q.shape[1], generator=rng)]
    with pytest.warns(UserWarning, match="Order or sign"):
        calibrate(chain, shuffled, x, ("base",))
    spoiled = x.clone()
    spoiled[: len(x) // 5] += 0.1
    calibrate(chain, q, spoiled, ("base",), loss="cauchy")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`q` holds 4 different rows")
def test_standard_errors_are_the_spread_of_the_estimates_also_with_few_rows(rng):
    """Four rows determine the six numbers of the base: half of the degrees of freedom are left."""
    truth = trunk(base=planted_base())
    q = chambers(rng, 4)
    x = truth(q)
    squares, variances = [], []
    for _ in range(40):
        result = calibrate(truth, q, x + 1e-4 * gauss(rng, 4, 3), parameters=("base",))
        squares.append((result.values["base"][:3, 3] - truth.base[:3, 3]).square().sum())
        variances.append(result.std_errors["base"][3:].square().sum())
    # Means of 40 variances with 6 degrees of freedom are right to a tenth; 12 degrees of freedom
    # would halve them.
    expected = 1e-8 * _base_variance(truth, q)
    assert torch.stack(squares).mean() == pytest.approx(expected, rel=0.4)
    assert torch.stack(variances).mean() == pytest.approx(expected, rel=0.3)


def _base_variance(chain, q):
    """Return the summed variances of the origin of the base, for tips of unit variance."""
    # A small turn phi and shift move a tip by phi x (x - origin) + shift.
    arms = (chain(q) - chain.base[:3, 3]).numpy()
    J = np.vstack([np.hstack([np.cross(arm, np.eye(3)), np.eye(3)]) for arm in arms])
    return np.trace(np.linalg.inv(J.T @ J)[3:, 3:])
