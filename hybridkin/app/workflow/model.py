"""What the commands ask of a model: tips, commands, errors to expect, and words."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin import native, robots
from hybridkin.app.workflow.errors import ExpectedErrors, HeldOutErrors, Promise
from hybridkin.arguments import as_path
from hybridkin.datasets import LOG_SUFFIXES
from hybridkin.formats import UNITS, LogUnit, in_terms

if TYPE_CHECKING:
    from hybridkin import HybridForwardModel

"""Endings of files that are treated as logs."""

_MODELS = (".toml", ".safetensors")
_HEADER = 8  # bytes of the size of the header of a model, which begins with a brace
_LONG = 1e9  # time after which all creep has come [s]


def is_fitted(model: HybridForwardModel) -> bool:
    """Return whether rows were fitted to a model; none were to a nominal one."""
    return bool(np.isfinite(model.training_range_.low).all())


def trained_range(model: HybridForwardModel) -> robots.Limits:
    """Return the least and largest q of the fit, no limits for a nominal model.

    With backlash it is the range of the actuators' motion.
    """
    return robots.Limits(*model.training_range_)


def has_body(model: HybridForwardModel) -> bool:
    """Return whether a model has a mechanical part with a geometry, which can be drawn."""
    return bool(model.module_.robot.geometry())


def tips_at(model: HybridForwardModel, q: NDArray) -> NDArray:
    """Return tips (N, 3) [m] for the motion q (N, n) of the actuators, without backlash."""
    return native.evaluate(model.module_.tip_model, np.array(q, dtype=float))[0]


def domain_distance(model: HybridForwardModel, q: NDArray) -> NDArray:
    """Return the distance of rows q (N, n) from the training rows, at most 1 in the domain."""
    tip = model.module_.tip_model
    q = np.array(q, dtype=float)
    return native.evaluate(tip, q, value=False, distance=True)[0]


def commands_for(model: HybridForwardModel, q: NDArray, time: NDArray | None = None) -> NDArray:
    """Return the commands (N, n) that move the actuators along q (N, n), row after row.

    The times (N,) of the rows matter with creep [s]; without them the robot rests at each row.
    """
    steps = _LONG if time is None else np.diff(time, prepend=time[:1])
    commands, _ = model.hysteresis_.command(q, dt=steps)
    return commands


def half_width(model: HybridForwardModel) -> NDArray:
    """Return half the width of the hysteresis, in the unit of q; 0 without."""
    return 0.5 * model.hysteresis_.width


def log_unit(model: HybridForwardModel) -> LogUnit:
    """Return the unit of q in the logs of the robot."""
    return LogUnit.of(model.description_.log.q_unit)


def hysteresis_in_words(model: HybridForwardModel) -> str:
    """Return the hysteresis of the actuators in words, its widths in the unit of logs."""
    return model.hysteresis_.in_words(log_unit(model))


def widths_in_log(model: HybridForwardModel) -> list[float] | None:
    """Return widths of the hysteresis of one or all actuators, in the unit of logs, or None."""
    if not model.hysteresis_:
        return None
    size = UNITS.get(model.description_.log.q_unit, 1.0)
    return np.ravel(model.hysteresis_.width / size).tolist()


def check_columns(model: HybridForwardModel, q: NDArray) -> None:
    """Raise if the rows q (N, n) of a log do not have one column for each actuator."""
    n = model.n_features_in_
    if q.shape[1] != n:
        raise ValueError(
            f"`q` must name {n} columns, one for each actuator of the model, got {q.shape[1]}."
        )


def fitted_rows(
    model: HybridForwardModel, q: NDArray, x: NDArray, motions: NDArray
) -> NDArray[np.bool_] | None:
    """Return whether each row (N,), to a micrometre, or half of its motion was fitted.

    None if the model does not hold its rows: a file of a calibrated chain.
    """
    if not is_fitted(model) and model.description_.created:
        return None
    fitted = model.was_fitted(q, x)
    _, motion = np.unique(motions, return_inverse=True)
    half_fitted = np.bincount(motion, fitted) >= 0.5 * np.bincount(motion)
    return fitted | half_fitted[motion]


def held_out_errors(model: HybridForwardModel) -> HeldOutErrors | None:
    """Return the errors of the fit on held-out motions, where the file has them."""
    training = model.description_.training
    entry = training.get("held_out", {}).get(training.get("saved"))
    return None if entry is None else HeldOutErrors.read(entry)


def kind_of(model: HybridForwardModel) -> str:
    """Return what the model is, as the fit calls it: "hybrid, ELM", "mechanical, nominal", ..."""
    kind = "hybrid"
    if not is_fitted(model):
        kind = "mechanical, nominal" if has_body(model) else "data-driven"
    return model.description_.training.get("saved", kind)


def promised_errors(model: HybridForwardModel, q: NDArray) -> ExpectedErrors:
    """Return the errors (N,) to expect where the actuators do q (N, n).

    They are those of held-out motions at the same distance from the log, unknown if the file does
    not have them.
    """
    training = model.description_.training
    if not is_fitted(model) or "promise" not in training:
        return ExpectedErrors.unknown(len(q))
    promise = Promise(**training["promise"])
    tested = model.fitted_module_.tested
    if tested is None:
        return promise.at(np.zeros(len(q)))
    moved = torch.from_numpy(q + model.change_.shift)
    return promise.at(tested.distances(moved).numpy())


def expected_errors(model: HybridForwardModel, q: NDArray) -> dict[str, NDArray]:
    """Return by name the errors (N,) [m] to expect of the robot on a path of motions q (N, n)."""
    expected = {}
    promised = promised_errors(model, q)
    if promised.known:
        expected["expected on this path"] = promised.mean
        expected["95 % below, on this path"] = promised.p95
    radius = model.radius_
    if radius is not None:
        name = f"estimated error radius, {100 * radius.coverage:g} %"
        expected[name] = radius.at(domain_distance(model, q) <= 1.0)
    return expected


def plane_in_words(model: HybridForwardModel) -> str:
    """Return which motions the log lacks and no command makes, in its names; "" if none."""
    plane = model.module_.plane
    if not plane.n_normals:
        return ""
    log = model.description_.log
    normals = plane.normals.numpy(force=True) * np.reshape(log.q_factor, (-1, 1))
    motions = in_terms(normals / np.abs(normals).max(axis=0), log.q)
    return (
        f"The log has no motion along {motions}, and the mechanical model knows no effect of it: "
        "commands keep to what the log has."
    )


def is_log(path: str | Path) -> bool:
    """Return whether a path names a log: by its ending, else a file that is no model.

    Parameters
    ----------
    path : str or Path
        A file, or a folder of a fit.

    Returns
    -------
    bool
        Files without a known ending are logs if they do not begin like a model.
    """
    path = as_path(path)
    if path.suffix.lower() in LOG_SUFFIXES:
        return True
    if path.suffix.lower() in _MODELS or not path.is_file():
        return False
    with open(path, "rb") as file:
        start = file.read(_HEADER + 1)
    return start[_HEADER:] != b"{"
