"""Derivatives of solved configurations, by the implicit function theorem."""

from __future__ import annotations

import warnings
from functools import partial

import torch
from torch import Tensor

from hybridkin._core.model import slopes
from hybridkin.ik._gram import apply_columns, apply_rows
from hybridkin.ik._settings import StepSettings
from hybridkin.ik.tasks import Tolerance

_POLISHES = 4


def differentiable(
    settings: StepSettings, q: Tensor, target: Tensor, reached: Tensor, tol: Tolerance
) -> Tensor:
    """Return q with its graph to the targets and to the model's parameters.

    A solution is a root of F = (W (q_pref - q) + J^T mu, f(q) - x) in q and mu, with actuators at a
    limit fixed. A Newton step from the root, with constant matrices, is zero but has the right
    derivatives. Where J lacks rows, e.g. for a planar arm, F counts along the range of J only.

    Parameters
    ----------
    settings : StepSettings
        Task, limits and posture of the solutions.
    q : Tensor of shape (N, n)
        Solutions; they are first polished to a root.
    target : Tensor of shape (N, ...)
        Their targets, with a graph.
    reached : Tensor of shape (N,)
        Rows that are solutions; the others get no derivatives.
    tol : float or tuple of float
        Tolerance that polished rows must meet, else they stay as they are.

    Returns
    -------
    Tensor of shape (N, n)
        Polished q, differentiable. Rows have no derivatives, with a warning, where J loses rank at
        the solution but not beside it.
    """
    rows = reached.nonzero()[:, 0]
    part = q[rows]
    goal = target[rows]
    lower, upper = settings.box(part)
    free = (part > lower) & (part < upper)
    best = part
    least = torch.full_like(part[:, 0], torch.inf)
    for _ in range(_POLISHES + 1):
        dq, lacking = _newton(settings, part, goal.detach(), free, tol)
        better = lacking < least
        best = torch.where(better[:, None], part, best)
        least = torch.where(better, lacking, least)
        part = torch.clamp(part + dq.detach(), lower, upper)
    dq, _ = _newton(settings, best, goal, free, tol)
    regular = _is_regular(settings, best, free)
    if not regular.all():
        warnings.warn(
            f"{int((~regular).sum())} of {len(q)} solutions are at a singular configuration, e.g. "
            "a stretched arm, and have no derivatives there; move their targets.",
            stacklevel=4,
        )
    dq = torch.where(regular[:, None], dq - dq.detach(), 0.0)
    return q.index_put((rows,), best + dq)


def _newton(
    settings: StepSettings, q: Tensor, target: Tensor, free: Tensor, tol: Tolerance
) -> tuple[Tensor, Tensor]:
    """Return the Newton step of F with constant matrices for the `free` q, and |F| in units of q.

    In units of q in which all weights are 1, let P = J+ and N = 1 - P J. The step is P e, and in
    the null space -N (N H N)+ N (g + H P e), where g = q_pref - q - J^T mu has the slope H. |F| is
    infinite outside the tolerance.
    """
    unit = settings.unit(q)
    cutoff = _cutoff(q)
    leaf = q.detach().requires_grad_(True)
    x, J = settings.evaluate(leaf)
    e = settings.task.difference(x, target)
    held = torch.where(free[:, None], J.detach(), 0.0) * unit
    inverse = torch.linalg.pinv(held, rtol=cutoff)
    null = torch.diag_embed(free.to(q)) - inverse @ held
    step = apply_rows(inverse, e)
    lacking = step
    if settings.has_posture:
        wish = (settings.preferred(leaf) - leaf) / unit
        pull = wish - unit * apply_columns(J, apply_columns(inverse, wish.detach()))
        H = unit * slopes(pull, leaf).detach()
        compliance = (
            null @ torch.linalg.pinv(null @ H @ null, atol=cutoff, rtol=cutoff) @ null
        )
        lacking = torch.cat([step, apply_rows(null, pull)], dim=-1)
        step = step - apply_rows(compliance, pull + apply_rows(H, step))
    size = lacking.detach().norm(dim=-1)
    return unit * step, torch.where(settings.task.reached(e, tol), size, torch.inf)


def _is_regular(settings: StepSettings, q: Tensor, free: Tensor) -> Tensor:
    """Return whether the free columns of J have the same rank at q and beside it."""
    # Unequal factors, because equal ones can cancel in a symmetric robot.
    aside = torch.cos(torch.ones_like(q).cumsum(-1))
    beside = torch.where(free, q + _cutoff(q) ** 0.5 * aside, q)
    at_q, at_beside = (settings.evaluate(a)[1] * free[:, None] for a in (q, beside))
    rank = partial(torch.linalg.matrix_rank, rtol=_cutoff(q))
    return rank(at_q) == rank(at_beside)


def _cutoff(q: Tensor) -> float:
    """Return the ratio of singular values below which a direction counts as lost."""
    return torch.finfo(q.dtype).eps ** 0.75
