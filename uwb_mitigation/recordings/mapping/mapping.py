"""Mapping files: where the values of ranges are in the files or messages of other software, and in which unit.

A mapping is a YAML file. `data import --map` reads recordings with it, and the driver live topics (`source:=topic`) and
lines of serial ports and UDP (`source:=lines`).
The mappings in `recordings/mappings` are found by their names. docs/guides/recordings.md describes the format.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Field,
    ValidationError,
    WrapValidator,
    model_validator,
)

from uwb_mitigation.errors import ParameterError, did_you_mean
from uwb_mitigation.files import read_bounded
from uwb_mitigation.types.measurement import RadioType, Segment
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.yaml_text import parse_yaml

MAX_BYTES = 1 << 20
_FOLDER = Path(__file__).parents[1] / "mappings"

TIME = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": NS_PER_S, "iso8601": 1}
"""Nanoseconds per unit of time."""

LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
"""Metres per unit of length."""

SCALES = LENGTHS | {"samples": 1.0, "10.6": 1 / 64, "dBm": 1.0}
"""SI units per unit that is not of time; 10.6 is the fixed-point first-path index of the DW1000."""

FILE, TOPIC = "@file", "@topic"
"""Columns with the path of the file below the recording, and with the topic of a message."""

LIST_INDEX = "#"
"""Column with the index of an element in the innermost list of a message."""

VARIABLE = "variable"
"""Column with the key of a column of `unpivot`."""


class _Strict(BaseModel):
    model_config = {"frozen": True}

    @model_validator(mode="before")
    @classmethod
    def _check_names(cls, value: Any) -> Any:
        for name in value if isinstance(value, dict) else ():
            if name not in cls.model_fields:
                valid, suggestion = ", ".join(cls.model_fields), did_you_mean(str(name), cls.model_fields)
                raise ValueError(f"unknown field {name!r:.40}; {suggestion or f'valid: {valid}'}")
        return value


def _listed(value: Any) -> Any:
    return value if isinstance(value, list) else [value] if value else []


def series(column: str) -> list[str]:
    """Return the columns of `CIR{0..1015}`; another name is returned alone."""
    match = re.fullmatch(r"(.*)\{(\d{1,5})\.\.(\d{1,5})\}", column)
    return [f"{match[1]}{n}" for n in range(int(match[2]), int(match[3]) + 1)] if match else [column]


def _expanded(names: Any) -> Any:
    return [column for name in names for column in series(str(name))] if isinstance(names, list) else names


def _texts(values: Any) -> Any:
    """YAML reads the keys 0 and 1 as numbers."""
    return {str(key): str(value) for key, value in values.items()} if isinstance(values, dict) else values


def _expression(groups: str = "") -> AfterValidator:
    """Return a check of a regular expression; `groups`: attribute of the compiled expression that must not be empty."""

    def check(text: str) -> str:
        try:
            compiled = re.compile(text)
        except re.error as error:
            raise ValueError(f"not a regular expression: {text!r}: {error}") from error
        if text and groups and not getattr(compiled, groups):
            raise ValueError(
                f"{text!r} has no {'group (...)' if groups == 'groups' else 'named group (?P<name>...)'}"
            )
        return text

    return AfterValidator(check)


Expression = Annotated[str, _expression()]
GroupExpression = Annotated[str, _expression("groups")]
NamedExpression = Annotated[str, _expression("groupindex")]


class FieldRule(_Strict):
    """Where one value is: exactly one of the first six fields; a text is short for a column, a number for a constant.

    Attributes:
        column: name of a column, or path of a message's field, such as `nodes[].dis`; `#`: index in the list.
        constant: the value itself.
        sum: {column: factor}.
        file_name, topic_name: regular expression; its first group in the path of the file or topic.
        rate_hz: row number divided by this (stamps only).
        pattern: regular expression; its first group in the text of the value is used.
        hex: ids are hexadecimal numbers without `0x`.
        values: {text: other text}; any other text is kept.
        names: texts are numbered from 1 in the order of their appearance (ids only); a tag and an anchor of the same name
            have the same number.
        unit: a key of `TIME` or `SCALES`; of dates also their format, such as `%d/%m/%Y %H:%M:%S`.
        units: {anchor: unit} of lengths whose unit differs from `unit`.
        scale, offset: value * scale + offset, after the unit; of stamps the offset is in s.
        optional: if the column is absent or the pattern does not match, the value is unknown.
        or_index: if a message does not contain the column, the value is the index in the list.
    """

    column: str = ""
    constant: float | int | str | None = None
    sum: dict[str, float] = {}
    file_name: GroupExpression = ""
    topic_name: GroupExpression = ""
    rate_hz: float = Field(default=0.0, ge=0.0)
    pattern: GroupExpression = ""
    values: Annotated[dict[str, str], BeforeValidator(_texts)] = {}
    hex: bool = False
    names: bool = False
    unit: str = ""
    units: dict[int, Literal["m", "cm", "mm", "ft", "in"]] = {}
    scale: float = Field(default=1.0, allow_inf_nan=False)
    offset: float = Field(default=0.0, allow_inf_nan=False)
    optional: bool = False
    or_index: bool = False

    @model_validator(mode="after")
    def _check(self) -> FieldRule:
        sources = (self.column, self.sum, self.file_name, self.topic_name, self.rate_hz)
        if sum(map(bool, sources)) + (self.constant is not None) != 1:
            raise ValueError("give one of column, constant, sum, file_name, topic_name, rate_hz")
        if (self.unit == "iso8601" or "%" in self.unit) and self.scale != 1:
            raise ValueError("a date has no scale")
        return self

    @property
    def source(self) -> str:
        """Return the column of a chunk with the value."""
        return FILE if self.file_name else TOPIC if self.topic_name else self.column

    @property
    def is_text(self) -> bool:
        """Return whether the value is a part of a text, or replaced."""
        return bool(self.pattern or self.values or self.file_name or self.topic_name)

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the columns that it reads."""
        return (*self.sum, *([self.column] if self.column and self.column != LIST_INDEX else ()))


