"""The container of a saved model: arrays and a JSON header in one safetensors file, and a checksum.

What the arrays mean is said in `persistence`. The header is a JSON object with

- ``format``: "hybridkin-model";
- ``version``: raised when files can no longer be read by what read the earlier ones;
- ``requires``: names of what came later within a version, and must be known to read the file;
- everything else by name, of which a reader ignores what it does not know.

The checksum, SHA-256 of the header and of names, types, shapes and bytes of all arrays, stands
beside the header. It tells accidents, not forgers: who can write a file can write its checksum.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from torch import Tensor

__all__ = ["VERSION", "Arrays", "Part", "plain", "read", "read_header", "write"]

FORMAT = "hybridkin-model"
VERSION = 2
"""1: without a checksum. 2: with one, with `requires`, scalars without an axis."""
KNOWN: frozenset[str] = frozenset()
"""What a file of this version may require."""

_HEADER, _CHECKSUM = "hybridkin", "sha256"
_ANY: Any = object()

Arrays = dict[str, NDArray]


def write(path: Path, header: dict[str, Any], arrays: Arrays) -> None:
    """Write header and arrays to a file, which is replaced only once all is written."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"`path` must lie in a folder that exists, got {path}.")
    text = json.dumps({"format": FORMAT, "version": VERSION, **header}, allow_nan=False)
    whole = {name: np.array(array, order="C", ndmin=0) for name, array in arrays.items()}
    handle, staging = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
    os.close(handle)
    try:
        save_file(whole, staging, metadata={_HEADER: text, _CHECKSUM: _checksum(text, whole)})
        # A temporary file is its owner's alone; a saved model is as readable as any other file.
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(staging, 0o666 & ~mask)
        os.replace(staging, path)
    finally:
        Path(staging).unlink(missing_ok=True)


def read(path: Path) -> tuple[dict[str, Any], Arrays]:
    """Return header and arrays of a file, whole and of a version that is known here."""
    with _opened(path) as (file, metadata):
        header = _header(path, metadata)
        arrays = {name: file.get_tensor(name) for name in file.keys()}
    checksum = metadata.get(_CHECKSUM)
    if checksum is None and header["version"] == 1:
        return header, arrays
    if checksum != _checksum(metadata[_HEADER], arrays):
        raise ValueError(
            f"{path} is damaged: its content is not that of its checksum; copy it anew, or save "
            "the model again."
        )
    return header, arrays


def read_header(path: Path) -> dict[str, Any]:
    """Return the header of a file alone; its arrays are neither read nor checked."""
    with _opened(path) as (_, metadata):
        return _header(path, metadata)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, dict[str, str]]]:
    if path.is_dir():
        found = sorted(file.name for file in path.glob("*.safetensors"))
        hint = f"; in it lies {found[0]}." if found else " without a saved model."
        raise FileNotFoundError(f"`path` must name a saved model, got the folder {path}{hint}")
    if not path.is_file():
        raise FileNotFoundError(f"`path` must name a saved model, got {path}: no such file.")
    try:
        with safe_open(path, framework="numpy") as file:
            yield file, file.metadata() or {}
    except (SafetensorError, AttributeError, TypeError, OSError) as error:
        raise ValueError(f"{path} is not a model saved by hybridkin ({error}).") from error


