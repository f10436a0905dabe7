"""The large figures of the page: position errors and range errors, each for a named interval."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.track_errors import NO_ERRORS, TrackErrors, track_errors
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Track, TruePath
from uwb_mitigation.viewer.histories import HISTORY_S
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
    return positions.cards(-math.inf, WHOLE) + _range_cards(scene, WHOLE)


def _range_cards(scene: Scene, window: str) -> list[Card]:
    """Return the figures of ranges."""
    corrected, count, faults = scene.corrected, scene.ranges, scene.faults
    if not count:
        return []
    corrected_text = f"{100.0 * corrected / count:.1f} %" if corrected else "none"
    text = f"{corrected} of {count} ranges" + ("" if corrected or faults else ": no CIRs")
    text += f"; {faults} ranges not OK" if faults else ""
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
        self._tracks = {key: track.rows for key, track in all_data.tracks.items()} if is_ready else {}
        self._names = [name for name, kind in self._tracks if kind is TrackKind.CORRECTED]
        self._is_corrected = view.scene.corrected > 0
        self._name = next(iter(self._names), "")
        if tag_id is not None:
            self._name = tag_name(tag_id, self._names, view.all_data.pairs)
        self._frame = tag_label(self._name or DEFAULT_TAG, tag_id).replace(" ", "_")
        self._estimated = view.timeline.estimates.get(self._name) if is_ready else None

    def track(self, kind: TrackKind) -> NDArray[np.float64] | None:
        """Return the track of a kind; a true track has the frame of the tag as name, or any name if there is only one tag."""
        if kind is not TrackKind.TRUE:
            return self._tracks.get((self._name, kind))
        true = {name: track for (name, track_kind), track in self._tracks.items() if track_kind is kind}
        is_single = len(true) == len(self._names) == 1
        return next(iter(true.values())) if is_single else true.get(self._frame)

    def _compared(self, kind: TrackKind, begin_s: float) -> tuple[Track, TruePath] | None:
        """Return a track from a time on and the true path; None: one of them is unknown."""
        columns, true = self.track(kind), self.track(TrackKind.TRUE)
        if columns is None or true is None:
            return None
        rows = slice(int(np.searchsorted(columns[:, 0], begin_s, side="right")), None)
        if self._estimated is not None and len(self._estimated.recording.truth):
            # Exact stamps: the same figures as those of `track`.
            return getattr(self._estimated, ATTRIBUTES[kind]).take(rows), self._estimated.recording.truth
        # Messages that overtake each other; a longer step back is a replay in a loop.
        stamp_s = true[:, 5]
        if (np.maximum.accumulate(stamp_s) - stamp_s < 1.0).all():
            true = true[np.argsort(stamp_s, kind="stable")]
        path = _track(true)
        return _track(columns[rows]), TruePath(path.stamp_ns, path.position * (1.0, 1.0, 0.0))

    def errors(self, kind: TrackKind, begin_s: float) -> TrackErrors:
        """Return the errors of a track from a time on."""
        compared = self._compared(kind, begin_s)
        return NO_ERRORS if compared is None else track_errors(*compared)

    def error_columns(self, kind: TrackKind) -> NDArray[np.float64]:
        """Return time (s), horizontal error and two standard deviations (m) of each position, float64 (n, 3); NaN: unknown."""
        if (columns := self.track(kind)) is None:
            return np.zeros((0, 3))
        error_m = np.full(len(columns), np.nan)
        if (compared := self._compared(kind, -math.inf)) is not None:
            track, truth = compared
            error_m = np.linalg.norm((track.position - truth.position_at(track.stamp_ns))[:, :2], axis=1)
        return np.column_stack([columns[:, 0], error_m, 2.0 * columns[:, 4]])

    def cards(self, begin_s: float, window: str) -> list[Card]:
        """Return the figures of the positions from a time on; `window`: name of this interval."""
        track = self.track(TrackKind.CORRECTED)
        if track is None:
            return []
        if self.track(TrackKind.TRUE) is None:
            median_m = _metres(track[track[:, 0] > begin_s, 4], np.median)
            return [[f"Reported standard deviation, {window}", median_m, "median; no true positions"]]
        errors = {
            kind: self.errors(kind, begin_s)
            for kind in (TrackKind.RAW, TrackKind.SMOOTHED)
            if self.track(kind) is not None
        }
        corrected, shown = self.errors(TrackKind.CORRECTED, begin_s), []
        for title, name in (("Position RMSE", "rmse"), ("95 % of position errors below", "p95")):
            others = (
                f"{self._title(kind)}: {_metres(getattr(error, name))}" for kind, error in errors.items()
            )
            shown.append([f"{title}, {window}", _metres(getattr(corrected, name)), "; ".join(others)])
        raw_m = errors.get(TrackKind.RAW, NO_ERRORS).rmse
        # Without corrections, offsets make the difference.
        if self._is_corrected and corrected.rmse + raw_m > 0.0:
            percent = 100.0 * (corrected.rmse / raw_m - 1.0)
            change = f"{abs(percent):.0f} % {'more' if percent > 0.0 else 'less'} error"
            text = f"position RMSE {corrected.rmse:.3f} m; {self._title(TrackKind.RAW)}: {raw_m:.3f} m"
            shown.append([f"Correction, {window}", change if abs(percent) >= 0.5 else "no change", text])
        return shown

    def _title(self, kind: TrackKind) -> str:
        """Return the name of a track that is compared with the corrected one; recorded poses may have other settings."""
        if kind is not TrackKind.RAW:
            return str(kind.value)
        return "raw + default filter" if self._estimated is None else "raw + same filter"


def _track(columns: NDArray[np.float64]) -> Track:
    """Return rows of `Scene.tracks` as a track without covariances."""
    n = len(columns)
    stamp_ns = np.rint(columns[:, 5] * NS_PER_S).astype(np.int64)
    return Track(stamp_ns, columns[:, 1:4], np.zeros((n, 3)), np.full((n, 6, 6), np.nan))


def _metres(values_m: Any, statistic: Callable[[NDArray[np.float64]], Any] = np.mean) -> str:
    """Return a value, or a statistic of the finite values, as text; "-" without any."""
    finite = np.atleast_1d(values_m)
    finite = finite[np.isfinite(finite)]
    return f"{statistic(finite):.3f} m" if len(finite) else "-"
