"""Reports: one HTML file each, with figures and texts as on the page of the viewer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.embed import file_html
from bokeh.models import ColumnDataSource, FactorRange
from bokeh.plotting import figure
from bokeh.resources import INLINE

from uwb_mitigation.files import write_atomically
from uwb_mitigation.mitigation.correction import Corrector
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.positioning.recorded_tracks import TagTracks
from uwb_mitigation.viewer.charts import HEADINGS, finish, new_figure
from uwb_mitigation.viewer.figures import Figures
from uwb_mitigation.viewer.page import TEMPLATES
from uwb_mitigation.viewer.palette import TRACK_STYLES, TrackKind
from uwb_mitigation.viewer.playback import BagPlayer
from uwb_mitigation.viewer.scene import Displaced
from uwb_mitigation.viewer.state import Controls, PageState, View
from uwb_mitigation.viewer.texts import ANCHOR_TITLES, TAG_TITLES, Texts

SHOWN = "map", "positions", "errors", "distribution"
"""Figures of the report of a recording."""

_BOX = "low", "begin", "middle", "end", "high"

Rows = Sequence[Sequence[object]]
"""Rows of a table; the first one has the titles."""


def render_report(title: str, lines: Sequence[str], sections: Mapping[str, figure | Rows]) -> str:
    """Return an HTML page that needs no other file.

    Args:
        title: its heading.
        lines: paragraphs below it; text, or HTML as `markupsafe.Markup`.
        sections: {heading: figure or table}, with at least one figure.
    """
    figures = [section for section in sections.values() if isinstance(section, figure)]
    values = {"heading": title, "lines": lines, "sections": sections}
    template = TEMPLATES.get_template("report.html.j2")
    return str(file_html(figures, INLINE, title, template=template, template_variables=values))


def draw_scene(view: View) -> tuple[dict[str, figure], Controls]:
    """Return the figures and texts of a scene, with complete tracks and for its first pair."""
    state = PageState(view)
    state.selected, state.trail_s = next((pair for pair, _, _ in view.scene.latest()), None), math.inf
    figures = Figures(state)
    Texts(state).draw(view.scene)
    figures.draw(view.scene)
    return figures.plots, state.controls


def draw_boxes(name: str, axis: str, rows: Mapping[TrackKind, Mapping[str, Iterable[float]]]) -> figure:
    """Return a figure with a box for each row and kind.

    Args:
        name: of the figure.
        axis: title of the horizontal axis.
        rows: {kind: {row: ends of the lower line and of the box, middle, ends of the box and of the upper line}}.
    """
    names = list(next(iter(rows.values())))
    height = 90 + 20 * len(rows) * len(names)
    plot = new_figure(name, axis, "", height, y_range=FactorRange(*reversed(names)))
    for number, (kind, boxes) in enumerate(rows.items()):
        columns = np.array([list(box) for box in boxes.values()]).reshape(-1, len(_BOX))
        # Of each row, the first kind is the upper one.
        places = [(row, (0.5 * (len(rows) - 1) - number) / len(rows)) for row in boxes]
        source = ColumnDataSource(dict(zip(_BOX, columns.T, strict=True)) | {"row": places})
        style = {"source": source, "color": TRACK_STYLES[kind][0], "legend_label": kind.value}
        plot.segment("low", "row", "high", "row", **style)
        plot.hbar("row", right="end", left="begin", height=0.35, fill_alpha=0.35, **style)
        plot.scatter("middle", "row", marker="dash", angle=math.pi / 2, size=14, line_width=3, **style)
    finish(plot)
    return plot


def write_report(
    path: Path,
    bag: Path,
    config: EstimatorConfig,
    backend: Callable[[], Corrector],
    tracks: Sequence[TagTracks],
    displaced: Displaced,
    stamp_offset_s: float = 0.0,
) -> None:
    """Write the state of the page at the end of a recording.

    Args:
        path: the file.
        bag: the recording.
        config: of the estimators.
        backend: see `BagPlayer`.
        tracks: the tracks of its tags.
        displaced: see `Scene`.
        stamp_offset_s: see `BagPlayer.index`.

    Raises:
        RecordingError: the bag cannot be read.
    """
    player = BagPlayer(bag, backend)
    player.index(config, stamp_offset_s, lambda *_: displaced, tracks).join()
    if player.error is not None:
        raise player.error
    player.seek(player.seconds)
    figures, controls = draw_scene(View(player.scene, player=player))
    _, _, action, *facts = controls.verdict
    lines = [f"{controls.headline}. {action}", *filter(None, facts), *controls.notice]
    sections: dict[str, Any] = {"Figures": [("", "", ""), *controls.cards]}
    sections |= {HEADINGS[name]: figures[name] for name in SHOWN}
    sections["Anchors at the end"] = [ANCHOR_TITLES, *controls.health]
    sections["Tags at the end"] = [TAG_TITLES, *controls.tag_rows]
    write_atomically(path, render_report(bag.name, lines, sections))
