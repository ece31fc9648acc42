"""A heavy, tapered elastic body pulled by tendons of given forces, as a torch module q -> x."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.arrays import Numbers, Transform, whole
from hybridkin._core.blocks import in_blocks
from hybridkin._core.constants import constant
from hybridkin._core.frames import Marker
from hybridkin._core.model import is_at_rest
from hybridkin._core.named_rows import first_row
from hybridkin._core.stored import Layout, Restore, Stored
from hybridkin.chains._checks import filled, float_dtype, numeric, stiffnesses
from hybridkin.chains._elastic_body import COMPRESSED, ElasticBody, why_not
from hybridkin.chains._equilibrium import (
    Found,
    Outcome,
    Shape,
    Statics,
    shapes_of_least_energy,
)
from hybridkin.chains._slack import WithoutDerivative, applied
from hybridkin.chains.arc_chain import STRUCTURE, ArcChain, Change
from hybridkin.chains.calibratable import Scale
from hybridkin.chains.chain import Chain
from hybridkin.chains.markers import MarkedChain

__all__ = ["ForceTendonChain"]

_MOST_ARCS = 50  # of a segment
_LARGEST_TAPER = 0.95  # of a calibration
_NO_FORCE = 1e-300  # [N]
_WHY = {
    Outcome.BUCKLED: "buckled: in {rows} no load decides to which side the body falls",
    Outcome.COMPRESSED: COMPRESSED,
    Outcome.NOT_FOUND: "not at rest: in {rows} the search found no shape of least energy",
}


@dataclass
class _LastShapes:
    """The arcs (3 A, N) that the last search found for rows q (N, n)."""

    q: Tensor
    arcs: Tensor


class ForceTendonChain(ElasticBody):
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
    A search on the energy of every row starts at the rest shape and only goes downhill; derivatives
    follow from the implicit function theorem. Heavy bodies can have several stable shapes; the one
    returned is reached from the rest shape. The force of a tendon is the same along its path: no
    friction.

    A returned shape is at rest, to 1e-10 of the tendon forces and the weight with their moments,
    and stable. A row without such a shape is NaN, with a warning that names it, and outside of the
    domain (`in_domain`); in a log it is an error. There are two reasons.

    "buckled": the body falls, and no load decides to which side. A straight, uniform body that
    stands on its base falls where its weight times length squared is more than 7.84 times its
    bending stiffness. A tendon, a rest bend or a tilt decides the side if its moment is more than
    some millionths of weight times length. Then the shape is the fallen one on that side. It
    depends continuously on q, except between sides, and `J` is large near them. A real body may
    stay on the other side.

    "compressed": an arc is shorter than a tenth of its rest length.

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
            raise ValueError(f"`weight` must not be negative [N/m], got {weights.tolist()}.")
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
    def unit_of_q(self) -> str:
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

    def scale_of(self, entry: str) -> Scale:
        """Return the natural scale of the numbers of an entry of the geometry."""
        if entry == "taper":
            return Scale(1.0, "-", 0.0, _LARGEST_TAPER)
        return super().scale_of(entry)

    def pulled(self, q: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """Return the forces of the tendons at q (..., n), relative to the largest."""
        forces = self.forces(q)
        return forces / forces.amax(-1, keepdim=True).clamp(min=_NO_FORCE)

    def slack(self, q: Tensor) -> Tensor:
        """Return which tendons are slack, a bool tensor of the shape of q."""
        return self.forces(q) == 0.0

    def _set_markers(self, markers: Sequence[Marker]) -> None:
        super()._set_markers(markers)
        offsets = [offset for _, *offset in self.markers]
        like = getattr(self, "base", None)
        if like is not None:  # None while the chain is built
            self._set_geometry({"marker_offsets": like.new_tensor(offsets)})

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

        def outcome_of(rows: Tensor) -> tuple[Tensor]:
            return (self._found(rows.double()).outcome[:, None],)

        with torch.no_grad():
            (outcome,) = in_blocks(outcome_of, rows)
        messages = self._missing(rows, outcome[:, 0])
        if messages:
            raise ValueError(
                f"`{name}` must hold forces at which the body has a shape, got {messages[0]} Leave "
                "these rows out, or make the body stiffer or lighter."
            )

    def _lost_radii(self, taper: Tensor) -> Tensor:
        """Return the relative loss of outer radii (..., S, k) up to the middle of each arc."""
        k = self.arcs_per_segment
        middles = torch.arange(k, dtype=torch.float64, device=taper.device) + 0.5
        return taper.double()[..., None] * middles / k

    def moved(self, motion: Tensor) -> Self:
        """Return the chain after a motion (4, 4) of its base, with which gravity turns.

        It is the same robot in another measuring frame, as for every model.
        """
        moved = super().moved(motion)
        if not is_at_rest(motion):
            down = torch.tensor(self.gravity, dtype=torch.float64, device="cpu")
            moved.gravity = tuple((motion[:3, :3].to(down) @ down).tolist())
        return moved

    def _statics(self) -> Statics:
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
        down = constant(tuple(self.gravity), base)
        return Statics(
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
        shape = Shape(statics, arcs, self.forces(q))
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
        arcs, compliance, is_known = self._shapes(q)

        def imbalance(chain: ForceTendonChain) -> Tensor:
            return Shape(chain._statics().at(q), arcs, chain.forces(q)).imbalance

        forcing = self._slope_of(imbalance, tangents)  # (3 A, N, P)
        by_geometry = -compliance @ forcing.permute(1, 0, 2)

        def change(by_arcs: Tensor) -> Tensor:
            return by_arcs @ by_geometry.to(by_arcs)

        return torch.where(is_known, arcs, torch.nan).to(rows), change

    def _at_rest(self, q: Tensor) -> Tensor:
        """Return the arcs (3 A, N) at rest, float64; NaN where there are none.

        The shape is found without derivative. Two steps with its constant compliance follow: by
        the implicit function theorem the first one gives the first derivative, the second one the
        second. Their values count only where they make the imbalance smaller.
        """
        arcs, compliance, is_known = self._shapes(q)
        statics = self._statics().at(q)
        forces = self.forces(torch.where(is_known[:, None], q, 0.0))
        first = Shape(statics, arcs, forces).imbalance.mT
        stepped = arcs - applied(compliance, first).mT
        second = Shape(statics, stepped, forces).imbalance.mT
        arcs = stepped - applied(compliance, second).mT

        unit = statics.unit
        is_better = (unit * second).norm(dim=1) < (unit * first).norm(dim=1)
        value = torch.where(is_better, stepped, arcs).detach()
        arcs = value + (arcs - arcs.detach())
        return torch.where(is_known, arcs, torch.nan)

    def _shapes(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return arcs (3 A, N), the compliance (N, 3 A, 3 A) and whether they are at rest (N,).

        They have no derivatives. Where they are not at rest they are rest shapes and zeros.
        """
        entries = [self.geometry()[name].detach() for name in self._entries]
        packed = WithoutDerivative.apply(self._search, q.detach(), *entries)
        n = 3 * self.n_segments * self.arcs_per_segment
        arcs, compliance, is_known = packed.split([n, n * n, 1], dim=1)
        return arcs.mT, compliance.unflatten(1, (n, n)), is_known[:, 0] > 0.0

    def _search(self, q: Tensor, *entries: Tensor) -> Tensor:
        """Return what `_shapes` returns side by side (N, ...), for entries of the geometry."""
        geometry = dict(zip(self._entries, entries, strict=True))
        chain = self.with_geometry(**geometry)
        shapes = chain._found(q)
        first = first_row()
        last = self._last
        if last is not None:
            last.q = q
            last.arcs = shapes.arcs
        elif first is not None:
            for message in chain._missing(q, shapes.outcome, first):
                warnings.warn(f"{message} Results are NaN there.", stacklevel=2)
        is_known = shapes.outcome == Outcome.AT_REST
        parts = [shapes.arcs.mT, shapes.compliance.flatten(1), is_known[:, None].to(q)]
        return torch.cat(parts, dim=1)

    def _found(self, q: Tensor) -> Found:
        """Return the results of searches for rows q (N, n), float64."""
        statics = self._statics().at(q)
        start = statics.rest[:, None].expand(-1, len(q))
        last = self._last
        if last is not None and torch.equal(last.q, q):
            start = last.arcs
        return shapes_of_least_energy(statics, self.forces(q), start)

    def _missing(self, q: Tensor, outcome: Tensor, first: int = 0) -> list[str]:
        """Return why rows q (N, n), numbered from `first` on, have no shape: one text a reason."""
        messages = []
        for reason, words in _WHY.items():
            why = why_not(words, q, outcome == reason, first)
            if why is not None:
                messages.append(f"{why} {self._body()}")
        return messages

    def _body(self) -> str:
        """Return a sentence about the weight and stiffness of the body, for messages."""
        statics = self._statics()
        along = float(statics.down[2])
        pose = "stands on its base" if along < 0.0 else "hangs from its base"
        length = float(self.lengths.sum())
        ratio = float(statics.weights.sum()) * length**2 / float(self.bending_stiffness[0])
        axial = float(self.axial_stiffness.min())
        return (
            f"The body {pose} (gravity along its axis: {along:.3g}) with sum(W) L^2 / EI = "
            f"{ratio:.3g} and EA of at least {axial:.3g} N."
        )

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
