"""Choice of the configurations to measure next: those that leave the least expected tip error."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin._core.arrays import identity, labels, shaped, whole
from hybridkin._core.model import ForwardModel, as_forward_model
from hybridkin._core.rotations import cross_matrix
from hybridkin.calibration.measured import check_finite
from hybridkin.hybrid import _linearised
from hybridkin.hybrid._features import PoseFeatures, QuadraticFeatures
from hybridkin.hybrid._module import Hybrid
from hybridkin.hybrid._structure import StructureDesign
from hybridkin.hybrid.estimator import HybridForwardModel

# For models without the errors of a structure: standard deviations at the tip, in reaches of the
# robot. Priors: weights of linear features and of other features, translation of the base, its
# rotation [rad]. Last: noise of a measured tip.
_LINEAR = 0.055
_OTHER = 0.0165
_SHIFT = 0.033
_TURN = 0.1
_NOISE = 0.0055
# What the errors of a structure leave, of a coordinate, in reaches of the robot: from row to row,
# and as a quadratic function of q, by which rows spread over the range.
_ROUGH = 0.009
_SMOOTH = 0.02
_MOST_SMOOTH = 60  # quadratic functions
_LARGEST = 1000  # parameters above which features are reduced
_MOST = 5000  # parameters
_BLOCK = 1000  # rows whose design matrix is in memory at once
_ROWS = 8  # that represent a motion
_WORTH = 2.0  # independent rows that they count as


def choose_rows(
    model: object,
    candidates: ArrayLike,
    n: int,
    *,
    measured: ArrayLike | None = None,
    target: ArrayLike | None = None,
    groups: ArrayLike | None = None,
) -> tuple[NDArray, NDArray]:
    """Return which candidates to measure next, in order, and the error expected after each.

    Greedy Bayesian I-optimality: each chosen row reduces the expected error over the target most.
    The error of the mechanical model is assumed linear in unknown parameters. Of a chain with one
    arc for each segment they are the errors of its structure, which ``error_model="structural"``
    and "auto" learn, with the same prior and noise, and a smooth function that these leave. Of
    another chain of arcs they are weights of pose features, else of quadratic features, and a small
    motion of the base. The choice depends on the actuator vectors, not on measured tips, so all
    rows can be chosen before the first measurement.

    Do not use rows chosen for learning for a calibration without learning. They lie where the
    mechanical model has its largest errors, and make such a calibration worse.

    Parameters
    ----------
    model : ForwardModel, HybridForwardModel or callable
        A chain, any other model that `as_forward_model` accepts, or a fitted hybrid. Of a hybrid,
        the mechanical model with the learned errors of its structure is used.
    candidates : array-like of shape (N, n_actuators)
        Actuator vectors that can be measured, for example a few thousand over the whole range
        [unit of q]. With backlash: the motion of the actuators, not the commands.
    n : int
        How many to choose.
    measured : array-like of shape (M, n_actuators), optional
        Actuator vectors that are already measured [unit of q], e.g. those of a hybrid's fit.
    target : array-like of shape (K, n_actuators), optional
        Where the error must be small, for example along a path [unit of q]. Default: all
        candidates.
    groups : array-like of shape (N,), optional
        Motion of every candidate. Whole motions are chosen. Eight rows from the first to the last
        represent each motion and count as two independent rows.

    Returns
    -------
    indices : ndarray of int or labels, of shape (n,)
        Rows of `candidates`, or labels of motions with `groups`, in the order of the choice: the
        first k are the choice for n=k.
    expected_error : ndarray of shape (n,)
        Expected root mean square tip error over the target after each row [m]. If it falls slowly,
        more rows bring little. It is computed from the size of the robot, not from data: use it to
        compare rows, not as an accuracy. Of the errors of a structure, without what they leave.

    Raises
    ------
    TypeError
        If `model` is not a model.
    ValueError
        For a wrong shape, NaN, more rows than candidates, or a robot with too many parameters
        (float64 matrices stay below 200 MB).

    Warns
    -----
    UserWarning
        For a hybrid with ``error_model="drop"``, which learns nothing.

    Notes
    -----
    For three segments on one core, 100 of 2000 candidates take a second and 80 MB, 100 of 20,000
    five seconds and 200 MB.

    References
    ----------
    Chaloner and Verdinelli, Bayesian Experimental Design: A Review, Statistical Science 10 (1995),
    273-304, section 2.

    Examples
    --------
    >>> from hybridkin import choose_rows, datasets, robots
    >>> pool = datasets.load_trunk().q[::10]
    >>> rows, error = choose_rows(robots.bionic_handling_assistant(), pool, 20)
    >>> rows.shape, bool(error[-1] < 0.5 * error[0])
    ((20,), True)
    """
    if isinstance(model, HybridForwardModel) and model.error_model == "drop":
        warnings.warn(
            "`model` has error_model='drop' and learns nothing: for its calibration, rows chosen "
            "for learning are worse than random rows. Set an error model, or measure random rows.",
            stacklevel=2,
        )
    forward_model = as_forward_model(model)
    robot = forward_model.robot
    if isinstance(forward_model, Hybrid) and forward_model.mechanical is not None:
        forward_model = forward_model.mechanical
    q = _actuators(robot, candidates, "candidates")
    if measured is None:
        measured_rows = q[:0]
    else:
        measured_rows = _actuators(robot, measured, "measured")
    aim = q
    if target is not None:
        aim = _actuators(robot, target, "target")
    names = np.arange(len(q))
    places = np.arange(len(q))[:, None]
    if groups is not None:
        names, places = _few_rows_of(labels(groups, len(q)))
    n = whole(n, "n", 1, len(names))  # of the candidates
    rows = torch.cat([q, measured_rows, aim])
    places = torch.from_numpy(places)
    try:
        chosen, error = _chosen(robot, forward_model, rows, q[places], n, measured_rows, aim)
    except torch.linalg.LinAlgError as failure:  # pyright: ignore
        raise ValueError(
            "`candidates`, `measured` or `target` hold numbers too large for the model; check "
            "their unit."
        ) from failure
    return names[chosen], error


def _chosen(
    robot: ForwardModel,
    model: ForwardModel,
    rows: Tensor,
    q: Tensor,
    n: int,
    measured: Tensor,
    aim: Tensor,
) -> tuple[list[int], NDArray]:
    """Return n of the motions q (G, R, n), and the errors; `rows` set the units."""
    with torch.no_grad():
        if robot.has_one_arc_per_segment:
            errors = _StructuralErrors(robot, model, rows)
        else:
            errors = _TipErrors(robot, rows)
        return _greedy(errors, q, n, measured, aim)


def _few_rows_of(groups: NDArray) -> tuple[NDArray, NDArray]:
    """Return the labels of all motions (G,), and R rows of each, from first to last, (G, R)."""
    names, of_row, counts = np.unique(groups, return_inverse=True, return_counts=True)
    order = np.argsort(of_row, kind="stable")
    ends = np.cumsum(counts)
    return names, order[np.rint(np.linspace(ends - counts, ends - 1, _ROWS).T).astype(int)]


def _actuators(robot: ForwardModel, value: ArrayLike, name: str) -> Tensor:
    """Return checked rows (N, n)."""
    q = shaped(value, name, ["N", str(robot.n_actuators or "n")])
    if not len(q):
        raise ValueError(f"`{name}` must hold at least one row, got none.")
    check_finite(**{name: q})
    rows = torch.from_numpy(q)
    for message in robot.check_actuators(rows, name):
        warnings.warn(message, stacklevel=3)
    return rows


class _Errors(ABC):
    """The tip error as A theta, with theta ~ N(0, 1), and the noise of a measured tip."""

    @abstractmethod
    def design(self, q: Tensor) -> Tensor:
        """Return A for rows q (N, n), shape (N, m, P) [m]."""

    @abstractmethod
    def noise(self, q: Tensor) -> Tensor:
        """Return the covariance of the noise of rows, shape (N, m, m) [m^2]."""

    @abstractmethod
    def times(self, q: Tensor) -> Callable[[Tensor], Tensor]:
        """Return the function of X (P, K) that gives A X for rows q (N, n), shape (N, m, K)."""

    def reported(self, M: Tensor) -> Tensor:
        """Return the part of the mean M of A' A (P, P) whose error is reported."""
        return M

    def gram(self, q: Tensor) -> Tensor:
        """Return sum_n A_n' A_n over rows q (N, n), shape (P, P)."""
        blocks = (self.design(rows).flatten(0, 1) for rows in q.split(_BLOCK))
        return sum((A.mT @ A for A in blocks), q.new_zeros(()))

    def information(self, q: Tensor) -> Tensor:
        """Return sum_n A_n' R_n^-1 A_n over measured rows with noise R_n, shape (P, P)."""
        total = q.new_zeros(())
        for rows in q.split(_BLOCK):
            A = self.design(rows)
            factor = torch.linalg.cholesky(self.noise(rows))
            white = torch.linalg.solve_triangular(factor, A, upper=False).flatten(0, 1)
            total = total + white.mT @ white
        return total


