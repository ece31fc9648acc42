"""Three simulated robots whose faults are known: a trunk, a tendon robot, and bellows.

Each has a nominal chain that a user describes, a truth that differs from it and shares no code with
the fitted corrections, and smooth random motions. Trunk and bellows consist of many arcs of unequal
stiffness that sag under their weight and give way to a load at the tip; the tendon robot is the one
of `motor_robot`, without backlash of its own. All is simulated.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch
from motor_robot import MotorRobot
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from hybridkin import ConstantCurvatureChain, robots
from hybridkin.chains.arc_chain import ArcChain

GRAVITY = 9.81  # [m/s^2]
PERIOD = 0.05  # of the commands [s]
_N_ARCS = 5  # in a segment of the truth
_ROUNDS = 8  # of the balance of bending and load
_RING = 2.0 * np.pi / 3.0 * np.arange(3)


class FaultRobot(ABC):
    """A simulated robot, and what its user knows of it.

    Attributes
    ----------
    settings : dict of str
        Arguments of the hybrid that is fitted to its log.
    name, unit : str
        Name of the robot and unit of its actuators in logs.
    chain : ArcChain
        The nominal chain; its base is to be calibrated.
    noise : float
        Standard deviation of every coordinate of the camera [m].
    size : float
        Length of the robot [m].
    """

    settings: ClassVar[dict[str, Any]] = {
        "error_model": "quadratic",
        "calibrate": ("radii", "base"),
    }
    name: str
    unit: str
    chain: ArcChain
    noise: float
    size: float

    @property
    def rest(self) -> NDArray:
        """The q (n,) without effect [unit of q]."""
        return np.zeros(self.chain.n_actuators)

    @abstractmethod
    def motion(self, rng: np.random.Generator, rows: int) -> NDArray:
        """Return smooth commands (N, n) from the rest and back [unit of q]."""

    @abstractmethod
    def tips(self, q: NDArray, load: float = 0.0) -> NDArray:
        """Return the true tips (N, 3) with an additional mass at the tip [kg], [m]."""

    def log_format(self) -> robots.LogFormat:
        """Return the format of the robot's logs."""
        names = tuple(f"m{i + 1}" for i in range(self.chain.n_actuators))
        return robots.LogFormat(names, ("x", "y", "z"), q_unit=self.unit)


class _Sagging(FaultRobot):
    """A robot of chambers: many arcs that sag and give way to a load."""

    def _build(
        self, rng: np.random.Generator, lengths: NDArray, radii: NDArray, give: float
    ) -> None:
        n = len(lengths)
        self.radii = radii
        self.size = float(lengths.sum())
        # Curvature is not constant along a segment.
        parts = 1.0 + 0.15 * rng.standard_normal((n, _N_ARCS))
        self.parts = parts / parts.sum(axis=1, keepdims=True)
        lean = np.radians(20.0) * rng.standard_normal(2)
        down = np.array([np.sin(lean[0]), np.sin(lean[1]), 1.0])
        self.down = down / np.linalg.norm(down)
        # The tip gives way by this part of its length to its own weight.
        self.weight = 0.3
        self.softness = give * self.size / self.size**3 / (self.weight * GRAVITY)
        self.body = ConstantCurvatureChain(np.repeat(radii, _N_ARCS))
        self.turned = rng.normal(0.0, 0.03, 3)
        self.shift = 0.02 * self.size * rng.standard_normal(3)

    def _chamber_lengths(self, q: NDArray) -> NDArray:
        """Return the lengths (N, n) of the chambers [m]."""
        raise NotImplementedError

    def tips(self, q: NDArray, load: float = 0.0) -> NDArray:
        """Return the true tips (N, 3) with an additional mass at the tip [kg], [m]."""
        chambers = self._chamber_lengths(q).reshape(len(q), -1, 3)
        length = chambers.mean(axis=2)
        around = np.stack([np.cos(_RING), np.sin(_RING)], axis=1)
        free = -2.0 / 3.0 * (chambers @ around) / self.radii[:, None]
        arcs = length[..., None] * self.parts
        bends = free[..., None, :] * self.parts[..., None]
        arcs = torch.from_numpy(arcs.reshape(len(q), -1))
        bends = torch.from_numpy(bends.reshape(len(q), -1, 2))
        force = torch.from_numpy((self.weight + load) * GRAVITY * self.down)
        given = torch.zeros_like(bends)
        for _ in range(_ROUNDS):
            moved = (bends + given).requires_grad_()
            (moment,) = torch.autograd.grad((self._tip(arcs, moved) @ force).sum(), moved)
            given = 0.5 * given + 0.5 * self.softness * arcs[..., None] * moment
        tip = self._tip(arcs, bends + given).detach().numpy()
        return tip + np.cross(self.turned, tip) + self.shift

    def _tip(self, arcs: torch.Tensor, bends: torch.Tensor) -> torch.Tensor:
        z = torch.cat([arcs, bends[..., 0], bends[..., 1]], dim=1)
        return self.body.from_coordinates(z)

    def _postures(
        self, rng: np.random.Generator, rows: int, low: float, high: float, n: int
    ) -> NDArray:
        """Return smooth paths (N, n) between random postures, from the middle and back."""
        n_knots = max(4, rows // 12)
        knots = rng.uniform(low, high, (n_knots, n))
        knots[[0, -1]] = 0.5 * (low + high)
        path = CubicSpline(np.linspace(0.0, 1.0, n_knots), knots)
        return path(np.linspace(0.0, 1.0, rows)).clip(low, high)


class Trunk(_Sagging):
    """A trunk of three segments of three chambers whose lengths are measured."""

    name = "trunk"
    unit = "m"
    noise = 5e-4

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 10])
        self.chain = robots.bionic_handling_assistant()
        radii = self.chain.radii.numpy() * rng.uniform(0.97, 1.03, 3)
        self._build(rng, np.full(3, 0.25), radii, 0.06)

    def motion(self, rng: np.random.Generator, rows: int) -> NDArray:
        """Return smooth lengths of the chambers (N, 9) [m]."""
        return self._postures(rng, rows, 0.2, 0.3, 9)

    def _chamber_lengths(self, q: NDArray) -> NDArray:
        return q


