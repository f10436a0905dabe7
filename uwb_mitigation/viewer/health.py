"""State of the anchors, with advice, and the accuracy that their positions permit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.viewer.scene import Pair, Scene

LONG_M, VERY_LONG_M = 0.15, 0.3
"""Mean residuals of an anchor that need attention, and that spoil positions."""
LOST, NLOS, NOT_OK = 20.0, 50.0, 20.0
"""Shares of ranges that need attention, %."""
CELLS = 40
"""Width and height of the map of the predicted accuracy, cells."""
MAX_PREDICTED_M = 10.0
"""Larger predicted standard deviations are not shown."""


class Level(IntEnum):
    """Traffic light of an anchor."""

    OK = 0
    CHECK = 1
    BAD = 2


@dataclass(frozen=True, slots=True)
class AnchorHealth:
    """Means over the pairs of one anchor; NaN: unknown.

    Attributes:
        rate_hz: sum of the rates of its pairs.
        nlos, lost, not_ok: shares, %.
        residual_m: mean of corrected range minus distance to the estimated position.
        age_s: time since the last range if the anchor has stopped, else NaN.
    """

    anchor_id: int
    rate_hz: float
    nlos: float
    lost: float
    not_ok: float
    residual_m: float
    age_s: float = math.nan

    def verdict(self) -> tuple[Level, str]:
        """Return the level and a sentence with advice."""
        name = f"Anchor {format_id(self.anchor_id)}"
        if self.age_s > 0.0:
            return Level.BAD, f"{name} has not answered for {self.age_s:.0f} s: check its power and PAN id."
        if abs(self.residual_m) > LONG_M:
            level = Level.BAD if abs(self.residual_m) > VERY_LONG_M else Level.CHECK
            direction = "long" if self.residual_m > 0.0 else "short"
            advice = (
                f"{name} reads {abs(self.residual_m):.2f} m {direction}: calibrate, or check its position."
            )
            return level, advice
        if self.lost > LOST:
            return Level.CHECK, f"{name} loses {self.lost:.0f} % of its ranges: check distance and antenna."
        if self.not_ok > NOT_OK:
            return (
                Level.CHECK,
                f"{self.not_ok:.0f} % of the ranges of {name.lower()} are not OK: see their status.",
            )
        if self.nlos > NLOS:
            return (
                Level.CHECK,
                f"{name} has no line of sight in {self.nlos:.0f} % of the CIRs: move it if possible.",
            )
        return Level.OK, ""


def anchor_health(
    scene: Scene, statistics: dict[Pair, dict[str, float]], losses: dict[Pair, tuple[int, int]]
) -> list[AnchorHealth]:
    """Return the state of each anchor with ranges.

    Args:
        scene: provides the latest ranges.
        statistics: of the latest ranges of each pair.
        losses: lost and received ranges of each pair of a recording; of other pairs, those of the scene are used.
    """
    rows: dict[int, list[list[float]]] = {}
    for pair, history, _ in scene.latest():
        age_s = scene.age_s(history)
        has_data, means = history.has_data(age_s), statistics[pair]
        lost, received = losses.get(pair, (history.lost, history.received))
        rows.setdefault(pair[0], []).append(
            [
                history.rate_hz(age_s) if has_data else 0.0,
                means["nlos"],
                100.0 * lost / max(lost + received, 1),
                means["not_ok"],
                means["innovation"],
                math.nan if has_data else age_s,
            ]
        )
    health = []
    for anchor_id, values in rows.items():
        table = np.array(values)
        rates, ages = table[:, 0], table[:, 5]
        averages = [
            float(column[~np.isnan(column)].mean()) if not np.isnan(column).all() else math.nan
            for column in table.T[1:5]
        ]
        stopped_s = float(ages.min()) if np.isfinite(ages).all() else math.nan
        nlos, lost_share, not_ok, residual_m = averages
        rate_hz = float(np.nansum(rates))
        health.append(AnchorHealth(anchor_id, rate_hz, nlos, lost_share, not_ok, residual_m, stopped_s))
    return health


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
