"""All tags of a site: a locator for each, and what a person should know of them."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.offsets import NO_OFFSETS, Offsets
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.positioning.fixed_lag import FixedLag
from uwb_mitigation.positioning.geometry import Shape, protection_levels, shape
from uwb_mitigation.positioning.locator import SILENCE_S, TagLocator
from uwb_mitigation.positioning.model import Model
from uwb_mitigation.positioning.offset_learning import OffsetLearner
from uwb_mitigation.positioning.start import Area, Height
from uwb_mitigation.positioning.tracks import Estimate

MAX_TAGS = 256
"""More tags than that are no tags: damaged numbers, rather."""

UNKNOWN_HEIGHT_SD_M = 0.1
"""Standard deviation of a measured height without a variance."""


@dataclass(slots=True)
class Tag:
    """Attributes:
    tag_id: its number.
    locator, smoother, learner: of this tag.
    taken_off: float64 (m,), what is taken off its ranges now, m.
    latest_ns: stamp of its latest range.
    """

    tag_id: int
    locator: TagLocator
    smoother: FixedLag
    learner: OffsetLearner
    taken_off: NDArray[np.float64]
    latest_ns: int = 0

    def add_height(self, height_m: float, variance_m2: float) -> None:
        """Take in the tag's height at the time of its latest range; one that is not finite is skipped."""
        if not (math.isfinite(height_m) and math.isfinite(variance_m2)):
            return
        # A variance of 0 means unknown in ROS.
        variance_m2 = variance_m2 if variance_m2 > 0.0 else UNKNOWN_HEIGHT_SD_M**2
        self.locator.add_height(height_m, variance_m2)
        self.smoother.add_height(height_m, variance_m2)


