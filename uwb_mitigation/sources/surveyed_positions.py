"""Surveyed positions that lie beside a folder of logs: which log was made where, and what is true there.

Three or four small CSV files with a header row: `pairs.csv` (file_number, anchor_location,
tag_location), `anchors.csv` and `tags.csv` (location, x, y in metres), and optionally `labels.csv`
(file_id, label). The true distance is the Euclidean one in the plane: the antennas stand level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.measurement import Truth
from uwb_mitigation.positioning.anchors import Anchor, AnchorMap
from uwb_mitigation.sources.csv_rows import read_rows

MAX_CSV_BYTES = 1 << 20
MAX_LOCATION = (1 << 64) - 1
"""A location's number serves as a 64-bit identity."""

_Value = TypeVar("_Value")


@dataclass(frozen=True, slots=True)
class Placement:
    """Where one log was made: location numbers of anchor and tag, where the tag stood, and the truth that follows."""

    anchor: int
    tag: int
    tag_position: tuple[float, float, float]
    truth: Truth


@dataclass(frozen=True, slots=True)
class Survey:
    """The surveyed placements of a folder's logs, by log number; and all anchors, by location number, at z = 0."""

    folder: Path
    placements: dict[int, Placement]
    anchors: AnchorMap

    @classmethod
    def find(cls, folder: Path) -> Survey | None:
        """The survey in `folder` or else in its parent; None where neither holds a `pairs.csv`.

        Raises:
            RecordingError: the survey is incomplete or malformed.
        """
        folder = folder.resolve()
        for candidate in (folder, folder.parent):
            if (candidate / "pairs.csv").is_file():
                return cls.load(candidate)
        return None

    @classmethod
    def load(cls, folder: Path) -> Survey:
        """Read the survey of `folder`; configurations are named `<folder name>/<log number>`.

        Raises:
            RecordingError: a file is absent (`labels.csv` may be), malformed, names a location
                that was not surveyed, or says two things of one number.
        """
        anchors = _positions(folder / "anchors.csv")
        tags = _positions(folder / "tags.csv")
        labels = _labels(folder / "labels.csv") if (folder / "labels.csv").is_file() else {}
        placements: dict[int, Placement] = {}
        path = folder / "pairs.csv"
        columns = ("file_number", "anchor_location", "tag_location")
        for line, row in read_rows(path, columns, MAX_CSV_BYTES):
            where = f"{path}: line {line}"
            number, anchor, tag = (_count(row[name], where) for name in columns)
            for kind, location, surveyed in (("anchor", anchor, anchors), ("tag", tag, tags)):
                if location not in surveyed:
                    raise RecordingError(
                        f"{kind} location {location} was not surveyed",
                        where=where,
                        valid=f"a location of {kind}s.csv",
                    )
            truth = Truth(
                range_m=math.dist(anchors[anchor], tags[tag]),
                label=labels.get(number, ""),
                configuration=f"{folder.name}/{number}",
            )
            _put(placements, number, Placement(anchor, tag, (*tags[tag], 0.0), truth), where)
        known = [Anchor(number, (*place, 0.0)) for number, place in anchors.items()]
        return cls(folder, placements, AnchorMap(known, str(folder / "anchors.csv")))


def _positions(path: Path) -> dict[int, tuple[float, float]]:
    positions: dict[int, tuple[float, float]] = {}
    for line, row in read_rows(path, ("location", "x", "y"), MAX_CSV_BYTES):
        where = f"{path}: line {line}"
        place = (_metres(row["x"], where), _metres(row["y"], where))
        _put(positions, _count(row["location"], where), place, where)
    return positions


def _labels(path: Path) -> dict[int, str]:
    labels: dict[int, str] = {}
    for line, row in read_rows(path, ("file_id", "label"), MAX_CSV_BYTES):
        where = f"{path}: line {line}"
        _put(labels, _count(row["file_id"], where), row["label"].strip(), where)
    return labels


def _put(table: dict[int, _Value], key: int, value: _Value, where: str) -> None:
    if key in table:
        raise RecordingError(f"the number {key} is there twice", where=where, valid="one row for each")
    table[key] = value


def _count(text: str, where: str) -> int:
    stripped = text.strip()
    if stripped.isascii() and stripped.isdigit() and len(stripped) <= 20 and int(stripped) <= MAX_LOCATION:
        return int(stripped)
    raise RecordingError(f"{text!r} is not a number of a file or location", where=where, valid="0, 1, 2, ...")


def _metres(text: str, where: str) -> float:
    try:
        metres = float(text)
    except ValueError:
        metres = math.nan
    if not math.isfinite(metres):
        raise RecordingError(f"the coordinate {text!r} is not finite", where=where, valid="metres")
    return metres
