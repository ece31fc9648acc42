import math

import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, robots

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


def test_bionic_handling_assistant():
    chain = robots.bionic_handling_assistant(tool=0.1)
    assert_close(chain.radii, torch.tensor([0.100, 0.093, 0.079], dtype=torch.float64))
    straight = torch.full((9,), 0.25, dtype=torch.float64)
    assert_close(chain(straight), torch.tensor([0.0, 0.0, 0.85], dtype=torch.float64))


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
    assert_close(robots.from_toml(write(TENDONS))(q), expected(q), rtol=1e-13, atol=1e-15)
    assert robot.name == "three by three"
    assert robot.calibrate == ("radii", "base")
    log = robots.LogFormat(tuple("abcdefghij"), ("x", "y", "z"), "mm", "m", -1, "", "motion", "t")
    assert robot.log == log


def test_columns_of_motions_and_time_and_limits(write):
    robot = robots.read_description(write(TENDONS))
    assert (robot.log.groups, robot.log.time) == ("motion", "t")
    assert robot.limits.q_min.tolist() == [-0.01] * 10
    assert robot.limits.q_max.tolist() == [0.01] * 3 + [0.02] * 3 + [0.03] * 4
    assert robot.limits.dq_max is None
    plain = robots.read_description(write("[[segment]]\nradius = 0.1\n[limits]\ndq_max = 1"))
    assert plain.limits.q_min is None
    assert plain.limits.dq_max.tolist() == [1.0] * 3


def test_rest_bends_and_zeros(write):
    text = """
    [[segment]]
    radius = 0.01
    length = 0.1
    rest_bend_deg = [90, -4.5]
    zeros = [0.001, 0, -0.002]
    repeat = 2
    [[segment]]
    radius = 0.01
    length = 0.1
    actuators = 4
    """
    chain = robots.from_toml(write(text))
    expected = ConstantCurvatureChain(
        [0.01] * 3,
        n_actuators=[3, 3, 4],
        lengths=[0.1] * 3,
        rest_bends=[[math.pi / 2, -math.pi / 40]] * 2 + [[0.0, 0.0]],
        actuator_zeros=[0.001, 0.0, -0.002] * 2 + [0.0] * 4,
    )
    assert_close(chain.geometry(), expected.geometry(), rtol=1e-15, atol=0)


def test_elastic_tendons(write):
    robot = robots.read_description(write(ELASTIC))
    base = torch.eye(4, dtype=torch.float64)
    base[2, 3] = 1.0
    ring = [math.radians(30) - 2 * math.pi / 3 * i for i in range(3)]
    expected = ElasticTendonChain(
        [0.0045, 0.0045, 0.004],
        [0.06, 0.06, 0.05],
        n_tendons=[3, 3, 2],
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
    assert robot.calibrate == expected.default_parameters
    q = 1e-3 * torch.arange(-4, 4, dtype=torch.float64)
    assert_close(robots.from_toml(write(ELASTIC))(q), expected(q), rtol=1e-13, atol=1e-15)


def test_elastic_tendons_by_default(write):
    text = "model = 'elastic-tendon'\nrouting = 'segment'\ncalibrate = ['base']\n"
    robot = robots.read_description(write(text + "[[segment]]\nradius = 0.01\nlength = 0.1\n"))
    expected = ElasticTendonChain([0.01], [0.1], routing="segment")
    assert_close(robot.chain.geometry(), expected.geometry(), rtol=1e-15, atol=0)
    assert repr(robot.chain) == repr(expected)
    assert robot.calibrate == ("base",)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('model = "elastic-tendon"', ""), "`bending_stiffness` in .* not known to model"),
        (("length = 0.05\n", ""), "`length` is missing for segment 3"),
        (("axial_stiffness = 4\n", ""), "`axial_stiffness` must stand in every"),
        (("bending_stiffness = 1e-6\n", ""), "`bending_stiffness` must stand in every"),
        (("axial_stiffness = 4", "axial_stiffness = 'soft'"), "`axial_stiffness` in .* a number"),
        (("axial_stiffness = 4", "axial_stifness = 4"), "did you mean `axial_stiffness`"),
        (("axial_stiffness = 4", "axial_stiffness = -4"), "`axial_stiffness` must be positive"),
        (("zeros = [0.001, 0, -0.002]", "zeros = [0.001]"), "`zeros` in .* must hold 3"),
        (('"elastic-tendon"', '"elastic"'), "`model` must be one of .*'elastic-tendon'"),
        (("[[segment]]", "routing = 'tip'\n[[segment]]"), "`routing` must be one of"),
    ],
)
def test_bad_elastic_descriptions_name_the_key(write, change, message):
    assert change[0] in ELASTIC
    with pytest.raises(ValueError, match=message):
        robots.read_description(write(ELASTIC.replace(*change, 1)))


