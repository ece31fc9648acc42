"""Safe reading of npz files from others: a bad file costs little memory and runs no code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_MOST = 2**28  # bytes of content allowed in any file
_RATIO = 100  # of larger content to the file's size


def check_expansion(path: Path, size: int) -> None:
    """Raise if the content [bytes] is far larger than the file."""
    if size > max(_MOST, _RATIO * path.stat().st_size):
        raise ValueError(f"it expands to {size / 1e6:.0f} MB, over {_RATIO} times its size")


def arrays_of(path: Path) -> dict[str, NDArray]:
    """Return the arrays of an npz file by name, without pickled objects."""
    try:
        with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            size = sum(entry.file_size for entry in file.zip.infolist())
            check_expansion(path, size)
            arrays = {name: file[name] for name in file.files}
        for name, array in arrays.items():
            if not isinstance(array, np.ndarray) or max(array.shape, default=0) > size:
                raise ValueError(f"{name!r:.60} is not an array, or has a shape without numbers")
    except Exception as error:  # numpy, zipfile, zlib, tokenize and struct raise their own
        raise ValueError(
            f"{str(path)!r} is not an npz file of plain arrays: {error!s:.200}."
        ) from error
    return arrays
