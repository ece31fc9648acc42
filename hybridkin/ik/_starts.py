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
    bounded = torch.isfinite(settings.q_max - settings.q_min).all()
    k = max(count, _SHARED if bounded else _OWN)
    sample = settings.start_at(even_starts(settings, q, size, k))
    rows = sample.flatten(0, 1)
    x, _ = settings.evaluate(rows)
    # Tips outside the domain count as farther away than they are.
    distance = task.distances(x.unflatten(0, (-1, k)), target)
    inside = task.in_domain(rows).view(-1, k)
    distance = torch.where(inside, distance, _OUTSIDE * distance)
    distance = distance.nan_to_num(torch.inf)
    nearest = distance.topk(count, largest=False).indices
    nearest = nearest[..., None].expand(-1, -1, n)
    return sample.expand(len(q), k, n).gather(1, nearest)


def even_starts(settings: StepSettings, q: Tensor, size: Tensor, count: int) -> Tensor:
    """Return `count` configurations (1, count, n) that fill the limits, their faces and corners.

    If an actuator has no limits they fill a range around q (N, n): (N, count, n).
    """
    n = q.shape[-1]
    low = settings.q_min.to(q).expand(1, n)
    high = settings.q_max.to(q).expand(1, n)
    if not torch.isfinite(high - low).all():
        reach = torch.minimum(size[:, None], 0.5 * settings.periods.to(q))
        below = torch.minimum(q, high) - reach
        above = torch.maximum(q, low) + reach
        low = torch.where(torch.isfinite(low), low, below)
        high = torch.where(torch.isfinite(high), high, above)
    low = low[:, None]
    high = high[:, None]
    fractions = _even_points(n, count, q.device).to(q)
    return torch.lerp(low, high, fractions).clamp(low, high)


def _even_points(n: int, count: int, device: torch.device) -> Tensor:
    """Return `count` points that fill the n-dimensional unit cube and its faces evenly.

    A Kronecker sequence of the generalised golden ratio in n + 1 dimensions, from the middle. The
    last one moves a point away from the middle; points outside the cube are clipped to its faces.

    References
    ----------
    Roberts, "The unreasonable effectiveness of quasirandom sequences" (2018).
    """
    # The golden ratio of n + 1 dimensions, the root of ratio^(n + 2) = ratio + 1.
    ratio = 2.0
    for _ in range(64):
        ratio = (1.0 + ratio) ** (1.0 / (n + 2))
    dimension = torch.arange(n + 1, dtype=torch.float64, device=device)
    index = torch.arange(count, dtype=torch.float64, device=device)[:, None]
    points = (0.5 + index * ratio ** -(dimension + 1.0)) % 1.0
    from_middle = (points[:, :n] - 0.5) / (1.0 - points[:, n:])
    return (0.5 + from_middle).clamp(0.0, 1.0)
