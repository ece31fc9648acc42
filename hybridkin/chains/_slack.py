"""Which tendons are taut, and how an elastic shape answers while they are."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from hybridkin._core.arrays import identity

MOST = 62  # a set of tendons is the bits of one integer
_MANY = 2000  # rows from which on steps in single precision save more than they cost
_ROUGH_STEPS = 5
_WHOLE_STEPS = 8  # then one tendon at a time, which ends for certain
_MOST_TURNS = 12  # two to this power, should rounding keep it from an end


class Elasticity(NamedTuple):
    """What shapes the backbone: shapes are the length changes, then the x- and y-bendings."""

    readings: Tensor  # (n, 3 S), tendon paths by shape
    units: Tensor  # (3 S,), shapes of like effect on the paths
    stiffness: Tensor  # (3 S,)
    rest: Tensor  # (3 S,), the shape without tendons
    zeros: Tensor  # (n,)


class Responses(NamedTuple):
    """For M sets of taut tendons how the shape answers; the actuators come as (q, 1)."""

    shape: Tensor  # (M, 3 S, n + 1)
    stretch: Tensor  # (M, n, n + 1), slack counts as negative
    compliance: Tensor  # (M, 3 S, 3 S), shape by a generalised force


class Balance(NamedTuple):
    """Shapes at which backbones and tendons balance, and what derivatives need."""

    shape: Tensor  # (N, 3 S)
    pull: Tensor  # (N, n), tensions
    taut: Tensor  # (N, n), bool
    compliance: Tensor  # (N, 3 S, 3 S), shape by a generalised force


def responses_of(
    taut: Tensor, readings: Tensor, units: Tensor, stiffness: Tensor, rest: Tensor, zeros: Tensor
) -> Responses:
    """Return the linear answers of sets of taut tendons (M, n)."""
    pulling = readings.T * taut[:, None]  # (M, 3 S, n)
    hessian = torch.diag(stiffness) + pulling @ readings
    scaled = units[:, None] * hessian * units
    compliance = units[:, None] * torch.linalg.inv_ex(scaled).inverse * units
    force = torch.cat([pulling, (stiffness * rest - pulling @ zeros)[..., None]], dim=-1)
    shape = compliance @ force
    given = torch.cat([identity(len(zeros), zeros), -zeros[:, None]], dim=-1)
    return Responses(shape, readings @ shape - given, compliance)


def extended(rows: Tensor) -> Tensor:
    return nn.functional.pad(rows, (0, 1), value=1.0)


def applied(maps: Tensor, vectors: Tensor) -> Tensor:
    return torch.matmul(maps, vectors[..., None])[..., 0]


def as_mask(codes: Tensor, n: int) -> Tensor:
    """Return sets given as bits of a number (N,) as a mask (N, n)."""
    return ((codes[:, None] >> torch.arange(n, device=codes.device)) & 1) > 0


def find_in_table(rows: Tensor, table: Tensor, rough: Tensor, size: Tensor) -> Tensor:
    """Return which tendons are taut (N,), from the stretches of all sets; see `rough_of`."""
    x, at = extended(rows), torch.arange(len(rows), device=rows.device)
    codes = _pulling_if_taut(table[-1], x)
    if len(rows) >= _MANY:
        at = _pivoted_roughly(codes, at, x, rough, size)
    return _pivoted(partial(table.index_select, 0), codes, at, x)


def find_by_solving(rows: Tensor, *elasticity: Tensor) -> Tensor:
    """Return which tendons are taut (N,), from the elasticity."""
    n, x = rows.shape[1], extended(rows)

    def maps_of(codes: Tensor) -> Tensor:
        return responses_of(as_mask(codes, n), *elasticity).stretch

    at = torch.arange(len(rows), device=rows.device)
    codes = _pulling_if_taut(maps_of(at.new_tensor([2**n - 1]))[0], x)
    return _pivoted(maps_of, codes, at, x)


def rough_of(table: Tensor) -> tuple[Tensor, Tensor]:
    """Return the columns of maps (M, n, n + 1) in single precision, (M (n + 1), n), and a bound.

    No entry of a map is larger than the bound (n + 1,) of its column.
    """
    return table.mT.float().flatten(0, 1), table.abs().amax((0, 1))


def _pulling_if_taut(full: Tensor, x: Tensor) -> Tensor:
    bits = 2 ** torch.arange(len(full), device=x.device)
    return ((full @ x.T >= 0) * bits[:, None]).sum(0)


def _pivoted_roughly(codes: Tensor, at: Tensor, x: Tensor, rough: Tensor, size: Tensor) -> Tensor:
    """Change codes (N,) by block principal pivoting in single precision.

    Returns the rows where that did not settle them: it never errs, it leaves what is too close.
    """
    here, n = codes, x.shape[1] - 1
    # Stretches in units of a bound on their rounding errors: from one on the sign is certain.
    error = 4 * (n + 1) * torch.finfo(rough.dtype).eps * (x.abs() @ size)
    x = (x / error[:, None]).to(rough).nan_to_num()
    bits, ones = rough.new_tensor([2.0**k for k in range(n)]), rough.new_ones(n)
    for _ in range(_ROUGH_STEPS):
        terms = here[:, None] * (n + 1) + torch.arange(n + 1, device=at.device)
        stretch = nn.functional.embedding_bag(terms, rough, per_sample_weights=x, mode="sum")
        signs = stretch.clamp(-1.0, 1.0)
        found = (0.5 * (signs @ bits + (2**n - 1))).long()
        left = ((found != here) | (signs.abs() @ ones < n)).nonzero()[:, 0]
        at, x, here = (part.index_select(0, left) for part in (at, x, found))
        codes[at] = here
    return at


def _pivoted(maps_of: Callable[[Tensor], Tensor], codes: Tensor, at: Tensor, x: Tensor) -> Tensor:
    """Return the codes (N,) of the taut tendons by block principal pivoting in the rows `at`.

    The stretches of sets of taut tendons come as maps (N, n, n + 1) from `maps_of`.
    """
    n = x.shape[1] - 1
    bits = 2 ** torch.arange(n, device=x.device)
    x, here = (part.index_select(0, at) for part in (x, codes))
    for step in range(_WHOLE_STEPS + 2 ** min(n, _MOST_TURNS)):
        maps = maps_of(here)
        stretch = applied(maps, x)
        found = ((stretch >= 0) * bits).sum(-1)
        if step >= _WHOLE_STEPS:  # one at a time, and none for a rounding error
            rounding = 4.0 * torch.finfo(x.dtype).eps * applied(maps.abs(), x.abs())
            wrong = (found ^ here) & ((stretch.abs() > rounding) * bits).sum(-1)
            found = here ^ (wrong & -wrong)
        moved = (found != here).nonzero()[:, 0]
        if not len(moved):
            break
        at, x, here = (part.index_select(0, moved) for part in (at, x, found))
        codes[at] = here
    return codes


class FindTaut(torch.autograd.Function):
    """Which tendons are taut, under every transform: its result is constant between the kinks."""

    @staticmethod
    def forward(find: Callable[..., Tensor], rows: Tensor, *parts: Tensor) -> Tensor:
        return find(rows, *parts)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        return None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        return None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Tensor, int]:
        find, tensors, dims = args[0], args[1:], in_dims[1:]
        if all(dim is None for dim in dims[1:]):  # the same robot: the batch is more rows
            rows = tensors[0].movedim(dims[0], 0)
            codes = FindTaut.apply(find, rows.flatten(0, 1), *tensors[1:])
            return codes.unflatten(0, rows.shape[:2]), 0
        n, pairs = info.batch_size, zip(tensors, dims, strict=True)
        each = [[a] * n if dim is None else a.unbind(dim) for a, dim in pairs]
        found = [FindTaut.apply(find, *parts) for parts in zip(*each, strict=True)]
        return torch.stack(found), 0
