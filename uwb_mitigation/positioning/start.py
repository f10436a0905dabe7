"""Every place from which a handful of ranges may come: a robust fit from many starts at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.positioning.model import Model

IMPLAUSIBLE = 9.0
"""Places less likely than the best by e^-9 are none: one in eight thousand."""

_STEPS = 40
_STUCK = 0.01
_WALL_SD_M = 0.02
"""Standard deviation of the pseudo-measurement that holds a position at the wall of the area."""

_NEAR_WALL_M = 0.5
_AROUND = 24
_SPHERE = 96


@dataclass(frozen=True, slots=True)
class Height:
    """The tag's height, as far as known: m, and its standard deviation."""

    value: float
    sd: float = 0.1

    def __post_init__(self) -> None:
        if not (abs(self.value) <= 1e5 and 0.0 < self.sd <= 1e3):
            raise ParameterError(
                f"height {self.value} with deviation {self.sd}", valid="metres, deviation over 0"
            )


@dataclass(frozen=True, slots=True)
class Area:
    """Where a tag can be: two opposite corners of a box, m."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ParameterError(
                f"area from {self.low} to {self.high}", valid="three smaller, then three larger"
            )

    @classmethod
    def parse(cls, text: str) -> Area | None:
        """The box that `X,Y,Z,X,Y,Z` says, m; None where it is empty.

        Raises:
            ParameterError: it says no box.
        """
        if not text:
            return None
        try:
            x, y, z, x1, y1, z1 = (float(word) for word in text.split(","))
        except ValueError as error:
            raise ParameterError(f"area {text!r}", valid="six numbers: X,Y,Z,X,Y,Z") from error
        return cls((x, y, z), (x1, y1, z1))

    def holds(self, position: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of the places float64 (n, 3) lie in it."""
        inside: NDArray[np.bool_] = np.all((position >= self.low) & (position <= self.high), axis=-1)
        return inside

    def clip(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the nearest point of the box to each position float64 (..., 3)."""
        nearest: NDArray[np.float64] = np.clip(position, self.low, self.high)
        return nearest


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where ranges may come from.

    Attributes:
        position: float64 (3,), m.
        covariance: float64 (3, 3), m^2, of a tag whose ranges err independently.
        gain: float64 (3, k), what an error of each range does to the position.
        loss: minus the log likelihood, up to a constant.
    """

    position: NDArray[np.float64]
    covariance: NDArray[np.float64]
    gain: NDArray[np.float64]
    loss: float


def places(
    anchors: NDArray[np.float64],
    range_m: NDArray[np.float64],
    sd_m: NDArray[np.float64],
    model: Model,
    *,
    height: Height | None = None,
    area: Area | None = None,
) -> list[Place]:
    """All local optima that are plausible beside the best, the best first.

    Starts lie on the circle (the sphere, where the height is unknown) that the shortest range draws around
    its anchor, on that of the next one, and at the anchors' centre; each descends by Levenberg and Marquardt.

    Args:
        anchors: float64 (k, 3), m, of each range.
        range_m, sd_m: float64 (k,), m.
        model: how robust.
        height, area: where the tag can be.
    """
    dims = 2 if height is not None else 3
    if len(range_m) < dims:
        return []
    x = _starts(anchors, range_m, height)
    prior = _Prior.of(len(x), height)
    x, cost, gradient, hessian = _descend(x, anchors, range_m, sd_m, model, prior)
    # A start that got stuck on its way is no place, unless all did.
    step = np.linalg.solve(hessian + 1e-9 * np.eye(3), gradient[..., None])[..., 0]
    arrived = np.einsum("ni,ni->n", step, gradient) < _STUCK
    if arrived.any():
        cost = np.where(arrived, cost, np.inf)
    keep = cost <= cost.min() + IMPLAUSIBLE
    if area is not None:
        keep = np.isfinite(cost)
        excess = x - area.clip(x)
        squared = np.einsum("ni,ni->n", excess, np.einsum("nij,nj->ni", hessian, excess))
        near = (np.linalg.norm(excess, axis=1) < _NEAR_WALL_M) | (squared < IMPLAUSIBLE)
        keep &= near
        if not keep.any():
            return []
        outside = np.flatnonzero(keep & (excess != 0.0).any(axis=1))
        if len(outside):
            # Optima just outside, because of range errors: find the best positions on the wall.
            walls = prior.take(outside).with_walls(area.clip(x[outside]), excess[outside] != 0.0)
            x[outside], cost[outside], *_ = _descend(
                area.clip(x[outside]), anchors, range_m, sd_m, model, walls
            )
            x = area.clip(x)
        keep &= cost <= cost[keep].min() + IMPLAUSIBLE
    result: list[Place] = []
    for i in np.flatnonzero(keep)[np.argsort(cost[keep])]:
        if any(_same(x[i], place) for place in result):
            continue
        _, _, h, rows = _linearised(x[i : i + 1], anchors, range_m, sd_m, model, _Prior.of(1, height))
        covariance = np.linalg.inv(h[0] + 1e-6 * np.eye(3))
        # Of the damped normal equations, ranges only: their errors move the position by this much.
        gain = covariance @ (rows[0] / sd_m[:, None]).T
        result.append(Place(x[i].copy(), covariance, gain, float(cost[i])))
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Prior:
    """Independent priors of n positions: mean float64 (n, 3) and inverse variance (n, 3), 0 = none."""

    mean: NDArray[np.float64]
    information: NDArray[np.float64]

    @classmethod
    def of(cls, count: int, height: Height | None) -> _Prior:
        prior = cls(np.zeros((count, 3)), np.zeros((count, 3)))
        if height is not None:
            prior.mean[:, 2], prior.information[:, 2] = height.value, 1.0 / height.sd**2
        return prior

    def take(self, rows: NDArray[np.intp]) -> _Prior:
        return _Prior(self.mean[rows], self.information[rows])

    def with_walls(self, wall: NDArray[np.float64], held: NDArray[np.bool_]) -> _Prior:
        """The same, with the coordinates `held` bool (n, 3) at the walls."""
        return _Prior(np.where(held, wall, self.mean), np.where(held, 1.0 / _WALL_SD_M**2, self.information))


def _descend(
    x: NDArray[np.float64],
    anchors: NDArray[np.float64],
    range_m: NDArray[np.float64],
    sd_m: NDArray[np.float64],
    model: Model,
    prior: _Prior,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Levenberg-Marquardt from n starts: positions, loss, gradient and Hessian."""
    damping = np.full(len(x), 1e-2)
    cost, gradient, hessian, _ = _linearised(x, anchors, range_m, sd_m, model, prior)
    for _ in range(_STEPS):
        diagonal = np.einsum("nii->ni", hessian)
        damped = hessian + (damping[:, None] * diagonal + 1e-9)[:, :, None] * np.eye(3)
        trial = x - np.linalg.solve(damped, gradient[..., None])[..., 0]
        found = _linearised(trial, anchors, range_m, sd_m, model, prior)
        better = found[0] <= cost
        x = np.where(better[:, None], trial, x)
        cost = np.where(better, found[0], cost)
        gradient = np.where(better[:, None], found[1], gradient)
        hessian = np.where(better[:, None, None], found[2], hessian)
        damping = np.clip(np.where(better, damping / 4.0, damping * 8.0), 1e-8, 1e8)
    return x, cost, gradient, hessian


def _same(position: NDArray[np.float64], place: Place) -> bool:
    apart = position - place.position
    return bool(apart @ apart < 0.25 or apart @ np.linalg.solve(place.covariance, apart) < 4.0)


def _starts(
    anchors: NDArray[np.float64], range_m: NDArray[np.float64], height: Height | None
) -> NDArray[np.float64]:
    order = np.argsort(range_m)[:2]
    found = [anchors.mean(axis=0, keepdims=True) + 0.1]
    for i in order:
        if height is not None:
            # Not along the axes: anchors often lie in one, where two mirror images meet in a saddle.
            angle = 0.1 + np.arange(_AROUND) * (2.0 * np.pi / _AROUND)
            up = np.zeros_like(angle)
        else:
            # Points spread evenly over a sphere by the golden angle.
            k = np.arange(_SPHERE) + 0.5
            angle, up = np.pi * (1.0 + 5.0**0.5) * k, 1.0 - 2.0 * k / _SPHERE
        level = np.sqrt(1.0 - up * up)
        direction = np.stack([level * np.cos(angle), level * np.sin(angle), up], axis=1)
        found.append(anchors[i] + max(float(range_m[i]), 0.1) * direction)
    starts = np.concatenate(found)
    if height is not None:
        starts[:, 2] = height.value
    return starts


def _linearised(
    x: NDArray[np.float64],
    anchors: NDArray[np.float64],
    range_m: NDArray[np.float64],
    sd_m: NDArray[np.float64],
    model: Model,
    prior: _Prior,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Loss (n,), its gradient (n, 3), a Gauss-Newton Hessian (n, 3, 3), and weighted rows (n, k, 3) at places x."""
    away = x[:, None] - anchors
    distance = np.sqrt(np.einsum("nki,nki->nk", away, away))
    z = (range_m - distance) / sd_m
    weight = model.weight(z)
    slope = away / np.maximum(distance, 1e-6)[..., None] / sd_m[:, None]
    rows = slope * weight[..., None]
    cost = model.loss(z).sum(axis=1)
    gradient = -np.einsum("nki,nk->ni", rows, z)
    hessian = np.einsum("nki,nkj->nij", rows, slope)
    apart = x - prior.mean
    pull = prior.information * apart
    cost = cost + 0.5 * np.einsum("ni,ni->n", pull, apart)
    hessian[:, [0, 1, 2], [0, 1, 2]] += prior.information
    return cost, gradient + pull, hessian, rows