def _value(*units: str) -> WrapValidator:
    def read(value: Any, validate: Any) -> Any:
        if isinstance(value, str | int | float):
            value = {"column" if isinstance(value, str) else "constant": value}
        rule = validate(value)
        is_format = "%" in rule.unit and "iso8601" in units
        if (rule.unit and rule.unit not in units and not is_format) or (rule.units and "m" not in units):
            raise ValueError(f"unit {rule.unit or rule.units!r}; valid: {', '.join(units) or 'none'}")
        return rule

    return WrapValidator(read)


Number = Annotated[FieldRule, _value()]
Time = Annotated[FieldRule, _value(*TIME)]
Length = Annotated[FieldRule, _value(*LENGTHS)]
Level = Annotated[FieldRule, _value("dBm")]
Index = Annotated[FieldRule, _value("samples", "10.6")]
Point = tuple[Length, Length, Length]


class RowFilter(_Strict):
    """Rule for rows that are not used: `column` and one or more conditions, of which one is sufficient.

    Attributes:
        equals, differs: text or number; or list of them.
        matches: regular expression that is found in the text.
        below, above: limits of a number in the unit of the file.
        from_median: largest distance from the median of the column in all files of the table.
    """

    column: str
    equals: list[str | float] | str | float | None = None
    differs: list[str | float] | str | float | None = None
    matches: Expression | None = None
    below: float | None = None
    above: float | None = None
    from_median: float | None = None

    @model_validator(mode="after")
    def _check(self) -> RowFilter:
        if not self.model_fields_set - {"column"}:
            raise ValueError("a rule needs equals, differs, matches, below, above or from_median")
        return self

    def __str__(self) -> str:
        rules = self.model_dump(exclude_none=True, exclude={"column"})
        return f"{self.column} " + ", ".join(f"{name} {value}" for name, value in rules.items())


