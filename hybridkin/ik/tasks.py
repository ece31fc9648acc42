"""Tasks of inverse kinematics: positions, poses, axes, several points, several tasks."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, TypeVar, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from hybridkin._core.actuation import Actuation
from hybridkin._core.arrays import (
    Numbers,
    as_array,
    as_tensor,
    check_shape,
    identity,
    leading,
    number,
    whole,
)
from hybridkin._core.blocks import in_blocks
from hybridkin._core.kernel_numbers import IK_NO_AXIS
from hybridkin._core.model import Fitted, ForwardModel, PoseModel, as_forward_model
from hybridkin._core.rotations import least_turn, rotation, rotation_vector

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["AxisTask", "PointsTask", "PoseTask", "PositionTask", "Stack", "Task"]

Tolerance: TypeAlias = float | tuple[float, ...]
_Rows = TypeVar("_Rows", Tensor, NDArray)


class Level(NamedTuple):
    """The rows of a task's error with the same priority."""

    rows: tuple[int, ...]
    n_free: int  # directions of these rows that no motion changes


class Task:
    """A controlled quantity: x(q), its Jacobian, and the error of x to a target in m rows.

    A subclass sets `shape`, `parts`, `units` and `models`, and defines `evaluate` and `difference`.

    Attributes
    ----------
    shape : tuple of int
        Shape of one target and of one x.
    parts : tuple of int
        Numbers of rows of the parts of the error, e.g. position and rotation of a pose.
    units : tuple of float
        Metres per unit of every part.
    models : tuple of ForwardModel
        The models that are evaluated.
    estimator, module : Fitted and nn.Module, or None
        The estimator that the model was taken from, and its module then.
    has_rotation : bool
        Whether targets are poses (4, 4).
    of_poses : bool
        Whether x is that of the pose of a tip.
    about_target : str
        What a target is.
    n_free : int
        Number of directions of the m rows that the task leaves free: no motion changes them.
    n_levels : int
        Number of levels of priority, see `Stack`.
    """

    shape: tuple[int, ...]
    parts: tuple[int, ...]
    units: tuple[float, ...]
    models: tuple[ForwardModel, ...]
    estimator: Fitted | None = None
    module: nn.Module | None = None
    has_rotation = False
    of_poses = False
    about_target = "desired x now [m];"
    n_free = 0
    n_levels = 1

    @property
    def hysteresis(self) -> Actuation:
        """The hysteresis of the actuators, which is that of the first model."""
        return self.models[0].hysteresis

    def present(self) -> Self:
        """Return the task for the module that its estimator has now."""
        if self.estimator is None or self.estimator.module_ is self.module:
            return self
        task = copy.copy(self)
        task._follow(self.estimator)
        return task

    def frozen(self) -> Self:
        """Return the task with copies of its models, see `ForwardModel.frozen`."""
        task = copy.copy(self)
        task.models = tuple(model.frozen() for model in self.models)
        return task

    def _follow(self, model: object) -> None:
        """Take the model of the task, and remember its estimator."""
        if isinstance(model, Fitted) and not isinstance(model, nn.Module):
            self.estimator = model
            self.module = model.module_
        self.models = (self._suitable(as_forward_model(model)),)

    def _suitable(self, model: ForwardModel) -> ForwardModel:
        return model

    def evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x ``(N, *shape)`` and minus the derivative of the error (N, m, n), q (N, n).

        Rows that are angles are scaled by `units` [m/rad].
        """
        raise NotImplementedError

    def difference(self, x: Tensor, x_target: Tensor) -> Tensor:
        """Return the error (N, m) of x with respect to targets, both ``(N, *shape)`` [m].

        To first order, a step with J dq = difference(x, x_target) moves x to the target.
        """
        raise NotImplementedError

    def distances(self, x: Tensor, x_target: Tensor) -> Tensor:
        """Return distances (N, k) of x ``(1 or N, k, *shape)`` to targets ``(N, *shape)``."""
        k = x.shape[1]
        x = x.expand(len(x_target), k, *self.shape).flatten(0, 1)
        error = self.difference(x, x_target.repeat_interleave(k, 0))
        return error.norm(dim=-1).view(-1, k)

    def positions(self, x: Tensor) -> Tensor:
        """Return the positions of the models in x ``(..., *shape)`` [m], (..., 0) if unknown.

        They tell which targets no configuration can reach.
        """
        return x.flatten(x.ndim - len(self.shape))[..., :0]

    def moved(self, x: Tensor, motion: Tensor, turn: Tensor) -> Tensor:
        """Return x moved by vectors [m] and turned by rotation vectors (..., 3), where it turns."""
        return x + motion

    def check(self, x_target: Tensor, name: str) -> None:
        """Raise if targets ``(..., *shape)`` are not valid, e.g. their rotations."""

    def reading(self, x: Tensor) -> Tensor:
        """Return a measured x ``(..., *shape)``, also from one without rotation, which is NaN."""
        return x

    def completed(self, reading: Tensor, x: Tensor) -> Tensor:
        """Return measured rows ``(N, *shape)`` with rotations that are NaN taken from those of x.

        Rows without a position stay as they are.
        """
        return reading

    @property
    def steered(self) -> tuple[ForwardModel, ...]:
        """The models whose outputs, side by side, are the points that are steered."""
        return self.models

    @property
    def angular(self) -> tuple[bool, ...]:
        """Whether the parts of the error are angles, one for each part."""
        return (False,) * len(self.parts)

    @property
    def stacked(self) -> tuple[Task, ...]:
        """The tasks that this one consists of: itself, or those of a `Stack`."""
        return (self,)

    @property
    def by_level(self) -> tuple[Level, ...]:
        """The levels of priority, the first one first; together they have all rows."""
        return (Level((*range(sum(self.parts)),), self.n_free),)

    def in_one_level(self, ratio: float) -> Task:
        """Return the task in one level, with weights that fall by a ratio from level to level."""
        return self

    def misses(self, x_target: Tensor, largest: Tensor) -> Tensor:
        """Return lower bounds (N,) of errors [m], of all q with ``|q| <= largest``; 0: unknown."""
        positions = self.positions(x_target)
        if positions.shape[-1] == 0:
            return positions.new_zeros(len(positions))
        missed = self.models[0].misses(positions, largest)
        worst_point = missed[..., None].flatten(1).amax(-1)
        return worst_point * min(self.units)

    def reached(self, error: Tensor, tol: Tolerance) -> Tensor:
        """Return whether errors (N, m) are within one tolerance [m], or one for every part."""
        if not isinstance(tol, tuple):
            return error.norm(dim=-1) <= tol
        parts = error.split(self.parts, dim=-1)
        reached = torch.ones_like(error[:, 0], dtype=torch.bool)
        for part, largest, unit in zip(parts, tol, self.units, strict=True):
            reached &= part.norm(dim=-1) <= largest * unit
        return reached

    @property
    def n_actuators(self) -> int | None:
        """Length of q, or None if no model defines it."""
        for model in self.models:
            if model.n_actuators:
                return model.n_actuators
        return None

    @property
    def device(self) -> torch.device:
        """Device of the first model with tensors; the CPU if there is none."""
        for model in self.models:
            for tensor in (*model.parameters(), *model.buffers()):
                return tensor.device
        return torch.device("cpu")

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the largest domain distance of the models, at most 1 inside, shape (N,)."""
        distances = [model.domain_distance(q) for model in self.models]
        return torch.stack(distances).amax(0)

    def in_domain(self, q: Tensor) -> Tensor:
        """Return whether q lies inside the domains of all models, shape (N,)."""
        if len(q) > 0:
            return self.domain_distance(q) <= 1.0
        return q.new_ones(0, dtype=torch.bool)