class _StructuralErrors(_Errors):
    """The tip error by the errors of a chain's structure, see `fit_structure`, and what they leave.

    The rows of A are [structure | phi]. What the errors of the structure leave is partly a smooth
    function of q, here quadratic features phi of unit mean square. Without it, many rows would be
    at the ends of the range, where each of them alone says most of the structure.

    Parameters
    ----------
    chain : ForwardModel
        The chain without these errors, one arc for each segment.
    model : ForwardModel
        Where it is linearised: the chain, or the chain with its learned errors.
    q : Tensor of shape (N, n)
        All rows, which give the mean lengths and the noise of the actuators.
    """

    def __init__(self, chain: ForwardModel, model: ForwardModel, q: Tensor) -> None:
        self.structure = StructureDesign(chain, q)
        self.model = model
        self.features = QuadraticFeatures.of_range(q)
        phi = self.features(q)
        n_linear = self.features.n_linear
        basis = _linearised.basis(phi, n_linear, _MOST_SMOOTH)[:, n_linear:]
        size = (phi @ basis).square().sum(1).mean().sqrt()
        unit = torch.where(size > 0.0, _SMOOTH * self.structure.reach / size, 0.0)
        self.basis = unit * basis

    def design(self, q: Tensor) -> Tensor:
        z, _ = self.model.coordinates(q)
        x, J = self.model.from_coordinates_and_jacobian(z)
        _, fields = self.structure.arcs(q)
        tips = x.unflatten(1, (-1, 3))
        by_arcs = J.unflatten(1, (-1, 3))
        A = self.structure.slopes(tips, by_arcs, fields, q.new_zeros(6))
        phi = self.features(q) @ self.basis
        smooth = torch.einsum("ij,nk->nijk", identity(x.shape[1], q), phi)
        return torch.cat([A, smooth.flatten(2)], dim=2)

    def noise(self, q: Tensor) -> Tensor:
        factor = self.structure.noise(q, self.model.forward_and_jacobian(q)[1])
        misfit = (_ROUGH * self.structure.reach) ** 2
        return factor @ factor.mT + misfit * identity(factor.shape[1], q)

    def reported(self, M: Tensor) -> Tensor:
        n = len(self.structure.names)  # the smooth function only spreads the rows
        of_structure = torch.zeros_like(M)
        of_structure[:n, :n] = M[:n, :n]
        return of_structure

    def times(self, q: Tensor) -> Callable[[Tensor], Tensor]:
        A = torch.cat([self.design(rows) for rows in q.split(_BLOCK)])
        return lambda X: A @ X


