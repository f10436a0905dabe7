"""The large figures of the page: position errors and range errors, each for a named interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import TruePath
from uwb_mitigation.viewer.palette import TrackKind
from uwb_mitigation.viewer.scene import DEFAULT_TAG, HISTORY_S, Pair, Scene, tag_label, tag_name
from uwb_mitigation.viewer.timeline import Timeline

NOW_S = 3.0
"""Maximum age of a current value."""

WHOLE, RECENT, LIVE = "whole recording", f"last {HISTORY_S:.0f} s", "since the start"
"""Names of the intervals."""

Card = list[str]
"""Title, value and explanation of a figure."""


def position_errors(
    track: NDArray[np.float64], truth: NDArray[np.float64], begin_s: float, end_s: float
) -> NDArray[np.float64]:
    """Return the horizontal errors of the positions of an interval whose true position is known, float64 (k,), m.

    Args:
        track: time (s), x, y, ..., float64 (n, 3 or more), in the order of time.
        truth: the same of the true positions.
        begin_s: begin of the interval.
        end_s: its end.
    """
    rows = track[slice(*np.searchsorted(track[:, 0], (begin_s, end_s), side="right"))]
    # True positions are interpolated: use those around the interval, too.
    truth = truth[slice(*np.searchsorted(truth[:, 0], (begin_s - NOW_S, end_s + NOW_S)))]
    path = TruePath(np.rint(truth[:, 0] * NS_PER_S).astype(np.int64), truth[:, 1:3])
    true = path.position_at(np.rint(rows[:, 0] * NS_PER_S).astype(np.int64))
    errors_m = np.hypot(rows[:, 1] - true[:, 0], rows[:, 2] - true[:, 1])
    return errors_m[np.isfinite(errors_m)]


def current_card(timeline: Timeline, tag_id: int | None, position_s: float) -> list[Card]:
    """Return the figure of a recording at a position of the player; empty before its index is complete."""
    if not timeline.is_complete:
        return []
    return _Positions(timeline.tracks, tag_id, timeline.losses).current_card(position_s)


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
        positions = _Positions(timeline.tracks, tag_id, timeline.losses)
        if second is not None and second.is_complete:
            positions.second = _Positions(second.tracks, tag_id, second.losses).track(TrackKind.CORRECTED)
        cards = positions.interval_cards(interval, window, raw_name)
    errors_m = dict(zip(("raw", ""), timeline.range_errors(*interval), strict=True))
    if second is not None:
        errors_m[TrackKind.SECOND.value] = second.range_errors(*interval)[1]
    bad = timeline.bad[slice(*np.searchsorted(timeline.log_s, interval, side="right"))]
    return cards + _range_cards(errors_m, int(bad.sum()), len(bad), window)


def live_cards(scene: Scene, tag_id: int | None) -> list[Card]:
    """Return the figures of live topics."""
    tracks = {key: view.columns() for key, view in scene.tracks.items() if len(view.points)}
    positions = _Positions(tracks, tag_id, scene.pairs)
    now_s = math.nan
    if view := scene.tracks.get((positions.name, TrackKind.CORRECTED)):
        now_s = view.points[-1][0] + scene.age_s(view)
    cards = positions.current_card(now_s)
    cards += positions.interval_cards((now_s - HISTORY_S, now_s), RECENT, "raw + locator")
    means_m = scene.error_sums_m[:, None] / (scene.errors or math.nan)
    return cards + _range_cards({"raw": means_m[0], "": means_m[1]}, scene.not_ok, scene.ranges, LIVE)


def _range_cards(
    errors_m: Mapping[str, NDArray[np.float64]], not_ok: int, count: int, window: str
) -> list[Card]:
    """Return the figures of ranges, from their errors {name: errors, or the mean absolute error}; "": the corrected ranges."""
    if not count:
        return []
    not_ok_card = [
        f"Ranges not OK, {window}",
        f"{100.0 * not_ok / count:.1f} %",
        f"{not_ok} of {count} corrected ranges",
    ]
    means_m = {name: _metres(np.abs(errors)) for name, errors in errors_m.items()}
    if (mean_m := means_m.pop("")) == "-":
        return [not_ok_card]
    references = "; ".join(f"{name}: {text}" for name, text in means_m.items())
    return [not_ok_card, [f"Mean absolute range error, {window}", mean_m, references]]


class _Positions:
    """The positions of one tag.

    Args:
        tracks: {(name, kind): time (s), x, y, z and standard deviation (m), float64 (n, 5)}.
        tag_id: the tag; None: the first one.
        pairs: all pairs with ranges.

    Attributes:
        name: name of its positions; empty: it has none.
        label: name of the tag for the page.
        second: its track in the second recording; None: none.
    """

    def __init__(
        self,
        tracks: Mapping[tuple[str, TrackKind], NDArray[np.float64]],
        tag_id: int | None,
        pairs: Iterable[Pair],
    ) -> None:
        self._tracks = tracks
        self._names = [name for name, kind in tracks if kind is TrackKind.CORRECTED]
        self.name = next(iter(self._names), "") if tag_id is None else tag_name(tag_id, self._names, pairs)
        self.label = tag_label(self.name or DEFAULT_TAG, tag_id)
        self.second: NDArray[np.float64] | None = None

    def track(self, kind: TrackKind) -> NDArray[np.float64] | None:
        """Return the track of a kind; a true track has the frame of the tag as name, or any name if there is only one tag."""
        if kind is not TrackKind.TRUE:
            return self._tracks.get((self.name, kind))
        true = {name: track for (name, track_kind), track in self._tracks.items() if track_kind is kind}
        is_single = len(true) == len(self._names) == 1
        return next(iter(true.values())) if is_single else true.get(self.label.replace(" ", "_"))

    def current_card(self, position_s: float) -> list[Card]:
        """Return the figure of the latest position."""
        track, truth = self.track(TrackKind.CORRECTED), self.track(TrackKind.TRUE)
        if track is None:
            return [["Position", "-", f"no positions of {self.label}"]] if self._names else []
        interval = position_s - NOW_S, position_s
        latest = track[slice(*np.searchsorted(track[:, 0], interval, side="right"))]
        place = f"{self.label}, horizontal"
        if not len(latest):
            place = f"no position of {self.label} in the last {NOW_S:.0f} s"
        if truth is None:
            return [["Reported standard deviation, now", _metres(latest[-1:, 4]), place]]
        return [["Position error, now", _metres(position_errors(track, truth, *interval)[-1:]), place]]

    def interval_cards(self, interval: tuple[float, float], window: str, raw_name: str) -> list[Card]:
        """Return the figures of the positions in an interval.

        Args:
            interval: its begin and end.
            window: its name.
            raw_name: name of the track of raw ranges.
        """
        track, truth = self.track(TrackKind.CORRECTED), self.track(TrackKind.TRUE)
        if track is None:
            return []
        if truth is None:
            sds_m = track[slice(*np.searchsorted(track[:, 0], interval, side="right")), 4]
            median_m = _metres(sds_m, np.median)
            return [[f"Reported standard deviation, {window}", median_m, "median; no true positions"]]
        references = {
            "": track,
            raw_name: self.track(TrackKind.RAW),
            TrackKind.SMOOTHED.value: self.track(TrackKind.SMOOTHED),
            TrackKind.SECOND.value: self.second,
        }
        errors_m = {
            name: position_errors(reference, truth, *interval)
            for name, reference in references.items()
            if reference is not None
        }
        return [
            [
                f"{title}, {window}",
                _metres(errors_m[""], statistic),
                "; ".join(f"{name}: {_metres(errors_m[name], statistic)}" for name in errors_m if name),
            ]
            for title, statistic in (("Position RMSE", _rms), ("95 % of position errors below", _p95))
        ]


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _p95(values: NDArray[np.float64]) -> float:
    return float(np.percentile(values, 95))


def _metres(values_m: NDArray[np.float64], statistic: Callable[[NDArray[np.float64]], Any] = np.mean) -> str:
    """Return a statistic of the finite values as text; "-" without any."""
    finite = values_m[np.isfinite(values_m)]
    return f"{statistic(finite):.3f} m" if len(finite) else "-"