class PositionTask(Task):
    """Task to bring the tip to a point: the default of `InverseKinematics`.

    Parameters
    ----------
    model : ForwardModel, nn.Module, callable or (callable, callable)
        Maps q ``(..., n)`` to x ``(..., size)``, or a pair of such a function and its Jacobian
        ``(..., size, n)``; row by row, torch to torch, see `as_forward_model`. NumPy functions:
        `from_numpy`.
    size : int, default=3
        Number of coordinates. For a model with several markers, 3 means that its last marker, the
        tip, goes to the target; three times their number means all markers.

    Examples
    --------
    A planar arm of two links, in NumPy:

    >>> import numpy as np
    >>> from hybridkin import InverseKinematics
    >>> from hybridkin.ik.tasks import PositionTask
    >>> def tip(q):
    ...     a, b = q[..., 0], q[..., 0] + q[..., 1]
    ...     return np.stack([np.cos(a) + np.cos(b), np.sin(a) + np.sin(b)], axis=-1)
    >>> def jacobian(q):
    ...     a, b = q[..., 0], q[..., 0] + q[..., 1]
    ...     second = np.stack([-np.sin(b), np.cos(b)], axis=-1)
    ...     first = np.stack([-np.sin(a), np.cos(a)], axis=-1) + second
    ...     return np.stack([first, second], axis=-1)
    >>> ik = InverseKinematics(PositionTask.from_numpy(tip, jacobian, size=2))
    >>> ik.solve(np.array([1.2, 0.9]), q0=np.array([0.2, 0.8]), tol=1e-9).x.round(6)
    array([1.2, 0.9])
    """

    def __init__(self, model: object, size: int = 3) -> None:
        count = whole(size, "size")
        self.shape = (count,)
        self.parts = (count,)
        self.units = (1.0,)
        self._follow(model)

    def _suitable(self, model: ForwardModel) -> ForwardModel:
        return model.tip_model if self.shape == (3,) else model

    @classmethod
    def from_numpy(
        cls,
        function: Callable[[NDArray], ArrayLike],
        jacobian: Callable[[NDArray], ArrayLike],
        size: int = 3,
    ) -> PositionTask:
        """Return the task for a model in NumPy.

        Parameters
        ----------
        function, jacobian : callable
            Map q ``(..., n)`` to x ``(..., size)`` and to dx/dq ``(..., size, n)``, row by row.
        size : int, default=3
            Number of coordinates.

        Returns
        -------
        PositionTask
            A task without derivatives of solutions (`differentiable`).
        """
        return cls([partial(_through_numpy, f) for f in (function, jacobian)], size)

    def evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (N, size) and J (N, size, n), in closed form if the model has one."""
        x, J = self.models[0].forward_and_jacobian(q)
        if x.shape != (len(q), *self.shape):
            raise ValueError(
                f"`model` must map q of shape {tuple(q.shape)} to tips of shape "
                f"{(len(q), *self.shape)}, got {tuple(x.shape)}; for other sizes use "
                "PositionTask(model, size=...)."
            )
        return x.to(q), J.to(q)

    def difference(self, x: Tensor, x_target: Tensor) -> Tensor:
        """Return x_target - x."""
        return x_target - x

    def positions(self, x: Tensor) -> Tensor:
        """Return x."""
        return x


class _OfPoses(Task):
    """A task of the pose of the tip, with a weight of rotations [m/rad]."""

    of_poses = True

    @property
    def angular(self) -> tuple[bool, ...]:
        """Whether the parts of the error are angles: the second one."""
        return (False, True)

    def _suitable(self, model: ForwardModel) -> ForwardModel:
        if not model.has_pose:
            raise TypeError(
                "`model` must be a PoseModel, which returns the pose of the tip, got "
                f"{type(model).__name__}; use a chain, or fit a hybrid with output='pose'."
            )
        return model

    @property
    def steered(self) -> tuple[ForwardModel, ...]:
        """The model of the tip."""
        return (self.models[0].tip_model,)

    def distances(self, x: Tensor, x_target: Tensor) -> Tensor:
        """Return distances of x to targets, with chords instead of angles of rotations."""
        points = self._in_metres(x)
        targets = self._in_metres(x_target)
        if len(points) == 1:  # much faster
            return torch.cdist(targets, points[0])
        return torch.cdist(targets[:, None], points)[:, 0]

    def _in_metres(self, x: Tensor) -> Tensor:
        """Return points (..., k) whose distances are those of x, for small rotations."""
        raise NotImplementedError


class PoseTask(_OfPoses):
    """Task to bring the tip to a pose, position and orientation: six rows.

    The error of the rotation is its logarithm: the rotation vector from the present to the desired
    frame, in the measuring frame. Targets are homogeneous (4, 4) matrices, or a
    pytorch_kinematics Transform3d.

    Parameters
    ----------
    model : PoseModel
        A chain, or a hybrid fitted with ``output="pose"``.
    radian : float, default=0.1
        Weight of the rotation: metres per radian.

    Examples
    --------
    >>> import torch
    >>> from hybridkin import InverseKinematics, robots
    >>> from hybridkin.ik.tasks import PoseTask
    >>> chain = robots.bionic_handling_assistant()
    >>> target = chain.poses(torch.linspace(0.22, 0.28, 9, dtype=torch.float64))[-1]
    >>> ik = InverseKinematics(PoseTask(chain), q_min=0.1, q_max=0.4)
    >>> ik.solve(target, tol=(1e-6, 1e-5)).converged  # [m], [rad]
    tensor(True)
    """

    has_rotation = True
    about_target = (
        "desired pose now, a homogeneous (4, 4) matrix, row by row [m]; one that holds no rotation "
        "counts as NaN;"
    )

    def __init__(self, model: object, radian: float = 0.1) -> None:
        self.shape = (4, 4)
        self.parts = (3, 3)
        self.units = (1.0, _length(radian, "radian"))
        self._follow(model)

    def evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip's poses (N, 4, 4) and J (N, 6, n), its angular rows times `radian`."""
        model = cast(PoseModel, self.models[0])
        T, J = in_blocks(model.pose_and_jacobian, q)
        scaled = torch.cat([J[:, :3], self.units[1] * J[:, 3:]], dim=-2)
        return T.to(q), scaled.to(q)

    def difference(self, x: Tensor, x_target: Tensor) -> Tensor:
        """Return the displacement [m] and the rotation vector [rad] times `radian`, (N, 6)."""
        displacement = x_target[..., :3, 3] - x[..., :3, 3]
        R = x_target[..., :3, :3] @ x[..., :3, :3].mT
        turn = self.units[1] * rotation_vector(R)
        return torch.cat([displacement, turn], dim=-1)

    def positions(self, x: Tensor) -> Tensor:
        """Return the positions of poses (..., 4, 4), shape (..., 3)."""
        return x[..., :3, 3]

    def reading(self, x: Tensor) -> Tensor:
        """Return measured poses (..., 4, 4); of positions (..., 3) the rotations are NaN."""
        if x.ndim == 0 or x.shape[-1] != 3:
            return x
        T = torch.full((*x.shape[:-1], 4, 4), math.nan, dtype=x.dtype, device=x.device)
        T[..., :3, 3] = x
        T[..., 3, :] = T.new_tensor([0.0, 0.0, 0.0, 1.0])
        return T

    def completed(self, reading: Tensor, x: Tensor) -> Tensor:
        """Return measured poses (N, 4, 4) with rotations that are NaN taken from those of x."""
        unknown = reading[:, :3, :3].isnan().flatten(1).all(1)
        rows = unknown & torch.isfinite(reading[:, :3, 3]).all(1)
        completed = torch.where(rows[:, None, None], x, reading)
        completed[:, :3, 3] = reading[:, :3, 3]
        return completed

    def moved(self, x: Tensor, motion: Tensor, turn: Tensor) -> Tensor:
        """Return poses (..., 4, 4) moved and turned, each about its tip."""
        T = x.clone()
        T[..., :3, 3] += motion
        T[..., :3, :3] = rotation(turn)[0] @ T[..., :3, :3]
        return T

    def _in_metres(self, x: Tensor) -> Tensor:
        """Return positions and scaled rotation matrices side by side, (..., 12)."""
        turned = x[..., :3, :3].flatten(-2)
        metres_per_radian = self.units[1] / math.sqrt(2.0)
        return torch.cat([x[..., :3, 3], metres_per_radian * turned], dim=-1)

    def check(self, x_target: Tensor, name: str) -> None:
        """Raise if a finite target does not hold a rotation."""
        R = x_target[..., :3, :3]
        R = R[torch.isfinite(R).flatten(-2).all(-1)]
        off = (R.mT @ R - identity(3, R)).abs()
        if (off > 1e-3).any() or (torch.linalg.det(R) < 0.0).any():
            raise ValueError(
                f"`{name}` must hold rotations in its upper left 3 x 3 blocks (orthonormal, "
                f"right-handed), got a block that is off by {float(off.max()):.3g}."
            )


