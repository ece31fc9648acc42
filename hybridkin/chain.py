"""Constant-curvature kinematics of a chain of segments, as a torch module q -> x."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from hybridkin._arcs import arc_transforms, reading_matrix, tip, tip_and_columns
from hybridkin._geometry import (
    actuator_counts,
    flat_angles,
    pose,
    vector,
    warn_millimetres,
)
from hybridkin._numerics import PortableModule, check_vectors, in_blocks, stumpff

if TYPE_CHECKING:
    from pytorch_kinematics import Transform3d

__all__ = ["ConstantCurvatureChain"]

_ROUTINGS = ("segment", "base")
_GEOMETRY = ("radii", "angles", "lengths", "offsets", "base")


class ConstantCurvatureChain(PortableModule):
    """Tip position of a chain of constant-curvature segments, from its actuator lengths.

    Straight parallel actuators at angle psi_i on a circle of radius r see an arc of centre-line
    length l and bending vector b (norm: bend angle, direction: where it bends) as
    ``l_i = l - r (b_x cos psi_i + b_y sin psi_i)``. The least-squares inverse of that relation is
    one constant matrix per robot, q -> (l, b), followed by one smooth chain of arcs; there is no
    division by a bend angle anywhere, so value and derivatives are right at the straight robot.

    Parameters
    ----------
    radii : array-like of shape (S,)
        Radius of the actuator circle of each segment, base to tip [m].
    n_actuators : int or sequence of S ints, default=3
        Actuators of each segment, at least 3.
    angles : array-like, optional
        Actuator angles about the backbone, counter-clockwise from the base x-axis [rad]: shape
        ``(n,)`` for all segments alike, ``(S, n)``, or one sequence per segment. Default: evenly
        spaced from 0.
    lengths : array-like of shape (S,), optional
        None for extensible segments: q holds absolute actuator lengths [m] (pneumatic trunk).
        Otherwise backbone lengths [m] of inextensible segments: q holds the *changes* of tendon
        length from straight [m], negative where a tendon is shortened.
    routing : {"segment", "base"}, default="segment"
        "segment": each actuator spans its own segment. "base": actuators of a segment also run
        through all segments nearer the base, at their own radius and angle.
    offsets : float or array-like of shape (S,), default=0.0
        Rigid length after each segment along its tangent [m]; the last one is the tool.
    base : array-like of shape (4, 4) or pytorch_kinematics Transform3d, optional
        Pose of the robot's base in the measuring frame. Default: identity.
    dtype : torch.dtype, default=torch.float64
        Precision in which the geometry is held. Results come in the dtype of q.

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

    radii: Tensor
    angles: Tensor
    lengths: Tensor | None
    offsets: Tensor
    base: Tensor
    arc_matrix: Tensor
    arc_offset: Tensor

    def __init__(
        self,
        radii: Any,
        *,
        n_actuators: int | Sequence[int] = 3,
        angles: Any = None,
        lengths: Any = None,
        routing: str = "segment",
        offsets: Any = 0.0,
        base: Any = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        if routing not in _ROUTINGS:
            raise ValueError(f"`routing` must be one of {_ROUTINGS}, got {routing!r}.")
        radii = vector(radii, "radii", dtype, positive=True)
        n_segments = radii.numel()
        counts = actuator_counts(n_actuators, n_segments)
        if lengths is not None:
            lengths = vector(lengths, "lengths", dtype, size=n_segments, positive=True)
        if np.ndim(offsets) == 0:
            offsets = np.full(n_segments, float(offsets))
        self.n_segments = n_segments
        self.actuators_per_segment = counts
        self.n_actuators = sum(counts)
        self.routing = routing
        angles = flat_angles(angles, counts, dtype)
        if torch.linalg.cond(reading_matrix(radii, angles, counts, routing, lengths is None)) > 1e6:
            raise ValueError(
                "`angles` must tell the bending of every segment apart, got "
                f"{[row.tolist() for row in angles.split(counts)]}; give each segment at least 3 "
                "actuators at different angles [rad]."
            )
        self._set_geometry(
            radii=radii,
            angles=angles,
            lengths=lengths,
            offsets=vector(offsets, "offsets", dtype, size=n_segments),
            base=pose(base, "base", dtype),
        )
        warn_millimetres("radii", radii, 1.0)
        if lengths is not None:
            warn_millimetres("lengths", lengths, 10.0)

    @property
    def default_parameters(self) -> tuple[str, ...]:
        """The geometry that a calibration fits by default."""
        return ("radii", "base") if self.lengths is None else ("radii", "lengths", "base")

    def geometry(self) -> dict[str, Tensor]:
        """Return the geometry by name: radii, angles, lengths (tendons only), offsets, base."""
        tensors = {name: getattr(self, name) for name in _GEOMETRY}
        return {name: value for name, value in tensors.items() if value is not None}

    def with_geometry(self, **geometry: Tensor) -> ConstantCurvatureChain:
        """Return a chain with some of the geometry replaced, differentiable in the new values.

        Parameters
        ----------
        **geometry : Tensor
            Entries of `geometry()`, in the same shapes and units. Their values are not checked.

        Returns
        -------
        ConstantCurvatureChain
            A new chain; this one is left as it was.
        """
        current = self.geometry()
        for name, value in geometry.items():
            if name not in current:
                raise ValueError(
                    f"`{name}` is not part of this chain's geometry; it has {sorted(current)}."
                )
            if value.shape != current[name].shape:
                raise ValueError(
                    f"`{name}` must have shape {tuple(current[name].shape)}, got "
                    f"{tuple(value.shape)}."
                )
        chain = type(self).__new__(type(self))
        nn.Module.__init__(chain)
        for name in ("n_segments", "actuators_per_segment", "n_actuators", "routing"):
            setattr(chain, name, getattr(self, name))
        chain._set_geometry(**{"lengths": None, **current, **geometry})
        return chain

    def forward(self, q: Tensor) -> Tensor:
        """Return the tip position.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].

        Returns
        -------
        Tensor of shape (..., 3)
            Tip position in the measuring frame [m].
        """
        length, bending = self._arc_rows(q)
        tail = tip(length, bending, stumpff((bending**2).sum(0)), self.offsets.to(q))
        base = self.base.to(q)
        return (base[:3, :3] @ tail + base[:3, 3:]).T.reshape(*q.shape[:-1], 3)

    def jacobian(self, q: Tensor) -> Tensor:
        """Return the position Jacobian dx/dq, shape (..., 3, n_actuators), in closed form."""
        return self.forward_and_jacobian(q)[1]

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tip position [m] and its Jacobian in one pass.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].

        Returns
        -------
        x : Tensor of shape (..., 3)
            Tip position [m].
        J : Tensor of shape (..., 3, n_actuators)
            Closed-form Jacobian dx/dq [-].
        """
        x, J = in_blocks(self._forward_and_jacobian, q)
        return x, J

    def pose_jacobian(self, q: Tensor) -> Tensor:
        """Return the tip's linear [-] and angular [rad/m] Jacobian, shape (..., 6, n_actuators).

        The angular rows give the angular velocity in the measuring frame.
        """
        length, bending = self._arc_rows(q)
        _, columns = tip_and_columns(length, bending, self.offsets.to(q), angular=True)
        linear, angular = columns.chunk(2, dim=1)
        return torch.cat(
            [self._actuator_jacobian(linear, q), self._actuator_jacobian(angular, q)], dim=-2
        )

    def arcs(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the arc of every segment.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].

        Returns
        -------
        length : Tensor of shape (..., S)
            Centre-line lengths [m].
        bending : Tensor of shape (..., S, 2)
            Bending vectors [rad]: their norm is the bend angle, they point where it bends.
        """
        length, bending = self._arc_rows(q)
        lead = (*q.shape[:-1], self.n_segments)
        return length.T.reshape(lead), bending.permute(2, 1, 0).reshape(*lead, 2)

    def poses(self, q: Tensor) -> Tensor:
        """Return the pose of the base and of the end of every segment, its offset included.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].

        Returns
        -------
        Tensor of shape (..., S + 1, 4, 4)
            Homogeneous transforms into the measuring frame; the last one is the tip.
        """
        length, bending = self.arcs(q)
        steps = arc_transforms(length, bending, self.offsets.to(q))
        pose = self.base.to(q).expand(*q.shape[:-1], 4, 4)
        poses = [pose]
        for k in range(self.n_segments):
            pose = pose @ steps[..., k, :, :]
            poses.append(pose)
        return torch.stack(poses, dim=-3)

    def tip_transform(self, q: Tensor) -> Transform3d:
        """Return the tip pose as a pytorch_kinematics Transform3d, for q of shape (N, n)."""
        from pytorch_kinematics import Transform3d  # takes a second and loads pyplot

        return Transform3d(matrix=self.poses(q)[..., -1, :, :])

    def backbone(self, q: Tensor, n_points: int = 20) -> Tensor:
        """Return points along the backbone, base to tip.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].
        n_points : int, default=20
            Points per segment; the last of each is the segment's end, its offset included.

        Returns
        -------
        Tensor of shape (..., S * n_points + 1, 3)
            Positions in the measuring frame [m].
        """
        if n_points < 1:
            raise ValueError(f"`n_points` must be at least 1, got {n_points}.")
        length, bending = self.arcs(q)
        poses = self.poses(q)
        t = torch.linspace(0.0, 1.0, n_points + 1, dtype=q.dtype, device=q.device)[1:, None]
        f, g = stumpff((t * bending[..., None, :]).square().sum(-1))[1:3]
        bend = (g[..., None] * t) * bending[..., None, :]
        arc = (t * length[..., None, None]) * torch.cat([bend, f[..., None]], dim=-1)
        start, end = poses[..., :-1, :, :], poses[..., 1:, None, :3, 3]
        points = arc @ start[..., :3, :3].mT + start[..., None, :3, 3]
        points = torch.cat([points[..., :-1, :], end], dim=-2)
        return torch.cat([poses[..., 0, None, :3, 3], points.flatten(-3, -2)], dim=-2)

    def consistency(self, q: Tensor) -> Tensor:
        """Return how far the actuator readings of each segment contradict each other.

        The readings are compared with those that the fitted arcs would give. Three chambers always
        agree; with more actuators a broken cable or sensor shows, and on tendon chains a common
        pull of all tendons of a segment, which bends nothing here.

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
        >>> chain.consistency(torch.tensor([-0.002, 0.001, 0.001, -0.003, -0.003, -0.003]))
        tensor([0.0000, 0.0030])
        """
        length, bending = self._arc_rows(q)
        readings = reading_matrix(
            self.radii,
            self.angles,
            self.actuators_per_segment,
            self.routing,
            self.lengths is None,
        ).to(q)
        turns = (bending * self.radii.to(q)[:, None]).flatten(0, 1)
        arcs = turns if self.lengths is not None else torch.cat([length, turns])
        residual = q.reshape(-1, self.n_actuators) - (readings @ arcs).T
        parts = residual.split(self.actuators_per_segment, dim=-1)
        norms = [torch.linalg.vector_norm(part, dim=-1) / part.shape[-1] ** 0.5 for part in parts]
        rms = torch.stack(norms, dim=-1)
        return rms.reshape(*q.shape[:-1], self.n_segments)

    def check_actuators(self, q: Tensor, name: str = "q") -> None:
        """Raise where q cannot be a log of this robot, and warn where it looks like millimetres.

        Parameters
        ----------
        q : Tensor of shape (..., n_actuators)
            Actuator lengths, or tendon length changes [m].
        name : str, default="q"
            What to call `q` in a message.

        Raises
        ------
        ValueError
            For NaN or infinite entries, and for absolute lengths that are not positive.
        """
        check_vectors(q, self.n_actuators, name, self._why_shape())
        rows = q.detach().reshape(-1, self.n_actuators)
        bad = ~torch.isfinite(rows).all(dim=1)
        if bad.any():
            raise ValueError(
                f"`{name}` must be finite, got NaN or infinity in {int(bad.sum())} of "
                f"{len(rows)} rows (first: row {int(bad.nonzero()[0])}); drop those rows."
            )
        if self.lengths is None and (rows <= 0).any():
            row = int((rows <= 0).any(dim=1).nonzero()[0])
            raise ValueError(
                f"`{name}` must hold positive actuator lengths [m], got {rows[row].min():.6g} in "
                f"row {row}; for tendon length changes build the chain with `lengths=`."
            )
        reach = 10.0 if self.lengths is None else 10.0 * float(self.lengths.detach().sum())
        warn_millimetres(name, rows.abs(), reach)

    def extra_repr(self) -> str:
        """Return the summary shown by repr()."""
        kind = "extensible" if self.lengths is None else "inextensible"
        return f"{self.n_segments} {kind} segments, {self.n_actuators} actuators, {self.routing}"

    def _set_geometry(
        self, radii: Tensor, angles: Tensor, lengths: Tensor | None, offsets: Tensor, base: Tensor
    ) -> None:
        for name, value in zip(_GEOMETRY, (radii, angles, lengths, offsets, base), strict=True):
            self.register_buffer(name, value)
        readings = reading_matrix(
            radii, angles, self.actuators_per_segment, self.routing, lengths is None
        )
        normal = readings.mT @ readings
        matrix = torch.linalg.solve(normal, readings.mT)
        scale = torch.cat([radii, radii])[:, None]
        if lengths is None:
            matrix = torch.cat([matrix[: self.n_segments], matrix[self.n_segments :] / scale])
            offset = radii.new_zeros(3 * self.n_segments)
        else:
            matrix = torch.cat(
                [matrix.new_zeros(self.n_segments, self.n_actuators), matrix / scale]
            )
            offset = torch.cat([lengths, lengths.new_zeros(2 * self.n_segments)])
        self.register_buffer("arc_matrix", matrix)
        self.register_buffer("arc_offset", offset)

    def _why_shape(self) -> str:
        per_segment = " + ".join(str(n) for n in self.actuators_per_segment)
        if len(set(self.actuators_per_segment)) == 1:
            per_segment = f"{self.actuators_per_segment[0]} actuators each"
        return f"this chain has {self.n_segments} segments of {per_segment}"

    def _arc_rows(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return lengths (S, N) and bending vectors (2, S, N), the batch last."""
        check_vectors(q, self.n_actuators, "q", self._why_shape())
        rows = q.reshape(-1, self.n_actuators)
        arcs = torch.addmm(self.arc_offset.to(q)[:, None], self.arc_matrix.to(q), rows.T)
        return arcs[: self.n_segments], arcs[self.n_segments :].unflatten(0, (2, self.n_segments))

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        length, bending = self._arc_rows(q)
        tail, columns = tip_and_columns(length, bending, self.offsets.to(q))
        base = self.base.to(q)
        x = (base[:3, :3] @ tail + base[:3, 3:]).T
        return x.reshape(*q.shape[:-1], 3), self._actuator_jacobian(columns, q)

    def _actuator_jacobian(self, columns: Tensor, q: Tensor) -> Tensor:
        """Fold the constant map q -> arcs and the base into columns (3, 3 S, N)."""
        arc_matrix = self.arc_matrix.to(q).unflatten(0, (3, self.n_segments))
        arc_matrix = arc_matrix.transpose(0, 1).flatten(0, 1)
        J = self.base.to(q)[:3, :3] @ (columns.permute(2, 0, 1) @ arc_matrix)
        return J.reshape(*q.shape[:-1], 3, self.n_actuators)
