"""Errors of the disk name the file that was to be written, and leave what was there."""

import errno
import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from small_files import small_files

from hybridkin import native, plots, robots, save_model
from hybridkin._core.files import write_file, write_files
from hybridkin.workflow.report import Report

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


CHAIN = robots.bionic_handling_assistant()


def film(path):
    q = 0.1 + np.linspace(0.0, 0.02, 27).reshape(3, 9)
    plots.TrackAnimation.from_estimator(CHAIN, q).save(path)


def report(out):
    written = Report("model", {})
    written.text("text " * 300)
    written.write(out)


def table(out):
    written = Report("next", {})
    written.file("next.csv", partial(np.savetxt, X=np.eye(20)))
    written.write(out)


@pytest.mark.parametrize(
    ("write", "name", "failing"),
    [
        (partial(save_model, CHAIN), "model", "model"),
        (partial(native.export_c, CHAIN), "code", "code/model.h"),
        (report, "out", "out/report.md"),
        (table, "out", "out/next.csv"),
        pytest.param(film, "film.gif", "film.gif", marks=pytest.mark.slow),
        pytest.param(film, "film.html", "film.html", marks=pytest.mark.slow),
    ],
)
def test_every_writer_names_the_file_that_does_not_fit(tmp_path, write, name, failing):
    if name.endswith("html"):
        pytest.importorskip("viser")
    with small_files(), pytest.raises(OSError, match="too large") as caught:
        write(tmp_path / name)
    assert caught.value.filename.startswith(str(tmp_path / failing))
    assert not (tmp_path / failing).exists()
    assert [*tmp_path.rglob("*.part*")] == []
