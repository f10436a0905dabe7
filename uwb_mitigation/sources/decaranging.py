"""Logs of Decawave's DecaRanging PC program (EVK1000) as sources: one file, or a folder of them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.measurement import Record, Truth
from uwb_mitigation.positioning.anchors import AnchorMap
from uwb_mitigation.sources.decaranging_format import CirOf, ExchangeReader, Oddity, is_log, stated_start_ns
from uwb_mitigation.sources.log_lines import LogLines, chunks
from uwb_mitigation.sources.source import Source
from uwb_mitigation.sources.surveyed_positions import Survey

__all__ = ["CirOf", "DecaRangingFolder", "DecaRangingLog", "Oddity", "open_decaranging"]

VALID_LOG = "a log of DecaRanging: lines such as 'File:', 'RX DATA:', 'RX OK', 'Anchor ToF:'"


class DecaRangingLog(Source):
    """The exchanges of one log, `.log` or `.log.xz` (told apart by content); a `Source`.

    A range is never lost: where the CIR that belongs to it is absent or malformed, the measurement
    has a CIR without samples. What in the middle of a log is malformed is counted in `skipped` (see
    `Oddity`) and reading goes on; a log that ends in the middle of a line or of an accumulator is damaged.

    `stamp_ns` is the start time in the log's first line, taken as UTC (0 where there is none), plus
    the time by the radio's counter from the first frame received to the exchange's last. The counter
    is unwrapped from frame to frame: a silence of more than 17.2 s cannot be seen in it.
    `device_time` is that of the frame that the CIR comes from, 0 where no frame was received.

    Args:
        path: the log.
        cir: which frame's CIR belongs to the range.
        truth: what was surveyed for this log. tag_position: where its tag stood, x, y, z in m.
        tag_id, anchor_id: in place of the 64-bit addresses in the frames (0 before the first frame).
    """

    simulated = False

    def __init__(
        self,
        path: Path | str,
        *,
        cir: CirOf = CirOf.FINAL,
        truth: Truth | None = None,
        tag_position: tuple[float, float, float] | None = None,
        tag_id: int | None = None,
        anchor_id: int | None = None,
    ) -> None:
        self.path = Path(path)
        self.name = f"DecaRanging log {self.path.name}"
        self.skipped: Counter[str] = Counter()
        self._cir_of = cir
        self._truth = truth
        self._tag_position = tag_position
        self._tag_id = tag_id
        self._anchor_id = anchor_id
        self._files: set[BinaryIO] = set()
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Record]:
        """Yield the exchanges that have a range.

        Raises:
            RecordingError: the file is absent, empty, or no DecaRanging log.
            DamagedRecordingError: the log is cut short or corrupt; names the line before.
        """
        return self.records()

    def records(self, first_sequence: int = 0, not_before_ns: int = 0) -> Iterator[Record]:
        """As iteration, for a log that follows others: counts on from there, and starts no earlier."""
        self.skipped = Counter()
        if self._closed.is_set():
            raise _closed_error(self.path)
        try:
            with self._opened() as lines:
                if self._truth is None:
                    self.skipped[Oddity.NO_TRUTH.value] += 1
                reader = ExchangeReader(
                    lines,
                    self.skipped,
                    self._cir_of,
                    self._tag_id,
                    self._anchor_id,
                    first_sequence,
                    not_before_ns,
                )
                for measurement in reader.measurements():
                    if self._closed.is_set():
                        return
                    yield Record(measurement, self._truth, self._tag_position)
        except RecordingError:
            if not self._closed.is_set():
                raise

    def start_ns(self) -> int:
        """The start time in the log's first line, ns since the epoch; 0 where it states none.

        Raises:
            RecordingError: see `__iter__`.
        """
        with self._opened() as lines:
            return stated_start_ns(lines.head())

    @contextmanager
    def _opened(self) -> Iterator[LogLines]:
        """The lines of the log, while it is open."""
        if not self.path.is_file():
            raise RecordingError("no such file", where=str(self.path), valid=VALID_LOG)
        try:
            file = self.path.open("rb")
        except OSError as error:
            raise RecordingError(f"cannot open: {error.strerror}", where=str(self.path)) from error
        self._files.add(file)
        try:
            lines = LogLines(chunks(file, self.path), self.path)
            head = lines.head()
            if not is_log(head):
                what = "not a DecaRanging log" if head else "the log is empty"
                raise RecordingError(what, where=str(self.path), valid=VALID_LOG)
            yield lines
        except ValueError as error:
            # What a file says that another thread has closed.
            if self._closed.is_set():
                raise _closed_error(self.path) from error
            raise
        finally:
            self._files.discard(file)
            file.close()

    def close(self) -> None:
        """End iterations under way and release their files; the source cannot be iterated again."""
        self._closed.set()
        for file in tuple(self._files):
            file.close()


class DecaRangingFolder(Source):
    """The logs of a folder one after the other, with what was surveyed; a `Source`.

    The logs are those in the folder, or else in its sub-folder `logs`; the survey's CSV files (see
    `survey`) are there or in the folder above. All logs of a survey are made with the same two boards,
    moved about: their tag and anchor therefore bear the numbers of the surveyed locations, not the
    boards' addresses, so that a pair is one pair of locations. Anchor 2 and tag 2 are two locations.
    Logs without a row in the survey keep the addresses and have no truth.

    Order is that of start times, then of log numbers. Where a log would begin before the one
    before it ends, it is moved later, so that time never runs backwards. A log that is damaged or
    is none does not keep those after it from being read: the first such error is raised at the end.

    Args:
        path: the folder.
        cir: which frame's CIR belongs to the range.

    Attributes:
        anchors: the surveyed locations of anchors, at z = 0; only where there is a survey.

    Raises:
        RecordingError: the folder is absent or without logs, or its survey is malformed.
    """

    simulated = False
    anchors: AnchorMap

    def __init__(self, path: Path | str, *, cir: CirOf = CirOf.FINAL) -> None:
        self.path = Path(path)
        self.skipped: Counter[str] = Counter()
        self._closed = threading.Event()
        paths, self._twice = _logs_of(self.path)
        survey = Survey.find(paths[0].parent)
        self._logs = [_surveyed(log, survey, cir) for log in paths]
        if survey is not None:
            self.anchors = survey.anchors
        self.name = f"DecaRanging folder {self.path.resolve().name} ({len(paths)} logs)"

    def __iter__(self) -> Iterator[Record]:
        """Yield the exchanges that have a range.

        Raises:
            RecordingError, DamagedRecordingError: a log could not be read to its end; all others were.
        """
        self.skipped = Counter()
        if self._closed.is_set():
            raise _closed_error(self.path)
        if self._twice:
            self.skipped[Oddity.TWICE.value] = self._twice
        first_error: RecordingError | None = None
        sequence = last_ns = 0
        for start_ns, log in self._in_order():
            if start_ns < last_ns:
                self.skipped[Oddity.MOVED.value] += 1
            try:
                for record in log.records(sequence, last_ns):
                    last_ns = record.measurement.stamp_ns
                    sequence += 1
                    yield record
            except RecordingError as error:
                if self._closed.is_set():
                    return
                self.skipped[Oddity.UNREADABLE.value] += 1
                first_error = first_error or error
            finally:
                self.skipped.update(log.skipped)
        if first_error is not None:
            raise first_error

    def _in_order(self) -> list[tuple[int, DecaRangingLog]]:
        started = [(_start_or_zero_ns(log), log) for log in self._logs]
        return sorted(started, key=lambda pair: (pair[0], _number_of(pair[1].path) or 0, pair[1].path.name))

    def close(self) -> None:
        """End iterations under way and release their files; the source cannot be iterated again."""
        self._closed.set()
        for log in self._logs:
            log.close()


def open_decaranging(path: Path | str, *, cir: CirOf = CirOf.FINAL) -> DecaRangingLog | DecaRangingFolder:
    """The source for a log or a folder of logs, with the truth that a survey beside it gives.

    Raises:
        RecordingError: nothing is there, the folder holds no logs, or the survey is malformed.
    """
    path = Path(path)
    if path.is_dir():
        return DecaRangingFolder(path, cir=cir)
    if not path.is_file():
        raise RecordingError("no such file or folder", where=str(path), valid=VALID_LOG)
    return _surveyed(path, Survey.find(path.parent), cir)


def _closed_error(path: Path) -> RecordingError:
    return RecordingError("the source is closed", where=str(path), valid="open it anew")


def _start_or_zero_ns(log: DecaRangingLog) -> int:
    try:
        return log.start_ns()
    except RecordingError:
        return 0  # reading the log raises it again, where it is reported


def _surveyed(path: Path, survey: Survey | None, cir: CirOf) -> DecaRangingLog:
    number = _number_of(path)
    placement = survey.placements.get(number) if survey is not None and number is not None else None
    if placement is None:
        return DecaRangingLog(path, cir=cir)
    return DecaRangingLog(
        path,
        cir=cir,
        truth=placement.truth,
        tag_position=placement.tag_position,
        tag_id=placement.tag,
        anchor_id=placement.anchor,
    )


def _logs_of(folder: Path) -> tuple[list[Path], int]:
    """The logs of a folder, each once (the plain one of two), and how many were there twice."""
    if not folder.is_dir():
        raise RecordingError("no such folder", where=str(folder), valid="a folder of DecaRanging logs")
    for place in (folder, folder / "logs"):
        compressed = {path.name[: -len(".xz")]: path for path in place.glob("*.log.xz") if path.is_file()}
        plain = {path.name: path for path in place.glob("*.log") if path.is_file()}
        if compressed or plain:
            return sorted({**compressed, **plain}.values()), len(compressed.keys() & plain.keys())
    raise RecordingError("the folder holds no logs", where=str(folder), valid="*.log or *.log.xz, or logs/")


def _number_of(path: Path) -> int | None:
    stem = path.name.split(".", 1)[0]
    return int(stem) if stem.isascii() and stem.isdigit() and len(stem) <= 18 else None