class TableFormat(_Strict):
    r"""Files that contain rows.

    Attributes:
        format: empty: detected from the name of each file, and `lines` with a pattern or text.
        files: glob, below the folder that is imported, or next to the file of the ranges; or {pattern: glob}, of which
            the first is used whose regular expression is found in the path of the recording.
        separator, decimal: of CSV; the separator may be a regular expression, such as `\\s+`.
        columns: names of the columns of files without header; `CIR{0..1015}` means 1016 columns.
        skip, comment: number of lines before the table or its header, and character with which comments start.
        pattern: regular expression for lines of a log, or for the texts of messages: each match is a row, and its named
            groups `(?P<name>...)` are the columns.
        group: name of the array, variable or group (MATLAB, HDF5), key of the mapping (YAML), or path of the objects with
            the columns (JSON, messages).
        topics, type: topics of messages, and their type.
        file_name: regular expression for the path of the file, whose named groups are columns.
        text: each line, or the field `data` of the message, contains JSON or `key:value` pairs.
        unpivot: {new column: regular expression}: one row for each column that matches, such as {value: 'r(\\d+)'} for
            r1 to r24. The column `variable` contains the first group, or without one the name of the column; named groups
            are columns, too. Columns of several expressions with the same groups are in the same row. A matrix has the
            columns 1, 2, and so on.
        drop: rules for rows that are not used.
    """

    format: Literal["", "csv", "lines", "json", "matlab", "hdf5", "messages", "yaml"] = ""
    files: str | dict[str, str] = "*"
    separator: str = ","
    decimal: Literal[".", ","] = "."
    columns: Annotated[list[str], BeforeValidator(_expanded)] = []
    skip: int = Field(default=0, ge=0)
    comment: str = Field(default="", max_length=1)
    pattern: NamedExpression = ""
    file_name: NamedExpression = ""
    group: str = ""
    topics: list[str] = []
    type: str = ""
    text: Literal["", "json", "pairs"] = ""
    unpivot: dict[str, Expression] = {}
    drop: list[RowFilter] = []


class _Stamped(_Strict):
    """Stamp and ids of a range or CIR."""

    stamp: Time | None = None
    tag: Number = FieldRule(constant=1)
    anchor: Number


class Fields(_Stamped):
    """The values of a range. Required: `anchor` and `range`; without a stamp the time of the message is used."""

    range: Length
    sequence: Number | None = None
    rx_power: Level | None = None
    first_path_power: Level | None = None
    first_path_index: Index | None = None
    preamble_count: Number | None = None
    channel: Number | None = None


class Registers(_Strict):
    """Registers of a DW1000, from which levels are computed (user manual, section 4.7): CIR_PWR, FP_AMPL1 to 3, MHz.

    Without `cir_power` the receive level is unknown.
    """

    cir_power: Number | None = None
    amplitudes: tuple[Number, Number, Number]
    prf: Number = FieldRule(constant=64)


class Join(_Stamped):
    """Stamp and ids of a CIR in another file; the nearest range of the pair within the tolerance gets it."""

    stamp: Time
    tolerance_s: float = Field(default=0.02, gt=0.0)


class CirSource(TableFormat):
    """The channel impulse response: `column` or `columns` of the ranges, or another file (`files`).

    Attributes:
        column: a column with lists, an array, or `NAME{0..1015}` for one column a sample.
        imaginary: column of the imaginary parts, if `column` contains the real ones.
        samples: magnitude, complex (complex numbers or pairs), or interleaved (real, imaginary, real, ...).
        join: of another file; without it, its rows are those of the ranges.
        first_path_index: in the other file.
        optional: the files may be absent.
    """

    files: str | dict[str, str] = ""
    column: str = ""
    imaginary: str = ""
    samples: Literal["magnitude", "complex", "interleaved"] = "magnitude"
    join: Join | None = None
    first_path_index: Index | None = None
    optional: bool = False

    @model_validator(mode="after")
    def _check(self) -> CirSource:
        if self.imaginary and "samples" in self.model_fields_set:
            raise ValueError("imaginary without samples, or samples without imaginary")
        return self

    @property
    def sample_columns(self) -> list[str]:
        """Return the columns with the samples."""
        return series(self.column) + (series(self.imaginary) if self.imaginary else [])


