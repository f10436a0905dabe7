"""Sources `lines` and `pans`: boards that print their ranges as text, on serial ports or UDP, read with a mapping file.

`pans` is a DWM1001 with its factory firmware, which the mapping `dwm1001_pans` describes.
"""

from __future__ import annotations

import logging
import re
import socket
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from uwb_mitigation.errors import LinkError, ParameterError, RecordingError
from uwb_mitigation.radios import port
from uwb_mitigation.radios.capture import Capture, Session
from uwb_mitigation.radios.parameters import ValueReader, read_baud, read_capture, read_ports
from uwb_mitigation.radios.settings import PortMessage
from uwb_mitigation.recordings.live_ranges import LiveConverter
from uwb_mitigation.recordings.mapping.conversion import UNREADABLE
from uwb_mitigation.recordings.mapping.mapping import Mapping, StartDialogue, load_mapping
from uwb_mitigation.types.measurement import RangeMeasurement

MAX_LINE = 1 << 16
"""Size after which a line is discarded."""

REOPEN_NS = 70 * 10**9
"""Time without data after which the port is opened again; some tags report once a minute while they do not move."""

FIRST_PAUSE_NS, MAX_PAUSE_NS = 10**9, 30 * 10**9
"""Time without a range before the output is started, and longest time until the next try, which doubles."""

MAX_WAKES = 7
"""Number of tries without a range, after more than a minute, after which the board is treated as after its connection."""

MAX_STAMP_OFFSET_S = 1.0
"""A larger difference between the stamps of a board and the clock of this computer is a warning."""

_MAX_ANSWER = 1024
_LINES, _NO_MATCH, _TOO_LONG = "lines", "lines that do not match", "lines that are too long"
_STARTS = "starts of the output"
_LINE_COUNTS = (_LINES, _NO_MATCH, _TOO_LONG, _STARTS)


@dataclass(frozen=True)
class UdpAddress(port.PortAddress):
    """An address at which datagrams are received, instead of a serial port; each ends a line.

    Attributes:
        host: address of this computer; empty: all.
        number: of the UDP port.
    """

    host: str = ""
    number: int = 0

    def __str__(self) -> str:
        return f"udp:{self.host}:{self.number}" if self.host else f"udp:{self.number}"

    def find(self) -> str | None:
        return str(self)

    def open(self, baud: int = 0, dtr: bool = True) -> Any:
        receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        try:
            receiver.bind((self.host, self.number))
        except OSError as error:
            receiver.close()
            raise LinkError(f"cannot be opened: {error.strerror or error}", where=self) from error
        return receiver


@dataclass(frozen=True)
class LineSettings(port.StreamSettings):
    """Settings of a board; `mapping`: where the values are in its lines, and the baud rate unless there is another one."""

    mapping: Mapping
    baud: int = field(default=0, kw_only=True)


def read_settings(value: ValueReader) -> list[LineSettings]:
    """Return the settings of the boards at `port`; raise ParameterError if a parameter is invalid."""
    addresses, mapping = [parse_address(text) for text in read_ports(value)], read_mapping(value)
    line = {"baud": read_baud(value, mapping.baud), "dtr": value("dtr"), "capture": read_capture(value)}
    return [LineSettings(address, mapping, **line) for address in addresses]


def read_mapping(value: ValueReader) -> Mapping:
    """Return the mapping of the parameters.

    Raises:
        ParameterError: there is none, or it is not for lines.
    """
    mapping = load_mapping(value("map") or ("dwm1001_pans" if value("source") == "pans" else ""))
    LineSession(mapping)
    return mapping


def parse_address(text: str) -> port.PortAddress:
    """Read `udp:PORT` or `udp:ADDRESS:PORT`, or an address of `PortAddress`; raise ParameterError for other texts."""
    if not text.startswith("udp:"):
        return port.PortAddress.parse(text)
    host, _, number = text.removeprefix("udp:").rpartition(":")
    if not number.isdecimal() or not 0 < int(number) < 65536:
        raise ParameterError(f"the port {text!r:.60}", valid="udp:PORT or udp:ADDRESS:PORT, such as udp:8000")
    return UdpAddress(host=host, number=int(number))


def open_capture(path: Path, value: ValueReader) -> Capture:
    """Open a capture as a recording; a mapping of the parameters replaces the captured one.

    Raises:
        RecordingError: it cannot be read.
        ParameterError: the mapping is invalid.
    """
    mapping = read_mapping(value) if value("map") else None

    def session(settings: dict[str, Any]) -> LineSession:
        used = mapping or Mapping.model_validate(settings["mapping"])
        return LineSession(used, int(settings["number"]), has_datagrams=bool(settings["datagrams"]))

    return Capture(path, "lines", session)


