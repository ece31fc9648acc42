"""The stack that the compiled core and exported code take: threads may have 128 KiB."""

import sys
import threading

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from painted import CC, LIMIT, painted, stacks
from saved_models import structural_chain

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    HybridForwardModel,
    InverseKinematics,
    RigidChain,
    as_forward_model,
    obstacles,
)
from hybridkin._core.plan import MOST, Plan
from hybridkin.ik._compiled import own_core_of
from hybridkin.ik.tasks import PointsTask, PoseTask
from hybridkin.native import library
from hybridkin.native.library import program_of

SEGMENTS, ACTUATORS = MOST["segments"], MOST["actuators"]
needs_cc = pytest.mark.skipif(CC is None, reason="needs a C compiler")


def arcs():
    return ConstantCurvatureChain([0.02] * SEGMENTS, n_actuators=ACTUATORS // SEGMENTS)


def elastic(segments=SEGMENTS):
    """Return a chain of tendons, by default of as many as there can be."""
    counts = [4] * (segments - 2) + [3, 3]
    return ElasticTendonChain([0.02] * segments, [0.1] * segments, n_actuators=counts)


def arm():
    """Return an arm of as many joints as kernels support."""
    origins = np.stack([np.eye(4)] * ACTUATORS)
    origins[:, 0, 3] = 0.1
    axes = np.tile([[0, 0, 1], [0, 1, 0]], (ACTUATORS // 2, 1))
    kinds = ["revolute"] * ACTUATORS
    return RigidChain(origins, axes, kinds=kinds, names=[f"joint_{k}" for k in range(ACTUATORS)])


CHAINS = {"arcs": arcs, "elastic": elastic, "arm": arm}


def rows(n, count, width=0.01):
    return np.random.default_rng(0).uniform(-width, width, (count, n))


def hybrid(chain, error_model, **options):
    q = rows(chain.n_actuators, 200)
    x = program_of(chain).evaluate(q)[0] + 0.01 * np.sin(100.0 * q[:, :3])
    return as_forward_model(
        HybridForwardModel(chain, error_model, random_state=0, **options).fit(q, x)
    )


def largest(kind):
    """Return a model of the largest sizes, and rows inside and far outside of its domain."""
    wide = ELMRegressor(MOST["features"] - ACTUATORS, direct_link=True, random_state=0)
    if kind == "regressor":
        q = rows(ACTUATORS, 200)
        model = as_forward_model(wide.fit(q, np.sin(100.0 * q)))
    elif kind in CHAINS:
        model = CHAINS[kind]()
    elif kind == "structural":
        model = structural_chain(elastic(), size=1e-3)
    elif kind == "inside":
        model = hybrid(elastic(4), "pose", coupling="serial")  # a larger one takes minutes to fit
    else:
        model = hybrid(elastic(), wide)
    q = rows(model.n_actuators, 19)
    q[3::4] *= 5.0
    q[5] = np.nan
    return model, q


KINDS = (*CHAINS, "structural", "regressor", "inside", "tip")


def write_plan(path, plan, q):
    head = np.array([len(plan.code), len(plan.data), plan.root, len(q)], dtype=np.int32)
    path.write_bytes(b"".join(a.tobytes() for a in (head, plan.code, plan.data, q)))


@needs_cc
@pytest.mark.slow
@pytest.mark.needs_core
@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX: threads")
@pytest.mark.parametrize("kind", KINDS)
def test_functions_of_the_library_take_little_stack(tmp_path, kind):
    model, q = largest(kind)
    plans = [Plan(model.stored())]
    if kind != "regressor":
        options = {"q_min": -0.02, "q_max": 0.02, "ddq_max": 10.0, "dq_max": 1.0}
        tasks = [PoseTask(model)] if kind in CHAINS else [model]
        if kind in ("arcs", "elastic"):
            tasks.append(PointsTask(model, np.linspace(1.0, SEGMENTS, MOST["rows of a task"] // 3)))
        plans += [own_core_of(InverseKinematics(task, **options).settings).plan for task in tasks]
        spaces = np.random.default_rng(0).standard_normal((ACTUATORS, 3)), np.ones(ACTUATORS)
        ik = InverseKinematics(model, **options, weights=2.0, tip_limits=spaces)
        plans.append(own_core_of(ik.settings).plan)
    if kind in ("arcs", "elastic"):
        balls = [obstacles.Sphere([0.1 * k, 0.0, 1.0], 0.01) for k in range(4)]
        points = [(0.5 + k, 0.01) for k in range(SEGMENTS - 1)] + [(float(SEGMENTS), 0.01)]
        among = {"obstacles": balls, "body_points": points, "tip_limits": spaces}
        plans.append(own_core_of(InverseKinematics(model, **options, **among).settings).plan)
    program = painted(tmp_path)
    for plan in plans:
        write_plan(tmp_path / "plan", plan, q)
        found = stacks(program, library.library()._name, tmp_path / "plan")
        assert found
        assert 0 < max(found.values()) <= LIMIT, found


@pytest.mark.needs_core
def test_a_thread_of_128_kib_computes():
    chain = elastic()
    q = rows(chain.n_actuators, 9)
    program, core = program_of(chain), own_core_of(InverseKinematics(chain, q_max=0.02).settings)
    expected = program.evaluate(q, True, True)
    x = torch.from_numpy(expected[0])
    found = []

    def work():
        found.append(program.evaluate(q, True, True))
        found.append(program.evaluate(q[0], True, True))
        found.append(program.domain(q, slope=True))
        found.append(core.steps(torch.from_numpy(q), x, None, None, None))
        start = torch.from_numpy(q[::-1].copy())
        found.append(core.find(1, start, x, 1e-9, 20))

    before = threading.stack_size(128 * 1024)
    try:
        thread = threading.Thread(target=work)
        thread.start()
    finally:
        threading.stack_size(before)
    thread.join()
    assert len(found) == 5
    for array, right in zip(found[0], expected, strict=True):
        assert_array_equal(array, right)
