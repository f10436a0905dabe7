"""The Bokeh models of one page: its figures, the data sources that a page fills from a scene, and the state of its controls."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from bokeh.core.properties import Any as AnyValue
from bokeh.model import DataModel
from bokeh.models import (
    CategoricalColorMapper,
    ColorBar,
    ColumnDataSource,
    DataRange1d,
    FixedTicker,
    HoverTool,
    Legend,
    LegendItem,
    Line,
    LinearAxis,
    LinearColorMapper,
    Quad,
    Range1d,
)
from bokeh.palettes import cividis
from bokeh.plotting import figure
from bokeh.transform import factor_mark
from numpy.typing import NDArray

from uwb_mitigation.viewer.health import BAD, CHECK, GOOD, STATES, STEPS_M, UNKNOWN
from uwb_mitigation.viewer.histories import HISTORY_S, MAX_CIRS, RATE_RANGES, STATISTICS
from uwb_mitigation.viewer.palette import (
    BLUE,
    GREEN,
    GREY,
    NIGHT,
    ORANGE,
    PAPER,
    STATUS_LOOKS,
    TRACK_COLOURS,
    VERMILLION,
    TrackKind,
)
from uwb_mitigation.viewer.scene import ERROR_EDGES_M

TRACE_BEFORE, TRACE_AFTER = 20, 180
"""Number of samples shown before and after the first path."""

_RANGES, _CIRS = f"last {STATISTICS} ranges", f"last {MAX_CIRS} CIRs"

COLUMNS = {
    "state": ("state", "", STATES),
    "status": ("status", "last range", "whether the network could correct the range"),
    "raw": ("raw, m", "last range", "measured range"),
    "corrected": ("corrected, m", "last range", "corrected range"),
    "sigma": ("sd, m", "last range", "standard deviation of the corrected range"),
    "correction": ("correction, m", _RANGES, "mean of raw minus corrected range"),
    "residual": ("residual, m", _RANGES, "mean of corrected range minus distance to the estimated position"),
    "not_ok": ("not OK, %", _RANGES, "share of ranges whose status is not OK"),
    "nlos": (
        "NLOS, %",
        _CIRS,
        "no line of sight: share of CIRs with the first path 6 dB or more below the total",
    ),
    "rx": ("RX, dBm", _CIRS, "mean receive level"),
    "rate": ("rate, Hz", f"last {RATE_RANGES} ranges", "ranges per second"),
    "lost": ("lost, %", "all; in a recording: since the minute before", "share of missing sequence numbers"),
}
"""Columns of the table of pairs after anchor and tag: {field: (title, interval, description)}."""

FIGURES = {
    "map": "Map",
    "strip": f"Range, last {HISTORY_S:.0f} s",
    "history": "Residual, rate and NLOS share",
    "positions": "Position error over time",
    "cir": "Last CIR",
    "errors": "Range errors",
    "distribution": "Cumulative distribution of the range errors",
}
"""Names and headings of the figures."""

_STROKES = {
    TrackKind.RAW: (1.0, "solid"),
    TrackKind.CORRECTED: (3.0, "solid"),
    TrackKind.SMOOTHED: (2.0, "dotdash"),
    TrackKind.TRUE: (2.0, "dashed"),
}
"""Width and dashes of the lines of each kind, in drawing order."""

_SIZES = {"95 % ellipse": "width", "heading": "heading"}
"""Columns that are NaN if a tag has none."""

_COMPARED = TrackKind.RAW, TrackKind.CORRECTED

HEALTH_LOOKS = {
    GOOD: ("hex", GREEN),
    CHECK: ("square_pin", ORANGE),
    BAD: ("circle_x", VERMILLION),
    UNKNOWN: ("hex_dot", PAPER),
}
"""Marker and colour of an anchor for each state; statuses of ranges have other markers."""

MAP_HEIGHT = 380
"""So that the map is on the first screen, pixels."""

HEADING_M = 1.0
"""Length of the line that shows the heading of a tag."""


class Controls(DataModel):  # type: ignore[misc]
    """State that the page's script shows, and its commands.

    Attributes:
        command: set by the script: name, arguments, and a number that makes it unique.
        update: set by the server after each update: its number, how long the previous one took, and the age of the
            latest range by its reception and by its stamp, s; the age is negative if there are no recent ranges.
        acknowledged: set by the script to the number of the last update that it has drawn.
        verdict, notice, nodes, health, tag_rows, incidents, cards, player, selected, marks: set by the server.
        available: set by the server: whether a control has an effect, {id: bool}.
        empty: set by the server: messages of figures without data, {name: message}.
    """

    command = AnyValue(default=None)
    update = AnyValue(default=None)
    acknowledged = AnyValue(default=0)
    health = AnyValue(default=[])
    cards = AnyValue(default=[])
    verdict = AnyValue(default=[])
    tag_rows = AnyValue(default=[])
    incidents = AnyValue(default=[])
    available = AnyValue(default={})
    empty = AnyValue(default={})
    notice = AnyValue(default=[])
    nodes = AnyValue(default=[])
    player = AnyValue(default=None)
    selected = AnyValue(default=None)
    marks = AnyValue(default=None)


class Models:
    """All models of a page.

    Args:
        seconds: duration of the recording; None: live.

    Attributes:
        coverage: the map of the predicted accuracy and its legend, which are shown on request.
    """

    def __init__(self, seconds: float | None) -> None:
        names, looks = [status.name for status in STATUS_LOOKS], STATUS_LOOKS.values()
        colours = CategoricalColorMapper(
            factors=names, palette=[look.colour or NIGHT for look in looks], nan_color=GREY
        )
        self._colour = {"field": "status", "transform": colours}
        marker = factor_mark("status", [look.marker for look in looks], names)
        self._symbols = {"marker": marker, "color": self._colour}
        self.controls = Controls(name="controls")
        self.pairs = _source("anchor", "tag", "no_data", *COLUMNS)
        self.pairs.name = "pairs"
        self.anchors = _source("x", "y", "name", "id", "health", "label")
        self.selected = _source("x", "y")
        # Glyphs with NaN are not drawn: without a heading, for example.
        self.tags = _source("x", "y", "name", "status", "label_y", "width", "height", "angle", "heading")
        # The script of the page fills it with the names that do not cover each other.
        self.labels = _source("x", "y", "text", "offset", "shift")
        self.tracks = {kind: _source("x", "y") for kind in _STROKES}
        self.accuracy = _source("image", "x", "y", "dw", "dh")
        # The map shows these corners until the user changes the view; it must not follow the data.
        self.extent = _source("x", "y")
        self.rays = _source("x", "y", "x0", "y0", "x1", "y1", "status")
        self.strip = _source("age", "raw", "corrected", "true")
        self.bad = _source("age", "corrected", "status")
        self.trace = _source("sample", "magnitude")
        self.marks = _source("noise", "first", "from", "to")
        self.errors = _source("left", "right", "raw", "corrected", "raw_share", "corrected_share")
        self.history = _source("age", "residual", "rate", "NLOS")
        self.positions = _source("time", "error", "bound")
        self.raw_positions = _source("time", "raw")
        self.position = _source("time")
        # A figure without data has no axis ranges: invisible corners define them until data arrives.
        corners = "cir", "strip", "history", "positions", "errors"
        self.corners = {name: _source("corner_x", "corner_y") for name in corners}
        self.figures = {
            "map": self._map(), "strip": self._strip(), "history": self._history(seconds), "cir": self._cir(),
            "positions": self._positions(seconds), "errors": self._errors(), "distribution": self._distribution(),
        }  # fmt: skip
        if seconds is not None:
            for name in ("history", "positions"):
                self.figures[name].vspan("time", source=self.position, line_color=NIGHT, line_width=2)
        for name, plot in self.figures.items():
            plot.name = name
        for name, corners in self.corners.items():
            self.figures[name].scatter("corner_x", "corner_y", source=corners, size=0, alpha=0)
        history = self.figures["history"]
        history.y_range.renderers = [
            renderer for renderer in history.renderers if renderer.y_range_name == "default"
        ]

    @property
    def roots(self) -> list[Any]:
        return [*self.figures.values(), self.pairs, self.controls]

    def show_empty(self, name: str, message: str) -> None:
        """Set the message and the invisible corners of a figure of `corners` without data; empty: it has data."""
        corners = [0.0, 10.0] if message else []
        if self.corners[name].data["corner_x"] != corners:
            self.corners[name].data = {"corner_x": corners, "corner_y": corners}
        if self.controls.empty.get(name) != message:
            self.controls.empty = self.controls.empty | {name: message}

    def fill(self, name: str, source: ColumnDataSource, table: NDArray[np.float64], message: str) -> None:
        """Set the columns of a figure, which at no moment has neither data nor corners."""
        if message:
            self.show_empty(name, message)
        source.data = dict(zip(source.data, table.T.astype(np.float32), strict=True))
        self.show_empty(name, message)

    def update_legend(self) -> None:
        """Show the entries of the map's legend that the map contains."""
        for name, item in self._legend.items():
            columns = [r.data_source.data[_SIZES.get(name, "x")] for r in item.renderers if r.visible]
            shown = any(len(column) and not (name in _SIZES and np.isnan(column).all()) for column in columns)
            if item.visible != shown:
                item.visible = shown

    def _map(self) -> figure:
        plot = new_figure(MAP_HEIGHT, "x, m", "y, m", match_aspect=True, tools="pan,wheel_zoom,reset,save")
        # Fixed borders: tick labels of another width would resize the frame and change the view.
        plot.min_border_left, plot.min_border_right = 70, 20
        extent = plot.scatter("x", "y", source=self.extent, size=0, alpha=0)
        plot.x_range, plot.y_range = DataRange1d(renderers=[extent]), DataRange1d(renderers=[extent])
        clear, count = "#00000000", len(STEPS_M)
        accuracy = LinearColorMapper(cividis(count), low=-0.5, high=count - 0.5, nan_color=clear)
        labels = {step: f"\u2264 {limit_m:g}" for step, limit_m in enumerate(STEPS_M)}
        bar = ColorBar(
            color_mapper=accuracy, width=10, padding=4, title="predicted sd, m", visible=False,
            ticker=FixedTicker(ticks=list(labels)), major_label_overrides=labels,
        )  # fmt: skip
        plot.add_layout(bar, "right")
        image = plot.image("image", source=self.accuracy, color_mapper=accuracy, alpha=0.6, visible=False)
        self.coverage = image, bar
        items = defaultdict[str, list[Any]](list)
        for name, glyph, source, style in self._map_layers():
            items[name].append(getattr(plot, glyph)(source=source, **style))
        del items[""]
        named = items["anchor"] + items["tag"]
        plot.add_tools(HoverTool(tooltips=[("", "@name"), ("x, y", "@x{0.00}, @y{0.00} m")], renderers=named))
        legend: dict[str, Any] = {name: name for name in items} | {"status": {"field": "status"}}
        self._legend = {name: LegendItem(label=legend[name], renderers=items[name]) for name in items}
        plot.add_layout(Legend(items=list(self._legend.values())), "below")
        return finished(plot)

    def _map_layers(self) -> list[tuple[str, str, ColumnDataSource, dict[str, Any]]]:
        """Return the layers of the map, the lowest first: entry of the legend (empty: none), glyph, source and style."""
        tag = CategoricalColorMapper(factors=["OK"], palette=[BLUE], nan_color=GREY)
        looks = HEALTH_LOOKS
        anchor = CategoricalColorMapper(factors=list(looks), palette=[colour for _, colour in looks.values()])
        label = {
            "text": "text", "text_align": "center", "text_font_size": "12px", "text_color": NIGHT, "level": "annotation",
            "background_fill_color": PAPER, "background_fill_alpha": 0.8, "y_offset": "offset", "x_offset": "shift",
        }  # fmt: skip
        return [
            ("", "segment", self.rays, {"line_color": self._colour, "line_alpha": 0.8}),
            *((kind.value, "line", source, _stroke(kind)) for kind, source in self.tracks.items()),
            ("95 % ellipse", "ellipse", self.tags, {
                "width": "width", "height": "height", "angle": "angle", "color": BLUE, "fill_alpha": 0.25,
            }),
            ("heading", "ray", self.tags, {"length": HEADING_M, "angle": "heading", "line_color": NIGHT, "line_width": 3}),
            ("status", "scatter", self.rays, self._symbols | {"size": 10, "line_width": 2}),
            ("anchor", "scatter", self.anchors, {
                "marker": factor_mark("health", [marker for marker, _ in HEALTH_LOOKS.values()], list(HEALTH_LOOKS)),
                "size": 15, "line_color": NIGHT, "fill_color": {"field": "health", "transform": anchor},
            }),
            ("selected anchor", "scatter", self.selected, {
                "marker": "circle", "size": 22, "fill_color": None, "line_color": NIGHT, "line_width": 3,
            }),
            ("tag", "scatter", self.tags, {
                "marker": "star", "size": 18, "fill_color": {"field": "status", "transform": tag}, "line_color": NIGHT,
            }),
            ("", "text", self.labels, label),
        ]  # fmt: skip

    def _strip(self) -> figure:
        plot = new_figure(230, _AGE, "m", x_range=Range1d(-HISTORY_S, 0))
        names = self._lines(plot, self.strip, "age", *_COMPARED, TrackKind.TRUE)
        plot.scatter("age", "corrected", source=self.bad, size=8, legend_field="status", **self._symbols)
        return finished(plot, "age", *names)

    def _history(self, seconds: float | None) -> figure:
        plot = _time_figure(seconds, "residual, m")
        plot.extra_y_ranges = {"share": Range1d(0, 100)}
        plot.add_layout(LinearAxis(y_range_name="share", axis_label="rate, Hz; NLOS, %"), "right")
        for name, colour, dash, axis in (
            ("residual", BLUE, "solid", "default"), ("rate", GREY, "dashed", "share"), ("NLOS", VERMILLION, "dotted", "share"),
        ):  # fmt: skip
            style = {"line_color": colour, "line_dash": dash, "line_width": 2, "y_range_name": axis}
            plot.line("age", name, source=self.history, legend_label=name, **style)
        return finished(plot, "age", "residual", "rate", "NLOS")

    def _positions(self, seconds: float | None) -> figure:
        plot = _time_figure(seconds, "m")
        style = {"fill_color": BLUE, "fill_alpha": 0.2, "legend_label": "2 standard deviations"}
        plot.varea("time", 0, "bound", source=self.positions, **style)
        corrected = _stroke(TrackKind.CORRECTED) | {"legend_label": "corrected"}
        plot.line("time", "error", source=self.positions, **corrected)
        self._lines(plot, self.raw_positions, "time", TrackKind.RAW)
        return finished(plot, "time", "error", "bound")

    def _lines(
        self, plot: figure, source: ColumnDataSource, x: str, *kinds: TrackKind, suffix: str = ""
    ) -> list[str]:
        """Draw lines of a source; return their columns."""
        names = [kind.name.lower() + suffix for kind in kinds]
        for kind, name in zip(kinds, names, strict=True):
            plot.line(x, name, source=source, legend_label=kind.value, **_stroke(kind))
        return names

    def _cir(self) -> figure:
        plot = new_figure(230, _SAMPLES, "magnitude", x_range=Range1d(-TRACE_BEFORE, TRACE_AFTER))
        style = {"fill_color": GREEN, "fill_alpha": 0.15, "line_color": None, "legend_label": "network input"}
        plot.vstrip("from", "to", source=self.marks, **style)
        style = {"line_color": BLUE, "line_width": 1.2, "legend_label": "CIR"}
        plot.line("sample", "magnitude", source=self.trace, **style)
        plot.vspan("first", source=self.marks, line_color=VERMILLION, line_width=2, legend_label="first path")
        plot.hspan("noise", source=self.marks, line_color=GREY, line_dash="dashed", legend_label="noise")
        return finished(plot, "sample", "magnitude")

    def _errors(self) -> figure:
        plot = new_figure(230, "range error, m", "ranges", y_range=DataRange1d(start=0.0, min_interval=1.0))
        low, high = int(ERROR_EDGES_M[0]), int(ERROR_EDGES_M[-1])
        plot.xaxis.ticker = FixedTicker(ticks=[low, -0.5, 0, 0.5, 1, 1.5, high])
        plot.xaxis.major_label_overrides = {low: f"{low} or less", high: f"{high} or more"}
        for kind, hatch in zip(_COMPARED, ("/", None), strict=True):
            colour = TRACK_COLOURS[kind]
            plot.quad(
                left="left", right="right", bottom=0, top=kind.name.lower(), source=self.errors, color=colour, fill_alpha=0.35,
                hatch_pattern=hatch, hatch_color=colour, hatch_scale=8, legend_label=kind.value,
            )  # fmt: skip
        return finished(plot, "left", "right", "raw", "corrected")

    def _distribution(self) -> figure:
        plot = new_figure(230, "range error, m", "share of ranges, %", y_range=Range1d(0, 100))
        plot.x_range = Range1d(float(ERROR_EDGES_M[0]), float(ERROR_EDGES_M[-1]))
        names = self._lines(plot, self.errors, "right", *_COMPARED, suffix="_share")
        return finished(plot, "right", *names)


