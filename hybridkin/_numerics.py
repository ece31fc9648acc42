"""Numerical ground floor: entire functions, Jacobians of modules, shape checks (torch only)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

_SERIES_END = 1.0  # [rad^2]; from here on nothing cancels in the trigonometric forms
# Coefficients of c3 and c4 by powers of s, highest first; float32 needs fewer.
_DEGREE = {torch.float64: 7, torch.float32: 4}
_SERIES = tuple(
    ((-1.0) ** j / math.factorial(2 * j + 3), (-1.0) ** j / math.factorial(2 * j + 4))
    for j in range(max(_DEGREE.values()), -1, -1)
)


class Stumpff(NamedTuple):
    """Entire functions of s = theta^2, with theta the bend angle of an arc.

    c = cos(theta), f = sin(theta)/theta, g = (1 - cos(theta))/theta^2,
    c3 = (theta - sin(theta))/theta^3, c4 = (cos(theta) - 1 + theta^2/2)/theta^4.
    With respect to s: 2 f' = c3 - g, 2 g' = 2 c4 - c3, 2 c' = -f.
    """

    c: Any
    f: Any
    g: Any
    c3: Any
    c4: Any


def stumpff(s: Tensor) -> Stumpff:
    """Return the Stumpff functions of s = theta^2, smooth through theta = 0.

    Up to one radian the power series is summed: no square root, no division. Beyond, where
    nothing cancels any more, trigonometry takes over; both agree to rounding where they meet.

    Parameters
    ----------
    s : Tensor
        Squared bend angles [rad^2], any shape.

    Returns
    -------
    Stumpff
        Five tensors of the shape of `s`.
    """
    # c3 and c4 together: one multiply-add per power, however small the batch.
    # Not s.new_tensor: before torch 2.5 it does not know functional transforms.
    powers = torch.tensor(_SERIES[-1 - _DEGREE.get(s.dtype, 7) :], dtype=s.dtype, device=s.device)
    powers = powers.reshape(-1, 2, *(1,) * s.ndim).unbind()
    near = s.clamp(max=_SERIES_END)
    both = powers[0]
    for power in powers[1:]:
        both = torch.addcmul(power, both, near)
    c3, c4 = both.expand(2, *s.shape).unbind()
    far = s.clamp(min=_SERIES_END)
    theta = far.sqrt()
    c, far_c3, far_c4 = _by_trigonometry(far, theta, torch.cos(theta), torch.sin(theta))
    bent = s > _SERIES_END
    c3, c4 = torch.where(bent, far_c3, c3), torch.where(bent, far_c4, c4)
    f, g = 1.0 - s * c3, 0.5 - s * c4
    return Stumpff(torch.where(bent, c, 1.0 - s * g), f, g, c3, c4)


def stumpff_of_number(s: float) -> Stumpff:
    """Return the Stumpff functions of one number; see `stumpff`."""
    if s > _SERIES_END:
        theta = math.sqrt(s)
        c, c3, c4 = _by_trigonometry(s, theta, math.cos(theta), math.sin(theta))
        return Stumpff(c, 1.0 - s * c3, 0.5 - s * c4, c3, c4)
    c3 = c4 = 0.0
    for of_c3, of_c4 in _SERIES:
        c3, c4 = of_c3 + c3 * s, of_c4 + c4 * s
    g = 0.5 - s * c4
    return Stumpff(1.0 - s * g, 1.0 - s * c3, g, c3, c4)


def _by_trigonometry(s: Any, theta: Any, c: Any, sine: Any) -> tuple[Any, Any, Any]:
    """Return c, c3 and c4 of s = theta^2 that is not small."""
    return c, (1.0 - sine / theta) / s, (0.5 - (1.0 - c) / s) / s


def jacobian(module: Any, q: Tensor) -> Tensor:
    """Return dx/dq of any module that maps every row of q by itself to a row of x.

    Uses the module's own closed-form ``jacobian`` where it has one, else one backward pass per
    output coordinate.

    Parameters
    ----------
    module : nn.Module or callable
        Maps ``(..., n)`` to ``(..., m)``, row by row.
    q : Tensor of shape (..., n)
        Actuator vectors.

    Returns
    -------
    Tensor of shape (..., m, n)
        Jacobian at every row.

    Examples
    --------
    >>> import torch
    >>> from hybridkin import jacobian
    >>> jacobian(lambda q: q**2, torch.tensor([1.0, 3.0]))
    tensor([[2., 0.],
            [0., 6.]])
    """
    return forward_and_jacobian(module, q)[1]


def forward_and_jacobian(module: Any, q: Tensor) -> tuple[Tensor, Tensor]:
    """Return x and dx/dq, in closed form where the module offers it; see `jacobian`."""
    if hasattr(module, "forward_and_jacobian"):
        return module.forward_and_jacobian(q)
    if hasattr(module, "jacobian"):
        return module(q), module.jacobian(q)
    return forward_and_reverse_jacobian(module, q)


def forward_and_reverse_jacobian(module: Any, q: Tensor) -> tuple[Tensor, Tensor]:
    """Return x and dx/dq by one backward pass per output coordinate; see `jacobian`."""
    keep_graph = q.requires_grad and torch.is_grad_enabled()
    with torch.enable_grad():
        leaf = q if keep_graph else q.detach().requires_grad_(True)
        x = module(leaf)
        rows = [
            torch.autograd.grad(
                x[..., i].sum(), leaf, create_graph=keep_graph, retain_graph=True, allow_unused=True
            )[0]
            for i in range(x.shape[-1])
        ]
    rows = [torch.zeros_like(leaf) if row is None else row for row in rows]
    J = torch.stack(rows, dim=-2)
    return (x, J) if keep_graph else (x.detach(), J.detach())


class PortableModule(nn.Module):
    """A module of buffers whose pickle and joblib hash are the same in every process.

    Buffers are stored as plain arrays and come back on their device, or on the CPU where that
    device does not exist.
    """

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        state["_buffers"] = {
            name: None if value is None else (value.detach().cpu().numpy(), str(value.device))
            for name, value in self._buffers.items()
        }
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        buffers: dict[str, Tensor | None] = {}
        for name, stored in state["_buffers"].items():
            buffers[name] = None
            if stored is not None:
                array, device = stored
                at_home = device == "cpu" or torch.cuda.is_available()
                buffers[name] = torch.tensor(array, device=device if at_home else "cpu")
        super().__setstate__({**state, "_buffers": buffers})


def in_blocks(
    function: Callable[[Tensor], tuple[Tensor, ...]], q: Tensor, size: int = 4096
) -> tuple[Tensor, ...]:
    """Return what a row-by-row function gives for q (..., n), computed in blocks of rows.

    The temporaries of a block stay in the cache: a million rows cost as much each as a thousand.
    What the function gives may lie in memory with the batch last; the result is contiguous.
    """
    if not isinstance(q, Tensor) or q.ndim == 0:
        return function(q)  # which says what is wrong
    blocks = q.reshape(-1, q.shape[-1]).split(size)
    first = function(blocks[0])
    if len(blocks) == 1:
        whole = [part.flatten(1).contiguous() for part in first]
    elif any(part.requires_grad for part in first):  # a graph would grow by every write
        parts = zip(first, *(function(rows) for rows in blocks[1:]), strict=True)
        whole = [torch.cat(part) for part in parts]
    else:
        whole = [part.new_empty(q.shape[:-1].numel(), part.shape[1:].numel()) for part in first]
        for k, rows in enumerate(blocks):
            for result, part in zip(whole, function(rows) if k else first, strict=True):
                result[k * size : k * size + len(part)].copy_(part.flatten(1))
    shapes = (part.shape[1:] for part in first)
    return tuple(
        result.reshape(*q.shape[:-1], *shape) for result, shape in zip(whole, shapes, strict=True)
    )


def check_vectors(value: Tensor, size: int, name: str, why: str) -> Tensor:
    """Return `value` when it is a floating tensor of shape (..., size), else raise."""
    if not isinstance(value, Tensor):
        raise TypeError(
            f"`{name}` must be a torch tensor of shape (..., {size}), got "
            f"{type(value).__name__}; wrap it in torch.as_tensor(...)."
        )
    if not value.is_floating_point():
        raise TypeError(
            f"`{name}` must be a floating tensor, got {value.dtype}; convert it with `.double()`."
        )
    if value.ndim == 0 or value.shape[-1] != size:
        raise ValueError(
            f"`{name}` must have shape (..., {size}), got {tuple(value.shape)}; {why}."
        )
    return value
