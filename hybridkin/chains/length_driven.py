"""Chains of arcs whose actuators have given lengths: chambers, and tendons that are wound up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.arrays import as_array
from hybridkin._core.blocks import in_blocks
from hybridkin._core.plausible import PlausibleRows
from hybridkin._core.units import LONGEST_PULL, length_message
from hybridkin.chains.arc_chain import ArcChain

PLANAR = 1e-9
"""Relative cut-off of singular values, for tendons in one plane."""
_LONGEST = 10.0  # largest plausible length of an extensible segment [m]
_REACHES = 50.0  # and in sizes of the robot


class LengthDrivenChain(ArcChain):
    """A chain of arcs whose actuators have given lengths, or changes of length.

    Attributes
    ----------
    in_metres : bool
        Whether q is in metres; else `metres` converts it.
    radii : Tensor of shape (S,)
        Radius of the circle of actuators of each segment [m].
    """

    takes_lengths: ClassVar[bool] = True

    @property
    def in_metres(self) -> bool:
        """Whether q is in metres: all gains are 1."""
        return bool((self.gains == 1.0).all())

    @property
    def mean_gain(self) -> float:
        """Mean length of a unit of q [m]."""
        return float(self.gains.detach().abs().mean())

    @property
    def unit_of_q(self) -> str | list[str]:
        """Unit of q, or of each actuator; with gains any, for example counts."""
        if not self.in_metres:
            return "as in training"
        if not self.n_stages:
            return "m"
        return ["rad"] * self.n_stages + ["m"] * (self.n_actuators - self.n_stages)

    @property
    def _tendons(self) -> NDArray[np.bool_]:
        """Which actuators (n,) are tendons of given length: those of segments with a length."""
        return ~np.repeat(self.extensible, self.actuators_per_segment)

    def metres(self, q: Tensor) -> Tensor:
        """Return q (..., n) in metres: lengths, or changes of length."""
        self._check_shape(q)
        return self.gains.to(q) * (q - self.rest.to(q))

    def balanced(self, q: NDArray, low: NDArray, high: NDArray) -> NDArray:
        """Return rows near q (N, n) in which no tendons of a segment pull against each other.

        If such a row exceeds an upper limit, all tendons of the segment are pulled until the
        slackest is at its limit. Chambers, and rows that then exceed a lower limit, are left out.
        """
        if not self._tendons.all():
            return q
        rest = as_array(self.rest.detach())
        gains = as_array(self.gains.detach())  # balanced in metres
        low, high = np.sort([gains * (low - rest), gains * (high - rest)], axis=0)
        pulled = gains * (q - rest)
        angles = as_array(self.angles.detach())
        for ring in self.rings:
            axes = np.stack([np.cos(angles[ring]), np.sin(angles[ring])], axis=1)
            balanced = pulled[:, ring] @ axes @ np.linalg.pinv(axes, rcond=PLANAR)
            excess = (balanced - high[ring]).max(axis=1, keepdims=True)
            pulled[:, ring] = balanced - excess.clip(min=0.0)
        within = ((pulled >= low) & (pulled <= high)).all(axis=1)
        return rest + pulled[within] / gains

    @property
    def _free_gain(self) -> tuple[str, ...]:
        """The gain as a parameter that a calibration fits by default, if q is not in metres."""
        return () if self.in_metres else ("gain",)

    def _with_gain(self, sets: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
        """Return sets of parameters, after the smallest, with the gain beside the radii.

        Tips of tendons determine only their ratio: without the gain, its error moves into the
        radii.
        """
        gain = self._free_gain
        both = [(*names, *gain) if "radii" in names else names for names in sets]
        return [(), ("base",), *both]

    def unit_messages(self, q: Tensor, name: str, factor: float = 1.0) -> list[str]:
        """Return a warning if lengths exceed 10 m or 50 robots, or changes 4 backbone lengths."""
        if not self.in_metres:
            name = f"{name}` times `gains"
        # Also test q itself, without zeros: `q` may hold speeds, or limits that are absent.
        gains = self.gains.to(q)

        def size(rows: Tensor) -> tuple[Tensor]:
            metres = self.metres(rows).abs()
            return (torch.minimum((gains * rows).abs(), metres),)

        (metres,) = in_blocks(size, q)
        beyond = metres > factor * self._largest_metres.to(q)
        beyond[..., : self.n_stages] = False  # an angle
        length = self.reach.detach() / self.n_segments
        usual = torch.where(self.absolute, length, self.radii.detach().max())
        usual = usual.to(q).expand_as(metres)[beyond]
        message = length_message(name, metres[beyond], 0.0, usual)
        return [] if message is None else [message]

    @property
    def _largest_metres(self) -> Tensor:
        """Largest plausible length or change of length (n,) [m]."""
        reach = self.reach.detach()
        longest = (_REACHES * reach).clamp(max=_LONGEST)
        return torch.where(self.absolute, longest, LONGEST_PULL * reach)

    def plausible_rows(self) -> PlausibleRows:
        """Return bounds of rows that need no warning about their units."""
        weights = torch.diag(self.gains.detach() / self._largest_metres)
        bounded = weights[self.n_stages :]  # the angle of a stage has no bound
        return PlausibleRows(as_array(self.rest), as_array(bounded))
