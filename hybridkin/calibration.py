"""Geometry of a kinematic chain from measured tips, with standard errors and identifiability."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.optimize import least_squares
from sklearn.model_selection import GroupKFold
from torch import Tensor

from hybridkin._numerics import stumpff

__all__ = ["CalibrationResult", "calibrate"]

_RELATIVE = ("radii", "lengths")
_PARAMETERS = ("radii", "angles", "lengths", "offsets", "tool", "base")
_LOSSES = ("linear", "soft_l1", "huber", "cauchy", "arctan")
_MAX_ROUNDS = 12
_WIDEST = 1e6  # a prior of a million natural units is none, and stays finite
_KNOWN = (
    0.1  # k parameters that share one unknown direction narrow to 1 / sqrt(k) by the prior alone
)


@dataclass(frozen=True, repr=False)
class CalibrationResult:
    """Calibrated chain and what the data say about its geometry.

    Attributes
    ----------
    chain
        Copy of the given chain with the calibrated geometry.
    values : dict of str to array
        The calibrated geometry by parameter name, in the chain's shapes and units: "radii" (S,)
        [m], "lengths" (S,) [m], "angles" (n,) [rad], "offsets" (S,) [m], "tool" () [m], "base"
        (4, 4).
    std_errors : dict of str to array
        One standard error for each entry of `values`; for "base" shape (6,), three of rotation
        [rad] and three of translation [m], in the measuring frame.
    correlations : ndarray of shape (P, P)
        Correlation of the P free parameters, ordered as `names`.
    names : tuple of P str
        Free parameters, as "radii[0]" or "base[rot x]".
    identifiable : dict of str to bool array
        False where the data narrow the prior less than tenfold: that value is an assumption.
    rmse : float
        Root mean square tip distance on the given data [m].
    cv_rmse : float or None
        The same on groups held out (at most 5 folds), when `groups` was given [m].
    converged : bool
        Whether the solver met its tolerance.
    """

    chain: Any
    values: dict[str, Any]
    std_errors: dict[str, Any]
    correlations: np.ndarray
    names: tuple[str, ...]
    identifiable: dict[str, np.ndarray]
    rmse: float
    cv_rmse: float | None
    converged: bool

    def __repr__(self) -> str:
        lines = [f"CalibrationResult(rmse={self.rmse:.3e} m, converged={self.converged})"]
        for name, value in self.values.items():
            known = np.asarray(self.identifiable[name]).all()
            lines.append(f"  {name}: {_shown(value)}")
            lines.append(f"    std. error {_shown(self.std_errors[name])}")
            if not known:
                lines.append("    not all identified by these data: the prior decides there")
        return "\n".join(lines)


def _shown(value: Any) -> str:
    array = np.asarray(value)
    rows = array[:3].reshape(3, 4) if array.shape == (4, 4) else np.atleast_2d(array)
    return "; ".join(" ".join(f"{entry:.4g}" for entry in row) for row in rows)


def calibrate(
    chain: Any,
    q: Any,
    x: Any,
    parameters: Sequence[str] = ("radii", "base"),
    *,
    loss: str = "linear",
    bounds: Mapping[str, tuple[float, float]] | None = None,
    prior: float | Mapping[str, float] = 0.5,
    groups: Any = None,
    sample_weight: Any = None,
) -> CalibrationResult:
    """Return the chain whose geometry explains measured tips best.

    Nonlinear least squares on the tip distance with exact derivatives. Radii and lengths are
    fitted by their logarithm and so stay positive. A weak prior keeps every parameter near its
    start where the data say nothing; its weight against the data follows the noise level, which
    is estimated from the residuals, so exact data override it.

    Parameters
    ----------
    chain : ConstantCurvatureChain
        Start of the search; it is not changed.
    q : array or Tensor of shape (N, n_actuators)
        Actuator vectors [m].
    x : array or Tensor of shape (N, 3)
        Measured tip positions [m].
    parameters : sequence of str, default=("radii", "base")
        Among "radii", "angles" (one turn of each segment's actuators), "lengths" (tendon chains),
        "offsets", "tool" (the last offset), "base" (pose).
    loss : {"linear", "soft_l1", "huber", "cauchy", "arctan"}, default="linear"
        All but "linear" bound the influence of outliers.
    bounds : dict of str to (low, high), optional
        Limits of "radii", "lengths", "offsets", "tool" [m] or of the turn in "angles" [rad].
    prior : float or dict of str to float, default=0.5
        Standard deviation of the weak prior in natural units: a fraction of radii and lengths, of
        the robot's length for "offsets", "tool" and the base position, radians for angles and the
        base orientation. ``inf`` turns it off.
    groups : array-like of shape (N,), optional
        Motion of every row; asks for `cv_rmse` on motions held out.
    sample_weight : array-like of shape (N,), optional
        How many times each row counts; rows of weight zero are left out.

    Returns
    -------
    CalibrationResult
        ``.chain`` is the calibrated chain.

    Raises
    ------
    ValueError
        For unknown parameters, wrong shapes, or data that are not finite.

    References
    ----------
    Reinhart & Steil (2016), section 2.1 (radii fitted to recorded movements).

    Examples
    --------
    >>> import torch
    >>> from hybridkin import ConstantCurvatureChain, calibrate
    >>> q = 0.25 + 0.05 * torch.rand(50, 6, generator=torch.manual_seed(0), dtype=torch.float64)
    >>> truth = ConstantCurvatureChain([0.05, 0.04])
    >>> result = calibrate(ConstantCurvatureChain([0.06, 0.06]), q, truth(q), ("radii",))
    >>> result.values["radii"]
    tensor([0.0500, 0.0400], dtype=torch.float64)
    """
    names = _check_parameters(chain, parameters, bounds, prior)
    if loss not in _LOSSES:
        raise ValueError(f"`loss` must be one of {_LOSSES}, got {loss!r}.")
    torch_given = isinstance(q, Tensor)
    q, x = _check_data(chain, q, x)
    if groups is not None:
        groups = np.asarray(groups)
        if groups.shape != (len(q),):
            raise ValueError(f"`groups` must have shape ({len(q)},), got {groups.shape}.")
    weights = _check_weights(sample_weight, q)
    kept = weights > 0
    rows = _Rows(q[kept], x[kept], weights[kept])
    starts = [chain]
    if "base" in names:
        starts.append(_aligned(chain, rows))
    fits = [_fit(start, rows, names, loss, bounds or {}, prior) for start in starts]
    best = min(fits, key=lambda fit: fit.rmse)
    cv_rmse = None
    if groups is not None:
        cv_rmse = _cross_validate(best.problem, rows, groups[kept.numpy()], loss)
    return _result(best, cv_rmse, torch_given)


class _Rows(NamedTuple):
    q: Tensor
    x: Tensor
    weight: Tensor

    def residual(self, chain: Any) -> Tensor:
        """Return the weighted coordinate errors (3 N,), whose squares add up to the loss."""
        return ((chain(self.q) - self.x) * self.weight.sqrt()[:, None]).reshape(-1)

    def rmse(self, residual: np.ndarray) -> float:
        return float(np.sqrt((residual**2).sum() / float(self.weight.sum())))

    def noise(self, residual: np.ndarray, robust: bool) -> float:
        """Return the standard deviation of one coordinate, from the median where robust."""
        weight = np.repeat(self.weight.numpy(), 3)
        if not robust:
            return float(np.sqrt((residual**2).sum() / weight.sum()))
        size = np.abs(residual) / np.sqrt(weight)
        order = np.argsort(size)
        middle = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
        return 1.4826 * float(size[order][middle])


@dataclass(frozen=True)
class _Problem:
    """The free parameters theta of a chain, all of natural size one, zero at the start."""

    chain: Any
    names: tuple[str, ...]
    prior_std: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def moved(self, theta: Tensor) -> Any:
        geometry = self.chain.geometry()
        reach = _reach(self.chain)
        moved: dict[str, Tensor] = {}
        parts = theta.split([_size(self.chain, name) for name in self.names])
        for name, part in zip(self.names, parts, strict=True):
            if name in _RELATIVE:
                moved[name] = geometry[name] * torch.exp(part)
            elif name == "angles":
                counts = torch.tensor(self.chain.actuators_per_segment, device=part.device)
                total = sum(self.chain.actuators_per_segment)
                turn = part.repeat_interleave(counts, output_size=total)
                moved[name] = geometry[name] + turn
            elif name == "offsets":
                moved[name] = geometry[name] + reach * part
            elif name == "tool":
                offsets = geometry["offsets"]
                moved["offsets"] = torch.cat([offsets[:-1], offsets[-1:] + reach * part])
            else:
                moved[name] = _moved_base(geometry["base"], part, reach)
        return self.chain.with_geometry(**moved)


@dataclass(frozen=True)
class _Fit:
    problem: _Problem
    theta: np.ndarray
    covariance: np.ndarray
    rmse: float
    converged: bool


def _fit(
    chain: Any,
    rows: _Rows,
    names: tuple[str, ...],
    loss: str,
    bounds: Mapping[str, tuple[float, float]],
    prior: float | Mapping[str, float],
) -> _Fit:
    low, high, stds = [], [], []
    for name in names:
        size = _size(chain, name)
        lo, hi = _theta_bounds(chain, name, bounds.get(name))
        low.append(lo)
        high.append(hi)
        std = prior.get(name, 0.5) if isinstance(prior, Mapping) else prior
        stds.append(np.full(size, min(float(std), _WIDEST)))
    problem = _Problem(
        chain, names, np.concatenate(stds), np.concatenate(low), np.concatenate(high)
    )
    theta = np.clip(np.zeros(problem.prior_std.size), problem.low, problem.high)
    return _solve(problem, rows, theta, loss)


def _solve(problem: _Problem, rows: _Rows, theta: np.ndarray, loss: str) -> _Fit:
    """Alternate least squares and the noise level that weighs the prior against the data."""

    def residual(theta: np.ndarray) -> np.ndarray:
        return rows.residual(problem.moved(torch.as_tensor(theta).to(rows.q))).detach().numpy()

    derivative = torch.func.jacfwd(lambda t: rows.residual(problem.moved(t)))

    def jacobian(theta: np.ndarray) -> np.ndarray:
        return derivative(torch.as_tensor(theta).to(rows.q)).detach().numpy()

    floor = 1e-12 * float(_reach(problem.chain))
    robust = loss != "linear"
    sigma = max(rows.noise(residual(theta), robust), floor)
    converged = False
    for _ in range(_MAX_ROUNDS):

        def whitened(theta: np.ndarray, sigma: float = sigma) -> np.ndarray:
            return np.concatenate([residual(theta) / sigma, theta / problem.prior_std])

        def whitened_jacobian(theta: np.ndarray, sigma: float = sigma) -> np.ndarray:
            return np.vstack([jacobian(theta) / sigma, np.diag(1.0 / problem.prior_std)])

        solution = least_squares(
            whitened,
            theta,
            jac=whitened_jacobian,  # pyright: ignore[reportArgumentType]
            bounds=(problem.low, problem.high),
            loss=loss,
            ftol=1e-12,
            xtol=1e-12,
            gtol=1e-12,
            max_nfev=100,
        )
        theta, converged = solution.x, solution.status > 0
        previous, sigma = sigma, max(rows.noise(residual(theta), robust), floor)
        if abs(sigma - previous) <= 0.02 * previous:
            break
    J = jacobian(theta)
    errors = residual(theta)
    freedom = max(3.0 * float(rows.weight.sum()) - theta.size, 1.0)
    variance = max(sigma**2 if robust else errors @ errors / freedom, floor**2)
    # By singular values in units of the prior: squares would lose what the data leave open.
    _, told, directions = np.linalg.svd(
        J * (problem.prior_std / np.sqrt(variance)), full_matrices=len(J) < theta.size
    )
    told = np.pad(told, (0, theta.size - told.size))
    factor = problem.prior_std[:, None] * directions.T / np.sqrt(told**2 + 1.0)
    covariance = factor @ factor.T
    return _Fit(problem, theta, covariance, rows.rmse(errors), bool(converged))


def _result(fit: _Fit, cv_rmse: float | None, torch_given: bool) -> CalibrationResult:
    problem = fit.problem
    with torch.no_grad():
        chain = problem.moved(torch.as_tensor(fit.theta).to(problem.chain.geometry()["base"]))
    std = np.sqrt(np.diag(fit.covariance))
    safe = np.where(std > 0, std, 1.0)
    known = std < _KNOWN * problem.prior_std
    geometry = {name: value.detach() for name, value in chain.geometry().items()}
    geometry["tool"] = geometry["offsets"][-1]
    reach = float(_reach(problem.chain))
    values, std_errors, identifiable, labels = {}, {}, {}, []
    start = 0
    for name in problem.names:
        size = _size(problem.chain, name)
        part = slice(start, start + size)
        start += size
        error, flag = std[part], known[part]
        if name in _RELATIVE:
            error = error * geometry[name].numpy()
        elif name == "angles":
            counts = problem.chain.actuators_per_segment
            error, flag = np.repeat(error, counts), np.repeat(flag, counts)
        elif name == "base":
            error = error * np.array([1.0, 1.0, 1.0, reach, reach, reach])
        else:
            error = error * reach
        if name == "tool":
            error, flag = error[0], flag[0]
        entries = ("rot x", "rot y", "rot z", "x", "y", "z") if name == "base" else range(size)
        labels += [f"{name}[{entry}]" for entry in entries]
        values[name] = geometry[name] if torch_given else geometry[name].numpy()
        std_errors[name] = torch.as_tensor(error) if torch_given else np.asarray(error)
        identifiable[name] = np.asarray(flag)
    return CalibrationResult(
        chain=chain,
        values=values,
        std_errors=std_errors,
        correlations=fit.covariance / np.outer(safe, safe),
        names=tuple(labels),
        identifiable=identifiable,
        rmse=fit.rmse,
        cv_rmse=cv_rmse,
        converged=fit.converged,
    )


def _cross_validate(problem: _Problem, rows: _Rows, groups: np.ndarray, loss: str) -> float:
    folds = min(5, len(np.unique(groups)))
    if folds < 2:
        raise ValueError("`groups` must name at least 2 motions to hold one out, got 1.")
    residuals = []
    start = np.clip(np.zeros(problem.prior_std.size), problem.low, problem.high)
    for train, test in GroupKFold(folds).split(rows.q, groups=groups):
        fit = _solve(problem, _Rows(*(part[train] for part in rows)), start, loss)
        held_out = _Rows(*(part[test] for part in rows))
        residuals.append(held_out.residual(problem.moved(torch.as_tensor(fit.theta).to(rows.q))))
    return rows.rmse(torch.cat(residuals).numpy())


def _aligned(chain: Any, rows: _Rows) -> Any:
    """Return the chain at the base pose that matches the two clouds of tips (Kabsch)."""
    tips, weight = chain(rows.q), rows.weight[:, None] / rows.weight.sum()
    here, there = (weight * tips).sum(0), (weight * rows.x).sum(0)
    u, _, vh = torch.linalg.svd((weight * (tips - here)).mT @ (rows.x - there))
    sign = torch.ones_like(here)
    sign[2] = torch.sign(torch.linalg.det(u @ vh))
    rotation = vh.mT @ (sign[:, None] * u.mT)
    move = torch.eye(4, dtype=here.dtype)
    move[:3, :3], move[:3, 3] = rotation, there - rotation @ here
    return chain.with_geometry(base=move @ chain.geometry()["base"])


def _moved_base(base: Tensor, part: Tensor, reach: Tensor) -> Tensor:
    """Return the base turned by the rotation vector part[:3] and moved by reach * part[3:]."""
    w = part[:3]
    zero = torch.zeros_like(w[0])
    cross = torch.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).reshape(3, 3)
    arc = stumpff((w * w).sum())
    eye = torch.eye(3, dtype=base.dtype, device=base.device)
    rotation = (eye + arc.f * cross + arc.g * cross @ cross) @ base[:3, :3]
    position = base[:3, 3] + reach * part[3:]
    return torch.cat([torch.cat([rotation, position[:, None]], dim=1), base[3:]], dim=0)


def _reach(chain: Any) -> Tensor:
    """Return the natural unit of length: the backbone's where it is fixed, else 10 radii."""
    geometry = chain.geometry()
    if "lengths" in geometry:
        return geometry["lengths"].sum()
    return 10.0 * geometry["radii"].mean()


def _size(chain: Any, name: str) -> int:
    if name == "base":
        return 6
    return 1 if name == "tool" else len(chain.actuators_per_segment)


def _theta_bounds(
    chain: Any, name: str, bound: tuple[float, float] | None
) -> tuple[np.ndarray, np.ndarray]:
    size = _size(chain, name)
    if bound is None:
        return np.full(size, -np.inf), np.full(size, np.inf)
    low, high = bound
    if not low < high:
        raise ValueError(f"`bounds` of {name!r} must be (low, high) with low < high, got {bound}.")
    if name == "angles":
        return np.full(size, float(low)), np.full(size, float(high))
    if name in _RELATIVE:
        start = chain.geometry()[name].numpy()
        if low < 0:
            raise ValueError(f"`bounds` of {name!r} must not be negative, got {bound}.")
        with np.errstate(divide="ignore"):
            return np.log(low / start), np.log(high / start)
    start = chain.geometry()["offsets"].numpy()[-size:]
    reach = float(_reach(chain))
    return (low - start) / reach, (high - start) / reach


def _check_parameters(
    chain: Any, parameters: Sequence[str], bounds: Mapping | None, prior: float | Mapping
) -> tuple[str, ...]:
    names = (parameters,) if isinstance(parameters, str) else tuple(parameters)
    geometry = {*chain.geometry(), "tool"}
    available = [name for name in _PARAMETERS if name in geometry]
    unknown = [name for name in names if name not in available]
    if unknown or not names or len(set(names)) < len(names):
        raise ValueError(
            f"`parameters` must name different ones of {available} for this chain, got {names}."
        )
    if {"offsets", "tool"} <= set(names):
        raise ValueError(
            "`parameters` must not hold both 'offsets' and 'tool': the tool is the "
            "last offset; leave 'tool' out."
        )
    for argument, given in (("bounds", bounds), ("prior", prior)):
        if isinstance(given, Mapping) and not set(given) <= set(names):
            raise ValueError(f"`{argument}` must name only {names}, got {sorted(given)}.")
    if bounds and "base" in bounds:
        raise ValueError("`bounds` cannot hold 'base'; tighten it by `prior={'base': ...}`.")
    stds = list(prior.values()) if isinstance(prior, Mapping) else [prior]
    if not all(std > 0 for std in stds):
        raise ValueError(f"`prior` must be positive standard deviations, got {prior}.")
    return names


def _check_data(chain: Any, q: Any, x: Any) -> tuple[Tensor, Tensor]:
    dtype = chain.geometry()["base"].dtype
    q, x = torch.as_tensor(q).detach().to(dtype), torch.as_tensor(x).detach().to(dtype)
    if q.ndim != 2:
        raise ValueError(f"`q` must have shape (N, n_actuators), got {tuple(q.shape)}.")
    if x.shape != (len(q), 3):
        raise ValueError(
            f"`x` must have shape ({len(q)}, 3), one tip position per row of `q`, got "
            f"{tuple(x.shape)}."
        )
    if len(q) == 0:
        raise ValueError("`q` must hold at least one row, got none.")
    chain.check_actuators(q)
    if not torch.isfinite(x).all():
        rows = int((~torch.isfinite(x).all(dim=1)).sum())
        raise ValueError(f"`x` must be finite, got NaN or infinity in {rows} rows; drop them.")
    return q, x


def _check_weights(sample_weight: Any, q: Tensor) -> Tensor:
    if sample_weight is None:
        return q.new_ones(len(q))
    weights = torch.as_tensor(sample_weight).to(q)
    valid = weights.shape == (len(q),) and bool((torch.isfinite(weights) & (weights >= 0)).all())
    if not valid or not (weights > 0).any():
        raise ValueError(
            f"`sample_weight` must hold {len(q)} non-negative numbers, not all zero, got shape "
            f"{tuple(weights.shape)}."
        )
    return weights
