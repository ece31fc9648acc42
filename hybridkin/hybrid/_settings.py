"""Checks of the settings of a HybridForwardModel."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from torch import nn

from hybridkin._core.arrays import number
from hybridkin._core.model import PoseModel
from hybridkin.calibration.measured import with_missing_markers
from hybridkin.chains.chain import Chain
from hybridkin.chains.markers import MarkedChain
from hybridkin.hybrid._error_models import FEATURES
from hybridkin.hybrid._guards import GUARDS
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.elm_cv import ELMRegressorCV

COUPLINGS = ("parallel", "serial")
_OUTPUTS = ("position", "pose")
_REGRESSORS = ("elm", "kernel")
_NETWORKS = (ELMRegressor, ELMRegressorCV)
_INSIDE = (str, type(None), *_NETWORKS)  # may act inside the robot


def missing_markers(estimator: BaseEstimator, y: Any) -> NDArray[np.bool_]:
    """Return which entries of y (N, 3 K) are missing markers; every row must keep one marker."""
    model = SimpleNamespace(**estimator.get_params(deep=False))
    allowed = model.mechanical_model is None or isinstance(
        model.mechanical_model, MarkedChain
    )
    if not allowed or model.output == "pose" or np.ndim(y) != 2 or y.shape[1] % 3:
        return np.zeros(np.shape(y), dtype=bool)
    return np.isnan(with_missing_markers(y, "y"))


def check_settings(estimator: BaseEstimator) -> None:
    """Raise if a setting of a HybridForwardModel is not allowed."""
    model = SimpleNamespace(**estimator.get_params(deep=False))
    error_model = model.error_model
    mechanical = model.mechanical_model
    names = ("auto", "drop", *_REGRESSORS, *FEATURES)
    chosen = ("coupling", model.coupling, COUPLINGS), ("guard", model.guard, GUARDS)
    for name, value, allowed in (*chosen, ("output", model.output, _OUTPUTS)):
        if value not in allowed:
            raise ValueError(f"`{name}` must be one of {allowed}, got {value!r}.")
    if (
        model.coverage is not None
        and not 0.0 < number(model.coverage, "coverage") < 1.0
    ):
        raise ValueError(
            f"`coverage` must lie in (0, 1) or be None, got {model.coverage!r}."
        )
    wanted = model.calibrate
    by_word = wanted is None or (
        isinstance(wanted, str) and wanted in ("auto", "default")
    )
    if not by_word and (isinstance(wanted, str) or not isinstance(wanted, Iterable)):
        need = (
            "a sequence of names, such as ['radii', 'base'], 'auto', 'default' or None"
        )
        raise ValueError(f"`calibrate` must be {need}, got {wanted!r}.")
    if isinstance(model.play, str) and model.play != "auto":
        raise ValueError(
            f"`play` must be a width or n widths, 'auto' or None, got {model.play!r}."
        )
    if model.output == "pose":
        _check_pose_settings(model)
    if isinstance(error_model, str) and error_model not in names:
        raise ValueError(
            f"`error_model` must be an estimator, None or one of {[*names]}, got {error_model!r}."
        )
    serial = model.coupling == "serial" and error_model != "drop"
    if serial and (not isinstance(error_model, _INSIDE) or error_model == "kernel"):
        raise TypeError(
            f"`error_model` must be None, one of {['elm', *FEATURES]}, an ELMRegressor or an "
            f"ELMRegressorCV with coupling='serial', because its features act inside the robot, "
            f"got {error_model!r}; use coupling='parallel'."
        )
    if mechanical is None:
        named = isinstance(error_model, str)
        if serial or (named and error_model not in ("auto", *_REGRESSORS)):
            raise ValueError(
                f"`mechanical_model` must be given with coupling={model.coupling!r} and "
                f"error_model={error_model!r}, which correct a mechanical model. "
                "To learn without one, give an estimator as `error_model`."
            )
    elif not isinstance(mechanical, nn.Module):
        raise TypeError(
            "`mechanical_model` must be a torch module q -> x or None, got "
            f"{type(mechanical).__name__}; wrap a function in an nn.Module."
        )
    elif not isinstance(mechanical, Chain) and not by_word and [*(wanted or ())]:
        raise TypeError(
            f"`mechanical_model` must be a chain to `calibrate` {wanted!r}, got "
            f"{type(mechanical).__name__}, which has no geometry."
        )


def _check_pose_settings(model: SimpleNamespace) -> None:
    if not isinstance(model.mechanical_model, PoseModel):
        raise TypeError(
            "`mechanical_model` must be a PoseModel with pose_and_jacobian(q) for output='pose'; "
            f"all chains are. Got {type(model.mechanical_model).__name__}; for positions use "
            "output='position'."
        )
    named = isinstance(model.error_model, str) and model.error_model not in _REGRESSORS
    if (model.coupling != "parallel" or named) and model.error_model != "drop":
        raise ValueError(
            "`coupling` must be 'parallel' and `error_model` a regressor, None, 'elm', 'kernel' or "
            f"'drop' with output='pose', got {model.coupling!r} and {model.error_model!r}; "
            "use ELMRegressorCV(), which chooses its penalties, or output='position'."
        )
    if model.coverage is not None:
        raise ValueError(
            f"`coverage` must be None with output='pose', got {model.coverage!r}: the radius is "
            "for tip positions. Fit a model with output='position' to y[:, :3]."
        )
