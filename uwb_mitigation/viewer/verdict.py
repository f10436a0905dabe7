"""Looks of the states of anchors, the verdict on a position that the page shows, and the accuracy that the anchors permit."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.positioning import health
from uwb_mitigation.positioning.geometry import dop
from uwb_mitigation.positioning.health import Means, Verdict
from uwb_mitigation.types.measurement import Status
from uwb_mitigation.viewer.histories import Pair
from uwb_mitigation.viewer.palette import GREEN, ORANGE, PAPER, VERMILLION
from uwb_mitigation.viewer.scene import Scene

LOOKS = {
    health.GOOD: ("hex", GREEN),
    health.CHECK: ("square_pin", ORANGE),
    health.BAD: ("circle_x", VERMILLION),
    health.UNKNOWN: ("hex_dot", PAPER),
    health.SILENT: ("hex", PAPER),
}
"""Marker and colour of an anchor for each state; statuses of ranges have other markers."""
LIMITS = (
    f"{health.CHECK}: residual over {health.LONG_M:.2f} m; {health.BAD}: over {health.VERY_LONG_M:.2f} m with line of sight. Position good: "
    f"horizontal sd, \u221a(sd x\u00b2 + sd y\u00b2), up to {health.MAX_SD_M:.2f} m. All limits"
)
"""The limits that decide most states, for the page."""
STATES = (
    f"{health.BAD}: ranges stopped, probably displaced, or a mean residual over {health.VERY_LONG_M:.2f} m with line of sight. {health.CHECK}: a mean residual over {health.LONG_M:.2f} "
    f"m, {health.MAX_LOST:.0f} % lost, {health.MAX_NOT_OK:.0f} % with a status that needs attention, or {health.MAX_NLOS:.0f} % NLOS. {health.UNKNOWN}: fewer than "
    f"{health.EVIDENCE} ranges can be compared with the position. {health.SILENT}: none so far, or of no anchor. The status "
    "of a pair shows only whether the network could correct the range."
)
"""Definition of the states, for the page."""
MAX_HEADLINE = 60
"""Maximum number of characters of a reason with its explanation."""
JUMP_S = 60.0
"""Time for which a jump of a clock is the reason for a missing position; of a lost one, until it is back."""
SYNCHRONISE = "Synchronise the clocks of the computers (such as with chrony), then restart the locator."
NOT_CORRECTED = "Ranges through obstacles stay too long: let the radio send CIRs (channel impulse responses)."
"""What to do if no range has a CIR."""
HOLD_S = 2.0
"""Time for which a better verdict must hold before it is shown."""
CELLS = 40
"""Width and height of the map of the predicted accuracy, points."""
STEPS_M = (0.1, 0.2, 0.5, 1.0, 10.0)
"""Upper limits of the colours of the map of the predicted accuracy; above the last one, it is not shown."""

_NO_JUMP = -math.inf, 0.0


def anchor_means(pairs: Mapping[Pair, Means]) -> dict[int, Means]:
    """Return the means over the pairs of each anchor, and the sum of their rates."""
    by_anchor = defaultdict[int, list[Means]](list)
    for (anchor_id, _), means in pairs.items():
        by_anchor[anchor_id].append(means)
    result: dict[int, Means] = {}
    for anchor_id, rows in by_anchor.items():
        values = {name: [row[name] for row in rows if not math.isnan(row[name])] for name in rows[0]}
        means = {name: sum(column) / len(column) if column else math.nan for name, column in values.items()}
        # An anchor has stopped if all of its pairs have.
        totals = {name: sum(values[name]) for name in ("rate", "evidence")}
        extremes = {"stopped": min(values["stopped"]), "displaced": max(values["displaced"])}
        result[anchor_id] = means | totals | extremes
    return result


def verdict(
    scene: Scene, tag_id: int | None, anchors: Mapping[int, Means], states: Mapping[int, str], remedy: str
) -> Verdict:
    """Return the verdict on the latest position of a tag.

    Args:
        scene: its data.
        tag_id: the tag; None: no ranges yet.
        anchors: means of each of its anchors.
        states: states of all anchors.
        remedy: why the position is not unique, with the remedy; empty: it is, or unknown.
    """
    name = "" if tag_id is None else f"tag {format_id(tag_id)}"
    lasts = [
        history.last
        for (_, pair_tag), history in scene.pairs.items()
        if pair_tag == tag_id and len(history.rows)
    ]
    ages_s = list(map(scene.age_s, lasts))
    pose = next(iter(scene.tags.values()), None) if tag_id is None else scene.tag_of(tag_id)
    received = [key for key, means in anchors.items() if means["stopped"] == 0.0]
    reason, action = _of_remedy(remedy)
    if tag_id is None and pose is None:
        return Verdict(health.WAITING)
    if ages_s and min(ages_s) > health.NO_DATA_S:
        reason = f"no ranges of {name} for {min(ages_s):.0f} s"
        return Verdict(health.LOST, reason, "Check power of the tag, and the driver.")
    jump_at_s, jump_s = scene.incidents.clock_jumps.get(-1 if tag_id is None else tag_id, _NO_JUMP)
    # The last positions before a jump may arrive after it.
    is_lost = pose is not None and scene.age_s(pose) > health.NO_DATA_S
    begin_s = scene.clock() - JUMP_S if pose is None else pose.received_s - health.NO_DATA_S
    silent = sorted(set(scene.anchors).difference(received))
    # A paused bag is a jump, too: without a position before it, other reasons are more likely.
    is_explained = bool(reason or (silent and 0 < len(received) <= health.MIN_ANCHORS))
    if (is_lost or (pose is None and not is_explained)) and jump_at_s > begin_s:
        reason = f"the clock of {name} jumped by {jump_s:+.0f} s"
        return Verdict(health.LOST if is_lost else health.UNDETERMINED, reason, SYNCHRONISE)
    if pose is None:
        action = action or "see the notices below"
        if silent and 0 < len(received) <= health.MIN_ANCHORS:
            senders, missing = " and ".join(map(format_id, received)), ", ".join(map(format_id, silent[:6]))
            senders = f"anchors {senders} send" if len(received) > 1 else f"anchor {senders} sends"
            reason = f"only {senders} ranges; no ranges from {missing}" + (", ..." if silent[6:] else "")
            action = f"Find out why: check power, PAN id, and ids in the anchors file. Without them: {action}"
        return Verdict(health.UNDETERMINED, reason or f"no position of {name}", _sentence(action))
    if is_lost:
        reason = f"no position of {name} for {scene.age_s(pose):.0f} s"
        return Verdict(health.LOST, reason, _sentence(remedy or "Drive into the area of the anchors"))
    sd_m = pose.sd_m
    names = {anchor_id: place.name for anchor_id, place in scene.anchors.items()}
    if not reason:
        reason, action = health.degradation(anchors, states, names, sd_m)
    state = health.DEGRADED if reason else health.POSITION_GOOD
    statuses = {Status(int(last.status)) for last in lasts if scene.age_s(last) <= health.NO_DATA_S}
    if not reason and statuses and not any(status.is_corrected for status in statuses):
        reason = "not corrected"
        # Other statuses have their own advice if they are frequent.
        action = f"{action} {NOT_CORRECTED}".strip() if Status.NO_CIR in statuses else action
    return Verdict(
        state,
        reason,
        _sentence(action),
        health.accuracy_text(sd_m),
    )


def _of_remedy(remedy: str) -> tuple[str, str]:
    """Return a reason that fits a headline, and the explanation with the remedy, of a determination."""
    statement = re.sub(r"^(from \d+ ranges: )?((unknown|contradicted): )?", "", remedy)
    text, _, action = statement.partition(". Remedy: ")
    if len(text) <= MAX_HEADLINE:
        return text, action
    reason, _, explanation = text.partition(": ")
    return reason, f"{explanation}. Remedy: {action}"


def _sentence(text: str) -> str:
    """Return a text that begins with a capital letter and ends with a point."""
    return text[:1].upper() + text[1:] + "." * (bool(text) and text[-1] not in ".!")


class HeldVerdict:
    """Delays improvements of the verdict, so that it does not flicker.

    Attributes:
        shown: the current verdict.
    """

    def __init__(self) -> None:
        self.shown, self._since_s, self._now_s = Verdict(health.WAITING), math.nan, -math.inf

    def update(self, new: Verdict, now_s: float) -> Verdict:
        """Return the verdict to show at a time; after a jump of the time, it is the new one."""
        continues, self._now_s = 0.0 <= now_s - self._now_s <= HOLD_S, now_s
        if not (
            continues
            and new.state == health.POSITION_GOOD
            and self.shown.state in (health.DEGRADED, health.LOST)
        ):
            self._since_s = math.nan
            self.shown = new
        elif math.isnan(self._since_s):
            self._since_s = now_s
        elif now_s - self._since_s >= HOLD_S:
            self.shown = new
        return self.shown


def predicted_accuracy(
    anchors: NDArray[np.float64], height_m: float, sd_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the horizontal standard deviation of positions at a known height if all anchors are received.

    It is HDOP times the standard deviation of the ranges.

    Args:
        anchors: positions, float64 (m, 3), m.
        height_m: height of the tag, m.
        sd_m: standard deviation of a range, m.

    Returns:
        x and y of the points of a grid, float64 (CELLS,), m; the values, float64 (CELLS, CELLS), m, infinite where undetermined.
    """
    margin_m = 1.0 + 0.1 * np.ptp(anchors[:, :2], axis=0)
    low, high = anchors[:, :2].min(axis=0) - margin_m, anchors[:, :2].max(axis=0) + margin_m
    x, y = np.linspace(low, high, CELLS).T
    image = [[dop(anchors, np.array([at_x, at_y, height_m]), level=True).hdop for at_x in x] for at_y in y]
    return x, y, sd_m * np.array(image)
