"""Fill the figures of one page from a scene."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from bokeh import models
from bokeh.core.properties import value
from bokeh.palettes import cividis
from bokeh.plotting.contour import contour_data
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.positioning import health
from uwb_mitigation.positioning.health import NO_DATA_S
from uwb_mitigation.types.measurement import FAULTS, Encoding, Status
from uwb_mitigation.viewer import palette
from uwb_mitigation.viewer.charts import SOURCES, TRACE_AFTER, TRACE_BEFORE, new_plots
from uwb_mitigation.viewer.headline import Positions
from uwb_mitigation.viewer.histories import HISTORY_S, MAX_RANGE_M
from uwb_mitigation.viewer.palette import BLUE, GREY, NIGHT, PAPER, TrackKind
from uwb_mitigation.viewer.scene import ERROR_EDGES_M, Scene, finite_or_zero, plain_tag_id, tag_label
from uwb_mitigation.viewer.state import PageState, columns_of, new_source, set_rows
from uwb_mitigation.viewer.verdict import LOOKS, STEPS_M, predicted_accuracy

MAX_POINTS = 1200  # of a line
MAX_LABEL = 20  # characters of a name on the map
MARGIN_M = 5.0  # around a tag on a map without anchors
RANGE_SD_M = 0.1  # for the predicted accuracy if ranges have no standard deviation

_OPTIONAL = {"95 % ellipse": "width", "heading": "heading"}
"""Layers of the map, and their columns that are NaN where they have nothing to show."""


class Figures:
    """All figures of a page.

    Without an action of the user, the view of the map changes only for the first content and the first anchors.

    Attributes:
        plots: {name: figure}, see `HEADINGS`.
        position: mark of the position of the player.
        shows_accuracy: whether the map shows the predicted accuracy.
    """

    def __init__(self, page: PageState) -> None:
        self._page, self._fitted, self.shows_accuracy = page, (False, False, False), False
        self._sources = {name: new_source(*columns.split()) for name, columns in SOURCES.items()}
        set_rows(self._sources["states"], [(math.nan, math.nan, state) for state in LOOKS])
        set_rows(self._sources["corners"], [(0.0, 0.0), (10.0, 10.0)])
        self.plots = new_plots(page, self._sources)
        self.position = models.Span(dimension="height", line_color=NIGHT, line_width=2)
        if page.view.player is not None:
            for name in ("history", "positions"):
                self.plots[name].add_layout(self.position)

    def draw(self, scene: Scene) -> None:
        """Draw what has changed."""
        self._draw_map(scene)
        self._draw_strip(scene)
        self._draw_cir(scene)
        self._draw_history(scene)
        self._draw_positions(scene)
        self._draw_errors()

    def _fill(self, name: str, table: NDArray[np.float64], message: str, source: str = "") -> None:
        """Set the columns of a source (default: of the same name) if they have changed; a message, in place of missing data."""
        source_of, columns = self._sources[source or name], table.T.astype(np.float32)
        corners = self.plots[name].renderers[0]
        # Before the data go: an axis needs data or corners at any moment.
        corners.visible |= bool(message)
        before = [np.asarray(column, np.float32) for column in source_of.data.values()]
        if not all(map(partial(np.array_equal, equal_nan=True), columns, before)):
            source_of.data = dict(zip(source_of.data, columns, strict=True))
        corners.visible = bool(message)
        self._page.controls.empty = self._page.controls.empty | {name: message}

    def _draw_strip(self, scene: Scene) -> None:
        """Draw the ranges of the selected pair in the last minute, and the statuses that need attention."""
        page, now_s = self._page, scene.now_s(self._page.tag_id)
        ranges = page.history.columns
        columns = ranges.stamp_s - now_s, ranges.raw_m, ranges.corrected_m, ranges.true_m, ranges.status
        table = np.column_stack(columns)[ranges.stamp_s >= now_s - HISTORY_S]
        table[:, 1:][~(np.abs(table[:, 1:]) < MAX_RANGE_M)] = np.nan
        faults = table[np.isin(table[:, 4], FAULTS)][:, [0, 2, 4]]
        rows = [(age_s, range_m, Status(int(status)).name) for age_s, range_m, status in faults]
        set_rows(self._sources["faults"], rows)
        message = ""
        if not np.isfinite(table[:, 1]).any():
            interval = f" in the last {HISTORY_S:.0f} s" if len(page.history.rows) else " yet"
            message = f"No range of this pair{interval}."
        self._fill("strip", thinned(table[:, :4], page.history.max_gap_s), message)

    def _draw_history(self, scene: Scene) -> None:
        """Draw the quality of the selected pair: in the recording, or in the last minute."""
        page = self._page
        now_s = scene.clock() if page.view.player is None else 0.0
        # All of it moves every second.
        if page.changed("history", (page.selected, math.floor(now_s), page.view.timeline.is_complete)):
            history = page.view.all_data.pairs.get(page.selected or (-1, -1)) or page.history
            table = history.quality() - (now_s, 0.0, 0.0, 0.0)
            message = "" if np.isfinite(table[:, 1]).any() else "No residuals of this pair yet."
            self._fill("history", thinned(table, page.history.max_gap_s), message)

    def _draw_positions(self, scene: Scene) -> None:
        """Draw the errors of the positions of the selected tag with and without correction."""
        page, is_live = self._page, self._page.view.player is None
        live_s = math.floor(scene.clock()) if is_live else -1
        if not page.changed("positions", (page.tag_id, page.view.timeline.is_complete, live_s)):
            return
        positions = Positions(page.view, page.tag_id)
        table, raw = (positions.errors(kind) for kind in (TrackKind.CORRECTED, TrackKind.RAW))
        now_s = table[-1, 0] if is_live and len(table) else 0.0
        message = "" if np.isfinite(table[:, 1:]).any() else "No positions."
        self.plots["positions"].legend[0].items[0].label = value(page.view.timeline.track_name)
        self._fill("positions", thinned(table - (now_s, 0.0, 0.0), NO_DATA_S), message)
        self._fill("positions", thinned(raw[:, :2] - (now_s, 0.0), NO_DATA_S), message, "raw_positions")

    def _draw_cir(self, scene: Scene) -> None:
        """Draw the last CIR of the selected pair, with first path, noise and the input of the network."""
        page, cir = self._page, self._page.cir
        marks, table, message = [], np.zeros((0, 2)), ""
        if cir is None:
            message = "No CIRs: the source sends none, or no raw ranges are received."
            if page.view.timeline.cirs_ns or any(history.cir for history in scene.pairs.values()):
                message = "No CIR of this pair yet."
        else:
            magnitude = cir.samples.astype(np.float32)
            if cir.encoding is Encoding.COMPLEX_INT16:
                magnitude = np.hypot(magnitude[0::2], magnitude[1::2])
            is_known = math.isfinite(cir.first_path_index)
            origin = math.floor(cir.first_path_index) if is_known else cir.start_index
            sample = np.arange(len(magnitude)) + (cir.start_index - origin)
            first = finite_or_zero(cir.first_path_index - origin)
            marks = [(cir.noise_threshold, first, -WINDOW_LEAD, page.view.window - WINDOW_LEAD)]
            is_shown = (sample >= -TRACE_BEFORE) & (sample < TRACE_AFTER)
            table = np.column_stack([sample, magnitude * np.float32(cir.scale)])[is_shown]
            message = "" if len(table) else "This CIR has no samples near its first path."
        set_rows(self._sources["cir_marks"], marks)
        self._fill("cir", table, message)

    def _draw_errors(self) -> None:
        """Draw histogram and cumulative shares of the errors of the ranges with known truth."""
        counts = self._page.view.timeline.error_counts
        shares = 100.0 * np.cumsum(counts, axis=1) / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        table = np.stack([ERROR_EDGES_M[1:], ERROR_EDGES_M[:-1], *counts, *shares], axis=1)
        self._fill("errors", table, "" if counts.any() else "No true ranges.")

    def _draw_map(self, scene: Scene) -> None:
        self._draw_anchors(scene)
        self._draw_tags(scene)
        self._draw_tracks(scene)
        self._draw_rays(scene)
        self._draw_accuracy(scene)
        is_complete = self._page.view.timeline.is_complete
        fitted = is_complete, bool(scene.anchors), bool(scene.anchors or scene.tracks)
        if fitted > self._fitted or not self._sources["extent"].data["x"]:
            self._fitted = fitted
            self.fit_map(scene)
        # The legend shows only what the map contains.
        for item in self.plots["map"].legend[0].items:
            data = item.renderers[0].data_source.data
            column = _OPTIONAL.get(getattr(item.label, "value", ""))
            item.visible = bool(np.isfinite(data[column]).any() if column else len(next(iter(data.values()))))

    def _draw_anchors(self, scene: Scene) -> None:
        page, displaced, rows, fits = self._page, self._page.view.timeline.displaced, [], []
        # A report has no selection.
        selected = page.selected[0] if page.selected and math.isfinite(page.trail_s) else None
        # The selected one first: its name has priority.
        for identity in sorted(scene.anchors, key=lambda identity: identity != selected):
            anchor = scene.anchors[identity]
            state, residual_m = page.health.get(identity, (health.SILENT, math.nan))
            name = anchor.name or format_id(identity)
            label = name[:MAX_LABEL]
            if state not in (health.UNKNOWN, health.SILENT):
                label += f" {state[0]}"
            if identity in displaced:
                fit = displaced[identity][1].position[:2]
                fits.append((*fit, *anchor.position[:2], f"{name[:MAX_LABEL]} ranges fit"))
                label += " file"
            elif state in (health.BAD, health.CHECK) and abs(residual_m) >= health.LONG_M:
                # Rounded, so that the map is not drawn again for every range.
                label += f" {residual_m:+.1f} m"
            colours = NIGHT, PAPER
            if identity == selected:
                label, colours = f"{label} selected", (PAPER, NIGHT)
            rows.append((*anchor.position[:2], name, str(identity), state, label, *colours))
        set_rows(self._sources["anchors"], rows)
        set_rows(self._sources["fits"], fits)

    def _draw_tags(self, scene: Scene) -> None:
        rows = []
        plain_id, colours = plain_tag_id(scene.tags, scene.pairs), palette.tag_colours(scene.tags)
        for tag, pose in scene.tags.items():
            age_s, name, colour = scene.age_s(pose), tag_label(tag, plain_id), colours[tag]
            if age_s > NO_DATA_S:
                name, colour = f"{name}: no data for {age_s:.0f} s", GREY
            # A huge one would make all others invisible.
            width_m = 2 * pose.major_m if pose.major_m < MAX_RANGE_M else math.nan
            ellipse = width_m, 2 * pose.minor_m, pose.angle_rad
            rows.append((pose.x, pose.y, name, colour, *ellipse, pose.heading_rad))
        set_rows(self._sources["tags"], rows)

    def _draw_tracks(self, scene: Scene) -> None:
        colours, kinds = palette.tag_colours(scene.tags), list(palette.TRACK_STYLES)
        tracks = [(*key, track) for key, track in scene.tracks.items() if len(track.rows)]
        tracks.sort(key=lambda item: kinds.index(item[1]))
        lengths = [(*key, len(track.rows), math.floor(scene.age_s(track.last))) for *key, track in tracks]
        ends_s = [track.last.received_s for *_, track in tracks]
        if self._page.changed("tracks", (lengths, ends_s, colours)):
            rows = []
            for name, kind, track in tracks:
                (colour, *style), label = palette.TRACK_STYLES[kind], kind.value
                if kind is TrackKind.CORRECTED:
                    colour, label = colours.get(name, BLUE), self._page.view.timeline.track_name
                begin_s = track.last.received_s + scene.age_s(track.last) - self._page.trail_s
                begin = np.searchsorted(track.columns.received_s, begin_s)
                line = thinned(track.rows[begin:, [-1, 0, 1]], NO_DATA_S)[:, 1:].astype(np.float32)
                rows.append((*line.T, colour, *style, label))
            self._sources["tracks"].data = columns_of(self._sources["tracks"], rows)

    def _draw_rays(self, scene: Scene) -> None:
        """Draw rays with statuses from the anchors to the tag of the selected pair."""
        tag_id, rows = self._page.tag_id, []
        pose = None if tag_id is None else scene.tag_of(tag_id)
        for (anchor_id, of_tag), history, sample in scene.latest():
            place = scene.anchors.get(anchor_id)
            if of_tag == tag_id and pose and place and not scene.no_data(history):
                x, y, _ = place.position
                middle, status = ((x + pose.x) / 2, (y + pose.y) / 2), sample.status.name
                rows.append((*middle, x, y, pose.x, pose.y, status, f"last range: {status}"))
        set_rows(self._sources["rays"], rows)

    def _draw_accuracy(self, scene: Scene) -> None:
        """Draw areas of the predicted accuracy if they are shown."""
        inputs, rows = None, list[tuple[Any, ...]]()
        if self.shows_accuracy and len(scene.anchors) > 1:
            anchors = np.nan_to_num([anchor.position for anchor in scene.anchors.values()])
            height_m = next((finite_or_zero(pose.z) for pose in scene.tags.values()), 0.0)
            sds_m = [sample.sigma_m for _, _, sample in scene.latest() if sample.sigma_m > 0.0]
            inputs = anchors.tobytes(), round(height_m, 1), round(float(np.median(sds_m or [RANGE_SD_M])), 2)
        if not self._page.changed("accuracy", inputs):
            return
        if inputs is not None:
            image = predicted_accuracy(anchors, height_m, inputs[-1])
            areas = contour_data(*image, [0.0, *STEPS_M], want_line=False).fill_data
            for xs, ys, limit_m in zip(areas.xs, areas.ys, areas.upper_levels, strict=True):
                colour = cividis(len(STEPS_M))[STEPS_M.index(limit_m)]
                rows.append((xs, ys, colour, f"sd \u2264 {limit_m:g} m"))
        self._sources["accuracy"].data = columns_of(self._sources["accuracy"], rows)

    def fit_map(self, scene: Scene) -> None:
        """Fit the view of the map to its current content."""
        places = [anchor.position[:2] for anchor in scene.anchors.values()]
        places += [(pose.x, pose.y) for pose in scene.tags.values()]
        for track in list(self._page.view.all_data.tracks.values()):
            places += np.percentile(track.rows[:, :2], (2, 98), axis=0).tolist() if len(track.rows) else []
        places += [anchor.position[:2] for _, anchor in self._page.view.timeline.displaced.values()]
        corners = np.array(places or [(0.0, 0.0), (10.0, 10.0)])
        low, high = corners.min(axis=0), corners.max(axis=0)
        # A margin for ellipses and labels; without anchors, one in which the tag can move.
        margin = 0.15 * float((high - low).max()) if scene.anchors or not places else MARGIN_M
        low, high = low - margin, high + margin
        self._sources["extent"].data = {name: [float(low[i]), float(high[i])] for i, name in enumerate("xy")}


def thinned(table: NDArray[np.float64], gap_s: float) -> NDArray[np.float64]:
    """Return rows of a line whose first column is the time: about `MAX_POINTS`, at equal steps, interrupted by gaps."""
    rows = np.arange(len(table))[:: -max(1, -(-len(table) // MAX_POINTS))][::-1]
    gaps = np.cumsum(np.diff(table[:, 0], prepend=table[:1, 0]) > gap_s)
    return np.insert(table[rows], np.flatnonzero(np.diff(gaps[rows])) + 1, np.nan, axis=0)
