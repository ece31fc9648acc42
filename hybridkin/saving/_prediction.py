"""What a model predicts at two fixed rows: stored beside it, and compared when it is loaded."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.model import ForwardModel
from hybridkin._core.stored import Stored
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.native.export import usual_range
from hybridkin.native.library import evaluate, program_of
from hybridkin.saving._file import Header

_INSIDE = 0.5  # of half the usual range: inside the domain, where all actuators have an effect
_OUTSIDE = 1.5  # outside, where guards fade corrections out
# What rounding on another machine may change, relative to the size of x plus its change over q.
_TOLERANCE = {torch.float64: 1e-7, torch.float32: 1e-3}
_MOST = 1e-3  # of the size of x: a model whose rounding changes more is damaged
_LEAST = 1e-30  # smaller numbers may be rounded to zero


def prediction_of(model: Any) -> Header:
    """Return rows q, and the tips x and domain distances there, as JSON values.

    Raises
    ------
    ValueError
        If they are not finite.
    """
    rows = _rows(model)
    x, _, distance = _by_torch(_module(model), rows)
    _check_finite(rows, x, distance)
    return {"q": rows.tolist(), "x": _rounded(x), "distance": _rounded(distance)}


def check_prediction(model: Any, prediction: object) -> None:
    """Raise a ValueError if a loaded model does not predict what its file says.

    The compiled core and torch must also agree. A file of an earlier version says nothing; then
    what they predict must be finite.
    """
    module = _module(model)
    rows = _rows(model)
    stored = None
    if prediction is not None:
        if not isinstance(prediction, dict):
            raise ValueError(f"`prediction` must be a dict, got {prediction!r:.60}")
        stored = Stored("prediction", prediction)
        n_rows = len(stored.value("q", list))
        rows = _numbers(stored, "q", (n_rows, module.n_actuators))
    x, J, distance = _by_torch(module, rows)
    _check_finite(rows, x, J, distance)
    single = any(a.dtype == torch.float32 for a in module.state_dict().values())
    relative = _TOLERANCE[torch.float32 if single else torch.float64]
    change = (np.abs(J) * np.abs(rows[:, None])).sum(2)
    size = np.abs(x).max()
    tolerance = np.minimum(relative * (size + change), _MOST * size) + _LEAST
    if stored is not None:
        wanted = _numbers(stored, "x", x.shape)
        _check_equal(rows, x, wanted, tolerance, "the file says")
        wanted = _numbers(stored, "distance", distance.shape)
        far = relative * (1.0 + distance) * 10.0
        _check_equal(rows, distance, wanted, far, "the file says of the domain")
    if program_of(module) is not None:
        by_core, J_by_core, far_by_core = evaluate(module, rows, jacobian=True, distance=True)
        _check_finite(rows, by_core, J_by_core, far_by_core)
        _check_equal(rows, x, by_core, tolerance, "the compiled core")


def _module(model: Any) -> ForwardModel:
    return model if isinstance(model, ForwardModel) else model.module_


def _rows(model: Any) -> NDArray:
    """Return the fixed rows q (1 or 2, n), from the training range or the geometry.

    One may be left out: an elastic robot may have no shape there.
    """
    module = _module(model)
    if isinstance(model, HybridForwardModel):
        low, high = model.training_range_
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
    else:
        middle, half = usual_range(module, module.n_actuators)
    pattern = np.linspace(-1.0, 0.8, module.n_actuators)
    rows = middle + half * np.outer([_INSIDE, _OUTSIDE], pattern)
    has_shape = module.has_shape(_on_its_device(module, rows)).numpy(force=True)
    if not has_shape.any():
        raise ValueError(
            f"the arrays do not give finite numbers: the robot has no shape at q = {rows.tolist()}"
        )
    return rows[has_shape]


def _by_torch(module: ForwardModel, rows: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return x (N, m), dx/dq (N, m, n) and the domain distances (N,)."""
    q = _on_its_device(module, rows)
    with torch.no_grad():
        x, J = module.forward_and_jacobian(q)
        results = x, J, module.domain_distance(q)
    x, J, distance = [a.numpy(force=True) for a in results]
    return x, J, distance


def _on_its_device(module: ForwardModel, rows: NDArray) -> Tensor:
    state = next(iter(module.state_dict().values()))
    return torch.tensor(rows, device=state.device)


def _rounded(values: NDArray) -> Any:
    """Return values as lists, without the digits that depend on the machine."""
    flat = [float(f"{value:.10g}") for value in values.ravel().tolist()]
    return np.reshape(flat, values.shape).tolist()


def _numbers(stored: Stored, name: str, shape: tuple[int, ...]) -> NDArray:
    values = np.array(stored.value(name, list), dtype=np.float64)
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"`{name}` of the stored prediction must be finite and have shape {shape}")
    return values


def _check_finite(rows: NDArray, *results: NDArray) -> None:
    if not all(np.isfinite(a).all() for a in results):
        raise ValueError(
            f"the arrays do not give finite numbers: at q = {rows.tolist()} the model predicts "
            f"{results[0].tolist()}"
        )


def _check_equal(
    rows: NDArray, found: NDArray, wanted: NDArray, tolerance: NDArray, who: str
) -> None:
    if not (np.abs(found - wanted) <= tolerance).all():
        raise ValueError(
            f"at q = {rows.tolist()} the model predicts {found.tolist()}, but {who} "
            f"{wanted.tolist()}"
        )
