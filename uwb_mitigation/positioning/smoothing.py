"""The smoothed track of a recording: the live filter forwards and backwards, and the batch smoother.

The batch smoother is best where offsets and smooth motion have to replace geometry: far away from a small group of
anchors. Among NLOS errors and in weakly observable heights it trusts its model too much, and its errors exceed those of
the live filter. So its covariance is enlarged, and the three tracks are fused by covariance intersection, which stays
consistent whatever the correlation of their errors is (Julier, Uhlmann 1997; weights of Niehsen 2002).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.locator import TagLocator, run_live
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.smoother import Smoother, knots_of
from uwb_mitigation.positioning.start import Area, Height
from uwb_mitigation.positioning.tracks import Heights, Ranges, Track

BATCH_BIAS_M = 0.2
"""Standard deviation of the batch smoother's bias that its covariance does not contain: a typical NLOS error."""

_OLDEST_NS = 1_000_000_000
_SECOND_NS = 1_000_000_000


def smooth(
    anchors: AnchorMap,
    model: Model,
    ranges: Ranges,
    live: Track,
    *,
    height: Height | None = None,
    area: Area | None = None,
    heights: Heights | None = None,
) -> Track:
    """Return positions at ten stamps a second, each from all ranges before and after it.

    Args:
        anchors, model, height, area: As of `TagLocator`.
        ranges: Two or more.
        live: The track of `run_live` from the same ranges; not empty.
        heights: Measured heights of the tag.
    """
    stamp_ns = int(ranges.stamp_ns[0]) + knots_of(ranges.stamp_ns)[0]
    end_ns = int(ranges.stamp_ns[-1])
    backwards = slice(None, None, -1)
    reversed_ranges = ranges.take(backwards)
    mirrored = Ranges(
        end_ns - reversed_ranges.stamp_ns,
        reversed_ranges.anchor,
        reversed_ranges.range_m,
        reversed_ranges.variance_m2,
        reversed_ranges.rx_power_dbm,
        ranges.tag_id,
    )
    mirrored_heights = heights and Heights(
        end_ns - heights.stamp_ns[backwards], heights.height_m[backwards], heights.variance_m2[backwards]
    )
    locator = TagLocator(anchors, model, height=height, area=area)
    later = _at(run_live(mirrored, locator, mirrored_heights).track, (end_ns - stamp_ns)[backwards])
    flip = np.diag([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    later = later[0][backwards] @ flip, flip @ later[1][backwards] @ flip
    state, covariance, spread = _fused(_at(live, stamp_ns), later)
    # Without a position of either filter the batch smoother's choice among several optima is arbitrary.
    found = np.asarray(np.isfinite(state).all(axis=1), np.bool_)
    try:
        batch = Smoother(anchors, model, ranges, height=height, heights=heights).fit(live).track
    except DatasetError:
        batch = None
    if batch is not None:
        bias = np.diag([BATCH_BIAS_M**2] * 3 + [0.0] * 3)
        own, own_covariance = (
            np.concatenate([batch.position, batch.velocity], axis=1),
            batch.covariance + bias,
        )
        apart = (own - state)[:, :3]
        expected = _regular((covariance + own_covariance)[:, :3, :3])
        squared = np.einsum("ni,ni->n", apart, np.linalg.solve(expected, apart[..., None])[..., 0])
        # Where it contradicts the filters, it is in another optimum.
        own_covariance = own_covariance * np.fmax(squared / 3.0, 1.0)[:, None, None]
        state, covariance, more = _fused((state, covariance), (own, own_covariance))
        spread += more
    position = state[:, :3] if area is None else area.clip(state[:, :3])
    return Track(stamp_ns, position, state[:, 3:], covariance + spread).take(found)


def _at(track: Track, stamp_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """States float64 (k, 6) and covariances (k, 6, 6) predicted from the latest estimates; NaN without a recent one."""
    if len(track) == 0:
        return np.full((len(stamp_ns), 6), np.nan), np.full((len(stamp_ns), 6, 6), np.nan)
    latest = np.searchsorted(track.stamp_ns, stamp_ns, side="right") - 1
    age_ns = stamp_ns - track.stamp_ns[latest]
    age_s = age_ns[:, None] / _SECOND_NS
    state = np.concatenate(
        [track.position[latest] + age_s * track.velocity[latest], track.velocity[latest]], axis=1
    )
    covariance = track.covariance[latest].copy()
    absent = (latest < 0) | (age_ns > _OLDEST_NS)
    state[absent], covariance[absent] = np.nan, np.nan
    return state, covariance


def _fused(
    one: tuple[NDArray[np.float64], NDArray[np.float64]],
    other: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Fuse states (k, 6) with covariances (k, 6, 6) by covariance intersection; where one is NaN, take the other.

    Returns:
        States, covariances, and the spread of the two means (k, 6, 6), as in a mixture: where they differ, one is wrong.
    """
    (a, p), (b, q) = one, other
    state, covariance = np.where(np.isfinite(a), a, b), np.where(np.isfinite(p), p, q)
    spread = np.zeros_like(covariance)
    both = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    p, q = _regular(p[both]), _regular(q[both])
    trace = [np.einsum("nii->n", c[:, :3, :3]) for c in (p, q)]
    weight = (trace[1] / (trace[0] + trace[1]))[:, None, None]
    of_p, of_q = weight * np.linalg.inv(p), (1.0 - weight) * np.linalg.inv(q)
    found = np.linalg.inv(of_p + of_q)
    covariance[both] = found
    apart = a[both] - b[both]
    spread[both] = weight * (1.0 - weight) * np.einsum("ni,nj->nij", apart, apart)
    weighted = of_p @ a[both][..., None] + of_q @ b[both][..., None]
    state[both] = (found @ weighted)[..., 0]
    return state, covariance, spread


def _regular(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Without the zero variances of a level tag."""
    regular: NDArray[np.float64] = covariance + 1e-9 * np.eye(covariance.shape[-1])
    return regular
