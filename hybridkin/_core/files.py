"""Files that are written completely or not at all, even if the process or the power fails."""

from __future__ import annotations

import errno
import os
import secrets
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

Writer = Callable[[Path], object]
"""A function that writes a file to the path it is given."""


def write_file(path: str | Path, write: Writer) -> None:
    """Write a file; an old one is replaced only when the new one is completely on the disk.

    For a symbolic link the target is replaced. A replaced file keeps its permissions. A writer that
    is killed can leave a hidden file ``.NAME-*.part``.
    """
    path = Path(os.path.realpath(path))
    if not path.parent.is_dir():
        raise FileNotFoundError(f"`path` must lie in a folder that exists, got {path}.")
    if path.exists() and not path.is_file():
        raise ValueError(
            f"`path` must name a file, got {path}, which is not one; add a file name."
        )
    staging = path.with_name(f".{path.name}-{secrets.token_hex(8)}.part{path.suffix}")
    try:
        write(staging)
        with open(staging, "rb+") as file:
            os.fsync(file.fileno())
        if path.exists():
            os.chmod(staging, path.stat().st_mode)
        os.replace(staging, path)
        _flush_folder(path.parent)
    except OSError as error:
        # A full disk is found by calls that know no name; then name the file that was asked for.
        if error.filename is not None and staging.name not in str(error):
            raise
        reason = error.strerror or str(error)
        raise OSError(error.errno or errno.EIO, reason, str(path)) from error
    finally:
        with suppress(OSError):  # with too long a name there is none
            staging.unlink(missing_ok=True)


def write_files(folder: str | Path, files: Mapping[str, Writer]) -> None:
    """Write files into a folder, one after the other; the folder is created if it is missing."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, write in files.items():
        write_file(folder / name, write)


def _flush_folder(folder: Path) -> None:
    if sys.platform == "win32":  # it cannot open folders
        return
    handle = os.open(folder, os.O_RDONLY)
    with suppress(OSError):  # some file systems cannot sync folders
        os.fsync(handle)
    os.close(handle)
