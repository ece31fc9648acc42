"""What the settings of a HybridForwardModel may be, and the error model that they name."""

from __future__ import annotations

from numbers import Real

from sklearn.frozen import FrozenEstimator
from sklearn.utils._param_validation import HasMethods, Interval, StrOptions
from torch import nn

from hybridkin.calibration.choice import GeometryChoice
from hybridkin.hybrid._error_models import (
    NAMED,
    ForeignModel,
    FrozenModel,
    network_model,
)
from hybridkin.hybrid._selection import Auto
from hybridkin.hybrid._spec import ErrorModel, Seed
from hybridkin.hysteresis.value import Hysteresis
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.elm_cv import ELMRegressorCV

ERROR_MODELS: dict[str, type[ErrorModel]] = {**NAMED, "auto": Auto}

CONSTRAINTS = {
    "mechanical_model": [nn.Module, None],
    "error_model": [
        StrOptions({"elm", *ERROR_MODELS}),
        HasMethods(["fit", "predict"]),
        None,
    ],
    "coupling": [StrOptions({"parallel", "serial"})],
    "calibrate": [
        StrOptions({"auto", "default"}),
        GeometryChoice,
        "array-like",
        None,
    ],
    "guard": [StrOptions({"leverage"}), None],
    "hysteresis": [StrOptions({"auto"}), Real, "array-like", Hysteresis],
    "coverage": [Interval(Real, 0, 1, closed="neither"), None],
    "output": [StrOptions({"position", "pose"})],
    "random_state": ["random_state"],
}


def error_model_of(setting: object, coupling: str, random_state: Seed) -> ErrorModel:
    """Return the error model for the settings of a HybridForwardModel."""
    if setting is None or setting == "elm":
        setting = ELMRegressor()
    if isinstance(setting, str):
        error_model = ERROR_MODELS[setting].of(coupling, random_state)
    elif isinstance(setting, (ELMRegressor, ELMRegressorCV)):
        error_model = network_model(setting, coupling, random_state)
    elif isinstance(setting, FrozenEstimator):
        error_model = FrozenModel(setting)
    else:
        error_model = ForeignModel(setting)
    if coupling not in error_model.couplings and coupling == "parallel":
        raise TypeError(
            f"`coupling` must be 'serial' with error_model={setting!r}, whose errors act inside "
            f"the robot, got {coupling!r}; use coupling='serial'."
        )
    if coupling not in error_model.couplings:
        raise TypeError(
            "`error_model` must be a name of features, an ELMRegressor or an ELMRegressorCV with "
            f"coupling={coupling!r}, because its features act inside the robot, got {setting!r}; "
            "use coupling='parallel'."
        )
    return error_model
