"""Backlash (also called play) of the actuators from a log, chosen by held-out motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import Numbers, check_shape, labels, real_array
from hybridkin._core.commands import Commands
from hybridkin.calibration.calibrate import CalibrationResult, calibrate, fit_geometry
from hybridkin.calibration.hysteresis_log import HysteresisLog
from hybridkin.calibration.hysteresis_search import search_width
from hybridkin.chains.chain import Chain
from hybridkin.chains.play import PlayOperator

__all__ = ["PlayFit", "fit_play"]

_WIDTHS = np.array([0.05e-3, 0.1e-3, 0.2e-3, 0.4e-3])  # [m]


@dataclass(frozen=True)
class PlayFit:
    """Backlash (also called play) identified from a log, and the chain calibrated with it.

    Attributes
    ----------
    width : float
        Chosen play [unit of q]; zero if none was kept.
    widths : ndarray of shape (W,)
        Widths tried [unit of q], ascending from zero, including doubled ones if the largest was
        the best.
    cv_distance : ndarray of shape (W,)
        Mean tip distance on held-out motions for each width [m], with a linear correction inside
        the chain.
    gain : float
        Mean reduction of the distances of motions by the best width [m].
    gain_std_error : float
        Standard error of `gain` over the motions [m].
    kept : bool
        Whether the play lowers the error: `gain` is above `gain_std_error` and 1 % of the error.
    result : CalibrationResult
        The calibration on all rows with the chosen width.
    """

    width: float
    widths: NDArray
    cv_distance: NDArray
    gain: float
    gain_std_error: float
    kept: bool
    result: CalibrationResult

    @property
    def play(self) -> PlayOperator:
        """The operator to apply to q before ``result.chain``."""
        return PlayOperator(self.width)


def fit_play(
    chain: Chain,
    q: Numbers | Commands,
    x: Numbers,
    groups: ArrayLike,
    widths: Sequence[float] | None = None,
    parameters: Sequence[str] | None = None,
    **calibrate_options: Any,
) -> PlayFit:
    """Return the backlash (also called play) of the tendons, and the chain calibrated with it.

    The chain is calibrated without play. For every width, a linear correction inside it is fitted
    to the training motions and evaluated on the held-out motions, in at most 5 folds. The best
    width is kept only if its mean gain over zero play exceeds the standard error of the gain, and
    1 % of the error. Then the chain is calibrated again; only this issues warnings.

    Parameters
    ----------
    chain : ElasticTendonChain, ConstantCurvatureChain or another Chain
        Start of the calibration; it is not changed.
    q : array or Tensor of shape (N, n_actuators), or Commands
        Commanded tendon length changes, the rows of each motion in order of time [m]. Backlash goes
        on within a run of `Commands`; by default each motion is a run.
    x : array or Tensor of shape (N, 3)
        Measured tip positions [m].
    groups : array-like of shape (N,)
        Motion of every row. Whole motions are held out.
    widths : sequence of float, optional
        Total play to try, the same for all tendons [unit of q]. Default: 0, 0.05, 0.1, 0.2 and
        0.4 mm, divided by the mean gain of a chain with gains. Zero is always tried. While the
        largest width is the best, twice that width is tried too, up to the largest range of q.
    parameters : sequence of str, optional
        Parameters to calibrate, see `calibrate`. Default: the chain's own list.
    **calibrate_options
        `loss` and `prior` of `calibrate`.

    Returns
    -------
    PlayFit
        ``.play`` followed by ``.result.chain`` is the model.

    Raises
    ------
    ValueError
        For fewer than two motions or negative widths, and as in `calibrate`.

    References
    ----------
    Krasnosel'skii & Pokrovskii, Systems with Hysteresis, Springer 1989, section 2 (play).

    Examples
    --------
    >>> import numpy as np, torch
    >>> from hybridkin import ConstantCurvatureChain, PlayOperator, fit_play
    >>> truth = ConstantCurvatureChain([0.005], lengths=[0.1])
    >>> groups = np.repeat(np.arange(8), 20)
    >>> swing = np.sin(np.linspace(0, 6, 20)) * np.arange(1, 9)[:, None]
    >>> q = 0.0005 * np.stack([np.cos(groups - a) * swing.ravel() for a in (0, 2.1, 4.2)], axis=1)
    >>> with torch.no_grad():
    ...     x = truth(torch.as_tensor(PlayOperator(0.0004).apply_by_group(q, groups))).numpy()
    >>> fit = fit_play(truth, q, x, groups, parameters=("radii",))
    >>> fit.kept, fit.width
    (True, 0.0004)
    """
    tried = _WIDTHS / chain.mean_gain
    if widths is not None:
        tried = real_array(widths, "widths").ravel()
    tried = np.unique([0.0, *tried]).tolist()
    names = parameters or chain.default_parameters
    commands = q if isinstance(q, Commands) else Commands(real_array(q, "q"))
    q = real_array(commands.q, "q")
    x = real_array(x, "x")
    check_shape(x, "x", ("N", chain.n_outputs))
    check_shape(q, "q", (len(x), chain.n_actuators), "one row for each row of `x`")
    groups = labels(groups, len(x))
    runs = groups if commands.runs is None else commands.runs
    nominal, _ = fit_geometry(chain, q, x, names, **calibrate_options)
    log = HysteresisLog(
        nominal.chain,
        q.astype(np.float64),
        x.astype(np.float64),
        np.ones(len(x)),
        groups,
        runs=runs,
        time=np.arange(len(x), dtype=np.float64),
    )
    search = search_width(log.thinned(), tried)
    gain = search.gain
    width = search.best.width if gain.clear else 0.0
    y = PlayOperator(width).apply_by_group(q, runs)
    return PlayFit(
        width,
        widths=np.array([candidate.width for candidate in search.tried]),
        cv_distance=np.array([candidate.error() for candidate in search.tried]),
        gain=gain.mean,
        gain_std_error=gain.std_error,
        kept=gain.clear,
        result=calibrate(chain, y, x, names, **calibrate_options),
    )
