"""The readout of a `SerialModule` from data: its optimum, its penalties, its errors left out."""

from __future__ import annotations

import copy
from functools import partial
from math import inf, nan
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hybridkin._core.model import forward_and_jacobian
from hybridkin._core.stored import Restore, Stored
from hybridkin.hybrid._features import Features, Readout
from hybridkin.hybrid._linearised import (
    Linearised,
    Pair,
    basis,
    choose,
    members_of,
    moment,
    quasi_newton,
)

_LARGEST = 1000  # weights at most; of wide features the strongest directions are kept
_ROUNDS, _FACTORS, _REFRESH = 200, 4, 10  # of descent; the first, and every tenth, factorise
_SETTLED = 1e-9  # of the gradient without a correction
_RATIOS = torch.logspace(-2, 4, 25, dtype=torch.float64)  # of noise, over the mean of dx/dq squared


class ReadoutFit(NamedTuple):
    """What `fit_readout` found."""

    readout: Readout
    alphas: Pair  # of the linear and of the other features; infinity: none of them
    residual: NDArray  # (N, m) [m], of every row when it, or its group, was left out
    scores: dict[Pair, float]  # mean squared distance of rows left out [m^2], by alphas
    gradient: float  # of the objective at the optimum, relative to that without a correction
    noise_ratio: float = inf  # variance of tips over that of actuators; infinity: of tips alone

    def stored(self) -> Stored:
        """Return how the fit describes itself; JSON has no infinity, so penalties are strings."""
        return Stored.of(
            "readout_fit",
            {"residual": self.residual},
            {"readout": self.readout.stored()},
            alphas=[*map(str, self.alphas)],
            scores=[[*map(str, alphas), score] for alphas, score in self.scores.items()],
            gradient=self.gradient,
            noise_ratio=str(self.noise_ratio),
        )

    @classmethod
    def from_stored(cls, stored: Stored, restore: Restore) -> ReadoutFit:
        """Return the fit of a description; `restore` returns its readout."""
        first, second = map(float, stored.list_of(str, "alphas"))
        return cls(
            restore(stored.part("readout")),
            (first, second),
            stored.array("residual", (None, None), finite=False),
            {(float(a), float(b)): float(c) for a, b, c in stored.list_of(list, "scores")},
            stored.value("gradient", float),
            float(stored.value("noise_ratio", str)),
        )


class _Found(NamedTuple):
    """A fit before it is dressed up as one."""

    problem: _Problem
    linear: Linearised
    readout: Tensor
    alphas: Pair
    residual: Tensor  # (N, m) [m], left out
    scores: dict[Pair, float]
    gradient: float


def fit_readout(
    mechanical: nn.Module,
    features: Features,
    q: Tensor,
    x: Tensor,
    *,
    place: str = "coordinates",
    sample_weight: Tensor | None = None,
    groups: Any = None,
    alphas: Pair | None = None,
    noise_ratio: float = inf,
) -> ReadoutFit:
    """Return the readout that minimises the error of the tip plus a penalty on its weights.

    The objective sum_n w_n |x_n - f(z_n + D W phi_n)|^2 + alpha_1 |W_lin|^2 + alpha_2 |W_bent|^2 is
    brought to its exact minimum by damped Gauss-Newton rounds, carried on by quasi-Newton ones.
    D scales the coordinates, lengths and bendings, such that one unit of each moves the tip by 1 m
    (rms over the rows): a penalty is the variance of the noise over that of a weight.

    Noise of the actuators moves the tip by dx/dq: far in some directions, little in others, and
    otherwise in every posture. Where the residuals of rows left out look like that, |.| is measured
    in units of such noise (generalised least squares), if that lowers their mean distance.

    Parameters
    ----------
    mechanical : nn.Module
        Maps q to x.
    features : Features
        phi; what its linear features explain of the others is taken off those.
    q : Tensor of shape (N, n)
        Actuator vectors.
    x : Tensor of shape (N, m)
        Measured tips [m].
    place : {"coordinates", "tip"}, default="coordinates"
        Where the correction acts, see `SerialModule`.
    sample_weight : Tensor of shape (N,), optional
        How many times each row counts; residuals of rows that do not count are NaN.
    groups : array-like of shape (N,), optional
        Motion of every row: what is left out together. Default: single rows.
    alphas : tuple of two floats, optional
        The penalties; infinity: without these features. Default: those with the least error on
        rows left out, which the linearised problem gives exactly without fitting again.
    noise_ratio : float, default=inf
        With `alphas`: the variance of a tip's coordinate over that of an actuator, without the
        noise of this one [m^2 over the squared unit of q]. Infinity: the actuators are exact.

    Returns
    -------
    ReadoutFit
        The model, and how it was found.
    """
    q, x = q.detach().double(), x.detach().double()
    weight = torch.ones_like(q[:, 0]) if sample_weight is None else sample_weight.to(q)
    kept = weight > 0
    members = None if groups is None else members_of(np.asarray(groups)[kept.cpu().numpy()])
    with torch.no_grad():
        problem = _Problem(mechanical, features, q[kept], x[kept], weight[kept], place)
        if alphas is not None:
            found = _fitted(problem.in_noise(noise_ratio), members, alphas)
        else:
            found = _chosen(problem, members)
            noise_ratio = problem.likeliest_ratio(found.residual)
            if noise_ratio < inf:
                other = _chosen(problem.in_noise(noise_ratio), members, found.alphas)
                if problem.mean_distance(other.residual) < problem.mean_distance(found.residual):
                    found = other
        residual = x.new_full(x.shape, nan)
        residual[kept] = found.residual
        penalty = found.problem.penalty(found.alphas)
        spread = found.linear.posterior(penalty, x.shape[1] * float(weight.sum()))
        module = found.problem.module(found.readout, *spread)
    return ReadoutFit(
        *(module, found.alphas, residual.cpu().numpy(), found.scores, found.gradient),
        found.problem.noise_ratio,
    )


