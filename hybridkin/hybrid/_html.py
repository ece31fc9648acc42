"""What a notebook shows of a fitted `HybridForwardModel`, below its parameters."""

from __future__ import annotations

from hybridkin._core.html import numbers
from hybridkin.hybrid._predictor import HybridPredictor


def fitted_rows(model: HybridPredictor) -> dict[str, object]:
    """Return names and values of what the fit of a hybrid found, for `html_table`."""
    mechanical = model.mechanical_model_
    kind = "none"
    if mechanical is not None:
        kind = type(mechanical).__name__
    rows: dict[str, object] = {
        "actuators": model.n_features_in_,
        "mechanical model": kind,
        "calibrated": _calibrated(model),
        "error model": _error_model(model),
        **_error(model),
        "training rows": f"{len(model._fit.fitted_rows)} different rows",
        "domain": _domain(model),
    }
    words = model.structure_in_words()
    if words:
        rows["structure"] = " ".join(words)
    if model.radius_ is not None:
        rows["estimated error radius"] = str(model.radius_)
    if model.hysteresis_:
        rows[model.hysteresis_.kind] = (
            f"width {numbers(model.hysteresis_.width)} (unit of q)"
        )
    if model.module_ is not model.fitted_module_:
        rows["adapted"] = "after the fit; the errors are those of the fit"
    if model.calibration_ is not None:
        rows["calibration"] = {"": repr(model.calibration_)}
    if mechanical is not None:
        rows["geometry"] = mechanical.html_rows()
    rows["training range of q"] = _range(model)
    return rows


def _calibrated(model: HybridPredictor) -> str:
    if model.calibration_ is not None:
        return ", ".join(model.calibration_.values)
    if model.cv_results_ is not None:  # of a model from a file
        return model.cv_results_["parameters"]
    if isinstance(model.calibrate, str):
        return model.calibrate
    return ", ".join(model.calibrate or ()) or "nothing"


def _domain(model: HybridPredictor) -> str:
    domain = "close to the training rows (guard by leverage)"
    if model.guard is None:
        domain = "everywhere (no guard)"
    if model.fitted_module_.tested is None:
        return domain
    return f"{domain}, as far as held-out groups tested it"


def _error_model(model: HybridPredictor) -> str:
    if model.cv_results_ is not None:
        parts = []
        for name, weight in model.cv_results_["weights"].items():
            if weight > 0.0:
                parts.append(f"{weight:.2f} {name}")
        return f'{" + ".join(parts)} (chosen by "auto")'
    name = model._fit.kind
    if isinstance(model.error_model, str):
        name = f'"{model.error_model}"'
    if model._fit.error.rejected:
        return f"{name}, {model.coupling}, rejected by the held-out error"
    return f"{name}, {model.coupling}"


def _error(model: HybridPredictor) -> dict[str, str]:
    """Return the error on held-out rows or, where it is not known, on training rows."""
    results = model.cv_results_
    if results is not None:
        mean = _mm(results["expected_distance"])
        first = results["candidate"][0]
        error_of_first = _mm(results["mean_distance"][0])
        words = f"mean {mean}, {first} model alone {error_of_first}"
        return {"held-out error": words}
    words = f"standard deviation of a coordinate {_mm(model._fit.error.noise)}"
    if model._fit.error.held_out:
        return {"held-out error": words}
    return {"training error": words}


def _range(model: HybridPredictor) -> dict[str, object]:
    low, high = model.training_range_
    names = vars(model).get("feature_names_in_", [f"q[{k}]" for k in range(len(low))])
    ranges: dict[str, object] = {"": ("least", "largest")}
    for name, least, largest in zip(names, low, high, strict=True):
        ranges[str(name)] = numbers(least), numbers(largest)
    return ranges


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"
