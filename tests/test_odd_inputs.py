"""Every entry point, given what users hand over: the right answer, or an error of ours."""

import copy
import functools

import numpy as np
import pandas as pd
import pytest
import torch
from numpy.testing import assert_allclose
from saved_models import arm, elastic_chain, tendon_chain, trunk, trunk_log
from scipy import sparse
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
    InverseKinematics,
    PlayOperator,
    PlayState,
    RigidChain,
    calibrate,
    choose_rows,
    fit_play,
    jacobian,
    load_model,
    plots,
    save_model,
    tasks,
    trajectories,
)
from hybridkin.calibration.choice import choose_geometry
from hybridkin.datasets import Log, check_log, paper_split
from hybridkin.plots import ErrorHistogramDisplay, TrackingDisplay
from hybridkin.workflow import FitSettings

Q, X, GROUPS = trunk_log(24)
SLACK = np.linspace(-0.002, 0.002, 21).reshape(3, 7)
JOINTS = np.linspace(-1.0, 1.0, 9).reshape(3, 3)
FITTED = HybridForwardModel(trunk(), ELMRegressor(4, random_state=0)).fit(Q, X)
NETWORK = ELMRegressor(4, random_state=0).fit(Q, X)
IK = InverseKinematics(trunk(), q_min=0.1, q_max=0.4, dq_max=0.05)
POSES = np.tile(np.eye(4), (2, 1, 1))
POSES[:, 0, 3] = 0.2, 0.1


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
# The answer must be that of the rounded numbers, or an error.
ROUNDED = {
    "float32": lambda a: a.astype(np.float32),
    "float16": lambda a: a.astype(np.float16),
    "half tensor": lambda a: torch.tensor(a).half(),
    "bfloat16": lambda a: torch.tensor(a).bfloat16(),
    "single tensor": lambda a: torch.tensor(a).float(),
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


def of_chain(chain, method):
    return lambda q: getattr(chain, method)(q)


def geometry(cls, name, *args, **given):
    return lambda value: [*cls(*args, **given, **{name: value}).geometry().values()]


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
PLAY = {"groups": np.arange(8) // 4, "widths": [0.001], "parameters": ("radii",)}
PLAY |= {"q": Q[:8], "x": X[:8]}
# name of the argument, numbers, entry point.
TENSORS = {
    **{
        f"{label}.{method}": ("q", rows, of_chain(chain, method))
        for label, chain, rows, methods in (
            ("trunk", trunk(), Q[:3], "__call__ poses arcs backbone consistency contradictory"),
            ("elastic", elastic_chain(), SLACK, "__call__ jacobian pose_jacobian tensions slack"),
            ("arm", arm(), JOINTS, "__call__ forward_and_jacobian poses pose backbone"),
        )
        for method in methods.split()
    },
    "jacobian": ("q", Q[:3], functools.partial(jacobian, trunk())),
    "network": ("q", Q[:3], NETWORK.module_),
    "hybrid": ("q", Q[:3], FITTED.module_),
    "hybrid.jacobian": ("q", Q[:3], FITTED.module_.jacobian),
    "hybrid.in_domain": ("q", Q[:3], FITTED.module_.in_domain),
}
ARRAYS = {
    "radii": ("radii", HALF / 10, geometry(ConstantCurvatureChain, "radii")),
    "angles": (
        "angles",
        np.array([0.0, 2.0, 4.0]),
        geometry(ConstantCurvatureChain, "angles", [0.1, 0.1]),
    ),
    "angles by segment": (
        "angles",
        np.array([[0.0, 2.0, 4.0], [0.5, 2.5, 4.5]]),
        geometry(ConstantCurvatureChain, "angles", [0.1, 0.1]),
    ),
    "offsets": ("offsets", HALF, geometry(ConstantCurvatureChain, "offsets", [0.1] * 3)),
    "zeros": (
        "actuator_zeros",
        HALF / 100,
        geometry(ConstantCurvatureChain, "actuator_zeros", [0.1]),
    ),
    "rest_bends": (
        "rest_bends",
        np.array([[0.1, 0.2], [0.2, 0.3]]),
        geometry(ConstantCurvatureChain, "rest_bends", [0.1] * 2),
    ),
    "base": ("base", POSES[0], geometry(ConstantCurvatureChain, "base", [0.1])),
    "lengths": ("lengths", HALF, geometry(ElasticTendonChain, "lengths", [0.1] * 3)),
    "stiffness": (
        "bending_stiffness",
        HALF,
        geometry(ElasticTendonChain, "bending_stiffness", [0.1] * 3, [0.2] * 3),
    ),
    "origins": ("origins", POSES, geometry(RigidChain, "origins", axes=[[0, 0, 1]] * 2)),
    "axes": ("axes", POSES[:, :3, 2], geometry(RigidChain, "axes", POSES)),
    "arm.q_min": ("q_min", -HALF[:2], geometry(RigidChain, "q_min", POSES, [[0, 0, 1.0]] * 2)),
    "calibrate.q": ("q", Q, lambda v: radii(q=v)),
    "calibrate.x": ("x", X, lambda v: radii(x=v)),
    "calibrate.weights": ("sample_weight", WEIGHTS, lambda v: radii(sample_weight=v)),
    "choose": ("candidates", Q, lambda v: choose_rows(trunk(), v, 3)[1]),
    "choose.measured": ("measured", Q, lambda v: choose_rows(trunk(), Q, 3, measured=v)[1]),
    "choose.target": ("target", Q, lambda v: choose_rows(trunk(), Q, 3, target=v)[1]),
    "play.q": ("q", Q[:8], lambda v: fit_play(trunk(), **{**PLAY, "q": v}).cv_rmse),
    "play.x": ("x", X[:8], lambda v: fit_play(trunk(), **{**PLAY, "x": v}).cv_rmse),
    "play.width": ("width", HALF / 1e3, lambda v: PlayOperator(v).apply(Q)[0]),
    "play.apply": ("q", Q, lambda v: PlayOperator(0.01).apply(v)[0]),
    "play.command": ("y", Q, lambda v: PlayOperator(0.01).command(v)[0]),
    "play.apply_by_group": ("q", Q, lambda v: PlayOperator(0.01).apply_by_group(v, GROUPS)),
    "hybrid.fit X": ("X", Q, lambda v: fitted(LINEAR, X=v)),
    "hybrid.fit y": ("y", X, lambda v: fitted(LINEAR, y=v)),
    "hybrid.fit weights": ("sample_weight", WEIGHTS, lambda v: fitted(LINEAR, sample_weight=v)),
    "hybrid.partial_fit X": ("X", Q[:4], lambda v: followed(X=v)),
    "hybrid.partial_fit y": ("y", X[:4], lambda v: followed(y=v)),
    "hybrid.predict": ("X", Q, FITTED.predict),
    "hybrid.jacobian of rows": ("X", Q, FITTED.jacobian),
    "elm.fit X": ("X", Q, lambda v: fitted(NETWORK, X=v)),
    "elm.fit y": ("y", X, lambda v: fitted(NETWORK, y=v)),
    "elm.fit weights": ("sample_weight", WEIGHTS, lambda v: fitted(NETWORK, sample_weight=v)),
    "elm.predict": ("X", Q, NETWORK.predict),
    "elm.leverage": ("X", Q, NETWORK.leverage),
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
    "ik.step dq": ("dq", Q[:3] / 1e3, lambda v: IK.step(Q[:3], X[:3], dq=v).dq),
    "ik.step x_measured": ("x_measured", X[:3], lambda v: IK.step(Q[:3], X[:3], x_measured=v).dq),
    "ik.track": ("path", X[:3], lambda v: IK.track(v, q0=Q[0]).q),
    "ik.track q0": ("q0", Q[0], lambda v: IK.track(X[:3], q0=v).q),
    "ik.track t": ("t", HALF / 1e3, lambda v: IK.track(X[:3], v, q0=Q[0]).q),
    "tracker": ("q", Q[0], lambda v: tracked(v, X[1])),
    "tracker.step": ("x_target", X[1], lambda v: tracked(Q[0], v)),
    "tracker.step dx": ("dx", X[1], lambda v: tracked(Q[0], X[1], v)),
    "tracker.step x_measured": ("x_measured", X[1], lambda v: tracked(Q[0], X[1], x_measured=v)),
    "trajectory t": ("t", HALF, lambda v: trajectories.Trajectory(v, X[:3]).t),
    "trajectory x": ("x", X[:3], lambda v: trajectories.Trajectory(HALF, v).x),
    "figure_eight": ("center", HALF, lambda v: trajectories.figure_eight(v, duration=0.1).x),
    "line": ("start", HALF, lambda v: trajectories.line(v, X[0], duration=0.1).x),
    "min_jerk": ("s", HALF / 4, trajectories.min_jerk),
    "log.q": ("q", Q, lambda v: check_log(Log(v, X), chain=trunk()).q_range),
    "log.x": ("x", X, lambda v: check_log(Log(Q, v), chain=trunk()).x_range),
    "plots.x": ("x", X, lambda v: ErrorHistogramDisplay.from_predictions(v, {"a": Q}).errors["a"]),
    "plots.errors": ("errors", X[:, 0], lambda v: ErrorHistogramDisplay({"a": v}).errors["a"]),
    "plots.target": ("target", X, lambda v: TrackingDisplay(v, {"a": X}).target),
}
TORCH = ("gradient", "tensor", "expanded", "transposed")


# What cannot be said of an entry, or is right there.
NEVER = {
    ("offsets", "ragged"),
    ("stiffness", "ragged"),
    ("zeros", "ragged"),  # one list per segment
    ("ik.solve pose", "bfloat16"),  # no rotation
    *(("origins", kind) for kind in ("matrix of pandas", "nullable", "read-only pandas", "sparse")),
}
# What takes its time: of these a few kinds every time, all of them where time does not count.
LONG = ("calibrate", "play.q", "play.x", "hybrid.fit", "elm_cv", "ik.q_", "ik.dq_max", "ik.weights")
LONG += ("ik.solve", "ik.track")


def entries(table, slow=False):
    """Parametrise over entry points; `slow` marks those that take their time."""
    marks = [pytest.mark.slow] if slow else []
    return pytest.mark.parametrize(
        "entry",
        [pytest.param(name, marks=marks if name.startswith(LONG) else []) for name in table],
    )


def given_to(entry, kinds):
    """Yield every kind, and the numbers of an entry point as such."""
    for kind, convert in kinds.items():
        if (entry, kind) not in NEVER:
            yield kind, convert((ARRAYS | TENSORS)[entry][1])


def check_good(entry, kinds):
    _, plain, function = ARRAYS[entry]
    expected = numbers(function(plain))
    for kind, given in given_to(entry, kinds):
        found = numbers(function(given))
        assert_allclose(found, expected, rtol=1e-9, atol=1e-12, err_msg=kind)


def check_rounded(entry, kinds):
    _, _, function = ARRAYS[entry]
    for kind, given in given_to(entry, kinds):
        values = given.double().numpy() if isinstance(given, torch.Tensor) else given.astype(float)
        # float32 is computed in float32.
        tol = 1e-9 if given.dtype not in (np.float32, torch.float32) else 2e-4
        found, expected = numbers(function(given)), numbers(function(values))
        assert_allclose(found, expected, rtol=tol, atol=tol, err_msg=kind)


@pytest.mark.filterwarnings("ignore:X does not have valid feature names")
@pytest.mark.filterwarnings("ignore:X has feature names")
@entries(ARRAYS, slow=True)
def test_equal_numbers_give_equal_answers(entry):
    check_good(entry, GOOD)


@entries(ARRAYS, slow=True)
def test_rounded_numbers_give_their_answer(entry):
    check_rounded(entry, ROUNDED)


@entries(ARRAYS | TENSORS)
def test_what_is_no_numbers_is_refused_by_name(entry):
    name, _, function = (ARRAYS | TENSORS)[entry]
    for kind, given in given_to(entry, BAD):
        with pytest.raises((TypeError, ValueError), match=f"`{name}`"):
            pytest.fail(f"{kind} gave {function(given)!r}")


@entries(TENSORS)
def test_modules_take_tensors(entry):
    name, plain, function = TENSORS[entry]
    expected = numbers(function(torch.tensor(plain)))
    for kind, given in given_to(entry, GOOD):
        if kind in TORCH:
            found = numbers(function(given))
            assert_allclose(found, expected, rtol=1e-9, atol=1e-12, err_msg=kind)
            continue
        with pytest.raises(TypeError, match=f"`{name}` must be a torch tensor"):
            function(given)


@entries(TENSORS)
def test_modules_refuse_half_precision(entry):
    _, plain, function = TENSORS[entry]
    for dtype in (torch.float16, torch.bfloat16, torch.int64):
        with pytest.raises(TypeError, match="`q` must be a dense floating tensor, float64 or"):
            function(torch.tensor(plain).to(dtype))


@pytest.mark.parametrize("dtype", ["float16", torch.bfloat16, "double-ish", None, 3, complex])
@pytest.mark.parametrize("build", [trunk, elastic_chain, arm])
def test_other_dtypes_are_refused(build, dtype):
    with pytest.raises(ValueError, match="`dtype` must be"):
        build(dtype=dtype)


def test_one_row_read_backwards():
    q, x = Q[:1][::-1], X[:1][::-1]
    model = ELMRegressor(4, random_state=0).fit(q, x)
    assert_allclose(model.output_weights_, copy.deepcopy(model).fit(Q[:1], X[:1]).output_weights_)
    assert_allclose(NETWORK.leverage(q), NETWORK.leverage(Q[:1]))
    assert_allclose(IK.step(q, x).dq, IK.step(Q[:1], X[:1]).dq)
    assert_allclose(IK.solve(x, q).q, IK.solve(X[:1], Q[:1]).q)


# Arguments that once gave an error of torch or NumPy, a bare warning, or a wrong answer.

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
    found = trajectories.spiral(X[0], normal=[0.0, size, 0.0], **circle)
    np.testing.assert_array_equal(found.x, trajectories.spiral(X[0], normal=[0, 1, 0], **circle).x)


def test_errors_beyond_the_root_of_the_largest_number_are_drawn():
    found = plots.ErrorHistogramDisplay.from_predictions(X, {"a": HUGE}).errors["a"]
    assert found[3] == pytest.approx(np.sqrt(3) * 1e300)
