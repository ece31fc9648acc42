"""Hybrid mechanical and data-driven kinematics of soft and cable-driven robots."""

from hybridkin import datasets, robots, trajectories
from hybridkin._numerics import jacobian
from hybridkin.calibration import CalibrationResult, calibrate
from hybridkin.chain import ConstantCurvatureChain
from hybridkin.elm import ELMRegressor
from hybridkin.hybrid import HybridForwardModel
from hybridkin.ik import IKSolution, IKStatus, InverseKinematics, Step, Track
from hybridkin.persistence import load_model, save_model

__version__ = "0.1.0"

__all__ = [
    "CalibrationResult",
    "ConstantCurvatureChain",
    "ELMRegressor",
    "HybridForwardModel",
    "IKSolution",
    "IKStatus",
    "InverseKinematics",
    "Step",
    "Track",
    "__version__",
    "calibrate",
    "datasets",
    "jacobian",
    "load_model",
    "robots",
    "save_model",
    "trajectories",
]
