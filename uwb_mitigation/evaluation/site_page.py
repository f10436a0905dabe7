"""The page of a calibrated site: where the tag was, what ranges erred by and err by now, what was found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.evaluation.page import rendered

MOST_POINTS = 2000
WIDTH, HEIGHT, MARGIN = 720.0, 480.0, 36.0


@dataclass(frozen=True, slots=True)
class AnchorRow:
    """MAE of an anchor's ranges before and after, m."""

    anchor: str
    ranges: int
    before_m: float
    after_m: float


@dataclass(frozen=True, slots=True)
class OffsetRow:
    """The offset of a pair and its deviation, m."""

    tag: str
    anchor: str
    offset_m: float
    sd_m: float


@dataclass(frozen=True, slots=True, eq=False)
class SitePage:
    """What the page shows.

    Attributes:
        name: of the recordings. sentence: what the calibration should bring. facts, notes: in words.
        anchors: (name, x, y), m. tracks: float64 (k, 2) each, m.
        by_anchor, offsets: tables. candidates: (name, MAE on what was held out, m), of which `chosen` is one.
    """

    name: str
    sentence: str
    facts: tuple[str, ...]
    notes: tuple[str, ...]
    anchors: tuple[tuple[str, float, float], ...]
    tracks: tuple[NDArray[np.float64], ...]
    by_anchor: tuple[AnchorRow, ...]
    offsets: tuple[OffsetRow, ...]
    candidates: tuple[tuple[str, float], ...]
    chosen: str

    def drawing(self) -> Drawing:
        """The plan, in pixels."""
        known = [
            np.array([[x, y] for _, x, y in self.anchors]),
            *(track for track in self.tracks if len(track)),
        ]
        every = np.concatenate(known)
        every = every[np.isfinite(every).all(axis=1)]
        low, high = every.min(axis=0), every.max(axis=0)
        scale = float(
            min(
                (WIDTH - 2 * MARGIN) / max(high[0] - low[0], 1.0),
                (HEIGHT - 2 * MARGIN) / max(high[1] - low[1], 1.0),
            )
        )

        def pixel(x: float, y: float) -> tuple[float, float]:
            return MARGIN + (x - low[0]) * scale, HEIGHT - MARGIN - (y - low[1]) * scale

        lines, dots = [], []
        for track in self.tracks:
            track = track[np.isfinite(track).all(axis=1)]
            points = [pixel(x, y) for x, y in track[:: max(1, len(track) // MOST_POINTS)].tolist()]
            if len(points) == 1:
                dots.append(points[0])
            else:
                lines.append(" ".join(f"{x:.1f},{y:.1f}" for x, y in points))
        named = [(name, *pixel(x, y)) for name, x, y in self.anchors]
        return Drawing(tuple(named), tuple(lines), tuple(dots), scale)


@dataclass(frozen=True, slots=True)
class Drawing:
    """Anchors (name, x, y), tracks as points of a polyline, and places (x, y), in pixels; `scale` pixels are 1 m."""

    anchors: tuple[tuple[str, float, float], ...]
    lines: tuple[str, ...]
    dots: tuple[tuple[float, float], ...]
    scale: float


def site_page(page: SitePage) -> str:
    """One page of HTML that needs nothing else.

    Raises:
        MissingDependencyError: jinja2 is not installed.
    """
    worst = max([row.before_m for row in page.by_anchor] + [row.after_m for row in page.by_anchor] + [1e-9])
    return rendered(
        "site.html.j2", page=page, drawing=page.drawing(), worst=worst, width=WIDTH, height=HEIGHT
    )
