"""The verdict on the position of a tag in the diagnostics of the locator, by the rules and with the sentences of `positioning.health`."""

from __future__ import annotations

import math
import time
from collections import defaultdict, deque
from collections.abc import Callable

import numpy as np

from uwb_mitigation.errors import format_id
from uwb_mitigation.positioning import health
from uwb_mitigation.positioning.determination import current_determination
from uwb_mitigation.positioning.health import LONG_M, NO_DATA_INTERVALS, NO_DATA_S, Means, Verdict
from uwb_mitigation.positioning.multi_tag import TagState
from uwb_mitigation.positioning.residual_directions import ResidualDirections, displaced_anchor
from uwb_mitigation.types.anchors import Anchor
from uwb_mitigation.types.measurement import CorrectedRange, Status
from uwb_mitigation.types.tracks import Estimate

MAX_RANGES, RECENT_S = 50, 60.0
"""Number of latest ranges of an anchor whose mean residual is compared with the limits, and the time after which an anchor is forgotten."""


class PositionMonitor:
    """Receives the ranges and estimates of one tag.

    Args:
        tag: its estimators.
        now_s: a steady clock: stamps of ranges may be on another one.
    """

    def __init__(self, tag: TagState, now_s: Callable[[], float] = time.monotonic) -> None:
        self.name = f"tag {format_id(tag.tag_id)}"
        self._tag, self._now_s = tag, now_s
        self._received_s = now_s()
        self._estimate: Estimate | None = None
        # Reception of a range, s; range minus distance to the estimate, m, NaN without one; whether its correction is uncertain.
        self._residuals = defaultdict[Anchor, deque[tuple[float, float, bool]]](
            lambda: deque(maxlen=MAX_RANGES)
        )
        self._directions = defaultdict[int, ResidualDirections](ResidualDirections)

    @property
    def age_s(self) -> float:
        """Time since the last range, s."""
        return self._now_s() - self._received_s

    def add(self, anchor: Anchor, corrected: CorrectedRange, estimate: Estimate | None) -> None:
        """Add a range, and the estimate of the antenna after it."""
        self._received_s, self._estimate = self._now_s(), estimate
        residual_m = math.nan
        if estimate is not None:
            position = estimate.position.tolist()
            residual_m = corrected.range_m - math.dist(position, anchor.position)
            self._directions[anchor.id].add(self._received_s, corrected.range_m, position, anchor.position)
        # The power gap of the CIR, with which the viewer recognises NLOS, is not in corrected ranges.
        status = corrected.status
        is_uncertain = status is Status.OUT_OF_DISTRIBUTION or (
            status.is_corrected and corrected.variance_m2 > LONG_M**2
        )
        self._residuals[anchor].append((self._received_s, residual_m, is_uncertain))

    def verdict(self) -> Verdict:
        """Return the verdict on the latest position."""
        if self.age_s > NO_DATA_S:
            reason = f"no ranges of {self.name} for {self.age_s:.0f} s"
            return Verdict(health.LOST, reason, "Check power of the tag, and the driver.")
        current, estimate = current_determination(self._tag.estimator), self._estimate
        statement, _, remedy = str(current).partition(". Remedy: ")
        if estimate is None:
            reason = f"no position of {self.name}" if current.is_unique else statement
            return Verdict(health.UNDETERMINED, reason, remedy and f"Remedy: {remedy}")
        sd_m, anchors = math.sqrt(np.trace(estimate.covariance[:2, :2])), self._means()
        reason, action = statement, remedy and f"Remedy: {remedy}"
        if current.is_unique:
            states = {key: health.state(means) for key, means in anchors.items()}
            names = {anchor.id: anchor.name for anchor in self._residuals}
            reason, action = health.degradation(anchors, states, names, sd_m)
        state = health.DEGRADED if reason else health.POSITION_GOOD
        return Verdict(state, reason, action, health.accuracy_text(sd_m))

    def sentence(self) -> tuple[bool, str]:
        """Return whether the position is good, and the verdict as text."""
        verdict = self.verdict()
        is_good = verdict.state == health.POSITION_GOOD
        action = verdict.action and f". {verdict.action[0].upper()}{verdict.action[1:]}".removesuffix(".")
        detail = f": {verdict.accuracy}" if is_good else action
        return is_good, verdict.headline(f" of {self.name}") + detail

    def residuals(self) -> str:
        """Return each anchor with the mean of range minus distance to the position, m."""
        return ", ".join(f"{format_id(key)} {means['residual']:+.2f}" for key, means in self._means().items())

    def _means(self) -> dict[int, Means]:
        """Return the means of each anchor that was received in the last minute, as the viewer has them of its pairs."""
        result, now_s = dict[int, Means](), self._now_s()
        moved = displaced_anchor(self._directions) or (None, 0.0)
        for anchor, rows in self._residuals.items():
            received_s, residual_m, is_uncertain = np.array(rows).T
            age_s, known_m = now_s - float(received_s[-1]), residual_m[np.isfinite(residual_m)]
            interval_s = float(received_s[-1] - received_s[0]) / max(len(received_s) - 1, 1)
            if age_s < RECENT_S:
                result[anchor.id] = dict.fromkeys(("rate", "lost", "not_ok"), 0.0) | {
                    "displaced": moved[1] if anchor.id == moved[0] else 0.0,
                    "residual": float(known_m.mean()) if len(known_m) else math.nan,
                    "evidence": float(len(known_m)),
                    "nlos": 100.0 * float(is_uncertain.mean()),
                    "stopped": age_s if age_s > max(NO_DATA_S, NO_DATA_INTERVALS * interval_s) else 0.0,
                }
        return result
