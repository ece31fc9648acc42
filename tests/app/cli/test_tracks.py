"""`next`, `track`, `animate` and `export`: from a model to commands."""

import json
import re

import numpy as np
import pytest
import torch
from simulated_log import COLUMNS, ROBOT, document, rows, run, write

import hybridkin
from hybridkin import Hysteresis, datasets, load_model, robots, save_model, trajectories
from hybridkin.app import workflow

SHAPE = ["--shape", "figure-eight", "--unit", "mm", "--dt", "0.1"]
CHAIN = hybridkin.ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1])


def planned(folder):
    """Return the configurations of next.csv (N, 6) [mm, pulled positive], and the errors [mm]."""
    table = np.genfromtxt(folder / "next.csv", delimiter=",", names=True)
    assert table.dtype.names == (*COLUMNS, "expected_error")
    table = np.array([*map(tuple, table)])
    return table[:, :6], table[:, 6]


def commands(folder):
    return np.loadtxt(folder / "track.csv", delimiter=",", skiprows=1, usecols=range(1, 7))


def test_next_keeps_to_the_limits_with_balanced_tendons(robot, tmp_path, capsys):
    code, out, errors = run(capsys, "next", robot, "-n", 12, "--out", tmp_path / "plan")
    assert code == 0
    assert "warning" not in errors  # nobody chose a model that learns nothing
    q, error = planned(tmp_path / "plan")
    assert len(q) == 12
    assert 4.0 < np.abs(q).max() <= 6.0
    segments = q.reshape(-1, 2, 3)
    balanced = np.abs(segments.sum(axis=2)) < 1e-6
    # Others are pulled until the slackest tendon is at its limit.
    np.testing.assert_allclose(segments.min(axis=2)[~balanced], -6.0, atol=1e-6)
    assert balanced.any()
    assert (np.diff(error) < 0.0).all()
    assert f"{error[-1]:.2f}" in out
    options = ["--q-min", 0, "--q-max", 4, "-n", 3, "--out", tmp_path / "pull"]
    assert run(capsys, "next", robot, *options)[0] == 0
    q, _ = planned(tmp_path / "pull")
    assert (q.min(), q.max() <= 4.0) == (0.0, True)
    np.testing.assert_allclose(q.reshape(-1, 2, 3).min(axis=2), 0.0, atol=1e-6)  # one is slack


@pytest.mark.slow
def test_next_counts_what_is_measured_and_where_the_error_matters(robot, log, tmp_path, capsys):
    plan = ["next", robot, "-n", 3, "--out", tmp_path / "plan"]
    code, fresh = document(capsys, *plan)
    assert (code, fresh["n_measured"], fresh["limits"]["source"]) == (0, 0, "robot description")
    _, record = document(capsys, *plan, "--measured", log)
    assert record["n_measured"] == 120
    assert record["expected_errors"][0] < 0.5 * fresh["expected_errors"][0]
    (tmp_path / "path.csv").write_text("x,y,z\n0,0,190\n10,0,190\n20,0,189\n")
    path = ["--path", tmp_path / "path.csv", "--dt", 1, "--unit", "mm"]
    _, record = document(capsys, *plan, *path)
    assert record["where"].startswith("along the path")
    # A base that is not known to the end moves a path as it moves all tips.
    assert record["expected_errors"][-1] < fresh["expected_errors"][-1]


