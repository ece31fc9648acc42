"""The compiled core: C kernels that evaluate models and inverse kinematics for NumPy arrays."""

from hybridkin.native.export import export_c
from hybridkin.native.fmu import export_fmu
from hybridkin.native.library import available, backend, evaluate
from hybridkin.native.mex import export_mex

__all__ = ["available", "backend", "evaluate", "export_c", "export_fmu", "export_mex"]
