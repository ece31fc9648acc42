"""The live view: what it draws and says, without a browser."""

import builtins
import time
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import hybridkin
from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressor,
    HybridForwardModel,
    datasets,
    obstacles,
    open_model,
    robots,
    trajectories,
)
from hybridkin.app.cli.main import main
from hybridkin.app.viewer.motions import Loop
from hybridkin.plots.page_server import Camera

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


def tendon_log():
    """Return a tendon chain, and a log whose measuring frame is turned and far from its base."""
    chain = ConstantCurvatureChain([0.008, 0.007], lengths=[0.08, 0.07], routing="base")
    q = np.random.default_rng(0).uniform(-0.004, 0.004, (80, 2, 3))
    q = (q - q.mean(axis=2, keepdims=True)).reshape(80, 6)
    base = np.eye(4)
    base[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    base[:3, 3] = [1.2, -0.4, 0.7]
    moved = chain.with_geometry(base=torch.from_numpy(base))
    with torch.no_grad():
        x = moved(torch.from_numpy(q)).numpy()
    return chain, base, datasets.Log(q, x)


ROBOT = """
calibrate = {calibrate}
[[segment]]
radius = 0.008
length = 0.08
[[segment]]
radius = 0.007
length = 0.07
"""


@pytest.mark.parametrize(("calibrate", "is_fitted"), [('["base"]', True), ('["radii"]', False)])
def test_a_base_that_is_not_known_is_fitted_before_it_is_drawn(tmp_path, calibrate, is_fitted):
    _, base, log = tendon_log()
    path = tmp_path / "robot.toml"
    path.write_text('routing = "base"' + ROBOT.format(calibrate=calibrate))
    with hybridkin.app.view(open_model(path), log, port=9360) as shown:
        assert shown.base_is_fitted == is_fitted
        expected = base if is_fitted else np.eye(4)
        np.testing.assert_allclose(shown.robot.base, expected, atol=1e-6)
        np.testing.assert_allclose(shown._body.points[0], expected[:3, 3], atol=1e-6)
        assert shown.robot.size < 0.5 or not is_fitted  # whatever the frame of the log is


def test_the_base_of_a_chain_is_known():
    chain, _, log = tendon_log()
    with hybridkin.app.view(chain, log, port=9361) as shown:
        np.testing.assert_array_equal(shown.robot.base, np.eye(4))


def test_tendons_that_pull_against_each_other_are_told_on_the_page_alone():
    chain, _, log = tendon_log()
    model = HybridForwardModel(chain, "quadratic", coupling="serial", calibrate=("base",))
    model.fit(log.q, log.x)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with hybridkin.app.view(model, log, q_min=-0.006, q_max=0.006, port=9362) as shown:
            assert "against each other" not in shown._words.content
            shown.go_to(np.array([0.005, 0.005, 0.005, 0.0, 0.0, 0.0]))
            until(lambda: "tendons pull against each other" in shown._words.content)
    assert caught == []


def test_a_log_of_another_robot_is_refused_in_words_of_the_user(fitted):
    model, log = fitted
    few = datasets.Log(log.q[:, :2], log.x)
    for shown in (model, robots.bionic_handling_assistant()):
        with pytest.raises(ValueError, match="`q` must name 9 columns, one for each actuator"):
            hybridkin.app.view(shown, few, port=9363)


@pytest.mark.parametrize("size", [0.005, 0.3, 20.0])
def test_the_first_look_has_every_point_whatever_the_size(size):
    lengths = 3 * [size / 3.0]
    chain = ConstantCurvatureChain(3 * [0.02 * size], lengths=lengths, routing="base")
    log = datasets.Log(
        np.random.default_rng(0).uniform(-0.01 * size, 0.01 * size, (50, 9)),
        size * np.random.default_rng(1).uniform(-1.0, 2.0, (50, 3)),
    )
    with hybridkin.app.view(chain, log, port=9364) as shown:
        eye = shown._server.initial_camera
        camera = Camera(eye.position, eye.look_at)
        on_page = camera.on_page(np.concatenate([log.x, shown._body.points]))
        assert np.abs(on_page).max() == pytest.approx(0.9)
        depths = (log.x - camera.position) @ camera.axes[2]
        assert eye.near < depths.min()
        assert depths.max() < eye.far


def test_a_slider_moves_one_actuator_and_reaches_its_limits(shown):
    shown.go_to(shown.robot.domain.preferred + 1.3e-4)
    until(lambda: shown.robot._resting)
    before = shown.robot.q.copy()
    slider = shown._sliders[2]
    slider.value = slider.max
    shown._slid(2, SimpleNamespace(client=object()))
    until(lambda: shown.robot._resting)
    moved = np.flatnonzero(shown.robot.q != before)
    np.testing.assert_array_equal(moved, [2])
    assert shown.robot.q[2] == shown.robot.limits.q_max[2]
