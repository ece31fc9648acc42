"""A heavy, tapered elastic body pulled by tendons of given forces, as a torch module q -> x."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from hybridkin._core.arrays import Numbers, Transform, identity, whole
from hybridkin._core.stored import Layout, Restore, Stored
from hybridkin.chains._arcs import WorkOfGravity, segments_of
from hybridkin.chains._checks import filled, float_dtype, numeric, stiffnesses
from hybridkin.chains._slack import WithoutDerivative, applied
from hybridkin.chains.arc_chain import STRUCTURE, ArcChain, Change
from hybridkin.chains.chain import Chain
from hybridkin.chains.markers import MarkedChain, Marker

__all__ = ["ForceTendonChain"]

_MOST_STEPS = 100
_MOST_ARCS = 50  # of a segment
_CONVERGED = 1e-6  # last Newton step, in units of 1 J^(1/2); two more follow
_ROUNDING = 1e-12


class _Statics(NamedTuple):
    """The energy of a shape: arcs (3 A, N), all lengths, then x- and y-bendings.

    ``1/2 (a - rest)' K (a - rest) + a' B' f`` minus the work of gravity.
    """

    stiffness: Tensor  # (3 A,), diagonal of K
    rest: Tensor  # (3 A,), without forces and weight
    readings: Tensor  # B (n, 3 A), change of the tendon paths per change of shape
    weights: Tensor  # (A,) [N]
    offsets: Tensor  # (A,), rigid length after each arc [m]
    down: Tensor  # (3,), direction of gravity in the frame of the base

    def at(self, rows: Tensor) -> _Statics:
        """Return the same on the device of rows."""
        return _Statics(*(part.to(rows.device) for part in self))

    def shape_of_least_energy(
        self, forces: Tensor, arcs: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return arcs (3 A, N) at a minimum of the energy, and the inverse Hessian (N, 3 A, 3 A).

        Newton steps from the given arcs. A step that does not lower the energy is repeated with
        more damping. Each coordinate is scaled by the root of its stiffness.
        """
        unit = self.stiffness.rsqrt()
        column_unit = unit[:, None]
        eye = identity(len(unit), forces)
        shape = _Shape(self, arcs, forces)
        energy = shape.energy
        damping = torch.zeros_like(energy)
        for _ in range(_MOST_STEPS):
            # The damped Newton step; none where the damped Hessian is not positive.
            imbalance = (column_unit * shape.imbalance).mT
            hessian = column_unit * shape.hessian * unit
            damped = hessian + damping[:, None, None] * eye
            factor, failed = torch.linalg.cholesky_ex(damped)
            factor = torch.where(failed[:, None, None] > 0, eye, factor)
            descent = torch.cholesky_solve(imbalance[..., None], factor)[..., 0]

            # Accepted if it lowers the energy, or is near the end.
            moved = arcs - column_unit * descent.mT
            shape = _Shape(self, moved, forces)
            moved_energy = shape.energy
            size = descent.abs().amax(1)
            lower = moved_energy <= energy + _ROUNDING * energy.abs()
            accepted = (failed == 0) & (lower | (size < _CONVERGED))
            arcs = torch.where(accepted, moved, arcs)
            if not accepted.all():
                shape = _Shape(self, arcs, forces)
            energy = torch.where(accepted, moved_energy, energy)

            more = (10.0 * damping).clamp(min=0.1)
            less = torch.where(damping > 1e-3, 0.1 * damping, 0.0)
            damping = torch.where(accepted, less, more)
            if (accepted & (size < _CONVERGED)).all():
                break
        hessian = column_unit * shape.hessian * unit
        inverse, _ = torch.linalg.solve_ex(hessian, eye.expand_as(hessian))
        return arcs, column_unit * inverse * unit


@dataclass
class _LastShapes:
    """The arcs (3 A, N) that the last search found for rows q (N, n)."""

    q: Tensor
    arcs: Tensor


