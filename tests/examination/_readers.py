"""The readers of the library, each with a whole file and with what may be made of it."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import _hostile as hostile
import numpy as np
import pandas as pd
import torch
from saved_models import FOLDER, predictions

from hybridkin import RigidChain, load_model, open_model, robots
from hybridkin.datasets import load_armlab, load_asl_trunk, load_log
from hybridkin.ik import trajectories

URDF = b"""<robot name="arm"><link name="base"/><link name="upper"/><link name="hand"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="upper"/>
<origin xyz="0 0 0.1" rpy="0 0.2 0"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="2"/>
</joint><joint name="bend" type="prismatic"><parent link="upper"/><child link="hand"/>
<origin xyz="0.2 0 0"/><mimic joint="turn" multiplier="2" offset="0.1"/><limit lower="0" upper="1"/>
</joint></robot>
"""
TOML = b"""name = "arm"
calibrate = ["radii", "base"]
[[segment]]
radius = 0.0045
length = 0.06
angles_deg = [0, 120, 240]
rest_bend_deg = [1.0, 0.0]
repeat = 2
[base]
position = [0.0, 0.0, 0.1]
[log]
q = ["a", "b", "c", "d", "e", "f"]
x = ["x", "y", "z"]
q_unit = "mm"
q_sign = [-1, 1, 1, 1, 1, 1]
[limits]
q_min = -0.01
q_max = [0.01, 0.01, 0.01, 0.01, 0.01, 0.01]
dq_max = 0.02
"""


class Reader(NamedTuple):
    """A reader: whole files, what makes others of them, how it is called, and the file's name."""

    whole: list[bytes]
    makers: list[Callable[[bytes, np.random.Generator], bytes]]
    read: Callable[[Path, int], Any]
    name: str


def _log() -> pd.DataFrame:
    rng = np.random.default_rng(0)
    cells = np.round(rng.uniform(-0.01, 0.01, (20, 7)), 6)
    table = pd.DataFrame(cells, columns=["q1", "q2", "q3", "x", "y", "z", "t"])
    return table.assign(motion=[f"m{k // 5}" for k in range(20)])


