"""Logs of Decawave's DecaRanging PC program (EVK1000) as sources: one file, or a folder with surveyed positions.

The format is known from recordings alone (doi 10.5281/zenodo.4742391, DecaRanging 3.05). From the anchor's view, one
exchange consists of a received poll, a sent response, a received final frame, and the range. Each received frame
appears as `RX DATA` (the frame), `RX OK` (diagnostics) and `Accum Len` (the CIR); a reception error is `RX E`.
"""

from __future__ import annotations

import contextlib
import enum
import io
import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from uwb_mitigation.errors import DamagedRecordingError, RecordingError
from uwb_mitigation.recordings.mapping.conversion import ColumnDict
from uwb_mitigation.recordings.text_blocks import UpToDamage
from uwb_mitigation.types.anchors import Anchor, AnchorMap
from uwb_mitigation.types.measurement import (
    DEVICE_TICK_HZ,
    DEVICE_TIME_WRAP,
    Cir,
    RadioType,
    RangeMeasurement,
    Record,
    Segment,
    Truth,
)
from uwb_mitigation.types.source import Source
from uwb_mitigation.types.stamps import NS_PER_S

MAX_ACCUMULATOR = 1016
"""Samples of the accumulator at 64 MHz PRF; 992 at 16 MHz (DW1000 user manual, section 7.2.38)."""

MAX_BYTES = 1 << 30
"""Maximum size of a decompressed log (one hour has 80 MB)."""

_TOKEN = re.compile(
    rb"(?m)^(?:"
    rb"File:(?P<start>\d{8}-\d{6})"
    rb"|Mode: .*?Chan (?P<channel>[1-7]), .*?PRF (?P<prf>16|64),"
    rb"|RX DATA: ?(?P<frame>(?:[0-9A-Fa-f]{2}){22,1024})$"
    rb"|RX OK .*?HLP\((?P<path>[^()\n]*)\), PSC\((?P<preamble>\d{1,4})\), .*?RC\((?P<high>[0-9A-F]{1,4}) "
    rb"(?P<low>[0-9A-F]{8})\), .*?NTH\((?P<noise>[0-9A-F]{1,4})\), "
    rb".*?RSL\((?P<power>[^()\n]*)\), FSL\((?P<first>[^()\n]*)\)"
    rb"|Accum Len (?P<length>\d{1,9})\n(?P<pairs>(?:-?\d{1,5}, -?\d{1,5}\n)*)"
    rb"|Anchor ToF: .*?Dist: (?P<range>\S+) m "
    rb"|(?P<error>RX E)"
    rb"|(?P<malformed>Mode: |RX |Accum Len|Anchor ToF))"
)
"""All parts of a log that are used; the last group that matches determines the kind."""

_NO_CIR = Cir(np.zeros(0, np.int16), radio=RadioType.DW1000, segment=Segment.IPATOV)
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")


class CirFrame(str, enum.Enum):
    """The frame whose CIR and time belong to the range."""

    POLL = "poll"
    FINAL = "final"


_CODES = {0x21: CirFrame.POLL, 0x29: CirFrame.FINAL}


class Anomaly(str, enum.Enum):
    """Keys of `skipped`."""

    RECEPTION_ERROR = "reception error"
    NO_RANGE = "exchange without a range"
    NO_CIR = "range without a CIR"
    NOT_A_NUMBER = "value that is not a number or out of range"
    MALFORMED = "malformed line"
    NO_START_TIME = "log without a start time"
    NO_TRUTH = "log without surveyed truth"
    MOVED = "log shifted in time to start after the previous one"
    UNREADABLE = "log that was not read completely"


@dataclass(frozen=True, slots=True)
class Placement:
    """Surveyed location of one log: numbers of anchor and tag location, position of the tag, and truth."""

    anchor: int
    tag: int
    tag_position: tuple[float, float, float]
    truth: Truth


Survey = tuple[dict[int, Placement], AnchorMap]