def _header(path: Path, metadata: dict[str, str]) -> dict[str, Any]:
    try:
        header = json.loads(metadata[_HEADER])
    except (KeyError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not a model saved by hybridkin ({error!r}).") from error
    known = isinstance(header, dict) and header.get("format") == FORMAT
    if not known or type(header.get("version")) is not int or header["version"] < 1:
        raise ValueError(f"{path} is not a model saved by hybridkin: its header is another one.")
    if header["version"] > VERSION:
        raise ValueError(
            f"{path} has format version {header['version']}, this hybridkin reads up to version "
            f"{VERSION}; {_way_out(header)}."
        )
    required = header.get("requires", [])
    if not isinstance(required, list) or not all(isinstance(name, str) for name in required):
        raise ValueError(f"{path} is damaged: `requires` must be a list of names.")
    unknown = sorted({*required} - KNOWN)
    if unknown:
        raise ValueError(
            f"{path} requires what this hybridkin does not know, {', '.join(unknown)}; "
            f"{_way_out(header)}."
        )
    return header


def _way_out(header: dict[str, Any]) -> str:
    versions = header.get("versions")
    writer = versions.get("hybridkin") if isinstance(versions, dict) else None
    if not isinstance(writer, str):
        return "install a newer one"
    return f"install a newer one, {writer[:40]} wrote it"


def _checksum(text: str, arrays: Arrays) -> str:
    names = sorted(arrays)
    manifest = [text, [[name, arrays[name].dtype.name, arrays[name].shape] for name in names]]
    digest = hashlib.sha256(json.dumps(manifest).encode())
    for name in names:
        array = arrays[name]
        digest.update(array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes())
    return digest.hexdigest()


class Part:
    """A part of a stored model: a JSON object, and the arrays whose names begin with its prefix.

    Every entry is checked for its type, every array for its shape, as it is asked for.

    Parameters
    ----------
    header : dict
        The object. Entries that nobody asks for do not matter.
    arrays : dict of str to ndarray
        All arrays of the file.
    prefix : str, default=""
        How the names of the part's own begin.
    """

    def __init__(self, header: Any, arrays: Arrays, prefix: str = "") -> None:
        if not isinstance(header, dict):
            raise ValueError(f"`{prefix or 'header'}` must be an object, got {header!r:.60}")
        self.header, self.arrays, self.prefix = header, arrays, prefix

    def __contains__(self, name: str) -> bool:
        """Return whether there is an array of this name."""
        return self.prefix + name in self.arrays

    def child(self, key: str, prefix: str | None = None) -> Part | None:
        """Return the part of an entry, whose arrays are named after it; None where it is null."""
        header = self.value(key, (dict, None))
        prefix = key if prefix is None else prefix
        return None if header is None else Part(header, self.arrays, f"{self.prefix}{prefix}.")

    def value(self, key: str, kinds: Any, default: Any = _ANY) -> Any:
        """Return an entry of one of these types.

        Parameters
        ----------
        key : str
            Its name.
        kinds : type or tuple of types and None
            What it may be. An int will do for a float; a bool is neither.
        default : optional
            What is returned where there is none; without a default there must be one.
        """
        if key not in self.header and default is not _ANY:
            return default
        if key not in self.header:
            raise ValueError(f"`{self.prefix}{key}` is missing")
        value, kinds = self.header[key], kinds if isinstance(kinds, tuple) else (kinds,)
        if type(value) is int and float in kinds and int not in kinds:
            value = float(value)
        if type(value) not in [type(None) if kind is None else kind for kind in kinds]:
            names = " or ".join("null" if kind is None else kind.__name__ for kind in kinds)
            raise ValueError(f"`{self.prefix}{key}` must be {names}, got {value!r:.60}")
        return value

    def names(self, key: str) -> list[str]:
        """Return an entry that is a list of strings."""
        names = self.value(key, list)
        if not all(isinstance(name, str) for name in names):
            raise ValueError(f"`{self.prefix}{key}` must be a list of strings, got {names!r:.60}")
        return names

    def array(
        self,
        name: str,
        shape: tuple[int | None, ...] | None = None,
        *,
        nan: bool = False,
        infinite: bool = False,
    ) -> NDArray:
        """Return an array of floating-point numbers.

        Parameters
        ----------
        name : str
            Its name, without the prefix.
        shape : tuple of int or None, optional
            What its shape must be; None: any length. Of a scalar one axis of length one goes.
        nan, infinite : bool, default=False
            Whether it may hold such entries.
        """
        full = self.prefix + name
        if full not in self.arrays:
            raise ValueError(f"the array {full!r} is missing")
        array = self.arrays[full]
        if array.dtype not in (np.float32, np.float64):
            raise ValueError(f"{full!r} must be float32 or float64, got {array.dtype}")
        if shape == () and array.shape == (1,):  # as files of version 1 have them
            array = array.reshape(())
        if shape is not None and not _fits(array.shape, shape):
            wanted = str(shape).replace("None", "any")
            raise ValueError(f"{full!r} must have shape {wanted}, got {array.shape}")
        if not nan and np.isnan(array).any():
            raise ValueError(f"{full!r} must not hold NaN")
        if not infinite and np.isinf(array).any():
            raise ValueError(f"{full!r} must be finite")
        return array

    def tensor(self, name: str, shape: tuple[int | None, ...] | None = None, **may: bool) -> Tensor:
        """Return the same as a tensor."""
        return torch.from_numpy(self.array(name, shape, **may))


def _fits(shape: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    pairs = zip(shape, wanted, strict=False)
    return len(shape) == len(wanted) and all(n is None or m == n for m, n in pairs)


def plain(value: Any) -> Any:
    """Return a value as JSON can say it: arrays as lists, what is not finite as null."""
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (np.ndarray, np.generic, Tensor)):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
