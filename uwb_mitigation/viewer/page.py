"""Draw a scene into the models of one page, and handle clicks on it."""

from __future__ import annotations

import html
import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
from bokeh.document import Document
from bokeh.events import Reset
from bokeh.models import ColumnDataSource

from uwb_mitigation.errors import format_id
from uwb_mitigation.measurement import Status
from uwb_mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.viewer.models import (
    CORRECTED,
    SMOOTHED,
    TRACE_AFTER,
    TRACE_BEFORE,
    Models,
    blank_waterfall,
)
from uwb_mitigation.viewer.scene import (
    ERROR_EDGES_M,
    HISTORY_S,
    MAX_RANGE_M,
    NO_DATA_S,
    History,
    MissingData,
    Pair,
    Scene,
    Trace,
)

if TYPE_CHECKING:
    from uwb_mitigation.viewer.playback import BagPlayer

REFRESH_S = 0.1
FAST_PAGES = 3
"""Number of pages that are drawn every `REFRESH_S`; more pages are drawn less often."""

COLOURS = {
    Status.OK: "#15803d",
    Status.NO_CIR: "#6b7280",
    Status.BAD_CIR: "#b45309",
    Status.OUT_OF_DISTRIBUTION: "#c2410c",
    Status.MODEL_ERROR: "#b91c1c",
}
LEVELS = ("OK", "WARN", "ERROR", "STALE")
LEVEL_COLOURS = ("#15803d", "#b45309", "#b91c1c", "#6b7280")

NO_DATA_COLOUR = "#9ca3af"
"""Colour of pairs and tags without recent data."""

MARGIN_M = 5.0
"""Margin around a tag on a map without anchors."""

_NOTICE_STYLE = "background:#fef3c7;color:#78350f;padding:4px 10px;border-radius:4px;margin-bottom:4px"
_DIAGNOSTICS_STYLE = (
    "<style>td{padding:2px 10px 2px 4px;vertical-align:top;overflow-wrap:anywhere}"
    "td:first-child{min-width:90px}</style>"
)

_TEMPLATES = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"))


@dataclass(slots=True)
class View:
    """State that all pages of a server share.

    Attributes:
        lock: held while the scene is changed or drawn.
        window: number of samples that the network reads.
        player: player of a recording; None: live.
        missing: the reasons for an empty page.
        pages: number of open pages.
    """

    scene: Scene
    lock: Lock
    title: str = "UWB ranges"
    window: int = 157
    player: BagPlayer | None = None
    missing: MissingData = field(default_factory=MissingData)
    pages: int = 0


