"""Rows as the readers of all formats return them, and their values in SI units."""

from __future__ import annotations

import contextlib
import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.recordings.mapping.mapping import LIST_INDEX, SCALES, TIME, FieldRule, RowFilter
from uwb_mitigation.types.measurement import (
    LINEAR_MAGNITUDES,
    Cir,
    Encoding,
    RadioType,
    RangeMeasurement,
    Segment,
    int16_samples,
    is_logarithmic,
)
from uwb_mitigation.types.stamps import NS_PER_S

LOG_TIME = "@stamp"
"""Column with the time at which a message was recorded, ns."""

UNREADABLE = (OSError, ValueError, TypeError, KeyError, EOFError, OverflowError, NotImplementedError)
"""Errors of values that do not have the expected form."""

_MISSING = frozenset(("", "-", "nan", "nat", "none", "null", "n/a", "na"))
"""Texts that mean an unknown value."""

UNKNOWN_ID = (1 << 64) - 1
UNKNOWN_STAMP = np.iinfo(np.int64).min
"""Id and stamp of a row without one."""

_HINTS = (
    (r"[-+]?[\d.]*,\d+$", "decimal commas: set decimal: ','"),
    (r"\d{4}-\d\d-\d\d|\d{1,2}:\d\d", "dates: set unit: iso8601"),
    (
        r"\d{1,2}([/.-])\d{1,2}\1\d{2,4}",
        "dates: set unit: '%d/%m/%Y %H:%M:%S', in the order of the file; with a fraction %S.%f",
    ),
    (r"[#%;]|//", "comments: set comment: '#'; other lines: drop them with `matches`"),
    (r"[-+]?\d[\d.]*\s*[^\d.]", r"a number in a text: set pattern: '([-\d.]+)'"),
)
"""Forms of texts that are not numbers, and what a mapping needs."""

MAX_STAMP_S = 4.6e9
"""Stamps are within the years 1824 to 2115, so that differences fit into 64 bits."""

_VALID_IDS = "a whole number such as 3 or 0x1f; otherwise set `hex: true`, `pattern` or `names: true`"
NO_CIR = Cir(np.zeros(0, np.int16))
_TIME_OF_DAY = r"\d{1,2}:\d\d:\d\d(\.\d+)?"
_LEVEL_OFFSETS = {16: 113.77, 64: 121.74}
"""Constant A of the DW1000's levels by PRF in MHz (user manual, section 4.7)."""

MAX_POSSIBLE = 10_000.0
"""Rows with a larger range (m), level (dBm) or first-path index are not used."""

MAX_NEGATIVE = 0.2
"""Largest share of negative magnitudes; of real and imaginary parts, about half are negative."""

_LIMITED = ("range", "true range", "rx_power", "first_path_power", "first_path_index")

Mask = NDArray[np.bool_]
ColumnDict = dict[str, NDArray[Any]]
"""{name: array (n,)} in SI units. `stamp`: ns, int64; `tag`, `anchor`: uint64; `label`, `configuration`: texts; others, such
as `range`, `true range` and `tag x`: float64, NaN: unknown."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Rows of one file.

    Attributes:
        columns: {name: array or list}.
        count: number of rows.
        path: the file, or the topic.
        rows: int64 (count,), numbers of the rows in the file, from 0.
        before: number of rows in the files before.
    """

    columns: Mapping[str, Any]
    count: int
    path: Path | str
    rows: NDArray[np.int64]
    before: int = 0

    def where(self, row: int) -> str:
        """Return the location of a row for errors."""
        return f"{self.path}: row {self.rows[row] + 1}"

    def take(self, mask: NDArray[np.bool_]) -> Chunk:
        """Return the chosen rows."""
        if mask.all():
            return self
        items = self.columns.items()
        columns = {n: v[mask] if isinstance(v, np.ndarray) else [*compress(v, mask)] for n, v in items}
        return Chunk(columns, int(mask.sum()), self.path, self.rows[mask], self.before)


