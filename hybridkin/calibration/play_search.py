"""The search for the backlash (also called play) whose held-out error is least."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

_CLOSE = 0.02  # tolerance of a refined width, relative to it


@dataclass(frozen=True)
class WidthSearch:
    """Backlash (also called play) with the least held-out error.

    Attributes
    ----------
    width : float
        The chosen width [unit of q]; zero if none lowers the error.
    widths : ndarray of shape (W,)
        Widths tried, ascending from zero, including doubled ones if the largest was the best.
    cv_rmse : ndarray of shape (W,)
        Mean held-out error for each width [m].
    gain : float
        Mean reduction of the errors of the parts by the best width [m].
    gain_std_error : float
        Standard error of `gain` over the parts [m].
    kept : bool
        Whether the play lowers the error: `gain` is above `gain_std_error`.
    """

    width: float
    widths: NDArray
    cv_rmse: NDArray
    gain: float
    gain_std_error: float
    kept: bool


def search_width(
    errors_by_part: Callable[[float], NDArray],
    mean: Callable[[NDArray], float],
    widths: list[float],
    widest: float,
    *,
    refine: bool = False,
) -> WidthSearch:
    """Return the width of the play with the least held-out error.

    Parameters
    ----------
    errors_by_part : callable
        Maps a width to the held-out errors (K,) of folds or motions [m].
    mean : callable
        Maps these errors to their mean, which is compared.
    widths : list of float
        Widths to try, ascending from zero. While the largest is the best, twice that width is
        tried too.
    widest : float
        Largest width to try.
    refine : bool, default=False
        Whether to minimise the error between the neighbours of the best width.
    """
    errors_of = cache(errors_by_part)

    def error(width: float) -> float:
        return float(mean(errors_of(width)))

    widths = list(widths)
    best = min(widths, key=error)
    while 0.0 < best == widths[-1] < widest:
        widths.append(min(2.0 * best, widest))
        best = min(widths, key=error)
    if refine and best > 0.0:
        place = widths.index(best)
        bounds = widths[place - 1], widths[min(place + 1, len(widths) - 1)]
        options = {"xatol": _CLOSE * best}
        minimum = minimize_scalar(
            error, bounds=bounds, method="bounded", options=options
        )
        best = min(best, float(minimum.x), key=error)
    gains = errors_of(0.0) - errors_of(best)
    gain = float(gains.mean())
    std_error = float(gains.std(ddof=1) / np.sqrt(len(gains)))
    helps = best > 0.0 and gain > std_error
    return WidthSearch(
        best if helps else 0.0,
        np.array(widths),
        np.array([error(width) for width in widths]),
        gain,
        std_error,
        helps,
    )
