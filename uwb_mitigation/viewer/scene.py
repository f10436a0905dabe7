"""State of the viewer: pairs, tags, anchors, diagnostics.

Topics or a recording add data in the order of time. No ROS, no page, no I/O here. Everything that a stream can fill has a
limit.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_right
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.health import NO_DATA_S
from uwb_mitigation.positioning.online.measurements import TagHeight, TagRange
from uwb_mitigation.positioning.online.tag_estimator import TagEstimator
from uwb_mitigation.positioning.recorded_tracks import TagTracks
from uwb_mitigation.positioning.residual_directions import ResidualDirections
from uwb_mitigation.types.anchors import MAX_ANCHORS, Anchor, AnchorMap
from uwb_mitigation.types.measurement import Cir, Status
from uwb_mitigation.types.ros.poses import tag_frame
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.viewer import histories
from uwb_mitigation.viewer.histories import HISTORY_S, MAX_RANGE_M, BoundedDict, History, Pair, Pose, Sample
from uwb_mitigation.viewer.incidents import Incidents
from uwb_mitigation.viewer.palette import TrackKind

# Limits. Ids and texts come from the air or the network; above a limit, the oldest entries are removed.
MAX_PAIRS, MAX_TAGS, MAX_NODES = 256, 64, 64
MAX_TRACK = 3000  # points
MAX_DROPPING_S = 10.0
"""A pair without ranges is silent after this time also if the viewer drops ranges all the time."""
MAX_OUTAGES = 1000  # of the reading of ranges
MAX_TEXT = 400  # characters of a name or a message
MAX_COORDINATE_M = 2e7  # any position on Earth; a position further away is ignored

MAX_MOVED_M = 0.2
"""A range has no residual if the tag moves further between the range and its latest position."""
STALE_S, STALE = 5.0, 3
"""A node has this diagnostic level if its last diagnostics are older, as in rqt_robot_monitor."""
ERROR_EDGES_M = np.linspace(-1.0, 2.0, 61)
"""Bins of the error histogram; larger errors count in the outermost bins."""
STEP_M, STEP_S = 0.02, 0.09
"""Distance and time between points of a live track: closer points are skipped, unless a point is 0.5 s old."""
HEIGHT_VARIANCE_M2 = 0.01
"""Of the published height, for the positions from raw ranges."""

_NEVER = math.nan, math.nan
DEFAULT_TAG = "tag"
"""Name of the tag whose topics have the plain names; the others are named as `tag_frame` does."""


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """The latest diagnostics of one node: level 0 OK, 1 WARN, 2 ERROR, 3 STALE.

    Attributes:
        received_s: time of reception on the scene's clock; NaN: the report never becomes stale.
        determinations: how well the positions of its tags are determined, if they are not unique.
    """

    level: int
    message: str
    received_s: float = math.nan
    determinations: tuple[str, ...] = ()

    def aged(self, now_s: float) -> NodeStatus:
        """Return the report at a time: STALE with the age if the node has stopped reporting."""
        age_s = now_s - self.received_s
        if not age_s > STALE_S:
            return self
        message = f"no diagnostics for {age_s:.0f} s; last: {self.message}"
        return replace(self, level=STALE, message=message, determinations=())


Displaced = dict[int, tuple[float, Anchor]]
"""{anchor whose ranges fit another position: (its median held-out residual, m, the anchor there)}."""


class Scene:
    """All data that the page shows.

    Attributes:
        lock: held while it is changed or drawn.
        clock: returns the time for ages, s: a steady clock live, the recording's time in a replay. Stamps are not
            compared with it, because they may come from another computer.
        stamp_clock: returns the time on the clock of the stamps, s, if it is that of this computer.
        ranges, corrected, faults, uncertain: number of ranges, of those that were corrected, of those with a status that needs
            attention, and of those that were corrected but are UNRELIABLE.
        incidents: on the clock of the scene.
        received_s: time of the last range on the scene's clock.
        is_whole: it keeps all data of a recording; otherwise the last minute of ranges, and as many positions as a page shows.
        dropped: number of ranges that the viewer could not read in time.
        pairs: {(anchor, tag): history of its last minute}, the latest at the end.
        tags, anchors, node_statuses: {id or name: ...}.
        tracks: {(name, kind): positions}.
        lever_arms: {tag id as text: position of its antenna in the frame of its poses, m}; only those that are not 0.
        reports: (time of reception, name, diagnostics) of a recording.
        latest_stamps: {tag: (its latest stamp, time of its reception)}.
        revision: increases with every change, so that a page draws only changes.
        missing: why there are no ranges, anchors or positions.
        is_read, is_complete: whether a recording has been read, and tracks, residuals and all incidents have been added.
        cirs_ns: {pair: log time of each raw range with a CIR}, of a recording.
        notices: messages for the page.
        estimates: {tag: its estimated tracks}, if a recording contains no positions.
        displaced: the anchor whose ranges fit another position.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, is_whole: bool = False) -> None:
        self.lock, self.clock, self.stamp_clock, self.is_whole = Lock(), clock, time.time, is_whole
        self.anchors: dict[int, Anchor] = {}
        self.missing = {"ranges": "No ranges received.", "anchors": "No anchor positions."}
        self.received_s, self.revision = math.nan, 0
        self.is_read = self.is_complete = True
        self.cirs_ns: dict[Pair, list[int]] = {}
        self.notices: list[str] = []
        self.estimates: dict[str, TagTracks] = {}
        self.displaced: Displaced = {}
        self.clear()

    def clear(self) -> None:
        """Remove everything except the anchors."""
        self.incidents = Incidents()
        # Stamps of different tags may come from different clocks.
        self.latest_stamps: BoundedDict[int | None, tuple[float, float]] = BoundedDict(MAX_PAIRS)
        self._outages: BoundedDict[int | None, histories.Outages] = BoundedDict(MAX_PAIRS)
        self.ranges = self.corrected = self.faults = self.uncertain = self.dropped = 0
        self.pairs: BoundedDict[Pair, History] = BoundedDict(math.inf if self.is_whole else MAX_PAIRS)
        self.tags: BoundedDict[str, Pose] = BoundedDict(MAX_TAGS)
        self.lever_arms: BoundedDict[str, histories.LeverArm] = BoundedDict(MAX_TAGS)
        # {tag: (filter of its raw ranges, stamp of the last pose whose height it got)}
        self._raw_locators: BoundedDict[int, tuple[TagEstimator, float]] = BoundedDict(MAX_TAGS)
        self.tracks: BoundedDict[tuple[str, TrackKind], histories.Trail] = BoundedDict(4 * MAX_TAGS)
        self.reports: list[tuple[float, str, NodeStatus]] = []
        self.node_statuses: BoundedDict[str, NodeStatus] = BoundedDict(MAX_NODES)
        self.error_counts = np.zeros((2, len(ERROR_EDGES_M) - 1), np.int64)
        self.error_sums_m, self.errors = np.zeros(2), 0
        self.revision += 1

    @property
    def track_name(self) -> str:
        """The name of the tracks of `TrackKind.CORRECTED` in legends."""
        return "not corrected" if self.ranges and not self.corrected else TrackKind.CORRECTED.value

    def now_s(self, tag_id: int | None) -> float:
        """Return the latest stamp of a tag plus the time since then; NaN before any."""
        latest_s, received_s = self.latest_stamps.get(tag_id, _NEVER)
        return latest_s + max(self.clock() - received_s, 0.0)

    def latest_stamp_s(self, tag_id: int | None) -> float:
        """Return the latest stamp of a tag; NaN: none."""
        return self.latest_stamps.get(tag_id, _NEVER)[0]

    def stamp_age_s(self, pair: Pair) -> float:
        """Return the time from the last range of a pair to that of its tag by their stamps: 0 without other ranges.

        It does not depend on how fast the viewer reads them.
        """
        return max(0.0, self.latest_stamp_s(pair[1]) - self.pairs[pair].latest_stamp_s)

    def age_s(self, last: Sample | Pose) -> float:
        """Return the time since the last data of a pair, tag or track."""
        return max(self.clock() - float(last.received_s), 0.0)

    def no_data(self, history: History) -> str:
        """Return "no data for 12 s" for a pair that has stopped, else an empty string."""
        age_s = self.age_s(history.last)
        dropping_s = min(history.outage_s(age_s), MAX_DROPPING_S)
        return "" if age_s - dropping_s <= history.max_gap_s else f"no data for {age_s:.0f} s"

    def history(self, pair: Pair) -> History:
        """Return the history of a pair, a new one for a new pair."""
        self.revision += 1
        return self.pairs.touch(pair, lambda: History(outages=self._outages_of(pair[1])))

    def _outages_of(self, tag_id: int | None) -> histories.Outages:
        return self._outages.touch(tag_id, histories.Outages)

    def add_sample(self, pair: Pair, sample: Sample) -> None:
        """Add a corrected range.

        If the time of a pair jumps back by more than a second (a replay in a loop), the strips of its tag start again.
        """
        tag_id, stamp_s = pair[1], sample.stamp_s
        tag_latest_s, history = self.latest_stamp_s(tag_id), self.history(pair)
        if stamp_s < tag_latest_s - HISTORY_S or stamp_s < history.latest_stamp_s - 1.0:
            tag_latest_s = math.nan
            if not self.is_whole:
                self.clear_history(tag_id)
        if not stamp_s < tag_latest_s:
            tag_latest_s = self.latest_stamps.add(tag_id, (stamp_s, self.clock()))[0]
            end_s = self._outages_of(tag_id).rows[-1:, 1]
            end_s[:] = np.minimum(end_s, stamp_s)
        self.ranges += 1
        self.corrected += sample.status.is_corrected
        self.faults += sample.status.is_fault
        self.uncertain += sample.status is Status.UNRELIABLE
        self.incidents.add_range(pair, self.clock(), stamp_s)
        self.received_s = self.clock()
        history = self.pairs[pair]
        if self.is_whole:
            history.add(sample, math.nan, self.received_s)
        else:
            residual_m = self._compare_with_position(pair, sample)
            history.add(sample, residual_m, self.received_s, histories.MAX_SAMPLES)
            history.remove_before(tag_latest_s - HISTORY_S)
        if not math.isnan(sample.true_m):
            self.count_errors(np.array([[sample.raw_m], [sample.corrected_m]]) - sample.true_m)

    def count_errors(self, errors_m: NDArray[np.float64]) -> None:
        """Count raw and corrected errors, float64 (2, n), in the histograms; NaN: the truth is unknown."""
        errors_m = errors_m[:, (np.abs(errors_m) <= MAX_RANGE_M).all(axis=0)]
        bins = len(ERROR_EDGES_M) - 1
        rows = np.clip(np.searchsorted(ERROR_EDGES_M, errors_m, side="right") - 1, 0, bins - 1)
        self.error_counts += [np.bincount(row, minlength=bins) for row in rows]
        self.error_sums_m += np.abs(errors_m).sum(axis=1)
        self.errors += errors_m.shape[1]

    def set_truth(self, pair: Pair, stamp_s: float, sequence: int, true_m: float) -> None:
        """Set the truth of a range of a stream that was added without it."""
        self.revision += 1
        columns = (self.pairs.get(pair) or History()).columns
        is_known = (columns.stamp_s == stamp_s) & (columns.sequence == sequence)
        for row in np.flatnonzero(is_known)[-1:]:
            columns.true_m[row] = true_m
            self.count_errors(np.array([columns.raw_m[[row]], columns.corrected_m[[row]]]) - true_m)

    def set_cir(self, pair: Pair, cir: Cir) -> None:
        """Set the last CIR of a pair; those of a recording stay in the bag."""
        if not self.is_whole:
            self.history(pair).cir = cir

    def add_pose(self, tag: str, pose: Pose, kind: TrackKind = TrackKind.CORRECTED) -> None:
        """Append a pose to a track; a corrected one is the latest pose of its tag."""
        self.revision += 1
        name = tag[:MAX_TEXT]
        if not _is_plausible(pose.x, pose.y, pose.z):
            return
        pose = pose._replace(received_s=self.clock())
        if kind is TrackKind.CORRECTED:
            before = self.tags.get(name, pose)
            passed_s, moved_m = pose.stamp_s - before.stamp_s, math.dist(pose[:2], before[:2])
            pose = pose._replace(speed=moved_m / passed_s if passed_s > 0.0 else before.speed)
            self.tags.add(name, pose)
            self.incidents.add_position(tag_label(name, None), pose.received_s, pose.x, pose.y)
        if not math.isfinite(pose.stamp_s):
            return
        track = self.tracks.touch((name, kind), histories.Trail)
        step_s, step_m = pose.stamp_s - track.last.stamp_s, math.dist(track.last[:2], pose[:2])
        if self.is_whole:
            track.append(pose)
        elif step_s < -1.0:
            self.set_track(name, kind, [pose])
        elif not (step_s < STEP_S or (step_m < STEP_M and step_s < 5 * STEP_S)):
            track.append(pose, MAX_TRACK)

    def set_track(self, tag: str, kind: TrackKind, poses: NDArray[np.float64] | Sequence[Pose]) -> None:
        """Replace a track by poses or their rows, float64 (k, 11)."""
        self.tracks.add((tag[:MAX_TEXT], kind), histories.Trail(np.reshape(poses, (-1, len(Pose._fields)))))
        self.revision += 1

    def show(self, recorded: Scene, now_s: float) -> None:
        """Show the minute before a time of a recording, and its tracks until then; only the recording has counts."""
        self.clear()
        minutes = {pair: history.until(now_s, now_s - HISTORY_S) for pair, history in recorded.pairs.items()}
        begun = [(pair, history) for pair, history in minutes.items() if len(history.rows)]
        for pair, history in sorted(begun, key=lambda item: item[1].last.received_s):
            self.pairs.add(pair, history)
            self.received_s = history.last.received_s
            self.latest_stamps.add(pair[1], (history.last.stamp_s, self.received_s))
        for (name, kind), track in recorded.tracks.items():
            trail = track.until(now_s)
            if len(trail.rows):
                self.set_track(name, kind, trail.rows)
            if len(trail.rows) and kind is TrackKind.CORRECTED:
                self.tags.add(name, trail.last)
        begin, end = (bisect_right(recorded.reports, (at_s,)) for at_s in (now_s - HISTORY_S, now_s + 1e-6))
        for _, name, report in recorded.reports[begin:end]:
            self.set_node_status(name, report)

    def _compare_with_position(self, pair: Pair, sample: Sample) -> float:
        """Estimate a position from raw ranges; return the residual of a range, NaN without a recent position of its tag."""
        anchor, pose = self.anchors.get(pair[0]), self.tag_of(pair[1])
        if pose is None or anchor is None or self.age_s(pose) > NO_DATA_S:
            return math.nan
        if (arm := self.lever_arms.get(format_id(pair[1]))) is not None:
            pose = pose.antenna(arm)
        self._locate_raw(pair, pose, sample)
        # On a busy computer, positions arrive late.
        if abs(pose.stamp_s - sample.stamp_s) * pose.speed > MAX_MOVED_M:
            return math.nan
        x, y, z = anchor.position
        tag, anchor_place = (pose.x, pose.y, finite_or_zero(pose.z - z)), (x, y, 0.0)
        self.pairs[pair].directions.add(sample.received_s, sample.corrected_m, tag, anchor_place)
        return float(sample.corrected_m) - math.dist(tag, anchor_place)

    def _locate_raw(self, pair: Pair, pose: Pose, sample: Sample) -> None:
        """Filter the raw ranges of a tag as the locator filters the corrected ones, at the height of the locator."""
        if not (0.0 <= sample.raw_m < MAX_RANGE_M and math.isfinite(sample.stamp_s)):
            return
        if pair[1] not in self._raw_locators:
            self._raw_locators.add(pair[1], (TagEstimator(EstimatorConfig(self._anchor_map)), math.nan))
        estimator, height_s = self._raw_locators[pair[1]]
        if pose.stamp_s != height_s and math.isfinite(pose.z):
            self._raw_locators[pair[1]] = estimator, pose.stamp_s
            estimator.add(TagHeight(pose.z, HEIGHT_VARIANCE_M2))
        row = self._anchor_map.index[pair[0]]
        estimate = estimator.add(TagRange(round(sample.stamp_s * NS_PER_S), row, sample.raw_m))
        if estimate is not None:
            name = tag_frame(pair[1])
            name = name if name in self.tags else DEFAULT_TAG
            x, y, z = estimate.position.tolist()
            self.add_pose(name, Pose(x, y, z, stamp_s=sample.stamp_s), TrackKind.RAW)

    def set_anchors(self, anchors: Iterable[Anchor]) -> None:
        """Set the anchors on Earth; the height of an anchor may be NaN."""
        plausible = (anchor for anchor in anchors if _is_plausible(*anchor.position))
        before, self.anchors = self.anchors, {anchor.id: anchor for anchor in islice(plausible, MAX_ANCHORS)}
        self.revision += 1
        if self.anchors and self.anchors != before:
            places = [
                replace(anchor, position=(*anchor.position[:2], finite_or_zero(anchor.position[2])))
                for anchor in self.anchors.values()
            ]
            self._anchor_map = AnchorMap(places)
            self._raw_locators.clear()
            for _, history, _ in self.latest():
                history.directions = ResidualDirections()

    def set_node_status(self, name: str, report: NodeStatus) -> None:
        report = replace(report, message=report.message[:MAX_TEXT])
        self.node_statuses.add(name[:MAX_TEXT], report)
        if self.is_whole:
            self.reports.append((self.clock(), name, report))
        self.revision += 1

    def count_dropped(self, number: int) -> None:
        """Count ranges that the viewer itself has dropped; they do not count as lost."""
        self.dropped += number
        for tag_id, (stamp_s, _) in self.latest_stamps.items():
            outages = self._outages_of(tag_id)
            if not np.isinf(outages.rows[-1:, 1]).any():
                outages.append((stamp_s, math.inf), MAX_OUTAGES)

    def clear_history(self, tag_id: int) -> None:
        """Remove the last minute of the pairs of a tag, but not the counts."""
        self.latest_stamps.pop(tag_id, None)
        self._outages.pop(tag_id, None)
        outages = self._outages_of(tag_id)
        self.pairs.update({pair: History(outages=outages) for pair in self.pairs if pair[1] == tag_id})

    def latest(self) -> Iterator[tuple[Pair, History, Sample]]:
        """Yield every pair with its last range, by anchor and tag; also pairs that have stopped."""
        for pair, history in sorted(self.pairs.items()):
            if len(history.rows):
                yield pair, history, history.last._replace(status=Status(int(history.last.status)))

    def tag_of(self, tag_id: int) -> Pose | None:
        """Return the position of the tag of a range; None: it has none."""
        return self.tags.get(tag_name(tag_id, self.tags, self.pairs))


