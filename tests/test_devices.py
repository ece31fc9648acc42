"""Models and data on the CPU, whatever device and precision torch takes for new tensors."""

import ast
import pickle
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from saved_models import arm, bent_chain, elastic_chain, predictions, trunk, trunk_log

import hybridkin
from hybridkin import (
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
    Hysteresis,
    InverseKinematics,
    calibrate,
    load_model,
    save_model,
    tasks,
)

Q, X, GROUPS = trunk_log(40)
TENDONS = 0.002 * np.random.default_rng(1).uniform(-1, 1, (3, 7))
JOINTS = np.linspace(-1.0, 1.0, 9).reshape(3, 3)
CREATORS = "tensor as_tensor asarray zeros ones full empty eye arange linspace logspace rand randn "
CREATORS += "randint randperm scalar_tensor tril_indices triu_indices Generator"


FOREIGN = (("meta", torch.float32), ("cpu", torch.float64))  # "meta" holds no data


@contextmanager
def defaults(device, dtype):
    """Let torch put new tensors on a device, in a precision."""
    torch.set_default_device(device)
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(torch.float32)


def of_chain(build, q):
    chain, rows = build(), torch.from_numpy(q)
    x, J = chain.forward_and_jacobian(rows)
    poses, pose_jacobian = chain.poses(rows), chain.pose_jacobian(rows)
    parts = [x, J, poses, pose_jacobian, chain.pose(rows), chain.backbone(rows)]
    parts += [chain.tip_transform(rows).get_matrix(), chain.in_domain(rows).double()]
    parts.append(chain.geometry_jacobian(rows, {"base": torch.from_numpy(np.ones((2, 4, 4)))}))
    return [part.detach().numpy() for part in parts]


def inverse(build, q):
    chain = build()
    x = chain(torch.from_numpy(q)).numpy()
    box = {"q_min": q.min(0) - 1e-3, "q_max": q.max(0) + 1e-3}
    ik = InverseKinematics(chain, **box, dq_max=0.1, ddq_max=10.0)
    path = np.linspace(x[0], x[1], 3)
    tracker = ik.tracker(q[0])
    tracker.step(x[1], np.zeros(3), x_measured=x[0])
    target = torch.from_numpy(x).requires_grad_()
    pose = InverseKinematics(tasks.PoseTask(chain), **box)
    measured = ik.track(path, plant=lambda q: q[:3] * np.nan, feedback="measured", memory=0.1)
    return [
        ik.solve(x, restarts=2, max_iter=5).q,
        ik.solve(x[:1] + 10.0, max_iter=5).status,
        ik.solve(target, differentiable=True, max_iter=5).q.detach().numpy(),
        ik.step(q, x + 1e-3, dx=0 * x, x_measured=x).dq,
        ik.track(path).q,
        InverseKinematics(chain, **box, tip_limits=([[0.0, 0.0, 1.0]], x[:1, 2])).track(path).q,
        measured.q,
        tracker.q,
        pose.solve(chain.pose(torch.from_numpy(q)).numpy(), max_iter=3).q,
    ]


def calibrated(*parameters, **options):
    rows = (torch.from_numpy(Q), torch.from_numpy(X)) if options.pop("tensors", 0) else (Q, X)
    result = calibrate(trunk(), *rows, parameters, **options)
    return [np.asarray(value) for value in (*result.values.values(), *result.std_errors.values())]


def hybrid(**settings):
    model = HybridForwardModel(trunk(), **{"random_state": 0, **settings})
    y = np.hstack([X, 5 * (Q - 0.25)]) if settings.get("output") == "pose" else X
    model.fit(Q, y, groups=GROUPS)
    found = [model.predict(Q), model.jacobian(Q), model.in_domain(Q)]
    return [*found, model.partial_fit(Q[:3], y[:3]).predict(Q)]


def saved(folder):
    found = []
    for name, chain, q in (("arc", bent_chain(), TENDONS), ("arm", arm(), JOINTS)):
        save_model(chain, folder / name)
        found += [*predictions(load_model(folder / name), q).values()]
    model = HybridForwardModel(trunk(), "linear", calibrate=("radii",)).fit(Q, X)
    save_model(model, folder / "hybrid")
    for twin in (load_model(folder / "hybrid"), pickle.loads(pickle.dumps(model))):
        found += [*predictions(twin, Q).values()]
    return found


NETWORK = ELMRegressor(4, random_state=0)
WORK = {
    "arc chain": lambda _: of_chain(bent_chain, TENDONS),
    "elastic chain": lambda _: of_chain(elastic_chain, TENDONS),
    "arm": lambda _: of_chain(arm, JOINTS),
    "inverse of a trunk": lambda _: inverse(trunk, Q[:3]),
    "inverse of an arm": lambda _: inverse(arm, JOINTS),
    "calibrate": lambda _: calibrated("radii", groups=GROUPS),
    "calibrate tensors": lambda _: calibrated("radii", "base", tensors=1),
    "hysteresis": lambda _: [
        Hysteresis.backlash(0.01).apply(Q)[0],
        *hybrid(error_model="drop", hysteresis="auto"),
    ],
    "elm": lambda _: [*NETWORK.fit(Q, X).partial_fit(Q, X).predict(Q, return_std=True)],
    "parallel elm": lambda _: hybrid(error_model=NETWORK, coverage=0.8),
    "parallel linear": lambda _: hybrid(error_model="linear", hysteresis=0.01),
    "serial quadratic": lambda _: hybrid(error_model="quadratic", coupling="serial"),
    "pose output": lambda _: hybrid(error_model=NETWORK, output="pose"),
    "chosen": lambda _: hybrid(error_model=ELMRegressorCV(8, cv=3, random_state=0)),
    "save": saved,
}
SLOW = {
    "hysteresis",
    "parallel elm",
    "pose output",
    "chosen",
    "save",
}
SLOW |= {"inverse of a trunk", "inverse of an arm", "calibrate", "calibrate tensors"}
SLOW |= {"serial quadratic", "parallel linear", "arm", "arc chain"}


@pytest.mark.parametrize(
    "work", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in WORK]
)
def test_nothing_follows_the_default_device_or_precision(work, tmp_path):
    expected = WORK[work](tmp_path)
    for device, dtype in FOREIGN:
        with defaults(device, dtype):
            answer = WORK[work](tmp_path)
        for found, wanted in zip(answer, expected, strict=True):
            assert found.dtype == wanted.dtype
            assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_tensors_of_the_package_name_their_device():
    for path in Path(hybridkin.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                of_torch = isinstance(node.func.value, ast.Name) and node.func.value.id == "torch"
                if of_torch and node.func.attr in CREATORS.split():
                    assert "device" in {keyword.arg for keyword in node.keywords}, (
                        f"{path}:{node.lineno}: torch.{node.func.attr} without device="
                    )


def test_a_chain_is_built_on_the_cpu_from_tensors_of_any_device():
    with pytest.raises(ValueError, match="`radii` must be a dense tensor that holds real numbers"):
        hybridkin.ConstantCurvatureChain(torch.ones(2, device="meta"))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_chain_from_tensors_of_the_gpu_computes_the_same_on_both():
    chain = hybridkin.ConstantCurvatureChain(torch.ones(2, device="cuda") / 10)
    assert chain.base.device.type == "cpu"
    q = torch.from_numpy(Q[:, :6])
    x = chain(q)
    assert_allclose(chain.cuda()(q.cuda()).cpu(), x, rtol=1e-12, atol=1e-15)
