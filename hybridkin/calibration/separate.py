"""Motions that separate geometries with nearly equal errors on a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import Numbers, real_array
from hybridkin.calibration._least_squares import TipRows
from hybridkin.calibration._motions import Motion, motions_within
from hybridkin.calibration.calibrate import check_data, refitted
from hybridkin.calibration.choice import GeometryChoice
from hybridkin.calibration.measured import evenly_spaced, points
from hybridkin.chains.chain import Chain

__all__ = ["SeparatingMotion", "separating_motions"]

_MOST = 200  # rows of the log
_BEYOND = 0.25  # of the range of the log, on both sides, without limits
_TRIED = 4  # motions after which both sets are calibrated again


@dataclass(frozen=True)
class SeparatingMotion:
    """A motion that shows which of two sets of parameters suits a robot.

    Attributes
    ----------
    chosen, rival : str
        Names of the two sets, see `errors` of `GeometryChoice`.
    motion : str
        What to do, in words.
    q : ndarray of shape (T, n_actuators)
        Rows of the motion, in order [unit of q].
    difference : float
        Largest distance along the motion between the tips of both models, each calibrated on the
        log and moved by its mean residual [m].
    remaining : float
        The part of it that a calibration on the log and this motion cannot remove: the root mean
        square error on the motion, if the robot is one of both models and the other one is
        calibrated [m].
    noise : float
        Root mean square error of the chosen set on the log [m].
    """

    chosen: str
    rival: str
    motion: str
    q: NDArray
    difference: float
    remaining: float
    noise: float

    @property
    def separates(self) -> bool:
        """Whether the difference that remains is larger than the errors on the log."""
        return self.remaining > self.noise

    def __str__(self) -> str:
        sets = f"{self.chosen!r} and {self.rival!r}"
        if self.separates:
            return (
                f"{self.motion}: {sets} differ by up to {1e3 * self.difference:.2g} mm there "
                f"({1e3 * self.remaining:.2g} mm rms after a new calibration; errors on the log "
                f"{1e3 * self.noise:.2g} mm)"
            )
        return (
            f"no motion within the limits separates {sets}: the best one leaves "
            f"{1e3 * self.remaining:.2g} mm rms, errors on the log are {1e3 * self.noise:.2g} mm"
        )


def separating_motions(
    choice: GeometryChoice,
    q: Numbers,
    x: Numbers,
    *,
    q_min: ArrayLike | None = None,
    q_max: ArrayLike | None = None,
) -> tuple[SeparatingMotion, ...]:
    """Return for each rival of a choice the motion that best shows which of the two is right.

    A log can leave open which parameters of the robot are wrong: the `rivals` of a `GeometryChoice`
    have nearly the errors of the chosen set. All are calibrated on the log. Motions within the
    limits are compared: each segment bends to one side, goes around a circle, or changes its
    length, while the others stay straight; all segments bend together; one goes around a circle
    while another is bent. Of chains without one arc for each segment single actuators and pairs of
    them move. Of the motions with the largest differences the one is taken of which most remains
    after a calibration on the log and this motion.

    Parameters
    ----------
    choice : GeometryChoice
        As from `choose_geometry` for the nominal chain; a `HybridForwardModel` takes it as
        `calibrate`.
    q : array or Tensor of shape (N, n_actuators)
        Actuator vectors of the log of the choice [unit of q].
    x : array or Tensor of shape (N, 3) or (N, 3 K)
        Measured tip positions [m].
    q_min, q_max : float or array-like of shape (n_actuators,), optional
        Limits [unit of q]. Default: the range of the log, and a quarter of it beyond both ends.

    Returns
    -------
    tuple of SeparatingMotion
        One for each rival; a `SeparatingMotion` can say that no motion separates the two.

    Raises
    ------
    TypeError
        If `choice` is no `GeometryChoice`.
    ValueError
        For limits that are not finite or of a wrong shape, and as for `calibrate`.

    Examples
    --------
    A log of one segment that only becomes longer does not show its radius.

    >>> import torch
    >>> from hybridkin import ConstantCurvatureChain, GeometryChoice, separating_motions
    >>> q = torch.linspace(0.2, 0.3, 30, dtype=torch.float64)[:, None].repeat(1, 3)
    >>> q = q + 1e-3 * torch.randn(q.shape, generator=torch.manual_seed(0), dtype=torch.float64)
    >>> noise = 1e-3 * torch.randn(q.shape, generator=torch.manual_seed(1), dtype=torch.float64)
    >>> x = ConstantCurvatureChain([0.05])(q) + noise
    >>> chain = ConstantCurvatureChain([0.06])
    >>> radii = GeometryChoice(chain, ("radii", "base"), name="radii + base")
    >>> choice = GeometryChoice(chain, ("base",), name="base", rivals=(radii,))
    >>> (motion,) = separating_motions(choice, q, x, q_min=0.2, q_max=0.3)
    >>> motion.rival, motion.motion, motion.separates
    ('radii + base', 'lead segment 1 around a circle, bent by 60 deg', True)
    """
    if not isinstance(choice, GeometryChoice):
        raise TypeError(
            "`choice` must be a GeometryChoice, as from choose_geometry(chain, q, x), got "
            f"{choice!r:.80}."
        )
    chain = choice.chain.frozen().cpu()
    q, x, _ = check_data(chain, q, x)
    rows = q.numpy()
    margin = _BEYOND * np.ptp(rows, axis=0)
    low = _limit(q_min, "q_min", rows.min(axis=0) - margin)
    high = _limit(q_max, "q_max", rows.max(axis=0) + margin)
    if (low > high).any():
        raise ValueError(f"`q_min` must not exceed `q_max`, got {low} and {high}.")
    if not choice.rivals:
        return ()
    log = TipRows(q, x, q.new_ones(len(q))).take(evenly_spaced(len(q), _MOST))
    chosen = _Calibrated.of(choice.started(log.q, log.x, log.weight), log)
    with torch.no_grad():
        motions = motions_within(chosen.chain, rows, low, high)
    found = []
    for rival in choice.rivals:
        other = _Calibrated.of(rival.started(log.q, log.x, log.weight), log)
        found.append(_separating(chosen, other, log, motions))
    return tuple(found)


def _limit(value: ArrayLike | None, name: str, usual: NDArray) -> NDArray:
    """Return a finite limit of each actuator (n,)."""
    if value is None:
        return usual
    limit = real_array(value, name).astype(float)
    if limit.shape not in ((), usual.shape) or not np.isfinite(limit).all():
        raise ValueError(f"`{name}` must be one finite number or {len(usual)}, got {value!r:.200}.")
    return np.broadcast_to(limit, usual.shape)


class _Calibrated(NamedTuple):
    """A set of parameters, calibrated on rows, and the mean of the residual that is left (m,)."""

    choice: GeometryChoice
    chain: Chain
    offset: NDArray

    @classmethod
    def of(cls, choice: GeometryChoice, rows: TipRows) -> _Calibrated:
        """Return the calibration of a set on rows."""
        chain = choice.chain.frozen().cpu()
        if choice.parameters:
            chain = refitted(choice.start, rows.q, rows.x, rows.weight)
        residual = rows.x.numpy() - _tips(chain, rows.q.numpy())
        weights = np.where(np.isnan(residual), 0.0, rows.weight.numpy()[:, None])
        counts = np.maximum(weights.sum(axis=0), np.finfo(np.float64).tiny)
        offset = (weights * np.nan_to_num(residual)).sum(axis=0) / counts  # 0: never measured
        return cls(choice, chain, offset)

    def tips(self, q: NDArray) -> NDArray:
        """Return the tips at rows q (T, n), shape (T, m) [m]."""
        return _tips(self.chain, q) + self.offset


def _tips(chain: Chain, q: NDArray) -> NDArray:
    with torch.no_grad():
        return chain(torch.from_numpy(q)).numpy()


def _lengths(difference: NDArray) -> NDArray:
    """Return the largest distance of a marker in each row (T,); missing markers have none."""
    return np.nanmax(np.linalg.norm(points(difference), axis=2), axis=1)


def _rms(difference: NDArray) -> float:
    return float(np.sqrt(np.mean(_lengths(difference) ** 2)))


def _separating(
    chosen: _Calibrated, rival: _Calibrated, log: TipRows, motions: Sequence[Motion]
) -> SeparatingMotion:
    """Return the best motion for two sets: the first ones by their difference are tried."""
    differences = [chosen.tips(motion.q) - rival.tips(motion.q) for motion in motions]
    order = np.argsort([-_rms(difference) for difference in differences], kind="stable")
    best = 0
    remaining = -1.0
    for k in order[:_TRIED].tolist():
        q = motions[k].q
        left = max(_left(chosen, rival, log, q), _left(rival, chosen, log, q))
        if left > remaining:
            best = k
            remaining = left
    return SeparatingMotion(
        chosen=chosen.choice.name,
        rival=rival.choice.name,
        motion=motions[best].words,
        q=motions[best].q,
        difference=float(_lengths(differences[best]).max()),
        remaining=remaining,
        noise=_rms(log.x.numpy() - chosen.tips(log.q.numpy())),
    )


def _left(truth: _Calibrated, imitation: _Calibrated, log: TipRows, q: NDArray) -> float:
    """Return the error on a motion q (T, n) of a set that is calibrated on it and on the log [m].

    The tips are those of the other set. The motion counts as much as the log.
    """
    tips = truth.tips(q)
    weights = torch.cat([log.weight, log.weight.new_full((len(q),), len(log.q) / len(q))])
    both = TipRows(
        torch.cat([log.q, torch.from_numpy(q)]),
        torch.cat([log.x, torch.from_numpy(tips)]),
        weights,
    )
    anew = _Calibrated.of(imitation.choice, both)
    return _rms(anew.tips(q) - tips)
