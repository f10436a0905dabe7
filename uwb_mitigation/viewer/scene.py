"""What the viewer shows at one moment: pairs with their last minute and last CIRs, tags, anchors, diagnostics.

Plain bookkeeping with a bound on everything that a stream could fill. It is fed in the order of time, by a node
from topics or by a recording; no ROS, no page, no I/O here.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.bag.poses import tag_frame
from uwb_mitigation.measurement import Cir, CorrectedRange, Encoding, Status, Truth

STRIP_S = 60.0
"""A pair's strip chart holds the last minute."""

WATERFALL = 50
"""Exchanges whose CIRs are kept for each pair."""

MAX_PAIRS, MAX_TAGS, MAX_REPORTS, MAX_ANCHORS = 256, 64, 64, 256
"""Ids come from the air: of more than these, those unheard the longest are forgotten, pairs once they are silent."""

SILENT_S = 10.0
"""A pair unheard for as long makes room for another: of too many, some are shown rather than each for a moment."""

NO_DATA_S, NO_DATA_INTERVALS = 3.0, 3.0
"""A pair or a tag has no data after this time, or after this many of its mean intervals if that is longer."""

STALE_S = 5.0
"""A node is STALE if its last diagnostics are older than this, as in rqt_robot_monitor."""

MAX_STRIP, MAX_TRAIL = 6000, 1200
"""Points of a strip (100 ranges a second for a minute) and of a tag's trail."""

MAX_TRUTHS = 10_000
"""Truths that wait for their corrected ranges."""

MAX_VALUES = 2 * 1016
"""Of a CIR's samples: the DW1000's whole accumulator, real and imaginary."""

MAX_TEXT = 400
"""Letters kept of a name or a message."""

FARTHEST_M = 10_000.0
"""A range of more is in the table alone, and no error of more is counted: no radio has measured it."""

FARTHEST_PLACE_M = 2e7
"""From the origin of any coordinates of a place on Earth: one of more is left out."""

ERROR_EDGES_M = np.linspace(-1.0, 2.0, 61)
"""Bins of the error histogram; what lies beyond counts in the outermost."""

Pair = tuple[int, int]
"""Anchor and tag."""

PLAIN = "tag"
"""The tag whose topics have the plain names, whatever its number is; others are called as `tag_frame` has it."""


@dataclass(slots=True)
class Sample:
    """One corrected range of a pair; its truth may arrive later.

    Attributes:
        time_s: its stamp.
        raw_m, range_m, sigma_m: as measured, corrected, and the corrected one's standard deviation.
        status: of `measurement.Status`.
        true_m, label: NaN and empty = unknown.
    """

    time_s: float
    raw_m: float
    range_m: float
    sigma_m: float
    status: Status
    true_m: float = math.nan
    label: str = ""

    @classmethod
    def of(cls, time_s: float, corrected: CorrectedRange, truth: Truth | None) -> Sample:
        return cls(
            time_s,
            corrected.range_raw_m,
            corrected.range_m,
            math.sqrt(corrected.variance_m2) if corrected.variance_m2 >= 0 else math.nan,
            corrected.status,
            math.nan if truth is None else truth.range_m,
            "" if truth is None else truth.label,
        )