def concat(tables: list[ColumnDict]) -> ColumnDict:
    """Concatenate tables with the same columns, and empty them to save memory."""
    columns = {}
    for name in list(tables[0]):
        arrays = [table.pop(name) for table in tables]
        arrays = [array for array in arrays if len(array)] or arrays
        if all(array.strides == (0,) for array in arrays):
            columns[name] = np.broadcast_to(arrays[0][:1], sum(map(len, arrays)))
        else:
            columns[name] = np.concatenate(arrays)
    return columns


def take(columns: ColumnDict, rows: NDArray[Any]) -> ColumnDict:
    """Return the rows of a mask or of indices, and empty `columns` to save memory."""
    if rows.dtype == bool and rows.all():
        return columns
    count = int(np.count_nonzero(rows)) if rows.dtype == bool else len(rows)
    constant = [name for name, column in columns.items() if column.strides == (0,)]
    constants = {name: np.broadcast_to(columns.pop(name)[:1], count) for name in constant}
    return constants | {name: columns.pop(name)[rows] for name in list(columns)}


def measurement(
    columns: ColumnDict, row: int, cir: Cir, kind: tuple[RadioType, Segment], sequence: int
) -> RangeMeasurement:
    """Return one range with the samples of `cir` and its own levels; `sequence` is used if the columns have none."""

    def number(name: str) -> float:
        return float(columns[name][row])

    count = number("sequence")
    counter = (int(count) if math.isfinite(count) else sequence) & 0xFFFFFFFF
    fields: dict[str, Any] = {
        "first_path_index": number("first_path_index"), "preamble_count": _integer(number("preamble_count"), 65535),
        "rx_power_dbm": number("rx_power"), "first_path_power_dbm": number("first_path_power"),
        "channel": _integer(number("channel"), 255), "radio": kind[0], "segment": kind[1],
    }  # fmt: skip
    stamp, tag, anchor = (int(columns[name][row]) for name in ("stamp", "tag", "anchor"))
    return RangeMeasurement(stamp, tag, anchor, counter, 0, number("range"), replace(cir, **fields))


def _integer(value: float, limit: int) -> int:
    return int(value) if 0 <= value <= limit else 0


@dataclass(slots=True)
class Converter:
    """Converts the rows of a table.

    Args:
        values: the columns of the result; None: unknown.
        names: numbers of named tags and anchors.
        ids: the values that are ids.
    """

    values: Mapping[str, FieldRule | None]
    names: dict[str, int] = field(default_factory=dict)
    ids: Collection[str] = ("tag", "anchor")

    @property
    def columns(self) -> dict[str, bool | None]:
        """Return the columns of the table that are needed, and whether they may be missing; see `MessageRows`."""
        columns: dict[str, bool | None] = {}
        for value in filter(None, self.values.values()):
            columns |= {name: value.optional and columns.get(name, True) for name in value.columns}
            if value.or_index:
                columns[value.column] = None
        return columns

    @property
    def id_columns(self) -> set[str]:
        """Return the columns of the table that contain ids."""
        return {column for name in self.ids if (value := self.values.get(name)) for column in value.columns}

    def convert(self, chunk: Chunk) -> ColumnDict:
        """Return the values of all rows of a chunk.

        Raises:
            RecordingError: an id or a number cannot be read; `where` names the row.
        """
        columns: ColumnDict = {}
        try:
            for name, value in self.values.items():
                if name == "stamp":
                    columns[name] = read_stamps(value, chunk)
                elif name in self.ids:
                    columns[name] = _read_ids(value or FieldRule(constant=1), chunk, name, self.names)
                elif name in ("label", "configuration"):
                    columns[name] = _read_texts(value, chunk, name)
                else:
                    columns[name] = read_numbers(value, chunk, name)
                for anchor, unit in (value.units if value else {}).items():
                    factor = SCALES[unit] / SCALES[value.unit or "m"] if value else 1.0
                    columns[name] = columns[name] * np.where(columns["anchor"] == anchor, factor, 1.0)
        except UNREADABLE as error:
            raise RecordingError(f"{name} cannot be read: {error!s:.200}", where=chunk.path) from error
        if "cir_power" in columns:
            _add_levels(columns)
        return columns


