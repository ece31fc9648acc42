"""The live view: what it draws and says, without a browser."""

import builtins
import time
from types import SimpleNamespace

import numpy as np
import pytest

import hybridkin
from hybridkin import (
    ELMRegressor,
    HybridForwardModel,
    datasets,
    obstacles,
    robots,
    trajectories,
)
from hybridkin.app.cli.main import main
from hybridkin.app.viewer.motions import Loop

pytest.importorskip("viser", reason='needs viser: pip install "hybridkin[view]"')

PLATE = obstacles.Box([-0.5, 0.0, 0.5], [0.02, 0.5, 0.5])


@pytest.fixture(scope="module")
def fitted():
    data = datasets.load_trunk()
    rows = datasets.paper_split(data, random_state=0)[0][:300]
    chain = robots.bionic_handling_assistant()
    model = HybridForwardModel(chain, "quadratic", calibrate="default", random_state=0)
    log = datasets.Log(data.q[rows], data.x[rows])
    return model.fit(log.q, log.x), log


@pytest.fixture
def shown(fitted):
    with hybridkin.app.view(*fitted, port=9300) as view:
        yield view


def until(condition, seconds=10.0):
    """Wait until a condition holds; fail after some seconds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_the_tip_follows_the_target_and_the_page_says_so(shown):
    target = shown.robot.x + np.array([0.1, 0.05, -0.02])
    shown.follow(target)
    until(lambda: np.linalg.norm(shown.robot.x - target) < 1e-3)
    until(lambda: "On target" in shown._words.content)
    time.sleep(0.3)
    assert np.linalg.norm(shown.robot.x - target) < 1e-3
    assert shown._aim.position == pytest.approx(target)
    sliders = np.array([slider.value for slider in shown._sliders])
    assert sliders == pytest.approx(shown.robot.q, abs=0.6 * shown._scales[0].step)
    assert shown._body._backbone.points[-1] == pytest.approx(shown.robot.x, abs=0.01)


def test_a_robot_at_rest_costs_nothing(shown):
    until(lambda: not shown.robot.tick())
    time.sleep(0.2)
    start = time.process_time()
    time.sleep(1.0)
    assert time.process_time() - start < 0.05


@pytest.mark.slow
def test_every_actuator_wiggles_and_the_robot_returns(shown):
    seen = []
    move = shown.robot.go_to
    shown.robot.go_to = lambda q: (seen.append(q), move(q))
    buttons = {h.label: h for h in shown._server.gui._gui_input_handle_from_uuid.values()}
    (start,) = buttons["Wiggle every actuator"]._impl.update_cb
    start(None)
    until(lambda: "moving: q5" in shown._words.content, 30.0)
    until(lambda: len(seen) == 19 and shown._motion is None, 60.0)
    away = np.array(seen[1::2]) - seen[0]
    assert (np.count_nonzero(away, axis=1) == 1).all()
    assert sorted(np.argmax(abs(away), axis=1)) == [*range(9)]
    assert shown.robot.q == pytest.approx(seen[0])


def test_a_click_on_a_row_of_the_log_moves_the_robot_there(shown, fitted):
    log = fitted[1]
    eye = log.x[7] + [0.0, -2.0, 0.3]
    ray = (log.x[7] - eye) / np.linalg.norm(log.x[7] - eye)
    (q, tip) = shown._rows.row_at(eye, ray)
    assert (log.q == q).all(axis=1).any()
    assert np.linalg.norm(np.cross(tip - eye, ray)) < 0.02 * shown.robot.size
    assert shown._rows.row_at(eye, -ray) is None
    shown._clicked(SimpleNamespace(ray_origin=tuple(eye), ray_direction=tuple(ray)))
    until(lambda: shown.robot.q == pytest.approx(q))
    assert shown._measured.position == pytest.approx(tip)


def test_a_path_is_followed_in_a_loop(fitted):
    path = trajectories.line([0.0, 0.0, 0.7], [0.05, 0.0, 0.7], duration=0.4, dt=0.02)
    with hybridkin.app.view(*fitted, path=path, port=9340) as shown:
        shown._motion = Loop(shown.robot, path)
        targets = []
        follow = shown.robot.follow
        shown.robot.follow = lambda target: (targets.append(target), follow(target))
        shown._wake.set()
        until(lambda: len(targets) > 41)
    np.testing.assert_allclose(targets[19], path.x[-1])
    np.testing.assert_allclose(targets[:20], targets[20:40])


def test_an_error_of_the_drawing_is_raised_where_one_waits(shown):
    def fail(robot):
        raise RuntimeError("no picture")

    shown._body.move = fail
    shown.follow(shown.robot.x + np.array([0.02, 0.0, 0.0]))
    with pytest.raises(RuntimeError, match="no picture"):
        shown.wait()
    assert "no picture" in shown._words.content


def test_messages_of_what_cannot_be_shown(fitted, monkeypatch):
    data_only = ELMRegressor(20).fit(fitted[1].q, fitted[1].x)
    with pytest.raises(TypeError, match="mechanical part"):
        hybridkin.app.view(data_only)
    with pytest.raises(ValueError, match="q_min"):
        hybridkin.app.view(robots.bionic_handling_assistant())
    real = builtins.__import__

    def without(name, *rest):
        if name == "viser":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"hybridkin\[view\]"):
        hybridkin.app.view(fitted[0])


def test_the_command_ends_at_ctrl_c(fitted, tmp_path, capsys, monkeypatch):
    hybridkin.save_model(fitted[0], tmp_path / "model.safetensors")
    opened = []
    monkeypatch.delenv("SSH_CONNECTION", raising=False)
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr(
        hybridkin.app.viewer.LiveView, "wait", lambda view: (_ for _ in ()).throw(KeyboardInterrupt)
    )
    assert main(["view", str(tmp_path / "model.safetensors"), "--port", "9320"]) == 0
    out, err = capsys.readouterr()
    assert "closed" in out
    assert opened
    assert opened[0] in err
    assert opened[0].startswith("http://127.0.0.1:93")


def test_obstacles_are_drawn_moved_and_named():
    scene = [obstacles.Sphere([0.5, 0.0, 0.5], 0.05, name="lamp <img src=x>\n"), PLATE]
    chain = robots.bionic_handling_assistant()
    with hybridkin.app.view(chain, q_min=0.1, q_max=0.4, obstacles=scene, port=9350) as shown:
        until(lambda: "nearest obstacle" in shown._words.content)
        nodes = shown._server.scene._handle_from_node_name
        assert {"/obstacle 1", "/obstacle 1/surface", "/obstacle 2"} <= {*nodes}
        vertices = nodes["/obstacle 1/surface"].vertices
        np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.05, rtol=1e-5)
        assert not shown._switched["body that keeps clear"].visible
        shown._switched["body that keeps clear"].visible = True
        shown.move_obstacle(0, np.array([0.25, 0.0, 0.5]))
        assert nodes["/obstacle 1"].position == pytest.approx([0.25, 0.0, 0.5])
        until(lambda: "lamp `<img` `src=x>" in shown._words.content)
        until(lambda: shown.robot.distances[0] > -1e-6)
        points, radii = shown.robot.balls
        until(lambda: nodes[f"/balls/{len(radii)}"].position == pytest.approx(points[-1], abs=0.01))
        assert nodes["/balls/1"].radius == pytest.approx(radii[0])
