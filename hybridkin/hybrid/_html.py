"""What a notebook shows of a fitted `HybridForwardModel`, below its parameters."""

from __future__ import annotations

from typing import Any, Protocol

from hybridkin._core.html import numbers
from hybridkin._core.model import ForwardModel
from hybridkin.hybrid._range import TrainingRange
from hybridkin.hybrid.log_fit import HybridFit


class _Fitted(Protocol):
    """What is read of a fitted `HybridForwardModel`, beside the record of its fit."""

    error_model: Any
    coupling: str
    calibrate: Any
    guard: str | None
    n_features_in_: int
    module_: ForwardModel
    mechanical_model_: ForwardModel | None

    @property
    def training_range_(self) -> TrainingRange: ...

    def structure_in_words(self) -> list[str]: ...


def fitted_rows(model: _Fitted, fit: HybridFit) -> dict[str, object]:
    """Return names and values of what the fit of a hybrid found, for `html_table`."""
    mechanical = model.mechanical_model_
    kind = "none"
    if mechanical is not None:
        kind = type(mechanical).__name__
    rows: dict[str, object] = {
        "actuators": model.n_features_in_,
        "mechanical model": kind,
        "calibrated": _calibrated(model, fit),
        "error model": _error_model(model, fit),
        **_error(fit),
        "training rows": f"{len(fit.fitted_rows)} different rows",
        "domain": _domain(model, fit),
    }
    words = model.structure_in_words()
    if words:
        rows["structure"] = " ".join(words)
    if fit.radius is not None:
        rows["estimated error radius"] = str(fit.radius)
    if fit.hysteresis:
        rows[fit.hysteresis.kind] = f"width {numbers(fit.hysteresis.width)} (unit of q)"
    if model.module_ is not fit.module:
        rows["adapted"] = "after the fit; the errors are those of the fit"
    if fit.calibration is not None:
        rows["calibration"] = {"": repr(fit.calibration)}
    if mechanical is not None:
        rows["geometry"] = mechanical.html_rows()
    rows["training range of q"] = _range(model)
    return rows


def _calibrated(model: _Fitted, fit: HybridFit) -> str:
    if fit.calibration is not None:
        return ", ".join(fit.calibration.values)
    if fit.error.comparison is not None:  # of a model from a file
        return fit.error.comparison["parameters"]
    if isinstance(model.calibrate, str):
        return model.calibrate
    return ", ".join(model.calibrate or ()) or "nothing"


def _domain(model: _Fitted, fit: HybridFit) -> str:
    domain = "close to the training rows (guard by leverage)"
    if model.guard is None:
        domain = "everywhere (no guard)"
    if fit.module.tested is None:
        return domain
    return f"{domain}, as far as held-out groups tested it"


def _error_model(model: _Fitted, fit: HybridFit) -> str:
    if fit.error.comparison is not None:
        parts = []
        for name, weight in fit.error.comparison["weights"].items():
            if weight > 0.0:
                parts.append(f"{weight:.2f} {name}")
        return f'{" + ".join(parts)} (chosen by "auto")'
    name = fit.kind
    if isinstance(model.error_model, str):
        name = f'"{model.error_model}"'
    if fit.error.rejected:
        return f"{name}, {model.coupling}, rejected by the held-out error"
    return f"{name}, {model.coupling}"


def _error(fit: HybridFit) -> dict[str, str]:
    """Return the error on held-out rows or, where it is not known, on training rows."""
    results = fit.error.comparison
    if results is not None:
        mean = _mm(results["expected_distance"])
        first = results["candidate"][0]
        error_of_first = _mm(results["mean_distance"][0])
        words = f"mean {mean}, {first} model alone {error_of_first}"
        return {"held-out error": words}
    words = f"standard deviation of a coordinate {_mm(fit.error.noise)}"
    if fit.error.held_out:
        return {"held-out error": words}
    return {"training error": words}


def _range(model: _Fitted) -> dict[str, object]:
    low, high = model.training_range_
    names = vars(model).get("feature_names_in_", [f"q[{k}]" for k in range(len(low))])
    ranges: dict[str, object] = {"": ("least", "largest")}
    for name, least, largest in zip(names, low, high, strict=True):
        ranges[str(name)] = numbers(least), numbers(largest)
    return ranges


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"
