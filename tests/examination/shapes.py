"""Shapes of random heavy bodies: at rest and stable wherever there is a number.

Bodies of one to three unequal segments, upright, hanging, horizontal and in random directions, with
sum(W) L^2 / EI from 0.1 to 100, and rows of forces: none, equal ones, tiny ones, some tendons
slack, up to three radians of bend. Seed 0. Energy, gradient and Hessian are computed anew here,
by torch from the positions of the weights along products of transforms.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from _line import Line
from numpy.typing import NDArray
from torch import Tensor

from hybridkin import ForceTendonChain

ROWS = 8  # rows of forces for each body
LEAST = 0.1  # length of an arc, relative to its rest length
REASONS = {"buckled", "compressed", "not at rest"}
POSES = {"upright": 0.4, "hanging": 0.3, "horizontal": 0.1, "random": 0.2}


@dataclass(frozen=True)
class Body:
    """A random body: the arguments of its chain, and rows of forces."""

    arguments: dict[str, Any]
    forces: NDArray
    pose: str

    def chain(self) -> ForceTendonChain:
        """Return the model of the body."""
        return ForceTendonChain(**self.arguments)


def bodies(count: int, seed: int = 0) -> Iterator[Body]:
    """Yield random bodies."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        S, arcs = rng.integers(1, 4), rng.integers(1, 7)
        lengths, radii = rng.uniform(0.05, 0.3, S), rng.uniform(0.005, 0.02, S)
        taper = rng.choice([0.0, 0.5]) * rng.random(S)
        bending = 10.0 ** rng.uniform(-3.0, 0.0) * np.sort(rng.uniform(0.3, 1.0, S))[::-1]
        axial = bending * 4.0 / (rng.uniform(0.5, 2.0) * radii.max()) ** 2
        heavy = 10.0 ** rng.uniform(-1.0, 2.0) * rng.choice([0.0, 1.0], p=[0.05, 0.95])
        weight = rng.uniform(0.5, 1.0, S)
        weight *= heavy * bending[0] / (lengths.sum() ** 2 * (weight @ lengths))
        pose = str(rng.choice([*POSES], p=[*POSES.values()]))
        gravity = {"upright": [0, 0, -1], "hanging": [0, 0, 1], "horizontal": [1, 0, 0]}
        down = np.asarray(gravity.get(pose, rng.normal(size=3)), dtype=float)
        base = np.eye(4)
        base[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        base[:3, 0] *= np.linalg.det(base[:3, :3])
        per_segment = int(rng.integers(2, 5))
        n = S * per_segment
        by_one_radian = bending[0] / (radii.max() * lengths.sum())
        forces = rng.uniform(0.0, 3.0, (ROWS, n)) * by_one_radian
        forces[0] = 0.0
        forces[1] = forces[1, 0]
        forces[2] *= 10.0 ** rng.uniform(-9.0, -3.0)
        forces[3:6] *= rng.random((3, n)) < 0.4
        arguments = {
            "radii": radii,
            "lengths": lengths,
            "bending_stiffness": bending,
            "axial_stiffness": axial * 10.0 ** rng.uniform(-1.0, 1.0),
            "n_actuators": per_segment,
            "routing": str(rng.choice(["base", "segment"])),
            "weight": weight,
            "taper": taper,
            "gravity": base[:3, :3] @ down,
            "arcs": int(arcs),
            "rest_bends": rng.choice([0.0, 0.5]) * rng.normal(size=(S, 2)),
            "offsets": rng.choice([0.0, 0.02]) * rng.random(S),
            "base": base,
        }
        yield Body(arguments, forces, pose)


class Energy(NamedTuple):
    """What the energy of a body depends on, each with leading axes."""

    rest: Tensor  # (3, A) lengths and bendings of the arcs without loads
    stiffness: Tensor  # (3, A)
    pulls: Tensor  # (3, A), tendon forces times the changes of their paths
    weights: Tensor  # (A,)
    offsets: Tensor  # (A,)
    down: Tensor  # (3,)

    @classmethod
    def of(cls, body: Body, row: int) -> Energy:
        """Return the energy for a row of forces, from the arguments of the body."""
        a = body.arguments
        S, k = len(a["lengths"]), a["arcs"]
        outer = (1.0 - np.outer(a["taper"], (np.arange(k) + 0.5) / k)).ravel()
        lengths = np.repeat(a["lengths"], k) / k
        axial = np.repeat(a["axial_stiffness"], k) * outer**2 / lengths
        bending = np.repeat(a["bending_stiffness"], k) * outer**4 / lengths
        unbent = np.repeat(a["rest_bends"], k, axis=0).T / k
        offsets = np.zeros((S, k))
        offsets[:, -1] = a["offsets"]
        pulls = np.zeros((3, S * k))
        per_segment = a["n_actuators"]
        for i, force in enumerate(body.forces[row]):
            # A tendon at angle t, radius r becomes shorter by a bend towards it.
            segment = i // per_segment
            t = 2.0 * np.pi * (i % per_segment) / per_segment
            r = a["radii"][segment]
            first = 0 if a["routing"] == "base" else segment
            path = np.array([1.0, -r * np.cos(t), -r * np.sin(t)])
            pulls[:, first * k : (segment + 1) * k] += force * path[:, None]
        parts = [
            np.vstack([lengths, unbent]),
            np.vstack([axial, bending, bending]),
            pulls,
            np.repeat(a["weight"], k) * outer**2 * lengths,
            offsets.ravel(),
            a["base"][:3, :3].T @ (a["gravity"] / np.linalg.norm(a["gravity"])),
        ]
        return cls(*map(torch.from_numpy, parts))

    def at(self, z: Tensor) -> Tensor:
        """Return the energy () of arcs (3, A) in units of the elastic energy."""
        arcs = z / self.stiffness.sqrt()
        strain = arcs - self.rest
        total = (0.5 * self.stiffness * strain**2 + self.pulls * strain).sum()
        turn = torch.eye(3, dtype=z.dtype)
        place = torch.zeros(3, dtype=z.dtype)
        for j, (length, x, y) in enumerate(arcs.T):
            _, middle = _arc(0.5 * length, 0.5 * x, 0.5 * y)  # the weight is half way
            total = total - self.weights[j] * (self.down @ (place + turn @ middle))
            rotation, end = _arc(length, x, y)
            place = place + turn @ end
            turn = turn @ rotation
            place = place + self.offsets[j] * turn[:, 2]
        return total


def _arc(length: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotation (3, 3) and the end (3,) of an arc with bending x, y."""
    square = x * x + y * y
    is_small = square < 1e-3
    angle = torch.where(is_small, 1.0, square).sqrt()
    series = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
    f = torch.where(is_small, series, angle.sin() / angle)
    series = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
    g = torch.where(is_small, series, 2.0 * (0.5 * angle).sin() ** 2 / angle**2)
    rows = [
        torch.stack([1.0 - g * x * x, -g * x * y, f * x]),
        torch.stack([-g * x * y, 1.0 - g * y * y, f * y]),
        torch.stack([-f * x, -f * y, 1.0 - g * square]),
    ]
    return torch.stack(rows), length * torch.stack([g * x, g * y, f])


def _of_energy(z: Tensor, *parts: Tensor) -> Tensor:
    return Energy(*parts).at(z)


class Rows(NamedTuple):
    """Rows with a number, of bodies with as many arcs."""

    pose: list[str]
    arcs: list[Tensor]  # (3, A) each
    energy: list[Energy]

    def lines(self) -> Iterator[tuple[str, float, float, float]]:
        """Yield pose, imbalance, least curvature and shortest arc of each row, relative."""
        arcs = torch.stack(self.arcs)
        energy = Energy(*map(torch.stack, zip(*self.energy, strict=True)))
        z = arcs * energy.stiffness.sqrt()
        slope = torch.func.vmap(torch.func.grad(_of_energy))(z, *energy)
        hessian = torch.func.vmap(torch.func.hessian(_of_energy), chunk_size=256)(z, *energy)
        hessian = hessian.flatten(3).flatten(1, 2)
        # The loads as generalised forces, and the elastic ones.
        elastic = z - energy.rest * energy.stiffness.sqrt()
        pulls = energy.pulls / energy.stiffness.sqrt()
        size = elastic.flatten(1).norm(dim=1) + pulls.flatten(1).norm(dim=1)
        size = size + 1e-6 * z.flatten(1).norm(dim=1)
        imbalance = slope.flatten(1).norm(dim=1) / size
        curvature = torch.linalg.eigvalsh(hessian)[:, 0]
        shortest = (arcs[:, 0] / energy.rest[:, 0]).amin(1)
        numbers = torch.stack([imbalance, curvature, shortest], dim=1).tolist()
        for pose, of_row in zip(self.pose, numbers, strict=True):
            yield pose, *of_row


def _reason(chain: ForceTendonChain, q: Tensor) -> str:
    """Return why a row has no number, or what is wrong with it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if chain(q).isfinite().any():
            return "alone it has one"
        if chain.in_domain(q):
            return "in the domain"
    if len(caught) != 1 or "row 0 " not in str(caught[0].message):
        return "silent"
    return str(caught[0].message).split(":")[0]


def examine(full: bool) -> Iterator[Line]:
    """Yield the claims."""
    torch.set_num_threads(1)
    by_size: dict[int, Rows] = {}
    refused: dict[str, Counter[str]] = {pose: Counter() for pose in POSES}
    for body in bodies(2500 if full else 60):
        chain = body.chain()
        q = torch.from_numpy(body.forces)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            lengths, bending = chain.arcs(q)
        arcs = torch.cat([lengths[:, None], bending.mT], dim=1)  # (N, 3, A)
        rows = by_size.setdefault(arcs.shape[2], Rows([], [], []))
        for row, shape in enumerate(arcs):
            if shape.isfinite().all():
                rows.pose.append(body.pose)
                rows.arcs.append(shape)
                rows.energy.append(Energy.of(body, row))
            else:
                refused[body.pose][_reason(chain, q[row])] += 1
    numbers: dict[str, list[tuple[float, ...]]] = {pose: [] for pose in POSES}
    for rows in by_size.values():
        for pose, *of_row in rows.lines():
            numbers[pose].append(tuple(of_row))
    for pose in POSES:
        imbalance, curvature, shortest = np.array(numbers[pose]).T
        n, worst, least = len(imbalance), imbalance.max(), curvature.min()
        yield Line(
            f"{pose}: at rest", f"{n} rows, imbalance at most {worst:.1e}", bool(worst < 1e-9)
        )
        yield Line(f"{pose}: stable", f"curvature at least {least:.1e}", bool(least > 0.0))
        yield Line(f"{pose}: arcs", f"at least {shortest.min():.3f}", bool(shortest.min() >= LEAST))
        words = ", ".join(f"{count} {reason}" for reason, count in sorted(refused[pose].items()))
        named = {*refused[pose]} <= REASONS
        yield Line(f"{pose}: refused rows are named", words or "none", named)
