"""Derivatives of solved configurations, by the implicit function theorem."""

from __future__ import annotations

import warnings

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
    solved = q[rows]
    goal = target[rows]
    box = settings.box(solved)
    free = ~box.held(solved)

    # Polish to a root, with the rounding of a few Newton steps.
    best = solved
    least = torch.full_like(best[:, 0], torch.inf)
    for _ in range(_POLISHES + 1):
        dq, size = _newton(settings, solved, goal.detach(), free, tol)
        better = size < least
        best = torch.where(better[:, None], solved, best)
        least = torch.where(better, size, least)
        solved = box.clip(solved + dq.detach())

    # A step of zero with the derivatives of the solution.
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
    J_free = torch.where(free[:, None], J.detach(), 0.0) * unit
    inverse = torch.linalg.pinv(J_free, rtol=cutoff)
    step = apply_rows(inverse, e)
    residual = step
    if settings.has_posture:
        # g = wish - J^T mu in these units, and its slope H.
        wish = (settings.preferred(leaf) - leaf) / unit
        mu = apply_columns(inverse, wish.detach())
        pull = wish - unit * apply_columns(J, mu)
        H = unit * slopes(pull, leaf).detach()

        null = torch.diag_embed(free.to(q)) - inverse @ J_free
        stiffness = null @ H @ null
        compliance = torch.linalg.pinv(stiffness, atol=cutoff, rtol=cutoff)
        compliance = null @ compliance @ null
        residual = torch.cat([step, apply_rows(null, pull)], dim=-1)
        step = step - apply_rows(compliance, pull + apply_rows(H, step))
    size = residual.detach().norm(dim=-1)
    size = torch.where(settings.task.reached(e, tol), size, torch.inf)
    return unit * step, size


def _is_regular(settings: StepSettings, q: Tensor, free: Tensor) -> Tensor:
    """Return whether the free columns of J have the same rank at q and beside it."""
    # Unequal factors, because equal ones can cancel in a symmetric robot.
    cutoff = _cutoff(q)
    aside = cutoff**0.5 * torch.ones_like(q).cumsum(-1).cos()
    ranks = []
    for at in (q, torch.where(free, q + aside, q)):
        _, J = settings.evaluate(at)
        J_free = J * free[:, None]
        ranks.append(torch.linalg.matrix_rank(J_free, rtol=cutoff))
    return ranks[0] == ranks[1]


def _cutoff(q: Tensor) -> float:
    """Return the ratio of singular values below which a direction counts as lost."""
    return torch.finfo(q.dtype).eps ** 0.75
