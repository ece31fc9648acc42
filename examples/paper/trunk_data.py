"""Data of the simulated trunk, by default with the paper's sampling protocol."""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import warnings
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import shaped
from hybridkin._core.files import write_file
from hybridkin.datasets import load_trunk
from hybridkin.datasets._npz import arrays_of
from paper.protocol import RANGE, draw, paper_protocol
from paper.trunk import NotSettledError, TrunkPlant

OWN = -1  # part of a row with a given command
PARTS = ("segment 0", "segment 1", "segment 2", "all segments")
CHUNK = 25  # rows that a process computes at once, and loses if it is interrupted
MAX_REDRAWS = 20
# Random streams besides that of the protocol: measurement noise (row), redraws (row, attempt).
NOISE, REDRAW = 1, 2


def make_trunk(
    q_target: ArrayLike | None = None,
    *,
    n_segment: int = 500,
    n_random: int = 500,
    random_state: int | None = None,
    cable_noise: float = 1e-3,
    mocap_noise: float = 5e-4,
    n_jobs: int | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    return_X_y: bool = False,
    **plant_parameters: Any,
) -> Any:
    """Return simulated data of a pneumatic trunk, by default with the paper's protocol.

    The rows are chamber lengths and tip positions of `TrunkPlant`, a MuJoCo model
    similar to Festo's Bionic Handling Assistant, sampled by the protocol of Reinhart and
    Steil (2016). All data are simulated, not measured on a robot. To repeat row i::

        plant = TrunkPlant(**data.parameters["plant"])
        seed = data.parameters["random_state"]
        q, pose = plant.settle(data.q_target[i], random_state=[seed, 1, data.row[i]])

    The result depends only on the seed and the parameters, not on `n_jobs` or on interruptions.
    A row of the protocol that does not settle is drawn again, so that every part keeps its size.
    Rows of a given `q_target` that do not settle are left out. Both are reported in ``failed``
    and by a warning.

    Parameters
    ----------
    q_target : array-like of shape (n_samples, 9) or None, default=None
        Commanded chamber lengths [m]; None draws them by `paper_protocol`.
    n_segment, n_random : int, default=500
        Sizes of the parts of the protocol, if `q_target` is None.
    random_state : int or None, default=None
        Seed of sampling and noise; None: a new one, which is stored in ``parameters``.
    cable_noise : float, default=1e-3
        Standard deviation of the measured lengths [m].
    mocap_noise : float, default=5e-4
        Standard deviation of each coordinate of the measured tip position [m].
    n_jobs : int or None, default=None
        Number of processes, as in joblib.
    checkpoint : path-like or None, default=None
        Folder for finished rows, in npz files. Rows in it with the same seed and parameters are
        not computed again, for example after an interruption.
    return_X_y : bool, default=False
        If True, return ``(q, x)`` only.
    **plant_parameters
        Arguments of `TrunkPlant`.

    Returns
    -------
    data : :class:`~sklearn.utils.Bunch`
        ``q`` (n_samples, 9), measured chamber lengths [m], three per segment from base to tip;
        ``x`` (n_samples, 3), measured tip position in the motion-capture frame [m]; ``q_target``
        (n_samples, 9), commanded chamber lengths [m]; ``part`` (n_samples,), 0, 1 or 2 if only that
        segment moves, 3 if all lengths are random, None for a given `q_target`; ``row``
        (n_samples,), row of the sampling protocol; ``groups`` (None); ``failed``, rows that did not
        settle, as (row, q_target, message); ``parameters``, seed, noise, sampling and plant
        parameters; ``units``, ``source``, ``citation``, ``DESCR``.

    Raises
    ------
    ValueError
        If `q_target` or a parameter is invalid.
    ImportError
        If MuJoCo is not installed.

    Warns
    -----
    UserWarning
        If rows did not settle.

    Examples
    --------
    >>> from paper import make_trunk
    >>> data = make_trunk(n_segment=1, n_random=2, random_state=0)
    >>> data.q.shape, data.x.shape, data.part.tolist()
    ((5, 9), (5, 3), [0, 1, 2, 3, 3])
    """
    if random_state is None:
        random_state = int(np.random.default_rng().integers(2**31))
    if not isinstance(random_state, (int, np.integer)) or random_state < 0:
        raise ValueError(f"`random_state` must be an integer >= 0 or None, got {random_state!r}.")
    noise = {"cable_noise": cable_noise, "mocap_noise": mocap_noise}
    plant = _plant_parameters({**plant_parameters, **noise})
    made = {
        "random_state": int(random_state),
        "plant": plant,
        "mujoco": version("mujoco"),
    }
    targets, part, drawn = _targets(q_target, made["random_state"], n_segment, n_random)
    chunks = np.array_split(np.arange(len(targets)), max(1, -(-len(targets) // CHUNK)))
    jobs = (delayed(_kept)(checkpoint, rows, targets[rows], part[rows], made) for rows in chunks)
    q, x, targets, failed = zip(*Parallel(n_jobs=n_jobs)(jobs), strict=True)  # type: ignore
    q, x, targets = map(np.concatenate, (q, x, targets))
    failed = [one for chunk in failed for one in chunk]
    if failed:
        row, _, message = failed[0]
        fate = "drawn again" if q_target is None else "left out"
        warnings.warn(
            f"{len(failed)} configurations did not settle and were {fate}; the first, in row "
            f"{row}: {message}",
            stacklevel=2,
        )
    kept = np.flatnonzero(np.isfinite(q).all(axis=1))
    columns = {
        "q": q,
        "x": x,
        "q_target": targets,
        "part": part,
        "row": np.arange(len(q)),
    }
    columns = {name: column[kept] for name, column in columns.items()}
    return _bunch(columns, made | drawn, failed, return_X_y)


def _targets(
    q_target: ArrayLike | None, seed: int, n_segment: int, n_random: int
) -> tuple[NDArray, NDArray, dict[str, Any]]:
    """Return the commanded lengths (N, 9), the part of each row, and the protocol's settings."""
    if q_target is None:
        targets, part = paper_protocol(seed, n_segment=n_segment, n_random=n_random)
        sizes = {"n_segment": int(n_segment), "n_random": int(n_random)}
        return targets, part, {"protocol": sizes | RANGE}
    targets = shaped(q_target, "q_target", ("n_samples", 9))
    low, high = TrunkPlant.admissible
    bad = np.flatnonzero(~((targets >= low) & (targets <= high)).all(axis=1))
    if len(bad):
        raise ValueError(
            f"`q_target` must be chamber lengths of {low} to {high} m, but {len(bad)} rows are "
            f"not, first row {bad[0]}: {targets[bad[0]]}; clip them or convert them to metres."
        )
    return targets, np.full(len(targets), OWN, np.int8), {}


def _kept(checkpoint, rows, targets, part, made):
    """Return the result of `_measure`, from a file of the checkpoint if it has a valid one."""
    if checkpoint is None:
        return _measure(rows, targets, part, made)
    text = json.dumps([rows.tolist(), targets.tolist(), part.tolist(), made], sort_keys=True)
    file = Path(checkpoint) / f"rows-{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"
    names = ("q", "x", "targets", "failed", "failed_targets", "key")
    try:
        q, x, reached, failed, tried, key = map(arrays_of(file).__getitem__, names)
        if str(key) == text and np.hstack([q, x, reached]).shape == (len(rows), 21):
            found = zip(json.loads(str(failed)), tried, strict=True)
            return q, x, reached, [(row, target, why) for (row, why), target in found]
    except (ValueError, LookupError, TypeError):  # missing or damaged: computed again
        pass
    q, x, reached, failed = _measure(rows, targets, part, made)
    said = json.dumps([[row, why] for row, _, why in failed])
    values = (
        q,
        x,
        reached,
        said,
        np.reshape([at for _, at, _ in failed], (-1, 9)),
        text,
    )
    Path(checkpoint).mkdir(parents=True, exist_ok=True)
    write_file(file, partial(np.savez, **dict(zip(names, values, strict=True))))
    return q, x, reached, failed


def _measure(rows, targets, part, made):
    """Settle a chunk of rows; the noise of a row depends on (seed, row), not on the process."""
    seed, plant = made["random_state"], TrunkPlant(**made["plant"])
    failed, targets = [], targets.copy()
    q, x = np.full((len(rows), 9), np.nan), np.full((len(rows), 3), np.nan)
    for i, row in enumerate(rows.tolist()):
        for attempt in range(1 if part[i] == OWN else 1 + MAX_REDRAWS):
            if attempt:
                rng = np.random.default_rng([seed, REDRAW, row, attempt])
                targets[i] = draw(rng, part[i : i + 1])[0]
            try:
                q[i], pose = plant.settle(targets[i], random_state=[seed, NOISE, row])
            except NotSettledError as error:
                failed.append((row, targets[i].copy(), str(error)))
                continue
            x[i] = pose[:3, 3]
            break
        else:
            if part[i] != OWN:
                raise NotSettledError(
                    f"Row {row}: none of {1 + MAX_REDRAWS} draws of part {PARTS[part[i]]!r} "
                    f"settled; the last: {failed[-1][2]}"
                )
    return q, x, targets, failed


def _plant_parameters(given):
    """Return all arguments of the plant, as plain numbers and lists."""
    merged = {k: v.default for k, v in inspect.signature(TrunkPlant).parameters.items()} | given
    del merged["random_state"]  # every row has its own seed
    TrunkPlant(**merged)  # raises errors here, not in a process
    return {name: np.asarray(value).tolist() for name, value in merged.items()}


def _bunch(columns, parameters, failed, return_X_y):
    """Return rows with their source; `columns` are q, x, q_target, part and row."""
    if return_X_y:
        return columns["q"], columns["x"]
    data = load_trunk()  # the same units, source and citation
    data.update(columns, failed=failed, parameters=parameters, DESCR=inspect.getdoc(make_trunk))
    if (data.part == OWN).any():
        data.part = None
    return data
