"""Steps, ticks and searches with the compiled core, for tasks that have kernels."""

from __future__ import annotations

import ctypes
import dataclasses
import math
from struct import Struct
from struct import error as StructError
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.kernel_numbers import (
    IK_AT_REST,
    IK_DAMPING,
    IK_DISTANCE,
    IK_ERROR,
    IK_FEED,
    IK_FROM_REST,
    IK_HAS_FEED,
    IK_HAS_TARGET,
    IK_HAS_TIP,
    IK_HELD,
    IK_LAST,
    IK_LOWERS,
    IK_MEMORY,
    IK_MODE,
    IK_MUST_SEE,
    IK_PERIOD,
    IK_Q,
    IK_REACHED,
    IK_SIGMA_MIN,
    IK_TARGET,
    IK_TIP,
    IK_TO_DOMAIN,
    IK_TO_POSTURE,
    IK_X,
)
from hybridkin._core.plan import NoKernel, Plan
from hybridkin.ik._search import Found, Point, Search
from hybridkin.ik._settings import StepSettings
from hybridkin.ik._step import StepRows
from hybridkin.ik.tasks import PositionTask, Task, Tolerance
from hybridkin.native.library import (
    Call,
    Program,
    backend,
    in_chunks,
    opened_library,
    program_of,
)

_FLOAT64 = np.dtype(np.float64)
_write_point = Struct("3d").pack_into


class Tick(NamedTuple):
    """Results of a tick, as single rows: q, the model there, the error, and the step."""

    q: Tensor
    x: Tensor
    J: Tensor
    e: Tensor
    step: StepRows


def core_of(settings: StepSettings, search: bool = False) -> Core | None:
    """Return the core of settings, or None if a part of the task has no kernel.

    Poses have kernels for the search only. The core is kept with the settings, and made again if
    the model has changed.
    """
    program = vars(settings).get("_program")
    model = program_of(settings.task.models[0])
    if program is None or program[0] is not model:
        try:
            program = model, None if model is None else Core(settings, model), ""
        except (NoKernel, TypeError) as error:
            program = model, None, str(error)
        object.__setattr__(settings, "_program", program)
    return program[1] if search or settings.task.parts == (3,) else None


def why_torch(settings: StepSettings) -> str:
    """Return why settings that `core_of` has seen have no core for a step."""
    reason = vars(settings)["_program"][2] or "only positions have a kernel of a step"
    model = backend(settings.task.models[0])
    return reason if model == "compiled" else model.removeprefix("torch: ")


