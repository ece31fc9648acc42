"""Exact errors of a ridge readout on held-out rows, for a grid of penalties in one pass."""

import numpy as np
import torch
from scipy.linalg.lapack import dposv  # pyright: ignore
from sklearn.utils import gen_batches

from hybridkin.learning._ridge import moments

_BLOCK_ELEMENTS = 2_000_000  # 16 MB of float64 per temporary
# Rows whose products with all rows before are computed at once, in the cache.
_PAIRED = 4


def left_out(elm, stats, X, y, weights, fit_intercept):
    """Return the `LeftOut` for these rows, see there for the parameters."""
    few_rows = len(X) <= len(elm.output_weights)
    kind = _OfFewRows if few_rows else _OfManyRows
    return kind(elm, stats, X, y, weights, fit_intercept)


class LeftOut:
    """Errors of the readout of a hidden layer on held-out rows.

    All rows have the residuals ``r = y - Phi W = P y`` with ``P = 1 - Phi A^-1 Phi'`` and
    ``A = Phi' Phi + alpha 1``. The errors on rows S of a fit without S are ``P_SS^-1 r_S``; no
    refit is needed. Subclasses choose coordinates Z in which ``P = P_0 + Z D Z'``, with a diagonal
    D. Rows are multiplied by the root of their weight.

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
        mean, G, C, _ = moments(stats, n_features, fit_intercept)
        self._scatter = np.block([[G, C], [C.T, np.zeros([y.shape[1]] * 2)]])
        self._elm = elm
        self._X = X
        self._intercept = fit_intercept
        self._n = stats.n
        self._center = mean[:n_features]
        self._root = np.sqrt(weights)
        self._y = (y - mean[n_features:]) * self._root[:, None]
        eigenvalues, self._basis, self._Zy = self._decomposed(G, C)
        self.eigenvalues = np.maximum(eigenvalues, 0.0)

    def _decomposed(self, G, C):
        """Return the eigenvalues, their eigenvectors and Z' y."""
        raise NotImplementedError

    def _d(self, alphas):
        """Return the diagonals of D, (n_alphas, n_eigenvalues)."""
        raise NotImplementedError

    def _z(self, rows):
        """Return Z of some rows."""
        raise NotImplementedError

    def _constant(self, rows):
        """Return P_0 of some rows."""
        raise NotImplementedError

    def _constant_diagonal(self, rows):
        """Return the diagonal of P_0 of some rows."""
        raise NotImplementedError

    def _residuals(self, Z, D, rows):
        """Return the residuals r (n_alphas, n_rows, n_outputs) of a fit to all rows."""
        raise NotImplementedError

    def _is_refitted(self, out) -> bool:
        """Return whether the errors of a split come from `_refitted`."""
        return False

    def _refitted(self, out, test_rows, alphas):
        """Return the errors of one split from sums over the remaining rows."""
        raise NotImplementedError

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
            diagonal = D @ (Z * Z).T
            diagonal += self._constant_diagonal(rows)
            errors = self._residuals(Z, D, rows) / diagonal[:, :, None]
            yield rows, errors / self._root[rows, None]

    def together(self, splits, alphas):
        """Yield the test rows of each split, and their errors (n_alphas, n_asked, n_outputs).

        Parameters
        ----------
        splits : list of (out, test_rows)
            Held-out rows, ascending, and the rows of them to evaluate.
        alphas : ndarray of shape (n_alphas,)
            Penalties.
        """
        D = self._d(alphas)
        for part in self._in_parts(splits, self._rows_at_a_time(len(alphas))):
            out, test_rows = part[0]
            if self._is_refitted(out):
                yield test_rows, self._refitted(out, test_rows, alphas)
                continue
            rows = np.concatenate([out for out, _ in part])
            Z = self._z(rows)
            residuals = self._residuals(Z, D, rows)
            start = 0
            for out, test_rows in part:
                stop = start + len(out)
                errors = self._solved(Z[start:stop], D, residuals[:, start:stop], out)
                test_errors = errors[:, np.searchsorted(out, test_rows)]
                yield test_rows, test_errors / self._root[test_rows, None]
                start = stop

    def _in_parts(self, splits, n_rows):
        """Yield lists of splits that together hold out at most `n_rows` rows, or a single one.

        A split that is refitted is single.
        """
        part = []
        size = 0
        for split in splits:
            count = len(split[0])
            if self._is_refitted(split[0]):
                count = n_rows
            if part and size + count > n_rows:
                yield part
                part = []
                size = 0
            part.append(split)
            size += count
        if part:
            yield part

    def _solved(self, Z, D, residuals, out):
        """Return P_SS^-1 r_S (n_alphas, n_out, n_outputs) for the rows S."""
        constant = self._constant(out)
        errors = np.empty(residuals.shape)
        for k, lower in enumerate(_products(Z, D)):
            lower += constant
            # Its transpose is in the order of LAPACK.
            _, errors[k], failed = dposv(lower.T, residuals[k])
            if failed:  # by singular values: P may have none left
                whole = np.tril(lower) + np.tril(lower, -1).T
                errors[k] = np.linalg.lstsq(whole, residuals[k], rcond=None)[0]
        return errors

    def _rows_at_a_time(self, n_alphas):
        numbers_of_row = len(self._center) + n_alphas * self._y.shape[1]
        return max(1, _BLOCK_ELEMENTS // numbers_of_row)

    def _features(self, rows):
        q = torch.from_numpy(self._X[rows].astype(np.float64))
        with torch.no_grad():
            phi = self._elm.features(q.to(self._elm.input_center.device))
        return (phi.numpy(force=True) - self._center) * self._root[rows, None]

    def _projected(self, Z, D):
        """Return Z D Z' y for every penalty (n_alphas, n_rows, n_outputs)."""
        by_alpha = D.T[:, :, None] * self._Zy[:, None]
        products = Z @ by_alpha.reshape(Z.shape[1], -1)
        return products.reshape(len(Z), len(D), -1).swapaxes(0, 1)


class _OfFewRows(LeftOut):
    """At most as many rows as features: Z is the eigenbasis of ``Phi Phi'``, and P_0 is zero.

    Nothing cancels in ``P = Z D Z'`` with ``D = alpha / (eigenvalues + alpha)``.
    """

    def _decomposed(self, G, C):
        phi = self._features(np.arange(len(self._X)))
        gram = phi @ phi.T
        if self._intercept:  # the direction of the mean, without residual, comes last
            mean_direction = np.outer(self._root, self._root) / self._n
            gram += (1 + np.trace(gram)) * mean_direction
        eigenvalues, basis = _eigh(gram)
        if self._intercept:
            eigenvalues = eigenvalues[:-1]
            basis = basis[:, :-1]
        return eigenvalues, basis, basis.T @ self._y

    def _d(self, alphas):
        return alphas[:, None] / np.add.outer(alphas, self.eigenvalues)

    def _z(self, rows):
        return self._basis[rows]

    def _constant(self, rows):
        return 0.0

    _constant_diagonal = _constant

    def _residuals(self, Z, D, rows):
        return self._projected(Z, D)


class _OfManyRows(LeftOut):
    """More rows than features: Z are coordinates of phi in the eigenbasis of ``Phi' Phi``.

    ``P_0 = 1``, without the direction of the mean if there is an intercept, and
    ``D = -1 / (eigenvalues + alpha)``.
    """

    def _decomposed(self, G, C):
        eigenvalues, basis = _eigh(G)
        return eigenvalues, basis, basis.T @ C

    def _d(self, alphas):
        return -1.0 / np.add.outer(alphas, self.eigenvalues)

    def _z(self, rows):
        return self._features(rows) @ self._basis

    def _constant(self, rows):
        constant = np.eye(len(rows))
        if self._intercept:
            constant -= np.outer(self._root[rows], self._root[rows]) / self._n
        return constant

    def _constant_diagonal(self, rows):
        if self._intercept:
            return 1.0 - self._root[rows] ** 2 / self._n
        return 1.0

    def _residuals(self, Z, D, rows):
        return self._y[rows] + self._projected(Z, D)

    def _is_refitted(self, out) -> bool:
        """Return whether sums over the remaining rows are faster than P_SS of every penalty."""
        return 2 * len(out) > len(self._center)

    def _refitted(self, out, test_rows, alphas):
        n_features = len(self._center)
        # Sums of squares and products of [phi, y], less those of the rows out.
        scatter = self._scatter.copy()
        total = np.zeros(len(scatter))
        weight = self._n
        for batch in gen_batches(len(out), self._rows_at_a_time(0)):
            rows = out[batch]
            z = np.hstack([self._features(rows), self._y[rows]])
            scatter -= z.T @ z
            total -= self._root[rows] @ z
            weight -= np.sum(self._root[rows] ** 2)
        mean = total / weight * self._intercept
        scatter -= weight * np.outer(mean, mean)
        # Ridge regression on the remaining rows.
        eigenvalues, V = _eigh(scatter[:n_features, :n_features])
        shrunk = 1.0 / np.add.outer(alphas, np.maximum(eigenvalues, 0.0))
        moment = V.T @ scatter[:n_features, n_features:]
        by_alpha = shrunk.T[:, :, None] * moment[:, None]
        W = V @ by_alpha.reshape(n_features, -1)
        errors = np.empty((len(alphas), len(test_rows), self._y.shape[1]))
        for batch in gen_batches(len(test_rows), self._rows_at_a_time(len(alphas))):
            rows = test_rows[batch]
            root = self._root[rows, None]
            z = self._features(rows) / root - mean[:n_features]
            y = self._y[rows] / root - mean[n_features:]
            predicted = (z @ W).reshape(len(rows), len(alphas), -1)
            errors[:, batch] = y - predicted.swapaxes(0, 1)
        return errors


def _eigh(matrix):
    """Return the eigenvalues and eigenvectors of a symmetric matrix, as `scipy.linalg.eigh`."""
    eigenvalues, axes = torch.linalg.eigh(torch.from_numpy(matrix))
    return eigenvalues.numpy(), axes.numpy()


def _products(Z, D):
    """Return the lower triangles of ``Z diag(d) Z'`` (n_alphas, n_rows, n_rows) for rows d of D."""
    n_rows, n_features = Z.shape
    P = np.zeros((len(D), n_rows, n_rows))
    for start in range(0, n_rows, _PAIRED):
        stop = min(start + _PAIRED, n_rows)
        pairs = (Z[start:stop, None] * Z[:stop]).reshape(-1, n_features)
        P[:, start:stop, :stop] = (D @ pairs.T).reshape(len(D), -1, stop)
    return P
