"""Which values a report gives, and whether it calls them identified where others contradict."""

import numpy as np
import pytest

from hybridkin import calibrate, datasets, robots
from hybridkin.app.workflow.calibrated import Calibration, calibrated_parameters
from hybridkin.app.workflow.compare import mechanical_of
from hybridkin.app.workflow.fit_record import whose_values, write_tried
from hybridkin.app.workflow.log import checked
from hybridkin.app.workflow.report import Report
from hybridkin.formats import LogUnit


def measured(q, x, motions):
    return checked(datasets.Log(q, x, motions), None, base_is_free=True)


def entries(robot, rows):
    """Parameters of the calibration on rows, as in their report, and those without other sets."""
    mechanical = mechanical_of(robot, rows, "linear")
    reported = mechanical.calibration(rows, "linear", ())
    alone = calibrated_parameters(mechanical.geometry.chain, mechanical.result, rows.q_unit)
    by_name = [{entry.name: entry for entry in found} for found in (reported.entries, alone)]
    return mechanical.geometry, *by_name


@pytest.mark.slow
def test_a_tilt_that_other_sets_contradict_is_not_identified():
    """A tilted base, a rest bend and shifted zeros explain the tips of the trunk alike."""
    data = datasets.load_trunk()
    robot = robots.RobotDescription("r", robots.bionic_handling_assistant(), "auto", None)
    rows = measured(data.q, data.x, np.arange(len(data.q)) // 50)
    geometry, shown, alone = entries(robot, rows)
    assert geometry.name == "radii + base"
    assert "radii + rest_bends + base" in [rival.name for rival in geometry.rivals]
    for rival in geometry.rivals:
        pairs = zip(geometry.errors[rival.name], geometry.errors[geometry.name], strict=True)
        assert all(theirs <= 1.1 * ours for theirs, ours in pairs)
    assert alone["base[rot y]"].identified
    assert not shown["base[rot y]"].identified
    assert all(shown[f"radii[{k}]"].identified for k in range(3))


def test_what_the_log_identifies_only_together_is_not_alone():
    """Rest bends that cancel, with a turn of the base, hardly move the tips of the trunk."""
    data = datasets.load_trunk()
    rows = np.flatnonzero(data.part == 3)[:240]
    start = robots.bionic_handling_assistant()
    result = calibrate(start, data.q[rows], data.x[rows], ("radii", "rest_bends", "base"))
    calibration = Calibration.of(start, result, LogUnit.of("mm"))
    answers = {entry.name: entry.answer for entry in calibration.entries}
    assert [answers[f"radii[{k}]"] for k in range(3)] == ["yes"] * 3
    assert answers["base[rot z]"] == "yes"
    named = [name for name in answers if any(name in text for text in result.unidentified)]
    assert {"rest_bends[0, x]", "base[rot y]"} < {*named}
    assert {answers[name] for name in named} == {"not alone"}
    report = Report("", {})
    calibration.write(report)
    assert report.plain().count("|  not alone |") == len(named)


def test_a_report_says_where_the_saved_model_has_other_values():
    auto = {"parameters": "radii + base", "mechanical_model": {"base": {}, "radii + base": {}}}
    of_row = 'These are the values of the row "mechanical, calibrated".'
    assert whose_values("radii + base", auto) == of_row
    assert whose_values("radii", None) == of_row
    one_set = auto | {"mechanical_model": {"radii + base": {}}}
    assert whose_values("radii", one_set) == of_row
    words = whose_values("radii + rest_bends + base", auto)
    assert words == f"{of_row} The saved model has other ones: it calibrates radii + base."


def test_a_report_has_no_nan_where_rows_are_too_few_for_errors_outside():
    reason = "-: too few rows for an error outside; the score is the held-out error."
    few = Report("", {})
    write_tried(few, "base", {"base": {"cv": 0.00123}, "radii + base": {"cv": 0.002}})
    assert "nan" not in few.plain()
    assert "| base         |             1.23 |       - |" in few.plain()
    assert reason in few.plain()
    many = Report("", {})
    write_tried(many, "base", {"base": {"cv": 0.00123, "io": 0.004}})
    assert "| base       |             1.23 |    4.00 |" in many.plain()
    assert reason not in many.plain()
