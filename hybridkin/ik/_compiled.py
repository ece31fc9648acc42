"""Steps, ticks and searches with the compiled core, for tasks that have kernels."""

from __future__ import annotations

import ctypes
import dataclasses
import math
from collections.abc import Sequence
from struct import Struct
from struct import error as StructError
from typing import Any, NamedTuple, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.arrays import as_array
from hybridkin._core.kernel_numbers import (
    IK_AGE,
    IK_AGREEING,
    IK_AT_REST,
    IK_BLOCKED,
    IK_DAMPING,
    IK_DISTANCE,
    IK_DOUBTS,
    IK_FROM_REST,
    IK_HAS_FEED,
    IK_HAS_TARGET,
    IK_HAS_TIP,
    IK_HELD,
    IK_LAST,
    IK_LEADS,
    IK_LOWERS,
    IK_MEMORY,
    IK_MODE,
    IK_MUST_SEE,
    IK_OBSTACLE,
    IK_PERIOD,
    IK_PROMISED,
    IK_REACHED,
    IK_REJECTED,
    IK_RING,
    IK_SIGMA_MIN,
    IK_SINCE,
    IK_STATE_ROWS,
    IK_STOPPED,
    IK_TARGET,
    IK_TO_DOMAIN,
    IK_TO_POSTURE,
)
from hybridkin._core.plan import NoKernel, Plan
from hybridkin.ik._feedback import Feedback
from hybridkin.ik._search import Found, Point, Search
from hybridkin.ik._settings import StepSettings
from hybridkin.ik._step import StepRows
from hybridkin.ik.tasks import Task, Tolerance
from hybridkin.native.library import (
    Call,
    Program,
    ThreadCall,
    backend,
    in_chunks,
    opened_library,
    program_of,
)

_FLOAT64 = np.dtype(np.float64)
_write_point = Struct("3d").pack_into


class Tick(NamedTuple):
    """Results of a tick, as single rows: q, the model there, the error, and the step.

    With hysteresis q is what the actuators did, and the step is that of the commands.
    """

    q: Tensor
    x: Tensor
    J: Tensor
    e: Tensor
    step: StepRows
    rejected: bool = False  # the reading


def core_of(settings: StepSettings) -> Core | None:
    """Return the core of settings, or None if a part of the task has no kernel.

    The core is kept with the settings, and made again if a model has changed. Large buffers it
    shares with the model.
    """
    return _made(settings, copies=False).core


def own_core_of(settings: StepSettings) -> Core | None:
    """Return a core that keeps what the models are now, or None; see `core_of`."""
    core = _made(settings, copies=True).core
    if core is None or not core.plan.shared:
        return core
    if core.own is None:
        core.own = Core(*core.made_of, shares=False)
    return core.own


def _made(settings: StepSettings, copies: bool) -> _Made:
    """Return what was made for settings; for `copies` see `program_of`."""
    programs = [program_of(model, copies) for model in settings.task.models]
    made = vars(settings).get("_program")
    if made is None or made.programs != programs:
        made = _Made(settings, programs)
        object.__setattr__(settings, "_program", made)
    return made


class _Made:
    """The core that was made for settings, or the reason why there is none."""

    def __init__(self, settings: StepSettings, programs: list[Program | None]) -> None:
        self.programs = programs
        self.core: Core | None = None
        self.reason = ""
        compiled = []
        for model, program in zip(settings.task.models, programs, strict=True):
            if program is None:
                self.reason = backend(model).removeprefix("torch: ")
                return
            compiled.append(program)
        try:
            self.core = Core(settings, compiled)
        except (NoKernel, TypeError) as error:
            self.reason = str(error)


def why_torch(settings: StepSettings) -> str:
    """Return why settings that `core_of` has seen have no core."""
    return vars(settings)["_program"].reason


