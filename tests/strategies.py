"""Hostile arrays for property tests, and what no call may change."""

import os
import random
import re
import warnings
from contextlib import contextmanager

import numpy as np
import torch
from hypothesis import strategies as st
from threadpoolctl import ThreadpoolController

SPECIAL = (np.nan, np.inf, -np.inf, 5e-324, -5e-324, -0.0, 0.0, 1e300, -1e300, 1e-300, 1e30, -1.0)
LAYOUTS = {
    "plain": np.array,
    "read-only": lambda a: _read_only(a),
    "fortran": np.asfortranarray,
    "strided": lambda a: np.repeat(a, 2, axis=-1)[..., ::2] if a.ndim else a.copy(),
    "negative strides": lambda a: a[::-1].copy()[::-1] if a.ndim else a.copy(),
    "unaligned": lambda a: np.frombuffer(b"\0" + a.tobytes(), a.dtype, a.size, 1).reshape(a.shape),
}
POOLS = ThreadpoolController()
ERRORS = (ValueError, TypeError, OSError, NotImplementedError)  # which the docstrings name


def _read_only(a):
    a = a.copy()
    a.flags.writeable = False
    return a


@st.composite
def arrays(draw, shape, low=-1.0, high=1.0, special=SPECIAL, dtypes=(np.float64, np.float32)):
    """Numbers of a shape in [low, high], up to three of `special` among them, in any layout.

    `shape` is a tuple or a strategy of tuples. A shrunk example is plain, float64, without any.
    """
    shape = draw(shape) if isinstance(shape, st.SearchStrategy) else shape
    values = np.random.default_rng(draw(st.integers(0, 9))).uniform(low, high, shape)
    if values.size and special:
        for value in draw(st.lists(st.sampled_from(special), max_size=3)):
            values.flat[draw(st.integers(0, values.size - 1))] = value
    with np.errstate(over="ignore", under="ignore"):
        values = values.astype(draw(st.sampled_from(dtypes)))
    return LAYOUTS[draw(st.sampled_from(sorted(LAYOUTS, key=list(LAYOUTS).index)))](values)


def tensors(shape, low=-1.0, high=1.0, special=SPECIAL, dtypes=(torch.float64, torch.float32)):
    """Tensors as `arrays` gives them, some expanded, transposed or strided."""

    def tensor(values, dtype, layout):
        plain = torch.tensor(values.copy(), dtype=dtype)
        if layout == "strided" and plain.ndim:
            return plain.repeat_interleave(2, -1)[..., ::2]
        if layout == "transposed":
            return plain.T.contiguous().T if plain.ndim == 2 else plain
        return plain.expand(2, *plain.shape)[0] if layout == "expanded" else plain

    layouts = st.sampled_from(["plain", "strided", "transposed", "expanded"])
    numbers = arrays(shape, low, high, special, (np.float64,))
    return st.builds(tensor, numbers, st.sampled_from(dtypes), layouts)


def _state(inputs):
    plain = [isinstance(a, torch.Tensor) and a.device.type == "cpu" for a in inputs]
    arrays = [a.detach().numpy() if ok else a for a, ok in zip(inputs, plain, strict=True)]
    return {
        "inputs": [a.tobytes() if isinstance(a, np.ndarray) else repr(a) for a in arrays],
        "seeds": (
            random.getstate(),
            np.random.get_state()[1].tobytes(),  # noqa: NPY002
            torch.random.get_rng_state().numpy().tobytes(),
        ),
        "torch": (torch.get_default_dtype(), torch.get_num_threads(), torch.is_grad_enabled()),
        "threads": [pool.num_threads for pool in POOLS.lib_controllers],
        "warnings": list(warnings.filters),
        "NumPy's errors": np.geterr(),
        "environment": dict(os.environ),
        "folder": os.getcwd(),
    }


@contextmanager
def untouched(*inputs):
    """Assert that inputs and the settings of the process are the same after the block.

    Also after one that raises.
    """
    before = _state(inputs)
    try:
        yield
    finally:
        after = _state(inputs)
        for name, value in before.items():
            assert after[name] == value, f"{name} changed"


def answer(function, *args, **kwargs):
    """Return what a call gives and None, or None and its error, which must be one of ours.

    That is one of `ERRORS`, or another one that begins so, whose message names something in
    backticks, or a file given. A warning must do so too. Arguments and settings stay untouched.
    """
    files = [str(a) for a in (*args, *kwargs.values()) if isinstance(a, (str, os.PathLike)) and a]

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with untouched(*args, *kwargs.values()):
            try:
                value, error = function(*args, **kwargs), None
            except Exception as raised:
                if not (isinstance(raised, ERRORS) or str(raised).startswith("`")):
                    raise
                value, error = None, raised
    for said in [warning.message for warning in caught] + ([] if error is None else [error]):
        named = "`" in str(said) or any(file in str(said) for file in files)
        assert named, f"{type(said).__name__}: {said}"
    return value, error


_NAMED = re.compile(r"\b([Xy]|[Ss]amples?|sample_weight|n_splits|array|parameter|weights)\b")


def named(function):
    """Return a function whose messages that name X, y or the weights have a backtick."""

    def call(*args, **given):
        try:
            return function(*args, **given)
        except ValueError as error:
            if _NAMED.search(str(error)):
                raise ValueError(f"`{error}`") from error
            raise

    return call
