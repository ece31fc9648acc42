"""The geometry of a chain as free parameters in natural units, zero at the start."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.rotations import cross_matrix, rotation
from hybridkin._core.stumpff import stumpff
from hybridkin.calibration.natural_scales import GEOMETRY
from hybridkin.chains.chain import Chain

_WIDEST = 1e6  # a prior of a million natural units has no effect, and is finite


@dataclass(frozen=True, eq=False)
class Parameter(ABC):
    """One parameter of `calibrate`, and how its free directions change the geometry.

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
    kinds : tuple of str
        Kind of each unit: "m", "rad", "q" or "-".
    shape : tuple of int
        Shape of the user's value of each direction.
    """

    name: str
    entry: str
    start: Tensor
    labels: tuple[str, ...]
    units: NDArray
    kinds: tuple[str, ...]
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of free directions."""
        return len(self.labels)

    @abstractmethod
    def entry_at(self, theta: Tensor) -> Tensor:
        """Return the entry at a point of the free directions (size,)."""

    @abstractmethod
    def tangents(self, theta: Tensor) -> Tensor:
        """Return the derivatives of `entry_at`, shape (size, ...)."""

    @abstractmethod
    def bounds(self) -> tuple[NDArray, NDArray]:
        """Return the physical limits of the free directions; the start is within them."""

    @abstractmethod
    def value(self, entry: Tensor) -> Tensor:
        """Return the part of the entry that this parameter stands for."""

    def std_errors(self, std: NDArray, value: NDArray) -> NDArray:
        """Return the standard errors of `value` from those of the free directions."""
        return (self.units * std).reshape(self.shape)


@dataclass(frozen=True, eq=False)
class Shifts(Parameter):
    """Numbers that change by addition along constant directions.

    Direction k changes the number with the index ``shown[k]``, and maybe others with it. `low` and
    `high` are the default bounds.
    """

    directions: Tensor  # (numel, size)
    shown: NDArray
    low: float
    high: float

    def entry_at(self, theta: Tensor) -> Tensor:
        return self.start + self._change(theta)

    def tangents(self, theta: Tensor) -> Tensor:
        return self.directions.to(theta).T.reshape(-1, *self.start.shape)

    def _change(self, theta: Tensor) -> Tensor:
        return (self.directions.to(theta) @ theta).reshape(self.start.shape)

    def bounds(self) -> tuple[NDArray, NDArray]:
        origin = self.start.numpy().ravel()[self.shown]
        low = (self.low - origin) / self.units
        high = (self.high - origin) / self.units
        return np.minimum(low, 0.0), np.maximum(high, 0.0)

    def value(self, entry: Tensor) -> Tensor:
        shown = torch.as_tensor(self.shown, device=entry.device)
        return entry.flatten()[shown].reshape(self.shape)


class Factors(Shifts):
    """Numbers that keep their sign: they change by the logarithm of their absolute value.

    The limits are those of the factor.
    """

    def entry_at(self, theta: Tensor) -> Tensor:
        return self.start * torch.exp(self._change(theta))

    def tangents(self, theta: Tensor) -> Tensor:
        return super().tangents(theta) * self.entry_at(theta)

    def bounds(self) -> tuple[NDArray, NDArray]:
        low = np.full(self.size, np.log(self.low))
        high = np.full(self.size, np.log(self.high))
        return low, high

    def std_errors(self, std: NDArray, value: NDArray) -> NDArray:
        return super().std_errors(std, value) * np.abs(value)


@dataclass(frozen=True, eq=False)
class Directions(Parameter):
    """Unit vectors (n, 3) that turn, each by two angles, along great circles from the start.

    Column k of `directions` holds unit vectors perpendicular to those of the start.
    """

    directions: Tensor  # (3 n, size)

    def entry_at(self, theta: Tensor) -> Tensor:
        way = self._way(theta)
        circular = stumpff(way.square().sum(-1, keepdim=True))
        return circular.c * self.start + circular.f * way

    def tangents(self, theta: Tensor) -> Tensor:
        way = self._way(theta)
        circular = stumpff(way.square().sum(-1, keepdim=True))
        steps = self.directions.to(theta).T.reshape(-1, *self.start.shape)
        along = (steps * way).sum(-1, keepdim=True)  # change of half the squared angle
        turned = (circular.c3 - circular.g) * way - circular.f * self.start
        return along * turned + circular.f * steps

    def _way(self, theta: Tensor) -> Tensor:
        return (self.directions.to(theta) @ theta).reshape(self.start.shape)

    def bounds(self) -> tuple[NDArray, NDArray]:
        return np.full(self.size, -np.inf), np.full(self.size, np.inf)

    def value(self, entry: Tensor) -> Tensor:
        return entry


@lru_cache(1)  # the derivatives are asked for where the pose was
def _rotation(x: float, y: float, z: float) -> tuple[Tensor, Tensor]:
    """Return the `rotation` of a vector, and its left Jacobian."""
    return rotation(torch.from_numpy(np.array([x, y, z])))