class AxisTask(_OfPoses):
    """Task to bring the tip to a position, and one of its axes to a direction.

    It has five degrees of freedom in six rows: a turn about the axis is free, as for a drill, a
    needle or a camera. A target (6,) holds the position and the direction, whose length does not
    matter, but must not be zero. The error of the direction is the rotation vector of least angle
    from the present to the desired axis, in the measuring frame; for opposite axes, which have many
    such turns, always the same one.

    Parameters
    ----------
    model : PoseModel
        A chain, or a hybrid fitted with ``output="pose"``.
    axis : array-like of shape (3,), default=(0, 0, 1)
        The axis in the frame of the tip, of any length [1]; of chains of arcs z is along the
        backbone.
    length : float, default=0.1
        Weight of the direction: metres per radian. As if a second point, so far along the axis,
        had a target, too.

    Examples
    --------
    The tip of a trunk bends over and looks back along the base:

    >>> import numpy as np
    >>> from hybridkin import InverseKinematics, robots
    >>> from hybridkin.ik.tasks import AxisTask
    >>> task = AxisTask(robots.bionic_handling_assistant())
    >>> ik = InverseKinematics(task, q_min=0.1, q_max=0.4)
    >>> target = np.array([0.35, 0.0, 0.45, 0.0, 0.0, -1.0])
    >>> solution = ik.solve(target, tol=(1e-6, 1e-5))  # [m], [rad]
    >>> bool(solution.converged), bool(np.allclose(solution.x, target, atol=1e-6))
    (True, True)
    """

    about_target = (
        "desired position now [m], then the direction of the axis, of any length; one without a "
        "direction counts as NaN;"
    )

    def __init__(self, model: object, axis: Numbers = (0.0, 0.0, 1.0), length: float = 0.1) -> None:
        along = as_tensor(axis, "axis").cpu().double()
        check_shape(along, "axis", [3], "a direction in the frame of the tip")
        size = float(along.norm())
        if not IK_NO_AXIS < size < math.inf:
            raise ValueError(f"`axis` must be finite and not zero, got {along.tolist()}.")
        self.axis = along / size
        self.shape = (6,)
        self.parts = (3, 3)
        self.units = (1.0, _length(length, "length"))
        self.n_free = 1
        self._follow(model)

    def evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions and axes (N, 6) and J (N, 6, n), its angular rows times `length`."""
        model = cast(PoseModel, self.models[0])
        T, J = in_blocks(model.pose_and_jacobian, q)
        axis = T[:, :3, :3] @ self.axis.to(T)
        turn = J[:, 3:] - axis[:, :, None] * (axis[:, None] @ J[:, 3:])
        scaled = torch.cat([J[:, :3], self.units[1] * turn], dim=-2)
        return torch.cat([T[:, :3, 3], axis], dim=-1).to(q), scaled.to(q)

    def difference(self, x: Tensor, x_target: Tensor) -> Tensor:
        """Return the displacement [m] and the least turn of the axis [rad] times `length`."""
        displacement = x_target[..., :3] - x[..., :3]
        turn = self.units[1] * least_turn(x[..., 3:], x_target[..., 3:])
        return torch.cat([displacement, turn], dim=-1)

    def positions(self, x: Tensor) -> Tensor:
        """Return the positions in x (..., 6), shape (..., 3)."""
        return x[..., :3]

    def reading(self, x: Tensor) -> Tensor:
        """Return measured x (..., 6); of positions (..., 3) the axes are NaN."""
        if x.ndim == 0 or x.shape[-1] != 3:
            return x
        return torch.cat([x, torch.full_like(x, math.nan)], dim=-1)

    def completed(self, reading: Tensor, x: Tensor) -> Tensor:
        """Return measured rows (N, 6) with axes that are NaN taken from those of x."""
        unknown = reading[:, 3:].isnan().all(1) & torch.isfinite(reading[:, :3]).all(1)
        axes = torch.where(unknown[:, None], x[:, 3:], reading[:, 3:])
        return torch.cat([reading[:, :3], axes], dim=-1)

    def moved(self, x: Tensor, motion: Tensor, turn: Tensor) -> Tensor:
        """Return x (..., 6) moved and turned about its position."""
        axes = (rotation(turn)[0] @ x[..., 3:, None])[..., 0]
        return torch.cat([x[..., :3] + motion, axes], dim=-1)

    def _in_metres(self, x: Tensor) -> Tensor:
        """Return positions and scaled unit axes side by side, (..., 6)."""
        axes = nn.functional.normalize(x[..., 3:], dim=-1)
        return torch.cat([x[..., :3], self.units[1] * axes], dim=-1)

    def check(self, x_target: Tensor, name: str) -> None:
        """Raise if the direction of a target is zero."""
        sizes = x_target[..., 3:].norm(dim=-1)
        if (sizes <= IK_NO_AXIS).any():
            raise ValueError(
                f"`{name}` must hold directions in its last 3 numbers, of any length but zero, got "
                f"one of length {float(sizes.nan_to_num(math.inf).min()):.3g}."
            )


class PointsTask(Task):
    """Task to bring several points of the backbone to target points: 3 P rows, targets (P, 3).

    Parameters
    ----------
    chain : chain
        A chain with the method ``with_tip(at)``: a chain of arcs or a `RigidChain`.
    at : sequence of float
        Places on the backbone, in segments from the base; of a rigid arm in joints.
    weights : sequence of float, optional
        Factor on the error of every point, a compromise if not all points can be reached. Default:
        1 each.

    Examples
    --------
    The end of the second segment near one point, the tip at another:

    >>> import torch
    >>> from hybridkin import InverseKinematics, robots
    >>> from hybridkin.ik.tasks import PointsTask
    >>> task = PointsTask(robots.bionic_handling_assistant(), [2.0, 3.0], weights=[0.1, 1.0])
    >>> targets = torch.tensor([[0.0, 0.0, 0.5], [0.1, 0.0, 0.75]], dtype=torch.float64)
    >>> InverseKinematics(task, q_min=0.1, q_max=0.4).solve(targets).converged
    tensor(True)
    """

    def __init__(
        self, chain: object, at: Sequence[float], weights: Sequence[float] | None = None
    ) -> None:
        model = as_forward_model(chain)
        self.models = tuple(model.with_tip(number(a, "at")) for a in at)
        n = len(at)
        if weights is None:
            weights = (1.0,) * n
        self.units = tuple(number(w, "weights") for w in weights)
        positive = all(0.0 < w < math.inf for w in self.units)
        if n == 0 or len(self.units) != n or not positive:
            raise ValueError(
                "`weights` must be positive, one for every point of `at`, got "
                f"{self.units} for {n} points."
            )
        self.shape = (n, 3)
        self.parts = (3,) * n

    def evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points (N, P, 3) and the weighted J (N, 3 P, n)."""
        points = []
        weighted = []
        for model, weight in zip(self.models, self.units, strict=True):
            x, J = model.forward_and_jacobian(q)
            points.append(x)
            weighted.append(weight * J)
        return torch.stack(points, dim=1).to(q), torch.cat(weighted, dim=-2).to(q)

    def difference(self, x: Tensor, x_target: Tensor) -> Tensor:
        """Return the weighted errors (N, 3 P), one point after another."""
        weights = x.new_tensor(self.units)[:, None]
        return (weights * (x_target - x)).flatten(-2)

    def positions(self, x: Tensor) -> Tensor:
        """Return the points, x."""
        return x


