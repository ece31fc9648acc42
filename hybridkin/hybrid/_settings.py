"""What the settings of a HybridForwardModel must be."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from torch import nn

from hybridkin.hybrid._couplings import COUPLINGS, READOUTS, Readout
from hybridkin.hybrid._guards import GUARDS
from hybridkin.hybrid._pose import check_pose_settings
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.elm_cv import ELMRegressorCV

HIDDEN_LAYERS = (ELMRegressor, ELMRegressorCV)
"""Regressors whose features can act inside the robot."""

NAMED = (str, Readout)
"""What names an error model rather than being one."""


def check_settings(model: Any) -> None:
    """Raise where the settings of a HybridForwardModel cannot be met."""
    if model.coupling not in COUPLINGS:
        raise ValueError(f"`coupling` must be one of {[*COUPLINGS]}, got {model.coupling!r}.")
    if model.coverage is not None and not 0.0 < model.coverage < 1.0:
        raise ValueError(f"`coverage` must lie in (0, 1) or be None, got {model.coverage!r}.")
    names = model.calibrate
    if (isinstance(names, str) and names != "default") or not isinstance(names, (str, Iterable)):
        raise ValueError(
            f'`calibrate` must be a sequence of names or "default", got {names!r}; for example '
            '["radii", "base"].'
        )
    if isinstance(model.play, str) and model.play != "auto":
        raise ValueError(
            f"`play` must be a width, one per actuator, 'auto' or None, got {model.play!r}."
        )
    if model.output not in ("position", "pose"):
        raise ValueError(f"`output` must be 'position' or 'pose', got {model.output!r}.")
    if model.output == "pose":
        check_pose_settings(model)
    if model.guard not in GUARDS:
        raise ValueError(f"`guard` must be one of {GUARDS}, got {model.guard!r}.")
    named, names = isinstance(model.error_model, NAMED), ("auto", "drop", *READOUTS)
    if isinstance(model.error_model, str) and model.error_model not in names:
        raise ValueError(
            f"`error_model` must be an estimator, None or one of {[*names]}, got "
            f"{model.error_model!r}."
        )
    serial = model.coupling == "serial" and model.error_model != "drop"
    if serial and not (
        named or model.error_model is None or isinstance(model.error_model, HIDDEN_LAYERS)
    ):
        raise TypeError(
            f"`error_model` must give features that can act inside the robot with "
            f"coupling='serial': None, one of {[*READOUTS]}, an ELMRegressor or an "
            f"ELMRegressorCV, got {type(model.error_model).__name__}; use coupling='parallel'."
        )
    if model.mechanical_model is None:
        if named or serial:
            raise ValueError(
                f"`mechanical_model` must be given with coupling={model.coupling!r} and "
                f"error_model={model.error_model!r}: the error is that of a mechanical model. "
                "For the data alone give an estimator as `error_model`."
            )
    elif not isinstance(model.mechanical_model, nn.Module):
        raise TypeError(
            "`mechanical_model` must be a torch module q -> x or None, got "
            f"{type(model.mechanical_model).__name__}; wrap a function in an nn.Module."
        )
