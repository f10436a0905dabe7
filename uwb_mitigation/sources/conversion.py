"""Values of a mapping in SI units, from columns of a file or message."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError, UwbMitigationError
from uwb_mitigation.measurement import Cir, Encoding, RangeMeasurement
from uwb_mitigation.sources.mapping import INDEX, LENGTH, LIST_INDEX, TIME, Drop, Mapping, Point, Value
from uwb_mitigation.sources.tables import LOG_TIME, TOPIC, Chunk, series

_MISSING = frozenset(("", "-", "nan", "none", "null", "n/a", "na"))
"""Texts that mean an unknown value."""

UNKNOWN_ID = (1 << 64) - 1
"""Id of a row without an id."""

NO_SAMPLES: NDArray[np.int16] = np.zeros(0, np.int16)

_LEVEL_OFFSETS = {16: 113.77, 64: 121.74}
"""Constant A of the DW1000's levels by PRF in MHz (user manual, section 4.7)."""


class Names:
    """Numbers for texts that name tags and anchors, in the order of their appearance, from 1."""

    def __init__(self) -> None:
        self.numbers: dict[str, int] = {}

    def number(self, text: str) -> int:
        """Return the number of a text."""
        return self.numbers.setdefault(text, len(self.numbers) + 1)


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Values of n ranges in SI units; NaN: unknown. Names as in `RangeMeasurement`, `Cir` and `Record`.

    Attributes:
        stamp_ns: int64 (n,).
        tag_id, anchor_id: uint64 (n,); `UNKNOWN_ID`: unknown.
        numbers: {name: float64 (n,)} for `range`, `rx_power`, `first_path_power`, `first_path_index`,
            `preamble_count`, `channel`, `sequence`, `true range`, `error`, and true positions such as `tag x`.
        label, configuration: texts (n,).
    """

    stamp_ns: NDArray[np.int64]
    tag_id: NDArray[np.uint64]
    anchor_id: NDArray[np.uint64]
    numbers: dict[str, NDArray[np.float64]]
    label: NDArray[Any]
    configuration: NDArray[Any]

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def take(self, rows: NDArray[Any]) -> Columns:
        """Return the chosen rows."""
        numbers = {name: values[rows] for name, values in self.numbers.items()}
        texts = self.label[rows], self.configuration[rows]
        return Columns(self.stamp_ns[rows], self.tag_id[rows], self.anchor_id[rows], numbers, *texts)

    @classmethod
    def joined(cls, parts: list[Columns]) -> Columns:
        """Concatenate parts of one mapping."""
        numbers = {name: np.concatenate([part.numbers[name] for part in parts]) for name in parts[0].numbers}
        stamp, tag, anchor, label, configuration = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("stamp_ns", "tag_id", "anchor_id", "label", "configuration")
        )
        return cls(stamp, tag, anchor, numbers, label, configuration)

    def measurement(self, row: int, cir: Cir, sequence: int) -> RangeMeasurement:
        """Return one range with the samples of `cir` and its own levels."""
        n = self.numbers
        given = n["sequence"][row]
        return RangeMeasurement(
            int(self.stamp_ns[row]),
            int(self.tag_id[row]),
            int(self.anchor_id[row]),
            (int(given) if math.isfinite(given) else sequence) & 0xFFFFFFFF,
            0,
            float(n["range"][row]),
            Cir(
                cir.samples,
                cir.encoding,
                cir.start_index,
                float(n["first_path_index"][row]),
                scale=cir.scale,
                preamble_count=_whole(n["preamble_count"][row], 65535),
                rx_power_dbm=float(n["rx_power"][row]),
                first_path_power_dbm=float(n["first_path_power"][row]),
                channel=_whole(n["channel"][row], 255),
            ),
        )


def _whole(value: float, most: int) -> int:
    return int(value) if 0 <= value <= most else 0


@dataclass(slots=True)
class Converter:
    """Converts the rows of a mapping.

    Args:
        mapping: the mapping.

    Attributes:
        tags, anchors: numbers of named tags and anchors.
    """

    mapping: Mapping
    tags: Names = field(default_factory=Names)
    anchors: Names = field(default_factory=Names)

    @property
    def columns(self) -> list[str]:
        """Return the columns that a table must contain, except those in `optional`."""
        rows = {name: None for _, value, _ in self.mapping.measured() if value for name in value.columns}
        rows |= {rule.column: None for rule in self.mapping.drop if rule.column != LIST_INDEX}
        cir = self.mapping.cir
        if cir and not cir.files:
            rows |= dict.fromkeys(series(cir.column))
        return list(rows)

    @property
    def optional(self) -> list[str]:
        """Return the columns that may be missing."""
        return [
            name
            for _, value, _ in self.mapping.measured()
            if value and value.optional
            for name in value.columns
        ]

    def convert(self, chunk: Chunk, file: str = "") -> Columns:
        """Return the values of all rows of a chunk; `file`: its path for `file_name`.

        Raises:
            RecordingError: an id or a number cannot be read; `where` names the row.
        """
        fields, numbers = self.mapping.fields, {}
        for name, value, _ in self.mapping.measured():
            if name not in ("stamp", "tag", "anchor", "label", "configuration"):
                numbers[name] = read_numbers(value, chunk, name, file)
        if registers := self.mapping.registers:
            _levels(numbers, registers.amplitudes)
        for name in ("rx_power", "first_path_power"):
            numbers[name] = np.where(np.isfinite(numbers[name]), numbers[name], np.nan)
        texts = [
            np.array([""] * chunk.count, object) if value is None else read_texts(value, chunk, name, file)
            for name, value in (
                ("label", self.mapping.truth.label),
                ("configuration", self.mapping.truth.configuration),
            )
        ]
        return Columns(
            read_stamps(fields.stamp, chunk, file),
            read_ids(fields.tag, chunk, "tag", file, self.tags),
            read_ids(fields.anchor, chunk, "anchor", file, self.anchors),
            numbers,
            *texts,
        )


def _levels(numbers: dict[str, NDArray[np.float64]], amplitudes: Point) -> None:
    """Compute both levels from the registers of a DW1000."""
    count = numbers["preamble_count"]
    constant = np.where(numbers["prf"] == 16, _LEVEL_OFFSETS[16], _LEVEL_OFFSETS[64])
    power = numbers["cir_power"] * 2.0**17
    first = sum(numbers[f"amplitude {n}"] ** 2 for n in range(1, len(amplitudes) + 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        numbers["rx_power"] = 10 * np.log10(power / count**2) - constant
        numbers["first_path_power"] = 10 * np.log10(first / count**2) - constant


def read_texts(value: Value, chunk: Chunk, name: str, file: str) -> NDArray[Any]:
    """Return a value as texts (n,), after `pattern` and `values`."""
    raw = _raw(value, chunk, file)
    if raw is None:
        return np.array([""] * chunk.count, object)
    # Constants and file names are the same in all rows.
    # None and NaN are missing values.
    given = ["" if each is None or each != each else each for each in raw.tolist()]
    texts = {each: _text(value, each, name) if each != "" else "" for each in dict.fromkeys(given)}
    return np.array([texts[each] for each in given], object)


def _text(value: Value, given: Any, name: str) -> str:
    text = str(int(given)) if isinstance(given, float) and given.is_integer() else str(given).strip()
    if value.pattern:
        match = re.search(value.pattern, text)
        if match is None:
            raise RecordingError(f"{name} = {text!r:.60} does not match {value.pattern!r}")
        text = match[1]
    return value.values.get(text, text)


def read_numbers(value: Value | None, chunk: Chunk, name: str, file: str) -> NDArray[np.float64]:
    """Return a value in SI units, float64 (n,); NaN: unknown.

    Raises:
        RecordingError: a text is not a number; `where` names its row.
    """
    if value is None:
        return np.full(chunk.count, np.nan)
    raw = _raw(value, chunk, file)
    if raw is None:
        return np.full(chunk.count, np.nan)
    if value.pattern or value.values:
        raw = read_texts(value, chunk, name, file)
    factor = LENGTH.get(value.unit) or INDEX.get(value.unit) or 1.0
    return _floats(raw, chunk, name, value) * factor * value.scale + value.offset


def _floats(raw: NDArray[Any], chunk: Chunk, name: str, value: Value) -> NDArray[np.float64]:
    if raw.dtype.kind in "iufb":
        return raw.astype(np.float64)
    with np.errstate(all="ignore"):
        try:
            return raw.astype(np.float64)
        except (ValueError, TypeError):
            pass
    found = np.full(len(raw), np.nan)
    for row, item in enumerate(raw.tolist()):
        text = "" if item is None else str(item).strip()
        try:
            found[row] = float(text)
        except ValueError:
            if text.lower() in _MISSING:
                continue
            comma = re.fullmatch(r"[-+]?\d+,\d+", text)
            raise RecordingError(
                f"{name} = {text!r:.40} is not a number",
                where=chunk.where(row),
                valid="decimal commas: set decimal: ','" if comma else f"a number in column {value.column}",
            ) from None
    return found


def _raw(value: Value, chunk: Chunk, file: str) -> NDArray[Any] | None:
    """Return the unconverted values of the rows; None: the column is optional and missing."""
    if value.file_name or value.topic_name:
        source = [file] * chunk.count if value.file_name else chunk.columns.get(TOPIC, [""] * chunk.count)
        rule = value.file_name or value.topic_name
        found = {text: re.search(rule, text) for text in set(source)}
        if missing := [text for text, match in found.items() if match is None]:
            raise RecordingError(f"{missing[0]!r} does not match {rule!r}", where=str(chunk.path))
        return np.array([found[text][1] for text in source], object)  # type: ignore[index]
    if value.rate_hz:
        return np.asarray((chunk.before + chunk.rows) / value.rate_hz)
    if value.constant is not None:
        return np.array([value.constant] * chunk.count)
    if value.sum and not (value.optional and set(value.sum) - set(chunk.columns)):
        parts = [
            factor * _floats(_array(chunk.columns[name]), chunk, name, value)
            for name, factor in value.sum.items()
        ]
        return np.asarray(np.sum(parts, axis=0))
    if value.column not in chunk.columns:
        if value.optional:
            return None
        raise RecordingError(f"no column {value.column}", where=str(chunk.path))
    return _array(chunk.columns[value.column])


def _array(values: Any) -> NDArray[Any]:
    array = np.asarray(values)
    if array.ndim > 1:
        raise RecordingError(f"a column of shape {array.shape} where single values are needed")
    return array


def read_stamps(value: Value | None, chunk: Chunk, file: str) -> NDArray[np.int64]:
    """Return stamps in ns, int64 (n,); the smallest integer: unknown."""
    raw = None if value is None else _raw(value, chunk, file)
    if value is None or raw is None:
        if LOG_TIME in chunk.columns:
            return np.asarray(chunk.columns[LOG_TIME], np.int64)
        raise RecordingError("no stamp", where=str(chunk.path), valid="fields.stamp: a column, or rate_hz")
    if value.unit == "iso8601":
        import pandas as pd

        times = pd.to_datetime(pd.Series(raw), utc=True, errors="coerce", format="ISO8601")
        found = times.dt.tz_convert(None).to_numpy("datetime64[ns]").astype(np.int64)
        bad = np.flatnonzero(times.isna().to_numpy())
        for row in bad.tolist():
            if str(raw[row]).strip().lower() not in _MISSING | {"nat"}:
                raise RecordingError(
                    f"stamp = {raw[row]!r:.40} is not a date",
                    where=chunk.where(row),
                    valid="2024-06-09T19:39:13.4387",
                )
        return np.asarray(found + round(value.offset * 1e9))
    # Without a unit: seconds; the stamp of a message is an integer in nanoseconds.
    is_stamp = LOG_TIME in chunk.columns and raw.dtype.kind in "iu"
    factor = TIME[value.unit or ("ns" if is_stamp else "s")]
    offset = round(value.offset * 1e9)
    if raw.dtype.kind in "iu" and value.scale == 1.0:
        # As integers, because a float64 resolves nanoseconds since 1970 to 256 ns only.
        if len(raw) and max(-int(raw.min()), int(raw.max())) >= 9.2e18 / factor:
            raise RecordingError(
                f"stamp = {int(raw.max())} is outside of the years 1678 to 2261",
                where=str(chunk.path),
                valid="unit: ms, us or ns",
            )
        return np.asarray(raw.astype(np.int64) * factor + offset)
    scaled = _floats(raw, chunk, "stamp", value) * value.scale
    good = np.isfinite(scaled) & (np.abs(scaled) < 9.2e18 / factor)
    whole = np.floor(np.where(good, scaled, 0.0))
    fraction = np.where(good, scaled, 0.0) - whole
    # A float64 resolves seconds since 1970 to 0.2 us only: round them to 1 us.
    step = np.where((np.abs(whole) > 1e8) & (factor == TIME["s"]), 1000, 1)
    rest = np.rint(fraction * factor / step).astype(np.int64) * step
    found = whole.astype(np.int64) * factor + rest + offset
    return np.where(good, found, np.iinfo(np.int64).min)


def read_ids(value: Value, chunk: Chunk, name: str, file: str, names: Names) -> NDArray[np.uint64]:
    """Return ids, uint64 (n,); `UNKNOWN_ID`: unknown; `names` numbers the texts of `names: true`.

    Raises:
        RecordingError: a value is not an id; `where` names its row.
    """
    raw = _raw(value, chunk, file)
    if raw is None:
        raise RecordingError(f"no column {value.column} for the {name}", where=str(chunk.path))
    plain = not (value.pattern or value.values or value.names or value.offset)
    if plain and (raw.dtype.kind == "u" or (raw.dtype.kind == "i" and (len(raw) == 0 or raw.min() >= 0))):
        return np.asarray(raw, np.uint64)
    found: dict[Any, int] = {}
    items = raw.tolist()
    for row, item in enumerate(items):
        if item in found:
            continue
        try:
            if str(item).strip().lower() in _MISSING:
                found[item] = UNKNOWN_ID
                continue
            # Tables read whole numbers in a column with missing values as float64, which merges larger ids.
            if isinstance(item, float) and abs(item) >= 2**53:
                raise ValueError(item)
            text = _text(value, item, name)
            found[item] = names.number(text) if value.names else _id(text) + round(value.offset)
            if not 0 <= found[item] < UNKNOWN_ID:
                raise ValueError(text)
        except (ValueError, UwbMitigationError) as error:
            raise RecordingError(
                f"{name} = {item!r:.40} is not an id",
                where=chunk.where(row),
                valid="a whole number such as 3 or 0x1f; `pattern` takes a number from a text, `names: true` numbers texts",
            ) from error
    return np.array([found[item] for item in items], np.uint64)


def _id(text: str) -> int:
    if re.fullmatch(r"[0-9a-fA-F]{2}([:-][0-9a-fA-F]{2}){1,7}", text):
        return int(re.sub("[:-]", "", text), 16)
    # A column with unknown values contains texts such as 10.0.
    return int(text, 16) if text.lower().startswith("0x") else int(re.sub(r"\.0+$", "", text))


def samples_of(values: Any, form: str) -> tuple[NDArray[np.int16], Encoding, float]:
    """Return int16 samples of one CIR, their encoding, and the scale that restores the values.

    Raises:
        ValueError: the values are not numbers.
    """
    if isinstance(values, str):
        items = [item.strip("[]()") for item in re.split(r"[,;\s]+", values.strip())]
        parse: Any = complex if form == "complex" else float
        values = [parse(item.replace("i", "j")) for item in items if item]
    array = np.asarray(values)
    encoding = Encoding.MAGNITUDE if form == "magnitude" else Encoding.COMPLEX_INT16
    if form == "complex":
        pairs = array if array.ndim == 2 else np.stack([array.real, array.imag], axis=1)
        array = pairs.reshape(-1)
    elif np.iscomplexobj(array):
        array = np.abs(array)
    flat = array.reshape(-1).astype(np.float64)
    if not np.isfinite(flat).all():
        return NO_SAMPLES, encoding, 1.0
    largest = float(np.abs(flat).max()) if len(flat) else 0.0
    exact = largest <= 32767 and bool(np.all(flat == np.rint(flat)))
    scale = 1.0 if exact or largest == 0.0 else largest / 32767
    return np.rint(flat / scale).astype(np.int16), encoding, scale


def kept_rows(rules: list[Drop], chunk: Chunk, dropped: Counter[str], prefix: str = "") -> NDArray[np.bool_]:
    """Return which rows no rule drops, and count the others by rule."""
    kept = np.ones(chunk.count, bool)
    for rule in rules:
        raw = np.asarray(chunk.columns[rule.column])
        bad = np.zeros(chunk.count, bool)
        for wanted, opposite in ((rule.equals, False), (rule.differs, True)):
            if wanted is not None:
                listed = wanted if isinstance(wanted, list) else [wanted]
                texts = {f"{each:g}" if isinstance(each, float) else each for each in listed}
                values = [each for each in listed if not isinstance(each, str)]
                same = np.isin(raw.astype(str), list(texts)) | (
                    np.isin(raw, values) if raw.dtype.kind in "iuf" else False
                )
                bad |= ~same if opposite else same
        if rule.below is not None or rule.above is not None or rule.from_median is not None:
            found = read_numbers(Value(column=rule.column), chunk, rule.column, "")
            bad |= found < (-np.inf if rule.below is None else rule.below)
            bad |= found > (np.inf if rule.above is None else rule.above)
            if rule.from_median is not None:
                bad |= np.abs(found - np.nanmedian(found)) > rule.from_median
        count = int(np.count_nonzero(bad & kept))
        if count:
            dropped[f"{prefix}{rule}"] += count
        kept &= ~bad
    return kept
