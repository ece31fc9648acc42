"""Markers, the measured or controlled points of a chain of arcs: places and offsets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hybridkin._core.arrays import number
from hybridkin.chains._checks import filled
from hybridkin.chains.chain import Chain

if TYPE_CHECKING:
    from typing_extensions import Self

Marker = tuple[float, float, float, float]
"""Place on the backbone [segments from the base], and offset in the frame at that place [m]."""


class MarkedChain(Chain):
    """A chain whose outputs are one or several points of the robot; the last one is the tip.

    Attributes
    ----------
    markers : tuple of K tuples of four floats
        For every point its place on the backbone, in segments from the base, and its offset in
        the frame at that place [m]. By default the robot's end.
    tip_at : float
        The place of the last marker, the tip.
    """

    n_segments: int
    markers: tuple[Marker, ...]
    tip_at: float

    def with_tip(self, at: float) -> Self:
        """Return a chain whose tip is another point of the same robot.

        Parameters
        ----------
        at : float
            Place on the backbone, in segments from the base: 1.5 is the middle of the second
            segment's arc, 2.0 its end after its rigid offset, S (the default) the robot's end.

        Returns
        -------
        ArcChain
            Tip, Jacobians and tip transform belong to that point; actuators, arcs, poses and
            backbone still belong to the whole robot.

        Examples
        --------
        >>> import torch
        >>> from hybridkin import ConstantCurvatureChain
        >>> chain = ConstantCurvatureChain([0.01, 0.01], lengths=[0.1, 0.1]).with_tip(1.5)
        >>> chain(torch.zeros(6, dtype=torch.float64))
        tensor([0.0000, 0.0000, 0.1500], dtype=torch.float64)
        """
        if not 0.0 < number(at, "at") <= self.n_segments:
            raise ValueError(
                f"`at` must lie in (0, {self.n_segments}], in segments from the base, got {at}."
            )
        return self._marked([(at, 0.0, 0.0, 0.0)])

    def with_markers(self, markers: Sequence[Any]) -> Self:
        """Return a chain whose outputs are several points of the same robot.

        Parameters
        ----------
        markers : sequence of K tuples (segment, fraction) or (segment, fraction, offset)
            For every point: the segment, counted from 0; the fraction of its arc, in (0, 1], where
            1 is the end of the segment after its rigid offset; and the `offset` (3,) in the frame
            at that place [m], by default zero. The last point is the tip: poses refer to it.

        Returns
        -------
        ArcChain
            Maps q (..., n) to x (..., 3 K), marker by marker [m].

        Raises
        ------
        ValueError
            For a place that is not on the robot, and for a wrong shape.

        Examples
        --------
        >>> import torch
        >>> from hybridkin import ConstantCurvatureChain
        >>> chain = ConstantCurvatureChain([0.01, 0.01], lengths=[0.1, 0.1])
        >>> marked = chain.with_markers([(0, 0.5, (0.02, 0.0, 0.0)), (1, 1.0)])
        >>> marked(torch.zeros(6, dtype=torch.float64))
        tensor([0.0200, 0.0000, 0.0500, 0.0000, 0.0000, 0.2000], dtype=torch.float64)
        """
        markers_checked = []
        for marker in markers if isinstance(markers, (list, tuple)) else [markers]:
            if not isinstance(marker, (list, tuple)) or len(marker) not in (2, 3):
                need = "tuples (segment, fraction) or (segment, fraction, offset)"
                raise ValueError(f"`markers` must be {need}, got {marker!r:.80}.")
            segment, fraction, *offset = marker
            beside = filled(
                offset[0] if offset else 0.0, "markers", torch.float64, (3,)
            )
            if (
                segment not in range(self.n_segments)
                or not 0.0 < number(fraction, "markers") <= 1
            ):
                raise ValueError(
                    "`markers` must be tuples (segment, fraction, offset) with a segment from 0 to "
                    f"{self.n_segments - 1} and a fraction in (0, 1], got {segment}, {fraction}."
                )
            markers_checked.append((segment + fraction, *beside.tolist()))
        if not markers_checked:
            raise ValueError("`markers` must hold at least one marker, got none.")
        if getattr(self, "stage", None) and any(
            x or y for _, x, y, _ in markers_checked
        ):
            raise ValueError(
                "`markers` must lie on the backbone of a robot on a rotation stage."
            )
        return self._marked(markers_checked)

    @property
    def tip_model(self) -> Self:
        """The chain of the last marker alone."""
        return self.tips()[-1]

    def tips(self) -> list[Self]:
        """Return one chain per marker, each mapping q (..., n) to x (..., 3)."""
        single = len(self.markers) == 1
        return [self] if single else [self._marked([marker]) for marker in self.markers]

    def up_to_tip(self, arcs: Tensor) -> Tensor:
        """Return the rows (3 m, ...) up to the tip, of arcs (3 S, ...) or of their slope.

        The last of the m segments is cut at the tip.
        """
        if self.tip_at == self.n_segments:
            return arcs
        m = math.ceil(self.tip_at)
        parts = arcs.unflatten(0, (3, self.n_segments))[:, :m]
        last = parts[:, -1:] * (self.tip_at - m + 1)
        return torch.cat([parts[:, :-1], last], dim=1).flatten(0, 1)

    def _marked(self, markers: Sequence[Any]) -> Self:
        chain = self.with_geometry()  # shares the buffers
        chain._set_markers(markers)
        return chain

    def _set_markers(self, markers: Sequence[Any]) -> None:
        self.markers = tuple(
            (float(at), float(x), float(y), float(z)) for at, x, y, z in markers
        )
        self.tip_at = self.markers[-1][0]
        self.n_outputs = 3 * len(self.markers)

    def _tip_offsets(self, offsets: Tensor) -> Tensor:
        """Return the rigid offsets (..., m) up to the tip."""
        if self.tip_at == self.n_segments:
            return offsets
        m = math.ceil(self.tip_at)
        last = offsets[..., m - 1 : m] * float(self.tip_at == m)
        return torch.cat([offsets[..., : m - 1], last], dim=-1)