class Core:
    """Inverse kinematics of one task with the compiled core.

    Parameters
    ----------
    settings : StepSettings
        Task, limits, posture and rates.
    models : list of Program
        The models of the task.
    shares : bool, default=True
        Whether large buffers stay those of the models, see `Plan`.

    Attributes
    ----------
    settings : StepSettings
        The settings, with a task evaluated by the core.
    n, m, width : int
        Numbers of actuators, of rows of the task, and of numbers in a target.
    places : dict of str to slice
        Places of the parts of the state of a follower.
    lengths : list of int
        Their lengths.
    """

    def __init__(self, settings: StepSettings, models: list[Program], shares: bool = True) -> None:
        self.plan = Plan(settings.write_plan, shares)
        self.made_of = (settings, models)
        self.own: Core | None = None  # with copies of what this one shares, once it was needed
        self.n, self.m = self.plan.lengths(self.plan.root)
        self.width = math.prod(settings.task.shape)
        self._call = ThreadCall(self.plan, opened_library())
        self.settings = dataclasses.replace(settings, task=_CoreTask(settings.task, self, models))
        self._idle: list[Follower] = []  # one for every thread that has used `step`
        n_rows = self.plan.entry(self.plan.root, IK_STATE_ROWS)
        n_obstacles = len(settings.clear.scene)
        self.places = places = places_of(self.n, self.m, self.width, n_rows, n_obstacles)
        self.lengths = [place.stop - place.start for place in places.values()]
        x = places["x"]
        if len(settings.task.shape) > 1:
            x = np.arange(x.start, x.stop).reshape(settings.task.shape)
        self._fields = {
            "dq": places["dq"],
            "x": x,
            "error": (IK_DISTANCE, ...),
            "sigma_min": (IK_SIGMA_MIN, ...),
            "damping": (IK_DAMPING, ...),
            "saturated": places["held"],
        }

    def __reduce__(self) -> tuple[type[Core], tuple[StepSettings, list[Program], bool]]:
        return Core, (*self.made_of, len(self.plan.shared) > 0)

    def step(
        self, q: object, target: object, dx: object, tip: object
    ) -> tuple[NDArray, dict] | None:
        """Return the state of a step of one row and the places of its fields; else None."""
        if type(q) is not np.ndarray or q.dtype is not _FLOAT64 or q.shape != (self.n,):
            return None
        try:
            follower = self._idle.pop()
        except IndexError:  # other threads use them
            follower = Follower(self, Feedback(), IK_MUST_SEE + IK_FROM_REST)
        follower.q[...] = q
        result = None
        if follower.tick(target, dx, tip, 0.0):
            result = (follower.state.copy(), self._fields)
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
        out = np.empty((len(q), n + self.width + 3))
        held = np.empty((len(q), n), dtype=bool)
        mode = ctypes.c_int32(IK_MUST_SEE | _mode(target, feed, tip))
        arrays = [*map(_plain, (q, target, feed, tip, last)), out, held]
        self._run("hk_ik_steps", len(q), [mode], arrays)
        dq, x, numbers = torch.from_numpy(out).split([n, self.width, 3], dim=1)
        x = x.unflatten(1, self.settings.task.shape)
        return dq, x, *numbers.unbind(1), torch.from_numpy(held)

    def evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (N, ...) and J (N, m, n) of the task at q (N, n)."""
        x = np.empty((len(q), *self.settings.task.shape))
        J = np.empty((len(q), self.m, self.n))
        self._run("hk_ik_look", len(q), [], [_plain(q), x, J])
        return torch.from_numpy(x), torch.from_numpy(J)

    def search(self, tol: Tolerance, max_iter: int) -> Search:
        """Return the search for configurations that reach targets."""
        return _CoreSearch(self.settings, tol, max_iter, self)

    def find(self, mode: int, q: Tensor, target: Tensor, tol: Tolerance, max_iter: int) -> Found:
        """Return the result of `hk_ik_find` for starts q (N, n)."""
        n_rows = len(q)
        best = _plain(q).copy()
        J = np.empty((n_rows, self.m, self.n))
        e = np.empty((n_rows, self.m))
        outcome = np.empty(n_rows, dtype=np.int32)
        n_iter = np.empty(n_rows, dtype=np.int32)
        if isinstance(tol, tuple):
            tolerances = np.multiply(tol, self.settings.task.units)
            parts = len(tol)
        else:
            tolerances = np.array([tol])
            parts = 0
        numbers = [
            ctypes.c_int32(mode),
            ctypes.c_int32(max_iter),
            ctypes.c_int32(parts),
            ctypes.c_void_p(tolerances.ctypes.data),
        ]
        arrays = [_plain(target), best, J, e, outcome, n_iter]
        self._run("hk_ik_find", n_rows, numbers, arrays)
        error = torch.from_numpy(e)
        result = torch.from_numpy(outcome)
        iterations = torch.from_numpy(n_iter).long()
        x = torch.full_like(target, math.nan)  # of other tasks than positions: not used
        if not self.settings.task.of_poses and target.shape == error.shape:
            x = target - error
        return Found(
            torch.from_numpy(best),
            x,
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
        self,
        name: str,
        rows: int,
        numbers: Sequence[ctypes.c_int32 | ctypes.c_void_p],
        arrays: Sequence[NDArray | None],
    ) -> None:
        """Call a function of the library for all rows of arrays."""
        function = getattr(opened_library(), name)

        def run(start: int, count: int) -> None:
            places = []
            for a in arrays:
                place = None if a is None else a.ctypes.data + start * a.strides[0]
                places.append(ctypes.c_void_p(place))
            call = ctypes.c_void_p(self._call.place)
            function(call, ctypes.c_int64(count), *numbers, *places)

        in_chunks(rows, run)


class Follower:
    """Follows targets with the core; the state is one array of numbers.

    Only one thread at a time may use it.

    Parameters
    ----------
    core : Core
        The core that computes.
    feedback : Feedback
        How readings are used.
    mode : int, default=0
        Bits of the mode of `ik_tick` that are always set.
    state : ndarray, optional
        State of a follower to continue.

    Attributes
    ----------
    command, effective : callable
        Return the present command and what the actuators do (n,).
    """

    backend = "compiled"

    def __init__(
        self,
        core: Core,
        feedback: Feedback,
        mode: int = 0,
        state: NDArray | None = None,
    ) -> None:
        self.core = core
        self._feedback = feedback
        self._least = mode
        places = core.places
        if state is None:
            last = "scene" if mode & IK_MUST_SEE else "seen"
            state = np.zeros(int(places[last].stop))
            state[places["scene"]] = as_array(core.settings.clear.scene).ravel()
        self.state = state
        self.task = core.settings.task
        self._dt = state[IK_PERIOD] = core.settings.dt
        state[IK_MEMORY] = feedback.memory
        self._parts = {name: state[place] for name, place in places.items()}
        self.q = self._parts["q"]
        self._seen = self._parts["seen"]
        self.command = self.effective = self.q.copy
        self._lead = self._parts["lead"].reshape(-1, core.n)
        if len(self._lead) and not mode & IK_MUST_SEE:
            self.effective = self._lead[-1].copy
            self._least |= IK_LEADS
        shape = core.settings.task.shape
        self._inputs = [
            _Input(places["target"], state, shape),
            _Input(places["feed"], state, (core.m,)),
            _Input(places["tip"], state, shape),
        ]
        self._put_target, self._put_feed, self._put_tip = [place.put for place in self._inputs]
        self._call = Call(core.plan, opened_library(), state.ctypes.data)  # ik_follower
        self._place = self._call.place
        self._follow = opened_library().hk_ik_tick
        self._mode = -1

    def __reduce__(self) -> tuple[type[Follower], tuple]:
        return Follower, (self.core, self._feedback, self._least, self.state.copy())

    @property
    def scene(self) -> Tensor:
        """The obstacles, where they are now, shape (K, IK_OBSTACLE)."""
        return torch.from_numpy(self._parts["scene"].reshape(-1, IK_OBSTACLE).copy())

    @scene.setter
    def scene(self, scene: Tensor) -> None:
        self._parts["scene"][:] = as_array(scene).ravel()

    @property
    def hysteresis(self) -> Any:
        """State of the hysteresis; no rows without one."""
        return self._lead.copy()

    def start(self, q: Tensor, dq: Tensor | None, hysteresis: Any) -> None:
        """Set the initial command (1, n), the step to it, and the state of hysteresis before it.

        Without a step the robot is at rest.
        """
        parts = self._parts
        cleared = ("target", "feed", "tip", "offset", "dq", "held", "rest", "J", "seen")
        for name in cleared:
            parts[name][:] = 0.0
        parts["error"][:] = math.nan
        self.state[[IK_SIGMA_MIN, IK_DISTANCE]] = math.nan
        self.state[[IK_DAMPING, IK_STOPPED, IK_BLOCKED]] = 0.0
        self._seen[IK_SINCE] = math.inf
        if dq is not None:
            parts["dq"][:] = as_array(dq[0])
            self._seen[IK_SINCE] = 0.0
        parts["q"][:] = as_array(q[0])
        q, end = self.task.hysteresis.apply(q, hysteresis, 0.0)
        self._lead[:] = as_array(end)
        x, _ = self.core.settings.evaluate(q)
        parts["x"][:] = as_array(x).ravel()
        self.state[IK_LAST] = self._dt
        parts["before"][:] = as_array(q[0])

    def tick(self, target: object, dx: object, tip: object, age: float) -> bool:
        """Do a tick with plain arrays: the target, its velocity, the measured tip and its age.

        Returns False, and does nothing, if one of them needs full checks.
        """
        mode = self._least | IK_HAS_TARGET
        if not self._put_target(target):
            return False
        if dx is not None:
            if not self._put_feed(dx):
                return False
            self._parts["feed"] *= self._dt
            mode |= IK_HAS_FEED
        if tip is not None:
            if not self._put_tip(tip):
                return False
            mode |= IK_HAS_TIP
            if not mode & IK_MUST_SEE:
                self._seen[IK_AGE] = age
        if mode != self._mode:
            self._mode = mode
            self.state[IK_MODE] = mode
        return self._follow(self._place) > 0

    def advance(
        self,
        period: float | None,
        target: Tensor | None,
        feed: Tensor | None,
        tip: Tensor | None,
        age: float,
    ) -> Tick:
        """Do a tick with checked rows: the target, its motion in the period, the measured tip."""
        inputs = target, feed, tip
        self._seen[IK_AGE] = age
        for place, rows in zip(self._inputs, inputs, strict=True):
            if rows is not None:
                place.numbers[...] = rows[0].numpy()
        self._mode = self._least | _mode(*inputs)
        self.state[IK_MODE] = self._mode
        self.state[IK_PERIOD] = period or self._dt
        self._follow(self._place)
        self.state[IK_PERIOD] = self._dt
        return self.last()

    def last(self) -> Tick:
        """Return the results of the last tick."""
        state = torch.from_numpy(self.state.copy())[None]
        columns = state[:, IK_TARGET:].split(self.core.lengths, dim=1)
        parts = dict(zip(self.core.places, columns, strict=True))
        step = StepRows(
            parts["dq"],
            state[:, IK_SIGMA_MIN],
            state[:, IK_DAMPING],
            parts["held"] > 0.0,
            parts["rest"][:, IK_PROMISED : IK_PROMISED + self.core.m],
            state[:, IK_STOPPED] > 0.0,
            state[:, IK_BLOCKED] > 0.0,
        )
        x = parts["x"].unflatten(1, self.task.shape)
        J = parts["J"].unflatten(1, (self.core.m, self.core.n))
        rejected = bool(self._seen[IK_REJECTED])
        return Tick(parts["before"], x, J, parts["error"], step, rejected)


class _Input:
    """A place in the state for an array, or for a list of three numbers.

    Parameters
    ----------
    place : slice
        The numbers in the state.
    state : ndarray
        The state.
    shape : tuple of int
        Shape of the array.
    """

    def __init__(self, place: slice, state: NDArray, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self.numbers = state[place].reshape(shape)
        self._memory = memoryview(self.numbers)  # pyright: ignore[reportArgumentType]
        self._bytes = self._memory.cast("B")
        self._is_vector = len(shape) == 1
        self._is_point = shape == (3,)

    def put(self, point: object) -> bool:
        """Write a point, and return whether it has the type and shape that need no checks."""
        if type(point) is np.ndarray:
            if self._is_vector:
                try:
                    # Refuses any other dtype or shape.
                    self._memory[:] = point  # pyright: ignore
                except ValueError:
                    return False
                return True
            if point.dtype is not _FLOAT64 or point.shape != self._shape:
                return False
            self.numbers[...] = point
            return True
        if not self._is_point:
            return False
        if type(point) is not list and type(point) is not tuple:
            return False
        try:
            _write_point(self._bytes, 0, *point)
        except (StructError, OverflowError):
            return False
        return True


def places_of(n: int, m: int, width: int, n_rows: int, n_obstacles: int) -> dict[str, slice]:
    """Return the places of the parts of the state.

    For n actuators, m rows of the task, `width` numbers in a target, `n_rows` of hysteresis, and
    obstacles.
    """
    lengths = {
        "target": width,
        "feed": m,
        "tip": width,
        "offset": m,
        "x": width,
        "error": m,
        "q": n,
        "dq": n,
        "before": n,
        "held": n,
        "rest": IK_PROMISED + 2 * m,
        "J": m * n,
        "lead": n_rows * n,
        "tried": n_rows * n,
        "scene": n_obstacles * IK_OBSTACLE,
        "seen": IK_DOUBTS + IK_AGREEING * m + IK_RING * (1 + width),
    }
    places = {}
    start = IK_TARGET
    for name, length in lengths.items():
        places[name] = slice(start, start + length)
        start += length
    return places


class _CoreTask(Task):
    """A task that is evaluated by the core."""

    def __init__(self, task: Task, core: Core, programs: list[Program]) -> None:
        vars(self).update(vars(task))
        self.has_rotation = task.has_rotation
        self.of_poses = task.of_poses
        self.reading = task.reading
        self.misses = task.misses
        self.check = task.check
        self.difference = task.difference
        self.distances = task.distances
        self.positions = task.positions
        self.evaluate = core.evaluate
        self._programs = programs

    def domain_distance(self, q: Tensor) -> Tensor:
        rows = _plain(q)
        distances = [program.domain(rows)[0] for program in self._programs]
        return torch.from_numpy(np.max(distances, axis=0))


@dataclasses.dataclass(frozen=True)
class _CoreSearch(Search):
    """A search whose loops run in the core."""

    core: Core

    def _attempt(self, q: Tensor, target: Tensor) -> Found:
        return self._find(IK_LOWERS + IK_TO_DOMAIN, q, target)

    def _to_posture(self, ends: Found) -> None:
        rows = ends.reached.nonzero()[:, 0]
        slid = self._find(IK_TO_POSTURE, ends.q[rows], ends.target[rows])
        ends.put(rows, Point(slid.q, slid.x, slid.J, slid.e, slid.target))
        ends.n_iter[rows] += slid.n_iter

    def _find(self, mode: int, q: Tensor, target: Tensor) -> Found:
        return self.core.find(mode, q, target, self.tol, self.max_iter)


def _mode(target: Tensor | None, feed: Tensor | None, tip: Tensor | None) -> int:
    """Return the bits of the inputs that there are."""
    mode = 0
    if target is not None:
        mode |= IK_HAS_TARGET
    if feed is not None:
        mode |= IK_HAS_FEED
    if tip is not None:
        mode |= IK_HAS_TIP
    return mode


@overload
def _plain(a: Tensor) -> NDArray: ...
@overload
def _plain(a: Tensor | None) -> NDArray | None: ...
def _plain(a: Tensor | None) -> NDArray | None:
    """Return rows as a contiguous array, or None."""
    if a is None:
        return None
    return a.contiguous().numpy()
