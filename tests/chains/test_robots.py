import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, ForceTendonChain, robots

TENDONS = """
name = "three by three"
routing = "base"
calibrate = ["radii", "base"]
[[segment]]
radius = 0.0045
length = 0.06
angle_deg = 30
repeat = 2
[[segment]]
radius = 0.004
length = 0.05
actuators = 4
clockwise = true
offset = 0.01
[base]
position = [0, 0, 1]
rotation_vector_deg = [180, 0, 0]
[log]
q = ["a", "b", "c", "d", "e", "f", "g", "h", "i", "j"]
x = ["x", "y", "z"]
q_unit = "mm"
q_sign = -1
groups = "motion"
time = "t"
[limits]
q_min = -0.01
q_max = [0.01, 0.01, 0.01, 0.02, 0.02, 0.02, 0.03, 0.03, 0.03, 0.03]
"""


ELASTIC = """
model = "elastic-tendon"
[[segment]]
radius = 0.0045
length = 0.06
angle_deg = 30
clockwise = true
rest_bend_deg = [90, -4.5]
zeros = [0.001, 0, -0.002]
bending_stiffness = 1e-6
axial_stiffness = 3
repeat = 2
[[segment]]
radius = 0.004
length = 0.05
offset = 0.01
angles_deg = [0, 90]
bending_stiffness = 2e-6
axial_stiffness = 4
[base]
position = [0, 0, 1]
"""


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / "robot.toml"
        path.write_text(text)
        return path

    return write


def test_description_is_the_chain_it_describes(write):
    robot = robots.read_description(write(TENDONS))
    turn = math.radians(30)
    base = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    base[2, 3] = 1.0
    expected = ConstantCurvatureChain(
        [0.0045, 0.0045, 0.004],
        n_actuators=[3, 3, 4],
        angles=[[turn + 2 * math.pi / 3 * i for i in range(3)]] * 2
        + [[-math.pi / 2 * i for i in range(4)]],
        lengths=[0.06, 0.06, 0.05],
        routing="base",
        offsets=[0.0, 0.0, 0.01],
        base=base,
    )
    q = 1e-3 * torch.arange(10, dtype=torch.float64)
    assert_close(robot.chain(q), expected(q), rtol=1e-13, atol=1e-15)
    assert robot.name == "three by three"
    assert robot.calibrate == ("radii", "base")
    log = robots.LogFormat(
        tuple("abcdefghij"), ("x", "y", "z"), "motion", time="t", q_unit="mm", q_sign=-1
    )
    assert robot.log == log


def test_actuator_vectors_go_to_logs_and_back(write):
    robot = robots.read_description(write(TENDONS))
    q = 1e-3 * np.arange(20.0).reshape(2, 10)
    assert_allclose(robot.to_log(q), -np.arange(20.0).reshape(2, 10), rtol=1e-14)
    assert not np.signbit(robot.to_log(q)[0, 0])
    assert_allclose(robot.from_log(robot.to_log(q)), q, rtol=1e-14)
    plain = robots.read_description(write("[[segment]]\nradius = 0.1"))
    with pytest.raises(ValueError, match=r"robot.toml must have a table \[log\]"):
        plain.to_log(q)


def test_elastic_tendons(write):
    robot = robots.read_description(write(ELASTIC))
    base = torch.eye(4, dtype=torch.float64)
    base[2, 3] = 1.0
    ring = [math.radians(30) - 2 * math.pi / 3 * i for i in range(3)]
    expected = ElasticTendonChain(
        [0.0045, 0.0045, 0.004],
        [0.06, 0.06, 0.05],
        n_actuators=[3, 3, 2],
        angles=[ring, ring, [0.0, math.pi / 2]],
        bending_stiffness=[1e-6, 1e-6, 2e-6],
        axial_stiffness=[3.0, 3.0, 4.0],
        tendon_zeros=[0.001, 0.0, -0.002] * 2 + [0.0] * 2,
        rest_bends=[[math.pi / 2, -math.pi / 40]] * 2 + [[0.0, 0.0]],
        offsets=[0.0, 0.0, 0.01],
        base=base,
    )
    assert isinstance(robot.chain, ElasticTendonChain)
    assert_close(robot.chain.geometry(), expected.geometry(), rtol=1e-15, atol=1e-15)
    assert robot.chain.routing == "base"
    assert robot.calibrate == "auto"
    assert robot.base_is_free
    q = 1e-3 * torch.arange(-4, 4, dtype=torch.float64)
    assert_close(robot.chain(q), expected(q), rtol=1e-13, atol=1e-15)


