"""The change of a robot since the fit, base and actuator zeros, from a few new rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin._core.arrays import identity
from hybridkin._core.groups import Groups
from hybridkin._core.model import ForwardModel, moved_points
from hybridkin._core.rotations import (
    cross_matrix,
    rigid_motion,
    rotation,
    rotation_vector,
)
from hybridkin.hybrid._drift import MISFITS, SWITCH, too_far
from hybridkin.hybrid._module import Hybrid
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._wrapped import (
    in_columns,
    pose_difference,
)
from hybridkin.native.library import evaluate

PARAMETERS = ("base", "actuator_zeros")
# Prior standard deviations, in natural units.
_SCALES = 10.0 ** np.arange(-3.0, 0.6, 0.5)
_COMMON = 0.5  # share of the variance of a row that its whole group shares
_ROUNDS = 30  # of Gauss-Newton
_CHOOSING = 6  # of these that also choose the scales
_SETTLED = 1e-9
_LARGE = 3.0  # ratio of remaining errors to those of the fit that gives a warning
_SINGULAR = np.linalg.LinAlgError, torch.linalg.LinAlgError  # pyright: ignore


class Change(NamedTuple):
    """A change of a robot since the fit: its model f(q) becomes T f(q + shift).

    Attributes
    ----------
    shift : ndarray of shape (n,)
        Shift of the actuator zeros [unit of q].
    motion : ndarray of shape (4, 4)
        T, the motion of the base in the measuring frame.
    """

    shift: NDArray
    motion: NDArray

    @classmethod
    def none(cls, n: int) -> Self:
        """Return the change of a robot of n actuators that has not changed."""
        return cls(np.zeros(n), np.eye(4))

    def after(self, model: ForwardModel) -> ForwardModel:
        """Return a model after the change."""
        moved = model.moved(torch.from_numpy(self.motion))
        return moved.shifted(torch.from_numpy(self.shift))

    def before(self, rows: Rows, output: str) -> Rows:
        """Return rows as they were before the change."""
        tips = torch.from_numpy(rows.tips)
        if not np.array_equal(self.motion, np.eye(4)):
            motion = torch.linalg.inv(torch.from_numpy(self.motion))
            if output == "pose":
                turns = motion[:3, :3] @ rotation(tips[:, 3:])[0]
                positions = moved_points(tips[:, :3], motion)
                tips = torch.cat([positions, rotation_vector(turns)], dim=1)
            else:
                tips = moved_points(tips, motion)
        X = rows.q.numpy() + self.shift
        return replace(rows, X=X, y=tips.numpy().reshape(rows.y.shape))


def likeliest_change(
    fitted: Hybrid,
    rows: Rows,
    noise: float,
    scale: NDArray,
    parameters: Sequence[str],
) -> tuple[Change, list[str]]:
    """Return the most probable change, given new rows, and warnings.

    The change theta = (rotation, translation, shift) is in natural units: a rotation about the base
    in radians, a translation of the base in reaches of the robot, a shift of an actuator zero in
    half its range in the log. Its prior is normal about zero, with the three standard deviations of
    largest evidence. Base and zeros do not change unless the evidence for a change is clear.

    Parameters
    ----------
    fitted : Hybrid
        The model of the fit.
    rows : Rows
        New rows. The errors of the rows of a group have a common part.
    noise : float
        Standard deviation of one tip coordinate about the fitted model [m].
    scale : ndarray of shape (n,)
        Half the range of every actuator in the log of the fit [unit of q].
    parameters : sequence of str
        What may have changed, from `PARAMETERS`.

    References
    ----------
    MacKay, Bayesian interpolation, Neural Computation 4 (1992), for the evidence.
    """
    problem = _ChangeProblem(fitted, rows, scale)
    try:
        with np.errstate(over="raise", invalid="raise"):
            theta, residual = _least_cost(problem, rows.groups, noise, parameters)
            rms = float(np.sqrt(np.mean(residual**2)))
    except (ArithmeticError, *_SINGULAR) as error:
        raise too_far() from error
    if not np.isfinite(theta).all():
        raise too_far()
    return problem.change(theta), _misfit(rms, noise)


def _least_cost(
    problem: _ChangeProblem, groups: Groups, noise: float, parameters: Sequence[str]
) -> tuple[NDArray, NDArray]:
    """Return the most probable change theta, and the residual after it, relative to the noise."""
    theta = std = np.zeros(6 + len(problem.scale))
    misfit = 1.0
    residual = np.zeros(0)
    if "base" in parameters:
        theta = problem.registered(noise)
    for k in range(_ROUNDS):
        both = problem.linearised(theta)
        residual, A = (_whitened(a, groups)[problem.measured] / noise for a in both)
        target = residual + A @ theta
        if k < _CHOOSING:
            std, misfit = _likeliest_scales(A, target, parameters)
        system = std[:, None] * (A.T @ A) * std + misfit * np.eye(len(std))
        previous = theta
        theta = std * np.linalg.solve(system, std * (A.T @ target))
        if np.abs(theta - previous).max() <= _SETTLED:
            break
    return theta, residual


def _misfit(rms: float, noise: float) -> list[str]:
    """Return a warning if the errors are far larger than those of the fit; `rms` is the ratio."""
    if rms <= _LARGE:
        return []
    return [
        f"`y` differs from the adapted model by {1e3 * 3**0.5 * rms * noise:.3g} mm (rms); the "
        f"held-out error of the fit is {1e3 * 3**0.5 * noise:.3g} mm. The robot has changed in a "
        "way that `parameters` do not cover, for example by a payload. Record a new log and `fit`."
    ]


def check_parameters(parameters: Sequence[str], in_space: bool) -> None:
    """Raise if `parameters` are not allowed; `in_space`: outputs are tips in space or poses."""
    if isinstance(parameters, str) or not parameters or not {*parameters} <= {*PARAMETERS}:
        raise ValueError(
            f"`parameters` must be one or both of {PARAMETERS} in a list, got {parameters!r}."
        )
    if "base" in parameters and not in_space:
        raise ValueError(
            f"`parameters` must be ['actuator_zeros'] for this `y`, got {parameters!r}: 'base' "
            "needs tips with three coordinates, or poses."
        )


class _ChangeProblem:
    """The new rows, and the model as a function of the change of the robot."""

    def __init__(self, fitted: Hybrid, rows: Rows, scale: NDArray) -> None:
        self.fitted = fitted
        self.output = "pose" if fitted.has_pose else "position"
        self.q = rows.q
        self.y = torch.from_numpy(rows.tips)
        self.measured = ~np.isnan(rows.tips)
        self.pivot = fitted.robot.origin.to(self.q)
        self.reach = float(fitted.robot.reach)
        self.scale = torch.from_numpy(scale)

    def change(self, theta: NDArray) -> Change:
        """Return the change for theta (6 + n,)."""
        theta_in_torch = torch.from_numpy(theta)
        R = rotation(theta_in_torch[:3])[0]
        motion = identity(4, R)
        motion[:3, :3] = R
        way = self.pivot - R @ self.pivot + self.reach * theta_in_torch[3:6]
        motion[:3, 3] = way
        return Change((self.scale * theta_in_torch[6:]).numpy(), motion.numpy())

    def registered(self, noise: float) -> NDArray:
        """Return the best change of the base alone, as a start.

        Arun, Huang & Blostein (1987); the rotation stays small about axes that are not identified.
        """
        x = torch.from_numpy(evaluate(self.fitted, self.q.numpy())[0])
        y = self.y[:, : x.shape[1]].reshape(-1, 3)
        measured = ~y.isnan().any(1)
        x = x.reshape(-1, 3)[measured]
        y = y[measured]
        # Points beside both means: they turn about no axis.
        beside = noise / 2**0.5 * torch.cat([identity(3, x), -identity(3, x)])
        motion = rigid_motion(
            torch.cat([x, x.mean(0) + beside]), torch.cat([y, y.mean(0) + beside])
        )
        R = motion[:3, :3]
        way = R @ self.pivot + motion[:3, 3] - self.pivot
        shift = torch.zeros_like(self.scale)
        return torch.cat([rotation_vector(R), way / self.reach, shift]).numpy()

    def linearised(self, theta: NDArray) -> tuple[NDArray, NDArray]:
        """Return the residual (k, m) at a change, and the derivative (k, m, 6 + n) of the model.

        Both are zero for missing markers. Orientation errors of poses are in metres: one radian
        counts as the reach of the robot.
        """
        model = in_columns(self.change(theta).after(self.fitted), self.output)
        x, J = map(torch.from_numpy, evaluate(model, self.q.numpy(), jacobian=True))
        residual = self.y - x
        J = J * self.scale
        A = torch.cat([J.new_zeros(*x.shape, 6), J], dim=-1)
        spin = rotation(torch.from_numpy(theta[:3]))[1]
        K = x.shape[1] // 3
        if x.shape[1] % 3 == 0:
            centre = self.pivot + self.reach * torch.from_numpy(theta[3:6])
            arm = x.unflatten(1, (K, 3)) - centre
            A[..., :3] = (-cross_matrix(arm) @ spin).flatten(1, 2)
            A[..., 3:6] = self.reach * identity(3, x).repeat(K, 1)
        if self.output == "pose":
            residual[:, 3:] = self.reach * pose_difference(x, self.y)[:, 3:]
            A[:, 3:, :3] = spin
            A[:, 3:, 3:6] = 0.0
            A[:, 3:] *= self.reach
        A[~self.measured] = residual[~self.measured] = 0.0
        return residual.numpy(), A.numpy()


def _whitened(values: NDArray, groups: Groups) -> NDArray:
    """Return rows (k, ...) whitened for errors with a part that is common to their group.

    The common part makes the mean of a group less certain, and differences from it more certain.
    """
    if not groups.whole:
        return values
    whitened = np.empty_like(values)
    individual = 1.0 - _COMMON
    for members in groups.members:
        rows = members.numpy()
        mean = values[rows].mean(axis=0)
        common = mean / (individual + _COMMON * len(rows)) ** 0.5
        whitened[rows] = (values[rows] - mean) / individual**0.5 + common
    return whitened


def _likeliest_scales(
    A: NDArray, target: NDArray, parameters: Sequence[str]
) -> tuple[NDArray, float]:
    """Return the prior standard deviations (6 + n,) and the misfit of largest evidence.

    The rows are A theta = target with unit variance. A standard deviation of zero means no change.
    The misfit is the variance that no change explains, relative to that of the fit.
    """
    scales = _SCALES.tolist()
    bases = [(0.0, 0.0)]
    if "base" in parameters:
        bases += product(scales, scales)
    shifts = [0.0]
    if "actuator_zeros" in parameters:
        shifts += scales
    tried = np.array([(*pair, shift) for pair, shift in product(bases, shifts)])
    std = np.repeat(tried, (3, 3, A.shape[1] - 6), axis=1)
    moments = std * (A.T @ target)
    systems = std[:, :, None] * (A.T @ A) * std[:, None]
    evidence = np.empty((len(MISFITS), len(std)))
    for k, misfit in enumerate(MISFITS):
        inner = systems / misfit + np.eye(A.shape[1])
        solved = np.linalg.solve(inner, moments[..., None])[..., 0]
        explained = (moments * solved).sum(1) / misfit
        left = (target @ target - explained) / misfit + len(A) * np.log(misfit)
        evidence[k] = -0.5 * (left + np.linalg.slogdet(inner)[1])
    evidence -= SWITCH * (tried[:, 1:] > 0.0).sum(1)
    evidence -= np.log2(MISFITS)[:, None]
    k, best = np.unravel_index(evidence.argmax(), evidence.shape)
    return std[best], float(MISFITS[k])
