"""Whether a report calls a value identified that other, equally good sets contradict."""

import numpy as np
import pytest

from hybridkin import datasets, robots
from hybridkin.workflow._fit_report import write_calibration
from hybridkin.workflow.fit import FitSettings, _Rows
from hybridkin.workflow.report import Report, geometry_entries


def entries(rows):
    """Entries of the calibration on rows, as in their report, and those without other sets."""
    rows = rows.with_geometry_chosen()
    start, result, _ = rows.calibrated()
    report = Report("r")
    write_calibration(report, start, result, [], others=rows.rival_entries())
    shown = {entry["name"]: entry for entry in report.record["calibration"]["entries"]}
    return rows.geometry, shown, {e["name"]: e for e in geometry_entries(start, result)}


@pytest.mark.slow
def test_a_tilt_that_other_sets_contradict_is_not_identified():
    """A tilted base, a rest bend and shifted zeros explain the tips of the trunk alike."""
    data = datasets.load_trunk()
    robot = robots.RobotDescription("r", robots.bionic_handling_assistant(), "auto", None)
    rows = _Rows(data.q, data.x, np.arange(len(data.q)) // 50, robot, FitSettings())
    geometry, shown, alone = entries(rows)
    assert geometry.name == "radii + base"
    assert "radii + rest_bends + base" in [rival.name for rival in geometry.rivals]
    for rival in geometry.rivals:
        pairs = zip(geometry.errors[rival.name], geometry.errors[geometry.name], strict=True)
        assert all(theirs <= 1.1 * ours for theirs, ours in pairs)
    assert alone["base[rot y]"]["identified"]
    assert not shown["base[rot y]"]["identified"]
    assert all(shown[f"radii[{k}]"]["identified"] for k in range(3))


@pytest.mark.slow
def test_the_tool_of_a_real_robot_is_not_identified(data_home):
    """Two sets with nearly the same errors give 6.7 and -8.7 mm, each to a fraction of one."""
    data = datasets.load_ftdcr(data_home)
    robot = robots.read_description("examples/robots/ftdcr_v4.toml")
    _, shown, alone = entries(_Rows(data.q, data.x, data.groups, robot, FitSettings()))
    assert alone["tool"]["identified"]
    assert not shown["tool"]["identified"]
