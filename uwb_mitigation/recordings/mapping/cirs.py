"""Channel impulse responses of a mapped recording, in a temporary file."""

from __future__ import annotations

import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.mapping.conversion import ColumnDict, samples_of
from uwb_mitigation.recordings.mapping.mapping import CirSource, series
from uwb_mitigation.recordings.mapping.tables import UNREADABLE, Chunk
from uwb_mitigation.types.measurement import Cir, Encoding


class CirFile:
    """Numbered CIRs in a temporary file."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        self._rows: list[tuple[int, int, Encoding, int, float]] = []

    def add(self, source: CirSource, chunk: Chunk) -> NDArray[np.int64]:
        """Store the CIRs of rows; return their numbers, -1 if a row has none.

        Raises:
            RecordingError: a value is not a CIR; `where` names its row.
        """
        names = series(source.column)
        lists: Any = chunk.columns[names[0]]
        if len(names) > 1:
            lists = np.stack([np.asarray(chunk.columns[name], np.float64) for name in names], axis=1)
        found = np.full(chunk.count, -1)
        for row in range(chunk.count):
            values = lists[row]
            if values is None or isinstance(values, float):
                continue
            try:
                samples, encoding, scale = samples_of(values, source.samples)
            except UNREADABLE as error:
                raise RecordingError(
                    f"not a CIR: {error}", where=chunk.where(row), valid=source.samples
                ) from error
            if len(samples):
                found[row] = len(self._rows)
                start = self._file.seek(0, 2)
                self._file.write(samples.tobytes())
                self._rows.append((start, len(samples), encoding, source.start_index, scale))
        return found

    def read(self, number: int) -> Cir:
        """Return the samples of a CIR."""
        start, length, encoding, start_index, scale = self._rows[number]
        self._file.seek(start)
        samples = np.frombuffer(self._file.read(2 * length), np.int16)
        return Cir(samples, encoding, start_index, scale=scale)

    def close(self) -> None:
        """Delete the file."""
        self._file.close()


def join_by_row(ranges: ColumnDict, rows: NDArray[Any], cirs: ColumnDict, where: str) -> None:
    """Give the ranges at `rows` the CIRs of the same rows in another file."""
    known = int(cirs["row"].max(initial=-1)) + 1
    if ranges["row"][rows].max(initial=-1) >= known:
        raise RecordingError(f"{known} CIRs for more ranges", where=where, valid="one row for each range")
    by_row = np.full(known, -1)
    by_row[cirs["row"]] = cirs["cir"]
    ranges["cir"][rows] = by_row[ranges["row"][rows]]


def join_by_time(ranges: ColumnDict, rows: NDArray[Any], cirs: ColumnDict, tolerance_s: float) -> None:
    """Give the ranges at `rows` the CIRs of their pairs that are nearest in time, within the tolerance."""
    import pandas as pd

    keys = ("stamp", "tag", "anchor")
    left = pd.DataFrame({name: ranges[name][rows] for name in keys} | {"to": rows})
    right = pd.DataFrame({name: cirs[name] for name in (*keys, "cir", "first_path_index")})
    left, right = (frame.sort_values("stamp", kind="stable") for frame in (left, right))
    within = {"direction": "nearest", "tolerance": round(tolerance_s * 1e9)}
    found = pd.merge_asof(left, right, on="stamp", by=["tag", "anchor"], **within).dropna(subset="cir")
    ranges["cir"][found["to"]] = found["cir"]
    index = found["first_path_index"]
    ranges["first_path_index"][found["to"][index.notna()]] = index.dropna()
