"""The container of a saved model: one safetensors file of arrays, a JSON header and a checksum.

The header is a JSON object with

- ``format``: "hybridkin-model";
- ``version``: increased when earlier readers cannot read the file any more;
- ``kind``, ``settings``, ``arrays``, ``parts``: the description of the model, see `Stored`.
  ``arrays`` gives the name of every array in the file; equal arrays are written once;
- other entries by name. A reader ignores entries that it does not know.

The checksum is the SHA-256 of the header and of names, types, shapes and bytes of all arrays. It
detects accidents, not forgery: anyone who can write a file can write its checksum.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from hybridkin._core.arrays import LARGEST, as_path, countable
from hybridkin._core.files import write_file
from hybridkin._core.stored import Stored

FORMAT = "hybridkin-model"
VERSION = 3
MODEL = "model.safetensors"
"""Name of the model in the folder of a fit."""
_HEADER = "hybridkin"
_CHECKSUM = "sha256"
_KINDS = {"kind": str, "settings": dict, "arrays": dict, "parts": dict}
_UNREADABLE = (
    SafetensorError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
)

Header = dict[str, Any]
Arrays = dict[str, NDArray]


class _Packer:
    """Descriptions as JSON entries, and their arrays, each distinct one once."""

    def __init__(self) -> None:
        self.arrays: Arrays = {}
        self._names: dict[tuple[str, tuple[int, ...], bytes], str] = {}

    def entries(self, stored: Stored, prefix: str = "") -> Header:
        references = {}
        for name, array in stored.arrays.items():
            content = hashlib.sha256(array.tobytes()).digest()
            key = (array.dtype.name, array.shape, content)
            reference = self._names.setdefault(key, prefix + name)
            references[name] = reference
            self.arrays[reference] = array
        parts = {}
        for name, part in stored.parts.items():
            parts[name] = self.entries(part, f"{prefix}{name}.")
        return {
            "kind": stored.kind,
            "settings": stored.settings,
            "arrays": references,
            "parts": parts,
        }


def packed(stored: Stored) -> tuple[Header, Arrays]:
    """Return a description as JSON entries and arrays, each distinct array once."""
    packer = _Packer()
    return packer.entries(stored), packer.arrays


class _Unpacker:
    """Descriptions from the entries of a header; equal parts become one object."""

    def __init__(self, arrays: Arrays) -> None:
        self.arrays = arrays
        self._described: dict[str, Stored] = {}

    def described(self, header: Header) -> Stored:
        entries = {name: header[name] for name in _KINDS}
        for name, kind in _KINDS.items():
            if type(entries[name]) is not kind:
                raise ValueError(f"`{name}` must be a {kind.__name__}, got {entries[name]!r:.60}")
        text = json.dumps(entries, sort_keys=True)
        if text not in self._described:
            stored = Stored(header["kind"], header["settings"])
            for name, reference in header["arrays"].items():
                stored.arrays[name] = self.arrays[reference]
            for name, part in header["parts"].items():
                stored.parts[name] = self.described(part)
            self._described[text] = stored
        return self._described[text]


def unpacked(header: Header, arrays: Arrays) -> Stored:
    """Return the description that `packed` wrote; raise a ValueError or KeyError if it is not one.

    Equal parts become one object, as in the model.
    """
    for name, array in arrays.items():
        numbers = array[np.isfinite(array)]
        if not countable(numbers).all():
            raise ValueError(f"the numbers of {name!r:.60} must be less than {LARGEST:g}")
    return _Unpacker(arrays).described(header)


def write(path: Path, header: Header, arrays: Arrays) -> None:
    """Write header and arrays to a file with `write_file`; equal content gives equal bytes."""
    text = json.dumps({"format": FORMAT, "version": VERSION, **header}, allow_nan=False)
    whole = {name: np.array(array, order="C", ndmin=0) for name, array in arrays.items()}
    content = save(whole, metadata={_HEADER: text, _CHECKSUM: _checksum(text, whole)})
    # safetensors writes its metadata in random order.
    end = 8 + int.from_bytes(content[:8], "little")
    head = json.dumps(json.loads(content[8:end]), sort_keys=True, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 8)

    def write_parts(staging: Path) -> None:
        with open(staging, "xb") as file:
            file.writelines([len(head).to_bytes(8, "little"), head, content[end:]])

    write_file(path, write_parts)


def model_path(value: object, name: str = "path") -> Path:
    """Return a caller's path of a model; for a folder that of the model in it."""
    path = as_path(value, name)
    return path / MODEL if path.is_dir() else path


def read(path: Path) -> tuple[Header, Arrays]:
    """Return header and arrays of a file; raise if it is damaged or of another version."""
    if not path.is_file():
        raise FileNotFoundError(
            f"`path` must name a saved model, or a folder with a {MODEL}, got {path}, which is no "
            "file."
        )
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            header: Header = dict(json.loads(metadata[_HEADER], parse_constant=_refused))
            arrays = {name: file.get_tensor(name) for name in file.keys()}
    except _UNREADABLE as error:
        raise ValueError(f"{path} is not a model saved by hybridkin ({error!r}).") from error
    if header.get("format") != FORMAT:
        raise ValueError(f"{path} is not a model saved by hybridkin: its header does not match.")
    if header.get("version") != VERSION:
        raise ValueError(
            f"{path} has format version {header.get('version')!r:.40}, but this hybridkin reads "
            f"version {VERSION}; install the hybridkin that wrote it, or save the model again "
            f"(written with {header.get('versions')!r:.200})."
        )
    if metadata.get(_CHECKSUM) != _checksum(metadata[_HEADER], arrays):
        raise ValueError(
            f"{path} is damaged: its content does not match its checksum. Copy it again, or save "
            "the model again."
        )
    return header, arrays


def _refused(constant: str) -> None:
    raise ValueError(f"{constant} is no JSON value")


def _checksum(text: str, arrays: Arrays) -> str:
    """Return the SHA-256 of the header, and of names, types, shapes and bytes of all arrays."""
    shapes = [[k, a.dtype.name, a.shape] for k, a in sorted(arrays.items())]
    digest = hashlib.sha256(json.dumps([text, shapes]).encode())
    for _, array in sorted(arrays.items()):
        little_endian = array.astype(array.dtype.newbyteorder("<"), copy=False)
        digest.update(little_endian.tobytes())
    return digest.hexdigest()
