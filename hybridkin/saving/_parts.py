"""What saved models are made of, as headers and arrays: chains, error models and guards."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import torch
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import LinearRegression
from torch import nn

from hybridkin.chains.constant_curvature import ConstantCurvatureChain
from hybridkin.chains.elastic_tendons import ElasticTendonChain
from hybridkin.chains.rigid import RigidChain
from hybridkin.hybrid._couplings import Readout
from hybridkin.hybrid._features import Features, HiddenFeatures, QuadraticFeatures
from hybridkin.hybrid._guards import BoxGuard, Guard, LeverageGuard, QuadraticReadout
from hybridkin.hybrid._pose_features import PoseFeatures
from hybridkin.hybrid._readout_fit import SerialFit
from hybridkin.hybrid._serial import SerialModule
from hybridkin.learning._ridge import Statistics
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.elm_cv import ELMRegressorCV
from hybridkin.learning.regressor_modules import AffineModule
from hybridkin.learning.regressor_modules import error_module as make_error_module
from hybridkin.saving._file import Arrays, Part, plain

Chain = ConstantCurvatureChain | ElasticTendonChain | RigidChain
CHAINS = (ConstantCurvatureChain, ElasticTendonChain, RigidChain)
ELMS = (ELMRegressor, ELMRegressorCV)

# Every kind of chain: its arrays, what its header says, and how its constructor calls the counts.
_CHAINS = {
    "chain": (
        ConstantCurvatureChain,
        ("radii", "angles", "lengths", "offsets", "rest_bends", "actuator_zeros", "base"),
        ("routing",),
        "n_actuators",
    ),
    "elastic_tendon_chain": (
        ElasticTendonChain,
        (
            *("radii", "angles", "lengths", "bending_stiffness", "axial_stiffness"),
            *("tendon_zeros", "rest_bends", "offsets", "base"),
        ),
        ("routing",),
        "n_tendons",
    ),
    "rigid": (
        RigidChain,
        ("origins", "axes", "q_min", "q_max", "tip", "tool", "base"),
        ("kinds", "names"),
        "",
    ),
}
CHAIN_KINDS = tuple(_CHAINS)
_OF_ARCS = ("actuators_per_segment", "tip_at")
_OPTIONAL = {"chain": ("lengths", "rest_bends", "actuator_zeros")}
_UNBOUNDED = ("q_min", "q_max")
_TYPES: dict[str, Any] = {"routing": str}
_FEATURES = {
    "linear": Features,
    "quadratic": QuadraticFeatures,
    "pose": PoseFeatures,
    "hidden": HiddenFeatures,
}
_FEATURE_ARRAYS = ("center", "scale", "input_weights", "input_bias")
_ELM_ARRAYS = (
    *("input_weights_", "input_bias_", "input_center_", "input_scale_"),
    *("output_weights_", "intercept_", "noise_variance_"),
    *("leverage_center_", "leverage_factor_", "leverage_offset_"),
)
_ELM_SETTINGS = {
    "solver_": str,
    "n_samples_seen_": float,
    "n_features_in_": int,
    "_activation": str,
    "_y_ndim": int,
}
# Error models that a HybridForwardModel may be given, whose parameters JSON can say.
_SETTINGS: dict[str, Any] = {
    "elm": ELMRegressor,
    "elm_cv": ELMRegressorCV,
    "kernel": KernelRidge,
    "linear": LinearRegression,
}


def store_chain(chain: Chain, arrays: Arrays, prefix: str) -> dict[str, Any]:
    """Return the header of a chain, and add its arrays."""
    kind = next(kind for kind, (cls, *_) in _CHAINS.items() if isinstance(chain, cls))
    cls, tensors, settings, _ = _CHAINS[kind]
    for name in tensors:
        if getattr(chain, name) is not None:
            arrays[prefix + name] = getattr(chain, name).detach().cpu().numpy()
    settings = settings if cls is RigidChain else (*settings, *_OF_ARCS)
    return {"kind": kind, **{name: plain(getattr(chain, name)) for name in settings}}


def restored_chain(part: Part) -> Chain:
    """Return the chain of a part."""
    kind = part.value("kind", str)
    if kind not in _CHAINS:
        raise ValueError(f"unknown chain {kind!r}")
    cls, tensors, settings, counts_name = _CHAINS[kind]
    optional = _OPTIONAL.get(kind, ())
    stored: dict[str, Any] = {
        name: part.array(name, infinite=name in _UNBOUNDED)
        for name in tensors
        if name not in optional or name in part
    }
    dtype = torch.from_numpy(stored["base"]).dtype
    if cls is RigidChain:
        return RigidChain(
            **stored, kinds=part.names("kinds"), names=part.names("names"), dtype=dtype
        )
    counts = part.value("actuators_per_segment", list)
    if not all(type(count) is int for count in counts) or sum(counts) != len(stored["angles"]):
        raise ValueError(f"`actuators_per_segment` must sum up to the angles, got {counts!r:.60}")
    stored["angles"] = np.split(stored["angles"], np.cumsum(counts)[:-1])
    options = {name: part.value(name, _TYPES[name]) for name in settings}
    if part.value("smoothing", float, 0.0) != 0.0:
        raise ValueError("smoothed tendons are no longer supported")
    chain = cls(**stored, **options, **{counts_name: counts}, dtype=dtype)
    return chain.with_tip(part.value("tip_at", float, float(chain.n_segments)))


def store_elm(regressor: Any, arrays: Arrays, prefix: str) -> dict[str, Any]:
    """Return the header of a fitted network, of an ELMRegressorCV the chosen one."""
    elm = getattr(regressor, "best_estimator_", regressor)
    for name in _ELM_ARRAYS:
        arrays[prefix + name] = np.asarray(getattr(elm, name))
    arrays[prefix + "mean"], arrays[prefix + "scatter"] = elm._stats.mean, elm._stats.scatter
    settings = {name: kind(getattr(elm, name)) for name, kind in _ELM_SETTINGS.items()}
    return {
        "kind": "elm",
        "params": _params(elm),
        "settings": settings,
        "feature_names_in": [str(name) for name in getattr(regressor, "feature_names_in_", [])],
    }


def restored_elm(part: Part) -> ELMRegressor:
    """Return the fitted network of a part."""
    elm = _made(ELMRegressor, part.value("params", dict))
    said = part.child("settings", "settings")
    assert said is not None
    settings = {name: said.value(name, kind) for name, kind in _ELM_SETTINGS.items()}
    n, shape = settings["n_features_in_"], part.array("output_weights_", (None, None)).shape
    n_hidden, n_both = len(part.array("input_bias_", (None,))), sum(shape)
    if shape[0] not in (n_hidden, n_hidden + n):
        raise ValueError(f"a network of {n_hidden} neurons cannot have {shape[0]} features")
    square = (shape[0], shape[0])
    shapes = ((n_hidden, n), (n_hidden,), (n,), (n,), shape, (shape[1],), (shape[1],))
    shapes = (*shapes, (shape[0],), square, ())
    stored = {
        name: part.array(name, wanted, nan=name == "noise_variance_")
        for name, wanted in zip(_ELM_ARRAYS, shapes, strict=True)
    }
    if settings["_y_ndim"] not in (1, 2):
        raise ValueError(f"`_y_ndim` must be 1 or 2, got {settings['_y_ndim']}")
    mean, scatter = part.array("mean", (n_both,)), part.array("scatter", (n_both, n_both))
    statistics = Statistics(settings["n_samples_seen_"], mean, scatter)
    elm.__setstate__({**elm.get_params(), **stored, **settings, "_stats": statistics})
    if part.header.get("feature_names_in"):
        elm.feature_names_in_ = feature_names(part, n)
    elm.module_.forward_and_jacobian(torch.ones(1, n, dtype=torch.float64))
    return elm


def feature_names(part: Part, n: int) -> Any:
    """Return the names of n columns as scikit-learn keeps them."""
    names = part.names("feature_names_in")
    if len(names) != n:
        raise ValueError(f"`feature_names_in` must be {n} names, got {len(names)}")
    return np.array(names, dtype=object)


def store_error(regressor: Any, arrays: Arrays, prefix: str) -> dict[str, Any] | None:
    """Return the header of a fitted error model, and add its arrays."""
    if regressor is None:
        return None
    if isinstance(regressor, ELMS):
        return store_elm(regressor, arrays, prefix)
    if isinstance(regressor, SerialFit):
        return _store_readout(regressor, arrays, prefix)
    if type(regressor) is KernelRidge and regressor.kernel == "rbf":
        fitted: Any = regressor
        arrays[prefix + "rows"], arrays[prefix + "dual"] = fitted.X_fit_, fitted.dual_coef_
        return {"kind": "kernel", "gamma": plain(fitted.gamma), "alpha": plain(fitted.alpha)}
    if isinstance(regressor, LinearRegression):
        arrays[prefix + "coef"] = np.asarray(regressor.coef_)
        arrays[prefix + "intercept"] = np.asarray(regressor.intercept_)
        return {"kind": "linear"}
    raise TypeError(
        "`model` must have an ELM, a LinearRegression, a KernelRidge with the kernel 'rbf' or a "
        f"name as `error_model` to be saved, got {type(regressor).__name__}, which could only be "
        "stored as code."
    )


def restored_error(
    part: Part | None, mechanical: nn.Module | None, n: int
) -> tuple[Any, nn.Module | None]:
    """Return the fitted error model of a part, for n actuators, and its torch module."""
    if part is None:
        return None, None
    kind = part.value("kind", str)
    if kind == "readout":
        fit = _restored_readout(part, mechanical, n)
        return fit, fit.module
    if kind == "elm":
        elm = restored_elm(part)
        if elm.n_features_in_ != n:
            raise ValueError(f"the error model must have {n} inputs, got {elm.n_features_in_}")
        return elm, elm.module_
    if kind == "kernel":
        rows = part.array("rows", (None, n))
        dual = part.array("dual")
        if dual.ndim not in (1, 2) or len(dual) != len(rows):
            raise ValueError(f"'dual' must have {len(rows)} rows, got shape {dual.shape}")
        gamma, alpha = part.value("gamma", (float, None)), part.value("alpha", (float, list))
        ridge = _made(KernelRidge, {"kernel": "rbf", "gamma": gamma, "alpha": alpha})
        ridge.X_fit_, ridge.dual_coef_, ridge.n_features_in_ = rows, dual, n
        return ridge, make_error_module(ridge, torch.from_numpy(rows))
    if kind == "linear":
        linear: Any = LinearRegression()
        several = part.array("coef").ndim == 2
        linear.coef_ = part.array("coef", (None, n) if several else (n,))
        linear.intercept_ = part.array("intercept", (len(linear.coef_),) if several else ())
        linear.n_features_in_ = n
        return linear, AffineModule(linear.coef_, linear.intercept_)
    raise ValueError(f"unknown error model {kind!r}")


def _store_readout(fit: SerialFit, arrays: Arrays, prefix: str) -> dict[str, Any]:
    features = fit.module.features
    kind = next(kind for kind, cls in _FEATURES.items() if type(features) is cls)
    for name in _FEATURE_ARRAYS[: 4 if kind == "hidden" else 2]:
        arrays[prefix + name] = getattr(features, name).cpu().numpy()
    for name in ("weights", "factor", "noise_variance"):
        arrays[prefix + name] = getattr(fit.module, name).cpu().numpy()
    arrays[prefix + "residual"] = fit.residual
    header = {"kind": "readout", "features": kind, "place": fit.module.place}
    if isinstance(features, HiddenFeatures):
        header["activation"] = features.activation
    scores = [[*map(str, alphas), score] for alphas, score in fit.scores.items()]
    alphas = [*map(str, fit.alphas)]  # infinity is no number in JSON
    header |= {"alphas": alphas, "noise_ratio": str(fit.noise_ratio), "scores": plain(scores)}
    return {**header, "gradient": fit.gradient}


def _restored_readout(part: Part, mechanical: Any, n: int) -> SerialFit:
    kind = part.value("features", str)
    if kind not in _FEATURES:
        raise ValueError(f"unknown features {kind!r}")
    if mechanical is None:
        raise ValueError("a readout needs a mechanical model")
    options: dict[str, Any] = {"chain": mechanical} if kind == "pose" else {}
    if kind == "hidden":
        options["input_bias"] = part.tensor("input_bias", (None,))
        options["input_weights"] = part.tensor("input_weights", (len(options["input_bias"]), n))
        options["activation"] = part.value("activation", str)
    features = _FEATURES[kind](part.tensor("center", (n,)), part.tensor("scale", (n,)), **options)
    weights = part.tensor("weights", (None, None))
    module = SerialModule(
        mechanical,
        features,
        weights,
        place=part.value("place", str),
        factor=part.tensor("factor", (weights.numel(), None)),
        noise_variance=part.tensor("noise_variance", (), nan=True),
    )
    first, second = map(float, part.names("alphas"))
    scores = {(float(a), float(b)): float(score) for a, b, score in part.value("scores", list, [])}
    residual = part.array("residual", (None, None), nan=True)
    gradient = part.value("gradient", float)
    ratio = float(part.value("noise_ratio", str, "inf"))
    return SerialFit(module, (first, second), residual, scores, gradient, ratio)


def store_setting(error_model: Any) -> Any:
    """Return what JSON can say of an `error_model` as it was asked for, for `fit` to go by."""
    if error_model is None or isinstance(error_model, str):
        return error_model
    if isinstance(error_model, Readout):
        alphas = None if error_model.alphas is None else [*map(str, error_model.alphas)]
        return {"kind": "readout", "name": error_model.kind, "alphas": alphas}
    kind = next((kind for kind, cls in _SETTINGS.items() if type(error_model) is cls), None)
    if kind is not None:
        try:
            params = _params(error_model)
            json.dumps(params, allow_nan=False)
            return {"kind": kind, "params": params}
        except (TypeError, ValueError):
            pass  # a splitter or a function, for example: what it led to is stored
    return {"kind": "fitted"}


def restored_setting(part: Part, error: Any) -> Any:
    """Return the `error_model` to fit again, from a hybrid's part and its fitted error model."""
    said = part.value("error_model", (str, dict, None), None)
    if not isinstance(said, dict):
        # Version 1 has names alone, and those only of readouts.
        named = said is not None or part.value("version", int) > 1
        return said if named else _unfitted(error)
    setting = Part(said, part.arrays)
    kind = setting.value("kind", str)
    if kind == "readout":
        alphas = setting.value("alphas", (list, None))
        if alphas is not None:
            first, second = map(float, setting.names("alphas"))
            alphas = first, second
        return Readout(setting.value("name", str), alphas)
    if kind == "fitted":
        return _unfitted(error)
    if kind not in _SETTINGS:
        raise ValueError(f"unknown error model {kind!r}")
    return _made(_SETTINGS[kind], setting.value("params", dict))


