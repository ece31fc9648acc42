"""Scenes of obstacles in TOML files."""

import numpy as np
import pytest
import torch

from hybridkin import obstacles

SCENE = """
unit = "mm"

[[sphere]]
name = "lamp"
center = [0, 80, 500]
radius = 30

[[half_space]]
normal = [0.0, 0.0, 2.0]
offset = -40.0

[[capsule]]
start = [-100.0, 0.0, 400.0]
end = [100.0, 0.0, 400.0]
radius = 10.0

[[box]]
center = [0.0, 0.0, 900.0]
size = [200.0, 20.0, 100.0]
rotation_vector_deg = [0.0, 0.0, 30.0]
radius = 5.0

[[sphere]]
center = [1.0, 2.0, 3.0]
radius = 4.0
"""


@pytest.fixture
def written(tmp_path):
    def write(text):
        path = tmp_path / "scene.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_a_scene_file_gives_the_obstacles_of_their_classes(written):
    cosine, sine = np.cos(np.pi / 6.0), np.sin(np.pi / 6.0)
    turned = [[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]
    expected = [
        obstacles.Sphere([0.0, 0.08, 0.5], 0.03, name="lamp"),
        obstacles.Sphere([0.001, 0.002, 0.003], 0.004),
        obstacles.HalfSpace([0.0, 0.0, 1.0], -0.02),
        obstacles.Capsule([-0.1, 0.0, 0.4], [0.1, 0.0, 0.4], 0.01),
        obstacles.Box([0.0, 0.0, 0.9], [0.2, 0.02, 0.1], turned, 0.005),
    ]
    scene = obstacles.read_scene(written(SCENE))
    assert [type(obstacle) for obstacle in scene] == [type(obstacle) for obstacle in expected]
    for obstacle, other in zip(scene, expected, strict=True):
        torch.testing.assert_close(obstacle.numbers, other.numbers, rtol=1e-12, atol=1e-15)
        assert obstacle.name == other.name


def test_units_change_lengths_and_nothing_else(written):
    metres = written(SCENE.replace('"mm"', '"m"'))
    in_metres = obstacles.as_numbers(obstacles.read_scene(metres))
    in_millimetres = obstacles.as_numbers(obstacles.read_scene(written(SCENE)))
    scale = torch.ones(19, dtype=torch.float64)
    scale[:3] = scale[12:] = 1e-3
    torch.testing.assert_close(in_millimetres, in_metres * scale, rtol=1e-12, atol=1e-15)


def test_a_file_without_tables_is_an_empty_scene(written):
    assert obstacles.read_scene(written("")) == []


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("radius = 30", "radius = -30", r"`radius` in \[\[sphere\]\] 1 must be a positive number"),
        ("radius = 4.0", "radius = nan", r"`radius` in \[\[sphere\]\] 2 must be a positive number"),
        ("radius = 4.0", "", r"`radius` is missing in \[\[sphere\]\] 2"),
        ("radius = 4.0", "raduis = 4.0", r"`raduis` in \[\[sphere\]\] 2 .* did you mean `radius`"),
        ("radius = 4.0", "radius = 4.0\nsize = [1, 1, 1]", r"`size` in \[\[sphere\]\] 2 is not kn"),
        ("[0, 80, 500]", "[0, 80]", r"`center` in \[\[sphere\]\] 1 must hold 3 numbers"),
        ("[0, 80, 500]", "[0, 80, inf]", r"`center` in \[\[sphere\]\] 1 must hold 3 numbers"),
        ("[0, 80, 500]", '["0", 80, 5]', r"`center` in \[\[sphere\]\] 1 must hold 3 numbers"),
        ("[0.0, 0.0, 2.0]", "[0, 0, 0]", r"\[\[half_space\]\] 1: `normal` must have a direction"),
        ("200.0, 20.0", "200.0, 0.0", r"`size` in \[\[box\]\] 1 must hold 3 positive numbers"),
        ('"lamp"', "1", r"`name` in \[\[sphere\]\] 1 must be text"),
        ('"mm"', '"miles"', "`unit` in the file must be one of"),
        ("[[box]]", "[[cube]]", "`cube` in the file is not known; known: "),
        ("[[box]]", "[box]", "`box` in the file must hold tables, each under a heading in double"),
        ("[[box]]", "[[box", "this is not a TOML file"),
    ],
)
def test_errors_name_file_table_and_key(written, old, new, words):
    assert old in SCENE
    with pytest.raises(ValueError, match=rf"scene\.toml: .*{words}"):
        obstacles.read_scene(written(SCENE.replace(old, new, 1)))


def test_what_is_no_scene_file(written, tmp_path):
    with pytest.raises(FileNotFoundError, match="`path` must be a scene of obstacles"):
        obstacles.read_scene(tmp_path)
    with pytest.raises(ValueError, match="a scene of obstacles must be at most 30000 bytes long"):
        obstacles.read_scene(written("#" * 40_000))
    with pytest.raises(ValueError, match="this is not a TOML file"):
        obstacles.read_scene(written("a = " + "[" * 5000))
    with pytest.raises(TypeError, match="`path` must be a path"):
        obstacles.read_scene([])


def test_names_stay_with_moved_obstacles():
    ball = obstacles.Sphere([0.0, 0.0, 1.0], 0.1, name="ball")
    assert ball.moved([1.0, 0.0, 0.0]).name == "ball"
    assert "'ball'" in repr(ball)
    with pytest.raises(TypeError, match="`name` must be text"):
        obstacles.Sphere([0.0, 0.0, 1.0], 0.1, name=b"ball")
