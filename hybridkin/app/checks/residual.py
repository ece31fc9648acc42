"""Checks of the residual of a rough model: a drift of the tip, or a lag behind q."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin import Commands
from hybridkin.app.checks.report import LogFinding
from hybridkin.datasets import Log

if TYPE_CHECKING:
    from hybridkin import ForwardModel

_LAGS = 10  # largest lag of the tip in rows, in both directions
# Limits of the rms residual of a model with a drift, and with a lag, relative to that without. For
# simulated logs and recordings of real robots without drift or lag it was above 0.89.
_DRIFT = 0.8
_LAG = 0.6
_MOST = 50_000  # rows of a fit


def residual_findings(log: Log, chain: ForwardModel | None, same: NDArray) -> Iterator[LogFinding]:
    """Yield findings on a drift of the tip and on lags.

    Parameters
    ----------
    log : Log
        Valid rows in order of time.
    chain : Chain or None
        Nominal model, a part of the rough model.
    same : ndarray of shape (N - 1,)
        Whether each row and the next belong to the same motion.
    """
    features = _features(log.q, chain)
    x = log.x
    if len(x) < 3 * features.shape[1] or not np.ptp(x, axis=0).any():
        return
    size = 1e3 * np.sqrt(x.var(axis=0).sum())
    t = np.linspace(-1.0, 1.0, len(x))[:, None]
    left = _left(features, x)
    drifted = _left(np.hstack([features, t, t**2]), x)
    if drifted < _DRIFT * left:
        message = (
            f"the tip drifts or steps during the log: the residual of a rough model falls from "
            f"{size * left:.3g} to {size * drifted:.3g} mm rms with a trend in time."
        )
        advice = (
            "find out if the camera or the base was moved, or if the robot became warm; fit the "
            "parts separately, or leave the moved part out."
        )
        yield LogFinding("drift", "warning", message, advice)
    run = np.concatenate([[0], np.cumsum(~same)])
    lagged = {0: left}
    for k in range(-_LAGS, _LAGS + 1):
        early = slice(max(-k, 0), min(-k, 0) or None)
        late = slice(max(k, 0), min(k, 0) or None)
        same_run = run[early] == run[late]
        if k and same_run.sum() > 0.3 * len(x):
            lagged[k] = _left(features[early][same_run], x[late][same_run])
    best = min(lagged, key=lambda k: lagged[k])
    if lagged[best] < _LAG * left:
        message = (
            f"the tip is {abs(best)} rows {'behind' if best > 0 else 'ahead of'} q: the rms "
            f"residual is {size * lagged[best]:.3g} mm with this lag, {size * left:.3g} mm without."
        )
        advice = "synchronise the clocks of the two recordings, or move slowly and wait for rest."
        yield LogFinding("lag", "warning", message, advice)


def _features(q: NDArray, chain: ForwardModel | None) -> NDArray:
    """Return the features of a rough linear model of the tip: q, squares and the chain's tips."""
    spans = np.ptp(q, axis=0)
    z = (q - q.mean(axis=0)) / np.where(spans > 0, spans, 1.0)
    columns = [np.ones((len(q), 1)), z, z**2]
    if chain is not None:
        with torch.no_grad():
            columns.append(chain(torch.from_numpy(q)).numpy())
    return np.hstack(columns)


def _left(features: NDArray, x: NDArray) -> float:
    """Return the rms residual of x by least squares over the rms of x about its mean.

    Of a long log some rows are enough, spread over it.
    """
    rows = Commands(features).spread_rows(_MOST)
    features = features[rows]
    x = x[rows]
    weights, *_ = np.linalg.lstsq(features, x, rcond=None)
    residual = x - features @ weights
    centred = x - x.mean(axis=0)
    return float(np.linalg.norm(residual) / np.linalg.norm(centred))
