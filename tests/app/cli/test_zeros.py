"""`init` proposes the zeros of tendons whose counts do not start at 0."""

import numpy as np
import pytest

from hybridkin import ConstantCurvatureChain, robots
from hybridkin.app.cli.main import main
from hybridkin.native import evaluate

CHAIN = ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1], routing="base")
PER_METRE = 40_000.0
ZEROS = np.array([2051, 1987, 2030, 2012, 1968, 2044])
COLUMNS = [f"m{i + 1}" for i in range(6)]


def written(path, zeros, starts_alike=True, sign=-1):
    """Write a log of tendons in counts, motion by motion from the straight robot."""
    rng = np.random.default_rng(0)
    ring = 2.0944 * np.arange(3)
    u = np.stack([np.cos(ring), np.sin(ring)])
    parts = []
    for _ in range(8):
        way = 0.004 * rng.standard_normal((2, 2)) @ u
        s = np.linspace(0.0 if starts_alike else rng.uniform(0, 3), np.pi, 20)[:, None]
        parts.append(np.sin(s) * way.ravel())
    q = np.concatenate(parts)
    x = 1e3 * (evaluate(CHAIN, q)[0] + 1e-4 * rng.standard_normal((len(q), 3)))
    counts = np.round(sign * PER_METRE * q) + zeros
    table = np.column_stack([counts, x, np.repeat(np.arange(8), 20)])
    head = ",".join([*COLUMNS, "x", "y", "z", "motion"])
    np.savetxt(path, table, "%.6g", ",", header=head, comments="")
    return path


def init(log, out, unit="counts"):
    options = {"kind": "tendons", "segments": 2, "radius": 5, "length": 100, "q-unit": unit}
    options |= {"gain": 1e3 / PER_METRE, "q-sign": -1, "x-unit": "mm"}
    arguments = [f"--{name}={value}" for name, value in options.items()]
    return main(["init", str(out), "--log", str(log), *arguments])


def test_zeros_are_those_of_the_first_rows(tmp_path, capsys):
    out = tmp_path / "robot.toml"
    assert init(written(tmp_path / "log.csv", ZEROS), out) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "`zeros` are the median of the first rows of the motions (8)" in text
    robot = robots.read_description(out)
    assert robot.chain.actuator_zeros.tolist() == pytest.approx((-ZEROS).tolist(), abs=1.0)


def test_counts_that_start_at_zero_have_no_zeros(tmp_path, capsys):
    out = tmp_path / "robot.toml"
    assert init(written(tmp_path / "log.csv", 0 * ZEROS), out) == 0
    assert "zeros" not in capsys.readouterr().out
    assert not robots.read_description(out).chain.actuator_zeros.any()


def test_motions_that_do_not_start_alike_give_no_zeros(tmp_path, capsys):
    out = tmp_path / "robot.toml"
    init(written(tmp_path / "log.csv", ZEROS, starts_alike=False), out)
    assert "the motions do not start alike" in " ".join(capsys.readouterr().out.split())
    assert not robots.read_description(out).chain.actuator_zeros.any()
