"""Hanyang University's outdoor runs: one moving tag, four anchors, and RTK GNSS positions of the tag. No CIRs.

One folder per run (github.com/cucudasluv/UWB-dataset): one file per anchor (`A3.csv`, `A5.csv`, ...) and `trajectory.csv`;
each may be compressed with xz. The tag's antenna is 1.0 m above the trajectory's z.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.measurement import Cir, RangeMeasurement, Record
from uwb_mitigation.positioning.anchors import Anchor, AnchorMap
from uwb_mitigation.positioning.tracks import TruePath
from uwb_mitigation.sources.csv_rows import id_cell, read_rows
from uwb_mitigation.sources.source import Source

TAG_ID = 1
ANTENNA_M = 1.0
"""Height of the tag's antenna above the trajectory."""

GNSS_LOST_M = 0.5
"""If the trajectory's z is further from its median, GNSS was lost and the positions are not ground truth."""

MAX_BYTES = 64 << 20
_ANCHOR = re.compile(r"A(\d{1,4})\.csv(\.xz)?")
_RANGE_COLUMNS = ("field.stamp", "field.id", "field.x", "field.y", "field.z", "field.distanceFromTag")
_POWERS = ("field.rssi", "field.rssi_fp")
_PATH_COLUMNS = ("timestamp", "x", "y", "z")
_ANCHOR_SD_M = 0.02
_Row = tuple[int, int, float, float, float]


def is_run(folder: Path) -> bool:
    """Return whether a folder contains such a run."""
    names = {entry.name for entry in folder.iterdir()}
    return bool(names & {"trajectory.csv", "trajectory.csv.xz"}) and any(map(_ANCHOR.fullmatch, names))


class HanyangRun(Source):
    """One run; a `Source`.

    Args:
        folder: the folder of the run.

    Attributes:
        anchors: anchor positions from the files.
        truth: positions of the tag's antenna, without segments of lost GNSS.
        in_motion: keep pauses, because the tag moves during them.

    Raises:
        RecordingError: a file is missing, too large or malformed; the message names file and line.
    """

    simulated = False
    in_motion = True

    def __init__(self, folder: Path) -> None:
        self.name = f"Hanyang run {folder.name}"
        self.skipped: Counter[str] = Counter()
        self._odd: Counter[str] = Counter()
        files = sorted(path for path in folder.iterdir() if _ANCHOR.fullmatch(path.name))
        anchors: dict[int, Anchor] = {}
        rows: list[_Row] = []
        for path in files:
            self._read_anchor(path, anchors, rows)
        self.anchors = AnchorMap([anchors[key] for key in sorted(anchors)], str(folder))
        self._rows = sorted(rows)
        self.truth = self._read_path(folder)

    def __iter__(self) -> Iterator[Record]:
        self.skipped = Counter(self._odd)
        stamps = np.array([row[0] for row in self._rows], np.int64)
        places = self.truth.at(stamps)
        empty = np.zeros(0, np.int16)
        for number, (row, place) in enumerate(zip(self._rows, places.tolist(), strict=True)):
            stamp_ns, anchor, range_m, power, first_path_power = row
            cir = Cir(empty, rx_power_dbm=power, first_path_power_dbm=first_path_power, channel=5)
            yield Record(
                RangeMeasurement(stamp_ns, TAG_ID, anchor, number, 0, range_m, cir, f"anchor_{anchor}"),
                tag_position=(place[0], place[1], place[2]) if math.isfinite(place[0]) else None,
            )

    def _read_anchor(self, path: Path, anchors: dict[int, Anchor], rows: list[_Row]) -> None:
        for line, row in read_rows(path, _RANGE_COLUMNS, MAX_BYTES):
            where = f"{path}: line {line}"
            stamp_ns, key = (id_cell(row, name, where) for name in ("field.stamp", "field.id"))
            x, y, z = (_number(row[f"field.{axis}"], where) for axis in "xyz")
            anchor = Anchor(key, (x, y, z), _ANCHOR_SD_M)
            if anchors.setdefault(key, anchor) != anchor:
                raise RecordingError(
                    f"anchor {key} is at two places", where=where, valid="one for each anchor"
                )
            power, first_path = (_number(row.get(name, "nan"), where) for name in _POWERS)
            if not math.isfinite(first_path):
                # -inf: the radio did not measure the first path.
                self._odd["first-path power that is not finite"] += 1
                first_path = math.nan
            rows.append((stamp_ns, key, _number(row["field.distanceFromTag"], where), power, first_path))

    def _read_path(self, folder: Path) -> TruePath:
        path = folder / "trajectory.csv"
        if not path.exists():
            path = folder / "trajectory.csv.xz"
        # The stamps were written as floats, with a rounding error of up to 256 ns.
        rows = [
            [_number(row[name], f"{path}: line {line}") for name in _PATH_COLUMNS]
            for line, row in read_rows(path, _PATH_COLUMNS, MAX_BYTES)
        ]
        table: NDArray[np.float64] = np.array(rows, np.float64).reshape(-1, 4)
        table = table[np.isfinite(table).all(axis=1)]
        height = np.median(table[:, 3]) if len(table) else 0.0
        lost = np.abs(table[:, 3] - height) > GNSS_LOST_M
        self._odd += Counter({"place without GNSS": int(lost.sum())})
        table = table[~lost]
        table = table[np.argsort(table[:, 0], kind="stable")]
        return TruePath(table[:, 0].astype(np.int64), table[:, 1:] + (0.0, 0.0, ANTENNA_M))


def _number(text: str | None, where: str) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        raise RecordingError(f"{text!r:.40} is no number", where=where, valid="a number") from None