def _npz(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def _parquet(table: pd.DataFrame) -> bytes:
    file = io.BytesIO()
    table.to_parquet(file)
    return file.getvalue()


def _finite(what: str, values: Any) -> None:
    if not np.isfinite(values).all():
        raise AssertionError(f"{what} must be finite, got {np.ravel(values)[:6]}")


def _read_log(path: Path, k: int) -> None:
    options = [{}, {"drop_invalid": True}, {"groups": "motion"}, {"time": "t", "q_unit": "mm"}]
    log = load_log(path, ["q1", "q2", "q3"], ["x", "y", "z"], **options[k % 4])
    _finite("the log", np.hstack([log.q, log.x]))


def _read_points(path: Path, k: int) -> None:
    path_read = trajectories.from_csv(path, dt=None if k % 3 else 0.02)
    _finite("the path", path_read.x)


def _read_recording(path: Path, k: int) -> None:
    home = path.parent
    folder, read = [("armlab_3cable", load_armlab), ("asl_trunk_static", load_asl_trunk)][k % 2]
    target = home / folder / f"{folder}.npz"
    target.parent.mkdir(exist_ok=True)
    target.unlink(missing_ok=True)
    target.hardlink_to(path)
    data = read(home)
    _finite("the recording", np.hstack([data.q, data.x]))


def _read_chain(chain: Any) -> None:
    q = np.full((2, chain.n_actuators), 0.001)
    _finite("the tip", predictions(chain, q)["x"])


def _read_model(path: Path, k: int) -> None:
    """Read a model; predict what it did where the file is not repaired, else finite values."""
    model = load_model(path)
    q = STORED[f"{NAMES[k % len(NAMES)]}.q"]
    module = isinstance(model, torch.nn.Module)
    n = model.n_actuators if module else model.n_features_in_
    found = predictions(model, np.resize(q, (len(q), n)))
    if k // len(NAMES) % 5 > 1:  # its checksum was repaired
        for name in ("x", "J"):
            _finite(f"{name} of the model", found[name])
        return
    for name, wanted in ((name, STORED[f"{NAMES[k % len(NAMES)]}.{name}"]) for name in ("x", "J")):
        if not np.allclose(found[name], wanted, rtol=1e-6, atol=1e-6):
            raise AssertionError(f"{name} must be as before, got {found[name]!r:.60}")


NAMES = sorted(path.stem for path in FOLDER.glob("*.safetensors"))
STORED = dict(np.load(FOLDER / "predictions.npz"))
MODELS = [(FOLDER / f"{name}.safetensors").read_bytes() for name in NAMES]
_Q = np.random.default_rng(0).uniform(size=(20, 6))
_RECORDING = {"cable_shortening_mm": _Q[:, :3], "tip_mm": _Q[:, 3:], "row": np.arange(20), "u": _Q}
_RECORDING |= {"disk_pos_m": np.ones((20, 3, 3)), "run_id": np.arange(20), "kind": np.arange(20)}
_RECORDING |= {"run_names": np.array(["a", "b"])}
_TABLE = _log()
_CSV = _TABLE.to_csv(index=False).encode()
_POINTS = _TABLE[["t", "x", "y", "z"]].assign(t=0.1 * np.arange(20)).to_csv(index=False).encode()
_POINTS_3 = _TABLE[["x", "y", "z"]].to_csv(index=False).encode()

READERS = {
    "model": Reader(
        MODELS, [hostile.damaged] * 2 + [hostile.repaired] * 3, _read_model, "m.safetensors"
    ),
    "csv": Reader(
        [_CSV], [hostile.damaged, hostile.renumbered, hostile.wide], _read_log, "log.csv"
    ),
    "npz": Reader(
        [_npz(**{c: _TABLE[c].to_numpy(dtype="U" if c == "motion" else float) for c in _TABLE})],
        [hostile.damaged, hostile.zipped, hostile.zipped],
        _read_log,
        "log.npz",
    ),
    "parquet": Reader(
        [_parquet(_TABLE)], [hostile.damaged, hostile.columnar], _read_log, "log.parquet"
    ),
    "points": Reader(
        [_POINTS, _POINTS_3],
        [hostile.damaged, hostile.renumbered, hostile.wide],
        _read_points,
        "path.csv",
    ),
    "recording": Reader(
        [_npz(**_RECORDING)], [hostile.damaged, hostile.zipped], _read_recording, "r.npz"
    ),
    "toml": Reader(
        [TOML],
        [hostile.damaged, hostile.renumbered, hostile.described],
        lambda path, k: _read_chain(
            open_model(path).mechanical_model_ if k % 2 else robots.read_description(path).chain
        ),
        "robot.toml",
    ),
    "urdf": Reader(
        [URDF],
        [hostile.damaged, hostile.renumbered, hostile.described],
        lambda path, k: _read_chain(RigidChain.from_urdf(path, "hand")),
        "arm.urdf",
    ),
}


def made(kind: str, k: int) -> bytes:
    """Return file k of a format."""
    reader = READERS[kind]
    rng = np.random.default_rng([20, sorted(READERS).index(kind), k])
    data = reader.whole[k % len(reader.whole)]
    return reader.makers[k // len(reader.whole) % len(reader.makers)](data, rng)


def outcome(kind: str, k: int, path: Path) -> str:
    """Return "refused" or "read", or what is wrong with how a file was taken."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            READERS[kind].read(path, k)
            return "read"
        except AssertionError as error:
            return f"AssertionError: {error}"
        except Exception as error:
            return refusal(error)


def refusal(error: Exception) -> str:
    """Return "refused" for an error of ours: of a plain type, raised here, that names the path."""
    at = error.__traceback__
    while at is not None and at.tb_next is not None:
        at = at.tb_next
    place = "" if at is None else at.tb_frame.f_code.co_filename
    said = str(error)
    plain = isinstance(error, OSError) or type(error) in (ValueError, TypeError)
    ours = "hybridkin" in place and ("`" in said or "/" in said or "'" in said)
    if plain and ours and 20 < len(said) < 3000:
        return "refused"
    return f"{type(error).__name__} of {place[-40:]}: {said[:100]} ({len(said)} characters)"
