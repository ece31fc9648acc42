"""How much play (backlash) the actuators have, from a log."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from hybridkin.chains.play import PlayOperator
from hybridkin.hybrid._fit import Rows, Spec, calibrated, residuals
from hybridkin.learning.elm_cv import ELMRegressorCV

_WIDTHS = (0.0025, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16)  # over the stroke of an actuator
_CLOSE = 0.02  # to the best width
_PLAIN: dict[str, Any] = {"relevance_rounds": 0, "max_hidden": 0, "random_state": 0}


def play_of(
    play: ArrayLike | str | None, spec: Spec, rows: Rows
) -> tuple[PlayOperator | None, list[str]]:
    """Return the play that a HybridForwardModel asks for, and warnings about it.

    Parameters
    ----------
    play : None, "auto", float or array-like of shape (n,)
        Its setting.
    spec : Spec
        Its mechanical model, and what to calibrate of that first.
    rows : Rows
        The log, the rows of one motion in the order of time.
    """
    if play is None:
        return None, []
    if isinstance(play, str):
        return choose_play(calibrated(spec, rows), rows), []
    operator, ranges = PlayOperator(play), np.ptp(rows.X, axis=0)
    if not np.any(operator.width >= ranges):
        return operator, []
    return operator, [
        f"`play` {play!r} is no less than the range of `X`, {ranges}: such an actuator never "
        "moves. Its unit is that of `X`, metres."
    ]


def choose_play(spec: Spec, rows: Rows) -> PlayOperator | None:
    """Return the play with the least held-out error of an ELM; None where none helps.

    As in `fit_play`, it is kept only where it lowers the error of a motion by more than the
    standard error of that over the motions.

    Parameters
    ----------
    spec : Spec
        Its mechanical model, calibrated without play.
    rows : Rows
        The log, the rows of one motion in the order of time.
    """
    X, y, weights, groups = rows
    motions = np.zeros(len(X)) if groups is None else groups
    strokes = np.subtract(*np.percentile(X, (95, 5), axis=0))
    widths = [0.0, *(share * float(np.median(strokes)) for share in _WIDTHS)]
    # A motion is one sample: its rows err alike. Without motions stretches of the log serve.
    parts = np.arange(len(X)) * 10 // len(X) if groups is None else motions
    counted = rows.counts > 0
    names = np.unique(parts[counted])

    @cache
    def error_by_motion(width: float) -> NDArray:
        effective = PlayOperator(width).apply_by_group(X, motions)
        q = torch.from_numpy(effective.astype(np.float64))
        error = residuals(spec.mechanical, q, y, spec.output)
        network = ELMRegressorCV(200, weight_scales=(0.4,), **_PLAIN)
        held_out = network.fit(effective, error, weights, parts).left_out_errors_
        distance = np.linalg.norm(held_out.reshape(len(y), -1), axis=1)
        kept = [counted & (parts == a) for a in names]
        return np.array([np.average(distance[k], weights=rows.counts[k]) for k in kept])

    def mean_error(width: float) -> float:
        return float(error_by_motion(width).mean())

    best = min(widths, key=mean_error)
    if best > 0.0:
        found = minimize_scalar(mean_error, (best / 2.0, best, best * 2.0), tol=_CLOSE)
        best = min(best, float(found.x), key=mean_error)
    gains = error_by_motion(0.0) - error_by_motion(best)
    kept = best > 0.0 and gains.mean() > gains.std(ddof=1) / np.sqrt(len(names))
    return PlayOperator(best) if kept else None