def small_log():
    """Rows bent by up to 6 deg, of a robot with a base of its own and a tool of 30 mm."""
    base = torch.eye(4, dtype=torch.float64)
    base[:3, 3] = torch.tensor([0.05, -0.1, 0.2])
    offsets = torch.tensor([0.0, 0.03], dtype=torch.float64)
    truth = hybridkin.ConstantCurvatureChain([0.0055, 0.0055], lengths=[0.1, 0.1])
    truth = truth.with_geometry(offsets=offsets, base=base)
    rng = np.random.default_rng(0)
    ring = 2.0 * np.pi / 3.0 * np.arange(3)
    bends = rng.uniform(-0.1, 0.1, (60, 2, 2))
    q = -0.0055 * (bends @ [np.cos(ring), np.sin(ring)]).reshape(60, 6)
    x = truth(torch.from_numpy(q)).numpy() + 3e-4 * rng.standard_normal((60, 3))
    return np.column_stack([np.arange(60), -1e3 * q, 1e3 * x, np.arange(60) // 6])


@pytest.mark.slow
def test_next_names_the_motion_that_shows_whether_the_tool_is_wrong(robot, tmp_path, capsys):
    """Only where the description leaves open what is calibrated, and rows are measured."""
    log = write(tmp_path / "log.csv", small_log())
    plan = ["next", robot, "-n", 3, "--out", tmp_path / "plan"]
    assert document(capsys, *plan, "--measured", log)[1]["separating"] == []
    robot.write_text(ROBOT.replace('calibrate = ["radii", "base"]', ""))
    assert document(capsys, *plan)[1]["separating"] == []
    assert not (tmp_path / "plan" / "separating.csv").exists()
    code, out, _ = run(capsys, *plan, "--measured", log)
    assert code == 0
    record = json.loads((tmp_path / "plan" / "report.json").read_text())
    table = np.genfromtxt(tmp_path / "plan" / "separating.csv", delimiter=",", names=True)
    assert table.dtype.names == ("motion", *COLUMNS)
    table = np.array([*map(tuple, table)])
    kept = [entry for entry in record["separating"] if entry["remaining"] > entry["noise"]]
    motions = {motion["motion"]: motion for motion in kept}
    assert len(np.unique(table[:, 0])) == len(motions) <= len(record["separating"])
    for k, motion in enumerate(motions.values()):
        assert motion["motion"].split(",")[0] in " ".join(out.split())
        sent = table[table[:, 0] == k + 1, 1:]
        np.testing.assert_allclose(sent, -1e3 * np.array(motion["q"]), atol=1e-5)
        assert np.abs(sent).max() <= 6.0 + 1e-9
    (tool,) = [entry for entry in record["separating"] if "tool" in entry["rival"]]
    assert tool["remaining"] > 5.0 * tool["noise"]
    for entry in record["separating"]:
        assert entry["rival"] in " ".join(out.split())
    robot.write_text(ROBOT)
    assert document(capsys, *plan, "--measured", log)[1]["separating"] == []
    assert not (tmp_path / "plan" / "separating.csv").exists()


@pytest.mark.slow
def test_next_writes_no_motion_where_none_separates(robot, tmp_path, capsys):
    """Limits of 0.02 mm move the tips by less than the noise."""
    log = write(tmp_path / "log.csv", small_log())
    narrow = ROBOT.replace('calibrate = ["radii", "base"]', "")
    robot.write_text(narrow.replace("0.006\n", "0.00002\n"))
    plan = ["next", robot, "-n", 3, "--out", tmp_path / "plan", "--measured", log]
    code, out, err = run(capsys, *plan)
    assert (code, err.count("error")) == (0, 0)
    words = " ".join(out.split())
    assert "No motion shows which one is right; use any." in words
    assert "no motion within the limits separates" in words
    assert not (tmp_path / "plan" / "separating.csv").exists()
    assert (tmp_path / "plan" / "next.csv").exists()


class Enough(ValueError):
    """A command has got so far."""


@pytest.mark.parametrize(("unit", "metre"), [("mm", 1e-3), ("cm", 1e-2), ("m", 1.0), (None, 1e-3)])
@pytest.mark.parametrize("source", ["shape", "file"])
def test_options_of_a_track_arrive_in_metres(
    robot, tmp_path, capsys, monkeypatch, unit, metre, source
):
    """Lengths by --unit (that of x in the log), the tolerance by mm, actuators by the log."""
    seen = {}

    def shape_path(loaded, limits, shape, size, **options):
        seen.update(options, shape=shape, size=size)
        return trajectories.line([0.0, 0.0, 0.1], [0.0, 0.0, 0.2], duration=1.0, dt=0.1)

    def track_path(loaded, path, out, **options):
        seen.update(options, path=path)
        raise Enough("enough")

    monkeypatch.setattr(workflow, "shape_path", shape_path, raising=False)
    monkeypatch.setattr(workflow, "track_path", track_path, raising=False)
    options = ["--tol", 0.2, "--scale", 0.5, "--from=1,-2,1,0.5,0,-0.5", "--q-min=-3"]
    options += ["--q-max", "5,4,5,4,5,4", "--dq-max", 4, "--ddq-max", 50]
    options += [] if unit is None else ["--unit", unit]
    path = ["--shape", "spiral", "--size", "2,4", "--rise=5", "--center=1,-2,3", "--duration", 7]
    if source == "file":
        (tmp_path / "path.csv").write_text("x,y,z\n0,0,0.1\n0,0,0.3\n")
        path = [tmp_path / "path.csv"]
    assert (
        run(capsys, "track", robot, *path, "--dt", 0.5, *options, "--out", tmp_path / "t")[0] == 2
    )
    if source == "shape":
        np.testing.assert_allclose(seen["size"], [2.0 * metre, 4.0 * metre])
        np.testing.assert_allclose(seen["center"], metre * np.array([1.0, -2.0, 3.0]))
        assert seen["rise"] == pytest.approx(5.0 * metre)
        assert (seen["duration"], seen["dt"]) == (7.0, 0.5)
        np.testing.assert_allclose(seen["path"].x[[0, -1], 2], [0.125, 0.175])
    else:
        np.testing.assert_allclose(seen["path"].x[:, 2], metre * np.array([0.15, 0.25]))
        np.testing.assert_allclose(seen["path"].t, [0.0, 0.5])
    assert seen["tol"] == pytest.approx(2e-4)
    np.testing.assert_allclose(seen["start"], 1e-3 * np.array([-1, 2, -1, -0.5, 0, 0.5]))
    limits = seen["limits"]  # of the chain, which counts what the log counts backwards
    np.testing.assert_allclose(limits.q_min, -1e-3 * np.array([5, 4, 5, 4, 5, 4]))
    np.testing.assert_allclose(limits.q_max, np.full(6, 3e-3))
    np.testing.assert_allclose(limits.dq_max, np.full(6, 4e-3))
    np.testing.assert_allclose(limits.ddq_max, np.full(6, 5e-2))


MIXED = (
    ROBOT.replace("q_sign = -1", "q_sign = [1, -1, 1, -1, 1, -1]")
    .replace('q_unit = "mm"', 'q_unit = "deg"')
    .replace("radius = 0.0055", "radius = 0.0055\nspool_radius = 0.006")
    .replace("q_min = -0.006", 'unit = "log"\nq_min = -60\ndq_max = [9, 8, 7, 6, 5, 4]')
    .replace("q_max = 0.006", "q_max = 40")
)


def test_limits_in_the_unit_and_signs_of_the_log_come_back_as_they_were(robot, capsys):
    robot.write_text(MIXED)
    limits = robots.read_description(robot).limits
    turn = np.radians(np.array([1, -1, 1, -1, 1, -1]))
    np.testing.assert_allclose(limits.q_min, np.minimum(-60 * turn, 40 * turn))
    np.testing.assert_allclose(limits.q_max, np.maximum(-60 * turn, 40 * turn))
    np.testing.assert_allclose(limits.dq_max, np.radians([9, 8, 7, 6, 5, 4]))
    text = " ".join(run(capsys, "describe", robot)[1].split())
    assert "Limits: q_min = -60, -60, -60, -60, -60, -60 deg." in text
    assert "Limits: q_max = 40, 40, 40, 40, 40, 40 deg." in text
    assert "Limits: dq_max = 9, 8, 7, 6, 5, 4 deg/s." in text


@pytest.mark.slow
@pytest.mark.parametrize(("x_unit", "metre"), [("mm", 1e-3), ("m", 1.0)])
def test_next_writes_degrees_and_errors_in_the_units_of_the_log(
    robot, tmp_path, capsys, x_unit, metre
):
    robot.write_text(MIXED.replace('x_unit = "mm"', f'x_unit = "{x_unit}"'))
    code, record = document(capsys, "next", robot, "-n", 5, "--out", tmp_path / "plan")
    assert code == 0
    q, error = planned(tmp_path / "plan")
    np.testing.assert_allclose(metre * error, record["expected_errors"], rtol=1e-6)
    assert ((q >= -60.0) & (q <= 40.0)).all()
    metres = 0.006 * np.radians(q) * [1, -1, 1, -1, 1, -1]
    high = 0.006 * np.radians([40, 60, 40, 60, 40, 60])
    common = metres.reshape(-1, 2, 3).sum(axis=2)
    slack = (high - metres).reshape(-1, 2, 3).min(axis=2)
    np.testing.assert_allclose(np.minimum(np.abs(common), slack), 0.0, atol=1e-9)


@pytest.mark.slow
def test_track_of_a_shape_can_be_sent_and_read_back(fitted, tmp_path, capsys):
    out = tmp_path / "track"
    shape = ["--shape", "figure-eight", "--size", "20,10", "--duration", "2", "--dt", "0.05"]
    code, record = document(capsys, "track", fitted / "model", *shape, "--out", out)
    assert code == 0
    assert record["reached"] == record["n"] == 41
    assert record["limits"]["source"] == "robot description, within the training range"
    assert (record["in_domain"], record["hysteresis"]) == (1.0, None)
    # What the file says, in the robot's units and sign, leads the model where it says.
    target = ["target_x", "target_y", "target_z"]
    units = {"q_unit": "mm", "x_unit": "mm", "q_sign": -1}
    data = datasets.load_log(out / "track.csv", COLUMNS, target, "status", time="t", **units)
    model = load_model(fitted / "model" / "model.safetensors")
    assert np.linalg.norm(model.predict(data.q) - data.x, axis=1).max() < 1e-4
    assert np.abs(data.q).max() <= 0.006
    n_lead = record["lead_in"]
    assert data.groups.tolist() == n_lead * ["LEAD_IN"] + 41 * ["CONVERGED"]
    np.testing.assert_allclose(data.time, 0.05 * np.arange(n_lead + 41), atol=1e-9)
    np.testing.assert_allclose(np.ptp(data.x[n_lead:], axis=0)[:2], [0.02, 0.01], rtol=0.02)
    # The robot starts at rest, and the lead-in keeps to a tenth of the range per second.
    assert not data.q[0].any()
    low, high = (np.array(record["limits"][name]) for name in ("q_min", "q_max"))
    speed = np.abs(np.diff(data.q[: n_lead + 1], axis=0)).max() / 0.05
    assert 0.08 * (high - low).max() < speed <= 0.1 * (high - low).max() + 1e-9
    assert (out / "track.png").stat().st_size > 500
    for film in (tmp_path / "film.gif", tmp_path / "film.html"):
        options = ["--out", film, "--frames", "3"]
        code, record = document(capsys, "animate", fitted / "model", out, *options)
        assert (code, record["frames"], record["written"]) == (0, 3, [str(film)])
        assert record["bytes"] == film.stat().st_size > 10_000


@pytest.mark.slow
def test_track_says_how_much_of_a_path_is_within_reach(robot, tmp_path, capsys):
    arguments = ["track", robot, *SHAPE, "--out", tmp_path / "track"]
    arguments += ["--center", "0,0,190"]  # else it is placed where it fits
    code, _, errors = run(capsys, *arguments, "--size", "800,400")
    assert code == 2
    assert (
        "`path` (of the file or --shape) leaves the reach of the robot within its limits (robot "
        "description)" in errors
    )
    scale = float(re.search(r"--scale ([\d.]+\d)", errors)[1])
    assert document(capsys, *arguments, "--size", "800,400", "--scale", scale)[0] == 0
    _, _, errors = run(capsys, *arguments, "--size", f"{960 * scale},{480 * scale}")
    assert float(re.search(r"--scale ([\d.]+\d)", errors)[1]) == pytest.approx(1 / 1.2, rel=0.1)
    _, _, errors = run(capsys, *arguments, "--size", "8,4", "--center", "0,0,500")
    assert "its centre is out of reach too" in errors


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_track_names_the_unit_of_a_path_a_thousand_times_too_large(robot, tmp_path, capsys, force):
    (tmp_path / "path.csv").write_text("t,x,y,z\n0,0,0,190\n1,5,0,190\n2,0,0,190\n")
    arguments = ["track", robot, tmp_path / "path.csv", "--out", tmp_path / "t"]
    code, _, errors = run(capsys, *arguments, "--unit", "m", *force)
    assert code == 2
    assert errors.endswith("give --unit mm.\n")


@pytest.mark.slow
def test_track_leads_in_from_where_the_robot_stands(robot, tmp_path, capsys):
    out = tmp_path / "track"
    arguments = ["track", robot, *SHAPE, "--size", "20,10", "--out", out]
    arguments += ["--duration", "2", "--dq-max", "4"]  # mm/s
    first, on_path = {}, {}
    for start in ("1,-2,1,0.5,0,-0.5", "rest", "path"):
        code, record = document(capsys, *arguments, f"--from={start}")
        assert code == 0
        q = commands(out)
        assert np.abs(np.diff(q, axis=0)).max() <= 0.4 + 1e-8
        n_lead = record["lead_in"]
        assert len(q) == n_lead + 21
        first[start], on_path[start] = q[0], q[n_lead:]
    assert first["1,-2,1,0.5,0,-0.5"].tolist() == [1, -2, 1, 0.5, 0, -0.5]
    assert not first["rest"].any()
    assert n_lead == 0
    for q in on_path.values():
        np.testing.assert_array_equal(q, on_path["path"])
    for start in ("1000,0,0,0,0,0", "1,2"):
        assert run(capsys, *arguments, f"--from={start}")[0] == 2


@pytest.fixture(scope="module")
def playful(tmp_path_factory):
    """A folder with a model whose actuators have play, its robot and a log of it."""
    home = tmp_path_factory.mktemp("playful")
    table = rows()
    q = Hysteresis.backlash(4e-4).apply_by_group(-1e-3 * table[:, 1:7], table[:, 10])
    with torch.no_grad():
        table[:, 7:10] = 1e3 * (CHAIN(torch.from_numpy(q)).numpy() + 5e-4 * np.sin(200 * q[:, :3]))
    write(home / "log.csv", table)
    (home / "robot.toml").write_text(ROBOT)
    model = hybridkin.HybridForwardModel(CHAIN, "quadratic", hysteresis=4e-4)
    model.fit(-1e-3 * table[:, 1:7], 1e-3 * table[:, 7:10], groups=table[:, 10])
    save_model(model, home / "model.safetensors")
    return home


def test_evaluate_knows_where_the_motions_of_play_begin(playful, tmp_path, capsys):
    code, record = document(capsys, "evaluate", playful, playful / "log.csv")
    assert code == 0
    assert record["all"]["mean"] < 1e-4
    table = rows()
    table[:15] = table[14::-1]  # the first motion backwards, its times too
    log = write(tmp_path / "backwards.csv", table)
    code, _, errors = run(capsys, "evaluate", playful, log)
    assert code == 2
    assert "order of time, but 14 rows" in errors


def test_a_column_of_runs_lets_backlash_go_on_from_motion_to_motion(playful, tmp_path, capsys):
    lines = (playful / "log.csv").read_text().splitlines()
    parts = [f"{lines[0]},part"]
    parts += [f"{line},{k // 5}" for k, line in enumerate(lines[1:])]
    log = tmp_path / "parts.csv"
    log.write_text("\n".join(parts))
    by_part = ["evaluate", playful, log, "--groups", "part"]
    assert document(capsys, *by_part)[1]["all"]["mean"] > 1e-4
    record = document(capsys, *by_part, "--runs", "motion")[1]
    assert record["all"]["mean"] < 1e-4
    assert len(record["motions"]) == len(lines) // 5


@pytest.mark.slow
def test_code_and_trackers_tell_unit_sign_and_backlash_of_q(playful, tmp_path, capsys):
    out = tmp_path / "c"
    export = ["export", playful, "--out", out, "--name", "robot", "--dt", "0.01"]
    code, printed, _ = run(capsys, *export)
    assert code == 0
    for text in (printed, *((out / name).read_text() for name in ("README.md", "robot.h"))):
        text = " ".join(text.split())
        assert f"log in mm: q[0] = -0.001 * {COLUMNS[0]}, q[1] = -0.001 * {COLUMNS[1]}" in text
        assert "have backlash of 0.4 mm: x(q)" in " ".join(text.split())
    assert "what the actuators do" in (out / "robot.h").read_text()
    matlab = tmp_path / "matlab"
    assert run(capsys, "export", playful, "--mex", "--out", matlab, "--name", "robot")[0] == 0
    text = " ".join((matlab / "robot.m").read_text().replace("%", " ").split())
    assert f"q(1) = -0.001 * {COLUMNS[0]}, q(2) = -0.001 * {COLUMNS[1]}" in text
    model = load_model(playful / "model.safetensors")
    ik = hybridkin.InverseKinematics(model, q_min=-0.005, q_max=0.005)
    tracker = ik.tracker(np.zeros(6))
    assert tracker.backend == "compiled"
    tracker.step(tracker.x + np.array([0.002, 0.0, 0.0]))
    assert np.abs(tracker.q - tracker.effective).max() == pytest.approx(2e-4)


@pytest.mark.slow
def test_track_with_hysteresis_tells_what_to_send_and_what_it_does(playful, tmp_path, capsys):
    out = tmp_path / "track"
    shape = ["--shape", "figure-eight", "--size", "20,10", "--duration", "2", "--dt", "0.05"]
    code, record = document(capsys, "track", playful, *shape, "--out", out)
    assert (code, record["hysteresis"]) == (0, [0.4])
    table = np.genfromtxt(out / "track.csv", delimiter=",", names=True, dtype=None, encoding=None)
    sent = -1e-3 * np.column_stack([table[name] for name in COLUMNS])
    does = -1e-3 * np.column_stack([table[f"effective_{name}"] for name in COLUMNS])
    np.testing.assert_allclose(Hysteresis.backlash(4e-4).apply(sent)[0], does, atol=1e-10)
    assert np.abs(sent - does).max() == pytest.approx(2e-4)
    assert np.abs(sent).max() <= 0.006
    steps = np.abs(np.diff(sent, axis=0))
    slow = ["--dq-max", "6", "--out", tmp_path / "slow", "--force"]
    document(capsys, "track", playful, *shape, *slow)
    table_of = np.genfromtxt(tmp_path / "slow" / "track.csv", delimiter=",", names=True, dtype=None)
    slow_steps = np.diff(np.column_stack([table_of[name] for name in COLUMNS]), axis=0)
    assert np.abs(slow_steps).max() <= 6 * 0.05 * (1 + 1e-6) < 1e3 * steps.max()
    target = 1e-3 * np.column_stack([table["target_" + axis] for axis in "xyz"])
    model = load_model(playful / "model.safetensors")
    assert np.linalg.norm(model.predict(sent) - target, axis=1).max() < 1e-4
    assert "The actuators have backlash of 0.4 mm." in run(capsys, "describe", playful)[1]
