"""Ports of radios: one thread for each opens the hardware, serves it, and reopens it after a loss.

Everything that a radio reports is passed to a callback: measurements, the events of its session, and `PortMessage`.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import select
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import serial
from serial.tools import list_ports

from uwb_mitigation.errors import LinkError, ParameterError, UwbMitigationError
from uwb_mitigation.radios.capture import CaptureWriter, Session
from uwb_mitigation.radios.settings import PortMessage, RadioStatus
from uwb_mitigation.types.measurement import RangeMeasurement

MIN_RETRY_S = 0.1
MAX_RETRY_S = 0.4
"""Hardware that was plugged in again is found within a second; the search takes little time."""

PROBLEM_DELAY_S = 0.5
"""A problem that lasts longer is logged; a handshake is shorter."""

PERIOD_S = 3.0
"""The diagnostics depend on the exchanges of this period; a longer interval of a radio extends it to three intervals."""

FAILURE_SHARE = 0.2
"""Share of failed exchanges above which a cause is a warning, for the causes that are not expected out of range."""

_READ_BYTES = 1 << 16

_Port = TypeVar("_Port", bound="RadioPort")

OnEvent = Callable[[Any], None]
"""Called with each event, from the thread of the port."""


@dataclass(frozen=True, slots=True)
class PortReport:
    """The state of a radio for the diagnostics.

    Attributes:
        device: device file or bus in use; empty = it is not open.
        hardware: identity of the radio for users.
        problem: reason why the radio does not work; empty while it works.
        warning: reason why it has no ranges, or not all of them, without a problem; or empty.
        activity: what it does if there is neither problem nor warning.
        values: {name: value}.
    """

    device: str
    hardware: str
    problem: str
    warning: str
    activity: str
    values: dict[str, object] = field(default_factory=dict)


class ExchangeMonitor:
    """Ranges and failed exchanges of the last seconds, from which the warning of a radio without ranges follows.

    Args:
        remedies: {cause: cause in words and what to do}.
        unexpected: causes that are a warning also next to ranges, if more than `FAILURE_SHARE` of the exchanges fail.

    Attributes:
        remedies: see above.
        totals: number of all failed exchanges, {cause: count}.
    """

    def __init__(self, remedies: Mapping[str, str], unexpected: Iterable[str] = ()) -> None:
        self.remedies, self._unexpected = remedies, tuple(unexpected)
        self.totals: Counter[str] = Counter()
        self._failures: deque[tuple[float, str, int]] = deque()
        self._ranges: deque[float] = deque(maxlen=4096)
        self._last_range_s: float | None = None

    def add_range(self, now_s: float) -> None:
        """Add a range."""
        self._ranges.append(now_s)
        self._last_range_s = now_s

    def add_failures(self, cause: str, count: int, now_s: float) -> None:
        """Add failed exchanges."""
        if count > 0:
            self.totals[cause] += count
            self._failures.append((now_s, cause, count))
            if len(self._failures) > 4096:
                self._failures.popleft()

    def add_status(self, before: RadioStatus | None, status: RadioStatus, now_s: float) -> None:
        """Add the exchanges that failed between two statuses of a radio; the remedies have the names of its counts."""
        for cause in self.remedies if before is not None else ():
            name = cause.replace(" ", "_")
            self.add_failures(cause, getattr(status, name) - getattr(before, name), now_s)

    def reset(self) -> None:
        """Forget all exchanges, for example after the radio was lost."""
        self._failures.clear()
        self._ranges.clear()
        self._last_range_s = None

    def warning(self, interval_s: float = 0.0) -> str:
        """Return what is wrong with the latest exchanges of a radio with this interval; empty if there are ranges."""
        now_s = time.monotonic()
        begin_s = now_s - max(PERIOD_S, 3.0 * interval_s)
        while self._failures and self._failures[0][0] < begin_s:
            self._failures.popleft()
        while self._ranges and self._ranges[0] < begin_s:
            self._ranges.popleft()
        causes: Counter[str] = Counter()
        for _, cause, count in self._failures:
            causes[cause] += count
        total = causes.total() + len(self._ranges)
        if self._ranges:
            text = "ranging"
            causes = Counter({cause: causes[cause] for cause in self._unexpected})
        elif self._last_range_s is None:
            text = "no range yet"
        else:
            text = f"no range for {now_s - self._last_range_s:.1f} s"
        cause, count = causes.most_common(1)[0] if causes else ("", 0)
        if self._ranges and count <= FAILURE_SHARE * total:
            return ""
        if not cause:
            return text
        return f"{text}: {count} of {total} exchanges failed: {cause}: {self.remedies.get(cause, 'send a field report')}"


class RadioPort(ABC):
    """Keeps a radio connected until `close`. Methods may be called from any thread.

    Hardware errors neither end the thread nor raise an exception; `problem` describes them.

    Args:
        name: of the radio, for users.
        on_event: see `OnEvent`.
        monitor: of the exchanges.

    Attributes:
        openings: how often the hardware was opened.
        device: device file or bus in use; empty = it is not open.
        monitor: its exchanges.
    """

    _range_types: tuple[type, ...] = (RangeMeasurement,)
    """Types of the events that count as ranges."""

    def __init__(self, name: str, on_event: OnEvent, monitor: ExchangeMonitor) -> None:
        self.openings = 0
        self.device = ""
        self._name = name
        self._on_event = on_event
        self.monitor = monitor
        self._lost = f"{name} is not there"
        self._was_connected = False
        self._lock = threading.RLock()
        """Guards the state of the radio; it is not held while `on_event` runs."""
        self._stop = threading.Event()
        self._logged_problem, self._problem_since_s = "", 0.0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self: _Port) -> _Port:
        """Start the thread, and return the port."""
        self._thread.start()
        return self

    @property
    def problem(self) -> str:
        """Reason why the radio does not work; empty if it works."""
        return self._lost

    @property
    def closed(self) -> bool:
        """True once `close` was called."""
        return self._stop.is_set()

    def request_close(self) -> None:
        """Let the thread close the hardware; `close` waits for it."""
        self._stop.set()

    def close(self) -> None:
        """Stop the thread and close the hardware; may be called twice."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    @abstractmethod
    def report(self) -> PortReport:
        """Return the present state."""

    @abstractmethod
    def apply(self, settings: Any) -> None:
        """Use other settings of the same source; those of the port itself stay."""

    @abstractmethod
    def _open(self) -> Any:
        """Open the hardware and set `device`; return what is closed after a loss.

        Raises:
            UwbMitigationError: it cannot be opened.
        """

    @abstractmethod
    def _serve(self, hardware: Any) -> list[Any]:
        """Wait for the radio for a short time; return events.

        Raises:
            UwbMitigationError, OSError: the hardware was lost, or must be opened again.
        """

    def _opened(self, now_ns: int) -> list[Any]:
        """Start the state of the radio, with the lock held, after the hardware was opened; return events."""
        return []

    def _is_stopped(self, now_ns: int) -> bool:
        """Return whether the hardware may be closed; called after `close`, until it returns true."""
        return True

    @abstractmethod
    def _closed(self, now_ns: int) -> list[Any]:
        """End the state of the radio, with the lock held, before the hardware is closed; return events."""

    def _connect(self) -> None:
        """Open the hardware and serve it until the port is closed; raise UwbMitigationError if that fails."""
        hardware = self._open()
        try:
            with self._lock:
                self.openings += 1
                events = self._opened(time.monotonic_ns())
            self._emit(events)
            while not (self.closed and self._is_stopped(time.monotonic_ns())):
                self._emit(self._serve(hardware))
                self._log_problem()
        except OSError as error:
            raise LinkError(f"was lost: {error.strerror}", where=self._name) from error
        finally:
            with self._lock:
                events = self._closed(time.monotonic_ns())
            self._emit(events)
            hardware.close()

    def _emit(self, events: Iterable[object]) -> None:
        for event in events:
            if isinstance(event, self._range_types):
                with self._lock:
                    self.monitor.add_range(time.monotonic())
            self._on_event(event)

    def _log_problem(self, *, lasts: bool = False) -> None:
        """Log a problem once if it lasts; call it at least every `PROBLEM_DELAY_S`."""
        problem, now_s = self.problem, time.monotonic()
        if not problem:
            self._logged_problem, self._problem_since_s = "", 0.0
            return
        self._problem_since_s = self._problem_since_s or now_s
        lasts |= now_s - self._problem_since_s >= PROBLEM_DELAY_S
        if lasts and problem != self._logged_problem and not self.closed:
            self._on_event(PortMessage(logging.WARNING, f"{problem}; waiting for the radio"))
            self._logged_problem = problem

    def _run(self) -> None:
        retry_s = MIN_RETRY_S
        while not self.closed:
            self._was_connected = is_repeated = False
            try:
                self._connect()
            except UwbMitigationError as error:
                with self._lock:
                    is_repeated, self._lost = self._lost == str(error), str(error)
                    self.monitor.reset()
            with self._lock:
                self.device = ""
            if self._was_connected:
                retry_s = MIN_RETRY_S
            # On a busy computer, a few attempts take longer than the delay.
            self._log_problem(lasts=is_repeated)
            self._stop.wait(retry_s)
            retry_s = min(2 * retry_s, MAX_RETRY_S)


