"""Long logs: what is measured is thinned, what moves is not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal

from hybridkin import Commands, ConstantCurvatureChain, Hysteresis, load_model, robots
from hybridkin.app import check_log, workflow
from hybridkin.app.workflow.log import checked
from hybridkin.datasets import Log
from hybridkin.hybrid._hysteresis import coarse_in_words
from hybridkin.hybrid._rows import Rows

CHAIN = ConstantCurvatureChain([0.05])
PLAY = Hysteresis.backlash(0.02)


def log_of(n_motions, seed=0, n_rows=60):
    """A log of one segment whose actuators have backlash."""
    rng = np.random.default_rng(seed)
    turn = np.linspace(0.0, 4.0 * np.pi, n_rows)
    waves = np.stack([np.sin(turn), np.sin(2.0 * turn), np.cos(turn) - 1.0])
    q = 0.25 + (rng.uniform(-0.03, 0.03, (n_motions, 3, 3)) @ waves).transpose(0, 2, 1)
    q = q.reshape(-1, 3)
    groups = np.repeat(np.arange(n_motions), n_rows)
    with torch.no_grad():
        x = CHAIN(torch.from_numpy(PLAY.apply_by_group(q, groups))).numpy()
    x = x + 3e-4 * rng.standard_normal(x.shape)
    return Log(q, x, groups, time=0.05 * np.arange(len(q)))


def measured(log):
    return checked(log, CHAIN, base_is_free=True)


@pytest.mark.parametrize("seed", range(4))
def test_a_thinned_log_keeps_all_that_moves_before_a_row_that_counts(seed):
    rng = np.random.default_rng(seed)
    log = log_of(int(rng.integers(3, 60)), seed, int(rng.integers(20, 90)))
    runs = np.asarray(log.groups) // int(rng.integers(1, 4))
    complete = measured(replace(log, runs=runs))
    max_rows = int(rng.integers(30, 200))
    thin = complete.thinned(max_rows)
    assert len(thin.measured.q) == len(thin.counted) <= max_rows
    assert (len(thin.q) == len(complete.q)) == (len(complete.q) <= max_rows) or (
        len(thin.q) > len(thin.counted)
    )
    for run in np.unique(thin.runs):
        of_run = thin.q[thin.runs == run]
        assert_array_equal(of_run, complete.q[complete.runs == run][: len(of_run)])
        assert thin.counts[thin.runs == run][-1] == 1.0
    some = rng.choice(thin.counted, 5, replace=False)
    part = thin.counting(np.sort(some))
    assert_array_equal(part.measured.q, thin.q[np.sort(some)])
    effective = PLAY.apply_by_group(part.q, part.commands.run_of_rows)[part.counted]
    expected = PLAY.apply_by_group(complete.q, complete.commands.run_of_rows)
    places = [int(np.flatnonzero((complete.x == x).all(axis=1))[0]) for x in part.measured.x]
    assert_array_equal(effective, expected[places])


def test_a_log_without_motions_has_only_the_rows_that_count():
    complete = measured(replace(log_of(20), groups=None))
    thin = complete.thinned(100)
    assert 90 <= len(thin.q) <= 100
    assert thin.counts.all()
    assert complete.thinned(None) is complete
    assert complete.thinned(10**6) is complete


def test_words_say_which_rows_were_fitted():
    complete = measured(log_of(200))
    thin = complete.thinned(400)
    words = thin.thinned_in_words(complete)
    assert words.startswith("of 12000, spread over 40 of 200 motions; hysteresis follows all ")
    assert complete.thinned_in_words(complete) == ""
    assert "40 of 200" in thin.measured.thinned_in_words(complete)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the calibration moved")
def test_more_motions_do_not_make_the_model_worse(tmp_path):
    """Every k-th row of a long log would not show how the actuators reverse."""
    robot = robots.RobotDescription("robot", CHAIN, ("radii",), None)
    new = log_of(20, seed=9)
    commands = Commands(new.q, new.groups, new.time)
    truth = CHAIN(torch.from_numpy(PLAY.apply_by_group(new.q, new.groups))).detach().numpy()
    errors = []
    for n_motions in (10, 300):
        settings = workflow.FitSettings(n_folds=2, max_rows=600)
        out = tmp_path / str(n_motions)
        record = workflow.fit_log(log_of(n_motions), robot, out, settings, n_jobs=1).record
        model = load_model(out / "model.safetensors")
        np.testing.assert_allclose(model.hysteresis_.width, 0.02, rtol=0.05)
        errors.append(np.linalg.norm(model.predict(commands) - truth, axis=1).mean())
        assert record.rows <= 600
        assert len(record.thinned) > 0 or n_motions == 10
    assert errors[1] < max(1.2 * errors[0], 3e-4)


def test_a_log_that_is_too_coarse_for_its_reversals_says_so():
    log = log_of(12)

    def words(step, operator=PLAY):
        rows = log.rows(np.arange(0, len(log.q), step))
        return coarse_in_words(operator, Rows.of(rows.q, rows.x, groups=rows.groups))

    assert not [f for f in check_log(log).findings if f.kind == "reversals"]
    assert words(1) == []
    assert "reverses about" in words(2, Hysteresis.backlash(0.001))[0]
    coarse = log.rows(np.arange(0, len(log.q), 12))
    (finding,) = (f for f in check_log(coarse).findings if f.kind == "reversals")
    assert "% of the rows" in finding.message
    assert "% of the rows" in words(12)[0]
    at_rest = np.random.default_rng(0).permutation(len(log.q))
    (finding,) = (f for f in check_log(log.rows(at_rest)).findings if f.kind == "reversals")
    assert finding.severity == "note"
