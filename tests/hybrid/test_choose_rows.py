"""Rows to measure next, against explicit inverses and enumeration."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from saved_models import arm, elastic_chain, tendon_chain

from hybridkin import ConstantCurvatureChain, HybridForwardModel, as_forward_model, choose_rows
from hybridkin._core.rotations import rotation
from hybridkin.hybrid.choose_rows import _StructuralErrors, _TipErrors


def trunk(size=1.0):
    return ConstantCurvatureChain(size * np.array([0.1, 0.08]))


def lengths(n, seed=0, size=1.0):
    return size * np.random.default_rng(seed).uniform(0.2, 0.3, (n, 6))


def square(q):
    """A planar model, in plain torch."""
    return torch.stack([q[..., 0] ** 2 + q[..., 1], q[..., 0] * q[..., 1]], dim=-1)


def explicit(robot, q, measured, target, times=1.0):
    """The mean squared error over the target from the inverse of the whole information matrix.

    Of all parameters, by which rows are chosen, or with `reported` of those that are reported.
    `times` multiplies the variance of the rows that are chosen.
    """
    q, measured, target = map(torch.from_numpy, (q, measured, target))
    with torch.no_grad():
        rows = torch.cat([q, measured, target])
        if isinstance(robot, ConstantCurvatureChain):
            errors = _StructuralErrors(robot, robot, rows)
        else:
            errors = _TipErrors(robot, rows)
        information = torch.eye(errors.design(q).shape[2], dtype=q.dtype)

        def of(rows, times=1.0):
            A, R = errors.design(rows), times * errors.noise(rows)
            return (A.mT @ torch.linalg.solve(R, A)).sum(0)

        def after(rows, reported=False):
            S = torch.linalg.inv(information + of(measured) + of(q[rows], times))
            A = errors.design(target)
            if reported and isinstance(errors, _StructuralErrors):
                A = A[..., : len(errors.structure.names)]
            S = S[: A.shape[2], : A.shape[2]]
            spread = [torch.trace(part @ S @ part.mT) for part in A]
            return float(torch.stack(spread).mean())

    return after


@pytest.mark.parametrize("robot", [trunk(), as_forward_model(square)], ids=["chain", "function"])
def test_every_row_is_the_best_by_enumeration(robot):
    rng, n = np.random.default_rng(1), robot.n_actuators or 2
    q, measured, target = (rng.uniform(0.2, 0.3, (k, n)) for k in (9, 4, 5))
    after = explicit(robot, q, measured, target)
    rows, error = choose_rows(robot, q, 4, measured=measured, target=target)
    for k, row in enumerate(rows):
        before = rows[:k].tolist()
        others = {i: after([*before, i]) for i in range(9) if i not in before}
        assert row == min(others, key=others.get)
        assert_allclose(error[k], after([*before, row], reported=True) ** 0.5, rtol=1e-9)


def test_every_motion_is_the_best_by_enumeration():
    q, names = lengths(48), np.repeat([*"abcdef"], 8)
    after = explicit(trunk(), q, q[:0], q, times=4.0)  # 8 rows of a motion are worth 2
    chosen, error = choose_rows(trunk(), q, 3, groups=names)
    for k, name in enumerate(chosen):
        before = [*chosen[:k]]
        left = {
            other: after(np.flatnonzero(np.isin(names, [*before, other])))
            for other in {*names} - {*before}
        }
        assert name == min(left, key=left.get)
        chosen_rows = np.flatnonzero(np.isin(names, [*before, name]))
        assert_allclose(error[k], after(chosen_rows, reported=True) ** 0.5, rtol=1e-9)
    mixed = np.random.default_rng(4).permutation(48)
    assert_array_equal(choose_rows(trunk(), q[mixed], 3, groups=names[mixed])[0], chosen)


@pytest.mark.parametrize("robot", [trunk(), tendon_chain(), elastic_chain(), arm()])
def test_the_design_is_the_derivative_of_the_tip(robot):
    rng = np.random.default_rng(2)
    spread = 0.05 if isinstance(robot, type(arm())) else 0.001
    at = 0.25 if robot.n_actuators == 6 and isinstance(robot, type(trunk())) else 0.0
    q = torch.from_numpy(at + spread * rng.standard_normal((30, robot.n_actuators)))
    with torch.no_grad():
        errors = _TipErrors(robot, q)
        A, z = errors.design(q), robot.coordinates(q)[0]
        theta = torch.from_numpy(rng.standard_normal(A.shape[2]))
        n_weights = len(theta) - 6
        W = theta[:n_weights].view(z.shape[1], -1)
        phi = errors.features(q) @ errors.basis
        shift = 0.033 * robot.reach * theta[n_weights : n_weights + 3]
        turn, origin = 0.1 * theta[n_weights + 3 :], robot.base[:3, 3]

        def tip(step):
            inside = robot.from_coordinates(z + step * errors.units * (phi @ W.mT))
            return (inside - origin) @ rotation(step * turn)[0].mT + origin + step * shift

        slope = (tip(1e-5) - tip(-1e-5)) / 2e-5
    assert_allclose((A @ theta).numpy(), slope.numpy(), atol=1e-6 * float(slope.abs().max()))


def test_the_order_of_candidates_and_the_unit_do_not_matter():
    q, shuffled = lengths(60), np.random.default_rng(3).permutation(60)
    rows, error = choose_rows(trunk(), q, 20)
    again, same = choose_rows(trunk(), q[shuffled], 20)
    assert_array_equal(shuffled[again], rows)
    assert_allclose(same, error, rtol=1e-9)
    large, doubled = choose_rows(trunk(2.0), 2.0 * q, 20)
    assert_array_equal(large, rows)
    assert_allclose(doubled, 2.0 * error, rtol=1e-9)


def test_a_hybrid_stands_for_its_mechanical_model():
    q = lengths(40)
    with torch.no_grad():
        x = trunk()(torch.from_numpy(q)).numpy() * 1.01
    fitted = HybridForwardModel(trunk(), "linear", coupling="serial").fit(q, x)
    rows, error = choose_rows(trunk(), q, 5)
    for model in (fitted, fitted.module_):
        same_rows, same_error = choose_rows(model, q, 5)
        assert_array_equal(same_rows, rows)
        assert_allclose(same_error, error)
    with pytest.warns(UserWarning, match="learns nothing"):
        choose_rows(HybridForwardModel(trunk(), "drop").fit(q, x), q, 5)


BAD = {
    "`candidates`": lambda q: choose_rows(trunk(), q[0], 1),
    "`target` must hold": lambda q: choose_rows(trunk(), q, 1, target=q[:0]),
    "`n` must be 1 to 3": lambda q: choose_rows(trunk(), q, 4, groups=[*"aaabbbccc"]),
    "5000 weights": lambda q: choose_rows(lambda q: q, np.ones((9, 80)), 1),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_refused_by_name(message):
    with pytest.raises(ValueError, match=message):
        BAD[message](lengths(9))
