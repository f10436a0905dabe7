"""Checks that a drive determines a calibration without ground truth: layout of the anchors, motion, mirror images and height."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.hypotheses import LIMITS
from uwb_mitigation.calibration.joint_fit import JointFit, Start, fit_joint
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.geometry import Area, Height, Symmetry, extents
from uwb_mitigation.types.anchors import AnchorMap

HEIGHTS_M = np.array([-2.0, -1.5, -1.0, 1.0, 1.5, 2.0])
"""Changes of the height that are tried. Ranges that obstacles lengthen often fit a height better that is wrong by 0.5 m."""

HEIGHT_GAIN = 0.12
"""The share of the misfit that another height must explain, in addition to `LIMITS.gain`: ranges to anchors above the tag
that obstacles lengthen also fit a lower tag better. Simulated: at most 0.09 with the right height, 0.18 or more if it is wrong
by 1.5 m."""

MOVES_M = 1.0
"""Positions within less have the same errors of the ranges: reflections change within about half a metre."""

MIN_INDEPENDENT = 20
"""Independent ranges in addition to those that the positions at rest need."""


def check_layout(
    anchors: AnchorMap, used: NDArray[np.intp], height: Height | None, area: Area | None = None
) -> None:
    """Refuse anchors that do not determine positions and offsets.

    Args:
        anchors: anchors of the file.
        used: rows of the received anchors.
        height: height of the tags, if constant.
        area: of the tags; it can exclude the mirror image of a track at a plane of anchors.

    Raises:
        DatasetError: too few, or all on a line (without a height: in a plane).
    """
    needed = 4 if height is not None else 5
    if len(used) < needed:
        raise DatasetError(
            f"{len(used)} anchors were received",
            valid=f"{needed} or more" + (", or four and --height" if height is None else ""),
        )
    position = anchors.position[used]
    if height is not None:
        position = position * (1.0, 1.0, 0.0)
    if extents(position) < 2:
        raise DatasetError("the anchors are all on a line", valid="one or more that are not on this line")
    if height is None and area is None and extents(position) == 2:
        raise DatasetError(
            "the anchors are all in a plane: the mirror image of the track explains the ranges equally well",
            valid="--height of the tag, --area on one side of the plane, or an anchor above or below that plane",
        )


def check_motion(fit: JointFit) -> None:
    """Refuse recordings in which positions and offsets cannot be separated.

    Raises:
        DatasetError: the tags do not move enough, or there are too few independent ranges.
    """
    spread = float(np.linalg.norm(np.ptp(fit.position, axis=0)))
    if spread < MOVES_M:
        raise DatasetError(
            f"the tag moves by {spread:.1f} m only: its position and the offset cannot be separated",
            valid=f"a drive of {MOVES_M:g} m or more, or tags at several positions",
        )
    independent = float(fit.observations.independent.sum())
    needed = MIN_INDEPENDENT + 1.5 * fit.config.dims * int(fit.observations.is_stationary.sum())
    if independent < needed:
        raise DatasetError(
            f"{len(fit.observations.observation_index)} ranges, {independent:.0f} of them independent: too few",
            valid=f"{needed:.0f} or more: a longer drive, or more anchors at each position",
        )


def mirrored(fit: JointFit) -> NDArray[np.bool_]:
    """Return which segments have a mirror image beyond the anchors that explains the ranges equally well, bool (s,)."""
    config, observations = fit.config, fit.observations
    used = config.anchors.position[np.unique(observations.anchor)]
    mirror = Symmetry.of(used, config.dims, 0.0)
    image = np.concatenate([mirror.images(position) for position in fit.position])
    corrected = observations.range_m - observations.rows @ fit.parameters
    try:
        refit = fit.positions_only(corrected, Start(image))
    except DatasetError:
        return np.zeros(len(fit.segment_loss), np.bool_)
    is_distinct = np.linalg.norm(refit.position - fit.position, axis=1) > MOVES_M
    if config.area is not None:
        is_distinct &= config.area.holds(refit.position)
    distinct_share = np.bincount(observations.knot_segment, is_distinct) / np.bincount(
        observations.knot_segment
    )
    return (refit.segment_loss - fit.segment_loss < LIMITS.indistinct) & (distinct_share > 0.5)


def check_height(fit: JointFit) -> None:
    """Refuse a height with which the ranges fit much worse than with another one.

    Raises:
        DatasetError: gives the better height.
    """
    config, height = fit.config, fit.config.height
    if height is None:
        return
    best_gain, best_m = max(LIMITS.gain, HEIGHT_GAIN * fit.loss), height.value
    for change_m in HEIGHTS_M[np.abs(HEIGHTS_M) > 3.0 * height.sd].tolist():
        changed = replace(config, height=replace(height, value=height.value + change_m))
        try:
            refit = fit_joint(changed, fit.observations, fit.prior, fit.start(), fit.scale_m)
        except DatasetError:
            continue
        if fit.loss - refit.loss > best_gain:
            best_gain, best_m = fit.loss - refit.loss, height.value + change_m
    if best_m != height.value:
        raise DatasetError(
            f"the height of {height.value:g} m contradicts the ranges: they fit a height of about {best_m:g} m much better",
            valid="the height of the tag's antenna in the coordinates of the anchors",
        )
