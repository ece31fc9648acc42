"""Plans: a model as one array of numbers and one of integers, for the compiled core."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.kernel_numbers import (
    HK_GROUP,
    HK_MAX_F,
    HK_MAX_M,
    HK_MAX_N,
    HK_MAX_R,
    HK_MAX_S,
    KINDS,
)
from hybridkin._core.stored import KINDS_OF_MODELS, Stored

CHAINS = KINDS[:4]
# Largest sizes that the kernels support, in the order in which a plan begins.
MOST = {
    "actuators": HK_MAX_N,
    "segments": HK_MAX_S,
    "outputs": HK_MAX_M,
    "features": HK_MAX_F,
    "rows of a task": HK_MAX_R,
}
_LARGE = 4096  # numbers of an array that is worth sharing
_BITS = 31  # of the lower part of a distance in memory
_LOW = 2**_BITS - 1
_OWN = 4  # entries of a node before its own: kind, lengths of input and output, place of numbers


class NoKernel(ValueError):
    """Error: a part of a model has no kernel; the message names the part and the reason."""


class Plan:
    """The nodes of a model, each after its parts, and the numbers they use.

    A model's `Layout` names the function that writes its node.

    Parameters
    ----------
    model : Stored or callable
        Description of the model, or a function that writes its nodes and returns the last place.
    shares : bool, default=False
        Whether large arrays stay where they are, and the plan only refers to them. Such a plan sees
        when they are written to. A copy of it has copies of them.

    Attributes
    ----------
    code : ndarray of int32
        The largest sizes, in the order of MOST. Then for each node: kind, lengths of input and
        output, place of its numbers, then its sizes and the places of its parts.
    data : ndarray of float64
        All numbers.
    n_inputs, n_outputs : int
        Lengths of q and of x.
    root : int
        Place in `code` of the node of the whole model.
    places : list of int
        Places of all nodes, in the order of their numbers.
    largest : dict
        Largest sizes, named as in MOST.
    shared : dict of int to ndarray
        The arrays that it refers to, by the place in `code` of their distance from `data`.
    """

    def __init__(self, model: Stored | Callable[[Plan], int], shares: bool = False) -> None:
        self._code = [0] * len(MOST)  # then the largest sizes
        self._data: list[NDArray] = []
        self._length = 0
        self.largest = dict.fromkeys(MOST, 0)
        self._place_of: dict[tuple, int] = {}
        self._shares = shares
        self.shared: dict[int, NDArray] = {}
        self.root = self.node_of(model) if isinstance(model, Stored) else model(self)
        self.n_inputs, self.n_outputs = self.lengths(self.root)
        self._code[: len(MOST)] = self.largest.values()
        self.code = np.array(self._code, dtype=np.int32)
        # The numbers begin with a cache line; a group of zeros follows them.
        memory = np.zeros(self._length + 2 * HK_GROUP)
        first = -memory.ctypes.data // 8 % HK_GROUP
        self.data = memory[first : first + self._length + HK_GROUP]
        self.data[:-HK_GROUP] = np.concatenate(self._data)
        self.places = [*self._place_of.values()]
        # do not pickle them twice
        self._data = []
        self._place_of = {}
        self.data.flags.writeable = False
        self._refer_to_shared()

    def __setstate__(self, state: dict[str, Any]) -> None:
        # The arrays of a copy stand elsewhere.
        vars(self).update(state)
        self._refer_to_shared()

    def _refer_to_shared(self) -> None:
        """Write the distances of the shared arrays from the numbers."""
        self.code.flags.writeable = True
        for place, array in self.shared.items():
            away = (array.ctypes.data - self.data.ctypes.data) // 8
            self.code[place : place + 2] = away & _LOW, away >> _BITS
        self.code.flags.writeable = False

    @property
    def digest(self) -> str:
        """SHA-256 of the plan: equal plans compute the same."""
        return hashlib.sha256(self.code.tobytes() + self.data.tobytes()).hexdigest()

    def node_of(self, stored: Stored) -> int:
        """Write the node of a description after its parts, and return its place."""
        model = KINDS_OF_MODELS.get(stored.kind)
        if model is None or model.layout.write_plan is None:
            raise NoKernel(f"a part of the kind {stored.kind!r} has no kernel")
        return model.layout.write_plan(self, stored)

    def stack(self, models: Iterable[Stored]) -> int:
        """Write models side by side, and return their place; a single one stands alone."""
        places = [self.node_of(model) for model in models]
        if len(places) == 1:
            return places[0]
        n = 0
        n_outputs = 0
        for place in places:
            if self.kind(place) in ("stacked", "moved", "shifted"):
                need = "models side by side must not hold several or another one"
                raise NoKernel(need)
            n, m = self.lengths(place)
            n_outputs += m
        return self.node("stacked", n, n_outputs, [], len(places), *places)

    def node(
        self,
        kind: str,
        n: int,
        m: int,
        numbers: Sequence[ArrayLike],
        *entries: int,
        aligned: bool = False,
        last: NDArray | None = None,
    ) -> int:
        """Write a node with its numbers, and return its place; equal nodes share one place.

        Parameters
        ----------
        kind : str
            One of KINDS.
        n, m : int
            Lengths of its input and output.
        numbers : sequence of array-like
            Its numbers.
        *entries : int
            Its sizes, and the places of its parts.
        aligned : bool, default=False
            Whether the numbers after center, scale, intercept and direct link, 2 n + m + m n, start
            a cache line.
        last : ndarray, optional
            Its last numbers. Two more entries say where they are, if they are shared; else 0.
        """
        self.limit("actuators", n)
        self.limit("outputs", m)
        parts = [np.empty(0), *map(np.ravel, numbers)]
        shared = None
        if last is not None:
            entries += 0, 0
            if self._can_share(last):
                shared = last
            else:
                parts.append(last.ravel())
        flat = np.concatenate(parts, dtype=np.float64)
        address = 0 if shared is None else shared.ctypes.data
        key = (kind, n, m, *entries, flat.tobytes(), address)
        if key in self._place_of:
            return self._place_of[key]
        place = len(self._code)
        self._place_of[key] = place
        if aligned:
            end = self._length + 2 * n + m + m * n
            self._append(np.zeros(-end % HK_GROUP))
        number = 1 + KINDS.index(kind)
        self._code += [number, n, m, self._length, *map(int, entries)]
        if shared is not None:
            self.shared[len(self._code) - 2] = shared
        self._append(flat)
        return place

    def _can_share(self, array: NDArray) -> bool:
        fits = array.dtype == np.float64 and array.flags.c_contiguous
        return self._shares and fits and array.size >= _LARGE

    def _append(self, numbers: NDArray) -> None:
        self._data.append(numbers)
        self._length += len(numbers)

    def kind(self, place: int) -> str:
        """Return the kind of a node."""
        return KINDS[self._code[place] - 1]

    def lengths(self, place: int) -> tuple[int, int]:
        """Return the lengths of input and output of a node."""
        return self._code[place + 1], self._code[place + 2]

    def entry(self, place: int, k: int) -> int:
        """Return the k-th own entry of a node, a size or the place of a part."""
        return self._code[place + _OWN + k]

    def begin(self, place: int) -> int:
        """Return the place in `data` where the numbers of a node begin."""
        return self._code[place + _OWN - 1]

    def limit(self, what: str, size: int) -> None:
        """Record a size, and raise if it is larger than the kernels support."""
        self.largest[what] = max(size, self.largest[what])
        if size > MOST[what]:
            raise NoKernel(f"{size} {what}: the kernels support at most {MOST[what]}")
