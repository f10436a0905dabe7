"""Measurements from single messages or lines as they arrive, with a mapping file."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.recordings.mapping.chunks import LOG_TIME, Chunk
from uwb_mitigation.recordings.mapping.conversion import (
    NO_CIR,
    Converter,
    count_bad,
    filter_rows,
    impossible_rows,
    measurement,
    samples_of,
    unknown_rows,
)
from uwb_mitigation.recordings.mapping.mapping import LIST_INDEX, TOPIC, Mapping
from uwb_mitigation.recordings.mapping.messages import MessageRows
from uwb_mitigation.types.measurement import (
    LINEAR_MAGNITUDES,
    Cir,
    Encoding,
    RangeMeasurement,
    is_logarithmic,
)


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
        self._converter = Converter(mapping.values | untimed)
        extra_columns = [*mapping.cir_columns, *(rule.column for rule in mapping.drop)]
        self._rows = MessageRows(mapping, self._converter.columns | dict.fromkeys(extra_columns, False))

    def measurements(self, message: Any, where: str, now_ns: int) -> list[RangeMeasurement]:
        """Return the ranges of a message or line; a stamp that is missing or 0 is replaced by `now_ns`.

        Raises:
            RecordingError: it does not match the mapping; or one of `UNREADABLE`.
        """
        rows = self._rows.rows(message)
        count = len(rows[LIST_INDEX])
        rows |= {LOG_TIME: [now_ns] * count, TOPIC: [where] * count}
        columns = {column: _array(values) for column, values in rows.items()}
        chunk = Chunk(columns, count, where, np.arange(count))
        chunk = chunk.take(filter_rows(self._mapping.drop, chunk, self.counts))
        if not chunk.count:
            return []
        values = self._converter.convert(chunk)
        # Radios without a synchronised clock send a zero stamp.
        values["stamp"][values["stamp"] <= 0] = now_ns
        reasons = unknown_rows(values) | impossible_rows(values)
        unknown = [count_bad(bad, self.counts, reason) for reason, bad in reasons.items()]
        rows_used = np.flatnonzero(~np.any(unknown, axis=0)).tolist()
        self._rows_seen += chunk.count
        first = self._rows_seen - chunk.count
        return [measurement(values, row, self._cir(chunk, row), first + row) for row in rows_used]

    def _cir(self, chunk: Chunk, row: int) -> Cir:
        source = self._mapping.cir
        if source is None or source.files:
            return NO_CIR
        samples, encoding, scale = samples_of(chunk.columns[source.column][row], source.samples)
        if encoding is Encoding.MAGNITUDE and is_logarithmic(samples):
            self.counts[f"CIR in dB; valid: {LINEAR_MAGNITUDES}"] += 1
            return NO_CIR
        return Cir(samples, encoding, scale=scale)


def _array(values: Any) -> Any:
    """Return single values as an array, and lists unchanged."""
    return (
        values
        if len(values) and hasattr(values[0], "__len__") and not isinstance(values[0], str)
        else np.asarray(values)
    )
