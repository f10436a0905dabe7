"""State of the pages of a server: what they share, and what the user of one page has chosen."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from threading import Lock
from typing import TYPE_CHECKING, Any

from bokeh.models import ColumnDataSource

from uwb_mitigation.viewer.histories import HISTORY_S, MAX_RANGE_M, History, Pair
from uwb_mitigation.viewer.models import Models
from uwb_mitigation.viewer.scene import MissingData, Scene
from uwb_mitigation.viewer.verdict import HeldVerdict

if TYPE_CHECKING:
    from uwb_mitigation.viewer.playback import BagPlayer
    from uwb_mitigation.viewer.timeline import Timeline


@dataclass(slots=True)
class View:
    """State that all pages of a server share.

    Attributes:
        lock: held while the scene is changed or drawn.
        window: number of samples that the network reads.
        player: player of a recording; None: live.
        missing: the reasons for an empty page.
        pages: number of open pages.
    """

    scene: Scene
    lock: Lock
    title: str = "UWB ranges"
    window: int = 157
    player: BagPlayer | None = None
    missing: MissingData = field(default_factory=MissingData)
    pages: int = 0

    @property
    def timeline(self) -> Timeline | None:
        """The index of the recording; None: live, or not ready."""
        return None if self.player is None else self.player.timeline

    @property
    def complete(self) -> Timeline | None:
        """The index of the recording with its tracks; None: live, or not ready."""
        return self.timeline if self.timeline is not None and self.timeline.is_complete else None


class PageState:
    """State of one page.

    Args:
        view: the view.
        models: models of the page.

    Attributes:
        selected: the selected pair; None: there are no ranges.
        trail_s: duration of the tracks.
        health: state and mean residual (m) of each anchor. verdict: on the position of the selected tag.
        has_data: whether a pair has recent ranges.
    """

    def __init__(self, view: View, models: Models) -> None:
        self.view, self.models = view, models
        self.selected: Pair | None = None
        self.trail_s = HISTORY_S
        self.health: dict[int, tuple[str, float]] = {}
        self.verdict, self.has_data = HeldVerdict(), False
        self._drawn: dict[str, object] = {}

    @property
    def tag_id(self) -> int | None:
        """The selected tag."""
        return None if self.selected is None else self.selected[1]

    def changed(self, name: str, value: object) -> bool:
        """Return whether a value differs from that of the last call."""
        if name in self._drawn and self._drawn[name] == value:
            return False
        self._drawn[name] = value
        return True

    def forget(self, name: str) -> None:
        """Let the next call of `changed` return True."""
        self._drawn.pop(name, None)

    def set(self, **values: object) -> None:
        """Set attributes of the controls that have changed."""
        for name, value in values.items():
            if getattr(self.models.controls, name) != value:
                setattr(self.models.controls, name, value)


def no_data(scene: Scene, history: History) -> str:
    """Return "no data for 12 s" for a pair that has stopped, else an empty string."""
    age_s = scene.age_s(history)
    return "" if age_s <= history.max_gap_s else f"no data for {age_s:.0f} s"


def set_rows(source: ColumnDataSource, rows: list[dict[str, Any]]) -> None:
    """Set the rows of a source, unless it is and remains empty."""
    if rows or any(map(len, source.data.values())):
        source.data = {column: [row[column] for row in rows] for column in source.data}


def drawable(value_m: float) -> float:
    """Return NaN for a length that would make all others invisible."""
    return value_m if abs(value_m) < MAX_RANGE_M else math.nan
