"""Hypotheses that contradict the anchors file: an anchor is elsewhere, or two are swapped.

The ranges of an anchor that is not where the file says look like ranges with an offset, but their errors depend on the
direction to the tag. So each hypothesis competes with the position of the file and an offset, by their likelihoods.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from uwb_mitigation.calibration.first_positions import first_positions
from uwb_mitigation.calibration.joint_fit import JointFit, Start, fit_joint, observations_of
from uwb_mitigation.calibration.motion_segments import GAP_S, Segments
from uwb_mitigation.calibration.regression import MAD_TO_SD, Regressors
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.geometry import unit_vectors
from uwb_mitigation.types.anchors import Anchor, AnchorMap
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Ranges


@dataclass(frozen=True, slots=True)
class HypothesisLimits:
    """How much better a hypothesis must explain the ranges than the anchors file.

    Attributes:
        displacement_m: a smaller displacement looks like reflections.
        gain: minimum gain in log likelihood (chi-squared of two unknowns: e^-12 by chance).
        explained_share: minimum share of the anchor's misfit that a displacement explains. Obstacles that fit one explain 0.39 to 0.62 of it
            (simulated sites 4, 7, 8 and 9); a true one by 1 m explains 0.72 to 0.86 (sites 3 and 6).
        independent_m, independent_share: both limits if the positions do not depend on the anchors: errors of other anchors cannot
            look like a displacement then. Walls fit displacements that explain up to 0.43 of the misfit, and those above 0.5 m up to
            0.37 (simulated sites 360, 364 and 700 to 715). Of 94 anchors that are 1 m and 2 m off, 70 and 89 exceed both limits.
        swap_share: minimum share of the misfit of all anchors that a swap explains.
        stands_out: minimum ratio of the gain to that of the next anchor, if the positions come from the other anchors: obstacles
            make several anchors look displaced, and a displaced one bends the tracks that judge the others.
        indistinct: log likelihoods of mirror images that differ by less do not distinguish them (a factor of e^4.5).
        offset_sd_m: prior standard deviation of the offset of an anchor about the common one, twice that of uncalibrated antenna
            delays: without it, a displacement by metres in the direction of the tag costs nothing.
        independent_s: errors of an anchor within this time count as one independent error: obstacles persist for metres.
        min_independent: an anchor with fewer independent errors is not examined.
        min_sd_m: minimum noise of a range: that of a DW1000 and the persisting error at one position.
        misfit_m, misfit_share: swaps are examined if this share of the ranges has larger residuals.
        max_misfit_share: if a larger share has such residuals, the track is wrong. Simulated: at most 0.11 of the ranges of
            drives and placements, 0.67 or more of those of placements that are recorded as one drive.
        suspects: number of anchors with the largest misfit that are tried, in pairs and displaced: all of 24 would take minutes.
        trial_ranges: number of ranges with which a pair is tried; `mean_gain`: minimum gain of a range, in addition to
            `swap_share`.
        no_position_loss: loss of a range without a position: that of a large outlier.
        displacement_sd_m: prior standard deviation of a displacement that is fitted together with the track.
        unnoticed_m: a larger displacement that is not noticed is reported.
    """

    displacement_m: float = 0.3
    gain: float = 12.0
    explained_share: float = 0.65
    independent_m: float = 0.5
    independent_share: float = 0.45
    swap_share: float = 0.35
    stands_out: float = 1.5
    indistinct: float = 4.5
    offset_sd_m: float = 0.3
    independent_s: float = 2.0
    min_independent: int = 8
    min_sd_m: float = 0.1
    misfit_m: float = 0.5
    misfit_share: float = 0.08
    max_misfit_share: float = 0.5
    suspects: int = 6
    trial_ranges: int = 1000
    mean_gain: float = 0.1
    no_position_loss: float = 6.0
    displacement_sd_m: float = 1.0
    unnoticed_m: float = 0.6


LIMITS = HypothesisLimits()

_MAX_ANCHOR_RANGES, _SIMPLEX_M = 1000, 0.5
"""Ranges of an anchor that are used, which limits the time, and the first step of the search for a better position."""

_LINEARISATIONS = 2
"""Fits of a displacement together with the track: the directions of the ranges change little with it."""

_REMEDY = "the true positions in the anchors file; `uwb-mitigation survey` finds them"


class AnchorHypotheses:
    """Other positions of anchors, for known positions of the tags.

    Args:
        anchors: anchors of the file.
        ranges: r ranges.
        antenna: float64 (r, 3), position of the tag's antenna at each range, m, from a localisation or a track of the other
            anchors; NaN: unknown.
        tag: int (r,), tag of each range; None: there is one.
    """

    def __init__(
        self,
        anchors: AnchorMap,
        ranges: Ranges,
        antenna: NDArray[np.float64],
        tag: NDArray[np.intp] | None = None,
    ) -> None:
        self._anchors = anchors
        tag = np.zeros(len(ranges), np.intp) if tag is None else tag
        error_m = ranges.range_m - np.linalg.norm(antenna - anchors.position[ranges.anchor], axis=1)
        common_m = float(np.nanmedian(error_m)) if np.isfinite(error_m).any() else 0.0
        # Anchors with too few independent errors have none.
        self._misfits: dict[int, _Misfit] = {}
        for row in np.unique(ranges.anchor).tolist():
            rows = np.flatnonzero(np.isfinite(error_m) & (ranges.anchor == row))
            interval = ranges.stamp_ns[rows] // round(LIMITS.independent_s * NS_PER_S)
            independent = np.unique(np.stack([interval, tag[rows]]), axis=1).shape[1]
            if independent >= LIMITS.min_independent:
                rows = rows[:: math.ceil(len(rows) / _MAX_ANCHOR_RANGES)]
                columns = antenna[rows], ranges.range_m[rows] - common_m, tag[rows]
                self._misfits[row] = _Misfit(*columns, independent / len(rows), anchors.position[row])

    def gain(self, row: int, *, is_independent: bool) -> float:
        """Return the gain in log likelihood of a displacement of this anchor; 0: within the limits.

        Args:
            row: of the anchor.
            is_independent: see `HypothesisLimits.independent_m`.
        """
        limit_m, explained_share = LIMITS.displacement_m, LIMITS.explained_share
        if is_independent:
            limit_m, explained_share = LIMITS.independent_m, LIMITS.independent_share
        misfit = self._misfits.get(row)
        if misfit is None or misfit.moved_m <= limit_m:
            return 0.0
        gain = misfit.loss - misfit.loss_at(misfit.best)
        return gain if gain > explained_share * misfit.loss else 0.0

    def fitted(self, row: int) -> Anchor:
        """Return an examined anchor at the position that explains its ranges best, at the height of the file.

        Its standard deviation is that of x and y, for positions of the tag without errors.
        """
        misfit = self._misfits[row]
        return replace(
            self._anchors.anchors[row], position=tuple(misfit.best.tolist()), sd=misfit.position_sd_m()
        )

    def check(self, reference: str, *, is_independent: bool) -> None:
        """Refuse positions that the ranges contradict.

        Args:
            reference: source of the positions of the tags, for the message.
            is_independent: they do not depend on the anchors.

        Raises:
            DatasetError: names the anchors.
        """
        gains = {row: self.gain(row, is_independent=is_independent) for row in self._misfits}
        suspects = sorted((row for row in gains if gains[row] > LIMITS.gain), key=gains.__getitem__)
        swaps = {pair: self._swap_gain(*pair) for pair in itertools.combinations(suspects, 2)}
        # Two free displacements always fit better than a swap, but only slightly better if the anchors are swapped.
        swaps = {
            (a, b): gain
            for (a, b), gain in swaps.items()
            if gain > LIMITS.explained_share * (gains[a] + gains[b])
        }
        if swaps:
            a, b = max(swaps, key=swaps.__getitem__)
            raise _swapped(self._anchors, (min(a, b), max(a, b)), reference)
        if not suspects or (
            len(suspects) > 1
            and not is_independent
            and gains[suspects[-1]] < LIMITS.stands_out * gains[suspects[-2]]
        ):
            return
        row = suspects[-1]
        anchor = self._anchors.anchors[row]
        raise DatasetError(
            f"anchor {anchor} contradicts {reference}: {fit_text(anchor, self.fitted(row))}", valid=_REMEDY
        )

    def _swap_gain(self, a: int, b: int) -> float:
        first, second = self._misfits[a], self._misfits[b]
        return first.loss + second.loss - first.loss_at(second.position) - second.loss_at(first.position)

    def mirror_image(self, row: int, axes: int) -> NDArray[np.float64] | None:
        """Return another position of an anchor that explains its ranges equally well, float64 (3,), m, or None.

        The candidate is the mirror image beyond the plane of the track; with two `axes`, beyond its line in plan.
        """
        misfit = self._misfits.get(row)
        if misfit is None:
            return None
        centre, normal = misfit.antenna.mean(axis=0), np.zeros(3)
        normal[:axes] = np.linalg.svd((misfit.antenna - centre)[:, :axes], full_matrices=False)[2][-1]
        image = misfit.position - 2.0 * float((misfit.position - centre) @ normal) * normal
        image = misfit.refined(image, misfit.sd_m)
        is_elsewhere = float(np.linalg.norm(image - misfit.position)) > LIMITS.displacement_m
        return image if is_elsewhere and misfit.loss_at(image) - misfit.loss < LIMITS.indistinct else None


class _Misfit:
    """How well positions of one anchor explain its ranges, with an unknown offset of each tag.

    Attributes:
        antenna: (n, 3), position of the tag, m.
        position: of the anchor in the file. best: the position that explains the ranges best.
        sd_m: robust standard deviation of the errors at `best`: elsewhere, the displacement would count as noise.
        moved_m: distance of the two. loss: minus the log likelihood of `position`.
    """

    def __init__(
        self,
        antenna: NDArray[np.float64],
        range_m: NDArray[np.float64],
        tag: NDArray[np.intp],
        weight: float,
        position: NDArray[np.float64],
    ) -> None:
        self.antenna, self.position = antenna, position
        self._range_m, self._weight = range_m, min(1.0, weight)
        self._tags = [tag == number for number in np.unique(tag)]
        self.best = self.refined(position, self._sd_at(position))
        self.sd_m = self._sd_at(self.best)
        self.moved_m = float(np.linalg.norm(self.best - position))
        self.loss = self.loss_at(position)

    def _residual_m(self, position: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the errors for an anchor at `position` minus the offset of each tag, (n,), and these offsets, m."""
        error: NDArray[np.float64] = self._range_m - np.linalg.norm(self.antenna - position, axis=1)
        offset_m = np.array([np.median(error[is_of_tag]) for is_of_tag in self._tags])
        for is_of_tag, value in zip(self._tags, offset_m.tolist(), strict=True):
            error[is_of_tag] -= value
        return error, offset_m

    def _sd_at(self, position: NDArray[np.float64]) -> float:
        residual_m, _ = self._residual_m(position)
        return max(LIMITS.min_sd_m, MAD_TO_SD * float(np.median(np.abs(residual_m))))

    def loss_at(self, position: NDArray[np.float64], sd_m: float | None = None) -> float:
        """Return minus the log likelihood (Cauchy) of an anchor at `position`, by default with the noise at `best`."""
        residual_m, offset_m = self._residual_m(position)
        of_offsets = 0.5 * float(np.sum((offset_m / LIMITS.offset_sd_m) ** 2))
        return self._weight * float(np.log1p((residual_m / (sd_m or self.sd_m)) ** 2).sum()) + of_offsets

    def position_sd_m(self) -> float:
        """Return the standard deviation of x and y of `best`, m, from the weighted derivatives of the distances."""
        unit, _ = unit_vectors(self.antenna, self.best)
        residual_m, _ = self._residual_m(self.best)
        weight = self._weight / (1.0 + (residual_m / self.sd_m) ** 2)
        derivatives = np.concatenate([unit[:, :2], np.ones((len(unit), 1))], axis=1)
        information = derivatives.T @ (weight[:, None] * derivatives) / self.sd_m**2
        information[2, 2] += LIMITS.offset_sd_m**-2
        return float(np.sqrt(np.trace(np.linalg.pinv(information)[:2, :2]) / 2.0))

    def refined(self, position: NDArray[np.float64], sd_m: float) -> NDArray[np.float64]:
        """Return the position near `position`, at the same height, that explains the ranges best."""
        start = np.array([[0.0, 0.0], [_SIMPLEX_M, 0.0], [0.0, _SIMPLEX_M]])
        solution = minimize(
            lambda shift: self.loss_at(position + np.append(shift, 0.0), sd_m),
            start[0],
            method="Nelder-Mead",
            options={"initial_simplex": start, "xatol": 0.01, "fatol": 0.01},
        )
        return np.asarray(position + np.append(solution.x, 0.0), np.float64)


