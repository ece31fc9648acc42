"""The compiled library: how it is found and checked, and how models are computed by it."""

from __future__ import annotations

import ctypes
import os
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.model import ForwardModel
from hybridkin.native.plan import Plan

_FOLDER = Path(__file__).parent / "lib"


@cache
def library() -> ctypes.CDLL | None:
    """Return the compiled library, None where there is none."""
    path = _FOLDER / "hk.so"
    if os.environ.get("HYBRIDKIN_NATIVE") == "off" or not path.exists():
        return None
    return ctypes.CDLL(str(path))


def available() -> bool:
    """Return whether the compiled core is there; without it all is computed by torch."""
    return library() is not None


class Program:
    """A model that the compiled core computes."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._code = plan.code.ctypes.data_as(ctypes.c_void_p)
        self._data = plan.data.ctypes.data_as(ctypes.c_void_p)

    def evaluate(self, q: NDArray, jacobian: bool = False, distance: bool = False):
        n, m, lead = self.plan.n_inputs, self.plan.n_outputs, q.shape[:-1]
        q = np.ascontiguousarray(q, dtype=np.float64)
        x = np.empty((*lead, m))
        J = np.empty((*lead, m, n)) if jacobian else None
        d = np.empty(lead) if distance else None
        pointers = [None if a is None else ctypes.c_void_p(a.ctypes.data) for a in (q, x, J, d)]
        library().hk_evaluate(
            self._code,
            self._data,
            ctypes.c_int32(self.plan.root),
            pointers[0],
            ctypes.c_int64(q.size // n),
            *pointers[1:],
        )
        return x, J, d


def program_of(model: ForwardModel) -> Program:
    """Return the program of a model, raises NoKernel."""
    return Program(Plan(model.stored()))
