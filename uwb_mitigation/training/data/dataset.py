"""Labelled measurements as arrays, for training, calibration and baselines."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.preprocessing import CirFault, Preprocessing
from uwb_mitigation.types.measurement import Cir, RadioType, RangeMeasurement, Record, Segment, Truth

_BATCH = 256

_COLUMNS = (
    *("inputs", "rx_power_dbm", "first_path_power_dbm", "range_m", "error_m", "configurations", "labels"),
    *("headers", "tags", "anchors"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
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
        tags, anchors: ids, int (n,), for splits by location; None = not kept.
        radios, segments: known sources of the CIRs.
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

    def __len__(self) -> int:
        return len(self.error_m)

    @property
    def has_cirs(self) -> bool:
        """Whether the measurements have CIRs; without, all inputs are zero."""
        return len(self) > 0 and bool(self.inputs[0].any())

    def rows(self, selected: NDArray[np.intp] | NDArray[np.bool_]) -> Dataset:
        """Return a dataset with these rows."""
        columns = {name: getattr(self, name) for name in _COLUMNS}
        selected_columns: dict[str, Any] = {
            name: None if values is None else values[selected] for name, values in columns.items()
        }
        return replace(self, skipped={}, **selected_columns)

    def shifted(self, by_m: NDArray[np.float64]) -> Dataset:
        """Return a copy with `by_m`, shape (n,), added to ranges and errors."""
        return replace(self, range_m=self.range_m + by_m, error_m=self.error_m + by_m)

    @classmethod
    def joined(cls, parts: Sequence[Dataset]) -> Dataset:
        """Concatenate parts with the same preprocessing, without headers and ids."""
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(selected_columns, name) for selected_columns in parts])
            for name in _COLUMNS[:7]
        }
        return cls(parts[0].preprocessing, **columns)

    @property
    def names(self) -> list[str]:
        """Return the sorted configurations."""
        return [str(name) for name in np.unique(self.configurations)]


class CirSources:
    """Collects the radios and segments of CIRs; unknown ones are those of earlier versions: DW1000, IPATOV."""

    def __init__(self) -> None:
        self._radios: set[RadioType] = set()
        self._segments: set[Segment] = set()

    def add(self, cir: Cir) -> None:
        """Add a CIR; without samples it has no segment."""
        self._radios.add(cir.radio or RadioType.DW1000)
        if len(cir):
            self._segments.add(cir.segment or Segment.IPATOV)

    @property
    def radios(self) -> tuple[RadioType, ...]:
        """All radios."""
        return tuple(sorted(self._radios))

    @property
    def segments(self) -> tuple[Segment, ...]:
        """All segments."""
        return tuple(sorted(self._segments)) or (Segment.IPATOV,)


def build_dataset(
    records: Iterable[Record], preprocessing: Preprocessing, on_record: Callable[[], None] = lambda: None
) -> Dataset:
    """Preprocess every measurement that has a true range; count the others by reason.

    If no measurement has a CIR, the inputs are zero. If some have one, only those are used.

    `on_record` is called with each record that was read.

    Raises:
        DatasetError: no measurement is usable.
    """
    skipped: Counter[str] = Counter()
    inputs, values, headers, ids, configurations, labels = [], [], [], [], [], []
    without_cir: list[tuple[RangeMeasurement, Truth]] = []
    sources = CirSources()

    def add(measurement: RangeMeasurement, truth: Truth, window: NDArray[np.float32]) -> None:
        inputs.append(window)
        sources.add(measurement.cir)
        values.append(
            (
                measurement.cir.rx_power_dbm,
                measurement.cir.first_path_power_dbm,
                measurement.range_m,
                measurement.range_m - truth.range_m,
            )
        )
        headers.append((measurement.cir.preamble_count, measurement.cir.noise_threshold))
        ids.append((measurement.tag_id, measurement.anchor_id))
        configurations.append(truth.configuration)
        labels.append(truth.label)

    for record, fault, window in _preprocessed(records, preprocessing, on_record):
        measurement, truth = record.measurement, record.truth
        if truth is None or not math.isfinite(truth.range_m):
            skipped["no true range"] += 1
            continue
        if not (math.isfinite(measurement.range_m) and measurement.range_m >= 0):
            skipped["no valid range"] += 1
            continue
        if fault == CirFault.EMPTY and not inputs:
            without_cir.append((measurement, truth))
        elif fault:
            skipped[CirFault(fault).text] += 1
        else:
            add(measurement, truth, window)
    if inputs or skipped[CirFault.EMPTY.text]:
        skipped[CirFault.EMPTY.text] += len(without_cir)
    else:
        for measurement, truth in without_cir:
            add(measurement, truth, np.zeros(preprocessing.samples, np.float32))
    skipped = +skipped
    if not inputs:
        reasons = ", ".join(f"{count} x {reason}" for reason, count in skipped.items()) or "no measurements"
        raise DatasetError(f"no labelled measurement that can be used: {reasons}")
    rx_power, first_path_power, range_m, error_m = np.array(values, np.float64).T
    tags, anchors = np.array(ids, np.uint64).T
    return Dataset(
        preprocessing,
        np.stack(inputs),
        _power(rx_power),
        _power(first_path_power),
        range_m,
        error_m,
        np.array(configurations),
        np.array(labels),
        dict(skipped),
        np.array(headers, np.float32),
        tags=tags,
        anchors=anchors,
        radios=sources.radios,
        segments=sources.segments,
    )


def _preprocessed(
    records: Iterable[Record], preprocessing: Preprocessing, on_record: Callable[[], None]
) -> Iterator[tuple[Record, int, NDArray[np.float32]]]:
    """Yield each record with the `CirFault` of its CIR, 0 if there is none, and its window."""
    stream = iter(records)
    while batch := list(islice(stream, _BATCH)):
        for record, fault, window in zip(
            batch, *preprocessing.windows_of([record.measurement for record in batch]), strict=True
        ):
            on_record()
            yield record, fault, window


def _power(levels: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return levels as float32, NaN if not finite: logs contain -inf if no signal was received."""
    return np.where(np.isfinite(levels), levels, np.nan).astype(np.float32)
