"""Base class of elastic bodies, which have no shape where an arc would be too short."""

from __future__ import annotations

import torch
from torch import Tensor

from hybridkin._core.blocks import in_blocks
from hybridkin._core.kernel_numbers import HK_LEAST_LENGTH
from hybridkin._core.named_rows import named_rows, without_warnings
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.calibratable import Scale

_FACTORS = ("bending_stiffness", "axial_stiffness", "weight")
_FACTOR = 1e4  # by which these can grow or shrink in a calibration

COMPRESSED = f"compressed: in {{rows}} an arc is below {HK_LEAST_LENGTH:g} of its rest length"


class ElasticBody(ArcChain):
    """A chain of arcs in balance; results are NaN where it has no shape."""

    def scale_of(self, entry: str) -> Scale:
        """Return the natural scale of the numbers of an entry of the geometry."""
        if entry in _FACTORS:
            return Scale.factor(_FACTOR)
        return super().scale_of(entry)

    def has_shape(self, q: Tensor) -> Tensor:
        """Return whether the body has a shape at q (..., n), shape (...), bool."""

        def known(rows: Tensor) -> tuple[Tensor]:
            return (self._arcs_of_rows(rows).isfinite().all(0)[:, None],)

        with torch.no_grad(), without_warnings():
            (rows,) = in_blocks(known, self._rows(q))
        return rows.reshape(q.shape[:-1])


def why_not(words: str, q: Tensor, is_missing: Tensor, first: int = 0) -> str | None:
    """Return `words` with the missing rows of q (N, n), numbered from `first` on; None if none."""
    places = is_missing.nonzero()[:, 0].tolist()
    if not places:
        return None
    rows = named_rows([first + place for place in places])
    example = [float(f"{value:.6g}") for value in q[places[0]].tolist()]
    return f"{words.format(rows=rows)} (first `q`: {example})."
