"""Logs, recordings and checkpoints that are damaged, or cost more to read than their size says."""

import io
import os
import sys
import zipfile

import numpy as np
import pytest

from hybridkin.datasets import _npz, load_armlab, load_log
from hybridkin.ik import trajectories

Q, X = ["q1", "q2", "q3"], ["x", "y", "z"]


def npy(shape, descr="<f8"):
    """An npy file whose header says something else than its content."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": descr, "fortran_order": False, "shape": shape}
    )
    return file.getvalue() + bytes(16)


@pytest.mark.parametrize(
    "member",
    [
        b"no magic number",
        npy((0, 10**9)),
        npy((10**18,)),
        npy((2 * 10**9,), "|S0"),
        npy((3,), "|O"),
        npy((3,)).replace(b"(3,)", b"(3, "),
    ],
)
def test_sizes_of_an_npz_that_are_not_there(tmp_path, member):
    for path in (tmp_path / "log.npz", tmp_path / "armlab_3cable" / "armlab_3cable.npz"):
        path.parent.mkdir(exist_ok=True)
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("q1.npy", member)
    with pytest.raises(ValueError, match="is not an npz file of plain arrays"):
        load_log(tmp_path / "log.npz", Q, X)
    with pytest.raises(ValueError, match="is not an npz file of plain arrays"):
        load_armlab(tmp_path)


def test_an_npz_that_expands_without_measure(tmp_path, monkeypatch):
    monkeypatch.setattr(_npz, "_MOST", 10**6)
    path = tmp_path / "log.npz"
    np.savez_compressed(path, q=np.zeros((10**5, 3)))
    with pytest.raises(ValueError, match="expands to 2 MB"):
        load_log(path, Q, X)


def test_paths_that_are_no_text_or_no_file(tmp_path):
    path = tmp_path / "path.csv"
    path.write_bytes(b"t,x,y,z\n0,0,0,\x00\n")
    with pytest.raises(ValueError, match=r"path\.csv' is not a text file"):
        trajectories.from_csv(path)
    if sys.platform != "win32":
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(FileNotFoundError, match="`path` must be a CSV file of points"):
            trajectories.from_csv(tmp_path / "pipe")
