"""One open page: its session, its commands, and when it is drawn."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from bokeh.document import Document
from bokeh.events import Reset

from uwb_mitigation.errors import format_id
from uwb_mitigation.types.measurement import FAULTS
from uwb_mitigation.viewer.charts import HEADINGS
from uwb_mitigation.viewer.figures import Figures
from uwb_mitigation.viewer.histories import Pair
from uwb_mitigation.viewer.palette import STATUS_LOOKS, TAG_COLOURS
from uwb_mitigation.viewer.scene import Scene
from uwb_mitigation.viewer.state import PageState, View
from uwb_mitigation.viewer.texts import COLUMNS, TAG_TITLES, Texts
from uwb_mitigation.viewer.verdict import LIMITS, STATES

REFRESH_S = 0.1
FAST_PAGES = 3
"""Number of pages that are drawn every `REFRESH_S`; more pages are drawn less often."""

TABLE_S = 0.5
"""Minimum interval of updates of the texts."""

HEARTBEAT_S = 1.0
"""Maximum interval of updates: a page without an update shows old data."""

TEMPLATES = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"))


class Page:
    """One open page. It draws at most ten times a second, and only what has changed.

    Args:
        document: the session's document; the page is added to it.
        nonce: nonce of the page's scripts for the Content-Security-Policy.
    """

    def __init__(self, document: Document, view: View, nonce: str = "") -> None:
        self._view, self._player = view, view.player
        self._sent, self._sent_s, self._took_s, self._redraw = 0, 0.0, 0.0, False
        self._due_s = self._table_due_s = 0.0
        self._paused = False
        player = view.player
        self._state = state = PageState(view)
        self._controls, self._texts, self._figures = state.controls, Texts(state), Figures(state)
        # Register before the model is added to the document: later registrations have no effect.
        self._figures.plots["map"].on_event(Reset, self._on_reset)
        # Add all roots in one step: Bokeh searches for new models after each, half of the time to open a page.
        with document.models.freeze():
            for model in (*self._figures.plots.values(), self._texts.pairs, self._controls):
                document.add_root(model)
        document.title = view.title
        document.template = TEMPLATES.get_template("page.html.j2")
        document.template_variables.update(
            page_title=view.title,
            recording=player is not None,
            nonce=nonce,
            columns=COLUMNS,
            states=STATES,
            limits=LIMITS,
            tag_titles=TAG_TITLES,
            figures=HEADINGS,
            tag_colours=TAG_COLOURS,
            looks=STATUS_LOOKS,
            speeds=player and player.SPEEDS,
        )
        document.config.update(reconnect_session=False, notify_connection_status=False, notifications=None)
        self._controls.on_change("command", self._on_command)
        self._controls.on_change("acknowledged", self._on_acknowledged)
        document.add_periodic_callback(self.tick, int(1000 * REFRESH_S))
        self.draw()
        # Register last: a session that could not be opened does not report its end.
        document.on_session_destroyed(self._on_closed)
        view.pages += 1

    @property
    def _is_waiting(self) -> bool:
        """Whether the page has not drawn the last update: another one would queue behind it and show old data."""
        return bool(self._sent != self._controls.acknowledged)

    def tick(self) -> None:
        """Draw if it is time, the page is not paused, and it has drawn the last update."""
        now_s = time.monotonic()
        if self._player is not None:
            self._player.advance()
        elif self._paused:
            return
        if now_s < self._due_s or self._is_waiting:
            return
        self.draw()
        self._due_s = now_s + REFRESH_S * (max(1.0, self._view.pages / FAST_PAGES) - 0.5)

    def draw(self) -> None:
        """Update every model from the scene, and number the update if anything has changed."""
        self._draw_player()
        player, scene = self._player, self._view.scene
        position = player and (player.shown_s, player.is_behind, self._view.timeline.is_read)
        with self._view.scene.lock:
            # Ages change without data; drawing them once a second is enough.
            state = scene.revision, self._state.selected, math.floor(scene.clock()), position
            is_changed = self._state.changed("scene", state)
            if is_changed:
                self._draw_scene(scene)
        now_s = time.monotonic()
        if is_changed or now_s > self._sent_s + HEARTBEAT_S:
            self._sent, self._sent_s, self._redraw = self._sent + 1, now_s, False
            age_s = scene.clock() - scene.received_s if self._state.has_data else -1.0
            self._controls.timing = [self._sent, round(self._took_s, 3), round(age_s, 3)]

    def _draw_scene(self, scene: Scene) -> None:
        state = self._state
        if state.selected is None:
            state.selected = next((pair for pair, _, _ in scene.latest()), None)
        self._controls.selected = state.selected and [*map(format_id, state.selected)]
        if (now_s := time.monotonic()) >= self._table_due_s:
            self._table_due_s = now_s + TABLE_S
            self._texts.draw(scene)
        else:
            state.forget("scene")
        self._figures.draw(scene)
        self._controls.available = {"accuracy": len(scene.anchors) > 1}

    def select(self, pair: Pair | None) -> None:
        """Show the CIR and the ranges of a pair, which may have no ranges yet."""
        if pair is not None and all(0 <= identity < 1 << 64 for identity in pair):
            self._state.selected = pair

    def _draw_player(self) -> None:
        player = self._player
        if player is None:
            self._controls.player = {"playing": not self._paused}
            return
        position_s = round(player.shown_s, 3)
        shown = {"playing": player.playing, "speed": player.speed, "behind": player.is_behind}
        self._controls.player = shown | {"position": position_s, "seconds": player.seconds}
        self._figures.position.location = position_s
        timeline, seconds = self._view.timeline, max(player.seconds, 1e-9)
        if timeline.is_read and self._state.changed("marks", timeline.is_complete):
            recorded = timeline.incidents
            ranges = [history.columns for history in timeline.pairs.values()]
            bad_s = [columns.received_s[np.isin(columns.status, FAULTS)] for columns in ranges]
            bad = np.unique((np.concatenate([np.zeros(0), *bad_s]) / seconds).round(3)).tolist()
            shares = [time_s / seconds for time_s, _ in recorded.all()]
            counts = {"faults": timeline.faults, "events": recorded.count + len(recorded.largest_error)}
            self._controls.marks = {"bad": bad, "incidents": shares} | counts

    # Events ---------------------------------------------------------------------------------------------------

    def _on_command(self, _attribute: str, _old: object, command: Any) -> None:
        """Execute a command of the page; a browser may send anything."""
        try:
            name, arguments = str(command[0]), list(command[1])
            if name == "accuracy":
                self._figures.shows_accuracy = bool(arguments[0])
            elif name == "select":
                self.select((int(str(arguments[0]), 0), int(str(arguments[1]), 0)))
            elif self._player is not None:
                self._player.command(name, *arguments)
            elif name == "play":
                self._paused = not bool(arguments[0])
        except (LookupError, TypeError, ValueError, OverflowError):
            return
        self._state.forget("scene")
        self._table_due_s = 0.0
        self._redraw = True
        if not self._is_waiting:
            self.draw()

    def _on_acknowledged(self, _attribute: str, _old: object, _number: Any) -> None:
        """Draw what changed by a command while the page was busy."""
        self._took_s = time.monotonic() - self._sent_s
        if self._redraw and not self._is_waiting:
            self.draw()

    def _on_reset(self, _event: Reset) -> None:
        with self._view.scene.lock:
            self._figures.fit_map(self._view.scene)

    def _on_closed(self, _context: Any) -> None:
        self._view.pages -= 1
