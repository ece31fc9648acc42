"""The plane of q that commands keep to, which may be all of its space."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class PlaneOfQ(NamedTuple):
    """A plane of actuator vectors; without normals it is the whole space.

    Attributes
    ----------
    point : Tensor of shape (n,)
        A point of the plane [unit of q].
    normals : Tensor of shape (n, k)
        Orthonormal columns.
    """

    point: Tensor
    normals: Tensor

    @classmethod
    def whole(cls) -> PlaneOfQ:
        """Return the whole space, whatever n is."""
        none = torch.zeros(0, 0, dtype=torch.float64, device="cpu")
        return cls(none.flatten(), none)

    @property
    def n_normals(self) -> int:
        """Number of directions that the plane leaves out."""
        return self.normals.shape[1]

    def shifted(self, shift: Tensor) -> PlaneOfQ:
        """Return the plane of q for which q + shift lies in this one."""
        if not self.n_normals:
            return self
        return PlaneOfQ(self.point - shift, self.normals)

    def along(self, motion: Tensor) -> Tensor:
        """Return motions (..., n) without their part normal to the plane."""
        if not self.n_normals:
            return motion
        normals = self.normals.to(motion)
        return motion - motion @ normals @ normals.mT

    def nearest(self, q: Tensor) -> Tensor:
        """Return the points of the plane that are nearest to q, shape () or (..., n)."""
        if not self.n_normals:
            return q
        point = self.point.to(q)
        return point + self.along(q - point)
