"""The large figures of the page: position errors and range errors, each for a named interval."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.types.palette import TrackKind
from uwb_mitigation.types.ros.poses import tag_frame
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import TruePath
from uwb_mitigation.viewer.scene import HISTORY_S, Scene
from uwb_mitigation.viewer.timeline import Timeline

NOW_S = 3.0
"""Maximum age of a current value."""

WHOLE, RECENT, LIVE = "whole recording", f"last {HISTORY_S:.0f} s", "since the start"
"""Names of the intervals."""

Card = list[str]
"""Title, value and explanation of a figure."""

_Tracks = Mapping[tuple[str, TrackKind], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class PositionErrors:
    """Horizontal errors of a track, m; NaN: unknown."""

    now_m: float
    rmse_m: float
    p95_m: float


def position_errors(
    track: NDArray[np.float64], truth: NDArray[np.float64], begin_s: float, end_s: float
) -> PositionErrors | None:
    """Return the errors of a track in an interval; None if no true position is known there.

    Args:
        track: time (s), x, y, ..., float64 (n, 3 or more).
        truth: the same of the true positions.
        begin_s: begin of the interval.
        end_s: its end; the current error is the last one before it.
    """
    rows = track[(track[:, 0] >= begin_s) & (track[:, 0] <= end_s)]
    truth = truth[np.argsort(truth[:, 0], kind="stable")]
    path = TruePath(np.rint(truth[:, 0] * NS_PER_S).astype(np.int64), truth[:, 1:3])
    error_m = np.hypot(*(rows[:, 1:3] - path.position_at(np.rint(rows[:, 0] * NS_PER_S).astype(np.int64))).T)
    is_known = np.isfinite(error_m)
    if not is_known.any():
        return None
    time_s, error_m = rows[is_known, 0], error_m[is_known]
    now_m = float(error_m[-1]) if time_s[-1] >= end_s - NOW_S else np.nan
    return PositionErrors(now_m, float(np.sqrt(np.mean(error_m**2))), float(np.percentile(error_m, 95)))


def recorded_cards(
    timeline: Timeline, second: Timeline | None, tag_id: int | None, window: str, position_s: float
) -> list[Card]:
    """Return the figures of a recording.

    Args:
        timeline: index of the recording.
        second: index of the recording that is compared; None: none.
        tag_id: the selected tag.
        window: `WHOLE` or `RECENT`.
        position_s: the current position.
    """
    interval = (-np.inf, np.inf) if window == WHOLE else (position_s - HISTORY_S, position_s)
    cards = []
    if timeline.is_complete:
        name = _track_name(timeline.tracks, tag_id)
        tracks = dict(timeline.tracks)
        if second is not None and second.is_complete:
            corrected = _track(second.tracks, _track_name(second.tracks, tag_id), TrackKind.CORRECTED)
            tracks |= {} if corrected is None else {(name, TrackKind.SECOND): corrected}
        raw = "raw + same filter" if timeline.estimates else "raw + locator with default settings"
        cards = _position_cards(partial(_track, tracks, name), interval, position_s, window, raw)
    rows = slice(*np.searchsorted(timeline.log_s, interval, side="right"))
    errors_m = {"raw": timeline.range_errors(*interval)[0], "": timeline.range_errors(*interval)[1]}
    if second is not None:
        errors_m[TrackKind.SECOND.value] = second.range_errors(*interval)[1]
    means_m = {label: float(np.abs(errors).mean()) for label, errors in errors_m.items() if len(errors)}
    return cards + _range_cards(means_m, int(timeline.bad[rows].sum()), len(timeline.bad[rows]), window)


def live_cards(scene: Scene, tag_id: int | None) -> list[Card]:
    """Return the figures of live topics."""
    tracks = {key: view.columns() for key, view in scene.tracks.items() if len(view.points)}
    name, cards = _track_name(tracks, tag_id), list[Card]()
    if (view := scene.tracks.get((name, TrackKind.CORRECTED))) and len(view.points):
        now_s = float(view.points[-1][0]) + scene.age_s(view)
        interval = now_s - HISTORY_S, now_s
        cards = _position_cards(partial(_track, tracks, name), interval, now_s, RECENT, "raw + locator")
    raw_m, corrected_m = (scene.error_sums_m / max(scene.errors, 1)).tolist()
    return cards + _range_cards(
        {"raw": raw_m, "": corrected_m} if scene.errors else {}, scene.not_ok, scene.ranges, LIVE
    )


def _track_name(tracks: _Tracks, tag_id: int | None) -> str:
    """Return the name of the track of a tag, else of any tag; empty if there is none."""
    names = [name for name, kind in tracks if kind is TrackKind.CORRECTED]
    name = "" if tag_id is None else tag_frame(tag_id)
    return name if name in names else next(iter(names), "")


def _track(tracks: _Tracks, name: str, kind: TrackKind) -> NDArray[np.float64] | None:
    """Return the track of a tag; if only one track of this kind exists, its name may differ."""
    candidates = [track for (_, track_kind), track in tracks.items() if track_kind is kind]
    return tracks.get((name, kind), candidates[0] if len(candidates) == 1 else None)


def _range_cards(means_m: dict[str, float], not_ok: int, count: int, window: str) -> list[Card]:
    if not count:
        return []
    cards = [[f"Ranges not OK, {window}", f"{100.0 * not_ok / count:.1f} %", f"{not_ok} of {count}"]]
    if "" in means_m:
        references = [f"{label}: {_metres(mean_m)}" for label, mean_m in means_m.items() if label]
        cards.append([f"Mean absolute range error, {window}", _metres(means_m[""]), "; ".join(references)])
    return cards


def _position_cards(
    tracks: Callable[[TrackKind], NDArray[np.float64] | None],
    interval: tuple[float, float],
    position_s: float,
    window: str,
    raw_name: str,
) -> list[Card]:
    """Return the figures of the positions of one tag.

    Args:
        tracks: returns the track of a kind: time (s), x, y, z and standard deviation (m), float64 (n, 5).
        interval: begin and end of the window.
        position_s: the current time.
        window: name of the window.
        raw_name: name of the track of raw ranges.
    """
    track, truth = tracks(TrackKind.CORRECTED), tracks(TrackKind.TRUE)
    if track is None or not len(track):
        return []
    errors = None if truth is None else position_errors(track, truth, *interval)
    now = None if truth is None else position_errors(track, truth, position_s - NOW_S, position_s)
    if truth is None or errors is None:
        rows = track[(track[:, 0] >= interval[0]) & (track[:, 0] <= interval[1])]
        latest = track[(track[:, 0] <= position_s) & (track[:, 0] >= position_s - NOW_S)]
        now_sd = latest[-1, 4] if len(latest) else np.nan
        median_sd = np.nanmedian(rows[:, 4]) if np.isfinite(rows[:, 4]).any() else np.nan
        return [
            ["Reported standard deviation, now", _metres(now_sd), "horizontal; the true position is unknown"],
            [f"Reported standard deviation, {window}", _metres(median_sd), "median"],
        ]
    comparisons: list[tuple[str, PositionErrors]] = []
    for kind, name in (
        (TrackKind.RAW, raw_name),
        (TrackKind.SMOOTHED, "smoothed"),
        (TrackKind.SECOND, TrackKind.SECOND.value),
    ):
        reference = tracks(kind)
        if reference is not None and (compared := position_errors(reference, truth, *interval)):
            comparisons.append((name, compared))
    return [
        ["Position error, now", _metres(np.nan if now is None else now.now_m), "horizontal"],
        [f"Position RMSE, {window}", _metres(errors.rmse_m), _compare(comparisons, "rmse_m")],
        [f"95 % of position errors below, {window}", _metres(errors.p95_m), _compare(comparisons, "p95_m")],
    ]


def _compare(comparisons: list[tuple[str, PositionErrors]], name: str) -> str:
    return "; ".join(f"{label}: {_metres(getattr(errors, name))}" for label, errors in comparisons)


def _metres(value: float) -> str:
    return f"{value:.3f} m" if np.isfinite(value) else "-"
