"""State of the pages of a server: what they share, and what one page shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bokeh.core.properties import Any as AnyValue
from bokeh.model import DataModel
from bokeh.models import ColumnDataSource

from uwb_mitigation.types.measurement import Cir
from uwb_mitigation.viewer.histories import HISTORY_S, History, Pair
from uwb_mitigation.viewer.scene import Scene

if TYPE_CHECKING:
    from uwb_mitigation.viewer.playback import BagPlayer


@dataclass
class View:
    """State that all pages of a server share.

    Attributes:
        scene: what they show.
        window: number of samples that the network reads.
        player: player of a recording; None: live.
        timeline: all data: of the recording as far as it has been read, or of the live topics.
        pages: number of open pages.
    """

    scene: Scene
    title: str = "UWB ranges"
    window: int = 157
    player: BagPlayer | None = None
    pages: int = 0

    def __post_init__(self) -> None:
        self.timeline: Scene = self.scene if self.player is None else self.player.timeline

    @property
    def all_data(self) -> Scene:
        """All data: of the recording as soon as it has been read, else those of the scene."""
        return self.timeline if self.timeline.is_read else self.scene


class Controls(DataModel):  # type: ignore[misc]
    """State that the page's script shows, and its commands.

    Attributes:
        command: set by the script: name, arguments, and a number that makes it unique.
        timing: set by the server after each update: its number, how long the previous one took, and the time since the
            latest range was received, s; negative if there are no recent ranges.
        acknowledged: set by the script to the number of the last update that it has drawn.
        headline, verdict, notice, nodes, health, tag_rows, incidents, cards, player, selected, marks: set by the server.
        available: set by the server: whether a control has an effect, {id: bool}.
        empty: set by the server: messages of figures without data, {name: message}.
    """

    command = AnyValue(default=None)
    timing = AnyValue(default=None)
    acknowledged = AnyValue(default=0)
    health = AnyValue(default=[])
    cards = AnyValue(default=[])
    headline = AnyValue(default="")
    verdict = AnyValue(default=[])
    tag_rows = AnyValue(default=[])
    incidents = AnyValue(default=[])
    available = AnyValue(default={})
    empty = AnyValue(default={})
    notice = AnyValue(default=[])
    nodes = AnyValue(default=[])
    player = AnyValue(default=None)
    selected = AnyValue(default=None)
    marks = AnyValue(default=None)


class PageState:
    """State of one page.

    Args:
        view: the view.

    Attributes:
        selected: the selected pair; None: there are no ranges.
        trail_s: duration of the tracks.
        health: state and mean residual (m) of each anchor.
        has_data: whether a pair has recent ranges.
    """

    def __init__(self, view: View) -> None:
        self.view, self.controls = view, Controls(name="controls")
        self.selected: Pair | None = None
        self.trail_s = HISTORY_S
        self.health: dict[int, tuple[str, float]] = {}
        self.has_data = False
        self._drawn: dict[str, object] = {}

    @property
    def tag_id(self) -> int | None:
        """The selected tag."""
        return None if self.selected is None else self.selected[1]

    @property
    def history(self) -> History:
        """The last minute of the selected pair; empty without one."""
        return self.view.scene.pairs.get(self.selected or (-1, -1)) or History()

    @property
    def cir(self) -> Cir | None:
        """The last CIR of the selected pair."""
        player = self.view.player
        return player.read_cir(self.selected) if player and self.selected else self.history.cir

    def changed(self, name: str, value: object) -> bool:
        """Return whether a value differs from that of the last call."""
        before, self._drawn[name] = self._drawn.get(name, self), value
        return before != value

    def forget(self, name: str) -> None:
        """Let the next call of `changed` return True."""
        self._drawn.pop(name, None)


def new_source(*columns: str, **options: Any) -> ColumnDataSource:
    """Return a source with empty columns."""
    return ColumnDataSource({column: [] for column in columns}, **options)


def columns_of(source: ColumnDataSource, rows: Sequence[Sequence[Any]]) -> dict[str, list[Any]]:
    """Return rows as the columns of a source."""
    columns = map(list, zip(*rows, strict=True)) if rows else ([] for _ in source.data)
    return dict(zip(source.data, columns, strict=True))


def set_rows(source: ColumnDataSource, rows: Sequence[Sequence[Any]]) -> None:
    """Set the rows of a source, which contain no arrays, if they have changed."""
    if (columns := columns_of(source, rows)) != source.data:
        source.data = columns
