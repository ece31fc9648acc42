"""Derivatives of solved configurations, by the implicit function theorem."""

from __future__ import annotations

import torch
from torch import Tensor

from hybridkin._core.model import slopes
from hybridkin.ik._gram import apply_columns, apply_rows, damped_solve, row_gram
from hybridkin.ik._settings import StepSettings

_POLISHES = 4


def differentiable(settings: StepSettings, q: Tensor, target: Tensor, reached: Tensor) -> Tensor:
    """Return q with its graph to the targets and to the model's parameters.

    A solution is a root of F = (W (q_pref - q) + J^T mu, f(q) - x) in q and mu, with actuators at a
    limit fixed. A Newton step from the root, with a constant matrix, is zero but has the right
    derivatives.

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

    Returns
    -------
    Tensor of shape (N, n)
        Polished q, differentiable.
    """
    rows = reached.nonzero()[:, 0]
    if rows.numel() == 0:  # an empty write, so that there is a graph
        return q.index_put((rows,), target[rows].flatten(1)[:, :1].expand(-1, q.shape[-1]))
    part, goal = q[rows], target[rows]
    lower, upper = settings.box(part)
    free = (part > lower) & (part < upper)
    dq, lacking = _newton(settings, part, goal.detach(), free)
    for _ in range(_POLISHES):
        new = part + dq.detach()
        dq_new, lacking_new = _newton(settings, new, goal.detach(), free)
        better = (lacking_new < lacking) & (((new > lower) & (new < upper)) | ~free).all(-1)
        part = torch.where(better[:, None], new, part)
        dq = torch.where(better[:, None], dq_new, 0.0)
        lacking = torch.where(better, lacking_new, lacking)
    dq, _ = _newton(settings, part, goal, free)
    return q.index_put((rows,), part + dq - dq.detach())


def _newton(
    settings: StepSettings, q: Tensor, target: Tensor, free: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the Newton step of F in q with a constant matrix, and |F|; only `free` moves."""
    n = q.shape[-1]
    unit = settings.unit(q)
    weights = unit.square().reciprocal().expand_as(q)
    leaf = q.detach().requires_grad_(True)
    x, J = settings.evaluate(leaf)
    e = settings.task.difference(x, target)
    held = torch.where(free[:, None], J.detach(), 0.0)
    pull, H = torch.zeros_like(q), -torch.diag_embed(weights)
    if settings.has_posture:
        posture = weights * (settings.preferred(leaf) - leaf)
        scaled = held * unit
        mu = damped_solve(row_gram(scaled), apply_rows(scaled, unit * posture.detach()))
        pull = posture - apply_columns(J, mu)
        H = slopes(pull, leaf)
    both = free[:, :, None] & free[:, None, :]
    H = torch.where(both, H.detach(), torch.diag_embed((~free).to(q)))
    corner = held.new_zeros(len(q), held.shape[-2], held.shape[-2])
    upper, lower = torch.cat([H, held.mT], dim=-1), torch.cat([held, corner], dim=-1)
    right = torch.cat([torch.where(free, -pull, 0.0), e], dim=-1)
    step = torch.linalg.solve_ex(torch.cat([upper, lower], dim=-2), right)[0][:, :n]
    # Posture in its unit and task in metres: both parts have the same weight.
    lacking = torch.cat([unit * right[:, :n], e], dim=-1).detach().norm(dim=-1)
    return step.nan_to_num(0.0, 0.0, 0.0), lacking
