"""Draw a scene into the models of one page, and handle clicks on it."""

from __future__ import annotations

import math
import time
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
from uwb_mitigation.viewer.floor_plan import FloorPlan
from uwb_mitigation.viewer.models import COLUMNS, FIGURES, TRACE_AFTER, TRACE_BEFORE, Models, blank_waterfall
from uwb_mitigation.viewer.palette import BLUE, GREY, NIGHT, PAPER, STATUS_LOOKS, TrackKind
from uwb_mitigation.viewer.scene import (
    CELL_M,
    ERROR_EDGES_M,
    HISTORY_S,
    MAX_RANGE_M,
    NO_DATA_S,
    SPEEDS,
    History,
    MissingData,
    Pair,
    Sample,
    Scene,
    Trace,
)

if TYPE_CHECKING:
    from uwb_mitigation.viewer.playback import BagPlayer
    from uwb_mitigation.viewer.timeline import Timeline

REFRESH_S = 0.1
FAST_PAGES = 3
"""Number of pages that are drawn every `REFRESH_S`; more pages are drawn less often."""

LEVELS = ("OK", "WARN", "ERROR", "STALE")
LEVEL_SYMBOLS = ("\u25cf", "\u25b2", "\u2716", "\u25a0")

TABLE_S = 0.5
"""Minimum interval of updates of the table of pairs."""

NO_DATA_COLOUR = GREY
"""Colour of pairs and tags without recent data."""

HEADING_M = 1.0
"""Length of the heading arrow."""

MARGIN_M = 5.0
"""Margin around a tag on a map without anchors."""

_TEMPLATES = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"))


