"""Hybrid mechanical and data-driven kinematics of soft and cable-driven robots."""

from hybridkin import robots
from hybridkin._numerics import jacobian
from hybridkin.calibration import CalibrationResult, calibrate
from hybridkin.chain import ConstantCurvatureChain
from hybridkin.elm import ELMRegressor
from hybridkin.hybrid import HybridForwardModel

__version__ = "0.1.0"

__all__ = [
    "CalibrationResult",
    "ConstantCurvatureChain",
    "ELMRegressor",
    "HybridForwardModel",
    "__version__",
    "calibrate",
    "jacobian",
    "robots",
]
