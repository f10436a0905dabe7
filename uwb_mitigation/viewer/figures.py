"""The figures of one page: their Bokeh models, and what they show of a scene."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from bokeh import models
from bokeh.core.properties import value
from bokeh.models import BooleanFilter, CDSView, ColumnDataSource, DataRange1d, GroupFilter, Range1d
from bokeh.palettes import cividis
from bokeh.plotting import figure
from bokeh.plotting.contour import contour_data
from bokeh.transform import factor_cmap, factor_mark
from numpy.typing import NDArray

from uwb_mitigation.errors import format_id
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.positioning import health
from uwb_mitigation.positioning.health import NO_DATA_S
from uwb_mitigation.types.measurement import FAULTS, Encoding, Status
from uwb_mitigation.viewer import palette
from uwb_mitigation.viewer.headline import Positions
from uwb_mitigation.viewer.histories import HISTORY_S, MAX_RANGE_M
from uwb_mitigation.viewer.palette import BLUE, GREEN, GREY, NIGHT, PAPER, VERMILLION, TrackKind
from uwb_mitigation.viewer.scene import (
    ERROR_EDGES_M,
    Scene,
    finite_or_zero,
    plain_tag_id,
    tag_label,
)
from uwb_mitigation.viewer.state import PageState, columns_of, new_source, set_rows
from uwb_mitigation.viewer.verdict import LOOKS, STEPS_M, predicted_accuracy

HEADINGS = {
    "map": "Map",
    "strip": f"Range, last {HISTORY_S:.0f} s",
    "history": "Residual, rate and NLOS share",
    "positions": "Position error over time",
    "cir": "Last CIR",
    "errors": "Range errors",
    "distribution": "Cumulative distribution of the range errors",
}
"""Names and headings of the figures."""

_COMPARED = TrackKind.RAW, TrackKind.CORRECTED
_AGE = "time before now, s"

MAX_POINTS = 1200  # of a line
TRACE_BEFORE, TRACE_AFTER = 20, 180  # samples before and after the first path
HEIGHT = 380  # of the map, pixels, so that it is on the first screen
HEADING_M = 1.0  # length of the line that shows the heading of a tag
MAX_LABEL = 20  # characters of a name on the map
MARGIN_M = 5.0  # around a tag on a map without anchors
RANGE_SD_M = 0.1  # for the predicted accuracy if ranges have no standard deviation

Lines = Mapping[str, Mapping[str, Any]]
"""Styles of the lines of a figure, {column: style}."""

_SIDES = (0, -13, "center"), (14, 7, "left"), (-14, 7, "right"), (0, 28, "center")
"""Places of a name above, right, left and below of its mark: offsets (pixels) and alignment."""

_OPTIONAL = {
    "95 % ellipse": "width", "heading": "heading", "where its ranges fit": "fit_x",
}  # fmt: skip
"""Layers of the map, and their columns that are NaN where they have nothing to show."""


class Figures:
    """All figures of a page.

    Attributes:
        map: the map.
        plots: {name: figure}, see `HEADINGS`.
        position: mark of the position of the player.
    """

    def __init__(self, page: PageState) -> None:
        self.map, errors = Map(page), RangeErrors(page)
        over_time = Quality(page), PositionErrors(page)
        self._charts = self.map, Strip(page), LastCir(page), *over_time, errors
        self.plots = {chart.plot.name: chart.plot for chart in (*self._charts, errors.distribution)}
        self.position = models.Span(dimension="height", line_color=NIGHT, line_width=2)
        if page.view.player is not None:
            for chart in over_time:
                chart.plot.add_layout(self.position)

    def draw(self, scene: Scene) -> None:
        """Draw what has changed."""
        for chart in self._charts:
            chart.draw(scene)


class Chart:
    """A figure; without data, invisible corners define the ranges of its axes, and a message says what is missing.

    Args:
        page: state of its page.
        plot: the figure.
        source: its data; the first column is that of the horizontal axis.
        lines: its lines.
    """

    def __init__(self, page: PageState, plot: figure, source: ColumnDataSource, lines: Lines) -> None:
        self.page, self.plot, self.source = page, plot, source
        self._corners = self.plot.scatter([0.0, 10.0], [0.0, 10.0], size=0, alpha=0)
        for axis in (self.plot.x_range, self.plot.y_range):
            if isinstance(axis, DataRange1d):
                axis.only_visible = True
        first = next(iter(source.data))
        for column, style in lines.items():
            self.plot.line(first, column, source=source, **{"line_width": 2.0} | dict(style))
        finish(self.plot, *([first, *lines] if lines else []))

    def draw(self, scene: Scene) -> None:
        """Draw what has changed."""
        raise NotImplementedError

    def fill(self, table: NDArray[np.float64], message: str, source: ColumnDataSource | None = None) -> None:
        """Set the columns of a source if they have changed; a message, in place of missing data."""
        source, columns = source or self.source, table.T.astype(np.float32)
        # Before the data go: an axis needs data or corners at any moment.
        self._corners.visible |= bool(message)
        before = [np.asarray(column, np.float32) for column in source.data.values()]
        if not all(map(partial(np.array_equal, equal_nan=True), columns, before)):
            source.data = dict(zip(source.data, columns, strict=True))
        self._corners.visible = bool(message)
        self.page.set(empty=self.page.controls.empty | {self.plot.name: message})


class Strip(Chart):
    """Raw, corrected and true ranges of the selected pair in the last minute, and the statuses that need attention."""

    def __init__(self, page: PageState) -> None:
        lines = {kind.name.lower(): stroke(kind) for kind in (*_COMPARED, TrackKind.TRUE)}
        source, self._bad = new_source("age", *lines), new_source("age", "corrected", "status")
        plot = new_figure("strip", _AGE, "m", x_range=Range1d(-HISTORY_S, 0))
        super().__init__(page, plot, source, lines)
        self.plot.scatter("age", "corrected", source=self._bad, size=8, **status_marks())

    def draw(self, scene: Scene) -> None:
        page, now_s = self.page, scene.now_s(self.page.tag_id)
        ranges = page.history.columns
        columns = ranges.stamp_s - now_s, ranges.raw_m, ranges.corrected_m, ranges.true_m, ranges.status
        table = np.column_stack(columns)[ranges.stamp_s >= now_s - HISTORY_S]
        table[:, 1:][~(np.abs(table[:, 1:]) < MAX_RANGE_M)] = np.nan
        faults = table[np.isin(table[:, 4], FAULTS)][:, [0, 2, 4]]
        rows = [(age_s, range_m, Status(int(status)).name) for age_s, range_m, status in faults]
        set_rows(self._bad, rows)
        message = ""
        if not np.isfinite(table[:, 1]).any():
            interval = f" in the last {HISTORY_S:.0f} s" if len(page.history.rows) else " yet"
            message = f"No range of this pair{interval}."
        self.fill(thinned(table[:, :4], page.history.max_gap_s), message)


class Quality(Chart):
    """Residual, rate and NLOS share of the selected pair: in the recording, or in the last minute."""

    def __init__(self, page: PageState) -> None:
        looks = (BLUE, "solid", "default"), (GREY, "dashed", "share"), (VERMILLION, "dotted", "share")
        lines = {
            name: {"line_color": colour, "line_dash": dash, "y_range_name": axis, "legend_label": name}
            for name, (colour, dash, axis) in zip(("residual", "rate", "NLOS"), looks, strict=True)
        }
        plot = new_figure("history", y="residual, m", **_time_axis(page))
        plot.extra_y_ranges = {"share": Range1d(0, 100)}
        plot.add_layout(models.LinearAxis(y_range_name="share", axis_label="rate, Hz; NLOS, %"), "right")
        super().__init__(page, plot, new_source("age", *lines), lines)
        plot.y_range.renderers = [r for r in plot.renderers if r.y_range_name == "default"]

    def draw(self, scene: Scene) -> None:
        page = self.page
        now_s = scene.clock() if page.view.player is None else 0.0
        # All of it moves every second.
        if page.changed("history", (page.selected, math.floor(now_s), page.view.timeline.is_complete)):
            history = page.view.all_data.pairs.get(page.selected or (-1, -1)) or page.history
            table = history.quality() - (now_s, 0.0, 0.0, 0.0)
            message = "" if np.isfinite(table[:, 1]).any() else "No residuals of this pair yet."
            self.fill(thinned(table, page.history.max_gap_s), message)


class PositionErrors(Chart):
    """Errors of the positions of the selected tag with and without correction, with two standard deviations."""

    def __init__(self, page: PageState) -> None:
        source, self._raw = new_source("time", "error", "bound"), new_source("time", "raw")
        plot = new_figure("positions", y="m", **_time_axis(page))
        super().__init__(page, plot, source, {"error": stroke(TrackKind.CORRECTED)})
        band = {"fill_color": BLUE, "fill_alpha": 0.2, "legend_label": "2 standard deviations"}
        self.plot.varea("time", 0, "bound", source=source, **band)
        self.plot.line("time", "raw", source=self._raw, **stroke(TrackKind.RAW))

    def draw(self, scene: Scene) -> None:
        page, is_live = self.page, self.page.view.player is None
        live_s = math.floor(scene.clock()) if is_live else -1
        if not page.changed("positions", (page.tag_id, page.view.timeline.is_complete, live_s)):
            return
        positions = Positions(page.view, page.tag_id)
        table, raw = (positions.error_columns(kind) for kind in (TrackKind.CORRECTED, TrackKind.RAW))
        now_s = table[-1, 0] if is_live and len(table) else 0.0
        message = "" if np.isfinite(table[:, 1:]).any() else "No positions."
        self.plot.legend[0].items[0].label = value(scene.track_name)
        self.fill(thinned(table - (now_s, 0.0, 0.0), NO_DATA_S), message)
        self.fill(thinned(raw[:, :2] - (now_s, 0.0), NO_DATA_S), message, self._raw)


class LastCir(Chart):
    """The last CIR of the selected pair, with first path, noise and the input of the network."""

    def __init__(self, page: PageState) -> None:
        x_range = Range1d(-TRACE_BEFORE, TRACE_AFTER)
        plot = new_figure("cir", "samples (1 ns) from the first path", "magnitude", x_range=x_range)
        line = {"line_color": BLUE, "line_width": 1.2, "legend_label": "CIR"}
        super().__init__(page, plot, new_source("sample", "magnitude"), {"magnitude": line})
        self._marks = source = new_source("noise", "first", "from", "to")
        style = {"fill_color": GREEN, "fill_alpha": 0.15, "line_color": None, "legend_label": "network input"}
        self.plot.vstrip("from", "to", source=source, **style)
        style = {"line_color": VERMILLION, "line_width": 2, "legend_label": "first path"}
        self.plot.vspan("first", source=source, **style)
        self.plot.hspan("noise", source=source, line_color=GREY, line_dash="dashed", legend_label="noise")

    def draw(self, scene: Scene) -> None:
        page = self.page
        cir = page.cir
        message = ""
        if cir is None:
            message = "No CIRs: the source sends none, or no raw ranges are received."
            if page.view.timeline.cirs_ns or any(history.cir for history in scene.pairs.values()):
                message = "No CIR of this pair yet."
        marks, table = [], np.zeros((0, 2))
        if cir is not None:
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
        set_rows(self._marks, marks)
        self.fill(table, message)


class RangeErrors(Chart):
    """Histogram of the errors of the ranges with known truth; `distribution` has their cumulative shares."""

    def __init__(self, page: PageState) -> None:
        shares = {f"{kind.name.lower()}_share": stroke(kind) for kind in _COMPARED}
        source = new_source("right", "left", *(kind.name.lower() for kind in _COMPARED), *shares)
        y_range = DataRange1d(start=0.0, min_interval=1.0)
        super().__init__(page, new_figure("errors", "range error, m", "ranges", y_range=y_range), source, {})
        low, high = int(ERROR_EDGES_M[0]), int(ERROR_EDGES_M[-1])
        self.plot.xaxis.ticker = models.FixedTicker(ticks=[low, -0.5, 0, 0.5, 1, 1.5, high])
        self.plot.xaxis.major_label_overrides = {low: f"{low} or less", high: f"{high} or more"}
        for kind, hatch in zip(_COMPARED, ("/", None), strict=True):
            colour, _, _ = palette.TRACK_STYLES[kind]
            self.plot.quad(
                left="left", right="right", bottom=0, top=kind.name.lower(), source=source, color=colour, fill_alpha=0.35,
                hatch_pattern=hatch, hatch_color=colour, hatch_scale=8, legend_label=kind.value,
            )  # fmt: skip
        finish(self.plot, "left", "right", "raw", "corrected")
        axes = {"x_range": Range1d(float(low), float(high)), "y_range": Range1d(0, 100)}
        plot = new_figure("distribution", "range error, m", "share of ranges, %", **axes)
        self.distribution = Chart(page, plot, source, shares)

    def draw(self, scene: Scene) -> None:
        counts = scene.error_counts
        shares = 100.0 * np.cumsum(counts, axis=1) / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        table = np.stack([ERROR_EDGES_M[1:], ERROR_EDGES_M[:-1], *counts, *shares], axis=1)
        self.fill(table, "" if counts.any() else "No true ranges.")


class Map:
    """The map; without an action of the user, its view changes only for the first content and the first anchors.

    Attributes:
        plot: the figure.
        shows_accuracy: whether it shows the predicted accuracy.
    """

    def __init__(self, page: PageState) -> None:
        self.shows_accuracy = False
        self._page, self._fitted = page, (False, False, False)
        # Glyphs with NaN are not drawn: without a heading, for example.
        self._anchors = new_source(
            "x", "y", "name", "id", "health", "label", "ink", "paper", "fit_x", "fit_y"
        )
        self._tags = new_source("x", "y", "name", "colour", "width", "height", "angle", "heading")
        self._tracks = new_source("xs", "ys", "colour", "line_width", "dash", "kind")
        self._rays = new_source("x", "y", "x0", "y0", "x1", "y1", "status")
        self._accuracy = new_source("xs", "ys", "colour", "step")
        # The map shows these corners until the user changes the view; it must not follow the data.
        self._extent = new_source("x", "y")
        self.plot = plot = new_figure("map", "x, m", "y, m", HEIGHT, match_aspect=True)
        # Fixed borders: tick labels of another width, or a second row of the legend, would change frame and view.
        plot.min_border_left, plot.min_border_right, plot.min_border_top = 70, 20, 46
        extent = plot.scatter("x", "y", source=self._extent, size=0, alpha=0)
        plot.x_range, plot.y_range = DataRange1d(renderers=[extent]), DataRange1d(renderers=[extent])
        for glyph, source, style in self._layers():
            getattr(plot, glyph)(source=source, **style)
        named = [r for r in plot.renderers if isinstance(r.glyph, models.Text)]
        tips = [("", "@name"), ("x, y", "@x{0.00}, @y{0.00} m")]
        plot.add_tools(models.HoverTool(tooltips=tips, renderers=named))
        # States have a legend of their own, whose height never changes; a report without ranges has no states.
        (legend,), has_states = plot.legend, math.isfinite(page.trail_s) or len(page.view.scene.pairs) > 0
        states = [item for item in legend.items if getattr(item.label, "value", "") in LOOKS]
        self._items = legend.items = [item for item in legend.items if item not in states]
        plot.add_layout(models.Legend(items=states, visible=has_states), "below")
        finish(plot)

    def _layers(self) -> list[tuple[str, ColumnDataSource, dict[str, Any]]]:
        """Return the layers of the map, the lowest first: glyph, source and style."""
        marks = status_marks()
        # The script of the page selects the side of each name; without it, names are above.
        names = [
            ("text", source, {
                "text": column, "text_font_size": "12px", "text_color": ink, "x_offset": x, "y_offset": y, "text_align": align,
                "background_fill_color": paper, "background_fill_alpha": 0.8, "level": "annotation",
                "view": CDSView(filter=BooleanFilter(None if y < 0 else [])),
            })
            for source, column, ink, paper in (
                (self._anchors, "label", "ink", "paper"), (self._tags, "name", NIGHT, PAPER),
            )
            for x, y, align in _SIDES
        ]  # fmt: skip
        # The legend has all states, whatever the anchors have: it needs data, which are nowhere.
        nowhere, anchors = ColumnDataSource({"x": [math.nan], "y": [math.nan]}), []
        for state, (marker, colour) in LOOKS.items():
            outline = GREY if state == health.SILENT else NIGHT
            style = {"marker": marker, "size": 15, "line_color": outline, "fill_color": colour}
            view = CDSView(filter=GroupFilter(column_name="health", group=state))
            anchors.append(("scatter", self._anchors, style | {"view": view}))
            anchors.append(("scatter", nowhere, style | {"legend_label": state}))
        return [
            ("multi_polygons", self._accuracy, {
                "fill_color": "colour", "fill_alpha": 0.6, "line_color": None, "legend_field": "step",
            }),
            ("segment", self._rays, {"line_color": marks["color"], "line_alpha": 0.8}),
            ("multi_line", self._tracks, {
                "line_color": "colour", "line_width": "line_width", "line_dash": "dash", "legend_field": "kind",
            }),
            ("ellipse", self._tags, {
                "width": "width", "height": "height", "angle": "angle", "color": "colour", "fill_alpha": 0.25, "legend_label": "95 % ellipse",
            }),
            ("ray", self._tags, {
                "length": HEADING_M, "angle": "heading", "line_color": NIGHT, "line_width": 3, "legend_label": "heading",
            }),
            ("scatter", self._rays, marks | {"size": 7, "line_width": 2}),
            *anchors,
            ("segment", self._anchors, {
                "x0": "x", "y0": "y", "x1": "fit_x", "y1": "fit_y", "line_color": VERMILLION, "line_dash": "dotted", "line_width": 2,
            }),
            ("scatter", self._anchors, {
                "x": "fit_x", "y": "fit_y", "marker": "square_x", "size": 13, "fill_color": None, "line_color": VERMILLION, "line_width": 2,
                "legend_label": "where its ranges fit",
            }),
            ("scatter", self._tags, {
                "marker": "star", "size": 18, "fill_color": "colour", "line_color": NIGHT, "legend_label": "tag",
            }),
            *names,
        ]  # fmt: skip

    def draw(self, scene: Scene) -> None:
        """Draw what has changed."""
        self._draw_anchors(scene)
        self._draw_tags(scene)
        self._draw_tracks(scene)
        self._draw_rays(scene)
        self._draw_accuracy(scene)
        is_complete = self._page.view.timeline.is_complete
        fitted = is_complete, bool(scene.anchors), bool(scene.anchors or scene.tracks)
        if fitted > self._fitted or not self._extent.data["x"]:
            self._fitted = fitted
            self.fit(scene)
        # The legend shows only what the map contains.
        for item in self._items:
            data = item.renderers[0].data_source.data
            column = _OPTIONAL.get(getattr(item.label, "value", ""))
            item.visible = bool(np.isfinite(data[column]).any() if column else len(next(iter(data.values()))))

    def _draw_anchors(self, scene: Scene) -> None:
        page, displaced, rows = self._page, self._page.view.timeline.displaced, []
        # A report has no selection.
        selected = page.selected[0] if page.selected and math.isfinite(page.trail_s) else None
        # The selected one first: its name has priority.
        for identity in sorted(scene.anchors, key=lambda identity: identity != selected):
            anchor = scene.anchors[identity]
            state, residual_m = page.health.get(identity, (health.SILENT, math.nan))
            name = anchor.name or format_id(identity)
            label = name[:MAX_LABEL] + (
                f" {state[0]}" if state not in (health.UNKNOWN, health.SILENT) else ""
            )
            fit = math.nan, math.nan
            if identity in displaced:
                label += " not here"
                fit = displaced[identity][1].position[:2]
            elif state in (health.BAD, health.CHECK) and abs(residual_m) >= health.LONG_M:
                # Rounded, so that the map is not drawn again for every range.
                label += f" {residual_m:+.1f} m"
            # The label of the selected one is white on black.
            colours = (PAPER, NIGHT) if identity == selected else (NIGHT, PAPER)
            rows.append((*anchor.position[:2], name, str(identity), state, label, *colours, *fit))
        set_rows(self._anchors, rows)

    def _draw_tags(self, scene: Scene) -> None:
        rows = []
        plain_id, colours = plain_tag_id(scene.tags, scene.pairs), palette.tag_colours(scene.tags)
        for tag, pose in scene.tags.items():
            age_s, name, colour = scene.age_s(pose), tag_label(tag, plain_id), colours[tag]
            if age_s > NO_DATA_S:
                name, colour = f"{name}: no data for {age_s:.0f} s", GREY
            # A huge one would make all others invisible.
            major, minor, angle = pose.ellipse if pose.ellipse[0] < MAX_RANGE_M else (math.nan,) * 3
            rows.append((pose.x, pose.y, name, colour, 2 * major, 2 * minor, angle, pose.heading_rad))
        set_rows(self._tags, rows)

    def _draw_tracks(self, scene: Scene) -> None:
        colours = palette.tag_colours(scene.tags)
        tracks = [
            (kind, name, track)
            for kind in palette.TRACK_STYLES
            for (name, track_kind), track in scene.tracks.items()
            if track_kind is kind and len(track.rows)
        ]
        state = [
            (kind, name, len(track.rows), track.received_s, math.floor(scene.age_s(track)), colours.get(name))
            for kind, name, track in tracks
        ]
        if self._page.changed("tracks", state):
            rows = []
            for kind, name, track in tracks:
                (colour, *style), label = palette.TRACK_STYLES[kind], kind.value
                if kind is TrackKind.CORRECTED:
                    colour, label = colours.get(name, BLUE), scene.track_name
                rows.append((*self._trail(track.rows, scene.age_s(track)).T, colour, *style, label))
            self._tracks.data = columns_of(self._tracks, rows)

    def _trail(self, track: NDArray[np.float64], age_s: float) -> NDArray[np.float32]:
        """Return x and y of the displayed time of a track whose last point has an age, float32 (k, 2)."""
        begin = np.searchsorted(track[:, 0], track[-1, 0] + age_s - self._page.trail_s)
        return thinned(track[begin:, :3], NO_DATA_S)[:, 1:].astype(np.float32)

    def _draw_rays(self, scene: Scene) -> None:
        """Draw rays with statuses from the anchors to the tag of the selected pair."""
        tag_id, rows = self._page.tag_id, []
        pose = None if tag_id is None else scene.tag_of(tag_id)
        for (anchor_id, of_tag), history, sample in scene.latest():
            place = scene.anchors.get(anchor_id)
            if of_tag == tag_id and pose and place and not scene.no_data(history):
                x, y, _ = place.position
                middle = (x + pose.x) / 2, (y + pose.y) / 2
                rows.append((*middle, x, y, pose.x, pose.y, sample.status.name))
        set_rows(self._rays, rows)

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
        self._accuracy.data = columns_of(self._accuracy, rows)

    def fit(self, scene: Scene) -> None:
        """Fit the view of the map to its current content."""
        places = [anchor.position[:2] for anchor in scene.anchors.values()]
        places += [(pose.x, pose.y) for pose in scene.tags.values()]
        for track in list(self._page.view.all_data.tracks.values()):
            places += np.percentile(track.rows[:, 1:3], (2, 98), axis=0).tolist() if len(track.rows) else []
        places += [anchor.position[:2] for _, anchor in self._page.view.timeline.displaced.values()]
        corners = np.array(places or [(0.0, 0.0), (10.0, 10.0)])
        low, high = corners.min(axis=0), corners.max(axis=0)
        # A margin for ellipses and labels; without anchors, one in which the tag can move.
        margin = 0.15 * float((high - low).max()) if scene.anchors or not places else MARGIN_M
        low, high = low - margin, high + margin
        self._extent.data = {name: [float(low[i]), float(high[i])] for i, name in enumerate("xy")}


def new_figure(name: str, x: str, y: str, height: int = 230, **options: Any) -> figure:
    """Return an empty figure with the style of the page; `x`, `y`: titles of its axes."""
    tools = "pan,wheel_zoom,reset,save" + ("" if options.get("match_aspect") else ",box_zoom")
    plot = figure(
        name=name, height=height, min_width=200, sizing_mode="stretch_width", x_axis_label=x, y_axis_label=y, tools=tools,
        **options,
    )  # fmt: skip
    plot.toolbar.update(logo=None, autohide=True)
    return plot


def finish(plot: figure, *columns: str) -> None:
    """Put the legend next to the plot, where it covers no data; show values of columns next to the pointer."""
    if columns:
        tips = [(name.replace("_", " "), f"@{name}{{0.000}}") for name in columns]
        shown = next(r for r in plot.renderers if isinstance(r.glyph, (models.Line, models.Quad)))
        plot.add_tools(models.HoverTool(tooltips=tips, mode="vline", renderers=[shown]))
    for legend in plot.legend:
        if legend in plot.center:
            plot.add_layout(legend, "above")
        legend.update(
            orientation="horizontal", label_text_font_size="11px", padding=0, margin=0, spacing=8, location="left",
            border_line_color=None, glyph_height=14, label_height=14,
        )  # fmt: skip


def _time_axis(page: PageState) -> dict[str, Any]:
    """Return the options of a figure of the whole recording, or of the last minute of live topics."""
    if (player := page.view.player) is None:
        return {"x": _AGE, "x_range": Range1d(-HISTORY_S, 0)}
    return {"x": "time in the recording, s", "x_range": Range1d(0.0, max(player.seconds, 0.1))}


def stroke(kind: TrackKind) -> dict[str, Any]:
    """Return style and legend of the lines of a kind."""
    colour, width, dash = palette.TRACK_STYLES[kind]
    return {"line_color": colour, "line_width": width, "line_dash": dash, "legend_label": kind.value}


def status_marks() -> dict[str, Any]:
    """Return marker and colour of marks whose column `status` has the name of a status."""
    names = [status.name for status in palette.STATUS_LOOKS]
    markers, colours = zip(
        *((look.marker, look.colour or NIGHT) for look in palette.STATUS_LOOKS.values()), strict=True
    )
    colour = factor_cmap("status", colours, names, nan_color=GREY)
    return {"marker": factor_mark("status", markers, names), "color": colour, "legend_field": "status"}


def thinned(table: NDArray[np.float64], gap_s: float) -> NDArray[np.float64]:
    """Return rows of a line whose first column is the time: about `MAX_POINTS`, at equal steps, interrupted by gaps."""
    rows = np.arange(len(table))[:: -max(1, -(-len(table) // MAX_POINTS))][::-1]
    gaps = np.cumsum(np.diff(table[:, 0], prepend=table[:1, 0]) > gap_s)
    return np.insert(table[rows], np.flatnonzero(np.diff(gaps[rows])) + 1, np.nan, axis=0)