class Page:
    """One open page. It draws at most ten times a second, and only what has changed.

    Args:
        document: the session's document; the page is added to it.
        nonce: nonce of the page's scripts for the Content-Security-Policy.
    """

    def __init__(self, document: Document, view: View, nonce: str = "") -> None:
        self._view = view
        self._fitted: tuple[bool, bool] = False, False
        self._selected: Pair | None = None
        self._rows: list[Pair] = []
        self._due_s = 0.0
        self._drawn: dict[str, object] = {}
        self._models = models = Models(None if view.player is None else view.player.seconds)
        # Register before the model is added to the document: later registrations have no effect.
        models.map_figure.on_event(Reset, self._on_reset)
        # Add all roots in one step: Bokeh searches for new models after each, half of the time to open a page.
        with document.models.freeze():
            for model in models.roots.values():
                document.add_root(model)
        document.title = view.title
        document.template = _TEMPLATES.get_template("page.html.j2")
        document.template_variables.update(
            page_title=view.title, recording=view.player is not None, nonce=nonce
        )
        document.config.update(reconnect_session=False, notify_connection_status=False, notifications=None)
        models.pairs.selected.on_change("indices", self._on_row)
        models.anchors.selected.on_change("indices", self._on_anchor)
        models.pause.on_change("active", self._on_pause)
        if models.slider is not None:
            models.slider.on_change("value_throttled", self._on_slider)
        document.add_periodic_callback(self.tick, int(1000 * REFRESH_S))
        self.draw()
        # Register last: a session that could not be opened does not report its end.
        document.on_session_destroyed(self._on_closed)
        view.pages += 1

    def tick(self) -> None:
        """Draw if it is time and the page is not paused."""
        now_s, player = time.monotonic(), self._view.player
        if player is not None:
            player.advance()
        elif self._models.pause.active:
            return
        if now_s < self._due_s:
            return
        self.draw()
        self._due_s = now_s + REFRESH_S * (max(1.0, self._view.pages / FAST_PAGES) - 0.5)

    def draw(self) -> None:
        """Update every model from the scene."""
        self._draw_player()
        with self._view.lock:
            scene = self._view.scene
            # Ages change without data; drawing them once a second is enough.
            if not self._changed("scene", (scene.revision, self._selected, math.floor(scene.clock()))):
                return
            self._draw_pairs(scene)
            self._draw_summary(scene)
            self._draw_map(scene)
            history = None if self._selected is None else scene.pairs.get(self._selected)
            self._draw_strip(scene, history)
            self._draw_trace(() if history is None else tuple(history.traces))
            self._draw_diagnostics(scene)
            if self._changed("errors", scene.errors):
                raw, corrected = scene.error_counts.astype(float)
                left, right = ERROR_EDGES_M[:-1], ERROR_EDGES_M[1:]
                self._models.errors.data = {"left": left, "right": right, "raw": raw, "corrected": corrected}

    def select(self, pair: Pair) -> None:
        """Show the CIR and the strip of a pair."""
        self._selected = pair
        self.draw()

    # Drawing --------------------------------------------------------------------------------------------------

    def _draw_player(self) -> None:
        player, slider = self._view.player, self._models.slider
        if player is None or slider is None:
            return
        if self._changed("position", position_s := min(round(player.position_s, 1), slider.end)):
            # The page's script moves the handle, unless the user is dragging it.
            slider.tags = [position_s]
        if self._changed("playing", player.playing):
            self._models.pause.active = not player.playing
            self._models.pause.label = "Pause" if player.playing else "Play"

    def _draw_pairs(self, scene: Scene) -> None:
        rows = []
        for pair, history, sample in scene.latest():
            no_data = _no_data(scene, history)
            rows.append(
                {
                    "anchor": format_id(pair[0]),
                    "tag": format_id(pair[1]),
                    "rate": 0.0 if no_data else history.rate_hz(scene.age_s(history)),
                    "raw": sample.raw_m,
                    "range": sample.range_m,
                    "sigma": sample.sigma_m,
                    "correction": sample.raw_m - sample.range_m,
                    "status": no_data or sample.status.name,
                    "colour": NO_DATA_COLOUR if no_data else COLOURS[sample.status],
                    "row_colour": NO_DATA_COLOUR if no_data else "",
                }
            )
        self._rows = [pair for pair, _, _ in scene.latest()]
        if self._selected is None and self._rows:
            self._selected = self._rows[0]
        _set_rows(self._models.pairs, rows)
        _select_row(self._models.pairs, self._rows, self._selected)

    def _draw_summary(self, scene: Scene) -> None:
        """Show counts, the reason for an empty page, and the pairs and tags that have stopped."""
        count = len(self._rows)
        parts = [f"{count} pair{'' if count == 1 else 's'}", f"{scene.ranges} ranges"]
        if math.isfinite(scene.now_s):
            parts.insert(0, _utc(scene.now_s))
        if scene.errors:
            raw_m, corrected_m = scene.error_sums_m / scene.errors
            parts.append(f"mean absolute error {raw_m:.3f} m raw, {corrected_m:.3f} m corrected")
        missing, lines = self._view.missing, []
        histories = [history for _, history, _ in scene.latest()]
        if not histories:
            lines.append(missing.ranges)
        elif all(_no_data(scene, history) for history in histories):
            lines.append(f"No ranges for {min(map(scene.age_s, histories)):.0f} s.")
        lines += [missing.anchors] if not scene.anchors else []
        lines += [missing.positions] if not scene.tags else []
        notice = "".join(f'<div style="{_NOTICE_STYLE}">{html.escape(line)}</div>' for line in lines if line)
        for div, text in (
            (self._models.summary, html.escape(" · ".join(parts))),
            (self._models.notice, notice),
        ):
            if div.text != text:
                div.text = text

    def _draw_map(self, scene: Scene) -> None:
        models = self._models
        if self._changed("anchors", scene.anchors):
            anchors = [
                {"x": place.x, "y": place.y, "name": place.name or format_id(identity), "id": str(identity)}
                for identity, place in scene.anchors.items()
            ]
            _set_rows(models.anchors, anchors)
        _select_row(
            models.anchors, list(scene.anchors), None if self._selected is None else self._selected[0]
        )
        tags, tracks = [], []
        for name, tag in scene.tags.items():
            colour = SMOOTHED if name.endswith(" smoothed") else CORRECTED
            tracks.append(_line(tag.track) | {"colour": colour})
            if (pose := tag.pose) is None:
                continue
            no_data = scene.age_s(tag) > NO_DATA_S
            major, minor, angle = pose.ellipse
            tags.append(
                {
                    "x": pose.x,
                    "y": pose.y,
                    "name": f"{name}: no data for {scene.age_s(tag):.0f} s" if no_data else name,
                    "colour": NO_DATA_COLOUR if no_data else colour,
                    "width": _finite(_drawable(2 * major)),
                    "height": _finite(_drawable(2 * minor)),
                    "angle": _finite(angle),
                }
            )
        _set_rows(models.tags, tags)
        _set_rows(models.tracks, tracks)
        _set_rows(models.true_tracks, [_line(track) for track in scene.true_tracks.values()])
        fitted = bool(scene.anchors), bool(scene.anchors or scene.tags or scene.true_tracks)
        # The view is set for the first content and for the first anchors, and then only by the user.
        if fitted > self._fitted or not models.extent.data["x"]:
            self._fitted = fitted
            self._fit(scene)
        self._draw_circles(scene)

    def _fit(self, scene: Scene) -> None:
        """Fit the view of the map to its current content."""
        places = [(place.x, place.y) for place in scene.anchors.values()]
        for track in (*(tag.track for tag in scene.tags.values()), *scene.true_tracks.values()):
            places += track
        x, y = np.array(places or [(0.0, 0.0), (10.0, 10.0)]).T
        # Without anchors, leave a margin in which the tag can move.
        margin = 0.0 if scene.anchors or not places else MARGIN_M
        corners = {"x": [x.min() - margin, x.max() + margin], "y": [y.min() - margin, y.max() + margin]}
        self._models.extent.data = {name: [float(value) for value in ends] for name, ends in corners.items()}

    def _draw_circles(self, scene: Scene) -> None:
        """Draw circles and rays of the tag of the selected pair."""
        rows = []
        tag_id = None if self._selected is None else self._selected[1]
        tag = None if tag_id is None else scene.tag_of(tag_id)
        pose = None if tag is None else tag.pose
        for (anchor, other), history, sample in scene.latest():
            place = scene.anchors.get(anchor)
            if other != tag_id or place is None or math.isnan(_drawable(sample.range_m)):
                continue
            if _no_data(scene, history):
                continue
            height_m = 0.0 if pose is None else _finite(pose.z - place.z)
            raw_m, range_m = (
                math.sqrt(max(_finite(_drawable(value)) ** 2 - height_m * height_m, 0.0))
                for value in (sample.raw_m, sample.range_m)
            )
            x1, y1 = (place.x, place.y) if pose is None else (pose.x, pose.y)
            row = {"x": place.x, "y": place.y, "raw": raw_m, "range": range_m, "x1": x1, "y1": y1}
            rows.append(row | {"colour": COLOURS[sample.status]})
        _set_rows(self._models.circles, rows)

    def _draw_strip(self, scene: Scene, history: History | None) -> None:
        # Also draw a pair without new data, because its ranges age.
        if not self._changed("strip", (self._selected, scene.now_s, scene.ranges)):
            return
        now_s = scene.now_s
        kept = () if history is None else tuple(history.samples)
        samples = [sample for sample in kept if sample.time_s >= now_s - HISTORY_S]
        self._models.show_empty("strip", all(math.isnan(_drawable(sample.raw_m)) for sample in samples))
        values = {
            "age": [sample.time_s - now_s for sample in samples],
            "raw": [_drawable(sample.raw_m) for sample in samples],
            "range": [_drawable(sample.range_m) for sample in samples],
            "true": [_drawable(sample.true_m) for sample in samples],
        }
        self._models.strip.data = {name: np.array(column, np.float32) for name, column in values.items()}
        title = "no pair chosen"
        if self._selected is not None:
            title = f"anchor {format_id(self._selected[0])}, tag {format_id(self._selected[1])}"
        self._models.strip_figure.title.text = f"Range: {title}"
        self._models.cir_figure.title.text = f"CIR: {title}"

    def _draw_trace(self, traces: tuple[Trace, ...]) -> None:
        models = self._models
        # Compare the newest trace instead of its stamp, because stamps may be equal.
        if not self._changed("traces", (self._selected, traces[-1] if traces else None)):
            return
        models.show_empty("cir", not traces)
        models.waterfall.data = {"image": [_waterfall_image(traces)]}
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
            "first": _finite(cir.first_path_index - trace.origin),
            "top": 1.05 * float(magnitude[shown].max()) if shown.any() else 1.0,
            "from": -float(WINDOW_LEAD),
            "to": float(self._view.window - WINDOW_LEAD),
        }
        _set_rows(models.marks, [marks])

    def _draw_diagnostics(self, scene: Scene) -> None:
        rows = [(name, report.at(scene.clock())) for name, report in sorted(scene.node_statuses.items())]
        if self._changed("node_statuses", rows):
            # Escape these texts: they come from messages and may contain HTML.
            cells = [
                f"<tr><td>{html.escape(name)}</td>"
                f"<td>{_level(report.level)}</td><td>{html.escape(report.message)}</td></tr>"
                for name, report in rows
            ]
            self._models.node_statuses.text = (
                f"{_DIAGNOSTICS_STYLE}<table>{''.join(cells)}</table>" if cells else "none yet"
            )

    def _changed(self, name: str, value: object) -> bool:
        if name in self._drawn and self._drawn[name] == value:
            return False
        self._drawn[name] = value
        return True

    # Events ---------------------------------------------------------------------------------------------------

    def _on_row(self, _attribute: str, _old: object, new: list[int]) -> None:
        if new and new[0] < len(self._rows) and self._rows[new[0]] != self._selected:
            self.select(self._rows[new[0]])

    def _on_anchor(self, _attribute: str, _old: object, new: list[int]) -> None:
        """Select the pair of a clicked anchor with the selected tag, else its first pair."""
        source, selected = self._models.anchors, self._selected
        anchors = [int(identity) for identity in source.data["id"]]
        anchor = anchors[new[0]] if new and new[0] < len(anchors) else None
        pairs = [pair for pair in self._rows if pair[0] == anchor]
        if pairs and selected not in pairs:
            self.select(next((pair for pair in pairs if selected and pair[1] == selected[1]), pairs[0]))
        else:
            _select_row(source, anchors, None if selected is None else selected[0])

    def _on_reset(self, _event: Reset) -> None:
        with self._view.lock:
            self._fit(self._view.scene)

    def _on_pause(self, _attribute: str, _old: object, new: bool) -> None:
        player = self._view.player
        if player is None:
            self._models.pause.label = "Resume" if new else "Pause"
        elif player.playing is new:
            player.play(not new)
            self.draw()

    def _on_slider(self, _attribute: str, _old: object, new: float) -> None:
        if self._view.player is not None:
            self._view.player.seek(new)
            self.draw()

    def _on_closed(self, _context: Any) -> None:
        self._view.pages -= 1


