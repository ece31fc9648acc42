"""Models on disk: one safetensors file of arrays with a JSON header, and no pickle."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import LinearRegression
from sklearn.utils.validation import check_is_fitted
from torch import nn

from hybridkin._drift import Drift
from hybridkin._error_modules import AffineModule
from hybridkin._error_modules import error_module as make_error_module
from hybridkin._features import Features, HiddenFeatures, QuadraticFeatures
from hybridkin._hybrid_modules import HybridModule, SerialHybridModule
from hybridkin._pose_features import PoseFeatures
from hybridkin._pose_hybrid import PoseHybridModule
from hybridkin._radius import Radius
from hybridkin._readout import Statistics
from hybridkin._serial import SerialModule
from hybridkin._serial_fit import SerialFit
from hybridkin.chain import ConstantCurvatureChain
from hybridkin.elm import ELMRegressor
from hybridkin.elm_cv import ELMRegressorCV
from hybridkin.guards import BoxGuard, Guard, LeverageGuard, QuadraticReadout
from hybridkin.hybrid import HybridForwardModel
from hybridkin.rigid import RigidChain
from hybridkin.tendons import ElasticTendonChain

__all__ = ["load_model", "save_model"]

_FORMAT = "hybridkin-model"
_VERSION = 1
# Every kind of chain: its arrays, what its header says, and how its constructor calls the counts.
_CHAINS = {
    "chain": (
        ConstantCurvatureChain,
        ("radii", "angles", "lengths", "offsets", "rest_bends", "actuator_zeros", "base"),
        ("actuators_per_segment", "routing", "tip_at"),
        "n_actuators",
    ),
    "elastic_tendon_chain": (
        ElasticTendonChain,
        (
            *("radii", "angles", "lengths", "bending_stiffness", "axial_stiffness"),
            *("tendon_zeros", "rest_bends", "offsets", "base"),
        ),
        ("actuators_per_segment", "routing", "tip_at", "smoothing"),
        "n_tendons",
    ),
    "rigid": (
        RigidChain,
        ("origins", "axes", "q_min", "q_max", "tip", "tool", "base"),
        ("kinds", "names"),
        "",
    ),
}
_OF_ALL_ARCS = ("actuators_per_segment", "tip_at")
_DAMAGE = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
_OPTIONAL = {"chain": ("lengths", "rest_bends", "actuator_zeros")}
_ELM_ARRAYS = (
    *("input_weights_", "input_bias_", "input_center_", "input_scale_"),
    *("output_weights_", "intercept_", "noise_variance_"),
    *("leverage_center_", "leverage_factor_", "leverage_offset_"),
)
_ELM_SETTINGS = ("solver_", "n_samples_seen_", "n_features_in_", "_activation", "_y_ndim")

_RANGE = ("center", "scale")
_FEATURES: dict[str, Any] = {
    "linear": (Features, _RANGE),
    "quadratic": (QuadraticFeatures, _RANGE),
    "pose": (PoseFeatures, _RANGE),
    "hidden": (HiddenFeatures, (*_RANGE, "input_weights", "input_bias")),
}
_READOUT_ARRAYS = ("weights", "factor", "noise_variance")

Arrays = dict[str, NDArray]
Chain = ConstantCurvatureChain | ElasticTendonChain | RigidChain
_CLASSES = (ConstantCurvatureChain, ElasticTendonChain, RigidChain)
_ELMS = (ELMRegressor, ELMRegressorCV)
_NAMES = "a ConstantCurvatureChain, an ElasticTendonChain, a RigidChain"


def save_model(model: Any, path: str | Path) -> None:
    """Write a chain or a fitted hybrid model to one file.

    Parameters
    ----------
    model : a chain, a fitted HybridForwardModel, ELMRegressor or ELMRegressorCV
        A chain is a ConstantCurvatureChain, ElasticTendonChain or RigidChain. The hybrid's
        mechanical model must be one of these or None, its error model an ELM, a LinearRegression, a
        KernelRidge with the kernel "rbf", or a name. Of an ELMRegressorCV the chosen ELMRegressor
        is stored.
    path : str or Path
        File to write, usually ``*.safetensors``. It is replaced only once all is written.

    Raises
    ------
    TypeError
        For other models: their parts could only be stored as code.

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
    if isinstance(model, _CLASSES):
        header = _store_chain(model, arrays, "")
    elif isinstance(model, HybridForwardModel):
        header = _store_hybrid(model, arrays)
    elif isinstance(model, _ELMS):
        check_is_fitted(model)
        header = _store_elm(model, arrays, "")
    else:
        raise TypeError(
            f"`model` must be {_NAMES}, a fitted HybridForwardModel or a fitted ELM, got "
            f"{type(model).__name__}."
        )
    header = {"format": _FORMAT, "version": _VERSION, **header}
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"`path` must lie in a folder that exists, got {path}.")
    handle, staging = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
    os.close(handle)
    try:
        whole = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        save_file(whole, staging, metadata={"hybridkin": json.dumps(header)})
        os.replace(staging, path)
    finally:
        Path(staging).unlink(missing_ok=True)


