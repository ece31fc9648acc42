"""The caller's touches: labels of rows that touched the same point, and known distances."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin._core.arrays import LARGEST, as_tensor, check_shape, is_label, number
from hybridkin.calibration._least_squares import Fit, TipRows
from hybridkin.calibration._touched import NO_POINT, Ties, TouchedRows
from hybridkin.chains.chain import Chain

DISTANCE_STD = 1e-4
"""Standard error of a distance between two points that calipers measured [m]."""

_SIZELESS = 1e-4  # of the robot's reach: far below the size of any set of points
_KNOWN = 0.05  # largest standard error of the size of the points that is no assumption
_COLLAPSED = 0.5  # a tip that moves less than this fraction
_SHOWN = 5  # labels in a message


@dataclass(frozen=True, eq=False)
class Touches:
    """Which rows touched which points, and what is known of these.

    Attributes
    ----------
    names : tuple of K labels
        The points, in the order of their first touch.
    point : ndarray of int of shape (N,)
        Which point each row touched; -1: none.
    known : Ties
        Known distances between points.
    """

    names: tuple[Hashable, ...]
    point: NDArray[np.intp]
    known: Ties

    @classmethod
    def of(
        cls,
        touched: ArrayLike | Tensor | None,
        distances: Mapping[tuple[Any, Any], float] | None,
        distance_std: float,
        weights: NDArray,
    ) -> Touches:
        """Return the touches of a caller, checked; rows of weight 0 (N,) touch nothing."""
        place: dict[Hashable, int] = {}
        point = np.full(len(weights), NO_POINT)
        if touched is not None:
            for row, label in enumerate(_labels(touched, len(weights))):
                if is_label(label) and label != "" and weights[row]:
                    point[row] = place.setdefault(label, len(place))
        known = _known_distances(distances or {}, distance_std, place)
        return cls((*place,), point, known)

    @property
    def touching(self) -> NDArray[np.bool_]:
        """Which rows touched a point, (N,)."""
        return np.asarray(self.point != NO_POINT)

    def tips(self, x: Any, n_outputs: int, weights: NDArray) -> Any:
        """Return measured tips (N, n_outputs), NaN for None if all rows that count are touches."""
        if x is not None or not self.names:
            return x
        unknown = np.flatnonzero(~self.touching & (weights > 0.0))
        if unknown.size:
            raise ValueError(
                "`touched` must name a point in every row if `x` is None, but "
                f"{unknown.size} of {len(weights)} rows have none (first: row {unknown[0]}); leave "
                "these rows out, or give measured tips in `x`."
            )
        return np.full((len(self.point), n_outputs), np.nan)

    def rows(self, chain: Chain, names: tuple[str, ...], rows: TipRows, first: NDArray) -> TipRows:
        """Return different rows, the given ones at the places `first`, with their touches.

        Raise if touches cannot calibrate the parameters with these names.
        """
        if not self.names:
            return rows
        touches = replace(self, point=self.point[first])
        touches._check(chain, names, rows)
        return TouchedRows(
            rows.q,
            rows.x,
            rows.weight,
            touches.point,
            len(self.names),
            self.known,
            _SIZELESS * chain.size,
        )

    def by_name(self, unknowns: NDArray, as_tensors: bool) -> dict[Any, Any]:
        """Return coordinates (3 K,) of the points as arrays or tensors (3,) by name."""
        rows = unknowns.reshape(-1, 3)
        values = torch.from_numpy(rows) if as_tensors else rows
        return dict(zip(self.names, values, strict=True))

    def size_sentences(self, error: float) -> list[str]:
        """Return a sentence if the relative standard error of the size of the points is large."""
        if error < _KNOWN:
            return []
        return [
            "touches do not fix the size of this robot: the size of the set of points is known to "
            f"{100 * error:.0f} % (std. error), from the prior. Give `distances` between points, "
            "or list fewer lengths in `parameters`."
        ]

    def messages(self, start: Chain, fit: Fit) -> list[str]:
        """Return a warning if the tip of a robot without known sizes has almost come to rest."""
        if not self.names or len(self.known.distances) or fit.rows.seen.any():
            return []
        q = fit.rows.q
        with torch.no_grad():
            before = float(start.jacobian(q).square().mean()) ** 0.5
            after = float(fit.chain().jacobian(q).square().mean()) ** 0.5
        if after > _COLLAPSED * before:
            return []
        return [
            f"the calibrated tip moves {after / before:.2g} times as far as that of `chain`: a "
            "robot that does not move touches all points at once. Give `distances` between points, "
            "touch more points, or list fewer `parameters`."
        ]

    def _check(self, chain: Chain, names: tuple[str, ...], rows: TipRows) -> None:
        if chain.n_outputs != 3:
            raise ValueError(
                f"`touched` needs a chain with one tip, which touches, got {chain.n_outputs // 3} "
                "markers; calibrate `chain.tip_model`."
            )
        n_touches = np.bincount(self.point[self.touching], minlength=len(self.names))
        single = np.flatnonzero(n_touches < 2)
        if single.size:
            shown = ", ".join(repr(self.names[k]) for k in single[:_SHOWN])
            raise ValueError(
                "`touched` must name every point in at least two different rows, but "
                f"{single.size} of {len(self.names)} labels are in one: {shown}. One touch of an "
                "unknown point says nothing: touch it from other postures, or set its label to ''."
            )
        if "base" in names and not rows.seen.any():
            raise ValueError(
                "`parameters` must not hold 'base' without measured tips: touched points move "
                "along with the base, so nothing shows where it is. Leave 'base' out (points and "
                "tips are then in the frame of the given base), or give tips in `x`."
            )
        for pair, distance in zip(self.known.pairs, self.known.distances, strict=True):
            if distance > chain.farthest:
                a, b = self.names[pair[0]], self.names[pair[1]]
                raise ValueError(
                    f"`distances` must be in metres, got {distance:.4g} between {a!r} and {b!r} of "
                    f"a robot of {chain.size:.3g} m."
                )


def _labels(touched: ArrayLike | Tensor, n_rows: int) -> list[Any]:
    """Return a caller's labels, one for each row."""
    if isinstance(touched, Tensor):
        as_tensor(touched, "touched")
        touched = touched.tolist()
    labels = np.asarray(touched, dtype=object)
    if isinstance(touched, np.ma.MaskedArray):
        labels = np.where(np.ma.getmaskarray(touched), np.nan, labels)
    check_shape(labels, "touched", [n_rows], "one label for each row of `q`")
    for row, label in enumerate(labels):
        if not isinstance(label, Hashable):
            raise TypeError(
                f"`touched` must hold texts or numbers, got {label!r:.80} in row {row}; '' means "
                "that the row touched nothing."
            )
    return labels.tolist()


