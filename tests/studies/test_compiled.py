import numpy as np
import pytest
from compiled import PARTS, agreement, main, solve, steps, ticks
from compiled_cases import CASES
from reachable_targets import ROBOTS

from hybridkin.native.library import Program

pytestmark = [pytest.mark.needs_core, pytest.mark.slow]
ROBOT = "tendons, 2 segments"


def test_the_core_is_torch_up_to_rounding():
    for name in ("trunk", "tendons, bends to 4 pi", "rigid arm", "ELM, leverage guard"):
        found = agreement(CASES[name](), 400, np.random.default_rng(0), n_single=50)
        assert found["decisions"] == found["nan"] == 0
        assert max(found[key] for key in found if key.startswith(("x", "J", "dist", "si"))) < 1e-12
    found = steps(ROBOTS[ROBOT](), 400, np.random.default_rng(0))
    assert found["move"] < 1e-9
    assert found["flags"] == found["outside"] == 0
    found = solve(ROBOTS[ROBOT](), 100, 10)
    assert (found["n"], found["differ"]) == (110, 0)


def test_a_core_that_errs_is_seen(monkeypatch):
    evaluate = Program.evaluate

    def wrong(self, q, *what):
        x, J, distance = evaluate(self, q, *what)
        return (x, J * (1.0 + 1e-9), distance + 1.5) if x.ndim > 1 else (x, J, distance)

    monkeypatch.setattr(Program, "evaluate", wrong)
    found = agreement(CASES["trunk"](), 100, np.random.default_rng(0), n_single=9)
    assert found["x"] < 1e-14
    assert found["J"] == pytest.approx(1e-9, rel=1e-3)
    assert found["decisions"] == 100
    assert found["single"] >= 1.5


def test_every_tick_is_timed():
    found = ticks(CASES["trunk"](), 400, np.random.default_rng(0))
    assert found.once.shape == found.least.shape == (400,)
    assert (found.least <= found.once).all()
    assert 0.1 < found.least.min() < 1e3  # [us], of the fastest tick: on a busy machine too
    assert found.slowest > 0.0


def test_runs_from_the_command_line(tmp_path, capsys):
    counts = {"rows": "100", "steps": "100", "targets": "20", "ticks": "100"}
    options = [text for name, n in counts.items() for text in (f"--{name}", n)]
    out, image = tmp_path / "out", tmp_path / "ticks.png"
    options += ["--cases", "trunk", "--robots", ROBOT, "--image", str(image)]
    main(["--out", str(out), *options])
    assert image.stat().st_size > 5000
    assert {path.name for path in out.iterdir()} == {"report.md", "report.json", "ticks.png"}
    said = capsys.readouterr().err
    assert all(f"{part} 1/1" in said for part in PARTS)
