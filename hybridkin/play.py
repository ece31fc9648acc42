"""Play of tendons: backlash and dry friction as the classical play operator, and its width."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.model_selection import GroupKFold
from torch import Tensor

from hybridkin.calibration import CalibrationResult, calibrate

__all__ = ["PlayFit", "PlayOperator", "PlayState", "fit_play"]

_FOLDS = 5


class PlayState(NamedTuple):
    """Where a play operator stands, to be carried from one call to the next.

    Attributes
    ----------
    command : array or Tensor of shape (n,)
        Last command q [m].
    effective : array or Tensor of shape (n,)
        Last effective change y [m], within half the width of the command.
    """

    command: Any
    effective: Any


class PlayOperator:
    """Play between commanded and effective tendon length changes.

    The effective change stands still until the command has moved away by half the width, then
    follows at that distance: ``y_t = clip(y_{t-1}, q_t - width / 2, q_t + width / 2)``. The
    outcome depends on the order of the commands, not on their speed. The operator holds no state:
    it is handed over and returned, so that several robots or branches of a plan share one.

    Parameters
    ----------
    width : float or array-like of shape (n,)
        Total play of all or of each tendon [m], zero or more. Zero is the identity.

    References
    ----------
    Krasnosel'skii & Pokrovskii, Systems with Hysteresis, Springer 1989, section 2 (play).

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import PlayOperator
    >>> play = PlayOperator(0.5)
    >>> y, state = play.apply(np.array([[0.0], [1.0], [0.75], [0.0]]))
    >>> y.ravel()
    array([0.  , 0.75, 0.75, 0.25])
    >>> q, state = play.command(np.array([[0.5], [0.0]]), state)
    >>> q.ravel()
    array([ 0.75, -0.25])
    """

    def __init__(self, width: ArrayLike) -> None:
        self.width = np.array(width, dtype=float)
        valid = np.isfinite(self.width) & (self.width >= 0)
        if self.width.ndim > 1 or not valid.all():
            raise ValueError(
                f"`width` must be one or (n,) finite numbers, zero or more, got {width!r}."
            )

    def apply(self, q: Any, state: PlayState | None = None) -> tuple[Any, PlayState]:
        """Return the effective changes of a motion, and the state at its end.

        Parameters
        ----------
        q : array or Tensor of shape (T, n)
            Commanded tendon length changes in the order of time [m].
        state : PlayState, optional
            Where the motion before ended. None: the first row counts as it is, y_0 = q_0.

        Returns
        -------
        y : array or Tensor of shape (T, n)
            Effective changes [m], what the robot's model is to be given.
        state : PlayState
            For the rows that follow.

        Raises
        ------
        ValueError
            For a wrong shape, for entries that are not finite, or for no rows without a state.
        """
        rows, half, before = self._checked(q, state, "q")
        y, (sent, effective) = [], before
        for sent in rows:
            effective = torch.minimum(torch.maximum(effective, sent - half), sent + half)
            y.append(effective)
        return _like(q, y, rows, PlayState(sent, effective))

    def command(self, y: Any, state: PlayState | None = None) -> tuple[Any, PlayState]:
        """Return the commands by which the effective changes become y: the inverse of `apply`.

        A tendon that moves is sent half the width further; one that rests keeps its command.

        Parameters
        ----------
        y : array or Tensor of shape (T, n)
            Wanted effective changes in the order of time [m].
        state : PlayState, optional
            Where the motion before ended. None: the first row is sent as it is, q_0 = y_0.

        Returns
        -------
        q : array or Tensor of shape (T, n)
            Commands to send [m]. They jump by the width where a tendon turns back.
        state : PlayState
            For the rows that follow.

        Raises
        ------
        ValueError
            For a wrong shape, for entries that are not finite, or for no rows without a state.
        """
        rows, half, before = self._checked(y, state, "y")
        q, (sent, effective) = [], before
        for row in rows:
            sent = torch.where(row == effective, sent, row + half * torch.sign(row - effective))
            effective = row
            q.append(sent)
        return _like(y, q, rows, PlayState(sent, effective))

    def apply_by_group(self, q: Any, groups: ArrayLike) -> Any:
        """Return the effective changes of a log of several motions, each started afresh.

        Parameters
        ----------
        q : array or Tensor of shape (N, n)
            Commanded tendon length changes, the rows of one motion in the order of time [m].
        groups : array-like of shape (N,)
            Motion of every row.

        Returns
        -------
        array or Tensor of shape (N, n)
            Effective changes [m].

        Raises
        ------
        ValueError
            For wrong shapes or entries that are not finite.
        """
        groups = np.asarray(groups)
        if groups.shape != tuple(q.shape)[:1]:
            raise ValueError(f"`groups` must have shape ({len(q)},), got {groups.shape}.")
        order = np.argsort(groups, kind="stable")  # a motion's rows keep their order
        starts = np.flatnonzero(groups[order][1:] != groups[order][:-1]) + 1
        parts = [self.apply(q[at])[0] for at in np.split(order, starts)]
        back = np.argsort(order)
        return torch.cat(parts)[back] if isinstance(q, Tensor) else np.concatenate(parts)[back]

    def __repr__(self) -> str:
        return f"PlayOperator(width={self.width.tolist()})"

    def _checked(
        self, rows: Any, state: PlayState | None, name: str
    ) -> tuple[Tensor, Tensor, PlayState]:
        """Return the rows, half the width and the state before them as tensors."""
        rows = rows if isinstance(rows, Tensor) else torch.as_tensor(np.asarray(rows))
        rows = rows if rows.is_floating_point() else rows.to(torch.float64)
        if rows.ndim != 2 or self.width.shape not in ((), rows.shape[1:]):
            needed = self.width.size if self.width.ndim else "n"
            raise ValueError(f"`{name}` must have shape (T, {needed}), got {tuple(rows.shape)}.")
        if not torch.isfinite(rows).all():
            raise ValueError(f"`{name}` must be finite, got NaN or infinity.")
        if state is None:
            if not len(rows):
                raise ValueError(f"`{name}` must hold at least one row where there is no `state`.")
            state = PlayState(rows[0], rows[0])
        before = PlayState(*(torch.as_tensor(part).to(rows) for part in state))
        if any(part.shape != rows.shape[1:] for part in before):
            shapes = [tuple(part.shape) for part in before]
            raise ValueError(
                f"`state` must hold vectors of shape {(rows.shape[1],)}, got {shapes}."
            )
        return rows, torch.as_tensor(self.width / 2).to(rows), before


@dataclass(frozen=True)
class PlayFit:
    """Play that a log shows, and the chain calibrated with it.

    Attributes
    ----------
    width : float
        Chosen play [m]; zero where none was kept.
    widths : ndarray of shape (W,)
        Widths tried [m], ascending, the first zero.
    cv_rmse : ndarray of shape (W,)
        Root mean square tip distance on motions held out, with each width [m].
    gain : float
        By how much the best width lowers the error of a fold, on average [m].
    gain_std_error : float
        Standard error of `gain` over the folds [m].
    kept : bool
        Whether play is worth its while: `gain` is above `gain_std_error`.
    result : CalibrationResult
        The calibration on all rows with the chosen width.
    """

    width: float
    widths: NDArray
    cv_rmse: NDArray
    gain: float
    gain_std_error: float
    kept: bool
    result: CalibrationResult

    @property
    def play(self) -> PlayOperator:
        """The operator to put before ``result.chain``."""
        return PlayOperator(self.width)


def fit_play(
    chain: Any,
    q: Any,
    x: Any,
    groups: ArrayLike,
    widths: Sequence[float] = (0.0, 0.05e-3, 0.1e-3, 0.2e-3, 0.4e-3),
    parameters: Sequence[str] | None = None,
    **calibrate_options: Any,
) -> PlayFit:
    """Return the play of the tendons, chosen by motions held out, and the chain behind it.

    With every width the chain is calibrated on the effective changes of the training motions and
    measured on the others, in at most 5 folds. The best width is kept only where its gain over no
    play, averaged over the folds, exceeds its standard error.

    Parameters
    ----------
    chain : ElasticTendonChain, ConstantCurvatureChain or nn.Module
        Start of the calibration; it is not changed.
    q : array or Tensor of shape (N, n_actuators)
        Commanded tendon length changes, the rows of one motion in the order of time [m].
    x : array or Tensor of shape (N, 3)
        Measured tip positions [m].
    groups : array-like of shape (N,)
        Motion of every row; each starts without a past.
    widths : sequence of float, default=(0, 0.05e-3, 0.1e-3, 0.2e-3, 0.4e-3)
        Total play to try, the same for all tendons [m]. Zero is tried in any case.
    parameters : sequence of str, optional
        What to calibrate, see `calibrate`. Default: the chain's own list.
    **calibrate_options
        `loss`, `prior` and `bounds` of `calibrate`.

    Returns
    -------
    PlayFit
        ``.play`` and ``.result.chain`` make the model.

    Raises
    ------
    ValueError
        For fewer than two motions, negative widths, and what `calibrate` raises.

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
    tried = np.unique(np.concatenate([[0.0], np.asarray(widths, dtype=float).ravel()]))
    groups = np.asarray(groups)
    folds = min(_FOLDS, len(np.unique(groups)))
    if folds < 2:
        raise ValueError("`groups` must name at least 2 motions to hold one out, got 1.")
    names = tuple(chain.default_parameters) if parameters is None else parameters
    effective = [PlayOperator(width).apply_by_group(q, groups) for width in tried]
    splits = list(GroupKFold(folds).split(groups, groups=groups))
    mean_squares = np.array(
        [
            [_mean_square(chain, y, x, names, split, calibrate_options) for split in splits]
            for y in effective
        ]
    )
    sizes = [len(test) for _, test in splits]
    cv_rmse = np.sqrt(np.average(mean_squares, axis=1, weights=sizes))
    best = int(np.argmin(cv_rmse))
    gains = np.sqrt(mean_squares[0]) - np.sqrt(mean_squares[best])
    gain, std_error = float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(folds))
    kept = best > 0 and gain > std_error
    chosen = best if kept else 0
    result = calibrate(chain, effective[chosen], x, names, **calibrate_options)
    return PlayFit(float(tried[chosen]), tried, cv_rmse, gain, std_error, kept, result)


def _mean_square(
    chain: Any, y: Any, x: Any, names: Sequence[str], split: Any, options: dict[str, Any]
) -> float:
    """Return the mean squared tip distance on the motions held out."""
    train, test = split
    fitted = calibrate(chain, y[train], x[train], names, **options).chain
    with torch.no_grad():
        held_out = torch.as_tensor(y[test]).to(fitted.geometry()["base"])
        error = fitted(held_out) - torch.as_tensor(x[test]).to(held_out)
    return float(error.square().sum(dim=1).mean())


def _like(given: Any, rows: Sequence[Tensor], like: Tensor, state: PlayState) -> tuple[Any, Any]:
    """Return rows and state as tensors or arrays, whichever was given."""
    out = torch.stack(tuple(rows)) if rows else torch.zeros_like(like)
    if isinstance(given, Tensor):
        return out, state
    return out.numpy(), PlayState(*(part.numpy() for part in state))
