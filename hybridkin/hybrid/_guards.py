"""Guards: smooth weights, from a leverage, that fade a learned correction out."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import eigh, solve_triangular
from torch import Tensor, nn

from hybridkin._core.arrays import identity
from hybridkin._core.blocks import in_blocks
from hybridkin._core.chosen import chosen
from hybridkin._core.directions import Directions, moved_directions
from hybridkin._core.kernel_numbers import (
    HK_FULL,
    HK_GROUP,
    HK_LONGEST,
)
from hybridkin._core.model import ForwardModel
from hybridkin._core.plan import Plan
from hybridkin._core.portable import PortableModule
from hybridkin._core.stored import Layout, Stored
from hybridkin.calibration.choice import split_by_effect
from hybridkin.hybrid._features import center_and_scale
from hybridkin.hybrid._rows import Rows
from hybridkin.learning.network import (
    ELM,
    LeverageModule,
    lever_numbers,
    write_network,
)

GUARDS = ("leverage", None)
_AS_IF = 0.1  # of half the range: the spread assumed in a direction that the log does not move
_ROWS = 128  # number of rows that represent the training rows
_BLOCK = 4096  # training rows whose distances are computed at once
_TESTED = 0.98  # share of these rows whose distances from other groups count as tested
_STEP = 0.2  # least tested distance, and the domain without data; the range of an actuator is 2
_OFF = 0.02  # domain off the plane of a log; the range of an actuator is 2
_AS_LOGGED = 3.0  # plus so many times its rms there
_BESIDE = 1000  # rows of the log, and as many beside them, for which distances are kept
_BEYOND = 1.5  # how far beside, in ranges of the log
_CHANGE = 4e-4  # largest relative change of their distances; of weights it is at most twice this
_ROUNDING = 1e-11  # largest rounding of their distances; 5e-3 in float32


class Guard(PortableModule):
    """Limits of a correction: a weight g(q), and a largest length.

    The weight is 1 where `domain_distance` is at most `FULL`, and decreases to 0 outside. Weight
    and shortening are twice continuously differentiable, so the full Jacobian is continuous.

    Parameters
    ----------
    largest : Tensor of shape ()
        The longest correction of a training row [m]. Longer ones are shortened to less than
        `MOST` times this length, which limits the distance from the mechanical model everywhere.
    """

    MOST = HK_LONGEST
    FULL = HK_FULL

    def __init__(self, largest: Tensor) -> None:
        super().__init__()
        self.register_buffer("largest", largest)

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the distance of q from the training rows, at most 1 in the domain, (...)."""
        raise NotImplementedError

    def domain_distance_and_gradient(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances (N,) of rows q (N, n), and their derivatives (N, n)."""
        raise NotImplementedError

    def forward(self, q: Tensor) -> Tensor:
        """Return g(q), shape (..., 1)."""
        return self._weight(self.domain_distance(q))[0][..., None]

    def weight_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return g(q) (N, 1) and its derivative (N, 1, n) at rows q (N, n)."""
        distance, gradient = self.domain_distance_and_gradient(q)
        weight, excess = self._weight(distance)
        # NaN where the square overflows, as in the kernels: such rows are refused.
        slope = (-3.0 / self.FULL) * excess.square() * weight.square()
        return weight[:, None], (slope[:, None] * gradient)[:, None]

    def _weight(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Return g at distances (...), and how far these exceed `FULL`, in parts of it."""
        excess = (distance / self.FULL - 1.0).clamp(min=0.0)
        # 0 where the distance overflows.
        return (1.0 / (1.0 + excess**3)).nan_to_num(), excess

    def shortened(self, correction: Tensor) -> Tensor:
        """Return corrections (..., m); those longer than `largest` are shortened [m]."""
        relative = self._relative(correction)
        return correction * (self._kept(relative)[0] / relative)

    def shortened_with_jacobian(self, correction: Tensor, J: Tensor) -> tuple[Tensor, Tensor]:
        """Return the `shortened` corrections (N, m), and their Jacobians (N, m, n)."""
        long = chosen(self.is_long(correction), costly=False)
        if long.is_empty:
            return correction, J
        too_long = long.take(correction)
        J_own = long.take(J)
        relative = self._relative(too_long)
        remaining, slope = self._kept(relative)
        # Derivative along the correction: the slope; across it: the factor.
        factor = remaining / relative
        length = too_long.norm(dim=-1, keepdim=True).clamp(min=_shortest(correction))
        along = (too_long / length)[..., None]
        change = (slope - factor)[..., None] * along @ (along.mT @ J_own)
        J_own = factor[..., None] * J_own + change
        return long.put(correction, factor * too_long), long.put(J, J_own)

    def is_long(self, correction: Tensor) -> Tensor:
        """Return which corrections (..., m) are longer than `largest`, shape (...)."""
        return self._relative(correction)[..., 0] > 1.0

    def _relative(self, correction: Tensor) -> Tensor:
        # Lengths up to `largest` count as one. They are not shortened, and the root stays smooth.
        unit = self.largest.to(correction).clamp(min=_shortest(correction))
        squares = (correction / unit).square().sum(-1, keepdim=True)
        return squares.clamp(min=1.0).sqrt()

    def _kept(self, relative: Tensor) -> tuple[Tensor, Tensor]:
        """Return the shortened value of a relative length of at least 1, and its derivative."""
        margin = self.MOST - 1.0
        bent = torch.tanh((relative - 1.0) / margin)
        return 1.0 + margin * bent, 1.0 - bent * bent


def _shortest(like: Tensor) -> float:
    """Return a length whose square, and the square of that, do not underflow."""
    return torch.finfo(like.dtype).tiny ** 0.25


def _write_leverage_guard(plan: Plan, stored: Stored) -> int:
    model = stored.part("model")
    if model.kind == "elm":
        place = write_network(plan, model, leverage=True)
    else:
        place = plan.node_of(model)
    n, _ = plan.lengths(place)
    return plan.node(
        "leverage_guard", n, 0, [stored.array("largest"), stored.array("limit")], place
    )


class LeverageGuard(Guard):
    """Distance from the training rows by the leverage phi^T (G + lambda 1)^-1 phi of a model.

    The domain ends at distance 1. Errors outside it are not known, but up to distance `FULL` a
    correction still removes more error than it adds, so it fades out only from there.

    Parameters
    ----------
    model : LeverageModule
        Gives the leverage: the error model itself if it is a network at the tip, else a
        `QuadraticLeverage`, which does not depend on the features of the error model.
    limit : Tensor of shape ()
        The leverage at distance 1.
    largest : Tensor of shape ()
        The longest correction of a training row [m].
    """

    layout = Layout(
        "leverage_guard",
        {"limit": "", "largest": ""},
        parts=("model",),
        write_plan=_write_leverage_guard,
    )

    def __init__(self, model: LeverageModule, limit: Tensor, largest: Tensor) -> None:
        super().__init__(largest)
        self.model = model
        self.register_buffer("limit", limit)

    @classmethod
    def fit(
        cls, model: LeverageModule, q: Tensor, largest: Tensor, counts: Tensor
    ) -> LeverageGuard:
        """Return the guard whose limit is the largest leave-one-out leverage of the rows q (N, n).

        That is h / (1 - c h), with h the leverage of a row that counts c times in the fit.
        """
        h = in_blocks(lambda rows: (model.leverage(rows)[:, None],), q)[0][:, 0]
        return cls(model, (h / (1.0 - counts * h).clamp(min=1e-9)).max(), largest)

    def of_low_rank(self, q: Tensor) -> LeverageGuard:
        """Return the guard with a network whose leverage has a prior and few columns.

        With A = R R' the inverse of the Gram matrix plus lambda, and p its largest eigenvalue, the
        leverage is p |v|^2 - v' (p - A) v. The eigenvectors of p - A are sorted: those along which
        the features of the training rows vary most come first, so most rows need only a few for an
        upper bound. Eigenvectors are left out if this does not change the distances of rows in the
        log and beside it. Where p is so large that the difference cancels digits, nothing changes.

        Parameters
        ----------
        q : Tensor of shape (N, n)
            The training rows.
        """
        network = self.model
        if not isinstance(network, ELM):
            return self
        factor = network.leverage_factor.numpy(force=True)
        eigenvalues, axes = eigh(factor @ factor.T)
        prior = eigenvalues[-1]
        columns = axes * np.sqrt(prior - eigenvalues)
        rows = _rows_beside(q)
        with torch.no_grad():
            v = (network.features(rows) - network.leverage_center.to(rows)).numpy()
            least = self.domain_distance(rows).clamp(min=1.0) * self.limit
        squares = np.square(v @ columns) / least.numpy()[:, None]
        rounding = np.square(v).sum(1) * prior / least.numpy() * np.finfo(float).eps
        if not rounding.max() < _ROUNDING:
            return self
        left_out = np.cumsum(squares[:, ::-1], axis=1)[:, ::-1].max(0)
        count = int(np.sum(left_out > _CHANGE))
        count += -count % HK_GROUP  # a kernel takes so many at once
        arrays = {name: a.cpu() for name, a in network.state_dict().items()}
        arrays |= {"leverage_factor": columns[:, :count], "leverage_prior": prior}
        model = ELM(network.activation, **arrays).to(network.leverage_factor.device)
        return LeverageGuard(model, self.limit, self.largest)

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the leverage of q divided by the limit, shape (...)."""
        return self.model.leverage(q) / self.limit.to(q)

    def domain_distance_and_gradient(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances (N,) of rows q (N, n), and their derivatives (N, n)."""
        leverage, gradient = self.model.leverage_and_gradient(q)
        limit = self.limit.to(q)
        return leverage / limit, gradient / limit


def _rows_beside(q: Tensor) -> Tensor:
    """Return rows of the log q (N, n), and rows beside them in random directions."""
    rows = q[:: max(1, len(q) // _BESIDE)].numpy()
    random = np.random.default_rng(0)
    start = rows[random.integers(len(rows), size=_BESIDE)]
    direction = random.normal(size=start.shape) ** 3  # few actuators move most
    direction /= np.abs(direction).max(1, keepdims=True)
    far = random.uniform(0.0, _BEYOND, (_BESIDE, 1))
    beside = start + far * direction * np.ptp(rows, axis=0)
    return torch.from_numpy(np.concatenate([rows, beside]))


def _write_quadratic_leverage(plan: Plan, stored: Stored) -> int:
    center = stored.array("center")
    half_width = stored.array("half_width")
    # |L^-1 phi|^2 in the form of a network's leverage: R = L^-T is upper triangular.
    identity_matrix = np.eye(2 * len(center) + 1)
    factor = solve_triangular(stored.array("factor"), identity_matrix, lower=True).T
    zeros = np.zeros(1), np.zeros(1), np.zeros(len(factor))
    _, lever, columns = lever_numbers(plan, *zeros, np.triu(factor))
    numbers = [center, 1.0 / half_width, *lever, columns]
    return plan.node("quadratic_leverage", len(center), 0, numbers, aligned=True)


class QuadraticLeverage(LeverageModule):
    """Leverage in linear and squared inputs, for error models without their own leverage.

    Parameters
    ----------
    center, half_width : Tensor of shape (n,)
        Map of the training range to [-1, 1].
    factor : Tensor of shape (2 n + 1, 2 n + 1)
        Lower Cholesky factor of the features' Gram matrix plus the penalty.
    """

    layout = Layout(
        "quadratic_leverage",
        {"center": "n", "half_width": "n", "factor": "ff"},
        write_plan=_write_quadratic_leverage,
    )

    def __init__(self, center: Tensor, half_width: Tensor, factor: Tensor) -> None:
        super().__init__()
        self.register_buffer("center", center)
        self.register_buffer("half_width", half_width)
        self.register_buffer("factor", factor)

    @classmethod
    def fit(cls, q: Tensor, alpha: float = 0.1) -> QuadraticLeverage:
        """Return the leverage of training rows q (N, n)."""
        n = q.shape[1]
        directions = moved_directions(q.numpy())
        scale, still = map(torch.from_numpy, (directions.scale, directions.still))
        leverage = cls(center_and_scale(q)[0], scale, identity(2 * n + 1, q))
        features = leverage.forward(q)
        gram = features.mT @ features
        gram.diagonal().add_(alpha)
        gram[1 : n + 1, 1 : n + 1] += _AS_IF**2 * len(q) * still @ still.mT
        leverage.factor = torch.linalg.cholesky(gram)
        return leverage

    def forward(self, q: Tensor) -> Tensor:
        """Return the features [1, u, u^2], shape (..., 2 n + 1)."""
        u = (q - self.center.to(q)) / self.half_width.to(q)
        return torch.cat([torch.ones_like(u[..., :1]), u, u * u], dim=-1)

    def leverage(self, q: Tensor) -> Tensor:
        """Return phi^T (Phi^T Phi + alpha 1)^-1 phi, shape (...)."""
        phi = self(q)
        # One solve for all rows, not one for each.
        white = self._white(torch.atleast_2d(phi))
        return white.square().sum(-1).view(phi.shape[:-1])

    def leverage_and_gradient(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the leverage (N,) of rows q (N, n), and its derivative (N, n)."""
        half_width = self.half_width.to(q)
        phi = self(q)
        white = self._white(phi)
        lower = self.factor.to(q)
        by_phi = 2.0 * torch.linalg.solve_triangular(lower, white, upper=False, left=False)
        _, u, _ = phi.tensor_split([1, 1 + len(half_width)], dim=1)
        _, by_u, by_square = by_phi.tensor_split([1, 1 + len(half_width)], dim=1)
        return white.square().sum(1), (by_u + 2.0 * u * by_square) / half_width

    def _white(self, phi: Tensor) -> Tensor:
        """Return L^-1 phi of rows phi (N, 2 n + 1)."""
        upper = self.factor.to(phi).mT
        return torch.linalg.solve_triangular(upper, phi, upper=True, left=False)


def fit_guard(
    kind: str | None,
    corrections: Tensor,
    model: nn.Module | None,
    q: Tensor,
    counts: NDArray,
) -> Guard | None:
    """Return the guard of an error model trained on rows q (N, n).

    Parameters
    ----------
    kind : {"leverage", None}
        The guard.
    corrections : Tensor of shape (N, m)
        Output of the error model for these rows [m].
    model : nn.Module or None
        The error model, which may have its own leverage.
    q : Tensor of shape (N, n)
        The training rows.
    counts : ndarray of shape (N,)
        Number of times each row counts.
    """
    if kind is None:
        return None
    largest = corrections.norm(dim=-1).max()
    times = torch.from_numpy(counts)
    with torch.no_grad():
        if not isinstance(model, LeverageModule):
            # Every configuration counts once, even if the log repeats it.
            model = QuadraticLeverage.fit(torch.unique(q, dim=0))
            times = torch.ones_like(times)
        return LeverageGuard.fit(model, q, largest, times)


def _write_group_distance(plan: Plan, stored: Stored) -> int:
    rows = stored.array("rows")
    axes = stored.array("axes") / stored.array("farthest")
    center = rows.mean(0)
    padding = (0, -len(rows) % HK_GROUP), (0, 0)
    placed = np.pad((rows - center) @ axes, padding, mode="edge")
    groups = placed.reshape(-1, HK_GROUP, axes.shape[1]).swapaxes(1, 2)
    numbers = [center, axes.T, groups]
    return plan.node("group_distance", len(center), 0, numbers, *groups.shape[:2])


class GroupDistance(PortableModule):
    """Distance from the training rows, at most 1 in the part that held-out groups have tested.

    Held-out errors are valid for rows that are no farther from the training rows than these are
    from the rows of other groups. A leverage cannot check this: motions of single actuators excite
    all of its features [1, u, u^2], but show nothing about combined motions.

    Parameters
    ----------
    rows : Tensor of shape (R, n)
        Training rows that represent all of them.
    axes : Tensor of shape (n, k)
        Directions in which the rows move, per range of each actuator.
    farthest : Tensor of shape ()
        Largest distance of a training row from the rows of other groups, except for a few rows.
    """

    layout = Layout(
        "group_distance",
        {"rows": "rn", "axes": "nk", "farthest": ""},
        write_plan=_write_group_distance,
    )

    def __init__(self, rows: Tensor, axes: Tensor, farthest: Tensor) -> None:
        super().__init__()
        self.register_buffer("rows", rows)
        self.register_buffer("axes", axes)
        self.register_buffer("farthest", farthest)

    @classmethod
    def fit(cls, q: Tensor, groups: NDArray) -> GroupDistance | None:
        """Return the distance for training rows q (N, n) in groups (N,), None for one group."""
        of = torch.from_numpy(np.unique(groups, return_inverse=True)[1])
        if not of.any():
            return None
        directions = moved_directions(q.numpy())
        axes = torch.from_numpy(directions.moved / directions.scale[:, None])
        y = (q - q.mean(0)) @ axes
        # Each added row is the farthest from the rows before.
        picked = [y.square().sum(1).argmax()]
        gap = y.new_full((len(y),), torch.inf)
        # Reused: allocating it each time costs more than the sums.
        step = torch.empty_like(y)
        while True:
            torch.sub(y, y[picked[-1]], out=step)
            gap = torch.minimum(gap, step.square_().sum(1))
            if len(picked) == _ROWS or not gap.any():
                break
            picked.append(gap.argmax())
        rows = torch.stack(picked)
        group = of[rows, None]
        apart = y.new_full((len(rows),), torch.inf)
        for some, theirs in zip(y.split(_BLOCK), of.split(_BLOCK), strict=True):
            far = torch.cdist(y[rows], some).masked_fill(group == theirs, torch.inf)
            apart = torch.minimum(apart, far.amin(1))
        # All training rows are within the gap of a picked row, so distances differ by at most it.
        # If every motion was repeated, the clamp keeps the domain from being empty.
        return cls(q[rows], axes, (apart.quantile(_TESTED) + gap.max().sqrt()).clamp(min=_STEP))

    @classmethod
    def of_log(
        cls,
        rows: Rows,
        held_out: bool,
        plane: Plane | None,
    ) -> GroupDistance | None:
        """Return the distance from the groups, and across the directions that no row moves.

        With `held_out`, errors of held-out groups have tested the model.

        Where mechanics predict what happens there, steps of a tenth of the range stay in the
        domain; off the plane, only steps of a hundredth. None if there is nothing to measure.
        """
        q = rows.q
        directions = rows.directions
        tested = None
        if held_out:
            tested = cls.fit(q, rows.groups.labels)
        if not directions.still.size and plane is None:
            return tested
        if tested is None:
            tested = cls(q.mean(0)[None], q[:0].mT, q.new_tensor(_STEP))
        scale = torch.from_numpy(directions.scale)[:, None]
        still = torch.from_numpy(directions.still) / scale
        axes = [tested.axes, still * (tested.farthest / _STEP)]
        if plane is not None:
            half_ranges = (scale * plane.normals).norm(dim=0)
            off = half_ranges * _OFF + _AS_LOGGED * plane.distances(q).square().mean(0).sqrt()
            axes.append(plane.normals * (tested.farthest / off))
        return cls(tested.rows, torch.cat(axes, 1), tested.farthest)

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the squared relative distance of rows q (N, n) from the nearest row, (N,)."""
        rows = self.rows.to(q)
        axes = self.axes.to(q) / self.farthest.to(q)
        with torch.no_grad():
            nearest = torch.cdist(q @ axes, rows @ axes).argmin(1)
        return ((q - rows[nearest]) @ axes).square().sum(1)

    def distances(self, q: Tensor) -> Tensor:
        """Return the distances (N,) of rows q (N, n); the range of an actuator is 2."""
        return self.domain_distance(q).sqrt() * self.farthest


class Plane(PortableModule):
    """The plane of q in which a log lies; outside it neither log nor mechanics say what happens.

    For example, the balanced tendons of a log do not show what happens when all of them are pulled,
    and kinematics of constant length predict that nothing happens.

    Parameters
    ----------
    point : Tensor of shape (n,)
        A point of the plane.
    normals : Tensor of shape (n, k)
        Orthonormal columns.
    """

    layout = Layout("plane", {"point": "n", "normals": "nk"})

    def __init__(self, point: Tensor, normals: Tensor) -> None:
        super().__init__()
        self.register_buffer("point", point)
        self.register_buffer("normals", normals)

    @classmethod
    def of_log(
        cls, mechanical: ForwardModel | None, q: Tensor, directions: Directions
    ) -> Plane | None:
        """Return the plane of rows q (N, n), None if mechanics move the tip in all directions."""
        normals = directions.normals()
        if mechanical is not None and normals.size:
            normals = normals @ split_by_effect(mechanical, q, normals)[1]
        if not normals.size:
            return None
        return cls(q.mean(0), torch.from_numpy(normals))

    def distances(self, q: Tensor) -> Tensor:
        """Return the distances (N, k) of rows q (N, n) from the plane, along each normal."""
        return (q - self.point) @ self.normals
