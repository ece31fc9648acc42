"""Hostile values in any argument: an answer, or an error of ours that names the argument."""

import warnings

import numpy as np
import pytest
import torch
from entry_points import (
    CSV,
    DISPLAYED,
    FITTED,
    FOLDER,
    FORMAT,
    GROUPS,
    LIMITS,
    LOADED,
    NAMES,
    PATH,
    POINTS,
    ROBOT,
    SAVED,
    TRACK,
    Q,
    X,
    fuzz,
)
from mechanical_models import CHAINS, ROW_BY_ROW
from saved_models import tendon_chain, trunk

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ForceTendonChain,
    PlayOperator,
    PlayState,
    RigidChain,
    as_forward_model,
    calibrate,
    choose_rows,
    datasets,
    jacobian,
    load_model,
    plots,
    robots,
    save_model,
    trajectories,
    workflow,
)
from hybridkin.calibration.choice import choose_geometry


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch):
    monkeypatch.chdir(FOLDER)  # where paths such as "a" are written


def drawn(display, **options):
    """Draw a display on new axes and render it."""
    space = {"subplot_kw": {"projection": "3d"}} if options.pop("space", False) else {}
    figure, ax = plots.new_figure(2.0, 2.0, **space)
    figure.set_dpi(20)
    method = options.pop("method", "plot")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # matplotlib squares 1e300
        getattr(display, method)(ax, **options)
        figure.canvas.draw()


def made(cls, **given):
    """Return a chain of these arguments at work."""
    chain = cls(**given)
    return chain(torch.zeros(2, chain.n_actuators, dtype=torch.float64))


GEOMETRY = {
    "radii": np.array([0.005, 0.004]),
    "n_actuators": [3, 4],
    "angles": None,
    "lengths": np.array([0.06, 0.05]),
    "routing": "base",
    "offsets": np.array([0.0, 0.01]),
    "rest_bends": np.array([[0.1, 0.2], [0.0, -0.3]]),
    "gains": np.array([1.0, -2.0]),
    "base": np.diag([1.0, -1.0, -1.0, 1.0]),
    "dtype": torch.float64,
}
ORIGINS = np.stack([np.eye(4)] * 3)
AXES = {"duration": 0.5, "dt": 0.1, "timing": "min_jerk"}
ROUND = {"center": np.array([0.0, 0.1, 0.5]), "normal": np.array([0.0, 0.0, 1.0]), **AXES}
BODY = {
    "points": DISPLAYED.points,
    "actuators": [*DISPLAYED.actuators],
    "segments": [0, 0, 0],
    "disks": DISPLAYED.disks,
    "frames": DISPLAYED.frames,
    "tips": DISPLAYED.tips,
    "predicted": DISPLAYED.tips + 0.01,
    "rigid": False,
}
FILM = {"x": X, "target": X, "t": np.arange(24.0), "rows": np.arange(0, 24, 8), "name": "tip"}
CALIBRATE = {
    "chain": trunk(),
    "q": Q,
    "x": X,
    "parameters": ["radii"],
    "loss": "linear",
    "prior": 0.5,
    "groups": GROUPS,
    "sample_weight": np.ones(24),
}
READ = {"q_unit": "m", "x_unit": "m", "q_sign": 1, "delimiter": None, "drop_invalid": False}

