import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridkin import (
    ConstantCurvatureChain,
    HybridForwardModel,
    Hysteresis,
    datasets,
    open_model,
    robots,
    save_model,
    trajectories,
)
from hybridkin.app import workflow
from hybridkin.app.cli.main import main
from hybridkin.app.workflow.choices import choices_by_fold
from hybridkin.app.workflow.compare import (
    compare,
    mechanical_of,
    with_hysteresis_detected,
)
from hybridkin.app.workflow.domain import Domain
from hybridkin.app.workflow.log import checked
from hybridkin.app.workflow.model import domain_distance, fitted_rows, has_body, held_out_errors

ROBOT = """
calibrate = ["radii", "base"]
[[segment]]
radius = 0.11
repeat = 2
[log]
q = ["l1", "l2", "l3", "l4", "l5", "l6"]
x = ["x", "y", "z"]
q_unit = "mm"
x_unit = "mm"
"""


@pytest.fixture
def log(tmp_path):
    """A simulated log of 6 motions in millimetres, and its robot description."""
    rng = np.random.default_rng(0)
    q = 0.25 + 0.05 * rng.uniform(-1, 1, (180, 6))
    robot = tmp_path / "robot.toml"
    robot.write_text(ROBOT)
    with torch.no_grad():
        x = robots.read_description(robot).chain(torch.from_numpy(q)).numpy()
    x += 0.02 * np.sin(30 * q[:, :3]) + 0.001 * rng.standard_normal(x.shape)
    rows = np.column_stack([1000 * q, 1000 * x, np.repeat(np.arange(6), 30)])
    path = tmp_path / "log.csv"
    header = "l1,l2,l3,l4,l5,l6,x,y,z,motion"
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.6f")
    return path, robot


@pytest.fixture(scope="module")
def playful():
    """A robot whose tendons have 0.4 mm of backlash, and a log of it."""
    rng = np.random.default_rng(0)
    chain = ConstantCurvatureChain([0.005], lengths=[0.1])
    groups = np.repeat(np.arange(8), 20)
    swing = np.sin(np.linspace(0, 6, 20)) * rng.uniform(1, 8, 8)[:, None]
    q = 0.0005 * np.stack([np.cos(groups - a) * swing.ravel() for a in (0, 2.0944, 4.1888)], axis=1)
    with torch.no_grad():
        x = chain(torch.from_numpy(Hysteresis.backlash(4e-4).apply_by_group(q, groups))).numpy()
    robot = robots.RobotDescription("playful", chain, ("radii",), None)
    return robot, datasets.Log(q, x, groups, time=np.tile(np.arange(20.0), 8))


@pytest.mark.slow
def test_play_lowers_the_errors_of_auto_on_held_out_motions(playful):
    robot, log = playful
    settings = workflow.FitSettings(n_folds=2, hysteresis=4e-4)
    log = checked(log, robot.chain, base_is_free=True)
    mechanical = mechanical_of(robot, log, settings.loss)
    compared = compare(log, robot, settings, mechanical, n_jobs=1)
    errors, choices = compared.errors, choices_by_fold(compared, log.q_unit)
    assert errors["hybrid, auto"].mean < 0.1 * errors["mechanical, calibrated"].mean
    assert all(choice["hybrid, auto"].endswith("backlash of 0.4 mm") for choice in choices)


@pytest.mark.slow
def test_play_is_tried_by_itself_where_the_order_of_the_rows_matters(playful):
    robot, log = playful

    def detected(log, **settings):
        rows = checked(log, robot.chain, base_is_free=False)
        mechanical = mechanical_of(robot, rows, "linear")
        return with_hysteresis_detected(
            workflow.FitSettings(**settings), rows, robot, mechanical
        ).hysteresis

    assert detected(log) == "auto"
    assert detected(log, hysteresis=0.0) == 0.0
    assert detected(log, auto=False) == 0.0
    assert detected(replace(log, groups=None)) == 0.0
    assert detected(replace(log, time=-log.time)) == 0.0
    with torch.no_grad():
        x = robot.chain(torch.from_numpy(log.q)).numpy()
    assert detected(replace(log, x=x)) == 0.0