def _unfitted(error: Any) -> Any:
    """Return what to fit again where only a fitted error model is known."""
    if error is None:
        return "drop"
    if not isinstance(error, SerialFit):
        return error
    features, (alpha, other) = error.module.features, error.alphas
    if not isinstance(features, HiddenFeatures):
        return next(kind for kind, cls in _FEATURES.items() if type(features) is cls)
    size, activation = len(features.input_bias), features.activation
    if alpha == other and np.isfinite(alpha):
        return ELMRegressor(size, alpha, activation=activation)
    return ELMRegressorCV(size, activation=activation)  # its penalties were chosen apart


def _params(estimator: Any) -> dict[str, Any]:
    params = estimator.get_params(deep=False)
    params |= {"device": None} if "device" in params else {}
    if not isinstance(params.get("random_state"), (int, np.integer, type(None))):
        params["random_state"] = None
    return {
        name: value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
        for name, value in params.items()
    }


def _made(cls: Any, params: dict[str, Any]) -> Any:
    """Return an estimator with those of the parameters that it has, checked."""
    defaults = cls().get_params(deep=False)
    known = {
        name: tuple(value) if isinstance(defaults[name], tuple) else value
        for name, value in params.items()
        if name in defaults
    }
    estimator = cls(**known)
    estimator._validate_params()
    return estimator


