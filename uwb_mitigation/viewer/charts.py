"""How the figures of one page look: their data, axes and layers. `figures` fills them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bokeh import models
from bokeh.models import BooleanFilter, CDSView, ColumnDataSource, DataRange1d, Range1d
from bokeh.plotting import figure
from bokeh.transform import factor_cmap, factor_mark

from uwb_mitigation.positioning import health
from uwb_mitigation.viewer import palette
from uwb_mitigation.viewer.histories import HISTORY_S
from uwb_mitigation.viewer.palette import BLUE, GREEN, GREY, NIGHT, PAPER, VERMILLION, TrackKind
from uwb_mitigation.viewer.scene import ERROR_EDGES_M
from uwb_mitigation.viewer.state import PageState, View
from uwb_mitigation.viewer.verdict import LOOKS

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

SOURCES = {
    "anchors": "x y name id health label ink paper",
    "fits": "x y file_x file_y name",
    "tags": "x y name colour width height angle heading",
    "tracks": "xs ys colour line_width dash kind",
    "rays": "x y x0 y0 x1 y1 status legend",
    "accuracy": "xs ys colour step",
    "states": "x y health",
    "extent": "x y",
    "corners": "x y",
    "strip": "age raw corrected true",
    "faults": "age corrected status",
    "history": "age residual rate NLOS",
    "positions": "time error bound",
    "raw_positions": "time raw",
    "cir": "sample magnitude",
    "cir_marks": "noise first from to",
    "errors": "right left raw corrected raw_share corrected_share",
}
"""Columns of the data; those of lines begin with the column of the horizontal axis. Glyphs with NaN are not drawn."""

TIPS = {
    "positions": "time error",
    "errors": "left right raw corrected",
    "distribution": "right raw_share corrected_share",
}
"""Columns whose values are shown next to the pointer; of other figures, all of the source of the same name."""

TRACE_BEFORE, TRACE_AFTER = 20, 180  # samples before and after the first path
HEIGHT = 380  # of the map, pixels, so that it is on the first screen
HEADING_M = 1.0  # length of the line that shows the heading of a tag

_SIDES = (0, -13, "center"), (14, 7, "left"), (-14, 7, "right"), (0, 28, "center")
"""Places of a name above, right, left and below of its mark: offsets (pixels) and alignment."""

Layer = tuple[str, str, dict[str, Any]]
"""Glyph, source and style of a layer of a figure."""


def new_plots(page: PageState, sources: Mapping[str, ColumnDataSource]) -> dict[str, figure]:
    """Return the figures of a page by their names, with its `SOURCES`."""
    layers, plots = _layers(), dict[str, figure]()
    for name, axes in _axes(page.view).items():
        plots[name] = plot = new_figure(
            name, **{f"{axis}_range": DataRange1d(only_visible=True) for axis in "xy"} | axes
        )
        # Invisible corners: without data, they define the ranges of axes. The map shows only its own ones, until the user changes
        # the view; it must not follow the data.
        corners = sources["extent" if name == "map" else "corners"]
        plot.scatter("x", "y", source=corners, size=0, alpha=0)
        for glyph, source, style in layers[name]:
            getattr(plot, glyph)(source=sources[source], **style)
    share = models.LinearAxis(y_range_name="share", axis_label="rate, Hz; NLOS, %")
    plots["history"].add_layout(share, "right")
    residuals = [r for r in plots["history"].renderers if r.y_range_name == "default"]
    plots["history"].y_range.renderers = residuals
    low, high = int(ERROR_EDGES_M[0]), int(ERROR_EDGES_M[-1])
    plots["errors"].xaxis.ticker = models.FixedTicker(ticks=[low, -0.5, 0, 0.5, 1, 1.5, high])
    plots["errors"].xaxis.major_label_overrides = {low: f"{low} or less", high: f"{high} or more"}
    # Fixed borders: tick labels of another width, or a second row of the legend, would change frame and view.
    plots["map"].update(min_border_left=70, min_border_right=20, min_border_top=46)
    extent = plots["map"].renderers[:1]
    plots["map"].update(x_range=DataRange1d(renderers=extent), y_range=DataRange1d(renderers=extent))
    named = [r for r in plots["map"].renderers if isinstance(r.glyph, models.Text)]
    tips = [("", "@name"), ("x, y", "@x{0.00}, @y{0.00} m")]
    plots["map"].add_tools(models.HoverTool(tooltips=tips, renderers=named))
    # Without buttons: the script of the page calls them for the keys that are their names.
    for side in ("left", "right", "up", "down"):
        move = models.ClickPanTool(direction=side, name=f"Arrow{side.title()}", visible=False)
        plots["map"].add_tools(move)
    for kind, key, factor in ((models.ZoomInTool, "+", 0.2), (models.ZoomOutTool, "-", 0.25)):
        plots["map"].add_tools(kind(factor=factor, name=key, visible=False))
    # States have a legend of their own, whose height never changes; a report without ranges has no states.
    marks = [r for r in plots["map"].renderers if r.data_source is sources["states"]]
    items = [models.LegendItem(label=state, renderers=marks, index=row) for row, state in enumerate(LOOKS)]
    has_states = math.isfinite(page.trail_s) or len(page.view.scene.pairs) > 0
    plots["map"].add_layout(models.Legend(items=items, visible=has_states), "below")
    for name, plot in plots.items():
        finish(plot, *TIPS.get(name, SOURCES.get(name, "")).split())
    return plots


def _axes(view: View) -> dict[str, dict[str, Any]]:
    """Return titles and ranges of the axes of each figure."""
    last_minute = {"x": "time before now, s", "x_range": (-HISTORY_S, 0.0)}
    time, edges = last_minute, (ERROR_EDGES_M[0], ERROR_EDGES_M[-1])
    if view.player is not None:
        time = {"x": "time in the recording, s", "x_range": (0.0, max(view.player.seconds, 0.1))}
    trace = {"x": "samples (1 ns) from the first path", "x_range": (-TRACE_BEFORE, TRACE_AFTER)}
    share = {"y": "share of ranges, %", "x_range": edges, "y_range": (0, 100)}
    return {
        "map": {"x": "x, m", "y": "y, m", "height": HEIGHT, "match_aspect": True},
        "strip": {"y": "m", **last_minute},
        "history": {"y": "residual, m", "extra_y_ranges": {"share": Range1d(0, 100)}, **time},
        "positions": {"y": "m", **time},
        "cir": {"y": "magnitude", **trace},
        "errors": {
            "x": "range error, m",
            "y": "ranges",
            "y_range": DataRange1d(start=0.0, min_interval=1.0, only_visible=True),
        },
        "distribution": {"x": "range error, m", **share},
    }


def _layers() -> dict[str, list[Layer]]:
    """Return the layers of each figure, the lowest first; Bokeh needs new ones for each page."""
    looks = {
        status.name: (look.marker, look.colour or NIGHT) for status, look in palette.STATUS_LOOKS.items()
    }
    status, state = _marks("status", looks), _marks("health", LOOKS)
    status |= {"line_color": status["fill_color"], "legend_field": "status"}
    outlines = [GREY if name == health.SILENT else NIGHT for name in LOOKS]
    state |= {"line_color": factor_cmap("health", outlines, list(LOOKS)), "size": 15}
    fit = {"line_color": VERMILLION, "line_width": 2}
    raw, corrected, true = map(stroke, (TrackKind.RAW, TrackKind.CORRECTED, TrackKind.TRUE))
    # The script of the page selects the side of each name; without it, names are above.
    names: list[Layer] = [
        ("text", source, {
            "text": column, "text_font_size": "12px", "text_color": ink, "x_offset": x, "y_offset": y, "text_align": align,
            "background_fill_color": paper, "background_fill_alpha": 0.8, "padding": 3, "level": "annotation",
            "view": CDSView(filter=BooleanFilter(None if y < 0 else [])),
        })
        for source, column, ink, paper in (
            ("fits", "name", NIGHT, PAPER), ("anchors", "label", "ink", "paper"), ("tags", "name", NIGHT, PAPER),
        )
        for x, y, align in _SIDES
    ]  # fmt: skip
    bars: list[Layer] = [
        ("quad", "errors", {
            "left": "left", "right": "right", "bottom": 0, "top": kind.name.lower(), "color": palette.TRACK_STYLES[kind][0],
            "fill_alpha": 0.35, "hatch_pattern": hatch, "hatch_color": palette.TRACK_STYLES[kind][0], "hatch_scale": 8,
            "legend_label": kind.value,
        })
        for kind, hatch in ((TrackKind.RAW, "/"), (TrackKind.CORRECTED, None))
    ]  # fmt: skip
    return {
        "map": [
            ("multi_polygons", "accuracy", {
                "fill_color": "colour", "fill_alpha": 0.6, "line_color": None, "legend_field": "step",
            }),
            ("segment", "rays", {"line_color": status["line_color"], "line_alpha": 0.8}),
            ("multi_line", "tracks", {
                "line_color": "colour", "line_width": "line_width", "line_dash": "dash", "legend_field": "kind",
            }),
            ("ellipse", "tags", {
                "width": "width", "height": "height", "angle": "angle", "color": "colour", "fill_alpha": 0.25,
                "legend_label": "95 % ellipse",
            }),
            ("ray", "tags", {
                "length": HEADING_M, "angle": "heading", "line_color": NIGHT, "line_width": 3, "legend_label": "heading",
            }),
            ("scatter", "rays", status | {"size": 7, "line_width": 2, "legend_field": "legend"}),
            ("scatter", "anchors", state),
            # The legend has all states, whatever the anchors have.
            ("scatter", "states", state),
            ("segment", "fits", fit | {"x0": "file_x", "y0": "file_y", "x1": "x", "y1": "y", "line_dash": "dotted"}),
            ("scatter", "fits", fit | {
                "marker": "square", "size": 13, "fill_color": None, "legend_label": "where its ranges fit",
            }),
            ("scatter", "tags", {
                "marker": "star", "size": 18, "fill_color": "colour", "line_color": NIGHT, "legend_label": "tag",
            }),
            *names,
        ],
        "strip": [
            *_lines("strip", raw=raw, corrected=corrected, true=true),
            ("scatter", "faults", {"x": "age", "y": "corrected", "size": 8, **status}),
        ],
        "history": _lines(
            "history",
            residual={"line_color": BLUE, "legend_label": "residual"},
            rate={"line_color": GREY, "line_dash": "dashed", "y_range_name": "share", "legend_label": "rate"},
            NLOS={"line_color": VERMILLION, "line_dash": "dotted", "y_range_name": "share", "legend_label": "NLOS"},
        ),
        "positions": [
            *_lines("positions", error=corrected),
            ("varea", "positions", {
                "x": "time", "y1": 0, "y2": "bound", "fill_color": BLUE, "fill_alpha": 0.2, "legend_label": "2 standard deviations",
            }),
            *_lines("raw_positions", raw=raw),
        ],
        "cir": [
            *_lines("cir", magnitude={"line_color": BLUE, "line_width": 1.2, "legend_label": "CIR"}),
            ("vstrip", "cir_marks", {
                "x0": "from", "x1": "to", "fill_color": GREEN, "fill_alpha": 0.15, "line_color": None, "legend_label": "network input",
            }),
            ("vspan", "cir_marks", {"x": "first", "line_color": VERMILLION, "line_width": 2, "legend_label": "first path"}),
            ("hspan", "cir_marks", {"y": "noise", "line_color": GREY, "line_dash": "dashed", "legend_label": "noise"}),
        ],
        "errors": bars,
        "distribution": _lines("errors", raw_share=raw, corrected_share=corrected),
    }  # fmt: skip


def _lines(source: str, **styles: dict[str, Any]) -> list[Layer]:
    """Return lines for columns of a source."""
    x = SOURCES[source].split()[0]
    return [("line", source, {"x": x, "y": column, "line_width": 2.0, **styles[column]}) for column in styles]


def stroke(kind: TrackKind) -> dict[str, Any]:
    """Return style and legend of the lines of a kind."""
    colour, width, dash = palette.TRACK_STYLES[kind]
    return {"line_color": colour, "line_width": width, "line_dash": dash, "legend_label": kind.value}


def _marks(column: str, looks: Mapping[str, tuple[str, str]]) -> dict[str, Any]:
    """Return marker and colour of marks for each value in a column."""
    names, (markers, colours) = list(looks), zip(*looks.values(), strict=True)
    colour = factor_cmap(column, colours, names, nan_color=GREY)
    return {"marker": factor_mark(column, markers, names), "fill_color": colour}


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
    for layer in plot.renderers:
        # Nothing is selected or muted: a page without glyphs for that opens faster.
        layer.update(nonselection_glyph=layer.glyph, selection_glyph=layer.glyph, muted_glyph=layer.glyph)
    for legend in plot.legend:
        if legend in plot.center:
            plot.add_layout(legend, "above")
        legend.update(
            orientation="horizontal", label_text_font_size="11px", padding=0, margin=0, spacing=8, location="left",
            border_line_color=None, glyph_height=14, label_height=14,
        )  # fmt: skip
