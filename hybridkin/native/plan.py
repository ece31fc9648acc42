"""Plans: a model as one array of numbers and one of positions in it, for the compiled core."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import replace

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


def _frame(stored: Stored, reach: float) -> tuple[NDArray, NDArray]:
    """Return the frame of a chain of arcs, and the shares (m,) of the m segments up to its tip.

    The frame is the rotation of the base, its position, the reach, and the rigid offsets.
    """
    base, at = stored.array("base"), stored.value("tip_at", float)
    offsets = stored.array("offsets")
    Plan.limit("segments", len(offsets))
    m = math.ceil(at)
    share = np.append(np.ones(m - 1), at - m + 1)
    frame = [base[:3, :3].ravel(), base[:3, 3], [reach], offsets[:m] * (share == 1)]
    return np.concatenate(frame), share


def whole_chain(plan: Plan, stored: Stored) -> int:
    """Write the node of a chain of arcs up to the robot's end, wherever it is steered."""
    end = {"tip_at": float(len(stored.array("offsets")))}
    return plan.node_of(replace(stored, settings={**stored.settings, **end}))


def _constant_curvature(plan: Plan, stored: Stored) -> int:
    given, radii = stored.arrays.get("lengths"), stored.array("radii")
    frame, share = _frame(stored, 10.0 * radii.mean() if given is None else given.sum())
    m, S = len(share), len(radii)
    # Segment by segment: lengths, x-, y-bendings.
    matrix, zero = (
        stored.derived[name].reshape(3, S, -1).swapaxes(0, 1)[:m] * share[:, None, None]
        for name in ("arc_matrix", "arc_offset")
    )
    n, step, width = matrix.shape[2], 0, matrix.shape[2]
    if n % S == 0:  # each segment on the actuators that are its own
        own = np.stack([part[:, k * n // S : (k + 1) * n // S] for k, part in enumerate(matrix)])
        if np.count_nonzero(own) == np.count_nonzero(matrix):
            matrix, step, width = own, n // S, n // S
    return plan.node(ARCS, n, 3, [frame, zero, matrix], m, step, width)


def _elastic_tendons(plan: Plan, stored: Stored) -> int:
    lengths, radii, rest = (stored.array(name) for name in ("lengths", "radii", "rest_bends"))
    frame, share = _frame(stored, lengths.sum())
    counts, m, S = stored.list_of(int, "actuators_per_segment"), len(share), len(radii)
    share = np.append(share, np.zeros(S - m))[:, None]
    base = stored.value("routing", str) == "base"
    coupled = base * (np.arange(S) > 0)[:, None]
    bending = stored.array("bending_stiffness")
    stiffness = np.stack([stored.array("axial_stiffness"), bending, bending], 1)
    arcs = share * np.column_stack([lengths, rest])
    segments = np.hstack([stiffness, coupled * stiffness, arcs, share, coupled * share])
    of, angles = np.repeat(np.arange(S), counts), stored.array("angles")
    x, y = -radii[of] * np.cos(angles), -radii[of] * np.sin(angles)
    bent = (np.cumsum(rest, 0) if base else rest)[of]  # the zeros become those of bends from rest
    zeros = stored.array("tendon_zeros") + x * bent[:, 0] + y * bent[:, 1]
    tendons = np.stack([zeros, x, y, x * x, x * y, y * y], 1)
    same = counts[0] if len({*counts}) == 1 else 0
    return plan.node(ELASTIC, len(x), 3, [frame, segments, tendons], m, S, same, *counts)


def _rigid(plan: Plan, stored: Stored) -> int:
    slides = [kind == "prismatic" for kind in stored.list_of(str, "kinds")]
    before, numbers = stored.array("base"), []
    for origin, axis in zip(stored.array("origins"), stored.array("axes"), strict=True):
        side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        side = side / np.linalg.norm(side)
        turn = np.eye(4)  # after which the joint's axis is z
        turn[:3, :3] = np.stack([side, np.cross(axis, side), axis], 1)
        frame = before @ origin @ turn
        numbers += [frame[:3, :3], frame[:3, 3]]
        before = turn.T
    tip = before @ stored.array("tip") @ np.append(stored.array("tool"), 1.0)
    return plan.node(RIGID, len(slides), 3, [*numbers, tip[:3]], *slides)


WRITERS: dict[str, Callable[[Plan, Stored], int]] = {
    "constant_curvature": _constant_curvature,
    "elastic_tendons": _elastic_tendons,
    "rigid": _rigid,
}
