"""Ridge readouts from sums in float64 to which rows and other sums can be added exactly."""

from typing import NamedTuple

import numpy as np
import torch
from scipy import linalg
from scipy.linalg.blas import dsyrk  # pyright: ignore
from scipy.linalg.lapack import dpocon, dpotrf, dtrtri  # pyright: ignore
from sklearn.utils import gen_batches

from hybridkin._core.arrays import copied
from hybridkin._core.blocks import rows_at_once

# 4 MB of float64: enough rows to feed the BLAS, near the cache.
BLOCK_ELEMENTS = 500_000


class Statistics(NamedTuple):
    """Total weight, mean and scatter about the mean of rows [features, targets]."""

    n: float
    mean: np.ndarray
    scatter: np.ndarray

    @classmethod
    def none(cls, n_columns):
        """Return the statistics of no rows."""
        return cls(0.0, np.zeros(n_columns), np.zeros((n_columns, n_columns)))


@torch.no_grad()
def gather(stats, elm, X, y, sample_weight, block_size):
    """Return the statistics `stats` with the rows of `X` and `y` added.

    Each block is centred about its own mean. The step from the old mean to the block's mean is
    added as one more row, so each block needs one symmetric product, and the result is exact.
    """
    n_features = len(elm.output_weights)
    device = elm.input_center.device
    n_columns = n_features + y.shape[1]
    if block_size is None:
        block_size = rows_at_once(max(1, BLOCK_ELEMENTS // n_columns), device)
    n = stats.n
    mean = torch.tensor(stats.mean, device=device)
    # In the order of BLAS; only one half is updated.
    scatter = torch.tensor(stats.scatter, device=device).T
    buffer = mean.new_empty(min(block_size, len(X)) + 1, len(mean))
    for rows in gen_batches(len(X), block_size):
        q = copied(X[rows], device, np.float64)
        z = buffer[: len(q) + 1]
        block = z[:-1]
        elm.write_features(q, block[:, :n_features])
        block[:, n_features:] = copied(y[rows], device)
        weights = copied(sample_weight[rows], "cpu")
        n_block = weights.sum().item()
        w = weights.to(device)
        mean_block = (w @ block) / n_block
        block -= mean_block
        block *= w.sqrt()[:, None]
        step = mean_block - mean
        torch.mul(step, (n / (n + n_block) * n_block) ** 0.5, out=z[-1])
        n += n_block
        mean += step * (n_block / n)
        if z.device.type == "cpu":  # half the work of a general product
            options = {"beta": 1.0, "overwrite_c": True, "lower": True}
            c = dsyrk(1.0, z.T.numpy(), c=scatter.numpy(), **options)
            scatter = torch.from_numpy(c)
        else:
            scatter.addmm_(z.T, z)
    lower = np.tril(scatter.cpu().numpy())
    return Statistics(n, mean.cpu().numpy(), lower + np.tril(lower, -1).T)


@np.errstate(over="ignore", invalid="ignore")
def merge(a, b):
    """Return the statistics of the rows of `a` and `b` (parallel variance formula)."""
    n = a.n + b.n
    step = b.mean - a.mean
    scatter = a.scatter + b.scatter + np.outer(step, step) * (a.n / n * b.n)
    return Statistics(n, a.mean + step * (b.n / n), scatter)


def ridge(G, C, alpha, least=0.0):
    """Return W = (G + alpha 1)^-1 C, R with R R' = (G + alpha 1)^-1, tr(R' G R), and the solver.

    If G + alpha 1 is singular, W is the solution of minimum norm. R then replaces eigenvalues
    below rounding by their rounding error, but at least by `least`: it is large in directions
    without data.
    """
    A = G + alpha * np.eye(len(G))
    eps = len(G) * np.finfo(np.float64).eps
    # Unit diagonal: different units of the features do not make a system singular.
    root = np.sqrt(A.diagonal())[:, None]
    root[root == 0] = 1.0
    scaled = A / root / root.T
    L, failed = dpotrf(scaled, lower=True)
    reciprocal_condition = 0.0
    if not failed:
        norm = np.abs(scaled).sum(0).max()
        reciprocal_condition, _ = dpocon(L, norm, uplo="L")
    if reciprocal_condition > eps:
        W = linalg.cho_solve((L, True), C / root) / root
        inverse, _ = dtrtri(L, lower=True)
        R = inverse.T / root
        dof = len(G) - alpha * np.sum(R * R)
        return W, R, dof, "cholesky"
    eigenvalues, V = linalg.eigh(G)
    shifted = eigenvalues + alpha
    cutoff = max(eps * shifted[-1], np.finfo(np.float64).tiny)
    regular = shifted > cutoff
    axes = V[:, regular]
    W = axes @ ((axes.T @ C) / shifted[regular, None])
    R = V / np.sqrt(np.maximum(shifted, max(cutoff, least)))
    dof = np.sum(eigenvalues[regular] / shifted[regular])
    return W, R, dof, "eigh"


@np.errstate(over="ignore", invalid="ignore")
def moments(stats, n_features, fit_intercept):
    """Return the means, the features' Gram matrix, their products with the targets, and y'y.

    With an intercept they are centred; else they are about the origin, and the means are zero.
    """
    n, mean, scatter = stats
    if not fit_intercept:
        # Both terms are positive: moving from the mean to the origin loses no digits.
        scatter = scatter + n * np.outer(mean, mean)
        mean = np.zeros_like(mean)
    if not np.isfinite(scatter).all():
        raise ValueError(
            "`X` and `y` must give finite sums of products of features and targets in float64, "
            "got an overflow; change their unit, or scale the inputs with `input_scaling`."
        )
    G = scatter[:n_features, :n_features]
    C = scatter[:n_features, n_features:]
    return mean, G, C, scatter.diagonal()[n_features:]


@np.errstate(over="ignore", invalid="ignore")
def fit_readout(stats, n_features, alpha, fit_intercept):
    """Return the arrays of the readout (eq. 3), the noise variance (m,) and the solver.

    The leverage belongs to the smallest entry of `alpha`, a number or an array of shape (m,).
    """
    n = stats.n
    mean, G, C, yy = moments(stats, n_features, fit_intercept)
    alphas = np.broadcast_to(np.asarray(alpha, dtype=np.float64), yy.shape)
    W = np.empty(C.shape)
    dof = np.empty(yy.shape)
    solvers = set()
    R = None
    mu = mean[:n_features]
    # Features that only differ from their mean by rounding.
    least = np.finfo(np.float64).eps * n * (mu @ mu)
    for value in np.unique(alphas)[::-1]:
        of = alphas == value
        W[:, of], R, dof[of], solver = ridge(G, C[:, of], value, least)
        solvers.add(solver)
    # This form of the residual is stationary in W: rounding in W enters squared.
    rss = yy - np.sum(W * (2 * C - G @ W), axis=0)
    dof_left = n - dof - fit_intercept
    smallest = np.sqrt(np.finfo(np.float64).eps) * n
    resolved = np.isfinite(dof_left) & (dof_left > smallest)
    noise = np.maximum(rss, 0.0) / np.where(resolved, dof_left, np.nan)
    readout = {
        "output_weights": W,
        "intercept": mean[n_features:] - mu @ W,
        "leverage_center": mu,
        "leverage_factor": R,
        "leverage_offset": np.float64(fit_intercept / n),
    }
    return readout, noise, max(solvers)  # "eigh" if any
