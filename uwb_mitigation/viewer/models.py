"""The Bokeh models of one page: figures and tables, and the data sources that a page fills from a scene."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import (
    ColorBar,
    ColumnDataSource,
    DataRange1d,
    DataTable,
    Div,
    FixedTicker,
    HTMLTemplateFormatter,
    LinearColorMapper,
    Range1d,
    Slider,
    TableColumn,
    TapTool,
    Toggle,
)
from bokeh.plotting import figure

from uwb_mitigation.viewer.scene import HISTORY_S, WATERFALL

TRACE_BEFORE, TRACE_AFTER = 20, 180
"""Number of samples shown before and after the first path."""

RAW, CORRECTED, TRUE, SMOOTHED = "#94a3b8", "#2563eb", "#111827", "#0f766e"
_MARK, _WINDOW = "#b91c1c", "#fde68a"


COLUMNS = (
    ("anchor", "anchor", 64, "text", None),
    ("tag", "tag", 64, "text", None),
    ("rate", "Hz", 46, "1", None),
    ("raw", "raw", 54, "3", None),
    ("range", "corrected", 66, "3", None),
    ("sigma", "sigma", 50, "3", None),
    ("correction", "correction", 70, "bar", None),
    ("status", "status", 160, "status", None),
    ("anchor", "pair", 76, "pair", "stacked"),
    ("range", "corrected, raw", 92, "ranges", "stacked"),
    ("correction", "correction, \u03c3", 90, "corrections", "stacked"),
    ("status", "status", 98, "broken", "stacked"),
)
"""Columns of the table: field, title, width, JavaScript function that renders the cells, and name. A narrow page
shows the columns with a name, a wide page the others."""


class Models:
    """All Bokeh models of a page; the attributes are the models that it updates and subscribes to.

    Args:
        seconds: duration of the recording; None: live, without a slider.
    """

    def __init__(self, seconds: float | None) -> None:
        self.pairs = _source(
            "anchor", "tag", "rate", "raw", "range", "sigma", "status", "colour", "row_colour", "correction"
        )
        self.anchors = _source("x", "y", "name", "id")
        self.tags = _source("x", "y", "name", "width", "height", "angle", "colour")
        self.tracks, self.true_tracks = _source("xs", "ys", "colour"), _source("xs", "ys")
        # The map shows these corners until the user changes the view; it must not follow the data.
        self.extent = _source("x", "y")
        self.circles = _source("x", "y", "raw", "range", "colour", "x1", "y1")
        self.strip = _source("age", "raw", "range", "true")
        self.trace = _source("sample", "magnitude")
        self.marks = _source("noise", "first", "top", "from", "to")
        self.waterfall = ColumnDataSource({"image": [blank_waterfall()]})
        self.errors = _source("left", "right", "raw", "corrected")
        # A figure without data has no axis ranges: invisible corners define them until data arrives.
        self.corners = {name: _source("corner_x", "corner_y") for name in ("cir", "strip")}
        self.summary, self.notice, self.node_statuses = (
            Div(text="", sizing_mode="stretch_width", disable_math=True) for _ in range(3)
        )
        self.pause = Toggle(label="Pause", width=90)
        self.slider = None if seconds is None else _slider(seconds)
        self.map_figure = self._map()
        self.strip_figure, self.cir_figure = self._strip(), self._cir()
        self.roots = {
            "summary": self.summary,
            "notice": self.notice,
            "pause": self.pause,
            "map": self.map_figure,
            "pairs": self._pairs_table(),
            "node_statuses": self.node_statuses,
            "cir": self.cir_figure,
            "waterfall": self._waterfall(),
            "strip": self.strip_figure,
            "errors": self._errors(),
        } | ({} if self.slider is None else {"slider": self.slider})
        for name, model in self.roots.items():
            model.name = name
        for name, corners in self.corners.items():
            self.roots[name].scatter("corner_x", "corner_y", source=corners, size=0, alpha=0)

    def show_empty(self, name: str, empty: bool) -> None:
        """Set the invisible corners of a figure of `corners` if it is empty, otherwise remove them."""
        corners = [0.0, 10.0] if empty else []
        if self.corners[name].data["corner_x"] != corners:
            self.corners[name].data = {"corner_x": corners, "corner_y": corners}

    def _map(self) -> figure:
        plot = _figure("Map", 480, "x, m", "y, m", match_aspect=True, tools="pan,wheel_zoom,reset,save")
        # Fixed borders: tick labels of another width would resize the frame and change the view.
        plot.min_border_left, plot.min_border_right = 70, 20
        unfilled = {"source": self.circles, "fill_color": None}
        extent = plot.scatter("x", "y", source=self.extent, size=0, alpha=0)
        plot.x_range, plot.y_range = DataRange1d(renderers=[extent]), DataRange1d(renderers=[extent])
        plot.circle("x", "y", radius="raw", line_color=RAW, line_width=1, **unfilled)
        plot.circle("x", "y", radius="range", line_color="colour", line_width=2.5, **unfilled)
        plot.segment(
            "x", "y", "x1", "y1", source=self.circles, line_color="colour", line_width=1, line_dash="dotted"
        )
        plot.multi_line("xs", "ys", source=self.tracks, line_color="colour", line_width=1.5)
        plot.multi_line(
            "xs", "ys", source=self.true_tracks, line_color=TRUE, line_width=1, line_dash="dashed"
        )
        plot.ellipse(
            "x", "y", width="width", height="height", angle="angle", source=self.tags,
            fill_color="colour", fill_alpha=0.15, line_color="colour",
        )  # fmt: skip
        plot.scatter("x", "y", source=self.tags, size=8, color="colour")
        anchors = plot.scatter(
            "x", "y", source=self.anchors, marker="triangle", size=12, color=TRUE, nonselection_alpha=0.8,
            selection_line_color=CORRECTED, selection_line_width=3,
        )  # fmt: skip
        plot.text(
            "x", "y", "name", source=self.anchors, x_offset=9, y_offset=-6, text_font_size="12px",
            nonselection_text_alpha=1.0,
        )  # fmt: skip
        plot.text("x", "y", "name", source=self.tags, x_offset=9, y_offset=6, text_font_size="12px")
        tap = TapTool(renderers=[anchors])
        plot.add_tools(tap)
        plot.toolbar.active_tap = tap
        return plot

    def _cir(self) -> figure:
        plot = _figure("CIR", 260, "samples (1 ns) from the first path", "magnitude")
        plot.x_range = Range1d(-TRACE_BEFORE, TRACE_AFTER)
        plot.quad(
            left="from", right="to", bottom=0, top="top", source=self.marks,
            fill_color=_WINDOW, fill_alpha=0.35, line_color=None, legend_label="read by the network",
        )  # fmt: skip
        plot.line("sample", "magnitude", source=self.trace, line_color=CORRECTED, line_width=1.2)
        plot.segment(
            "first", 0, "first", "top", source=self.marks,
            line_color=_MARK, line_width=1.5, legend_label="first path",
        )  # fmt: skip
        plot.hspan(
            "noise", source=self.marks, line_color=RAW, line_dash="dashed", legend_label="noise threshold"
        )
        return _with_legend(plot)

    def _waterfall(self) -> figure:
        title = f"Its last {WATERFALL} exchanges"
        plot = _figure(title, 220, "samples (1 ns) from the first path", "exchanges ago")
        plot.x_range = Range1d(-TRACE_BEFORE, TRACE_AFTER)
        plot.y_range = Range1d(WATERFALL, 0)
        levels = LinearColorMapper("Viridis256", low=0, high=255)
        # Anchor the image at its first row, the newest, because the axis points down.
        plot.image(
            "image", x=-TRACE_BEFORE, y=0, dw=TRACE_BEFORE + TRACE_AFTER, dh=WATERFALL,
            source=self.waterfall, color_mapper=levels,
        )  # fmt: skip
        scale = {0: "-40", 127.5: "-20", 255: "0"}
        plot.add_layout(
            ColorBar(
                color_mapper=levels, ticker=FixedTicker(ticks=list(scale)), major_label_overrides=scale,
                title="dB of peak", width=8, padding=4, major_tick_line_color=None,
            ),
            "right",
        )  # fmt: skip
        return plot

    def _strip(self) -> figure:
        plot = _figure("Range", 260, "seconds", "m")
        plot.x_range = Range1d(-HISTORY_S, 0)
        for column, looks in (
            ("raw", {"line_color": RAW, "legend_label": "raw"}),
            ("range", {"line_color": CORRECTED, "line_width": 2, "legend_label": "corrected"}),
            ("true", {"line_color": TRUE, "line_dash": "dashed", "legend_label": "true"}),
        ):
            plot.line("age", column, source=self.strip, **looks)
        return _with_legend(plot)

    def _errors(self) -> figure:
        plot = _figure("Error where the truth is known", 260, "measured - true, m", "ranges")
        for column, colour in (("raw", RAW), ("corrected", CORRECTED)):
            plot.quad(
                left="left", right="right", bottom=0, top=column, source=self.errors,
                fill_color=colour, fill_alpha=0.5, line_color=colour, legend_label=column,
            )  # fmt: skip
        return _with_legend(plot)

    def _pairs_table(self) -> DataTable:
        return DataTable(
            source=self.pairs,
            columns=[
                TableColumn(
                    field=field,
                    title=title,
                    width=width,
                    formatter=HTMLTemplateFormatter(template=cell),
                    name=name,
                    visible=name is None,
                )
                for field, title, width, cell, name in COLUMNS
            ],
            index_position=None,
            sortable=False,
            reorderable=False,
            editable=False,
            # Otherwise each update would scroll the table back to the selection.
            scroll_to_selection=False,
            height=290,
            sizing_mode="stretch_width",
            autosize_mode="force_fit",
        )


def blank_waterfall() -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return the image without any CIR, uint8 (WATERFALL, samples shown)."""
    return np.zeros((WATERFALL, TRACE_BEFORE + TRACE_AFTER), np.uint8)


def _source(*names: str) -> ColumnDataSource:
    return ColumnDataSource({name: [] for name in names})


def _slider(seconds: float) -> Slider:
    return Slider(
        start=0.0,
        end=max(round(seconds, 1), 0.1),
        value=0.0,
        step=0.1,
        title=f"Time in the recording, s of {seconds:.1f}",
        sizing_mode="stretch_width",
    )


def _figure(title: str, height: int, x: str, y: str, **options: Any) -> figure:
    options.setdefault("tools", "pan,wheel_zoom,box_zoom,reset,save")
    plot = figure(
        title=title, height=height, min_width=200, sizing_mode="stretch_width", x_axis_label=x, y_axis_label=y,
        output_backend="canvas", **options,
    )  # fmt: skip
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    return plot


def _with_legend(plot: figure) -> figure:
    """Move the legend to the line of the title, where it covers no data."""
    plot.add_layout(plot.legend[0], "above")
    plot.legend.orientation = "horizontal"
    plot.legend.label_text_font_size = "11px"
    plot.legend.padding = plot.legend.margin = 0
    plot.legend.border_line_color = None
    return plot