def test_pairs_mixed_segments_and_stages(write):
    text = """
        routing = "base"
        [[segment]]
        stage = "rotation"
        offset = 0.1
        [[segment]]
        stage = "insertion"
        [[segment]]
        radius = 0.005
        length = 0.1
        actuators = 2
        angle_deg = 30
        repeat = 2
    """
    angles = [[0.0], [0.0], *[[math.pi / 6, math.pi / 6 + math.pi]] * 2]
    expected = ConstantCurvatureChain(
        [0.005] * 4,
        n_actuators=[1, 1, 2, 2],
        angles=angles,
        lengths=[None, None, 0.1, 0.1],
        routing="base",
        offsets=[0.1, 0.0, 0.0, 0.0],
        stage="rotation",
    )
    q = torch.tensor([1.0, 0.2, -0.003, 0.003, 0.001, -0.001], dtype=torch.float64)
    chain = robots.read_description(write(text)).chain
    assert_close(chain.pose(q), expected.pose(q), rtol=1e-14, atol=1e-15)
    assert repr(chain) == repr(expected)
    every = "[[segment]]\nstage = 'insertion'\noffset = 0.1\nzeros = [0.02]\ngain = 0.5\n"
    slid = robots.read_description(write(every + SEGMENT + "gain = 1.0\n")).chain
    q = torch.tensor([0.3, 0.0, 0.0, 0.0], dtype=torch.float64)
    assert_close(slid(q)[2] - slid(0.0 * q)[2], torch.tensor(0.15).double(), rtol=1e-7, atol=0)
    mixed = robots.read_description(
        write("[[segment]]\nradius = 0.02\n" + SEGMENT.replace("0.1", "0.02"))
    ).chain
    assert mixed.extensible == (True, False)
    counts = "[log]\nq = ['a', 'b', 'c', 'd']\nx = ['x', 'y', 'z']\nq_unit = 'deg'\n"
    stage = "[[segment]]\nstage = 'rotation'\ngain = 0.5\n" + SEGMENT + "spool_radius = 0.01\n"
    turned = robots.read_description(write(stage + counts)).chain
    q = torch.tensor([2.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    assert_close(turned.metres(q)[0], torch.tensor(math.degrees(1.0)).double(), rtol=1e-7, atol=0)


def test_markers_of_a_log_are_the_outputs_of_the_chain(write):
    columns = [f"{axis}{k}" for k in range(2) for axis in "xyz"]
    log = f"[log]\nq = ['a', 'b', 'c']\nx = {columns}\n"
    places = "markers = [[0, 0.5, 0.01, 0, 0], [0, 1.0, 0, 0, 0.02]]\n"
    segment = "[[segment]]\nradius = 0.01\nlength = 0.1\n"
    robot = robots.read_description(write(segment + log + places))
    assert robot.chain.markers == ((0.5, 0.01, 0.0, 0.0), (1.0, 0.0, 0.0, 0.02))
    x = robot.chain(torch.zeros(3, dtype=torch.float64))
    assert_close(x, x.new_tensor([0.01, 0.0, 0.05, 0.0, 0.0, 0.12]), rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match=r"`x` in \[log\] must hold 3 column names"):
        robots.read_description(write(segment + log))


def test_defaults_are_chambers_named_after_the_file(write):
    robot = robots.read_description(write("[[segment]]\nradius = 0.1\n"))
    assert robot.name == "robot"
    assert robot.chain.lengths is None
    assert robot.log is None
    assert robot.calibrate == "auto"
    by_list = robots.read_description(write("calibrate = 'default'\n[[segment]]\nradius = 0.1\n"))
    assert by_list.calibrate == ("radii", "base")


SEGMENT = "[[segment]]\nradius = 0.1\nlength = 1\n"
SPOOL, GAIN = SEGMENT + "spool_radius = 0.006\n", SEGMENT + "gain = 2e-5\n"
LOG = "[log]\nq = ['a', 'b', 'c']\nx = ['x', 'y', 'z']\n"


FORCES = """model = "force-tendon"
[[segment]]
radius = 0.01
length = 0.3
bending_stiffness = 0.02
axial_stiffness = 100
"""
ELASTIC_SEGMENT = "model = 'elastic-tendon'\n" + SEGMENT


@pytest.mark.parametrize(
    ("text", "message"),
    [
        # what is missing, unknown or twice
        ("name = 'a'", "`segment` is missing"),
        (LOG + "[base]", "`segment` is missing"),
        ("name = ", "not a TOML file"),
        ("[[segment]]\nlength = 1.0", "`radius` is missing"),
        ("[[segment]]\nradius = 0.1\nlenght = 0.2", "did you mean `length`"),
        (ELASTIC_SEGMENT.replace("length = 1\n", ""), "`length` is missing in ..segment.. 1"),
        (ELASTIC_SEGMENT + "axial_stiffness = 4\n" + SEGMENT, "`axial_stiffness` .* for segment 2"),
        (GAIN + SEGMENT, "`gains` must be in every"),
        (SEGMENT + "[log]\nq = ['a', 'b', 'c']", "`q` or `x` is missing in .log."),
        (SEGMENT + LOG.replace("'b'", "'x'"), "every column once"),
        (SEGMENT + LOG + "time = 'a'", "every column once"),
        # types and ranges
        ("[segment]\nradius = 0.1", "`segment`"),
        ("base = 3\n" + SEGMENT, "`base`"),
        ("name = 5\n" + SEGMENT, "`name`"),
        ("model = 'rigid'\n" + SEGMENT, "`model`"),
        ("routing = 'tip'\n" + SEGMENT, "`routing`"),
        ("calibrate = 'radii'\n" + SEGMENT, "`calibrate`"),
        ("calibrate = ['base', 'base']\n" + SEGMENT, "`calibrate`"),
        (SEGMENT.replace("0.1", "'0.1'"), "`radius`"),
        (SEGMENT.replace("0.1", "nan"), "`radius`"),
        (SEGMENT.replace("0.1", "true"), "`radius`"),
        (SEGMENT.replace("0.1", "1" + 400 * "0"), "`radius`"),
        (SEGMENT + SEGMENT.replace("0.1", "1e-9"), "`radii`"),
        (SEGMENT + "clockwise = 'false'", "`clockwise`"),
        (SEGMENT + "actuators = 2.5", "`actuators`"),
        (SEGMENT + "repeat = true", "`repeat`"),
        (SEGMENT + "repeat = 1000000", "`repeat`"),
        ((SEGMENT + "repeat = 64\n") * 2, "at most 64 segments in all, got 128"),
        (SEGMENT + "angles_deg = [[0, 120, 240]]", "`angles_deg`"),
        (SEGMENT + "angles_deg = [0, 90, 200]\nactuators = 3", "cannot be combined"),
        (SEGMENT + "rest_bend_deg = 90", "`rest_bend_deg`"),
        (SEGMENT + "zeros = [0, 0]", "`zeros` .* must hold 3"),
        (SEGMENT + "zeros = [0, nan, 0]", "`zeros`"),
        (SEGMENT + "[base]\nposition = [1]", "`position`"),
        (SEGMENT + "gain = 0.0", "`gain`"),
        # what does not fit together
        (SEGMENT + "axial_stiffness = 4", "`axial_stiffness` .* another model"),
        ("[[segment]]\nstage = 'rotation'\nlength = 1", "can only be combined"),
        (ELASTIC_SEGMENT + "[[segment]]\nstage = 'rotation'", "`stage` .* another model"),
        (SEGMENT + "weight = 1", '`weight` .* model = "force-tendon"'),
        (FORCES + "zeros = [0, 0, 0]", '`zeros` .* "constant-curvature" or "elastic-tendon"'),
        (FORCES.replace("axial_stiffness = 100", ""), "`axial_stiffness` is missing"),
        (FORCES + "taper = 1.0", "`taper`"),
        (FORCES + LOG + "q_unit = 'mm'", "not be a length"),
        (SEGMENT + "[base]\ngravity = [0, 0, 1]", "`gravity`"),
        (SEGMENT + "[[segment]]\nstage = 'rotation'", "in the first"),
        (SEGMENT + LOG.replace(", 'c'", ""), "`q` in .log. must name 3"),
        (LOG.replace("z'", "'").replace(", '']", "]"), "`x` in .log. must hold 3"),
        (SEGMENT + LOG + "q_sign = [1, -1]", "`q_sign`"),
        (SEGMENT + LOG + "q_unit = 'deg'", "`q_unit` .* `spool_radius`"),
        (SPOOL + "gain = 1e-5\n" + LOG + "q_unit = 'deg'", "no `gain`"),
        (GAIN + LOG + "q_unit = 'mm'", "not a length"),
        (SEGMENT + "[limits]\nq_min = 2\nq_max = 1", "must not exceed `q_max`"),
        (SEGMENT + "[limits]\ndq_max = 0", "`dq_max`"),
        (GAIN + LOG + "[limits]\nq_min = 0", '`unit` in .limits. must be "log"'),
        (SEGMENT + "[limits]\nq_min = 0\nunit = 'log'", 'must be "m" without .log.'),
        # what would take long to read
        ("x = " + 2000 * "[" + 2000 * "]", "not a TOML file"),
        ("x = " + 5000 * "1", "not a TOML file"),
        ("#" * 30_001, "at most 30000 bytes"),
        (".".join(["a"] * 9_000) + " = 1", "more than 600 dots"),
    ],
)
def test_bad_descriptions_name_the_key(write, text, message):
    with pytest.raises(ValueError, match=message):
        robots.read_description(write(text))


def test_tendon_forces(write):
    text = FORCES + "weight = 2\ntaper = 0.5\n" + LOG + "q_unit = 'N'\n"
    robot = robots.read_description(write(text + "[base]\ngravity = [0, 2, 0]\n"))
    expected = ForceTendonChain(
        [0.01], [0.3], 0.02, 100.0, weight=2.0, taper=0.5, gravity=[0, 1, 0]
    )
    forces = torch.tensor([[0.0, 0.0, 0.0], [3.0, 1.0, 0.0]], dtype=torch.float64)
    assert_close(robot.chain(forces), expected(forces))
    assert robot.chain.unit_of_q == "N"
    assert robot.calibrate == "auto"
    assert robot.log.q_factor == 1.0


def test_spools_scales_and_signs(write):
    text = SEGMENT + "spool_radius = [0.01, 0.01, 0.02]\nzeros = [90, 0, 45]\n"
    text += LOG + "q_unit = 'deg'\nq_sign = [1, -1, 1]\n"
    robot = robots.read_description(
        write(text + "[limits]\nunit = 'log'\nq_min = -90\nq_max = [180, 180, 90]\ndq_max = 360\n")
    )
    radian = math.radians(1.0) * np.array([1, -1, 1])
    assert robot.log.q_unit == "deg"
    assert robot.log.q_factor == pytest.approx(radian)
    assert robot.limits.q_min == pytest.approx([-90, 180, -90] * radian)
    assert robot.limits.q_max == pytest.approx([180, -90, 90] * radian)
    assert robot.limits.dq_max == pytest.approx(360 * abs(radian))
    back = robot.limits.scaled(1 / robot.log.q_factor)
    assert (back.q_min.tolist(), back.dq_max.tolist()) == ([-90] * 3, pytest.approx([360] * 3))
    one_sided = robots.Limits(q_min=np.zeros(3)).scaled(radian)
    assert one_sided.q_max.tolist() == [math.inf, 0.0, math.inf]
    assert_close(robot.chain.gains, torch.tensor([0.01, 0.01, 0.02], dtype=torch.float64))
    zeros = torch.tensor([math.pi / 2, 0.0, math.pi / 4], dtype=torch.float64)
    assert_close(robot.chain.actuator_zeros, zeros)
    assert robot.log.reading["q_unit"] == "deg"
    assert "group_suffix" not in robot.log.reading


def test_gains_of_counts_and_pressures(write):
    text = GAIN + "zeros = [1, 2, 3]\n" + LOG
    robot = robots.read_description(write(text + "q_unit = 'kPa'"))
    assert (robot.log.q_unit, float(robot.log.q_factor)) == ("kPa", 1.0)
    assert robot.log.reading["q_unit"] == "1"
    assert robot.chain.gains.tolist() == [2e-5] * 3
    assert robot.chain.actuator_zeros.tolist() == [1.0, 2.0, 3.0]
    limited = text + "[limits]\nunit = 'log'\nq_min = -500\nq_max = 800\n"
    assert robots.read_description(write(limited)).limits.q_max.tolist() == [800.0] * 3
    degrees = robots.read_description(write(GAIN + LOG + "q_unit = 'deg'")).chain
    assert degrees.gains.tolist() == pytest.approx([2e-5 * 180 / math.pi] * 3)
    assert robots.read_description(write(SPOOL)).chain.gains.tolist() == [0.006] * 3  # per radian
    elastic = "model = 'elastic-tendon'\n" + GAIN + "zeros = [1e-4, 0, 0]\n" + LOG
    assert robots.read_description(write(elastic)).chain.tendon_zeros.tolist() == [1e-4, 0.0, 0.0]


def test_a_robot_of_a_log_alone(write):
    text = LOG + "q_unit = 'deg'\nq_sign = -1\n[limits]\nunit = 'log'\nq_max = 90\n"
    robot = robots.read_description(write(text))
    assert (robot.chain, robot.calibrate, robot.n_actuators) == (None, (), 3)
    assert robot.limits.q_min == pytest.approx([-math.pi / 2] * 3)
    assert np.isinf(robot.limits.q_max).all()
