"""Further starts of a search: configurations of an even sample with tips near the target."""

from __future__ import annotations

import torch
from torch import Tensor

from hybridkin.ik._settings import StepSettings

_SHARED = 2048  # configurations within the limits, the same for every row
_OWN = 64  # around a row's start, if an actuator has no limits
_OUTSIDE = 4.0  # factor on the distance of starts outside the domain of the models


def nearest_starts(
    settings: StepSettings, q: Tensor, size: Tensor, target: Tensor, count: int
) -> Tensor:
    """Return the `count` configurations of a sample whose tips are nearest to each target.

    The sample is the same in every call and for every batch. It fills the limits, their faces and
    their corners; for an actuator without limits, a range around its start.

    Parameters
    ----------
    settings : StepSettings
        Task and limits.
    q : Tensor of shape (N, n)
        Starts of the rows.
    size : Tensor of shape (N,)
        Motion of an actuator that moves the tip by about the error.
    target : Tensor of shape (N, ...)
        Targets.
    count : int
        Number of starts per row.

    Returns
    -------
    Tensor of shape (N, count, n)
        Starts, the nearest one first.
    """
    task = settings.task
    n = q.shape[-1]
    k = max(
        count,
        _SHARED if torch.isfinite(settings.q_max - settings.q_min).all() else _OWN,
    )
    sample = even_starts(settings, q, size, k)
    sample = settings.start_at(sample)
    x, _ = settings.evaluate(sample.flatten(0, 1))
    away = task.distances(x.unflatten(0, (-1, k)), target)
    away = away * torch.where(task.in_domain(sample.flatten(0, 1)), 1.0, _OUTSIDE).view(
        -1, k
    )
    near = away.nan_to_num(torch.inf).topk(count, largest=False).indices
    return sample.expand(len(q), k, n).gather(1, near[..., None].expand(-1, -1, n))


def even_starts(settings: StepSettings, q: Tensor, size: Tensor, count: int) -> Tensor:
    """Return `count` configurations (1, count, n) that fill the limits, their faces and corners.

    If an actuator has no limits they fill a range around q (N, n): (N, count, n).
    """
    low, high = (
        a.to(q).expand(1, q.shape[-1]) for a in (settings.q_min, settings.q_max)
    )
    if not torch.isfinite(high - low).all():
        size = torch.minimum(size[:, None], 0.5 * settings.periods.to(q))
        lower = torch.where(torch.isfinite(low), low, torch.minimum(q, high) - size)
        high = torch.where(torch.isfinite(high), high, torch.maximum(q, low) + size)
        low = lower
    low = low[:, None]
    high = high[:, None]
    fractions = _even_shares(q.shape[-1], count, q.device).to(q)
    return torch.lerp(low, high, fractions).clamp(low, high)


def _even_shares(n: int, count: int, device: torch.device) -> Tensor:
    """Return `count` points that fill the n-dimensional unit cube and its faces evenly.

    A Kronecker sequence of the generalised golden ratio in n + 1 dimensions, from the middle. The
    last one moves a point away from the middle; points outside the cube are clipped to its faces.

    References
    ----------
    Roberts, "The unreasonable effectiveness of quasirandom sequences" (2018).
    """
    ratio = 2.0
    for _ in range(64):  # the root of ratio^(n + 2) = ratio + 1
        ratio = (1.0 + ratio) ** (1.0 / (n + 2))
    index = torch.arange(max(count, n + 1), dtype=torch.float64, device=device)
    steps = ratio ** -(index[: n + 1] + 1.0)
    points = (0.5 + index[:count, None] * steps) % 1.0
    return (0.5 + (points[:, :n] - 0.5) / (1.0 - points[:, n:])).clamp(0.0, 1.0)