class _Shape:
    """Arcs (3 A, N) with tendon forces (N, n): their energy and its derivatives."""

    def __init__(self, statics: _Statics, arcs: Tensor, forces: Tensor) -> None:
        self.statics = statics
        self.arcs = arcs
        self.forces = forces
        self.strain = arcs - statics.rest[:, None]
        segments = segments_of(arcs, statics.offsets[:, None])
        weights = statics.weights[:, None]
        self.gravity = WorkOfGravity(segments, weights, statics.down[:, None])

    @property
    def energy(self) -> Tensor:
        """The energy (N,) [J]."""
        squares = self.strain.square()
        elastic = 0.5 * (self.statics.stiffness[:, None] * squares).sum(0)
        tendons = (self.forces.mT * (self.statics.readings @ self.strain)).sum(0)
        return elastic + tendons - self.gravity.value

    @property
    def imbalance(self) -> Tensor:
        """The derivative (3 A, N) of the energy by the arcs: zero at rest."""
        elastic = self.statics.stiffness[:, None] * self.strain
        tendons = self.statics.readings.mT @ self.forces.mT
        return elastic + tendons - self.gravity.gradient()

    @property
    def hessian(self) -> Tensor:
        """The second derivative (N, 3 A, 3 A) of the energy by the arcs."""
        by_gravity = self.gravity.hessian().permute(2, 0, 1)
        return torch.diag(self.statics.stiffness) - by_gravity


