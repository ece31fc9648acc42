"""The simplest of several models whose errors are nearly the least."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def simplest_within(errors: ArrayLike, margin: float) -> int:
    """Return the place of the first error that exceeds the least one by at most a margin.

    Parameters
    ----------
    errors : array-like of shape (K,)
        Errors of K models, the simplest model first; infinite for those that do not count.
    margin : float
        Part of the least error.
    """
    values = np.asarray(errors)
    return int(np.argmax(values <= (1.0 + margin) * values.min()))