class DecaRangingLog(Source):
    """The exchanges of one log, `.log` or `.log.xz`; a `Source`.

    No range is lost: if its CIR is missing or malformed, the measurement has a CIR without samples. Malformed parts are
    counted in `skipped`. `stamp_ns` is the start time in the first line (as UTC; 0 if missing) plus the time by the
    radio's 40-bit counter since the first received frame; gaps above 17.2 s are invisible in this counter.

    Args:
        cir: which frame's CIR belongs to the range.
        placement: surveyed location; its numbers replace the 64-bit addresses in the frames.
    """

    simulated = False

    def __init__(
        self, path: Path, cir: CirFrame = CirFrame.FINAL, placement: Placement | None = None
    ) -> None:
        self.path = path
        self.name = f"DecaRanging log {path.name}"
        self.skipped: Counter[str] = Counter()
        self._cir_frame = cir
        self._placement = placement

    def __iter__(self) -> Iterator[Record]:
        """Yield the exchanges that have a range.

        Raises:
            RecordingError: the file is absent, empty, too large, or not a DecaRanging log.
            DamagedRecordingError: the log is truncated or corrupt; `where` gives the last line.
        """
        return self.records()

    def records(self, first_sequence: int = 0, not_before_ns: int = 0) -> Iterator[Record]:
        """Iterate as part of a series: continue its sequence numbers and begin no earlier than `not_before_ns`."""
        self.skipped = Counter() if self._placement else Counter({Anomaly.NO_TRUTH.value: 1})
        placed = self._placement
        text, fault = _read(self.path)
        if not (_TOKEN.search(text) or fault):
            raise RecordingError("not a DecaRanging log", where=self.path, valid="lines such as 'RX DATA:'")
        for sequence, measured in enumerate(self._measurements(text, not_before_ns), first_sequence):
            tag, anchor = (placed.tag, placed.anchor) if placed else (measured.tag_id, measured.anchor_id)
            numbered = replace(measured, sequence=sequence & 0xFFFFFFFF, tag_id=tag, anchor_id=anchor)
            yield Record(numbered, placed.truth, placed.tag_position) if placed else Record(numbered)
        if fault:
            raise DamagedRecordingError(fault, where=self._after(text))

    def start_ns(self) -> int:
        """Return the start time in the first line, ns since the epoch; 0 if it is missing or unreadable."""
        with contextlib.suppress(OSError), UpToDamage(self.path) as stream:
            return _start_ns(stream.read(4096))
        return 0

    def _after(self, text: bytes) -> str:
        return f"{self.path}: after line {text.count(10)}"

    def _count(self, anomaly: Anomaly) -> None:
        self.skipped[anomaly.value] += 1

    def _measurements(self, text: bytes, not_before_ns: int) -> Iterator[RangeMeasurement]:
        start_ns = _start_ns(text)
        if not start_ns:
            self._count(Anomaly.NO_START_TIME)
        base_ns, ticks = max(start_ns, not_before_ns), 0
        latest: int | None = None  # device time of the latest frame
        frame_kind: CirFrame | None = None  # kind of the frame in RX DATA
        cir_owner: CirFrame | None = None  # kind of the frame that a CIR would belong to
        frames: dict[CirFrame, tuple[int, Cir]] = {}
        tag, anchor, without_samples = 0, 0, _NO_CIR
        for match in _TOKEN.finditer(text):
            kind = match.lastgroup
            if kind == "prf":
                without_samples = replace(_NO_CIR, channel=int(match["channel"]), prf_mhz=int(match["prf"]))
            elif kind == "frame":
                # IEEE 802.15.4 with 64-bit addresses, then the function code
                frame = bytes.fromhex(match["frame"].decode())
                frame_kind, cir_owner = _CODES.get(frame[21]), None
                tag, anchor = (int.from_bytes(frame[i : i + 8], "little") for i in (13, 5))
            elif kind == "first":
                cir_owner, frame_kind = frame_kind, None
                time = (int(match["high"], 16) << 32 | int(match["low"], 16)) % DEVICE_TIME_WRAP
                ticks += 0 if latest is None else (time - latest) % DEVICE_TIME_WRAP
                latest = time
                if cir_owner is not None:
                    if cir_owner in frames or (cir_owner is CirFrame.POLL and frames):
                        self._count(Anomaly.NO_RANGE)
                    if cir_owner is CirFrame.POLL:
                        frames.clear()
                    frames[cir_owner] = time, self._diagnostics(match, without_samples)
            elif kind == "pairs":
                length, lines = int(match["length"]), match["pairs"].count(b"\n")
                if match.end() == len(text) and lines < length:
                    what = f"ends after {lines} of {length} lines of a CIR"
                    raise DamagedRecordingError(what, where=self._after(text))
                if lines != length or length > MAX_ACCUMULATOR:
                    self._count(Anomaly.MALFORMED)
                elif cir_owner is self._cir_frame:
                    time, cir = frames[cir_owner]
                    frames[cir_owner] = time, self._with_samples(cir, match["pairs"])
                cir_owner = None
            elif kind == "range":
                time, cir = frames.get(self._cir_frame, (latest or 0, without_samples))
                if len(cir) == 0:
                    self._count(Anomaly.NO_CIR)
                stamp_ns = base_ns + ticks * NS_PER_S // int(DEVICE_TICK_HZ)
                range_m = self._number(match["range"], -3e38, 3e38)
                yield RangeMeasurement(stamp_ns, tag, anchor, 0, time, range_m, cir)
                frames.clear()
                frame_kind = cir_owner = None
            elif kind != "start":
                self._count(Anomaly.RECEPTION_ERROR if kind == "error" else Anomaly.MALFORMED)
                frame_kind = cir_owner = None
        if frames:
            self._count(Anomaly.NO_RANGE)

    def _diagnostics(self, match: re.Match[bytes], cir: Cir) -> Cir:
        power, first = (self._number(match[name], -1000.0, 1000.0) for name in ("power", "first"))
        return replace(
            cir,
            # fixed point: ten integer and six fractional bits
            first_path_index=self._number(match["path"], 0.0, 1024 - 2**-6),
            preamble_count=int(match["preamble"]),
            noise_threshold=int(match["noise"], 16),
            rx_power_dbm=power,
            first_path_power_dbm=first,
        )

    def _with_samples(self, cir: Cir, pairs: bytes) -> Cir:
        values = np.fromstring(pairs.replace(b",", b" "), np.int32, sep=" ")
        if values.size == 0 or values.min() < -32768 or values.max() > 32767:
            self._count(Anomaly.MALFORMED)
            return cir
        return replace(cir, samples=values.astype(np.int16))

    def _number(self, text: bytes, low: float, high: float) -> float:
        value = float(text) if _NUMBER.fullmatch(text) else math.nan
        if low <= value <= high:
            return value
        self._count(Anomaly.NOT_A_NUMBER)  # such as -001.#INF
        return math.nan


