"""An elastic backbone with tendons that can only pull, as a torch module q -> x."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from hybridkin._core.arrays import Numbers, Transform, as_array
from hybridkin._core.blocks import in_blocks
from hybridkin._core.derived import derived
from hybridkin._core.kernel_numbers import HK_LEAST_LENGTH
from hybridkin._core.named_rows import first_row, without_warnings
from hybridkin._core.plan import Plan
from hybridkin._core.plausible import PlausibleRows
from hybridkin._core.stored import Layout, Stored
from hybridkin.chains import _slack
from hybridkin.chains._checks import filled, float_dtype, stiffnesses
from hybridkin.chains._elastic_body import COMPRESSED, ElasticBody, why_not
from hybridkin.chains.arc_chain import (
    STRUCTURE,
    ArcChain,
    Change,
    each_marker,
    frame_numbers,
)
from hybridkin.chains.calibratable import Scale
from hybridkin.chains.length_driven import LengthDrivenChain
from hybridkin.native.library import evaluate

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["ElasticTendonChain"]

_SHAPING = (
    "radii",
    "angles",
    "bending_stiffness",
    "axial_stiffness",
    "rest_bends",
    "tendon_zeros",
    "gains",
)
_NO_TENSION = 1e-300  # [m]
_SOFT = 0.1  # stiffness of tendons in the guess, relative to their own
_Found = tuple[Tensor, Tensor, _slack.Responses]
_TABLE = 12  # largest number of tendons for which all responses are stored


def _write_plan(plan: Plan, stored: Stored) -> int:
    """Write the node of a chain: its frame, then numbers of its segments and of its tendons."""
    tips = each_marker(stored)
    if len(tips) > 1:
        return plan.stack(tips)
    lengths = stored.array("lengths")
    rest_bends = stored.array("rest_bends")
    bending = stored.array("bending_stiffness")
    axial = stored.array("axial_stiffness")
    counts = stored.list_of(int, "actuators_per_segment")
    n_segments = len(lengths)
    from_base = stored.value("routing", str) == "base"
    frame, parts = frame_numbers(plan, stored, lengths.sum())
    n_arcs = len(parts)

    # Tendons from the base also act on the segment before, which is coupled to this one.
    up_to_tip = np.append(parts, np.zeros(n_segments - n_arcs))[:, None]
    coupled = from_base * (np.arange(n_segments) > 0)[:, None]
    stiffness = np.column_stack([axial, bending, bending])
    arcs = up_to_tip * np.column_stack([lengths, rest_bends])
    segments = [stiffness, coupled * stiffness, arcs, up_to_tip, coupled * up_to_tip]

    segment = np.repeat(np.arange(n_segments), counts)
    radii = stored.array("radii")[segment]
    angles = stored.array("angles")
    x = -radii * np.cos(angles)
    y = -radii * np.sin(angles)
    if from_base:
        rest_bends = np.cumsum(rest_bends, 0)
    bends = rest_bends[segment]  # zeros of the tendons are for bends measured from rest
    zeros = stored.array("tendon_zeros") + x * bends[:, 0] + y * bends[:, 1]
    tendons = np.column_stack([zeros, x, y, x * x, x * y, y * y, stored.array("gains")])
    # The stretch of tendons that could also push, much softer: its signs are near those of the
    # real one. A tendon acts on its own segment and, from the base, on those before.
    acts = np.equal.outer(segment, np.arange(n_segments))
    if from_base:
        acts = np.greater_equal.outer(segment, np.arange(n_segments))
    paths = np.hstack([acts, x[:, None] * acts, y[:, None] * acts])
    stiff = np.diag(stiffness.T.ravel()) / _SOFT + paths.T @ paths
    stretch = np.eye(len(x)) - paths @ np.linalg.solve(stiff, paths.T)
    guess = np.vstack([-stretch * stored.array("gains"), stretch @ zeros])

    equal_count = counts[0] if len({*counts}) == 1 else 0
    numbers = [frame, np.hstack(segments), tendons, guess]
    return plan.node("elastic", len(x), 3, numbers, n_arcs, n_segments, equal_count, *counts)


class ElasticTendonChain(ElasticBody, LengthDrivenChain):
    """Tip position of an elastic backbone with tendons that can pull but not push.

    A shape a = (length changes, bending vectors of all segments) stretches the tendons by
    ``e = B a - (gains * q - tendon_zeros)``, with the path lengths B of `ConstantCurvatureChain`.
    The force of a taut tendon is its stretch e, in units of the tendon stiffness; a slack tendon
    (e < 0) has no force. The backbone takes the shape of least energy,
    ``1/2 (a - a0)' K (a - a0) + 1/2 sum max(0, e)^2``, with the rest bends a0. It is strictly
    convex: every q has one shape, continuous in q and linear while the same tendons are taut.

    If all tendons are taut and the bending stiffness goes to zero, the bends become those of
    `ConstantCurvatureChain`. If the tendons are unevenly spaced, this also needs a large axial
    stiffness. A common pull shortens the backbone.

    Parameters
    ----------
    radii : array-like of shape (S,)
        Radius of the tendon circle of each segment, base to tip [m].
    lengths : array-like of shape (S,)
        Backbone lengths without tendon forces [m].
    n_actuators : int or sequence of S ints, default=3
        Tendons that end at each segment.
    angles : array-like, optional
        Tendon angles about the backbone, counter-clockwise from the base x-axis [rad]: shape
        ``(n,)`` for all segments alike, ``(S, n)``, or one sequence per segment. Default: evenly
        spaced from 0.
    routing : {"base", "segment"}, default="base"
        "base": tendons of a segment also run through all segments nearer the base, at their own
        radius and angle. "segment": each tendon spans its own segment (sheathed before).
    bending_stiffness : float or array-like of shape (S,), optional
        Bending moment per bend of a segment, divided by the stiffness of a tendon [m^2/rad^2].
        Default: a hundredth of the squared radius. Three segments then bend 2 % less than the
        plain chain while all tendons are taut, 7 % if the outer side of the bend is slack.
    axial_stiffness : float or array-like of shape (S,), optional
        Axial stiffness of a segment, divided by that of a tendon [-]. Default: 10.
    tendon_zeros : float or array-like of shape (n,), default=0.0
        Pre-tension: stretch of each tendon at q = 0 on the straight backbone [m]; negative if it
        is slack. A list of lists, one per segment, is accepted too.
    gains : float or array-like of shape (S,) or (n,), default=1.0
        Metres per unit of q, as in `ConstantCurvatureChain`.
    rest_bends : float or array-like of shape (S, 2), default=0.0
        Pre-curvature: bending vector of each segment without tendons [rad].
    offsets : float or array-like of shape (S,), default=0.0
        Rigid length after each segment along its tangent [m]; the last one is the tool.
    base : array-like of shape (4, 4) or pytorch_kinematics Transform3d, optional
        Pose of the robot's base in the measuring frame. Default: identity.
    dtype : torch.dtype, default=torch.float64
        Precision of the stored geometry. Results have the dtype of q.

    Notes
    -----
    q holds the *changes* of tendon length from straight [m], negative if a tendon is shortened.

    The taut tendons are found by block principal pivoting: all tendons with the wrong sign switch
    between taut and slack at once. After eight such steps only the first one switches (Murty's
    rule), which always terminates. For up to twelve tendons the linear responses of all sets of
    taut tendons are stored at first use; for more tendons they are computed row by row.

    Where an arc would be shorter than a tenth of its rest length, results are NaN, with a warning
    that names the row, and the row is outside of the domain (`in_domain`).

    Derivatives are those of the present set of taut tendons. If a tendon is just becoming taut,
    they are the one-sided derivatives towards the taut side.

    References
    ----------
    Camarillo et al., IEEE Trans. Robotics 24 (2008), mechanics of tendon-driven continuum robots
    with slack; Murty, Opsearch 11 (1974); Judice & Pires, Computers & Op. Research 21 (1994).

    Examples
    --------
    >>> import torch
    >>> from hybridkin import ElasticTendonChain
    >>> chain = ElasticTendonChain([0.005], [0.1], axial_stiffness=100.0)
    >>> q = torch.tensor([-0.004, 0.004, 0.004], dtype=torch.float64)
    >>> chain.slack(q)
    tensor([False,  True,  True])
    >>> chain(q)
    tensor([0.0376, 0.0000, 0.0899], dtype=torch.float64)
    """

    _entries = (*_SHAPING, "lengths", "offsets", "base")
    layout = Layout(
        "elastic_tendons",
        dict.fromkeys(_entries, ""),
        STRUCTURE,
        write_plan=_write_plan,
    )

    # Of a copy that is evaluated once: the chain itself, which has a compiled program.
    _compiled: tuple[ElasticTendonChain, ...] = ()

    def __init__(
        self,
        radii: Numbers,
        lengths: Numbers,
        *,
        n_actuators: int | Sequence[int] = 3,
        angles: Numbers | None = None,
        routing: str = "base",
        bending_stiffness: Numbers | None = None,
        axial_stiffness: Numbers | None = None,
        tendon_zeros: Numbers = 0.0,
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
        if self.n_actuators > _slack.MOST:
            raise ValueError(
                f"`n_actuators` must be at most {_slack.MOST} in all, got {self.n_actuators}."
            )
        if bending_stiffness is None:
            bending_stiffness = 0.01 * geometry["radii"] ** 2
        if axial_stiffness is None:
            axial_stiffness = 10.0
        S = self.n_segments
        zeros = filled(tendon_zeros, "tendon_zeros", dtype, (self.n_actuators,))
        geometry |= stiffnesses(bending_stiffness, axial_stiffness, dtype, S)
        geometry["tendon_zeros"] = zeros
        self._set_geometry(geometry)

    @classmethod
    def from_chain(cls, chain: ArcChain, **options: Any) -> ElasticTendonChain:
        """Return an elastic chain with the geometry of a plain chain with tendons.

        Parameters
        ----------
        chain : ConstantCurvatureChain
            A chain with `lengths`. Its `actuator_zeros` times the gains, less what its rest bends
            change in the tendon paths, become `tendon_zeros`: both chains rest in the same shape.
        **options
            Further arguments, for example `bending_stiffness`.

        Returns
        -------
        ElasticTendonChain
            A chain with the same tip.

        Examples
        --------
        >>> from hybridkin import ConstantCurvatureChain, ElasticTendonChain
        >>> plain = ConstantCurvatureChain([0.005], lengths=[0.1])
        >>> ElasticTendonChain.from_chain(plain).lengths
        tensor([0.1000], dtype=torch.float64)
        """
        if any(chain.extensible):
            raise ValueError(
                "`chain` must have `lengths` in all segments: the actuators of extensible segments "
                "are not tendons."
            )
        geometry = chain.geometry()
        counts = chain.actuators_per_segment
        rest = torch.cat([torch.zeros_like(chain.radii), *chain.rest_bends.T])
        zeros = geometry.pop("actuator_zeros") * chain.gains
        geometry["tendon_zeros"] = zeros - chain._readings() @ rest
        angles = [part.tolist() for part in geometry["angles"].split(counts)]
        arguments: dict[str, Any] = {
            **geometry,
            "angles": angles,
            "n_actuators": counts,
            "routing": chain.routing,
            "dtype": chain.radii.dtype,
            **options,
        }
        return cls(**arguments)._marked(chain.markers)

    @property
    def default_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that a calibration fits by default."""
        geometry = ("radii", "turns", "rest_bends", "lengths", "tool", "base")
        tendons = ("bending_stiffness", "axial_stiffness", "tendon_zeros")
        return (*geometry, *tendons, *self._free_gain)

    @property
    def parameter_sets(self) -> list[tuple[str, ...]]:
        """Sets of parameters that ``calibrate="auto"`` compares, the smaller ones first."""
        stiffnesses = ("base", "bending_stiffness", "axial_stiffness")
        shape = ("turns", "rest_bends", "tool", *stiffnesses, "tendon_zeros")
        return self._with_gain([stiffnesses, shape, (*shape, "radii", "lengths")])

    def shifted(self, shift: Tensor) -> ElasticTendonChain:
        """Return the robot after a shift (n,) of its zeros [unit of q]."""
        if not shift.any():
            return self
        zeros = self.tendon_zeros - (self.gains * shift).to(self.tendon_zeros)
        return self.with_geometry(tendon_zeros=zeros)

    def scale_of(self, entry: str) -> Scale:
        """Return the natural scale of the numbers of an entry: of zeros it is a mean radius."""
        if entry == "tendon_zeros":
            return Scale(float(self.radii.detach().mean()), "m")
        return super().scale_of(entry)

    def free_rings(self, names: tuple[str, ...]) -> set[str]:
        """Return "angles" if these parameters free them; radii need no search."""
        return super().free_rings(names) - {"radii"}

    def pulled(self, q: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """Return the tensions of the tendons at q (..., n), relative to the largest."""
        tension = self.tensions(q)
        return tension / tension.amax(-1, keepdim=True).clamp(min=_NO_TENSION)

    @property
    def pulls(self) -> Tensor:
        """Sign of q in which a tendon pulls, shape (n,)."""
        return -self.gains.sign()

    def longest(self, largest: Tensor) -> Tensor:
        """Return the length of the robot; tendons only compress it."""
        return self.reach + self.rigid_length

    def tensions(self, q: Tensor) -> Tensor:
        """Return the stretch of every tendon, which is proportional to its force.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Tendon length changes [m].

        Returns
        -------
        Tensor of shape (..., n_actuators)
            Stretch [m], zero if slack; multiply by the tendon stiffness to get the force.

        Examples
        --------
        >>> import torch
        >>> from hybridkin import ElasticTendonChain
        >>> chain = ElasticTendonChain([0.005], [0.1], axial_stiffness=1.0, tendon_zeros=0.004)
        >>> chain.tensions(torch.zeros(3))
        tensor([0.0010, 0.0010, 0.0010])
        """
        return self._balance(self._rows(q)).pull.reshape(q.shape)

    def slack(self, q: Tensor) -> Tensor:
        """Return which tendons are slack, a bool tensor of the shape of q."""
        return ~self._balance(self._rows(q)).taut.reshape(q.shape)

    def _elasticity(self) -> _slack.Elasticity:
        bend = 1.0 / self.radii
        bending = self.bending_stiffness
        no_change = torch.zeros_like(self.radii)
        return _slack.Elasticity(
            readings=self._readings(),
            units=torch.cat([torch.ones_like(bend), bend, bend]),
            stiffness=torch.cat([self.axial_stiffness, bending, bending]),
            rest=torch.cat([no_change, *self.rest_bends.unbind(-1)]),
            zeros=self.tendon_zeros,
            gains=self.gains,
        )

    def _all_responses(self, rows: Tensor) -> _slack.Responses:
        """Return the responses of all sets of taut tendons, in the dtype of rows."""
        return self._table(rows.dtype, rows.device)

    @derived(*_SHAPING)
    def _table(self, dtype: torch.dtype, device: torch.device) -> _slack.Responses:
        codes = torch.arange(2**self.n_actuators, device=self.radii.device)
        taut = _slack.as_mask(codes, self.n_actuators)
        responses = _slack.responses_of(taut, self._elasticity().to(torch.float64))
        return _slack.Responses(*(part.to(device, dtype) for part in responses))

    def _find(self, rows: Tensor) -> _Found:
        """Return the sets of taut tendons (N,) as bits, their places in responses, and those."""
        if self._compiled:
            return self._found_once(self._compiled[0], rows)
        if self.n_actuators <= _TABLE:
            table = self._all_responses(rows)
            codes = _slack.taut_codes(rows, table.stretch)
            return codes, codes, table
        elasticity = self._elasticity().to(rows)
        codes = _slack.taut_codes(rows, *elasticity)
        taut = _slack.as_mask(codes, self.n_actuators)
        places = torch.arange(codes.shape[0], device=codes.device)
        return codes, places, _slack.responses_of(taut, elasticity)

    def _found_once(self, compiled: ElasticTendonChain, rows: Tensor) -> _Found:
        """Return `_find`, from a guess: the tendons that move the tip of the compiled chain.

        A slack one does not, so that the search confirms nearly all guesses at its first look.
        """
        _, J = evaluate(compiled, rows.numpy(), jacobian=True)
        guess = _slack.as_codes(torch.from_numpy(J).ne(0.0).any(1))
        occurring = _slack.Occurring(self._elasticity().to(rows))
        codes = occurring.find(rows, guess)
        return codes, *occurring.of(codes)

    def _once(self) -> Self:
        chain = self.with_geometry()
        chain._compiled = (self,)
        return chain

    def _balance(self, rows: Tensor) -> _slack.Balance:
        codes, places, responses = self._find(rows)
        shape, stretch, compliance = responses.at(places)
        q = _slack.extended(rows)
        taut = _slack.as_mask(codes, self.n_actuators)
        pull = _slack.applied(stretch, q).relu() * taut
        return _slack.Balance(_slack.applied(shape, q), pull, taut, compliance)

    def _arcs_and_slope(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        _, places, responses = self._find(rows)
        maps = responses.shape.index_select(0, places)
        shape = _slack.applied(maps, _slack.extended(rows))
        return self._arcs_of(shape, rows), maps[..., :-1].permute(1, 2, 0)

    def _arcs_of(self, shape: Tensor, rows: Tensor) -> Tensor:
        """Return the arcs (3 S, N) of shapes (N, 3 S), which hold changes of length.

        The length of an arc that would be too short is NaN, with a warning.
        """
        rest = self.geometry()["lengths"].to(shape)
        changes, bendings = shape.split([self.n_segments, 2 * self.n_segments], dim=1)
        lengths = rest + changes
        is_short = lengths < HK_LEAST_LENGTH * rest
        if not torch.compiler.is_compiling():  # a graph has no warnings
            _slack.WithoutDerivative.apply(self._warn, rows.detach(), is_short)
        lengths = torch.where(is_short, torch.nan, lengths)
        return torch.cat([lengths, bendings], dim=1).mT.contiguous()

    def _warn(self, rows: Tensor, is_short: Tensor) -> Tensor:
        first = first_row()
        if first is not None and is_short.any():
            is_named = is_short.any(1) & rows.isfinite().all(1)
            why = why_not(COMPRESSED, rows, is_named, first)
            if why is not None:
                warnings.warn(f"{why} Results are NaN there.", stacklevel=2)
        return is_short

    def contradictions(self, q: Tensor, name: str = "q") -> list[str]:
        """Return a warning if the tendons compress the body too much, which then has no shape."""
        rows = self._rows(q)
        with torch.no_grad(), without_warnings():
            (arcs,) = in_blocks(lambda q: (self._arcs_of_rows(q).mT,), rows)
        is_short = rows.isfinite().all(1) & arcs.isnan().any(1)
        why = why_not(COMPRESSED, rows, is_short)
        return [] if why is None else [f"`{name}` has no tip: {why}"]

    def plausible_rows(self) -> PlausibleRows:
        """Return bounds of rows that need no warning about their units or short arcs.

        At balance the energy is at most that of the rest shape: a change of length d of an arc
        with axial stiffness k has ``k d^2 <= n e^2``, with the largest stretch e there.
        """
        bounds = super().plausible_rows()
        lengths = self.geometry()["lengths"]
        softest = (self.axial_stiffness.sqrt() * lengths).amin()
        most = (1.0 - HK_LEAST_LENGTH) * softest / self.n_actuators**0.5
        shape = torch.cat([torch.zeros_like(self.radii), *self.rest_bends.T])
        preloaded = (self.tendon_zeros + self._readings() @ shape).abs()
        least = torch.finfo(most.dtype).tiny ** 0.5
        weights = torch.diag(self.gains / (most - preloaded).clamp(min=least))
        both = np.vstack([bounds.weights, as_array(weights.detach())])
        return PlausibleRows(bounds.rest, both)

    def _arcs_and_change(
        self, rows: Tensor, tangents: Mapping[str, Tensor]
    ) -> tuple[Tensor, Change]:
        """Return arcs and their changes, by the implicit function theorem.

        The forces on the shape a vanish: K (a - a0) + B' pull = 0, with the pull B a + zeros -
        gains q of the taut tendons. So a changes by -(K + B' B)^-1 times the change of the forces
        at a fixed shape.
        """
        shape, pull, taut, compliance = self._balance(rows)

        def change(by_arcs: Tensor) -> Tensor:
            fixed = self._elasticity().to(rows)
            by_force = -by_arcs @ compliance
            by_pull = (by_force @ fixed.readings.mT) * taut[:, None]
            by_stiffness = by_force * (shape - fixed.rest)[:, None]
            by_rest = -by_force * fixed.stiffness
            S = self.n_segments
            # A tendon reads the sums of the bendings of its segments, times its place beside the
            # backbone. Its readings of the lengths do not change.
            spans = fixed.readings[:, :S]
            x_force, y_force = by_force[..., S:].split(S, dim=-1)
            x_shape, y_shape = (shape[:, S:].unflatten(1, (2, S)) @ spans.mT).unbind(1)
            by_x = pull[:, None] * (x_force @ spans.mT) + by_pull * x_shape[:, None]
            by_y = pull[:, None] * (y_force @ spans.mT) + by_pull * y_shape[:, None]

            changes = self._all_changes(tangents)
            bending = changes["bending_stiffness"]
            x_changes, y_changes = self._changes_of_places(changes)
            effects_and_causes = [
                (by_stiffness[..., :S], changes["axial_stiffness"]),
                (by_stiffness[..., S:], torch.cat([bending, bending], dim=-1)),
                (by_rest[..., S:], changes["rest_bends"].mT.flatten(1)),
                (by_x, x_changes),
                (by_y, y_changes),
                (by_pull, changes["tendon_zeros"]),
                (-by_pull * rows[:, None], changes["gains"]),
                (by_arcs[..., :S], changes["lengths"]),
            ]
            effects, causes = zip(*effects_and_causes, strict=True)
            return torch.cat(effects, dim=-1) @ torch.cat(causes, dim=-1).mT

        return self._arcs_of(shape, rows), change

    def _changes_of_places(self, changes: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Return the changes (P, n) of what the tendons read of a bend of 1 rad, x and y [m]."""
        of_bends = self._changes_of_bends(changes).unflatten(2, (2, self.n_segments))
        # Each tendon bends its own segment.
        own = np.repeat(np.eye(self.n_segments), self.actuators_per_segment, axis=0)
        own = torch.from_numpy(own).to(of_bends)
        return (of_bends * own[:, None]).sum(-1).unbind(2)
