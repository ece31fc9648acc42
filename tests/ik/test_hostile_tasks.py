"""Tasks of one's own, lists of tasks, and modules in another precision, in inverse kinematics."""

import copy

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import HybridForwardModel, InverseKinematics, as_forward_model, jacobian, robots
from hybridkin.ik.results import IKStatus
from hybridkin.ik.tasks import PointsTask, PoseTask, PositionTask, Task

TRUNK = robots.bionic_handling_assistant()
LIMITS = {"q_min": 0.1, "q_max": 0.4}


class Rows(Task):
    """Any linear functions of the tip: heights, differences of coordinates."""

    def __init__(self, matrix):
        self.matrix = torch.as_tensor(matrix, dtype=torch.float64)
        m = len(self.matrix)
        self.shape, self.parts, self.units = (m,), (m,), (1.0,)
        self.models = (TRUNK,)

    def evaluate(self, q):
        x, J = self.models[0].forward_and_jacobian(q)
        return x @ self.matrix.T, self.matrix @ J

    def difference(self, x, x_target):
        return x_target - x


class Grid(Rows):
    """The same with targets of another shape (m, 1)."""

    def __init__(self, matrix):
        super().__init__(matrix)
        self.shape = (len(self.matrix), 1)

    def evaluate(self, q):
        x, J = super().evaluate(q)
        return x[..., None], J

    def difference(self, x, x_target):
        return (x_target - x)[..., 0]


@pytest.mark.parametrize("kind", [Rows, Grid])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("m", [1, 2, 3])
def test_a_task_of_its_own_needs_what_its_docstring_says(m, seed, kind):
    rng = np.random.default_rng(10 * m + seed)
    task = kind(10.0 * rng.standard_normal((m, 3)))  # up to 10 m from a tip that reaches 1 m
    q = rng.uniform(0.2, 0.3, (2, 9))
    with torch.no_grad():
        targets = task.evaluate(torch.from_numpy(q))[0].numpy()
    ik = InverseKinematics(task, **LIMITS)
    solution = ik.solve(targets)
    assert (solution.status == IKStatus.CONVERGED).all()
    track = ik.track(np.linspace(*targets, 20), q0=q[0])
    assert track.error.max() < 0.1
    tracker = InverseKinematics(task, beta=0.0, **LIMITS).tracker(q[0])
    for _ in range(10):
        tracker.step(targets[1])
    assert tracker.error < 1e-9


def test_a_target_that_no_configuration_reaches_is_still_proven():
    far = np.array([[0.0, 0.0, 9.0]])
    pose = np.eye(4)[None].copy()
    pose[:, :3, 3] = far
    for task, target in (
        (PositionTask(TRUNK), far),
        (PoseTask(TRUNK), pose),
        (PointsTask(TRUNK, [2.0, 3.0]), np.stack([far, far], axis=1)),
    ):
        ik = InverseKinematics(task, **LIMITS)
        assert (ik.settings.misses(torch.from_numpy(target)) > 0.5).all()
        assert ik.solve(target).status == IKStatus.UNREACHABLE


@pytest.mark.parametrize("several", [list, tuple])
def test_several_tasks_are_refused_with_the_ways_to_do_it(several):
    tasks = several([PositionTask(TRUNK), PoseTask(TRUNK)])
    with pytest.raises(TypeError, match=r"`model` must be one task, got 2 of them; .*PointsTask"):
        InverseKinematics(tasks)


def log(dtype=np.float64):
    q = np.random.default_rng(0).uniform(0.2, 0.3, (40, 9))
    with torch.no_grad():
        x = TRUNK(torch.from_numpy(q)).numpy()
    return q.astype(dtype), x.astype(dtype)


def linear(dtype):
    torch.manual_seed(0)
    return torch.nn.Linear(9, 3).to(dtype)


@pytest.mark.parametrize("of_module", [torch.float32, torch.float64, torch.float16])
@pytest.mark.parametrize("of_rows", [np.float32, np.float64])
def test_a_module_computes_in_its_precision_whatever_that_of_the_rows(of_module, of_rows):
    module = linear(of_module)
    q, x = log(of_rows)
    model = HybridForwardModel(module, "linear").fit(q, x)
    exact = HybridForwardModel(copy.deepcopy(module).double(), "linear").fit(q, x)
    assert model.predict(q).dtype == of_rows
    rounding = 10.0 * max(torch.finfo(of_module).eps, np.finfo(of_rows).eps)
    np.testing.assert_allclose(model.predict(q), exact.predict(q), rtol=0.0, atol=rounding)
    rows = torch.from_numpy(q)
    found, J = as_forward_model(module).forward_and_jacobian(rows)
    assert found.dtype == J.dtype == rows.dtype
    close = {"rtol": 4.0 * torch.finfo(of_module).eps, "atol": 4.0 * torch.finfo(of_module).eps}
    assert_close(J, module.weight.detach().to(J).expand_as(J), **close)
    assert_close(jacobian(module, rows), J)
    if of_module != torch.float16:  # too coarse to converge
        solution = InverseKinematics(module, q_min=-9.0, q_max=9.0, q_pref=[0.2] * 9).solve(
            found[:2]
        )
        assert (solution.status == IKStatus.CONVERGED).all()


def test_a_fitted_module_knows_how_many_actuators_there_are():
    q, x = log()
    for mechanical in (TRUNK, linear(torch.float64), None):
        if mechanical is None:
            from sklearn.linear_model import LinearRegression

            model = HybridForwardModel(None, LinearRegression())
        else:
            model = HybridForwardModel(mechanical, "linear")
        model.fit(q, x)
        for form in (model, model.module_):
            ik = InverseKinematics(form, **LIMITS)
            assert ik.settings.n_actuators == 9
            assert ik.solve(x[0]).q.shape == (9,)
