"""How a fitted HybridForwardModel describes itself: its settings, and what its fit found."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import torch
from sklearn.base import BaseEstimator
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import LinearRegression

from hybridkin._core.model import PortableModule, as_forward_model
from hybridkin._core.stored import Restore, Stored, estimator_of, feature_names, params_of, plain
from hybridkin.chains.constant_curvature import ConstantCurvatureChain
from hybridkin.chains.elastic_tendons import ElasticTendonChain
from hybridkin.chains.play import PlayOperator
from hybridkin.chains.rigid import RigidChain
from hybridkin.hybrid._couplings import Blend
from hybridkin.hybrid._drift import Drift
from hybridkin.hybrid._features import (
    Features,
    HiddenFeatures,
    PoseFeatures,
    QuadraticFeatures,
    Readout,
)
from hybridkin.hybrid._guards import BoxGuard, LeverageGuard, QuadraticLeverage
from hybridkin.hybrid._module import HybridModule, InnerCorrection, TipCorrection
from hybridkin.hybrid._pose import PoseHybridModule
from hybridkin.hybrid._radius import Radius
from hybridkin.hybrid._readout_fit import ReadoutFit
from hybridkin.hybrid._settings import check_settings
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.elm_cv import ELMRegressorCV
from hybridkin.learning.network import ELM
from hybridkin.learning.regressor_modules import AffineModule, KernelModule, PolynomialModule

__all__ = ["hybrid_of", "restorer", "stored_hybrid", "training_of"]

# Every module that a description may hold, by its kind.
_MODULES: dict[str, type[PortableModule]] = {
    module.layout.kind: module
    for module in (
        *(ConstantCurvatureChain, ElasticTendonChain, RigidChain),
        *(ELM, AffineModule, PolynomialModule, KernelModule, Readout),
        *(Features, QuadraticFeatures, HiddenFeatures, PoseFeatures),
        *(BoxGuard, LeverageGuard, QuadraticLeverage, TipCorrection, InnerCorrection),
        *(HybridModule, PoseHybridModule),
    )
}
# Error models that a HybridForwardModel may be given, besides names.
_REGRESSORS: dict[str, type[BaseEstimator]] = {
    cls.__name__: cls for cls in (ELMRegressor, ELMRegressorCV, KernelRidge, LinearRegression)
}
_FITS = {"elm_regressor": ELMRegressor.from_stored, "readout_fit": ReadoutFit.from_stored}


def restorer() -> Restore:
    """Return a function from descriptions to models, to one model from one description."""
    found: dict[int, Any] = {}

    def restore(stored: Stored) -> Any:
        if stored.kind == "list":
            return [restore(part) for part in stored.parts.values()]
        if stored.kind not in _MODULES:
            raise ValueError(f"unknown kind {stored.kind!r:.60}")
        if id(stored) not in found:
            found[id(stored)] = _MODULES[stored.kind].from_stored(stored, restore)
        return found[id(stored)]

    return restore


def stored_hybrid(model: HybridForwardModel) -> Stored:
    """Return how a fitted hybrid describes itself."""
    if "module_" not in vars(model):
        raise TypeError("`model` must be fitted before it is saved; call `fit` first.")
    nominal, seed = model.mechanical_model, model.random_state
    return Stored.of(
        "hybrid",
        {
            **{f"drift_{name}": array for name, array in model._drift._asdict().items()},
            "play_width": None if model.play_ is None else model.play_.width,
        },
        {
            "module": model.module_.stored(),
            "nominal": None if nominal is None else as_forward_model(nominal).stored(),
            "error_model": _stored_error(model.error_model_),
        },
        coupling=model.coupling,
        calibrate=model.calibrate,
        guard=model.guard,
        coverage=model.coverage,
        output=model.output,
        play=model.play,
        random_state=int(seed) if isinstance(seed, (int, np.integer)) else None,
        error_model=_setting(model.error_model, model.error_model_),
        radius=None if model.radius_ is None else model.radius_._asdict(),
        n_features_in=model.n_features_in_,
        feature_names_in=vars(model).get("feature_names_in_", []),
        single_output=model._single_output,
    )


def hybrid_of(stored: Stored, training: Any) -> HybridForwardModel:
    """Return the fitted hybrid of a description and of what `training_of` returned."""
    n, restore = stored.value("n_features_in", int), restorer()
    module = restore(stored.part("module"))
    nominal = restorer()(stored.part("nominal")) if "nominal" in stored.parts else None
    for chain in (module.mechanical, nominal):
        if chain is not None and chain.n_actuators != n:
            raise ValueError(f"a chain of {chain.n_actuators} actuators cannot take {n}")
    names, asked = stored.value("calibrate", (str, list)), stored.value("error_model", _ASKED)
    model = HybridForwardModel(
        nominal,
        _estimator(asked) if isinstance(asked, dict) else asked,
        coupling=stored.value("coupling", str),
        calibrate=names if isinstance(names, str) else tuple(stored.list_of(str, "calibrate")),
        guard=stored.value("guard", (str, None)),
        coverage=stored.value("coverage", (float, None)),
        output=stored.value("output", str),
        play=stored.value("play", (str, float, list, None)),
        random_state=stored.value("random_state", (int, None)),
    )
    check_settings(model)
    model.module_, model.mechanical_model_ = module, module.mechanical
    model.error_model_ = _restored_error(stored.parts.get("error_model"), restore, n)
    model.calibration_, model._play_state, model.play_ = None, None, None
    results = training.get("cv_results") if isinstance(training, dict) else None
    model.cv_results_ = {key: _array(value) for key, value in results.items()} if results else None
    if "play_width" in stored.arrays:
        width = stored.array("play_width")
        model.play_ = PlayOperator(stored.array("play_width", (n,) if width.ndim else ()))
    model.radius_ = None
    if stored.value("radius", (dict, None)) is not None:
        radius = Stored("radius", stored.settings["radius"])
        inside, outside, coverage = (radius.value(key, float) for key in Radius._fields[:3])
        model.radius_ = Radius(inside, outside, coverage, radius.value("n_rows", int))
    model.n_features_in_ = n
    columns = feature_names(stored, n)
    if columns is not None:
        model.feature_names_in_ = columns
    model._single_output = stored.value("single_output", bool)
    with torch.no_grad():  # arrays that do not fit together fail here, not in use
        m = model._rows().forward_and_jacobian(torch.ones(1, n, dtype=torch.float64))[0].shape[1]
    if model._single_output and m != 1:
        raise ValueError(f"`single_output` must be false with {m} outputs")
    shapes = {"center": (n,), "scale": (n,), "gram": (n + 1, n + 1), "moment": (n + 1, m)}
    drift = {name: stored.array(f"drift_{name}", shape) for name, shape in shapes.items()}
    model._drift = Drift(**drift)
    return model


def training_of(model: HybridForwardModel) -> dict[str, Any]:
    """Return what a fitted hybrid knows about its training as JSON values, errors in metres."""
    known: dict[str, Any] = {}
    error = model.error_model_
    error = error.error_models[0] if isinstance(error, Blend) else error
    if isinstance(error, ReadoutFit):
        squares = np.square(error.residual).sum(axis=1)
        known["rows"] = int(np.isfinite(squares).sum())
        known["left_out_rmse"] = float(np.sqrt(np.nanmean(squares)))
    elif isinstance(error, (ELMRegressor, ELMRegressorCV)):
        known["rows"] = error.stored().settings["n_samples_seen"]
    elif isinstance(error, KernelRidge):
        known["rows"] = len(error.X_fit_)
    elif model.radius_ is not None:
        known["rows"] = model.radius_.n_rows
    if model.calibration_ is not None:
        found = model.calibration_
        known["calibration"] = {
            "rmse": found.rmse,
            "held_out_rmse": found.cv_rmse,
            "converged": found.converged,
        }
    if model.cv_results_ is not None:
        known["cv_results"] = model.cv_results_
    return plain(known)


_ASKED = (str, dict, None)


def _setting(asked: Any, fitted: Any) -> Any:
    """Return `error_model` as JSON: as it was asked for, where not as what the fit led to."""
    if asked is None or isinstance(asked, str):
        return asked
    if type(asked).__name__ in _REGRESSORS:
        try:
            return json.loads(json.dumps(_said(asked), allow_nan=False))
        except (TypeError, ValueError):
            pass  # a splitter, for example
    if isinstance(fitted, ELMRegressorCV):
        return _said(fitted.best_estimator_)
    if isinstance(fitted, ReadoutFit) and isinstance(fitted.readout.features, HiddenFeatures):
        features = fitted.readout.features
        params = {"n_hidden": len(features.input_bias), "activation": features.activation}
        return {"class": "ELMRegressorCV", "params": params}
    raise TypeError(f"`error_model` {asked!r} could only be stored as code.")


def _said(estimator: Any) -> dict[str, Any]:
    """Return class and parameters of an estimator."""
    return {"class": type(estimator).__name__, "params": params_of(estimator)}


def _estimator(setting: dict[str, Any]) -> Any:
    """Return the unfitted estimator of a setting."""
    asked = Stored("error_model", setting)
    name = asked.value("class", str)
    if name not in _REGRESSORS:
        raise ValueError(f"unknown error model {name!r:.60}")
    return estimator_of(_REGRESSORS[name], asked.value("params", dict))


def _stored_error(error: Any) -> Stored | None:
    """Return how a fitted error model describes itself; None where there is none."""
    if error is None:
        return None
    if isinstance(error, Blend):
        models = {str(k): _stored_error(one) for k, one in enumerate(error.error_models)}
        return Stored.of("blend", parts=models, weights=error.weights)
    if isinstance(error, (ReadoutFit, ELMRegressor, ELMRegressorCV)):
        return error.stored()
    if type(error).__name__ not in _REGRESSORS:
        raise TypeError(f"`error_model` {error!r} could only be stored as code.")
    learned = {name: np.asarray(value) for name, value in vars(error).items() if name[-1] == "_"}
    arrays = {name: value for name, value in learned.items() if value.dtype.kind == "f"}
    return Stored.of("regressor", arrays, **_said(error))


def _restored_error(stored: Stored | None, restore: Restore, n: int) -> Any:
    """Return the fitted error model of a description, for n actuators."""
    if stored is None:
        return None
    if stored.kind == "blend":
        weights = tuple(stored.list_of(float, "weights"))
        parts = [stored.parts.get(str(k)) for k in range(len(weights))]
        return Blend(weights, tuple(_restored_error(part, restore, n) for part in parts))
    if stored.kind in _FITS:
        return _FITS[stored.kind](stored, restore)
    error = _estimator(stored.settings)
    vars(error).update({name: stored.array(name) for name in stored.arrays}, n_features_in_=n)
    if error.predict(np.ones((1, n))).ndim > 2:
        raise ValueError("the arrays of the error model do not fit together")
    return error


def _array(value: Any) -> Any:
    """Return a list of numbers, null for NaN, or of such lists, as an array; others as they are."""
    if not isinstance(value, list) or any(isinstance(entry, str) for entry in value):
        return value
    array = np.array(value)
    return array.astype(np.float64) if array.dtype == object else array
