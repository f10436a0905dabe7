"""Colours and symbols of statuses and tracks, the same on the page, in RViz, in Foxglove and in reports.

The colours are those of Okabe and Ito, which colour-blind people can distinguish. Their contrast is at least 3 : 1 on `PAPER`
and on `NIGHT` (RViz), as WCAG 2.1 level AA requires of graphics. Every status also has its own symbol.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from typing import NamedTuple

from uwb_mitigation.types.measurement import Status

BLUE, VERMILLION, GREEN, PURPLE, ORANGE = "#0072b2", "#d55e00", "#14a46c", "#c080a2", "#b87f00"
GREY = "#6c6c6c"
PAPER, NIGHT = "#ffffff", "#111827"
"""Backgrounds; each is also the ink on the other one."""


class StatusStyle(NamedTuple):
    """Appearance of a status.

    Attributes:
        colour: None: the ink of the page, black or white.
        marker: name of the marker in Bokeh. symbol: character of the same shape. meaning: explanation for users.
        triangles: corners of the same shape within the unit circle, three for each triangle.
    """

    colour: str | None
    marker: str
    symbol: str
    meaning: str
    triangles: tuple[tuple[float, float], ...]


_SQUARE = ((-0.8, -0.8), (0.8, -0.8), (0.8, 0.8), (-0.8, -0.8), (0.8, 0.8), (-0.8, 0.8))
_DIAMOND = ((-1.0, 0.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0), (1.0, 0.0), (0.0, 1.0))
_TRIANGLE = ((-1.0, 0.8), (0.0, -1.0), (1.0, 0.8))
_UP = tuple((x, -y) for x, y in _TRIANGLE)
_CROSS = (
    (-1.0, -0.7), (-0.7, -1.0), (1.0, 0.7), (-1.0, -0.7), (1.0, 0.7), (0.7, 1.0),
    (-1.0, 0.7), (0.7, -1.0), (1.0, -0.7), (-1.0, 0.7), (1.0, -0.7), (-0.7, 1.0),
)  # fmt: skip
_HEXAGON = ((1.0, 0.0), (0.5, 0.87), (-0.5, 0.87), (-1.0, 0.0), (-0.5, -0.87), (0.5, -0.87))
_DISC = tuple(corner for n in range(1, 5) for corner in (_HEXAGON[0], _HEXAGON[n], _HEXAGON[n + 1]))

_RAW = ": only the offset is subtracted"
STATUS_LOOKS = {
    Status.OK: StatusStyle(BLUE, "circle", "\u25cf", "corrected by the model", _DISC),
    Status.NO_CIR: StatusStyle(
        GREY, "square", "\u25a0", "not corrected: no CIRs (channel impulse responses)" + _RAW, _SQUARE
    ),
    Status.BAD_CIR: StatusStyle(PURPLE, "diamond", "\u25c6", "the CIR is invalid" + _RAW, _DIAMOND),
    Status.OUT_OF_DISTRIBUTION: StatusStyle(
        VERMILLION, "inverted_triangle", "\u25bc", "unlike the training data of the model" + _RAW, _TRIANGLE
    ),
    Status.MODEL_ERROR: StatusStyle(None, "x", "\u2716", "the network failed" + _RAW, _CROSS),
    Status.UNRELIABLE: StatusStyle(
        ORANGE, "triangle", "\u25b2", "corrected, but uncertain by more than 0.5 m", _UP
    ),
}


class TrackKind(Enum):
    """Kinds of tracks; the value is the name in legends."""

    RAW = "raw"
    CORRECTED = "corrected"
    SMOOTHED = "smoothed"
    TRUE = "true"


ATTRIBUTES = {TrackKind.RAW: "raw_live", TrackKind.CORRECTED: "live", TrackKind.SMOOTHED: "smoothed"}
"""Attributes of `TagTracks`."""

TRACK_STYLES = {
    TrackKind.RAW: (VERMILLION, 1.0, "solid"),
    TrackKind.CORRECTED: (BLUE, 3.0, "solid"),
    TrackKind.SMOOTHED: (GREEN, 2.0, "dotdash"),
    TrackKind.TRUE: (NIGHT, 2.0, "dashed"),
}
"""Colour, width and dashes of the lines of each kind, in drawing order."""

TAG_COLOURS = BLUE, ORANGE, PURPLE, GREEN
"""Colours of tags and their corrected tracks; further tags have them again."""


def tag_colours(names: Iterable[str]) -> dict[str, str]:
    """Return the colour of each tag, in the order of their names."""
    return {name: TAG_COLOURS[row % len(TAG_COLOURS)] for row, name in enumerate(sorted(names))}