def _add_levels(columns: ColumnDict) -> None:
    """Compute both levels from the registers of a DW1000."""
    count = columns["preamble_count"]
    constant = np.where(columns["prf"] == 16, _LEVEL_OFFSETS[16], _LEVEL_OFFSETS[64])
    first = sum(columns[f"amplitude {n}"] ** 2 for n in (1, 2, 3))
    for name, power in (("rx_power", columns["cir_power"] * 2.0**17), ("first_path_power", first)):
        with np.errstate(divide="ignore", invalid="ignore"):
            level = 10 * np.log10(power / count**2) - constant
        columns[name] = np.where(np.isfinite(level), level, columns[name])


def _read_texts(value: FieldRule | None, chunk: Chunk, name: str) -> NDArray[Any]:
    """Return a value as texts (n,), after `pattern` and `values`; empty: unknown."""
    if value is None or (raw := _raw(value, chunk)) is None:
        return np.broadcast_to(np.array([""], object), chunk.count)
    return _map_distinct(raw, chunk, lambda cell, where: _text(value, cell, name, where), object)


def _map_distinct(
    raw: NDArray[Any], chunk: Chunk, read: Callable[[Any, str], Any], kind: type
) -> NDArray[Any]:
    """Apply a function to each distinct value of a column and its first location."""
    results: dict[Any, Any] = {}
    for row, cell in enumerate(cells := raw.tolist()):
        if cell not in results:
            results[cell] = read(cell, chunk.where(row))
    return np.array([results[cell] for cell in cells], kind)


def _cell_text(cell: Any) -> str:
    # None and NaN are missing values. Tables read integers in a column with missing values as floats.
    if cell is None or cell != cell:
        return ""
    return str(int(cell)) if isinstance(cell, float) and cell.is_integer() else str(cell).strip()


def _text(value: FieldRule, cell: Any, name: str, where: str) -> str:
    text = _cell_text(cell)
    for pattern in filter(None, (value.file_name or value.topic_name, value.pattern)):
        if text.lower() not in _MISSING:
            match = re.search(pattern, text)
            if match is None and not value.optional:
                what = f"{name} = {text!r:.60} does not match {pattern!r}"
                raise RecordingError(what, where=where, valid="optional: true makes it unknown")
            text = (match[1] if match else None) or ""
    return value.values.get(text, text)


def read_numbers(value: FieldRule | None, chunk: Chunk, name: str) -> NDArray[np.float64]:
    """Return a value in SI units, float64 (n,); NaN: unknown.

    Raises:
        RecordingError: a text is not a number; `where` names its row.
    """
    if value is None or (raw := _raw(value, chunk)) is None:
        return np.broadcast_to(np.nan, chunk.count)
    if value.is_text:
        raw = _read_texts(value, chunk, name)
    numbers = _floats(raw, chunk, name, value.column)
    with np.errstate(over="ignore", invalid="ignore"):
        numbers = numbers * SCALES.get(value.unit, 1.0) * value.scale + value.offset
    numbers[~np.isfinite(numbers)] = np.nan
    return numbers


def _floats(raw: NDArray[Any], chunk: Chunk, name: str, column: str) -> NDArray[np.float64]:
    with np.errstate(all="ignore"), contextlib.suppress(ValueError, TypeError):
        return raw.astype(np.float64)
    import pandas as pd

    texts = pd.Series([str(item).strip() for item in raw.tolist()], dtype=object)
    numbers = np.array(pd.to_numeric(texts, errors="coerce"), np.float64)
    for row in np.flatnonzero(np.isnan(numbers) & ~texts.str.lower().isin(_MISSING))[:1].tolist():
        hints = [hint for form, hint in _HINTS if re.match(form, texts[row])]
        what = f"{name} = {texts[row]!r:.40} is not a number"
        valid = [*hints, f"a number in column {column}"][0]
        raise RecordingError(what, where=chunk.where(row), valid=valid)
    return numbers


