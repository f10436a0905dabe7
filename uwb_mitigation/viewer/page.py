"""Draw a scene into the models of one page, and handle its commands."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from datetime import datetime, timezone
from itertools import groupby, pairwise
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
from bokeh.document import Document
from bokeh.events import Reset
from bokeh.models import ColumnDataSource
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.types.measurement import Status
from uwb_mitigation.viewer import health
from uwb_mitigation.viewer.floor_plan import MapImage
from uwb_mitigation.viewer.headline import LIVE, RECENT, WHOLE, Card, current_card, interval_cards, live_cards
from uwb_mitigation.viewer.models import COLUMNS, FADING, FIGURES, TRACE_AFTER, TRACE_BEFORE, Models
from uwb_mitigation.viewer.palette import STATUS_LOOKS, TrackKind
from uwb_mitigation.viewer.scene import (
    CELL_M,
    ERROR_EDGES_M,
    HISTORY_S,
    MAX_RANGE_M,
    NO_DATA_S,
    SPEEDS,
    WATERFALL,
    History,
    MissingData,
    Pair,
    Pose,
    Sample,
    Scene,
    Trace,
    count_errors,
    finite_or_zero,
    plain_tag_id,
    tag_label,
    with_gaps,
)

if TYPE_CHECKING:
    from uwb_mitigation.viewer.playback import BagPlayer

REFRESH_S = 0.1
FAST_PAGES = 3
"""Number of pages that are drawn every `REFRESH_S`; more pages are drawn less often."""

LEVELS = ("\u25cf OK", "\u25b2 WARN", "\u2716 ERROR", "\u25a0 STALE")
"""Texts of the diagnostic levels."""

TABLE_S = 0.5
"""Minimum interval of updates of the texts."""

MARGIN_M = 5.0
"""Margin around a tag on a map without anchors."""

HEARTBEAT_S = 1.0
"""Maximum interval of updates: a page without an update shows old data."""

TRAILS_S = (10.0, 60.0, math.inf)
"""Durations of the tracks that a page can show."""

MAX_POINTS = 400
"""Maximum number of displayed points of each third of a track, and of a strip."""

RANGE_SD_M = 0.1
"""Standard deviation for the map of the predicted accuracy if the ranges have none."""

_NO_CIRS = "No CIRs: the source sends none, or no raw ranges are received."

_TEMPLATES = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"))


@dataclass(slots=True)
class View:
    """State that all pages of a server share.

    Attributes:
        lock: held while the scene is changed or drawn.
        window: number of samples that the network reads.
        player: player of a recording; None: live.
        second: scene of the second recording; None: there is only one.
        plan: floor plan; None: unknown.
        missing: the reasons for an empty page.
        pages: number of open pages.
    """

    scene: Scene
    lock: Lock
    title: str = "UWB ranges"
    window: int = 157
    player: BagPlayer | None = None
    second: Scene | None = None
    plan: MapImage | None = None
    missing: MissingData = field(default_factory=MissingData)
    pages: int = 0


class Page:
    """One open page. It draws at most ten times a second, and only what has changed.

    Args:
        document: the session's document; the page is added to it.
        nonce: nonce of the page's scripts for the Content-Security-Policy.
    """

    def __init__(self, document: Document, view: View, nonce: str = "") -> None:
        self._view, self._player = view, view.player
        self._fitted = False, False, False
        self._selected: Pair | None = None
        self._window, self._trail_s = WHOLE if self._player else RECENT, 60.0
        self._sent, self._sent_s, self._took_s, self._redraw = 0, 0.0, 0.0, False
        self._due_s = self._table_due_s = 0.0
        self._drawn: dict[str, object] = {}
        self._paused = self._has_data = False
        self._interval_cards: list[Card] = []
        player, compares = view.player, view.second is not None
        self._models = models = Models(None if player is None else player.seconds, view.plan, compares)
        # Register before the model is added to the document: later registrations have no effect.
        models.figures["map"].on_event(Reset, self._on_reset)
        # Add all roots in one step: Bokeh searches for new models after each, half of the time to open a page.
        with document.models.freeze():
            for model in models.roots:
                document.add_root(model)
        document.title = view.title
        columns = {
            name: (title, LIVE if interval == WHOLE and player is None else interval, description)
            for name, (title, interval, description) in COLUMNS.items()
            if name != "second" or compares
        }
        document.template = _TEMPLATES.get_template("page.html.j2")
        document.template_variables.update(
            page_title=view.title,
            recording=player is not None,
            nonce=nonce,
            columns=columns,
            intervals=[
                (interval, len(list(names)))
                for interval, names in groupby(columns, key=lambda name: columns[name][1])
            ],
            states=health.STATES,
            figures={name: FIGURES[name] for name in FIGURES if name in models.figures},
            looks=STATUS_LOOKS,
            speeds=SPEEDS,
            trails={
                f"{seconds:g}": "all" if math.isinf(seconds) else f"{seconds:g} s" for seconds in TRAILS_S
            },
            windows=(WHOLE, RECENT),
        )
        document.config.update(reconnect_session=False, notify_connection_status=False, notifications=None)
        models.controls.on_change("command", self._on_command)
        models.controls.on_change("acknowledged", self._on_acknowledged)
        document.add_periodic_callback(self.tick, int(1000 * REFRESH_S))
        self.draw()
        # Register last: a session that could not be opened does not report its end.
        document.on_session_destroyed(self._on_closed)
        view.pages += 1

    @property
    def _is_waiting(self) -> bool:
        """Whether the page has not drawn the last update: another one would queue behind it and show old data."""
        return bool(self._sent != self._models.controls.acknowledged)

    def tick(self) -> None:
        """Draw if it is time, the page is not paused, and it has drawn the last update."""
        now_s = time.monotonic()
        if self._player is not None:
            self._player.advance()
        elif self._paused:
            return
        if now_s < self._due_s or self._is_waiting:
            return
        self.draw()
        self._due_s = now_s + REFRESH_S * (max(1.0, self._view.pages / FAST_PAGES) - 0.5)

    def draw(self) -> None:
        """Update every model from the scene, and number the update if anything has changed."""
        self._draw_player()
        player, scene = self._player, self._view.scene
        position = None if player is None else (player.position_s, player.is_behind, player.timeline is None)
        with self._view.lock:
            # Ages change without data; drawing them once a second is enough.
            state = scene.revision, self._selected, math.floor(scene.clock()), position
            is_changed = self._changed("scene", state)
            if is_changed:
                self._draw_scene(scene)
        now_s = time.monotonic()
        if is_changed or now_s > self._sent_s + HEARTBEAT_S:
            self._sent, self._sent_s, self._redraw = self._sent + 1, now_s, False
            age_s = scene.clock() - scene.received_s if self._has_data else -1.0
            self._models.controls.update = [self._sent, round(self._took_s, 3), round(age_s, 3)]

    def _draw_scene(self, scene: Scene) -> None:
        if self._selected is None:
            self._selected = next((pair for pair, _, _ in scene.latest()), None)
        self._set(selected=self._selected and [format_id(identity) for identity in self._selected])
        if (now_s := time.monotonic()) >= self._table_due_s:
            self._table_due_s = now_s + TABLE_S
            self._draw_tables(scene)
        else:
            self._drawn.pop("scene", None)
        self._draw_map(scene)
        history = None if self._selected is None else scene.pairs.get(self._selected)
        self._draw_strip(scene, history)
        self._draw_trace(scene, () if history is None else tuple(history.traces))
        self._draw_errors(scene)

    def select(self, pair: Pair | None) -> None:
        """Show the CIR and the ranges of a pair, which may have no ranges yet."""
        if pair is not None and all(0 <= identity < 1 << 64 for identity in pair):
            self._selected = pair

    # Drawing --------------------------------------------------------------------------------------------------

    def _draw_player(self) -> None:
        player, models = self._player, self._models
        if player is None:
            self._set(player={"playing": not self._paused})
            return
        position_s = round(player.position_s, 3)
        self._set(
            player={
                "playing": player.playing, "position": position_s, "seconds": player.seconds, "speed": player.speed,
                "behind": player.is_behind,
            }
        )  # fmt: skip
        if self._changed("position", position_s):
            models.position.data = {"time": [position_s]}
        if (timeline := player.timeline) is not None and self._changed("timeline", True):
            models.timeline.data = timeline.mean_errors(player.seconds)
            relative = timeline.log_s / max(player.seconds, 1e-9)
            largest = timeline.largest_error()
            self._set(
                marks={
                    "bad": np.unique(relative[timeline.bad].round(3)).tolist(),
                    "count": int(timeline.bad.sum()),
                    "largest": None if largest is None else float(relative[largest]),
                    "truth": bool(np.isfinite(timeline.true_m).any()),
                }
            )
        second = player.companion
        if second is not None and second.timeline is not None and self._changed("second_timeline", True):
            columns = second.timeline.mean_errors(second.seconds)
            models.second_timeline.data = {"time": columns["time"], "second": columns["corrected"]}

    def _draw_tables(self, scene: Scene) -> None:
        """Draw everything that consists of text; all of it is from the same time."""
        timeline = None if self._player is None else self._player.timeline
        second, rows, pairs = self._view.second, [], {}
        for pair, history, sample in scene.latest():
            no_data, age_s = _no_data(scene, history), scene.age_s(history)
            means = history.statistics()
            means |= {
                "rate": 0.0 if no_data else history.rate_hz(scene.stamp_age_s(pair)),
                "stopped": age_s if no_data else 0.0,
            }
            if timeline is not None and pair in timeline.losses:
                lost, received = timeline.losses[pair]
                means["lost"] = 100.0 * lost / max(lost + received, 1)
            compared = None if second is None or pair not in second.pairs else second.pairs[pair].latest
            pairs[pair] = means
            rows.append(
                means
                | {
                    "anchor": format_id(pair[0]),
                    "tag": format_id(pair[1]),
                    "state": health.state(means),
                    "raw": sample.raw_m,
                    "corrected": sample.range_m,
                    "second": compared.range_m if compared else math.nan,
                    "sigma": sample.sigma_m,
                    "status": no_data or sample.status.name,
                    "no_data": bool(no_data),
                }
            )
        self._has_data = any(not row["no_data"] for row in rows)
        _set_rows(self._models.pairs, rows)
        self._set(health=_anchor_rows(health.anchor_means(pairs)), cards=self._cards(scene))
        reports = sorted((name, report.aged(scene.clock())) for name, report in scene.node_statuses.items())
        self._set(nodes=[[name, LEVELS[min(report.level, 3)], report.message] for name, report in reports])
        self._draw_summary(scene)

    def _cards(self, scene: Scene) -> list[Card]:
        """Return the large figures."""
        tag_id = None if self._selected is None else self._selected[1]
        if (player := self._player) is None:
            return live_cards(scene, tag_id)
        if player.timeline is None:
            return [["Reading the recording ...", "", ""]]
        timeline, second = player.timeline, None if player.companion is None else player.companion.timeline
        position_s = player.position_s if self._window == RECENT else 0.0
        is_complete = timeline.is_complete, second is not None and second.is_complete
        if self._changed("cards", (self._window, tag_id, position_s, second is None, *is_complete)):
            self._interval_cards = interval_cards(timeline, second, tag_id, self._window, position_s)
        return current_card(timeline, tag_id, player.position_s) + self._interval_cards

    def _draw_summary(self, scene: Scene) -> None:
        """Show counts, and the reason for an empty page."""
        histories = [history for _, history, _ in scene.latest()]
        texts = [f"{len(histories)} pair{'' if len(histories) == 1 else 's'}"]
        timeline = None if self._player is None else self._player.timeline
        texts.append(f"{scene.ranges if timeline is None else len(timeline.bad)} corrected ranges")
        missing, ranges = self._view.missing, ""
        if scene.dropped:
            texts.append(f"{scene.dropped} dropped by the viewer")
        if math.isfinite(now_s := scene.now_s(None if self._selected is None else self._selected[1])):
            texts.insert(0, _utc(now_s))
        if not histories:
            ranges = missing.ranges
        elif not self._has_data:
            ranges = f"No ranges for {min(map(scene.age_s, histories)):.0f} s."
        lines = (
            ranges,
            "" if scene.anchors else missing.anchors,
            "" if scene.tags or scene.tracks else missing.positions,
            *(() if timeline is None else timeline.notices),
            *(
                line
                for status in scene.node_statuses.values()
                for line in status.aged(scene.clock()).determinations
            ),
        )
        self._set(summary=" \u00b7 ".join(texts), notice=[line for line in lines if line])

    def _draw_map(self, scene: Scene) -> None:
        models = self._models
        if self._changed("anchors", scene.anchors):
            anchors = [
                {"x": place.x, "y": place.y, "name": place.name or format_id(identity), "id": str(identity)}
                for identity, place in scene.anchors.items()
            ]
            _set_rows(models.anchors, anchors)
        place = scene.anchors.get(self._selected[0]) if self._selected else None
        if self._changed("selected", place):
            _set_rows(models.selected, [{"x": place.x, "y": place.y}] if place else [])
        tags: list[dict[str, Any]] = []
        plain_id = plain_tag_id(scene.tags, scene.pairs)
        for name, tag in scene.tags.items():
            if (pose := tag.pose) is not None:
                age_s, label = scene.age_s(tag), tag_label(name, plain_id)
                major, minor, angle = map(_drawable, pose.ellipse)
                tags.append(
                    {
                        "x": pose.x,
                        "y": pose.y,
                        "name": f"{label}: no data for {age_s:.0f} s" if age_s > NO_DATA_S else label,
                        "status": "no data" if age_s > NO_DATA_S else "OK",
                        "width": 2 * major,
                        "height": 2 * minor,
                        "label_y": pose.y + finite_or_zero(_half_height(pose)),
                        "angle": angle,
                        "protection": _drawable(pose.protection_m),
                        "heading": pose.heading_rad,
                    }
                )
        _set_rows(models.tags, tags)
        _set_rows(models.ellipses, [row for row in tags if row["width"] > 0.0 and row["height"] > 0.0])
        _set_rows(models.protection, [row for row in tags if row["protection"] > 0.0])
        _set_rows(models.headings, [row for row in tags if math.isfinite(row["heading"])])
        self._draw_tracks(scene)
        self._draw_accuracy(scene, [sample for _, _, sample in scene.latest()])
        fitted = scene.is_indexed, bool(scene.anchors), bool(scene.anchors or scene.tracks)
        # The view is set for the first content and for the first anchors, and then only by the user.
        if fitted > self._fitted or not models.extent.data["x"]:
            self._fitted = fitted
            self._fit(scene)
        self._draw_rays(scene)
        models.update_legend()

    def _draw_tracks(self, scene: Scene) -> None:
        models, second = self._models, self._view.second
        for kind, sources in models.tracks.items():
            origin, origin_kind = (second, TrackKind.CORRECTED) if kind is TrackKind.SECOND else (scene, kind)
            tracks = [] if origin is None else [
                view for (_, track_kind), view in origin.tracks.items() if track_kind is origin_kind and len(view.points)
            ]  # fmt: skip
            state = [(len(view.points), view.points[-1][0], math.floor(scene.age_s(view))) for view in tracks]
            if not self._changed(kind.value, (self._trail_s, state)):
                continue
            thirds = [self._fading(view.columns(), scene.age_s(view)) for view in tracks]
            for third, source in enumerate(sources):
                # A NaN separates the tracks of two tags.
                rows = [row for points in thirds for row in (points[third], [(math.nan, math.nan)])]
                columns = np.concatenate(rows).astype(np.float32) if rows else np.zeros((0, 2), np.float32)
                source.data = {"x": columns[:, 0], "y": columns[:, 1]}
        shown = models.layers["heat"][0].visible
        if shown and self._changed("heat", sum(entry[1] for entry in scene.heat.values())):
            cells = np.array([(*cell, entry[0] / entry[1]) for cell, entry in scene.heat.items()], np.float32)
            x, y, mean = cells.reshape(-1, 3).T
            models.heat.data = {"x": (x + 0.5) * CELL_M, "y": (y + 0.5) * CELL_M, "mean": mean}
            if len(mean):
                low, high = np.percentile(mean, (5, 95)).tolist()
                models.heat_levels.update(low=low, high=high + 1e-6)

    def _fading(self, track: NDArray[np.float64], age_s: float) -> list[NDArray[np.float64]]:
        """Return x and y of the newest, middle and oldest third of the displayed time of a track, float64 (k, 2)."""
        time_s, now_s = track[:, 0], track[-1, 0] + age_s
        edges_s = now_s - min(self._trail_s, now_s - time_s[0]) / len(FADING) * np.arange(len(FADING) + 1)
        ends = np.searchsorted(time_s, edges_s, side="right")
        ends[-1] = np.searchsorted(time_s, edges_s[-1])
        # The first point of the next third belongs to both, so that the line is continuous.
        return [
            with_gaps(_thin(track[begin : end + 1, :3]), NO_DATA_S)[:, 1:]
            for end, begin in pairwise(ends.tolist())
        ]

    def _draw_accuracy(self, scene: Scene, shown: list[Sample]) -> None:
        """Draw the map of the predicted accuracy if it is visible."""
        models, tag = self._models, next(iter(scene.tags.values()), None)
        if not models.layers["accuracy"][0].visible or len(scene.anchors) < 2:
            return
        anchors = np.array([(place.x, place.y, finite_or_zero(place.z)) for place in scene.anchors.values()])
        height_m = finite_or_zero(tag.pose.z if tag and tag.pose else math.nan)
        sds_m = [sample.sigma_m for sample in shown if sample.sigma_m > 0.0]
        sd_m = round(float(np.median(sds_m)), 2) if sds_m else RANGE_SD_M
        if self._changed("accuracy", (anchors.tobytes(), round(height_m, 1), sd_m)):
            image, low, size = health.predicted_accuracy(anchors, height_m, sd_m)
            models.accuracy.data = {
                "image": [image], "x": [low[0]], "y": [low[1]], "dw": [size[0]], "dh": [size[1]]
            }  # fmt: skip
            low_m, high_m = (
                np.nanpercentile(image, (0, 90)).tolist() if np.isfinite(image).any() else (0.0, 1.0)
            )
            models.accuracy_levels.update(low=low_m, high=high_m)

    def _fit(self, scene: Scene) -> None:
        """Fit the view of the map to its current content."""
        places = [(place.x, place.y) for place in scene.anchors.values()]
        places += [(tag.pose.x, tag.pose.y) for tag in scene.tags.values() if tag.pose is not None]
        timeline = None if self._player is None else self._player.timeline
        tracks = [view.columns() for view in scene.tracks.values()]
        if timeline is not None and timeline.is_complete:
            tracks = list(timeline.tracks.values())
        for track in tracks:
            places += np.percentile(track[:, 1:3], (2, 98), axis=0).tolist() if len(track) else []
        corners = np.array(places or [(0.0, 0.0), (10.0, 10.0)])
        low, high = corners.min(axis=0), corners.max(axis=0)
        # A margin for ellipses and labels; without anchors, one in which the tag can move.
        margin = 0.05 * float((high - low).max()) if scene.anchors or not places else MARGIN_M
        low, high = low - margin, high + margin
        self._models.extent.data = {name: [float(low[i]), float(high[i])] for i, name in enumerate("xy")}

    def _draw_rays(self, scene: Scene) -> None:
        """Draw rays, circles and statuses of the tag of the selected pair."""
        rows, symbols = [], []
        tag = None if self._selected is None else scene.tag_of(self._selected[1])
        pose = None if tag is None else tag.pose
        for pair, history, sample in scene.latest():
            place = scene.anchors.get(pair[0])
            is_drawable = math.isfinite(_drawable(sample.range_m)) and not _no_data(scene, history)
            if self._selected is None or pair[1] != self._selected[1] or place is None or not is_drawable:
                continue
            height_m = 0.0 if pose is None else finite_or_zero(pose.z - place.z)
            raw_m, corrected_m = (
                math.sqrt(max(finite_or_zero(_drawable(value)) ** 2 - height_m * height_m, 0.0))
                for value in (sample.raw_m, sample.range_m)
            )
            x1, y1 = (place.x, place.y) if pose is None else (pose.x, pose.y)
            ends = {"x": place.x, "y": place.y, "x1": x1, "y1": y1}
            rows.append(ends | {"raw": raw_m, "corrected": corrected_m, "status": sample.status.name})
            if pose is not None:
                middle = {"x": (place.x + x1) / 2, "y": (place.y + y1) / 2}
                symbols.append(middle | {"status": sample.status.name})
        _set_rows(self._models.rays, rows)
        _set_rows(self._models.statuses, symbols)

    def _draw_strip(self, scene: Scene, history: History | None) -> None:
        # Also draw a pair without new data, because its ranges age.
        now_s = scene.now_s(None if self._selected is None else self._selected[1])
        if not self._changed("strip", (self._selected, now_s, scene.ranges)):
            return
        history_samples = () if history is None else tuple(history.samples)
        samples = [sample for sample in history_samples if sample.time_s >= now_s - HISTORY_S]
        values = {
            "age": [sample.time_s - now_s for sample in samples],
            "raw": [_drawable(sample.raw_m) for sample in samples],
            "corrected": [_drawable(sample.range_m) for sample in samples],
            "true": [_drawable(sample.true_m) for sample in samples],
            "second": self._second_ranges(samples),
        }
        none = (
            f"No range of this pair in the last {HISTORY_S:.0f} s."
            if history_samples
            else "No range of this pair yet."
        )
        self._models.show_empty("strip", "" if np.isfinite(values["raw"]).any() else none)
        table = _thin(np.array(list(values.values()), np.float64).reshape(len(values), -1).T, 3 * MAX_POINTS)
        table = with_gaps(table, NO_DATA_S if history is None else history.max_gap_s)
        self._models.strip.data = dict(zip(values, table.T.astype(np.float32), strict=True))
        bad = [
            {
                "age": sample.time_s - now_s,
                "corrected": _drawable(sample.range_m),
                "status": sample.status.name,
            }
            for sample in samples
            if sample.status is not Status.OK
        ]
        _set_rows(self._models.bad, bad)

    def _second_ranges(self, samples: list[Sample]) -> list[float]:
        """Return the ranges of the second recording at the stamps of the first one."""
        scene, pair = self._view.second, self._selected
        history = None if scene is None or pair is None else scene.pairs.get(pair)
        ranges = {round(sample.time_s, 6): sample.range_m for sample in history.samples} if history else {}
        return [_drawable(ranges.get(round(sample.time_s, 6), math.nan)) for sample in samples]

    def _draw_trace(self, scene: Scene, traces: tuple[Trace, ...]) -> None:
        models = self._models
        if not traces:
            has_cirs = any(history.traces for history in scene.pairs.values())
            none = "No CIR of this pair yet." if has_cirs else _NO_CIRS
        models.show_empty("cir", "" if traces else none)
        # Compare the newest trace instead of its stamp, because stamps may be equal.
        if not self._changed("traces", (self._selected, traces[-1] if traces else None)):
            return
        models.waterfall.data = {"image": [_waterfall_image(traces)] if traces else []}
        if not traces:
            _set_rows(models.trace, [])
            _set_rows(models.marks, [])
            return
        trace = traces[-1]
        cir, magnitude = trace.cir, trace.magnitude
        sample = np.arange(len(magnitude)) + (cir.start_index - trace.origin)
        shown = (sample >= -TRACE_BEFORE) & (sample < TRACE_AFTER)
        models.trace.data = {"sample": sample[shown].astype(np.float32), "magnitude": magnitude[shown]}
        marks = {
            "noise": float(cir.noise_threshold),
            "first": finite_or_zero(cir.first_path_index - trace.origin),
            "from": -float(WINDOW_LEAD),
            "to": float(self._view.window - WINDOW_LEAD),
        }
        _set_rows(models.marks, [marks])

    def _draw_errors(self, scene: Scene) -> None:
        player = self._player
        timeline = None if player is None else player.timeline
        second = None if player is None or player.companion is None else player.companion.timeline
        end_s = math.inf if player is None or self._window == WHOLE else player.position_s
        live_errors = scene.errors if timeline is None else -1
        if not self._changed("errors", (live_errors, end_s, second is None)):
            return
        begin_s = end_s - HISTORY_S if end_s < math.inf else -math.inf
        counts = (
            scene.error_counts if timeline is None else count_errors(timeline.range_errors(begin_s, end_s))
        )
        compared = counts if second is None else count_errors(second.range_errors(begin_s, end_s))
        columns = zip(("raw", "corrected", "second"), (*counts.astype(float), compared[1]), strict=True)
        self._models.show_empty("errors", "" if counts.any() else "No true ranges.")
        self._models.errors.data = dict(columns) | {"left": ERROR_EDGES_M[:-1], "right": ERROR_EDGES_M[1:]}

    def _changed(self, name: str, value: object) -> bool:
        if name in self._drawn and self._drawn[name] == value:
            return False
        self._drawn[name] = value
        return True

    def _set(self, **values: object) -> None:
        """Set attributes of the controls that have changed."""
        for name, value in values.items():
            if getattr(self._models.controls, name) != value:
                setattr(self._models.controls, name, value)

    # Events ---------------------------------------------------------------------------------------------------

    def _on_command(self, _attribute: str, _old: object, command: Any) -> None:
        """Execute a command of the page; a browser may send anything."""
        try:
            name, arguments = str(command[0]), list(command[1])
            if name == "show":
                for renderer in self._models.layers[arguments[0]]:
                    renderer.visible = bool(arguments[1])
            elif name == "select":
                self.select((int(str(arguments[0]), 0), int(str(arguments[1]), 0)))
            elif name == "trail" and float(arguments[0]) in TRAILS_S:
                self._trail_s = float(arguments[0])
            elif name == "window" and arguments[0] in (WHOLE, RECENT):
                self._window = arguments[0]
            elif name == "select_anchor":
                self._select_anchor(int(arguments[0]))
            elif self._player is not None:
                self.select(self._player.command(name, *arguments))
            elif name == "play":
                self._paused = not bool(arguments[0])
        except (LookupError, TypeError, ValueError, OverflowError):
            return
        self._drawn.pop("scene", None)
        self._table_due_s = 0.0
        self._redraw = True
        if not self._is_waiting:
            self.draw()

    def _on_acknowledged(self, _attribute: str, _old: object, _number: Any) -> None:
        """Draw what changed by a command while the page was busy."""
        self._took_s = time.monotonic() - self._sent_s
        if self._redraw and not self._is_waiting:
            self.draw()

    def _select_anchor(self, anchor: int) -> None:
        """Select the pair of an anchor with the selected tag, else its first pair."""
        pairs = [pair for pair, _, _ in self._view.scene.latest() if pair[0] == anchor]
        tag = self._selected[1] if self._selected else None
        self.select(next((pair for pair in pairs if pair[1] == tag), pairs[0] if pairs else None))

    def _on_reset(self, _event: Reset) -> None:
        with self._view.lock:
            self._fit(self._view.scene)

    def _on_closed(self, _context: Any) -> None:
        self._view.pages -= 1


def _no_data(scene: Scene, history: History) -> str:
    """Return "no data for 12 s" for a pair that has stopped, else an empty string."""
    age_s = scene.age_s(history)
    return "" if age_s <= history.max_gap_s else f"no data for {age_s:.0f} s"


def _anchor_rows(anchors: dict[int, health.Means]) -> list[list[str]]:
    """Return the texts of the table of anchors; advice for all of them is in the first row."""
    common, advice = health.advice(anchors)
    states = {anchor_id: health.state(means) for anchor_id, means in anchors.items()}
    worst = health.BAD if health.BAD in states.values() else health.CHECK
    rows = [[worst, "all", "", "", "", "", common]] if common else []
    for anchor_id, means in anchors.items():
        digits = {"rate": 1, "nlos": 0, "residual": 2, "lost": 0}
        texts = [f"{means[name]:.{count}f}".replace("nan", "-") for name, count in digits.items()]
        rows.append([states[anchor_id], format_id(anchor_id), *texts, advice[anchor_id]])
    return rows


def _set_rows(source: ColumnDataSource, rows: list[dict[str, Any]]) -> None:
    """Set the rows of a source, unless it is and remains empty."""
    if rows or any(map(len, source.data.values())):
        source.data = {column: [row[column] for row in rows] for column in source.data}


def _waterfall_image(traces: tuple[Trace, ...]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return one exchange per row, newest first, levels from -40 dB to its peak; uint8 (WATERFALL, width)."""
    image = np.zeros((WATERFALL, TRACE_BEFORE + TRACE_AFTER), np.uint8)
    for row, trace in enumerate(reversed(traces)):
        begin = trace.origin - TRACE_BEFORE - trace.cir.start_index
        low, high = max(begin, 0), min(begin + image.shape[1], len(trace.magnitude))
        magnitude = trace.magnitude[low:high]
        if low < high and (peak := float(magnitude.max())) > 0.0:
            level = 1.0 + np.log10(np.maximum(magnitude / peak, 1e-2)) / 2.0
            image[row, low - begin : high - begin] = (255.0 * level).astype(np.uint8)
    return image


def _thin(rows: NDArray[np.float64], limit: int = MAX_POINTS) -> NDArray[np.float64]:
    """Return at most about `limit` rows, at equal steps from the last one backwards."""
    return rows[:: -max(1, -(-len(rows) // limit))][::-1]


def _half_height(pose: Pose) -> float:
    """Return the extent of the ellipse of a pose in y, m."""
    major, minor, angle = pose.ellipse
    return math.hypot(_drawable(major) * math.sin(angle), _drawable(minor) * math.cos(angle))


def _utc(time_s: float) -> str:
    try:
        return f"{datetime.fromtimestamp(time_s, timezone.utc):%Y-%m-%d %H:%M:%S} UTC"
    except (OverflowError, ValueError, OSError):
        return f"{time_s:.0f} s"


def _drawable(value_m: float) -> float:
    """Return NaN for a length that would make all others invisible."""
    return value_m if abs(value_m) < MAX_RANGE_M else math.nan
