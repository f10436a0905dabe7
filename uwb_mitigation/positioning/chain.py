"""Least squares over a chain of knots and a few parameters that all of them share.

The normal equations are block tridiagonal with a border:

    [ A   C ] [ x ]   [ h ]        A: K blocks of b on the diagonal, and those between neighbours
    [ C'  G ] [ t ] = [ g ]        C: (K b, q), G: (q, q)

A is banded, so that LAPACK's banded Cholesky factors it in K b^3 operations; the border goes by Schur's complement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

_BLOCK = 8192


@dataclass(slots=True, eq=False)
class Chain:
    """Normal equations to fill, of K knots with b unknowns each and q shared ones.

    Attributes:
        diagonal: float64 (K, b, b). beside: (K - 1, b, b), rows of a knot, columns of the next.
        border: (K, b, q). shared: (q, q).
        right: (K, b). right_shared: (q,).
    """

    diagonal: NDArray[np.float64]
    beside: NDArray[np.float64]
    border: NDArray[np.float64]
    shared: NDArray[np.float64]
    right: NDArray[np.float64]
    right_shared: NDArray[np.float64]

    @classmethod
    def empty(cls, knots: int, unknowns: int, shared: int) -> Chain:
        """All zero."""
        return cls(
            np.zeros((knots, unknowns, unknowns)),
            np.zeros((max(knots - 1, 0), unknowns, unknowns)),
            np.zeros((knots, unknowns, shared)),
            np.zeros((shared, shared)),
            np.zeros((knots, unknowns)),
            np.zeros(shared),
        )

    def add_rows(
        self,
        of: NDArray[np.intp],
        own: NDArray[np.float64],
        rows: NDArray[np.float64],
        target: NDArray[np.float64],
        weight: NDArray[np.float64],
    ) -> None:
        """Add measurements, in the order of their knots `of`: n rows of a knot's unknowns (n, b) and of the shared ones
        (n, q), what they should come to (n,), and their inverse variances (n,)."""
        for start in range(0, len(of), _BLOCK):
            part = slice(start, start + _BLOCK)
            self._add_block(of[part], own[part], rows[part], target[part], weight[part])

    def _add_block(
        self,
        of: NDArray[np.intp],
        own: NDArray[np.float64],
        rows: NDArray[np.float64],
        target: NDArray[np.float64],
        weight: NDArray[np.float64],
    ) -> None:
        starts = np.flatnonzero(np.diff(of, prepend=-1))
        knots = of[starts]
        weighted = own * weight[:, None]
        self.diagonal[knots] += np.add.reduceat(weighted[:, :, None] * own[:, None], starts)
        self.border[knots] += np.add.reduceat(weighted[:, :, None] * rows[:, None], starts)
        self.right[knots] += np.add.reduceat(weighted * target[:, None], starts)
        scaled = rows * weight[:, None]
        self.shared += scaled.T @ rows
        self.right_shared += scaled.T @ target

    def add_motion(
        self, dt: NDArray[np.float64], axes: int, acceleration: float, tied: NDArray[np.bool_] | None = None
    ) -> None:
        """Tie neighbours by white acceleration (see `model`).

        Args:
            dt: float64 (K - 1,), s, more than 0 where tied.
            axes: d: the first d unknowns of a knot are its place, the next d its velocity.
            tied: bool (K - 1,), which neighbours are; None = all.
        """
        if tied is not None:
            dt = np.where(tied, dt, 1.0)
        here = 1.0 if tied is None else tied.astype(float)
        q = acceleration**2
        # The inverse of q [[dt^3/3, dt^2/2], [dt^2/2, dt]].
        a, b, c = 12.0 * here / (q * dt**3), -6.0 * here / (q * dt**2), 4.0 * here / (q * dt)
        near, far, beside = self.diagonal[:-1], self.diagonal[1:], self.beside
        # F' Q^-1 F and -F' Q^-1, with F = [[1, dt], [0, 1]].
        cross = b + a * dt
        for axis in range(axes):
            v = axes + axis
            far[:, axis, axis] += a
            far[:, axis, v] += b
            far[:, v, axis] += b
            far[:, v, v] += c
            near[:, axis, axis] += a
            near[:, axis, v] += cross
            near[:, v, axis] += cross
            near[:, v, v] += c + 2.0 * b * dt + a * dt**2
            beside[:, axis, axis] -= a
            beside[:, axis, v] -= b
            beside[:, v, axis] -= b + a * dt
            beside[:, v, v] -= c + b * dt

    def solve(self) -> Solution:
        """The solution.

        Raises:
            numpy.linalg.LinAlgError: the equations do not determine it.
        """
        knots, b, q = self.border.shape
        factor = cholesky_banded(self._banded(), overwrite_ab=True, lower=True, check_finite=False)
        both = np.concatenate([self.right[..., None], self.border], axis=2).reshape(knots * b, 1 + q)
        solved = cho_solve_banded((factor, True), both, check_finite=False)
        x, y = solved[:, 0], solved[:, 1:]
        c = both[:, 1:]
        schur = self.shared - c.T @ y
        covariance = np.linalg.inv((schur + schur.T) / 2.0) if q else np.zeros((0, 0))
        t = covariance @ (self.right_shared - c.T @ x)
        return Solution((x - y @ t).reshape(knots, b), t, covariance, y.reshape(knots, b, q), self)

    def _banded(self) -> NDArray[np.float64]:
        """The lower band of A as LAPACK wants it: row i - j, column j."""
        knots, b, _ = self.diagonal.shape
        band = np.zeros((2 * b, knots * b))
        columns = np.arange(knots)[:, None] * b
        for j in range(b):
            for i in range(j, b):
                band[i - j, columns[:, 0] + j] = self.diagonal[:, i, j]
            for i in range(b):
                # The block below the diagonal is the transpose of the one beside it.
                band[b + i - j, columns[:-1, 0] + j] = self.beside[:, j, i]
        return band


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Attributes:
    x: float64 (K, b). shared: (q,). shared_covariance: (q, q).
    """

    x: NDArray[np.float64]
    shared: NDArray[np.float64]
    shared_covariance: NDArray[np.float64]
    _y: NDArray[np.float64]
    _chain: Chain

    def reduced(
        self, of: NDArray[np.intp], own: NDArray[np.float64], rows: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Rows of the shared unknowns (n, q) of measurements, after the knots have adapted to those unknowns.

        Args: as in `Chain.add_rows`.
        """
        found: NDArray[np.float64] = rows - np.einsum("nb,nbq->nq", own, self._y[of])
        return found

    def covariances(self, first: int | None = None) -> NDArray[np.float64]:
        """The marginal covariance of every knot, float64 (K, f, f), of its `first` unknowns (None = all).

        Blocks of the inverse of a block tridiagonal matrix come from a sweep in each direction; the border adds
        what the shared parameters' own covariance does to a knot.
        """
        diagonal, beside = self._chain.diagonal, self._chain.beside
        knots, b, _ = diagonal.shape
        f = b if first is None else first
        ahead = np.zeros((knots, b, b))
        for k in range(1, knots):
            e = beside[k - 1]
            ahead[k] = e.T @ np.linalg.solve(diagonal[k - 1] - ahead[k - 1], e)
        found = np.empty((knots, f, f))
        back = np.zeros((b, b))
        for k in range(knots - 1, -1, -1):
            found[k] = np.linalg.inv(diagonal[k] - ahead[k] - back)[:f, :f]
            if k:
                e = beside[k - 1]
                back = e @ np.linalg.solve(diagonal[k] - back, e.T)
        y = self._y[:, :f]
        found += np.einsum("kiq,qr,kjr->kij", y, self.shared_covariance, y)
        return found
