"""The report of a recording: the state of the page at its end."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import Any

from uwb_mitigation.files import write_atomically
from uwb_mitigation.mitigation.correction import Corrector
from uwb_mitigation.positioning.config import EstimatorConfig
from uwb_mitigation.viewer.feed import SceneUpdater
from uwb_mitigation.viewer.models import FIGURES
from uwb_mitigation.viewer.playback import BagPlayer, Check
from uwb_mitigation.viewer.report import draw_scene, render_report
from uwb_mitigation.viewer.scene import Scene
from uwb_mitigation.viewer.state import View

SHOWN = "map", "positions", "errors", "distribution"


def write_report(
    path: Path,
    bag: Path,
    config: EstimatorConfig,
    backend: Callable[[], Corrector],
    stamp_offset_s: float = 0.0,
    check: Check | None = None,
) -> None:
    """Write the state of the page at the end of a recording.

    Args:
        path: the file.
        bag: the recording.
        config: of the estimators.
        backend: see `BagPlayer`.
        stamp_offset_s: see `BagPlayer.index`.
        check: see `BagPlayer.index`.

    Raises:
        RecordingError: the bag cannot be read.
    """
    feed = SceneUpdater(Scene(), Lock())
    player = BagPlayer(bag, feed, backend)
    feed.anchors(config.anchors)
    player.index(config, stamp_offset_s, check).join()
    player.seek(player.seconds)
    while player.is_behind:
        player.advance()
    models = draw_scene(View(feed.scene, feed.lock, player=player, missing=player.missing))
    controls = models.controls
    state, reason, action, facts = controls.verdict
    lines = [f"Position {state}" + (f": {reason}. {action}" if reason else ""), facts, *controls.notice]
    sections: dict[str, Any] = {"Figures": [("", "", ""), *controls.cards]}
    sections |= {FIGURES[name]: models.figures[name] for name in SHOWN}
    sections["Anchors at the end"] = [
        ("state", "anchor", "rate, Hz", "NLOS, %", "residual, m", "lost, %", "advice"), *controls.health,
    ]  # fmt: skip
    sections["Tags at the end"] = [
        ("tag", "x, y, z, m", "\u03c3, m", "age", "ranges, Hz"),
        *controls.tag_rows,
    ]
    write_atomically(path, render_report(bag.name, lines, sections))