def check_anchors(segments: Segments, fit: JointFit, antenna: NDArray[np.float64]) -> None:
    """Refuse ranges that contradict the anchors file, without known positions of the tags.

    Args:
        segments: r ranges.
        fit: their solution with the positions of the file.
        antenna: float64 (r, 3), position of the tag's antenna at each range according to the other anchors, m.

    Raises:
        DatasetError: names the anchors; or most ranges contradict the track.
    """
    independent = fit.observations.independent
    is_misfit = np.abs(fit.residual_m) > LIMITS.misfit_m
    ratio_of_misfits = float((independent * is_misfit).sum() / independent.sum())
    if ratio_of_misfits > LIMITS.misfit_share:
        pair = find_swapped(fit.config, segments, fit.prior, fit.scale_m, _suspects(fit))
        if pair is not None:
            raise _swapped(fit.config.anchors, pair, "the others")
    if ratio_of_misfits > LIMITS.max_misfit_share:
        raise DatasetError(
            f"{ratio_of_misfits:.0%} of the ranges contradict the estimated track by more than {LIMITS.misfit_m:g} m",
            valid=f"a drive, or pauses of more than {GAP_S:g} s between the positions of a carried tag; the anchors file of this "
            "site",
        )
    # The offset of an anchor competes with its displacement.
    is_common = [name.split()[0] not in ("anchor", "tag", "pair") for name in fit.prior.names]
    correction_m = fit.prior.rows[:, is_common] @ fit.parameters[is_common]
    ranges = replace(segments.ranges, range_m=segments.ranges.range_m - correction_m)
    hypotheses = AnchorHypotheses(fit.config.anchors, ranges, antenna, segments.tag)
    hypotheses.check("the others", is_independent=False)


