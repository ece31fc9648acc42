"""Base class of all mechanical models: a tip, poses, and a geometry that can be calibrated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, TypeVar

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hybridkin._core.arrays import as_array, check_shape, countable
from hybridkin._core.blocks import check_tensor, check_vectors, in_blocks
from hybridkin._core.derived import KEPT, entries_of
from hybridkin._core.html import numbers
from hybridkin._core.model import ForwardModel, PoseModel, is_at_rest
from hybridkin._core.plausible import PlausibleRows, UnknownRows
from hybridkin._core.units import motion_message, span_message
from hybridkin.chains.body import Body
from hybridkin.chains.calibratable import Part, Scale
from hybridkin.native.library import evaluate

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

    # Names of parts of entries that `calibrate` knows too, and those entries.
    aliases: ClassVar[dict[str, str]] = {}
    # Rows that a choice of parameters needs for each of them. Those of soft robots also compensate
    # for what the model does not describe, and then fail outside the log.
    rows_per_parameter: ClassVar[float] = 7.0
    # Entry of the geometry with the zeros of the actuators [unit of q]; empty: none.
    _zeros: ClassVar[str] = ""

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
    def origin(self) -> Tensor:
        """Where the base of the robot is in the measuring frame, shape (3,) [m]."""
        return self.base[:3, 3]

    @property
    def mean_gain(self) -> float:
        """Mean length of a unit of q [m]; 1 if q holds none."""
        return 1.0

    def rivals(self, q: Tensor) -> list[Chain]:
        """Return other models of the same robot that rows q (N, n) give reason to compare."""
        return []

    def with_elastic_tendons(self) -> Chain:
        """Return the robot with tendons that give way, if that is another model; else itself."""
        return self

    def shifted(self, shift: Tensor) -> ForwardModel:
        """Return the robot after a shift (n,) of its zeros; a chain that has zeros stays one."""
        if not self._zeros or not shift.any():
            return super().shifted(shift)
        zeros = self.geometry()[self._zeros]
        return self.with_geometry(**{self._zeros: zeros - shift.to(zeros)})

    def moved(self, motion: Tensor) -> Self:
        """Return the chain after a motion (4, 4) of its base."""
        if is_at_rest(motion):
            return self
        return self.with_geometry(base=motion.to(self.base) @ self.base)

    def geometry(self) -> dict[str, Tensor]:
        """Return the geometry by name, as in the constructor; entries that are None are omitted."""
        entries = zip(self._entries, entries_of(self, self._entries), strict=True)
        return {name: value for name, value in entries if value is not None}

    @property
    def parameter_names(self) -> list[str]:
        """Names that `calibrate` accepts."""
        return [*self.geometry(), *self.aliases]

    def part_of(self, name: str) -> Part:
        """Return what a parameter of `calibrate` changes of the geometry."""
        return Part.whole(name, tuple(self.geometry()[name].shape))

    def scale_of(self, entry: str) -> Scale:
        """Return the natural scale of the numbers of an entry; of most it is the robot's length."""
        return Scale(float(self.reach), "m")

    @property
    def reversible(self) -> tuple[int, ...]:
        """Actuators whose motors may count in the opposite direction; by default none."""
        return ()

    def with_reversed(self, actuators: Sequence[int]) -> Chain:
        """Return the robot with some of the `reversible` actuators in the opposite direction."""
        return self

    def free_rings(self, names: tuple[str, ...]) -> set[str]:
        """Return what these parameters free of the actuator rings that must be searched."""
        return set()

    def unit_of(self, name: str) -> str:
        """Return the unit of an entry of the geometry, or of a parameter of `calibrate`.

        It is "m", "rad", "-" or another one.
        """
        return self._units.get(self.aliases.get(name, name), "m")

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

    def tips_once(self, q: Tensor) -> NDArray:
        """Return the tips (N, m) at rows q (N, n) of a chain that is evaluated there once."""
        return evaluate(self, q.numpy())[0]

    def slopes_once(self, q: Tensor, tangents: Mapping[str, Tensor]) -> Tensor:
        """Return `geometry_jacobian` (N, m, P) of a chain that is evaluated at these rows once."""
        return self.geometry_jacobian(q, tangents)

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

    def body(self, q: Tensor, n_points: int) -> Body:
        """Return what can be drawn of the robot at rows q (K, n): by default only its links."""
        return Body.of_links(as_array(self.backbone(q)))

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

    def plausible_rows(self) -> PlausibleRows:
        """Return bounds of rows that need no warning about units or contradictions.

        By default none are known, and the chain checks all rows.
        """
        return UnknownRows.of(self.n_actuators)

    def _why_shape(self) -> str:
        """Return why q must have its shape, for messages."""
        return f"this robot has {self.n_actuators} actuators"

    def _check_shape(self, q: Tensor, name: str = "q") -> None:
        """Raise if q does not have the shape (..., n_actuators)."""
        check_vectors(q, self.n_actuators, name, self._why_shape())

    def by_rows(
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
        return self.plausible_rows().small

    def far_messages(self, x: Tensor, name: str) -> list[str]:
        """Return a warning if tips span more than 50 times the robot's size."""
        origin = self.origin.detach().to(x)
        points = torch.cat([origin[None], x.reshape(-1, 3)])
        finite = points[countable(points).all(-1)]
        message = span_message(name, finite, self.size, _FAR)
        return [] if message is None else [message]

    def tip_messages(self, q: Tensor, x: Tensor, name: str, calibrated: bool = False) -> list[str]:
        """Return a warning if measured tips span far more than those of the chain.

        Tips x (N, m) are measured at rows q (N, n), missing ones NaN. Only if the chain is
        calibrated its own tips are counted with them: else its base may be anywhere.
        """
        own = self(q).detach()
        tips = x[:, : self.n_outputs]
        tips = torch.where(tips.isnan(), own, tips)
        if calibrated:
            tips = torch.cat([own, tips])
        message = motion_message(name, tips, own, self.size)
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
