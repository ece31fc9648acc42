"""The backlash (also called play) of the actuators, from a log."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from hybridkin.calibration.play_search import search_width
from hybridkin.chains.play import PlayOperator
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import Spec, residuals
from hybridkin.learning.elm_cv import ELMRegressorCV

_LEAST = 0.0025  # first width, relative to the stroke
_PLAIN: dict[str, Any] = {"relevance_rounds": 0, "max_hidden": 0, "random_state": 0}


def play_of(
    play: ArrayLike | str | None, spec: Spec, rows: Rows
) -> tuple[PlayOperator | None, list[str]]:
    """Return the backlash for the setting `play` of a HybridForwardModel, and warnings about it.

    Parameters
    ----------
    play : None, "auto", float or array-like of shape (n,)
        The setting.
    spec : Spec
        The mechanical model, and its parameters to calibrate first.
    rows : Rows
        The log, with the rows of each motion in order of time.
    """
    if play is None:
        return None, []
    ranges = np.ptp(rows.X, axis=0)
    if isinstance(play, str):
        chosen = choose_play(spec.calibrated(replace(rows, groups=None)), rows)
        if chosen is None or chosen.width < 0.95 * ranges.max():
            return chosen, []
        return chosen, [
            f"play='auto' found a backlash of {chosen.width:.3g}, as wide as the range of "
            "`X`: the log gives no upper limit. Record larger motions, or give the width as `play`."
        ]
    operator = PlayOperator(play)
    if operator.width.size not in (1, len(ranges)):
        raise ValueError(
            f"`play` must be a width or {len(ranges)} widths, got {play!r:.200}."
        )
    if not np.any(operator.width >= ranges):
        return operator, []
    return operator, [
        f"`play` {play!r} must be less than the range of `X`, {ranges}: else an actuator never "
        "moves. Give `play` in the unit of `X`, for lengths metres."
    ]


def choose_play(spec: Spec, rows: Rows) -> PlayOperator | None:
    """Return the backlash with the least held-out error of an ELM; None if none helps.

    Widths up to the range of the actuators are tried. As in `fit_play`, the best width is kept only
    if its mean gain over the motions is larger than the standard error of this gain.

    Parameters
    ----------
    spec : Spec
        The mechanical model, calibrated without backlash.
    rows : Rows
        The log, with the rows of each motion in order of time.
    """
    X = rows.X
    y = rows.y
    groups = rows.groups
    motions = np.zeros(len(X)) if groups is None else groups
    strokes = np.subtract(*np.percentile(X, (95, 5), axis=0))
    widest = float(np.ptp(X, axis=0).max())
    widths = [0.0, widest]
    if strokes.any():
        # The error can have several minima over the width, so widths of all sizes are tried.
        least = _LEAST * np.median(strokes[strokes > 0.0])
        doubled = least * 2.0 ** np.arange(20)
        widths[1:1] = doubled[doubled < widest].tolist()
    # A motion is one sample, as its rows have similar errors. A single motion is cut into ten.
    parts = motions
    if len(np.unique(motions)) == 1:
        parts = np.arange(len(X)) * 10 // len(X)
    counted = (rows.counts > 0) & ~np.isnan(rows.tips).any(axis=1)
    counts = rows.counts[counted]
    motion = parts[counted]
    names, of_motion = np.unique(motion, return_inverse=True)
    if len(names) < 2:
        return None
    totals = np.bincount(of_motion, counts)

    def errors_by_motion(width: float) -> NDArray:
        effective = PlayOperator(width).apply_by_group(X, motions)[counted]
        q = torch.from_numpy(effective.astype(np.float64))
        error = residuals(spec.mechanical, q, y[counted], spec.output)
        network = ELMRegressorCV(200, weight_scales=(0.4,), **_PLAIN)
        held_out = network.fit(effective, error, counts, motion).left_out_errors_
        distance = np.linalg.norm(held_out.reshape(len(error), -1), axis=1)
        return np.bincount(of_motion, counts * distance) / totals

    search = search_width(errors_by_motion, np.mean, widths, widest, refine=True)
    return PlayOperator(search.width) if search.kept else None