class LineSession(Session):
    """The host's side of a board that prints lines. No I/O.

    Call `receive` after each read, and at least every second; send `outgoing`. `now_ns` is monotonic, `stamp_ns` is the
    clock of the stamps.

    Args:
        mapping: where the values are in a line, and how the output is started.
        number: number of the board; it is added to a constant id of the tag.
        has_datagrams: whether a line ends with each piece of data.

    Attributes:
        counts: numbers of lines and problems, and of rows that were not used, by reason.
        example: the last line that does not match the mapping, and why; empty: none.
        received: number of bytes since the port was opened.
        stamp_offset_s: last stamp minus time of reception.

    Raises:
        ParameterError: the mapping is not for lines.
    """

    def __init__(self, mapping: Mapping, number: int = 0, *, has_datagrams: bool = False) -> None:
        if not (mapping.pattern or mapping.text):
            valid = "for lines: a mapping with pattern or text"
            raise ParameterError(f"the mapping {mapping.name} is for recordings or topics", valid=valid)
        tag = mapping.fields.tag
        if number and isinstance(tag.constant, int):
            tag = tag.model_copy(update={"constant": tag.constant + number})
            fields = mapping.fields.model_copy(update={"tag": tag})
            mapping = mapping.model_copy(update={"fields": fields})
        super().__init__()
        # Datagrams are only received.
        self._start = None if has_datagrams else mapping.start
        self.mapping, self._has_datagrams = mapping, has_datagrams
        self._converter = LiveConverter(mapping, "lines")
        self.counts = self._converter.counts
        self.example, self.stamp_offset_s = "", 0.0
        self.opened(0)

    def opened(self, now_ns: int) -> None:
        """Begin with a port that was opened."""
        self.received = 0
        self._incomplete, self._incomplete_stamp_ns = b"", 0
        # The port may be opened in the middle of a line.
        self._is_partial = not self._has_datagrams
        self._outgoing.clear()
        self._answer = b""
        self._is_waking = self._was_started = self._was_reset = False
        self._pause_ns, self._due_ns, self._wakes = FIRST_PAUSE_NS, now_ns + FIRST_PAUSE_NS, 0

    @property
    def unused(self) -> Counter[str]:
        """Numbers of rows that were not used, by reason."""
        return Counter({reason: count for reason, count in self.counts.items() if reason not in _LINE_COUNTS})

    def receive(self, data: bytes, now_ns: int, stamp_ns: int) -> list[RangeMeasurement]:
        """Return the ranges of the lines that are complete; the stamp of a line is that of its first byte."""
        self.received += len(data)
        *lines, incomplete = re.split(
            rb"[\r\n]", self._incomplete + data + (b"\n" if data and self._has_datagrams else b"")
        )
        stamps_ns = [self._incomplete_stamp_ns or stamp_ns] + [stamp_ns] * len(lines)
        self._incomplete, self._incomplete_stamp_ns = incomplete, stamps_ns[len(lines)] if incomplete else 0
        measurements: list[RangeMeasurement] = []
        for line, line_stamp_ns in zip(lines, stamps_ns, strict=False):
            if not self._is_partial and line.strip():
                measurements += self._read(line.decode("utf-8", "replace").strip(), line_stamp_ns)
            self._is_partial = False
        if len(incomplete) > MAX_LINE:
            self.counts[_TOO_LONG] += not self._is_partial
            self._incomplete, self._incomplete_stamp_ns, self._is_partial = b"", 0, True
        if self._start is not None:
            self._converse(self._start, data, now_ns, bool(measurements))
        return measurements

    def _read(self, line: str, stamp_ns: int) -> list[RangeMeasurement]:
        self.counts[_LINES] += 1
        before, reason, measurements = self.counts.total(), "", []
        try:
            measurements = self._converter.measurements(line, "lines", stamp_ns)
        except (RecordingError, *UNREADABLE) as error:
            reason = f" ({getattr(error, 'what', error)!s:.60})"
        # A row that was not used has already been counted by its reason.
        if not measurements and self.counts.total() == before:
            self.counts[_NO_MATCH] += 1
            self.example = f"{line!r:.60}{reason}"
        for measured in measurements:
            self.stamp_offset_s = (measured.stamp_ns - stamp_ns) / 1e9
        return measurements

    def _converse(self, start: StartDialogue, data: bytes, now_ns: int, has_ranges: bool) -> None:
        """Start the output of a board without ranges."""
        if has_ranges:
            self._is_waking, self._pause_ns, self._wakes = False, FIRST_PAUSE_NS, 0
            self._due_ns = now_ns + 3 * FIRST_PAUSE_NS
            return
        if self._is_waking:
            self._answer = (self._answer + data)[-_MAX_ANSWER:]
            answer = self._answer.decode("ascii", "replace")
            is_ready = bool(re.search(start.ready, answer))
            if not is_ready and start.unknown and not self._was_started and re.search(start.unknown, answer):
                # Before the reset, `command` might turn the output off.
                is_ready = self._was_reset
                if not is_ready:
                    self._outgoing += start.reset.encode()
                    self._is_waking, self._was_reset = False, True
            if is_ready:
                self._outgoing += start.command.encode()
                self._is_waking, self._was_started = False, True
                self.counts[_STARTS] += 1
        if now_ns >= self._due_ns:
            self._wakes += 1
            if self._wakes == MAX_WAKES:
                self._was_started = self._was_reset = False
                self._pause_ns = FIRST_PAUSE_NS
            self._outgoing += start.wake.encode()
            self._is_waking, self._answer = True, b""
            self._due_ns = now_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, MAX_PAUSE_NS)