class Core:
    """Inverse kinematics of one task with the compiled core.

    Parameters
    ----------
    settings : StepSettings
        Task, limits, posture and rates.
    model : Program
        The model of the task.

    Attributes
    ----------
    settings : StepSettings
        The settings, with a task evaluated by the core.
    n : int
        Number of actuators.
    """

    def __init__(self, settings: StepSettings, model: Program) -> None:
        self.plan = Plan(settings.stored())
        self._made_of = (settings, model)
        self.n = self.plan.n_inputs
        self.program = model
        self.settings = settings
        self.rows = sum(settings.task.parts)
        if self.rows == 3:
            self.settings = dataclasses.replace(
                settings, task=_CoreTask(settings.task, model)
            )
        self._call = Call(self.plan, opened_library())
        self._idle: list[Follower] = []  # one for every thread that has used `step`
        n = self.n
        self._places = {
            "dq": slice(IK_Q + n, IK_Q + 2 * n),
            "x": slice(IK_X, IK_ERROR),
            "error": (IK_DISTANCE, ...),
            "sigma_min": (IK_SIGMA_MIN, ...),
            "damping": (IK_DAMPING, ...),
            "saturated": slice(IK_Q + 3 * n, IK_Q + 4 * n),
        }

    def __reduce__(self) -> tuple[type[Core], tuple[StepSettings, Program]]:
        return Core, self._made_of

    def step(
        self, q: object, target: object, dx: object, tip: object
    ) -> tuple[NDArray, dict] | None:
        """Return the state of a step of one row and the places of its fields; else None."""
        if type(q) is not np.ndarray or q.dtype is not _FLOAT64 or q.shape != (self.n,):
            return None
        try:
            follower = self._idle.pop()
        except IndexError:  # other threads use them
            follower = Follower(self, None, IK_MUST_SEE + IK_FROM_REST)
        follower.q[...] = q
        if follower.tick(target, dx, tip):
            result = (follower.state.copy(), self._places)
        else:
            result = None
        self._idle.append(follower)
        return result

    def steps(
        self,
        q: Tensor,
        target: Tensor,
        feed: Tensor | None,
        tip: Tensor | None,
        last: Tensor | None,
    ) -> tuple[Tensor, ...]:
        """Return dq, x, error, sigma_min, damping and held actuators, for rows q (N, n).

        `feed` is the motion of the targets in a period, `tip` the measured tips, and `last` the
        previous steps.
        """
        n = self.n
        out = np.empty((len(q), n + 6))
        held = np.empty((len(q), n), dtype=bool)
        arrays = [
            None if a is None else _plain(a) for a in (q, target, feed, tip, last)
        ]
        mode = ctypes.c_int32(IK_MUST_SEE | _mode(target, feed, tip))
        self._run("hk_ik_steps", len(q), [mode], [*arrays, out, held])
        dq, x, numbers = torch.from_numpy(out).split([n, 3, 3], dim=1)
        return dq, x, *numbers.unbind(1), torch.from_numpy(held)

    def search(self, tol: Tolerance, max_iter: int) -> Search:
        """Return the search for configurations that reach targets."""
        return _CoreSearch(self.settings, tol, max_iter, self)

    def find(
        self, mode: int, q: Tensor, target: Tensor, tol: Tolerance, max_iter: int
    ) -> Found:
        """Return the result of `hk_ik_find` for starts q (N, n)."""
        n_rows = len(q)
        best = _plain(q).copy()
        J = np.empty((n_rows, self.rows, self.n))
        e = np.empty((n_rows, self.rows))
        outcome = np.empty(n_rows, dtype=np.int32)
        n_iter = np.empty(n_rows, dtype=np.int32)
        metres, radians = (*tol, 0.0)[:2] if isinstance(tol, tuple) else (tol, 0.0)
        tolerances = metres, radians * self.settings.task.units[-1]
        numbers = [
            *map(ctypes.c_int32, (mode, max_iter)),
            *map(ctypes.c_double, tolerances),
        ]
        self._run(
            "hk_ik_find", n_rows, numbers, [_plain(target), best, J, e, outcome, n_iter]
        )
        error = torch.from_numpy(e)
        result = torch.from_numpy(outcome)
        iterations = torch.from_numpy(n_iter).long()
        return Found(
            torch.from_numpy(best),
            target - error
            if self.rows == 3
            else torch.full_like(target, math.nan),  # not used
            torch.from_numpy(J),
            error,
            target.clone(),
            reached=result & IK_REACHED > 0,
            stationary=result & IK_AT_REST > 0,
            held=result & IK_HELD > 0,
            n_iter=iterations,
            n_starts=torch.ones_like(iterations),
        )

    def _run(
        self, name: str, rows: int, numbers: list[Any], arrays: list[NDArray | None]
    ) -> None:
        """Call a function of the library for all rows of arrays."""
        function = getattr(opened_library(), name)
        places = [None if a is None else (a.ctypes.data, a.strides[0]) for a in arrays]

        def run(start: int, count: int) -> None:
            at = [
                p if p is None else ctypes.c_void_p(p[0] + start * p[1]) for p in places
            ]
            call = ctypes.c_void_p(self._call.place)
            function(call, ctypes.c_int64(count), *numbers, *at)

        in_chunks(rows, run)