class Truths:
    """Truths until their corrected ranges come; bounded, should those be lost."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Hashable, Truth] = OrderedDict()

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, key: Hashable, truth: Truth) -> None:
        self._kept[key] = truth
        if len(self._kept) > MAX_TRUTHS:
            self._kept.popitem(last=False)

    def take(self, key: Hashable) -> Truth | None:
        return self._kept.pop(key, None)


class Trace:
    """One CIR; its magnitudes are computed when somebody looks at them, which of most nobody does.

    Attributes:
        time_s: the stamp of its range.
        cir: as it came.
    """

    __slots__ = ("_magnitude", "cir", "time_s")

    def __init__(self, cir: Cir, time_s: float) -> None:
        self.cir = cir
        self.time_s = time_s
        self._magnitude: NDArray[np.float32] | None = None

    @classmethod
    def of(cls, cir: Cir, time_s: float) -> Trace | None:
        """None where the CIR holds no samples, or they are not what its encoding says, or out of all proportion."""
        odd = cir.encoding is Encoding.COMPLEX_INT16 and len(cir.samples) % 2
        if odd or not 0 < len(cir.samples) <= MAX_VALUES:
            return None
        # The largest sample times the scale must be a float32 still, and the first path's index an int32, as the others'.
        if not abs(cir.scale) < 1e30 or (
            math.isfinite(cir.first_path_index) and abs(cir.first_path_index) >= 2**31
        ):
            return None
        # They may be a view into a message of any size.
        return cls(replace(cir, samples=cir.samples.copy()), time_s)

    @property
    def magnitude(self) -> NDArray[np.float32]:
        """In accumulator units, float32 (n,)."""
        if self._magnitude is None:
            values = self.cir.samples.astype(np.float32)
            if self.cir.encoding is Encoding.COMPLEX_INT16:
                values = np.hypot(values[0::2], values[1::2])
            self._magnitude = values * np.float32(self.cir.scale)
        return self._magnitude

    @property
    def origin(self) -> int:
        """The sample of the accumulator that holds the first path; of an unknown one, the first that came."""
        first = self.cir.first_path_index
        return math.floor(first) if math.isfinite(first) else self.cir.start_index


@dataclass(slots=True)
class History:
    """The last minute of one pair.

    Attributes:
        received_s: time of the last range on the scene's clock.
    """

    received_s: float = math.nan
    samples: deque[Sample] = field(default_factory=lambda: deque(maxlen=MAX_STRIP))
    traces: deque[Trace] = field(default_factory=lambda: deque(maxlen=WATERFALL))

    def add(self, sample: Sample, now_s: float) -> None:
        """A range; what is older than a minute is forgotten."""
        self.samples.append(sample)
        while self.samples[0].time_s < now_s - STRIP_S:
            self.samples.popleft()

    @property
    def latest(self) -> Sample | None:
        return self.samples[-1] if self.samples else None

    def rate_hz(self, age_s: float = 0.0) -> float:
        """Ranges a second over the last twenty; NaN before the second one.

        Args:
            age_s: time since the last range; the rate decreases if this is several mean intervals.
        """
        # At once: the monitor's table looks from another thread than the one that adds.
        recent = [sample.time_s for sample in list(islice(reversed(self.samples), 20))]
        span = recent[0] - recent[-1] if recent else 0.0
        if not span > 0:
            return math.nan
        rate_hz = (len(recent) - 1) / span
        return rate_hz if age_s * rate_hz <= NO_DATA_INTERVALS else len(recent) / (span + age_s)

    def has_data(self, age_s: float) -> bool:
        """Return whether the last range is recent enough, relative to the mean interval of this pair."""
        rate_hz = self.rate_hz()
        return age_s <= max(NO_DATA_S, NO_DATA_INTERVALS / rate_hz if rate_hz > 0 else 0.0)


@dataclass(frozen=True, slots=True)
class Pose:
    """Where a tag is said to be, in metres.

    Attributes:
        ellipse: the horizontal 95 % ellipse: half axes (m) and the angle of the larger (rad); NaN = unknown.
    """

    time_s: float
    x: float
    y: float
    z: float = math.nan
    ellipse: tuple[float, float, float] = (math.nan, math.nan, math.nan)


@dataclass(slots=True)
class Tag:
    """A tag's latest pose, when it was received on the scene's clock, and where it came from."""

    pose: Pose | None = None
    received_s: float = math.nan
    trail: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=MAX_TRAIL))


@dataclass(frozen=True, slots=True)
class AnchorPlace:
    """An anchor on the map, in metres."""

    x: float
    y: float
    z: float = math.nan
    name: str = ""


@dataclass(frozen=True, slots=True)
class Report:
    """The latest diagnostics of one node: level 0 OK, 1 WARN, 2 ERROR, 3 STALE.

    Attributes:
        received_s: time of reception on the scene's clock; NaN: the report never becomes stale.
    """

    level: int
    message: str
    received_s: float = math.nan

    def at(self, now_s: float) -> Report:
        """Return what to show at a time: STALE with the age if the node has stopped reporting."""
        age_s = now_s - self.received_s
        if not age_s > STALE_S:
            return self
        return replace(self, level=STALE, message=f"no diagnostics for {age_s:.0f} s; last: {self.message}")


STALE = 3


class Scene:
    """Everything that the page shows.

    Attributes:
        clock: returns the time that ages are measured with, s: a steady clock live, the recording's time in a replay.
            Stamps are not compared with it: they may come from another computer.
        now_s: the latest stamp seen plus the time since then; NaN before any.
        ranges, not_shown: how many came, and how many of them are of pairs beyond `MAX_PAIRS`.
        pairs: {(anchor, tag): its last minute}, those heard last at the end.
        tags, true_trails, anchors, reports: {id or name: ...}.
        revision: grows with every change, so that a page may leave alone what has not changed.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self._latest_s = self._received_s = math.nan
        self.ranges = self.not_shown = 0
        self.pairs: OrderedDict[Pair, History] = OrderedDict()
        self.tags: OrderedDict[str, Tag] = OrderedDict()
        self.true_trails: OrderedDict[str, deque[tuple[float, float]]] = OrderedDict()
        self.anchors: dict[int, AnchorPlace] = {}
        self.reports: OrderedDict[str, Report] = OrderedDict()
        self.raw_errors = np.zeros(len(ERROR_EDGES_M) - 1, np.int64)
        self.corrected_errors = np.zeros_like(self.raw_errors)
        self.raw_error_sum_m = self.corrected_error_sum_m = 0.0
        self.errors = 0
        self.revision = 0

    @property
    def now_s(self) -> float:
        return self._latest_s + max(self.clock() - self._received_s, 0.0)

    def age_s(self, entry: History | Tag) -> float:
        """Return the time since the last data of a pair or tag."""
        return max(self.clock() - entry.received_s, 0.0)

    def history(self, pair: Pair) -> History | None:
        """The history of a pair, made anew for a new one; the pair counts as heard. None: there are too many."""
        history = self.pairs.get(pair)
        if history is None:
            if len(self.pairs) == MAX_PAIRS and not self._forget_silent():
                return None
            history = self.pairs[pair] = History()
        self.pairs.move_to_end(pair)
        self.revision += 1
        return history

    def add_sample(self, pair: Pair, sample: Sample) -> None:
        """A corrected range. Time that jumps back by more than a second (a replay's loop) starts the strips anew.

        The clocks of two pairs may differ by less than a strip: only a pair's own time tells of a jump sooner.
        """
        known = self.pairs.get(pair)
        latest = None if known is None else known.latest
        if sample.time_s < self._latest_s - STRIP_S or (latest and sample.time_s < latest.time_s - 1.0):
            self.rewind()
        if not sample.time_s < self._latest_s:
            self._latest_s, self._received_s = sample.time_s, self.clock()
        self.ranges += 1
        if (history := self.history(pair)) is None:
            self.not_shown += 1
        else:
            history.add(sample, self._latest_s)
            history.received_s = self.clock()

    def add_error(self, sample: Sample) -> None:
        """Count a range in the histogram, where its truth is known."""
        raw_m, corrected_m = sample.raw_m - sample.true_m, sample.range_m - sample.true_m
        if not (abs(raw_m) <= FARTHEST_M and abs(corrected_m) <= FARTHEST_M):
            return
        for errors, value in ((self.raw_errors, raw_m), (self.corrected_errors, corrected_m)):
            place = int(np.searchsorted(ERROR_EDGES_M, value, side="right")) - 1
            errors[min(max(place, 0), len(errors) - 1)] += 1
        self.raw_error_sum_m += abs(raw_m)
        self.corrected_error_sum_m += abs(corrected_m)
        self.errors += 1

    def set_truth(self, sample: Sample, truth: Truth) -> None:
        """Add the truth of a range that was added without it."""
        sample.true_m, sample.label = truth.range_m, truth.label
        self.add_error(sample)
        self.revision += 1

    def add_trace(self, pair: Pair, trace: Trace) -> None:
        if (history := self.history(pair)) is not None:
            history.traces.append(trace)

    def add_pose(self, tag: str, pose: Pose) -> None:
        if not _on_earth(pose.x, pose.y):
            return
        entry = self._tag(tag)
        entry.pose, entry.received_s = pose, self.clock()
        entry.trail.append((pose.x, pose.y))

    def add_true_position(self, tag: str, x: float, y: float) -> None:
        """Where a tag truly was, by the name that the truth has for it."""
        if not _on_earth(x, y):
            return
        trail = self.true_trails.setdefault(tag[:MAX_TEXT], deque(maxlen=MAX_TRAIL))
        trail.append((x, y))
        if len(self.true_trails) > MAX_TAGS:
            self.true_trails.popitem(last=False)
        self.revision += 1

    def set_anchors(self, anchors: dict[int, AnchorPlace]) -> None:
        placed = ((identity, place) for identity, place in anchors.items() if _on_earth(place.x, place.y))
        self.anchors = dict(islice(placed, MAX_ANCHORS))
        self.revision += 1

    def add_report(self, name: str, report: Report) -> None:
        self.reports[name[:MAX_TEXT]] = replace(report, message=report.message[:MAX_TEXT])
        self.reports.move_to_end(name[:MAX_TEXT])
        if len(self.reports) > MAX_REPORTS:
            self.reports.popitem(last=False)
        self.revision += 1

    def rewind(self) -> None:
        """Forget the last minute, but not what was counted, the anchors and the diagnostics."""
        self._latest_s = self._received_s = math.nan
        for history in self.pairs.values():
            history.samples.clear()
            history.traces.clear()
        self.tags.clear()
        self.true_trails.clear()

    def clear(self) -> None:
        """Forget everything but the anchors."""
        self.rewind()
        self.pairs.clear()
        self.ranges = self.not_shown = 0
        self.reports.clear()
        for errors in (self.raw_errors, self.corrected_errors):
            errors[:] = 0
        self.raw_error_sum_m = self.corrected_error_sum_m = 0.0
        self.errors = 0
        self.revision += 1

    def mean_errors_m(self) -> tuple[float, float]:
        """Mean absolute error of raw and of corrected ranges whose truth is known; NaN without any."""
        if not self.errors:
            return math.nan, math.nan
        return self.raw_error_sum_m / self.errors, self.corrected_error_sum_m / self.errors

    def latest(self) -> Iterator[tuple[Pair, History, Sample]]:
        """Every pair with its last range, by anchor and tag; also those that have stopped."""
        for pair, history in sorted(self.pairs.items()):
            if history.latest is not None:
                yield pair, history, history.latest

    def tag_of(self, tag_id: int) -> Tag | None:
        """The tag of ranges: the one of its name, else the plain one where no second tag lacks a name of its own."""
        own = self.tags.get(tag_frame(tag_id))
        nameless = {tag for _, tag in self.pairs if tag_frame(tag) not in self.tags}
        return self.tags.get(PLAIN) if own is None and nameless == {tag_id} else own

    def _forget_silent(self) -> bool:
        """Forget the pair unheard the longest, if that is long enough."""
        pair, history = next(iter(self.pairs.items()))
        if history.latest is not None and self.age_s(history) < SILENT_S:
            return False
        del self.pairs[pair]
        return True

    def _tag(self, tag: str) -> Tag:
        self.revision += 1
        entry = self.tags.setdefault(tag[:MAX_TEXT], Tag())
        self.tags.move_to_end(tag[:MAX_TEXT])
        if len(self.tags) > MAX_TAGS:
            self.tags.popitem(last=False)
        return entry


def _on_earth(x: float, y: float) -> bool:
    return abs(x) <= FARTHEST_PLACE_M and abs(y) <= FARTHEST_PLACE_M