class Pose(Parameter):
    """A pose that changes by a rotation vector and a translation, both in the measuring frame."""

    def entry_at(self, theta: Tensor) -> Tensor:
        turned = _rotation(*theta[:3].tolist())[0].to(theta) @ self.start[:3, :3]
        position = self.start[:3, 3] + theta[3:] * torch.from_numpy(self.units[3:]).to(theta)
        pose = torch.cat([turned, position[:, None]], dim=1)
        return torch.cat([pose, self.start[3:]], dim=0)

    def tangents(self, theta: Tensor) -> Tensor:
        turned, left = [part.to(theta) for part in _rotation(*theta[:3].tolist())]
        tangents = self.start.new_zeros(6, 4, 4)
        # Spins about the columns of the left Jacobian.
        tangents[:3, :3, :3] = cross_matrix(left.T) @ (turned @ self.start[:3, :3])
        tangents[3:, :3, 3] = torch.diag(torch.from_numpy(self.units[3:]))
        return tangents

    def bounds(self) -> tuple[NDArray, NDArray]:
        return np.full(6, -np.inf), np.full(6, np.inf)

    def value(self, entry: Tensor) -> Tensor:
        return entry


def parameter(chain: Chain, name: str) -> Parameter:
    """Return one parameter at the chain's present geometry."""
    part = chain.part_of(name)
    entry = part.entry
    start = chain.geometry()[entry].detach().cpu()
    if entry == "base":
        reach = float(chain.reach)
        units = np.array([1.0, 1.0, 1.0, reach, reach, reach])
        axes = ("rot x", "rot y", "rot z", "x", "y", "z")
        labels = tuple(f"base[{axis}]" for axis in axes)
        kinds = ("rad", "rad", "rad", "m", "m", "m")
        return Pose(name, entry, start, labels, units, kinds, (6,))
    scale = chain.scale_of(entry)
    units = np.broadcast_to(scale.unit, len(part.shown))
    kinds = tuple(np.broadcast_to(scale.kind, len(part.shown)).tolist())
    directions = torch.from_numpy(part.directions * units)
    if scale.turns:
        start = start / start.norm(dim=1, keepdim=True)
        labels = tuple(f"{name}[{k // 3}, {'xyz'[k % 3]}]" for k in part.shown.tolist())
        return Directions(name, entry, start, labels, units, kinds, part.shape, directions)
    form = Factors if scale.keeps_sign else Shifts
    return form(
        name,
        entry,
        start,
        _labels(name, part.shape),
        units,
        kinds,
        part.shape,
        directions,
        part.shown,
        scale.low,
        scale.high,
    )


def _labels(name: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    if not shape:
        return (name,)
    labels = []
    for index in np.ndindex(*shape):
        words = [str(i) for i in index]
        if len(shape) == 2 and shape[1] in (2, 3):
            words[1] = "xyz"[index[1]]
        labels.append(f"{name}[{', '.join(words)}]")
    return tuple(labels)


@dataclass(frozen=True, eq=False)
class Problem:
    """The free parameters theta of a chain, all in natural units, zero at the start."""

    chain: Chain
    parameters: tuple[Parameter, ...]
    prior_std: NDArray
    low: NDArray
    high: NDArray

    @classmethod
    def of(cls, chain: Chain, names: tuple[str, ...], prior: float = GEOMETRY) -> Problem:
        """Return the problem for these names; the priors have the same standard deviation."""
        parameters = tuple(parameter(chain, name) for name in names)
        lows = [np.empty(0)]
        highs = [np.empty(0)]
        for part in parameters:
            low, high = part.bounds()
            lows.append(low)
            highs.append(high)
        low = np.concatenate(lows)
        return cls(
            chain,
            parameters,
            np.full(len(low), min(prior, _WIDEST)),
            low,
            np.concatenate(highs),
        )

    def places(self) -> Iterator[tuple[Parameter, slice]]:
        """Yield every parameter, and its place in theta."""
        first = 0
        for part in self.parameters:
            yield part, slice(first, first + part.size)
            first += part.size

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of all free directions."""
        return tuple(label for part in self.parameters for label in part.labels)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of the units of all free directions."""
        return tuple(kind for part in self.parameters for kind in part.kinds)

    def start(self, scale: float) -> NDArray:
        """Return the start with all radii times a factor, clipped to the limits."""
        theta = np.zeros(len(self.low))
        for part, place in self.places():
            if part.name == "radii":
                theta[place] = np.log(scale)
        return np.clip(theta, self.low, self.high)

    def chain_at(self, theta: NDArray) -> Chain:
        """Return the chain at theta (P,), without a graph."""
        with torch.no_grad():
            at = torch.from_numpy(theta).to(self.chain.geometry()["base"])
            geometry = {}
            for part, place in self.places():
                geometry[part.entry] = part.entry_at(at[place])
            return self.chain.with_geometry(**geometry)

    def tangents(self, theta: Tensor) -> dict[str, Tensor]:
        """Return the derivatives of the geometry by theta, (P, ...) for every changed entry."""
        tangents = {}
        for part, place in self.places():
            of_entry = theta.new_zeros(len(theta), *part.start.shape)
            of_entry[place] = part.tangents(theta[place])
            tangents[part.entry] = of_entry
        return tangents
