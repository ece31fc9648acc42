"""The description of a fitted HybridForwardModel: its settings and the results of its fit."""

from __future__ import annotations

from math import inf
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.frozen import FrozenEstimator
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import LinearRegression

from hybridkin._core.arrays import LARGEST
from hybridkin._core.estimators import estimator_of, params_of, restore_columns
from hybridkin._core.model import ForwardModel, as_forward_model
from hybridkin._core.portable import PortableModule
from hybridkin._core.stored import (
    KINDS_OF_MODELS,
    Restore,
    Stored,
    plain,
)

# Their chains are among the kinds that a description may hold.
from hybridkin.chains import (  # noqa: F401
    constant_curvature,
    elastic_tendons,
    force_tendons,
    rigid,
    structural,
)
from hybridkin.hybrid._adapt import Change
from hybridkin.hybrid._drift import Drift
from hybridkin.hybrid._module import Hybrid, HybridModule
from hybridkin.hybrid._pace import PaceRange
from hybridkin.hybrid._radius import Radius
from hybridkin.hybrid._range import TrainingRange
from hybridkin.hybrid._spec import ErrorModel, FittedError
from hybridkin.hybrid._wrapped import WithPose, in_columns
from hybridkin.hybrid.cv_results import CvResults
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.hybrid.log_fit import HybridFit
from hybridkin.hysteresis.stage import Stage
from hybridkin.hysteresis.stages.backlash import Backlash
from hybridkin.hysteresis.stages.creep import Creep
from hybridkin.hysteresis.stages.friction import Friction
from hybridkin.hysteresis.value import Hysteresis
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.elm_cv import ELMRegressorCV
from hybridkin.native.export import usual_range

# Regressors that a file may name as the setting `error_model`.
# The setting `hysteresis` was a value, that of the fit; the last one is that of first files.
_VALUES = ("value", "operator")
_REGRESSORS = {
    cls.__name__: cls for cls in (ELMRegressor, ELMRegressorCV, KernelRidge, LinearRegression)
}


def restorer() -> Restore:
    """Return a function from descriptions to models; one description always gives one object."""
    restored: dict[int, object] = {}

    def restore(stored: Stored) -> object:
        if stored.kind == "list":
            return [restore(part) for part in stored.parts.values()]
        model = KINDS_OF_MODELS.get(stored.kind)
        if model is None or not issubclass(model, PortableModule):
            raise ValueError(f"unknown kind {stored.kind!r:.60}")
        if id(stored) not in restored:
            restored[id(stored)] = model.from_stored(stored, restore)
        return restored[id(stored)]

    return restore


def stored_hybrid(model: HybridForwardModel) -> Stored:
    """Return the description of a fitted hybrid."""
    if "module_" not in vars(model):
        raise TypeError("`model` must be fitted before it is saved; call `fit` first.")
    fit = model._fit
    nominal = model.mechanical_model
    params = params_of(model)
    del params["mechanical_model"], params["error_model"]
    if isinstance(model.hysteresis, Hysteresis):
        params["hysteresis"] = _VALUES[0]
    return Stored.of(
        "hybrid",
        {
            **{f"drift_{name}": array for name, array in model._drift._asdict().items()},
            **model.change_._asdict(),
            "training_range": fit.training_range,
            "state_range": fit.state_range,
            **_stored_pace(model),
            "radius": model.radius_,
            "fitted_rows": fit.fitted_rows,
        },
        {
            "module": model.fitted_module_.stored(),
            "nominal": None if nominal is None else as_forward_model(nominal).stored(),
            "hysteresis": model.hysteresis_.stored() if model.hysteresis_ else None,
        },
        params=params,
        error_model=_setting(model.error_model),
        n_features_in=model.n_features_in_,
        feature_names_in=vars(model).get("feature_names_in_", []),
        single_output=fit.single_output,
        noise=fit.error.noise,
        learned=fit.kind,
        rejected=fit.error.rejected,
        held_out=fit.error.held_out,
    )


def _hysteresis_of(stored: Stored, n: int) -> Hysteresis:
    """Return the hysteresis of n actuators; empty if the description has none."""
    if "hysteresis" in stored.parts:
        return Hysteresis.from_stored(stored.part("hysteresis"), n)
    return _of_first_files(stored, n)


def _of_first_files(stored: Stored, n: int) -> Hysteresis:
    """Return the hysteresis of a first file of this format: friction before creep, as arrays."""
    stages: list[Stage] = []
    names = {*stored.arrays}
    if names & {"play_width", "play_slopes"}:
        stages.append(_first_friction(stored, n))
    if names & {"creep_gains", "creep_times"}:
        times = stored.array("creep_times", "J")
        shape = (len(times), n)[: stored.array("creep_gains").ndim]
        stages.append(Creep(stored.array("creep_gains", shape), times))
    return Hysteresis(stages)