_SAMPLES, _AGE = "samples (1 ns) from the first path", "time before now, s"
_TIME = "time in the recording, s"


def _source(*columns: str) -> ColumnDataSource:
    return ColumnDataSource({column: [] for column in columns})


def new_figure(
    height: int, x: str, y: str, tools: str = "pan,wheel_zoom,box_zoom,reset,save", **options: Any
) -> figure:
    """Return an empty figure with the style of the page."""
    plot = figure(
        height=height, min_width=200, sizing_mode="stretch_width", x_axis_label=x, y_axis_label=y, tools=tools, **options
    )  # fmt: skip
    plot.toolbar.update(logo=None, autohide=True)
    return plot


def _time_figure(seconds: float | None, y: str) -> figure:
    """Return a figure of the whole recording, or of the last minute of live topics."""
    if seconds is None:
        return new_figure(230, _AGE, y, x_range=Range1d(-HISTORY_S, 0))
    return new_figure(230, _TIME, y, x_range=Range1d(0.0, max(seconds, 0.1)))


def _stroke(kind: TrackKind) -> dict[str, Any]:
    width, dash = _STROKES[kind]
    return {"line_color": TRACK_COLOURS[kind] or NIGHT, "line_width": width, "line_dash": dash}


def finished(plot: figure, *columns: str) -> figure:
    """Put the legend next to the plot, where it covers no data; show values of columns next to the pointer."""
    if columns:
        tips = [(name.replace("_", " "), f"@{name}{{0.000}}") for name in columns]
        first = [renderer for renderer in plot.renderers if isinstance(renderer.glyph, (Line, Quad))][:1]
        plot.add_tools(HoverTool(tooltips=tips, mode="vline", renderers=first))
    for legend in plot.legend:
        if legend in plot.center:
            plot.add_layout(legend, "above")
        legend.update(
            orientation="horizontal", label_text_font_size="11px", padding=0, margin=0, spacing=8, location="left",
            border_line_color=None, glyph_height=14, label_height=14,
        )  # fmt: skip
    return plot
