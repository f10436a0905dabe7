"""The large figures of the page: position errors and range errors, each for a named interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.positioning.track_errors import NO_ERRORS, TrackErrors, track_errors
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Track, TruePath
from uwb_mitigation.viewer.histories import HISTORY_S, Pair
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.scene import DEFAULT_TAG, Scene, tag_label, tag_name

if TYPE_CHECKING:
    # A live page reads no recordings.
    from uwb_mitigation.positioning.recorded_tracks import TagTracks
    from uwb_mitigation.viewer.timeline import Timeline

NOW_S = 3.0
"""Maximum age of a current value."""

WHOLE, RECENT, LIVE = "whole recording", f"last {HISTORY_S:.0f} s", "since the start"
"""Names of the intervals."""

_ATTRIBUTES = {TrackKind.RAW: "raw_live", TrackKind.CORRECTED: "live", TrackKind.SMOOTHED: "smoothed"}
"""Attributes of `TagTracks`."""

Card = list[str]
"""Title, value and explanation of a figure."""


def _track(columns: NDArray[np.float64]) -> Track:
    """Return time (s), x, y, z, ..., float64 (n, 4 or more), as a track without covariances."""
    n = len(columns)
    stamp_ns = np.rint(columns[:, 0] * NS_PER_S).astype(np.int64)
    return Track(stamp_ns, columns[:, 1:4], np.zeros((n, 3)), np.full((n, 6, 6), np.nan))


def interval_cards(
    timeline: Timeline, second: Timeline | None, tag_id: int | None, window: str, position_s: float
) -> list[Card]:
    """Return the figures of an interval of a recording.

    Args:
        timeline: index of the recording.
        second: index of the recording that is compared; None: none.
        tag_id: the selected tag; None: the recording has no ranges.
        window: `WHOLE` or `RECENT`.
        position_s: the current position.
    """
    interval = (-np.inf, np.inf) if window == WHOLE else (position_s - HISTORY_S, position_s)
    cards = []
    if timeline.is_complete:
        raw_name = "raw + same filter" if timeline.estimates else "raw + locator with default settings"
        positions = recorded_positions(timeline, tag_id)
        if second is not None and second.is_complete:
            positions.second = recorded_positions(second, tag_id)
        cards = positions.interval_cards(interval, window, raw_name)
    errors_m = dict(zip(("raw", ""), timeline.range_errors(*interval), strict=True))
    if second is not None:
        errors_m[TrackKind.SECOND.value] = second.range_errors(*interval)[1]
    rows = slice(*np.searchsorted(timeline.log_s, interval, side="right"))
    corrected, bad = timeline.is_corrected[rows], timeline.bad[rows]
    return cards + _range_cards(errors_m, int(corrected.sum()), int(bad.sum()), len(bad), window)


def live_cards(scene: Scene, tag_id: int | None) -> list[Card]:
    """Return the figures of live topics."""
    positions = live_positions(scene, tag_id)
    now_s = math.nan
    if view := scene.tracks.get((positions.name, TrackKind.CORRECTED)):
        now_s = view.points[-1][0] + scene.age_s(view)
    cards = positions.current_card(now_s)
    cards += positions.interval_cards((now_s - HISTORY_S, now_s), RECENT, "raw + locator")
    means_m = scene.error_sums_m[:, None] / (scene.errors or math.nan)
    return cards + _range_cards(
        {"raw": means_m[0], "": means_m[1]}, scene.corrected, scene.faults, scene.ranges, LIVE
    )


def live_positions(scene: Scene, tag_id: int | None) -> Positions:
    """Return the positions of a tag from topics."""
    tracks = {key: view.columns() for key, view in scene.tracks.items() if len(view.points)}
    return Positions(tracks, tag_id, scene.pairs)


def recorded_positions(timeline: Timeline, tag_id: int | None) -> Positions:
    """Return the positions of a tag in a recording whose index is complete."""
    return Positions(timeline.tracks, tag_id, timeline.losses, timeline.estimates)


def _range_cards(
    errors_m: Mapping[str, NDArray[np.float64]], corrected: int, faults: int, count: int, window: str
) -> list[Card]:
    """Return the figures of ranges, from their errors {name: errors, or the mean absolute error}; "": the corrected ranges."""
    if not count:
        return []
    reason = "" if corrected or faults else ": no CIRs"
    not_ok_card = [
        f"Ranges corrected, {window}",
        f"{100.0 * corrected / count:.1f} %" if corrected else "none",
        f"{corrected} of {count} ranges corrected{reason}" + (f"; {faults} need attention" if faults else ""),
    ]
    means_m = {name: _metres(np.abs(errors)) for name, errors in errors_m.items()}
    if (mean_m := means_m.pop("")) == "-":
        return [not_ok_card]
    references = "; ".join(f"{name}: {text}" for name, text in means_m.items())
    return [not_ok_card, [f"Mean absolute range error, {window}", mean_m, references]]


class Positions:
    """The positions of one tag.

    Args:
        tracks: {(name, kind): time (s), x, y, z and standard deviation (m), float64 (n, 5)}.
        tag_id: the tag; None: the first one.
        pairs: all pairs with ranges.
        estimates: {name: tracks that the viewer itself has estimated}.

    Attributes:
        name: name of its positions; empty: it has none.
        label: name of the tag for the page.
        second: its positions in the second recording; None: none.
    """

    def __init__(
        self,
        tracks: Mapping[tuple[str, TrackKind], NDArray[np.float64]],
        tag_id: int | None,
        pairs: Iterable[Pair],
        estimates: Mapping[str, TagTracks] = {},
    ) -> None:
        self._tracks = tracks
        self._names = [name for name, kind in tracks if kind is TrackKind.CORRECTED]
        self.name = next(iter(self._names), "") if tag_id is None else tag_name(tag_id, self._names, pairs)
        self.label = tag_label(self.name or DEFAULT_TAG, tag_id)
        self.second: Positions | None = None
        self._estimated = estimates.get(self.name)

    def track(self, kind: TrackKind) -> NDArray[np.float64] | None:
        """Return the track of a kind; a true track has the frame of the tag as name, or any name if there is only one tag."""
        if kind is not TrackKind.TRUE:
            return self._tracks.get((self.name, kind))
        true = {name: track for (name, track_kind), track in self._tracks.items() if track_kind is kind}
        is_single = len(true) == len(self._names) == 1
        return next(iter(true.values())) if is_single else true.get(self.label.replace(" ", "_"))

    def _compared(self, kind: TrackKind, rows: slice) -> tuple[Track, TruePath] | None:
        """Return a part of a track and the true path; None: one of them is unknown."""
        columns, true = self.track(kind), self.track(TrackKind.TRUE)
        if columns is None or true is None:
            return None
        if self._estimated is not None and len(self._estimated.recording.truth):
            # Exact stamps: the same figures as those of `track`.
            return getattr(self._estimated, _ATTRIBUTES[kind]).take(rows), self._estimated.recording.truth
        path = _track(true)
        return _track(columns[rows]), TruePath(path.stamp_ns, path.position * (1.0, 1.0, 0.0))

    def errors(self, kind: TrackKind, interval: tuple[float, float]) -> TrackErrors:
        """Return the errors of a track in an interval."""
        if (columns := self.track(kind)) is None:
            return NO_ERRORS
        compared = self._compared(kind, slice(*np.searchsorted(columns[:, 0], interval, side="right")))
        return NO_ERRORS if compared is None else track_errors(*compared)

    def error_columns(
        self, kind: TrackKind, interval: tuple[float, float] = (-math.inf, math.inf)
    ) -> NDArray[np.float64]:
        """Return time (s), horizontal error and two standard deviations (m) of each position, float64 (n, 3); NaN: unknown."""
        if (columns := self.track(kind)) is None:
            return np.zeros((0, 3))
        rows = slice(*np.searchsorted(columns[:, 0], interval, side="right"))
        error_m = np.full(len(columns[rows]), np.nan)
        if (compared := self._compared(kind, rows)) is not None:
            track, truth = compared
            error_m = np.linalg.norm((track.position - truth.position_at(track.stamp_ns))[:, :2], axis=1)
        return np.column_stack([columns[rows, 0], error_m, 2.0 * columns[rows, 4]])

    def current_card(self, position_s: float) -> list[Card]:
        """Return the figure of the latest position."""
        if self.track(TrackKind.CORRECTED) is None:
            return [["Position", "-", f"no positions of {self.label}"]] if self._names else []
        latest = self.error_columns(TrackKind.CORRECTED, (position_s - NOW_S, position_s))[-1:]
        place = (
            f"{self.label}, horizontal"
            if len(latest)
            else f"no position of {self.label} in the last {NOW_S:.0f} s"
        )
        if self.track(TrackKind.TRUE) is None:
            return [["Reported standard deviation, now", _metres(latest[:, 2] / 2.0), place]]
        return [["Position error, now", _metres(latest[:, 1]), place]]

    def interval_cards(self, interval: tuple[float, float], window: str, raw_name: str) -> list[Card]:
        """Return the figures of the positions in an interval.

        Args:
            interval: its begin and end.
            window: its name.
            raw_name: name of the track of raw ranges.
        """
        track = self.track(TrackKind.CORRECTED)
        if track is None:
            return []
        if self.track(TrackKind.TRUE) is None:
            sds_m = track[slice(*np.searchsorted(track[:, 0], interval, side="right")), 4]
            median_m = _metres(sds_m, np.median)
            return [[f"Reported standard deviation, {window}", median_m, "median; no true positions"]]
        names = {TrackKind.RAW: raw_name, TrackKind.SMOOTHED: TrackKind.SMOOTHED.value}
        errors = {
            name: self.errors(kind, interval) for kind, name in names.items() if self.track(kind) is not None
        }
        if self.second is not None:
            errors[TrackKind.SECOND.value] = self.second.errors(TrackKind.CORRECTED, interval)
        own = self.errors(TrackKind.CORRECTED, interval)
        change = _change(own.rmse, errors[raw_name].rmse, raw_name) if raw_name in errors else None
        cards = [
            [
                f"{title}, {window}",
                _metres(getattr(own, name)),
                "; ".join(
                    f"{reference}: {_metres(getattr(error, name))}" for reference, error in errors.items()
                ),
            ]
            for title, name in (("Position RMSE", "rmse"), ("95 % of position errors below", "p95"))
        ]
        return cards if change is None else [*cards, [f"Correction, {window}", *change]]


def _change(corrected_m: float, raw_m: float, raw_name: str) -> tuple[str, str] | None:
    """Return what the correction changes, as texts; None: unknown."""
    if not corrected_m + raw_m > 0.0:
        return None
    change_percent = 100.0 * (corrected_m / raw_m - 1.0)
    text = "no change" if abs(change_percent) < 0.5 else f"{change_percent:+.0f} %"
    return text, f"position RMSE {corrected_m:.3f} m; {raw_name}: {raw_m:.3f} m"


def _metres(values_m: Any, statistic: Callable[[NDArray[np.float64]], Any] = np.mean) -> str:
    """Return a value, or a statistic of the finite values, as text; "-" without any."""
    finite = np.atleast_1d(values_m)
    finite = finite[np.isfinite(finite)]
    return f"{statistic(finite):.3f} m" if len(finite) else "-"
