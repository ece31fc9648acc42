"""The robots of examples/robots are those of their sources: sizes in closed form."""

import math
import re
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from hybridkin import robots

FOLDER = Path(__file__).parents[2] / "examples" / "robots"
NAMES = sorted(path.stem for path in FOLDER.glob("*.toml"))


def read(name):
    return robots.read_description(FOLDER / f"{name}.toml")


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_the_table_lists_every_robot():
    table = (FOLDER / "robots.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[(\w+)\]\((.*?)\) \| (\d+) \| (\d+) ", table, re.MULTILINE)
    assert sorted(name for name, *_ in rows) == NAMES
    for name, link, n_segments, n_actuators in rows:
        assert (FOLDER / link).stem == name
        chain = read(name).chain
        assert chain.n_segments == int(n_segments)
        assert chain.n_actuators == int(n_actuators)


@pytest.mark.parametrize(
    ("name", "straight", "tip"),
    [
        # Nine bellows of 0.2 m, within the limits of the simulator.
        ("bionic_handling_assistant", [0.2] * 9, (0.0, 0.0, 0.6)),
        ("rao_benchmark", [0.0] * 6, (0.0, 0.0, 0.4)),  # two segments of 200 mm
        ("till_tendon_robot", [0.0] * 4, (0.0, 0.0, 0.5)),
        ("sopra", [0.0] * 6, (0.0, 0.0, -0.29)),  # hangs: 125, 20, 125 and 20 mm
        ("stiff_flop", [0.05] * 3, (0.0, 0.0, 0.0645)),  # 50 mm, and a sensor of 14.5 mm
    ],
)
def test_a_straight_robot_is_as_long_as_published(name, straight, tip):
    assert_close(read(name).chain(tensor(*straight)), tensor(*tip), rtol=0.0, atol=1e-15)


def test_the_handling_assistant_is_that_of_the_library_and_of_the_published_equations():
    """Bending and length of a segment by its three lengths, as in the simulator of CoR-Lab."""
    robot = read("bionic_handling_assistant")
    low = torch.from_numpy(robot.limits.q_min)
    high = torch.from_numpy(robot.limits.q_max)
    q = low + (high - low) * torch.rand(50, 9, generator=torch.manual_seed(0), dtype=torch.float64)
    assert_close(robot.chain(q), robots.bionic_handling_assistant()(q), rtol=0.0, atol=0.0)
    lengths = q[:, :3]
    radius = 0.100
    a, b, c = lengths.T
    g = torch.sqrt(a * a + b * b + c * c - a * b - a * c - b * c)
    theta = 2.0 * g / (3.0 * radius)
    chord = lengths.mean(1) * torch.sin(theta / 2.0) / (theta / 2.0)
    end = robot.chain.with_tip(1.0)(q)
    assert_close(end.norm(dim=1), chord, rtol=1e-13, atol=0.0)


def test_pulled_tendons_bend_a_segment_by_their_stroke_over_the_radius():
    """A tendon pulled by d shortens by the radius times the angle; the tip lies on that arc."""
    robot = read("till_tendon_robot")
    stroke = 0.005  # the displacement of the example
    x = robot.chain(tensor(-stroke, 0.0, stroke, 0.0))
    theta = stroke / 0.01506
    arc = 0.5 / theta
    expected = tensor(arc * (1.0 - math.cos(theta)), 0.0, arc * math.sin(theta))
    assert_close(x, expected, rtol=1e-13, atol=1e-15)


def test_tendons_and_chambers_lie_where_the_sources_have_them():
    """Bent towards its first actuator, each robot moves in the direction of that actuator."""
    ring = tensor(1.0, -0.5, -0.5)
    towards = torch.cat([-1e-4 * ring, torch.zeros(3, dtype=torch.float64)])
    rao = read("rao_benchmark").chain(towards)
    assert rao[1] > 1e-3  # along y, where tendon 1 is
    assert abs(rao[0]) < 1e-15
    stiff_flop = read("stiff_flop").chain(0.05 - 1e-4 * ring)
    assert stiff_flop[1] > 1e-4
    assert abs(stiff_flop[0]) < 1e-15
    clockwise = read("rao_benchmark").chain.angles[:3]
    assert_close(torch.rad2deg(clockwise).remainder(360.0), tensor(90.0, 330.0, 210.0))


def test_radii_of_the_tapered_arm_are_centroids_of_its_chambers():
    """By the cross-section of the published code: half discs on the sides of a triangle [mm]."""
    chain = read("sopra").chain
    for radius, ends in zip(chain.radii, ((35.0, 28.0), (28.0, 19.8)), strict=True):
        outer = sum(ends) / 4.0
        cavity = outer - 2.0
        side = outer / math.sqrt(3.0)
        centroid = side + (4.0 * cavity**2 - 24.0) / (3.0 * cavity * math.pi - 24.0)
        assert_close(1e3 * float(radius), centroid, rtol=0.0, atol=0.005)