class Fleet:
    """Args:
        anchors, model, height, area: as of `TagLocator`.
        known: offsets of pairs that were learnt before, with their deviations.
        learn_offsets: what is learnt of pairs' offsets is taken off their ranges too.

    Attributes:
        anchors: as given.
        tags: by their numbers, in the order in which they were heard.
        strangers: ranges of anchors that are not on the map, {anchor id: count}.
        invalid: ranges that were not finite, or negative.
    """

    def __init__(
        self,
        anchors: AnchorMap,
        model: Model,
        *,
        height: Height | None = None,
        area: Area | None = None,
        known: Offsets = NO_OFFSETS,
        learn_offsets: bool = False,
    ) -> None:
        self.anchors = anchors
        self.tags: dict[int, Tag] = {}
        self.strangers: Counter[int] = Counter()
        self.invalid = 0
        self._model, self._height, self._area = model, height, area
        self._known, self._applies = known, learn_offsets

    def add(
        self, tag_id: int, anchor_id: int, stamp_ns: int, range_m: float, variance_m2: float
    ) -> tuple[Tag, Estimate | None] | None:
        """Take in a range.

        Returns:
            Its tag, and where that is now, as far as known; None where the range was left out.
        """
        row = self.anchors.index.get(anchor_id)
        if row is None:
            if anchor_id in self.strangers or len(self.strangers) < MAX_TAGS:
                self.strangers[anchor_id] += 1
            return None
        if not (math.isfinite(range_m) and range_m >= 0.0):
            self.invalid += 1
            return None
        tag = self.tags.get(tag_id)
        if tag is None:
            if len(self.tags) >= MAX_TAGS:
                self.invalid += 1
                return None
            tag = self.tags[tag_id] = self._new(tag_id)
        better_m = max(range_m - float(tag.taken_off[row]), 0.0)
        estimate = tag.locator.add(stamp_ns, row, better_m, variance_m2)
        tag.latest_ns = stamp_ns
        known = tag.locator.filter
        if known is None:
            tag.smoother.clear()
        elif estimate is not None:
            tag.smoother.add(known, stamp_ns, row, better_m, variance_m2)
            if tag.learner.add(tag.locator, row, range_m, variance_m2) and self._applies:
                known.take_off(tag.learner.offset_m - tag.taken_off)
                tag.taken_off = tag.learner.offset_m
        return tag, estimate

    def _new(self, tag_id: int) -> Tag:
        learner = OffsetLearner(self.anchors, self._model, level=self._height is not None)
        pairs = [(tag_id, anchor.id) for anchor in self.anchors.anchors]
        learner.know(
            np.array([self._known.pairs.get(pair, math.nan) for pair in pairs]),
            np.array([self._known.pair_sd.get(pair, self._model.pair_sd) for pair in pairs]),
        )
        return Tag(
            tag_id,
            TagLocator(self.anchors, self._model, height=self._height, area=self._area),
            FixedLag(self.anchors, self._model, self._height, self._area),
            learner,
            learner.offset_m.copy() if self._applies else np.zeros(len(self.anchors)),
        )

    @property
    def learnt(self) -> int:
        """How many ranges offsets were learnt from."""
        return sum(int(tag.learner.learnt.sum()) for tag in self.tags.values())

    def offsets(self) -> Offsets:
        """What is known of pairs' offsets now, and of those of tags that were not heard since."""
        pairs, deviations = dict(self._known.pairs), dict(self._known.pair_sd)
        for tag in self.tags.values():
            columns = zip(
                self.anchors.anchors, tag.learner.learnt, tag.learner.offset_m, tag.learner.sd_m, strict=True
            )
            for anchor, learnt, offset_m, sd_m in columns:
                pair = tag.tag_id, anchor.id
                if learnt or pair in pairs:
                    pairs[pair], deviations[pair] = float(offset_m), float(sd_m)
        return Offsets(pairs=pairs, pair_sd=deviations)

    def warnings(self) -> list[str]:
        """What a person should know, in words; empty = all is well."""
        found = []
        if self.strangers:
            names = ", ".join(format_id(identity) for identity in sorted(self.strangers)[:5])
            found.append(f"ranges of anchors that are not in the anchors file: {names}")
        for tag in self.tags.values():
            locator, name = tag.locator, f"tag {format_id(tag.tag_id)}"
            if not locator.following:
                found.append(f"{name}: {self._why(locator)}")
            odd = [self.anchors.anchors[row] for row in locator.disagreeing()]
            found += [
                f"{name}: ranges of anchor {anchor} do not fit: blocked, or wrong in the anchors file"
                for anchor in odd
            ]
            geometry = locator.geometry()
            if geometry is not None and geometry.hdop > 10.0:
                found.append(f"{name}: poor geometry, HDOP {geometry.hdop:.0f}")
        return found

    def _why(self, locator: TagLocator) -> str:
        rows = locator.heard(SILENCE_S)
        needed = 2 if self._height is not None else 3
        if len(rows) < needed:
            return f"no place: {len(rows)} anchors heard, {needed} or more needed"
        kind = shape(self.anchors.position[rows])
        text = f"no place: {locator.candidates} are plausible" if locator.candidates > 1 else "no place yet"
        if kind is Shape.LINE or (kind is Shape.PLANE and self._height is None):
            text += f"; the anchors heard are {kind.value}: give a height, or an area that leaves one place"
        return text

    def facts(self) -> dict[str, object]:
        """Numbers for the diagnostics."""
        found: dict[str, object] = {
            "anchors": len(self.anchors),
            "tags": len(self.tags),
            "ranges not valid": self.invalid,
            "ranges of unknown anchors": self.strangers.total(),
        }
        for tag in self.tags.values():
            locator, name = tag.locator, f"tag {format_id(tag.tag_id)}"
            counts, health, known = locator.counts, locator.health, locator.filter
            found |= {
                f"{name} places": locator.candidates,
                f"{name} anchors used": len(locator.heard()),
                f"{name} found, lost, silent": f"{counts.found}, {counts.lost}, {counts.silent}",
                f"{name} out of order": counts.backwards,
                f"{name} innovation mean": f"{health.mean:.2f}",
                f"{name} innovation square": f"{health.square:.2f}",
            }
            sd = tag.learner.sd_m
            found |= {
                f"{name} anchor {format_id(anchor.id)} offset m": f"{tag.learner.offset_m[row]:.3f} +- {sd[row]:.3f}"
                for row, anchor in enumerate(self.anchors.anchors)
                if locator.states[row].ranges
            }
            geometry = locator.geometry()
            if geometry is not None and known is not None:
                levels = protection_levels(known.p)
                found |= {
                    f"{name} HDOP": f"{geometry.hdop:.2f}",
                    f"{name} VDOP": f"{geometry.vdop:.2f}",
                    f"{name} protection level m": ", ".join(f"{level:.2f}" for level in levels),
                }
        return found
