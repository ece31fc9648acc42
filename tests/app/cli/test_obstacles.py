"""Scenes of obstacles on the command line: `track`, `animate` and `view`."""

import numpy as np
import pytest
from PIL import Image
from simulated_log import document, run

from hybridkin import InverseKinematics, obstacles, robots
from hybridkin.app import workflow

LAMP = obstacles.Sphere([0.038, 0.0, 0.178], 0.012)
SCENE = """
unit = "mm"

[[sphere]]
name = "lamp *1*"
center = [38, 0, 178]
radius = 12

[[half_space]]
normal = [0, 0, 1]
offset = -30
"""
PATH = ["--shape", "line", "--size", "8,0,0", "--center=24,0,190", "--unit", "mm", "--dt", "0.5"]


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


def distances_in(folder, name="distance"):
    table = np.genfromtxt(folder / "track.csv", delimiter=",", names=True, dtype=None)
    return table[name], table["status"]


def test_a_track_keeps_clear_of_the_obstacles_of_a_file(robot, scene, tmp_path, capsys):
    out = tmp_path / "track"
    options = ["--obstacles", scene, "--clearance", "2mm", "--duration", 4, "--out-of-reach"]
    code, record = document(capsys, "track", robot, *PATH, *options, "--out", out)
    assert code == 0
    assert record["clearance"] == pytest.approx(0.002)
    lamp, floor = record["obstacles"]
    assert (lamp["name"], floor["name"]) == ("lamp *1*", "obstacle 2")
    assert 0.002 - 1e-6 < lamp["path"] < 0.0021
    assert record["blocked"] == record["statuses"]["BLOCKED"] > 0
    # What is sent keeps clear, by a solver of its own.
    chain = robots.read_description(robot).chain
    table = np.loadtxt(out / "track.csv", delimiter=",", skiprows=1, usecols=range(1, 7))
    ik = InverseKinematics(chain, q_min=-0.01, q_max=0.01, obstacles=[LAMP])
    least = ik.body_distances(-1e-3 * table)[:, 0]
    distance, status = distances_in(out)
    np.testing.assert_allclose(1e3 * least, distance, atol=1e-4)
    on_path = status != "LEAD_IN"
    assert least[on_path].min() == pytest.approx(lamp["path"], abs=1e-7)
    assert least[~on_path].min() == pytest.approx(lamp["lead_in"], abs=1e-7)
    text = (out / "report.md").read_text()
    assert "`*1*`" in text
    assert f"BLOCKED: {record['blocked']} points" in text
    assert (out / "obstacles.png").stat().st_size > 10_000
    # A film among the same obstacles.
    film = ["--obstacles", scene, "--frames", 2, "--out", tmp_path / "film.gif"]
    assert run(capsys, "animate", robot, out, *film)[0] == 0
    with Image.open(tmp_path / "film.gif") as image:
        brown = np.array(image.convert("RGB"), dtype=int)
    spread = brown[..., 0] - brown[..., 2]
    assert ((spread > 20) & (spread < 90) & (brown[..., 0] > 120)).sum() > 200


def test_a_lead_in_through_an_obstacle_is_named(robot, tmp_path, capsys):
    """The way to the path goes straight, whatever is there."""
    scene = tmp_path / "scene.toml"
    scene.write_text("[[sphere]]\ncenter = [0.02, 0.0, 0.194]\nradius = 0.002\n")
    (tmp_path / "path.csv").write_text("t,x,y,z\n0,45,0,180\n1,46,0,180\n")
    arguments = [tmp_path / "path.csv", "--unit", "mm", "--obstacles", scene, "--out-of-reach"]
    code, out, _ = run(capsys, "track", robot, *arguments, "--out", tmp_path / "track")
    assert code == 0
    assert "The lead-in does not keep clear of obstacle 1" in out.replace("\n", " ")
    out = tmp_path / "other"
    _, record = document(capsys, "track", robot, *arguments, "--from", "path", "--out", out)
    assert record["obstacles"][0]["lead_in"] is None
    assert record["obstacles"][0]["path"] > 0.0


@pytest.mark.parametrize(
    ("text", "metres"),
    [("5mm", 0.005), ("0.5 cm", 0.005), ("0.01m", 0.01), ("1in", 0.0254), ("3um", 3e-6)],
)
def test_a_clearance_is_a_length_with_its_unit(robot, scene, monkeypatch, capsys, text, metres):
    seen = {}

    def track_path(loaded, path, out, **options):
        seen.update(options)
        raise ValueError("enough")

    monkeypatch.setattr(workflow, "track_path", track_path, raising=False)
    options = ["--obstacles", scene, "--clearance", text, "--out", "nowhere"]
    assert run(capsys, "track", robot, *PATH, *options)[0] == 2
    assert seen["clearance"] == pytest.approx(metres, rel=1e-12)
    assert [type(obstacle).__name__ for obstacle in seen["obstacles"]] == ["Sphere", "HalfSpace"]


@pytest.mark.parametrize("text", ["5", "mm", "-1mm", "nanmm", "infmm", "5miles", ""])
def test_other_clearances_are_refused(robot, scene, capsys, text):
    options = ["--obstacles", scene, f"--clearance={text}", "--out", "nowhere"]
    with pytest.raises(SystemExit) as stopped:
        run(capsys, "track", robot, *PATH, *options)
    assert stopped.value.code == 2


def test_a_wrong_scene_file_is_named(robot, tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    scene.write_text("[[sphere]]\ncenter = [0, 0, 1]\n")
    for command in (["track", robot, *PATH, "--out", tmp_path / "t"], ["view", robot]):
        code, _, err = run(capsys, *command, "--obstacles", scene)
        assert code == 2
        assert "scene.toml: `radius` is missing in [[sphere]] 1" in err.replace("\n ", "")


def test_obstacles_of_a_controller_need_its_period(robot, scene, tmp_path, capsys):
    export = ["export", robot, "--out", tmp_path / "c", "--obstacles", scene]
    code, _, err = run(capsys, *export)
    assert code == 2
    assert "`obstacles` need `dt` (--dt)" in err
    code, record = document(capsys, *export, "--dt", 0.01, "--clearance", "2mm")
    assert code == 0
    assert record["obstacles"] == ["lamp *1*", "obstacle 2"]
    assert "double obstacles[38]" in (tmp_path / "c" / "model.h").read_text()
