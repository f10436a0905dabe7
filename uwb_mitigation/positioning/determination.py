"""How well ranges determine the position of a tag: one statement, with its reason and remedies for this layout of anchors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.geometry import Area, Symmetry, dop, separation, unit_vectors
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.online.ambiguity import EXCLUDED_SD, LEVEL, RANGE_ERROR_M, Ambiguity
from uwb_mitigation.positioning.online.tag_estimator import CONTRADICTED_S, RANGE_TIMEOUT_S, TagEstimator
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Ranges, Track

UNIQUE, UNKNOWN, CONTRADICTED = Ambiguity.NONE.value, "unknown", "contradicted"

TOO_SHORT_SHARE = 0.03
"""See `drive_determination`. Shares with two swapped anchors: 0.04 to 0.47 where there are any (simulated); with right ones: 0."""

POOR_DOP = 10.0
"""A direction is weak if errors of ranges are multiplied by more."""

_TAG_DISTANCE_M, _OFFSET_SD_M = 1.0, NoiseModel().offset_sd
_ANCHOR_DISTANCES_M = (0.5, 1.0, 1.5, 2.0, 3.0, 5.0)

UNKNOWN_POSITION = "no position can be determined"


@dataclass(frozen=True, slots=True)
class Determination:
    """How well the position of a tag is determined.

    Attributes:
        state: a value of `Ambiguity`, `UNKNOWN`, or `CONTRADICTED`.
        reason, remedy: empty: none.
    """

    state: str
    reason: str
    remedy: str = ""

    @property
    def is_unique(self) -> bool:
        """Whether nothing has to be remedied."""
        return self.state == UNIQUE

    def __str__(self) -> str:
        return f"{self.state}: {self.reason}" + (f". Remedy: {self.remedy}" if self.remedy else "")


_CONTRADICTED = Determination(
    CONTRADICTED,
    "ranges of half of the anchors or more contradicted it twice, or those of two anchors are too short for it",
    "unless obstacles blocked them, or the tag was carried: check ids, coordinates and units in the anchors file, and the height; "
    "`uwb-mitigation survey` finds swapped anchors",
)


def determination(
    anchors: NDArray[np.float64],
    position: NDArray[np.float64] | None,
    ambiguity: Ambiguity,
    dims: int,
    *,
    area: Area | None = None,
    sd_m: float = RANGE_ERROR_M,
    is_weak: bool = False,
) -> Determination:
    """Return the statement for a tag.

    Args:
        anchors: those that are received, float64 (m, 3).
        position: of the tag, float64 (3,); None: no position explains the ranges.
        ambiguity: which other positions do so.
        dims: the number of unknown coordinates: 2 if the height is known or measured.
        area: in which the tag is, if known.
        sd_m: standard deviation with which the ranges of positions were compared.
        is_weak: the ranges do not determine the position at all.
    """
    if len(anchors) < dims:
        reason = f"{len(anchors)} anchors received, {dims} or more needed"
        return Determination(UNKNOWN, reason, "more anchors")
    symmetry = Symmetry.of(anchors, dims, RANGE_ERROR_M)
    if position is None and not symmetry.is_rotation:
        return Determination(
            UNKNOWN, "no position explains the ranges", "check the anchors file and the height"
        )
    if ambiguity in (Ambiguity.NONE, Ambiguity.WEAK) and position is not None:
        return _weak_direction(anchors, position, dims, is_weak=is_weak)
    offset = anchors - symmetry.center
    along = offset @ symmetry.axis
    if symmetry.is_rotation:
        distance_m = float(np.linalg.norm(offset - np.outer(along, symmetry.axis), axis=1).max())
        state: Ambiguity = ambiguity if ambiguity is Ambiguity.ARC else Ambiguity.CIRCLE
        where = "a line" if dims == 3 else "a vertical line"
        positions = f"the positions on {'an arc' if state is Ambiguity.ARC else 'a circle'} around it"
        remedies = _circle_remedies(anchors, dims)
    else:
        distance_m = float(np.abs(along).max())
        is_level = ambiguity is Ambiguity.HEIGHT
        state = ambiguity if is_level else Ambiguity.MIRROR
        where = "a plane" if dims == 3 else "a line in plan"
        positions = "a height above and one below it" if is_level else "positions on both sides of it"
        assert position is not None
        remedies = _mirror_remedies(anchors, position, symmetry, dims, area, sd_m, is_level=is_level)
    reason = f"are within {distance_m:.2f} m of {where}, so that {positions} explain ranges with errors of {sd_m:.2f} m"
    if len(anchors) == 2 and state is Ambiguity.MIRROR:
        reason = "leave two mirror positions, on both sides of their line"
    reason += "" if area is None else "; the area does not exclude them"
    return Determination(state.value, f"the {len(anchors)} received anchors {reason}", ", or ".join(remedies))


def current_determination(estimator: TagEstimator) -> Determination:
    """Return the statement for the latest ranges of a tag."""
    if estimator.is_contradicted:
        return _CONTRADICTED
    rows, ambiguity = estimator.received_anchors(RANGE_TIMEOUT_S), estimator.images.ambiguity
    if estimator.candidates > 1 and not estimator.is_ambiguous:
        ambiguity = Ambiguity.MIRROR
    anchors, position = estimator.anchors.position[rows], estimator.likely_position
    return determination(
        anchors,
        position,
        ambiguity,
        estimator.dims,
        area=estimator.config.area,
        sd_m=estimator.images.error_sd_m,
        is_weak=estimator.undetermined,
    )


def drive_determination(estimator: TagEstimator, ranges: Ranges, track: Track) -> Determination:
    """Return the statement for a drive: what held most often, at the position with the median HDOP.

    It is contradicted if the tag was lost twice within `CONTRADICTED_S`, and on average once within twice this time, or if
    for `TOO_SHORT_SHARE` of the ranges those of two anchors were too short.

    Args:
        estimator: that processed the drive.
        ranges: of the drive.
        track: positions of the drive; empty: the statement is that for the latest ranges.
    """
    duration_s = float(ranges.stamp_ns[-1] - ranges.stamp_ns[0]) / NS_PER_S
    counts = estimator.counts
    is_often_lost = counts["contradicted"] and 2.0 * CONTRADICTED_S * counts["lost"] >= duration_s
    if is_often_lost or counts["too short"] > TOO_SHORT_SHARE * len(ranges):
        return _CONTRADICTED
    ambiguities = estimator.images.counts.most_common(1)
    if not len(track) or not ambiguities:
        return current_determination(estimator)
    config, anchors = estimator.config, estimator.anchors.position[np.unique(ranges.anchor)]
    dims = 2 if config.heights is not None else config.dims
    sample = track.position[:: max(len(track) // 200, 1)]
    order = np.argsort([dop(anchors, position, level=dims == 2).hdop for position in sample])
    position, sd_m = sample[order[len(order) // 2]], estimator.images.error_sd_m
    return determination(anchors, position, ambiguities[0][0], dims, area=config.area, sd_m=sd_m)


def _weak_direction(
    anchors: NDArray[np.float64], position: NDArray[np.float64], dims: int, *, is_weak: bool
) -> Determination:
    slope = unit_vectors(position, anchors)[0][:, :dims]
    values, directions = np.linalg.eigh(slope.T @ slope)
    factor = 1.0 / math.sqrt(max(float(values[0]), 1e-6))
    if factor <= POOR_DOP and not is_weak:
        one = dop(anchors, position, level=dims == 2)
        return Determination(UNIQUE, f"HDOP {one.hdop:.1f}" + (f", VDOP {one.vdop:.1f}" * (dims == 3)))
    direction = directions[:, 0] * (1.0 if directions[np.abs(directions[:, 0]).argmax(), 0] > 0.0 else -1.0)
    text = ", ".join(f"{value:.1f}" for value in np.round(direction, 1) + 0.0)
    remedies = [f"another anchor in the direction ({text}) from the tag"]
    if dims == 3 and dop(anchors, position, level=True).hdop <= POOR_DOP:
        remedies.insert(0, "the height of the tag")
    return Determination(
        Ambiguity.WEAK.value,
        f"errors of ranges are multiplied by {factor:.0f} in the direction ({text})",
        ", or ".join(remedies),
    )


def _mirror_remedies(
    anchors: NDArray[np.float64],
    position: NDArray[np.float64],
    mirror: Symmetry,
    dims: int,
    area: Area | None,
    sd_m: float,
    *,
    is_level: bool,
) -> list[str]:
    """Return what excludes the image, for a tag that is `_TAG_DISTANCE_M` or more from the mirror.

    A known height leaves no other position if these differ in height only (`is_level`).
    """
    has_height_remedy = is_level or (dims == 3 and _is_unique(anchors, position, 2, sd_m))
    remedies = ["the height of the tag"] if has_height_remedy else []
    if abs(mirror.axis[2]) > LEVEL:
        low_m, high_m = _heights(mirror, anchors, area)
        remedies.append(f"an area above z = {high_m:.2f} m or below {low_m:.2f} m")
    else:
        remedies.append(f"an area on one side of this {'plane' if dims == 3 else 'line'}")
    for distance_m in _ANCHOR_DISTANCES_M:
        added = anchors + distance_m * mirror.axis
        if all(_is_unique(np.vstack([anchors, one]), position, dims, sd_m) for one in added):
            name = "plane" if dims == 3 else "line"
            return [*remedies, f"another anchor {distance_m:.1f} m or more from this {name}"]
    return remedies


def _circle_remedies(anchors: NDArray[np.float64], dims: int) -> list[str]:
    anchors_off_line = "two more anchors, not in one plane with these"
    if dims == 2:
        return ["two more anchors, not on one line in plan with these"]
    if Symmetry.of(anchors, 2, RANGE_ERROR_M).is_rotation:
        # With a height, the circle stays.
        return [anchors_off_line]
    return ["the height of the tag and an area on one side of the line", anchors_off_line]


def _is_unique(anchors: NDArray[np.float64], position: NDArray[np.float64], dims: int, sd_m: float) -> bool:
    """Whether the ranges of a position and those of its image differ."""
    symmetry = Symmetry.of(anchors, dims, RANGE_ERROR_M)
    if symmetry.is_rotation:
        return False
    along = float((position - symmetry.center) @ symmetry.axis)
    place = position + math.copysign(max(_TAG_DISTANCE_M - abs(along), 0.0), along) * symmetry.axis
    separations = separation(anchors, place, symmetry.images(place), sd_m, _OFFSET_SD_M, dims)
    return bool(separations[0] >= EXCLUDED_SD)


def _heights(mirror: Symmetry, anchors: NDArray[np.float64], area: Area | None) -> tuple[float, float]:
    """Return the lowest and highest point of a mirror in the area, or in three times the extent of the anchors, m."""
    low, high = anchors.min(axis=0), anchors.max(axis=0)
    # A tag, and thus its area, can be outside of the anchors.
    corners = np.array([2 * low - high, 2 * high - low] if area is None else [area.low, area.high])
    x, y = np.meshgrid(corners[:, 0] - mirror.center[0], corners[:, 1] - mirror.center[1])
    z = mirror.center[2] - (mirror.axis[0] * x + mirror.axis[1] * y) / mirror.axis[2]
    return math.floor(100.0 * z.min()) / 100.0, math.ceil(100.0 * z.max()) / 100.0
