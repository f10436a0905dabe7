"""Counts of the mitigator, and the warnings of its diagnostics."""

from __future__ import annotations

import math
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uwb_mitigation.nodes.support.diagnostics import MAX_LATENCIES, drain, percentiles
from uwb_mitigation.types.measurement import CORRECTED, Cir, RangeMeasurement, Status

if TYPE_CHECKING:
    from uwb_mitigation.mitigation.model.choice import Choice


@dataclass(frozen=True, slots=True)
class Threshold:
    """Threshold of a diagnostic warning.

    Attributes:
        quantity: the value that is compared, over the last period.
        limit: the highest value that is OK.
        text: the warning above it.
    """

    quantity: str
    limit: float
    text: str


OUT_OF_DISTRIBUTION = Threshold(
    "share of ranges OUT_OF_DISTRIBUTION",
    0.2,
    "many ranges are out of distribution: the model was trained on other data",
)
NO_USABLE_CIR = Threshold("share of ranges NO_CIR or BAD_CIR", 0.2, "many ranges have no usable CIR")
DROPPED = Threshold("share of ranges dropped", 0.0, "ranges were dropped: the queue was too short")
SLOW = Threshold("p99 of the processing time, ms", 20.0, "correction is slow: the processor is overloaded")
NO_RANGES = Threshold("s without a range", 5.0, "no ranges received")
ALL_REJECTED = Threshold("s in which every range was rejected", 5.0, "every range is rejected")
OFFSET = Threshold(
    "absolute predicted error that three quarters of the LOS ranges exceed, m",
    0.15,
    "the correction of most LOS ranges is large: the model probably includes the antenna delay of other "
    "boards; calibrate offsets",
)

MAX_LOS, MIN_LOS = 1000, 200
"""Maximum and minimum number of latest LOS ranges that are compared with OFFSET. Their median is above its limit for seconds at some
places of drives with right offsets, in which NLOS ranges look like LOS; their quartile is not."""

MAX_PAIRS = 20
"""Maximum number of pairs of radios that are listed for each model."""


