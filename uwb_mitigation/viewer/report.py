"""Reports: one HTML file each, with figures and texts as on the page of the viewer."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import Lock
from typing import Any

from bokeh.embed import file_html
from bokeh.plotting import figure
from bokeh.resources import INLINE

from uwb_mitigation.files import write_atomically
from uwb_mitigation.mitigation.correction import Corrector
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.viewer.drawing import Figures
from uwb_mitigation.viewer.feed import SceneUpdater
from uwb_mitigation.viewer.models import FIGURES, Models
from uwb_mitigation.viewer.page import TEMPLATES
from uwb_mitigation.viewer.playback import BagPlayer
from uwb_mitigation.viewer.scene import Scene
from uwb_mitigation.viewer.state import PageState, View
from uwb_mitigation.viewer.texts import Texts

Rows = Sequence[Sequence[object]]
"""Rows of a table; the first one has the titles."""

SHOWN = "map", "timeline", "positions", "errors", "distribution"


def render_report(title: str, lines: Sequence[str], parts: Mapping[str, figure | Rows]) -> str:
    """Return an HTML page that needs no other file.

    Args:
        title: its heading.
        lines: paragraphs below it; text, or HTML as `markupsafe.Markup`.
        parts: {heading: figure or table}, with at least one figure.
    """
    figures = [part for part in parts.values() if isinstance(part, figure)]
    values = {"heading": title, "lines": lines, "parts": parts}
    template = TEMPLATES.get_template("report.html.j2")
    return str(file_html(figures, INLINE, title, template=template, template_variables=values))


def draw_scene(view: View) -> Models:
    """Return the figures and texts of a scene, with complete tracks and for its first pair."""
    models = Models(None if view.player is None else view.player.seconds)
    state = PageState(view, models)
    state.selected, state.trail_s = next((pair for pair, _, _ in view.scene.latest()), None), math.inf
    Texts(state).draw(view.scene)
    Figures(state).draw(view.scene)
    # On the page, its script selects the labels.
    anchors, tags = models.anchors.data, models.tags.data
    labels = [(*row, -13) for row in zip(anchors["x"], anchors["y"], anchors["label"], strict=True)]
    labels += [(*row, -4) for row in zip(tags["x"], tags["label_y"], tags["name"], strict=True)]
    columns = zip(*labels, strict=True) if labels else ((),) * 4
    models.labels.data = dict(zip(models.labels.data, columns, strict=True))
    return models


def write_report(
    path: Path,
    bag: Path,
    config: EstimatorConfig,
    backend: Callable[[], Corrector],
    stamp_offset_s: float = 0.0,
) -> None:
    """Write the state of the page at the end of a recording.

    Args:
        path: the file.
        bag: the recording.
        config: of the estimators.
        backend: see `BagPlayer`.
        stamp_offset_s: added to the stamps of the ranges.

    Raises:
        RecordingError: the bag cannot be read.
    """
    feed = SceneUpdater(Scene(), Lock())
    player = BagPlayer(bag, feed, backend)
    feed.anchors(config.anchors)
    player.index(config, stamp_offset_s).join()
    player.seek(player.seconds)
    while player.is_behind:
        player.advance()
    models = draw_scene(View(feed.scene, feed.lock, player=player, missing=player.missing))
    controls = models.controls
    state, reason, action, facts = controls.verdict
    lines = [f"Position {state}" + (f": {reason}. {action}" if reason else ""), facts, *controls.notice]
    parts: dict[str, Any] = {"Figures": [("", "", ""), *controls.cards]}
    parts |= {FIGURES[name]: models.figures[name] for name in SHOWN}
    parts["Anchors at the end"] = [
        ("state", "anchor", "rate, Hz", "NLOS, %", "residual, m", "lost, %", "advice"), *controls.health,
    ]  # fmt: skip
    parts["Tags at the end"] = [("tag", "x, y, z, m", "\u03c3, m", "age", "ranges, Hz"), *controls.tag_rows]
    write_atomically(path, render_report(bag.name, lines, parts))
