"""The Bokeh models of one page: figures and tables, and the sources that a page draws a scene into."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import (
    Button,
    CellFormatter,
    ColorBar,
    ColumnDataSource,
    CustomJS,
    DataTable,
    Div,
    FixedTicker,
    HTMLTemplateFormatter,
    LinearColorMapper,
    Range1d,
    Slider,
    StringFormatter,
    TableColumn,
    TapTool,
    Toggle,
)
from bokeh.plotting import figure

from uwb_mitigation.viewer.scene import STRIP_S, WATERFALL

TRACE_BEFORE, TRACE_AFTER = 20, 180
"""Samples before and after the first path that are shown."""

RAW, CORRECTED, TRUE = "#94a3b8", "#2563eb", "#111827"
_MARK, _WINDOW = "#b91c1c", "#fde68a"


def _digits(value: str, digits: int) -> str:
    """A number in a template; of what is too long for a column the magnitude."""
    near = f"Math.abs({value}) < 1e5 ? {value}.toFixed({digits})"
    return f"<%= {near} : isNaN({value}) ? '-' : {value}.toExponential(1) %>"


_BAR = (
    '<div style="position:relative;text-align:right"><div style="position:absolute;left:0;top:3px;bottom:3px;'
    'background:#bfdbfe;width:<%= Math.min(100, Math.abs(value) * 50) || 0 %>%"></div>'
    f'<span style="position:relative">{_digits("value", 3)}</span></div>'
)
_COLOURED = (
    '<span style="color:<%= colour %>;font-size:11px;font-weight:600;white-space:normal"><%- value %></span>'
)
_BROKEN = _COLOURED.replace("<%- value %>", '<%= value.replaceAll("_", "_<wbr>") %>')
"""Only numbers and names of ours reach these."""

STACKED = "stacked"
"""Name of the columns for a narrow box: the page shows these or the others."""


class Models:
    """Everything that a page consists of; the attributes are what it draws into and listens to.

    Args:
        seconds: length of a recording; None = live, without a slider.
    """

    def __init__(self, seconds: float | None) -> None:
        self.pairs = _source(
            "anchor", "tag", "rate", "raw", "range", "sigma", "status", "colour", "correction"
        )
        self.anchors = _source("x", "y", "name", "id")
        self.tags = _source("x", "y", "name", "width", "height", "angle")
        self.trails, self.true_trails = _source("xs", "ys"), _source("xs", "ys")
        self.circles = _source("x", "y", "raw", "range", "colour", "x1", "y1")
        self.strip = _source("age", "raw", "range", "true")
        self.trace = _source("sample", "magnitude")
        self.marks = _source("noise", "first", "top", "from", "to")
        self.waterfall = ColumnDataSource({"image": [blank_waterfall()]})
        self.errors = _source("left", "right", "raw", "corrected")
        # A figure without data would have no ranges: unseen corners stand in until some comes.
        self.corners = {name: _source("corner_x", "corner_y") for name in ("map", "cir", "strip")}
        self.summary, self.reports = (
            Div(text="", sizing_mode="stretch_width", disable_math=True) for _ in range(2)
        )
        self.pause = Toggle(label="Pause", width=90)
        self.screenshot = Button(label="Screenshot", width=110)
        self.screenshot.js_on_click(CustomJS(code="window.saveScreenshot()"))
        self.slider = None if seconds is None else _slider(seconds)
        self.strip_figure, self.cir_figure = self._strip(), self._cir()
        self.roots = {
            "summary": self.summary,
            "pause": self.pause,
            "screenshot": self.screenshot,
            "map": self._map(),
            "pairs": self._pairs_table(),
            "reports": self.reports,
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
        """Tell whether a figure of `corners` has nothing to show."""
        corners = [0.0, 10.0] if empty else []
        if self.corners[name].data["corner_x"] != corners:
            self.corners[name].data = {"corner_x": corners, "corner_y": corners}

    def _map(self) -> figure:
        plot = _figure("Map", 480, "x, m", "y, m", match_aspect=True, tools="pan,wheel_zoom,reset,save")
        unfilled = {"source": self.circles, "fill_color": None}
        plot.circle("x", "y", radius="raw", line_color=RAW, line_width=1, **unfilled)
        plot.circle("x", "y", radius="range", line_color="colour", line_width=2.5, **unfilled)
        plot.segment(
            "x", "y", "x1", "y1", source=self.circles, line_color="colour", line_width=1, line_dash="dotted"
        )
        plot.multi_line("xs", "ys", source=self.trails, line_color=CORRECTED, line_width=1.5)
        plot.multi_line(
            "xs", "ys", source=self.true_trails, line_color=TRUE, line_width=1, line_dash="dashed"
        )
        plot.ellipse(
            "x", "y", width="width", height="height", angle="angle", source=self.tags,
            fill_color=CORRECTED, fill_alpha=0.15, line_color=CORRECTED,
        )  # fmt: skip
        plot.scatter("x", "y", source=self.tags, size=8, color=CORRECTED)
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
        # By its first row, which is the newest; the axis runs downwards.
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
        plot.x_range = Range1d(-STRIP_S, 0)
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
        def number(digits: int) -> HTMLTemplateFormatter:
            return HTMLTemplateFormatter(
                template=f'<div style="text-align:right">{_digits("value", digits)}</div>'
            )

        return DataTable(
            source=self.pairs,
            columns=[
                _column("anchor", "anchor", 54, StringFormatter()),
                _column("tag", "tag", 54, StringFormatter()),
                _column("rate", "Hz", 46, number(1)),
                _column("raw", "raw", 54, number(3)),
                _column("range", "corrected", 66, number(3)),
                _column("sigma", "sigma", 50, number(3)),
                _column("correction", "correction", 76, HTMLTemplateFormatter(template=_BAR)),
                _column("status", "status", 166, HTMLTemplateFormatter(template=_COLOURED)),
                # The same for a narrow box.
                _stacked(
                    "anchor", "pair", 70, "<b><%= value %></b>", "tag <%= tag %>", f"{_digits('rate', 1)} Hz"
                ),
                _stacked("range", "corrected, raw", 98, f"<b>{_digits('value', 3)}</b>", _digits("raw", 3)),
                _stacked("correction", "correction, \u03c3", 90, _BAR, _digits("sigma", 3)),
                _stacked(
                    "status",
                    "status",
                    98,
                    f'<div style="text-align:left">{_BROKEN}</div>',
                ),
            ],
            index_position=None,
            sortable=False,
            reorderable=False,
            editable=False,
            # Ten times a second it would scroll back from where somebody reads.
            scroll_to_selection=False,
            height=290,
            sizing_mode="stretch_width",
            autosize_mode="force_fit",
        )


def blank_waterfall() -> np.ndarray[Any, np.dtype[np.uint8]]:
    """uint8 (WATERFALL, samples shown), of no CIR."""
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


def _column(
    field: str, title: str, width: int, formatter: CellFormatter, name: str | None = None
) -> TableColumn:
    return TableColumn(
        field=field, title=title, width=width, formatter=formatter, name=name, visible=name is None
    )


def _stacked(field: str, title: str, width: int, *lines: str) -> TableColumn:
    template = '<div style="line-height:16px;text-align:right">' + "".join(
        f"<div>{line}</div>" for line in lines
    )
    return _column(field, title, width, HTMLTemplateFormatter(template=template + "</div>"), STACKED)


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
    """Its legend beside the title's line, where it covers no data."""
    plot.add_layout(plot.legend[0], "above")
    plot.legend.orientation = "horizontal"
    plot.legend.label_text_font_size = "11px"
    plot.legend.padding = plot.legend.margin = 0
    plot.legend.border_line_color = None
    return plot
