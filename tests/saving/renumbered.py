"""Saved models with other numbers and a right checksum, and what became of each."""

from __future__ import annotations

import copy
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load_file
from saved_models import FOLDER

from hybridkin import load_model, native, save_model
from hybridkin.saving._file import write
from hybridkin.saving.header import model_header

FACTORS = [0.0, -1.0, 1.05, 1e-3, 1e3, 1e-9, 1e9, 1e-60, 1e60, 1e-70, 1e70, -1e40]
NUMBERS = [0, 1, -1, 2, 0.5, 1.05, 1e9, 1e60, -1e60, 1e-60, 7, True, None]
_LEAST = 1e-30  # smaller numbers may be rounded to zero
_ACCURATE = 1e-6  # relative to the size of x plus its change over q


def renumbered(kind: str, k: int, path: Path) -> tuple[Path, np.ndarray]:
    """Write model `kind` with some other numbers, and return the path and the rows of its kind.

    Every second file has no prediction, as those of earlier versions.
    """
    source = FOLDER / f"{kind}.safetensors"
    rng = np.random.default_rng([50, k, *kind.encode()])
    with np.load(FOLDER / "predictions.npz") as stored:
        rows = stored[f"{kind}.q"]
    if k % 2:
        save_model(load_model(source), path)
        source = path
    header, arrays = copy.deepcopy(model_header(source)), load_file(source)
    for _ in range(int(rng.integers(1, 3))):
        if rng.random() < 0.2:
            _other_setting(header, rng)
        else:
            name = rng.choice(sorted(arrays))
            arrays[name] = _others(arrays[name], rng)
    write(path, header, arrays)
    return path, rows


def _others(array: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return an array in which one number, or each, is another finite one."""
    changed = array.copy()
    factor = rng.choice(FACTORS)
    with np.errstate(over="ignore", invalid="ignore"):
        if rng.random() < 0.5 or not array.size:
            changed = changed * factor
        else:
            at = rng.integers(array.size)
            changed.flat[at] = factor * (changed.flat[at] or 1.0)
        return changed.astype(array.dtype)


def _other_setting(entry: Any, rng: np.random.Generator) -> None:
    """Replace a number somewhere in the header."""
    places = []

    def look(value: Any) -> None:
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            if isinstance(part, (dict, list)):
                look(part)
            elif isinstance(part, (int, float)) and key != "version":
                places.append((value, key))

    look({key: entry[key] for key in ("settings", "parts")})
    if places:
        holder, key = places[int(rng.integers(len(places)))]
        holder[key] = NUMBERS[int(rng.integers(len(NUMBERS)))]


def judged(path: Path, rows: np.ndarray) -> str:
    """Return "refused", "read" where the core and torch agree on finite numbers, or what is wrong.

    The rows are those of the kind, and shorter ones between.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            model = load_model(path)
        except ValueError as error:
            named = str(error).startswith(str(path)) and 20 < len(str(error)) < 2000
            return "refused" if named else f"an error without the file: {error!r:.200}"
        module = getattr(model, "module_", model)
        q = np.concatenate([rows, rows.mean(0) + 0.3 * (rows - rows.mean(0))])
        with torch.no_grad():
            x, J = (a.numpy() for a in module.forward_and_jacobian(torch.from_numpy(q)))
        by_core, J_by_core = native.evaluate(module, q, jacobian=True)
    if not all(np.isfinite(a).all() for a in (x, J, by_core, J_by_core)):
        return f"not finite: {x.tolist()} and {by_core.tolist()} by the core"
    allowed = _ACCURATE * (np.abs(x).max() + (np.abs(J) * np.abs(q[:, None])).sum(2)) + _LEAST
    if not (np.abs(x - by_core) <= allowed).all():
        return f"{x.tolist()}, but {by_core.tolist()} by the core"
    return "read"
