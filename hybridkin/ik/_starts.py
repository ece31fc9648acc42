"""Further starts of a search: configurations of an even sample with tips near the target."""

from __future__ import annotations

import torch
from torch import Tensor

from hybridkin._core.constants import moved
from hybridkin.ik._settings import StepSettings

_SHARED = 2048  # configurations within the limits, the same for every row
_OWN = 64  # around a row's start, if an actuator has no limits
_OUTSIDE = 4.0  # factor on the distance of starts outside the domain, or in obstacles


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
    bounded = torch.isfinite(settings.q_max - settings.q_min).all()
    n_sample = max(count, _SHARED if bounded else _OWN)
    sample = even_starts(settings, q, size, n_sample)
    sample = settings.start_at(sample)

    # Tips outside the domain, or of a body in an obstacle, count as farther away than they are.
    rows = sample.flatten(0, 1)
    x, _ = settings.evaluate(rows)
    tips = x.unflatten(0, (-1, n_sample))
    distance = task.distances(tips, target)
    usable = task.in_domain(rows) & ~settings.clear.is_inside(rows, settings.clear.scene)
    inside = usable.view(-1, n_sample)
    distance = torch.where(inside, distance, _OUTSIDE * distance)
    distance = distance.nan_to_num(torch.inf)

    nearest = distance.topk(count, largest=False)
    n = q.shape[-1]
    index = nearest.indices[..., None].expand(-1, -1, n)
    return sample.expand(len(q), -1, -1).gather(1, index)


def even_starts(settings: StepSettings, q: Tensor, size: Tensor, count: int) -> Tensor:
    """Return `count` configurations (1, count, n) that fill the limits, their faces and corners.

    If an actuator has no limits they fill a range around q (N, n): (N, count, n).
    """
    n = q.shape[-1]
    low = moved(settings.q_min, q).expand(1, n)
    high = moved(settings.q_max, q).expand(1, n)
    if not torch.isfinite(high - low).all():
        reach = torch.minimum(size[:, None], 0.5 * moved(settings.periods, q))
        below = torch.minimum(q, high) - reach
        above = torch.maximum(q, low) + reach
        low = torch.where(torch.isfinite(low), low, below)
        high = torch.where(torch.isfinite(high), high, above)
    low = low[:, None]
    high = high[:, None]
    fractions = _even_points(n, count, q.device)
    starts = torch.lerp(low, high, fractions.to(q))
    return starts.clamp(low, high)


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
    index = torch.arange(count, dtype=torch.float64, device=device)
    steps = ratio ** -(dimension + 1.0)
    points = (0.5 + index[:, None] * steps) % 1.0
    beside_middle = points[:, :n] - 0.5
    distance_to_end = 1.0 - points[:, n:]
    return (0.5 + beside_middle / distance_to_end).clamp(0.0, 1.0)
