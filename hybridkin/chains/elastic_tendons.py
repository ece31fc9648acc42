"""An elastic backbone with tendons that can only pull, as a torch module q -> x."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hybridkin._core.arrays import LARGEST, Numbers, Transform
from hybridkin._core.plan import Plan
from hybridkin._core.stored import Layout, Stored
from hybridkin.chains import _slack
from hybridkin.chains._arcs import levers, reading_matrix
from hybridkin.chains._checks import filled, float_dtype
from hybridkin.chains.arc_chain import STRUCTURE, ArcChain, Change, frame_numbers
from hybridkin.chains.constant_curvature import ConstantCurvatureChain

__all__ = ["ElasticTendonChain"]

_SHAPING = "radii angles bending_stiffness axial_stiffness rest_bends tendon_zeros gains".split()
_TABLE = 12  # largest number of tendons for which all responses are stored


def _write_plan(plan: Plan, stored: Stored) -> int:
    """Write the node of a chain: its frame, then numbers of its segments and of its tendons."""
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
    equal_count = counts[0] if len({*counts}) == 1 else 0
    numbers = [frame, np.hstack(segments), tendons]
    return plan.node(
        "elastic", len(x), 3, numbers, n_arcs, n_segments, equal_count, *counts
    )


class ElasticTendonChain(ArcChain):
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
    # The table is checked against the geometry.
    _structure = (
        *ArcChain._structure,
        "_table",
    )

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
        if lengths is None or (isinstance(lengths, (list, tuple)) and None in lengths):
            raise ValueError(
                "`lengths` must hold the backbone length of every segment, got None."
            )
        geometry = self._checked(
            routing,
            radii,
            lengths,
            n_actuators,
            angles,
            offsets,
            rest_bends,
            gains,
            base,
            dtype,
        )
        if self.n_actuators > _slack.MOST:
            raise ValueError(
                f"`n_actuators` must be at most {_slack.MOST} in all, got {self.n_actuators}."
            )
        if bending_stiffness is None:
            bending = 0.01 * geometry["radii"] ** 2
        else:
            bending = bending_stiffness
        axial = 10.0 if axial_stiffness is None else axial_stiffness
        for name, value in (("bending_stiffness", bending), ("axial_stiffness", axial)):
            geometry[name] = filled(value, name, dtype, (self.n_segments,))
            if not (geometry[name] > 1.0 / LARGEST).all():
                need = f"must be positive, over {1.0 / LARGEST:g}"
                raise ValueError(f"`{name}` {need}, got {geometry[name].tolist()}.")
        zeros = filled(tendon_zeros, "tendon_zeros", dtype, (self.n_actuators,))
        self._table: tuple[list[Tensor], object, _slack.Responses] | None = None
        self._set_geometry({**geometry, "tendon_zeros": zeros})

    @classmethod
    def from_chain(
        cls, chain: ConstantCurvatureChain, **options: Any
    ) -> ElasticTendonChain:
        """Return an elastic chain with the geometry of a plain chain with tendons.

        Parameters
        ----------
        chain : ConstantCurvatureChain
            A chain with `lengths`. Its `actuator_zeros` times the gains become `tendon_zeros`.
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
        geometry["tendon_zeros"] = geometry.pop("actuator_zeros") * chain.gains
        angles = [part.tolist() for part in geometry["angles"].split(counts)]
        arguments = {
            "n_actuators": counts,
            "routing": chain.routing,
            "dtype": chain.radii.dtype,
        }
        return cls(**{**geometry, "angles": angles, **arguments, **options})._marked(
            chain.markers
        )

    @property
    def default_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that a calibration fits by default."""
        stiffness = ("bending_stiffness", "axial_stiffness")
        geometry = ("radii", "turns", "rest_bends", "lengths", "tool", "base")
        return (
            *geometry,
            *stiffness,
            "tendon_zeros",
            *(() if self.in_metres else ("gain",)),
        )

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

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_table": None}

    def _elasticity(self) -> _slack.Elasticity:
        counts = self.actuators_per_segment
        at = levers(self.radii, self.angles, counts)
        ones = torch.ones_like(self.radii)
        return _slack.Elasticity(
            reading_matrix(at, counts, self.starts),
            torch.cat([ones, 1.0 / self.radii, 1.0 / self.radii]),
            torch.cat(
                [self.axial_stiffness, self.bending_stiffness, self.bending_stiffness]
            ),
            torch.cat([0.0 * ones, *self.rest_bends.unbind(-1)]),
            self.tendon_zeros,
            self.gains,
        )

    def _all_responses(self, rows: Tensor) -> _slack.Responses:
        """Return the responses of all sets of taut tendons, cached until the geometry changes."""
        geometry = self.geometry()
        shaping = [geometry[name] for name in _SHAPING]
        learning = torch.is_grad_enabled() and any(
            value.requires_grad for value in shaping
        )
        passing = learning or any(value.is_inference() for value in shaping)
        if passing:
            key = None
        else:
            key = (rows.dtype, rows.device, *(v._version for v in shaping))
        if key is not None and self._table is not None:
            kept_elasticity, kept_key, responses = self._table
            if key == kept_key and all(
                a is b for a, b in zip(kept_elasticity, shaping, strict=True)
            ):
                return responses
        codes = torch.arange(2**self.n_actuators, device=self.radii.device)
        # Outside inference mode: derivatives cannot use inference tensors.
        if torch.is_inference_mode_enabled():
            guard = torch.inference_mode(False)
        else:
            guard = nullcontext()
        with guard:
            elasticity = _slack.Elasticity(
                *(part.double() for part in self._elasticity())
            )
            responses = _slack.responses_of(
                _slack.as_mask(codes, self.n_actuators), elasticity
            )
            responses = _slack.Responses(*(part.to(rows) for part in responses))
        if not passing:
            self._table = (shaping, key, responses)
        return responses

    def _find(self, rows: Tensor) -> tuple[Tensor, Tensor, _slack.Responses]:
        """Return the sets of taut tendons (N,) as bits, their places in responses, and those."""
        if self.n_actuators <= _TABLE:
            table = self._all_responses(rows)
            codes = _slack.FindTaut.apply(
                _slack.find_in_table, rows.detach(), table.stretch.detach()
            )
            return codes, codes, table
        elasticity = _slack.Elasticity(*(part.to(rows) for part in self._elasticity()))
        parts = (part.detach() for part in (rows, *elasticity))
        codes = _slack.FindTaut.apply(_slack.find_by_solving, *parts)
        responses = _slack.responses_of(
            _slack.as_mask(codes, self.n_actuators), elasticity
        )
        return codes, torch.arange(len(rows), device=rows.device), responses

    def _balance(self, rows: Tensor) -> _slack.Balance:
        codes, at, responses = self._find(rows)
        shape, stretch = (
            _slack.applied(maps.index_select(0, at), _slack.extended(rows))
            for maps in responses[:2]
        )
        taut = _slack.as_mask(codes, self.n_actuators)
        compliance = responses.compliance.index_select(0, at)
        return _slack.Balance(shape, stretch.relu() * taut, taut, compliance)

    def _arcs_and_slope(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        _, at, responses = self._find(rows)
        straight = nn.functional.pad(
            self.get_buffer("lengths").to(rows), (0, 2 * self.n_segments)
        )
        maps = responses.shape.index_select(0, at)
        arcs = (_slack.applied(maps, _slack.extended(rows)) + straight).T.contiguous()
        return arcs, maps[..., :-1].permute(1, 2, 0)

    def _arcs_and_change(self, rows: Tensor) -> tuple[Tensor, Change]:
        S = self.n_segments
        shape, pull, taut, compliance = self._balance(rows)

        def change(by_arcs: Tensor, tangents: Mapping[str, Tensor]) -> Tensor:
            new, by_bendings = self._changes(rows, tangents)
            readings, _, stiffness, rest, *_ = (
                part.to(rows) for part in self._elasticity()
            )
            bending = new["bending_stiffness"]
            by_stiffness = torch.cat([new["axial_stiffness"], bending, bending], dim=-1)
            by_rest = nn.functional.pad(new["rest_bends"].mT.flatten(1), (S, 0))
            # Implicit function theorem: compliance times the unbalanced forces, accumulated from
            # the tip: its motion per force on the shape, and per pull of a tendon.
            by_force = by_arcs @ compliance
            by_pull = (by_force @ readings.mT) * taut[:, None]
            turned = pull[:, None, :, None] * by_force[:, :, None, S:]
            turned = turned + by_pull[..., None] * shape[:, None, None, S:]
            softer = by_force * (rest - shape)[:, None]
            effects = [by_force, softer, -by_pull, -turned.flatten(2), by_arcs[..., :S]]
            causes = [stiffness * by_rest, by_stiffness, new["tendon_zeros"]]
            causes += [by_bendings.flatten(1), new["lengths"], new["gains"]]
            effects.append(by_pull * rows[:, None])
            return torch.cat(effects, dim=-1) @ torch.cat(causes, dim=-1).mT

        straight = nn.functional.pad(self.get_buffer("lengths").to(rows), (0, 2 * S))
        return (shape + straight).mT.contiguous(), change