@dataclass(frozen=True)
class StreamSettings:
    """Settings of a board on a port with a stream of bytes.

    Attributes:
        address: address of the port.
        baud: baud rate of a serial line; native USB ignores it.
        dtr: the level of DTR. Boards with native USB send only while it is set; on boards with a USB bridge, its change
            resets the board.
        capture: file for the raw bytes of all boards; None = none.
    """

    address: PortAddress
    baud: int = field(default=115_200, kw_only=True)
    dtr: bool = field(default=True, kw_only=True)
    capture: Path | None = field(default=None, kw_only=True)


class StreamPort(RadioPort):
    """A serial port whose bytes a session encodes and decodes. See `stream_opener`.

    Args:
        settings: of the board.
        session: the state of the board.
        monitor: see `RadioPort`.
        place: number of the board, capture of its bytes, receiver of its events, and the clock of the stamps, ns.

    Attributes:
        session: see above.
    """

    session: Session
    _tick_s = 0.05
    """Maximum time between two calls of the session."""

    def __init__(
        self, settings: StreamSettings, session: Session, monitor: ExchangeMonitor, place: StreamPlace
    ) -> None:
        self._number, self._capture, on_event, self._stamp_clock = place
        super().__init__(str(settings.address), on_event, monitor)
        self._settings = settings
        self.session, self._outgoing = session, bytearray()
        self._empty_read_is_loss = True

    @abstractmethod
    def _received(self, data: bytes, now_ns: int, stamp_ns: int) -> list[Any]:
        """Pass bytes and the time to the session, with the lock held; return events.

        Raises:
            LinkError: the port must be opened again.
        """

    def _closed(self, now_ns: int) -> list[Any]:
        return self.session.closed(now_ns)

    def close(self) -> None:
        """Stop the thread, and close the hardware and the capture; may be called twice."""
        super().close()
        capture, self._capture = self._capture, None
        if capture is not None:
            capture.close()

    def _add_to_capture(self, data: bytes, *, sent: bool) -> None:
        if self._capture is not None:
            self._capture.add(self._number, data, sent=sent)

    def _open(self) -> Any:
        port = self._settings.address.open(self._settings.baud, self._settings.dtr)
        with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
            # Without this flag USB bridges delay bytes by 16 ms. Other ports do not support it.
            port.set_low_latency_mode(True)
        self._outgoing.clear()
        with self._lock:
            self.device, self._lost = getattr(port, "port", self._name), ""
        return port

    def _serve(self, hardware: Any) -> list[Any]:
        fd = hardware.fileno()
        readable, _, _ = select.select([fd], [], [], self._tick_s)
        data = os.read(fd, _READ_BYTES) if readable else b""
        if readable and not data and self._empty_read_is_loss:
            raise LinkError("was unplugged", where=self._name)
        now_ns, stamp_ns = time.monotonic_ns(), self._stamp_clock()
        self._add_to_capture(data, sent=False)
        with self._lock:
            events = self._received(data, now_ns, stamp_ns)
            # While the port accepts no bytes, requests wait in the bounded queue of the session.
            if not self._outgoing:
                self._outgoing += self.session.outgoing()
        if self._outgoing:
            with contextlib.suppress(BlockingIOError):
                written = os.write(fd, self._outgoing)
                self._add_to_capture(bytes(self._outgoing[:written]), sent=True)
                del self._outgoing[:written]
        if self._capture is not None and (problem := self._capture.take_problem()):
            events.append(PortMessage(logging.ERROR, problem))
        return events


