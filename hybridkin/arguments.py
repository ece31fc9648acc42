"""Checks of a caller's arguments, for tools that build on hybridkin.

Each returns the checked value, or raises an error that names the argument, the need, what came, and
the way out.
"""

from hybridkin._core.arrays import (
    as_path,
    number,
    one_of,
    real_array,
    shaped,
    whole,
)
from hybridkin._core.other_units import check_tips

__all__ = [
    "as_path",
    "check_tips",
    "number",
    "one_of",
    "real_array",
    "shaped",
    "whole",
]
