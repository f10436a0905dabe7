"""Survey of the anchors, from rough guesses and the ranges of a tag that moves among them.

Track and anchors are estimated together. Ranges do not determine position and orientation of the whole: these come from
the guesses, or from fixed anchors. Swapped anchors are tried first, because Gauss-Newton does not find them from the guesses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.calibration.hypotheses import LIMITS, AnchorHypotheses, find_swapped
from uwb_mitigation.calibration.motion_segments import find_segments
from uwb_mitigation.calibration.observability import MOVES_M
from uwb_mitigation.calibration.regression import Regressors
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.batch.smoother import Smoothed, Smoother
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import extents
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator
from uwb_mitigation.types.anchors import AnchorMap
from uwb_mitigation.types.tracks import Ranges, Track

_UNLIKELY = 2.2
"""An anchor is misplaced if it is further from its guess than `LIMITS.displacement_m` and than this number of standard
deviations. In a plane, an error exceeds this multiple of its RMS with a probability of 1/126: exp(-2.2^2)."""

TAPE_M = 0.1
"""Accuracy of a measured height."""

_STEPS_M = (1.0, 0.5, 0.25, 0.0)
"""Standard deviations of ranges decrease in steps, so that the first steps tolerate errors of a metre."""

UNEXPLAINED = 0.6
"""In real drives the loss was 0.7 or more if anchors were not found, or if a pair was wrongly reported as swapped."""

_AS_WELL = 1.5
"""Mirror images whose distances from the guesses differ by a smaller factor fit them equally well."""


@dataclass(frozen=True, slots=True, eq=False)
class SurveyResult:
    """The result.

    Attributes:
        anchors: at the estimated positions, with standard deviations.
        moved_m: float64 (m,), distances from the guesses after alignment.
        misplaced: rows of anchors too far from their guesses.
        swapped: pairs of rows that are swapped in the file.
        track: of the tag.
        loss: mean robust loss of a range.
        alternatives: {row: float64 (3,)}, other positions of single anchors that explain the ranges equally well.
        undetermined: rows of anchors whose standard deviation relative to the others exceeds
            `LIMITS.displacement_m`.
        mirrored: the mirror image of all anchors fits the guesses about as well; ranges never decide between the two.
    """

    anchors: AnchorMap
    moved_m: NDArray[np.float64]
    misplaced: list[int]
    swapped: list[tuple[int, int]]
    track: Track
    loss: float
    alternatives: dict[int, NDArray[np.float64]]
    undetermined: list[int]
    mirrored: bool

    @property
    def explained(self) -> bool:
        """Whether the loss is below `UNEXPLAINED`: otherwise the anchors may be anywhere."""
        return self.loss < UNEXPLAINED

    def as_json(self) -> dict[str, object]:
        """Return the keys of `survey --json`; anchors by their ids."""
        ids = [anchor.id for anchor in self.anchors.anchors]
        return {
            "anchors": [
                dict(zip("xyz", anchor.position, strict=True))
                | {"id": anchor.id, "sd": anchor.sd, "moved_m": float(self.moved_m[row])}
                for row, anchor in enumerate(self.anchors.anchors)
            ],
            "misplaced": [ids[row] for row in self.misplaced],
            "swapped": [[ids[row] for row in pair] for pair in self.swapped],
            "alternatives": {str(ids[row]): where.tolist() for row, where in self.alternatives.items()},
            "undetermined": [ids[row] for row in self.undetermined],
            "mirrored": self.mirrored,
            "mean_loss": self.loss,
            "explained": self.explained,
        }


def survey_anchors(
    config: EstimatorConfig, ranges: Ranges, *, off_m: float = 1.0, fixed: frozenset[int] = frozenset()
) -> SurveyResult:
    """Estimate the positions of the anchors.

    Args:
        config: its anchors are at approximate positions.
        ranges: of one tag that moves.
        off_m: standard deviation of each coordinate of the guesses. With a `height`, that of the heights of anchors is at
            most `TAPE_M`: a drive at constant height hardly determines them.
        fixed: rows of anchors that have the standard deviations of the file.

    Raises:
        DatasetError: too few anchors, all on a line, or a tag that hardly moves; says which.
    """
    # The standard deviations of the anchors must be honest: `smooth` enlarges its covariances, a survey does not.
    config = replace(config, model=replace(config.model, smoother_white=config.model.white))
    guesses, used, needed = config.anchors, np.unique(ranges.anchor), config.dims + 1
    if len(used) < needed:
        raise DatasetError(f"{len(used)} anchors were received", valid=f"{needed} or more for a survey")
    if extents(guesses.position[used]) < 2:
        raise DatasetError("the anchors are all on a line", valid="at least one next to the line")
    deviations = np.array(
        [sd if row in fixed else max(off_m, sd) for row, sd in enumerate(guesses.sd.tolist())]
    )
    swapped = _swapped_guesses(config, ranges, off_m)
    order = np.arange(len(guesses))
    order[swapped] = swapped[::-1]
    fit = _fit(replace(config, anchors=guesses.moved(guesses.position[order], deviations)), ranges)
    sd_m = np.sqrt(config.model.variances(ranges.variance_m2))
    loss = float(config.model.loss(fit.residual_m / sd_m).mean())
    free = [row for row in used.tolist() if row not in fixed]
    # A drive at constant height hardly determines heights: they are those of the guesses.
    axes = slice(0, config.dims)
    distance = np.zeros(len(guesses))
    distance[used] = np.linalg.norm(displacements(fit.anchors[used], guesses.position[used])[:, axes], axis=1)
    relative_sd = np.linalg.norm(_relative_sd(fit.anchors, fit.anchor_covariance)[:, axes], axis=1)
    sd = np.sqrt(np.einsum("ijij->i", fit.anchor_covariance) / 3.0)
    hypotheses = _hypotheses(config, fit, ranges)
    alternatives = {row: hypotheses.mirror_image(row, config.dims) for row in free}
    plain, mirror = (
        _misfit(fit.anchors[used], guesses.position[order][used], mirrored=side) for side in (False, True)
    )
    return SurveyResult(
        anchors=guesses.moved(fit.anchors, np.maximum(sd, 1e-3)),
        moved_m=distance,
        misplaced=[
            int(row)
            for row in used
            if distance[row] > max(LIMITS.displacement_m, _UNLIKELY * relative_sd[row])
        ],
        swapped=[(swapped[0], swapped[1])] if swapped else [],
        track=fit.track,
        loss=loss,
        alternatives={row: position for row, position in alternatives.items() if position is not None},
        undetermined=[row for row in free if relative_sd[row] > LIMITS.displacement_m],
        mirrored=not fixed and mirror < _AS_WELL * max(plain, TAPE_M),
    )


def _swapped_guesses(config: EstimatorConfig, ranges: Ranges, off_m: float) -> list[int]:
    """Return the rows of two guesses that are swapped, or an empty list."""
    guesses, used = config.anchors, np.unique(ranges.anchor)
    tried = replace(config, anchors=guesses.moved(guesses.position, np.full(len(guesses), off_m)))
    scale_m = np.array([np.hypot(off_m / 2.0, config.model.range_sd)])
    segments = find_segments([ranges])
    pair = find_swapped(tried, segments, Regressors.none(len(segments.ranges)), scale_m, used)
    if pair is None:
        return []
    order = np.arange(len(guesses))
    order[list(pair)] = pair[::-1]
    # In a square, swapped opposite anchors are the mirror image of the right ones: ranges cannot distinguish the two.
    mirrored_m = _misfit(guesses.position[order][used], guesses.position[used], mirrored=True)
    return list(pair) if mirrored_m > _AS_WELL * off_m else []


def _fit(config: EstimatorConfig, ranges: Ranges) -> Smoothed:
    start = config.anchors
    track = TagEstimator(config).run(ranges)
    if len(track) < 2:
        raise DatasetError(
            "no position of the tag can be determined",
            valid="better guesses, an area, or a height; four anchors or more",
        )
    spread = float(np.hypot(*np.ptp(track.position[:, :2], axis=0)))
    if spread < MOVES_M:
        raise DatasetError(f"the tag moves by {spread:.1f} m only", valid=f"{MOVES_M:g} m or more")
    around = np.repeat(start.sd[:, None], 3, axis=1)
    if config.height is not None:
        around[:, 2] = np.minimum(around[:, 2], TAPE_M)
    variance, anchors = config.model.variances(ranges.variance_m2), start
    for step in _STEPS_M:
        fit = Smoother(
            replace(config, anchors=anchors),
            replace(ranges, variance_m2=np.maximum(variance, step**2)),
            find_anchors=True,
            around=(start.position, around),
        ).fit(track)
        track, anchors = fit.track, anchors.moved(fit.anchors, start.sd)
    return fit


def _misfit(position: NDArray[np.float64], guess: NDArray[np.float64], *, mirrored: bool) -> float:
    """Return the horizontal RMS distance between estimated anchors (m, 3), or their mirror image, and the guesses."""
    side = -1.0 if mirrored else 1.0
    return float(np.sqrt(np.mean(displacements(position * (side, 1.0, 1.0), guess)[:, :2] ** 2)))


def _hypotheses(config: EstimatorConfig, fit: Smoothed, ranges: Ranges) -> AnchorHypotheses:
    """Return hypotheses about the estimated positions, for the estimated track."""
    track = fit.track
    tag = np.stack([np.interp(ranges.stamp_ns, track.stamp_ns, axis) for axis in track.position.T], axis=1)
    # Residuals of the fit, with what it attributes to offsets: another position has to explain the same ranges.
    distance_m = np.linalg.norm(tag - fit.anchors[ranges.anchor], axis=1)
    ranges = replace(ranges, range_m=distance_m + fit.residual_m)
    return AnchorHypotheses(config.anchors.moved(fit.anchors, config.anchors.sd), ranges, tag)


def displacements(position: NDArray[np.float64], guess: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the displacement of each anchor (m, 3) from its guess, after alignment with the guesses.

    The alignment, a translation and a rotation about the vertical, is a robust fit: one misplaced anchor does not displace the
    others.
    """
    weight = np.ones(len(position))
    off = position - guess
    for _ in range(30):
        total = weight.sum()
        p, q = position - (weight @ position) / total, guess - (weight @ guess) / total
        x, y = (weight[:, None] * p[:, :2]).T @ q[:, :2]
        angle = np.arctan2(x[1] - y[0], x[0] + y[1])
        c, s = np.cos(angle), np.sin(angle)
        turned = p @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        off = turned - q
        weight = 1.0 / np.maximum(np.linalg.norm(off, axis=1), 0.02)
    return off


def _relative_sd(position: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return standard deviations (m, 3) of anchors (m, 3), except for translation and rotation of the whole.

    Args:
        position: positions of the anchors, float64 (m, 3), m.
        covariance: float64 (m, 3, m, 3).
    """
    m = len(position)
    rigid = np.zeros((m, 3, 4))
    rigid[:, [0, 1, 2], [0, 1, 2]] = 1.0
    centred = position - position.mean(axis=0)
    rigid[:, 0, 3], rigid[:, 1, 3] = -centred[:, 1], centred[:, 0]
    basis, _ = np.linalg.qr(rigid.reshape(3 * m, 4))
    projection = np.eye(3 * m) - basis @ basis.T
    spread = np.diag(projection @ covariance.reshape(3 * m, 3 * m) @ projection).reshape(m, 3)
    return np.sqrt(spread)
