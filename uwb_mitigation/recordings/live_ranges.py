"""Measurements from single messages or lines as they arrive, with a mapping file."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from uwb_mitigation.errors import ParameterError, RecordingError
from uwb_mitigation.recordings.mapping import conversion
from uwb_mitigation.recordings.mapping.mapping import LIST_INDEX, TOPIC, Mapping
from uwb_mitigation.recordings.mapping.messages import MessageRows
from uwb_mitigation.types.measurement import Cir, RangeMeasurement


class LiveConverter:
    """Converts messages or lines one by one.

    Args:
        mapping: the mapping.
        what: kind of the input, for errors: topics, or lines.

    Attributes:
        counts: {reason: number of rows that were not used}.

    Raises:
        ParameterError: the mapping needs a whole recording.
    """

    def __init__(self, mapping: Mapping, what: str) -> None:
        # Ids by order of appearance may change with each start, and one message has no useful median.
        for refused, why, valid in (
            (mapping.fields.tag.names or mapping.fields.anchor.names, "numbers texts (names)", "values"),
            (any(r.from_median is not None for r in mapping.drop), "drops by from_median", "above, below"),
        ):
            if refused:
                raise ParameterError(f"the mapping {mapping.name} {why}", valid=f"for {what}: {valid}")
        self.counts: Counter[str] = Counter()
        self._mapping, self._rows_seen = mapping, 0
        stamp = mapping.fields.stamp
        # The number of a row is a time in recordings only.
        untimed = {"stamp": None} if stamp is not None and stamp.rate_hz else {}
        self._converter = conversion.Converter(mapping.values | untimed)
        extra_columns = [*mapping.cir_columns, *(rule.column for rule in mapping.drop)]
        self._rows = MessageRows(mapping, self._converter.columns | dict.fromkeys(extra_columns, False))

    def measurements(self, message: Any, where: str, now_ns: int) -> list[RangeMeasurement]:
        """Return the ranges of a message or line; a stamp that is missing or 0 is replaced by `now_ns`.

        Raises:
            RecordingError: it does not match the mapping; or one of `UNREADABLE`.
        """
        rows = self._rows.rows(message)
        count = len(rows[LIST_INDEX])
        rows |= {conversion.LOG_TIME: [now_ns] * count, TOPIC: [where] * count}
        columns = {column: _array(values) for column, values in rows.items()}
        chunk = conversion.Chunk(columns, count, where, np.arange(count))
        rules = conversion.filter_rows(self._mapping.drop, chunk)
        chunk = chunk.take(conversion.count_kept(rules, count, self.counts))
        if not chunk.count:
            return []
        values = self._converter.convert(chunk)
        # Radios without a synchronised clock send a zero stamp.
        values["stamp"][values["stamp"] <= 0] = now_ns
        rules = conversion.unknown_rows(values) | conversion.impossible_rows(values)
        rows_used = np.flatnonzero(conversion.count_kept(rules, chunk.count, self.counts)).tolist()
        first, self._rows_seen = self._rows_seen, self._rows_seen + chunk.count
        kind = self._mapping.cir_kind
        return [
            conversion.measurement(values, row, self._cir(chunk, row), kind, first + row) for row in rows_used
        ]

    def _cir(self, chunk: conversion.Chunk, row: int) -> Cir:
        if (source := self._mapping.cir) is None or source.files:
            return conversion.NO_CIR
        try:
            imaginary = chunk.columns[source.imaginary][row] if source.imaginary else None
            return conversion.read_cir(chunk.columns[source.column][row], source.samples, imaginary)
        except (RecordingError, ValueError) as error:
            self.counts[f"not a CIR: {error!s:.80}"] += 1
            return conversion.NO_CIR


def _array(values: list[Any]) -> Any:
    """Return single values as an array, and lists unchanged."""
    is_list = values and hasattr(values[0], "__len__") and not isinstance(values[0], str)
    return values if is_list else np.asarray(values)
