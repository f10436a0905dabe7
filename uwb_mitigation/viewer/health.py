"""States of pairs and anchors with advice, the verdict on a position, and the accuracy that the anchors permit."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.positioning.geometry import dop
from uwb_mitigation.viewer.histories import NO_DATA_S, Pair
from uwb_mitigation.viewer.palette import GREEN, ORANGE, PAPER, VERMILLION
from uwb_mitigation.viewer.scene import Scene

LONG_M, VERY_LONG_M = 0.15, 0.3
"""Mean residuals that need attention, and that spoil positions."""
MAX_LOST, MAX_NLOS, MAX_NOT_OK = 20.0, 50.0, 20.0
"""Shares of ranges that need attention, %."""
EVIDENCE = 10
"""Number of ranges with a residual from which an anchor is good or bad."""
RELEASE = 0.8
"""A state ends below this share of the limit at which it begins (hysteresis)."""
GOOD, CHECK, BAD, UNKNOWN = "\u2713 good", "! check", "\u2297 bad", "? unknown"
SILENT = "\u25cb no ranges"
LOOKS = {
    GOOD: ("hex", GREEN),
    CHECK: ("square_pin", ORANGE),
    BAD: ("circle_x", VERMILLION),
    UNKNOWN: ("hex_dot", PAPER),
    SILENT: ("hex", PAPER),
}
"""Marker and colour of an anchor for each state; statuses of ranges have other markers."""
STATES = (
    f"{BAD}: ranges stopped, or a mean residual over {VERY_LONG_M:.2f} m with line of sight. {CHECK}: a mean residual over {LONG_M:.2f} "
    f"m, {MAX_LOST:.0f} % lost, {MAX_NOT_OK:.0f} % with a status that needs attention, or {MAX_NLOS:.0f} % NLOS. {UNKNOWN}: fewer than "
    f"{EVIDENCE} ranges can be compared with the position. {SILENT}: none so far, or of no anchor. The status "
    "of a pair shows only whether the network could correct the range."
)
"""Definition of the states, for the page."""
POSITION_GOOD, DEGRADED, LOST = "good", "degraded", "lost"
UNDETERMINED, WAITING = "not determined", "no data yet"
"""States of a position."""
MAX_SD_M = 0.5
"""A horizontal standard deviation from which the position is degraded: the limit of a reliable range."""
MIN_ANCHORS = 3
MAX_HEADLINE = 60
"""Maximum number of characters of a reason with its explanation."""
JUMP_S = 60.0
"""Time for which a jump of a clock is the reason for a missing position; of a lost one, until it is back."""
SYNCHRONISE = "Synchronise the clocks of the computers (such as with chrony), then restart the locator."
HOLD_S = 2.0
"""Time for which a better verdict must hold before it is shown."""
RADIUS95 = math.sqrt(5.991 / 2.0)
"""Radius of 95 % of a circular normal distribution, relative to the root of the sum of its variances in x and y."""
CELLS = 40
"""Width and height of the map of the predicted accuracy, points."""
STEPS_M = (0.1, 0.2, 0.5, 1.0, 10.0)
"""Upper limits of the colours of the map of the predicted accuracy; above the last one, it is not shown."""

_NO_JUMP = -math.inf, 0.0

Means = Mapping[str, float]
"""Means of a pair or an anchor: `rate` (Hz); `nlos`, `lost`, `not_ok` (%); `residual`, corrected range minus distance to
the estimated position (m); `evidence`, number of residuals; `stopped`, age of the last range if it is not recent, else 0 (s);
`displaced`, held-out residual (m) of an anchor whose ranges fit another position (`fit_x`, `fit_y`, `moved` from the file, m), else 0. NaN: unknown."""


FAULTS = (
    ("stopped", 0.0, BAD, "has not answered for {stopped:.0f} s: check its power and PAN id."),
    ("displaced", 0.0, BAD, "is not where the anchors file says: its ranges fit x = {fit_x:.2f}, y = {fit_y:.2f} m, "
                            "{moved:.1f} m away. Measure it again, or run `uwb-mitigation survey`."),
    # Without line of sight, ranges may be long although anchor and offset are right.
    ("blocked", LONG_M, CHECK, "reads {size:.2f} m {direction}, with {nlos:.0f} % NLOS: its line of sight is probably blocked. Move it if possible."),
    ("clear", VERY_LONG_M, BAD, "reads {size:.2f} m {direction}: calibrate, or check its position."),
    ("clear", LONG_M, CHECK, "reads {size:.2f} m {direction}: calibrate, or check its position."),
    ("lost", MAX_LOST, CHECK, "loses {lost:.0f} % of its ranges: check distance and antenna."),
    ("not_ok", MAX_NOT_OK, CHECK, "has {not_ok:.0f} % of ranges with a status that needs attention: see the pairs."),
    ("nlos", MAX_NLOS, CHECK, "has no line of sight in {nlos:.0f} % of the CIRs: move it if possible."),
)  # fmt: skip
"""Faults of an anchor, the most important one first: mean (`blocked`, `clear`: size of the residual without and with line of
sight), limit, state above it, and advice with means."""


def faults(means: Means, before: str = "") -> list[tuple[str, str]]:
    """Return state and advice for each fault of a pair or an anchor; `before`: its state until now."""
    residual_m = means["residual"] if means["evidence"] >= EVIDENCE else math.nan
    values: dict[str, Any] = {"blocked": 0.0, "clear": 0.0, "size": abs(residual_m), **means}
    values["blocked" if means["nlos"] > MAX_NLOS else "clear"] = abs(residual_m)
    values["direction"] = "long" if residual_m > 0.0 else "short"
    return [
        (fault, text.format(**values))
        for name, limit, fault, text in FAULTS
        if values[name] > limit * (RELEASE if before in (BAD, fault) else 1.0)
    ]


def state(means: Means, before: str = "") -> str:
    """Return the state of a pair or an anchor; `before`: its state until now."""
    states = {fault for fault, _ in faults(means, before)}
    is_known = means["rate"] > 0.0 and means["evidence"] >= EVIDENCE and math.isfinite(means["residual"])
    return next((bad for bad in (BAD, CHECK) if bad in states), GOOD if is_known else UNKNOWN)


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
        result[anchor_id] = means | totals | {"stopped": min(values["stopped"])}
    return result


def advice(anchors: Mapping[int, Means], names: Mapping[int, str] = {}) -> tuple[str, dict[int, str]]:
    """Return a sentence on what all anchors have in common, and one for each anchor (by its name); empty: no advice.

    If all anchors are wrong in the same way, the cause is probably not in each of them.
    """
    is_common = len(anchors) > 1 and not any(means["displaced"] for means in anchors.values())
    common = _common_advice(list(anchors.values())) if is_common else ""
    if common:
        return common, dict.fromkeys(anchors, "")
    labels = {anchor_id: f"Anchor {names.get(anchor_id) or format_id(anchor_id)}" for anchor_id in anchors}
    found_faults = {anchor_id: faults(means) for anchor_id, means in anchors.items()}
    wrong = [format_id(key) for key, means in anchors.items() if means["displaced"]]
    not_judged = f"Not judged: see anchor {wrong[0]}." if wrong else ""
    return "", {
        key: f"{labels[key]} {texts[0][1]}" if texts else not_judged for key, texts in found_faults.items()
    }


def _common_advice(anchors: list[Means]) -> str:
    residuals_m = np.array([means["residual"] for means in anchors])
    if all(means["stopped"] > 0.0 for means in anchors):
        return "No anchor answers: check the tag, and the diagnostics of the driver."
    if not (np.abs(residuals_m) > LONG_M).all():
        return ""
    if all(means["nlos"] > MAX_NLOS for means in anchors):
        return "The ranges of all anchors contradict the position, and most are NLOS: something close to the tag covers it."
    if np.ptp(np.sign(residuals_m)) > 0.0:
        return "The ranges of all anchors contradict the position: check ids and coordinates in the anchors file, and the height."
    size_m, direction = abs(float(np.median(residuals_m))), "long" if residuals_m[0] > 0.0 else "short"
    return (
        f"All anchors read too {direction}, {size_m:.2f} m in the median: a common cause is likely. Calibrate the offset "
        "(antenna delay), or check the anchors file and the height."
    )


class Verdict(NamedTuple):
    """A statement on a position.

    Attributes:
        state: see above. reason: why; empty: nothing to report. action: what to do next.
        accuracy: standard deviation, and radius of 95 % of the errors.
    """

    state: str
    reason: str = ""
    action: str = ""
    accuracy: str = ""

    def headline(self, tag: str = "") -> str:
        """Return state and reason as a sentence without its point; `tag`: " of tag 7" if there are several."""
        statement = f"No position{tag} yet" if self.state == WAITING else f"Position{tag} {self.state}"
        return statement + (f": {self.reason}" if self.reason else "")


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
    ages_s = [scene.age_s(history) for (_, pair_tag), history in scene.pairs.items() if pair_tag == tag_id]
    pose = next(iter(scene.tags.values()), None) if tag_id is None else scene.tag_of(tag_id)
    received = [key for key, means in anchors.items() if means["stopped"] == 0.0]
    reason, action = _of_remedy(remedy)
    if tag_id is None and pose is None:
        return Verdict(WAITING)
    if ages_s and min(ages_s) > NO_DATA_S:
        reason = f"no ranges of {name} for {min(ages_s):.0f} s"
        return Verdict(LOST, reason, "Check power of the tag, and the driver.")
    jump_at_s, jump_s = scene.incidents.clock_jumps.get(-1 if tag_id is None else tag_id, _NO_JUMP)
    # The last positions before a jump may arrive after it.
    is_lost = pose is not None and scene.age_s(pose) > NO_DATA_S
    begin_s = scene.clock() - JUMP_S if pose is None else pose.received_s - NO_DATA_S
    if (pose is None or is_lost) and jump_at_s > begin_s:
        reason = f"the clock of {name} jumped by {jump_s:+.0f} s"
        return Verdict(LOST if is_lost else UNDETERMINED, reason, SYNCHRONISE)
    if pose is None:
        action = action or "see the notices below"
        silent = sorted(set(scene.anchors).difference(received))
        if silent and 0 < len(received) <= MIN_ANCHORS:
            senders, missing = " and ".join(map(format_id, received)), ", ".join(map(format_id, silent[:6]))
            senders = f"anchors {senders} send" if len(received) > 1 else f"anchor {senders} sends"
            reason = f"only {senders} ranges; no ranges from {missing}" + (", ..." if silent[6:] else "")
            action = f"Find out why: check power, PAN id, and ids in the anchors file. Without them: {action}"
        return Verdict(UNDETERMINED, reason or f"no position of {name}", _sentence(action))
    if is_lost:
        reason = f"no position of {name} for {scene.age_s(pose):.0f} s"
        return Verdict(LOST, reason, _sentence(remedy or "Drive into the area of the anchors"))
    sd_m = pose.sd_m
    accuracy = "" if math.isnan(sd_m) else f"horizontal sd {sd_m:.2f} m, 95 % within {RADIUS95 * sd_m:.2f} m"
    names = {anchor_id: place.name for anchor_id, place in scene.anchors.items()}
    common, texts = advice(anchors, names)
    # With a common cause, anchors that need attention are bad together.
    wrong = (BAD, CHECK) if common else (BAD,)
    # An anchor may be bad because of another tag only.
    bad = [key for key in anchors if states[key] in wrong and (common or texts[key])]
    if not reason and bad:
        worst = max(bad, key=lambda key: [abs(anchors[key][n]) for n in ("stopped", "displaced", "residual")])
        reason, _, action = (common or texts[worst]).partition(": ")
    elif not reason and anchors and len(received) < MIN_ANCHORS:
        reason, action = f"{len(received)} anchors received", "Drive closer to the anchors, or add some."
    elif not reason and math.isnan(sd_m):
        reason, action = "its standard deviation is unknown", "Publish poses with a covariance."
    elif not reason and sd_m > MAX_SD_M:
        reason, action = f"uncertain by {sd_m:.2f} m", "Add an anchor, or set height and area of the locator."
    if reason:
        return Verdict(DEGRADED, reason, _sentence(action), accuracy)
    action = next((texts[key] for key in anchors if states[key] == CHECK), "")
    return Verdict(POSITION_GOOD, "", action, accuracy)


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
        self.shown, self._since_s, self._now_s = Verdict(WAITING), math.nan, -math.inf

    def update(self, new: Verdict, now_s: float) -> Verdict:
        """Return the verdict to show at a time; after a jump of the time, it is the new one."""
        continues, self._now_s = 0.0 <= now_s - self._now_s <= HOLD_S, now_s
        if not (continues and new.state == POSITION_GOOD and self.shown.state in (DEGRADED, LOST)):
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
