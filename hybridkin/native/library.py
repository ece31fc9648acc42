"""The compiled library: find it, check it, and evaluate models with it."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin._core.kernel_numbers import (
    ACTIVATIONS,
    HK_DISTANCE,
    HK_GROUP,
    HK_IF_SAME,
    HK_J,
    checksum,
)
from hybridkin._core.model import ForwardModel
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.portable import PortableModule
from hybridkin.native._installation import compiling_command, warn_of_slow_models, without_kernels

_FOLDER = Path(__file__).parent
_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
_LEVELS = {"hk_v2": 2, "hk_v3": 3, "hk_v4": 4}  # smallest hk_level() of each
_CHUNK = 20_000  # rows per task of a thread
_BYTE = ctypes.c_char

Results = tuple[NDArray[np.float64], ...]


def library() -> ctypes.CDLL | None:
    """Return the compiled library, or None if there is none."""
    return _opened()[0]


def opened_library() -> ctypes.CDLL:
    """Return the compiled library; RuntimeError if there is none."""
    opened, reason = _opened()
    if opened is None:
        raise RuntimeError(f"the compiled core is not available: {reason}.")
    return opened


def available() -> bool:
    """Return whether the compiled core is available; without it torch computes everything.

    The environment variable HYBRIDKIN_NATIVE=off turns the core off.
    """
    return library() is not None


def backend(model: ForwardModel) -> str:
    """Return how a model is computed for NumPy arrays: "compiled", or "torch: " and a reason."""
    opened, reason = _opened()
    if opened is not None:
        program_of(model)
        reason = vars(model)["_program"].reason
    if reason:
        return f"torch: {reason}"
    return "compiled"


@cache
def _opened() -> tuple[ctypes.CDLL | None, str]:
    """Return the fastest library that this processor can run, or the reason why there is none."""
    if _is_off():
        return None, "HYBRIDKIN_NATIVE=off"
    paths = _compiled_files()
    if not paths:
        return None, without_kernels()
    reason = "no variant of the compiled library is for this processor"
    try:
        level = ctypes.CDLL(str(paths[0])).hk_level()
        for path in reversed(paths):
            if _LEVELS.get(path.stem, 0) <= level:
                opened = ctypes.CDLL(str(path))
                fault = _fault(opened)
                if not fault:
                    return opened, ""
                reason = f"{path.name} {fault}; compile it anew by `{compiling_command()}`"
    except (OSError, AttributeError) as error:
        reason = (
            f"the compiled library cannot be used ({error}); compile it anew by "
            f"`{compiling_command()}`"
        )
    warn_of_slow_models(reason)
    return None, reason


def _is_off() -> bool:
    """Return whether the user has turned the core off."""
    return os.environ.get("HYBRIDKIN_NATIVE") == "off"


def _compiled_files() -> list[Path]:
    """Return the compiled libraries, the fastest last; HYBRIDKIN_NATIVE can name a variant."""
    variant = os.environ.get("HYBRIDKIN_NATIVE") or "*"
    return sorted((_FOLDER / "lib").glob(f"hk_{variant}{_SUFFIX}"))


def _fault(opened: ctypes.CDLL) -> str:
    """Return what is wrong with a library, or an empty string."""
    if opened.hk_sources() & 0xFFFFFFFF != checksum(_FOLDER / "src"):
        return "was compiled from other sources"
    pointer = ctypes.c_void_p
    results = [pointer] * 3
    opened.hk_evaluate.argtypes = [
        pointer,
        pointer,
        ctypes.c_int64,
        *results,
        ctypes.c_double,
    ]
    opened.hk_changed.argtypes = [pointer, ctypes.c_int64]
    opened.hk_evaluate_row.argtypes = [
        pointer,
        pointer,
        ctypes.c_int32,
        ctypes.c_double,
    ]
    opened.hk_work.argtypes = [pointer, ctypes.c_int32]
    opened.hk_work.restype = ctypes.c_int64
    opened.hk_ik_tick.argtypes = [pointer]
    opened.hk_evaluate.restype = None
    opened.hk_hysteresis_rows.restype = None
    sizes = [ctypes.c_int64, ctypes.c_int32, ctypes.c_int32, ctypes.c_double]
    opened.hk_hysteresis_rows.argtypes = [*sizes, *[pointer] * 6]
    if not _is_right(opened):
        return "computes wrong numbers"
    return ""


def _is_right(opened: ctypes.CDLL) -> bool:
    """Return whether arcs and logistic units match their closed forms and finite differences."""
    # Two equal segments form one arc of length r [m] that bends by t [rad] in the direction a.
    r = 0.7
    a = 0.3
    t = np.array([0.5, 2.0, 3.0, 5.0, 9.0])
    side = r * (1.0 - np.cos(t)) / t
    x = np.stack([side * np.cos(a), side * np.sin(a), r * np.sin(t) / t], 1)
    q = np.stack([t * np.cos(a), t * np.sin(a), 0.0 * t + r], 1)
    beside = q[:, None, None] + 1e-5 * np.stack([np.eye(3), -np.eye(3)])
    for write, right in ((_two_halves, x), (_three_units, 1.0 / (1.0 + np.exp(-q)))):
        program = Program(Plan(write), opened)
        (x_beside,) = program.evaluate(beside)
        ahead, behind = x_beside.swapaxes(0, 1)
        slopes = np.swapaxes(ahead - behind, 1, 2) / 2e-5
        # All rows at once, then one by one.
        for rows in (slice(None), *range(len(q))):
            y, J = program.evaluate(q[rows], True)
            value_error = np.abs(y - right[rows]).max()
            slope_error = np.abs(J - slopes[rows]).max()
            if not (value_error < 1e-12 and slope_error < 1e-8):
                return False
    return True


def _two_halves(plan: Plan) -> int:
    """Write a chain of two equal arcs; q is their common bending, x and y, and their length."""
    identity = np.eye(3)
    frame = np.concatenate([identity.ravel(), np.zeros(3), [1.0], np.zeros(2)])
    half = 0.5 * identity[[2, 0, 1]]
    numbers = [frame, np.zeros((2, 3)), half, half]
    return plan.node("arcs", 3, 3, numbers, 2, 0, 3)


def _three_units(plan: Plan) -> int:
    """Write three logistic units, one for each input."""
    units = np.zeros((HK_GROUP, 7))
    units[:3] = np.column_stack([np.eye(3), np.zeros(3), np.eye(3)])
    numbers = [np.zeros(3), np.ones(3), np.zeros(3), np.zeros((3, 3)), units.T]
    activation = ACTIVATIONS.index("logistic")
    return plan.node("elm", 3, 3, numbers, 3, activation, 0, 0, aligned=True)


class Call:
    """A plan with memory to compute in: what functions of the library are called with.

    Only one thread at a time may use it.

    Parameters
    ----------
    plan : Plan
        The plan.
    opened : ctypes.CDLL
        The library.
    more : int
        Further pointers that a function needs.

    Attributes
    ----------
    place : int
        The address to call functions with.
    """

    def __init__(self, plan: Plan, opened: ctypes.CDLL, *more: int) -> None:
        head = plan.code.ctypes.data, plan.data.ctypes.data, plan.root
        self._work = np.empty(opened.hk_work(head[0], plan.root))
        self._pointers = np.array([*head, self._work.ctypes.data, *more])
        self.place = self._pointers.ctypes.data


class Sources:
    """Arrays that a plan was made of, to see whether they have changed since.

    Parameters
    ----------
    arrays : list of (ndarray, ndarray)
        Each with a copy of what it held.
    """

    def __init__(self, arrays: Sequence[tuple[NDArray, NDArray]] = ()) -> None:
        self._arrays = arrays
        table = [(a.ctypes.data, b.ctypes.data, a.nbytes) for a, b in arrays]
        self._table = np.array(table, dtype=np.int64)  # of hk_source
        self.pointers = self._table.ctypes.data, len(arrays)

    def changed(self) -> bool:
        """Return whether any of them holds other bytes."""
        return opened_library().hk_changed(*self.pointers) > 0


_NO_SOURCES = Sources()


class ThreadCall(threading.local, Call):
    """A call that has memory of its own in every thread, also for the results of one row."""

    def __init__(self, plan: Plan, opened: ctypes.CDLL, sources: Sources = _NO_SOURCES) -> None:
        self.results = np.empty(plan.n_outputs * (1 + plan.n_inputs) + 1)
        at_results = self.results.ctypes.data
        super().__init__(plan, opened, at_results, *sources.pointers)  # hk_row


class Program:
    """A model that the compiled core evaluates.

    Parameters
    ----------
    plan : Plan
        The model.
    opened : ctypes.CDLL, optional
        The library. Default: `library()`.
    sources : Sources, optional
        What the plan was made of, for HK_IF_SAME.
    """

    def __init__(
        self,
        plan: Plan,
        opened: ctypes.CDLL | None = None,
        sources: Sources = _NO_SOURCES,
    ) -> None:
        opened = opened or opened_library()
        self.plan = plan
        self._sizes = plan.n_inputs, plan.n_outputs
        self._evaluate = opened.hk_evaluate
        self._evaluate_row = opened.hk_evaluate_row
        self._sources = sources
        self._call = ThreadCall(plan, opened, sources)

    def __reduce__(self) -> tuple[type[Program], tuple[Plan]]:
        return Program, (self.plan,)

    def evaluate(
        self,
        q: NDArray,
        jacobian: bool = False,
        distance: bool = False,
        enough: float = 0.0,
    ) -> Results:
        """Return those of x (..., m), dx/dq (..., m, n) and domain distance (...) asked for.

        More than 20,000 rows are shared among the threads that torch may use. The number of
        threads does not change the result.

        Parameters
        ----------
        q : ndarray of shape (..., n)
            Actuator vectors, any strides.
        jacobian : bool, default=False
            Whether to compute dx/dq.
        distance : bool, default=False
            Whether to compute the domain distance.
        enough : float, default=0.0
            Instead of a distance up to this, any number between the two may be returned.
        """
        lead = q.shape[:-1]
        n, m = self._sizes
        if q.size == n == q.shape[-1]:
            wanted = HK_J * jacobian + HK_DISTANCE * distance
            results = self.row(np.asarray(q, np.float64), wanted, enough)
            assert results is not None
            return results
        x = np.empty((*lead, m))
        J = np.empty((*lead, m, n)) if jacobian else None
        d = np.empty(lead) if distance else None
        self._fill(q, [(x, m), (J, m * n), (d, 1)], enough)
        return tuple([a for a in (x, J, d) if a is not None])

    def row(self, q: NDArray, wanted: int, enough: float) -> Results | None:
        """Return the results of one row (..., n), quickly: they share an array.

        None with HK_IF_SAME in what is asked for, if the sources have changed.
        """
        call = self._call
        if self._evaluate_row(call.place, q.tobytes(), wanted, enough):
            return None
        lead = q.shape[:-1]
        n, m = self._sizes
        numbers = call.results.copy()
        results = (numbers[:m].reshape(*lead, m),)
        if wanted & HK_J:
            results += (numbers[m:-1].reshape(*lead, m, n),)
        if wanted & HK_DISTANCE:
            results += (numbers[-1:].reshape(lead),)
        return results

    def domain(
        self, q: NDArray, slope: bool = False, enough: float = 0.0
    ) -> tuple[NDArray, NDArray | None]:
        """Return the domain distance (...) at q (..., n), and its gradient (..., n) or None."""
        d = np.empty(q.shape[:-1])
        slopes = np.empty(q.shape) if slope else None
        self._fill(q, [(None, 0), (slopes, self._sizes[0]), (d, 1)], enough)
        return d, slopes

    def _fill(self, q: NDArray, results: list[tuple[NDArray | None, int]], enough: float) -> None:
        n = self._sizes[0]
        if q.shape[-1] != n:
            raise ValueError(f"`q` must have shape (..., {n}), got {q.shape}.")
        if q.size == 0:
            return
        q = np.ascontiguousarray(q, np.float64)
        at_q = q.ctypes.data

        def run(start: int, count: int) -> None:
            places = []
            for a, width in results:
                at = None
                if a is not None:
                    at = address(a) + 8 * width * start
                places.append(at)
            self._evaluate(self._call.place, at_q + 8 * n * start, count, *places, enough)

        in_chunks(q.size // n, run)


def in_chunks(rows: int, run: Callable[[int, int], None]) -> None:
    """Call ``run(start, count)`` for chunks of rows, in the threads that torch may use."""
    starts = range(0, rows, _CHUNK)
    counts = [min(_CHUNK, rows - start) for start in starts]
    threads = min(len(starts), torch.get_num_threads())
    if threads < 2:
        for start, count in zip(starts, counts, strict=True):
            run(start, count)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(run, starts, counts))


def address(a: NDArray) -> int:
    """Return the address of a contiguous, writable array; faster than `a.ctypes`."""
    return ctypes.addressof(_BYTE.from_buffer(a))  # pyright: ignore[reportArgumentType]


class _Compiled:
    """The program of a model, and what it was made of.

    A tensor counts with its place in memory and its bytes, because writes through ``.data`` or
    NumPy do not change its version. The program itself sees writes to large tensors, see `Plan`.
    """

    def __init__(self, model: ForwardModel) -> None:
        self.program = None
        self.row_shape = None
        self.reason = ""
        self.tensors = []
        self.sources = Sources()
        self.shared = Sources()
        self.dicts = []
        self.settings = []
        modules = [*model.modules()]
        for module in modules:
            for parts in (module._modules, module._buffers, module._parameters):
                if parts:
                    self.dicts.append(parts)
            if isinstance(module, PortableModule):
                for name in module.layout.settings:
                    self.settings.append((vars(module), name))
        self.parts = [dict(parts) for parts in self.dicts]
        self._remember()
        try:
            _check_classes(modules)
            tensors = _described_tensors(modules)
            if any(a.device.type != "cpu" or a.is_inference() for a in tensors):
                raise NoKernel("the compiled core needs tensors on the CPU, no inference tensors")
            self.tensors = tensors
            memory = [*map(_memory, tensors)]
            copies = [a.copy() for a in memory]
            self._remember()
            plan = Plan(model.stored(), shares=True)
            self._set_sources(plan, memory, copies)
            self.program = Program(plan, sources=self.sources)
            self.row_shape = (1, plan.n_inputs)
        except (ValueError, TypeError) as error:
            self.reason = str(error).split(";")[0]

    def _set_sources(self, plan: Plan, memory: list[NDArray], copies: list[NDArray]) -> None:
        """Keep the tensors that the plan shares apart from the others."""
        places = {array.ctypes.data for array in plan.shared.values()}
        own = []
        shared = []
        for place, *arrays in zip(self.places, memory, copies, strict=True):
            if place in places:
                shared.append(arrays)
            else:
                own.append(arrays)
        self.sources = Sources(own)
        self.shared = Sources(shared)

    def _remember(self) -> None:
        """Remember the places of the tensors and the settings."""
        self.places = [*map(Tensor.data_ptr, self.tensors)]
        movable = [a for a in self.tensors if _can_be_strided(a)]
        self.contiguous = [a for a in movable if a.is_contiguous()]
        self.strided = [a for a in movable if not a.is_contiguous()]
        self.strides = [*map(Tensor.stride, self.strided)]
        self.values = self._values()

    def _values(self) -> list[object]:
        """Return the present values of the settings."""
        return [attributes.get(name) for attributes, name in self.settings]

    def holds(self) -> bool:
        """Return whether the model still has the same tensors, in the same places, and settings."""
        try:
            if self.dicts != self.parts:  # identity first; else tensors are compared
                return False
        except RuntimeError:
            return False
        return (
            self.values == self._values()
            and [*map(Tensor.data_ptr, self.tensors)] == self.places
            and all(map(Tensor.is_contiguous, self.contiguous))
            and [*map(Tensor.stride, self.strided)] == self.strides
        )


def _memory(a: Tensor) -> NDArray:
    """Return the memory that a tensor reads."""
    whole = torch.empty(0, dtype=a.dtype, device=a.device)
    return whole.set_(a.untyped_storage()).numpy()


def _can_be_strided(a: Tensor) -> bool:
    """Return whether the same memory can hold as many numbers in another order."""
    return a.ndim > 1 or a.untyped_storage().nbytes() > a.nbytes


def _described_tensors(modules: list[torch.nn.Module]) -> list[Tensor]:
    """Return the tensors that a plan is made of; others are computed from them."""
    tensors = []
    for module in modules:
        if isinstance(module, PortableModule):
            tensors += module.entries()
    return [a for a in tensors if a is not None]


def _check_classes(modules: list[torch.nn.Module]) -> None:
    """Raise NoKernel for classes that inherit their layout: they may compute something else."""
    for module in modules:
        if isinstance(module, PortableModule) and "layout" not in vars(type(module)):
            raise NoKernel(f"a {type(module).__name__} has no kernel")


def program_of(model: ForwardModel, copies: bool = True) -> Program | None:
    """Return the program of a model, or None if torch computes it; see `backend`.

    The model keeps its program until a buffer or a submodule changes. Without `copies` of the plan,
    also while large buffers change that the program shares, which takes less time to find out.
    """
    if library() is None:
        return None
    compiled = model.__dict__.get("_program")
    if (
        compiled is None
        or not compiled.holds()
        or compiled.sources.changed()
        or (copies and compiled.shared.changed())
    ):
        compiled = model.__dict__["_program"] = _Compiled(model)
    return compiled.program


def evaluate(
    model: ForwardModel,
    q: ArrayLike,
    value: bool = True,
    jacobian: bool = False,
    distance: bool = False,
    enough: float = 0.0,
) -> tuple[NDArray, ...]:
    """Return the requested results of a model for NumPy rows, by the compiled core if it can.

    Parameters
    ----------
    model : ForwardModel
        A chain, or the ``module_`` of a fitted hybrid.
    q : array-like of shape (..., n)
        Actuator vectors [m or rad].
    value : bool, default=True
        Whether to compute x; with `jacobian` it always is.
    jacobian : bool, default=False
        Whether to compute dx/dq.
    distance : bool, default=False
        Whether to compute the domain distance; 1 is the edge of the domain.
    enough : float, default=0.0
        Instead of a distance up to this, any number between the two may be returned, which takes
        less time.

    Returns
    -------
    tuple of ndarray
        Those that are asked for of x (..., m) [m], dx/dq (..., m, n) and the distance (...).

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import ConstantCurvatureChain, native
    >>> chain = ConstantCurvatureChain([0.1])
    >>> x, J = native.evaluate(chain, np.full((2, 3), 0.2), jacobian=True)
    >>> x.shape, J.shape
    ((2, 3), (2, 3, 3))
    """
    q = np.asarray(q, np.float64)
    compiled = model.__dict__.get("_program")
    if value and compiled is not None and q.shape == compiled.row_shape and compiled.holds():
        wanted = HK_IF_SAME + HK_J * jacobian + HK_DISTANCE * distance
        results = compiled.program.row(q, wanted, enough)
        if results is not None:
            return results
    program = program_of(model, copies=False)
    if program is not None:
        if not (value or jacobian):
            return (program.domain(q, enough=enough)[0],)
        return program.evaluate(q, jacobian, distance, enough)
    rows = torch.from_numpy(np.require(q, requirements="W"))
    results = []
    with torch.no_grad():
        if jacobian:
            results += model.forward_and_jacobian(rows)
        elif value:
            results.append(model(rows))
        if distance:
            results.append(model.domain_distance(rows))
    return tuple(part.numpy() for part in results)


if not (_is_off() or _compiled_files()):  # said as soon as the core is imported
    warn_of_slow_models(without_kernels())
