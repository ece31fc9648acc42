"""Files that are written completely or not at all, even if the process or the power fails."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import Any

if sys.platform != "win32":
    import fcntl

_NEW = ".hybridkin-new"  # folder of complete files that are about to replace those beside it

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
        raise ValueError(f"`path` must name a file, got {path}, which is not one; add a file name.")
    with _staged(path, path.parent) as staging:
        write(staging)
        _flush(staging)
        if path.exists():
            os.chmod(staging, path.stat().st_mode)
        os.replace(staging, path)
        _flush(path.parent)


def write_files(folder: str | Path, files: Mapping[str, Writer]) -> None:
    """Write all files into a folder, or none; the folder is created if it is missing.

    A keyboard interrupt is raised before anything is replaced, or after everything is.
    """
    folder = Path(os.path.realpath(folder))
    folder.parent.mkdir(parents=True, exist_ok=True)
    home = folder if folder.is_dir() else folder.parent
    if taken := [name for name in files if (folder / name).is_dir()]:
        raise IsADirectoryError(f"{folder / taken[0]} must be a file or absent, but is a folder.")
    with _staged(folder, home) as staging:
        staging.mkdir()
        for name, write in files.items():
            with _named(folder / name, staging):
                write(staging / name)
                _flush(staging / name)
        _flush(staging)
        late, new = None, folder / _NEW if home == folder else folder
        while staging.exists() or (folder / _NEW).exists():
            try:
                _finish(folder)
                if staging.exists():
                    os.rename(staging, new)
                _flush(home)
            except KeyboardInterrupt as interrupt:
                late = interrupt
                if staging.exists():
                    raise
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
                new = folder / _NEW  # another run wrote in the meantime
    if late is not None:
        raise late


def newest(path: Path) -> Path:
    """Return the path, or the complete newer file that a killed `write_files` left for it."""
    waiting = path.with_name(_NEW) / path.name
    return waiting if waiting.is_file() else path


def _finish(folder: Path) -> None:
    """Move the complete new files of a folder to their final places."""
    if (folder / _NEW).is_dir():
        for path in (folder / _NEW).iterdir():
            with suppress(FileNotFoundError):  # another run does the same
                os.replace(path, folder / path.name)
        with suppress(OSError):
            (folder / _NEW).rmdir()


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
def _staged(path: Path, home: Path) -> Iterator[Path]:
    """Yield a temporary path in a folder, and remove what is left there at the end.

    Leftovers of killed writers are removed too. Every writer holds a shared lock on the folder
    until its process ends, so an exclusive lock means that no other writer is at work.
    """
    staging = home / f".{path.name}-{secrets.token_hex(8)}.part{path.suffix}"
    handle = os.open(os.devnull if sys.platform == "win32" else home, os.O_RDONLY)
    try:
        if sys.platform != "win32":
            with suppress(OSError):  # others write, or the file system has no locks
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                parts = f".{escape(path.name)}-{16 * '[0-9a-f]'}.part{escape(path.suffix)}"
                for left in home.glob(parts):
                    _remove(left)
            with suppress(OSError):
                fcntl.flock(handle, fcntl.LOCK_SH)
        with _named(path, staging):
            yield staging
    finally:
        _remove(staging)
        os.close(handle)


@contextmanager
def _named(path: Path, staging: Path) -> Iterator[None]:
    """Give a system's error the path that was to be written, if it names none or a temporary one.

    A full disk is found by calls that know no name.
    """
    try:
        yield
    except OSError as error:
        if error.filename is None or staging.name in str(error):
            reason = error.strerror or str(error)
            raise OSError(error.errno or errno.EIO, reason, str(path)) from error
        raise


def _remove(path: Path) -> None:
    with suppress(OSError):  # one on a read-only disk, or with too long a name, is not there
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
