"""Weighted linear least squares over a chain of knots and a few unknowns that all knots share.

A measurement is a sparse row: it depends on the unknowns of one knot or of two neighbours, and on shared ones. The normal
equations are banded, with a border for the shared unknowns:

    [ A   C ] [ x ]   [ h ]        A: (K b, K b), banded; C: (K b, q); G: (q, q)
    [ C'  G ] [ t ] = [ g ]

LAPACK's banded Cholesky factorisation solves A in K b^3 operations, and the Schur complement of A the rest.

`gauss_newton` is the loop of all nonlinear problems: linearise with robust weights, solve, repeat.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_matrix

from uwb_mitigation.errors import DatasetError

_DIVERGED = 1e6


@contextmanager
def _singular_is_undetermined() -> Iterator[None]:
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise DatasetError(
            "the ranges do not determine the positions", valid="more ranges, or anchors"
        ) from error


@_singular_is_undetermined()
def gauss_newton(
    improve: Callable[[int], float], *, iterations: int, converged: float, min_iterations: int = 1
) -> None:
    """Improve a solution until it changes little.

    Args:
        improve: gets the number of the iteration, linearises the problem at its solution, with robust weights, and replaces
            the solution; returns the largest change, for example in m.
        iterations: maximum number.
        converged: change at which the solution is good enough.
        min_iterations: minimum number, for problems whose weights change at first.

    Raises:
        DatasetError: the ranges do not determine the solution.
    """
    for iteration in range(iterations):
        change = improve(iteration)
        if not change < _DIVERGED:
            raise np.linalg.LinAlgError
        if change < converged and iteration + 1 >= min_iterations:
            return


class LeastSquares:
    """Normal equations, to which rows are added.

    Args:
        knots, unknowns, shared: K knots in the order of time, b unknowns of each, and q shared unknowns.
    """

    def __init__(self, knots: int, unknowns: int, shared: int) -> None:
        self.knots, self.unknowns, self.shared = knots, unknowns, shared
        n = knots * unknowns
        # The diagonals of A on and below its main one, and C above G.
        self._band, self._border = np.zeros((2 * unknowns, n)), np.zeros((n + shared, shared))
        self._right = np.zeros(n + shared)

    def copy(self) -> LeastSquares:
        """Return an independent copy."""
        twin = copy.copy(self)
        twin._band, twin._border, twin._right = self._band.copy(), self._border.copy(), self._right.copy()
        return twin

    def of_knot(
        self, knot: NDArray[np.intp] | int, unknown: NDArray[np.intp] | int | range
    ) -> NDArray[np.intp]:
        """Columns of unknowns of knots; the arguments are broadcast."""
        return np.asarray(knot) * self.unknowns + np.asarray(unknown, np.intp)

    def of_shared(self, unknown: NDArray[np.intp] | int | range) -> NDArray[np.intp]:
        """Columns of shared unknowns."""
        return self.knots * self.unknowns + np.asarray(unknown, np.intp)

    def add(
        self,
        columns: NDArray[np.intp],
        values: NDArray[np.float64],
        target: NDArray[np.float64] | float,
        weight: NDArray[np.float64] | float,
    ) -> None:
        """Add n rows: values (n, c) at columns (n, c), targets (n,) and inverse variances (n,); all are broadcast."""
        columns, values = np.broadcast_arrays(np.atleast_2d(columns), np.atleast_2d(values))
        (rows, width), n, size = columns.shape, self.knots * self.unknowns, len(self._right)
        starts = np.arange(0, rows * width + 1, width)
        weighted = values * np.broadcast_to(weight, rows)[:, None]
        jacobian, weighted_jacobian = (
            csr_matrix((factor.reshape(-1), columns.reshape(-1), starts), shape=(rows, size))
            for factor in (values, weighted)
        )
        self._right += weighted_jacobian.T @ np.broadcast_to(target, rows)
        normal = (weighted_jacobian.T @ jacobian).tocsc()
        knots = normal[:n, :n]
        for below in range(min(2 * self.unknowns, n)):
            self._band[below, : n - below] += knots.diagonal(-below)
        self._border += normal[:, n:].toarray()

    def add_at_knots(
        self,
        knot: NDArray[np.intp],
        values: NDArray[np.float64],
        shared: NDArray[np.float64],
        target: NDArray[np.float64],
        weight: NDArray[np.float64],
    ) -> None:
        """Add n rows of one knot each in a fraction of the time of `add`.

        Knots int (n,), values of their unknowns (n, b) and of the shared ones (n, q), targets (n,), inverse variances (n,).
        """
        rows, b, n = len(knot), self.unknowns, self.knots * self.unknowns
        of_knots = csr_matrix((weight, knot, np.arange(rows + 1)), shape=(rows, self.knots)).T
        i, j = np.tril_indices(b)
        self._band.reshape(2 * b, self.knots, b)[i - j, :, j] += (of_knots @ (values[:, i] * values[:, j])).T
        with_shared = (values[:, :, None] * shared[:, None, :]).reshape(rows, b * self.shared)
        self._border[:n] += (of_knots @ with_shared).reshape(n, -1)
        self._border[n:] += (shared.T * weight) @ shared
        self._right[:n] += (of_knots @ (values * target[:, None])).reshape(-1)
        self._right[n:] += (shared.T * weight) @ target

    def add_prior(
        self,
        columns: NDArray[np.intp],
        mean: NDArray[np.float64] | float,
        information: NDArray[np.float64] | float,
    ) -> None:
        """Add independent priors of the unknowns at `columns`, with inverse variances."""
        self.add(np.reshape(columns, (-1, 1)), np.ones((np.size(columns), 1)), mean, information)

    def add_motion(self, knot: NDArray[np.intp], dt: NDArray[np.float64], axes: int, density: float) -> None:
        """Connect knots (n,) to their successors by white acceleration.

        Args:
            knot: rows of the knots, int (n,).
            dt: float64 (n,), s, positive.
            axes: d: the first d unknowns of a knot are its position, the next d its velocity.
            density: spectral density of the acceleration, m^2/s^3.
        """
        for axis in range(axes):
            # p1 - p0 - (v0 + v1) dt / 2 and v1 - v0 are independent.
            p, v = self.of_knot(knot, axis), self.of_knot(knot, axes + axis)
            mean = np.stack([np.ones(len(dt)), -np.ones(len(dt)), -dt / 2.0, -dt / 2.0], axis=1)
            columns = np.stack([p + self.unknowns, p, v, v + self.unknowns], axis=1)
            self.add(columns, mean, 0.0, 12.0 / (density * dt**3))
            self.add(
                np.stack([v + self.unknowns, v], axis=1), np.array([1.0, -1.0]), 0.0, 1.0 / (density * dt)
            )

    def solve(self) -> Solution:
        """Return the solution.

        Raises:
            numpy.linalg.LinAlgError: the rows do not determine it.
        """
        n, b, q = self.knots * self.unknowns, self.unknowns, self.shared
        border, corner = np.split(self._border, [n])
        factor = cholesky_banded(self._band, lower=True, check_finite=False)
        columns = np.column_stack([self._right[:n], border])
        solved = cho_solve_banded((factor, True), columns, overwrite_b=True, check_finite=False)
        x, y = solved[:, 0], solved[:, 1:]
        schur = corner - border.T @ y
        covariance = np.linalg.inv((schur + schur.T) / 2.0) if q else np.zeros((0, 0))
        t = covariance @ (self._right[n:] - border.T @ x)
        return Solution((x - y @ t).reshape(self.knots, b), t, covariance, y, factor)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Solution of a bordered block-tridiagonal system.

    Attributes:
        x: float64 (K, b). shared: (q,). shared_covariance: (q, q).
    """

    x: NDArray[np.float64]
    shared: NDArray[np.float64]
    shared_covariance: NDArray[np.float64]
    _y: NDArray[np.float64]
    _factor: NDArray[np.float64]

    def reduced(self, columns: NDArray[np.intp], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives (n, q) of rows with respect to the shared unknowns, with the knots adapted to these.

        Args:
            columns: int (n, c), as in `LeastSquares.add`.
            values: float64 (n, c).
        """
        adapted = np.concatenate([-self._y, np.eye(len(self.shared))])
        return np.asarray(np.einsum("nc,ncq->nq", values, adapted[columns]), np.float64)

    def covariances(self, first: int) -> NDArray[np.float64]:
        """Return the marginal covariance of each knot's `first` unknowns, float64 (K, first, first).

        A backward sweep through the Cholesky factor L of the block-tridiagonal matrix, as in a Rauch-Tung-Striebel smoother:
        P_k = (L_kk L_kk')^-1 + G_k P_(k+1) G_k' with G_k = (L_(k+1)k L_kk^-1)'. The border adds the effect of the shared
        unknowns' covariance.
        """
        knots, b = self.x.shape
        i, j = np.indices((b, b))
        column = np.arange(knots)[:, None, None] * b + j
        inverse = np.linalg.inv(np.tril(self._factor[np.abs(i - j), column]))
        gain = (self._factor[b + i - j, column[:-1]] @ inverse[:-1]).swapaxes(1, 2)
        covariance = inverse.swapaxes(1, 2) @ inverse
        for k in range(knots - 2, -1, -1):
            covariance[k] += gain[k] @ covariance[k + 1] @ gain[k].T
        y = self._y.reshape(knots, b, -1)[:, :first]
        shared = np.einsum("kiq,qr,kjr->kij", y, self.shared_covariance, y)
        return np.asarray(covariance[:, :first, :first] + shared, np.float64)
