"""The readout W phi(q) from data: its optimum, its penalties and its held-out residuals."""

from __future__ import annotations

import copy
from functools import cached_property, partial
from math import inf, nan
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.arrays import identity
from hybridkin._core.groups import Groups
from hybridkin._core.model import ForwardModel
from hybridkin.calibration.measured import evenly_spaced_of, points
from hybridkin.hybrid import _linearised
from hybridkin.hybrid._features import Features, Readout
from hybridkin.hybrid._linearised import Linearised, Pair
from hybridkin.hybrid._rows import Rows

_ENOUGH = 1000  # rows to choose penalties
_LARGEST = 1000  # most weights; of more features only the strongest directions are kept
# Steps; the first ones, far from the optimum, and every tenth factorise.
_ROUNDS, _FACTORS, _REFRESH = (
    200,
    4,
    10,
)
# Gradients, relative to that without a correction.
_FAR = 0.01
_SETTLED = 1e-9
# Noise ratios, over the mean of dx/dq squared.
_RATIOS = torch.from_numpy(np.logspace(-2, 4, 25))


class ReadoutFit(NamedTuple):
    """A fitted readout, with its penalties and held-out residuals."""

    readout: Readout
    alphas: Pair  # of the linear and of the other features; infinity: features not used
    residual: NDArray  # (N, m) [m], of every row from a fit without that row, or its group
    scores: dict[Pair, float]  # mean squared held-out distance [m^2], by alphas
    gradient: float  # of the objective at the optimum, relative to that without a correction
    noise_ratio: float = inf  # variance of tips over that of actuators; infinity: tips only
    rmse: float = nan  # weighted root mean square length of `residual` [m]


def _at_tip(z: Tensor) -> tuple[Tensor, Tensor]:
    """Return the result of `tips_of` if the inner coordinates are the tip."""
    return z, identity(z.shape[1], z).expand(len(z), -1, -1)


def fit_readout(
    mechanical: ForwardModel,
    features: Features,
    rows: Rows,
    coupling: str = "serial",
    alphas: Pair | None = None,
    noise_ratio: float = inf,
    left_out: bool = True,
    near: bool = False,
    start: Readout | None = None,
    exact: bool = True,
) -> ReadoutFit:
    """Return the readout that minimises the tip error plus a penalty on its weights.

    The objective sum_n w_n |x_n - F(z_n + D W phi_n)|^2 + alpha_1 |W_lin|^2 + alpha_2 |W_bent|^2 is
    minimised by damped Gauss-Newton and then by quasi-Newton steps. D scales the
    coordinates so that one unit of each moves the tip by 1 m (rms over the rows). A penalty is
    therefore the variance of the noise over that of a weight.

    Noise of the actuators moves the tip by dx/dq, which depends on the direction and on the
    posture. If the held-out residuals have such a distribution, |.| is measured in units of this
    noise (generalised least squares), provided that this lowers the mean held-out distance.

    Parameters
    ----------
    mechanical : ForwardModel
        f, with inner coordinates z and F(z(q)) = f(q).
    features : Features
        phi; the part of its other features that the linear ones explain is subtracted.
    rows : Rows
        Different rows; tips are NaN for missing markers, whose residual is zero. Whole groups are
        held out, without groups single rows. The residual of a given row of weight 0 is NaN.
    coupling : {"serial", "parallel"}, default="serial"
        Whether W phi(q) is added to the inner coordinates, or to the tip.
    alphas : tuple of two floats, optional
        The penalties; infinity: without these features. Default: those with the least held-out
        error, which the linearised problem gives exactly without another fit.
    noise_ratio : float, default=inf
        With `alphas`: the variance of a tip coordinate, without actuator noise, over that of an
        actuator [m^2 over the squared unit of q]. Infinity: the actuators are exact.
    left_out : bool, default=True
        With `alphas`: whether the held-out residuals are computed; else they are NaN.
    near : bool, default=False
        With `alphas`: whether the penalties are chosen anew, in a search that starts there.
    start : Readout, optional
        With `alphas`: the readout of a fit to other rows, from which the fit starts.
    exact : bool, default=True
        Whether the search goes on to the minimum. Else it ends where a step promises to lower the
        objective by less than the noise of one coordinate of one row, and of many rows a thousand
        choose the penalties.

    Returns
    -------
    ReadoutFit
        The readout with its penalties and held-out residuals.
    """
    if alphas is None and not exact and len(rows) > _ENOUGH:
        few = rows.take(evenly_spaced_of(rows.groups, _ENOUGH))
        if len(few) <= _ENOUGH:
            chosen = fit_readout(mechanical, features, few, coupling, exact=False)
            alphas = chosen.alphas
            noise_ratio = chosen.noise_ratio
            start = chosen.readout
    x = torch.from_numpy(rows.tips.astype(np.float64))
    weight = torch.from_numpy(rows.counts.astype(np.float64))
    with torch.no_grad():
        problem = _ReadoutProblem(
            mechanical, features, rows.q, x, weight, rows.groups, coupling == "serial", exact
        )
        if alphas is None:
            fit = _chosen_with_noise(problem)
        else:
            weights = problem.weights_of(start)
            problem_in_noise = problem.in_noise(noise_ratio)
            if near:
                fit = _chosen(problem_in_noise, alphas, weights, rounds=1)
            else:
                fit = _fit_with_penalties(problem_in_noise, alphas, weights, left_out)
    rmse = problem.mean_distance(fit.residual, 2) ** 0.5
    return fit._replace(residual=rows.as_given(fit.residual), rmse=rmse)


