"""Arguments that once gave an error of torch or NumPy, a bare warning, or a wrong answer."""

import numpy as np
import pytest
import torch
from saved_models import arm, tendon_chain, trunk, trunk_log
from torch.testing import assert_close

from hybridkin import (
    ELMRegressorCV,
    InverseKinematics,
    PlayOperator,
    PlayState,
    calibrate,
    fit_play,
    load_model,
    plots,
    save_model,
)
from hybridkin import trajectories as paths
from hybridkin.calibration.choice import choose_geometry
from hybridkin.datasets import Log, check_log, paper_split
from hybridkin.workflow import FitSettings

Q, X, GROUPS = trunk_log(24)
HUGE = np.where(np.arange(24)[:, None] == 3, 1e300, X)
ROWS = torch.tensor(Q)
NAN_GROUPS = np.where(GROUPS == 1, np.nan, GROUPS)
META = ROWS.to("meta")


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("q", lambda: trunk().contradiction(META)),
        ("q", lambda: trunk().metres(ROWS[:, :0])),
        ("n_points", lambda: trunk().backbone(ROWS, 2.5)),
        ("n_points", lambda: trunk().backbone(ROWS, 2**63)),
        ("tangents", lambda: trunk().geometry_jacobian(ROWS, {})),
        (r"tangents\['base'\]", lambda: trunk().geometry_jacobian(ROWS, {"base": torch.ones(4)})),
        ("markers", lambda: tendon_chain().with_markers([(0,)])),
        ("state", lambda: PlayOperator(0.1).apply(Q, PlayState(np.nan * Q[0], Q[0]))),
        ("routing", lambda: trunk(routing=["segment"])),
        ("timing", lambda: paths.line(X[0], X[1], timing=X)),
        ("duration", lambda: paths.line(X[0], X[1], duration=1e300)),
        ("path", lambda: paths.from_csv(None)),
        ("path", lambda: paths.from_csv("nowhere.csv")),
        ("path", lambda: load_model(None)),
        ("path", lambda: save_model(trunk(), 3)),
        ("training", lambda: save_model(trunk(), "model", training=np.nan)),
        ("groups", lambda: Log(Q, X, GROUPS[:3])),
        ("groups", lambda: Log(Q, X, torch.tensor(GROUPS).to("meta"))),
        ("groups", lambda: Log(Q, X, np.where(GROUPS == 1, np.inf, GROUPS))),
        ("q", lambda: PlayOperator(0.1).apply_by_group(Q[:, :0], GROUPS)),
        ("stage", lambda: trunk(stage=Q)),
        ("actuators_per_segment", lambda: plots.ActuatorDisplay({"a": Q}, None)),
        ("names", lambda: plots.ActuatorDisplay({"a": Q}, [3], names=True)),
        ("actuators", lambda: plots.BackboneDisplay(X[None], actuators=None)),
        ("t", lambda: plots.TrackAnimation(X, t=np.where(np.arange(24) < 2, np.inf, 0.0))),
        ("loss", lambda: choose_geometry(trunk(), Q, X, loss=None)),
        ("q", lambda: fit_play(trunk(), Q[:0], X, GROUPS)),
        ("n_folds", lambda: FitSettings(n_folds=np.nan)),
        ("max_rows", lambda: FitSettings(max_rows=0)),
        ("auto", lambda: FitSettings(auto=np.nan)),
        ("alphas", lambda: ELMRegressorCV(alphas=[5e-324]).fit(Q, X)),
        ("damping", lambda: InverseKinematics(trunk(), damping=Q)),
        ("limits", lambda: InverseKinematics(trunk(), limits=Q)),
        ("dt", lambda: InverseKinematics(trunk(), beta=0.0, dt=1e300)),
        ("t", lambda: InverseKinematics(trunk(), beta=0.0).track(X[:2], [0.0, 1e300])),
        ("groups", lambda: Log(Q, X, NAN_GROUPS)),
        ("time", lambda: Log(Q, X, time=[0.0])),
        ("random_state", lambda: paper_split(np.full(5, 3), -1, n_test=2)),
        ("x", lambda: calibrate(trunk(), Q, HUGE, ("radii",))),
        ("groups", lambda: calibrate(trunk(), Q, X, ("radii",), groups=NAN_GROUPS)),
        ("groups", lambda: choose_geometry(trunk(), Q, X, groups=GROUPS[:3])),
        ("bins", lambda: plots.ErrorHistogramDisplay({"a": [0.1]}).plot(object(), bins=-1)),
        ("row", lambda: plots.WorkspaceDisplay(X, X, row=0.5)),
        ("names", lambda: plots.ActuatorDisplay({"a": Q}, [3], names=["a"])),
        ("limits", lambda: plots.ActuatorDisplay({"a": Q}, [3], limits=[1.0])),
        ("rows", lambda: plots.TrackAnimation(X, rows=0.5)),
    ],
)
def test_an_argument_that_has_no_answer_is_named(name, call):
    with pytest.raises((ValueError, TypeError, FileNotFoundError), match=f"`{name}`"):
        call()


def test_a_number_whose_square_overflows_counts_as_infinite():
    found = check_log(Log(Q, HUGE, GROUPS), chain=trunk()).findings
    (invalid,) = [finding for finding in found if finding.kind == "invalid"]
    assert invalid.rows.tolist() == [3]


def test_a_state_in_numpy_continues_a_motion_in_torch():
    state = PlayState(Q[0][::-1].copy()[::-1], Q[0])
    found, _ = PlayOperator(0.1).apply(ROWS, state)
    assert_close(found, torch.tensor(PlayOperator(0.1).apply(Q, state)[0]))


def test_the_geometry_of_an_arm_moves_in_single_precision():
    tangents = {"base": torch.ones(2, 4, 4, dtype=torch.float64)}
    found = arm().geometry_jacobian(ROWS.float(), tangents)
    assert found.dtype == torch.float32
    assert_close(found.double(), arm().geometry_jacobian(ROWS, tangents), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("size", [1e300, 5e-324])
def test_a_normal_of_any_size_gives_the_plane(size):
    circle = {"radius": 0.1, "duration": 0.2, "dt": 0.1}
    found = paths.spiral(X[0], normal=[0.0, size, 0.0], **circle)
    np.testing.assert_array_equal(found.x, paths.spiral(X[0], normal=[0, 1, 0], **circle).x)


def test_errors_beyond_the_root_of_the_largest_number_are_drawn():
    found = plots.ErrorHistogramDisplay.from_predictions(X, {"a": HUGE}).errors["a"]
    assert found[3] == pytest.approx(np.sqrt(3) * 1e300)
