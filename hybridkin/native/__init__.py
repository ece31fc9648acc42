"""The compiled core: C kernels that evaluate models and inverse kinematics for NumPy arrays."""

from hybridkin.native.export import export_c
from hybridkin.native.library import available, backend, evaluate

__all__ = ["available", "backend", "evaluate", "export_c"]
