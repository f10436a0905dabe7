"""Reports: one HTML file each, with figures and texts as on the page of the viewer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from bokeh.embed import file_html
from bokeh.plotting import figure
from bokeh.resources import INLINE

from uwb_mitigation.viewer.drawing import Figures
from uwb_mitigation.viewer.models import Models
from uwb_mitigation.viewer.page import TEMPLATES
from uwb_mitigation.viewer.state import PageState, View
from uwb_mitigation.viewer.texts import Texts

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