def _first_friction(stored: Stored, n: int) -> Stage:
    n_dimensions = stored.array("play_width").ndim
    if n_dimensions < 2 and "play_slopes" in stored.arrays:
        raise ValueError("`play_slopes` need a `play_width` of several plays")
    if n_dimensions == 2:
        widths = stored.array("play_width", ("K", 1))[:, 0]
        shape = (len(widths) - 1, n)[: stored.array("play_slopes").ndim]
        return Friction(widths, stored.array("play_slopes", shape))
    shape = () if n_dimensions == 0 else (n,)
    return Backlash(stored.array("play_width", shape))


def _params_of(stored: Stored, hysteresis: Hysteresis) -> dict[str, Any]:
    """Return the settings of a hybrid, with its hysteresis in the place of its name."""
    params = {**stored.value("params", dict)}
    if "play" in params:  # of a first file of this format
        params["hysteresis"] = params.pop("play") or 0.0
    if params.get("hysteresis") in _VALUES:
        params["hysteresis"] = hysteresis
    return params


def hybrid_of(stored: Stored, training: object) -> HybridForwardModel:
    """Return the fitted hybrid from its description and the result of `training_of`."""
    n = stored.value("n_features_in", int)
    hysteresis = _hysteresis_of(stored, n)
    params = _params_of(stored, hysteresis)
    model = estimator_of(HybridForwardModel, params)
    if isinstance(model.calibrate, list):
        model.calibrate = tuple(model.calibrate)
    if "nominal" in stored.parts:
        model.mechanical_model = restorer()(stored.part("nominal"))
    model.error_model = stored.value("error_model", (str, dict, None))
    if isinstance(model.error_model, dict):
        model.error_model = _estimator(model.error_model)
    error_model = model._checked_error_model()
    restore_columns(model, stored, n)
    module: Hybrid = restorer()(stored.part("module"))
    if isinstance(module, WithPose) != (model.output == "pose"):
        raise ValueError(f"`output` {model.output!r} does not fit {stored.part('module').kind!r}")
    center = stored.array("drift_center", (n,))
    q = torch.tensor(center[None], device="cpu")
    try:  # arrays that do not fit together fail here, not in use
        with torch.no_grad():
            m = in_columns(module, model.output)(q).shape[1]
        drift = _restored_drift(stored, Drift.of_range(q, m))
        fit = _restored_fit(stored, training, module, drift.emptied(), error_model)
        model.take_fit(fit)
        shift = stored.array("shift", (n,))
        model.change_ = Change(shift, stored.array("motion", (4, 4)))
        model._drift = drift
        model._follow_robot()
        with torch.no_grad():
            columns = in_columns(model.module_, model.output)
            x, J = columns.forward_and_jacobian(q)
            model.module_.in_domain(q)
    except (RuntimeError, np.linalg.LinAlgError) as error:
        raise ValueError("the arrays do not fit together") from error
    if not (torch.isfinite(x).all() and torch.isfinite(J).all()):
        raise ValueError("the arrays do not give finite numbers")
    return model


def nominal_hybrid(mechanical: ForwardModel) -> HybridForwardModel:
    """Return a model that no rows were fitted to as a fitted one, without a correction.

    Its training range is unknown: from minus infinity to infinity.
    """
    n = mechanical.n_actuators
    middle, half = usual_range(mechanical, n)
    q = torch.from_numpy(np.stack([middle - half, middle + half]))
    model = HybridForwardModel(mechanical, "drop")
    model.n_features_in_ = n
    error_model = model._checked_error_model()
    module = HybridModule(mechanical, [], q.new_zeros(0))
    model.take_fit(
        HybridFit(
            module=module,
            error=FittedError(None, [], error_model),
            kind=None,
            fitted_rows=np.empty(0),
            single_output=False,
            training_range=TrainingRange(np.full(n, -inf), np.full(n, inf)),
            no_drift=Drift.of_range(q, mechanical.n_outputs),
        )
    )
    return model


def _stored_pace(model: HybridForwardModel) -> dict[str, NDArray]:
    """Return the arrays of the range of paces; none without creep."""
    pace = model._fit.pace
    if pace is None:
        return {}
    return {"pace_low": pace.low, "pace_high": pace.high}


