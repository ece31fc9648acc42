"""What a fit says of a calibrated geometry far from the description; simulated robots."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hybridkin import ConstantCurvatureChain, Hysteresis, app, calibrate, robots
from hybridkin._core.units import LogUnit
from hybridkin.app import workflow
from hybridkin.app.workflow.calibrated import calibrated_parameters, deviations
from hybridkin.datasets import Log

RADII = np.array([0.008, 0.007])
RING = 2 * np.pi / 3 * np.arange(3)
MOTIONS = np.repeat(np.arange(6), 12)


def robot(turn=(0.0, 0.0, 0.0), second_ring=0.0, radii=RADII, length=0.1, **options):
    """Two segments of three tendons, the base rotated by `turn` and the second ring [deg]."""
    base = np.eye(4)
    base[:3, :3] = Rotation.from_rotvec(turn, degrees=True).as_matrix()
    angles = [RING, RING + np.radians(second_ring)]
    lengths = [length, 0.08]
    return ConstantCurvatureChain(radii, lengths=lengths, angles=angles, base=base, **options)


def measured(truth, sign=1):
    """Rows of six motions of balanced tendons, and their tips with noise."""
    rng = np.random.default_rng(0)
    ring = np.stack([np.cos(RING), np.sin(RING)])
    bends = rng.uniform(-1.0, 1.0, (6, 1, 2, 2)) * np.sin(np.linspace(0.1, 3.0, 12))[:, None, None]
    q = (-RADII[:, None] * (bends @ ring)).reshape(72, 6) / truth.gains.numpy()
    x = truth(torch.from_numpy(q)).numpy() + 1e-4 * rng.standard_normal((72, 3))
    return sign * q, x


def said(nominal, truth, parameters, sign=1):
    """Sentences about a calibration of the nominal robot to the true one."""
    q, x = measured(truth, sign)
    return [*deviations(nominal, calibrate(nominal, q, x, parameters), LogUnit.of("m"))]


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (150.0, 0.0, 60.0)])
def test_a_right_description_has_no_deviations(turn):
    nominal = robot(turn, radii=1.1 * RADII, length=0.095)
    assert said(nominal, robot(turn), ["radii", "turns", "lengths", "base"]) == []


def test_sizes_that_contradict_a_ruler_are_named_with_both_values():
    (sentence,) = said(robot(length=0.125), robot(), ["lengths", "base"])
    assert "lengths[0] from 125 to 100.1 mm" in sentence
    assert "lengths[1]" not in sentence
    assert "`spool_radius`" in sentence
    (sentence,) = said(robot(gains=1.3e-3), robot(gains=1e-3), ["gain", "base"])
    assert "gain from 0.0013 to" in sentence


def test_a_ring_that_is_turned_against_the_other_is_named():
    (sentence,) = said(robot(), robot(second_ring=60.0), ["turns", "base"])
    assert "by up to 60 degrees" in sentence
    assert "`angle_deg`" in sentence
    # Rings that are all turned alike are a turned base: their mounting is not known.
    alike = robot((0.0, 0.0, 60.0))
    assert said(robot(), alike, ["turns", "base"]) == []


def test_a_horizontal_robot_may_hide_a_wrong_sign_of_all_tendons():
    """With the wrong sign the base turns by 180 degrees about its axis, and the tips fit."""
    down = robot((0.0, 90.0, 0.0))
    (sentence,) = said(robot(), down, ["base"], sign=-1)
    assert "tilted by 90 degrees" in sentence
    assert "`q_sign`" in sentence
    # Where the description has the mounting, the check of the log finds the sign.
    q, x = measured(down, -1)
    (finding,) = app.check_log(Log(q, x, MOTIONS), chain=down).misread
    assert finding.kind == "sign"
    assert app.check_log(Log(-q, x, MOTIONS), chain=down).misread == ()


@pytest.mark.slow
def test_a_fit_warns_of_deviations_and_reports_them(tmp_path):
    q, x = measured(robot())
    description = robots.RobotDescription("r", robot(length=0.125), ("lengths", "base"), None)
    settings = workflow.FitSettings(n_folds=2, auto=False)
    log = Log(q[::3], x[::3], MOTIONS[::3])
    with pytest.warns(UserWarning, match=r"moved lengths\[0\] from 125 to 100") as caught:
        workflow.fit_log(log, description, tmp_path, settings, n_jobs=1)
    assert len(caught) == 1
    assert "Warning: the calibration moved" in (tmp_path / "report.md").read_text()


def test_gains_and_widths_are_in_the_unit_of_the_log():
    """As a lab writes them: millimetres for a count, counts of backlash, three digits."""
    truth = robot(gains=9.2e-6)
    q, x = measured(truth)
    start = robot(gains=1e-5)
    result = calibrate(start, q, x, ["gain", "base"])
    of_gain = calibrated_parameters(start, result, LogUnit.of("counts"))[0]
    assert (of_gain.name, of_gain.unit) == ("gain", "mm/counts")
    assert of_gain.digits(of_gain.start) == "0.01"
    assert of_gain.value == pytest.approx(1e3 * float(result.chain.gains[0]), rel=1e-12)
    assert of_gain.digits(0.00923456) == "0.00923"
    series = Hysteresis.backlash([12.34, 9.0]) | Hysteresis.creep([0.25], [3.0])
    words = series.in_words(LogUnit.of("counts"))
    assert words == "backlash of 12.3 counts and creep (up to 25 % late, with 3 s)"
    assert Hysteresis.backlash(0.0004).in_words(LogUnit.of("m")) == "backlash of 0.4 mm"
    assert Hysteresis.backlash(np.radians(3.0)).in_words(LogUnit.of("deg")) == "backlash of 3 deg"
