"""Hybrid mechanical and data-driven kinematics of soft and cable-driven robots."""

from hybridkin._numerics import jacobian
from hybridkin.calibration import CalibrationResult, calibrate
from hybridkin.chain import ConstantCurvatureChain

__version__ = "0.1.0"

__all__ = [
    "CalibrationResult",
    "ConstantCurvatureChain",
    "__version__",
    "calibrate",
    "jacobian",
]
