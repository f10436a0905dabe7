"""State of pairs and anchors, with advice, and the accuracy that the positions of the anchors permit."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.positioning.geometry import dop
from uwb_mitigation.viewer.histories import Pair

LONG_M, VERY_LONG_M = 0.15, 0.3
"""Mean residuals that need attention, and that spoil positions."""
LOST, NLOS, NOT_OK = 20.0, 50.0, 20.0
"""Shares of ranges that need attention, %."""
EVIDENCE = 10
"""Number of ranges with a residual from which an anchor is good or bad."""
RELEASE = 0.8
"""A state ends below this share of the limit at which it begins (hysteresis)."""
GOOD, CHECK, BAD, UNKNOWN = "\u2713 good", "! check", "\u2297 bad", "? unknown"
STATES = (
    f"{BAD}: no ranges, or a mean residual over {VERY_LONG_M:.2f} m with line of sight. {CHECK}: a mean residual over {LONG_M:.2f} "
    f"m, {LOST:.0f} % lost, {NOT_OK:.0f} % with a status that needs attention, or {NLOS:.0f} % NLOS. {UNKNOWN}: fewer than "
    f"{EVIDENCE} ranges can be compared with the position. The status of a pair shows only whether the network could correct the range."
)
"""Definition of the states, for the page."""
CELLS = 40
"""Width and height of the map of the predicted accuracy, cells."""
STEPS_M = (0.1, 0.2, 0.5, 1.0, 10.0)
"""Upper limits of the colours of the map of the predicted accuracy; above the last one, it is not shown."""

Means = Mapping[str, float]
"""Means of a pair or an anchor: `rate` (Hz); `nlos`, `lost`, `not_ok` (%); `residual`, corrected range minus distance to
the estimated position (m); `evidence`, number of residuals; `stopped`, age of the last range if it is not recent, else 0 (s);
`displaced`, held-out residual (m) of an anchor whose ranges fit another position, else 0. NaN: unknown."""


def state(means: Means, before: str = "") -> str:
    """Return the state of a pair or an anchor; `before`: its state until now."""
    residual_m = abs(means["residual"]) if means["evidence"] >= EVIDENCE else math.nan
    bad_m, check_m = (
        limit_m * (RELEASE if before in states else 1.0)
        for limit_m, states in ((VERY_LONG_M, (BAD,)), (LONG_M, (BAD, CHECK)))
    )
    # Without line of sight, ranges may be long although anchor and offset are right.
    is_long = residual_m > bad_m and not means["nlos"] > NLOS
    if means["stopped"] > 0.0 or means["displaced"] > 0.0 or is_long:
        return BAD
    is_suspicious = means["lost"] > LOST or means["not_ok"] > NOT_OK or means["nlos"] > NLOS
    if is_suspicious or residual_m > check_m:
        return CHECK
    return GOOD if means["rate"] > 0.0 and not math.isnan(residual_m) else UNKNOWN


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
    return "", {anchor_id: _anchor_advice(labels[anchor_id], means) for anchor_id, means in anchors.items()}


def _common_advice(anchors: list[Means]) -> str:
    residuals_m = np.array([means["residual"] for means in anchors])
    if all(means["stopped"] > 0.0 for means in anchors):
        return "No anchor answers: check the tag, and the diagnostics of the driver."
    if not (np.abs(residuals_m) > LONG_M).all():
        return ""
    if all(means["nlos"] > NLOS for means in anchors):
        return "The ranges of all anchors contradict the position, and most are NLOS: something close to the tag covers it."
    if np.ptp(np.sign(residuals_m)) > 0.0:
        return "The ranges of all anchors contradict the position: check ids and coordinates in the anchors file, and the height."
    size_m, direction = abs(float(np.median(residuals_m))), "long" if residuals_m[0] > 0.0 else "short"
    return (
        f"All anchors read too {direction}, {size_m:.2f} m in the median: a common cause is likely. Calibrate the offset "
        "(antenna delay), or check the anchors file and the height."
    )


def _anchor_advice(name: str, means: Means) -> str:
    residual_m = means["residual"]
    reads = f"{name} reads {abs(residual_m):.2f} m {'long' if residual_m > 0.0 else 'short'}"
    if means["stopped"] > 0.0:
        return f"{name} has not answered for {means['stopped']:.0f} s: check its power and PAN id."
    if means["displaced"] > 0.0:
        return (
            f"{name} is not where the anchors file says: its ranges differ by {means['displaced']:.2f} m from the track of the "
            "others, and fit another position. Measure it again."
        )
    if abs(residual_m) > LONG_M and means["nlos"] > NLOS:
        return f"{reads}, with {means['nlos']:.0f} % NLOS: its line of sight is probably blocked. Move it if possible."
    if abs(residual_m) > LONG_M:
        return f"{reads}: calibrate, or check its position."
    if means["lost"] > LOST:
        return f"{name} loses {means['lost']:.0f} % of its ranges: check distance and antenna."
    if means["not_ok"] > NOT_OK:
        return (
            f"{name} has {means['not_ok']:.0f} % of ranges with a status that needs attention: see the pairs."
        )
    if means["nlos"] > NLOS:
        return f"{name} has no line of sight in {means['nlos']:.0f} % of the CIRs: move it if possible."
    return ""


def predicted_accuracy(
    anchors: NDArray[np.float64], height_m: float, sd_m: float
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
    """Return the horizontal standard deviation of positions at a known height if all anchors are received.

    It is HDOP times the standard deviation of the ranges.

    Args:
        anchors: positions, float64 (m, 3), m.
        height_m: height of the tag, m.
        sd_m: standard deviation of a range, m.

    Returns:
        The values, m, float32 (CELLS, CELLS), infinite where undetermined; lower left corner and size, float64 (2,), m.
    """
    margin_m = 1.0 + 0.1 * np.ptp(anchors[:, :2], axis=0)
    low, size = anchors[:, :2].min(axis=0) - margin_m, np.ptp(anchors[:, :2], axis=0) + 2.0 * margin_m
    x, y = low[:, None] + (np.arange(CELLS) + 0.5) / CELLS * size[:, None]
    image = [[dop(anchors, np.array([at_x, at_y, height_m]), level=True).hdop for at_x in x] for at_y in y]
    return (sd_m * np.array(image)).astype(np.float32), low, size