def displacement_note(fit: JointFit) -> str:
    """Return which anchor is likely displaced, or which displacement is not noticed; empty: neither.

    Unlike in `AnchorHypotheses`, tracks and offsets are fitted again with each displacement, so that few anchors suffice: a
    track that follows a displaced anchor hides it from the others. Walls can look the same.
    """
    fits = {}
    for row in np.intersect1d(_suspects(fit)[: LIMITS.suspects], fit.observations.anchor).tolist():
        with contextlib.suppress(DatasetError):
            fits[row] = _displaced(fit, row)
    moved = {
        row: gain
        for row, (anchor, gain) in fits.items()
        if math.dist(anchor.position, fit.config.anchors.position[row]) > LIMITS.displacement_m
    }
    row = max(moved, key=moved.__getitem__, default=None)
    if row is not None and moved[row] > LIMITS.gain:
        anchor = fit.config.anchors.anchors[row]
        return f"anchor {anchor} may be displaced: {fit_text(anchor, fits[row][0])}. Walls or a wrong height can look the same: check the height, then measure it again"
    if not fits:
        return ""
    anchor, _ = max(fits.values(), key=lambda of_anchor: of_anchor[0].sd)
    if 2.0 * anchor.sd > LIMITS.unnoticed_m:
        return (
            f"a position of anchor {anchor} that is wrong by up to {2.0 * anchor.sd:.1f} m is not noticed: drive nearer to it, or "
            "compare it with `uwb-mitigation survey`"
        )
    return ""