class Follower:
    """Follows targets with the core; the state is one array of numbers.

    Parameters
    ----------
    core : Core
        The core that computes.
    memory : float, optional
        Time constant of the measured offset [s].
    mode : int, default=0
        Bits of the mode of `ik_tick` that are always set.
    state : ndarray, optional
        State of a follower to continue.
    """

    backend = "compiled"

    def __init__(
        self,
        core: Core,
        memory: float | None,
        mode: int = 0,
        state: NDArray | None = None,
    ) -> None:
        self.core = core
        self._memory = memory
        self._least = mode
        n = core.n
        self.state = state = np.zeros(IK_Q + 7 * core.n) if state is None else state
        self.task = core.settings.task
        self._dt = state[IK_PERIOD] = core.settings.dt
        state[IK_MEMORY] = memory or 0.0
        self.q = state[IK_Q : IK_Q + n]
        self._bytes = memoryview(state).cast("B")  # pyright: ignore[reportArgumentType]
        self._inputs = {at: state[at : at + 3] for at in (IK_TARGET, IK_FEED, IK_TIP)}
        self._call = Call(core.plan, opened_library(), state.ctypes.data)  # ik_follower
        self._follow = opened_library().hk_ik_tick
        self._mode = -1

    def __reduce__(self) -> tuple[type[Follower], tuple]:
        return Follower, (self.core, self._memory, self._least, self.state.copy())

    def start(self, q: Tensor, dq: Tensor) -> None:
        """Set the initial configuration (1, n), and the step that led to it."""
        state = self.state
        n = self.core.n
        state[IK_SIGMA_MIN:] = 0.0
        state[[IK_SIGMA_MIN, IK_DISTANCE, *range(IK_ERROR, IK_Q)]] = math.nan
        state[IK_X:IK_ERROR] = self.core.settings.evaluate(q)[0][0]
        state[IK_LAST] = self._dt
        state[IK_Q + n : IK_Q + 2 * n] = dq[0]
        self.q[:] = state[IK_Q + 2 * n : IK_Q + 3 * n] = q[0]

    def tick(self, target: object, dx: object, tip: object) -> bool:
        """Do a tick with plain arrays: the target, its velocity, the measured tip.

        Returns False, and does nothing, if one of them needs full checks.
        """
        mode = self._least | IK_HAS_TARGET
        if not self._put(IK_TARGET, target):
            return False
        if dx is not None:
            if not self._put(IK_FEED, dx):
                return False
            self._inputs[IK_FEED] *= self._dt
            mode |= IK_HAS_FEED
        if tip is not None:
            if not self._put(IK_TIP, tip):
                return False
            mode |= IK_HAS_TIP
        if mode != self._mode:
            self.state[IK_MODE] = self._mode = mode
        self._follow(self._call.place)
        return True

    def _put(self, at: int, point: object) -> bool:
        """Write a point into the state, if it is an array or a list of three numbers."""
        if type(point) is np.ndarray:
            if point.dtype is not _FLOAT64 or point.shape != (3,):
                return False
            self._inputs[at][...] = point
            return True
        if type(point) is not list and type(point) is not tuple:
            return False
        try:
            _write_point(self._bytes, 8 * at, *point)
        except (StructError, OverflowError):
            return False
        return True

    def advance(self, period: float | None, *inputs: Tensor | None) -> Tick:
        """Do a tick with checked rows: the target, its motion in the period, the measured tip."""
        for place, rows in zip(self._inputs.values(), inputs, strict=True):
            if rows is not None:
                place[...] = rows.reshape(3).numpy()
        mode = self._least | _mode(*inputs)
        self.state[IK_MODE] = self._mode = mode
        self.state[IK_PERIOD] = period or self._dt
        self._follow(self._call.place)
        self.state[IK_PERIOD] = self._dt
        return self.last()

    @property
    def command(self) -> NDArray:
        """The present command (n,)."""
        return self.q.copy()

    def last(self) -> Tick:
        """Return the results of the last tick."""
        a = torch.from_numpy(self.state.copy())[None]
        n = self.core.n
        _, dq, before, held, J = a[:, IK_Q:].split([n, n, n, n, 3 * n], dim=1)
        step = StepRows(dq, a[:, IK_SIGMA_MIN], a[:, IK_DAMPING], held > 0.0)
        return Tick(
            before, a[:, IK_X:IK_ERROR], J.view(1, 3, n), a[:, IK_ERROR:IK_Q], step
        )


class _CoreTask(PositionTask):
    """A position task that is evaluated by the core."""

    def __init__(self, task: Task, program: Program) -> None:
        vars(self).update(vars(task))
        self._program = program

    def evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]:
        x, J, _ = self._program.evaluate(_plain(q), jacobian=True)
        return torch.from_numpy(x), torch.from_numpy(J)

    def domain_distance(self, q: Tensor) -> Tensor:
        return torch.from_numpy(self._program.evaluate(_plain(q), distance=True)[2])


@dataclasses.dataclass(frozen=True)
class _CoreSearch(Search):
    """A search whose loops run in the core."""

    core: Core

    def _attempt(self, q: Tensor, target: Tensor) -> Found:
        return self._find(IK_LOWERS + IK_TO_DOMAIN, q, target)

    def _to_posture(self, found: Found) -> None:
        rows = found.reached.nonzero()[:, 0]
        slid = self._find(IK_TO_POSTURE, found.q[rows], found.target[rows])
        found.put(rows, Point(slid.q, slid.x, slid.J, slid.e, slid.target))
        found.n_iter[rows] += slid.n_iter

    def _find(self, mode: int, q: Tensor, target: Tensor) -> Found:
        return self.core.find(mode, q, target, self.tol, self.max_iter)


def _mode(target: Tensor | None, feed: Tensor | None, tip: Tensor | None) -> int:
    """Return the bits of the inputs that there are."""
    mode = IK_HAS_TARGET * (target is not None) + IK_HAS_FEED * (feed is not None)
    return mode + IK_HAS_TIP * (tip is not None)


def _plain(a: Tensor) -> NDArray:
    """Return rows as a contiguous array."""
    return a.contiguous().numpy()
