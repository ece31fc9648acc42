"""Exact errors of a ridge readout on held-out rows, for a grid of penalties in one pass."""

import numpy as np
import torch
from scipy import linalg
from scipy.linalg.lapack import dposv  # pyright: ignore
from sklearn.utils import gen_batches

from hybridkin.learning._ridge import moments

_BLOCK_ELEMENTS = 2_000_000  # 16 MB of float64 per temporary
_PAIRED = (
    4  # rows whose products with all rows before are computed at once, in the cache
)


class LeftOut:
    """Errors of the readout of a hidden layer on held-out rows.

    All rows have the residuals ``r = y - Phi W = P y`` with ``P = 1 - Phi A^-1 Phi'`` and
    ``A = Phi' Phi + alpha 1``. The errors on rows S of a fit without S are ``P_SS^-1 r_S``; no
    refit is needed. In the eigenbasis of ``Phi' Phi``, with coordinates Z, ``P = 1 - Z D Z'`` with
    a diagonal D. If there are fewer rows than features, Z is the eigenbasis of ``Phi Phi'`` and
    ``P = Z D Z'``, without cancellation. Rows are multiplied by the root of their weight.

    Parameters
    ----------
    elm : ELM
        Hidden layer; its readout is not used.
    stats : Statistics
        Statistics of all rows.
    X, y : ndarray of shape (n_samples, n_inputs) and (n_samples, n_outputs)
        All rows.
    weights : ndarray of shape (n_samples,)
        Positive weights of the rows.
    fit_intercept : bool
        Whether the readout has an intercept; it is refitted without the held-out rows.

    References
    ----------
    .. [1] Allen, D. M. (1974). The relationship between variable selection and data augmentation
       and a method for prediction. Technometrics, 16, 125-127.
    .. [2] Cook, R. D., & Weisberg, S. (1982). Residuals and influence in regression, section 3.7.
    """

    def __init__(self, elm, stats, X, y, weights, fit_intercept):
        n_features = len(elm.output_weights)
        self._elm = elm
        self._X = X
        self._intercept = fit_intercept
        mean, G, C, _ = moments(stats, n_features, fit_intercept)
        self._n = stats.n
        self._center = mean[:n_features]
        self._root = np.sqrt(weights)
        self._y = (y - mean[n_features:]) * self._root[:, None]
        self._wide = len(X) <= n_features
        if self._wide:
            phi = self._features(np.arange(len(X)))
            gram = phi @ phi.T
            if fit_intercept:  # the direction of the mean, without residual, comes last
                gram += (
                    (1 + np.trace(gram)) * np.outer(self._root, self._root) / self._n
                )
            eigenvalues, self._basis = linalg.eigh(gram)
            if fit_intercept:
                eigenvalues = eigenvalues[:-1]
                self._basis = self._basis[:, :-1]
            self._Zy = self._basis.T @ self._y
        else:
            eigenvalues, self._basis = linalg.eigh(G)
            self._Zy = self._basis.T @ C
        self.eigenvalues = np.maximum(eigenvalues, 0.0)

    def alone(self, alphas):
        """Yield blocks of rows and their errors (n_alphas, n_rows, n_outputs), each held out alone.

        Parameters
        ----------
        alphas : ndarray of shape (n_alphas,)
            Penalties.
        """
        D = self._d(alphas)
        for batch in gen_batches(len(self._X), self._rows_at_a_time(len(alphas))):
            rows = np.arange(batch.start, batch.stop)
            Z = self._z(rows)
            root = self._root[rows]
            p = D @ (Z * Z).T
            if not self._wide:
                p += 1.0 - (root**2 / self._n if self._intercept else 0.0)
            yield rows, self._residuals(Z, D, rows) / p[:, :, None] / root[:, None]

    def together(self, splits, alphas):
        """Yield the asked rows of each split, and their errors (n_alphas, n_asked, n_outputs).

        Parameters
        ----------
        splits : list of (out, asked)
            Held-out rows, ascending, and the rows of them to evaluate.
        alphas : ndarray of shape (n_alphas,)
            Penalties.
        """
        D = self._d(alphas)
        for part in self._in_parts(splits, self._rows_at_a_time(len(alphas))):
            rows = np.concatenate([out for out, _ in part])
            if not self._wide and len(rows) > len(self._center) and len(part) == 1:
                out, held_out = part[0]
                yield held_out, self._refitted(out, held_out, alphas)
                continue
            Z = self._z(rows)
            residuals = self._residuals(Z, D, rows)
            start = 0
            for out, held_out in part:
                stop = start + len(out)
                errors = self._solved(Z[start:stop], D, residuals[:, start:stop], out)
                yield (
                    held_out,
                    errors[:, np.searchsorted(out, held_out)]
                    / self._root[held_out, None],
                )
                start = stop

    def _in_parts(self, splits, n_rows):
        """Yield lists of splits that together hold out at most `n_rows` rows, or a single one.

        A split of more rows than features is single, see `_refitted`.
        """
        part = []
        size = 0
        for split in splits:
            count = len(split[0])
            single = not self._wide and count > len(self._center)
            if part and (single or size + count > n_rows):
                yield part
                part = []
                size = 0
            part.append(split)
            size = n_rows if single else size + count
        if part:
            yield part

    def _solved(self, Z, D, residuals, out):
        """Return P_SS^-1 r_S (n_alphas, n_out, n_outputs) for the rows S."""
        fixed = np.zeros((len(out), len(out)))
        if not self._wide:
            fixed += np.eye(len(out))
            if self._intercept:
                fixed -= np.outer(self._root[out], self._root[out]) / self._n
        errors = np.empty(residuals.shape)
        for k, lower in enumerate(_products(Z, D)):
            lower += fixed
            # Its transpose is in the order of LAPACK.
            _, errors[k], failed = dposv(lower.T, residuals[k])
            if failed:  # by singular values: P may have none left
                whole = np.tril(lower) + np.tril(lower, -1).T
                errors[k] = np.linalg.lstsq(whole, residuals[k], rcond=None)[0]
        return errors

    def _rows_at_a_time(self, n_alphas):
        return max(
            1, _BLOCK_ELEMENTS // (len(self._center) + n_alphas * self._y.shape[1])
        )

    def _d(self, alphas):
        numerator = alphas[:, None] if self._wide else -1.0
        return numerator / np.add.outer(alphas, self.eigenvalues)

    def _z(self, rows):
        return self._basis[rows] if self._wide else self._features(rows) @ self._basis

    def _features(self, rows):
        q = torch.from_numpy(self._X[rows].astype(np.float64))
        with torch.no_grad():
            phi = self._elm.features(q.to(self._elm.input_center.device)).numpy(
                force=True
            )
        return (phi - self._center) * self._root[rows, None]

    def _residuals(self, Z, D, rows):
        """Return the residuals r (n_alphas, n_rows, n_outputs) of a fit to all rows."""
        by_alpha = (D.T[:, :, None] * self._Zy[:, None]).reshape(Z.shape[1], -1)
        r = (Z @ by_alpha).reshape(len(Z), len(D), -1).swapaxes(0, 1)
        return r if self._wide else self._y[rows] + r

    def _refitted(self, out, asked, alphas):
        """Return the errors of one split from sums over the remaining rows; faster for large S."""
        n_features = len(self._center)
        scatter = np.diag(np.append(self.eigenvalues, np.zeros(self._y.shape[1])))
        scatter[:n_features, n_features:] = self._Zy
        total = np.zeros(len(scatter))
        weight = self._n
        for batch in gen_batches(len(out), self._rows_at_a_time(0)):
            rows = out[batch]
            z = np.hstack([self._z(rows), self._y[rows]])
            scatter -= z.T @ z
            total -= self._root[rows] @ z
            weight -= np.sum(self._root[rows] ** 2)
        mean = total / weight * self._intercept
        scatter -= weight * np.outer(mean, mean)
        eigenvalues, V = linalg.eigh(scatter[:n_features, :n_features])
        shrunk = 1.0 / np.add.outer(alphas, np.maximum(eigenvalues, 0.0))
        W = V @ (shrunk[:, :, None] * (V.T @ scatter[:n_features, n_features:]))
        errors = np.empty((len(alphas), len(asked), self._y.shape[1]))
        for batch in gen_batches(len(asked), self._rows_at_a_time(len(alphas))):
            root = self._root[asked[batch], None]
            z = self._z(asked[batch]) / root
            y = self._y[asked[batch]] / root
            errors[:, batch] = y - mean[n_features:] - (z - mean[:n_features]) @ W
        return errors


def _products(Z, D):
    """Return the lower triangles of ``Z diag(d) Z'`` (n_alphas, n_rows, n_rows) for rows d of D."""
    n_rows, n_features = Z.shape
    P = np.zeros((len(D), n_rows, n_rows))
    for start in range(0, n_rows, _PAIRED):
        stop = min(start + _PAIRED, n_rows)
        pairs = (Z[start:stop, None] * Z[:stop]).reshape(-1, n_features)
        P[:, start:stop, :stop] = (D @ pairs.T).reshape(len(D), -1, stop)
    return P
