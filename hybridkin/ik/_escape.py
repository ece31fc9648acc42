"""The way out of singular configurations, eq. (22) of the page "Theory" of the documentation."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from hybridkin._core.constants import moved
from hybridkin._core.kernel_numbers import (
    IK_BENDS,
    IK_BENDS_MOST,
    IK_FLAT,
    IK_HEALTHY,
    IK_PROBE,
    IK_TURNS,
    IK_WAY_OUT,
)
from hybridkin.ik._gram import apply_columns, apply_rows, solve_rows
from hybridkin.ik._settings import StepSettings
from hybridkin.ik.limits import Bounds


def way_out(
    settings: StepSettings, q: Tensor, J: Tensor, e: Tensor, dq: Tensor, bounds: Bounds
) -> Tensor:
    """Return what to add to steps dq out of configurations in which errors e (N, m) are lost.

    If the second derivative of the model moves the tip towards the target along a direction, the
    result leads there, as far as this curvature takes back the error. Where the target is out of
    reach there is no such direction, and the result is zero.

    Parameters
    ----------
    settings : StepSettings
        The model and the ranges.
    q : Tensor of shape (N, n)
        Configurations.
    J : Tensor of shape (N, m, n)
        Jacobians there.
    e : Tensor of shape (N, m)
        Errors.
    dq : Tensor of shape (N, n)
        The steps.
    bounds : Bounds
        Their bounds.
    """
    n = q.shape[1]
    spans = moved(settings.spans, q).expand(n)
    spans = torch.where(torch.isfinite(spans), spans, 1.0)
    # Open is what the bounds allow, and what does not raise the error to first order.
    slope = apply_columns(J, e)
    flat = IK_FLAT * J.norm(dim=-2) * e.norm(dim=-1, keepdim=True)
    up = (bounds.upper > 0.0) & (slope >= -flat)
    down = (bounds.lower < 0.0) & (slope <= flat)
    largest = J.square().sum((-2, -1))
    damping_sq = IK_HEALTHY**2 * largest

    def allowed(u: Tensor) -> Tensor:
        """Return unit vectors without what moves the tip well, or is forbidden."""
        mu = solve_rows(J, apply_rows(J, u), damping_sq)
        u = settings.plane.along(u - apply_columns(J, mu))
        u = torch.where(torch.where(u > 0.0, up, down), u, 0.0)
        size = u.norm(dim=-1, keepdim=True)
        return torch.where(size > 0.0, u / size, u)

    # The second derivative of x along e, by differences inwards.
    probe = torch.where(bounds.upper > 0.0, IK_PROBE * spans, -IK_PROBE * spans)
    beside = (q[:, None] + torch.diag_embed(probe)).flatten(0, 1)
    _, there = settings.evaluate(beside)
    change = there.unflatten(0, (len(q), n)) - J[:, None]
    bent = (e[:, None, :, None] * change).sum(-2) / probe[..., None]
    seen = bent.flatten(1).norm(dim=-1)

    # The power method, from a start with a part of each direction.
    places = torch.arange(n, dtype=q.dtype, device=q.device)
    start = torch.where(places % 2 == 0.0, 1.0, -1.0) / (1.0 + places)
    one_sided = torch.where(up, start.abs(), -start.abs())
    u = allowed(torch.where(up & down, start, one_sided))
    symmetric = 0.5 * (bent + bent.mT)
    for _ in range(IK_TURNS):
        u = allowed(seen[:, None] * u + apply_rows(symmetric, u))

    curved = (u * apply_rows(bent, u)).sum(-1) - apply_rows(J, u).square().sum(-1)
    leads = (curved > IK_BENDS * largest) & (curved > IK_BENDS_MOST * seen)
    left = torch.where(u > 0.0, bounds.upper - dq, dq - bounds.lower)
    most = (torch.minimum(left, IK_WAY_OUT * spans) / u.abs()).nan_to_num(math.inf)
    most = most.amin(-1)
    length = torch.minimum(e.norm(dim=-1) * (2.0 / curved).sqrt(), most)
    length = torch.where(leads, length, 0.0).nan_to_num(0.0, math.inf)
    return length[:, None] * u
