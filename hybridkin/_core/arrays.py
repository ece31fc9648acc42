"""Conversion of the caller's arrays, NumPy or torch, to rows of tensors and back."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterable, Sequence
from numbers import Real
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin._core.forks import THREADS


@runtime_checkable
class Transform(Protocol):
    """A pose as a pytorch_kinematics Transform3d, which takes a second to import."""

    def get_matrix(self) -> Tensor:
        """Return the homogeneous transforms, shape (N, 4, 4)."""
        ...


Numbers = ArrayLike | Tensor  # what a caller may pass as an array
# Fourth powers of larger numbers overflow, and so do those of 1 / scale for tiny scales.
LARGEST = np.float64(1e75)


def as_tensor(
    value: Numbers | Transform, name: str, device: torch.device | str | None = None
) -> Tensor:
    """Return a caller's real numbers as a tensor without a graph; an array is copied.

    float32 is kept; all other types become float64.
    """
    THREADS.check()
    if isinstance(value, Transform):
        value = value.get_matrix()
    if not isinstance(value, Tensor):
        return copied(real_array(value, name), device or "cpu")
    if value.is_complex() or value.layout != torch.strided or value.is_meta:
        got = f"{value.dtype} with layout {value.layout} on {value.device}"
        raise ValueError(f"`{name}` must be a dense tensor that holds real numbers, got {got}.")
    value = value.detach()
    return value if value.dtype == torch.float32 else value.double()


def real_array(value: Numbers | Transform, name: str) -> NDArray:
    """Return a caller's real numbers as an array; float32 is kept, others become float64."""
    THREADS.check()
    if isinstance(value, (Tensor, Transform)):
        return as_tensor(value, name).numpy(force=True)
    if np.ma.is_masked(value):
        raise ValueError(f"`{name}` has masked entries; drop these rows, or fill them with NaN.")
    if hasattr(value, "toarray"):
        raise TypeError(f"`{name}` must be dense, got a sparse matrix; use `.toarray()`.")
    try:
        array = np.asarray(value)
        if array.dtype.kind in "biufO":
            kind = np.float32 if array.dtype == np.float32 else np.float64
            return np.require(array, kind, ["C", "W"])
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        kind = TypeError if type(error) is TypeError else ValueError
        need = f"`{name}` must be numeric, got {value!r:.200} ({error})."
        raise kind(need) from error
    hint = ""
    if array.dtype.kind == "c":
        hint = " Complex data not supported."
    raise ValueError(f"`{name}` must be numeric, got {value!r:.200}.{hint}")


def copied(a: NDArray, device: torch.device | str, dtype: type | None = None) -> Tensor:
    """Return a copy as a tensor; torch accepts no negative strides, even for a single row."""
    return torch.from_numpy(np.array(a, dtype, order="C")).to(device)


def number(value: Any, name: str) -> float:
    """Return a caller's real number."""
    numbers = real_array(value, name)
    if numbers.ndim:
        raise ValueError(f"`{name}` must be one number, got {value!r:.200}.")
    return float(numbers)


def whole(value: object, name: str, least: int = 1, most: float = math.inf) -> int:
    """Return a caller's whole number between `least` and `most`."""
    if isinstance(value, (int, np.integer)) and least <= value <= most:
        return int(value)
    need = f"at least {least}" if most == math.inf else f"{least} to {most}"
    raise ValueError(f"`{name}` must be {need}, a whole number, got {value!r:.80}.")


def random_generator(
    random_state: int | np.random.Generator | None,
) -> np.random.Generator:
    """Return the caller's generator, or a new one with the caller's seed."""
    if isinstance(random_state, np.random.Generator):
        return random_state
    if random_state is not None:
        random_state = whole(random_state, "random_state", 0)
    return np.random.default_rng(random_state)


def one_of(value: object, name: str, known: Collection[str], hint: str = "") -> str:
    """Return a caller's choice from the known names."""
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"`{name}` must be one of {[*known]}, got {value!r:.80}{hint}.")
    return value


def as_path(value: object, name: str = "path") -> Path:
    """Return a caller's path."""
    if not isinstance(value, (str, os.PathLike)) or "\0" in str(value):
        raise TypeError(f"`{name}` must be a path, got {value!r:.80}.")
    return Path(value)


def countable(value: Any) -> Any:
    """Return whether numbers are not NaN and their fourth powers do not overflow."""
    return abs(value) < LARGEST


