"""A pneumatic trunk under gravity, simulated in MuJoCo: from commands to lengths and the tip."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigvalsh, null_space
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from paper.mjcf import LINKS, REST_LENGTH, TIME_STEP, trunk_mjcf

# Limits for a settled trunk, and the hold in which they are checked with the length servos on.
MAX_LENGTH_ERROR = 1e-5  # [m]
MAX_SPEED = 1e-4  # speed of the tip [m/s]
MAX_DRIFT = 1e-5  # drift of the tip during the hold [m]
HOLD_STEPS = 40  # 0.1 s
SERVO_GAINS = (2000.0, 4000.0)  # proportional [N/m], integral [N/(m s)]

# Newton iteration of the equilibrium, and its continuation from the start shape.
MAX_NEWTON, MIN_FRACTION, DIFFERENCE = 7, 1 / 128, 1e-6
FORCE_TOL, LENGTH_TOL = 1e-8, 1e-10  # [N or N m], [m]

_MAY_BE_ZERO = ("tilt", "gravity", "tip_mass", "cable_noise", "mocap_noise")


class NotSettledError(RuntimeError):
    """The error for a trunk that does not come to rest; the message names the failed criterion."""


class TrunkPlant:
    """Simulated three-segment pneumatic trunk, similar to Festo's Bionic Handling Assistant.

    A chain of short links hangs from a tilted base. Each link bends about two axes, twists and
    extends against linear springs; nine chambers act along the outer hull, each spanning its own
    segment (radii 0.100, 0.093 and 0.079 m, at 0, 120 and 240 degrees), and a servo drives every
    chamber to its commanded length. Shortening a chamber bends its segment towards it.

    Gravity bends and twists a segment between its end plates; the nine lengths do not determine
    this shape. This, and a base that differs from its nominal pose, cause the residual of a
    constant-curvature model. Without gravity and with ``base_error`` zero, the trunk is a
    constant-curvature arm to about a millimetre.

    `settle` solves for the static equilibrium by Newton's method on MuJoCo's forces, continued from
    the start shape to the command. It checks that the equilibrium is stable, then runs MuJoCo with
    the servos on and checks that lengths, speed and drift stay within their limits.

    Parameters
    ----------
    tilt : float, default=35 degrees in radians
        Angle between the z axis of the base, along the straight trunk, and the direction of gravity
        [rad]. At 0 the trunk hangs straight down; otherwise gravity pulls it towards +x of the
        base.
    gravity : float, default=9.81
        Gravitational acceleration [m/s^2].
    mass : float, default=1.2
        Mass of the three segments together [kg], divided by the squares of their radii.
    tip_mass : float, default=0.3
        Mass of the gripper at the tip [kg].
    bending_stiffness : float, default=1.0
        Stiffness of the first segment against bending [N m^2]. This and the next two are smaller
        on the other segments, by the squares of their radii.
    torsional_stiffness : float, default=2.2
        Stiffness against twist about the backbone [N m^2].
    axial_stiffness : float, default=300.0
        Stiffness against extension [N].
    max_force : float, default=150.0
        Largest push or pull of a chamber [N]. A chamber that needs more force does not reach its
        commanded length.
    base_error : array-like of shape (6,), default=(0.004, -0.003, 0.005, 0.015, -0.005, -0.015)
        True pose of the base in the motion-capture frame: position [m], rotation vector [rad].
    cable_noise : float, default=0.0
        Standard deviation of the measured lengths [m].
    mocap_noise : float, default=0.0
        Standard deviation of each coordinate of the measured tip position [m].
    max_iter : int, default=200
        Largest number of Newton iterations for one command.
    random_state : int, Generator or None, default=None
        Source of the measurement noise.

    Attributes
    ----------
    admissible : tuple of two floats
        Smallest and largest chamber length that may be commanded [m].
    segment_ends : ndarray of shape (3, 3)
        After `settle`: ends of the segments, base to tip, in the motion-capture frame without
        noise [m]. The last one is the tip.
    backbone : ndarray of shape (19, 3)
        After `settle`: the backbone from the base to the tip, link by link, likewise [m].

    Raises
    ------
    ImportError
        If MuJoCo is not installed.
    ValueError
        If a parameter is out of its range.
    NotSettledError
        If the trunk has no stable shape under its own weight.

    Examples
    --------
    >>> import numpy as np
    >>> from paper import TrunkPlant
    >>> plant = TrunkPlant(gravity=0.0, base_error=np.zeros(6))
    >>> q, pose = plant.settle(np.full(9, 0.3))
    >>> bool(abs(pose[2, 3] - 0.9) < 1e-6)
    True
    """

    admissible = (0.1, 0.4)

    def __init__(
        self,
        *,
        tilt: float = 35 * np.pi / 180,
        gravity: float = 9.81,
        mass: float = 1.2,
        tip_mass: float = 0.3,
        bending_stiffness: float = 1.0,
        torsional_stiffness: float = 2.2,
        axial_stiffness: float = 300.0,
        max_force: float = 150.0,
        base_error: ArrayLike = (0.004, -0.003, 0.005, 0.015, -0.005, -0.015),
        cable_noise: float = 0.0,
        mocap_noise: float = 0.0,
        max_iter: int = 200,
        random_state: int | np.random.Generator | None = None,
    ):
        try:
            mujoco: Any = import_module("mujoco")
        except ImportError as error:
            raise ImportError(
                "TrunkPlant needs MuJoCo; install it with `pip install hybridkin[sim]`."
            ) from error
        stiffness = (bending_stiffness, torsional_stiffness, axial_stiffness)
        names = ("bending_stiffness", "torsional_stiffness", "axial_stiffness")
        numbers = {
            **dict(zip(names, stiffness, strict=True)),
            "tilt": tilt,
            "gravity": gravity,
        }
        numbers |= {"mass": mass, "tip_mass": tip_mass, "max_force": max_force}
        numbers |= {
            "max_iter": max_iter,
            "cable_noise": cable_noise,
            "mocap_noise": mocap_noise,
        }
        for name, value in numbers.items():
            _check_number(name, value)
        error = np.asarray(base_error, dtype=float)
        if error.shape != (6,) or not np.isfinite(error).all():
            raise ValueError(
                "`base_error` must be 6 finite numbers, position [m] and rotation vector [rad], "
                f"got {base_error!r}."
            )
        self._max_force, self._max_iter = float(max_force), int(max_iter)
        self._noise, self._random_state = (
            (float(cable_noise), float(mocap_noise)),
            random_state,
        )
        self._T_mocap_base = np.eye(4)
        self._T_mocap_base[:3, :3] = Rotation.from_rotvec(error[3:]).as_matrix()
        self._T_mocap_base[:3, 3] = error[:3]

        down = (gravity * np.sin(tilt), gravity * np.cos(tilt))
        self._mujoco = mujoco
        self._model = mujoco.MjModel.from_xml_string(trunk_mjcf(down, mass, tip_mass, stiffness))
        self._data = mujoco.MjData(self._model)
        self._tip = self._model.site("tip").id
        levels = [(0, 0), *((s, k + 1) for s in range(3) for k in range(LINKS))]
        rings = [[f"s{s}_{i}_{k}" for i in range(3)] for s, k in levels]
        self._rings = [[self._model.site(name).id for name in ring] for ring in rings]
        # A state holds the joint positions and the forces of the nine chambers.
        self._n_dof = self._model.nv
        straight, lengths = np.zeros(self._n_dof + 9), np.full(9, REST_LENGTH)
        self._rest, _ = self._equilibrium(straight, lengths, iter(range(self._max_iter)))
        self.reset()

    def reset(self) -> None:
        """Reset the measurement noise to its seed."""
        self._rng = np.random.default_rng(self._random_state)

    def __call__(self, q_target: ArrayLike) -> NDArray[np.float64]:
        """Return the measured tip position after settling at the commanded lengths.

        Parameters
        ----------
        q_target : array-like of shape (9,)
            Commanded chamber lengths [m], as for `settle`.

        Returns
        -------
        x : ndarray of shape (3,)
            Tip position in the motion-capture frame [m].
        """
        return self.settle(q_target)[1][:3, 3]

    def settle(
        self,
        q_target: ArrayLike,
        *,
        random_state: int | Sequence[int] | np.random.Generator | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the measured lengths and the tip pose after settling at the commanded lengths.

        Parameters
        ----------
        q_target : array-like of shape (9,)
            Commanded chamber lengths [m], three per segment from base to tip, within
            ``admissible``.
        random_state : int, sequence of ints, Generator or None, default=None
            Source of the noise of this measurement; None: the plant's own.

        Returns
        -------
        q : ndarray of shape (9,)
            Measured chamber lengths [m]: the command to 0.01 mm, plus ``cable_noise``, except
            for chambers that need more than ``max_force``.
        pose : ndarray of shape (4, 4)
            Tip pose in the motion-capture frame, with ``mocap_noise`` on the position.

        Raises
        ------
        ValueError
            If `q_target` has the wrong shape, is not finite or is outside the admissible range.
        NotSettledError
            If the trunk does not come to rest at a stable shape.
        """
        target = self._check_lengths(q_target)
        state, held = self._equilibrium(self._rest, target, iter(range(self._max_iter)))
        self._check_stable(state, held)
        lengths, T_base_tip = self._hold(state, target, held)
        middles = self._data.site_xpos[self._rings].mean(1) @ self._T_mocap_base[:3, :3].T
        self.backbone = middles + self._T_mocap_base[:3, 3]
        self.segment_ends = self.backbone[LINKS::LINKS]
        rng = self._rng if random_state is None else np.random.default_rng(random_state)
        q = lengths + self._noise[0] * rng.standard_normal(9)
        pose = self._T_mocap_base @ T_base_tip
        pose[:3, 3] += self._noise[1] * rng.standard_normal(3)
        return q, pose

    def _check_lengths(self, q_target):
        target = np.asarray(q_target, dtype=float)
        if target.shape != (9,):
            raise ValueError(
                f"`q_target` must have shape (9,), got {target.shape}; the trunk has 3 segments "
                "of 3 chambers, and each call takes one configuration."
            )
        low, high = self.admissible
        bad = ~((target >= low) & (target <= high))  # NaN included
        if bad.any():
            raise ValueError(
                f"`q_target` must be chamber lengths of {low} to {high} m, got {target[bad]} for "
                f"chambers {np.flatnonzero(bad)}; clip the command or convert it to metres."
            )
        return target

    def _forces(self, state):
        """Return unbalanced joint forces (n_dof,) and chamber lengths (9,) of a state at rest."""
        mujoco, model, data = self._mujoco, self._model, self._data
        data.qpos[:] = state[: self._n_dof]
        data.qvel[:] = 0
        data.ctrl[:] = state[self._n_dof :]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_tendon(model, data)
        mujoco.mj_transmission(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fwdActuation(model, data)
        return (
            data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator,
            data.ten_length.copy(),
        )

    def _derivatives(self, state):
        """Return derivatives by the joints of forces (n_dof, n_dof) and lengths (9, n_dof)."""
        n = self._n_dof

        def both(joints):
            return np.concatenate(self._forces(np.concatenate([joints, state[n:]])))

        return np.split(np.asarray(approx_fprime(state[:n], both, DIFFERENCE)), [n])

    def _newton(self, state, target, held, budget):
        """Return an equilibrium near `state`, or None; chambers not `held` keep their force."""
        n, chambers = self._n_dof, np.arange(9)
        for _ in range(MAX_NEWTON):
            forces, lengths = self._forces(state)
            gap = np.where(held, lengths - target, 0.0)
            if np.abs(forces).max() < FORCE_TOL and np.abs(gap).max() < LENGTH_TOL:
                return state
            if next(budget, None) is None:
                raise NotSettledError(
                    f"Not settled: no equilibrium within max_iter={self._max_iter} Newton "
                    "iterations; raise `max_iter`."
                )
            stiffness, jacobian = self._derivatives(state)
            kkt = np.zeros((n + 9, n + 9))
            kkt[:n, :n] = stiffness
            kkt[:n, n:] = jacobian.T
            kkt[n:, :n] = jacobian * held[:, None]
            kkt[n + chambers, n + chambers] = ~held
            try:
                state = state - np.linalg.solve(kkt, np.concatenate([forces, gap]))
            except np.linalg.LinAlgError:
                return None
            if not np.isfinite(state).all() or np.abs(state[:n]).max() > np.pi:
                return None
        return None

    def _follow(self, state, target, held, budget):
        """Return the equilibrium at the target, in as few steps as Newton's method allows."""
        begin, done, fraction = self._forces(state)[1], 0.0, 1.0
        while done < 1.0:
            fraction = min(fraction, 1.0 - done)
            next_target = begin + (done + fraction) * (target - begin)
            reached = self._newton(state, next_target, held, budget)
            if reached is not None:
                state, done = reached, done + fraction
                continue
            fraction /= 2
            if fraction < MIN_FRACTION:
                raise NotSettledError(
                    f"Not settled: no equilibrium was found after {done:.0%} of the way to the "
                    "commanded lengths. Command lengths that are closer to each other, or make the "
                    "trunk stiffer."
                )
        return state

    def _equilibrium(self, state, target, budget):
        """Return the equilibrium and which chambers hold their length; others are saturated."""
        n, limit, held = self._n_dof, self._max_force, np.ones(9, dtype=bool)
        for _ in range(10):
            state = self._follow(state, target, held, budget)
            force, gap = state[n:], target - self._forces(state)[1]
            saturated = held & (np.abs(force) > limit)
            # a push if too long, or a pull if too short.
            released = ~held & (force * gap < 0)
            if not (saturated | released).any():
                return state, held
            held = (held & ~saturated) | released
            state = np.concatenate([state[:n], np.clip(force, -limit, limit)])
        raise NotSettledError(
            "Not settled: chambers alternate between their commanded length and their largest "
            "force; raise `max_force`."
        )

    def _check_stable(self, state, held):
        stiffness, jacobian = self._derivatives(state)
        free = null_space(jacobian[held]) if held.any() else np.eye(self._n_dof)
        reduced = -free.T @ (stiffness + stiffness.T) @ free / 2
        lowest = eigvalsh(reduced, subset_by_index=(0, 0))[0]
        if not lowest > 0:
            raise NotSettledError(
                f"Not settled: the shape is unstable, as its lowest stiffness is {lowest:.3g} and "
                "must be positive. The trunk is too soft for its weight and tilt."
            )

    def _hold(self, state, target, held):
        """Return lengths (9,) and tip pose (4, 4) in the base frame after a short simulation."""
        mujoco, model, data = self._mujoco, self._model, self._data
        mujoco.mj_resetData(model, data)
        data.qpos[:] = state[: self._n_dof]
        mujoco.mj_forward(model, data)
        begin = data.site_xpos[self._tip].copy()
        force, integral = state[self._n_dof :], np.zeros(9)
        for _ in range(HOLD_STEPS):
            gap = np.where(held, target - data.ten_length, 0.0)
            integral += TIME_STEP * gap
            push = force + SERVO_GAINS[0] * gap + SERVO_GAINS[1] * integral
            data.ctrl[:] = np.clip(push, -self._max_force, self._max_force)
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        T_base_tip, velocity = np.eye(4), np.zeros(6)
        T_base_tip[:3, :3] = data.site_xmat[self._tip].reshape(3, 3)
        T_base_tip[:3, 3] = data.site_xpos[self._tip]
        site = mujoco.mjtObj.mjOBJ_SITE
        mujoco.mj_objectVelocity(model, data, site, self._tip, velocity, 0)
        error = np.abs(target - data.ten_length)[held].max(initial=0.0)
        for name, value, limit in (
            ("length error [m]", error, MAX_LENGTH_ERROR),
            ("tip speed [m/s]", np.linalg.norm(velocity[3:]), MAX_SPEED),
            ("tip drift [m]", np.linalg.norm(T_base_tip[:3, 3] - begin), MAX_DRIFT),
        ):
            if not value <= limit:
                raise NotSettledError(
                    f"Not settled: after {HOLD_STEPS * TIME_STEP:g} s with the servos on, the "
                    f"{name} is {value:.3g} and must be at most {limit:g}."
                )
        return data.ten_length.copy(), T_base_tip


def _check_number(name: str, value: Any) -> None:
    low = -np.inf if name == "tilt" else 0.0
    enough = isinstance(value, (int, float, np.number)) and np.isfinite(value) and value >= low
    if not enough or (value == 0 and name not in _MAY_BE_ZERO):
        sign = ">=" if name in _MAY_BE_ZERO else ">"
        raise ValueError(f"`{name}` must be a finite number {sign} {low:g}, got {value!r}.")
