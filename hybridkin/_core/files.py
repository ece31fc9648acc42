"""Files that are written completely or not at all, even if the process or the power fails."""

from __future__ import annotations

import errno
import os
import secrets
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path

Writer = Callable[[Path], object]
"""A function that writes a file to the path it is given."""

MARK = b"hybridkin"  # in a file of ours, near its start or end
_MARGIN = 65_536  # bytes


def write_file(path: str | Path, write: Writer) -> None:
    """Write a file; an old one is replaced only when the new one is completely on the disk.

    For a symbolic link the target is replaced. A replaced file keeps its permissions. A writer that
    is killed can leave a hidden file ``.NAME-*.part``.
    """
    path = Path(os.path.realpath(path))
    if not path.parent.is_dir():
        raise FileNotFoundError(f"`path` must lie in a folder that exists, got {path}.")
    _check_kind(path)
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


def check_outputs(
    paths: Iterable[Path],
    command: str,
    is_ours: Callable[[Path], bool] | None = None,
    *,
    force: bool,
) -> None:
    """Raise, before any work, if a command cannot write its files, or would replace others'.

    Parameters
    ----------
    paths : iterable of Path
        The files, in one folder, which `write_files` may create.
    command : str
        Name of the command, for the message.
    is_ours : callable, optional
        Returns whether the command wrote a file earlier, so that it may be replaced. Default:
        whether it has the name of this package near its start or end.
    force : bool
        Replace files of others, too. Folders, devices and pipes are never replaced.
    """
    present = []
    for path in paths:
        folder = path.absolute().parent
        while not folder.exists():
            folder = folder.parent
        if not folder.is_dir() or not os.access(folder, os.W_OK):
            raise OSError(
                f"`out` must be a folder that can be written, got {path.parent}; name another one."
            )
        _check_kind(path)
        if path.exists() and not (force or (is_ours or _is_marked)(path)):
            present.append(path)
    if present:
        names = ", ".join(path.name for path in present)
        raise FileExistsError(
            f"{present[0].absolute().parent} has {names} already, which `hybridkin {command}` "
            "replaces only with --force (in Python: force=True); or name another place."
        )


def _check_kind(path: Path) -> None:
    """Raise if a path is taken by what is no file: a folder, a device or a pipe."""
    if path.exists() and not path.is_file():
        raise ValueError(f"`path` must name a file, got {path}, which is not one; add a file name.")


def _is_marked(path: Path) -> bool:
    """Return whether a file names this package near its start or end."""
    with open(path, "rb") as file:
        start = file.read(_MARGIN)
        file.seek(max(0, path.stat().st_size - _MARGIN))
        end = file.read(_MARGIN)
    return MARK in start or MARK in end


def _flush_folder(folder: Path) -> None:
    if sys.platform == "win32":  # it cannot open folders
        return
    handle = os.open(folder, os.O_RDONLY)
    with suppress(OSError):  # some file systems cannot sync folders
        os.fsync(handle)
    os.close(handle)
