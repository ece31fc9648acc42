"""Hybrid mechanical and data-driven kinematics of soft and cable-driven robots."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybridkin import datasets, experiments, plots, robots, simulation, tasks, trajectories
    from hybridkin._numerics import jacobian
    from hybridkin.calibration import CalibrationResult, calibrate
    from hybridkin.chain import ConstantCurvatureChain
    from hybridkin.elm import ELMRegressor
    from hybridkin.elm_cv import ELMRegressorCV
    from hybridkin.hybrid import HybridForwardModel
    from hybridkin.ik import (
        Controller,
        IKSolution,
        IKStatus,
        InverseKinematics,
        Step,
        Track,
        Tracker,
    )
    from hybridkin.persistence import load_model, save_model
    from hybridkin.play import PlayFit, PlayOperator, PlayState, fit_play
    from hybridkin.rigid import RigidChain
    from hybridkin.tendons import ElasticTendonChain

__version__ = "0.1.0"

__all__ = [
    "CalibrationResult",
    "ConstantCurvatureChain",
    "Controller",
    "ELMRegressor",
    "ELMRegressorCV",
    "ElasticTendonChain",
    "HybridForwardModel",
    "IKSolution",
    "IKStatus",
    "InverseKinematics",
    "PlayFit",
    "PlayOperator",
    "PlayState",
    "RigidChain",
    "Step",
    "Track",
    "Tracker",
    "__version__",
    "calibrate",
    "datasets",
    "experiments",
    "fit_play",
    "jacobian",
    "load_model",
    "plots",
    "robots",
    "save_model",
    "simulation",
    "tasks",
    "trajectories",
]

# Rooms are opened when first used: torch and scikit-learn take seconds to import.
_ROOM_OF = {
    "CalibrationResult": "calibration",
    "ConstantCurvatureChain": "chain",
    "ELMRegressor": "elm",
    "ELMRegressorCV": "elm_cv",
    "ElasticTendonChain": "tendons",
    "HybridForwardModel": "hybrid",
    "IKSolution": "ik",
    "IKStatus": "ik",
    "InverseKinematics": "ik",
    "PlayFit": "play",
    "PlayOperator": "play",
    "PlayState": "play",
    "RigidChain": "rigid",
    "Controller": "ik",
    "Step": "ik",
    "Track": "ik",
    "Tracker": "ik",
    "calibrate": "calibration",
    "fit_play": "play",
    "jacobian": "_numerics",
    "load_model": "persistence",
    "save_model": "persistence",
}


def __getattr__(name: str) -> Any:
    if name in _ROOM_OF:
        return getattr(import_module(f"hybridkin.{_ROOM_OF[name]}"), name)
    if name in __all__:
        return import_module(f"hybridkin.{name}")
    raise AttributeError(f"module 'hybridkin' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