class LinePort(port.StreamPort):
    """Operates one board until `close`; see `StreamPort`. Events are measurements and `PortMessage`."""

    session: LineSession

    def __init__(self, settings: LineSettings, place: port.StreamPlace) -> None:
        self._is_udp = isinstance(settings.address, UdpAddress)
        session = LineSession(settings.mapping, place[0], has_datagrams=self._is_udp)
        settings = replace(settings, baud=settings.baud or settings.mapping.baud)
        super().__init__(settings, session, port.ExchangeMonitor({}), place)
        self._mapping, self._received_ns, self._has_ranges = settings.mapping, 0, False
        self._empty_read_is_loss = not self._is_udp

    def apply(self, settings: LineSettings) -> None:
        """Change nothing: no parameter of this source is live."""

    def report(self) -> port.PortReport:
        """Return the present state."""
        with self._lock:
            session = self.session
            values: dict[str, object] = {"mapping": session.mapping.name} | dict(session.counts)
            if session.example:
                values["last line that does not match"] = session.example
            values |= {"bytes": session.received, "openings": self.openings}
            hardware = f"{session.mapping.name} at {self._name}"
            return port.PortReport(self.device, hardware, self.problem, self._warning(), "receiving", values)

    def _warning(self) -> str:
        session, text = self.session, self.monitor.warning()
        if text and not session.received:
            setting = "sender's address" if self._is_udp else f"baud rate {self._settings.baud}"
            return f"{text}: nothing was received; is the {setting} right?"
        if text and session.example:
            count = session.counts[_NO_MATCH]
            return f"{text}: {count} lines do not match the mapping {session.mapping.name}, such as {session.example}"
        if text and (reasons := session.unused):
            reason, count = reasons.most_common(1)[0]
            return f"{text}: {count} rows were not used: {reason}"
        if not text and abs(session.stamp_offset_s) > MAX_STAMP_OFFSET_S:
            remedy = "leave fields.stamp out to use the time of reception"
            return f"the stamps of the board differ by {session.stamp_offset_s:.1f} s from this computer's clock; {remedy}"
        return text

    def _opened(self, now_ns: int) -> list[Any]:
        if self._capture is not None:
            mapping = self._mapping.model_dump(mode="json", exclude_unset=True)
            settings = {"number": self._number, "datagrams": self._is_udp, "mapping": mapping}
            self._capture.add_board(self._number, settings)
        self._received_ns, self._has_ranges = now_ns, False
        self.session.opened(now_ns)
        self.monitor.reset()
        return []

    def _received(self, data: bytes, now_ns: int, stamp_ns: int) -> list[Any]:
        if data:
            self._received_ns, self._was_connected = now_ns, True
        elif not self._is_udp and now_ns - self._received_ns > REOPEN_NS:
            raise LinkError("sends no data", where=self._name)
        measurements: list[Any] = [*self.session.receive(data, now_ns, stamp_ns)]
        if measurements and not self._has_ranges:
            self._has_ranges = True
            text = f"{self.session.mapping.name} at {self.device}: ranges of tag {measurements[0].tag_id}"
            return [PortMessage(logging.INFO, text), *measurements]
        return measurements


open = port.stream_opener(LinePort, "lines")