class MitigatorHealth:
    """Counts ranges. One thread adds, another reads.

    Args:
        publishers: returns the number of publishers of ranges.
        now_s: a steady clock.

    Attributes:
        statuses: number of ranges by status, since the start.
        lost: ranges that the middleware reports as lost, because the publisher's queue was too short.
        loss_counter: counts the lost ranges and those dropped by the subscription's queue.
        malformed: messages that could not be decoded.
        pairs: first pairs of radios (tag, anchor) of each choice of a model, since the model was set.
        misfit: why no model, or not the named one, can correct a CIR of this period; empty: none.
        rejected: the last CIR whose range was not corrected, since the model was set.
        los_m: predicted errors of the latest LOS ranges without the offsets of the radios.
        excludes_offset: whether the predicted errors do not contain the radios' offset, so that `los_m` is near 0.
    """

    def __init__(
        self, publishers: Callable[[], int] = lambda: 1, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self.statuses: Counter[Status] = Counter()
        self.lost = 0
        self.loss_counter = LossCounter(publishers)
        self.malformed = 0
        self.pairs: dict[Choice, set[tuple[int, int]]] = {}
        self.misfit = ""
        self.rejected: Cir | None = None
        self.los_m: deque[float] = deque(maxlen=MAX_LOS)
        self.excludes_offset = False
        self._processing_ns: deque[int] = deque(maxlen=MAX_LATENCIES)
        self._now_s = now_s
        self._last_s = now_s()
        self._rejected_since_s = math.inf
        self._previous: tuple[Counter[Status], int] = (Counter(), 0)

    @property
    def dropped(self) -> int:
        """Number of ranges that are known to have been dropped by a queue."""
        return max(self.lost, self.loss_counter.missing)

    def add_time(self, processing_ns: int) -> None:
        """Add the processing time of a range or of a batch."""
        self._processing_ns.append(processing_ns)
        self._last_s = self._now_s()

    def add(self, choice: Choice, measurement: RangeMeasurement, status: Status) -> bool:
        """Count a range; return whether it is the first one with this choice of a model."""
        self.statuses[status] += 1
        if status.is_corrected:
            self._rejected_since_s = math.inf
        else:
            self._rejected_since_s = min(self._rejected_since_s, self._last_s)
            if len(measurement.cir):
                self.rejected = measurement.cir
                self.misfit = self.misfit if choice.fits else str(choice)
        is_first = choice not in self.pairs
        pairs = self.pairs.setdefault(choice, set())
        if len(pairs) < MAX_PAIRS:
            pairs.add((measurement.tag_id, measurement.anchor_id))
        return is_first

    def reset_model(self) -> None:
        """Forget the ranges of the previous model."""
        self.pairs, self.misfit, self.rejected, self._rejected_since_s = {}, "", None, math.inf

    def period(self) -> tuple[list[str], dict[str, object], bool]:
        """Begin a new period.

        Returns:
            The warnings of the period that ends, its values for the diagnostics, and whether the model failed.
        """
        previous, previous_dropped = self._previous
        self._previous = self.statuses.copy(), self.dropped
        statuses = self._previous[0] - previous
        dropped = self._previous[1] - previous_dropped
        processing_ns = drain(self._processing_ns)
        los_m = self.los_m.copy()
        median_m = statistics.median(los_m) if los_m else math.nan
        total = max(statuses.total(), 1)
        out_of_distribution = statuses[Status.OUT_OF_DISTRIBUTION] / total
        values = {
            OUT_OF_DISTRIBUTION: out_of_distribution,
            NO_USABLE_CIR: (statuses[Status.NO_CIR] + statuses[Status.BAD_CIR]) / total,
            DROPPED: dropped / max(statuses.total() + dropped, 1),
            SLOW: float(np.percentile(processing_ns, 99)) / 1e6 if processing_ns else 0.0,
            NO_RANGES: self._now_s() - self._last_s,
            ALL_REJECTED: self._last_s - self._rejected_since_s,
            OFFSET: _common_error_m(los_m) if self.excludes_offset and len(los_m) >= MIN_LOS else 0.0,
        }
        entries: dict[str, object] = {f"ranges {status.name}": self.statuses[status] for status in Status}
        corrected = sum(self.statuses[status] for status in CORRECTED)
        entries |= {
            "ranges corrected": f"{corrected} of {self.statuses.total()}",
            "out of distribution": f"{out_of_distribution:.3f}",
            "dropped by a queue": f"{self.dropped}" + ("" if self.loss_counter.complete else " or more"),
            "malformed": self.malformed,
            "line of sight: ranges": len(los_m),
        }
        if los_m:
            entries["line of sight: median predicted error m"] = f"{median_m:.3f}"
        entries |= percentiles("processing", processing_ns)
        warnings = [threshold.text for threshold, value in values.items() if value > threshold.limit]
        if self.misfit:
            warnings.insert(0, f"ranges are not corrected: {self.misfit}")
            self.misfit = ""
        return warnings, entries, statuses[Status.MODEL_ERROR] > 0


NO_SEQUENCE_NUMBER = 2**64 - 1
"""Sequence number of rmw if the middleware provides none (RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED)."""


class LossCounter:
    """Counts dropped messages by the sequence numbers of their publishers.

    A queue with keep-last drops messages silently. A message does not identify its publisher: a number that
    follows a known last number belongs to that publisher. Any other number is the first of a new publisher if
    there are more publishers than known ones, and otherwise a gap after the nearest lower number. The gap may
    be attributed to the wrong publisher, but the total is right.

    Args:
        publishers: returns the number of publishers; called only for a number that does not follow a known one.

    Attributes:
        missing: numbers that were never received.
        complete: False once a message had no number.
    """

    def __init__(self, publishers: Callable[[], int]) -> None:
        self.missing = 0
        self.complete = True
        self._publishers = publishers
        # The last number of each publisher; the latest is at the end.
        self._last: list[int] = []

    def add(self, number: int) -> None:
        """Add the number of a received message."""
        last = self._last
        if last and last[-1] == number - 1:
            last[-1] = number
        elif number == NO_SEQUENCE_NUMBER:
            self.complete = False
        elif number - 1 in last:
            last.remove(number - 1)
            last.append(number)
        else:
            self._add_gap_or_publisher(number)

    def _add_gap_or_publisher(self, number: int) -> None:
        publishers = self._publishers()
        lower = [last for last in self._last if last < number]
        if len(self._last) < publishers or not lower:
            # A publisher has joined or restarted: it replaces the publisher with the oldest last message.
            self._last.append(number)
            del self._last[: max(len(self._last) - max(publishers, 1), 0)]
            return
        nearest = max(lower)
        self.missing += number - nearest - 1
        self._last.remove(nearest)
        self._last.append(number)


def _common_error_m(errors_m: Sequence[float]) -> float:
    """Return the absolute error that three quarters of errors of one sign exceed, m; 0 or less: they differ."""
    low, high = np.percentile(errors_m, (25, 75))
    return float(max(low, -high))