def _raw(value: FieldRule, chunk: Chunk) -> NDArray[Any] | None:
    """Return the unconverted values of the rows; None: the column is optional and missing."""
    if value.rate_hz:
        return np.asarray((chunk.before + chunk.rows) / value.rate_hz)
    if value.constant is not None:
        return np.full(chunk.count, value.constant)
    names = list(value.sum) or [value.source]
    if missing := [name for name in names if name not in chunk.columns]:
        if value.optional:
            return None
        raise RecordingError(f"no column {missing[0]}", where=chunk.path)
    arrays = [np.asarray(chunk.columns[name]) for name in names]
    for name, array in zip(names, arrays, strict=True):
        if array.ndim > 1 or (array.dtype == object and len(array) and np.ndim(array[0])):
            raise RecordingError(f"column {name} contains lists", where=chunk.path, valid=f"{name}[]")
    if value.or_index:
        index = chunk.columns[LIST_INDEX]
        return np.array(
            [number if cell is None else cell for cell, number in zip(arrays[0], index, strict=True)]
        )
    if not value.sum:
        return arrays[0]
    factors = zip(value.sum.items(), arrays, strict=True)
    terms = [factor * _floats(array, chunk, name, name) for (name, factor), array in factors]
    return np.asarray(np.sum(terms, axis=0))


def read_stamps(value: FieldRule | None, chunk: Chunk) -> NDArray[np.int64]:
    """Return stamps in ns, int64 (n,); `UNKNOWN_STAMP`: unknown.

    Raises:
        RecordingError: a text is not a date or number; or most stamps are impossible, so that the unit is wrong.
    """
    if value is None or (raw := _raw(value, chunk)) is None:
        if LOG_TIME in chunk.columns:
            return np.asarray(chunk.columns[LOG_TIME], np.int64)
        raise RecordingError("no stamp", where=chunk.path, valid="fields.stamp: a column, or rate_hz")
    if value.unit == "iso8601" or "%" in value.unit:
        stamps, is_known = _dates(raw, value.unit, chunk)
        possible = is_known & (np.abs(stamps / 1e9) < MAX_STAMP_S)
        raw = stamps / NS_PER_S
    else:
        # Without a unit: seconds; the stamp of a message is an integer in nanoseconds.
        is_stamp = LOG_TIME in chunk.columns and raw.dtype.kind in "iu"
        factor = TIME[value.unit or ("ns" if is_stamp else "s")]
        scaled = _floats(raw, chunk, "stamp", value.column) * value.scale
        is_known = np.isfinite(scaled)
        possible = is_known & (np.abs(scaled) < MAX_STAMP_S * 1e9 / factor)
        if raw.dtype.kind in "iu" and value.scale == 1.0:
            # As integers, because a float64 resolves nanoseconds since 1970 to 256 ns only.
            stamps = np.where(possible, raw, 0).astype(np.int64) * factor
        else:
            scaled = np.where(possible, scaled, 0.0)
            seconds = np.floor(scaled)
            # A float64 resolves seconds since 1970 to 0.2 us only: round them to 1 us.
            step = np.where((np.abs(seconds) > 1e8) & (factor == TIME["s"]), 1000, 1)
            fraction = np.rint((scaled - seconds) * factor / step).astype(np.int64) * step
            stamps = seconds.astype(np.int64) * factor + fraction
    if 2 * np.count_nonzero(possible) < np.count_nonzero(is_known):
        first = raw[np.flatnonzero(is_known & ~possible)[0]]
        dates_s = [(unit, abs(float(first) * TIME[unit] / 1e9)) for unit in ("s", "ms", "us", "ns")]
        unit = next((f"unit: {unit}" for unit, date_s in dates_s if 9e8 < date_s < MAX_STAMP_S), "")
        what, valid = f"stamp = {first} is outside of the years 1824 to 2115", unit or "seconds since 1970"
        raise RecordingError(what, where=chunk.path, valid=valid)
    possible &= np.abs(stamps / 1e9 + value.offset) < MAX_STAMP_S
    offset = round(min(max(value.offset, -MAX_STAMP_S), MAX_STAMP_S) * 1e9)
    return np.where(possible, stamps + offset, UNKNOWN_STAMP)


