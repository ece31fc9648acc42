"""What a fitted hybrid chose by itself: its error model and hysteresis, in words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from hybridkin import ELMRegressorCV, HybridForwardModel
from hybridkin.app.workflow.report import millimetres
from hybridkin.formats import LogUnit


def choice_in_words(model: HybridForwardModel, unit: LogUnit) -> str:
    """Return the chosen settings of a fitted model in a few words; widths in the unit of a log."""
    if model.cv_results_ is not None:
        return auto_in_short(model.cv_results_, memory_in_words(model, unit))
    network = model.error_model_
    if isinstance(network, ELMRegressorCV):
        return (
            f"{network.best_params_['n_hidden']} neurons, alpha = {network.alpha_:.3g}"
        )
    if not isinstance(model.error_model, str):
        return "a network for each marker"
    if model.error_model == "drop":
        return "no correction"
    return model.error_model


def _weights(results: Mapping[str, Any]) -> dict[str, float]:
    """Return the weights of the chosen error models, largest first."""
    chosen = {}
    for name, weight in results["weights"].items():
        if weight > 0.0:
            chosen[name] = float(weight)
    return dict(sorted(chosen.items(), key=lambda item: -item[1]))


def memory_in_words(model: HybridForwardModel, unit: LogUnit) -> str:
    """Return the hysteresis of a fitted model in words; empty without one."""
    return model.hysteresis_.in_words(unit)


def auto_in_short(results: Mapping[str, Any], hysteresis: str) -> str:
    """Return the parts, the calibrated parameters and the hysteresis that "auto" chose."""
    weights = _weights(results)
    words = next(iter(weights))
    if len(weights) > 1:
        parts = [f"{weight:.1f} {name}" for name, weight in weights.items()]
        words = f"blend of {', '.join(parts)}"
    if len(results["mechanical_model"]) > 1:
        words += f" on {results['parameters']}"
    if hysteresis:
        words += f", {hysteresis}"
    return words


def auto_in_words(model: HybridForwardModel, unit: LogUnit) -> list[str]:
    """Return the choices of error_model="auto" in sentences; none for other error models."""
    results = model.cv_results_
    if results is None:
        return []
    sentences = []
    tried = results["mechanical_model"]
    if len(tried) > 1:
        taken = results["parameters"]
        errors = tried[taken]
        words = f"{millimetres(errors['cv'], '.2f')} on held-out motions"
        if not math.isnan(errors.get("io", math.nan)):
            words += f", {millimetres(errors['io'], '.2f')} outside the fitted rows"
        sentences.append(
            f"Of {len(tried)} sets of parameters, auto calibrates {taken}: {words}."
        )
    errors = dict(zip(results["candidate"], results["mean_distance"], strict=True))
    listed = [f"{name} {1e3 * error:.2f}" for name, error in errors.items()]
    expected = millimetres(results["expected_distance"], ".2f")
    sentences += [
        f"Auto chose {', '.join(_weights(results))}. Mean errors on held-out motions in mm: "
        f"{', '.join(listed)}.",
        f"Expected on new motions like these: {expected}.",
    ]
    if model.hysteresis_:
        sentences.append(
            f"The actuators have {model.hysteresis_.in_words(unit)}. Predictions depend on the "
            "order of the rows in a motion, with creep on their times."
        )
    elif model.follows_order:
        sentences.append(
            "Auto looked for backlash (play), friction and creep, but none lowered the errors."
        )
    return sentences
