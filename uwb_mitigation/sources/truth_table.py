"""True ranges in a CSV file, for recordings that hold none: which pair stood how far apart, and when.

Columns `tag_id`, `anchor_id` (decimal) and `range_m`; optionally `start_s` and `stop_s`, seconds from the
recording's first measurement (empty = from its start, to its end), `configuration` and `label`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.measurement import Record, Truth
from uwb_mitigation.sources.csv_rows import read_rows

MAX_CSV_BYTES = 1 << 20
MAX_RANGE_M = 1e6

_NEEDED = ("tag_id", "anchor_id", "range_m")
_MAX_ID = (1 << 64) - 1


@dataclass(frozen=True, slots=True)
class Stretch:
    """What is true of one pair from `start_s` (included) to `stop_s` (not) of a recording."""

    tag_id: int
    anchor_id: int
    start_s: float
    stop_s: float
    truth: Truth


def load_truth(path: Path) -> list[Stretch]:
    """The rows of a truth table; one without a configuration's name is a configuration of its own.

    Raises:
        RecordingError: the file is absent, too large, or malformed; names the line.
    """
    found = [_stretch(row, path, line) for line, row in read_rows(path, _NEEDED, MAX_CSV_BYTES)]
    if not found:
        raise RecordingError("the truth holds no rows", where=str(path), valid="one for each configuration")
    return found


def with_truth(records: Iterable[Record], stretches: Sequence[Stretch]) -> Iterator[Record]:
    """The records with the truth of the first stretch that holds each; others have none."""
    by_pair: dict[tuple[int, int], list[Stretch]] = {}
    for stretch in stretches:
        by_pair.setdefault((stretch.tag_id, stretch.anchor_id), []).append(stretch)
    first_ns: int | None = None
    for record in records:
        measurement = record.measurement
        first_ns = measurement.stamp_ns if first_ns is None else first_ns
        at_s = (measurement.stamp_ns - first_ns) / 1e9
        candidates = by_pair.get((measurement.tag_id, measurement.anchor_id), ())
        yield replace(
            record,
            truth=next((item.truth for item in candidates if item.start_s <= at_s < item.stop_s), None),
        )


def _stretch(row: dict[str, str], path: Path, line: int) -> Stretch:
    where = f"{path}: line {line}"

    def number(name: str, otherwise: float | None = None) -> float:
        text = (row.get(name) or "").strip()
        if not text and otherwise is not None:
            return otherwise
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not 0 <= value <= MAX_RANGE_M:
            raise RecordingError(f"{name} = {text!r}", where=where, valid=f"0 to {MAX_RANGE_M:g}")
        return value

    def identity(name: str) -> int:
        text = (row.get(name) or "").strip()
        if text.isascii() and text.isdigit() and len(text) <= 20 and int(text) <= _MAX_ID:
            return int(text)
        raise RecordingError(f"{name} = {text!r}", where=where, valid="a whole number of 64 bits")

    start_s, stop_s = number("start_s", 0.0), number("stop_s", math.inf)
    if start_s >= stop_s:
        raise RecordingError(f"start_s = {start_s} is not before stop_s = {stop_s}", where=where)
    truth = Truth(
        number("range_m"),
        (row.get("label") or "").strip(),
        (row.get("configuration") or "").strip() or f"{path.name} line {line}",
    )
    return Stretch(identity("tag_id"), identity("anchor_id"), start_s, stop_s, truth)