def _dates(raw: NDArray[Any], unit: str, chunk: Chunk) -> tuple[NDArray[np.int64], Mask]:
    """Return the stamps of dates in ns, and which are known; times without a date are on 1970-01-01."""
    import pandas as pd

    # Python's logging writes a comma.
    texts = pd.Series([str(cell).strip().replace(",", ".") for cell in raw.tolist()], dtype=object)
    if unit == "iso8601":
        times = pd.to_datetime(texts, utc=True, errors="coerce", format="ISO8601").dt.as_unit("ns")
        of_day = pd.to_timedelta(texts.where(texts.str.fullmatch(_TIME_OF_DAY)), errors="coerce")
        times = times.fillna((pd.Timestamp(0, tz="UTC") + of_day).dt.as_unit("ns"))
    else:
        times = pd.to_datetime(texts, utc=True, errors="coerce", format=unit)
        if not re.search("%[YyGcx]", unit):
            times -= pd.Timestamp(1900, 1, 1) - pd.Timestamp(0)
    is_known = times.notna().to_numpy()
    for row in np.flatnonzero(~is_known & ~texts.str.lower().isin(_MISSING).to_numpy())[:1].tolist():
        valid = "2024-06-09T19:39:13.43, 19:39:13.43, or a format such as unit: '%d/%m/%Y %H:%M:%S.%f'"
        raise RecordingError(f"stamp = {raw[row]!r:.40} is not a date", where=chunk.where(row), valid=valid)
    return times.dt.tz_convert(None).to_numpy("datetime64[ns]").astype(np.int64), is_known


def _read_ids(value: FieldRule, chunk: Chunk, name: str, names: dict[str, int]) -> NDArray[np.uint64]:
    """Return ids, uint64 (n,); `UNKNOWN_ID`: unknown; `names` numbers the texts of `names: true`."""
    raw = _raw(value, chunk)
    if raw is None:
        raise RecordingError(f"no column {value.source} for the {name}", where=chunk.path)
    is_converted = value.is_text or value.hex or value.names or value.offset or value.scale != 1
    if raw.dtype.kind in "iu" and not is_converted and raw.min(initial=0) >= 0:
        return np.asarray(raw, np.uint64)

    def read(item: Any, where: str) -> int:
        text = _text(value, item, name, where)
        if text.lower() in _MISSING:
            return UNKNOWN_ID
        with contextlib.suppress(ValueError):
            number = names.setdefault(text, len(names) + 1) if value.names else _id(text, value.hex)
            number = round(number * value.scale if value.scale != 1 else number) + round(value.offset)
            # A float64 merges larger ids.
            if 0 <= number < (2**53 if isinstance(item, float) else UNKNOWN_ID):
                return number
        raise RecordingError(f"{name} = {item!r:.40} is not an id", where=where, valid=_VALID_IDS)

    return _map_distinct(raw, chunk, read, np.uint64)


def _id(text: str, is_hex: bool) -> int:
    if re.fullmatch(r"[0-9a-fA-F]{2}([:-][0-9a-fA-F]{2}){1,7}", text):
        return int(re.sub("[:-]", "", text), 16)
    if is_hex or text.lower().startswith("0x"):
        return int(text, 16)
    # A column with unknown values contains texts such as 10.0.
    if not (match := re.fullmatch(r"\+?([0-9]+)(\.0+)?", text)):
        raise ValueError(text)
    return int(match[1])


_PAIR = re.compile(r"[\[(]\s*[-+.\de]+\s*[,;\s]\s*[-+.\de]+\s*[\])]", re.IGNORECASE)

_COMPLEX_FORMS = "cir.samples: interleaved, or complex numbers; cir.imaginary: the column of imaginary parts"


