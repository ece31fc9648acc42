"""Descriptions of models as kind, settings, arrays and parts, and their checked reading."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.arrays import as_array, check_shape


class Layout(NamedTuple):
    """Contents of a module's description, named like the parameters of its constructor.

    Parameters
    ----------
    kind : str
        Name of the class.
    arrays : dict of str to str
        The state, buffers or parameters, with one letter per axis as in `Stored.tensors`.
    settings : dict of str to type
        Plain attributes.
    parts : tuple of str
        Submodules, lists of them, or None.
    derived : tuple of str
        Tensors computed from the state. Kernels use them; files do not contain them.
    write_plan : callable, optional
        Called with a plan and a description of this kind: writes its node into the plan and returns
        the place. None: the class has no kernel.
    """

    kind: str
    arrays: dict[str, str]
    settings: Mapping[str, type] = MappingProxyType({})
    parts: tuple[str, ...] = ()
    derived: tuple[str, ...] = ()
    write_plan: Callable[..., int] | None = None


@dataclass(frozen=True)
class Stored:
    """A model as data: what a file contains, and what a kernel needs.

    The methods read entries and check them: damaged data raise a ValueError that names the entry.

    Parameters
    ----------
    kind : str
        Name of the class.
    settings : dict
        JSON values by name.
    arrays : dict of str to ndarray
        float64 or float32 arrays by name.
    parts : dict of str to Stored
        The models that this one is made of.
    derived : dict of str to ndarray
        Arrays computed from the others, for kernels; not in files.
    """

    kind: str
    settings: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, NDArray] = field(default_factory=dict)
    parts: dict[str, Stored] = field(default_factory=dict)
    derived: dict[str, NDArray] = field(default_factory=dict, compare=False)

    @classmethod
    def of(
        cls,
        kind: str,
        arrays: Mapping[str, Any] | None = None,
        parts: Mapping[str, Stored | None] | None = None,
        **settings: Any,
    ) -> Stored:
        """Return the description of a model; arrays and parts that are None are left out.

        Parameters
        ----------
        kind : str
            Name of the class.
        arrays : mapping of str to Tensor or array-like, optional
            Numbers, on any device.
        parts : mapping of str to Stored, optional
            The models that it is made of.
        **settings
            Values that JSON can express; arrays and tuples become lists.
        """
        stored = cls(kind, plain(settings))
        for name, array in (arrays or {}).items():
            if array is not None:
                stored.arrays[name] = as_array(array)
        for name, part in (parts or {}).items():
            if part is not None:
                stored.parts[name] = part
        return stored

    def value(self, key: str, kinds: Any) -> Any:
        """Return a setting of one of these types.

        Parameters
        ----------
        key : str
            Its name.
        kinds : type or tuple of types and None
            The types allowed. An int counts as a float; a bool is neither.
        """
        if key not in self.settings:
            raise ValueError(f"`{key}` of {self.kind!r} is missing")
        value = self.settings[key]
        if not isinstance(kinds, tuple):
            kinds = (kinds,)
        if type(value) is int and float in kinds and int not in kinds:
            value = float(value)
        kind = None if value is None else type(value)
        if kind not in kinds:
            need = f"must be one of {kinds}, got {value!r:.60}"
            raise ValueError(f"`{key}` of {self.kind!r} {need}")
        return value

    def list_of(self, kind: type, key: str) -> list[Any]:
        """Return a setting that is a list of one type."""
        values = self.value(key, list)
        if not all(type(value) is kind for value in values):
            need = f"must be a list of {kind.__name__}, got {values!r:.60}"
            raise ValueError(f"`{key}` of {self.kind!r} {need}")
        return values

    def array(
        self,
        name: str,
        shape: Sequence[int | str] | None = None,
        *,
        finite: bool = True,
    ) -> NDArray:
        """Return an array of floating-point numbers.

        Parameters
        ----------
        name : str
            Its name.
        shape : sequence of int or str, optional
            The shape that it must have, see `check_shape`.
        finite : bool, default=True
            Whether to refuse NaN and infinite entries.
        """
        if name not in self.arrays:
            raise ValueError(f"the array {name!r} of {self.kind!r} is missing")
        array = self.arrays[name]
        if array.dtype not in (np.float32, np.float64):
            raise ValueError(f"{name!r} must be float32 or float64, got {array.dtype}")
        if shape is not None:
            check_shape(array, name, shape)
        if finite and not np.isfinite(array).all():
            raise ValueError(f"{name!r} must be finite")
        return array

    def tensors(self, **shapes: str) -> dict[str, Tensor]:
        """Return copies of finite arrays with matching shapes, as tensors.

        Parameters
        ----------
        **shapes
            One letter per axis of every array; equal letters are equal lengths:
            ``tensors(coef="mn", bias="m")``.
        """
        lengths = {}
        tensors = {}
        for name, letters in shapes.items():
            array = self.array(name, [lengths.get(letter, letter) for letter in letters])
            lengths |= dict(zip(letters, array.shape, strict=True))
            tensors[name] = torch.tensor(array, device="cpu")
        return tensors

    def part(self, name: str) -> Stored:
        """Return the description of a part."""
        if name not in self.parts:
            raise ValueError(f"the part {name!r} of {self.kind!r} is missing")
        return self.parts[name]


KINDS_OF_MODELS: dict[str, Any] = {}
"""The classes with a layout, by its kind."""

Restore = Callable[[Stored], Any]
"""A function that returns the model of a description, and a list for a list of them."""


def plain(value: object) -> Any:
    """Return a value as JSON can express it: arrays as lists, NaN and infinity as null."""
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (np.ndarray, np.generic, Tensor)):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
