"""The interface of the stages of a hysteresis."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin._core.stored import Stored
from hybridkin._core.units import LogUnit

STAGE_OF_KIND: dict[str, type[Stage]] = {}
"""The stages, by their kind."""


class Fixed:
    """An object whose attributes are set once, and whose arrays are read-only."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in vars(self):
            raise AttributeError(
                f"`{name}` of a {type(self).__name__} cannot change; make a new one."
            )
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
        super().__setattr__(name, value)

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, memo: object) -> Self:
        return self


class Stage(Fixed, ABC):
    """A stage of hysteresis between the commands that it gets and its result.

    A stage has no state and does not change. What is inside of it after a command (plays, slow
    parts) is passed to it. A subclass is one file of `hybridkin.hysteresis.stages`, and one header
    with its kernel.

    Attributes
    ----------
    kind : str
        Its name, in words and in files.
    kernel : str
        Name of its kernel, see hysteresis.h.
    names : tuple of str
        Arguments of its constructor: the arrays that it keeps.
    needs_time : bool
        Whether the result depends on the times of the commands.
    width : ndarray of shape () or (n,)
        Largest distance between two commands with the same result, if actuators stay at each of
        them [unit of q].
    """

    kind: ClassVar[str]
    kernel: ClassVar[str]
    names: ClassVar[tuple[str, ...]]
    needs_time: ClassVar[bool] = False
    width: NDArray

    def __init_subclass__(cls, **options: object) -> None:
        """Register the stage for files."""
        super().__init_subclass__(**options)
        STAGE_OF_KIND[cls.kind] = cls

    @property
    def arrays(self) -> dict[str, NDArray]:
        """The arguments of the constructor."""
        return {name: getattr(self, name) for name in self.names}

    def __eq__(self, other: object) -> bool:
        """Return whether both are of one kind with equal numbers."""
        if not isinstance(other, Stage) or other.kind != self.kind:
            return False
        pairs = zip(self.arrays.values(), other.arrays.values(), strict=True)
        return all(np.array_equal(a, b) for a, b in pairs)

    def __hash__(self) -> int:
        numbers = [array.tobytes() for array in self.arrays.values()]
        return hash((self.kind, *numbers))

    def __repr__(self) -> str:
        numbers = [f"{name}={array.tolist()}" for name, array in self.arrays.items()]
        return f"{self.kind}({', '.join(numbers)})"

    @property
    @abstractmethod
    def n_actuators(self) -> int:
        """Number of actuators; 0: any."""

    @property
    @abstractmethod
    def n_inside(self) -> int:
        """Number of rows inside of the state."""

    @abstractmethod
    def numbers(self, n: int) -> tuple[NDArray, ...]:
        """Return the numbers of the kernel for n actuators."""

    @abstractmethod
    def follower(self, state: NDArray, rounding: float) -> Follower:
        """Return the stage in NumPy with its part (R, n) of a state, see `follow.follow`."""

    @abstractmethod
    def in_words(self, unit: LogUnit) -> str:
        """Return what it is, with its largest numbers in the unit of a log."""

    @property
    def time_constants(self) -> NDArray:
        """Time constants of creep (J,) [s]; empty without creep."""
        return np.empty(0)

    def each_inside(self, rows: NDArray, steps: NDArray) -> Iterator[NDArray]:
        """Yield what is inside (N, n) after each of the rows, which are as for `follow.followed`.

        Nothing is where the result says as much.
        """
        yield from ()

    def stored(self) -> Stored:
        """Return the description of the stage for a file."""
        return Stored.of(self.kind, self.arrays)

    @classmethod
    def from_stored(cls, stored: Stored) -> Self:
        """Return the stage of a description; raise a ValueError for other numbers than it has."""
        return cls(*(stored.array(name) for name in cls.names))


class Follower(ABC):
    """A stage in NumPy, with views of the state: the command (n,), what is inside, the result (n,).

    Parameters
    ----------
    state : ndarray of shape (R, n)
        The part of the state of this stage.
    """

    def __init__(self, state: NDArray) -> None:
        self.command = state[0]
        self.inside = state[1:-1]
        self.result = state[-1]

    @abstractmethod
    def follow(self, seconds: float) -> None:
        """Follow the command in the state, some seconds after the one before."""

    @abstractmethod
    def lead(self, goal: NDArray, seconds: float) -> NDArray:
        """Return the command (n,) for a result (n,) after some seconds, and follow it."""