class Bellows(_Sagging):
    """An arm of two segments of three bellows, driven by pressures in bar."""

    name = "bellows"
    unit = "1"
    noise = 4e-4

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 20])
        lengths = np.array([0.12, 0.1])
        radii = np.array([0.03, 0.028])
        self._build(rng, lengths, radii, 0.05)
        self.gains = 0.035 * rng.uniform(0.95, 1.05, 6)  # [m/bar]
        self.bend = rng.uniform(-0.1, 0.1, 6)
        self.lengths = np.repeat(lengths, 3)
        self.chain = ConstantCurvatureChain(
            radii * rng.uniform(0.97, 1.03, 2),
            gains=0.035,
            actuator_zeros=np.repeat(-lengths / 0.035, 3),
        )

    def motion(self, rng: np.random.Generator, rows: int) -> NDArray:
        """Return smooth pressures (N, 6) [bar]."""
        return self._postures(rng, rows, 0.0, 1.5, 6)

    def _chamber_lengths(self, q: NDArray) -> NDArray:
        return self.lengths + self.gains * q * (1.0 + self.bend * q / 1.5)


class Tendons(FaultRobot):
    """The tendon robot of `motor_robot`: two segments of three tendons, in counts of motors."""

    settings: ClassVar[dict[str, Any]] = {"error_model": "auto"}
    name = "tendons"
    unit = "1"
    noise = 3e-4

    def __init__(self, seed: int) -> None:
        self.robot = MotorRobot.random(seed, backlash=0.0)
        rng = np.random.default_rng([seed, 30])
        robot = self.robot
        self.size = float(robot.lengths.sum())
        gain = float((1.0 + 0.02 * rng.standard_normal()) / robot.counts_per_metre.mean())
        self.signs = -robot.signs  # a pull shortens
        self.chain = ConstantCurvatureChain(
            robot.radii * rng.uniform(0.97, 1.03, 2),
            lengths=robot.lengths * rng.uniform(0.98, 1.02, 2),
            angles=[*robot.angles.reshape(2, 3)],
            offsets=[0.0, robot.tool],
            routing="base",
            gains=gain,
            actuator_zeros=self.signs * robot.zeros,
        )

    @property
    def rest(self) -> NDArray:
        """The counts (n,) of the straight robot."""
        return self.signs * self.robot.zeros

    def motion(self, rng: np.random.Generator, rows: int) -> NDArray:
        """Return smooth balanced commands (N, 6) in counts that shorten where negative."""
        n = max(1, rows // 40)
        pulls = self.robot._motion_pulls(rng, n, rows // n, 0.9, True)
        pulls = np.concatenate([pulls, np.repeat(pulls[-1:], rows - len(pulls), axis=0)])
        return self.signs * np.round(self.robot.counts(pulls))

    def tips(self, q: NDArray, load: float = 0.0) -> NDArray:
        """Return the true tips (N, 3) with an additional mass at the tip [kg], [m]."""
        robot = replace(self.robot, tip_mass=self.robot.tip_mass + load)
        return robot.tips_of(robot.pulls(q / self.signs))


ROBOTS = (Trunk, Tendons, Bellows)