@pytest.mark.slow
def test_a_fit_to_a_thinned_log_knows_all_of_its_rows(log, tmp_path):
    path, robot = log
    description = robots.read_description(robot)
    measured = workflow.read_log(path, description.log, chain=description.chain)
    settings = workflow.FitSettings(n_folds=2, auto=False, max_rows=60)
    record = workflow.fit_log(measured, description, tmp_path / "m", settings, n_jobs=1).record
    loaded = open_model(tmp_path / "m")
    assert fitted_rows(loaded, measured.q, measured.x, measured.motions).all()
    assert not fitted_rows(loaded, measured.q, measured.x + 1e-5, measured.motions).any()
    assert held_out_errors(loaded).mean == record.held_out[record.saved].mean > 0.0
    again = loaded.fit(measured.q, measured.x)  # a new model, of which no file tells
    assert not again.description_.created
    assert not again.description_.training
    with pytest.raises(FileNotFoundError, match="`model` must be a saved model, the folder of a"):
        open_model(tmp_path / "nothing")
    nominal = open_model(robot)
    assert not fitted_rows(nominal, measured.q, measured.x, measured.motions).any()
    report = workflow.evaluate_log(nominal, measured)
    assert report.record.fitted_rows == 0


def test_given_limits_replace_those_of_the_description():
    chain = ConstantCurvatureChain([0.005], lengths=[0.1])
    limits = robots.Limits(np.full(3, -0.01), np.full(3, 0.01), np.full(3, 0.02))
    robot = robots.RobotDescription("robot", chain, (), None, limits)
    nominal = open_model(chain)
    loaded = nominal.described(replace(nominal.description_, robot=robot))
    found = workflow.path_limits(loaded, q_max=0.002, ddq_max=0.5)
    assert found.q_min.tolist() == [-0.01] * 3
    assert found.q_max.tolist() == [0.002] * 3
    assert found.dq_max.tolist() == [0.02] * 3
    assert found.ddq_max.tolist() == [0.5] * 3
    assert np.isinf(workflow.path_limits(loaded).ddq_max).all()
    assert found.source == "given and robot description"
    with pytest.raises(ValueError, match="`q_min` must not exceed `q_max`"):
        workflow.path_limits(loaded, q_min=0.02)
    with pytest.raises(ValueError, match="--q-min"):
        workflow.path_limits(open_model(chain))


MOTORS = """
[[segment]]
radius = 0.005
length = 0.1
spool_radius = [0.006, 0.006, 0.012]
[log]
q = ["a", "b", "c"]
x = ["x", "y", "z"]
q_unit = "deg"
q_sign = -1
[limits]
unit = "log"
q_min = -60
q_max = 60
dq_max = 90
ddq_max = 360
"""


@pytest.mark.slow
def test_motor_angles_from_the_log_to_the_commands(tmp_path, capsys):
    robot = tmp_path / "motors.toml"
    robot.write_text(MOTORS)
    loaded = open_model(robot)
    turn = np.radians([1.0, 1.0, 1.0])
    np.testing.assert_allclose(workflow.path_limits(loaded).q_min, -60 * turn)
    assert main(["describe", str(robot)]) == 0
    printed = capsys.readouterr().out
    assert "Limits: q_min = -60, -60, -60 deg." in printed
    assert "Limits: dq_max = 90, 90, 90 deg/s." in printed
    assert "Limits: ddq_max = 360, 360, 360 deg/s^2." in printed
    points, out = tmp_path / "points.csv", tmp_path / "track"
    angles = np.array([[0.0, 10.0, -5.0], [0.0, 9.0, -5.0]])
    np.savetxt(points, loaded.predict(-turn * angles), delimiter=",")
    options = ["--unit", "m", "--dt", "1", "--q-min=-10", "--q-max", "20,20,30", "--json"]
    assert main(["track", str(robot), str(points), "--out", str(out), *options]) == 0
    limits = json.loads(capsys.readouterr().out)["limits"]
    np.testing.assert_allclose(limits["q_min"], [-20, -20, -30] * turn)
    np.testing.assert_allclose(limits["q_max"], 10 * turn)
    log = workflow.read_log(out / "track.csv", replace(loaded.description_.log, x_unit="m"))
    angles = datasets.load_log(out / "track.csv", ["a", "b", "c"], ["x", "y", "z"], q_unit="1").q
    np.testing.assert_allclose(log.q, -turn * angles, rtol=1e-12)
    assert (np.abs(angles - [5, 5, 10]) <= [15.001, 15.001, 20.001]).all()
    np.testing.assert_allclose(loaded.predict(log.q), log.x, atol=1e-8)