def _chosen(problem: _Problem, members: Any, start: Pair | None = None) -> _Found:
    """Return the fit with the penalties that err least on rows left out."""
    readout, alphas, scores = problem.nothing, start, {}
    for _ in range(2):
        # Linearised without a correction first, then where that has led.
        alphas, scores = choose(
            partial(problem.score, problem.linearised(readout), members), alphas
        )
        readout, _ = problem.minimum(readout, problem.penalty(alphas), _FACTORS)
    assert alphas is not None
    found = _fitted(problem, members, alphas, readout)._replace(scores=scores)
    if problem.mean_square(found.residual) > problem.mean_square(problem.rest):
        # The linearised problem promised what the robot does not keep.
        return _fitted(problem, members, (inf, inf))._replace(scores=scores)
    return found


def _fitted(problem: _Problem, members: Any, alphas: Pair, readout: Tensor | None = None) -> _Found:
    """Return the fit with given penalties, from a readout to start at."""
    penalty = problem.penalty(alphas)
    start = problem.nothing if readout is None else readout
    readout, gradient = problem.minimum(start, penalty)
    linear = problem.linearised(readout)
    residual = problem.in_metres(linear.left_out(penalty, members))
    return _Found(problem, linear, readout, alphas, residual, {}, gradient)


class _Problem:
    """The rows of a fit, in scaled coordinates and in a basis of the features without idle ones."""

    def __init__(
        self,
        mechanical: nn.Module,
        features: Features,
        q: Tensor,
        x: Tensor,
        weight: Tensor,
        place: str,
    ) -> None:
        self.mechanical, self.features, self.place = mechanical, features, place
        self.q, self.x, self.root = q, x, weight.sqrt()[:, None]
        self.noise_ratio, self.whitening = inf, None
        self.z = coordinates(mechanical, q, place)[0]
        tips, J = tip_and_columns(mechanical, self.z, place)
        self.rest = x - tips
        J = self.root[:, None] * J
        moved = (J.square().sum((0, 1)) / weight.sum()).sqrt()
        moves = moved > 1e-9 * moved.max()
        self.units = torch.where(moves, 1.0 / torch.where(moves, moved, 1.0), 0.0)
        phi = features(q)
        most = max(_LARGEST // len(self.units) - features.n_linear, 0)
        self.basis = basis(self.root * phi, features.n_linear, most)
        self.phi = phi @ self.basis
        self.nothing = phi.new_zeros(len(self.units), self.phi.shape[1])

    def in_noise(self, ratio: float) -> _Problem:
        """Return the problem for noise of covariance dx/dq dx/dq' + ratio, but for a factor."""
        if ratio == inf:
            return self
        problem = copy.copy(self)
        spread, axes = self._principal_noise()
        variance = spread + ratio
        # The mean square of whitened residuals is that of residuals in metres, were they all noise.
        weights = self.root.square()
        variance /= (weights * variance).sum() / (weights.sum() * variance.shape[1])
        problem.noise_ratio = ratio
        problem.whitening = axes @ (variance.rsqrt()[..., None] * axes.mT)
        return problem

    def likeliest_ratio(self, residual: Tensor) -> float:
        """Return the ratio that makes residuals (N, m) [m] likeliest as normal noise."""
        spread, axes = self._principal_noise()
        squares = (axes.mT @ residual[..., None])[..., 0].square()
        weights = self.root.square().expand_as(squares)
        total, mean = weights.sum(), (weights * spread).sum() / weights.sum()

        def unlikely(ratio: float) -> float:
            variance = spread + ratio if ratio < inf else torch.ones_like(spread)
            level = (weights * squares / variance).sum() / total
            return float(level.log() + (weights * variance.log()).sum() / total)

        return min([inf, *(float(mean) * _RATIOS).tolist()], key=unlikely)

    def _principal_noise(self) -> tuple[Tensor, Tensor]:
        """Return variances (N, m) and axes (N, m, m) of what noise of the actuators does to x."""
        J = forward_and_jacobian(self.mechanical, self.q)[1]
        spread, axes = torch.linalg.eigh(J @ J.mT)
        return spread.clamp(min=0.0), axes

    def in_metres(self, residual: Tensor) -> Tensor:
        """Return weighted and whitened residuals (N, m) as they were [m]."""
        if self.whitening is not None:
            residual = torch.linalg.solve(self.whitening, residual)
        return residual / self.root

    def mean_distance(self, residual: Tensor) -> float:
        """Return the mean of the distances (N, m) [m] of the rows as often as they count."""
        return float((self.root[:, 0].square() @ residual.norm(dim=1)) / self.root.square().sum())

    def mean_square(self, residual: Tensor) -> float:
        """Return the same of their squares [m^2]."""
        return float((self.root * residual).square().sum() / self.root.square().sum())

    def penalty(self, alphas: Pair) -> Tensor:
        """Return the penalty of every feature (K,)."""
        n = self.features.n_linear
        return torch.tensor([alphas[0]] * n + [alphas[1]] * (self.phi.shape[1] - n)).to(self.phi)

    def linearised(self, readout: Tensor) -> Linearised:
        """Return the ridge problem about a readout (C, K)."""
        J, rest = self._about(readout)
        return Linearised(J, self.phi, rest + (J @ (self.phi @ readout.mT)[..., None])[..., 0])

    def score(self, linear: Linearised, members: list[Tensor] | None, alphas: Pair) -> float:
        """Return the mean squared distance of rows left out [m^2]."""
        left = linear.left_out(self.penalty(alphas), members)
        return float(left.square().sum() / self.root.square().sum())

    def minimum(
        self, readout: Tensor, penalty: Tensor, rounds: int = _ROUNDS
    ) -> tuple[Tensor, float]:
        """Return the best readout, from one to start at, and the relative gradient left there.

        The first steps solve a Gauss-Newton system each. The later ones keep the last of these and
        correct it by how the gradient has changed (L-BFGS): they cost no factorisation.
        """
        taking_part = torch.isfinite(penalty)
        readout = torch.where(taking_part, readout, 0.0)
        weight = torch.where(taking_part, penalty, 0.0)
        value, slope = self._value_and_slope(readout, weight, taking_part)
        scale = float(self._value_and_slope(self.nothing, weight, taking_part)[1].norm()) or 1.0
        pairs: list[tuple[Tensor, Tensor]] = []
        factor: tuple[Tensor, Tensor] | None = None
        for k in range(rounds):
            if float(slope.norm()) <= _SETTLED * scale:
                break
            if factor is None or k < _FACTORS or k % _REFRESH == 0:
                factor, pairs = self.linearised(readout).factor(penalty), []
            step = -quasi_newton(slope, pairs, factor)
            share, descent = 1.0, float((slope * step).sum())
            while share > 1e-6:  # a full step may overshoot where the tip curves away
                tried = readout + share * step
                new, new_slope = self._value_and_slope(tried, weight, taking_part)
                if new <= (1.0 + 1e-14) * value + 1e-4 * share * descent:
                    break
                share *= 0.5
            else:
                break
            change = tried - readout, new_slope - slope
            if float((change[0] * change[1]).sum()) > 0.0:
                pairs = [*pairs[-20:], change]
            readout, value, slope = tried, new, new_slope
        return readout, float(slope.norm()) / scale

    def module(self, readout: Tensor, factor: Tensor, noise_variance: Tensor) -> SerialModule:
        """Return the model of the features themselves, in the units of the coordinates."""
        factor = torch.einsum("c,pk,ckr->cpr", self.units, self.basis, factor).flatten(0, 1)
        return SerialModule(
            self.mechanical,
            self.features,
            self.units[:, None] * (readout @ self.basis.mT),
            place=self.place,
            factor=factor,
            noise_variance=noise_variance,
        )

    def _about(self, readout: Tensor) -> tuple[Tensor, Tensor]:
        """Return the Jacobians (N, m, C) by the scaled coordinates, and the residuals (N, m)."""
        z = self.z + self.units * (self.phi @ readout.mT)
        tip, J = tip_and_columns(self.mechanical, z, self.place)
        J, rest = self.root[:, None] * J * self.units, self.root * (self.x - tip)
        if self.whitening is None:
            return J, rest
        return self.whitening @ J, (self.whitening @ rest[..., None])[..., 0]

    def _value_and_slope(
        self, readout: Tensor, weight: Tensor, taking_part: Tensor
    ) -> tuple[float, Tensor]:
        """Return the objective and half its gradient (C, K)."""
        J, rest = self._about(readout)
        slope = torch.where(taking_part, weight * readout - moment(J, rest, self.phi), 0.0)
        return float(rest.square().sum() + (weight * readout.square()).sum()), slope