StreamPlace = tuple[int, CaptureWriter | None, OnEvent, Callable[[], int]]


def stream_opener(make_port: Callable[[Any, StreamPlace], Any], kind: str = "") -> Callable[..., list[Any]]:
    """Return the function `open` of a source of boards on streams.

    `open(settings, on_event, stamp_clock=time.time_ns)` opens boards; `RadioPort.close` ends them. It raises
    ParameterError if the file of the capture, of this `kind`, cannot be written.
    """

    def open(
        settings: Sequence[StreamSettings], on_event: OnEvent, stamp_clock: Callable[[], int] = time.time_ns
    ) -> list[Any]:
        path = settings[0].capture
        capture = CaptureWriter(path, kind, len(settings)) if path is not None else None
        places = [(number, capture, on_event, stamp_clock) for number in range(len(settings))]
        return [port.start() for port in list(map(make_port, settings, places))]

    return open


@dataclass(frozen=True)
class PortAddress:
    """Address of a board: a device file, or the ids of a USB device.

    Attributes:
        device: path of the device file; empty = search by USB ids.
        vendor, product: USB ids.
        serial_number: of the USB device; empty = the first device with the ids.
    """

    device: str = ""
    vendor: int = 0
    product: int = 0
    serial_number: str = ""

    @classmethod
    def parse(cls, text: str) -> PortAddress:
        """Read `/dev/ttyACM0`, `usb:2341:805a` or `usb:2341:805a:SERIAL` (ids in hexadecimal).

        Raises:
            ParameterError: the text has another format.
        """
        if text.startswith("/"):
            return cls(device=text)
        if ids := re.fullmatch("usb:([0-9a-fA-F]{1,4}):([0-9a-fA-F]{1,4})(?::(.*))?", text):
            return cls("", int(ids[1], 16), int(ids[2], 16), ids[3] or "")
        raise ParameterError(
            f"the port {text!r}" if text else "no port is given",
            valid="port:=/dev/ttyACM0, or port:=usb:VENDOR:PRODUCT[:SERIAL]",
        )

    def __str__(self) -> str:
        if self.device:
            return self.device
        tail = f":{self.serial_number}" if self.serial_number else ""
        return f"usb:{self.vendor:04x}:{self.product:04x}{tail}"

    def find(self) -> str | None:
        """Return the path of the device file, or None if it does not exist."""
        if self.device:
            return self.device if os.path.exists(self.device) else None
        for port in list_ports.comports():
            is_wanted = self.serial_number in ("", port.serial_number)
            if is_wanted and (port.vid, port.pid) == (self.vendor, self.product):
                return str(port.device)
        return None

    def open(self, baud: int = 9600, dtr: bool = True) -> serial.Serial:
        """Open the port exclusively, with non-blocking reads and writes.

        Raises:
            LinkError: it is absent, in use or forbidden; the message contains the remedy.
        """
        path = ""
        try:
            path = self.find() or ""
            if not path:
                raise LinkError("is not there", where=self, valid="plug the board in")
            port = serial.Serial(None, baud, timeout=0, exclusive=True)
            port.dtr = dtr
            port.port = path
            port.open()
        except (OSError, TypeError, ValueError) as error:
            # SerialException is an OSError; a ValueError is a baud rate that the port refuses; pyserial raises a
            # TypeError if a USB device is unplugged while it lists the ports.
            raise LinkError(f"cannot be opened: {_open_error(path, error)}", where=self) from error
        os.set_blocking(port.fileno(), False)
        return port


def processes_using(path: str) -> list[str]:
    """Return the other programs that have a device file open, such as `minicom (process 123)`.

    Without root, only the programs of this user are visible.
    """
    device, programs = os.path.realpath(path), []
    for process in os.listdir("/proc"):
        if not process.isdigit() or int(process) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            folder = f"/proc/{process}/fd"
            if any(os.readlink(f"{folder}/{fd}") == device for fd in os.listdir(folder)):
                with open(f"/proc/{process}/comm", encoding="utf-8") as name:
                    programs.append(f"{name.read().strip()} (process {process})")
    return programs


def _open_error(path: str, error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code in (errno.EAGAIN, errno.EBUSY):
        users = ", ".join(processes_using(path)) or "another program"
        return f"in use by {users} (close it; sudo fuser -v {path} lists the users)"
    remedy = " (sudo usermod -aG dialout $USER, then log in again)" if code == errno.EACCES else ""
    return f"{error}{remedy}"