def store_guard(guard: Guard | None, arrays: Arrays, prefix: str) -> str | None:
    """Return the kind of a guard, and add its arrays."""
    if guard is None:
        return None
    arrays[prefix + "largest"] = guard.largest.cpu().numpy()
    if isinstance(guard, BoxGuard):
        names, kind, module = ("low", "high"), "box", guard
    else:
        assert isinstance(guard, LeverageGuard)
        arrays[prefix + "limit"] = guard.limit.cpu().numpy()
        if not isinstance(guard.readout, QuadraticReadout):
            return "leverage of the error model"
        names, kind, module = ("center", "half_width", "factor"), "leverage", guard.readout
    for name in names:
        arrays[prefix + name] = getattr(module, name).cpu().numpy()
    return kind


def restored_guard(
    kind: str | None, part: Part, error_module: nn.Module | None, n: int
) -> Guard | None:
    """Return the guard of a part, over n actuators."""
    if kind is None:
        return None
    largest = torch.tensor(float("inf"), dtype=torch.float64)
    if "largest" in part:  # in files from before corrections had one, none is too long
        largest = part.tensor("largest", (), infinite=True)
    if kind == "box":
        return BoxGuard(part.tensor("low", (n,)), part.tensor("high", (n,)), largest)
    limit = part.tensor("limit", ())
    if kind == "leverage":
        size = 2 * n + 1
        center, half_width = part.tensor("center", (n,)), part.tensor("half_width", (n,))
        readout = QuadraticReadout(center, half_width, part.tensor("factor", (size, size)))
        return LeverageGuard(readout, limit, largest)
    if kind == "leverage of the error model" and hasattr(error_module, "leverage"):
        assert error_module is not None
        return LeverageGuard(error_module, limit, largest)
    raise ValueError(f"unknown guard {kind!r}")
