"""State of pairs and anchors, with advice, and the accuracy that the positions of the anchors permit."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.viewer.scene import Pair

LONG_M, VERY_LONG_M = 0.15, 0.3
"""Mean residuals that need attention, and that spoil positions."""
LOST, NLOS, NOT_OK = 20.0, 50.0, 20.0
"""Shares of ranges that need attention, %."""
GOOD, CHECK, BAD = "\u25cf good", "\u25b2 check", "\u2716 bad"
STATES = (
    f"{BAD}: no ranges, or a mean residual over {VERY_LONG_M:.2f} m. {CHECK}: a mean residual over {LONG_M:.2f} m, "
    f"{LOST:.0f} % lost, {NOT_OK:.0f} % not OK, or {NLOS:.0f} % NLOS. The status of a pair shows only "
    "whether the network could correct the range, not whether the range agrees with the position."
)
"""Definition of the states, for the page."""
CELLS = 40
"""Width and height of the map of the predicted accuracy, cells."""
MAX_PREDICTED_M = 10.0
"""Larger predicted standard deviations are not shown."""

Means = Mapping[str, float]
"""Means of a pair or an anchor: `rate` (Hz); `nlos`, `lost`, `not_ok` (%); `residual`, corrected range minus distance to
the estimated position (m); `stopped`, age of the last range if it is not recent, else 0 (s). NaN: unknown."""


def state(means: Means) -> str:
    """Return the state of a pair or an anchor."""
    residual_m = abs(means["residual"])
    if means["stopped"] > 0.0 or residual_m > VERY_LONG_M:
        return BAD
    is_suspicious = means["lost"] > LOST or means["not_ok"] > NOT_OK or means["nlos"] > NLOS
    return CHECK if is_suspicious or residual_m > LONG_M else GOOD


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
        result[anchor_id] = means | {"rate": sum(values["rate"]), "stopped": min(values["stopped"])}
    return result


def advice(anchors: Mapping[int, Means]) -> tuple[str, dict[int, str]]:
    """Return a sentence on what all anchors have in common, and one for each anchor; empty: no advice.

    If all anchors are wrong in the same way, the cause is probably not in each of them.
    """
    common = _common_advice(list(anchors.values())) if len(anchors) > 1 else ""
    return common, {
        anchor_id: "" if common else _anchor_advice(f"Anchor {format_id(anchor_id)}", means)
        for anchor_id, means in anchors.items()
    }


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
    if abs(residual_m) > LONG_M and means["nlos"] > NLOS:
        return f"{reads}, with {means['nlos']:.0f} % NLOS: its line of sight is probably blocked. Move it if possible."
    if abs(residual_m) > LONG_M:
        return f"{reads}: calibrate, or check its position."
    if means["lost"] > LOST:
        return f"{name} loses {means['lost']:.0f} % of its ranges: check distance and antenna."
    if means["not_ok"] > NOT_OK:
        return f"{means['not_ok']:.0f} % of the ranges of {name.lower()} are not OK: see their status."
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
        The values, m, float32 (CELLS, CELLS), NaN where undetermined; lower left corner and size, float64 (2,), m.
    """
    margin_m = 1.0 + 0.1 * np.ptp(anchors[:, :2], axis=0)
    low, size = anchors[:, :2].min(axis=0) - margin_m, np.ptp(anchors[:, :2], axis=0) + 2.0 * margin_m
    centres = (np.arange(CELLS) + 0.5) / CELLS
    x, y = np.meshgrid(low[0] + centres * size[0], low[1] + centres * size[1])
    delta = np.stack([x, y, np.full_like(x, height_m)], axis=-1)[:, :, None, :] - anchors
    slope = (delta / np.maximum(np.linalg.norm(delta, axis=-1, keepdims=True), 0.05))[..., :2]
    normal = np.einsum("xymi,xymj->xyij", slope, slope)
    determinant = normal[..., 0, 0] * normal[..., 1, 1] - normal[..., 0, 1] ** 2
    trace = normal[..., 0, 0] + normal[..., 1, 1]
    predicted_m = sd_m * np.sqrt(trace / np.where(determinant > 1e-6, determinant, np.nan))
    predicted_m[predicted_m > MAX_PREDICTED_M] = np.nan
    return predicted_m.astype(np.float32), low, size
