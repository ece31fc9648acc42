"""What a fitted hybrid chose by itself: its error model and hysteresis, in words."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from hybridkin import CrossFit, ELMRegressorCV, HybridForwardModel, Hysteresis
from hybridkin.app.workflow.report import millimetres
from hybridkin.formats import LogUnit


def choice_in_words(model: HybridForwardModel, unit: LogUnit) -> str:
    """Return the chosen settings of a fitted model in a few words; widths in the unit of a log."""
    results = model.cv_results_
    if results is not None:
        parameters = ""
        if len(results["mechanical_model"]) > 1:
            parameters = results["parameters"]
        return _blend_in_words(results["weights"], parameters, model.hysteresis_, unit)
    network = model.error_model_
    if isinstance(network, ELMRegressorCV):
        return network_in_words(network)
    if not isinstance(model.error_model, str):
        return "a network for each marker"
    if model.error_model == "drop":
        return "no correction"
    return model.error_model


def network_in_words(network: ELMRegressorCV) -> str:
    """Return the chosen settings of a fitted network in a few words."""
    return f"{network.best_params_['n_hidden']} neurons, alpha = {network.alpha_:.3g}"


def choices_by_fold(compared: CrossFit, unit: LogUnit) -> list[dict[str, str]]:
    """Return what the networks and "auto" chose in each fold, by model."""
    n_folds = len(np.unique(compared.fold))
    words: list[dict[str, str]] = [{} for _ in range(n_folds)]
    for name, table in compared.tables.items():
        for of_fold, choice, weights in zip(words, table.choices, table.fold_weights, strict=True):
            if isinstance(choice.error_model, ELMRegressorCV):
                of_fold[name] = network_in_words(choice.error_model)
            elif len(table.names) > 1:
                by_name = dict(zip(table.names, weights.tolist(), strict=True))
                of_fold[name] = _blend_in_words(by_name, choice.parameters, choice.hysteresis, unit)
    return words


def _chosen(weights: Mapping[str, float]) -> dict[str, float]:
    """Return the weights of the chosen error models, largest first."""
    chosen = {name: weight for name, weight in weights.items() if weight > 0.0}
    return dict(sorted(chosen.items(), key=lambda item: -item[1]))


def _blend_in_words(
    weights: Mapping[str, float],
    parameters: str,
    hysteresis: Hysteresis,
    unit: LogUnit,
) -> str:
    """Return the parts, the calibrated parameters and the hysteresis that "auto" chose."""
    chosen = _chosen(weights)
    words = next(iter(chosen))
    if len(chosen) > 1:
        parts = [f"{weight:.1f} {name}" for name, weight in chosen.items()]
        words = f"blend of {', '.join(parts)}"
    if parameters:
        words += f" on {parameters}"
    if hysteresis:
        words += f", {hysteresis.in_words(unit)}"
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
        sentences.append(f"Of {len(tried)} sets of parameters, auto calibrates {taken}: {words}.")
    if results["corrected"]:
        listed = []
        for name, both in results["corrected"].items():
            millimetre_words = [f"{1e3 * error:.2f}" for error in both.values()]
            listed.append(f"{name} {' and '.join(millimetre_words)}")
        sentences.append(
            "With quick corrections, mean errors on held-out motions and outside the fitted rows "
            f"in mm: {'; '.join(listed)}."
        )
    errors = dict(zip(results["candidate"], results["mean_distance"], strict=True))
    listed = [f"{name} {1e3 * error:.2f}" for name, error in errors.items()]
    expected = millimetres(results["expected_distance"], ".2f")
    chosen = ", ".join(_chosen(results["weights"]))
    sentences += [
        f"Auto chose {chosen}. Mean errors on held-out motions in mm: {', '.join(listed)}.",
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