def _suspects(fit: JointFit) -> NDArray[np.intp]:
    """Return the rows of anchors, that with the largest misfit first."""
    observations = fit.observations
    loss = fit.config.model.loss(fit.residual_m / fit.scale_m[observations.noise_group])
    by_anchor = np.bincount(observations.anchor, loss * observations.independent)
    return np.argsort(by_anchor)[::-1]


def _displaced(fit: JointFit, row: int) -> tuple[Anchor, float]:
    """Return an anchor at the position that explains the ranges best together with the tracks, and the gain in log likelihood."""
    config, observations = fit.config, fit.observations
    position, refit = config.anchors.position.copy(), fit
    prior = replace(fit.prior, rows=observations.rows)
    for _ in range(_LINEARISATIONS):
        unit, _ = unit_vectors(refit.antenna_position(), position[observations.anchor])
        columns = np.where((observations.anchor == row)[:, None], -unit[:, :2], 0.0)
        sds = np.full(2, LIMITS.displacement_sd_m)
        displacement = Regressors(("x", "y"), columns, np.zeros(2), sds, observations.noise_group)
        refit = fit_joint(
            replace(config, anchors=config.anchors.moved(position, config.anchors.sd)),
            replace(observations, rows=np.hstack([observations.rows, columns])),
            prior.concat(displacement),
            Start(refit.position, np.append(fit.parameters, [0.0, 0.0]), is_close=True),
            fit.scale_m,
        )
        position[row, :2] += refit.parameters[-2:]
    sd = float(np.sqrt(np.trace(refit.covariance[-2:, -2:]) / 2.0))
    anchor = replace(config.anchors.anchors[row], position=tuple(position[row].tolist()), sd=sd)
    return anchor, fit.loss - refit.loss


