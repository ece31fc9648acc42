"""Errors of the disk name the file that was to be written, and leave what was there."""

import errno
import os
from pathlib import Path

import pytest

from hybridkin._core.files import write_file, write_files

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # as of a call that knows no name


def fails(path):
    raise FULL


def test_a_file_on_a_full_disk(tmp_path):
    path = tmp_path / "model"
    path.write_text("old")
    with pytest.raises(OSError, match="No space left on device") as caught:
        write_file(path, fails)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(path))
    assert [*tmp_path.iterdir()] == [path]
    assert path.read_text() == "old"


@pytest.mark.parametrize("reason", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_a_disk_that_is_full_when_the_file_is_flushed(tmp_path, monkeypatch, reason):
    def flush(handle):
        raise OSError(reason, os.strerror(reason))

    monkeypatch.setattr(os, "fsync", flush)
    with pytest.raises(OSError, match="out/a'") as caught:
        write_files(tmp_path / "out", {"a": Path.touch})
    assert caught.value.errno == reason
    with pytest.raises(OSError, match="model'"):
        write_file(tmp_path / "model", Path.touch)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("length", [235, 300])
def test_a_name_that_is_too_long_is_the_one_in_the_message(tmp_path, length):
    name = "m" * length
    with pytest.raises(OSError, match="too long") as caught:
        write_file(tmp_path / name, Path.touch)
    assert caught.value.filename == str(tmp_path / name)