# What a user calls, and arguments of it that are right. Cheap ones first.
ENTRIES = {
    "ConstantCurvatureChain": (
        lambda **k: made(ConstantCurvatureChain, **k),
        GEOMETRY | {"actuator_zeros": 1e-4 * np.arange(7), "stage": None},
    ),
    "ElasticTendonChain": (
        lambda **k: made(ElasticTendonChain, **k),
        GEOMETRY
        | {"bending_stiffness": np.array([2e-7, 3e-7]), "axial_stiffness": np.array([3.0, 4.0])}
        | {"tendon_zeros": 1e-4 * np.arange(7)},
    ),
    "ForceTendonChain": (
        lambda **k: made(ForceTendonChain, **k),
        GEOMETRY
        | {"bending_stiffness": np.array([0.02, 0.01]), "axial_stiffness": np.array([9.0, 8.0])}
        | {"weight": np.array([1.0, 2.0]), "taper": np.array([0.1, 0.5]), "arcs": 2}
        | {"gravity": np.array([0.0, 0.0, 1.0])},
    ),
    "RigidChain": (
        lambda **k: made(RigidChain, **k),
        {
            "origins": ORIGINS,
            "axes": np.eye(3),
            "kinds": ["revolute", "prismatic", "revolute"],
            "couplings": np.eye(3),
            "names": ["a", "b", "c"],
            "joint_zeros": np.zeros(3),
            "q_min": np.full(3, -1.0),
            "q_max": np.full(3, 1.0),
            "dq_max": np.ones(3),
            "tip": np.eye(4),
            "tool": np.array([0.1, 0.0, 0.2]),
            "base": np.eye(4),
            "dtype": torch.float64,
        },
    ),
    **{
        f"{type(chain).__name__}.{method} of {name}": (
            lambda q, chain=chain, method=method, **k: getattr(chain, method)(q, **k),
            {"q": torch.tensor(q)}
            | ({"n_points": 3} if method == "backbone" and name != "arm" else {})
            | ({"name": "q"} if method == "check_actuators" else {})
            | (
                {"tangents": {"base": torch.ones(1, 4, 4, dtype=torch.float64)}}
                if method == "geometry_jacobian"
                else {}
            ),
        )
        for name, (chain, q) in CHAINS.items()
        for method in (ROW_BY_ROW[type(chain)] + " check_actuators contradiction").split()
    },
    "ConstantCurvatureChain.with_tip": (tendon_chain().with_tip, {"at": 1.5}),
    "ConstantCurvatureChain.with_markers": (
        tendon_chain().with_markers,
        {"markers": [(0, 0.5, np.array([0.01, 0.0, 0.0])), (1, 1.0)]},
    ),
    "ElasticTendonChain.from_chain": (
        ElasticTendonChain.from_chain,
        {"chain": tendon_chain(), "bending_stiffness": 1e-6, "axial_stiffness": 3.0},
    ),
    "as_forward_model": (as_forward_model, {"model": torch.sin}),
    "jacobian": (jacobian, {"model": trunk(), "q": torch.tensor(Q[:3])}),
    "PlayOperator": (PlayOperator, {"width": np.array([0.1, 0.0, 0.2])}),
    "PlayOperator.apply": (
        PlayOperator([0.01, 0.0, 0.1]).apply,
        {"q": Q, "state": PlayState(Q[0], Q[0])},
    ),
    "PlayOperator.command": (
        PlayOperator([0.01, 0.0, 0.1]).command,
        {"y": Q, "state": PlayState(Q[0], Q[0])},
    ),
    "PlayOperator.apply_by_group": (
        PlayOperator(0.01).apply_by_group,
        {"q": Q, "groups": GROUPS},
    ),
    "robots.bionic_handling_assistant": (robots.bionic_handling_assistant, {"tool": 0.1}),
    "robots.from_toml": (robots.from_toml, {"path": ROBOT}),
    "robots.read_description": (robots.read_description, {"path": ROBOT}),
    "trajectories.Trajectory": (
        lambda t, x: repr(trajectories.Trajectory(t, x)),
        {"t": PATH.t, "x": PATH.x},
    ),
    "trajectories.min_jerk": (trajectories.min_jerk, {"s": np.linspace(0, 1, 5)}),
    "trajectories.figure_eight": (trajectories.figure_eight, {"size": (0.3, 0.2), **ROUND}),
    "trajectories.spiral": (
        trajectories.spiral,
        {"radius": (0.0, 0.1), "rise": 0.1, "turns": 2.0, **ROUND},
    ),
    "trajectories.line": (trajectories.line, {"start": X[0], "end": X[1], **AXES}),
    "trajectories.from_csv": (
        trajectories.from_csv,
        {"path": POINTS, "dt": None, "unit": "m"},
    ),
    "datasets.Log": (
        datasets.Log,
        {"q": Q, "x": X, "groups": GROUPS, "time": np.arange(24.0), "line": np.arange(24)},
    ),
    "datasets.load_log": (
        datasets.load_log,
        {"path": CSV, **NAMES, "groups": "g", "time": None, **READ},
    ),
    "datasets.log_columns": (datasets.log_columns, {"path": CSV, "delimiter": None}),
    "plots.model_color": (plots.model_color, {"name": "hybrid, ELM", "default": "#000000"}),
    "datasets.check_log": (
        lambda q, x, groups, time, **k: str(
            datasets.check_log(datasets.Log(q, x, groups, time), **k)
        ),
        {
            **{"q": Q, "x": X, "groups": GROUPS, "time": np.arange(24.0), "chain": trunk()},
            **{"base_is_free": True, "drop_invalid": True},
        },
    ),
    "datasets.paper_split": (
        datasets.paper_split,
        {"data": np.arange(12) % 4, "random_state": 0, "n_test": 2},
    ),
    "save_model": (
        save_model,
        {"model": FITTED, "path": FOLDER / "new.safetensors", "training": {"a": 1.0}},
    ),
    "load_model": (load_model, {"path": SAVED, "device": None}),
    "plots.ErrorHistogramDisplay": (
        lambda unit, bins, errors: drawn(plots.ErrorHistogramDisplay(errors), unit=unit, bins=bins),
        {"errors": {"a": X[:, 0] ** 2}, "unit": "cm", "bins": 5},
    ),
    "plots.ErrorBoxDisplay": (
        lambda unit, errors: drawn(plots.ErrorBoxDisplay(errors), unit=unit),
        {"errors": {"a": X[:, 0] ** 2, "b": X[:, 1] ** 2}, "unit": "mm"},
    ),
    "plots.ErrorHistogramDisplay.from_predictions": (
        plots.ErrorHistogramDisplay.from_predictions,
        {"x": X, "predictions": {"a": X + 0.01}},
    ),
    "plots.LearningCurveDisplay": (
        plots.LearningCurveDisplay,  # matplotlib warns of zero errors on its logarithmic axis
        {"sizes": np.array([5.0, 10.0]), "errors": {"a": np.array([[0.2, 0.3], [0.1, 0.2]])}},
    ),
    "plots.TrackingDisplay": (
        lambda unit, plane, **k: drawn(plots.TrackingDisplay(**k), unit=unit, plane=plane),
        {"target": X, "tracks": {"a": X + 0.01}, "t": np.arange(24.0), "unit": "cm", "plane": "xz"},
    ),
    **{
        f"plots.TrackingDisplay.{method}": (
            lambda unit, method=method, **k: drawn(
                plots.TrackingDisplay(**k), unit=unit, method=method
            ),
            {"target": X, "tracks": {"a": X + 0.01}, "t": np.arange(24.0), "unit": "cm"},
        )
        for method in ("plot_error", "plot_time")
    },
    "plots.TrackingDisplay.from_tracks": (
        plots.TrackingDisplay.from_tracks,
        {"tracks": {"a": TRACK}},
    ),
    "plots.ActuatorDisplay": (
        lambda unit, per_unit, **k: plots.ActuatorDisplay(**k).plot(
            [plots.new_figure(2.0, 2.0)[1]], unit=unit, per_unit=per_unit
        ),
        {
            "paths": {"a": Q},
            "actuators_per_segment": [3],
            "t": np.arange(24.0),
            "limits": np.array([[0.1] * 3, [0.4] * 3]),
            "names": ["a", "b", "c"],
            "unit": "cm",
            "per_unit": None,
        },
    ),
    "plots.ActuatorDisplay.from_tracks": (
        plots.ActuatorDisplay.from_tracks,
        {"tracks": {"a": TRACK}, "actuators_per_segment": [3]},
    ),
    "plots.WorkspaceDisplay": (
        lambda unit, **k: drawn(plots.WorkspaceDisplay(**k), unit=unit, space=True),
        {"x": X, "predicted": X + 0.01, "backbone": X, "row": 3, "unit": "cm"},
    ),
    "plots.BackboneDisplay": (
        lambda unit, **k: drawn(plots.BackboneDisplay(**k), unit=unit, space=True),
        {**BODY, "unit": "cm"},
    ),
    "plots.BackboneDisplay.from_estimator": (
        lambda n_points, q: plots.BackboneDisplay.from_estimator(FITTED, q, n_points=n_points),
        {"q": Q[:2], "n_points": 3},
    ),
    "plots.TrackAnimation": (
        lambda unit, frame, **k: drawn(
            plots.TrackAnimation(**k), unit=unit, frame=frame, space=True
        ),
        {**FILM, "unit": "cm", "frame": 1},
    ),
    "plots.TrackAnimation.from_estimator": (
        plots.TrackAnimation.from_estimator,
        {
            **{"model": FITTED, "q": Q, "target": X, "t": np.arange(24.0), "x": X, "n_frames": 3},
            **{"names": ["a", "b", "c"], "expected": X[:, 0]},
        },
    ),
    "choose_rows": (
        choose_rows,
        {
            "model": trunk(),
            "candidates": Q,
            "n": 3,
            "measured": Q[:2],
            "target": Q[2:4],
            "groups": GROUPS,
        },
    ),
    "workflow.open_model": (workflow.open_model, {"path": SAVED, "robot": ROBOT}),
    "workflow.read_path": (workflow.read_path, {"path": POINTS, "unit": "m", "dt": 0.05}),
    "workflow.scaled_path": (workflow.scaled_path, {"path": PATH, "scale": 0.5}),
    "workflow.path_limits": (
        workflow.path_limits,
        {
            "loaded": LOADED,
            "q_min": 0.1,
            "q_max": np.full(3, 0.4),
            "dq_max": 1.0,
            "ddq_max": None,
            "within_fit": False,
        },
    ),
    "workflow.shape_path": (
        workflow.shape_path,
        {
            "loaded": LOADED,
            "limits": LIMITS,
            "shape": "spiral",
            "size": [0.02, 0.05],
            "center": X[0],
            "normal": None,
            "turns": 1.0,
            "rise": 0.01,
            "duration": 0.5,
            "dt": 0.1,
        },
    ),
    "workflow.describe": (workflow.describe, {"loaded": LOADED}),
    "workflow.read_log": (
        workflow.read_log,
        {
            **{"path": CSV, "log_format": FORMAT, "chain": trunk(), "base_is_free": True},
            **{"exclude": (), "drop_invalid": False, "drop_frozen": False, "delimiter": None},
        },
    ),
}
COSTLY = {
    "calibrate": (calibrate, CALIBRATE),
    "choose_geometry": (
        choose_geometry,
        {"chain": trunk(), "q": Q, "x": X, "groups": GROUPS},
    ),
}


@pytest.mark.parametrize("entry", ENTRIES)
def test_any_argument_gives_an_answer_or_an_error_of_ours(entry):
    fuzz(*ENTRIES[entry])


@pytest.mark.slow
@pytest.mark.parametrize("entry", COSTLY)
def test_any_argument_of_what_takes_its_time(entry):
    fuzz(*COSTLY[entry], share=8)