def _no_data(scene: Scene, history: History) -> str:
    """Return "no data for 12 s" for a pair that has stopped, else an empty string."""
    age_s = scene.age_s(history)
    return "" if history.has_data(age_s) else f"no data for {age_s:.0f} s"


def _set_rows(source: ColumnDataSource, rows: list[dict[str, Any]]) -> None:
    source.data = {column: [row[column] for row in rows] for column in source.data}


def _select_row(source: ColumnDataSource, rows: list[Any], chosen: object) -> None:
    """Select a row of a source, or clear the selection."""
    indices = [rows.index(chosen)] if chosen in rows else []
    if source.selected.indices != indices:
        source.selected.indices = indices


def _waterfall_image(traces: tuple[Trace, ...]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return one exchange per row, newest first, levels from -40 dB to its peak; uint8 (WATERFALL, width)."""
    image = blank_waterfall()
    for row, trace in enumerate(reversed(traces)):
        begin = trace.origin - TRACE_BEFORE - trace.cir.start_index
        low, high = max(begin, 0), min(begin + image.shape[1], len(trace.magnitude))
        part = trace.magnitude[low:high]
        if low < high and (peak := float(part.max())) > 0.0:
            level = 1.0 + np.log10(np.maximum(part / peak, 1e-2)) / 2.0
            image[row, low - begin : high - begin] = (255.0 * level).astype(np.uint8)
    return image


def _level(level: int) -> str:
    """Return the HTML of a diagnostic level, with its colour."""
    if not 0 <= level < len(LEVELS):
        return "?"
    return f'<span style="color:{LEVEL_COLOURS[level]};font-weight:600;white-space:nowrap">{LEVELS[level]}</span>'


def _line(track: Iterable[tuple[float, float]]) -> dict[str, Any]:
    return {"xs": [x for x, _ in track], "ys": [y for _, y in track]}


def _utc(time_s: float) -> str:
    try:
        return f"{datetime.fromtimestamp(time_s, timezone.utc):%Y-%m-%d %H:%M:%S} UTC"
    except (OverflowError, ValueError, OSError):
        return f"{time_s:.0f} s"


def _drawable(value_m: float) -> float:
    """Return NaN for a length that would make all others invisible."""
    return value_m if abs(value_m) < MAX_RANGE_M else math.nan


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0