class Poses(TableFormat):
    """True poses of the tag or robot in another file or on a topic; interpolated at the stamps of the ranges.

    Attributes:
        stamp, position: of a pose.
        orientation: quaternion x, y, z, w; needed for a lever arm that is not vertical.
        lever_arm: position of the antenna in the robot's frame, m; or {tag: position}.
    """

    stamp: Time
    position: Point
    orientation: tuple[Number, Number, Number, Number] | None = None
    lever_arm: tuple[float, float, float] | dict[int, tuple[float, float, float]] = (0.0, 0.0, 0.0)


class TrueRanges(TableFormat, _Stamped):
    """True ranges of pairs in another file, interpolated at the stamps of the ranges in gaps of at most 1 s.

    Attributes:
        stamp: without it, each pair has one true range.
    """

    range: Length


class TruthSource(_Strict):
    """Ground truth: true range, error (measured - true), label (LOS, NLOS, other), name of the placement, positions.

    A `range` with `files` is that of another table, and is in `ranges`.
    """

    range: Length | None = None
    ranges: TrueRanges | None = None
    error: Length | None = None
    label: Number | None = None
    configuration: Number | None = None
    tag_position: Point | None = None
    poses: Poses | None = None
    range_from_positions: bool = False

    @model_validator(mode="before")
    @classmethod
    def _separate_table(cls, value: Any) -> Any:
        source = value.get("range") if isinstance(value, dict) else None
        is_table = isinstance(source, dict) and "files" in source
        return {**value, "range": None, "ranges": source} if is_table else value


class AnchorSource(TableFormat):
    """Positions of the anchors, and `sd` of each coordinate in m: columns of the ranges, or of other `files` with `id`.

    In a list of sources, the first one is used whose files exist; all are then optional.
    """

    files: str | dict[str, str] = ""
    id: Number | None = None
    position: Point | None = None
    sd: float = Field(default=0.02, gt=0.0)
    optional: bool = False


class OdometryTable(TableFormat):
    """Wheel odometry, written to the topic `/odom`: speeds in the robot's frame in m/s and rad/s."""

    files: str | dict[str, str] = ""
    stamp: Time
    forward: Number
    left: Number = FieldRule(constant=0.0)
    yaw_rate: Number


class StartDialogue(_Strict):
    r"""What is sent to a board on a serial port that reports no ranges; `\\r` in double quotes is the Enter key.

    Attributes:
        wake: opens the board's command line.
        ready: regular expression of the answer after which `command` is sent; empty: at once.
        command: starts the output of ranges.
        unknown: regular expression of another answer, of a board whose output may be on or off since an earlier session.
            The first time, `reset` is sent, and the next time `command`.
        reset: stops the output, and closes the command line.
    """

    wake: str = ""
    ready: Expression = ""
    command: str
    unknown: Expression = ""
    reset: str = ""


