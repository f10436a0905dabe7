"""A recording as one HTML file: figures and texts as on the page of the viewer."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from threading import Lock

from bokeh.embed import file_html
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

SHOWN = {name: FIGURES[name] for name in ("map", "timeline", "errors")}


def write_report(
    path: Path,
    bag: Path,
    config: EstimatorConfig,
    backend: Callable[[], Corrector],
    stamp_offset_s: float = 0.0,
) -> None:
    """Write the state of the page at the end of a recording, with the complete tracks; the file needs no other one.

    Args:
        path: the file.
        bag: the recording.
        config: of the estimators.
        backend: see `BagPlayer`.
        stamp_offset_s: added to the stamps of the ranges.

    Raises:
        RecordingError: the bag cannot be read.
    """
    scene = Scene()
    feed = SceneUpdater(scene, Lock())
    player = BagPlayer(bag, feed, backend)
    feed.anchors(config.anchors)
    player.index(config, stamp_offset_s).join()
    player.seek(player.seconds)
    while player.is_behind:
        player.advance()
    models = Models(player.seconds)
    state = PageState(View(scene, feed.lock, player=player, missing=player.missing), models)
    state.selected, state.trail_s = next((pair for pair, _, _ in scene.latest()), None), math.inf
    Texts(state).draw(scene)
    Figures(state).draw(scene)
    # On the page, its script selects the labels.
    labels = [
        (*row, -13) for row in zip(*(models.anchors.data[name] for name in ("x", "y", "label")), strict=True)
    ]
    labels += [
        (*row, -4) for row in zip(*(models.tags.data[name] for name in ("x", "label_y", "name")), strict=True)
    ]
    models.labels.data = dict(zip(models.labels.data, zip(*labels, strict=True), strict=True))
    if player.timeline is not None:
        models.timeline.data = player.timeline.mean_errors(player.seconds)
    variables = {"controls": models.controls, "shown": SHOWN, "heading": bag.name}
    figures, template = [models.figures[name] for name in SHOWN], TEMPLATES.get_template("report.html.j2")
    html = file_html(figures, INLINE, bag.name, template=template, template_variables=variables)
    write_atomically(path, html)
