"""The errors of a chain's structure from few rows, by a prior in natural units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hybridkin._core.arrays import identity
from hybridkin._core.blocks import in_blocks
from hybridkin._core.groups import Groups
from hybridkin._core.model import ForwardModel
from hybridkin._core.rotations import cross_matrix, rotation
from hybridkin.calibration.measured import points
from hybridkin.calibration.natural_scales import STRUCTURE
from hybridkin.chains.structural import Loads, StructuralChain, Weights, change_of
from hybridkin.hybrid._drift import too_far
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid.structure_fit import StructureFit

# Noise of a tip coordinate [reaches of the robot], and of an actuator [its spread in the log].
_TIP_NOISE = 0.004
_ACTUATOR_NOISE = 0.02
_MOVES = 1e-9  # spread of a length over the reach of the robot, above which it varies
_BLOCK = 512  # rows whose derivatives are computed at once
_ROUNDS = 30  # of Gauss-Newton; five are usual
_SHORTEST = 1e-3  # part of a step below which the cost is at its minimum
_SETTLED = 1e-7  # largest change of a parameter, in units of its prior


@dataclass(frozen=True)
class Blocks:
    """The free errors of a structure as directions of its weights, in units of their prior.

    Attributes
    ----------
    names : tuple of str
        The block of every direction.
    directions : Tensor of shape (P, 18 S)
        Weights zeros, maps, twists and sags, one after the other, of one prior standard deviation.
    """

    names: tuple[str, ...]
    directions: Tensor

    @classmethod
    def of(cls, varies: Tensor, scales: Mapping[str, float] = STRUCTURE) -> Blocks:
        """Return the blocks of S segments; `varies` (S,) says whose lengths vary, bool."""
        names = []
        directions = []
        for name, error in _errors(varies, scales["sag of a twist"]):
            if scales[name] > 0.0:
                flat = torch.cat([entry.flatten() for entry in error])
                names.append(name)
                directions.append(scales[name] * flat)
        return cls(tuple(names), torch.stack(directions))

    def weights(self, parameters: Tensor) -> Weights:
        """Return the weights of parameters (P,) in units of their prior."""
        return _weights(parameters @ self.directions)


def _errors(varies: Tensor, sag_of_a_twist: float) -> Iterator[tuple[str, Weights]]:
    """Yield every free error of S segments of size one, with the name of its block."""
    S = len(varies)
    nothing = _weights(torch.zeros(18 * S, dtype=torch.float64, device="cpu"))
    segments = identity(S, nothing.zeros)
    axes = identity(3, segments)
    for k, segment in enumerate(segments):
        for name, zero in _zeros(bool(varies[k]), axes):
            yield name, nothing._replace(zeros=torch.outer(segment, zero))
        for name, ring in _rings(bool(varies[k]), axes):
            yield name, nothing._replace(maps=segment[:, None, None] * ring)
    for axis in axes:
        load = axis.expand(S, 3)
        yield "gravity", nothing._replace(twists=load, sags=sag_of_a_twist * load)
        for segment in segments:
            of_segment = torch.outer(segment, axis)
            yield "twists", nothing._replace(twists=of_segment)
            yield "sags", nothing._replace(sags=of_segment)


def _zeros(has_strain: bool, axes: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Yield the constant errors (3,) of strain and bending."""
    strain, x, y = axes
    if has_strain:
        yield "zero lengths", strain
    yield "zero bends", x
    yield "zero bends", y


