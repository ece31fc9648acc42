"""How much play the actuators have, told by a log."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from hybridkin.calibration.calibrate import calibrate
from hybridkin.chains.play import PlayOperator
from hybridkin.learning.elm_cv import ELMRegressorCV

_WIDTHS = (0.0025, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16)  # over the stroke of an actuator
_CLOSE = 0.02  # to the best width
_PLAIN: dict[str, Any] = {"relevance_rounds": 0, "max_hidden": 0, "random_state": 0}


def play_of(
    play: Any,
    mechanical: Any,
    names: tuple[str, ...],
    X: NDArray,
    y: NDArray,
    weights: NDArray | None,
    groups: Any,
) -> PlayOperator | None:
    """Return the play that a HybridForwardModel asks for.

    Parameters
    ----------
    play : None, "auto", float or array-like of shape (n,)
        Its setting.
    mechanical : nn.Module or None
        Its mechanical model.
    names : tuple of str
        What to calibrate of that, first.
    X, y, weights, groups
        As for `choose_play`.
    """
    if not isinstance(play, str):
        operator = None if play is None else PlayOperator(play)
        if operator is not None and np.any(operator.width >= np.ptp(X, axis=0)):
            warnings.warn(
                f"`play` {play!r} is no less than the range of `X`, {np.ptp(X, axis=0)}: such an "
                "actuator never moves. Its unit is that of `X`, metres.",
                stacklevel=4,
            )
        return operator
    if names:
        tips = y.reshape(len(y), -1)[:, :3]
        with warnings.catch_warnings():  # what is to say is said of the model with play
            warnings.simplefilter("ignore", UserWarning)
            mechanical = calibrate(mechanical, X, tips, names, sample_weight=weights).chain
    return choose_play(mechanical, X, y, weights, groups)


def choose_play(
    mechanical: Any, X: NDArray, y: NDArray, weights: NDArray | None, groups: Any
) -> PlayOperator | None:
    """Return the play with which an ELM errs least on motions left out; None where none helps.

    As in `fit_play`, it is kept only where it lowers the error of a motion by more than the
    standard error of that over the motions.

    Parameters
    ----------
    mechanical : nn.Module or None
        Calibrated without play.
    X, y : ndarray of shape (N, n) and (N, m)
        Log, the rows of one motion in the order of time.
    weights, groups : ndarray of shape (N,) or None
        How often each row counts; its motion.
    """
    motions = np.zeros(len(X)) if groups is None else np.asarray(groups)
    strokes = np.subtract(*np.percentile(X, (95, 5), axis=0))
    widths = [0.0, *(share * float(np.median(strokes)) for share in _WIDTHS)]
    # A motion is one sample: its rows err alike. Without motions stretches of the log serve.
    parts = np.arange(len(X)) * 10 // len(X) if groups is None else motions
    counted = np.ones(len(y), bool) if weights is None else weights > 0
    names = np.unique(parts[counted])
    tried: dict[float, NDArray] = {}

    def error_by_motion(width: float) -> NDArray:
        if width not in tried:
            effective = PlayOperator(width).apply_by_group(X, motions)
            error = y
            if mechanical is not None:
                with torch.no_grad():
                    tips = mechanical(torch.from_numpy(effective.astype(np.float64))).numpy()
                error = y - tips.reshape(y.shape)
            network = ELMRegressorCV(200, weight_scales=(0.4,), **_PLAIN)
            left = network.fit(effective, error, weights, parts).left_out_errors_
            distance = np.linalg.norm(left.reshape(len(y), -1), axis=1)
            tried[width] = np.array([distance[counted & (parts == a)].mean() for a in names])
        return tried[width]

    def mean_error(width: float) -> float:
        return float(error_by_motion(width).mean())

    best = min(widths, key=mean_error)
    if best > 0.0:
        found = minimize_scalar(mean_error, (best / 2.0, best, best * 2.0), tol=_CLOSE)
        best = min(best, float(found.x), key=mean_error)
    gains = error_by_motion(0.0) - error_by_motion(best)
    kept = best > 0.0 and gains.mean() > gains.std(ddof=1) / np.sqrt(len(names))
    return PlayOperator(best) if kept else None
