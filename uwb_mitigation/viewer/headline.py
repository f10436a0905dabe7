"""The large figures of the page: position errors and range errors, each for a named interval."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import TruePath
from uwb_mitigation.viewer.histories import HISTORY_S, Pose
from uwb_mitigation.viewer.palette import ATTRIBUTES, TrackKind
from uwb_mitigation.viewer.scene import DEFAULT_TAG, Scene, tag_label, tag_name
from uwb_mitigation.viewer.state import View

WHOLE, RECENT, LIVE = "whole recording", f"last {HISTORY_S:.0f} s", "since the start"
"""Names of the intervals."""

Card = list[str]
"""Title, value and explanation of a figure."""


def cards(view: View, tag_id: int | None) -> list[Card]:
    """Return the figures of a tag (None: without ranges) and of all ranges."""
    positions, scene = Positions(view, tag_id), view.scene
    if view.player is None:
        return positions.cards(scene.clock() - HISTORY_S, RECENT) + _range_cards(scene, LIVE)
    if not view.timeline.is_read:
        return [["Reading the recording ...", "", ""]]
    return positions.cards(-math.inf, WHOLE) + _range_cards(view.timeline, WHOLE)


def _range_cards(scene: Scene, window: str) -> list[Card]:
    """Return the figures of ranges."""
    corrected, count, faults = scene.corrected, scene.ranges, scene.faults
    if not count:
        return []
    corrected_text = f"{100.0 * corrected / count:.1f} %" if corrected else "none"
    text = f"{corrected} of {count} ranges" + ("" if corrected or faults else ": no CIRs")
    # An UNRELIABLE range is corrected and needs attention.
    text += f"; {scene.uncertain} of these uncertain" if scene.uncertain else ""
    text += f"; {failed} not corrected (see their status)" if (failed := faults - scene.uncertain) else ""
    shown = [[f"Ranges corrected, {window}", corrected_text, text]]
    if not corrected and not faults:
        shown.insert(0, [f"Correction, {window}", "none", "the radio sends no CIRs"])
    if scene.errors:
        raw, mean = map(_metres, scene.error_sums_m / scene.errors)
        shown.append([f"Mean absolute range error, {window}", mean, f"raw: {raw}"])
    return shown


class Positions:
    """The positions of one tag, from topics, or of a recording with complete tracks.

    Args:
        view: what is shown.
        tag_id: the tag; None: the first one.
    """

    def __init__(self, view: View, tag_id: int | None) -> None:
        is_ready, all_data = view.timeline.is_complete, view.all_data
        self._tracks = {key: track.columns for key, track in all_data.tracks.items()} if is_ready else {}
        self._names = [name for name, kind in self._tracks if kind is TrackKind.CORRECTED]
        self._is_corrected = view.timeline.corrected > 0
        self._name = next(iter(self._names), "")
        if tag_id is not None:
            self._name = tag_name(tag_id, self._names, view.all_data.pairs)
        self._frame = tag_label(self._name or DEFAULT_TAG, tag_id).replace(" ", "_")
        self._estimated = view.timeline.estimates.get(self._name) if is_ready else None

    def track(self, kind: TrackKind) -> Pose | None:
        """Return the track of a kind; a true track has the frame of the tag as name, or any name if there is only one tag."""
        if kind is not TrackKind.TRUE:
            return self._tracks.get((self._name, kind))
        true = {name: track for (name, track_kind), track in self._tracks.items() if track_kind is kind}
        is_single = len(true) == len(self._names) == 1
        return next(iter(true.values())) if is_single else true.get(self._frame)

    def _truth(self) -> TruePath | None:
        """Return the true path; None: it is unknown."""
        if (true := self.track(TrackKind.TRUE)) is None:
            return None
        if self._estimated is not None and len(self._estimated.recording.truth):
            return self._estimated.recording.truth
        order = np.arange(len(true.x))
        # Messages that overtake each other; a longer step back is a replay in a loop.
        if (np.maximum.accumulate(true.stamp_s) - true.stamp_s < 1.0).all():
            order = np.argsort(true.stamp_s, kind="stable")
        return TruePath(_stamp_ns(true.stamp_s[order]), np.stack(true[:3], axis=1)[order])

    def errors(self, kind: TrackKind) -> NDArray[np.float64]:
        """Return time (s), horizontal error and two standard deviations (m) of each position, float64 (n, 3); NaN: unknown."""
        if (poses := self.track(kind)) is None:
            return np.zeros((0, 3))
        error_m = np.full(len(poses.x), np.nan)
        if (truth := self._truth()) is not None:
            stamp_ns = _stamp_ns(poses.stamp_s)
            if self._estimated is not None and truth is self._estimated.recording.truth:
                # Exact stamps: the same figures as those of `track`.
                stamp_ns = getattr(self._estimated, ATTRIBUTES[kind]).stamp_ns
            true = truth.position_at(stamp_ns)
            error_m = np.hypot(poses.x - true[:, 0], poses.y - true[:, 1])
        return np.column_stack([poses.received_s, error_m, 2.0 * poses.sd_m])

    def cards(self, begin_s: float, window: str) -> list[Card]:
        """Return the figures of the positions from a time on; `window`: name of this interval."""
        track = self.track(TrackKind.CORRECTED)
        if track is None:
            return []
        if self.track(TrackKind.TRUE) is None:
            median_m = _statistic(np.median, track.sd_m[track.received_s > begin_s])
            return [
                [f"Reported standard deviation, {window}", _metres(median_m), "median; no true positions"]
            ]
        kinds = [kind for kind in ATTRIBUTES if self.track(kind) is not None]
        tables, shown = {kind: self.errors(kind) for kind in kinds}, []
        errors_m = {kind: table[table[:, 0] > begin_s, 1] for kind, table in tables.items()}
        rmse, p95 = (
            {kind: _statistic(statistic, errors_m[kind]) for kind in kinds}
            for statistic in (lambda of_m: np.sqrt(np.mean(of_m**2)), partial(np.percentile, q=95))
        )
        for title, values in (("Position RMSE", rmse), ("95 % of position errors below", p95)):
            texts = {kind: _metres(value_m) for kind, value_m in values.items()}
            corrected = texts.pop(TrackKind.CORRECTED)
            others = "; ".join(f"{self._title(kind)}: {text}" for kind, text in texts.items())
            shown.append([f"{title}, {window}", corrected, others])
        corrected_m, raw_m = rmse[TrackKind.CORRECTED], rmse.get(TrackKind.RAW, math.nan)
        # Without corrections, offsets make the difference.
        if self._is_corrected and corrected_m + raw_m > 0.0:
            percent = 100.0 * (corrected_m / raw_m - 1.0)
            change = f"{abs(percent):.0f} % {'more' if percent > 0.0 else 'less'} error"
            text = f"position RMSE {corrected_m:.3f} m; {self._title(TrackKind.RAW)}: {raw_m:.3f} m"
            shown.append([f"Correction, {window}", change if abs(percent) >= 0.5 else "no change", text])
        return shown

    def _title(self, kind: TrackKind) -> str:
        """Return the name of a track that is compared with the corrected one; recorded poses may have other settings."""
        if kind is not TrackKind.RAW:
            return str(kind.value)
        return "raw + default filter" if self._estimated is None else "raw + same filter"


def _stamp_ns(stamp_s: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.rint(stamp_s * NS_PER_S).astype(np.int64)


def _statistic(statistic: Callable[[NDArray[np.float64]], Any], values: NDArray[np.float64]) -> float:
    """Return a statistic of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(statistic(finite)) if len(finite) else math.nan


def _metres(value_m: float) -> str:
    return f"{value_m:.3f} m" if math.isfinite(value_m) else "-"