def _read(path: Path) -> tuple[bytes, str]:
    """Return the complete lines of a log, with line feeds only, and a description of the damage (empty: none)."""
    blocks: list[bytes] = []
    try:
        with io.BufferedReader(source := UpToDamage(path)) as stream:
            while block := stream.read(1 << 16):
                blocks.append(block)
                if len(blocks) << 16 > MAX_BYTES:
                    raise RecordingError(f"more than {MAX_BYTES} bytes", where=path)
    except OSError as error:
        raise RecordingError(f"cannot be read: {error}", where=path) from error
    fault = str(source.damage or "")
    if fault and not blocks:
        raise RecordingError(f"cannot be read: {fault}", where=path)
    text = b"".join(blocks).replace(b"\r\n", b"\n")
    complete = text[: text.rfind(b"\n") + 1]
    return complete, fault or ("ends in the middle of a line" if len(complete) < len(text) else "")


def _start_ns(head: bytes) -> int:
    """Return the start time in a log's first line, as UTC; 0 if missing."""
    match = _TOKEN.match(head)
    try:
        start_text = match["start"].decode() if match is not None and match["start"] else ""
        start = datetime.strptime(start_text, "%Y%m%d-%H%M%S").replace(tzinfo=timezone.utc)
    except ValueError:
        return 0
    # The 64-bit nanoseconds of ROS and NumPy end in 2262.
    return int(start.timestamp()) * NS_PER_S if 1970 <= start.year < 2262 else 0


class DecaRangingFolder(Source):
    """The logs of a folder (or of its sub-folder `logs`) in the order of time, with surveyed positions; a `Source`.

    The survey is in the folder or its parent: `pairs.csv` (file_number, anchor_location, tag_location), `anchors.csv` and
    `tags.csv` (location, x, y in m) and optionally `labels.csv` (file_id, label). True ranges are distances in the plane.
    Location numbers replace the boards' addresses as ids. Logs without a row in `pairs.csv` keep the addresses and have no
    truth. A log that would begin before the previous one ends is moved later. If a log cannot be read, the others are;
    the first error is raised at the end.

    Attributes:
        anchors: surveyed anchor locations, at z = 0; only if there is a survey.

    Raises:
        RecordingError: the folder is absent or contains no logs, or the survey is malformed.
    """

    simulated = False
    anchors: AnchorMap

    def __init__(self, path: Path, cir: CirFrame = CirFrame.FINAL) -> None:
        self.skipped: Counter[str] = Counter()
        folder = next(
            (candidate for candidate in (path, path / "logs") if any(candidate.glob("*.log*"))), path
        )
        plain, compressed = (
            {log.name.removesuffix(".xz"): log for log in folder.glob(f"*.log{end}")} for end in ("", ".xz")
        )
        if not plain | compressed:
            raise RecordingError("no logs", where=path, valid="*.log or *.log.xz, or logs/")
        survey = find_survey(folder)
        if survey is not None:
            self.anchors = survey[1]
        logs = [_make_log(log, survey, cir) for log in sorted({**compressed, **plain}.values())]
        self._logs = sorted(logs, key=lambda log: (log.start_ns(), _log_number(log.path) or 0, log.path.name))
        self.name = f"DecaRanging folder {path.resolve().name} ({len(logs)} logs)"

    def __iter__(self) -> Iterator[Record]:
        """Yield the exchanges that have a range; raises as `DecaRangingLog`, after all logs were read."""
        self.skipped = Counter()
        first_error: RecordingError | None = None
        sequence = last_ns = 0
        for log in self._logs:
            if log.start_ns() < last_ns:
                self.skipped[Anomaly.MOVED.value] += 1
            try:
                for record in log.records(sequence, last_ns):
                    last_ns = record.measurement.stamp_ns
                    sequence += 1
                    yield record
            except RecordingError as error:
                self.skipped[Anomaly.UNREADABLE.value] += 1
                first_error = first_error or error
            finally:
                self.skipped.update(log.skipped)
        if first_error is not None:
            raise first_error