@dataclass(slots=True)
class View:
    """State that all pages of a server share.

    Attributes:
        lock: held while the scene is changed or drawn.
        window: number of samples that the network reads.
        player: player of a recording; None: live.
        compared: scene of the second recording; None: there is only one.
        plan: floor plan; None: unknown.
        missing: the reasons for an empty page.
        pages: number of open pages.
    """

    scene: Scene
    lock: Lock
    title: str = "UWB ranges"
    window: int = 157
    player: BagPlayer | None = None
    compared: Scene | None = None
    plan: FloorPlan | None = None
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
        self._fitted = False, False, False
        self._selected: Pair | None = None
        self._rows: list[Pair] = []
        self._due_s = 0.0
        self._drawn: dict[str, object] = {}
        self._paused = self._dark = False
        self._table_due_s = 0.0
        player = view.player
        self._models = models = Models(
            None if player is None else player.seconds, view.plan, view.compared is not None
        )
        # Register before the model is added to the document: later registrations have no effect.
        models.figures["map"].on_event(Reset, self._on_reset)
        # Add all roots in one step: Bokeh searches for new models after each, half of the time to open a page.
        with document.models.freeze():
            for model in models.roots:
                document.add_root(model)
        document.title = view.title
        document.template = _TEMPLATES.get_template("page.html.j2")
        document.template_variables.update(
            page_title=view.title,
            recording=player is not None,
            compares=view.compared is not None,
            nonce=nonce,
            columns=[column for column in COLUMNS if column[0] != "compared" or view.compared is not None],
            figures={name: FIGURES[name] for name in FIGURES if name in models.figures},
            looks=STATUS_LOOKS,
            speeds=SPEEDS,
        )
        document.config.update(reconnect_session=False, notify_connection_status=False, notifications=None)
        models.anchors.selected.on_change("indices", self._on_anchor)
        models.controls.on_change("command", self._on_command)
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
        elif self._paused:
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
            compared = self._view.compared
            if self._changed("errors", (scene.errors, None if compared is None else compared.errors)):
                raw, corrected = scene.error_counts.astype(float)
                columns = {
                    "left": ERROR_EDGES_M[:-1],
                    "right": ERROR_EDGES_M[1:],
                    "raw": raw,
                    "corrected": corrected,
                }
                second = np.zeros(len(raw)) if compared is None else compared.error_counts[1].astype(float)
                self._models.errors.data = columns | {"compared": second}

    def select(self, pair: Pair) -> None:
        """Show the CIR and the ranges of a pair."""
        self._selected = pair
        self._table_due_s = 0.0
        self.draw()

    # Drawing --------------------------------------------------------------------------------------------------

    def _draw_player(self) -> None:
        player, models = self._view.player, self._models
        if player is None:
            state: dict[str, object] = {"playing": not self._paused}
        else:
            position_s = round(player.position_s, 3)
            state = {
                "playing": player.playing, "position": position_s, "seconds": player.seconds, "speed": player.speed,
            }  # fmt: skip
            if self._changed("position", position_s):
                models.position.data = {"time": [position_s], "low": [0.0], "high": [1.0]}
            if player.timeline is not None and self._changed("timeline", True):
                self._draw_timeline(player, player.timeline)
            second = player.companion
            if (
                second is not None
                and second.timeline is not None
                and self._changed("compared_timeline", True)
            ):
                columns = second.timeline.mean_errors(second.seconds)
                models.compared_timeline.data = {"time": columns["time"], "compared": columns["corrected"]}
        if models.controls.player != state:
            models.controls.player = state

    def _draw_timeline(self, player: BagPlayer, timeline: Timeline) -> None:
        self._models.timeline.data = timeline.mean_errors(player.seconds)
        bad_s = np.unique(np.round(timeline.time_s[timeline.bad] / max(player.seconds, 1e-9), 3))
        largest = timeline.largest_error()
        self._models.controls.marks = {
            "bad": bad_s.tolist(),
            "count": int(timeline.bad.sum()),
            "largest": None
            if largest is None
            else float(timeline.time_s[largest] / max(player.seconds, 1e-9)),
            "truth": bool(np.isfinite(timeline.true_m).any()),
        }

    def _draw_pairs(self, scene: Scene) -> None:
        self._rows = [pair for pair, _, _ in scene.latest()]
        if self._selected is None and self._rows:
            self._selected = self._rows[0]
        selected = None if self._selected is None else [format_id(identity) for identity in self._selected]
        if self._models.controls.selected != selected:
            self._models.controls.selected = selected
        if time.monotonic() < self._table_due_s:
            self._drawn.pop("scene", None)
            return
        self._table_due_s = time.monotonic() + TABLE_S
        rows = []
        for pair, history, sample in scene.latest():
            no_data, look = _no_data(scene, history), STATUS_LOOKS[sample.status]
            other = None if self._view.compared is None else self._view.compared.pairs.get(pair)
            values = history.statistics()
            rows.append(
                values
                | {
                    "anchor": format_id(pair[0]),
                    "tag": format_id(pair[1]),
                    "rate": 0.0 if no_data else history.rate_hz(scene.age_s(history)),
                    "raw": sample.raw_m,
                    "range": sample.range_m,
                    "compared": other.latest.range_m if other and other.latest else math.nan,
                    "sigma": sample.sigma_m,
                    "status": no_data or sample.status.name,
                    "symbol": "\u25cb" if no_data else look.symbol,
                    "colour": NO_DATA_COLOUR if no_data else look.colour or "",
                    "no_data": bool(no_data),
                    "not_ok": 100.0 * values["not_ok"],
                    "nlos": 100.0 * values["nlos"],
                }
            )
        _set_rows(self._models.pairs, rows)

    def _draw_summary(self, scene: Scene) -> None:
        """Show counts, the reason for an empty page, and the pairs and tags that have stopped."""
        count = len(self._rows)
        parts = [f"{count} pair{'' if count == 1 else 's'}", f"{scene.ranges} ranges"]
        if math.isfinite(scene.now_s):
            parts.insert(0, _utc(scene.now_s))
        if scene.errors:
            raw_m, corrected_m = scene.error_sums_m / scene.errors
            parts.append(f"mean absolute error {raw_m:.3f} m raw, {corrected_m:.3f} m corrected")
            if (other := self._view.compared) is not None and other.errors:
                parts[-1] += f", {other.error_sums_m[1] / other.errors:.3f} m second recording"
        missing, lines = self._view.missing, []
        histories = [history for _, history, _ in scene.latest()]
        if not histories:
            lines.append(missing.ranges)
        elif all(_no_data(scene, history) for history in histories):
            lines.append(f"No ranges for {min(map(scene.age_s, histories)):.0f} s.")
        lines += [missing.anchors] if not scene.anchors else []
        lines += [missing.positions] if not (scene.tags or scene.tracks) else []
        lines = [line for line in lines if line]
        for name, value in (("summary", " \u00b7 ".join(parts)), ("notice", lines)):
            if getattr(self._models.controls, name) != value:
                setattr(self._models.controls, name, value)

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
        tags: list[dict[str, Any]] = []
        for name, tag in scene.tags.items():
            if (pose := tag.pose) is None:
                continue
            no_data = scene.age_s(tag) > NO_DATA_S
            major, minor, angle = pose.ellipse
            tags.append(
                {
                    "x": pose.x,
                    "y": pose.y,
                    "name": f"{name}: no data for {scene.age_s(tag):.0f} s" if no_data else name,
                    "colour": NO_DATA_COLOUR if no_data else BLUE,
                    "width": _finite(_drawable(2 * major)),
                    "height": _finite(_drawable(2 * minor)),
                    "angle": _finite(angle),
                    "protection": _finite(_drawable(pose.protection_m)),
                    "heading": _finite(pose.heading_rad),
                    "heading_size": HEADING_M if math.isfinite(pose.heading_rad) else math.nan,
                }
            )
        _set_rows(models.tags, tags)
        self._draw_tracks(scene)
        fitted = scene.is_indexed, bool(scene.anchors), bool(scene.anchors or scene.tracks)
        # The view is set for the first content and for the first anchors, and then only by the user.
        if fitted > self._fitted or not models.extent.data["x"]:
            self._fitted = fitted
            self._fit(scene)
        self._draw_rays(scene)
        for key, shown in (
            ("ellipse", any(row["width"] > 0.0 for row in tags)),
            ("protection", any(row["protection"] > 0.0 for row in tags)),
            ("heat", bool(scene.heat) and models.heat_renderer.visible),
        ):
            models.show_legend(key, shown)

    def _draw_tracks(self, scene: Scene) -> None:
        models = self._models
        for kind, source in models.tracks.items():
            of, wanted = scene, kind
            if kind is TrackKind.COMPARED:
                if self._view.compared is None:
                    continue
                of, wanted = self._view.compared, TrackKind.CORRECTED
            found = [tuple(track) for (_, own), track in of.tracks.items() if own is wanted]
            if not self._changed(kind.value, [(len(track), track[-1]) for track in found if track]):
                continue
            # A NaN separates the tracks of two tags.
            gap = ((math.nan, math.nan),)
            points = np.array([point for track in found for point in (*track, *gap)] or gap, np.float32)
            source.data = {"x": points[:, 0], "y": points[:, 1]}
            models.show_legend(kind, bool(found))
        if models.heat_renderer.visible and self._changed(
            "heat", sum(entry[1] for entry in scene.heat.values())
        ):
            cells = np.array([(*cell, entry[0] / entry[1]) for cell, entry in scene.heat.items()], np.float32)
            cells = cells.reshape(-1, 3)
            x, y = ((cells[:, axis] + 0.5) * CELL_M for axis in (0, 1))
            models.heat.data = {"x": x, "y": y, "mean": cells[:, 2]}
            if len(cells):
                low, high = np.percentile(cells[:, 2], (5, 95)).tolist()
                models.heat_levels.update(low=low, high=high + 1e-6)

    def _fit(self, scene: Scene) -> None:
        """Fit the view of the map to its current content."""
        places = [(place.x, place.y) for place in scene.anchors.values()]
        for track in scene.tracks.values():
            places += track
        if (player := self._view.player) is not None and player.timeline is not None:
            for _, position in player.timeline.tracks.values():
                places += np.percentile(position[:, :2], (2, 98), axis=0).tolist() if len(position) else []
        x, y = np.array(places or [(0.0, 0.0), (10.0, 10.0)]).T
        # Without anchors, leave a margin in which the tag can move.
        margin = 0.0 if scene.anchors or not places else MARGIN_M
        corners = {"x": [x.min() - margin, x.max() + margin], "y": [y.min() - margin, y.max() + margin]}
        self._models.extent.data = {name: [float(value) for value in ends] for name, ends in corners.items()}

    def _draw_rays(self, scene: Scene) -> None:
        """Draw rays, circles and statuses of the tag of the selected pair."""
        rows = []
        symbols: dict[Status, list[dict[str, float]]] = {status: [] for status in Status}
        tag_id = None if self._selected is None else self._selected[1]
        tag = None if tag_id is None else scene.tag_of(tag_id)
        pose = None if tag is None else tag.pose
        for (anchor, other), history, sample in scene.latest():
            place = scene.anchors.get(anchor)
            if (
                other != tag_id
                or place is None
                or math.isnan(_drawable(sample.range_m))
                or _no_data(scene, history)
            ):
                continue
            height_m = 0.0 if pose is None else _finite(pose.z - place.z)
            raw_m, range_m = (
                math.sqrt(max(_finite(_drawable(value)) ** 2 - height_m * height_m, 0.0))
                for value in (sample.raw_m, sample.range_m)
            )
            x1, y1 = (place.x, place.y) if pose is None else (pose.x, pose.y)
            row = {"x": place.x, "y": place.y, "raw": raw_m, "range": range_m, "x1": x1, "y1": y1}
            rows.append(row | {"colour": self._colour(sample.status)})
            if pose is not None:
                symbols[sample.status].append({"x": (place.x + x1) / 2, "y": (place.y + y1) / 2})
        _set_rows(self._models.circles, rows)
        for status, points in symbols.items():
            if points or self._models.statuses[status].data["x"]:
                _set_rows(self._models.statuses[status], points)
                self._models.show_legend(status, bool(points))

    def _colour(self, status: Status) -> str:
        return STATUS_LOOKS[status].colour or (PAPER if self._dark else NIGHT)

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
            "compared": self._compared_ranges(samples),
        }
        self._models.strip.data = {name: np.array(column, np.float32) for name, column in values.items()}
        bad = [sample for sample in samples if sample.status is not Status.OK]
        _set_rows(
            self._models.bad,
            [
                {
                    "age": sample.time_s - now_s,
                    "range": _drawable(sample.range_m),
                    "marker": STATUS_LOOKS[sample.status].marker,
                    "colour": self._colour(sample.status),
                }
                for sample in bad
            ],
        )

    def _compared_ranges(self, samples: list[Sample]) -> list[float]:
        """Return the ranges of the second recording at the stamps of the first one."""
        second = (
            None if self._view.compared is None else self._view.compared.pairs.get(self._selected or (-1, -1))
        )
        known = (
            {} if second is None else {round(sample.time_s, 6): sample.range_m for sample in second.samples}
        )
        return [_drawable(known.get(round(sample.time_s, 6), math.nan)) for sample in samples]

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
            self._models.controls.nodes = [
                [name, *_level(status.level), status.message] for name, status in rows
            ]

    def _changed(self, name: str, value: object) -> bool:
        if name in self._drawn and self._drawn[name] == value:
            return False
        self._drawn[name] = value
        return True

    # Events ---------------------------------------------------------------------------------------------------

    def _on_command(self, _attribute: str, _old: object, command: Any) -> None:
        """Execute a command of the page; a browser may send anything."""
        try:
            name, arguments = str(command[0]), list(command[1])
            if name == "dark":
                self._dark = bool(arguments[0])
                self._models.set_dark(self._dark)
            elif name == "heat":
                self._models.heat_renderer.visible = bool(arguments[0])
                self._models.heat_scale.visible = bool(arguments[0])
            elif name == "select":
                pair = int(str(arguments[0]), 0), int(str(arguments[1]), 0)
                if pair in self._view.scene.pairs:
                    self.select(pair)
            elif self._view.player is not None:
                self._control_player(self._view.player, name, arguments)
            elif name == "play":
                self._paused = not bool(arguments[0])
        except (LookupError, TypeError, ValueError, OverflowError):
            return
        self._drawn.pop("scene", None)
        if not self._paused:
            self.draw()
        else:
            self._draw_player()

    def _control_player(self, player: BagPlayer, name: str, arguments: list[Any]) -> None:
        timeline = player.timeline
        pair = None
        if name == "play":
            player.play(bool(arguments[0]))
        elif name == "seek" and math.isfinite(position_s := float(arguments[0])):
            player.seek(position_s)
        elif name == "speed" and float(arguments[0]) in SPEEDS:
            player.speed = float(arguments[0])
        elif name == "step":
            player.step()
        elif name == "next_bad" and timeline is not None:
            pair = player.jump(timeline.next_bad(player.position_s))
        elif name == "largest" and timeline is not None:
            pair = player.jump(timeline.largest_error())
        if pair is not None:
            self._selected = pair
        self._table_due_s = 0.0

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


def _level(level: int) -> tuple[str, str]:
    """Return name and symbol of a diagnostic level."""
    return (LEVELS[level], LEVEL_SYMBOLS[level]) if 0 <= level < len(LEVELS) else ("?", "?")


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
