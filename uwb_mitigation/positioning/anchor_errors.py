"""Errors in the anchors file: an anchor that is not where the file says, and two that are swapped.

The ranges of such an anchor look like ranges with an offset. The difference is that the error depends on the direction
to the tag. So the hypothesis of another position competes with that of an offset, by their likelihoods.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.joint import JointFit, JointSolver, Links, links_of
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.own_offsets import Columns
from uwb_mitigation.positioning.rests import Stretches
from uwb_mitigation.positioning.smoother import Parameters
from uwb_mitigation.positioning.start import Area, Height
from uwb_mitigation.positioning.starting import first_positions
from uwb_mitigation.positioning.tracks import Ranges

MISPLACED_M = 0.4
"""A smaller displacement looks like reflections."""

LIKELIER = 12.0
"""The log likelihood by which another position must explain the ranges better than an offset."""

LARGER = 0.35
"""The share of the misfit that two swapped anchors must also explain."""

SUSPECT_OFFSET_M, SUSPECT_MISFIT = 0.3, 2.5
"""An anchor is examined if its offset is that far from the median offset (radios of one kind differ by 0.3 m at three
sigma, Decawave APS014), or if its median residual is that many times the median of all."""

MISFIT_M, MISFIT_SHARE = 0.5, 0.08
"""Swaps are examined if this share of the ranges has larger residuals."""

_DISPLACEMENT_SD_M = 2.0
_STEPS = 6
_MOST_RANGES = 1000


def check_anchor_positions(
    anchors: AnchorMap,
    tags: list[Ranges],
    found: Stretches,
    solved: Columns,
    links: Links,
    fit: JointFit,
    height: Height | None,
    area: Area | None,
    model: Model,
) -> None:
    """Refuse ranges that other anchor positions explain much better.

    Args:
        tags: all ranges. found, solved, links, fit: the solution with the positions of the file.

    Raises:
        DatasetError: names the anchors.
    """
    fix = "their true positions in the anchors file (`uwb-mitigation survey` finds them)"
    best: tuple[float, int, float] | None = None
    for row in _suspects(links, solved, fit):
        moved_m, gain = _displaced(row, anchors, found, solved, fit, height, model)
        if moved_m > MISPLACED_M and gain > LIKELIER and (best is None or gain > best[0]):
            best = gain, row, moved_m
    misfit = float((links.share * (np.abs(fit.residual_m) > MISFIT_M)).sum() / links.share.sum())
    if misfit > MISFIT_SHARE:
        pair = _swapped(anchors, tags, found, solved, fit, height, area, model)
        if pair is not None:
            a, b = (anchors.anchors[row] for row in pair)
            raise DatasetError(
                f"anchors {a} and {b} contradict the others: swapped, they explain the ranges", valid=fix
            )
    if best is not None:
        _, row, moved_m = best
        raise DatasetError(
            f"anchor {anchors.anchors[row]} contradicts the others: {moved_m:.1f} m from its position in the anchors "
            "file, it explains the ranges",
            valid=fix,
        )


def _suspects(links: Links, solved: Columns, fit: JointFit) -> list[int]:
    used = np.unique(links.anchor)
    own = {name: float(value) for name, value in zip(solved.names, fit.parameters, strict=True)}
    offset = np.array([own.get(f"anchor {row}", 0.0) for row in used])
    size = np.abs(fit.residual_m)
    misfit = np.array([np.median(size[links.anchor == row]) for row in used])
    suspect = (np.abs(offset - np.median(offset)) > SUSPECT_OFFSET_M) | (
        misfit > SUSPECT_MISFIT * np.median(size)
    )
    return [int(row) for row in used[suspect]]


def _displaced(
    row: int,
    anchors: AnchorMap,
    found: Stretches,
    solved: Columns,
    fit: JointFit,
    height: Height | None,
    model: Model,
) -> tuple[float, float]:
    """The horizontal displacement of an anchor that explains the ranges best, m, and the gain in log likelihood."""
    keep = np.array([name != f"anchor {row}" for name in solved.names])
    base = Columns(
        tuple(name for name, kept in zip(solved.names, keep, strict=True) if kept),
        solved.rows[:, keep],
        solved.alike,
        solved.mean[keep],
        solved.sd[keep],
    )
    links = links_of(found, base.rows, base.alike, model)
    own = links.anchor == row
    position, shared, moved = fit.position, fit.parameters[keep], anchors
    gain, axes = 0.0, slice(0, 2)
    parameters = base.parameters(links)
    try:
        for _ in range(_STEPS):
            away = position[links.knot] - moved.position[links.anchor]
            away[:, 2] += links.rise
            unit = away / np.maximum(np.linalg.norm(away, axis=1), 0.05)[:, None]
            rows = np.concatenate([parameters.rows, -unit[:, axes] * own[:, None]], axis=1)
            shift = moved.position[row, axes] - anchors.position[row, axes]
            with_shift = Parameters(
                rows,
                np.concatenate([parameters.mean, -shift]),
                np.concatenate([parameters.sd, np.full(2, _DISPLACEMENT_SD_M)]),
            )
            solver = JointSolver(
                moved, replace(links, rows=rows), with_shift, model, height, fit.scale_m, position
            )
            other = solver.fit(position, np.concatenate([shared, np.zeros(2)]), near=True)
            position, shared, step = other.position, other.parameters[:-2], other.parameters[-2:]
            where = moved.position.copy()
            where[row, axes] += step
            moved = moved.moved(where, moved.sd)
            gain = fit.loss - other.loss
            if float(np.abs(step).max()) < 0.02:
                break
    except DatasetError:
        return 0.0, 0.0
    return float(np.linalg.norm(moved.position[row] - anchors.position[row])), gain


def _swapped(
    anchors: AnchorMap,
    tags: list[Ranges],
    found: Stretches,
    solved: Columns,
    fit: JointFit,
    height: Height | None,
    area: Area | None,
    model: Model,
) -> tuple[int, int] | None:
    """The pair of anchors that explains the ranges best if swapped; None: no pair does so much better."""
    part = np.arange(min(len(found.ranges), _MOST_RANGES))
    few = Stretches(
        found.ranges.take(part),
        found.tag[part],
        found.row[part],
        found.of[part],
        found.at_rest,
        found.rise[part],
    )
    few = few.keep(np.isin(np.arange(len(found)), few.of))
    columns = solved.take(np.isin(np.arange(len(found.ranges)), part))
    expected = columns.rows @ solved.mean
    scale = np.maximum(fit.scale_m, 0.1)

    def loss(order: NDArray[np.intp]) -> float:
        tried = anchors.moved(anchors.position[order], anchors.sd)
        position, placed = first_positions(tried, tags, few, expected, height, area, model)
        if not placed.all():
            return np.inf
        links = links_of(few, columns.rows, columns.alike, model)
        try:
            return (
                JointSolver(tried, links, columns.parameters(links), model, height, scale).fit(position).loss
            )
        except DatasetError:
            return np.inf

    order = np.arange(len(anchors))
    now = loss(order)
    best: tuple[int, int] | None = None
    limit = (1.0 - LARGER) * now - LIKELIER
    for a, b in itertools.combinations(np.unique(found.ranges.anchor).tolist(), 2):
        swapped = order.copy()
        swapped[[a, b]] = b, a
        if (value := loss(swapped)) < limit:
            best, limit = (a, b), value
    return best
