"""Labelled measurements as arrays, for training, calibration and baselines."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.early_path import MIN_RANGE_M, early_path_error_m
from uwb_mitigation.mitigation.preprocessing import Preprocessing
from uwb_mitigation.types.columns import Columns
from uwb_mitigation.types.measurement import (
    Cir,
    CirFault,
    RadioType,
    RangeColumns,
    RangeMeasurement,
    Record,
    Segment,
    Truth,
)

_BATCH = 256


@dataclass(frozen=True, slots=True, eq=False)
class Dataset(Columns):
    """Preprocessed measurements with true ranges; every array has n rows.

    Attributes:
        preprocessing: preprocessing of the inputs.
        inputs: float32 (n, K).
        rx_power_dbm, first_path_power_dbm: float32; NaN = unknown.
        range_m: measured range.
        error_m: measured - true.
        configurations: name of the placement. Measurements of one placement are not independent; all
            measurements without a name count as one placement.
        labels: propagation condition; may be empty.
        skipped: {reason: number of measurements that were not used}.
        headers: float32 (n, 2), preamble count and noise threshold; None = not kept.
        tags, anchors: ids, int (n,), of each pair; None = not kept.
        radios, segments: known sources of the CIRs. channels: known UWB channels.
        early_path_m: float32 (n,), errors that missed direct paths cause (`mitigation.early_path`), NaN: none; None = not
            computed.
    """

    preprocessing: Preprocessing
    inputs: NDArray[np.float32]
    rx_power_dbm: NDArray[np.float32]
    first_path_power_dbm: NDArray[np.float32]
    range_m: NDArray[np.float64]
    error_m: NDArray[np.float64]
    configurations: NDArray[np.str_]
    labels: NDArray[np.str_]
    skipped: Mapping[str, int] = field(default_factory=dict)
    headers: NDArray[np.float32] | None = None
    tags: NDArray[np.uint64] | None = None
    anchors: NDArray[np.uint64] | None = None
    radios: tuple[RadioType, ...] = (RadioType.DW1000,)
    segments: tuple[Segment, ...] = (Segment.IPATOV,)
    channels: tuple[int, ...] = ()
    early_path_m: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.error_m)

    @property
    def has_cirs(self) -> bool:
        """Whether the measurements have CIRs; without, all inputs are zero."""
        return len(self) > 0 and bool(self.inputs[0].any())

    def rows(self, selected: NDArray[np.intp] | NDArray[np.bool_]) -> Dataset:
        """Return a dataset with these rows."""
        return replace(self.take(selected), skipped={})

    def with_early_paths(self, predicted_m: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the output of a network, (n,), m, with missed direct paths in place of it."""
        if self.early_path_m is None:
            return predicted_m
        is_far_enough = self.range_m - self.early_path_m >= MIN_RANGE_M  # False for NaN.
        return np.where(is_far_enough, self.early_path_m, predicted_m)

    @property
    def names(self) -> list[str]:
        """Return the sorted configurations."""
        return [str(name) for name in np.unique(self.configurations)]


CirSource = tuple[RadioType, Segment, int]


def source_of(cir: Cir) -> CirSource:
    """Return radio, segment (0: no samples) and channel; unknown radios and segments are those of earlier versions: DW1000, IPATOV."""
    segment = (cir.segment or Segment.IPATOV) if len(cir) else Segment.UNKNOWN
    return cir.radio or RadioType.DW1000, segment, cir.channel


def source_fields(sources: Iterable[CirSource]) -> dict[str, Any]:
    """Return the fields of a `Dataset` for one source or more; no channels if one is unknown."""
    radios, segments, channels = (tuple(sorted(set(column))) for column in zip(*sources, strict=True))
    known = tuple(filter(None, segments)) or (Segment.IPATOV,)
    return {"radios": radios, "segments": known, "channels": () if 0 in channels else channels}


