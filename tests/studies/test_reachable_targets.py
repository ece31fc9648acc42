import pytest
import torch
from reachable_targets import KINDS, ROBOTS, STARTS, draw, main, reachable_report, study


@pytest.fixture(scope="module")
def entries():
    names = ("tendons, 2 segments", "elastic tendons, 2 segments", "hybrid, parallel ELM")
    return study({name: ROBOTS[name] for name in names}, 300)


@pytest.mark.slow
def test_reachable_targets_are_reached_within_the_limits(entries):
    full = [entry for entry in entries if entry["restarts"] == "default"]
    assert sum(entry["n"] for entry in full) == 300
    assert sum(entry["CONVERGED"] for entry in full) >= 0.999 * 300
    assert sum(entry["false"] + entry["violated"] for entry in entries) == 0
    once = [entry for entry in entries if entry["restarts"] == "0"]
    assert sum(entry["CONVERGED"] for entry in once) < 0.9 * 300


@pytest.mark.slow
def test_report_counts_every_target_once(entries, tmp_path):
    paths = reachable_report(entries).write(tmp_path / "study")
    assert {path.name for path in paths} == {"report.md", "report.json"}
    text = (tmp_path / "study" / "report.md").read_text()
    assert text.count("| all | 300 |") == 3
    for name in (*KINDS, *STARTS):
        assert f"| {name} | {300 // len(KINDS if name in KINDS else STARTS)} |" in text


def test_draws_lie_where_their_names_say(rng):
    robot = ROBOTS["tendons, 2 segments"]()
    low, high = robot.q_min, robot.q_max
    held = {}
    for kind in KINDS:
        q = draw(robot, kind, 200, rng)
        assert ((q >= low) & (q <= high)).all()
        held[kind] = ((q == low) | (q == high)).sum(1)
    assert (held["inside"] == 0).all()
    assert (held["edge"] == 5).all()
    assert (held["corner"] == 6).all()
    assert 1.0 < held["face"].double().mean() < 3.0
    q = draw(robot, "straight", 200, rng).unflatten(1, (2, 3))
    assert (q.amax(2) - q.amin(2)).max() <= 1e-3 * 0.04
    hybrid = ROBOTS["hybrid, parallel ELM"]()
    q = draw(hybrid, "corner", 50, rng)
    assert hybrid.model.in_domain(q).all()
    assert torch.unique(q, dim=0).shape == q.shape


@pytest.mark.slow
def test_runs_from_the_command_line(tmp_path, capsys):
    out = tmp_path / "results"
    main(["--out", str(out), "--robots", "trunk, 2 segments", "--targets", "20", "--seed", "1"])
    assert (out / "report.md").is_file()
    assert "1/1 trunk, 2 segments" in capsys.readouterr().err
