"""Hostile arguments of every entry point: the right answer, or an error that names the argument."""

import copy
import warnings

import numpy as np
import pandas as pd
import pytest
import torch
from entry_points import (
    CSV,
    DESCRIPTION,
    DISPLAYED,
    FITTED,
    FOLDER,
    FORMAT,
    GROUPS,
    LIMITS,
    LOADED,
    LOG,
    NAMES,
    PATH,
    POINTS,
    ROBOT,
    SAVED,
    Q,
    X,
    fuzz,
)
from mechanical_models import CHAINS, ROW_BY_ROW
from numpy.testing import assert_allclose
from saved_models import tendon_chain, trunk
from scipy import sparse

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    ELMRegressorCV,
    ForceTendonChain,
    HybridForwardModel,
    Hysteresis,
    InverseKinematics,
    RigidChain,
    app,
    as_forward_model,
    calibrate,
    choose_rows,
    cross_fit,
    datasets,
    jacobian,
    load_model,
    obstacles,
    open_model,
    plots,
    robots,
    save_model,
    separating_motions,
    tasks,
    trajectories,
)
from hybridkin.app import check_log, workflow
from hybridkin.app.workflow import FitSettings
from hybridkin.calibration.choice import GeometryChoice, choose_geometry
from hybridkin.datasets import Log, paper_split


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


BALL = obstacles.Sphere([0.1, 0.0, 0.5], 0.05)


SCENE = FOLDER / "scene.toml"
SCENE.write_text("[[sphere]]\ncenter = [0.1, 0.0, 0.5]\nradius = 0.05\n")


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


CALIBRATE = {
    "chain": trunk(),
    "q": Q,
    "x": X,
    "parameters": ["radii"],
    "loss": "linear",
    "prior": 0.5,
    "groups": GROUPS,
    "sample_weight": np.ones(24),
    "touched": np.arange(24) % 3,
    "distances": {(0, 1): 0.1, (1, 2): 0.2},
    "distance_std": 1e-4,
}


RECORDING = FOLDER / "recording.csv"
np.savetxt(
    RECORDING,
    np.column_stack([np.arange(24.0), X, GROUPS]),
    delimiter=",",
    header="t,x,y,z,g",
    comments="",
)


READ = {
    **{"q_unit": "m", "x_unit": "m", "q_sign": 1, "delimiter": None, "drop_invalid": False},
    **{"header_line": None, "decimal": ".", "missing": (), "unwrap": False},
}


SETTINGS = {"n_folds": 2, "auto": False, "loss": "linear", "coverage": None}


SETTINGS |= {"hysteresis": 0.0, "max_rows": None}


OUT, SENT = FOLDER / "out", FOLDER / "sent.csv"


SENT.write_text("q1,q2,q3,x,y,z\n" + "\n".join(",".join(map(str, row)) for row in np.c_[Q, X]))


TENDONS = ConstantCurvatureChain([0.005], lengths=[0.1])


