"""The Bokeh models of one page: its figures, the data sources that a page fills from a scene, and the state of its controls."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.core.properties import Any as AnyValue
from bokeh.model import DataModel, Model
from bokeh.models import (
    ColorBar,
    ColumnDataSource,
    DataRange1d,
    FixedTicker,
    Legend,
    LegendItem,
    LinearColorMapper,
    Range1d,
    TapTool,
)
from bokeh.plotting import figure

from uwb_mitigation.measurement import Status
from uwb_mitigation.viewer.floor_plan import FloorPlan
from uwb_mitigation.viewer.palette import (
    BLUE,
    GREEN,
    GREY,
    NIGHT,
    PAPER,
    PURPLE,
    STATUS_LOOKS,
    TRACK_COLOURS,
    VERMILLION,
    TrackKind,
)
from uwb_mitigation.viewer.scene import CELL_M, HISTORY_S, WATERFALL

TRACE_BEFORE, TRACE_AFTER = 20, 180
"""Number of samples shown before and after the first path."""

COLUMNS = (
    ("status", "status", "status of the last range"),
    ("range", "corrected, m", "last corrected range"),
    ("raw", "raw, m", "last measured range"),
    ("compared", "second, m", "last corrected range of the second recording"),
    ("sigma", "\u03c3, m", "standard deviation of the corrected range"),
    ("correction", "correction, m", "mean of measured minus corrected range"),
    ("spread", "spread, m", "standard deviation of the corrections"),
    ("innovation", "innovation, m", "mean of corrected range minus distance to the estimated position"),
    ("not_ok", "not OK, %", "share of ranges whose status is not OK"),
    ("nlos", "NLOS, %", "share of CIRs whose first path is 6 dB or more below the receive level"),
    ("rate", "rate, Hz", "ranges per second"),
    ("lost", "lost", "missing sequence numbers"),
    ("rx", "RX, dBm", "mean receive level"),
    ("fp", "FP, dBm", "mean level of the first path"),
)
"""Columns of the table of pairs after anchor and tag: field, title, description."""

FIGURES = {
    "map": "Map",
    "strip": "Range",
    "timeline": "Error over time",
    "cir": "CIR",
    "waterfall": f"Last {WATERFALL} CIRs",
    "errors": "Error histogram",
}
"""Names and headings of the figures."""


_LINES = {
    "raw": (VERMILLION, 1.0, "solid", "raw"),
    "range": (BLUE, 2.5, "solid", "corrected"),
    "corrected": (BLUE, 2.5, "solid", "corrected"),
    "compared": (PURPLE, 2.5, "dotted", TrackKind.COMPARED.value),
    "true": (None, 1.5, "dashed", "true"),
}
"""Colour, width, dashes and label of the columns of line charts; colour None: ink."""


class Controls(DataModel):  # type: ignore[misc]
    """State that the page's script shows, and its commands.

    Attributes:
        command: set by the script: name, arguments, and a number that makes it unique.
        summary, notice, nodes, player, selected, timeline: set by the server.
    """

    command = AnyValue(default=None)
    summary = AnyValue(default="")
    notice = AnyValue(default=[])
    nodes = AnyValue(default=[])
    player = AnyValue(default=None)
    selected = AnyValue(default=None)
    marks = AnyValue(default=None)


class Models:
    """All Bokeh models of a page; the attributes are the models that it updates and subscribes to.

    Args:
        seconds: duration of the recording; None: live.
        plan: floor plan; None: unknown.
        compares: whether the page compares two recordings.
    """

    def __init__(self, seconds: float | None, plan: FloorPlan | None = None, compares: bool = False) -> None:
        self._seconds, self._plan, self._compares = seconds, plan, compares
        self._ink: list[tuple[Any, str]] = []
        self.controls = Controls(name="controls")
        self.pairs = _source(
            "anchor", "tag", "symbol", "colour", "no_data", *(name for name, _, _ in COLUMNS)
        )
        self.anchors = _source("x", "y", "name", "id")
        self.tags = _source(
            "x", "y", "name", "width", "height", "angle", "protection", "heading", "heading_size", "colour"
        )
        self.tracks = {kind: _source("x", "y") for kind in TrackKind}
        self.heat = _source("x", "y", "mean")
        # The map shows these corners until the user changes the view; it must not follow the data.
        self.extent = _source("x", "y")
        self.circles = _source("x", "y", "raw", "range", "colour", "x1", "y1")
        self.statuses = {status: _source("x", "y") for status in Status}
        self.strip = _source("age", "raw", "range", "compared", "true")
        self.bad = _source("age", "range", "marker", "colour")
        self.trace = _source("sample", "magnitude")
        self.marks = _source("noise", "first", "top", "from", "to")
        self.waterfall = ColumnDataSource({"image": [blank_waterfall()]})
        self.errors = _source("left", "right", "raw", "corrected", "compared")
        self.timeline = _source("time", "raw", "corrected")
        self.compared_timeline = _source("time", "compared")
        self.position = _source("time", "low", "high")
        # A figure without data has no axis ranges: invisible corners define them until data arrives.
        self.corners = {name: _source("corner_x", "corner_y") for name in ("cir", "strip")}
        self.legend_items: dict[object, LegendItem] = {}
        self.figures = {"map": self._map(), "strip": self._strip(), "cir": self._cir()}
        self.figures |= {"waterfall": self._waterfall(), "errors": self._errors()}
        if seconds is not None:
            self.figures["timeline"] = self._timeline(seconds)
        for name, plot in self.figures.items():
            plot.name = name
        for name, corners in self.corners.items():
            self.figures[name].scatter("corner_x", "corner_y", source=corners, size=0, alpha=0)
        self.pairs.name = "pairs"
        self.set_dark(False)

    @property
    def roots(self) -> list[Any]:
        return [*self.figures.values(), self.pairs, self.controls]

    def show_empty(self, name: str, empty: bool) -> None:
        """Set the invisible corners of a figure of `corners` if it is empty, otherwise remove them."""
        corners = [0.0, 10.0] if empty else []
        if self.corners[name].data["corner_x"] != corners:
            self.corners[name].data = {"corner_x": corners, "corner_y": corners}

    def show_legend(self, key: object, shown: bool) -> None:
        """Show or hide an entry of the legend of the map."""
        if self.legend_items[key].visible != shown:
            self.legend_items[key].visible = shown

    def set_dark(self, dark: bool) -> None:
        """Use the colours of the dark or of the light page."""
        paper, ink = (NIGHT, PAPER) if dark else (PAPER, NIGHT)
        for plot in self.figures.values():
            plot.background_fill_color = plot.border_fill_color = paper
            plot.outline_line_color = GREY
            for axis in plot.axis:
                axis.axis_label_text_color = axis.major_label_text_color = ink
                axis.axis_line_color = axis.major_tick_line_color = axis.minor_tick_line_color = GREY
            plot.grid.grid_line_color = GREY
            plot.grid.grid_line_alpha = 0.25
            for legend in plot.legend:
                legend.background_fill_color, legend.label_text_color = paper, ink
        for model, attribute in self._ink:
            setattr(model, attribute, ink)

    def _inked(self, renderer: Any, *attributes: str) -> Any:
        """Draw these attributes of a glyph in the ink of the page."""
        glyphs = renderer.glyph, renderer.selection_glyph, renderer.nonselection_glyph
        self._ink += [(glyph, name) for glyph in glyphs if isinstance(glyph, Model) for name in attributes]
        return renderer

    def _map(self) -> figure:
        plot = _figure(540, "x, m", "y, m", match_aspect=True, tools="pan,wheel_zoom,reset")
        # Fixed borders: tick labels of another width would resize the frame and change the view.
        plot.min_border_left, plot.min_border_right = 70, 20
        extent = plot.scatter("x", "y", source=self.extent, size=0, alpha=0)
        plot.x_range, plot.y_range = DataRange1d(renderers=[extent]), DataRange1d(renderers=[extent])
        if (plan := self._plan) is not None:
            plot.image_url(
                url=[plan.url], x=[plan.x], y=[plan.y], w=[plan.width], h=[plan.height], angle=[plan.yaw],
                anchor="bottom_left",
            )  # fmt: skip
        self.heat_levels = levels = LinearColorMapper("Viridis256", low=0.0, high=1.0)
        self.heat_renderer = heat = plot.rect(
            "x", "y", width=CELL_M, height=CELL_M, source=self.heat, line_color=None, fill_alpha=0.8,
            fill_color={"field": "mean", "transform": levels}, name="heat", visible=False,
        )  # fmt: skip
        self.heat_scale = bar = ColorBar(
            color_mapper=levels, title="mean correction, m", width=10, padding=4, visible=False
        )
        self._ink += [(bar, "title_text_color"), (bar, "major_label_text_color")]
        bar.background_fill_alpha = 0.0
        plot.add_layout(bar, "right")
        for column, colour, width in (("raw", VERMILLION, 1.0), ("range", "colour", 2.5)):
            plot.circle(
                "x", "y", radius=column, source=self.circles, fill_color=None, line_color=colour,
                line_width=width, name=f"{column}_circles", visible=False,
            )  # fmt: skip
        plot.segment(
            "x", "y", "x1", "y1", source=self.circles, line_color="colour", line_width=1.2, line_alpha=0.8
        )
        items: list[tuple[object, str, list[Any]]] = [("heat", "mean correction", [heat])]
        for kind, width, dash in (
            (TrackKind.TRUE, 2.0, "dashed"),
            (TrackKind.RAW, 1.0, "solid"),
            (TrackKind.CORRECTED, 3.0, "solid"),
            (TrackKind.COMPARED, 3.0, "dotted"),
            (TrackKind.SMOOTHED, 2.0, "dotdash"),
        ):
            line = plot.line(
                "x",
                "y",
                source=self.tracks[kind],
                line_color=TRACK_COLOURS[kind] or NIGHT,
                line_width=width,
                line_dash=dash,
            )
            shown = [line if TRACK_COLOURS[kind] else self._inked(line, "line_color")]
            if kind is TrackKind.RAW:
                shown.append(
                    plot.scatter(
                        "x",
                        "y",
                        source=self.tracks[kind],
                        marker="cross",
                        size=5,
                        color=VERMILLION,
                        alpha=0.7,
                    )
                )
            items.append((kind, kind.value, shown))
        for status, look in STATUS_LOOKS.items():
            symbols = plot.scatter(
                "x", "y", source=self.statuses[status], marker=look.marker, size=10, color=look.colour or NIGHT,
                line_width=2 if look.marker == "x" else 0,
            )  # fmt: skip
            items.append(
                (status, status.name, [symbols if look.colour else self._inked(symbols, "line_color")])
            )
        ellipse = plot.ellipse(
            "x", "y", width="width", height="height", angle="angle", source=self.tags,
            fill_color="colour", fill_alpha=0.25, line_color="colour",
        )  # fmt: skip
        protection = self._inked(
            plot.circle("x", "y", radius="protection", source=self.tags, fill_color=None, line_dash="dotted"),
            "line_color",
        )
        self._inked(
            plot.ray("x", "y", length="heading_size", angle="heading", source=self.tags, line_width=3),
            "line_color",
        )
        tag = self._inked(
            plot.scatter("x", "y", source=self.tags, size=11, marker="star", fill_color="colour"),
            "line_color",
        )
        anchors = self._inked(
            plot.scatter(
                "x", "y", source=self.anchors, marker="triangle", size=14, line_width=0, nonselection_alpha=1.0,
                selection_line_color=GREEN, selection_line_width=5,
            ),
            "fill_color",
        )  # fmt: skip
        for source, y in ((self.anchors, -6), (self.tags, 18)):
            self._inked(
                plot.text(
                    "x", "y", "name", source=source, x_offset=9, y_offset=y, text_font_size="12px",
                    nonselection_text_alpha=1.0,
                ),
                "text_color",
            )  # fmt: skip
        items += [("tag", "tag", [tag]), ("ellipse", "95 % ellipse", [ellipse])]
        items += [("protection", "protection level", [protection]), ("anchors", "anchor", [anchors])]
        for key, label, renderers in items:
            self.legend_items[key] = LegendItem(
                label=label, renderers=renderers, visible=key in ("tag", "anchors")
            )
        legend = Legend(items=list(self.legend_items.values()), orientation="horizontal", ncols=3)
        plot.add_layout(legend, "below")
        _small_legend(plot)
        tap = TapTool(renderers=[anchors])
        plot.add_tools(tap)
        plot.toolbar.active_tap = tap
        return plot

    def _cir(self) -> figure:
        plot = _figure(230, "samples (1 ns) from the first path", "magnitude")
        plot.x_range = Range1d(-TRACE_BEFORE, TRACE_AFTER)
        plot.quad(
            left="from", right="to", bottom=0, top="top", source=self.marks,
            fill_color=GREEN, fill_alpha=0.15, line_color=None, legend_label="network input",
        )  # fmt: skip
        plot.line(
            "sample", "magnitude", source=self.trace, line_color=BLUE, line_width=1.2, legend_label="CIR"
        )
        plot.segment(
            "first", 0, "first", "top", source=self.marks,
            line_color=VERMILLION, line_width=2, legend_label="first path",
        )  # fmt: skip
        plot.hspan("noise", source=self.marks, line_color=GREY, line_dash="dashed", legend_label="noise")
        return _with_legend(plot)

    def _waterfall(self) -> figure:
        plot = _figure(230, "samples (1 ns) from the first path", "exchanges ago")
        plot.x_range = Range1d(-TRACE_BEFORE, TRACE_AFTER)
        plot.y_range = Range1d(WATERFALL, 0)
        levels = LinearColorMapper("Cividis256", low=0, high=255)
        # Anchor the image at its first row, the newest, because the axis points down.
        plot.image(
            "image", x=-TRACE_BEFORE, y=0, dw=TRACE_BEFORE + TRACE_AFTER, dh=WATERFALL,
            source=self.waterfall, color_mapper=levels,
        )  # fmt: skip
        scale = {0: "-40", 127.5: "-20", 255: "0"}
        bar = ColorBar(
            color_mapper=levels, ticker=FixedTicker(ticks=list(scale)), major_label_overrides=scale,
            title="dB of peak", width=8, padding=4, major_tick_line_color=None, background_fill_alpha=0.0,
        )  # fmt: skip
        self._ink += [(bar, "title_text_color"), (bar, "major_label_text_color")]
        plot.add_layout(bar, "right")
        return plot

    def _strip(self) -> figure:
        plot = _figure(230, "seconds", "m")
        plot.x_range = Range1d(-HISTORY_S, 0)
        self._lines(plot, self.strip, "age", "raw", "range", "compared", "true")
        plot.scatter("age", "range", source=self.bad, marker="marker", color="colour", size=8)
        return _with_legend(plot)

    def _timeline(self, seconds: float) -> figure:
        plot = _figure(170, "time in the recording, s", "mean |error|, m")
        plot.x_range = Range1d(0.0, max(seconds, 0.1))
        plot.y_range = DataRange1d(start=0.0)
        self._lines(plot, self.timeline, "time", "raw", "corrected")
        self._lines(plot, self.compared_timeline, "time", "compared")
        self._inked(plot.vspan("time", source=self.position, line_width=2), "line_color")
        return _with_legend(plot)

    def _lines(self, plot: figure, source: ColumnDataSource, x: str, *columns: str) -> None:
        for column in columns:
            colour, width, dash, label = _LINES[column]
            if column != "compared" or self._compares:
                line = plot.line(
                    x, column, source=source, line_color=colour or NIGHT, line_width=width, line_dash=dash, legend_label=label
                )  # fmt: skip
                if colour is None:
                    self._inked(line, "line_color")

    def _errors(self) -> figure:
        plot = _figure(230, "measured - true, m", "ranges")
        for column, colour, hatch in (
            ("raw", VERMILLION, "/"),
            ("corrected", BLUE, None),
            ("compared", PURPLE, "."),
        ):
            if column != "compared" or self._compares:
                plot.quad(
                    left="left", right="right", bottom=0, top=column, source=self.errors, fill_color=colour, fill_alpha=0.35,
                    line_color=colour, hatch_pattern=hatch, hatch_color=colour, hatch_scale=8,
                    legend_label=TrackKind.COMPARED.value if column == "compared" else column,
                )  # fmt: skip
        return _with_legend(plot)


def blank_waterfall() -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return the image without any CIR, uint8 (WATERFALL, samples shown)."""
    return np.zeros((WATERFALL, TRACE_BEFORE + TRACE_AFTER), np.uint8)


def _source(*names: str) -> ColumnDataSource:
    return ColumnDataSource({name: [] for name in names})


def _figure(height: int, x: str, y: str, **options: Any) -> figure:
    options.setdefault("tools", "pan,wheel_zoom,box_zoom,reset")
    plot = figure(
        height=height, min_width=200, sizing_mode="stretch_width", x_axis_label=x, y_axis_label=y,
        output_backend="canvas", **options,
    )  # fmt: skip
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    return plot


def _with_legend(plot: figure) -> figure:
    """Move the legend above the plot, where it covers no data."""
    plot.add_layout(plot.legend[0], "above")
    plot.legend.orientation = "horizontal"
    _small_legend(plot)
    return plot


def _small_legend(plot: figure) -> None:
    plot.legend.label_text_font_size = "11px"
    plot.legend.padding = plot.legend.margin = 0
    plot.legend.spacing = 8
    plot.legend.location = "left"
    plot.legend.border_line_color = None
