"""Rows in another unit than those of the fit: which of q and x, and by what factor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.units import other_unit

_LARGER = 20.0  # times the fit; smaller ratios can be other motions
_SMALLER = 0.01
_POSTURES = 0.05  # span of predicted tips over their largest distance that tells a unit


def check_commands(q: NDArray, low: NDArray, high: NDArray, turns: bool) -> None:
    """Raise if actuator vectors are those of the fit in another unit.

    Parameters
    ----------
    q : ndarray of shape (N, n)
        New rows.
    low, high : ndarray of shape (n,)
        The range of q in the fit.
    turns : bool
        Whether all actuators are angles.
    """
    usual = np.maximum(np.abs(low), np.abs(high))
    # Small numbers are another unit only for lengths that are never near zero.
    lengths = np.minimum(low * np.sign(high), high * np.sign(low)) > 0.0
    moved = usual > 0.0
    if not len(q) or not moved.any():
        return
    largest = (np.abs(q)[:, moved] / usual[moved]).max(axis=1)
    ratio = float(np.median(largest))
    small = ratio < _SMALLER and lengths.all()
    if not small and ratio < _LARGER:
        return
    _refuse("X", "actuator vectors", ratio, "those of the fit", turns)


def check_tips(measured: NDArray, predicted: NDArray, name: str) -> None:
    """Raise if measured tips are those of a model in another unit; its base may have moved.

    Rows that hold about one posture, or that do not move, tell nothing of the unit.

    Parameters
    ----------
    measured, predicted : ndarray of shape (N, m)
        Tips, NaN if not measured, and those of the model at the same commands [m].
    name : str
        Name of the measured tips in messages.
    """
    seen = np.where(np.isnan(measured), np.nan, predicted)
    moved = _span(seen)
    if len(measured) < 2 or not moved > _POSTURES * np.nanmax(np.abs(seen)):
        return
    ratio = _span(measured) / moved
    small = ratio < _SMALLER and other_unit(ratio) is not None
    if not small and ratio < _LARGER:  # smaller ones can be a robot that did not move
        return
    _refuse(name, "tips", ratio, "the model predicts", False)


def _refuse(name: str, what: str, ratio: float, than: str, turns: bool) -> None:
    """Raise an error that names the unit, if the ratio is that of one."""
    unit = other_unit(ratio, angle=turns)
    looks = "check their unit" if unit is None else f"this looks like {unit.in_words}"
    raise ValueError(
        f"`{name}` must hold {what} in the unit of the fit, but they are about {ratio:.2g} times "
        f"as large as {than}; {looks}."
    )


def _span(tips: NDArray) -> float:
    """Return the largest side of the box around tips (N, m), NaN left out."""
    with np.errstate(all="ignore"):
        sides = np.nanmax(tips, axis=0, initial=-np.inf) - np.nanmin(tips, axis=0, initial=np.inf)
    return float(np.max(sides, initial=0.0, where=np.isfinite(sides)))
