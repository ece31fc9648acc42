"""Models on disk: one safetensors file of arrays with a JSON header, and no pickle."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import sklearn
import torch
from sklearn.utils.validation import check_is_fitted

from hybridkin import __version__
from hybridkin.chains.play import PlayOperator
from hybridkin.chains.rigid import RigidChain
from hybridkin.hybrid._couplings import Blend, blended
from hybridkin.hybrid._drift import Drift
from hybridkin.hybrid._guards import BoxGuard, LeverageGuard, QuadraticReadout
from hybridkin.hybrid._module import HybridModule, SerialHybridModule
from hybridkin.hybrid._pose import PoseHybridModule
from hybridkin.hybrid._radius import Radius
from hybridkin.hybrid._readout_fit import SerialFit
from hybridkin.hybrid._serial import SerialModule
from hybridkin.hybrid._settings import check_settings
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.hidden_layer import device_named
from hybridkin.learning.regressor_modules import AffineModule
from hybridkin.saving._file import Arrays, Part, plain, read, read_header, write
from hybridkin.saving._parts import (
    CHAIN_KINDS,
    CHAINS,
    ELMS,
    Chain,
    feature_names,
    restored_chain,
    restored_elm,
    restored_error,
    restored_guard,
    restored_setting,
    store_chain,
    store_elm,
    store_error,
    store_guard,
    store_setting,
)

__all__ = ["load_model", "model_header", "save_model"]

_DAMAGE = (
    *(ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError),
    *(AssertionError, TypeError, ValueError),
)
_NAMES = "a ConstantCurvatureChain, an ElasticTendonChain, a RigidChain"


def save_model(model: Any, path: str | Path, *, training: Mapping[str, Any] | None = None) -> None:
    """Write a chain or a fitted model to one file.

    Parameters
    ----------
    model : a chain, a fitted HybridForwardModel, ELMRegressor or ELMRegressorCV
        A chain is a ConstantCurvatureChain, ElasticTendonChain or RigidChain. The hybrid's
        mechanical model must be one of these or None, its error model an ELM, a LinearRegression, a
        KernelRidge with the kernel "rbf", or a name. Of an ELMRegressorCV the chosen ELMRegressor
        is stored.
    path : str or Path
        File to write, usually ``*.safetensors``. It is replaced only once all is written.
    training : mapping of str to numbers, strings or lists, optional
        What people shall read about the training besides what the model knows of it, for example
        ``{"log": "log.csv", "motions": 24, "held_out_rmse": 0.0031}``; see `model_header`.

    Raises
    ------
    TypeError
        For other models: their parts could only be stored as code.

    Notes
    -----
    Files of every format version that was ever released load. Of a file written by a later
    hybridkin, entries of the header that are not known are ignored, unless the file says that it
    ``requires`` them; then, and for a later format version, `load_model` refuses it and names the
    hybridkin that wrote it.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from hybridkin import load_model, robots, save_model
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "trunk.safetensors"
    >>> save_model(robots.bionic_handling_assistant(), path)
    >>> load_model(path)
    ConstantCurvatureChain(extensible, 3 segments, 9 actuators, routing 'segment')
    """
    arrays: Arrays = {}
    if isinstance(model, CHAINS):
        header = {**store_chain(model, arrays, ""), "units": _units(model)}
    elif isinstance(model, HybridForwardModel):
        header = _store_hybrid(model, arrays)
    elif isinstance(model, ELMS):
        check_is_fitted(model)
        header = store_elm(model, arrays, "")
        header["training"] = {"rows": header["settings"]["n_samples_seen_"]}
    else:
        raise TypeError(
            f"`model` must be {_NAMES}, a fitted HybridForwardModel or a fitted ELM, got "
            f"{type(model).__name__}."
        )
    header["training"] = {**header.get("training", {}), **_checked(training)}
    write(Path(path), {"requires": [], **_origin(), **header}, arrays)


def load_model(path: str | Path, *, device: str | torch.device | None = None) -> Any:
    """Return the model that `save_model` wrote; nothing in the file is ever run as code.

    Parameters
    ----------
    path : str or Path
        File to read, from any machine.
    device : str or torch.device, optional
        Where the model's tensors shall be, ``"cuda"`` for example, whatever device it was saved
        from. Default: the CPU. Dtypes are those that were saved.

    Returns
    -------
    ConstantCurvatureChain, ElasticTendonChain, RigidChain, HybridForwardModel or ELMRegressor
        Ready to predict, and with the settings of the saved one to fit again; random states that
        are not numbers come back as None.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not such a model, is damaged, or comes from a later version.
    RuntimeError
        If there is no such device here.
    """
    path = Path(path)
    at = device_named(device)
    header, arrays = read(path)
    try:
        part = Part(header, arrays)
        kind = part.value("kind", str)
        if kind in CHAIN_KINDS:
            return restored_chain(part).to(at)
        if kind == "hybrid":
            model = _restored_hybrid(part)
            model.module_ = model.module_.to(at)
            return model
        if kind == "elm":
            elm = restored_elm(part)
            elm.device = None if device is None else str(at)
            elm.module_ = elm.module_.to(at)
            return elm
    except _DAMAGE as error:
        raise ValueError(f"{path} is damaged: {error or repr(error)}.") from error
    raise ValueError(f"{path} holds a model of unknown kind {kind[:60]!r}.")


def model_header(path: str | Path) -> dict[str, Any]:
    """Return what the header of a saved model says, without loading the model.

    Parameters
    ----------
    path : str or Path
        File that `save_model` wrote.

    Returns
    -------
    dict
        Of JSON values: ``kind``; ``created`` (date) and ``versions`` of what wrote it; ``units`` of
        q and x; ``training`` (``rows``, errors [m], of error_model="auto" all candidates, and what
        `save_model` was told); ``domain`` (``q_low`` and ``q_high`` of the training rows, null for
        a column that did not vary, and the ``guard``); geometry and settings. Files of format
        version 1 have the last two alone.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not such a model, or comes from a later version.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from hybridkin import robots, save_model
    >>> from hybridkin.saving.saved_model import model_header
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "trunk.safetensors"
    >>> save_model(robots.bionic_handling_assistant(), path)
    >>> model_header(path)["units"]
    {'q': 'm', 'x': 'm'}
    """
    return read_header(Path(path))


def _origin() -> dict[str, Any]:
    versions = {
        "hybridkin": __version__,
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "numpy": np.__version__,
        "scikit-learn": sklearn.__version__,
    }
    return {"versions": versions, "created": datetime.now(timezone.utc).date().isoformat()}


def _checked(training: Mapping[str, Any] | None) -> dict[str, Any]:
    said = plain(dict(training or {}))
    try:
        json.dumps(said)
    except TypeError as error:
        raise TypeError(
            f"`training` must hold numbers, strings and lists of them, got {training!r}."
        ) from error
    return said


def _units(chain: Chain | None, output: str = "position") -> dict[str, Any]:
    if isinstance(chain, RigidChain):
        q: Any = ["m" if kind == "prismatic" else "rad" for kind in chain.kinds]
    else:
        q = "as in training" if chain is None else "m"
    if output == "pose":
        return {"q": q, "x": ["m"] * 3 + ["rad"] * 3}
    return {"q": q, "x": "as in training" if chain is None else "m"}


def _store_hybrid(model: HybridForwardModel, arrays: Arrays) -> dict[str, Any]:
    if not hasattr(model, "module_"):
        raise TypeError("`model` must be fitted before it is saved; call `fit` first.")
    seed = model.random_state
    header: dict[str, Any] = {
        "kind": "hybrid",
        "coupling": model.coupling,
        "calibrate": model.calibrate if isinstance(model.calibrate, str) else [*model.calibrate],
        "guard": model.guard,
        "coverage": model.coverage,
        "output": model.output,
        "play": plain(model.play),
        "random_state": int(seed) if isinstance(seed, (int, np.integer)) else None,
        "error_model": store_setting(model.error_model),
        "radius": None if model.radius_ is None else plain(model.radius_._asdict()),
        "n_features_in": model.n_features_in_,
        "feature_names_in": [str(name) for name in getattr(model, "feature_names_in_", [])],
        "single_output": model._single_output,
        "mechanical": None,
        "nominal": None,
        "units": _units(model.mechanical_model_, model.output),
        "training": _training(model),
    }
    for key, part in (("mechanical", model.mechanical_model_), ("nominal", model.mechanical_model)):
        if part is not None:
            if not isinstance(part, CHAINS):
                raise TypeError(
                    f"`model` must have {_NAMES} or None as `mechanical_model` to be saved, got "
                    f"{type(part).__name__}."
                )
            header[key] = store_chain(part, arrays, f"{key}.")
    error = model.error_model_
    if isinstance(error, Blend):
        fits = zip(error.weights, error.error_models, model.module_.parts, strict=True)
        header["blend"] = [
            {"weight": weight, **_store_fit(one, module, arrays, f"blend.{k}.")}
            for k, (weight, one, module) in enumerate(fits)
        ]
    else:
        header |= _store_fit(error, model.module_, arrays, "")
    header["domain"] = {"guard": model.guard}
    if model.play_ is not None:
        arrays["play.width"] = model.play_.width
    if hasattr(model, "_drift"):
        arrays |= {f"drift.{name}": array for name, array in model._drift._asdict().items()}
        center, scale = model._drift.center, model._drift.scale
        varied = scale != 1.0  # a column without a range counts as one of [-1, 1]
        for name, bound in (("q_low", center - scale), ("q_high", center + scale)):
            header["domain"][name] = plain(np.where(varied, bound, np.nan))
    if model.module_.drift is not None:
        arrays["drift.coef"] = model.module_.drift.coef.cpu().numpy()
        arrays["drift.bias"] = model.module_.drift.bias.cpu().numpy()
    return header


def _store_fit(error: Any, module: HybridModule, arrays: Arrays, prefix: str) -> dict[str, Any]:
    """Return the header of an error model and of the guard that weighs it, and add their arrays."""
    return {
        "error": store_error(error, arrays, f"{prefix}error."),
        "fitted_guard": store_guard(module.guard, arrays, f"{prefix}guard."),
    }


def _training(model: HybridForwardModel) -> dict[str, Any]:
    """Return what a fitted hybrid knows about its training, errors in metres."""
    said: dict[str, Any] = {}
    error: Any = model.error_model_
    if isinstance(error, Blend):
        error = error.error_models[0]
    if isinstance(error, SerialFit):
        squares = np.square(error.residual).sum(axis=1)
        said["rows"] = int(np.isfinite(squares).sum())
        said["left_out_rmse"] = float(np.sqrt(np.nanmean(squares)))
    elif isinstance(error, ELMS):
        network: Any = getattr(error, "best_estimator_", error)
        said["rows"] = network.n_samples_seen_
    elif hasattr(error, "X_fit_"):
        said["rows"] = len(error.X_fit_)
    elif model.radius_ is not None:
        said["rows"] = model.radius_.n_rows
    if model.calibration_ is not None:
        found = model.calibration_
        said["calibration"] = {
            "rmse": found.rmse,
            "held_out_rmse": found.cv_rmse,
            "converged": found.converged,
        }
    if getattr(model, "cv_results_", None) is not None:
        said["cv_results"] = model.cv_results_
    return plain(said)


def _restored_hybrid(part: Part) -> HybridForwardModel:
    n = part.value("n_features_in", int)
    mechanical, nominal = (
        None if child is None else restored_chain(child)
        for child in (part.child("mechanical"), part.child("nominal"))
    )
    for chain in (mechanical, nominal):
        if chain is not None and chain.n_actuators != n:
            raise ValueError(f"a chain of {chain.n_actuators} actuators cannot take {n}")
    entries = part.value("blend", (list, None), None)
    blend = [Part(one, part.arrays, f"blend.{k}.") for k, one in enumerate(entries or [])]
    output = part.value("output", str, "position")
    fits = [_restored_fit(one, mechanical, n, output) for one in blend or [part]]
    error, module = blended([one.value("weight", float) for one in blend], fits)
    names = part.header.get("calibrate")
    model = HybridForwardModel(
        nominal,
        restored_setting(part, error),
        coupling=part.value("coupling", str),
        calibrate=names if isinstance(names, str) else tuple(part.names("calibrate")),
        guard=part.value("guard", (str, None)),
        coverage=part.value("coverage", (float, None), None),
        output=output,
        play=part.value("play", (str, float, list, None), None),
        random_state=part.value("random_state", (int, None), None),
    )
    check_settings(model)
    model.mechanical_model_, model.error_model_ = mechanical, error
    model.calibration_, model.radius_ = None, _restored_radius(part)
    model.cv_results_ = _restored_results(part)
    model.n_features_in_ = n
    if part.header.get("feature_names_in"):
        model.feature_names_in_ = feature_names(part, n)
    model._single_output = part.value("single_output", bool)
    own = Part(part.header, part.arrays, "play.")
    model.play_, model._play_state = None, None
    if "width" in own:
        width = own.array("width", (n,) if own.arrays["play.width"].ndim else ())
        model.play_ = PlayOperator(width)
    model.module_ = module
    with torch.no_grad():  # a file whose arrays do not fit together fails here, not in use
        x = model._rows().forward_and_jacobian(torch.ones(1, n, dtype=torch.float64))[0]
    if model._single_output and x.shape[1] != 1:
        raise ValueError(f"`single_output` must be false with {x.shape[1]} outputs")
    drift = _restored_drift(part, model, n, x.shape[1])
    if drift is not None:
        model.module_ = model.module_.with_drift(drift)
    return model


def _restored_fit(part: Part, mechanical: Any, n: int, output: str) -> tuple[Any, Any]:
    """Return the error model of a part and the hybrid of it, as `_store_fit` stored them."""
    error, module = restored_error(part.child("error"), mechanical, n)
    own = Part(part.header, part.arrays, f"{part.prefix}guard.")
    guard = restored_guard(part.value("fitted_guard", (str, None)), own, module, n)
    if isinstance(module, SerialModule):
        return error, SerialHybridModule(module, guard)
    build = PoseHybridModule if output == "pose" else HybridModule
    return error, build(mechanical, module, guard)


def _restored_drift(part: Part, model: HybridForwardModel, n: int, m: int) -> AffineModule | None:
    """Set the statistics that `partial_fit` goes on from, and return the correction so far."""
    own = Part(part.header, part.arrays, "drift.")
    if "gram" in own:
        shapes = ((n,), (n,), (n + 1, n + 1), (n + 1, m))
        found = (own.array(name, s) for name, s in zip(Drift._fields, shapes, strict=True))
        model._drift = Drift(*found)
    elif part.value("version", int) == 1:  # from before `partial_fit`
        low, high = _range(model)
        if low is not None:
            model._drift = Drift.of_range(low, high, m)
    if "coef" not in own:
        return None
    return AffineModule(own.array("coef", (m, n)), own.array("bias", (m,)))


def _range(model: HybridForwardModel) -> tuple[Any, Any]:
    """Return the range of the training rows as far as guard or error model tell it."""
    guard, error = model.module_.guard, model.error_model_
    if isinstance(guard, BoxGuard):
        return guard.low.numpy(), guard.high.numpy()
    if isinstance(guard, LeverageGuard) and isinstance(guard.readout, QuadraticReadout):
        center, scale = guard.readout.center.numpy(), guard.readout.half_width.numpy()
    elif isinstance(error, ELMRegressor):
        center, scale = error.input_center_, error.input_scale_
    else:
        return None, None
    return center - scale, center + scale


def _restored_radius(part: Part) -> Radius | None:
    own = part.child("radius") if part.header.get("radius") is not None else None
    if own is None:
        return None
    inside, outside, coverage = (own.value(key, float) for key in Radius._fields[:3])
    return Radius(inside, outside, coverage, own.value("n_rows", int))


def _restored_results(part: Part) -> dict[str, Any] | None:
    """Return the scores of error_model="auto", numbers as arrays again."""
    results = part.value("training", dict, {}).get("cv_results")
    if not isinstance(results, dict):
        return None
    return {key: _numbers(value) for key, value in results.items()}


def _numbers(value: Any) -> Any:
    """Return a list of numbers, or of such lists, as an array; anything else as it is."""
    if not isinstance(value, list):
        return value
    try:
        array = np.array(value)
        array = array.astype(np.float64) if array.dtype == object else array  # null is NaN
    except (OverflowError, TypeError, ValueError):
        return value
    return array if array.dtype.kind in "fi" else value
