"""Where the other anchors see the tag: of each range a length that its own anchor had no say in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.joint import FAR_S, JointFit, JointSolver, Links
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.rests import Stretches
from uwb_mitigation.positioning.smoother import Parameters
from uwb_mitigation.positioning.start import Height

MOST_REFITS = 8
MOST_GROUPS = 5


def less_parameters(links: Links, fit: JointFit) -> Links:
    """The same links, what the parameters explain taken off."""
    return replace(links, range_m=links.range_m - links.rows @ fit.parameters, rows=np.zeros((len(links), 0)))


def without(
    anchors: AnchorMap,
    links: Links,
    fit: JointFit,
    rows: NDArray[np.intp],
    height: Height | None,
    model: Model,
) -> JointFit:
    """The places without those anchors, the parameters as they are."""
    rest = less_parameters(links, fit).without(np.isin(links.anchor, rows))
    nothing = Parameters(rest.rows, np.zeros(0), np.zeros(0))
    return JointSolver(anchors, rest, nothing, model, height, fit.scale_m, fit.position).fit(
        fit.position, near=True
    )


def position_scatter(
    anchors: AnchorMap,
    links: Links,
    fit: JointFit,
    correction_m: NDArray[np.float64],
    height: Height | None,
    model: Model,
) -> float:
    """The error of the horizontal positions without ground truth, RMSE in m: the jackknife over the anchors.

    Errors of ranges that contradict each other move the track when an anchor is left out. An error that all anchors have in
    common is not seen.

    Args:
        correction_m: float64 (n,), what is subtracted from each range.

    Returns:
        NaN if too few anchors remain.
    """
    used = np.unique(links.anchor)
    groups = min(MOST_GROUPS, len(used))
    parts = [used[k::groups] for k in range(groups)]
    if len(used) - max(map(len, parts)) < (3 if height is not None else 4):
        return float("nan")
    corrected = replace(links, range_m=links.range_m - correction_m, rows=np.zeros((len(links), 0)))
    nothing = replace(fit, parameters=np.zeros(0))
    tracks = np.array(
        [without(anchors, corrected, nothing, part, height, model).position[:, :2] for part in parts]
    )
    squared = np.sum((tracks - tracks.mean(axis=0)) ** 2, axis=(0, 2))
    return float(np.sqrt(squared.mean() * (groups - 1) / groups))


def seen_by_others(
    anchors: AnchorMap, found: Stretches, links: Links, fit: JointFit, height: Height | None, model: Model
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """For each of the ranges how far its anchor is from where the others see the tag, and the deviation of that."""
    distance = np.full(len(found.ranges), np.nan)
    sd = np.full(len(found.ranges), np.nan)
    used = np.unique(links.anchor)
    # Of many anchors a few are left out at once: enough others remain.
    for part in (used[k::MOST_REFITS] for k in range(min(MOST_REFITS, len(used)))):
        try:
            seen = without(anchors, links, fit, part, height, model)
            covariance = seen.covariances()
        except (DatasetError, np.linalg.LinAlgError):
            continue
        own = np.isin(links.anchor, part)
        heard = np.zeros(len(links.time_s), np.bool_)
        heard[links.knot[~own]] = True
        knot, ahead = links.knot[own], links.ahead_s[own]
        away = (
            seen.position[knot] + ahead[:, None] * seen.velocity[knot] - anchors.position[links.anchor[own]]
        )
        away[:, 2] += links.rise[own]
        length = np.maximum(np.linalg.norm(away, axis=1), 0.05)
        unit = away / length[:, None]
        known = np.sqrt(np.einsum("ni,nij,nj->n", unit, covariance[knot], unit))
        known[~(_nearest_heard_s(links, heard)[knot] <= FAR_S)] = np.nan
        of_link, sd_of = np.full(len(links), np.nan), np.full(len(links), np.nan)
        of_link[own], sd_of[own] = length, known
        mine = np.isin(found.ranges.anchor, part)
        distance[mine], sd[mine] = of_link[links.of[mine]], sd_of[links.of[mine]]
    return distance, sd


def _nearest_heard_s(links: Links, heard: NDArray[np.bool_]) -> NDArray[np.float64]:
    """How far in time each knot is from one of its stretch that still has ranges; inf = there is none."""
    # Stretches set so far apart that none is near another.
    time = links.time_s + links.knot_stretch * (float(links.time_s.max(initial=0.0)) + 1e6)
    there = time[heard]
    if not len(there):
        return np.full(len(time), np.inf)
    after = (
        np.clip(np.searchsorted(there, time), 1, len(there) - 1)
        if len(there) > 1
        else np.zeros(len(time), int)
    )
    nearest: NDArray[np.float64] = np.minimum(np.abs(time - there[after]), np.abs(time - there[after - 1]))
    return nearest
