"""States of anchors with advice, and the verdict on a position, from means of their ranges: what page and locator say."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from uwb_mitigation.errors import format_id

NO_DATA_S, NO_DATA_INTERVALS = 3.0, 3.0
"""A tag or a pair has no data after this time, or after this number of its mean intervals if that is longer."""
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
POSITION_GOOD, DEGRADED, LOST = "good", "degraded", "lost"
UNDETERMINED, WAITING = "not determined", "no data yet"
"""States of a position."""
MAX_SD_M = 0.5
"""A horizontal standard deviation from which the position is degraded: the limit of a reliable range."""
MIN_ANCHORS = 3
RADIUS95 = math.sqrt(5.991 / 2.0)
"""Radius of 95 % of a circular normal distribution, relative to the root of the sum of its variances in x and y."""

Means = Mapping[str, float]
"""Means of a pair or an anchor: `rate` (Hz); `nlos`, `lost`, `not_ok` (%); `residual`, corrected range minus distance to
the estimated position (m); `evidence`, number of residuals; `stopped`, age of the last range if it is not recent, else 0 (s);
`displaced`, held-out residual (m) of an anchor whose ranges fit another position (`fit_x`, `fit_y`, `moved` from the file, m), live the
displacement without these, else 0. NaN: unknown."""

_FITTED = "is not where the anchors file says: its ranges fit x = {fit_x:.2f}, y = {fit_y:.2f} m, {moved:.1f} m away"
_DISPLACED = "is probably not where the anchors file says: at least {displaced:.1f} m away, or the height of the tag is wrong"
FAULTS = (
    ("stopped", 0.0, BAD, "has not answered for {stopped:.0f} s: it is blocked or too far away, or check its power and PAN id."),
    ("displaced", 0.0, BAD, "{place}. Measure it again, or run `uwb-mitigation survey`."),
    # Without line of sight, ranges may be long although anchor and offset are right.
    ("blocked", LONG_M, CHECK, "reads {size:.2f} m {direction}, with {nlos:.0f} % NLOS: its line of sight is probably blocked. Move it if possible."),
    ("clear", VERY_LONG_M, BAD, "reads {size:.2f} m {direction}: check its position, or run `uwb-mitigation calibrate`."),
    ("clear", LONG_M, CHECK, "reads {size:.2f} m {direction}: check its position, or run `uwb-mitigation calibrate`."),
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
    values["place"] = (_FITTED if "fit_x" in means else _DISPLACED).format(**values)
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
        f"All anchors read too {direction}, {size_m:.2f} m in the median: a common cause is likely. Check the height "
        "and the anchors file, or calibrate the offset (antenna delay)."
    )


def _is_wrong(means: Means) -> bool:
    """Return whether an anchor reads wrong with line of sight."""
    has_evidence = means["evidence"] >= EVIDENCE and means["nlos"] <= MAX_NLOS and means["stopped"] == 0.0
    return has_evidence and abs(means["residual"]) > LONG_M


def degradation(
    anchors: Mapping[int, Means], states: Mapping[int, str], names: Mapping[int, str], sd_m: float
) -> tuple[str, str]:
    """Return why a unique position is degraded, and what to do; empty reason: it is not.

    Args:
        anchors: means of each anchor.
        states: their states.
        names: their names, where they have one.
        sd_m: horizontal standard deviation of the position, m; NaN: unknown.
    """
    common, texts = advice(anchors, names)
    # With a common cause, anchors that need attention are bad together.
    wrong = (BAD, CHECK) if common else (BAD,)
    # An anchor may be bad because of another tag only.
    if bad := [key for key in anchors if states[key] in wrong and (common or texts[key])]:
        worst = max(bad, key=lambda key: [abs(anchors[key][n]) for n in ("stopped", "displaced", "residual")])
        reason, _, action = (common or texts[worst]).partition(": ")
        if (
            not common
            and not anchors[worst]["displaced"]
            and sum(_is_wrong(means) for means in anchors.values()) > 1
            and _is_wrong(anchors[worst])
        ):
            action += " Several anchors read wrong: check height and lever arm of the tag, too."
        return reason, action
    received = sum(means["stopped"] == 0.0 for means in anchors.values())
    if anchors and received < MIN_ANCHORS:
        return f"{received} anchors received", "Drive closer to the anchors, or add some."
    if math.isnan(sd_m):
        return "its standard deviation is unknown", "Publish poses with a covariance."
    if sd_m > MAX_SD_M:
        return f"uncertain by {sd_m:.2f} m", "Add an anchor, or set height and area of the locator."
    return "", next((texts[key] for key in anchors if states[key] == CHECK), "")


def accuracy_text(sd_m: float) -> str:
    """Return a horizontal standard deviation and the radius of 95 % of the errors as text; NaN: empty."""
    return "" if math.isnan(sd_m) else f"horizontal sd {sd_m:.2f} m, 95 % within {RADIUS95 * sd_m:.2f} m"


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