class Mapping(TableFormat):
    """A mapping file.

    Attributes:
        name, source: name of the data set or radio, and where its format is described.
        baud, start: baud rate of a serial port with lines, and how their output is started.
        moving: the tag moves during pauses, so they are kept.
        range_sd: standard deviation of a range, m (data sheet); 0: unknown.
        radio, segment: of the CIRs; without `radio`, models assume the preamble of a DW1000.
    """

    name: str
    source: str = ""
    baud: int = Field(default=115_200, ge=1200, le=12_000_000)
    start: StartDialogue | None = None
    simulated: bool = False
    moving: bool = True
    range_sd: float = Field(default=0.0, ge=0.0)
    radio: Literal["", "DW1000", "DW3000", "QM35"] = ""
    segment: Literal["", "IPATOV", "STS"] = ""
    fields: Fields
    registers: Registers | None = None
    cir: CirSource | None = None
    truth: TruthSource = TruthSource()
    anchors: Annotated[list[AnchorSource], BeforeValidator(_listed)] = []
    odometry: OdometryTable | None = None

    @model_validator(mode="after")
    def _check(self) -> Mapping:
        if self.registers and not self.fields.preamble_count:
            raise ValueError("registers: needs fields.preamble_count")
        if any(source.files and not (source.id and source.position) for source in self.anchors):
            raise ValueError("anchors: id and position are needed with files")
        if self.segment and not self.radio:
            raise ValueError("segment: needs radio")
        return self

    @property
    def cir_kind(self) -> tuple[RadioType, Segment]:
        """Return the radio and the segment of the CIRs."""
        if not self.radio:
            return RadioType.UNKNOWN, Segment.UNKNOWN
        return RadioType[self.radio], Segment[self.segment or "IPATOV"]

    @property
    def values(self) -> dict[str, FieldRule | None]:
        """Return everything that is in a row of the ranges, by the names of `conversion.Columns`."""
        truth = self.truth
        rules: dict[str, FieldRule | None] = {
            **dict(self.fields),
            "true range": truth.range,
            "error": truth.error,
        }
        rules |= {"label": truth.label, "configuration": truth.configuration}
        if self.registers:
            amplitudes = enumerate(self.registers.amplitudes, 1)
            rules |= {"cir_power": self.registers.cir_power, "prf": self.registers.prf}
            rules |= {f"amplitude {n}": value for n, value in amplitudes}
        anchors = next((source.position for source in self.anchors if not source.files), None)
        return rules | axes("tag", truth.tag_position) | axes("anchor", anchors)

    @property
    def cir_columns(self) -> list[str]:
        """Return the columns of the ranges that contain the CIR."""
        return self.cir.sample_columns if self.cir and not self.cir.files else []


def axes(name: str, point: Point | None) -> dict[str, FieldRule | None]:
    """Return the coordinates of a point by their names, such as `tag x`."""
    return {f"{name} {axis}": value for axis, value in zip("xyz", point or (None,) * 3, strict=True)}


def shipped_mappings() -> list[str]:
    """Return the names of the mappings of this package."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def load_mapping(name: str) -> Mapping:
    """Read a mapping file, or a shipped mapping by its name.

    Raises:
        ParameterError: it cannot be read, or is not a mapping; the message names the field and what is valid. Or its key
            `refused` contains the reason why this data set contains no ranges.
    """
    path, shipped = Path(name).expanduser(), shipped_mappings()
    if not name:
        raise ParameterError("parameter map is empty", valid="map:=FILE, or the name of a shipped mapping")
    if name in shipped:
        path = _FOLDER / f"{name}.yaml"
    elif not path.exists():
        valid, suggestion = f"a file, or one of {', '.join(shipped)}", did_you_mean(name, shipped)
        raise ParameterError(f"no mapping {name!r}", valid=valid, suggestion=suggestion)
    document = parse_yaml(read_bounded(path, MAX_BYTES, ParameterError), str(path))
    if isinstance(document, dict) and "refused" in document:
        raise ParameterError(f"{document.get('name')} cannot be imported: {document['refused']}")
    try:
        return Mapping.model_validate(document)
    except ValidationError as error:
        problem = error.errors()[0]
        texts = [".".join(map(str, problem["loc"])), problem["msg"].removeprefix("Value error, ")]
        raise ParameterError(": ".join(filter(None, texts)), where=path) from error
