"""What the viewer shows at one moment: pairs with their last minute and last CIRs, tags, anchors, diagnostics.

Plain bookkeeping with a bound on everything that a stream could fill. It is fed in the order of time, by a node
from topics or by a recording; no ROS, no page, no I/O here.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import NamedTuple

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


class Sample(NamedTuple):
    """One corrected range of a pair.

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
    """The last minute of one pair."""

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

    def rate_hz(self) -> float:
        """Ranges a second over the last twenty; NaN before the second one."""
        # At once: the monitor's table looks from another thread than the one that adds.
        recent = [sample.time_s for sample in list(islice(reversed(self.samples), 20))]
        span = recent[0] - recent[-1] if recent else 0.0
        return (len(recent) - 1) / span if span > 0 else math.nan


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
    """A tag's latest pose, and where it came from."""

    pose: Pose | None = None
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
    """The latest diagnostics of one node: level 0 OK, 1 WARN, 2 ERROR, 3 STALE."""

    level: int
    message: str


class Scene:
    """Everything that the page shows.

    Attributes:
        now_s: the latest stamp seen; NaN before any.
        ranges, not_shown: how many came, and how many of them are of pairs beyond `MAX_PAIRS`.
        pairs: {(anchor, tag): its last minute}, those heard last at the end.
        tags, true_trails, anchors, reports: {id or name: ...}.
        revision: grows with every change, so that a page may leave alone what has not changed.
    """

    def __init__(self) -> None:
        self.now_s = math.nan
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
        if sample.time_s < self.now_s - STRIP_S or (latest and sample.time_s < latest.time_s - 1.0):
            self.rewind()
        self.now_s = max(sample.time_s, self.now_s) if math.isfinite(self.now_s) else sample.time_s
        self.ranges += 1
        if (history := self.history(pair)) is None:
            self.not_shown += 1
        else:
            history.add(sample, self.now_s)

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

    def add_trace(self, pair: Pair, trace: Trace) -> None:
        if (history := self.history(pair)) is not None:
            history.traces.append(trace)

    def add_pose(self, tag: str, pose: Pose) -> None:
        if not _on_earth(pose.x, pose.y):
            return
        entry = self._tag(tag)
        entry.pose = pose
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
        self.reports[name[:MAX_TEXT]] = Report(report.level, report.message[:MAX_TEXT])
        self.reports.move_to_end(name[:MAX_TEXT])
        if len(self.reports) > MAX_REPORTS:
            self.reports.popitem(last=False)
        self.revision += 1

    def rewind(self) -> None:
        """Forget the last minute, but not what was counted, the anchors and the diagnostics."""
        self.now_s = math.nan
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
        """Every pair that has been heard within the last minute, by anchor and tag."""
        for pair, history in sorted(self.pairs.items()):
            if history.latest is not None and history.latest.time_s >= self.now_s - STRIP_S:
                yield pair, history, history.latest

    def tag_of(self, tag_id: int) -> Tag | None:
        """The tag of ranges: the one of its name, else the plain one where no second tag lacks a name of its own."""
        own = self.tags.get(tag_frame(tag_id))
        nameless = {tag for _, tag in self.pairs if tag_frame(tag) not in self.tags}
        return self.tags.get(PLAIN) if own is None and nameless == {tag_id} else own

    def _forget_silent(self) -> bool:
        """Forget the pair unheard the longest, if that is long enough."""
        pair, history = next(iter(self.pairs.items()))
        if history.latest is not None and history.latest.time_s > self.now_s - SILENT_S:
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
