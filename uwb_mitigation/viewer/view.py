"""What the pages of one server share: a scene and its lock, a recording's player, and what drawing costs."""

from __future__ import annotations

from dataclasses import dataclass, field
from threading import Lock
from typing import Protocol

from uwb_mitigation.viewer.scene import Scene

REFRESH_S = 0.1
SHARE = 0.3
"""Of one core, for drawing all open pages: beyond it they are drawn less often."""


@dataclass(slots=True)
class Drawing:
    """What drawing costs, over all pages of a server: each asks it when to draw next.

    Attributes:
        pages: that are open.
        cost_s: processor time of one drawing, a running mean.
    """

    pages: int = 0
    cost_s: float = 0.0

    def pause_s(self) -> float:
        """How long a page waits from one drawing to the next."""
        return max(REFRESH_S, self.cost_s * self.pages / SHARE)

    def drawn(self, took_s: float) -> None:
        self.cost_s += 0.1 * (took_s - self.cost_s)


class Player(Protocol):
    """Moves a scene through a recording; all pages look at the same place.

    Attributes:
        seconds: length of the recording.
        position_s: where it is, from the beginning.
        playing: whether `advance` moves.
    """

    seconds: float
    position_s: float
    playing: bool

    def play(self, on: bool) -> None:
        """Go on, or stand still; at its end the recording begins anew."""

    def seek(self, position_s: float) -> None:
        """Bring the scene to a place."""

    def advance(self) -> None:
        """Move on by the time that has passed since the last call."""


@dataclass(slots=True)
class Missing:
    """What the page says if it has no ranges, anchors or positions to show; empty = nothing."""

    ranges: str = "No ranges received."
    anchors: str = "No anchor positions."
    positions: str = ""


@dataclass(slots=True)
class View:
    """What pages look at: a scene and the lock that its feed holds while it changes it.

    Attributes:
        title: of the page.
        window: samples that the network reads.
        player: of a recording; None = live.
        parameters: shows whether there is a page of parameters to link to.
        missing: the reasons for an empty page.
    """

    scene: Scene
    lock: Lock
    title: str = "UWB ranges"
    window: int = 157
    player: Player | None = None
    parameters: bool = False
    missing: Missing = field(default_factory=Missing)
    drawing: Drawing = field(default_factory=Drawing)