DATA_ROBOT = """
name = "pneumatic arm"
[log]
q = ["l1", "l2", "l3", "l4", "l5", "l6"]
x = ["x", "y", "z"]
q_unit = "1"
x_unit = "mm"
groups = "motion"
"""


@pytest.mark.slow
def test_a_robot_without_segments_from_the_log_to_the_commands(log, tmp_path):
    path, _ = log
    robot, model = tmp_path / "data.toml", tmp_path / "m"
    robot.write_text(DATA_ROBOT)
    with pytest.raises(ValueError, match="has no model before a fit: hybridkin fit LOG"):
        open_model(robot)
    description = robots.read_description(robot)
    measured = workflow.read_log(path, description.log, chain=description.chain)
    with pytest.raises(ValueError, match="`hysteresis` requires a robot with segments"):
        workflow.fit_log(measured, description, model, workflow.FitSettings(hysteresis="auto"))
    settings = workflow.FitSettings(n_folds=2, auto=False)
    report = workflow.fit_log(measured, description, model, settings, n_jobs=1)
    errors = report.record.held_out
    saved = report.record.saved
    assert saved in ("hybrid, quadratic", "hybrid, ELM")
    assert errors[saved].mean < errors["data-driven, linear"].mean
    loaded = open_model(model)
    assert loaded.description_.name == "pneumatic arm"
    assert not has_body(loaded)
    np.testing.assert_allclose(measured.q[0], 1e3 * np.array([0.25] * 6), rtol=0.3)  # as they are
    evaluated = workflow.evaluate_log(loaded, measured)
    assert evaluated.record.all.mean < 0.005
    assert loaded.in_domain(measured.q).mean() > 0.9
    assert not loaded.in_domain(measured.q + 300).any()
    text = workflow.describe(loaded).plain()
    assert re.search("mechanical model: +AffineModule", text)
    fitted_for = text[text.index("Training range") : text.index("Logs:")]
    assert re.search(r"q_min = 2\d\d(\.\d)?(, 2\d\d(\.\d)?){5}\.\n", fitted_for)
    x = loaded.predict(measured.q[:1])[0]
    way = trajectories.line(x, (x[0] + 0.005, x[1], x[2]), duration=1.0, dt=0.5)
    tracked = workflow.track_path(loaded, way, tmp_path / "t", tol=1e-3)
    assert tracked.record.reached == 3


def test_a_log_that_does_not_pass_its_check_stops_the_fit(log, tmp_path):
    path, robot = log
    description = robots.read_description(robot)
    measured = workflow.read_log(path, description.log)
    x = measured.x.copy()
    x[20:60] = x[20]
    spoilt = datasets.Log(measured.q, x, np.repeat(np.arange(6), 30))
    with pytest.raises(workflow.LogError, match="did not pass its check") as caught:
        workflow.fit_log(spoilt, description, tmp_path / "m")
    assert [f.kind for f in caught.value.report.errors] == ["frozen tip"]
    settings = workflow.FitSettings(auto=False, hysteresis="auto")
    with pytest.raises(ValueError, match="`hysteresis` requires"):
        workflow.fit_log(measured, description, tmp_path / "m", settings)
    assert not (tmp_path / "m").exists()


def test_the_range_and_the_preferred_configuration_move_with_the_zeros(tmp_path):
    data = datasets.load_trunk()
    q, x = data.q[:200], data.x[:200]
    chain = robots.bionic_handling_assistant()
    model = HybridForwardModel(chain, "linear", coupling="serial")
    model.fit(q, x, groups=np.arange(200) // 20)
    found = []
    for _ in range(2):
        save_model(model, tmp_path / "model")
        loaded = open_model(tmp_path / "model")
        limits = workflow.path_limits(loaded)
        found.append((Domain(loaded, limits).preferred, limits.q_min))
        model.adapt(q - 0.01 * np.linspace(-1, 1, 9), model.predict(q))
    assert np.abs(loaded.change_.shift).max() > 0.005
    for before, after in zip(*found, strict=True):
        np.testing.assert_allclose(before - after, loaded.change_.shift, atol=1e-12)
    assert domain_distance(loaded, found[1][0][None])[0] <= 1.0
