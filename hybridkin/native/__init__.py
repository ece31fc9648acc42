"""The compiled core: kernels in C that compute models and inverse kinematics for NumPy arrays."""

from hybridkin.native.library import available, backend

__all__ = ["available", "backend"]
