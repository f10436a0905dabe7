"""Channel impulse responses of a mapped recording, in a temporary file."""

from __future__ import annotations

import tempfile
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.mapping.conversion import UNREADABLE, Chunk, ColumnDict, read_cir
from uwb_mitigation.recordings.mapping.mapping import CirSource, Join, series
from uwb_mitigation.types.measurement import Cir, Encoding

MAX_DELAY_S = 1.0
"""Largest delay of a CIR that is searched."""

_MAX_SEARCHED = 5000
"""Number of CIRs whose delay is computed."""


class CirFile:
    """Numbered CIRs in a temporary file."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        self._rows: list[tuple[int, int, Encoding, float]] = []

    def add(self, source: CirSource, chunk: Chunk) -> NDArray[np.int64]:
        """Store the CIRs of rows; return their numbers, -1 if a row has none.

        Raises:
            RecordingError: a value is not a CIR; `where` names its row.
        """
        kind = object if source.samples == "complex" else np.float64
        lists = _lists(source.column, chunk, kind)
        imaginary = _lists(source.imaginary, chunk, kind) if source.imaginary else None
        numbers = np.full(chunk.count, -1)
        for row in range(chunk.count):
            values = lists[row]
            if values is None or isinstance(values, float):
                continue
            try:
                cir = read_cir(values, source.samples, None if imaginary is None else imaginary[row])
            except (RecordingError, *UNREADABLE) as error:
                what, valid = (
                    getattr(error, "what", f"not a CIR: {error}"),
                    getattr(error, "valid", source.samples),
                )
                raise RecordingError(what, where=chunk.where(row), valid=valid) from error
            if len(cir):
                numbers[row] = len(self._rows)
                self._rows.append((self._file.seek(0, 2), len(cir.samples), cir.encoding, cir.scale))
                self._file.write(cir.samples.tobytes())
        return numbers

    def read(self, number: int) -> Cir:
        """Return the samples of a CIR."""
        start, length, encoding, scale = self._rows[number]
        self._file.seek(start)
        return Cir(np.frombuffer(self._file.read(2 * length), np.int16), encoding, scale=scale)

    def samples(self, number: int) -> int:
        """Return the number of samples of a CIR."""
        _, length, encoding, _ = self._rows[number]
        return length // (1 if encoding is Encoding.MAGNITUDE else 2)

    def close(self) -> None:
        """Delete the file."""
        self._file.close()


def _lists(column: str, chunk: Chunk, kind: type) -> Any:
    """Return the list of each row, from one column or a series of columns."""
    names = series(column)
    if len(names) == 1:
        return chunk.columns[column]
    lists: Any = np.stack([np.asarray(chunk.columns[name], kind) for name in names], axis=1)
    # At a PRF of 16 MHz, a CIR has 992 samples instead of 1016.
    return [row[: np.flatnonzero(row == row).max(initial=-1) + 1] for row in lists]


def join_by_row(ranges: ColumnDict, rows: NDArray[Any], cirs: ColumnDict, where: str) -> None:
    """Give the ranges at `rows` the CIRs of the same rows in another file."""
    count = int(cirs["row"].max(initial=-1)) + 1
    if ranges["row"][rows].max(initial=-1) >= count:
        raise RecordingError(f"{count} CIRs for more ranges", where=where, valid="one row for each range")
    by_row = np.full(count, -1)
    by_row[cirs["row"]] = cirs["cir"]
    ranges["cir"][rows] = by_row[ranges["row"][rows]]


def join_by_time(ranges: ColumnDict, rows: NDArray[Any], cirs: ColumnDict, join: Join) -> tuple[str, bool]:
    """Give the ranges at `rows` the CIRs of their pairs that are nearest in time, within the tolerance.

    Returns:
        A sentence for the user, and whether it is a warning.
    """
    keys = ("stamp", "tag", "anchor")
    targets = pd.DataFrame({name: ranges[name][rows] for name in keys} | {"target": rows})
    sources = pd.DataFrame({name: cirs[name] for name in (*keys, "cir", "first_path_index")})
    sources = sources[sources["cir"] >= 0].assign(cir_stamp=sources["stamp"])
    targets, sources = (frame.sort_values("stamp", kind="stable") for frame in (targets, sources))
    limits: Any = {"direction": "nearest", "tolerance": round(join.tolerance_s * 1e9)}
    pairs = pd.merge_asof(targets, sources, on="stamp", by=["tag", "anchor"], **limits).dropna(subset="cir")
    # A CIR belongs to one range only.
    distance = (pairs["cir_stamp"] - pairs["stamp"]).abs()
    pairs = pairs.loc[distance.sort_values(kind="stable").index].drop_duplicates("cir")
    ranges["cir"][pairs["target"]] = pairs["cir"]
    index = pairs["first_path_index"]
    ranges["first_path_index"][pairs["target"][index.notna()]] = index.dropna()
    return _summary(targets, sources, len(pairs), join)


def _summary(ranges: Any, cirs: Any, attached: int, join: Join) -> tuple[str, bool]:
    """Return how many CIRs were attached, their typical delay, and the offset that would attach more."""
    stamps = {key: group["stamp"].to_numpy() for key, group in ranges.groupby(["tag", "anchor"])}
    # Those of other pairs belong to ranges that were dropped.
    is_paired = np.array([key in stamps for key in zip(cirs["tag"], cirs["anchor"], strict=True)], bool)
    if others := int(np.count_nonzero(~is_paired)) if is_paired.any() else 0:
        cirs = cirs[is_paired]
    text = f"CIRs attached: {attached} of {len(cirs)}" + (f" ({others} of other pairs)" if others else "")
    delays = []
    for key, group in cirs.iloc[:_MAX_SEARCHED].groupby(["tag", "anchor"]):
        if key in stamps:
            times, limit = group["stamp"].to_numpy(), round(MAX_DELAY_S * 1e9)
            first, last = (np.searchsorted(stamps[key], times + shift) for shift in (-limit, limit))
            delays += [time - stamps[key][i:j] for time, i, j in zip(times, first, last, strict=True)]
    sorted_s = np.sort(np.concatenate(delays) / 1e9) if delays else np.zeros(0)
    if not len(sorted_s):
        return f"{text}; no CIR has the tag, anchor and time of a range: compare the keys of cir.join", True
    counts = np.searchsorted(sorted_s, sorted_s + 2 * join.tolerance_s, "right") - np.arange(len(sorted_s))
    # Ranges at a constant rate give several delays: the smallest one is meant.
    starts = np.flatnonzero(counts >= 0.9 * counts.max())
    medians = np.array([np.median(sorted_s[start : start + counts[start]]) for start in starts[:10_000]])
    best = int(np.argmin(np.abs(medians)))
    delay_s, count = float(medians[best]), int(counts[starts[best]])
    text += f"; typical delay {delay_s:+.2f} s"
    if count > 1.1 * min(attached, _MAX_SEARCHED) + 1:
        hint = f"cir.join.stamp with offset: {join.stamp.offset - delay_s:.3f} would attach more"
        return f"{text}; {hint}", True
    return text, attached < len(cirs) / 2
