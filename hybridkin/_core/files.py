"""Files that are written completely or not at all, even if the process or the power fails."""

from __future__ import annotations

import errno
import os
import secrets
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import Any

if sys.platform != "win32":
    import fcntl

Writer = Callable[[Path], Any]
"""A function that writes a file to the path it is given."""


def write_file(path: str | Path, write: Writer) -> None:
    """Write a file; an old one is replaced only when the new one is completely on the disk.

    For a symbolic link the target is replaced. A replaced file keeps its permissions.
    """
    path = Path(os.path.realpath(path))
    if not path.parent.is_dir():
        raise FileNotFoundError(f"`path` must lie in a folder that exists, got {path}.")
    if path.exists() and not path.is_file():
        raise ValueError(
            f"`path` must name a file, got {path}, which is not one; add a file name."
        )
    with _staged(path) as staging:
        write(staging)
        _flush(staging)
        if path.exists():
            os.chmod(staging, path.stat().st_mode)
        os.replace(staging, path)
        _flush(path.parent)


def write_files(folder: str | Path, files: Mapping[str, Writer]) -> None:
    """Write files into a folder, one after the other; the folder is created if it is missing."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, write in files.items():
        write_file(folder / name, write)


def _flush(path: Path) -> None:
    """Wait until a file or a folder is on the disk."""
    if path.is_dir() and sys.platform == "win32":  # it cannot open folders
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    except OSError:  # some file systems cannot sync folders
        if not path.is_dir():
            raise
    finally:
        os.close(handle)


@contextmanager
def _staged(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside a file, and remove what is left there at the end.

    Leftovers of killed writers are removed too. Every writer holds a shared lock on the folder
    until its process ends, so an exclusive lock means that no other writer is at work.
    """
    staging = path.with_name(f".{path.name}-{secrets.token_hex(8)}.part{path.suffix}")
    handle = os.open(
        os.devnull if sys.platform == "win32" else path.parent, os.O_RDONLY
    )
    try:
        if sys.platform != "win32":
            with suppress(OSError):  # others write, or the file system has no locks
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                parts = (
                    f".{escape(path.name)}-{16 * '[0-9a-f]'}.part{escape(path.suffix)}"
                )
                for left in path.parent.glob(parts):
                    left.unlink(missing_ok=True)
            with suppress(OSError):
                fcntl.flock(handle, fcntl.LOCK_SH)
        yield staging
    except OSError as error:
        # A full disk is found by calls that know no name; then name the file that was asked for.
        if error.filename is not None and staging.name not in str(error):
            raise
        reason = error.strerror or str(error)
        raise OSError(error.errno or errno.EIO, reason, str(path)) from error
    finally:
        with suppress(
            OSError
        ):  # one on a read-only disk, or with too long a name, is not there
            staging.unlink(missing_ok=True)
        os.close(handle)