def test_defaults_are_chambers_named_after_the_file(write):
    robot = robots.read_description(write("[[segment]]\nradius = 0.1\n"))
    assert robot.name == "robot"
    assert robot.chain.lengths is None
    assert robot.log is None
    assert robot.calibrate == ("radii", "base")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("segment = 3", "`segment` is missing"),
        ("name = ", "is not a TOML file"),
        ("[[segment]]\nlength = 1.0", "`radius` is missing in .*segment.* 1"),
        ("[[segment]]\nradius = 0.1\nlenght = 0.2", "`lenght` in .* did you mean `length`"),
        ("[[segment]]\nradius = '0.1'", "`radius` in .* must be a number"),
        ("[[segment]]\nradius = -0.1", "`radii` must be positive"),
        ("[[segment]]\nradius = 0.1\nactuators = 2", "at least 3"),
        ("[[segment]]\nradius = 0.1\nrest_bend_deg = [1]", "`rest_bend_deg` in .* 1 must hold 2"),
        ("[[segment]]\nradius = 0.1\nrest_bend_deg = 90", "`rest_bend_deg` in .* must hold 2"),
        ("[[segment]]\nradius = 0.1\nzeros = [0, 0]", "`zeros` in .*segment.* 1 must hold 3"),
        ("[[segment]]\nradius = 0.1\nzeros = ['0', '0', '0']", "`zeros` in .* must hold 3"),
        ("[[segment]]\nradius = 0.1\nzeros = [0, [0], 0]", "`zeros` in .* must hold 3"),
        ("[[segment]]\nradius = 0.1\nzeros = [0, nan, 0]", "`zeros` in .* must hold 3"),
        ("[[segment]]\nradius = 0.1\n[base]\nposition = 'here'", "`position` in .* must hold 3"),
        ("[[segment]]\nradius = 0.1\nlength = 1\n[[segment]]\nradius = 0.1", "in every"),
        ("model = 'rigid'\n[[segment]]\nradius = 0.1", "`model` must be"),
        ("calibrate = 'radii'\n[[segment]]\nradius = 0.1", "`calibrate` must be a list"),
        ("[[segment]]\nradius = 0.1\n[base]\nposition = [1]", "`position` in .base. must hold 3"),
        ("[[segment]]\nradius = 0.1\n[log]\nq = ['a']", "`q` in .log. must name 3 columns"),
        (
            "[[segment]]\nradius = 0.1\n[log]\nq = ['a','b','c']\nx = ['x','y','z']\nq_unit = 'in'",
            "`q_unit` in .log. must be one of",
        ),
        (
            "[[segment]]\nradius = 0.1\n[log]\nq = ['a','b','c']\nx = ['x','y','z']\ngroups = 3",
            "`groups` in .log. must be text",
        ),
        ("[[segment]]\nradius = 0.1\n[limits]\nq_mni = 1", "did you mean `q_min`"),
        ("[[segment]]\nradius = 0.1\n[limits]\nq_min = [1, 2]", "`q_min` in .* must hold 3"),
        ("[[segment]]\nradius = 0.1\n[limits]\nq_min = 2\nq_max = 1", "must not exceed `q_max`"),
        ("[[segment]]\nradius = 0.1\n[limits]\ndq_max = 0", "`dq_max` .* must be positive"),
    ],
)
def test_bad_descriptions_name_the_key(write, text, message):
    with pytest.raises(ValueError, match=message):
        robots.read_description(write(text))


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        robots.from_toml(tmp_path / "none.toml")