def load_model(path: str | Path) -> Any:
    """Return the model that `save_model` wrote; nothing in the file is ever run as code.

    Parameters
    ----------
    path : str or Path
        File to read.

    Returns
    -------
    ConstantCurvatureChain, ElasticTendonChain, RigidChain, HybridForwardModel or ELMRegressor
        On the CPU, ready to predict.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not such a model, is damaged, or comes from a later version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"`path` must name a saved model, got {path}: no such file.")
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {})["hybridkin"])
            arrays = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not a model saved by hybridkin ({error}).") from error
    known = isinstance(header, dict) and header.get("format") == _FORMAT
    if not known or not isinstance(header.get("version"), int):
        raise ValueError(f"{path} is not a model saved by hybridkin: its header is another one.")
    if header["version"] > _VERSION:
        raise ValueError(
            f"{path} has format version {header['version']}, this hybridkin reads up to "
            f"{_VERSION}; install a newer one."
        )
    try:
        if header["kind"] in _CHAINS:
            return _restored_chain(header, arrays, "")
        if header["kind"] == "hybrid":
            return _restored_hybrid(header, arrays)
        if header["kind"] == "elm":
            elm = _restored_elm(header, arrays, "")
            elm.module_.forward_and_jacobian(torch.ones(1, elm.n_features_in_).double())
            return elm
    except _DAMAGE as error:
        raise ValueError(f"{path} is damaged: {error!r}.") from error
    raise ValueError(f"{path} holds a model of unknown kind {header['kind']!r}.")


def _store_chain(chain: Chain, arrays: Arrays, prefix: str) -> dict[str, Any]:
    kind = next(kind for kind, (cls, *_) in _CHAINS.items() if isinstance(chain, cls))
    _, tensors, settings, _ = _CHAINS[kind]
    for name in tensors:
        if getattr(chain, name) is not None:
            arrays[prefix + name] = getattr(chain, name).detach().cpu().numpy()
    return {"kind": kind, **{name: getattr(chain, name) for name in settings}}


def _restored_chain(header: dict[str, Any], arrays: Arrays, prefix: str) -> Chain:
    cls, tensors, settings, counts_name = _CHAINS[header["kind"]]
    optional = _OPTIONAL.get(header["kind"], ())
    needed = [name for name in tensors if name not in optional or prefix + name in arrays]
    stored: dict[str, Any] = {name: arrays[prefix + name] for name in needed}
    dtype = torch.from_numpy(stored["base"]).dtype
    if not dtype.is_floating_point:
        raise ValueError(f"`base` must be floating, got {dtype}")
    if cls is RigidChain:
        return RigidChain(**stored, kinds=header["kinds"], names=header["names"], dtype=dtype)
    counts = [int(n) for n in header["actuators_per_segment"]]
    stored["angles"] = np.split(stored["angles"], np.cumsum(counts)[:-1])
    options = {name: header[name] for name in settings if name not in _OF_ALL_ARCS}
    chain = cls(**stored, **options, **{counts_name: counts}, dtype=dtype)
    return chain.with_tip(header.get("tip_at", chain.n_segments))


def _store_hybrid(model: HybridForwardModel, arrays: Arrays) -> dict[str, Any]:
    if not hasattr(model, "module_"):
        raise TypeError("`model` must be fitted before it is saved; call `fit` first.")
    header: dict[str, Any] = {
        "kind": "hybrid",
        "coupling": model.coupling,
        "calibrate": model.calibrate if isinstance(model.calibrate, str) else [*model.calibrate],
        "guard": model.guard,
        "coverage": model.coverage,
        "output": model.output,
        "radius": None if model.radius_ is None else model.radius_._asdict(),
        "n_features_in": model.n_features_in_,
        "feature_names_in": [str(name) for name in getattr(model, "feature_names_in_", [])],
        "single_output": model._single_output,
        "mechanical": None,
        "nominal": None,
    }
    for key, part in (("mechanical", model.mechanical_model_), ("nominal", model.mechanical_model)):
        if part is not None:
            if not isinstance(part, _CLASSES):
                raise TypeError(
                    f"`model` must have {_NAMES} or None as `mechanical_model` to be saved, got "
                    f"{type(part).__name__}."
                )
            header[key] = _store_chain(part, arrays, f"{key}.")
    header["error"] = _store_error(model.error_model_, arrays)
    if isinstance(model.error_model_, SerialFit):
        name = model.error_model
        header["error_model"] = name if isinstance(name, str) else None
    header["fitted_guard"] = _store_guard(model.module_.guard, arrays)
    arrays |= {f"drift.{name}": array for name, array in model._drift._asdict().items()}
    if model.module_.drift is not None:
        arrays["drift.coef"] = model.module_.drift.coef.cpu().numpy()
        arrays["drift.bias"] = model.module_.drift.bias.cpu().numpy()
    return header


def _restored_hybrid(header: dict[str, Any], arrays: Arrays) -> HybridForwardModel:
    mechanical, nominal = (
        None if header[key] is None else _restored_chain(header[key], arrays, f"{key}.")
        for key in ("mechanical", "nominal")
    )
    readout = header["error"] is not None and header["error"]["kind"] == "readout"
    error, error_module = (None, None) if readout else _restored_error(header["error"], arrays)
    error_model: Any = "drop" if error is None else error
    if readout:
        error = _restored_readout(header["error"], arrays, mechanical)
        error_module, error_model = error.module, header["error_model"]
    names = header["calibrate"]
    model = HybridForwardModel(
        nominal,
        error_model,
        coupling=header["coupling"],
        calibrate=names if isinstance(names, str) else tuple(names),
        guard=header["guard"],
        coverage=header.get("coverage"),
        output=header.get("output", "position"),
    )
    radius = header.get("radius")
    model.radius_ = None if radius is None else Radius(**radius)
    model.mechanical_model_, model.error_model_ = mechanical, error
    model.calibration_ = None
    model.n_features_in_ = int(header["n_features_in"])
    if header["feature_names_in"]:
        model.feature_names_in_ = np.array(header["feature_names_in"], dtype=object)
    model._single_output = bool(header["single_output"])
    guard = _restored_guard(header["fitted_guard"], arrays, error_module)
    drift: AffineModule | None = None
    if "drift.coef" in arrays:
        drift = AffineModule(arrays["drift.coef"], arrays["drift.bias"])
    if "drift.gram" in arrays:  # files from before partial_fit have none
        model._drift = Drift(*(arrays[f"drift.{name}"] for name in Drift._fields))
    if isinstance(error_module, SerialModule):
        model.module_ = SerialHybridModule(error_module, guard, drift)
    else:
        build = PoseHybridModule if model.output == "pose" else HybridModule
        model.module_ = build(mechanical, error_module, guard, drift)
    with torch.no_grad():  # a file whose arrays do not fit together fails here, not in use
        one_row = torch.ones(1, model.n_features_in_, dtype=torch.float64)
        model._rows().forward_and_jacobian(one_row)
    return model


def _store_readout(fit: SerialFit, arrays: Arrays) -> dict[str, Any]:
    features = fit.module.features
    kind = next(kind for kind, (cls, _) in _FEATURES.items() if type(features) is cls)
    for name in _FEATURES[kind][1]:
        arrays[f"error.{name}"] = getattr(features, name).cpu().numpy()
    for name in _READOUT_ARRAYS:
        arrays[f"error.{name}"] = getattr(fit.module, name).cpu().numpy()
    arrays["error.residual"] = fit.residual
    header = {"kind": "readout", "features": kind, "place": fit.module.place}
    if isinstance(features, HiddenFeatures):
        header["activation"] = features.activation
    return {**header, "alphas": [*map(str, fit.alphas)], "gradient": fit.gradient}


def _restored_readout(header: Any, arrays: Arrays, mechanical: Any) -> SerialFit:
    cls, names = _FEATURES[header["features"]]
    tensors: dict[str, Any] = {
        name: torch.from_numpy(arrays[f"error.{name}"]) for name in (*names, *_READOUT_ARRAYS)
    }
    options: dict[str, Any] = {"chain": mechanical} if cls is PoseFeatures else {}
    if "activation" in header:
        options["activation"] = header["activation"]
    features = cls(**{name: tensors.pop(name) for name in names}, **options)
    module = SerialModule(mechanical, features, place=header["place"], **tensors)
    first, second = map(float, header["alphas"])
    residual = arrays["error.residual"]
    return SerialFit(module, (first, second), residual, {}, float(header["gradient"]))


def _store_elm(regressor: Any, arrays: Arrays, prefix: str) -> dict[str, Any]:
    elm = getattr(regressor, "best_estimator_", regressor)
    for name in _ELM_ARRAYS:
        arrays[prefix + name] = np.asarray(getattr(elm, name))
    arrays[prefix + "mean"], arrays[prefix + "scatter"] = elm._stats.mean, elm._stats.scatter
    params = elm.get_params()
    params["device"] = None
    if not isinstance(params["random_state"], (int, np.integer)):
        params["random_state"] = None
    return {
        "kind": "elm",
        "params": {name: _plain(value) for name, value in params.items()},
        "settings": {name: _plain(getattr(elm, name)) for name in _ELM_SETTINGS},
        "feature_names_in": [str(name) for name in getattr(regressor, "feature_names_in_", [])],
    }


def _restored_elm(header: Any, arrays: Arrays, prefix: str) -> ELMRegressor:
    elm = ELMRegressor(**header["params"])
    settings = {name: header["settings"][name] for name in _ELM_SETTINGS}
    stored = {name: arrays[prefix + name] for name in _ELM_ARRAYS}
    mean, scatter = arrays[prefix + "mean"], arrays[prefix + "scatter"]
    statistics = Statistics(float(settings["n_samples_seen_"]), mean, scatter)
    elm.__setstate__({**elm.get_params(), **stored, **settings, "_stats": statistics})
    if header.get("feature_names_in"):
        elm.feature_names_in_ = np.array(header["feature_names_in"], dtype=object)
    return elm


def _store_error(regressor: Any, arrays: Arrays) -> dict[str, Any] | None:
    if regressor is None:
        return None
    if isinstance(regressor, _ELMS):
        return _store_elm(regressor, arrays, "error.")
    if isinstance(regressor, SerialFit):
        return _store_readout(regressor, arrays)
    if type(regressor) is KernelRidge and regressor.kernel == "rbf":
        fitted: Any = regressor
        arrays["error.rows"], arrays["error.dual"] = fitted.X_fit_, fitted.dual_coef_
        return {"kind": "kernel", "gamma": _plain(fitted.gamma), "alpha": _plain(fitted.alpha)}
    if isinstance(regressor, LinearRegression):
        arrays["error.coef"] = np.asarray(regressor.coef_)
        arrays["error.intercept"] = np.asarray(regressor.intercept_)
        return {"kind": "linear"}
    raise TypeError(
        "`model` must have an ELM, a LinearRegression, a KernelRidge with the kernel 'rbf' or a "
        f"name as `error_model` to be saved, got {type(regressor).__name__}, which could only be "
        "stored as code."
    )


def _restored_error(header: Any, arrays: Arrays) -> tuple[Any, nn.Module | None]:
    if header is None:
        return None, None
    if header["kind"] == "elm":
        elm = _restored_elm(header, arrays, "error.")
        return elm, elm.module_
    if header["kind"] == "kernel":
        ridge: Any = KernelRidge(kernel="rbf", gamma=header["gamma"], alpha=header["alpha"])
        ridge.X_fit_, ridge.dual_coef_ = arrays["error.rows"], arrays["error.dual"]
        ridge.n_features_in_ = ridge.X_fit_.shape[1]
        return ridge, make_error_module(ridge, torch.from_numpy(ridge.X_fit_))
    if header["kind"] == "linear":
        linear = LinearRegression()
        linear.coef_, linear.intercept_ = arrays["error.coef"], arrays["error.intercept"]
        linear.n_features_in_ = linear.coef_.shape[-1]  # pyright: ignore[reportAttributeAccessIssue]
        return linear, AffineModule(linear.coef_, linear.intercept_)
    raise ValueError(f"unknown error model {header['kind']!r}")


def _store_guard(guard: Guard | None, arrays: Arrays) -> str | None:
    if guard is None:
        return None
    arrays["guard.largest"] = guard.largest.cpu().numpy()
    if isinstance(guard, BoxGuard):
        names, kind, module = ("low", "high"), "box", guard
    else:
        assert isinstance(guard, LeverageGuard)
        arrays["guard.limit"] = guard.limit.cpu().numpy()
        if not isinstance(guard.readout, QuadraticReadout):
            return "leverage of the error model"
        names, kind, module = ("center", "half_width", "factor"), "leverage", guard.readout
    for name in names:
        arrays[f"guard.{name}"] = getattr(module, name).cpu().numpy()
    return kind


def _restored_guard(kind: Any, arrays: Arrays, error_module: nn.Module | None) -> Guard | None:
    tensors = {
        name.removeprefix("guard."): torch.from_numpy(array)
        for name, array in arrays.items()
        if name.startswith("guard.")
    }
    if kind is None:
        return None
    # Files from before corrections had a largest length: none is too long.
    largest = tensors.pop("largest", torch.tensor(float("inf"), dtype=torch.float64))
    if kind == "box":
        return BoxGuard(tensors["low"], tensors["high"], largest)
    if kind == "leverage":
        limit = tensors.pop("limit")
        return LeverageGuard(QuadraticReadout(**tensors), limit, largest)
    if kind == "leverage of the error model" and error_module is not None:
        return LeverageGuard(error_module, tensors["limit"], largest)
    raise ValueError(f"unknown guard {kind!r}")


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
