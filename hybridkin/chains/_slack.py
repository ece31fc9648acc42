"""Sets of taut tendons, and the linear response of the elastic shape for each set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx

from hybridkin._core.arrays import identity
from hybridkin._core.kernel_numbers import HK_MOST_TURNS, HK_WHOLE_STEPS

MOST = 62  # a set of tendons is the bits of one integer
_EXACT = 24  # bits of a float32


class Elasticity(NamedTuple):
    """Elasticity of the backbone. A shape is its length changes, then x- and y-bendings."""

    readings: Tensor  # (n, 3 S), change of the tendon paths per change of shape
    units: Tensor  # (3 S,), units of the shape with similar effects on the paths
    stiffness: Tensor  # (3 S,)
    rest: Tensor  # (3 S,), the shape without tendons
    zeros: Tensor  # (n,)
    gains: Tensor  # (n,)

    def to(self, like: Tensor | torch.dtype) -> Elasticity:
        """Return it in the dtype and on the device of a tensor, or in a dtype."""
        return Elasticity(*(part.to(like) for part in self))


class Responses(NamedTuple):
    """Linear responses to (q, 1) for M sets of taut tendons."""

    shape: Tensor  # (M, 3 S, n + 1)
    stretch: Tensor  # (M, n, n + 1), negative if slack
    compliance: Tensor  # (M, 3 S, 3 S), shape per generalised force

    def at(self, places: Tensor) -> Responses:
        """Return the responses of some of the sets."""
        return Responses(*(part.index_select(0, places) for part in self))


class Balance(NamedTuple):
    """Shapes in static balance, and values that derivatives use."""

    shape: Tensor  # (N, 3 S)
    pull: Tensor  # (N, n), tensions
    taut: Tensor  # (N, n), bool
    compliance: Tensor  # (N, 3 S, 3 S), shape per generalised force


def responses_of(taut: Tensor, elasticity: Elasticity) -> Responses:
    """Return the linear responses for M sets of taut tendons (M, n).

    With the readings B of the taut tendons and the stiffness K of the backbone the shape is
    ``a = (K + B' B)^-1 (K a0 + B' (gains * q - zeros))``.
    """
    readings, units, stiffness, rest, zeros, gains = elasticity
    pulling = readings.mT * taut[:, None]  # (M, 3 S, n)
    hessian = torch.diag(stiffness) + pulling @ readings

    # Generalised forces: by q, constant, and one of each kind for the compliance. A product with
    # the inverse of the Hessian would lose digits of a soft backbone.
    by_q = pulling * gains
    constant = stiffness * rest - pulling @ zeros
    unit_forces = identity(len(stiffness), readings).expand(taut.shape[0], -1, -1)
    forces = torch.cat([by_q, constant[..., None], unit_forces], dim=-1)

    # Solved in the units of the shape.
    column_units = units[:, None]
    scaled = column_units * hessian * units
    solution, _ = torch.linalg.solve_ex(scaled, column_units * forces)
    responses = column_units * solution
    shape, compliance = responses.split([len(gains) + 1, len(stiffness)], dim=-1)

    commanded = torch.cat([torch.diag(gains), -zeros[:, None]], dim=-1)
    stretch = readings @ shape - commanded
    return Responses(shape, stretch, compliance)


def extended(rows: Tensor) -> Tensor:
    """Return (q, 1) for rows q (N, n), shape (N, n + 1)."""
    return nn.functional.pad(rows, (0, 1), value=1.0)


def applied(maps: Tensor, vectors: Tensor) -> Tensor:
    """Return linear maps (N, m, n) of vectors (N, n)."""
    products = maps @ vectors[..., None]
    return products[..., 0]


def as_mask(codes: Tensor, n: int) -> Tensor:
    """Return sets, given as the bits of integers (N,), as a mask (N, n)."""
    places = torch.arange(n, device=codes.device)
    return (codes[:, None] >> places) & 1 > 0


def as_codes(mask: Tensor) -> Tensor:
    """Return sets, given as a mask (N, n), as the bits of integers (N,)."""
    return _as_codes(mask, _bits(mask.shape[1], mask))


def _bits(n: int, like: Tensor) -> Tensor:
    """Return the bits of n tendons (n,); as floating-point numbers if sums of them are exact."""
    bits = 2 ** torch.arange(n, device=like.device)
    return bits.float() if n <= _EXACT else bits


def _as_codes(mask: Tensor, bits: Tensor) -> Tensor:
    if bits.is_floating_point():  # a product is faster than a sum
        return (mask.to(bits) @ bits).long()
    return (mask * bits).sum(-1)


def find_in_table(rows: Tensor, table: Tensor) -> Tensor:
    """Return codes (N,) of the taut tendons, from the stretches of all sets (M, n, n + 1)."""
    n = rows.shape[1]
    columns = table.mT.reshape(-1, n)
    places = torch.arange(n + 1, device=rows.device)

    def stretches(codes: Tensor, x: Tensor, columns: Tensor = columns) -> Tensor:
        # The map of each row times x, without a copy of the maps.
        at = codes[:, None] * (n + 1) + places
        return nn.functional.embedding_bag(at, columns, per_sample_weights=x, mode="sum")

    def sizes(codes: Tensor, x: Tensor) -> Tensor:
        return stretches(codes, x.abs(), columns.abs())

    x = extended(rows)
    return _pivoted(stretches, sizes, _guess(table[-1], x), x)


def find_by_solving(rows: Tensor, *elasticity: Tensor) -> Tensor:
    """Return codes (N,) of the taut tendons, from the elasticity."""
    occurring = Occurring(Elasticity(*elasticity))
    return occurring.find(rows, occurring.guess(rows))


class Occurring:
    """Responses of those sets of taut tendons that occur: far fewer than rows, or than all sets.

    The responses of the last sets are kept.
    """

    def __init__(self, elasticity: Elasticity) -> None:
        self._elasticity = elasticity
        self._n = len(elasticity.gains)
        self._sets = elasticity.gains.new_full((1,), -1, dtype=torch.long)  # no set
        self._responses: Responses

    def of(self, codes: Tensor) -> tuple[Tensor, Responses]:
        """Return the places of codes (N,) among the sets that occur, and the responses of these."""
        sets, places = codes.unique(return_inverse=True)
        if not torch.equal(sets, self._sets):
            self._responses = responses_of(as_mask(sets, self._n), self._elasticity)
            self._sets = sets
        return places, self._responses

    def guess(self, rows: Tensor) -> Tensor:
        """Return codes (N,) for the signs of the stretches with all tendons taut."""
        all_taut = rows.new_full((1,), 2**self._n - 1, dtype=torch.long)
        return _guess(self._maps_of(all_taut)[0], extended(rows))

    def find(self, rows: Tensor, guess: Tensor) -> Tensor:
        """Return codes (N,) of the taut tendons, in a search that starts at a guess (N,)."""
        return _pivoted(self._stretches, self._sizes, guess, extended(rows))

    def _maps_of(self, codes: Tensor) -> Tensor:
        places, responses = self.of(codes)
        return responses.stretch.index_select(0, places)

    def _stretches(self, codes: Tensor, x: Tensor) -> Tensor:
        return applied(self._maps_of(codes), x)

    def _sizes(self, codes: Tensor, x: Tensor) -> Tensor:
        return applied(self._maps_of(codes).abs(), x.abs())


def taut_codes(rows: Tensor, *parts: Tensor) -> Tensor:
    """Return codes (N,) of the taut tendons at rows (N, n), without derivatives.

    `parts` are the stretches of all sets, for `find_in_table`, or the elasticity, for
    `find_by_solving`.
    """
    fixed = [part.detach() for part in parts]
    if torch.compiler.is_compiling():
        return _taut_in_graph(rows.detach(), fixed)
    return WithoutDerivative.apply(_found, rows.detach(), *fixed)


def _found(rows: Tensor, *parts: Tensor) -> Tensor:
    """Return codes (N,) of the taut tendons."""
    find = find_in_table if len(parts) == 1 else find_by_solving
    return find(rows, *parts)


# One operation of a graph: the number of its steps depends on the numbers.
@torch.library.custom_op(
    "hybridkin::taut", mutates_args=(), schema="(Tensor rows, Tensor[] parts) -> Tensor"
)
def _taut_in_graph(rows: Tensor, parts: Sequence[Tensor]) -> Tensor:
    return _found(rows, *parts)


@_taut_in_graph.register_fake
def _like_codes(rows: Tensor, parts: Sequence[Tensor]) -> Tensor:
    return rows.new_empty(rows.shape[0], dtype=torch.long)


_Stretches = Callable[[Tensor, Tensor], Tensor]


def _guess(full: Tensor, x: Tensor) -> Tensor:
    """Return codes (N,) for the signs of the stretches (n, n + 1) with all tendons taut."""
    return as_codes(x @ full.T >= 0)


def _pivoted(stretches: _Stretches, sizes: _Stretches, guess: Tensor, x: Tensor) -> Tensor:
    """Return the codes (N,) of the taut tendons by block principal pivoting.

    Parameters
    ----------
    stretches : callable
        Returns the stretches (N, n) for sets of taut tendons, as codes (N,), at x (N, n + 1).
    sizes : callable
        The same, of the absolute values of all numbers.
    guess : Tensor of shape (N,)
        The codes to start from.
    x : Tensor of shape (N, n + 1)
        (q, 1).
    """
    n = x.shape[1] - 1
    places = torch.arange(len(x), device=x.device)  # of the rows that still change
    bits = _bits(n, x)
    codes = guess.clone()
    for step in range(HK_WHOLE_STEPS + 2 ** min(n, HK_MOST_TURNS)):
        stretch = stretches(guess, x)
        taut = _as_codes(stretch >= 0, bits)
        if step >= HK_WHOLE_STEPS:
            # The first wrong tendon alone, ignoring rounding errors.
            rounding = 4.0 * torch.finfo(x.dtype).eps * sizes(guess, x)
            certain = _as_codes(stretch.abs() > rounding, bits)
            wrong = (taut ^ guess) & certain
            taut = guess ^ (wrong & -wrong)  # its lowest bit
        changed = (taut != guess).nonzero()[:, 0]
        if not len(changed):
            break
        places = places[changed]
        x = x[changed]
        guess = taut[changed]
        codes[places] = guess
    return codes


class VmapInfo(Protocol):
    """What torch tells the vmap of a function."""

    batch_size: int


class WithoutDerivative(torch.autograd.Function):
    """The result of a search by rows, for every torch transform; its derivative is zero."""

    @staticmethod
    def forward(find: Callable[..., Tensor], rows: Tensor, *parts: Tensor) -> Tensor:
        return find(rows, *parts)

    @staticmethod
    def setup_context(ctx: FunctionCtx, inputs: tuple[object, ...], output: Tensor) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def backward(ctx: FunctionCtx, *grads: Tensor) -> None:
        """Return no derivative."""

    @staticmethod
    def jvp(ctx: FunctionCtx, *tangents: Tensor) -> None:
        """Return no derivative."""

    @staticmethod
    def vmap(info: VmapInfo, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Tensor, int]:
        find, *tensors = args
        results = []
        for k in range(info.batch_size):
            parts = []
            for tensor, dim in zip(tensors, in_dims[1:], strict=True):
                parts.append(tensor if dim is None else tensor.select(dim, k))
            results.append(WithoutDerivative.apply(find, *parts))
        return torch.stack(results), 0
