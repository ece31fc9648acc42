"""Calibration by touch points against a camera: errors of the tip at new configurations.

The table of the docs page "Results", section "Touch points"::

    python examples/studies/touch_points.py --seeds 10

Some ten minutes on one core. All robots are simulated. Seed k draws the robot, the points and the
noise; each touch starts the inverse kinematics of the real robot at a random posture.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin import Chain, ConstantCurvatureChain, InverseKinematics, RigidChain, calibrate

CALIPER = 5e-5  # standard error of measured distances [m]
N_TEST = 500
_STARTS = 30
_WITHIN = 0.7  # part of the range of q in which points are drawn, so that many postures touch them


@dataclass(frozen=True)
class Robot:
    """A nominal robot, the range of its actuators, and what is calibrated.

    Attributes
    ----------
    nominal : Chain
        Its description.
    low, high : ndarray of shape (n,)
        Range of q [m or rad].
    noise : float
        Standard error of a coordinate of a touch, and of the camera [m].
    fewer, more : tuple of str
        Parameters that leave its lengths, and all parameters.
    changes : dict of str to float
        Standard deviation of what the real robot adds to entries of the geometry; of "radii" the
        relative change, of "tool" the length.
    """

    nominal: Chain
    low: NDArray
    high: NDArray
    noise: float
    fewer: tuple[str, ...]
    more: tuple[str, ...]
    changes: Mapping[str, float]

    def draw(self, rng: np.random.Generator, n: int, within: float = 1.0) -> NDArray:
        """Return random actuator vectors (n, n_actuators) in a part of the range."""
        middle = 0.5 * (self.low + self.high)
        return middle + within * (rng.uniform(self.low, self.high, (n, len(self.low))) - middle)

    def real(self, rng: np.random.Generator) -> Chain:
        """Return a real robot."""
        geometry = self.nominal.geometry()
        for name, size in self.changes.items():
            part = self.nominal.part_of(name)
            entry = geometry[part.entry]
            change = rng.standard_normal(part.shape)
            if name == "tool":
                change = change / np.linalg.norm(change)
            if name in ("radii", "lengths"):
                change = change * entry.numpy()
            moved = part.directions @ np.ravel(size * change)
            geometry[part.entry] = entry + torch.from_numpy(moved.reshape(entry.shape))
        return self.nominal.with_geometry(**geometry)

    def touch(
        self, real: Chain, points: NDArray, each: int, rng: np.random.Generator
    ) -> tuple[NDArray, NDArray]:
        """Return actuator vectors (n_touches, n) that touch points (K, 3), and the labels.

        Touches that are out of reach after many starts are left out.
        """
        ik = InverseKinematics(real, q_min=self.low, q_max=self.high, beta=0.0)
        labels = np.repeat(np.arange(len(points)), each)
        x = points[labels] + self.noise * rng.standard_normal((len(labels), 3))
        q = np.empty((len(labels), len(self.low)))
        left = np.arange(len(labels))
        for _ in range(_STARTS):
            solved = ik.solve(x[left], self.draw(rng, left.size), tol=1e-9, max_iter=300).q
            missed = np.linalg.norm(tips(real, solved) - x[left], axis=1)
            q[left] = solved
            left = left[missed > 1e-7]
            if not left.size:
                break
        return np.delete(q, left, axis=0), np.delete(labels, left)


def arm() -> Robot:
    """Return an arm of five revolute joints and 0.74 m, with a tool that is 60 mm elsewhere."""
    origins = np.tile(np.eye(4), (5, 1, 1))
    origins[:, 2, 3] = [0.10, 0.05, 0.25, 0.20, 0.06]
    axes = [[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1]]
    tip = np.eye(4)
    tip[2, 3] = 0.08
    high = np.array([2.0, 1.3, 1.8, 1.4, 2.4])
    changes = {"tool": 0.06, "joint_zeros": np.radians(1.0), "links": 1e-3}
    return Robot(
        RigidChain(origins, axes, tip=tip),
        -high,
        high,
        5e-5,
        ("joint_zeros", "tool"),
        ("joint_zeros", "links", "tool"),
        changes,
    )


def bellows() -> Robot:
    """Return a trunk of three extensible segments with radii 10 % and a tool 10 mm off."""
    return Robot(
        ConstantCurvatureChain([0.05] * 3),
        np.full(9, 0.08),
        np.full(9, 0.12),
        5e-4,
        ("radii",),
        ("radii", "tool"),
        {"radii": 0.1, "tool": 0.01},
    )


def tendons() -> Robot:
    """Return a robot of three segments of tendons with radii 10 % and lengths 3 % off."""
    return Robot(
        ConstantCurvatureChain([0.02] * 3, lengths=[0.1] * 3),
        np.full(9, -0.02),
        np.full(9, 0.02),
        5e-4,
        ("radii",),
        ("radii", "lengths"),
        {"radii": 0.1, "lengths": 0.03},
    )


ROBOTS = {"arm": arm, "bellows": bellows, "tendons": tendons}


def tips(chain: Chain, q: NDArray) -> NDArray:
    """Return the tips (N, 3) at actuator vectors (N, n)."""
    with torch.no_grad():
        return chain(torch.from_numpy(q)).numpy()


def errors(chain: Chain, real: Chain, q: NDArray) -> tuple[float, float]:
    """Return rms tip errors [mm]: in the frame of the base, and after the best rigid motion."""
    a = tips(chain, q)
    b = tips(real, q)
    left, _, right = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    sign = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    moved = (a - a.mean(0)) @ left @ sign @ right + b.mean(0)
    return rms(a - b), rms(moved - b)


def rms(difference: NDArray) -> float:
    """Return the root mean square length of rows (N, 3) in millimetres."""
    return 1e3 * float(np.sqrt((difference**2).sum(axis=1).mean()))


def cases(robot: Robot, seed: int, n_points: int, each: int) -> dict[str, tuple[float, float]]:
    """Return the errors of all calibrations of one real robot."""
    rng = np.random.default_rng(seed)
    real = robot.real(rng)
    points = tips(real, robot.draw(rng, n_points, _WITHIN))
    q, labels = robot.touch(real, points, each, rng)
    distances = {}
    for i in range(n_points):
        for j in range(i):
            measured = np.linalg.norm(points[i] - points[j]) + CALIPER * rng.standard_normal()
            distances[j, i] = float(measured)
    known = {
        "no distance": {},
        "one distance": dict([*distances.items()][:1]),
        "all distances": distances,
    }
    seen = robot.draw(rng, len(q))
    x = tips(real, seen) + robot.noise * rng.standard_normal((len(q), 3))
    nominal = robot.nominal
    chains = {"nominal": nominal}
    for parameters in (robot.fewer, robot.more):
        names = ", ".join(parameters)
        for case, between in known.items():
            touches = {"touched": labels, "distances": between, "distance_std": CALIPER}
            chains[f"{names}: touched, {case}"] = calibrate(
                nominal, q, None, parameters, **touches
            ).chain
        chains[f"{names}: camera"] = calibrate(nominal, seen, x, parameters).chain
    test = robot.draw(rng, N_TEST)
    return {name: errors(chain, real, test) for name, chain in chains.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="errors of calibrations by touch points")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=[*ROBOTS])
    parser.add_argument("--points", type=int, default=4)
    parser.add_argument("--each", type=int, default=15)
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    for name in options.robots:
        robot = ROBOTS[name]()
        drawn = [cases(robot, k, options.points, options.each) for k in range(options.seeds)]
        print(f"{name}: {options.points} points x {options.each} touches, {options.seeds} seeds")
        for case in drawn[0]:
            table = np.array([errors_of[case] for errors_of in drawn])
            mean = table.mean(axis=0)
            spread = table.std(axis=0, ddof=1)
            print(
                f"  {case:50} in the base's frame {mean[0]:7.3f} ± {spread[0]:.3f} mm, "
                f"aligned {mean[1]:7.3f} ± {spread[1]:.3f} mm, median {np.median(table[:, 1]):.3f}"
            )


if __name__ == "__main__":
    main()
