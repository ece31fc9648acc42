"""What a fitted hybrid chose by itself: its error model, backlash and error radius, in words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.learning.elm_cv import ELMRegressorCV
from hybridkin.workflow.model import play_widths
from hybridkin.workflow.report import millimetres


@dataclass(frozen=True)
class RadiusEntry:
    """An estimated error radius.

    Attributes
    ----------
    inside : float
        The radius in the domain of the error model [m]; infinite if the log supports none.
    coverage : float
        Share of the tips that it covers.
    n_rows : int
        Number of held-out rows it was computed from.
    words : str
        The radius in words.
    """

    inside: float
    coverage: float
    n_rows: int
    words: str

    @classmethod
    def of(cls, model: HybridForwardModel | None) -> RadiusEntry | None:
        """Return the estimated error radius of a model; None without one."""
        if model is None or model.radius_ is None:
            return None
        radius = model.radius_
        if math.isfinite(radius.inside):
            size = f"{millimetres(radius.inside)}, in the domain and for motions as in the log."
        else:
            size = f"not known; at least {radius.least_groups} motions in the domain are needed."
        words = f"Estimated error radius covering {100 * radius.coverage:g} % of the tips: {size}"
        return cls(radius.inside, radius.coverage, radius.n_rows, words)


@dataclass(frozen=True, kw_only=True)
class AutoChoice:
    """The choices of a fitted `HybridForwardModel` with error_model="auto".

    Attributes
    ----------
    chosen : str
        Name of the chosen candidate.
    weights : dict of str to float
        Weights of the parts of a blend.
    taken : str
        The set of parameters that is calibrated.
    mechanical_models : dict
        For each set of parameters the mean error on held-out motions, "cv", and outside the fitted
        rows, "io" [m].
    candidates : dict of str to float
        Held-out error of every candidate [m].
    expected : float
        Error to expect on new motions [m].
    play : list of float or None
        Backlash of every actuator [m].
    play_asked : bool
        Whether it was looked for.
    words : list of str
        The choices in sentences.
    """

    chosen: str
    weights: Mapping[str, float]
    taken: str
    mechanical_models: Mapping[str, Mapping[str, float]]
    candidates: Mapping[str, float]
    expected: float
    play: list[float] | None
    play_asked: bool
    words: tuple[str, ...] = ()

    @classmethod
    def of(cls, model: HybridForwardModel) -> AutoChoice | None:
        """Return the choices of a fitted model; None if it did not choose."""
        results = model.cv_results_
        if results is None:
            return None
        weights = {}
        for name, weight in results["weights"].items():
            if weight > 0.0:
                weights[name] = float(weight)
        errors = map(float, results["mean_distance"])
        choice = cls(
            chosen=str(results["chosen"]),
            weights=weights,
            taken=results.get("parameters", type(model.mechanical_model_).__name__),
            mechanical_models=results["mechanical_model"],
            candidates=dict(zip(results["candidate"], errors, strict=True)),
            expected=float(results["expected_distance"]),
            play=play_widths(model),
            play_asked=model.play is not None,
        )
        object.__setattr__(choice, "words", choice._sentences())
        return choice

    @property
    def in_short(self) -> str:
        """Parts, mechanical model and backlash in a few words."""
        words = next(iter(self.weights))
        if len(self.weights) > 1:
            largest_first = sorted(self.weights.items(), key=lambda item: -item[1])
            parts = [f"{weight:.1f} {name}" for name, weight in largest_first]
            words = f"blend of {', '.join(parts)}"
        if len(self.mechanical_models) > 1:
            words += f" on {self.taken}"
        if self.play is not None:
            words += f", backlash {millimetres(max(self.play))}"
        return words

    def _sentences(self) -> tuple[str, ...]:
        sentences = [
            *self._on_parameters(),
            self._on_error_model(),
            f"Expected on new motions like these: {millimetres(self.expected, '.2f')}.",
        ]
        if self.play is not None:
            sentences.append(
                f"Backlash (play) of the actuators: {millimetres(max(self.play))}. Predictions "
                "depend on the order of the rows in a motion."
            )
        elif self.play_asked:
            sentences.append(
                "Auto looked for backlash (play), but it did not lower the errors."
            )
        return tuple(sentences)

    def _on_parameters(self) -> list[str]:
        """Return which set of parameters was taken, with its errors on held-out and outer rows."""
        if len(self.mechanical_models) < 2:
            return []
        errors = self.mechanical_models[self.taken]
        words = f"{self.taken}: {millimetres(errors['cv'], '.2f')} on held-out motions"
        if not math.isnan(errors.get("io", math.nan)):
            words += f", {millimetres(errors['io'], '.2f')} outside the fitted rows"
        n = len(self.mechanical_models)
        return [f"Of {n} sets of parameters, auto calibrates {words}."]

    def _on_error_model(self) -> str:
        """Return the error model, and the errors it was compared by.

        A single candidate is named even if another one has less error: a gain must be clear.
        """
        candidates = self.candidates
        blend = len(self.weights) > 1
        names = {*candidates} - {"blend"} if blend else {*self.weights}
        error, alone = min((candidates[name], name) for name in names)
        least = millimetres(error, ".2f")
        without = f"{millimetres(candidates['mechanical'], '.2f')} without one."
        if blend:
            return (
                "Auto chose a blend, the weighted mean of several hybrids: "
                f"{millimetres(candidates['blend'], '.2f')} on held-out motions, {least} with the "
                f"best of them alone ({alone}), {without}"
            )
        if alone == "mechanical":
            return (
                f"Auto chose no error model: {least} on held-out motions; none is clearly "
                "better."
            )
        return f"Auto chose the error model {alone}: {least} on held-out motions, {without}"


def choice_in_words(model: HybridForwardModel) -> str:
    """Return the chosen settings of a fitted model in a few words."""
    choice = AutoChoice.of(model)
    if choice is not None:
        return choice.in_short
    network = model.error_model_
    if isinstance(network, ELMRegressorCV):
        return (
            f"{network.best_params_['n_hidden']} neurons, alpha = {network.alpha_:.3g}"
        )
    if not isinstance(model.error_model, str):
        return "a network for each marker"
    return "no correction" if model.error_model == "drop" else model.error_model