def with_settings(function):
    """Return a function that takes the fields of its settings one by one."""

    def call(n_jobs=1, **given):
        own = {name: given.pop(name) for name in SETTINGS}
        return function(**given, settings=workflow.FitSettings(**own), n_jobs=n_jobs)

    return call


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
        for method in (ROW_BY_ROW[type(chain)] + " check_actuators contradictions").split()
    },
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
    "Hysteresis.backlash": (Hysteresis.backlash, {"width": np.array([0.1, 0.0, 0.2])}),
    "Hysteresis.apply": (
        Hysteresis.backlash([0.01, 0.0, 0.1]).apply,
        {"q": Q, "state": np.tile(Q[0], (3, 1))},
    ),
    "Hysteresis.command": (
        Hysteresis.backlash([0.01, 0.0, 0.1]).command,
        {"y": Q, "state": np.tile(Q[0], (3, 1))},
    ),
    "Hysteresis.apply_by_group": (
        Hysteresis.backlash(0.01).apply_by_group,
        {"q": Q, "groups": GROUPS},
    ),
    "Hysteresis.friction": (
        Hysteresis.friction,
        {"widths": np.array([0.0, 0.1, 0.2]), "slopes": np.array([0.3, 0.8])},
    ),
    "Hysteresis.creep": (
        Hysteresis.creep,
        {"shares": np.array([0.1, 0.2]), "times": np.array([3.0, 80.0])},
    ),
    "friction.apply": (
        Hysteresis.friction([0.0, 0.1], [0.3]).apply,
        {"q": Q, "state": np.tile(Q[0], (4, 1))},
    ),
    "friction.command": (
        Hysteresis.friction([0.0, 0.1], [0.3]).command,
        {"y": Q, "state": np.tile(Q[0], (4, 1))},
    ),
    "robots.read_description": (robots.read_description, {"path": ROBOT}),
    "trajectories.min_jerk": (trajectories.min_jerk, {"s": np.linspace(0, 1, 5)}),
    "trajectories.figure_eight": (trajectories.figure_eight, {"size": (0.3, 0.2), **ROUND}),
    "trajectories.spiral": (
        trajectories.spiral,
        {"radius": (0.0, 0.1), "rise": 0.1, "turns": 2.0, **ROUND},
    ),
    "trajectories.line": (trajectories.line, {"start": X[0], "end": X[1], **AXES}),
    "trajectories.from_csv": (
        trajectories.from_csv,
        {"path": POINTS, "dt": 0.05, "unit": "m"},
    ),
    "datasets.Log": (
        datasets.Log,
        {"q": Q, "x": X, "groups": GROUPS, "time": np.arange(24.0), "line": np.arange(24)},
    ),
    "datasets.load_log": (
        datasets.load_log,
        {"path": CSV, **NAMES, "groups": "g", "time": None, **READ},
    ),
    "datasets.TimedColumns": (
        datasets.TimedColumns,
        {"values": Q, "time": np.arange(24.0), "groups": GROUPS},
    ),
    "datasets.read_columns": (
        datasets.read_columns,
        {
            **{
                "path": RECORDING,
                "names": ["x", "y", "z"],
                "time": "t",
                "unit": "mm",
                "sign": [1, 1, -1],
            },
            **{
                "groups": "g",
                "delimiter": None,
                "header_line": None,
                "decimal": ".",
                "missing": (),
            },
        },
    ),
    "datasets.merge_logs": (
        datasets.merge_logs,
        {
            "motors": datasets.TimedColumns(Q, np.arange(24.0)),
            "camera": datasets.TimedColumns(X, np.arange(24.0)),
            **{"lag": 0.5, "tolerance": 2.0, "hold": False},
        },
    ),
    "app.check_log": (
        lambda q, x, groups, time, **k: str(app.check_log(datasets.Log(q, x, groups, time), **k)),
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
        lambda unit, errors: drawn(plots.ErrorHistogramDisplay(errors), unit=unit),
        {"errors": {"a": X[:, 0] ** 2}, "unit": "cm"},
    ),
    "plots.TrackingDisplay": (
        lambda unit, plane, **k: drawn(plots.TrackingDisplay(**k), unit=unit, plane=plane),
        {"target": X, "tracks": {"a": X + 0.01}, "t": np.arange(24.0), "unit": "cm", "plane": "xz"},
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
    "plots.ClearanceDisplay": (
        lambda unit, **k: drawn(plots.ClearanceDisplay(**k), unit=unit),
        {
            "distances": {"a": X[:, 0], "b": X[:, 1]},
            "t": np.arange(24.0),
            "clearance": 0.01,
            "unit": "cm",
        },
    ),
    "plots.obstacle_surface": (
        plots.obstacle_surface,
        {"obstacle": BALL, "low": np.zeros(3), "high": np.ones(3)},
    ),
    "plots.BackboneDisplay among obstacles": (
        lambda obstacles: drawn(plots.BackboneDisplay(**BODY, obstacles=obstacles), space=True),
        {"obstacles": [BALL, obstacles.HalfSpace([0.0, 0.0, 1.0], 0.0)]},
    ),
    "obstacles.read_scene": (obstacles.read_scene, {"path": SCENE}),
    "InverseKinematics.body_distances": (
        InverseKinematics(
            trunk(), q_min=0.1, q_max=0.4, obstacles=[BALL], body_points=2
        ).body_distances,
        {"q": Q[:3], "obstacles": [BALL, BALL]},
    ),
    "plots.BackboneDisplay": (
        lambda unit, **k: drawn(plots.BackboneDisplay(**k), unit=unit, space=True),
        {**BODY, "unit": "cm"},
    ),
    "plots.BackboneDisplay.from_estimator": (
        lambda n_points, q: plots.BackboneDisplay.from_estimator(FITTED, q, n_points=n_points),
        {"q": Q[:2], "n_points": 3},
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
    "open_model": (open_model, {"model": SAVED, "robot": ROBOT}),
    "cross_fit": (
        cross_fit,
        {
            "models": {"nominal": HybridForwardModel(trunk(), "drop")},
            "log": LOG,
            "folds": 2,
            "choices": "anew",
            "sample_weight": np.ones(24),
        },
    ),
    "workflow.scaled_path": (workflow.scaled_path, {"path": PATH, "scale": 0.5}),
    "workflow.path_limits": (
        workflow.path_limits,
        {
            "model": LOADED,
            "q_min": 0.1,
            "q_max": np.full(3, 0.4),
            "dq_max": 1.0,
            "ddq_max": np.inf,
            "within_fit": False,
        },
    ),
    "workflow.shape_path": (
        workflow.shape_path,
        {
            "model": LOADED,
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
    "workflow.describe": (workflow.describe, {"model": LOADED}),
    "workflow.read_log": (
        workflow.read_log,
        {
            **{"path": CSV, "log_format": FORMAT, "chain": trunk(), "base_is_free": True},
            **{"exclude": (), "drop_invalid": False, "drop_frozen": False, "delimiter": None},
        },
    ),
}


TWO_SETS = GeometryChoice(
    trunk(), ("base",), name="base", rivals=(GeometryChoice(trunk(), ("radii",), name="radii"),)
)


COSTLY = {
    "calibrate": (calibrate, CALIBRATE),
    "choose_geometry": (
        choose_geometry,
        {"chain": trunk(), "q": Q, "x": X, "groups": GROUPS},
    ),
    "separating_motions": (
        separating_motions,
        {"choice": TWO_SETS, "q": Q, "x": X, "q_min": 0.1, "q_max": np.full(3, 0.4)},
    ),
    "HybridForwardModel.was_fitted": (LOADED.was_fitted, {"X": Q, "y": X}),
    "RobotDescription.to_log": (DESCRIPTION.to_log, {"q": Q}),
    "RobotDescription.from_log": (DESCRIPTION.from_log, {"q": Q}),
    "evaluate_log": (
        workflow.evaluate_log,
        {"model": LOADED, "log": LOG, "out": None, "force": True},
    ),
    "verify_track": (
        workflow.verify_track,
        {"model": LOADED, "track": SENT, "log": LOG, "out": None},
    ),
    "next_rows": (
        workflow.next_rows,
        {"model": LOADED, "out": OUT, "n": 2, "limits": LIMITS, "path": PATH},
    ),
    "track_path": (
        workflow.track_path,
        {
            **{"model": LOADED, "path": PATH, "out": OUT, "limits": LIMITS, "start": "rest"},
            **{"tol": 1e-3, "force": True, "obstacles": [BALL.moved([3.0, 0.0, 0.0])]},
            "clearance": 0.01,
        },
    ),
    "fit_log": (
        with_settings(workflow.fit_log),
        {"log": LOG, "robot": DESCRIPTION, "out": OUT, "force": True, **SETTINGS},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("entry", ENTRIES)
def test_any_argument_gives_an_answer_or_an_error_of_ours(entry):
    fuzz(*ENTRIES[entry])


@pytest.mark.slow
@pytest.mark.parametrize("entry", COSTLY)
def test_any_argument_of_what_takes_its_time(entry):
    fuzz(*COSTLY[entry], share=40 if "_" in entry else 8)


# Arrays of other kinds


def frame(array):
    names = [f"c{k}" for k in range(array.shape[1])] if array.ndim == 2 else None
    return pd.Series(array) if names is None else pd.DataFrame(array, columns=names)


def read_only(array):
    array = array.copy()
    array.flags.writeable = False
    return array


def masked(array):
    array = np.ma.masked_array(array)
    array[(0,) * array.ndim] = np.ma.masked
    return array


def holes(array):
    array = array.astype(object)
    array[(0,) * array.ndim] = pd.NA
    return array


# The answer must be that of the plain numbers.
GOOD = {
    "list": lambda a: a.tolist(),
    "read-only": read_only,
    "fortran": np.asfortranarray,
    "strided": lambda a: np.repeat(a, 2, axis=-1)[..., ::2],
    "negative strides": lambda a: a[::-1].copy()[::-1],
    "big-endian": lambda a: a.astype(">f8"),
    "long": lambda a: a.astype(np.longdouble),
    "object": lambda a: a.astype(object),
    "masked without a mask": np.ma.masked_array,
    "matrix of pandas": frame,
    "nullable": lambda a: frame(a).astype("Float64"),
    "read-only pandas": lambda a: frame(read_only(a)),
    "gradient": lambda a: torch.tensor(a, requires_grad=True),
    "tensor": torch.tensor,
    "expanded": lambda a: torch.tensor(a).expand(2, *a.shape)[0],
    "transposed": lambda a: torch.tensor(a.T.copy()).permute(*range(a.ndim)[::-1]),
}


# There is no answer.
BAD = {
    "sparse": lambda a: sparse.csr_array(a) if a.ndim else sparse.csr_array(a[None]),
    "sparse tensor": lambda a: torch.tensor(a).to_sparse(),
    "complex": lambda a: a + 1j,
    "complex tensor": lambda a: torch.tensor(a) + 1j,
    "text": lambda a: np.full(a.shape, "a"),
    "numbers as text": lambda a: a.astype(str),
    "bytes": lambda a: a.astype("S8"),
    "dates": lambda a: np.full(a.shape, np.datetime64("2020-01-01")),
    "records": lambda a: np.zeros(a.shape, dtype=[("a", float)]),
    "masked": masked,
    "missing": holes,
    "mapping": lambda a: {"a": a},
    "ragged": lambda a: [[0.1, 0.2], [0.3]],
    "without data": lambda a: torch.tensor(a, device="meta"),
    "list of gradients": lambda a: [[torch.ones(2, requires_grad=True)], [torch.ones(1)]],
}


def numbers(value):
    """Return what an entry point gave as one array."""
    if isinstance(value, (tuple, list)):
        return np.concatenate([numbers(part).ravel() for part in value])
    return value.numpy(force=True) if isinstance(value, torch.Tensor) else np.asarray(value, float)


NETWORK = ELMRegressor(4, random_state=0).fit(Q, X)


IK = InverseKinematics(trunk(), q_min=0.1, q_max=0.4, dq_max=0.05)


AMONG = InverseKinematics(trunk(), q_min=0.1, q_max=0.4, obstacles=[BALL], body_points=2)


def solver(**given):
    given = {"q_min": 0.1, "q_max": 0.4, **given}
    return InverseKinematics(trunk(), **given).solve(X[:2], max_iter=2).q


def tracked(q0, target, dx=None, x_measured=None):
    tracker = IK.tracker(q0)
    return tracker.step(target, dx, x_measured=x_measured)


def fitted(model, **given):
    rows = {"X": Q, "y": X, **given}
    return copy.deepcopy(model).fit(**rows).predict(Q)


def followed(**given):
    model = copy.deepcopy(FITTED)
    return model.partial_fit(**{"X": Q[:4], "y": X[:4], **given}).predict(Q)


def radii(**given):
    return calibrate(**{"chain": trunk(), "q": Q, "x": X, "parameters": ("radii",), **given}).rmse


HALF = 0.5 + np.arange(3.0)


WEIGHTS = 0.5 + np.arange(24.0) % 2


LINEAR = HybridForwardModel(trunk(), "linear")


# Name of the argument, numbers, entry point.
ARRAYS = {
    "calibrate.q": ("q", Q, lambda v: radii(q=v)),
    "calibrate.x": ("x", X, lambda v: radii(x=v)),
    "calibrate.weights": ("sample_weight", WEIGHTS, lambda v: radii(sample_weight=v)),
    "choose": ("candidates", Q, lambda v: choose_rows(trunk(), v, 3)[1]),
    "choose.measured": ("measured", Q, lambda v: choose_rows(trunk(), Q, 3, measured=v)[1]),
    "backlash.width": ("width", HALF / 1e3, lambda v: Hysteresis.backlash(v).apply(Q)[0]),
    "backlash.command": ("y", Q, lambda v: Hysteresis.backlash(0.01).command(v)[0]),
    "backlash.apply_by_group": (
        "q",
        Q,
        lambda v: Hysteresis.backlash(0.01).apply_by_group(v, GROUPS),
    ),
    "hybrid.fit X": ("X", Q, lambda v: fitted(LINEAR, X=v)),
    "hybrid.fit y": ("y", X, lambda v: fitted(LINEAR, y=v)),
    "hybrid.fit weights": ("sample_weight", WEIGHTS, lambda v: fitted(LINEAR, sample_weight=v)),
    "hybrid.partial_fit X": ("X", Q[:4], lambda v: followed(X=v)),
    "hybrid.partial_fit y": ("y", X[:4], lambda v: followed(y=v)),
    "hybrid.predict": ("X", Q, FITTED.predict),
    "elm.fit X": ("X", Q, lambda v: fitted(NETWORK, X=v)),
    "elm.fit y": ("y", X, lambda v: fitted(NETWORK, y=v)),
    "elm.fit weights": ("sample_weight", WEIGHTS, lambda v: fitted(NETWORK, sample_weight=v)),
    "elm.predict": ("X", Q, NETWORK.predict),
    "elm_cv.fit X": ("X", Q, lambda v: fitted(ELMRegressorCV(4, cv=2, random_state=0), X=v)),
    "ik.q_min": ("q_min", 0.1 + HALF / 100, lambda v: solver(q_min=v)),
    "ik.q_max": ("q_max", 0.3 + HALF / 100, lambda v: solver(q_max=v)),
    "ik.dq_max": ("dq_max", HALF, lambda v: solver(dq_max=v)),
    "ik.ddq_max": ("ddq_max", HALF, lambda v: solver(ddq_max=v)),
    "ik.tip_limits": (
        "tip_limits",
        X[0] - HALF / 1e3,
        lambda v: solver(tip_limits=(np.eye(3), v)),
    ),
    "ik.q_pref": ("q_pref", 0.2 + HALF / 100, lambda v: solver(q_pref=v)),
    "ik.weights": ("weights", HALF, lambda v: solver(weights=v)),
    "ik.solve": ("x_target", X[:3], lambda v: IK.solve(v, max_iter=3).q),
    "ik.solve q0": ("q0", Q[:3], lambda v: IK.solve(X[:3], v, max_iter=3).q),
    "ik.solve pose": (
        "x_target",
        trunk().pose(torch.from_numpy(Q[0])).numpy(),
        lambda v: (
            InverseKinematics(tasks.PoseTask(trunk()), q_min=0.1, q_max=0.4).solve(v, max_iter=3).q
        ),
    ),
    "ik.step q": ("q", Q[:3], lambda v: IK.step(v, X[:3]).dq),
    "ik.step x_target": ("x_target", X[:3], lambda v: IK.step(Q[:3], v).dq),
    "ik.step dx": ("dx", X[:3], lambda v: IK.step(Q[:3], X[:3], v).dq),
    "ik.step x_measured": ("x_measured", X[:3], lambda v: IK.step(Q[:3], X[:3], x_measured=v).dq),
    "ik.body_balls": ("q", Q[:3], lambda v: AMONG.body_balls(v)),
    "ik.body_distances": ("q", Q[:3], lambda v: AMONG.body_distances(v)),
    "ik.track": ("path", X[:3], lambda v: IK.track(v, q0=Q[0]).q),
    "ik.track q0": ("q0", Q[0], lambda v: IK.track(X[:3], q0=v).q),
    "ik.track t": ("t", HALF / 1e3, lambda v: IK.track(X[:3], v, q0=Q[0]).q),
    "tracker": ("q", Q[0], lambda v: tracked(v, X[1])),
    "tracker.step": ("x_target", X[1], lambda v: tracked(Q[0], v)),
    "tracker.step dx": ("dx", X[1], lambda v: tracked(Q[0], X[1], v)),
    "tracker.step x_measured": ("x_measured", X[1], lambda v: tracked(Q[0], X[1], x_measured=v)),
    "trajectory x": ("x", X[:3], lambda v: trajectories.Trajectory(HALF, v).x),
    "figure_eight": ("center", HALF, lambda v: trajectories.figure_eight(v, duration=0.1).x),
    "line": ("start", HALF, lambda v: trajectories.line(v, X[0], duration=0.1).x),
    "log.q": ("q", Q, lambda v: check_log(Log(v, X), chain=trunk()).q_range),
}


LONG = ("calibrate", "hybrid.fit", "elm_cv", "ik.q_", "ik.dq_max", "ik.weights")


LONG += ("ik.solve", "ik.track")


def entries(marks_of):
    """Parametrise over entry points; `marks_of` gives the marks of one by its name."""
    params = [pytest.param(name, marks=marks_of(name)) for name in ARRAYS]
    return pytest.mark.parametrize("entry", params)


@pytest.mark.filterwarnings("ignore:X does not have valid feature names")
@pytest.mark.filterwarnings("ignore:X has feature names")
@entries(lambda name: [pytest.mark.slow] if name.startswith(LONG) else [])
def test_equal_numbers_give_equal_answers(entry):
    _, plain, function = ARRAYS[entry]
    expected = numbers(function(plain))
    for kind, convert in GOOD.items():
        found = numbers(function(convert(plain)))
        assert_allclose(found, expected, rtol=1e-9, atol=1e-12, err_msg=kind)


@entries(lambda name: [])
def test_what_is_no_numbers_is_refused_by_name(entry):
    name, plain, function = ARRAYS[entry]
    for kind, convert in BAD.items():
        with pytest.raises((TypeError, ValueError), match=f"`{name}`"):
            pytest.fail(f"{kind} gave {function(convert(plain))!r}")


HUGE = np.where(np.arange(24)[:, None] == 3, 1e300, X)


ROWS = torch.tensor(Q)


NAN_GROUPS = np.where(GROUPS == 1, np.nan, GROUPS)


META = ROWS.to("meta")


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("q", lambda: trunk().contradictions(META)),
        ("q", lambda: trunk().metres(ROWS[:, :0])),
        ("n_points", lambda: trunk().backbone(ROWS, 2.5)),
        ("n_points", lambda: trunk().backbone(ROWS, 2**63)),
        ("tangents", lambda: trunk().geometry_jacobian(ROWS, {})),
        (r"tangents\['base'\]", lambda: trunk().geometry_jacobian(ROWS, {"base": torch.ones(4)})),
        ("markers", lambda: tendon_chain().with_markers([(0,)])),
        ("state", lambda: Hysteresis.backlash(0.1).apply(Q, np.nan * Q[:3])),
        ("routing", lambda: trunk(routing=["segment"])),
        ("timing", lambda: trajectories.line(X[0], X[1], timing=X)),
        ("duration", lambda: trajectories.line(X[0], X[1], duration=1e300)),
        ("path", lambda: trajectories.from_csv(None)),
        ("path", lambda: trajectories.from_csv("nowhere.csv")),
        ("path", lambda: load_model(None)),
        ("path", lambda: save_model(trunk(), 3)),
        ("training", lambda: save_model(trunk(), "model", training=np.nan)),
        ("groups", lambda: Log(Q, X, GROUPS[:3])),
        ("groups", lambda: Log(Q, X, torch.tensor(GROUPS).to("meta"))),
        ("groups", lambda: Log(Q, X, np.where(GROUPS == 1, np.inf, GROUPS))),
        ("q", lambda: Hysteresis.backlash(0.1).apply_by_group(Q[:, :0], GROUPS)),
        ("stage", lambda: trunk(stage=Q)),
        ("actuators_per_segment", lambda: plots.ActuatorDisplay({"a": Q}, None)),
        ("names", lambda: plots.ActuatorDisplay({"a": Q}, [3], names=True)),
        ("actuators", lambda: plots.BackboneDisplay(X[None], actuators=None)),
        ("t", lambda: plots.TrackAnimation(X, t=np.where(np.arange(24) < 2, np.inf, 0.0))),
        ("loss", lambda: choose_geometry(trunk(), Q, X, loss=None)),
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
        ("touched", lambda: calibrate(trunk(), Q, None, ("radii",), touched=Q)),
        ("touched", lambda: calibrate(trunk(), Q, X, ("radii",), touched=META[:, 0])),
        ("distances", lambda: calibrate(trunk(), Q, X, ("radii",), distances={(0, 1): 0.1})),
        ("distance_std", lambda: calibrate(trunk(), Q, X, ("radii",), distance_std=np.nan)),
        ("groups", lambda: choose_geometry(trunk(), Q, X, groups=GROUPS[:3])),
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
    state = Q[:3, ::-1].copy()[:, ::-1]
    found, _ = Hysteresis.backlash(0.1).apply(ROWS, state)
    torch.testing.assert_close(found, torch.tensor(Hysteresis.backlash(0.1).apply(Q, state)[0]))


@pytest.mark.parametrize("size", [1e300, 5e-324])
def test_a_normal_of_any_size_gives_the_plane(size):
    circle = {"radius": 0.1, "duration": 0.2, "dt": 0.1}
    found = trajectories.spiral(X[0], normal=[0.0, size, 0.0], **circle)
    np.testing.assert_array_equal(found.x, trajectories.spiral(X[0], normal=[0, 1, 0], **circle).x)