def open_decaranging(
    path: Path | str, *, cir: CirFrame = CirFrame.FINAL
) -> DecaRangingLog | DecaRangingFolder:
    """Return the source for a log or a folder of logs, with surveyed truth if there is a survey.

    Raises:
        RecordingError: nothing is there, the folder contains no logs, or the survey is malformed.
    """
    path = Path(path)
    if path.is_dir():
        return DecaRangingFolder(path, cir)
    if not path.is_file():
        raise RecordingError("no such file or folder", where=path, valid="a log, or a folder of logs")
    return _make_log(path, find_survey(path.parent), cir)


def find_survey(folder: Path) -> Survey | None:
    """Return {log number: placement} and all anchors of the survey in `folder` or its parent; None without `pairs.csv`.

    Raises:
        RecordingError: a file is absent or malformed, names an unknown location, or repeats a number.
    """
    folder = folder.resolve()
    folder = folder if (folder / "pairs.csv").is_file() else folder.parent
    if not (folder / "pairs.csv").is_file():
        return None

    # It imports pandas, which logs without a survey do not need.
    from uwb_mitigation.recordings.csv_tables import read_csv

    def table(name: str, *ids: str, axes: str = "", texts: tuple[str, ...] = ()) -> ColumnDict:
        columns = read_csv(folder / name, ids, dict.fromkeys(axes, (-1e6, 1e6)), texts)
        keys = columns[ids[0]]
        for row in sorted(set(range(len(keys))) - set(np.unique(keys, return_index=True)[1].tolist()))[:1]:
            raise RecordingError(f"{ids[0]} {keys[row]} is repeated", where=f"{folder / name}: row {row + 1}")
        return columns

    labels, surveyed = {}, {}
    if (folder / "labels.csv").is_file():
        columns = table("labels.csv", "file_id", texts=("label",))
        labels = dict(zip(columns["file_id"].tolist(), columns["label"].tolist(), strict=True))
    for kind in ("anchor", "tag"):
        columns = table(f"{kind}s.csv", "location", axes="xy")
        positions = zip(columns["x"].tolist(), columns["y"].tolist(), strict=True)
        surveyed[kind] = dict(zip(columns["location"].tolist(), positions, strict=True))
    pairs = table("pairs.csv", "file_number", "anchor_location", "tag_location")
    placements = {}
    for row, log in enumerate(pairs["file_number"].tolist()):
        anchor, tag = (int(pairs[f"{kind}_location"][row]) for kind in surveyed)
        for kind, location in (("anchor", anchor), ("tag", tag)):
            if location not in surveyed[kind]:
                what = f"{kind} location {location} is unknown"
                raise RecordingError(what, where=f"{folder / 'pairs.csv'}: row {row + 1}")
        position = surveyed["tag"][tag]
        true_m = math.dist(surveyed["anchor"][anchor], position)
        truth = Truth(true_m, labels.get(log, ""), f"{folder.name}/{log}")
        placements[log] = Placement(anchor, tag, (*position, 0.0), truth)
    anchors = [Anchor(key, (x, y, 0.0)) for key, (x, y) in surveyed["anchor"].items()]
    return placements, AnchorMap(anchors, str(folder / "anchors.csv"))


def _make_log(path: Path, survey: Survey | None, cir: CirFrame) -> DecaRangingLog:
    log = _log_number(path)
    return DecaRangingLog(path, cir, survey[0].get(log) if survey and log is not None else None)


def _log_number(path: Path) -> int | None:
    stem = path.name.split(".", 1)[0]
    return int(stem) if stem.isascii() and stem.isdigit() and len(stem) <= 18 else None
