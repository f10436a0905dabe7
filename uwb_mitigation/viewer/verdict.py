"""The verdict on the position of a tag: one statement, its reason and the next action."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import NamedTuple

from uwb_mitigation.errors import format_id
from uwb_mitigation.viewer import health
from uwb_mitigation.viewer.histories import NO_DATA_S
from uwb_mitigation.viewer.scene import Scene

GOOD, DEGRADED, LOST, UNDETERMINED, WAITING = "good", "degraded", "lost", "not determined", "no data yet"
MAX_SD_M = 0.5
"""A horizontal standard deviation from which the position is degraded: the limit of a reliable range."""
MIN_ANCHORS = 3
MAX_HEADLINE = 60
"""Maximum number of characters of a reason with its explanation."""
HOLD_S = 2.0
"""Time for which a better verdict must hold before it is shown."""
RADIUS95 = math.sqrt(5.991 / 2.0)
"""Radius of 95 % of a circular normal distribution, relative to the root of the sum of its variances in x and y."""


class Verdict(NamedTuple):
    """A statement on a position.

    Attributes:
        state: one of the names above. reason: why; empty: nothing to report. action: what to do next.
        accuracy: standard deviation, and radius of 95 % of the errors.
    """

    state: str
    reason: str = ""
    action: str = ""
    accuracy: str = ""


def verdict(
    scene: Scene,
    tag_id: int | None,
    anchors: Mapping[int, health.Means],
    states: Mapping[int, str],
    remedy: str,
) -> Verdict:
    """Return the verdict on the latest position of a tag.

    Args:
        scene: its data.
        tag_id: the tag; None: no ranges yet.
        anchors: means of each anchor.
        states: their states.
        remedy: why the position is not unique, with the remedy; empty: it is, or unknown.
    """
    names = {anchor_id: place.name or format_id(anchor_id) for anchor_id, place in scene.anchors.items()}
    tag = None if tag_id is None else scene.tag_of(tag_id)
    ages_s = [scene.age_s(history) for (_, pair_tag), history in scene.pairs.items() if pair_tag == tag_id]
    name = "" if tag_id is None else f"tag {format_id(tag_id)}"
    if tag_id is None and not scene.tags:
        return Verdict(WAITING)
    if ages_s and min(ages_s) > NO_DATA_S:
        reason = f"no ranges of {name} for {min(ages_s):.0f} s"
        return Verdict(LOST, reason, "Check power of the tag, and the driver.")
    if tag_id is None:
        tag = next(iter(scene.tags.values()))
    if tag is None or tag.pose is None:
        reason, action = _of_remedy(remedy)
        return _verdict(UNDETERMINED, reason or f"no position of {name}", action or "See the notices below.")
    if scene.age_s(tag) > NO_DATA_S:
        reason = f"no position of {name} for {scene.age_s(tag):.0f} s"
        return _verdict(LOST, reason, remedy or "Drive into the area of the anchors.")
    sd_m = tag.pose.sd_m
    accuracy = "" if math.isnan(sd_m) else f"horizontal sd {sd_m:.2f} m, 95 % within {RADIUS95 * sd_m:.2f} m"
    common, advice = health.advice(anchors, names)
    # With a common cause, anchors that need attention are bad together.
    wrong = {health.BAD, health.CHECK} if common else {health.BAD}
    bad = [anchor_id for anchor_id, state in states.items() if state in wrong]
    received = sum(means["stopped"] == 0.0 for means in anchors.values())
    reason = action = ""
    if remedy:
        reason, action = _of_remedy(remedy)
    elif bad:
        names_of_worst = ("stopped", "displaced", "residual")
        worst = max(bad, key=lambda key: [abs(anchors[key][name]) for name in names_of_worst])
        reason, _, action = (common or advice[worst]).partition(": ")
    elif anchors and received < MIN_ANCHORS:
        reason, action = f"{received} anchors received", "Drive closer to the anchors, or add some."
    elif math.isnan(sd_m):
        reason, action = "its standard deviation is unknown", "Publish poses with a covariance."
    elif sd_m > MAX_SD_M:
        reason, action = f"uncertain by {sd_m:.2f} m", "Add an anchor, or set height and area of the locator."
    if not reason:
        action = next((advice[key] for key, state in states.items() if state == health.CHECK), "")
    return _verdict(DEGRADED if reason else GOOD, reason, action, accuracy)


def _of_remedy(remedy: str) -> tuple[str, str]:
    """Return a reason that fits a headline, and the explanation with the remedy, of a determination."""
    text, _, action = re.sub(r"^(from \d+ ranges: )?((unknown|contradicted): )?", "", remedy).partition(
        ". Remedy: "
    )
    if len(text) <= MAX_HEADLINE:
        return text, action
    reason, _, explanation = text.partition(": ")
    return reason, f"{explanation}. Remedy: {action}"


def _verdict(state: str, reason: str, action: str, accuracy: str = "") -> Verdict:
    """Return a verdict whose action is a sentence."""
    sentence = action[:1].upper() + action[1:]
    return Verdict(state, reason, sentence + "." * (bool(sentence) and sentence[-1] not in ".!"), accuracy)


class HeldVerdict:
    """Delays improvements of the verdict, so that it does not flicker.

    Attributes:
        shown: the current verdict.
    """

    def __init__(self) -> None:
        self.shown, self._since_s, self._now_s = Verdict(WAITING), math.nan, -math.inf

    def update(self, new: Verdict, now_s: float) -> Verdict:
        """Return the verdict to show at a time; after a jump of the time, it is the new one."""
        continues, self._now_s = 0.0 <= now_s - self._now_s <= HOLD_S, now_s
        if not (continues and new.state == GOOD and self.shown.state in (DEGRADED, LOST)):
            self._since_s = math.nan
            self.shown = new
        elif math.isnan(self._since_s):
            self._since_s = now_s
        elif now_s - self._since_s >= HOLD_S:
            self.shown = new
        return self.shown