def plain_tag_id(names: Container[str], pairs: Iterable[Pair]) -> int | None:
    """Return the id of the tag whose positions have the plain name: the only one of `pairs` without positions of its name."""
    nameless = {tag_id for _, tag_id in pairs if tag_frame(tag_id) not in names}
    return nameless.pop() if DEFAULT_TAG in names and len(nameless) == 1 else None


def tag_name(tag_id: int, names: Container[str], pairs: Iterable[Pair]) -> str:
    """Return the name of the positions of a tag; empty: it has none."""
    if (name := tag_frame(tag_id)) in names:
        return name
    return DEFAULT_TAG if plain_tag_id(names, pairs) == tag_id else ""


def tag_label(name: str, plain_id: int | None) -> str:
    """Return the name of positions as the page shows it, such as "tag 7"; see `plain_tag_id`."""
    if name == DEFAULT_TAG and plain_id is not None:
        return f"tag {format_id(plain_id)}"
    return name.replace("_", " ")


def finite_or_zero(value: float) -> float:
    """Return 0 for NaN and infinity."""
    return value if math.isfinite(value) else 0.0


def _is_plausible(x: float, y: float, z: float) -> bool:
    """Return whether coordinates are on Earth; z may be NaN."""
    return abs(x) <= MAX_COORDINATE_M and abs(y) <= MAX_COORDINATE_M and not abs(z) > MAX_COORDINATE_M
