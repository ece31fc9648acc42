"""Markers, the measured or controlled points of a chain of arcs: places and offsets."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from hybridkin._core.arrays import number
from hybridkin._core.constants import constant
from hybridkin._core.frames import Marker
from hybridkin._core.model import ForwardModel
from hybridkin.chains._checks import filled, place_on_body
from hybridkin.chains.chain import Chain

if TYPE_CHECKING:
    from typing_extensions import Self


class MarkedChain(Chain):
    """A chain whose outputs are one or several points of the robot; the last one is the tip.

    Attributes
    ----------
    markers : tuple of K tuples of four floats
        For every point its place on the backbone, in segments from the base, and its offset in
        the frame at that place [m]. By default the robot's end.
    """

    n_segments: int
    arcs_per_segment: int = 1
    markers: tuple[Marker, ...]
    stage: str | None = None  # "rotation" if the first segment is a rotation stage

    @property
    def n_stages(self) -> int:
        """Number of leading actuators that turn the whole robot, 1 on a rotation stage, else 0."""
        return int(self.stage == "rotation")

    @property
    def tip_at(self) -> float:
        """The place of the tip, the last marker, in segments from the base."""
        return self.markers[-1][0]

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
        return self._marked([(place_on_body(at, self.n_segments), 0.0, 0.0, 0.0)])

    def with_markers(self, markers: Sequence[Sequence[Any]]) -> Self:
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
        need = (
            "`markers` must be tuples (segment, fraction) or (segment, fraction, offset), with a "
            f"segment from 0 to {self.n_segments - 1} and a fraction in (0, 1]"
        )
        if not isinstance(markers, Iterable):
            raise TypeError(f"{need}, got {markers!r:.80}.")
        places: list[Marker] = []
        for marker in markers:
            try:
                segment, fraction, offset = (*marker, 0.0)[:3]
            except (TypeError, ValueError) as error:
                raise ValueError(f"{need}, got {marker!r:.80}.") from error
            x, y, z = filled(offset, "markers", torch.float64, (3,)).tolist()
            inside = 0.0 < number(fraction, "markers") <= 1.0
            if segment not in range(self.n_segments) or not inside:
                raise ValueError(f"{need}, got {marker!r:.80}.")
            places.append((float(segment + fraction), x, y, z))
        if not places:
            raise ValueError(f"{need}, got none.")
        if self.n_stages and any(x or y for _, x, y, _ in places):
            raise ValueError("`markers` must lie on the backbone of a robot on a rotation stage.")
        return self._marked(places)

    @property
    def tip_model(self) -> Self:
        """The chain of the last marker alone."""
        return self.each_tip()[-1]

    def each_tip(self) -> list[Self]:
        """Return one chain per marker, each mapping q (..., n) to x (..., 3)."""
        single = len(self.markers) == 1
        return [self] if single else [self._marked([marker]) for marker in self.markers]

    def joined(self, tips: list[ForwardModel]) -> Self:
        """Return the chain of all markers of chains of one marker each."""
        markers = [marker for tip in tips for marker in tip.markers]
        return self._marked(markers)

    def up_to_tip(self, coordinates: Tensor) -> Tensor:
        """Return arcs (3 S, ...), or their slope, up to the tip, (3 m, ...)."""
        return self.up_to_markers(coordinates)[:, -1]

    def up_to_markers(self, arcs: Tensor) -> Tensor:
        """Return arcs (3 S, ...), or their slope, up to each of K markers, (3 m, K, ...).

        The m segments lead to the farthest marker. An arc is cut at a marker.
        """
        if self.markers_at_end:
            return arcs[:, None]
        reached = self._reached(arcs)
        by_kind = arcs.unflatten(0, (3, -1)).unbind()
        return torch.cat([_times(reached, part) for part in by_kind])

    def offsets_to_markers(self, offsets: Tensor) -> Tensor:
        """Return the rigid offsets (S,) that lie before each marker, (m, K)."""
        if self.markers_at_end:
            return offsets[:, None]
        return _times(self._reached(offsets) == 1.0, offsets)

    def by_arcs(self, columns: Tensor) -> Tensor:
        """Return derivatives (3, 3 S, K, N) by arcs, from those by arcs up to the markers.

        The latter are (3, 3 m, K, N).
        """
        if self.markers_at_end:
            return columns
        reached = self._reached(columns)
        parts = columns.unflatten(1, (3, -1)) * reached[..., None]
        return self._padded(parts).flatten(1, 2)

    def by_offsets(self, columns: Tensor) -> Tensor:
        """Return derivatives (3, S, K, N) by offsets, from those before markers (3, m, K, N)."""
        if self.markers_at_end:
            return columns
        before = self._reached(columns) == 1.0
        return self._padded(columns * before[..., None])

    def _padded(self, parts: Tensor) -> Tensor:
        """Return derivatives (..., S, K, N): zero by segments after all markers."""
        n_after = self.n_segments * self.arcs_per_segment - parts.shape[-3]
        if n_after == 0:
            return parts  # `pad` would copy them
        return nn.functional.pad(parts, (0, 0, 0, 0, 0, n_after))

    @property
    def markers_at_end(self) -> bool:
        """Whether the only marker is at the end of the robot."""
        return len(self.markers) == 1 and self.markers[0][0] == self.n_segments

    def _reached(self, like: Tensor) -> Tensor:
        """Return the part (m, K) of the arc of every segment that lies before each marker."""
        places = tuple(at * self.arcs_per_segment for at, *_ in self.markers)
        segments = tuple(range(math.ceil(max(places))))
        before = constant(segments, like)[:, None]
        return (constant(places, like) - before).clamp(0.0, 1.0)

    def _marked(self, markers: Sequence[Marker]) -> Self:
        chain = self.with_geometry()  # shares the buffers
        chain._set_markers(markers)
        return chain

    def _set_markers(self, markers: Sequence[Marker]) -> None:
        self.markers = tuple(markers)
        self.n_outputs = 3 * len(self.markers)


def _times(reached: Tensor, values: Tensor) -> Tensor:
    """Return parts (m, K) times the first m of values (S, ...), shape (m, K, ...)."""
    values = values[: len(reached), None]
    return reached.reshape(*reached.shape, *[1] * (values.ndim - 2)) * values
