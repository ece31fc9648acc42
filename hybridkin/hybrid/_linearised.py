"""Ridge regression on features times Jacobians: optimum, held-out residuals, penalties."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import product
from math import inf, log10
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.utils import gen_batches
from torch import Tensor

from hybridkin._core.arrays import identity
from hybridkin._core.groups import Groups

Pair = tuple[float, float]
_GRID = (inf, 4.0, 0.0, -4.0)  # penalties to start with, in half decades
_LOW = (-6.0, -12.0)
_HIGH = 8.0
_EQUAL = 1e-3
_RANK = 1e-8  # least share of the features' sum of squares for an axis to be kept
_FOLDS = 10  # up to this number of groups, Gram matrices are kept even for groups of few rows
_BLOCK = 2**22  # numbers in the products that are kept: 32 MB


class Products:
    """The products phi_k phi_l, l <= k, of the features of every row.

    A sum over rows of these products is one matrix product. For few rows the products are kept;
    for many rows they are computed at every use, block by block.

    Parameters
    ----------
    phi : Tensor of shape (N, K)
        Features.
    """

    def __init__(self, phi: Tensor) -> None:
        self.phi = phi.numpy(force=True)
        self._rows = max(_BLOCK // _pairs(phi.shape[1]), 1)
        self._kept: list[tuple[slice, NDArray]] = []
        if len(phi) <= self._rows:
            self._kept = [*self._blocks()]

    def __iter__(self) -> Iterator[tuple[slice, NDArray]]:
        """Yield blocks of n rows, and their products (K (K + 1) / 2, n)."""
        return iter(self._kept or self._blocks())

    def _blocks(self) -> Iterator[tuple[slice, NDArray]]:
        for rows in gen_batches(len(self.phi), self._rows):
            columns = self.phi[rows].T.copy()
            block = np.empty((_pairs(len(columns)), columns.shape[1]))
            for k, column in enumerate(columns):
                np.multiply(columns[: k + 1], column, out=block[_pairs(k) : _pairs(k + 1)])
            yield rows, block


class Solution(NamedTuple):
    """The fit to all rows."""

    used: Tensor  # (K,), whether the feature has a finite penalty
    factor: Tensor  # (D, D), the Cholesky factor of the system
    residual: Tensor  # (N, m)


class Reduced(NamedTuple):
    """A system for one penalty of the other features, reduced to the linear ones.

    If the linear features have the weights w, the others have ``offset - slope @ w``.
    """

    system: Tensor  # (C n, C n), without the penalty of the linear features
    right: Tensor  # (C n,)
    slope: Tensor  # (C P, C n)
    offset: Tensor  # (C P,)


class Linearised:
    """The problem sum_n |y_n - J_n W phi_n|^2 + sum_ck penalty_k W_ck^2.

    Features with an infinite penalty are not used.

    Parameters
    ----------
    J : Tensor of shape (N, m, C)
        Jacobians.
    phi : Tensor of shape (N, K)
        Features.
    y : Tensor of shape (N, m)
        Targets.
    products : Products, optional
        Products of the features. Default: they are computed.
    n_linear : int, default=0
        Number of linear features, which come first. Scores of several penalties of these share a
        factorisation.
    """

    def __init__(
        self,
        J: Tensor,
        phi: Tensor,
        y: Tensor,
        products: Products | None = None,
        n_linear: int = 0,
    ) -> None:
        self.J = J
        self.phi = phi
        self.y = y
        self._products = Products(phi) if products is None else products
        self.gram = _gram(J, self._products)
        self.moment = moment(J, y, phi)
        self.n_linear = n_linear
        # Gram matrices and right-hand sides of the rows without a large group.
        self._without: dict[int, tuple[Tensor, Tensor]] = {}
        self._reduced: dict[tuple[int, bytes], Reduced] = {}

    def factor(self, penalty: Tensor) -> tuple[Tensor, Tensor]:
        """Return which features are used (K,), and the Cholesky factor (D, D) of their system."""
        finite = torch.isfinite(penalty)
        gram = self.gram
        if not finite.all():
            gram = gram[:, finite][..., finite]
        flat = gram.flatten(2).flatten(0, 1)
        system = _penalised(flat, penalty[finite], len(gram))
        return finite, torch.linalg.cholesky(system)

    def residual(self, readout: Tensor) -> Tensor:
        """Return y - J W phi, shape (N, m)."""
        return self.y - moved_by(self.J, self.phi, readout)

    def left_out(self, penalty: Tensor, groups: Groups) -> Tensor:
        """Return the residual (N, m) of every row from a fit without that row, or its group.

        Exact: (1 - H_SS)^-1 r_S, with H the hat matrix and S the rows of a group. Groups with
        more rows than there are weights are subtracted from the system instead.

        Parameters
        ----------
        penalty : Tensor of shape (K,)
            Penalty of every feature.
        groups : Groups
            Group of every row, the same at every call.
        """
        if not groups.whole:
            return self._single_rows_left_out(penalty)
        n_weights = len(self.gram) * int(torch.isfinite(penalty).sum())
        few = n_weights if groups.number > _FOLDS else n_weights // 4
        all_rows = None
        left_out = torch.empty_like(self.y)
        for group, rows in enumerate(groups.members):
            if self.y[rows].numel() > few:
                left_out[rows] = self._refitted_without(group, rows, penalty)
            else:
                all_rows = all_rows or self._solved(penalty)
                left_out[rows] = self._few_left_out(rows, all_rows)
        return left_out

    def _solved(self, penalty: Tensor) -> Solution:
        used, L = self.factor(penalty)
        residual = self.residual(solve_kept(self.moment, used, L))
        return Solution(used, L, residual)

    def _single_rows_left_out(self, penalty: Tensor) -> Tensor:
        used, L, residual = self._solved(penalty)
        covariance = self._spread(used, torch.cholesky_inverse(L))
        leverage = self.J @ covariance @ self.J.mT
        unexplained = identity(leverage.shape[1], leverage) - leverage
        return torch.linalg.solve(unexplained, residual)

    def _few_left_out(self, rows: Tensor, all_rows: Solution) -> Tensor:
        """Return the residuals of one group, from the fit to all rows."""
        used, L, residual = all_rows
        A = design(self.J[rows], self.phi[rows][:, used]).flatten(0, 1)
        white = torch.linalg.solve_triangular(L, A.mT, upper=False)
        unexplained = identity(len(A), A) - white.mT @ white
        of_group = residual[rows]
        return torch.linalg.solve(unexplained, of_group.flatten()).view_as(of_group)

    def _refitted_without(self, group: int, rows: Tensor, penalty: Tensor) -> Tensor:
        """Return the residuals of one group, from the system without its rows."""
        J = self.J[rows]
        phi = self.phi[rows]
        y = self.y[rows]
        n = self.n_linear
        linear, others = penalty.tensor_split([n])
        key = group, others.numpy().tobytes()
        if key not in self._reduced:
            if group not in self._without:
                gram = self.gram - _gram(J, Products(phi))
                self._without[group] = gram, self.moment - moment(J, y, phi)
            self._reduced[key] = _reduced(*self._without[group], others)
        reduced = self._reduced[key]
        used = torch.isfinite(linear)
        system = _penalised(reduced.system, linear, len(self.gram))
        right = reduced.right
        slope = reduced.slope
        if not used.all():
            of_used = used.repeat(len(self.gram))
            system = system[of_used][:, of_used]
            right = right[of_used]
            slope = slope[:, of_used]
        w = torch.cholesky_solve(right[:, None], torch.linalg.cholesky(system))[:, 0]
        readout = torch.zeros_like(self.moment)
        readout[:, :n][:, used] = w.view(len(readout), -1)
        of_others = reduced.offset - slope @ w
        readout[:, n:][:, torch.isfinite(others)] = of_others.view(len(readout), -1)
        return y - moved_by(J, phi, readout)

    def _spread(self, used: Tensor, inverse: Tensor) -> Tensor:
        """Return the covariance (N, C, C) of W phi, from that of W (D, D)."""
        C = self.J.shape[2]
        features = used.nonzero()[:, 0].numpy()
        K = int(features.max(initial=-1)) + 1
        # The covariance of all weights: zero for unused features.
        weights = np.add.outer(K * np.arange(C), features).ravel()
        covariance = np.zeros((C * K, C * K))
        covariance[np.ix_(weights, weights)] = inverse.numpy()
        # phi' S_ab phi is a sum over the products phi_k phi_j, j <= k.
        a, b = np.tril_indices(C)
        k, j = np.tril_indices(K)
        blocks = covariance.reshape(C, K, C, K)[a, :, b]
        folded = blocks[:, k, j] + blocks[:, j, k]
        folded[:, k == j] *= 0.5
        spread = np.empty((C, C, len(self.phi)))
        for rows, block in self._products:
            entries = folded @ block[: len(k)]
            spread[a, b, rows] = entries
            spread[b, a, rows] = entries
        return torch.from_numpy(spread).permute(2, 0, 1)


def _reduced(gram: Tensor, right: Tensor, penalty: Tensor) -> Reduced:
    """Return the system of a Gram matrix (C, K, C, K) and a right-hand side (C, K), reduced.

    The last features have the penalties (P,); those with an infinite one are not used.
    """
    n = gram.shape[1] - len(penalty)
    used = torch.isfinite(penalty)
    linear = gram[:, :n, :, :n].flatten(2).flatten(0, 1)
    right_linear, right_others = right.tensor_split([n], dim=1)
    both = gram[:, n:, :, :n]
    others = gram[:, n:, :, n:]
    if not used.all():
        both = both[:, used]
        others = others[:, used][..., used]
        right_others = right_others[:, used]
    both = both.flatten(2).flatten(0, 1)
    others = _penalised(others.flatten(2).flatten(0, 1), penalty[used], len(gram))
    right_sides = torch.cat([both, right_others.reshape(-1, 1)], dim=1)
    solved = torch.cholesky_solve(right_sides, torch.linalg.cholesky(others))
    slope = solved[:, :-1]
    offset = solved[:, -1]
    return Reduced(
        linear - both.mT @ slope,
        right_linear.flatten() - both.mT @ offset,
        slope,
        offset,
    )


def _penalised(system: Tensor, penalty: Tensor, n_outputs: int) -> Tensor:
    """Return a system (C P, C P) with the penalties (P,) of C outputs on its diagonal."""
    diagonal = system.diagonal() + penalty.repeat(n_outputs)
    return torch.diagonal_scatter(system, diagonal)


def _gram(J: Tensor, products: Products) -> Tensor:
    """Return sum_n (J' J)_ab phi phi', shape (C, K, C, K)."""
    C = J.shape[2]
    K = products.phi.shape[1]
    a, b = np.tril_indices(C)
    of_coordinates = (J.mT @ J).numpy()[:, a, b]
    sums = np.zeros((_pairs(C), _pairs(K)))
    for rows, of_features in products:
        sums += of_coordinates[rows].T @ of_features.T
    gram = np.take(sums, _places(K), axis=1)[_places(C)]
    return torch.from_numpy(gram.transpose(0, 2, 1, 3).copy())


def _pairs(n: int) -> int:
    return n * (n + 1) // 2


def _places(n: int) -> NDArray:
    """Return the places (n, n) of the pairs of n items in the list ordered by the larger item."""
    i, j = np.indices((n, n))
    larger = np.maximum(i, j)
    return larger * (larger + 1) // 2 + np.minimum(i, j)


def moved_by(J: Tensor, phi: Tensor, readout: Tensor) -> Tensor:
    """Return J W phi, shape (N, m)."""
    change = phi @ readout.mT
    return (J @ change[..., None])[..., 0]


def moment(J: Tensor, y: Tensor, phi: Tensor) -> Tensor:
    """Return sum_n J_n' y_n phi_n', shape (C, K)."""
    pulled = (J.mT @ y[..., None])[..., 0]
    return pulled.mT @ phi


def solve_kept(right: Tensor, kept: Tensor, L: Tensor) -> Tensor:
    """Return the solution (C, K) for a right-hand side (C, K), zero for unused features."""
    solution = torch.zeros_like(right)
    coefficients = torch.cholesky_solve(right[:, kept].reshape(-1, 1), L)
    solution[:, kept] = coefficients.reshape(len(right), -1)
    return solution


def design(J: Tensor, phi: Tensor) -> Tensor:
    """Return the matrix (..., m, C P) that maps the entries of W to J W phi."""
    return (J[..., None] * phi[..., None, None, :]).flatten(-2)


def basis(phi: Tensor, n_linear: int, most: int) -> Tensor:
    """Return the basis (P, K) of features (N, P): linear ones, then the rest of the others.

    The part of the other features that the first `n_linear` explain over the rows is subtracted,
    so that their penalty does not act on it. The rest is rotated to its principal axes, which does
    not change the penalty. Axes with almost no data are dropped, and the weakest above `most`.
    """
    linear, bent = phi.tensor_split([n_linear], dim=1)
    explained = torch.linalg.pinv(linear, rtol=1e-6) @ bent
    rest = bent - linear @ explained
    sizes, axes = torch.linalg.eigh(rest.mT @ rest)
    with_data = sizes > _RANK * bent.square().sum()
    axes = axes[:, with_data].flip(1)[:, :most]
    of_linear = torch.cat([identity(n_linear, phi), -explained @ axes], dim=1)
    of_bent = torch.nn.functional.pad(axes, (n_linear, 0))
    return torch.cat([of_linear, of_bent])


def choose(
    score: Callable[[Pair], float], start: Pair | None = None
) -> tuple[Pair, dict[Pair, float]]:
    """Return the pair of penalties with the least score, and the scores of all tried pairs.

    Of pairs whose scores differ by less than a thousandth, the largest is best conditioned.

    Parameters
    ----------
    score : callable
        Score of a pair; a penalty may be infinite.
    start : tuple of two floats, optional
        Start of the search in single steps, besides no correction. Default: a coarse grid.
    """
    scores: dict[Pair, float] = {}  # by half decades

    def best_of(pairs: Iterable[Pair]) -> Pair:
        for pair in pairs:
            if pair not in scores:
                scores[pair] = score(_penalties(pair))
        limit = (1.0 + _EQUAL) * min(scores.values())
        equal = [pair for pair, value in scores.items() if value <= limit]
        return max(equal, key=preference)

    def preference(pair: Pair) -> tuple[int, float, float]:
        n_infinite = pair.count(inf)
        finite = sum(k for k in pair if k < inf)
        return n_infinite, finite, -scores[pair]

    if start is None:
        at = best_of(product(_GRID, _GRID))
        steps = (2.0, 1.0)
    else:
        nearest = _half_decades(start[0]), _half_decades(start[1])
        at = best_of([(inf, inf), nearest])
        steps = (1.0,)
    for step in steps:
        previous = None
        while at != previous:
            previous = at
            linear = _near(at[0], step, _LOW[0])
            bent = _near(at[1], step, _LOW[1])
            at = best_of(product(linear, bent))
    by_penalties = {_penalties(pair): value for pair, value in scores.items()}
    return _penalties(at), by_penalties


def _near(half_decades: float, step: float, low: float) -> list[float]:
    """Return a penalty and its neighbours that are within the limits, or infinite."""
    neighbours = (half_decades + step, half_decades, half_decades - step)
    return [k for k in neighbours if k == inf or low <= k <= _HIGH]


def _half_decades(penalty: float) -> float:
    return penalty if penalty == inf else float(round(2.0 * log10(penalty)))


def _penalties(half_decades: Pair) -> Pair:
    return 10.0 ** (half_decades[0] / 2.0), 10.0 ** (half_decades[1] / 2.0)


def quasi_newton(
    slope: Tensor, pairs: list[tuple[Tensor, Tensor]], factor: tuple[Tensor, Tensor]
) -> Tensor:
    """Return the L-BFGS inverse Hessian times a slope, from changes of readout and slope."""
    forward = []
    for moved, turned in reversed(pairs):
        forward.append((moved * slope).sum() / (moved * turned).sum())
        slope = slope - forward[-1] * turned
    step = solve_kept(slope, *factor)
    for moved, turned in pairs:
        backward = (turned * step).sum() / (moved * turned).sum()
        step = step + (forward.pop() - backward) * moved
    return step