class _Row(NamedTuple):
    """A labelled measurement with its window, and the error of a missed direct path, m (NaN: none)."""

    measurement: RangeMeasurement
    truth: Truth
    window: NDArray[np.float32]
    early_path_m: float


def build_dataset(records: Iterable[Record], preprocessing: Preprocessing) -> Dataset:
    """Preprocess every measurement that has a true range; count the others by reason.

    If no measurement has a CIR, the inputs are zero. If some have one, only those are used.

    Raises:
        DatasetError: no measurement is usable.
    """
    skipped: Counter[str] = Counter()
    rows: list[_Row] = []
    without_cir: list[_Row] = []
    no_window = np.zeros(preprocessing.samples, np.float32)
    for record, fault, window, early_m in _preprocessed(records, preprocessing):
        measurement, truth = record.measurement, record.truth
        if truth is None or not math.isfinite(truth.range_m):
            skipped["no true range"] += 1
        elif not (math.isfinite(measurement.range_m) and measurement.range_m >= 0):
            skipped["no valid range"] += 1
        elif fault == CirFault.EMPTY and not rows:
            without_cir.append(_Row(measurement, truth, no_window, math.nan))
        elif fault:
            skipped[CirFault(fault).text] += 1
        else:
            rows.append(_Row(measurement, truth, window, early_m))
    if rows or skipped[CirFault.EMPTY.text]:
        skipped[CirFault.EMPTY.text] += len(without_cir)
    else:
        rows = without_cir
    skipped = +skipped
    if not rows:
        reasons = ", ".join(f"{count} x {reason}" for reason, count in skipped.items()) or "no measurements"
        raise DatasetError(f"no labelled measurement that can be used: {reasons}")
    return _dataset_of(rows, preprocessing, skipped)


def _dataset_of(rows: Sequence[_Row], preprocessing: Preprocessing, skipped: Mapping[str, int]) -> Dataset:
    measurements, truths, windows, early_paths = zip(*rows, strict=True)
    range_m = np.array([measurement.range_m for measurement in measurements], np.float64)
    cirs = [measurement.cir for measurement in measurements]
    return Dataset(
        preprocessing,
        np.stack(windows),
        _power(np.array([cir.rx_power_dbm for cir in cirs], np.float64)),
        _power(np.array([cir.first_path_power_dbm for cir in cirs], np.float64)),
        range_m,
        range_m - np.array([truth.range_m for truth in truths], np.float64),
        np.array([truth.configuration for truth in truths]),
        np.array([truth.label for truth in truths]),
        dict(skipped),
        np.array([(cir.preamble_count, cir.noise_threshold) for cir in cirs], np.float32),
        tags=np.array([measurement.tag_id for measurement in measurements], np.uint64),
        anchors=np.array([measurement.anchor_id for measurement in measurements], np.uint64),
        early_path_m=np.array(early_paths, np.float32),
        **source_fields(map(source_of, cirs)),
    )


def _preprocessed(
    records: Iterable[Record], preprocessing: Preprocessing
) -> Iterator[tuple[Record, int, NDArray[np.float32], float]]:
    """Yield each record with the `CirFault` of its CIR (0: none), its window, and the error of a missed direct path."""
    stream = iter(records)
    while batch := list(islice(stream, _BATCH)):
        measurements = [record.measurement for record in batch]
        faults, windows = preprocessing.windows_of(measurements)
        early_m = np.full(len(batch), np.nan, np.float32)
        for indices, ranges in RangeColumns.grouped(measurements):
            rows = np.flatnonzero(np.array(faults)[indices] == 0)
            early_m[np.array(indices)[rows]] = early_path_error_m(ranges, rows, preprocessing.samples)
        yield from zip(batch, faults, windows, early_m.tolist(), strict=True)


def _power(levels: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return levels as float32, NaN if not finite: logs contain -inf if no signal was received."""
    return np.where(np.isfinite(levels), levels, np.nan).astype(np.float32)
