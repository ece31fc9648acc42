"""What a notebook shows of a fitted `HybridForwardModel`, below its parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from hybridkin._core.html import numbers
from hybridkin.hybrid._readout_fit import ReadoutFit
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.elm_cv import ELMRegressorCV

# Their errors are those of held-out rows.
_HELD_OUT = (
    ReadoutFit,
    ELMRegressor,
    ELMRegressorCV,
)


def fitted_rows(model: Any) -> dict[str, object]:
    """Return names and values of what the fit of a hybrid found, for `html_table`."""
    mechanical = model.mechanical_model_
    calibration = model.calibration_
    play = model.play_
    tested = model.fitted_module_.tested
    domain = {None: "everywhere (no guard)", "box": "the training range of q"}
    domain = domain.get(model.guard, "close to the training rows (guard by leverage)")
    return {
        "actuators": model.n_features_in_,
        "mechanical model": "none" if mechanical is None else type(mechanical).__name__,
        "calibrated": _calibrated(model),
        "error model": _error_model(model),
        **_error(model),
        "training rows": f"{len(model._fitted_rows)} different rows",
        "domain": domain
        + ", as far as held-out groups tested it" * (tested is not None),
        "radius": None if model.radius_ is None else _radius(model),
        "backlash": None if play is None else f"{numbers(play.width)} (unit of q)",
        "adapted": "after the fit; the errors are those of the fit"
        if model.module_ is not model.fitted_module_
        else None,
        "calibration": None if calibration is None else {"": repr(calibration)},
        "geometry": None if mechanical is None else mechanical.html_rows(),
        "training range of q": _range(model),
    }


def _calibrated(model: Any) -> str:
    calibration = model.calibration_
    setting = model.calibrate
    if calibration is not None:
        if calibration.cv_rmse is None:
            held_out = ""
        else:
            held_out = f", held-out groups {_mm(calibration.cv_rmse)}"
        error = f"root mean square error {_mm(calibration.rmse)}"
        return f"{', '.join(calibration.values)}; {error}{held_out}"
    chosen = (model.cv_results_ or {}).get("parameters")  # of a model from a file
    return str(
        chosen
        or (
            setting
            if isinstance(setting, str)
            else ", ".join(setting or ()) or "nothing"
        )
    )


def _error_model(model: Any) -> str:
    error = model.error_model_
    setting = model.error_model
    if model.cv_results_ is not None:
        weights = model.cv_results_["weights"].items()
        parts = [f"{share:.2f} {name}" for name, share in weights if share > 0.0]
        return f'{" + ".join(parts)} (chosen by "auto")'
    first = error[0] if type(error) is tuple else error  # of several markers
    name = f'"{setting}"' if isinstance(setting, str) else type(first).__name__
    rejected = isinstance(first, ReadoutFit) and np.isinf(first.alphas).all()
    return f"{name}, {model.coupling}" + ", rejected by the held-out error" * bool(
        rejected
    )


def _error(model: Any) -> dict[str, str]:
    """Return the error on held-out rows or, where it is not known, on training rows."""
    if (results := model.cv_results_) is not None:
        if model.mechanical_model is None:
            first = "a linear model"
        else:
            first = "mechanical model"
        alone = f", {first} alone {_mm(results['mean_distance'][0])}"
        return {"held-out error": f"mean {_mm(results['expected_distance'])}{alone}"}
    error = model.error_model_
    held_out = isinstance(error[0] if type(error) is tuple else error, _HELD_OUT)
    words = f"standard deviation of a coordinate {_mm(model._noise)}"
    return {"held-out error" if held_out else "training error": words}


def _radius(model: Any) -> str:
    radius = model.radius_
    covered = f"{100 * model.radius_.coverage:g} % of the tips"
    if np.isfinite(radius.inside):
        return f"{_mm(radius.inside)} covers {covered} inside the domain"
    return (
        f"not known: {covered} need at least {radius.least_groups} groups in the domain"
    )


def _range(model: Any) -> dict[str, object]:
    low, high = model.training_range_
    names = vars(model).get("feature_names_in_", [f"q[{k}]" for k in range(len(low))])
    ranges: dict[str, object] = {"": ("least", "largest")}
    for name, least, largest in zip(names, low, high, strict=True):
        ranges[str(name)] = numbers(least), numbers(largest)
    return ranges


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"