def _rings(has_strain: bool, axes: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Yield the linear maps (3, 3) of a segment's own strain and bending."""
    _, x, y = axes
    yield "ring stretch", torch.outer(x, x) + torch.outer(y, y)
    yield "ring turn", torch.outer(y, x) - torch.outer(x, y)
    own = axes if has_strain else axes[1:]
    for changed in own:
        for by in own:
            yield "ring maps", torch.outer(changed, by)


def _weights(flat: Tensor) -> Weights:
    """Return the weights from one tensor (..., 18 S)."""
    S = flat.shape[-1] // 18
    zeros, maps, twists, sags = flat.split([3 * S, 9 * S, 3 * S, 3 * S], dim=-1)
    return Weights(
        zeros.unflatten(-1, (S, 3)),
        maps.unflatten(-1, (S, 3, 3)),
        twists.unflatten(-1, (S, 3)),
        sags.unflatten(-1, (S, 3)),
    )


class StructureDesign:
    """How the tips of a chain follow the errors of its structure.

    theta are the base (6) and the blocks, in units of the prior.

    Parameters
    ----------
    chain : ForwardModel
        The chain, with one arc for each segment.
    q : Tensor of shape (N, n)
        Rows of the log, which give the mean lengths and the noise of the actuators.
    factor : float
        Common factor of all standard deviations of the prior.
    scales : mapping of str to float
        Standard deviations by block.
    """

    def __init__(
        self,
        chain: ForwardModel,
        q: Tensor,
        factor: float = 1.0,
        scales: Mapping[str, float] = STRUCTURE,
    ) -> None:
        self.chain = chain
        self.factor = factor
        lengths = chain.frames_and_moves(q).arcs[: chain.n_arcs]
        self.reach = chain.reach.to(q)
        self.lengths = lengths.mean(1)
        varies = lengths.std(1, correction=0) > _MOVES * self.reach
        self.blocks = Blocks.of(varies, scales)
        turn = q.new_full((3,), factor * scales["base turn"])
        move = q.new_full((3,), factor * scales["base move"])
        self.base = torch.cat([turn, self.reach * move])
        self.pivot = chain.origin.to(q)
        self.spread = _ACTUATOR_NOISE * q.std(0, correction=0)

    @property
    def names(self) -> tuple[str, ...]:
        """The block of every entry of theta."""
        return (*3 * ("base turn",), *3 * ("base move",), *self.blocks.names)

    def units(self, scales: Mapping[str, float]) -> Tensor:
        """Return one prior standard deviation of every entry of theta (P,) [rad], [m] or [-]."""
        of_blocks = [self.factor * scales[name] for name in self.blocks.names]
        return torch.cat([self.base, self.base.new_tensor(of_blocks)])

    def arcs(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the arcs (N, C) up to the tip at rows q, and their change (N, C, P) by blocks."""
        z, fields = in_blocks(self._arcs_of_rows, q, _BLOCK)
        return z, fields

    def _arcs_of_rows(self, q: Tensor) -> tuple[Tensor, Tensor]:
        frames = self.chain.frames_and_moves(q)
        loads = Loads.of(frames, self.lengths)
        fields = torch.func.vmap(
            lambda weights: change_of(loads, frames.arcs, self.lengths, weights)
        )(_weights(self.factor * self.blocks.directions))
        arcs = frames.arcs
        fields = fields.transpose(0, 1)  # (3 S, P, N)
        if len(self.chain.markers) == 1:
            arcs = self.chain.up_to_tip(arcs)
            fields = self.chain.up_to_tip(fields)
        return arcs.mT, fields.permute(2, 0, 1).contiguous()

    def noise(self, q: Tensor, J: Tensor) -> Tensor:
        """Return A noise (N, m, m) of rows, A A' its covariance; J (N, m, n) are dx/dq."""
        moved = J * self.spread
        of_tip = (_TIP_NOISE * self.reach) ** 2 * identity(J.shape[1], q)
        return torch.linalg.cholesky(of_tip + moved @ moved.mT)

    def motion(self, theta: Tensor) -> Tensor:
        """Return the motion (4, 4) of the base."""
        turn, move = (self.base * theta[:6]).split(3)
        motion = identity(4, theta)
        motion[:3, :3] = rotation(turn)[0]
        motion[:3, 3] = self.pivot - motion[:3, :3] @ self.pivot + move
        return motion

    def model(self, theta: Tensor) -> StructuralChain:
        """Return the chain with these errors."""
        weights = self.blocks.weights(self.factor * theta[6:])
        return StructuralChain(self.chain, self.lengths, *weights, self.motion(theta))

    def slopes(self, tips: Tensor, by_arcs: Tensor, fields: Tensor, base: Tensor) -> Tensor:
        """Return the derivative (N, m, P) of tips (N, K, 3) by theta [m].

        `by_arcs` (N, K, 3, C) are the derivatives by the arcs, and `base` (6,) the entries of theta
        for the base.
        """
        turn, move = (self.base * base).split(3)
        spins = rotation(turn)[1] * self.base[:3]
        turned = -cross_matrix(tips - self.pivot - move) @ spins
        moved = torch.diag(self.base[3:]).expand_as(turned)
        by_base = torch.cat([turned, moved], dim=3).flatten(1, 2)
        return torch.cat([by_base, by_arcs.flatten(1, 2) @ fields], dim=2)


class _StructureProblem:
    """The rows of a fit, and the fit of theta."""

    def __init__(self, design: StructureDesign, rows: Rows) -> None:
        self.design = design
        chain = design.chain
        x = torch.from_numpy(rows.tips.astype(np.float64))
        self.seen = ~x.isnan()
        self.x = torch.where(self.seen, x, 0.0)
        self.root = torch.from_numpy(rows.counts.astype(np.float64)).sqrt()
        self.z, self.fields = design.arcs(rows.q)
        self.tips = chain.tips_by_coordinates()
        J = chain.forward_and_jacobian(rows.q)[1]
        self.noise = design.noise(rows.q, J * self.seen[..., None])

    def residual(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return whitened residuals (N, m), tips (N, K, 3), their slopes (N, K, 3, C) by arcs."""
        x, J = self.tips(self.z + self.fields @ theta[6:])
        motion = self.design.motion(theta)
        tips = x.unflatten(1, (-1, 3)) @ motion[:3, :3].mT + motion[:3, 3]
        slope = motion[:3, :3] @ J.unflatten(1, (-1, 3))
        rest = torch.where(self.seen, self.x - tips.flatten(1), 0.0)
        return self.white(rest[..., None])[..., 0], tips, slope

    def slopes(self, theta: Tensor, tips: Tensor, by_arcs: Tensor) -> Tensor:
        """Return the whitened derivative (N, m, P) of the tips by theta."""
        A = self.design.slopes(tips, by_arcs, self.fields, theta[:6])
        return self.white(torch.where(self.seen[..., None], A, 0.0))

    def white(self, values: Tensor) -> Tensor:
        """Return values (N, m, C) in units of the noise of their rows, times the row weights."""
        white = torch.linalg.solve_triangular(self.noise, values, upper=False)
        return self.root[:, None, None] * white

    def in_metres(self, white: Tensor) -> Tensor:
        """Return residuals (N, m) [m] from whitened ones."""
        return (self.noise @ white[..., None])[..., 0] / self.root[:, None]

    def minimum(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return theta of the least cost, and the whitened residuals and design there."""
        theta = self.x.new_zeros(len(self.design.names))
        rest, *at = self.residual(theta)
        for _ in range(_ROUNDS):
            A = self.slopes(theta, *at).flatten(0, 1)
            system = A.mT @ A + identity(len(theta), A)
            slope = A.mT @ rest.flatten() - theta
            step = torch.cholesky_solve(slope[:, None], torch.linalg.cholesky(system))[:, 0]
            cost = _cost(rest, theta)
            part = 1.0
            while part > _SHORTEST:  # a full step may overshoot
                tried = theta + part * step
                new, *new_at = self.residual(tried)
                if _cost(new, tried) < cost:
                    theta, rest, at = tried, new, new_at
                    break
                part *= 0.5
            if part <= _SHORTEST or float((part * step).abs().max()) < _SETTLED:
                break
        return theta, rest, self.slopes(theta, *at)


def _cost(rest: Tensor, theta: Tensor) -> float:
    return float(rest.square().sum() + theta.square().sum())


def fit_structure(
    chain: ForwardModel,
    rows: Rows,
    factor: float = 1.0,
    left_out: bool = True,
    scales: Mapping[str, float] = STRUCTURE,
) -> StructureFit:
    """Return the most probable errors of a chain's structure, given rows.

    The errors have independent normal priors about zero, whose standard deviations are in
    `natural_scales`. A row has the noise of its tip, and the noise of the actuators times dx/dq.

    Parameters
    ----------
    chain : ForwardModel
        The calibrated chain.
    rows : Rows
        Different rows; tips are NaN for missing markers, whose residual is zero.
    factor : float, default=1.0
        Common factor of all standard deviations of the prior.
    left_out : bool, default=True
        Whether residuals of held-out rows, or groups, are computed; else they are NaN. They are
        exact for the linearised problem.
    scales : mapping of str to float
        Standard deviations by block; a block of 0 is left out.

    Returns
    -------
    StructureFit
        The chain with its errors.

    References
    ----------
    MacKay, Bayesian interpolation, Neural Computation 4 (1992), for the posterior; Hastie,
    Tibshirani & Friedman, The Elements of Statistical Learning (2009), section 7.10, for held-out
    residuals of linear fits.
    """
    with torch.no_grad():
        design = StructureDesign(chain, rows.q, factor, scales)
        try:
            problem = _StructureProblem(design, rows)
            theta, rest, A = problem.minimum()
        except torch.linalg.LinAlgError as error:  # pyright: ignore
            raise too_far() from error
        flat = A.flatten(0, 1)
        system = flat.mT @ flat + identity(len(theta), A)
        covariance = torch.cholesky_inverse(torch.linalg.cholesky(system))
        residual = torch.full_like(rest, torch.nan)
        if left_out:
            residual = problem.in_metres(_left_out(A, rest, theta, covariance, system, rows.groups))
        model = design.model(theta)
    weights = rows.counts * points(problem.seen.numpy())[..., 0].sum(1)
    squares = residual.square().sum(1).numpy()
    in_metres = (problem.noise @ A).flatten(0, 1)
    spread = (in_metres.mT @ in_metres).numpy() / weights.sum()
    return StructureFit(
        model,
        design.names,
        theta.numpy(),
        covariance.numpy(),
        factor,
        rows.as_given(residual.numpy()),
        float(np.sqrt((rows.counts * squares).sum() / weights.sum())),
        design.units(scales).numpy(),
        spread,
        len(rows),
    )


def _left_out(
    A: Tensor,
    rest: Tensor,
    theta: Tensor,
    covariance: Tensor,
    system: Tensor,
    groups: Groups,
) -> Tensor:
    """Return the residuals (N, m) of every row from a linearised fit without it, or its group."""
    if not groups.whole:
        leverage = A @ covariance @ A.mT
        unexplained = identity(leverage.shape[1], leverage) - leverage
        return torch.linalg.solve(unexplained, rest)
    targets = rest + A @ theta
    moment = A.flatten(0, 1).mT @ targets.flatten()
    left = torch.empty_like(rest)
    for members in groups.members:
        own = A[members].flatten(0, 1)
        without = torch.linalg.cholesky(system - own.mT @ own)
        right = moment - own.mT @ targets[members].flatten()
        theta_without = torch.cholesky_solve(right[:, None], without)[:, 0]
        left[members] = targets[members] - A[members] @ theta_without
    return left
