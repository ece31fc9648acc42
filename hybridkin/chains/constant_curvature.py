"""Constant-curvature kinematics of a chain of segments, as a torch module q -> x."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hybridkin._core.arrays import Numbers, Transform, as_array, identity
from hybridkin._core.blocks import in_blocks
from hybridkin._core.constants import constant
from hybridkin._core.derived import derived
from hybridkin._core.model import ForwardModel
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.plausible import PlausibleRows
from hybridkin._core.stored import Layout, Restore, Stored
from hybridkin.chains._arcs import turned_by_first
from hybridkin.chains._checks import filled, float_dtype
from hybridkin.chains._paths import bend_counts, bend_extremes, free_arcs
from hybridkin.chains.arc_chain import (
    STRUCTURE,
    Change,
    each_marker,
    frame_numbers,
)
from hybridkin.chains.calibratable import Scale
from hybridkin.chains.chain import Chain
from hybridkin.chains.elastic_tendons import ElasticTendonChain
from hybridkin.chains.length_driven import PLANAR, LengthDrivenChain

__all__ = ["ConstantCurvatureChain"]

_SOFTER = (0.03, 0.3)  # stiffness of a bend over that of the tendons that bend it

_EXTENSIBLE = (
    ("radii", "base"),
    ("radii", "rest_bends", "base"),
    ("radii", "turns", "offsets", "rest_bends", "base"),
    ("radii", "angles", "rest_bends", "offsets", "actuator_zeros", "base"),
)
_TENDONS = (
    ("radii", "base"),
    ("radii", "turns", "rest_bends", "base"),
    ("radii", "turns", "rest_bends", "lengths", "tool", "base"),
)
_SHAPING = (
    "radii",
    "angles",
    "lengths",
    "rest_bends",
    "actuator_zeros",
    "gains",
)
_NEARLY = 0.5  # relative reading across the plane of planar actuators, after a calibration
_CONTRADICTED = 0.3  # share of the readings that the arcs explain, in one segment
_NOTICED = 0.1  # share of the radius: the reading of a bend of 0.1 rad


def _write_plan(plan: Plan, stored: Stored) -> int:
    """Write the node of a chain: its frame, and the linear map from q to its arcs."""
    tips = each_marker(stored)
    if len(tips) > 1:
        return plan.stack(tips)
    if stored.value("stage", (str, None)) is not None:
        raise NoKernel("a chain on a rotation stage has no kernel")
    radii = stored.array("radii")
    reach = 10.0 * radii.mean()
    if "lengths" in stored.arrays:
        reach = stored.array("lengths").sum()
    frame, parts = frame_numbers(plan, stored, reach)
    n_segments = len(radii)
    n_arcs = len(parts)

    def by_segment(name: str) -> NDArray:
        """Return rows (n_arcs, 3, ...) of length, x- and y-bending up to the tip."""
        rows = stored.derived[name].reshape(3, n_segments, -1).swapaxes(0, 1)
        return rows[:n_arcs] * parts[:, None, None]

    matrix = by_segment("arc_matrix")
    offset = by_segment("arc_offset")
    n = matrix.shape[2]
    width = n
    step = 0  # columns from the actuators of a segment to those of the next one
    if n % n_segments == 0:
        # Only the columns of a segment's own actuators, if all others are zero.
        per_segment = n // n_segments
        columns = np.arange(n_arcs)[:, None] * per_segment + np.arange(per_segment)
        diagonal = np.take_along_axis(matrix, columns[:, None], axis=2)
        if np.count_nonzero(diagonal) == np.count_nonzero(matrix):
            matrix = diagonal
            step = per_segment
            width = per_segment
    return plan.node("arcs", n, 3, [frame, offset, matrix], n_arcs, step, width)


class ConstantCurvatureChain(LengthDrivenChain):
    """Tip position of a chain of constant-curvature segments, from its actuator lengths.

    An arc has a centre-line length l and a bending vector b (norm: bend angle, direction: that of
    the bend). Parallel actuators at angle psi_i on a circle of radius r then have the lengths
    ``l_i = l - r (b_x cos psi_i + b_y sin psi_i)``. The least-squares inverse of this relation is
    one constant matrix per robot, q -> (l, b). A smooth chain of arcs follows. Nothing is divided
    by a bend angle, so value and derivatives are exact at the straight robot.

    Parameters
    ----------
    radii : array-like of shape (S,)
        Radius of the actuator circle of each segment, base to tip [m].
    n_actuators : int or sequence of S ints, default=3
        Actuators of each segment. Actuators in one plane, e.g. an antagonistic pair, bend a
        segment in that plane only; in the other plane it keeps its rest bend. An extensible
        segment with a single actuator does not bend: it is a rigid insertion stage.
    angles : array-like, optional
        Actuator angles about the backbone, counter-clockwise from the base x-axis [rad]: shape
        ``(n,)`` for all segments alike, ``(S, n)``, or one sequence per segment. Default: evenly
        spaced from 0.
    lengths : array-like of shape (S,), optional
        None for extensible segments: q holds absolute actuator lengths [m] (pneumatic trunk).
        Otherwise backbone lengths [m] of inextensible segments: q holds the *changes* of tendon
        length from straight [m], negative if a tendon is shortened. A list with None for some
        segments mixes both.
    routing : {"segment", "base"}, default="segment"
        "segment": each actuator spans its own segment. "base": actuators of a segment also run
        through all segments nearer the base, at their own radius and angle, from the last stage
        before them, which carries them.
    offsets : float or array-like of shape (S,), default=0.0
        Rigid length after each segment along its tangent [m]; the last one is the tool.
    rest_bends : float or array-like of shape (S, 2), default=0.0
        Pre-curvature: bending vector of each segment with equally long actuators [rad].
    actuator_zeros : float or array-like of shape (n,), default=0.0
        Offset of each sensor [unit of q]: the chain bends by ``gains * (q - actuator_zeros)``. A
        list of lists, one per segment, is accepted too.
    gains : float or array-like of shape (S,) or (n,), default=1.0
        Metres per unit of q, for all actuators, each segment or each actuator; negative if q has
        the opposite sign. q, Jacobians and limits are then in that unit, for example motor
        counts. A list of lists, one per segment, is accepted too.
    stage : {None, "rotation"}, default=None
        "rotation": the first segment is a rigid stage with one actuator, an angle [rad] that
        turns all later segments about the z-axis of the base. Its length must be None; its radius
        has no effect.
    base : array-like of shape (4, 4) or pytorch_kinematics Transform3d, optional
        Pose of the robot's base in the measuring frame. Default: identity.
    dtype : torch.dtype, default=torch.float64
        Precision of the stored geometry. Results have the dtype of q.

    References
    ----------
    Reinhart & Steil (2016), section 2.1; Webster & Jones, Int. J. Robotics Research 29 (2010).

    Examples
    --------
    >>> import torch
    >>> from hybridkin import ConstantCurvatureChain
    >>> chain = ConstantCurvatureChain([0.10, 0.093, 0.079])
    >>> chain(torch.full((9,), 0.25, dtype=torch.float64)).abs().round(decimals=9)
    tensor([0.0000, 0.0000, 0.7500], dtype=torch.float64)
    """

    _entries = (
        "radii",
        "angles",
        "lengths",
        "offsets",
        "rest_bends",
        "actuator_zeros",
        "gains",
        "base",
    )
    layout = Layout(
        "constant_curvature",
        dict.fromkeys(_entries, ""),
        {**STRUCTURE, "extensible": list, "bends": list, "stage": str},
        derived=("arc_matrix", "arc_offset"),
        write_plan=_write_plan,
    )
    computed = layout.derived
    _zeros = "actuator_zeros"
    _structure = (*LengthDrivenChain._structure, "bends", "stage")

    bends: tuple[int, ...]  # number of directions in which each segment bends

    def __init__(
        self,
        radii: Numbers,
        *,
        n_actuators: int | Sequence[int] = 3,
        angles: Numbers | None = None,
        lengths: Numbers | Sequence[float | None] | None = None,
        routing: str = "segment",
        offsets: Numbers = 0.0,
        rest_bends: Numbers = 0.0,
        actuator_zeros: Numbers = 0.0,
        gains: Numbers = 1.0,
        stage: str | None = None,
        base: Numbers | Transform | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        dtype = float_dtype(dtype)
        geometry = self._checked(
            routing,
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
        zeros = filled(actuator_zeros, "actuator_zeros", dtype, (self.n_actuators,))
        by_segment = geometry["angles"].split(self.actuators_per_segment)
        self.bends = bend_counts(by_segment, self.extensible)
        self.stage = stage
        is_rotation = isinstance(stage, str) and stage == "rotation"
        if stage is not None and not (is_rotation and self.bends[0] == 0):
            raise ValueError(
                '`stage` must be None or "rotation"; "rotation" needs a first segment with one '
                f"actuator and without a length, got {stage!r}."
            )
        self._set_geometry({"lengths": None, **geometry, "actuator_zeros": zeros})

    @property
    def default_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that a calibration fits by default."""
        if self.lengths is None:
            return ("radii", *self._free_gain, "base")
        return ("radii", "turns", "rest_bends", "lengths", *self._free_gain, "base")

    @property
    def parameter_sets(self) -> list[tuple[str, ...]]:
        """Sets of parameters that ``calibrate="auto"`` compares, the smaller ones first."""
        return self._with_gain(_EXTENSIBLE if self.lengths is None else _TENDONS)

    @property
    def rest(self) -> Tensor:
        """The q (n,) at which tendons are not displaced and chambers have length 0."""
        return self.actuator_zeros

    def softer(self) -> list[ForwardModel]:
        """Return the same robot with tendons that stretch and go slack, for some stiffnesses.

        Tendons in balance bend both alike; a single tendon does not. Empty for chambers.
        """
        if self.lengths is None or self.n_stages or any(self.extensible):
            return []
        angles = self.angles.detach().split(self.actuators_per_segment)
        zeros = (self.gains * self.rest).detach()
        chains: list[ForwardModel] = []
        for stiffness in _SOFTER:
            chain = ElasticTendonChain(
                self.radii.detach(),
                self.lengths.detach(),
                n_actuators=self.actuators_per_segment,
                angles=[*angles],
                routing=self.routing,
                bending_stiffness=stiffness * self.radii.detach().square(),
                tendon_zeros=zeros,
                gains=self.gains.detach(),
                rest_bends=self.rest_bends.detach(),
                offsets=self.offsets.detach(),
                base=self.base.detach(),
            )
            chains.append(chain._marked(self.markers))
        return chains

    def with_elastic_tendons(self) -> Chain:
        """Return the robot with tendons that give way; a chain with chambers stays as it is."""
        return self if any(self.extensible) else ElasticTendonChain.from_chain(self)

    def rivals(self, q: Tensor) -> list[Chain]:
        """Return the robot with elastic tendons, if those of q (N, n) contradict each other."""
        if any(self.extensible) or not self.contradictory(q).any():
            return []
        return [self.with_elastic_tendons()]

    def effective_directions(self) -> NDArray:
        """Return the projector (n, n) on directions of q that bend a chain with tendons.

        Its bendings are linear in q and do not depend on the common pull of its tendons, which is
        one in metres. With chambers all directions move the chain.
        """
        if any(self.extensible):
            return super().effective_directions()
        zero = torch.from_numpy(np.zeros(self.n_actuators))
        slopes = torch.func.jacrev(lambda row: self.arcs(row)[1].ravel())(zero)
        gains = as_array(self.gains.detach())
        slopes = as_array(slopes) / gains
        of_metres = np.linalg.pinv(slopes, rcond=PLANAR) @ slopes
        return gains[:, None] * of_metres / gains

    def unit_of(self, name: str) -> str:
        """Return the unit of an entry of the geometry: "m", "rad", "-" or another one."""
        if name == "actuator_zeros" and self.in_metres:
            return "m"
        return super().unit_of(name)

    def scale_of(self, entry: str) -> Scale:
        """Return the natural scale of the numbers of an entry: of zeros it is a mean radius."""
        if entry != "actuator_zeros":
            return super().scale_of(entry)
        unit = float(self.radii.detach().mean() / self.gains.detach().abs().mean())
        return Scale(unit, "m" if self.in_metres else "q")

    def consistency(self, q: Tensor) -> Tensor:
        """Return by how much the actuator lengths of each segment contradict each other.

        The lengths are compared with those of the fitted arc. Three chambers always agree. With
        more actuators, a broken cable or sensor gives a residual; on tendon chains so does a
        common pull of all tendons of a segment, which causes no bend in this model.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].

        Returns
        -------
        Tensor of shape (..., S)
            Root mean square residual of the actuators of each segment [m].

        Examples
        --------
        >>> import torch
        >>> from hybridkin import ConstantCurvatureChain
        >>> chain = ConstantCurvatureChain([0.01, 0.01], lengths=[0.1, 0.1])
        >>> q = torch.tensor([-0.002, 0.001, 0.001, -0.003, -0.003, -0.003]).double()
        >>> chain.consistency(q).round(decimals=6)
        tensor([0.0000, 0.0030], dtype=torch.float64)
        """
        metres = self.metres(q)
        explained = metres @ self._explained_by_arcs().to(q).mT
        return self._by_segment(metres - explained)

    def contradictory(self, q: Tensor) -> Tensor:
        """Return whether the actuator lengths of each segment contradict each other.

        They do if the `consistency` residual exceeds both 30 % of the part that the arcs explain
        and a tenth of the segment's radius (the length change at a bend of 0.1 rad). On tendon
        chains slack is the usual cause: one tendon pulled while the others stay leaves a residual
        of 71 % of the explained part; balanced tendons leave none. In extensible segments a common
        change is a change of length.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].

        Returns
        -------
        Tensor of shape (..., S)
            Bool.

        Examples
        --------
        >>> import torch
        >>> from hybridkin import ConstantCurvatureChain
        >>> chain = ConstantCurvatureChain([0.01], lengths=[0.1])
        >>> chain.contradictory(torch.tensor([[-0.004, 0.002, 0.002], [-0.004, 0.0, 0.0]]))
        tensor([[False],
                [ True]])
        """
        readings = self._by_segment(self.metres(q))
        residual = self.consistency(q)
        explained = (readings.square() - residual.square()).clamp(min=0.0).sqrt()
        least = torch.maximum(_NOTICED * self.radii.to(q), _CONTRADICTED * explained)
        return residual > least

    def contradictions(self, q: Tensor, name: str = "q") -> list[str]:
        """Return a warning if the tendons of inextensible segments contradict each other.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Tendon length changes [m].
        name : str, default="q"
            Name of `q` in the message.

        Returns
        -------
        list of str
            The number of rows that are `contradictory`, and the worst of them. Empty if there are
            none; extensible segments are not checked.
        """
        rows = self._rows(q)
        if all(self.extensible):
            return []
        fixed_length = ~torch.tensor(self.extensible, device=q.device)
        with torch.no_grad():
            (wrong,) = in_blocks(lambda q: (self.contradictory(q) & fixed_length,), rows)
            if not wrong.any():
                return []
            residual = self.consistency(rows) * wrong
        row, segment = divmod(int(residual.argmax()), self.n_segments)
        n_wrong = int(wrong.any(-1).sum())
        return [
            f"{n_wrong} of {len(rows)} rows of `{name}` pull the tendons of a segment together or "
            "release them, which bends nothing in a ConstantCurvatureChain but compresses a robot "
            f"or leaves tendons slack: the worst is row {row}, segment {segment + 1}, "
            f"{1e3 * float(residual.max()):.3g} mm rms. ElasticTendonChain models tendons that can "
            "only pull."
        ]

    def plausible_rows(self) -> PlausibleRows:
        """Return bounds of rows that need no warning about units or contradictions.

        Tendons do not contradict each other if no residual of `consistency` is noticed.
        """
        rows = super().plausible_rows()
        if all(self.extensible):
            return rows
        counts = self.actuators_per_segment
        fixed_length = ~np.repeat(self.extensible, counts)
        noticed = as_array(_NOTICED * self.radii).repeat(counts)
        explained = as_array(self._explained_by_arcs())
        residuals = (np.eye(len(explained)) - explained) * as_array(self.gains)
        of_tendons = (residuals / noticed[:, None])[fixed_length]
        return replace(rows, weights=np.concatenate([rows.weights, of_tendons]))

    def _explained_by_arcs(self) -> Tensor:
        """Return the matrix (n, n) from readings to those of the fitted arcs [-]."""
        return self._readings() @ (self.arc_matrix / self.gains)

    @property
    def limits(self) -> dict[str, Any]:
        """Limits of q: none for tendons, lengths above 0 m in extensible segments."""
        if not self.absolute.any():
            return super().limits
        above = self.absolute & (self.gains > 0)
        below = self.absolute & (self.gains < 0)
        low = torch.where(above, self.actuator_zeros, -torch.inf)
        high = torch.where(below, self.actuator_zeros, torch.inf)
        return super().limits | {"q_min": low, "q_max": high}

    def longest(self, largest: Tensor) -> Tensor:
        """Return the sum of the largest lengths of arcs and of the rigid parts."""
        matrix, offset = self._arc_map()
        arcs = (matrix.abs() * largest).sum(1) + offset.abs()
        return arcs[: self.n_segments].sum() + self.rigid_length

    def _check_rows(self, rows: Tensor, name: str) -> None:
        lengths = torch.where(self.absolute.to(rows.device), self.metres(rows), 1.0)
        if (lengths <= 0).any():
            row = int((lengths <= 0).any(dim=1).nonzero()[0])
            raise ValueError(
                f"`{name}` must hold positive actuator lengths [m], got {lengths[row].min():.6g} "
                f"in row {row}; for tendon length changes build the chain with `lengths=`."
            )

    def extra_repr(self) -> str:
        """Return the summary shown by repr()."""
        kinds = ["extensible" if stretches else "inextensible" for stretches in self.extensible]
        if self.n_stages:
            kinds[0] = f"{self.stage} stage"
        return f"{' and '.join(dict.fromkeys(kinds))}, {super().extra_repr()}"

    def tips_once(self, q: Tensor) -> NDArray:
        """Return the tips (N, m) at rows q (N, n) of a chain that is evaluated there once.

        No plan is made of it.
        """
        program = self._program_of_arcs()
        if program is None:
            return super().tips_once(q)
        with torch.no_grad():
            (arcs,) = self.by_rows(lambda rows: (self._arcs_of_rows(rows).mT,), q)
        (points,) = program.evaluate(self._arcs_and_offsets(arcs))
        turn, move = np.split(as_array(self.base[:3]), [3], axis=1)
        x = points.reshape(-1, 3) @ turn.T + move[:, 0]
        return x.reshape(points.shape)

    @derived(*_SHAPING)
    def _arc_map(self) -> tuple[Tensor, Tensor]:
        """Return the matrix (3 S, n) and the offset (3 S,) of the map from q to the arcs."""
        free = self._free_arcs()
        # Arcs in units with similar readings, bendings times radius: metres beside radians would
        # lose half of the digits.
        units = torch.cat([torch.ones_like(self.radii), *[1.0 / self.radii] * 2])
        readings = self._readings() * units @ free
        # Least squares by the normal equations, with ones for the arcs that are not free.
        fixed = identity(len(free), free) - free
        inverse = torch.linalg.solve(readings.mT @ readings + fixed, readings.mT)
        # One step of refinement: the normal equations lose some digits.
        inverse = inverse + (free - inverse @ readings) @ inverse
        matrix = inverse * units[:, None] * self.gains
        lengths = self.radii[:0] if self.lengths is None else self.lengths
        rest = torch.cat([self._placed(lengths), *self.rest_bends.T])
        return matrix, rest - matrix @ self.actuator_zeros

    @property
    def arc_matrix(self) -> Tensor:
        """The matrix (3 S, n) of the map from q to the arcs, before a stage turns them."""
        return self._arc_map()[0]

    @property
    def arc_offset(self) -> Tensor:
        """The offset (3 S,) of the map from q to the arcs."""
        return self._arc_map()[1]

    def _free_arcs(self) -> Tensor:
        by_segment = self.angles.split(self.actuators_per_segment)
        return free_arcs(by_segment, self.extensible, self.bends)

    def _placed(self, lengths: Tensor) -> Tensor:
        """Return lengths (..., S), 0 if extensible, from those of the other segments."""
        fixed = tuple(k for k, stretches in enumerate(self.extensible) if not stretches)
        place = identity(self.n_segments, lengths)
        return lengths @ place.index_select(0, constant(fixed, lengths, torch.long))

    def _by_segment(self, q: Tensor) -> Tensor:
        """Return the RMS (..., S) of q (..., n) over the actuators of each segment."""
        parts = q.split(self.actuators_per_segment, dim=-1)
        rms = [torch.linalg.vector_norm(part, dim=-1) / part.shape[-1] ** 0.5 for part in parts]
        return torch.stack(rms, dim=-1)

    def _arcs_and_slope(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        matrix, offset = self._arc_map()
        matrix = matrix.to(rows)
        arcs = torch.addmm(offset.to(rows)[:, None], matrix, rows.T)
        if not self.n_stages:
            return arcs, matrix
        return turned_by_first(arcs, matrix[..., None])

    def _arcs_and_change(
        self, rows: Tensor, tangents: Mapping[str, Tensor]
    ) -> tuple[Tensor, Change]:
        matrix, offset = self._arc_map()
        arcs = torch.addmm(offset.to(rows)[:, None], matrix.to(rows), rows.T)
        by_matrix, by_rest = self._changes_of_map(matrix, tangents)
        slope = torch.addmm(by_rest.flatten(), rows, by_matrix.flatten(0, 1).mT)
        slope = slope.unflatten(1, by_rest.shape).permute(2, 1, 0)  # (3 S, P, N)
        if self.n_stages:
            arcs, slope = turned_by_first(arcs, slope)
        return arcs, lambda by_arcs: by_arcs @ slope.permute(2, 0, 1)

    def _changes_of_map(
        self, matrix: Tensor, tangents: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return the changes (P, 3 S, n) and (P, 3 S) of `arc_matrix` and `arc_offset`.

        For M, the pseudo-inverse of the readings B of the free arcs F, the change is that of Golub
        & Pereyra, SIAM J. Numer. Anal. 10 (1973), eq. 4.12.
        """
        changes = self._all_changes(tangents)
        like = changes["radii"]
        gains = self.gains.to(like)
        matrix = matrix.to(like)
        M = matrix / gains
        F = self._free_arcs().to(like)
        B = self._readings().to(like)
        dB = nn.functional.pad(self._changes_of_bends(changes), (self.n_segments, 0)) @ F
        dM = torch.zeros_like(dB).mT
        if 1 in self.bends:  # planes turn with their actuators
            dF = self._slope_of(ConstantCurvatureChain._free_arcs, tangents)
            dF = dF.to(like).permute(2, 0, 1)
            dB = dB + B @ dF
            dM = (identity(len(F), F) - F) @ dF @ B.mT @ M.mT @ M
        unexplained = identity(len(B), B) - B @ M
        dM = dM + M @ M.mT @ dB.mT @ unexplained - M @ dB @ M
        d_matrix = dM * gains + M * changes["gains"][:, None]
        d_lengths = self._placed(changes.get("lengths", like[:, :0]))
        d_rest = torch.cat([d_lengths, *changes["rest_bends"].unbind(-1)], dim=1)
        d_zeros = changes["actuator_zeros"] @ matrix.mT
        return d_matrix, d_rest - d_zeros - d_matrix @ self.actuator_zeros.to(like)

    @classmethod
    def _arguments(cls, stored: Stored) -> dict[str, Any]:
        arguments = super()._arguments(stored)
        given_lengths = iter(arguments.pop("lengths", ()))
        lengths = []
        for stretches in stored.list_of(bool, "extensible"):
            lengths.append(None if stretches else next(given_lengths, math.nan))
        angles = arguments["angles"]
        for k, n_bends in enumerate(stored.list_of(int, "bends")):
            # Planar actuators stay planar, although calibration has moved their angles slightly.
            if n_bends == 1:
                angles[k] = math.pi * (np.arange(len(angles[k])) % 2)
        stage = stored.value("stage", (str, None))
        return {**arguments, "lengths": lengths, "angles": angles, "stage": stage}

    @classmethod
    def from_stored(cls, stored: Stored, restore: Restore) -> ConstantCurvatureChain:
        """Return the chain built from a description."""
        chain = super().from_stored(stored, restore)
        bends = stored.list_of(int, "bends")
        if [*chain.bends] != bends or not chain._are_nearly_planar():
            raise ValueError(f"`bends` must be those of the angles, got {bends!r:.80}")
        return chain

    def _are_nearly_planar(self) -> bool:
        """Return whether the angles of planar segments are near a plane."""
        by_segment = self.angles.split(self.actuators_per_segment)
        for angles, stretches, n_bends in zip(by_segment, self.extensible, self.bends, strict=True):
            if n_bends == 1:
                most, least = bend_extremes(angles, stretches)
                if not least < _NEARLY * most:
                    return False
        return True
