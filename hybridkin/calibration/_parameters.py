"""The geometry of a chain as free parameters in natural units, zero at the start."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin._core.arrays import identity
from hybridkin._core.rotations import cross_matrix, rotation
from hybridkin.chains.arc_chain import ALIASES, ArcChain
from hybridkin.chains.chain import Chain
from hybridkin.chains.rigid import RigidChain

_Vector = TypeVar("_Vector", NDArray, Tensor)

# Geometry that keeps its sign, and the factor by which it can grow or shrink from its start.
SCALED: dict[str, float] = {"bending_stiffness": 1e4, "axial_stiffness": 1e4}
SCALED |= {"radii": 5.0, "lengths": 5.0, "gains": 5.0}
_SHORTEST = -0.1  # of the robot's length: a marker may sit a little before the end


@dataclass(frozen=True, eq=False)
class _Named:
    """One parameter of `calibrate`, and how its free directions change an entry of the geometry.

    Attributes
    ----------
    name, entry : str
        Its name in `calibrate`, and the entry of ``chain.geometry()`` that it changes.
    start : Tensor
        The entry at the start.
    labels : tuple of str
        Its free directions, e.g. "radii[0]".
    units : ndarray
        Size of one natural unit of each direction: [m], [rad], [unit of q], or [-] as a fraction
        of its start.
    kind : tuple of str
        Kind of each unit: "m", "rad", "q" or "-".
    """

    name: str
    entry: str
    start: Tensor
    labels: tuple[str, ...]
    units: NDArray
    kind: tuple[str, ...]

    @property
    def size(self) -> int:
        """Number of free directions."""
        return len(self.labels)


@dataclass(frozen=True, eq=False)
class Entries(_Named):
    """Numbers that change along constant directions, each number along at most one of them.

    Numbers that keep their sign (`log`) change by the logarithm of their absolute value, which the
    bounds refer to. `physical` are the default bounds. The user's value has the entries with the
    indices `shown`, in `shape`.
    """

    directions: NDArray  # (numel, size)
    physical: tuple[ArrayLike, ArrayLike]
    shown: NDArray
    shape: tuple[int, ...]
    log: bool

    def moved(self, part: Tensor) -> Tensor:
        """Return the entry at a point of the free directions (size,)."""
        change = (torch.from_numpy(self.directions).to(part) @ part).reshape(
            self.start.shape
        )
        return self.start * torch.exp(change) if self.log else self.start + change

    def tangents(self, part: Tensor) -> Tensor:
        """Return the derivatives of `moved`, shape (size, ...)."""
        slope = (
            torch.from_numpy(self.directions.T.copy())
            .to(part)
            .reshape(-1, *self.start.shape)
        )
        return slope * self.moved(part) if self.log else slope

    def bounds(self, bound: tuple[float, float] | None) -> tuple[NDArray, NDArray]:
        """Return the limits of the free directions, by default the physical ones."""
        origin = self.start.numpy().ravel()[self.shown]
        if self.log:
            origin = np.abs(origin)
        low, high = self.physical if bound is None else bound
        if bound is None:  # the start itself is always allowed
            low = np.minimum(low, origin)
            high = np.maximum(high, origin)
        if not np.all(np.less(low, high)) or (self.log and np.any(np.less(low, 0.0))):
            need = (
                "(low, high) with low < high" + ", and must not be negative" * self.log
            )
            raise ValueError(f"`bounds` of {self.name!r} must be {need}, got {bound}.")
        if not self.log:
            return (low - origin) / self.units, (high - origin) / self.units
        with np.errstate(divide="ignore"):
            return np.log(low / origin), np.log(high / origin)

    def value(self, entry: Tensor) -> Tensor:
        """Return the part of the entry that this parameter stands for."""
        return entry.flatten()[
            torch.as_tensor(self.shown, device=entry.device)
        ].reshape(self.shape)

    def std_errors(self, std: NDArray, value: NDArray) -> NDArray:
        """Return the standard errors of `value` from those of the free directions."""
        error = (np.abs(self.directions) @ std)[self.shown].reshape(self.shape)
        return error * np.abs(value) if self.log else error

    def flags(self, identified: NDArray) -> NDArray:
        """Return for each entry of `value` whether the directions that change it are identified."""
        flags = ~((self.directions != 0) & ~identified).any(axis=1)
        return flags[self.shown].reshape(self.shape)


class Posed(_Named):
    """A pose that changes by a rotation vector and a translation, both in the measuring frame.

    It has the same methods as `Entries`.
    """

    def moved(self, part: Tensor) -> Tensor:
        turned = rotation(part[:3])[0] @ self.start[:3, :3]
        position = self.start[:3, 3] + part[3:] * torch.from_numpy(self.units[3:]).to(
            part
        )
        pose = torch.cat([turned, position[:, None]], dim=1)
        return torch.cat([pose, self.start[3:]], dim=0)

    def tangents(self, part: Tensor) -> Tensor:
        turned, left = rotation(part[:3])
        tangents = self.start.new_zeros(6, 4, 4)
        # Spins about the columns of the left Jacobian.
        tangents[:3, :3, :3] = cross_matrix(left.T) @ (turned @ self.start[:3, :3])
        tangents[3:, :3, 3] = torch.diag(torch.from_numpy(self.units[3:]).to(part))
        return tangents

    def bounds(self, bound: tuple[float, float] | None) -> tuple[NDArray, NDArray]:
        if bound is not None:
            raise ValueError(
                f"`bounds` cannot hold {self.name!r}; use `prior={{{self.name!r}: ...}}` instead."
            )
        return np.full(6, -np.inf), np.full(6, np.inf)

    def value(self, entry: Tensor) -> Tensor:
        return entry

    def std_errors(self, std: NDArray, value: NDArray) -> NDArray:
        return std * self.units

    def flags(self, identified: NDArray) -> NDArray:
        return identified


Parameter = Entries | Posed


def parameter_names(chain: Chain) -> list[str]:
    """Return the names that `calibrate` accepts for a chain."""
    aliases = ALIASES if isinstance(chain, ArcChain) else ()
    return [*chain.geometry(), *aliases]


def parameter(chain: Chain, name: str) -> Parameter:
    """Return the free directions of one parameter, at the chain's present geometry."""
    geometry = {key: value.detach().cpu() for key, value in chain.geometry().items()}
    entry = name if name in geometry else ALIASES[name]
    start = geometry[entry]
    reach = float(chain.reach)
    shape = tuple(start.shape)
    size = start.numel()
    if name == "base":
        labels = tuple(
            f"base[{axis}]" for axis in ("rot x", "rot y", "rot z", "x", "y", "z")
        )
        units = np.array([1.0, 1.0, 1.0, reach, reach, reach])
        return Posed(name, name, start, labels, units, (*("rad",) * 3, *("m",) * 3))
    unit = reach
    kind = "m"
    physical = (-np.inf, np.inf)
    origin = np.abs(start.numpy().ravel())
    joints = chain.units if isinstance(chain, RigidChain) else []
    kinds = tuple(joints) if entry == "joint_zeros" else ()
    if entry in SCALED:
        unit = 1.0
        kind = "-"
        physical = origin / SCALED[entry], origin * SCALED[entry]
    elif entry == "rest_bends":
        unit = 1.0
        kind = "rad"
        physical = (-math.pi, math.pi)
    elif entry == "angles":
        unit = 1.0
        kind = "rad"
    elif entry == "offsets":
        physical = (_SHORTEST * reach, np.inf)
    elif kinds:
        unit = np.where(np.array(kinds) == "m", reach, 1.0)
    elif entry == "tendon_zeros":
        unit = float(geometry["radii"].mean())
    elif entry == "actuator_zeros":
        unit = float(geometry["radii"].mean() / geometry["gains"].abs().mean())
        kind = "m" if (geometry["gains"] == 1.0).all() else "q"
    directions = unit * np.eye(size)
    shown = np.arange(size)
    if name == "turns" and isinstance(
        chain, ArcChain
    ):  # each segment's actuators together
        counts = np.array(chain.actuators_per_segment)
        directions = np.repeat(np.eye(len(counts)), counts, axis=0)
        shown = np.cumsum(counts) - counts
        shape = (len(counts),)
    elif name == "gain":  # a common factor
        directions = np.ones((size, 1))
        shown = shown[:1]
        shape = ()
        physical = origin[:1] / SCALED[entry], origin[:1] * SCALED[entry]
    elif name != entry:  # "tool", the last of the offsets
        directions = directions[:, -1:]
        shown = shown[-1:]
        shape = ()
    labels = _labels(name, shape)
    size = len(shown)
    basic = (
        name,
        entry,
        start,
        labels,
        np.broadcast_to(unit, size),
        kinds or (kind,) * size,
    )
    return Entries(*basic, directions, physical, shown, shape, log=entry in SCALED)