def check_shape(
    value: NDArray | Tensor, name: str, need: Sequence[int | str], why: str = ""
) -> None:
    """Raise if the shape differs from `need`.

    In `need`, digits are lengths, equal letters are equal lengths, a leading "..." is any axes.
    """
    got = tuple(value.shape)
    sizes = [*map(str, need)]
    axes = got
    if sizes[:1] == ["..."]:
        del sizes[0]
        axes = got[max(0, len(got) - len(sizes)) :]
    matches = len(sizes) == len(axes)
    lengths: dict[str, int] = {}
    for size, length in zip(sizes, axes, strict=False):
        if size.isdigit():
            lengths[size] = int(size)
        matches &= length == lengths.setdefault(size, length)
    if not matches:
        shape = ", ".join(map(str, need))
        if len(need) == 1:
            shape += ","
        reason = f"; {why}" if why else ""
        raise ValueError(f"`{name}` must have shape ({shape}), got {got}{reason}.")


def shaped(
    value: Numbers | Transform,
    name: str,
    need: Sequence[int | str],
    length: int | None = None,
    why: str = "",
) -> NDArray[np.float64]:
    """Return numbers of a checked shape (see `check_shape`) as a new float64 array.

    `length` replaces the first entry of `need`. NaN is allowed.
    """
    array = np.array(real_array(value, name), dtype=float)
    if length is not None:
        need = (length, *need[1:])
    check_shape(array, name, need, why)
    return array


def table(value: Any, name: str) -> Any:
    """Return rows as scikit-learn expects them: a data frame `X` unchanged, else an array."""
    if value is None or isinstance(value, Real):
        return value
    array = real_array(value, name)
    return value if name == "X" and hasattr(value, "columns") else array


def labels(groups: ArrayLike | Tensor, n_rows: int, name: str = "groups") -> NDArray:
    """Return the label of the motion of every row, shape (N,); no row may lack one."""
    if isinstance(groups, Tensor):
        groups = as_tensor(groups, name).numpy(force=True)
    if isinstance(groups, np.ma.MaskedArray):
        groups = np.array([None if x is np.ma.masked else x for x in groups])
    names = entries = np.asarray(groups)
    check_shape(names, name, [n_rows], "one entry for each row of the log")
    if isinstance(groups, (list, tuple)):  # NumPy makes a text of NaN beside texts
        entries = np.array([*groups, None], dtype=object)[:-1]
    missing = _is_missing(entries)
    if missing.any():
        row = int(missing.argmax())
        raise ValueError(
            f"`{name}` must name the motion of every row, got {entries[row]} in {missing.sum()} of "
            f"{n_rows} rows (first: row {row}); name these rows, or leave them out."
        )
    return names.astype(str) if names.dtype == object else names


def _is_missing(names: NDArray) -> NDArray[np.bool_]:
    """Return which labels (N,) are None, NaN, NaT, NA or infinite."""
    if names.dtype.kind in "iubUSV":
        return np.zeros(names.shape, dtype=bool)
    if names.dtype != object:
        return ~np.isfinite(names)
    return np.array([not is_label(entry) for entry in names], dtype=bool)


def is_label(entry: Any) -> bool:
    """Return whether an object can name a motion: it equals itself, and is not infinite."""
    try:
        equal = bool(entry == entry)
    except (TypeError, ValueError):  # NA of pandas is neither equal nor unequal
        return False
    infinite = isinstance(entry, Real) and math.isinf(entry)
    return entry is not None and equal and not infinite


def as_array(a: Numbers) -> np.ndarray:
    """Return a tensor, without its graph, or an array as a NumPy array."""
    return a.numpy(force=True) if isinstance(a, Tensor) else np.asarray(a)


def identity(n: int, like: Tensor) -> Tensor:
    """Return the identity (n, n) in the dtype and on the device of a tensor."""
    return torch.eye(n, dtype=like.dtype, device=like.device)


def is_numpy(value: object) -> bool:
    """Return whether results for this argument are returned as NumPy arrays."""
    return not isinstance(value, (Tensor, Transform))


def leading(pairs: Sequence[tuple[Tensor, int]]) -> tuple[int, ...]:
    """Return the common batch shape of tensors, each with its number of trailing axes."""
    shapes = [tuple(a.shape[: a.ndim - trailing]) for a, trailing in pairs]
    try:
        # Torch's version takes half a second to import.
        return np.broadcast_shapes(*shapes)
    except ValueError as error:
        need = "configurations (`q`) and targets (`x_target`) must agree in their batch shapes"
        raise ValueError(f"{need}, got {shapes}.") from error


def rows_of(a: Tensor, lead: tuple[int, ...], trailing: int = 1) -> Tensor:
    """Return a tensor broadcast to the batch shape, as rows (N, ...)."""
    shape = a.shape[a.ndim - trailing :]
    return a.expand(*lead, *shape).reshape(math.prod(lead), *shape)


def give_back(results: Iterable[Tensor], lead: tuple[int, ...], as_numpy: bool) -> list[Any]:
    """Return rows (N, ...) in the caller's batch shape and array type."""
    arrays = []
    for rows in results:
        array = rows.reshape((*lead, *rows.shape[1:]))
        arrays.append(as_array(array) if as_numpy else array)
    return arrays
