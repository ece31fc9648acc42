"""A fitted structure: its errors in words, and the tip error to expect with more rows."""

from __future__ import annotations

from math import degrees, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin.chains.structural import StructuralChain
from hybridkin.hybrid.held_out import MEAN_LENGTH

# Label, unit and units per SI unit of every block.
_WORDS = {
    "gravity": ("twist by a load across the robot", "deg", degrees(1.0)),
    "twists": ("twist of single segments", "deg", degrees(1.0)),
    "sags": ("sag", "deg", degrees(1.0)),
    "ring stretch": ("ring stretch", "%", 100.0),
    "ring turn": ("ring turn", "deg", degrees(1.0)),
    "ring maps": ("other ring maps", "%", 100.0),
    "zero lengths": ("zeros of lengths", "%", 100.0),
    "zero bends": ("zeros of bends", "deg", degrees(1.0)),
    "base turn": ("base turn", "deg", degrees(1.0)),
    "base move": ("base move", "mm", 1e3),
}
_MORE = 4  # times the rows of a fit, in a forecast
_VECTORS = ("gravity", "base turn", "base move")  # others: root mean square of entries


class BlockSize(NamedTuple):
    """The size of a block of errors, with its standard error, in prior standard deviations and SI.

    Attributes
    ----------
    name : str
        The block, a key of `natural_scales.STRUCTURE`.
    size, std_error : float
        Length of a vector, or root mean square of several numbers [rad], [m] or [-].
    in_priors : float
        Root mean square in standard deviations of the prior.
    """

    name: str
    size: float
    std_error: float
    in_priors: float

    def __str__(self) -> str:
        label, unit, per_si = _WORDS[self.name]
        return f"{label} {per_si * self.size:.2g} +- {per_si * self.std_error:.2g} {unit}"


class StructureFit(NamedTuple):
    """A fitted structure, its posterior, and the residuals of held-out rows.

    Attributes
    ----------
    model : StructuralChain
        The chain with its errors.
    blocks : tuple of str
        Block of every parameter; the base comes first.
    parameters : ndarray of shape (P,)
        In units of their prior standard deviation.
    covariance : ndarray of shape (P, P)
        Of the posterior, in these units.
    factor : float
        Common factor of the prior.
    residual : ndarray of shape (N, m)
        Of every row from a fit without it, or its group [m].
    rmse : float
        Weighted root mean square length of `residual` [m].
    units : ndarray of shape (P,)
        Prior standard deviation of every parameter [rad], [m] or [-].
    spread : ndarray of shape (P, P)
        Mean of A' A over the rows, with A the derivative of a tip by the parameters [m^2].
    n_rows : int
        Number of rows N.
    """

    model: StructuralChain
    blocks: tuple[str, ...]
    parameters: NDArray
    covariance: NDArray
    factor: float
    residual: NDArray
    rmse: float
    units: NDArray
    spread: NDArray
    n_rows: int

    def __repr__(self) -> str:
        errors = ", ".join(str(size) for size in self.sizes())
        held_out = ""
        if self.rmse == self.rmse:
            held_out = f"; held-out rmse {1e3 * self.rmse:.3g} mm"
        return f"StructureFit({self.n_rows} rows: {errors}{held_out})"

    def sizes(self) -> list[BlockSize]:
        """Return the sizes of the blocks, the largest in units of its prior first."""
        sizes = []
        variances = np.diag(self.covariance)
        for name in dict.fromkeys(self.blocks):
            members = np.flatnonzero([block == name for block in self.blocks])
            rms = sqrt(np.mean(self.parameters[members] ** 2))
            unit = float(self.units[members[0]])
            of_vector = sqrt(len(members)) if name in _VECTORS else 1.0
            std_error = sqrt(np.mean(variances[members]))
            sizes.append(BlockSize(name, unit * of_vector * rms, unit * std_error, rms))
        return sorted(sizes, key=lambda size: -size.in_priors)

    def in_words(self, most: int = 5) -> str:
        """Return the largest blocks in words."""
        return "Structure: " + "; ".join(str(size) for size in self.sizes()[:most])

    def distance_by_few_rows(self, n_rows: float) -> float:
        """Return the mean tip error because n rows do not identify the structure [m].

        The rows are like those of the fit: n / N times their information.
        """
        return MEAN_LENGTH / sqrt(3.0) * sqrt(self._square(n_rows))

    def expected_distance(self, n_rows: float, now: float | None = None) -> float:
        """Return the mean distance to new readings to expect after a fit to n rows like these [m].

        With S the covariance of the parameters after n rows and A the derivative of a tip, the mean
        square is that of A S A' plus a constant, the noise of a reading and what the structure does
        not explain. The constant makes it agree with the error `now` of the fit.

        Parameters
        ----------
        n_rows : float
            Number of rows.
        now : float, optional
            Mean distance to expect after this fit [m]. Default: by `rmse`.
        """
        per_rms = MEAN_LENGTH / sqrt(3.0)
        if now is None:
            now = per_rms * self.rmse
        square = (now / per_rms) ** 2
        of_fit = self._square(self.n_rows)
        # Less noise than assumed can make the error smaller than predicted.
        scale = min(1.0, square / of_fit)
        return per_rms * sqrt(square + scale * (self._square(n_rows) - of_fit))

    def forecast_in_words(self, now: float) -> str:
        """Return what to expect of this fit, and of more rows; `now` is as in `expected_distance`.

        Both are the mean distance to new readings, and the part of it that more rows lower.
        """
        more = _MORE * self.n_rows
        later = self.expected_distance(more, now)
        of_few = min(self.distance_by_few_rows(self.n_rows), now)
        of_more = min(self.distance_by_few_rows(more), later)
        return (
            f"{self.n_rows} rows: structural model; expect {1e3 * now:.2g} mm at new readings. "
            f"Few rows alone cause {1e3 * of_few:.2g} mm; the rest is noise and what the model "
            f"does not explain. {more} rows like these would give about {1e3 * later:.2g} mm "
            f"({1e3 * of_more:.2g} mm by few rows)."
        )

    def _square(self, n_rows: float) -> float:
        """Return the mean of tr(A S A') over the rows [m^2], with S after n rows like these."""
        information = np.linalg.inv(self.covariance) - np.eye(len(self.units))
        system = n_rows / self.n_rows * information + np.eye(len(self.units))
        return max(float(np.trace(np.linalg.solve(system, self.spread))), 0.0)