class Stack(Task):
    """Several tasks of one robot at once, e.g. the position of the tip and an axis before it.

    The errors of the tasks stand one after another, and so do their targets: a target of the stack
    is one array (K,), the targets of the tasks side by side, poses row by row. `join` makes it of
    the targets of the tasks, and `split` takes an x apart. Tolerances are those of the parts of all
    tasks.

    If the tasks cannot all be reached, their levels decide: a task moves the robot only in ways
    that do not move the tasks of the levels before it, within all limits. Among tasks of one level
    the weights decide. A target is reached if those of all levels are.

    Tasks of positions and points run in the compiled core; with poses or axes, or with several
    levels, torch computes the stack.

    Parameters
    ----------
    tasks : sequence of Task
        Tasks of the same actuators. Settings, limits and hysteresis of the robot are those of the
        first one.
    weights : sequence of float, optional
        Factor on the errors of every task. Default: 1 each.
    levels : sequence of int, optional
        Level of every task: 0 comes first, then 1, and so on. Default: 0 each.

    Examples
    --------
    The tip of a trunk at a point, and its second segment upright at its end:

    >>> import torch
    >>> from hybridkin import InverseKinematics, robots
    >>> from hybridkin.ik.tasks import AxisTask, PositionTask, Stack
    >>> trunk = robots.bionic_handling_assistant()
    >>> middle = trunk.with_tip(2.0)
    >>> task = Stack([PositionTask(trunk), AxisTask(middle)], weights=[1.0, 0.1])
    >>> at_rest = middle(torch.full((9,), 0.25, dtype=torch.float64))
    >>> up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    >>> target = task.join([0.05, 0.0, 0.8], torch.cat([at_rest, up]))
    >>> solution = InverseKinematics(task, q_min=0.1, q_max=0.4).solve(target)
    >>> tip, axis = task.split(solution.x)
    >>> solution.converged, bool(axis[5] > 0.9999)
    (tensor(True), True)

    The tip at a point, and the end of the second segment as near to another one as that allows:

    >>> task = Stack([PositionTask(trunk), PositionTask(middle)], levels=[0, 1])
    >>> target = task.join([0.05, 0.0, 0.8], [0.2, 0.0, 0.5])
    >>> solution = InverseKinematics(task, q_min=0.1, q_max=0.4).solve(target)
    >>> tip, _ = task.split(solution.x)
    >>> bool(abs(tip - [0.05, 0.0, 0.8]).max() < 1e-4)
    True
    """

    def __init__(
        self,
        tasks: Sequence[Task],
        weights: Sequence[float] | None = None,
        levels: Sequence[int] | None = None,
    ) -> None:
        parts = tuple(tasks)
        if len(parts) == 0 or not all(isinstance(task, Task) for task in parts):
            names = [type(task).__name__ for task in parts]
            raise TypeError(
                f"`tasks` must be tasks, e.g. PositionTask(model), at least one, got {names}."
            )
        if weights is None:
            weights = (1.0,) * len(parts)
        self.weights = tuple(number(w, "weights") for w in weights)
        positive = all(0.0 < w < math.inf for w in self.weights)
        if len(self.weights) != len(parts) or not positive:
            raise ValueError(
                "`weights` must be positive, one for every task, got "
                f"{self.weights} for {len(parts)} tasks."
            )
        self.levels = _checked_levels(levels, len(parts))
        sizes = {task.n_actuators for task in parts if task.n_actuators}
        if len(sizes) > 1:
            raise ValueError(f"`tasks` must have the same actuators, got {sorted(sizes)} of them.")
        self._take(parts)

    def _take(self, tasks: tuple[Task, ...]) -> None:
        """Set the tasks."""
        self._tasks = tasks
        self.widths = tuple(math.prod(task.shape) for task in tasks)
        self.rows = tuple(sum(task.parts) for task in tasks)
        self.shape = (sum(self.widths),)
        self.parts = tuple(part for task in tasks for part in task.parts)
        units = []
        for task, weight in zip(tasks, self.weights, strict=True):
            units += [weight * unit for unit in task.units]
        self.units = tuple(units)
        self.models = tuple(model for task in tasks for model in task.models)
        self.n_free = sum(task.n_free for task in tasks)
        self.n_levels = 1 + max(self.levels)
        self.estimator = tasks[0].estimator
        self.module = tasks[0].module

    @property
    def angular(self) -> tuple[bool, ...]:
        """Whether the parts of the error are angles, one for each part of the tasks."""
        return tuple(turns for task in self._tasks for turns in task.angular)

    @property
    def by_level(self) -> tuple[Level, ...]:
        """The levels of priority, the first one first; together they have all rows."""
        levels = []
        for level in range(self.n_levels):
            rows = []
            n_free = 0
            start = 0
            for task, size, at in zip(self._tasks, self.rows, self.levels, strict=True):
                if at == level:
                    rows += range(start, start + size)
                    n_free += task.n_free
                start += size
            levels.append(Level(tuple(rows), n_free))
        return tuple(levels)

    def in_one_level(self, ratio: float) -> Stack:
        """Return the stack in one level, with weights that fall by a ratio from level to level."""
        stack = copy.copy(self)
        weighted = zip(self.weights, self.levels, strict=True)
        stack.weights = tuple(weight * ratio**level for weight, level in weighted)
        stack.levels = (0,) * len(self.levels)
        stack._take(self._tasks)
        return stack

    @property
    def stacked(self) -> tuple[Task, ...]:
        """The tasks."""
        return self._tasks

    @property
    def steered(self) -> tuple[ForwardModel, ...]:
        """The models whose outputs, side by side, are the points that are steered."""
        return tuple(model for task in self._tasks for model in task.steered)

    def present(self) -> Self:
        """Return the stack for the modules that the estimators of its tasks have now."""
        tasks = tuple(task.present() for task in self._tasks)
        if all(a is b for a, b in zip(tasks, self._tasks, strict=True)):
            return self
        return self._with(tasks)

    def frozen(self) -> Self:
        """Return the stack with copies of its models."""
        return self._with(tuple(task.frozen() for task in self._tasks))

    def _with(self, tasks: tuple[Task, ...]) -> Self:
        stack = copy.copy(self)
        stack._take(tasks)
        return stack

    def join(self, *targets: ArrayLike | Tensor) -> Tensor | NDArray:
        """Return a target (..., K) of the targets ``(..., *shape)`` of the tasks.

        It is a tensor if one of them is, else an array.
        """
        if len(targets) != len(self._tasks):
            raise ValueError(
                f"`targets` must be one for every task, {len(self._tasks)}, got {len(targets)}."
            )
        rows = []
        for i, (task, target) in enumerate(zip(self._tasks, targets, strict=True)):
            name = f"targets[{i}]"
            x = as_tensor(target, name, self.device)
            check_shape(x, name, ("...", *task.shape), type(task).__name__)
            task.check(x, name)
            rows.append(x.flatten(x.ndim - len(task.shape)))
        dtype = rows[0].dtype
        for row in rows:
            dtype = torch.promote_types(dtype, row.dtype)
        lead = leading([(row, 1) for row in rows])
        joined = torch.cat([row.to(dtype).expand(*lead, -1) for row in rows], dim=-1)
        if any(isinstance(target, Tensor) for target in targets):
            return joined
        return as_array(joined)

    def split(self, x: _Rows) -> list[_Rows]:
        """Return the x of the tasks ``(..., *shape)`` in an x (..., K) of the stack."""
        parts = []
        start = 0
        for task, width in zip(self._tasks, self.widths, strict=True):
            part = x[..., start : start + width]
            parts.append(part.reshape(*x.shape[:-1], *task.shape))
            start += width
        return parts

    def _joined(self, parts: Sequence[Tensor]) -> Tensor:
        """Return x of the stack (..., K) from those of the tasks."""
        rows = []
        for task, x in zip(self._tasks, parts, strict=True):
            rows.append(x.flatten(x.ndim - len(task.shape)))
        return torch.cat(rows, dim=-1)

    def evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (N, K) and the weighted J (N, m, n), one task after another."""
        parts = []
        weighted = []
        for task, weight in zip(self._tasks, self.weights, strict=True):
            x, J = task.evaluate(q)
            parts.append(x)
            weighted.append(weight * J)
        return self._joined(parts), torch.cat(weighted, dim=-2)

    def difference(self, x: Tensor, x_target: Tensor) -> Tensor:
        """Return the weighted errors (N, m), one task after another."""
        errors = []
        pairs = zip(self._tasks, self.split(x), self.split(x_target), strict=True)
        for (task, part, target), weight in zip(pairs, self.weights, strict=True):
            errors.append(weight * task.difference(part, target))
        return torch.cat(errors, dim=-1)

    def positions(self, x: Tensor) -> Tensor:
        """Return the points (..., P, 3) of the tasks that have them, (..., 0) if none has."""
        points = []
        for task, part in zip(self._tasks, self.split(x), strict=True):
            at = task.positions(part)
            if at.shape[-1] == 3:
                points.append(at.reshape(*x.shape[:-1], -1, 3))
        return torch.cat(points, dim=-2) if points else x[..., :0]

    def misses(self, x_target: Tensor, largest: Tensor) -> Tensor:
        """Return lower bounds (N,) of errors [m]: that of the task that is missed by most."""
        bounds = []
        for i, part in enumerate(self.split(x_target)):
            missed = self._tasks[i].misses(part, largest)
            bounds.append(self.weights[i] * missed)
        return torch.stack(bounds).amax(0)

    def moved(self, x: Tensor, motion: Tensor, turn: Tensor) -> Tensor:
        """Return x (..., K) of points, moved by vectors (..., P, 3) [m]."""
        return x + motion.flatten(-2)

    def check(self, x_target: Tensor, name: str) -> None:
        """Raise if the part of a target that belongs to a task is not valid."""
        for i, part in enumerate(self.split(x_target)):
            self._tasks[i].check(part, f"part {i} of {name}")

    def completed(self, reading: Tensor, x: Tensor) -> Tensor:
        """Return measured rows (N, K) with rotations and axes that are NaN taken from x."""
        parts = []
        pairs = zip(self.split(reading), self.split(x), strict=True)
        for task, (part, model) in zip(self._tasks, pairs, strict=True):
            parts.append(task.completed(part, model))
        return self._joined(parts)


def as_task(model: object) -> Task:
    """Return a task unchanged, and for a model the task to bring its tip to a point."""
    if isinstance(model, (list, tuple)) and any(isinstance(a, Task) for a in model):
        raise TypeError(
            f"`model` must be one task, got {len(model)} of them; for several of them at once "
            "use tasks.Stack, for several points of a backbone tasks.PointsTask, for position and "
            "orientation tasks.PoseTask, for anything else a subclass of tasks.Task."
        )
    return model if isinstance(model, Task) else PositionTask(model)


def _checked_levels(levels: Sequence[int] | None, count: int) -> tuple[int, ...]:
    """Return the levels of tasks, checked; 0 for all without them."""
    if levels is None:
        return (0,) * count
    need = f"`levels` must be whole numbers 0, 1, ... without a gap, one for each of {count} tasks"
    if isinstance(levels, str) or not isinstance(levels, Iterable):
        raise TypeError(f"{need}, got {levels!r:.80}.")
    numbers = tuple(levels)
    good = all(isinstance(a, int | np.integer) for a in numbers) and len(numbers) == count
    if not good or {*numbers} != {*range(1 + max(numbers))}:
        raise ValueError(f"{need}, got {numbers}.")
    return tuple(int(level) for level in numbers)


def _length(value: float, name: str) -> float:
    """Return the weight of a rotation [m/rad], checked."""
    length = number(value, name)
    if not 0.0 < length < math.inf:
        raise ValueError(f"`{name}` must be a positive length [m], got {value!r}.")
    return length


def _through_numpy(function: Callable[[NDArray], ArrayLike], q: Tensor) -> Tensor:
    """Return the result of a NumPy function as a tensor without a graph."""
    if q.requires_grad and torch.is_grad_enabled():
        raise ValueError(
            "`model` must be twice differentiable by torch for derivatives of the solution, got "
            "NumPy functions."
        )
    return as_tensor(function(q.numpy(force=True)), "model", q.device)
