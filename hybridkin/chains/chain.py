"""Base class of all mechanical models: a tip, poses, and a geometry that can be calibrated."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, ClassVar, TypeVar

import torch
from torch import Tensor, nn

from hybridkin._core.arrays import check_shape, countable
from hybridkin._core.blocks import check_tensor, check_vectors, in_blocks
from hybridkin._core.derived import KEPT, entries_of
from hybridkin._core.html import numbers
from hybridkin._core.model import PoseModel
from hybridkin._core.plausible import PlausibleRows
from hybridkin._core.units import span_message

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["Chain"]

_Values = TypeVar("_Values", bound=Tensor | tuple[Tensor, ...])
_FAR = 50.0  # robot sizes; some extensible robots are long and thin


class Chain(PoseModel):
    """A mechanical model of a robot: q -> tip position, with a geometry.

    Its state is its geometry: buffers, or parameters in their place. Whatever else `forward` needs
    is `derived` from them. A subclass lists the entries in `_entries` and its other attributes in
    `_structure`.

    Attributes
    ----------
    base : Tensor of shape (4, 4)
        Pose of the robot's base in the measuring frame.
    """

    _entries: ClassVar[tuple[str, ...]]
    _structure: ClassVar[tuple[str, ...]]
    _units: ClassVar[dict[str, str]] = {
        "angles": "rad",
        "rest_bends": "rad",
        "gains": "m/unit of q",
        "axial_stiffness": "-",
        "bending_stiffness": "m²/rad²",
        "actuator_zeros": "unit of q",
        "joint_zeros": "unit of q",
    }

    base: Tensor

    @property
    def default_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that a calibration fits by default."""
        raise NotImplementedError

    @property
    def parameter_sets(self) -> list[tuple[str, ...]]:
        """Sets of parameters that ``calibrate="auto"`` compares, the smaller ones first."""
        return [(), self.default_parameters]

    @property
    def reach(self) -> Tensor:
        """Size of the robot, shape () [m]."""
        raise NotImplementedError

    @property
    def units(self) -> str | list[str]:
        """Unit of q, or of each actuator."""
        return "as in training"

    def geometry(self) -> dict[str, Tensor]:
        """Return the geometry by name, as in the constructor; entries that are None are omitted."""
        entries = zip(self._entries, entries_of(self, self._entries), strict=True)
        return {name: value for name, value in entries if value is not None}

    def unit_of(self, name: str) -> str:
        """Return the unit of an entry of the geometry: "m", "rad", "-" or another one."""
        return self._units.get(name, "m")

    def html_rows(self) -> dict[str, object]:
        """Return names and values that a notebook shows of the chain."""
        rows = super().html_rows()
        for name, value in self.geometry().items():
            rows[f"{name} [{self.unit_of(name)}]"] = numbers(value.detach())
        return rows

    def with_geometry(self, **geometry: Tensor) -> Self:
        """Return a chain with parts of the geometry replaced, differentiable in the new values.

        Parameters
        ----------
        **geometry : Tensor
            Entries of `geometry()`, in the same shapes and units. The values are not checked.

        Returns
        -------
        Chain
            A new chain of the same kind; this one is not changed.
        """
        current = self.geometry()
        for name, value in geometry.items():
            if name not in current:
                raise ValueError(
                    f"`{name}` is not part of this chain's geometry; it has {sorted(current)}."
                )
            check_tensor(value, name)
            check_shape(value, name, current[name].shape)
        chain = type(self).__new__(type(self))
        nn.Module.__init__(chain)
        for name in self._structure:
            chain.__dict__[name] = self.__dict__[name]
        chain.__dict__[KEPT] = dict(self.__dict__.get(KEPT, {}))
        chain._parameters.update(self._parameters)
        chain._buffers.update(self._buffers)
        chain._set_geometry(geometry)
        return chain

    def near_last_shapes(self) -> Self:
        """Return a chain whose searches start where the last one for the same q ended.

        So do those of all chains that `with_geometry` makes of it. A chain without searches is
        returned as it is.
        """
        return self

    def _set_geometry(self, geometry: Mapping[str, Tensor | None]) -> None:
        """Register entries of the geometry, parameters as such and other tensors as buffers."""
        for name, value in geometry.items():
            if isinstance(value, nn.Parameter):
                self._buffers.pop(name, None)
                self.register_parameter(name, value)
            else:
                self._parameters.pop(name, None)
                self.register_buffer(name, value)

    def geometry_jacobian(self, q: Tensor, tangents: Mapping[str, Tensor]) -> Tensor:
        """Return the derivative of the tip along P changes of the geometry, shape (..., 3, P).

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator vectors.
        tangents : dict of str to Tensor of shape (P, ...)
            P changes of entries of `geometry()`, stacked; other entries do not change.
        """
        self._check_tangents(tangents)
        self._check_shape(q)
        return self._slope_of(lambda chain: chain(q), tangents)

    def _slope_of(
        self, function: Callable[[Self], _Values], tangents: Mapping[str, Tensor]
    ) -> _Values:
        """Return derivatives (..., P) of tensors of a chain along P changes of its geometry."""
        geometry = self.geometry()

        def moved(steps: Tensor) -> _Values:
            entries = {}
            for name, tangent in tangents.items():
                entry = geometry[name]
                change = torch.tensordot(steps.to(entry), tangent.to(entry), 1)
                entries[name] = entry + change
            chain = self.with_geometry(**entries)
            return function(chain)

        first = next(iter(tangents.values()))
        return torch.func.jacfwd(moved)(first.new_zeros(len(first)))

    def _check_tangents(self, tangents: Mapping[str, Tensor]) -> None:
        geometry = self.geometry()
        if not tangents or not {*tangents} <= {*geometry}:
            need = f"must map entries of the geometry, {[*geometry]}, to changes"
            raise ValueError(f"`tangents` {need}, got {tangents!r:.80}.")
        for name, value in tangents.items():
            check_tensor(value, f"tangents[{name!r}]")
        first = next(iter(tangents.values()))
        n_changes = len(first) if first.ndim else 1
        for name, value in tangents.items():
            shape = (n_changes, *geometry[name].shape)
            check_shape(value, f"tangents[{name!r}]", shape)

    def poses(self, q: Tensor) -> Tensor:
        """Return the poses (..., K, 4, 4) of the base and of the frames along the robot."""
        raise NotImplementedError

    def backbone(self, q: Tensor, n_points: int = 20) -> Tensor:
        """Return points (..., P, 3) along the robot, base to end [m]."""
        raise NotImplementedError

    def check_actuators(self, q: Tensor, name: str = "q") -> list[str]:
        """Return warnings about the units of q; raise if q cannot be a log of this robot.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator vectors [m]; [rad] for revolute joints.
        name : str, default="q"
            Name of `q` in messages.

        Returns
        -------
        list of str
            One message for each unit that looks wrong: millimetres, degrees.

        Raises
        ------
        ValueError
            For a wrong shape, for NaN or infinite entries, and for absolute actuator lengths that
            are not positive.
        """
        self._check_shape(q, name)
        rows = q.detach().reshape(-1, self.n_actuators)
        bad = ~countable(rows).all(dim=1)
        if bad.any():
            raise ValueError(
                f"`{name}` must be finite, got NaN or infinity in {int(bad.sum())} of {len(rows)} "
                f"rows (first: row {int(bad.nonzero()[0])}; more than 1e75 counts as infinite); "
                "drop those rows."
            )
        self._check_rows(rows, name)
        return self.unit_messages(rows, name)

    def plausible_rows(self) -> PlausibleRows | None:
        """Return bounds of rows that need no warning about units or contradictions, if known."""
        return None

    def _why_shape(self) -> str:
        """Return why q must have its shape, for messages."""
        return f"this robot has {self.n_actuators} actuators"

    def _check_shape(self, q: Tensor, name: str = "q") -> None:
        """Raise if q does not have the shape (..., n_actuators)."""
        check_vectors(q, self.n_actuators, name, self._why_shape())

    def _by_rows(
        self,
        function: Callable[[Tensor], tuple[Tensor, ...]],
        q: Tensor,
        size: int = 4096,
    ) -> tuple[Tensor, ...]:
        """Return the tensors (..., K) of a function of rows (N, n) at q (..., n), by blocks."""
        self._check_shape(q)
        return in_blocks(function, q, size)

    def _check_rows(self, rows: Tensor, name: str) -> None:
        """Raise if finite rows (N, n) cannot be a log of this robot."""

    @property
    def size(self) -> float:
        """Size of the robot [m], its reach."""
        return float(self.reach.detach())

    @property
    def farthest(self) -> float:
        """Distance from a tip beyond which a target is in another unit [m]."""
        return _FAR * self.size

    @property
    def longest_usual(self) -> float:
        """Length of q up to which `unit_messages` has nothing to say; infinite: unknown."""
        plausible = self.plausible_rows()
        return math.inf if plausible is None else plausible.small

    def far_messages(self, x: Tensor, name: str) -> list[str]:
        """Return a warning if tips span more than 50 times the robot's size."""
        origin = self.base[:3, 3].detach().to(x)
        points = torch.cat([origin[None], x.reshape(-1, 3)])
        finite = points[countable(points).all(-1)]
        message = span_message(name, finite, self.size, _FAR)
        return [] if message is None else [message]

    def misses(self, x: Tensor, largest: Tensor) -> Tensor:
        """Return how much farther points are from the base than the stretched robot is long."""
        base = self.base[:3, 3]
        away = x.unflatten(-1, (-1, 3)) - base.to(x.device)
        longest = self.longest(largest.to(base.device))
        return away.norm(dim=-1).amax(-1) - torch.as_tensor(longest, device=x.device)

    def longest(self, largest: Tensor) -> Tensor | float:
        """Return an upper bound of the distance from base to tip for ``|q| <= largest`` [m]."""
        return torch.inf

    def contradiction(self, q: Tensor, name: str = "q") -> str | None:
        """Return a warning if the actuators of q (..., n) contradict each other, else None.

        Always None for a robot whose actuators cannot contradict each other.
        """
        return None