def fit_text(anchor: Anchor, fitted: Anchor) -> str:
    """Return where an anchor is according to its ranges, for messages."""
    x, y, _ = fitted.position
    moved_m = math.dist(anchor.position, fitted.position)
    return (
        f"its ranges fit x = {x:.2f} m, y = {y:.2f} m (standard deviation {fitted.sd:.2f} m), {moved_m:.1f} m from its position in "
        "the anchors file"
    )


def _swapped(anchors: AnchorMap, pair: tuple[int, int], reference: str) -> DatasetError:
    first, second = (anchors.anchors[row] for row in pair)
    return DatasetError(
        f"anchors {first} and {second} contradict {reference}: swapped, they explain the ranges",
        valid=_REMEDY,
    )


def find_swapped(
    config: EstimatorConfig,
    segments: Segments,
    prior: Regressors,
    scale_m: NDArray[np.float64],
    suspects: NDArray[np.intp],
) -> tuple[int, int] | None:
    """Return the two anchors whose exchange explains the first ranges much better, without known positions of the tags.

    Args:
        config: anchors, noise model, height and area.
        segments: ranges.
        prior: parameters of the ranges.
        scale_m: float64 (g,), of the residuals.
        suspects: rows of anchors, those with the largest misfit first.
    """
    is_trial = np.arange(len(segments.ranges)) < LIMITS.trial_ranges
    segments, prior = segments.select_ranges(is_trial), prior.select_rows(is_trial)
    anchors, scale_m = config.anchors, np.maximum(scale_m, LIMITS.min_sd_m)

    def loss(pair: tuple[int, int] | None) -> float:
        """Return the mean loss of a range; a range without a position counts as an outlier."""
        position = anchors.position.copy()
        if pair is not None:
            position[list(pair)] = position[list(pair)[::-1]]
        trial = replace(config, anchors=anchors.moved(position, anchors.sd))
        start, has_position = first_positions(trial, segments, prior.rows @ prior.mean)
        if not has_position.any():
            return LIMITS.no_position_loss
        is_used = has_position[segments.segment]
        selected = prior.select_rows(is_used)
        observations = observations_of(segments.select(has_position), selected, config.model)
        try:
            fit = fit_joint(trial, observations, selected, Start(start), scale_m)
        except DatasetError:
            return LIMITS.no_position_loss
        used = float(is_used.mean())
        return (
            used * fit.loss / float(observations.independent.sum()) + (1.0 - used) * LIMITS.no_position_loss
        )

    as_given = loss(None)
    examined = np.intersect1d(suspects[: LIMITS.suspects], segments.ranges.anchor).tolist()
    losses = {pair: loss(pair) for pair in itertools.combinations(examined, 2)}
    best = min(losses, key=losses.__getitem__, default=None)
    if best is None or losses[best] > (1.0 - LIMITS.swap_share) * as_given - LIMITS.mean_gain:
        return None
    return best
