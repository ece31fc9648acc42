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

from hybridkin._core.arrays import LARGEST, countable
from hybridkin._core.files import write_file
from hybridkin._core.stored import Stored

FORMAT = "hybridkin-model"
VERSION = 3
_HEADER = "hybridkin"
_CHECKSUM = "sha256"
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


def packed(stored: Stored) -> tuple[Header, Arrays]:
    """Return a description as JSON entries and arrays, each distinct array once."""
    arrays: Arrays = {}
    names: dict[tuple[str, tuple[int, ...], bytes], str] = {}

    def entries(stored: Stored, prefix: str) -> Header:
        references = {}
        for name, array in stored.arrays.items():
            content = hashlib.sha256(array.tobytes()).digest()
            references[name] = names.setdefault(
                (array.dtype.name, array.shape, content), prefix + name
            )
            arrays[references[name]] = array
        parts = {
            key: entries(part, f"{prefix}{key}.") for key, part in stored.parts.items()
        }
        return {
            "kind": stored.kind,
            "settings": stored.settings,
            "arrays": references,
            "parts": parts,
        }

    return entries(stored, ""), arrays


def unpacked(header: Header, arrays: Arrays) -> Stored:
    """Return the description that `packed` wrote; raise a ValueError if it is not one.

    Equal parts become one object, as in the model.
    """
    for name, array in arrays.items():
        if (
            array.dtype == np.float64
            and not (countable(array) | ~np.isfinite(array)).all()
        ):
            raise ValueError(
                f"the numbers of {name!r:.60} must be less than {LARGEST:g}"
            )
    found: dict[str, Stored] = {}
    kinds = {"kind": str, "settings": dict, "arrays": dict, "parts": dict}

    def described(header: Header) -> Stored:
        entries = [header.get(key) for key in kinds] if isinstance(header, dict) else []
        if [type(entry) for entry in entries] != [*kinds.values()]:
            raise ValueError(f"a part must hold {', '.join(kinds)}, got {header!r:.60}")
        missing = [name for name in header["arrays"].values() if name not in arrays]
        if missing:
            raise ValueError(f"the array {missing[0]!r:.60} is missing")
        entry = json.dumps({key: header[key] for key in kinds}, sort_keys=True)
        if entry not in found:
            arrays_of_entry = {
                key: arrays[name] for key, name in header["arrays"].items()
            }
            parts = {key: described(part) for key, part in header["parts"].items()}
            found[entry] = Stored(
                header["kind"], header["settings"], arrays_of_entry, parts
            )
        return found[entry]

    return described(header)


def write(path: Path, header: Header, arrays: Arrays) -> None:
    """Write header and arrays to a file with `write_file`; equal content gives equal bytes."""
    text = json.dumps({"format": FORMAT, "version": VERSION, **header}, allow_nan=False)
    whole = {
        name: np.array(array, order="C", ndmin=0) for name, array in arrays.items()
    }
    content = save(whole, metadata={_HEADER: text, _CHECKSUM: _checksum(text, whole)})
    # safetensors writes its metadata in random order.
    end = 8 + int.from_bytes(content[:8], "little")
    head = json.dumps(
        json.loads(content[8:end]), sort_keys=True, separators=(",", ":")
    ).encode()
    head += b" " * (-len(head) % 8)

    def write_parts(staging: Path) -> None:
        with open(staging, "xb") as file:
            file.writelines([len(head).to_bytes(8, "little"), head, content[end:]])

    write_file(path, write_parts)


def read(path: Path) -> tuple[Header, Arrays]:
    """Return header and arrays of a file; raise if it is damaged or of another version."""
    if path.is_dir():
        names = sorted(file.name for file in path.glob("[!.]*.safetensors"))
        hint = f"; it contains {names[0]}." if names else " without a saved model."
        raise FileNotFoundError(
            f"`path` must name a saved model, got the folder {path}{hint}"
        )
    if not path.is_file():
        raise FileNotFoundError(
            f"`path` must name a saved model, got {path}: no such file."
        )
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            header = json.loads(metadata[_HEADER], parse_constant=_refused)
            arrays = {name: file.get_tensor(name) for name in file.keys()}
    except _UNREADABLE as error:
        raise ValueError(
            f"{path} is not a model saved by hybridkin ({error!r})."
        ) from error
    _check_version(path, header)
    if metadata.get(_CHECKSUM) != _checksum(metadata[_HEADER], arrays):
        raise ValueError(
            f"{path} is damaged: its content does not match its checksum. Copy it again, or save "
            "the model again."
        )
    return header, arrays


def _check_version(path: Path, header: Any) -> None:
    is_ours = isinstance(header, dict) and header.get("format") == FORMAT
    if not is_ours or type(header.get("version")) is not int or header["version"] < 1:
        raise ValueError(
            f"{path} is not a model saved by hybridkin: its header does not match."
        )
    if header["version"] != VERSION:
        versions = header.get("versions")
        writer = versions.get("hybridkin") if isinstance(versions, dict) else None
        named = f", {writer[:40]}" if isinstance(writer, str) else ""
        raise ValueError(
            f"{path} has format version {header['version']}, but this hybridkin reads version "
            f"{VERSION}; install the hybridkin that wrote it{named}, or save the model again."
        )


def _refused(constant: str) -> None:
    raise ValueError(f"{constant} is no JSON value")


def _checksum(text: str, arrays: Arrays) -> str:
    names = sorted(arrays)
    manifest = [
        text,
        [[name, arrays[name].dtype.name, arrays[name].shape] for name in names],
    ]
    digest = hashlib.sha256(json.dumps(manifest).encode())
    for name in names:
        array = arrays[name]
        digest.update(array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes())
    return digest.hexdigest()