def _restored_fit(
    stored: Stored,
    training: object,
    module: Hybrid,
    no_drift: Drift,
    error_model: ErrorModel,
) -> HybridFit:
    """Return what the fit of a described hybrid found, without what files do not contain."""
    n = stored.value("n_features_in", int)
    hysteresis = _hysteresis_of(stored, n)
    states = None
    if "state_range" in stored.arrays:
        if not hysteresis:
            raise ValueError("`state_range` needs the arrays of a hysteresis")
        n_states = hysteresis.inner_states(np.zeros((1, n)), [0], [0.0]).shape[1]
        states = TrainingRange(*stored.array("state_range", (2, n_states, n)))
    pace = None
    if "pace_high" in stored.arrays:
        if not hysteresis.needs_time:
            raise ValueError("`pace_high` needs the arrays of creep")
        n_times = len(hysteresis.time_constants)
        low = stored.array("pace_low", (n_times,))
        pace = PaceRange(low, stored.array("pace_high", (n_times, n)))
    radius = None
    if "radius" in stored.arrays:
        numbers = stored.array("radius", (3,), finite=False).tolist()
        inside, coverage, n_rows = numbers
        if not (inside >= 0.0 and 0.0 < coverage < 1.0 and n_rows < inf):
            raise ValueError("`radius` must hold a radius, a coverage and a number of rows")
        radius = Radius(inside, coverage, int(n_rows))
    comparison = None
    if isinstance(training, dict) and training.get("cv_results"):
        results = training["cv_results"].items()
        comparison = cast(CvResults, {key: _array(value) for key, value in results})
    kind = None
    rejected = False
    held_out = True
    if "learned" in stored.settings:
        kind = stored.value("learned", (str, None))
        rejected = stored.value("rejected", bool)
        held_out = stored.value("held_out", bool)
    elif "error_model" in stored.parts:  # of a first file of this format
        kind = stored.part("error_model").kind
    noise = stored.value("noise", float)
    error = FittedError(None, [], error_model, noise, rejected, held_out, comparison)
    return HybridFit(
        module=module.behind(hysteresis),
        error=error,
        kind=kind,
        fitted_rows=stored.array("fitted_rows", "N"),
        single_output=stored.value("single_output", bool),
        training_range=TrainingRange(*stored.array("training_range", (2, n))),
        no_drift=no_drift,
        hysteresis=hysteresis,
        state_range=states,
        pace=pace,
        radius=radius,
    )


def _restored_drift(stored: Stored, empty: Drift) -> Drift:
    """Return the drift of a description, with arrays shaped like those of an empty one."""
    arrays = {}
    for name, array in empty._asdict().items():
        shape = np.shape(array)
        arrays[name] = stored.array(f"drift_{name}", shape, finite=name != "alpha")
    drift = Drift(**arrays)
    if not (drift.scale > 1.0 / LARGEST).all():
        raise ValueError(f"`drift_scale` must be positive, over {1.0 / LARGEST:g}")
    if not drift.alpha > 0.0:
        raise ValueError("`drift_alpha` must be positive")
    return drift._replace(alpha=float(drift.alpha))


def training_of(model: HybridForwardModel) -> dict[str, object]:
    """Return the results of the training of a fitted hybrid as JSON values, errors in metres."""
    results: dict[str, object] = {"rows": len(model._fit.fitted_rows)}
    calibration = model.calibration_
    if calibration is not None:
        results["calibration"] = {
            "rmse": calibration.rmse,
            "held_out_rmse": calibration.cv_rmse,
            "converged": calibration.converged,
        }
    if model.cv_results_ is not None:
        results["cv_results"] = model.cv_results_
    return plain(results)


def _setting(error_model: object) -> str | dict[str, object] | None:
    """Return the setting `error_model` as JSON; entries that JSON lacks, such as a splitter, go.

    Of a frozen regressor the settings remain, as its module is that of the model.
    """
    if isinstance(error_model, FrozenEstimator):
        error_model = error_model.estimator
    if error_model is None or isinstance(error_model, str):
        return error_model
    name = type(error_model).__name__
    if not isinstance(error_model, BaseEstimator) or name not in _REGRESSORS:
        raise TypeError(f"`error_model` {error_model!r} could only be stored as code.")
    params = {}
    for key, value in params_of(error_model).items():
        if value is None or isinstance(value, (str, bool, int, float, list)):
            params[key] = value
    return {"class": name, "params": params}


def _estimator(setting: dict[str, object]) -> BaseEstimator:
    """Return the unfitted estimator of a setting."""
    entries = Stored("error_model", setting)
    name = entries.value("class", str)
    if name not in _REGRESSORS:
        raise ValueError(f"unknown error model {name!r:.60}")
    estimator = estimator_of(_REGRESSORS[name], entries.value("params", dict))
    estimator._validate_params()
    return estimator


def _array(value: object) -> Any:
    """Return a (nested) list of numbers, null for NaN, as an array; other values unchanged."""
    if not isinstance(value, list) or any(isinstance(entry, str) for entry in value):
        return value
    array = np.array(value)
    if array.dtype == object:
        return array.astype(np.float64)
    return array