def read_cir(values: Any, form: str, imaginary: Any = None) -> Cir:
    """Return one CIR as int16 samples with the scale that restores the values; NaN: without samples.

    Args:
        values: the samples, or their real parts.
        form: see `CirSource.samples`.
        imaginary: their imaginary parts; None: they are in `values`.

    Raises:
        RecordingError: the values are in dB, real and imaginary parts instead of magnitudes, or real parts only.
        ValueError: the values are not numbers.
    """
    if (
        isinstance(values, str)
        and form == "complex"
        and _PAIR.search(values)
        and not _PAIR.sub("", values).strip("[](), ;")
    ):
        form = "interleaved"  # pairs such as [[1, 2], [3, 4]]
    array = _samples(values, form)
    if imaginary is not None:
        form, second = "complex", _samples(imaginary, form)
        if array.shape != second.shape:
            what = f"{len(array)} real and {len(second)} imaginary parts"
            raise RecordingError(what, valid="as many imaginary as real parts")
        array = array + 1j * second
    if form == "complex":
        if array.ndim == 1 and len(array) and not np.iscomplexobj(array):
            raise RecordingError("real numbers instead of complex ones", valid=_COMPLEX_FORMS)
        # Rows of real and imaginary parts, or numbers.
        is_pairs = array.ndim == 2 and not np.iscomplexobj(array)
        array = (array.astype(np.float64) @ (1, 1j) if is_pairs else array).astype(np.complex128)
    elif np.iscomplexobj(array):
        array = np.abs(array)
    (samples,), (scale,) = int16_samples(array.reshape(1, -1))
    if np.isnan(scale):
        return NO_CIR
    encoding = Encoding.MAGNITUDE if form == "magnitude" else Encoding.COMPLEX_INT16
    if encoding is Encoding.MAGNITUDE and is_logarithmic(samples):
        raise RecordingError("a CIR in dB", valid=LINEAR_MAGNITUDES)
    if encoding is Encoding.MAGNITUDE and np.mean(samples < 0) > MAX_NEGATIVE:
        raise RecordingError("negative magnitudes", valid=_COMPLEX_FORMS)
    return Cir(samples, encoding, scale=float(scale))


def _samples(values: Any, form: str) -> NDArray[Any]:
    """Return numbers, or a text with numbers, as an array; see `read_cir`."""
    if isinstance(values, str):
        values = [item.strip("[]()") for item in re.split(r"[,;\s]+", values.strip())]
    if len(values) and isinstance(values[0], str):
        texts = [str(item).replace("i", "j") for item in values if item]
        parse: Any = complex if form == "complex" and "j" in "".join(texts) else float
        values = [parse(item) for item in texts]
    array = np.asarray(values)
    if array.dtype == object and array.ndim:
        array = np.stack(list(array))
    return array


def filter_rows(rules: list[RowFilter], chunk: Chunk, prefix: str = "") -> dict[str, Mask]:
    """Return {rule: rows that it drops}; `from_median` needs all files and is ignored."""
    dropped = {}
    for rule in rules:
        raw = np.asarray(chunk.columns[rule.column])
        bad, cells = np.zeros(chunk.count, bool), [_cell_text(cell) for cell in raw.tolist()]
        for values, is_bad in ((rule.equals, True), (rule.differs, False)):
            if values is not None:
                texts = {_cell_text(value) for value in (values if isinstance(values, list) else [values])}
                bad |= np.array([(cell in texts) == is_bad for cell in cells], bool)
        if rule.matches is not None:
            bad |= np.array([re.search(rule.matches, cell) is not None for cell in cells], bool)
        if rule.below is not None or rule.above is not None:
            numbers = _floats(raw, chunk, rule.column, rule.column)
            bad |= numbers < (-math.inf if rule.below is None else rule.below)
            bad |= numbers > (math.inf if rule.above is None else rule.above)
        dropped[f"{prefix}{rule}"] = bad
    return dropped


def unknown_rows(values: ColumnDict) -> dict[str, Mask]:
    """Return {reason: rows} without a range, stamp or id."""
    return {
        "range is not a number": ~np.isfinite(values["range"]),
        "stamp is not a number": values["stamp"] == UNKNOWN_STAMP,
        "tag or anchor is unknown": (values["tag"] == UNKNOWN_ID) | (values["anchor"] == UNKNOWN_ID),
    }


def impossible_rows(values: ColumnDict) -> dict[str, Mask]:
    """Return {reason: rows} with a number above `MAX_POSSIBLE`."""
    return {f"{name} is above {MAX_POSSIBLE:g}": np.abs(values[name]) > MAX_POSSIBLE for name in _LIMITED}


def count_kept(rules: Mapping[str, Mask], count: int, dropped: Counter[str]) -> Mask:
    """Return which of `count` rows no rule drops, and count each other one with the first rule that drops it."""
    is_kept = np.ones(count, bool)
    for reason, bad in rules.items():
        if found := int(np.count_nonzero(bad & is_kept)):
            dropped[reason] += found
        is_kept &= ~bad
    return is_kept
