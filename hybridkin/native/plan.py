"""Plans: a model as one array of numbers and one of positions in it, for the compiled core."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.stored import Stored

# Kinds of nodes, as src/plan.h numbers them.
ARCS, ELASTIC, RIGID, AFFINE, ELM, POLYNOMIAL, KERNEL, READOUT = range(1, 9)
LEVERAGE_GUARD, BOX_GUARD, QUADRATIC_LEVERAGE, HYBRID = range(9, 13)
# What the kernels have room for, see src/plan.h.
MOST = {"actuators": 64, "segments": 16, "outputs": 64, "features": 4096}


class NoKernel(ValueError):
    """A part of a model has no kernel; the message says which and why."""


class Plan:
    """The nodes of a model, parts before what is made of them, and the numbers they use.

    Attributes
    ----------
    code : ndarray of int32
        Node after node: kind, lengths of input and output, place of its numbers, then sizes and
        the places of parts.
    data : ndarray of float64
        All numbers.
    root : int
        Place in `code` of the node that is the whole model.
    """

    def __init__(self, stored: Stored) -> None:
        self._code: list[int] = []
        self._data: list[NDArray] = []
        self._length = 0
        self.root = self.node_of(stored)
        self.code = np.array(self._code, dtype=np.int32)
        self.data = np.concatenate([*self._data, np.zeros(8)])
        self._data = []  # not twice in pickles
        for array in (self.code, self.data):
            array.flags.writeable = False

    @property
    def n_inputs(self) -> int:
        """Length of q."""
        return int(self.code[self.root + 1])

    @property
    def n_outputs(self) -> int:
        """Length of x."""
        return int(self.code[self.root + 2])

    @property
    def digest(self) -> str:
        """SHA-256 of the plan: equal for models that compute the same."""
        whole = self.code.tobytes() + self.root.to_bytes(4, "little") + self.data.tobytes()
        return hashlib.sha256(whole).hexdigest()

    def node_of(self, stored: Stored) -> int:
        """Write the node of a description, its parts first, and return its place."""
        write = WRITERS.get(stored.kind)
        if write is None:
            raise NoKernel(f"a part of the kind {stored.kind!r} has no kernel")
        return write(self, stored)

    def node(self, kind: int, n: int, m: int, numbers: list[NDArray], *more: int) -> int:
        """Write a node with its numbers, and return its place."""
        for what, size in (("actuators", n), ("outputs", m)):
            self.limit(what, size)
        place, at = len(self._code), self._length
        flat = [np.asarray(part, dtype=np.float64).ravel() for part in numbers]
        self._data += flat
        self._length += sum(len(part) for part in flat)
        self._code += [kind, n, m, at, *map(int, more)]
        return place

    @staticmethod
    def limit(what: str, size: int) -> None:
        """Raise where a size is larger than the kernels have room for."""
        if size > MOST[what]:
            raise NoKernel(f"{size} {what}: the kernels have room for {MOST[what]}")


def _up_to_tip(stored: Stored, *by_arcs: NDArray) -> tuple[int, NDArray, list[NDArray]]:
    """Return the segments up to the tip, the frame, and arrays (3 S, ...) cut to these segments.

    The frame is the rotation of the base, its position, and the rigid offsets up to the tip.
    """
    base, at = stored.array("base"), stored.value("tip_at", float)
    offsets = stored.array("offsets")
    S, m = len(offsets), math.ceil(at)
    Plan.limit("segments", S)
    share = at - m + 1
    ends = np.append(offsets[: m - 1], offsets[m - 1] * (at == m))
    scale = np.append(np.ones(m - 1), share)
    cut = [a.reshape(3, S, -1)[:, :m] * scale[:, None] for a in (np.asarray(a) for a in by_arcs)]
    return m, np.concatenate([base[:3, :3].ravel(), base[:3, 3], ends]), cut


def _constant_curvature(plan: Plan, stored: Stored) -> int:
    S, frame, (matrix, offset) = _up_to_tip(
        stored, stored.derived["arc_matrix"], stored.derived["arc_offset"]
    )
    return plan.node(ARCS, matrix.shape[2], 3, [matrix, offset, frame], S)


WRITERS: dict[str, Callable[[Plan, Stored], int]] = {
    "constant_curvature": _constant_curvature,
}