class ForceTendonChain(ArcChain):
    """Tip position of a heavy, tapered elastic body whose tendons are pulled with given forces.

    q holds the tendon forces [N]. Each segment is divided into arcs of constant curvature and equal
    rest length. The shape a, the lengths and bending vectors of all arcs, has least energy

        1/2 (a - a0)' K (a - a0) + (gains * q)' B a - sum_j W_j g . p_j(a)

    with the straight or bent rest shape a0, the path lengths B of the tendons, and the weight W_j
    of every arc at its centre p_j. Tendons pull only: a negative force counts as zero. Without
    weight the shape is linear in q.

    The outer radius of a segment falls linearly to (1 - taper) times that at its start. Along with
    it the bending stiffness falls by the fourth power, axial stiffness and weight by the second.
    The radius of the tendon circle is constant along a segment.

    Parameters
    ----------
    radii : array-like of shape (S,)
        Radius of the tendon circle of each segment, base to tip [m].
    lengths : array-like of shape (S,)
        Length of each segment without forces and weight [m].
    bending_stiffness : float or array-like of shape (S,)
        Bending stiffness at the start of each segment, Young's modulus times the second moment of
        area [N m^2].
    axial_stiffness : float or array-like of shape (S,)
        Axial stiffness at the start of each segment, Young's modulus times the area [N].
    n_actuators : int or sequence of S ints, default=3
        Tendons that end at each segment.
    angles : array-like, optional
        Tendon angles about the backbone, counter-clockwise from the base x-axis [rad]: shape
        ``(n,)`` for all segments alike, ``(S, n)``, or one sequence per segment. Default: evenly
        spaced from 0.
    routing : {"base", "segment"}, default="base"
        "base": tendons of a segment also run through all segments nearer the base.
    weight : float or array-like of shape (S,), default=0.0
        Weight per length at the start of each segment [N/m].
    taper : float or array-like of shape (S,), default=0.0
        Relative loss of outer radius from the start to the end of each segment, below 1 [-].
    gravity : array-like of shape (3,), default=(0, 0, -1)
        Direction of gravity in the measuring frame [-].
    arcs : int, default=6
        Arcs of each segment.
    gains : float or array-like of shape (S,) or (n,), default=1.0
        Newtons per unit of q.
    rest_bends : float or array-like of shape (S, 2), default=0.0
        Bending vector of each segment without forces and weight [rad].
    offsets : float or array-like of shape (S,), default=0.0
        Rigid, weightless length after each segment along its tangent [m]; the last one is the tool.
    base : array-like of shape (4, 4) or pytorch_kinematics Transform3d, optional
        Pose of the robot's base in the measuring frame. Default: identity.
    dtype : torch.dtype, default=torch.float64
        Precision of the stored geometry. Shapes are solved in float64; results have the dtype of q.

    Notes
    -----
    Newton's method on the energy of every row; derivatives follow from the implicit function
    theorem. Heavy bodies can have several stable shapes; the one returned is reached from the rest
    shape. The force of a tendon is the same along its path: no friction.

    `calibrate` can also fit "marker_offsets", the offsets of the markers in the frames of their
    places [m]. Forces identify the tendon radii only together with weight and stiffness: give the
    radii as measured. There is no compiled kernel.

    References
    ----------
    Rucker & Webster, IEEE Trans. Robotics 27 (2011), statics of tendon-driven robots; Renda et al.,
    IEEE Trans. Robotics 34 (2018), piecewise constant strain.

    Examples
    --------
    >>> import torch
    >>> from hybridkin import ForceTendonChain
    >>> chain = ForceTendonChain([0.01], [0.3], 0.02, 200.0, weight=1.0, taper=0.5)
    >>> chain(torch.zeros(3, dtype=torch.float64)).shape
    torch.Size([3])
    """

    _entries = (
        "radii",
        "angles",
        "bending_stiffness",
        "axial_stiffness",
        "weight",
        "taper",
        "rest_bends",
        "gains",
        "lengths",
        "offsets",
        "marker_offsets",
        "base",
    )
    layout = Layout(
        "force_tendons",
        dict.fromkeys(_entries, ""),
        {**STRUCTURE, "arcs_per_segment": int, "gravity": list},
    )
    _structure = (*ArcChain._structure, "arcs_per_segment", "gravity", "_last")

    _units: ClassVar[dict[str, str]] = {
        **Chain._units,
        "gains": "N/unit of q",
        "axial_stiffness": "N",
        "bending_stiffness": "N m²",
        "weight": "N/m",
        "taper": "-",
    }
    takes_lengths = False

    gravity: tuple[float, ...]
    marker_offsets: Tensor  # (K, 3)
    bending_stiffness: Tensor  # (S,)
    axial_stiffness: Tensor
    weight: Tensor
    taper: Tensor
    lengths: Tensor  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(
        self,
        radii: Numbers,
        lengths: Numbers,
        bending_stiffness: Numbers,
        axial_stiffness: Numbers,
        *,
        n_actuators: int | Sequence[int] = 3,
        angles: Numbers | None = None,
        routing: str = "base",
        weight: Numbers = 0.0,
        taper: Numbers = 0.0,
        gravity: Numbers = (0.0, 0.0, -1.0),
        arcs: int = 6,
        gains: Numbers = 1.0,
        rest_bends: Numbers = 0.0,
        offsets: Numbers = 0.0,
        base: Numbers | Transform | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        dtype = float_dtype(dtype)
        geometry = self._checked(
            routing,
            without_lengths=False,
            radii=radii,
            lengths=lengths,
            n_actuators=n_actuators,
            angles=angles,
            offsets=offsets,
            rest_bends=rest_bends,
            gains=gains,
            base=base,
            dtype=dtype,
        )
        S = self.n_segments
        weights = filled(weight, "weight", dtype, (S,))
        if not (weights >= 0.0).all():
            raise ValueError(
                f"`weight` must not be negative [N/m], got {weights.tolist()}."
            )
        tapers = filled(taper, "taper", dtype, (S,))
        if not ((tapers >= 0.0) & (tapers < 1.0)).all():
            raise ValueError(f"`taper` must lie in [0, 1), got {tapers.tolist()}.")
        down = numeric(gravity, "gravity", need="n", length=3)
        if not down.norm() > 0.0:
            raise ValueError(f"`gravity` must be a direction, got {down.tolist()}.")
        self.gravity = tuple((down / down.norm()).tolist())
        self._last: _LastShapes | None = None
        self.arcs_per_segment = whole(arcs, "arcs", most=_MOST_ARCS)
        geometry |= stiffnesses(bending_stiffness, axial_stiffness, dtype, S)
        geometry |= {
            "weight": weights,
            "taper": tapers,
            "marker_offsets": geometry["base"].new_zeros(1, 3),
        }
        self._set_geometry(geometry)

    @property
    def default_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that a calibration fits by default."""
        statics = ("bending_stiffness", "axial_stiffness", "weight", "taper")
        return (*statics, "rest_bends", "turns", "base")

    @property
    def parameter_sets(self) -> list[tuple[str, ...]]:
        """Sets of parameters that ``calibrate="auto"`` compares, the smaller ones first."""
        statics = ("base", "bending_stiffness", "axial_stiffness", "weight")
        shape = (*statics, "taper", "rest_bends")
        return [(), ("base",), statics, shape, (*shape, "turns", "marker_offsets")]

    @property
    def in_metres(self) -> bool:
        """Whether q is in metres: False, it holds forces."""
        return False

    @property
    def units(self) -> str:
        """Unit of q."""
        return "N" if (self.gains == 1.0).all() else "as in training"

    @property
    def rigid_length(self) -> Tensor:
        """Upper bound of the length of rigid offsets and of the way to a marker, shape () [m]."""
        return self.offsets.abs().sum() + self.marker_offsets.abs().sum()

    def tips(self) -> list[MarkedChain]:
        """Return one chain per marker, each mapping q (..., n) to x (..., 3)."""
        offsets = self.marker_offsets.tolist()
        tips: list[MarkedChain] = []
        for (at, *_), (x, y, z) in zip(self.markers, offsets, strict=True):
            tips.append(self._marked([(at, x, y, z)]))
        return tips

    def near_last_shapes(self) -> ForceTendonChain:
        """Return a chain whose searches start where the last one for the same q ended."""
        chain = self.with_geometry()
        chain._last = _LastShapes(self.gains[:0], self.gains[:0])
        return chain

    def forces(self, q: Tensor) -> Tensor:
        """Return the tendon forces (..., n) [N] at q (..., n); they are not negative."""
        self._check_shape(q)
        return (self.gains.to(q) * q).clamp(min=0.0)

    def metres(self, q: Tensor) -> Tensor:
        """Return the forces (..., n) [N] of q (..., n): they take the place of length changes."""
        return self.forces(q)

    def unit_messages(self, q: Tensor, name: str, factor: float = 1.0) -> list[str]:
        """Return no warning: forces have no plausible size that the geometry gives."""
        return []

    def plausible_rows(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return None: every force is plausible."""

    def _set_markers(self, markers: Sequence[Marker]) -> None:
        super()._set_markers(markers)
        offsets = [offset for _, *offset in self.markers]
        like = self._buffers.get("base")
        if like is not None:  # None while the chain is built
            self.register_buffer("marker_offsets", like.new_tensor(offsets))

    def _beside(self, like: Tensor) -> Tensor:
        return self.marker_offsets.to(like).mT[..., None]

    def _check_rows(self, rows: Tensor, name: str) -> None:
        forces = rows * self.gains.detach().to(rows)
        n_negative = int((forces < 0.0).any(dim=1).sum())
        if n_negative:
            raise ValueError(
                f"`{name}` must hold tendon forces that pull, gains * q >= 0, got "
                f"{n_negative} of {len(rows)} rows with a negative one."
            )

    def _lost_radii(self, taper: Tensor) -> Tensor:
        """Return the relative loss of outer radii (..., S, k) up to the middle of each arc."""
        k = self.arcs_per_segment
        middles = torch.arange(k, dtype=torch.float64, device=taper.device) + 0.5
        return taper.double()[..., None] * middles / k

    def _statics(self) -> _Statics:
        """Return the energy of shapes, in float64."""
        k = self.arcs_per_segment
        base = self.base.double()

        outer = 1.0 - self._lost_radii(self.taper)
        length = self.lengths.double()[:, None].expand(-1, k) / k
        weights = self.weight.double()[:, None] * outer**2 * length
        axial = self.axial_stiffness.double()[:, None] * outer**2 / length
        bending = self.bending_stiffness.double()[:, None] * outer**4 / length
        rest_x, rest_y = self.rest_bends.double()[..., None].expand(-1, -1, k).unbind(1)
        rest = torch.stack([length, rest_x / k, rest_y / k])
        readings = self._readings().to(base).unflatten(-1, (3, -1))
        down = torch.tensor(self.gravity, dtype=base.dtype, device=base.device)
        return _Statics(
            stiffness=torch.stack([axial, bending, bending]).flatten(),
            rest=rest.flatten(),
            readings=readings.repeat_interleave(k, dim=-1).flatten(1),
            weights=weights.flatten(),
            offsets=self.arc_offsets.to(base),
            down=base[:3, :3].mT @ down,
        )

    def _arcs_of_rows(self, rows: Tensor) -> Tensor:
        return self._at_rest(rows.double()).to(rows)

    def _arcs_and_slope(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        q = rows.double()
        arcs = self._at_rest(q)
        statics = self._statics().at(q)
        gains = self.gains.to(q)
        shape = _Shape(statics, arcs, self.forces(q))
        by_force, _ = torch.linalg.solve_ex(shape.hessian, -statics.readings.mT)
        pulls = (gains * q >= 0.0) * gains
        slope = by_force * pulls[:, None]
        return arcs.to(rows), slope.permute(1, 2, 0).to(rows)

    def _arcs_and_change(
        self, rows: Tensor, tangents: Mapping[str, Tensor]
    ) -> tuple[Tensor, Change]:
        """Return arcs and their changes, by the implicit function theorem.

        The imbalance vanishes at rest, so the arcs change by minus the inverse Hessian times its
        change at fixed arcs.
        """
        q = rows.double()
        arcs, compliance = self._shapes(q)

        def imbalance(chain: ForceTendonChain) -> Tensor:
            return _Shape(chain._statics().at(q), arcs, chain.forces(q)).imbalance

        forcing = self._slope_of(imbalance, tangents)  # (3 A, N, P)
        by_geometry = -compliance @ forcing.permute(1, 0, 2)

        def change(by_arcs: Tensor) -> Tensor:
            return by_arcs @ by_geometry.to(by_arcs)

        return arcs.to(rows), change

    def _at_rest(self, q: Tensor) -> Tensor:
        """Return the arcs (3 A, N) at rest, float64.

        The shape is found without derivative. Two steps with its constant compliance follow: by
        the implicit function theorem the first one gives the first derivative, the second one the
        second.
        """
        arcs, compliance = self._shapes(q)
        statics = self._statics().at(q)
        forces = self.forces(q)
        for _ in range(2):
            imbalance = _Shape(statics, arcs, forces).imbalance.mT
            arcs = arcs - applied(compliance, imbalance).mT
        return arcs

    def _shapes(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the arcs (3 A, N) at rest and the compliance (N, 3 A, 3 A), no derivatives."""
        entries = [self.geometry()[name].detach() for name in self._entries]
        packed = WithoutDerivative.apply(self._search, q.detach(), *entries)
        n = 3 * self.n_segments * self.arcs_per_segment
        arcs, compliance = packed.split([n, n * n], dim=1)
        return arcs.mT, compliance.unflatten(1, (n, n))

    def _search(self, q: Tensor, *entries: Tensor) -> Tensor:
        """Return arcs (N, 3 A) at rest and the flat compliance, for entries of the geometry."""
        geometry = dict(zip(self._entries, entries, strict=True))
        chain = self.with_geometry(**geometry)
        statics = chain._statics().at(q)
        start = statics.rest[:, None].expand(-1, len(q))
        last = self._last
        if last is not None and torch.equal(last.q, q):
            start = last.arcs
        arcs, compliance = statics.shape_of_least_energy(chain.forces(q), start)
        if last is not None:
            last.q = q
            last.arcs = arcs
        return torch.cat([arcs.mT, compliance.flatten(1)], dim=1)

    @classmethod
    def _arguments(cls, stored: Stored) -> dict[str, Any]:
        arguments = super()._arguments(stored)
        del arguments["marker_offsets"]
        arguments["arcs"] = stored.value("arcs_per_segment", int)
        arguments["gravity"] = stored.list_of(float, "gravity")
        return arguments

    @classmethod
    def from_stored(cls, stored: Stored, restore: Restore) -> ForceTendonChain:
        """Return the chain built from a description."""
        chain = super().from_stored(stored, restore)
        offsets = torch.from_numpy(stored.array("marker_offsets")).to(chain.base)
        return chain.with_geometry(marker_offsets=offsets)