def _known_distances(distances: Any, std: Any, place: Mapping[Hashable, int]) -> Ties:
    """Return a caller's distances between points with these places."""
    std = number(std, "distance_std")
    if not 1.0 / LARGEST < std < LARGEST:
        raise ValueError(f"`distance_std` must be a positive standard error [m], got {std}.")
    if not isinstance(distances, Mapping):
        raise TypeError(
            "`distances` must map pairs of labels to metres, e.g. {('a', 'b'): 0.25}, got "
            f"{distances!r:.80}."
        )
    pairs = []
    lengths = []
    for pair, length in distances.items():
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise ValueError(
                f"`distances` must have pairs of labels as keys, e.g. ('a', 'b'), got {pair!r:.80}."
            )
        for label in pair:
            if label not in place:
                shown = [*place][:_SHOWN]
                raise ValueError(
                    f"`distances` must be between labels of `touched`, e.g. {shown}, got "
                    f"{label!r:.80} in {pair!r:.80}."
                )
        ends = sorted(place[label] for label in pair)
        if ends[0] == ends[1] or ends in pairs:
            raise ValueError(
                "`distances` must be between two different points, each pair once, got "
                f"{pair!r:.80}; give the mean of several measurements."
            )
        metres = number(length, "distances")
        if not 1.0 / LARGEST < metres < LARGEST:
            raise ValueError(
                f"`distances` must be positive and finite [m], got {metres} for {pair!r:.80}."
            )
        pairs.append(ends)
        lengths.append(metres)
    return Ties(np.array(pairs, dtype=np.intp).reshape(-1, 2), np.array(lengths), std)
