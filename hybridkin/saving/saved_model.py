"""Models on disk: one safetensors file of arrays with a JSON header, without pickle."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import sklearn
import torch

from hybridkin._core.arrays import as_path
from hybridkin._core.model import ForwardModel, as_forward_model
from hybridkin._core.stored import plain
from hybridkin._core.version import __version__
from hybridkin.hybrid.description import hybrid_of, restorer, stored_hybrid, training_of
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.elm_cv import ELMRegressorCV
from hybridkin.learning.hidden_layer import device_named
from hybridkin.saving._file import Header, model_path, packed, read, unpacked, write
from hybridkin.saving._prediction import check_prediction, prediction_of

_DAMAGE = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RuntimeError,
    TypeError,
    ValueError,
)
Model = ForwardModel | ELMRegressor | ELMRegressorCV | HybridForwardModel


def save_model(
    model: Model, path: str | Path, *, training: Mapping[str, object] | None = None
) -> None:
    """Write a chain or a fitted model to one file.

    Parameters
    ----------
    model : a chain, a fitted HybridForwardModel, ELMRegressor or ELMRegressorCV
        A chain is a ConstantCurvatureChain, ElasticTendonChain or RigidChain. The hybrid's
        mechanical model must be one of these or None, its error model an ELM, a LinearRegression, a
        KernelRidge with the kernel "rbf", or a name. For an ELMRegressorCV, the chosen ELMRegressor
        is stored.
    path : str or Path
        File to write, usually ``*.safetensors``. An existing file is replaced only when the new one
        is completely on the disk; its permissions are kept.
    training : mapping of str to numbers, strings or lists, optional
        Notes on the training, in addition to the model's own, for example
        ``{"log": "log.csv", "motions": 24, "held_out_rmse": 0.0031}``; see `model_header`.

    Raises
    ------
    TypeError
        For other models, because their parts could only be stored as code.
    ValueError
        For a model that does not predict finite numbers.

    Notes
    -----
    The file also holds what the model predicts at two rows. `load_model` compares it.

    A reader ignores entries of the header that it does not know. A file of another format version
    is not loaded: `load_model` raises an error that names the hybridkin version that wrote it.

    Equal models give equal files if the package versions and the date are the same. The environment
    variable ``SOURCE_DATE_EPOCH`` sets the date, in seconds since 1970. A save that is killed does
    not change the earlier file. If `path` is a symbolic link, its target is replaced.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from hybridkin import load_model, robots, save_model
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "trunk.safetensors"
    >>> save_model(robots.bionic_handling_assistant(), path)
    >>> load_model(path)
    ConstantCurvatureChain(extensible, 3 segments, 9 actuators, routing 'segment')
    """
    versions = {"hybridkin": __version__, "python": platform.python_version()}
    versions |= {"torch": str(torch.__version__), "numpy": np.__version__}
    versions["scikit-learn"] = sklearn.__version__
    now = float(os.environ.get("SOURCE_DATE_EPOCH", time.time()))
    created = datetime.fromtimestamp(now, timezone.utc).date().isoformat()
    header: Header = {"versions": versions, "created": created}
    results: Header = {}
    if isinstance(model, HybridForwardModel):
        _check_fitted_to_rows(model)
        stored = stored_hybrid(model)
        results = training_of(model)
        header["units"] = _units(model.module_, model.output)
        header["domain"] = _domain(model)
    elif isinstance(model, Model):
        stored = model.stored()
        header["units"] = _units(as_forward_model(model))
    else:
        raise TypeError(
            "`model` must be a ConstantCurvatureChain, an ElasticTendonChain, a RigidChain, a "
            f"fitted HybridForwardModel or a fitted ELM, got {type(model).__name__}."
        )
    if stored.kind == "elm_regressor":
        results = {"rows": stored.settings["n_samples_seen"]}
    entries, arrays = packed(stored)
    try:
        header["prediction"] = prediction_of(model)
    except ValueError as error:
        raise ValueError(f"`model` must predict finite numbers: {error}.") from error
    header["training"] = {**results, **_checked(training)}
    write(as_path(path), {**header, **entries}, arrays)


def load_model(path: str | Path, *, device: str | torch.device | None = None) -> Any:
    """Return the model that `save_model` wrote; no part of the file is run as code.

    Parameters
    ----------
    path : str or Path
        File to read, from any machine, or the folder of a fit, which has a ``model.safetensors``.
    device : str or torch.device, optional
        Device for the model's tensors, for example ``"cuda"``; it does not depend on the device of
        the saved model. Default: the CPU. Dtypes are those of the saved model.

    Returns
    -------
    ConstantCurvatureChain, ElasticTendonChain, RigidChain, HybridForwardModel or ELMRegressor
        Ready to predict, and to fit again with the saved settings. Random states that are not
        numbers become None.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not a saved model, is damaged, has another format version, or describes a
        model that a constructor refuses or that does not predict what it did.
    RuntimeError
        If this machine does not have the device.
    """
    path = model_path(path)
    at = device_named(device)
    header, arrays = read(path)
    try:
        stored = unpacked(header, arrays)
        if stored.kind == "hybrid":
            model = hybrid_of(stored, header.get("training"))
            _check_domain(model, header.get("domain"))
        elif stored.kind == "elm_regressor":
            model = ELMRegressor.from_stored(stored, restorer())
            model.device = None if device is None else str(at)
        else:
            model = restorer()(stored)
        check_prediction(model, header.get("prediction"))
    except _DAMAGE as error:
        reason = (str(error) or repr(error))[:800].rstrip(".")
        raise ValueError(f"{path} is damaged: {reason}.") from error
    module = model if isinstance(model, ForwardModel) else model.module_
    module.to(at)
    return model


def _check_fitted_to_rows(model: HybridForwardModel) -> None:
    """Raise if no rows were fitted to a model."""
    if "module_" in vars(model) and not np.isfinite(model.training_range_.low).all():
        raise ValueError("`model` was not fitted to rows; save its `mechanical_model`, the chain.")


def _checked(training: Mapping[str, object] | None) -> Header:
    try:
        notes = plain(dict(training or {}))
        json.dumps(notes)
    except (TypeError, ValueError) as error:
        need = "must map names to numbers, strings and lists of them"
        raise TypeError(f"`training` {need}, got {training!r:.200}.") from error
    return notes


def _units(model: ForwardModel, output: str = "position") -> dict[str, str | list[str]]:
    robot = model.robot
    if output == "position":
        return {"q": robot.unit_of_q, "x": robot.unit_of_x}
    return {"q": robot.unit_of_q, "x": [robot.unit_of_x] * 3 + ["rad"] * 3}


def _check_domain(model: HybridForwardModel, domain: object) -> None:
    """Raise a ValueError if the range of the training rows is not that of the header."""
    if not isinstance(domain, dict):
        return
    ranges = _domain(model)
    for name in ("q_low", "q_high"):
        found, wanted = ranges[name], domain.get(name)
        if not np.allclose(np.array(wanted, dtype=float), found, rtol=1e-9, atol=1e-300):
            raise ValueError(f"`{name}` of the domain is {wanted}, but {found} of the model")


def _domain(model: HybridForwardModel) -> Header:
    """Return the guard and the range of the training rows."""
    low, high = model.training_range_
    return {"guard": model.guard, "q_low": plain(low), "q_high": plain(high)}