def _chosen_with_noise(problem: _ReadoutProblem) -> ReadoutFit:
    """Return the fit with chosen penalties, in metres or in units of the actuators' noise."""
    fit = _chosen(problem, None, problem.nothing)
    noise_ratio = problem.likeliest_ratio(torch.from_numpy(fit.residual))
    if noise_ratio == inf:
        return fit
    in_noise = _chosen(problem.in_noise(noise_ratio), fit.alphas, problem.nothing)
    if problem.mean_distance(in_noise.residual) < problem.mean_distance(fit.residual):
        return in_noise
    return fit


def _chosen(
    problem: _ReadoutProblem,
    alphas: Pair | None,
    weights: Tensor,
    rounds: int = 2,
) -> ReadoutFit:
    """Return the fit with the penalties of least held-out error, from a start of the search."""
    scores = {}
    for _ in range(rounds):
        # Linearised first about the start, then about the correction found.
        score = partial(problem.score, problem.linearised(weights))
        alphas, scores = _linearised.choose(score, alphas)
        weights, _ = problem.minimum(weights, problem.penalty(alphas), _FACTORS)
    assert alphas is not None
    fit = _fit_with_penalties(problem, alphas, weights)._replace(scores=scores)
    without = problem.mean_distance(problem.rest.numpy(force=True), 2)
    if problem.mean_distance(fit.residual, 2) > without:
        # The improvement of the linearised problem is not there in the exact one.
        nothing = _fit_with_penalties(problem, (inf, inf), problem.nothing)
        return nothing._replace(scores=scores)
    return fit


def _fit_with_penalties(
    problem: _ReadoutProblem, alphas: Pair, weights: Tensor, held_out: bool = True
) -> ReadoutFit:
    """Return the fit with given penalties, from a start; its residuals are those of held-out rows.

    Without `held_out` they are NaN.
    """
    penalty = problem.penalty(alphas)
    weights, gradient = problem.minimum(weights, penalty)
    left_out = problem.x * nan
    if held_out:
        left_out = problem.left_out(problem.linearised(weights), penalty)
    readout = problem.readout(weights)
    ratio = problem.noise_ratio
    return ReadoutFit(readout, alphas, left_out.numpy(force=True), {}, gradient, ratio)


