"""The two stages of a step within limits: the task first, then the posture."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor

from hybridkin.ik._box import BoxProblem
from hybridkin.ik._calm import calmed
from hybridkin.ik._gram import apply_rows

Solver: TypeAlias = "Callable[[BoxProblem, Tensor | slice, Tensor], tuple[Tensor, Tensor]]"
"""Returns the steps and multipliers of problems, which are some rows of all; it starts from others.

Its arguments are the problems, their places among all rows, and multipliers (N, m).
"""


def in_two_stages(problem: BoxProblem, calm: Tensor, solve: Solver) -> Tensor:
    """Return steps within limits whose task part does not depend on preferred steps z, eq. (19).

    Without damping, z only chooses among the steps that reach v, or come nearest to it. Damping
    would be a compromise between v and z. Therefore the damped task is first solved for z = 0; z
    then chooses among the steps with the same motion.

    Parameters
    ----------
    problem : BoxProblem
        With lambda^2 >= 0.
    calm : bool Tensor of shape (N,)
        Where z is at most half as long as the step of the task.
    solve : Solver
        What solves a stage.

    Returns
    -------
    Tensor of shape (N, n)
        Steps within the limits.
    """
    centre = torch.zeros_like(problem.v)
    has_posture = (problem.z != 0.0).any(-1)
    rows = ((problem.damping_sq > 0.0) & has_posture).nonzero()[:, 0]
    if rows.numel() > 0:
        # The damped task without posture; its motion replaces v.
        damped = problem.take(rows)
        damped = damped._replace(z=torch.zeros_like(damped.z))
        task, mu = solve(damped, rows, centre[rows])
        problem = problem._replace(
            v=problem.v.index_put((rows,), apply_rows(damped.J, task)),
            z=problem.z.index_put((rows,), calmed(problem.z[rows], task, calm[rows])),
            damping_sq=problem.damping_sq.index_fill(0, rows, 0.0),
        )
        # These multipliers keep the active limits, also where v is out of reach.
        centre = centre.index_put((rows,), mu)
    return solve(problem, slice(None), centre)[0]