class _TipErrors(_Errors):
    """The tip error that a serial hybrid can learn by features.

    The rows of A are [J_z D (x) phi | base]. Weights of the features phi(q) act on the coordinates
    z inside the robot, in units D that move the tip by 1 m (rms); the base moves and rotates.

    Parameters
    ----------
    robot : ForwardModel
        The mechanical model.
    q : Tensor of shape (N, n)
        Rows that set the units of features and coordinates.
    """

    def __init__(self, robot: ForwardModel, q: Tensor) -> None:
        self.robot = robot
        if robot.n_arcs:
            self.features = PoseFeatures.of_range(q, robot)
        else:
            self.features = QuadraticFeatures.of_range(q)
        tips, J = robot.from_coordinates_and_jacobian(robot.coordinates(q)[0])
        moved = J.square().sum(1).mean(0).sqrt()
        self.units = torch.where(moved > 1e-9 * moved.max(), 1.0 / moved, 0.0)
        self.center = tips.mean(0)
        size = (tips - tips.mean(0)).norm(dim=1).max()
        self.size = torch.where(size > 0.0, size, 1.0)
        if robot.geometry():
            self.center = robot.origin.to(q)
            self.size = robot.reach.to(q)
        n_linear = self.features.n_linear
        if len(self.units) * n_linear > _MOST:
            raise ValueError(
                f"`model` must have at most {_MOST} weights to learn, so that matrices stay below "
                f"200 MB, got {len(self.units)} coordinates times {n_linear} linear features."
            )
        most = max(_LARGEST // len(self.units) - n_linear, 0)
        basis = _linearised.basis(self.features(q), n_linear, most)
        linear, nonlinear = basis.tensor_split([n_linear], dim=1)
        self.basis = self.size * torch.cat([_LINEAR * linear, _OTHER * nonlinear], dim=1)
        self.variance = (_NOISE * self.size) ** 2

    def parts(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return J_z D (N, m, C), the features (N, K) and the columns of the base (N, m, B)."""
        tips, J = self.robot.from_coordinates_and_jacobian(self.robot.coordinates(q)[0])
        base = (_SHIFT * self.size * identity(tips.shape[1], q)).expand(len(q), -1, -1)
        if tips.shape[1] == 3:
            base = torch.cat([base, -_TURN * cross_matrix(tips - self.center)], dim=2)
        return J * self.units, self.features(q) @ self.basis, base

    def design(self, q: Tensor) -> Tensor:
        J, phi, base = self.parts(q)
        return torch.cat([_linearised.design(J, phi), base], dim=2)

    def noise(self, q: Tensor) -> Tensor:
        m = len(self.center)
        return (self.variance * identity(m, q)).expand(len(q), -1, -1)

    def times(self, q: Tensor) -> Callable[[Tensor], Tensor]:
        J, phi, base = self.parts(q)
        C = J.shape[2]
        K = phi.shape[1]

        def product(X: Tensor) -> Tensor:
            weights, moves = X.tensor_split([C * K])
            inside = phi @ weights.view(C, K, -1).transpose(0, 1).flatten(1)
            return J @ inside.unflatten(1, (C, -1)) + base @ moves

        return product


def _greedy(
    errors: _Errors, q: Tensor, n: int, measured: Tensor, aim: Tensor
) -> tuple[list[int], NDArray]:
    """Return n of the motions q (G, R, n), each the best given those before, and the errors.

    With S the covariance of theta, M the mean of A' A over the target and R the noise, a motion
    with rows A reduces the mean squared error tr(M S) by tr[(A S A' + R)^-1 A S M S A']. A chosen
    motion changes S by a matrix of low rank, with which both products are updated for all motions.
    """
    size = q.shape[1]
    flat = q.flatten(0, 1)
    times = errors.times(flat)
    noise = _of_motions(errors.noise(flat), size)
    M = errors.gram(aim) / len(aim)
    information = identity(len(M), M) + errors.information(measured)
    S = torch.cholesky_inverse(torch.linalg.cholesky(information))
    SMS = S @ M @ S
    blocks = (errors.design(part.flatten(0, 1)) for part in q.split(_BLOCK // size))
    designs = (A.flatten(0, 1).unflatten(0, (-1, size * A.shape[1])) for A in blocks)
    about = [(A @ S @ A.mT, A @ SMS @ A.mT) for A in designs]
    spread, worth = (torch.cat(part) for part in zip(*about, strict=True))
    reported = errors.reported(M)
    left = (reported * S).sum()
    chosen = []
    squares = []
    free = torch.ones_like(spread[:, 0, 0], dtype=torch.bool)
    for _ in range(n):
        gain = torch.linalg.solve(spread + noise, worth).diagonal(dim1=1, dim2=2).sum(1)
        k = int(torch.where(free, gain, -1.0).argmax())
        free[k] = False
        A = errors.design(q[k]).flatten(0, 1)
        L = torch.linalg.cholesky(spread[k] + noise[k])
        G = torch.linalg.solve_triangular(L, A @ S, upper=False).mT
        MG = M @ G
        moved = times(torch.cat([G, S @ MG], dim=1)).view(len(q), len(A), -1)
        a, b = moved.split(len(A), dim=2)
        cross = a @ b.mT
        worth = worth - cross - cross.mT + a @ (G.mT @ MG) @ a.mT
        spread = spread - a @ a.mT
        S = S - G @ G.mT
        left = left - (G * (reported @ G)).sum()
        chosen.append(k)
        squares.append(float(left))
    return chosen, np.sqrt(np.maximum(squares, 0.0))


def _of_motions(noise: Tensor, size: int) -> Tensor:
    """Return the covariances (G, R m, R m) of motions of R rows from those of rows (G R, m, m).

    Rows of a motion have similar errors.
    """
    blocks = max(1.0, size / _WORTH) * noise.unflatten(0, (-1, size))
    own = identity(size, noise)[:, None, :, None]
    return (own * blocks[:, :, :, None]).flatten(3, 4).flatten(1, 2)