class _ReadoutProblem:
    """The rows of a fit, in scaled coordinates and a basis of the features with data."""

    def __init__(
        self,
        mechanical: ForwardModel,
        features: Features,
        q: Tensor,
        x: Tensor,
        weight: Tensor,
        groups: Groups,
        serial: bool,
        exact: bool = True,
    ) -> None:
        self.mechanical = mechanical
        self.features = features
        self.q = q
        self.x = x
        self.groups = groups
        self.root = weight.sqrt()[:, None]
        self.noise_ratio = inf
        self.whitening = None
        self._last = None
        self._tips = mechanical.tips_by_coordinates() if serial else _at_tip
        self.z = mechanical.coordinates(q)[0] if serial else mechanical(q)
        self.seen = ~x.isnan()
        # Part of the objective that a step must promise to gain.
        self.least_gain = 0.0 if exact else 1.0 / int(self.seen.sum())
        self.rest, J = self._rest(self.z)
        J = self.root[:, None] * J
        moved = (J.square().sum((0, 1)) / weight.sum()).sqrt()
        moves = moved > 1e-9 * moved.max()
        self.units = torch.where(moves, 1.0 / torch.where(moves, moved, 1.0), 0.0)
        phi = features(q)
        most = max(_LARGEST // len(self.units) - features.n_linear, 0)
        self.basis = _linearised.basis(self.root * phi, features.n_linear, most)
        self.phi = phi @ self.basis
        self.products = _linearised.Products(self.phi)
        self.nothing = phi.new_zeros(len(self.units), self.phi.shape[1])

    def in_noise(self, ratio: float) -> _ReadoutProblem:
        """Return the problem for noise of covariance dx/dq dx/dq' + ratio, up to a factor."""
        if ratio == inf:
            return self
        problem = copy.copy(self)
        problem._last = None
        spread, axes = self._principal_noise
        variance = spread + ratio
        # If residuals are only noise, the factor keeps their mean square the same as in metres.
        weights = self.root.square()
        variance /= (weights * variance).sum() / (weights.sum() * variance.shape[1])
        problem.noise_ratio = ratio
        problem.whitening = axes @ (variance.rsqrt()[..., None] * axes.mT)
        return problem

    def likeliest_ratio(self, residual: Tensor) -> float:
        """Return the ratio with the largest likelihood of residuals (N, m) [m] as normal noise."""
        spread, axes = self._principal_noise
        squares = (axes.mT @ residual[..., None])[..., 0].square()
        weights = self.root.square() * self.seen.all(1, keepdim=True) * torch.ones_like(squares)
        total = weights.sum()
        mean = (weights * spread).sum() / weights.sum()

        def unlikely(ratio: float) -> float:
            variance = spread + ratio if ratio < inf else torch.ones_like(spread)
            level = (weights * squares / variance).sum() / total
            return float(level.log() + (weights * variance.log()).sum() / total)

        return min([inf, *(float(mean) * _RATIOS).tolist()], key=unlikely)

    @cached_property
    def _principal_noise(self) -> tuple[Tensor, Tensor]:
        """Return variances (N, m) and axes (N, m, m) of x for unit noise of the actuators."""
        J = self.mechanical.forward_and_jacobian(self.q)[1] * self.seen[..., None]
        spread, axes = torch.linalg.eigh(J @ J.mT)
        return spread.clamp(min=0.0), axes

    def in_metres(self, residual: Tensor) -> Tensor:
        """Return residuals (N, m) [m] from weighted and whitened ones."""
        if self.whitening is not None:
            residual = torch.linalg.solve(self.whitening, residual)
        return residual / self.root

    def mean_distance(self, residual: NDArray, power: int = 1) -> float:
        """Return the weighted mean of the marker lengths of residuals (N, m) to a `power` [m]."""
        weights = self.root.square().numpy() * points(self.seen.numpy())[..., 0]
        far = np.linalg.norm(points(residual), axis=2)
        return float((weights * far**power).sum() / weights.sum())

    def penalty(self, alphas: Pair) -> Tensor:
        """Return the penalty of every feature (K,)."""
        n = self.features.n_linear
        return self.phi.new_tensor([alphas[0]] * n + [alphas[1]] * (self.phi.shape[1] - n))

    def linearised(self, readout: Tensor) -> Linearised:
        """Return the ridge problem linearised about a readout (C, K); the last one is cached."""
        if self._last is None or not torch.equal(self._last[0], readout):
            rest, J = self._about(readout)
            J = self._whitened(J * self.units)
            y = self._whitened(rest) + (J @ (self.phi @ readout.mT)[..., None])[..., 0]
            linear = Linearised(J, self.phi, y, self.products, self.features.n_linear)
            self._last = readout, linear
        return self._last[1]

    def left_out(self, linear: Linearised, penalty: Tensor) -> Tensor:
        """Return the residuals (N, m) of every row from a fit without its group [m]."""
        return self.in_metres(linear.left_out(penalty, self.groups))

    def score(self, linear: Linearised, alphas: Pair) -> float:
        """Return the mean squared held-out distance [m^2]."""
        left = linear.left_out(self.penalty(alphas), self.groups)
        return float(left.square().sum() / self.root.square().sum())

    def minimum(
        self, readout: Tensor, penalty: Tensor, rounds: int = _ROUNDS
    ) -> tuple[Tensor, float]:
        """Return the best readout, from a start `readout`, and its relative gradient.

        Each of the first steps solves a Gauss-Newton system. Later steps reuse the last system and
        correct it by changes of the gradient (L-BFGS), without a factorisation.
        """
        taking_part = torch.isfinite(penalty)
        readout = torch.where(taking_part, readout, 0.0)
        weight = torch.where(taking_part, penalty, 0.0)
        value, slope = self._value_and_slope(readout, weight, taking_part)
        scale = float(self._value_and_slope(self.nothing, weight, taking_part)[1].norm()) or 1.0
        pairs: list[tuple[Tensor, Tensor]] = []
        factor: tuple[Tensor, Tensor] | None = None
        step_size = 1.0
        for k in range(rounds):
            gradient = float(slope.norm()) / scale
            if gradient <= _SETTLED:
                break
            far = k < _FACTORS and gradient > _FAR
            # A shortened step was too far from the system for corrections.
            if factor is None or step_size < 1.0 or far or k % _REFRESH == 0:
                factor = self.linearised(readout).factor(penalty)
                pairs = []
            step = -_linearised.quasi_newton(slope, pairs, factor)
            step_size = 1.0
            descent = float((slope * step).sum())
            if -descent <= self.least_gain * value:
                break
            while step_size > 1e-6:  # a full step may overshoot, as the tip is nonlinear
                tried = readout + step_size * step
                new, new_slope = self._value_and_slope(tried, weight, taking_part)
                if new <= (1.0 + 1e-14) * value + 1e-4 * step_size * descent:
                    break
                step_size *= 0.5
            else:
                break
            change = tried - readout, new_slope - slope
            if float((change[0] * change[1]).sum()) > 0.0:
                pairs = [*pairs[-20:], change]
            readout = tried
            value = new
            slope = new_slope
        return readout, float(slope.norm()) / scale

    def weights_of(self, readout: Readout | None) -> Tensor:
        """Return the weights (C, K) nearest to a readout of other features at the rows."""
        if readout is None or readout.n_outputs != len(self.units):
            return self.nothing
        change = readout(self.q)
        change = torch.where(self.units > 0.0, change / self.units, 0.0)
        return torch.linalg.lstsq(self.phi, change).solution.mT

    def readout(self, weights: Tensor) -> Readout:
        """Return the readout of the original features, in the units of the coordinates."""
        return Readout(self.features, self.units[:, None] * (weights @ self.basis.mT))

    def _about(self, readout: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (N, m) [m] and Jacobians (N, m, C) by the coordinates, at a readout."""
        return self._rest(self.z + self.units * (self.phi @ readout.mT))

    def _rest(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (N, m) [m] and Jacobians (N, m, C) at z, zero for missing markers."""
        tip, J = self._tips(z)
        seen = self.seen
        return torch.where(seen, self.x - tip, 0.0), torch.where(seen[..., None], J, 0.0)

    def _whitened(self, values: Tensor) -> Tensor:
        """Return values (N, m) or (N, m, C) in units of noise, times the roots of the weights."""
        flat = values.reshape(*self.x.shape, -1)
        if self.whitening is not None:
            flat = self.whitening @ flat
        return (self.root[..., None] * flat).view_as(values)

    def _value_and_slope(
        self, readout: Tensor, weight: Tensor, taking_part: Tensor
    ) -> tuple[float, Tensor]:
        """Return the objective and half its gradient (C, K)."""
        rest, J = self._about(readout)
        rest = self._whitened(rest)
        moment = _linearised.moment(J, self._whitened(rest), self.phi)
        slope = weight * readout - self.units[:, None] * moment
        slope = torch.where(taking_part, slope, 0.0)
        return float(rest.square().sum() + (weight * readout.square()).sum()), slope
