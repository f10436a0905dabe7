"""Offsets of radios, and what else all ranges share, from ranges to known anchors alone: nobody knows where the tags were.

What geometry cannot tell apart is not solved for: an offset of its own has an anchor, a tag or a pair only where the
ranges say so by more than their own uncertainty; otherwise all share one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.positioning.anchor_errors import check_anchor_positions
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.joint import SLOW_S, JointFit, JointSolver, Links, links_of
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.observability import (
    check_anchors,
    check_motion,
    mirrored,
)
from uwb_mitigation.positioning.other_anchors import position_scatter, seen_by_others
from uwb_mitigation.positioning.own_offsets import Columns, candidates, with_own_offsets
from uwb_mitigation.positioning.regressors import Regressors
from uwb_mitigation.positioning.rests import Stretches, stretches
from uwb_mitigation.positioning.start import Area, Height
from uwb_mitigation.positioning.starting import first_positions, likely_offset
from uwb_mitigation.positioning.tracks import Ranges

UNTOLD_M = 0.2
"""An offset that is known no better is as good as unknown: antenna delays that nobody calibrated differ by as much."""

SEVERAL = 3.0
"""An offset is subtracted only if it is at least this number of standard deviations away from zero."""

HEIGHT_SD_M = 0.1
"""Of a measured height."""

MODEL = Model(long=1.5, short=1.5)
"""Of errors about as often too long as too short, once offsets and predictions are taken off: what is doubted sooner on
one side than on the other would pull an offset to that other."""


@dataclass(frozen=True, slots=True, eq=False)
class SelfCalibration:
    """What was found.

    Attributes:
        stretches, links, fit: as in `rests` and `joint`.
        solved: the parameters: `offset`, `anchor ROW`, `tag NUMBER`, `pair NUMBER ROW`, and the regressors'.
        level: `pair`, `anchor` or `one`: what has an offset of its own.
        not_told: what geometry cannot tell apart, and what was left out, in words.
        tag_ids: of the tags.
        pseudo_m, pseudo_sd_m: float64 (r,), in the order of `stretches.ranges`: how far each range's anchor is from where
            the *other* anchors see the tag, and how well that is known; NaN = not at all.
        own_sd_m: standard deviation of own offsets about the common one, for pairs that get the common one.
        position_scatter_m: `position_scatter` of raw ranges, and of calibrated ones on held-out parts; NaN = unknown.
    """

    stretches: Stretches
    links: Links
    fit: JointFit
    solved: Columns
    level: str
    not_told: tuple[str, ...]
    tag_ids: tuple[int, ...]
    anchors: AnchorMap
    pseudo_m: NDArray[np.float64]
    pseudo_sd_m: NDArray[np.float64]
    untold_m: float
    own_sd_m: float
    height: Height | None
    model: Model
    position_scatter_m: tuple[float, float] = (float("nan"), float("nan"))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
        return self.solved.names

    def found_without(self, left_out: NDArray[np.bool_]) -> SelfCalibration:
        """The same parameters and tracks from all but those of `stretches.ranges`, bool (r,); the pseudo-truth stays.

        Raises:
            DatasetError: the other ranges do not determine them.
        """
        gone = np.ones(len(self.links), np.bool_)
        gone[self.links.of[~left_out]] = False
        links = self.links.without(gone)
        solver = JointSolver(
            self.anchors,
            links,
            self.solved.parameters(links),
            self.model,
            self.height,
            around=self.fit.position,
        )
        return replace(self, fit=solver.fit(self.fit.position, self.fit.parameters, near=True))

    def value(self, name: str) -> tuple[float, float]:
        """A parameter and its standard deviation; (0, 0) where it was not solved for."""
        if name not in self.names:
            return 0.0, 0.0
        at = self.names.index(name)
        return float(self.fit.parameters[at]), float(np.sqrt(self.fit.covariance[at, at]))

    def pair(self, tag: int, row: int) -> tuple[float, float]:
        """The offset of a tag (its number) and an anchor (its row), m, and its standard deviation."""
        at = self._columns(tag, row)
        # How well anchors were measured bounds it: an anchor's misplacement looks like an offset, its mean over all
        # directions from which the tag saw it being about half of it in variance.
        placed = (
            self.anchors.sd[row] ** 2 / 2.0
            if len(at) > 1
            else np.mean(self.anchors.sd**2) / len(self.anchors) + self.own_sd_m**2
        )
        variance = self.fit.covariance[np.ix_(at, at)].sum() + placed + self.untold_m**2
        return float(self.fit.parameters[at].sum()), float(np.sqrt(variance))

    def applied(self, tag: int, row: int) -> tuple[float, float]:
        """The offset to subtract from the ranges of a tag and an anchor, m, and its standard deviation.

        If the mean of all offsets is significant, it is the estimate. Otherwise only an offset that is significant by
        itself is subtracted, and the others are 0.
        """
        value, sd = self.pair(tag, row)
        if self.mean_is_significant or abs(value) >= SEVERAL * sd:
            return value, sd
        return 0.0, float(np.hypot(value, sd))

    @property
    def mean_is_significant(self) -> bool:
        """Whether the mean offset of all pairs is `SEVERAL` standard deviations away from zero."""
        value, sd = self.mean()
        return abs(value) >= SEVERAL * sd

    def mean(self) -> tuple[float, float]:
        """The mean offset of all pairs, m, and its standard deviation."""
        pairs = self.pairs()
        rows = np.zeros((len(pairs), len(self.names)))
        for number, (tag, row) in enumerate(pairs):
            rows[number, self._columns(tag, row)] = 1.0
        of_mean = rows.mean(axis=0)
        placed = float(np.mean(self.anchors.sd**2)) / 2.0 / len(self.anchors)
        variance = of_mean @ self.fit.covariance @ of_mean + placed + self.untold_m**2
        return float(of_mean @ self.fit.parameters), float(np.sqrt(variance))

    def _columns(self, tag: int, row: int) -> list[int]:
        """The parameters that are added to the ranges of a tag and an anchor."""
        wanted = {"offset", f"anchor {row}", f"tag {tag}", f"pair {tag} {row}"}
        return [i for i, name in enumerate(self.names) if name in wanted]

    def pairs(self) -> list[tuple[int, int]]:
        """(tag number, anchor row) of all pairs that there are ranges of."""
        found = np.unique(np.stack([self.stretches.tag, self.stretches.ranges.anchor]), axis=1).T
        return [(int(tag), int(row)) for tag, row in found]


def calibrate(
    anchors: AnchorMap,
    tags: Sequence[Ranges],
    regressors: Regressors | None = None,
    *,
    height: Height | None = None,
    area: Area | None = None,
    heights_m: NDArray[np.float64] | None = None,
    model: Model | None = None,
) -> SelfCalibration:
    """Solve for all of it.

    Args:
        anchors: where they are.
        tags: what was recorded of each, of unknown places; each in the order of time.
        regressors: as many rows as there are ranges.
        height: of all tags, where it stays the same. area: where tags can be.
        heights_m: float64 (r,), the measured height at each range, in place of `height`.

    Raises:
        DatasetError: geometry does not tell; says what is missing.
    """
    model = model or MODEL
    tags = list(tags)
    if heights_m is not None:
        # Positions to start from are found with the median height, and only these.
        height = Height(float(np.median(heights_m)), max(float(np.std(heights_m)), HEIGHT_SD_M))
    known = regressors or Regressors.none(sum(map(len, tags)))
    check_anchors(anchors, np.unique(np.concatenate([one.anchor for one in tags])), height, area)
    told: list[str] = []
    found = stretches(tags, anchors, height, model)
    begins = np.cumsum([0, *map(len, tags)])
    of_range = begins[found.tag] + found.row
    rows, alike = known.rows[of_range], known.alike[of_range]
    if heights_m is not None and height is not None:
        found = replace(found, rise=heights_m[of_range] - height.value)
    expected = rows @ known.mean
    offset = likely_offset(anchors, found, expected, height, area, model)
    position, placed = first_positions(anchors, tags, found, expected + offset, height, area, model)
    if heights_m is not None and height is not None:
        # The spread of the heights was for the start: each height is known as well as it was measured.
        height = Height(height.value, HEIGHT_SD_M)
    if not placed.all():
        told.append(
            f"{int((~placed).sum())} of {len(placed)} stretches left out: no place of the tag can be told"
        )
    if not placed.any():
        raise DatasetError(
            "no place of a tag can be told",
            valid="four anchors or more that hear a tag at once, --height or --area",
        )
    kept = placed[found.of]
    found, rows, alike = found.keep(placed), rows[kept], alike[kept]
    solved = Columns.shared(rows, alike, known, offset)
    links = links_of(found, solved.rows, solved.alike, model)
    # Knots of stretches that were left out are gone from the positions, too.
    fit = JointSolver(anchors, links, solved.parameters(links), model, height).fit(position)
    ambiguous = mirrored(anchors, links, fit, height, area, model)
    if ambiguous.any():
        told.append(
            f"{int(ambiguous.sum())} of {len(ambiguous)} stretches left out: their mirror images are as good"
        )
        if ambiguous.all():
            raise DatasetError(
                "the track has two mirror images, and either explains the ranges as well",
                valid="--height or --area to say which, or an anchor beside the others' line (above or below their plane)",
            )
        kept, knots = ~ambiguous[found.of], ~ambiguous[links.knot_stretch]
        found, solved, position = found.keep(~ambiguous), solved.take(kept), fit.position[knots]
        links = links_of(found, solved.rows, solved.alike, model)
        fit = JointSolver(anchors, links, solved.parameters(links), model, height).fit(position)
    check_motion(links, fit, height)
    level, own_sd = "one", 0.0
    tag_ids = tuple(one.tag_id for one in tags)

    def result(untold_m: float) -> SelfCalibration:
        no_truth = np.zeros(0)
        return SelfCalibration(
            found, links, fit, solved, level, tuple(told), tag_ids, anchors, no_truth, no_truth, untold_m, own_sd, height, model
        )  # fmt: skip

    def held_out_scatter(some: Columns, fitted: JointFit) -> float:
        """Of positions, with parameters from the other half of the drive."""
        of_some = links_of(found, some.rows, some.alike, model)
        block = (of_some.time_s[of_some.knot] // SLOW_S).astype(int) + of_some.stretch
        correction = np.zeros(len(of_some))
        for half in range(2):
            held_out = block % 2 == half
            if held_out.any() and not held_out.all():
                rest = of_some.without(held_out)
                solver = JointSolver(
                    anchors, rest, some.parameters(rest), model, height, around=fitted.position
                )
                parameters = solver.fit(fitted.position, fitted.parameters, near=True).parameters
            else:
                parameters = fitted.parameters
            correction[held_out] = of_some.rows[held_out] @ parameters
        return position_scatter(anchors, of_some, fitted, correction, height, model)

    # Without the common offset the true ranges are unknown: own offsets would contain its error.
    common_sd = float(np.sqrt(fit.covariance[0, 0]))
    tried = candidates(found) if common_sd <= UNTOLD_M else []
    shared_only = solved
    for group, columns in tried:
        richer, better, shared, sd_of_group = with_own_offsets(
            anchors, found, solved, columns, fit, height, model
        )
        if group == "anchor":
            own_sd = sd_of_group
        if richer is None or better is None:
            told.append(f"offsets of {group}s of their own: not told from chance, so that all share one")
            break
        before, after = (held_out_scatter(one, result) for one, result in ((solved, fit), (richer, better)))
        if after > before:
            told.append(
                f"offsets of {group}s of their own: positions without one anchor scatter by {after:.3f} m with them, by "
                f"{before:.3f} m without them, so that all share one"
            )
            break
        solved, fit, level = richer, better, "pair" if group != "anchor" else "anchor"
        if shared:
            names = ", ".join(_with_ids(name, anchors, tags) for name in shared)
            told.append(f"{names}: their own offsets are not significant, so that they get the common offset")
    if level == "anchor" and len(np.unique(found.tag)) == 1:
        # Of one tag an anchor's offset is the pair's.
        level = "pair"
    links = links_of(found, solved.rows, solved.alike, model)
    fit = JointSolver(anchors, links, solved.parameters(links), model, height).fit(
        fit.position, fit.parameters
    )
    check_anchor_positions(anchors, tags, found, solved, links, fit, height, area, model)
    untold = 0.0
    trial = result(0.0)
    if common_sd > UNTOLD_M or not any(trial.applied(*pair)[0] for pair in trial.pairs()):
        value, sd = trial.mean()
        untold, level = float(np.hypot(value, sd)), "one"
        told.append(
            f"the offset is not significant, so that no offset is subtracted: {value:.2f} m with a standard deviation of "
            f"{sd:.2f} m. Drive between the anchors, not only past them"
        )
        solved = replace(
            shared_only,
            mean=np.array([0.0, *shared_only.mean[1:]]),
            sd=np.array([1e-4, *shared_only.sd[1:]]),
        )
        links = links_of(found, solved.rows, solved.alike, model)
        start = np.array([0.0, *fit.parameters[1 : len(solved.names)]])
        fit = JointSolver(anchors, links, solved.parameters(links), model, height).fit(fit.position, start)
    scatter = (
        position_scatter(anchors, links, fit, np.zeros(len(links)), height, model),
        held_out_scatter(solved, fit),
    )
    pseudo, pseudo_sd = seen_by_others(anchors, found, links, fit, height, model)
    return replace(result(untold), pseudo_m=pseudo, pseudo_sd_m=pseudo_sd, position_scatter_m=scatter)


def _with_ids(name: str, anchors: AnchorMap, tags: Sequence[Ranges]) -> str:
    """The name of an own offset, with the ids of tag and anchor in place of their numbers."""
    kind, *numbers = name.split()
    if kind == "anchor":
        return f"anchor {anchors.anchors[int(numbers[0])]}"
    if kind == "tag":
        return f"tag {tags[int(numbers[0])].tag_id}"
    return f"tag {tags[int(numbers[0])].tag_id} and anchor {anchors.anchors[int(numbers[1])]}"