def _labels(name: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    if len(shape) == 2 and shape[1] in (2, 3):
        return tuple(
            f"{name}[{k}, {axis}]"
            for k in range(shape[0])
            for axis in "xyz"[: shape[1]]
        )
    if not shape:
        return (name,)
    return tuple(
        f"{name}[{', '.join(map(str, index))}]" for index in np.ndindex(*shape)
    )


@dataclass(frozen=True, eq=False)
class Problem:
    """The free parameters theta of a chain, all in natural units, zero at the start."""

    chain: Chain
    parameters: tuple[Parameter, ...]
    prior_std: NDArray
    low: NDArray
    high: NDArray

    @classmethod
    def of(
        cls,
        chain: Chain,
        names: tuple[str, ...],
        bounds: Mapping[str, tuple[float, float]],
        prior: Mapping[str, float],
    ) -> Problem:
        """Return the problem for these names, with limits and priors from the user's."""
        parameters = tuple(parameter(chain, name) for name in names)
        limits = [part.bounds(bounds.get(part.name)) for part in parameters]
        stds = [np.full(part.size, prior[part.name]) for part in parameters]
        low, high = (np.concatenate(side) for side in zip(*limits, strict=True))
        return cls(chain, parameters, np.concatenate(stds), low, high)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of all free directions."""
        return tuple(label for part in self.parameters for label in part.labels)

    def start(self, scale: float) -> NDArray:
        """Return the start with all radii times a factor, clipped to the limits."""
        logs = [
            np.log(scale) if part.name == "radii" else 0.0 for part in self.parameters
        ]
        sizes = [part.size for part in self.parameters]
        return np.clip(np.repeat(logs, sizes), self.low, self.high)

    def parts(self, theta: _Vector) -> list[_Vector]:
        """Return theta (P,), split by parameters."""
        ends = np.cumsum([part.size for part in self.parameters])
        starts = [0, *ends[:-1]]
        return [theta[a:b] for a, b in zip(starts, ends, strict=True)]

    def chain_at(self, theta: NDArray) -> Chain:
        """Return the chain at theta (P,), without a graph."""
        with torch.no_grad():
            return self.moved(torch.from_numpy(theta).to(self.chain.geometry()["base"]))

    def moved(self, theta: Tensor) -> Chain:
        """Return the chain at theta (P,), differentiable in it."""
        pairs = zip(self.parameters, self.parts(theta), strict=True)
        return self.chain.with_geometry(
            **{part.entry: part.moved(at) for part, at in pairs}
        )

    def tangents(self, theta: Tensor) -> dict[str, Tensor]:
        """Return the derivatives of the geometry by theta, (P, ...) for every changed entry."""
        rows = self.parts(identity(len(theta), theta))
        pairs = zip(self.parameters, self.parts(theta), rows, strict=True)
        return {
            part.entry: torch.tensordot(own.mT, part.tangents(at), 1)
            for part, at, own in pairs
        }
