"""Units of time on the command line and in robot descriptions."""

import json

import numpy as np
import pytest
from simulated_log import ROBOT, rows, write

from hybridkin.app.cli.main import main

UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


def durations(capsys, log, robot, *options):
    """Return the duration and the findings on times of a check."""
    assert main(["evaluate", str(robot), str(log), "--json", *options]) == 0
    report = json.loads(capsys.readouterr().out)["log_check"]
    return report["duration_s"], [f for f in report["findings"] if f["kind"] == "time"]


@pytest.mark.parametrize("unit", UNITS)
def test_a_log_is_read_in_its_unit_of_time(unit, robot, tmp_path, capsys):
    table = rows()
    expected = np.ptp(table[:, 0])
    table[:, 0] = UNITS[unit] * (1.7e9 + table[:, 0])
    log = tmp_path / "log.csv"
    np.savetxt(log, table, delimiter=",", header=_HEADER, comments="", fmt="%.17g")
    duration, findings = durations(capsys, log, robot, "--time-unit", unit)
    assert abs(duration - expected) < 1e-3
    assert not findings
    described = tmp_path / "described.toml"
    described.write_text(ROBOT.replace("[limits]", f'time_unit = "{unit}"\n[limits]'))
    assert durations(capsys, log, described)[0] == duration
    if unit != "s":
        _, (finding,) = durations(capsys, log, robot)
        assert f"--time-unit {unit}" in finding["advice"]


def test_frames_need_a_rate(robot, tmp_path, capsys):
    table = rows()
    table[:, 0] = np.arange(len(table))
    log = write(tmp_path / "log.csv", table)
    frames = ["--time-unit", "frames", "--rate", "50"]
    duration, _ = durations(capsys, log, robot, *frames)
    assert abs(duration - (len(table) - 1) / 50.0) < 1e-9
    assert main(["evaluate", str(robot), str(log), *frames[:2]]) != 0
    assert "`rate` must be given" in capsys.readouterr().err
    described = tmp_path / "described.toml"
    keys = 'time_unit = "frames"\nrate = 50\n[limits]'
    described.write_text(ROBOT.replace("[limits]", keys))
    assert durations(capsys, log, described)[0] == duration
    assert durations(capsys, log, described, "--time-unit", "s")[0] == len(table) - 1
    described.write_text(ROBOT.replace("[limits]", 'time_unit = "minutes"\n[limits]'))
    assert main(["evaluate", str(described), str(log)]) != 0
    assert "time_unit" in capsys.readouterr().err


_HEADER = ",".join(["time", "t1", "t2", "t3", "t4", "t5", "t6", "x", "y", "z", "motion"])
