"""The backlash (also called play), or other hysteresis, of the actuators, from a log."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin.calibration.hysteresis_fit import HysteresisProblem
from hybridkin.calibration.measured import folds
from hybridkin.calibration.play_search import search_width
from hybridkin.chains.hysteresis import HysteresisOperator
from hybridkin.chains.play import PlayOperator
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import Spec, residuals
from hybridkin.learning.elm_cv import ELMRegressorCV

_LEAST = 0.0025  # first width, relative to the stroke
_SPREADS = 0.2, 1.0  # standard deviations of slopes to try, as long as errors fall
_PLAIN: dict[str, Any] = {"relevance_rounds": 0, "max_hidden": 0, "random_state": 0}


def play_of(
    play: ArrayLike | str | None, spec: Spec, rows: Rows
) -> tuple[HysteresisOperator | None, list[str]]:
    """Return the hysteresis for the setting `play` of a HybridForwardModel, and warnings about it.

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
        single = isinstance(chosen, PlayOperator)
        if not single or chosen.width < 0.95 * ranges.max():
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


def choose_play(spec: Spec, rows: Rows) -> HysteresisOperator | None:
    """Return the hysteresis with the least held-out error of an ELM; None if none helps.

    Widths of one backlash up to the range of the actuators are tried. As in `fit_play`, the best
    width is kept only if its mean gain over the motions is larger than the standard error of this
    gain. A Prandtl-Ishlinskii operator replaces it by the same rule.

    Parameters
    ----------
    spec : Spec
        The mechanical model, calibrated without backlash.
    rows : Rows
        The log, with the rows of each motion in order of time.
    """
    log = _Log.of(spec, rows)
    if log is None:
        return None
    X = rows.X
    strokes = np.subtract(*np.percentile(X, (95, 5), axis=0))
    widest = float(np.ptp(X, axis=0).max())
    widths = [0.0, widest]
    if strokes.any():
        # The error can have several minima over the width, so widths of all sizes are tried.
        least = _LEAST * np.median(strokes[strokes > 0.0])
        doubled = least * 2.0 ** np.arange(20)
        widths[1:1] = doubled[doubled < widest].tolist()

    def errors_by_motion(width: float) -> NDArray:
        effective = PlayOperator(width).apply_by_group(X, log.motions)
        return log.by_motion(log.left_out_errors(effective))

    search = search_width(errors_by_motion, np.mean, widths, widest, refine=True)
    if not search.kept:
        return None
    smooth = None if spec.mechanical is None else _smooth(log, search.width)
    return smooth or PlayOperator(search.width)


def _smooth(log: _Log, width: float) -> HysteresisOperator | None:
    """Return a Prandtl-Ishlinskii operator around one backlash; None if it does not help.

    For each fold the slopes are fitted to the other folds.
    """
    assert log.spec.mechanical is not None
    q = log.rows.X.astype(np.float64)
    positions = log.spec.positions(log.rows).numpy()
    problem = HysteresisProblem(
        log.spec.mechanical, q, log.motions, positions, log.rows.counts, width
    )
    splits = folds(log.counted, log.parts)

    def errors_by_motion(spread: float) -> NDArray:
        distance = np.empty(len(log.counted))
        for train, test in splits:
            slopes = problem.start
            if spread > 0.0:
                slopes = problem.fitted(log.counted[train], spread)
            distance[test] = log.held_out_errors(problem.effective(slopes), train, test)
        return log.by_motion(distance)

    single = errors_by_motion(0.0)
    chosen = 0.0
    errors = single
    for spread in _SPREADS:
        tried = errors_by_motion(spread)
        if tried.mean() >= errors.mean():
            break
        chosen = spread
        errors = tried
    gains = single - errors
    if gains.mean() <= gains.std(ddof=1) / np.sqrt(len(gains)):
        return None
    return problem.operator(problem.fitted(log.counted, chosen))


@dataclass(frozen=True)
class _Log:
    """Rows of whole motions, and the held-out errors of an ELM for effective changes.

    Attributes
    ----------
    spec : Spec
        The mechanical model.
    rows : Rows
        All rows, in order of time.
    motions : ndarray of shape (N,)
        Motion of every row.
    counted : ndarray of int of shape (C,)
        The rows whose errors count.
    parts : ndarray of shape (C,)
        Which of the counted rows are held out together.
    """

    spec: Spec
    rows: Rows
    motions: NDArray
    counted: NDArray
    parts: NDArray

    @classmethod
    def of(cls, spec: Spec, rows: Rows) -> Self | None:
        """Return the log of rows; None if less than two parts can be held out."""
        n_rows = len(rows)
        motions = np.zeros(n_rows) if rows.groups is None else rows.groups
        # A motion is one sample, as its rows have similar errors. A single motion is cut into ten.
        parts = motions
        if len(np.unique(motions)) == 1:
            parts = np.arange(n_rows) * 10 // n_rows
        usable = (rows.counts > 0) & ~np.isnan(rows.tips).any(axis=1)
        counted = np.flatnonzero(usable)
        if len(np.unique(parts[counted])) < 2:
            return None
        return cls(spec, rows, motions, counted, parts[counted])

    def by_motion(self, distance: NDArray) -> NDArray:
        """Return the mean distance of every part, of the distances of the counted rows (C,)."""
        _, part = np.unique(self.parts, return_inverse=True)
        counts = self.rows.counts[self.counted]
        return np.bincount(part, counts * distance) / np.bincount(part, counts)

    def left_out_errors(self, effective: NDArray) -> NDArray:
        """Return the distances (C,) of an ELM without the part of each row [m]."""
        error = self._residuals(effective)
        network = self._network(effective, error, np.arange(len(self.counted)))
        return np.linalg.norm(network.left_out_errors_.reshape(len(error), -1), axis=1)

    def held_out_errors(
        self, effective: NDArray, train: NDArray, test: NDArray
    ) -> NDArray:
        """Return the distances of an ELM, fitted to some counted rows, on others [m]."""
        error = self._residuals(effective)
        network = self._network(effective, error, train)
        missed = error[test] - network.predict(effective[self.counted[test]])
        return np.linalg.norm(missed.reshape(len(test), -1), axis=1)

    def _residuals(self, effective: NDArray) -> NDArray:
        """Return the residuals of the counted rows (C, m) [m]."""
        q = torch.from_numpy(effective[self.counted].astype(np.float64))
        y = self.rows.y[self.counted]
        return residuals(self.spec.mechanical, q, y, self.spec.output)

    def _network(
        self, effective: NDArray, error: NDArray, train: NDArray
    ) -> ELMRegressorCV:
        rows = self.counted[train]
        network = ELMRegressorCV(200, weight_scales=(0.4,), **_PLAIN)
        counts = self.rows.counts[rows]
        return network.fit(effective[rows], error[train], counts, self.parts[train])
