"""Inverse kinematics for a control loop: one configuration at a time, in NumPy and plain numbers.

A NumPy call costs half a microsecond and a torch call several. Vectors of actuators are NumPy
arrays here; what has three rows is written out in numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import lt
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import nn

from hybridkin._core.model import forward_and_jacobian
from hybridkin.ik._box import PROXIMAL_ROUNDS, box_floor
from hybridkin.ik._step import HEALTHY
from hybridkin.ik.results import IKStatus

_BOX_FLOOR = box_floor(torch.float64)  # lambda^2 of a box-limited step over the norm of J J^T
_NEWTON_STEPS = 60
_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)

Three = tuple[float, float, float]
Entries = tuple[float, float, float, float, float, float]  # g11, g21, g31, g22, g32, g33
Held = tuple[NDArray, NDArray]
NumpyFunction = Callable[[NDArray], tuple[NDArray, NDArray]]


def numpy_function(module: Any) -> NumpyFunction:
    """Return a NumPy function of one configuration, q (n,) -> x (m,) and dx/dq (m, n).

    Parameters
    ----------
    module : nn.Module or callable
        Maps q ``(..., n)`` to ``(..., m)``, torch to torch. Its own ``numpy_function()`` is used
        where it has one; else torch computes a batch of one, many times slower.

    Returns
    -------
    function
        In float64. It keeps the module's present parameters.
    """
    own = getattr(module, "numpy_function", None)
    return by_torch(module) if own is None else own()


def by_torch(module: Any) -> NumpyFunction:
    """Return the `numpy_function` of a module that has none: torch computes a batch of one."""
    device = None
    if isinstance(module, nn.Module):
        device = next((a.device for a in (*module.parameters(), *module.buffers())), None)

    def tip_and_jacobian(q: NDArray) -> tuple[NDArray, NDArray]:
        rows = torch.tensor(q, dtype=torch.float64, device=device)[None]
        with torch.no_grad():
            x, J = forward_and_jacobian(module, rows)
        return x[0].cpu().double().numpy(), J[0].cpu().double().numpy()

    return tip_and_jacobian


class Controller:
    """Inverse kinematics tick by tick: a target goes in, the next command comes out.

    The law is `InverseKinematics.step`, for one configuration, in float64 and without torch where
    the model offers ``numpy_function()``: the same steps to rounding, some fifty times faster.
    It holds the present command and nothing else of the past, but for a guess at the limits that
    will be met; a call does a bounded amount of work. Settings and model are those of the time of
    its making.

    Parameters
    ----------
    ik : InverseKinematics
        Model, limits, posture and rates.
    q0 : array-like of shape (n,)
        Present actuator vector of the robot, in the unit of q.
    tol : float, default=1e-4
        Error that counts as reached [m], for `status`.

    Attributes
    ----------
    x : ndarray of shape (3,)
        The model's tip at the configuration that the last step started from [m].
    error : float
        Distance from the tip, the measured one where it was given, to the target before the last
        step [m].
    sigma_min : float
        Smallest singular value of the Jacobian there, NaN where an input was not finite.
    damping : float
        lambda used, in the unit of `sigma_min`.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import InverseKinematics, robots
    >>> ik = InverseKinematics(robots.bionic_handling_assistant(), q_min=0.1, q_max=0.4)
    >>> controller = ik.controller(np.full(9, 0.25))
    >>> for _ in range(5):
    ...     q = controller.step([0.1, 0.05, 0.7])
    >>> controller.status.name, int(controller.saturated.sum())
    ('CONVERGED', 0)
    """

    x: NDArray
    error: float
    sigma_min: float
    damping: float

    def __init__(self, ik: Any, q0: ArrayLike, *, tol: float = 1e-4) -> None:
        if not tol > 0:
            raise ValueError(f"`tol` must be positive [m], got {tol!r}.")
        task = ik.task
        steers_a_tip = (len(task.models), task.shape, task.units) == (1, (3,), (1.0,))
        if not steers_a_tip or ik.mode != "least_squares":
            raise ValueError(
                "`ik` must steer a tip position of three coordinates in mode='least_squares', got "
                f"{type(task).__name__} with targets of shape {task.shape} and mode={ik.mode!r}; "
                "`InverseKinematics.tracker` follows any task in any mode."
            )
        self.tol = float(tol)
        self._function = numpy_function(task.models[0])
        self._is_trusted = _domain(task.models[0])
        self._dt = ik.dt
        self._gain = 1.0 if ik.gain is None else min(ik.gain * ik.dt, 1.0)
        self._beta = min(ik.beta * ik.dt, 1.0)
        self._damping = ik.damping
        self._limits = ik.limits
        bounds = (ik.q_min, ik.q_max, ik.dq_max * ik.dt)
        sizes = [len(bound) for bound in bounds if bound.ndim]
        n = task.n_actuators or max(sizes, default=np.size(q0))
        self._low, self._high, self._largest = (
            np.broadcast_to(bound.numpy(), n).astype(np.float64) for bound in bounds
        )
        if self._limits == "off":
            self._low, self._high, self._largest = (
                np.full(n, bound) for bound in (-math.inf, math.inf, math.inf)
            )
        self._unit = None  # in u = q / unit every actuator costs the same
        if ik.weights is not None:
            self._unit = np.broadcast_to(ik.weights.rsqrt().numpy(), n).astype(np.float64)
        # As lists: a comparison of nine numbers is faster without NumPy.
        self._corners = self._low.tolist(), self._high.tolist(), self._largest.tolist()
        self._posture = _posture(ik.q_pref, n) if self._beta > 0.0 else None
        self.reset(q0)

    def __repr__(self) -> str:
        """Return a one-line summary."""
        return f"Controller({len(self._q)} actuators, {self.status.name}, error {self.error:.3g} m)"

    @property
    def q(self) -> NDArray:
        """The present command, shape (n,): what the last `step` returned, or `reset` was given."""
        return self._q.copy()

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """Actuators that the last step held at a limit of position or speed, shape (n,)."""
        if self._held is None:
            return np.zeros(len(self._q), dtype=bool)
        low, high = self._held
        return low | high

    @property
    def status(self) -> IKStatus:
        """Outcome of the last step, as of a point of `InverseKinematics.track`.

        CONVERGED where `error` is within `tol` (OUT_OF_DOMAIN where the model does not vouch for
        itself there); else AT_LIMITS where a limit held the step, SINGULAR where it was damped,
        MAX_ITER where it was free. INVALID_INPUT where an input or the model was not finite.
        """
        if not (math.isfinite(self.error) and math.isfinite(self.sigma_min)):
            return IKStatus.INVALID_INPUT
        if self.error <= self.tol:
            trusted = self._is_trusted is None or self._is_trusted(self._before)
            return IKStatus.CONVERGED if trusted else IKStatus.OUT_OF_DOMAIN
        if self.saturated.any():
            return IKStatus.AT_LIMITS
        return IKStatus.SINGULAR if self.damping > 0.0 else IKStatus.MAX_ITER

    def reset(self, q: ArrayLike) -> None:
        """Start anew from an actuator vector, as read from the robot.

        Parameters
        ----------
        q : array-like of shape (n,)
            Actuator vector, in the unit of q. Outside the limits it is led back at `dq_max`.
        """
        q = np.array(q, dtype=np.float64)
        if q.shape != self._low.shape or not np.isfinite(q).all():
            raise ValueError(
                f"`q` must be finite and of shape ({len(self._low)},), got {q.tolist()}; read it "
                "from the robot, or solve for a start."
            )
        x, J = self._function(q)
        if x.shape != (3,) or J.shape != (3, len(q)):
            raise ValueError(
                f"`model` must map q of shape {q.shape} to a tip of shape (3,), got {x.shape} and "
                f"a Jacobian of shape {J.shape}."
            )
        self._q = self._before = q
        self._held: Held | None = None  # at the lower, at the upper limits; None: all free
        self.x, self.error, self.sigma_min, self.damping = x, math.nan, math.nan, 0.0

    def step(
        self, x_target: ArrayLike, dx: ArrayLike | None = None, x_measured: ArrayLike | None = None
    ) -> NDArray:
        """Return the actuator vector to command next, one period ahead, eq. (1).

        Parameters
        ----------
        x_target : array-like of shape (3,)
            Present target [m].
        dx : array-like of shape (3,), optional
            Velocity of the target [m/s], (next target - target) / dt for second order in dt.
            Default: at rest.
        x_measured : array-like of shape (3,), optional
            Measured tip [m], to close the loop on. Default: the model's tip.

        Returns
        -------
        ndarray of shape (n,)
            The command, within the limits to the last bit; the caller's to keep. With an input
            that is not finite the robot holds still.
        """
        q = self._q
        x, J = self._function(q)
        aim = _point(x_target, "x_target")
        tip = x.tolist() if x_measured is None else _point(x_measured, "x_measured")
        e1, e2, e3 = aim[0] - tip[0], aim[1] - tip[1], aim[2] - tip[2]
        gain = self._gain
        v = gain * e1, gain * e2, gain * e3
        if dx is not None:
            rate, dt = _point(dx, "dx"), self._dt
            v = v[0] + dt * rate[0], v[1] + dt * rate[1], v[2] + dt * rate[2]
        unit = self._unit
        if unit is not None:
            J = J * unit
        gram = _gram(J, J)
        self.x, self.error = x, math.sqrt(e1 * e1 + e2 * e2 + e3 * e3)
        self._before = q
        if math.isfinite(v[0] + v[1] + v[2] + gram[0] + gram[3] + gram[5]):
            q = self._advanced(q, J, gram, v)
        else:
            self.sigma_min, self.damping = math.nan, 0.0
            q = self._arrived(q, self._reach(q), np.zeros_like(q))
        self._q = q
        return q.copy()

    def _advanced(self, q: NDArray, J: NDArray, gram: Entries, v: Three) -> NDArray:
        """Return q after the step with the task v, for J by u = q / unit."""
        unit = self._unit
        self.sigma_min, sigma_max = _singular_values(gram)
        healthy = self.sigma_min >= HEALTHY * sigma_max
        if self._damping == "adaptive":
            damping = 0.0
            if not healthy:
                threshold = HEALTHY * sigma_max
                damping = threshold * (1.0 - (self.sigma_min / threshold) ** 2)
        else:
            damping = float(self._damping) * sigma_max
        self.damping = damping
        damping_sq = damping * damping
        factor = _factor(gram, damping_sq)
        z = np.zeros_like(q)
        if self._posture is not None:
            posture = self._beta * (self._posture(q) - q)
            if unit is not None:
                posture = posture / unit
            undamped = factor if damping == 0.0 else _factor(gram, 0.0)
            z = posture - np.array(_solve(undamped, J.dot(posture).tolist())).dot(J)
            if not healthy:  # once more, for rounding
                z = z - np.array(_solve(undamped, J.dot(z).tolist())).dot(J)
        if self._held is not None and damping == 0.0 and self._limits == "saturate":
            # As a rule limits go on holding what they hold; else the step is free of them.
            reach = self._reach(q)
            box = _Box(J, z, reach.lower, reach.upper)
            new = self._arrived(q, reach, _strict_box_step(box, v, 0.0, gram, self._held))
            if self.saturated.any():
                return new
        dq = np.array(_solve(factor, v)).dot(J) + z
        move = dq if unit is None else dq * unit
        new = q + move
        low, high, largest = self._corners
        there, moves = new.tolist(), np.abs(move).tolist()
        if all(map(lt, low, there)) and all(map(lt, there, high)) and all(map(lt, moves, largest)):
            self._held = None
            return new
        reach = self._reach(q)
        limited = np.minimum(np.maximum(dq, reach.lower), reach.upper)
        if self._limits == "saturate" and not all((limited == dq).tolist()):
            box = _Box(J, z, reach.lower, reach.upper)
            held = self._held or (dq <= box.lower, dq >= box.upper)
            limited = _strict_box_step(box, v, damping_sq, gram, held)
        return self._arrived(q, reach, limited)

    def _reach(self, q: NDArray) -> _Reach:
        """Return the bounds of position and speed together.

        From outside the limits both meet at the way back, at most the largest step.
        """
        down, up = q - self._largest, q + self._largest
        low = np.minimum(np.maximum(self._low, down), up)
        high = np.minimum(np.maximum(self._high, down), up)
        lower, upper = low - q, high - q
        if self._unit is not None:
            lower, upper = lower / self._unit, upper / self._unit
        return _Reach(low, high, lower, upper)

    def _arrived(self, q: NDArray, reach: _Reach, dq: NDArray) -> NDArray:
        """Return q after a step dq of u, and note what is held."""
        self._held = dq <= reach.lower, dq >= reach.upper
        move = dq if self._unit is None else dq * self._unit
        return np.minimum(np.maximum(q + move, reach.low), reach.high)


class _Reach(NamedTuple):
    """Bounds of the next q, and of dq in units of u."""

    low: NDArray
    high: NDArray
    lower: NDArray
    upper: NDArray


class _Box(NamedTuple):
    """Minimise |dq - z|^2 + |J dq - v|^2 / lambda^2 within the bounds, for any v and lambda."""

    J: NDArray  # (3, n)
    z: NDArray
    lower: NDArray
    upper: NDArray

    def at(self, mu: Any) -> tuple[NDArray, NDArray]:
        """Return y = z + J^T mu, and dq, which is y in the box, for mu of shape (..., 3)."""
        y = self.z + np.array(mu).dot(self.J)
        return y, np.minimum(np.maximum(y, self.lower), self.upper)


class _Piece:
    """Where the same actuators are held at the same limits: there dq is linear in mu."""

    def __init__(self, box: _Box, free: NDArray, rest: NDArray, damping_sq: float) -> None:
        self.box, self.free, self.rest, self.damping_sq = box, free, rest, damping_sq
        self.task = box.J.dot(rest).tolist()
        self.factor = _factor(_gram(box.J * free, box.J), damping_sq)

    @classmethod
    def at(cls, box: _Box, y: NDArray, dq: NDArray, damping_sq: float) -> _Piece:
        """Return the piece of a point, from its `_Box.at`."""
        free = dq == y
        return cls(box, free, np.where(free, box.z, dq), damping_sq)

    def solve(self, v: Three) -> Three:
        """Return mu with J dq(mu) + lambda^2 mu = v, were every mu on this piece."""
        task = self.task
        return _solve(self.factor, (v[0] - task[0], v[1] - task[1], v[2] - task[2]))

    def holds(self, y: NDArray, dq: NDArray) -> bool:
        """Return whether points are on this piece, from their `_Box.at`."""
        return bool((np.where(self.free, y, self.rest) == dq).all())


def _strict_box_step(box: _Box, v: Three, damping_sq: float, gram: Entries, held: Held) -> NDArray:
    """Return the box-limited step whose task part does not depend on z.

    As for batches: `InverseKinematics` says what it is in its notes. What is held at the lower and
    at the upper limits is a guess.
    """
    g11, g21, g31, g22, g32, g33 = gram
    off = g21 * g21 + g31 * g31 + g32 * g32
    size_sq = math.sqrt(g11 * g11 + g22 * g22 + g33 * g33 + 2.0 * off)
    floor = _BOX_FLOOR * size_sq if size_sq > 0.0 else 1.0
    centre = (0.0, 0.0, 0.0)
    if damping_sq > 0.0 and box.z.any():
        task = box._replace(z=np.zeros_like(box.z))
        dq, centre = _proximal_box_step(task, v, damping_sq, floor, centre, held)
        v, damping_sq = tuple(box.J.dot(dq).tolist()), 0.0
        held = dq <= box.lower, dq >= box.upper
    return _proximal_box_step(box, v, damping_sq, floor, centre, held)[0]


def _proximal_box_step(
    box: _Box, v: Three, damping_sq: float, floor: float, centre: Three, held: Held
) -> tuple[NDArray, Three]:
    """Return the box-limited step for any lambda^2 >= 0, and its multipliers."""
    used = max(damping_sq, floor)
    excess = used - damping_sq
    rounds = 1 + PROXIMAL_ROUNDS if excess > 0.0 else 1
    low, high = held
    rest = np.where(low, box.lower, np.where(high, box.upper, box.z))
    piece = _Piece(box, ~(low | high), rest, used)
    start = mu = centre
    for guessed in (True, False):
        if not guessed:
            piece, start = _newton(box, _plus(v, excess, centre), used, start)
        all_mu, mu = [], centre
        for _ in range(rounds):
            mu = piece.solve(_plus(v, excess, mu))
            all_mu.append(mu)
        y, dq = box.at(all_mu)
        if piece.holds(y, dq):  # all rounds on one piece, as a rule: a few small solves were all
            return dq[-1], mu
        start = all_mu[0]
    mu = centre
    for _ in range(rounds):
        _, start = _newton(box, _plus(v, excess, mu), used, start)
        mu = start
    return box.at(mu)[1], mu


def _newton(box: _Box, v: Three, damping_sq: float, mu: Three) -> tuple[_Piece, Three]:
    """Return mu with J dq(mu) + lambda^2 mu = v, and its piece, by semismooth Newton."""
    y, dq = box.at(mu)
    piece = _Piece.at(box, y, dq, damping_sq)
    for _ in range(_NEWTON_STEPS):
        new = piece.solve(v)
        full, dq = box.at(new)
        if piece.holds(full, dq):
            return piece, new
        pull = [damping_sq * m for m in new]
        residual = [a + b - c for a, b, c in zip(box.J.dot(dq).tolist(), pull, v, strict=True)]
        reach = np.abs(box.J).dot(np.abs(dq)).tolist()
        scale = [a + abs(b) + abs(c) for a, b, c in zip(reach, pull, v, strict=True)]
        if all(abs(r) <= 4.0 * _EPS * s for r, s in zip(residual, scale, strict=True)):
            return piece, new
        ahead = (new[0] - mu[0], new[1] - mu[1], new[2] - mu[2])
        if sum(a * r for a, r in zip(ahead, residual, strict=True)) > 0.0:
            new = _plus(mu, _exact_line_search(box, v, damping_sq, mu, ahead), ahead)
            full, dq = box.at(new)
        mu, piece = new, _Piece.at(box, full, dq, damping_sq)
    return piece, mu


def _exact_line_search(box: _Box, v: Three, damping_sq: float, mu: Three, ahead: Three) -> float:
    """Return t in (0, 1] where ahead . (J dq(m) + lambda^2 m - v) = 0 at m = mu + t ahead.

    That grows with t, at a rate that changes where an actuator meets a limit or leaves it.
    """
    y, dq = box.at(mu)
    slopes = np.array(ahead).dot(box.J)
    (m1, m2, m3), (a1, a2, a3) = mu, ahead
    pull = a1 * (damping_sq * m1 - v[0]) + a2 * (damping_sq * m2 - v[1])
    value = float(slopes.dot(dq)) + pull + a3 * (damping_sq * m3 - v[2])
    rate = damping_sq * (a1 * a1 + a2 * a2 + a3 * a3)
    changes = []
    for at, slope, low, high in zip(*(a.tolist() for a in (y, slopes, *box[2:])), strict=True):
        if slope == 0.0:
            continue
        enters, leaves = sorted(((low - at) / slope, (high - at) / slope))
        if enters < 1.0 and leaves > 0.0:
            if enters > 0.0:
                changes.append((enters, slope * slope))
            else:
                rate += slope * slope
            changes.append((leaves, -slope * slope))
    t = 0.0
    for there, change in sorted(changes):
        if there >= 1.0 or value + rate * (there - t) >= 0.0:
            break
        value, t, rate = value + rate * (there - t), there, rate + change
    return min(t - value / rate, 1.0) if rate > 0.0 else 1.0


def _gram(A: NDArray, B: NDArray) -> Entries:
    """Return the lower triangle of A B^T, symmetric, for matrices of three rows."""
    (g11, _, _), (g21, g22, _), (g31, g32, g33) = A.dot(B.T).tolist()
    return g11, g21, g31, g22, g32, g33


def _singular_values(gram: Entries) -> tuple[float, float]:
    """Return the smallest and the largest singular value of J, from J J^T."""
    g11, g21, g31, g22, g32, g33 = gram
    mean = (g11 + g22 + g33) / 3.0
    a, b, c = g11 - mean, g22 - mean, g33 - mean
    radius = math.sqrt((a * a + b * b + c * c + 2.0 * (g21 * g21 + g31 * g31 + g32 * g32)) / 6.0)
    det = a * (b * c - g32 * g32) - g21 * (g21 * c - g32 * g31) + g31 * (g21 * g32 - b * g31)
    ratio = 0.5 * det / max(radius**3, _TINY)
    angle = math.acos(min(max(ratio, -1.0), 1.0)) / 3.0
    low = mean + 2.0 * radius * math.cos(angle + 2.0 * math.pi / 3.0)
    high = mean + 2.0 * radius * math.cos(angle)
    return math.sqrt(max(low, 0.0)), math.sqrt(max(high, 0.0))


def _factor(gram: Entries, damping_sq: float) -> Entries:
    """Return i1, l21, l31, i2, l32, i3 of L D L^T = G + lambda^2 1, the i being 1 / D.

    A pivot that is only rounding gets i = 0, so that the rest is inverted without it.
    """
    g11, g21, g31, g22, g32, g33 = gram
    floor = 8.0 * _EPS * (g11 + g22 + g33 + damping_sq)
    pivot = g11 + damping_sq
    i1 = 1.0 / pivot if pivot > floor else 0.0
    l21, l31 = g21 * i1, g31 * i1
    pivot = g22 + damping_sq - l21 * g21
    i2 = 1.0 / pivot if pivot > floor else 0.0
    t = g32 - l31 * g21
    l32 = t * i2
    pivot = g33 + damping_sq - l31 * g31 - l32 * t
    return i1, l21, l31, i2, l32, (1.0 / pivot if pivot > floor else 0.0)


def _solve(factor: Entries, v: Any) -> Three:
    """Return mu with L D L^T mu = v."""
    i1, l21, l31, i2, l32, i3 = factor
    v1, v2, v3 = v
    v2 -= l21 * v1
    x3 = (v3 - l31 * v1 - l32 * v2) * i3
    x2 = v2 * i2 - l32 * x3
    return v1 * i1 - l21 * x2 - l31 * x3, x2, x3


def _plus(v: Any, factor: float, mu: Any) -> Three:
    return v[0] + factor * mu[0], v[1] + factor * mu[1], v[2] + factor * mu[2]


def _point(value: ArrayLike, name: str) -> list[float]:
    point = np.asarray(value, dtype=np.float64)
    if point.shape != (3,):
        raise ValueError(f"`{name}` must have shape (3,), got {point.shape}.")
    return point.tolist()


def _posture(wanted: Any, n: int) -> Callable[[NDArray], NDArray] | None:
    """Return the preferred configuration as a NumPy function of q."""
    if wanted is None:
        return None
    if callable(wanted):
        function: Any = wanted
        return lambda q: function(torch.tensor(q)[None]).double().numpy().reshape(n)
    fixed = np.broadcast_to(wanted.numpy(), n).astype(np.float64)
    return lambda q: fixed


def _domain(module: Any) -> Callable[[NDArray], bool] | None:
    """Return whether the model vouches for itself, as a NumPy function of q."""
    if not hasattr(module, "in_domain"):
        return None
    guard: Any = getattr(module, "guard", None)
    if hasattr(guard, "numpy_function"):
        strangeness = guard.numpy_function()
        return lambda q: strangeness(q)[0] <= 1.0
    return lambda q: bool(module.in_domain(torch.tensor(q)[None])[0])
