"""Hybrid mechanical and data-driven kinematics of soft and cable-driven robots."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hybridkin._core.first_use import on_first_use
from hybridkin._core.version import __version__

if TYPE_CHECKING:
    from hybridkin import datasets, native, plots
    from hybridkin._core.commands import Commands
    from hybridkin._core.model import ForwardModel, as_forward_model, jacobian
    from hybridkin.calibration.calibrate import CalibrationResult, calibrate
    from hybridkin.calibration.choice import GeometryChoice, choose_geometry
    from hybridkin.calibration.separate import SeparatingMotion, separating_motions
    from hybridkin.chains import robots
    from hybridkin.chains.chain import Chain
    from hybridkin.chains.constant_curvature import ConstantCurvatureChain
    from hybridkin.chains.elastic_tendons import ElasticTendonChain
    from hybridkin.chains.force_tendons import ForceTendonChain
    from hybridkin.chains.length_driven import LengthDrivenChain
    from hybridkin.chains.rigid import RigidChain
    from hybridkin.hybrid.choose_rows import choose_rows
    from hybridkin.hybrid.cross_fit import cross_fit
    from hybridkin.hybrid.estimator import HybridForwardModel
    from hybridkin.hybrid.held_out import CrossFit
    from hybridkin.hybrid.model_description import ModelDescription
    from hybridkin.hysteresis.value import Hysteresis
    from hybridkin.ik import obstacles, tasks, trajectories
    from hybridkin.ik.results import IKSolution, IKStatus, Step, Track
    from hybridkin.ik.solver import InverseKinematics
    from hybridkin.ik.tracker import Tracker
    from hybridkin.learning.elm import ELMRegressor
    from hybridkin.learning.elm_cv import ELMRegressorCV
    from hybridkin.saving.opened_model import open_model
    from hybridkin.saving.saved_model import load_model, save_model

__all__ = [
    "CalibrationResult",
    "Chain",
    "Commands",
    "ConstantCurvatureChain",
    "CrossFit",
    "ELMRegressor",
    "ELMRegressorCV",
    "ElasticTendonChain",
    "ForceTendonChain",
    "ForwardModel",
    "GeometryChoice",
    "HybridForwardModel",
    "Hysteresis",
    "IKSolution",
    "IKStatus",
    "InverseKinematics",
    "LengthDrivenChain",
    "ModelDescription",
    "RigidChain",
    "SeparatingMotion",
    "Step",
    "Track",
    "Tracker",
    "__version__",
    "as_forward_model",
    "calibrate",
    "choose_geometry",
    "choose_rows",
    "cross_fit",
    "datasets",
    "jacobian",
    "load_model",
    "native",
    "obstacles",
    "open_model",
    "plots",
    "robots",
    "save_model",
    "separating_motions",
    "tasks",
    "trajectories",
]

_NAMES_OF = {
    "_core.commands": ("Commands",),
    "_core.model": ("ForwardModel", "as_forward_model", "jacobian"),
    "calibration.calibrate": ("CalibrationResult", "calibrate"),
    "calibration.choice": ("GeometryChoice", "choose_geometry"),
    "calibration.separate": ("SeparatingMotion", "separating_motions"),
    "chains.chain": ("Chain",),
    "chains.constant_curvature": ("ConstantCurvatureChain",),
    "chains.elastic_tendons": ("ElasticTendonChain",),
    "chains.force_tendons": ("ForceTendonChain",),
    "chains.length_driven": ("LengthDrivenChain",),
    "chains.rigid": ("RigidChain",),
    "hybrid.choose_rows": ("choose_rows",),
    "hybrid.cross_fit": ("cross_fit",),
    "hybrid.held_out": ("CrossFit",),
    "hybrid.model_description": ("ModelDescription",),
    "saving.opened_model": ("open_model",),
    "hybrid.estimator": ("HybridForwardModel",),
    "hysteresis.value": ("Hysteresis",),
    "ik.results": ("IKSolution", "IKStatus", "Step", "Track"),
    "ik.solver": ("InverseKinematics",),
    "ik.tracker": ("Tracker",),
    "learning.elm": ("ELMRegressor",),
    "learning.elm_cv": ("ELMRegressorCV",),
    "saving.saved_model": ("load_model", "save_model"),
}
_FOLDER_OF = {
    "datasets": "",
    "native": "",
    "obstacles": "ik.",
    "plots": "",
    "robots": "chains.",
    "tasks": "ik.",
    "trajectories": "ik.",
}


_open_name = on_first_use(__name__, _NAMES_OF)


def __getattr__(name: str) -> Any:
    """Open public names on first use: torch and scikit-learn take seconds to import."""
    if name in _FOLDER_OF:
        return import_module(f"hybridkin.{_FOLDER_OF[name]}{name}")
    return _open_name(name)


def __dir__() -> list[str]:
    return __all__
