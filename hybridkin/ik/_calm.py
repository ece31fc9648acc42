"""Posture steps of a robot that rests where its target is out of reach."""

from __future__ import annotations

import torch
from torch import Tensor


def calmed(z: Tensor, task: Tensor, calm: Tensor) -> Tensor:
    """Return steps z (N, n), in the rows `calm` (N,) at most half as long as those of a task.

    Else the way to a posture would go on shaking a robot that rests where its target is out of
    reach.
    """
    share = task.norm(dim=-1) / (2.0 * z.norm(dim=-1))
    share = torch.where(calm, share.clamp_max(1.0), 1.0)
    return share.nan_to_num(1.0)[..., None] * z
