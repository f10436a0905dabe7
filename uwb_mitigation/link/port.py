"""The serial port of a board, kept open in a thread of its own: found, opened, read, and opened again.

What the bytes mean is for `session`.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import select
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import serial
from serial.tools import list_ports

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.link.event_queue import EventQueue
from uwb_mitigation.link.events import Event, LinkState
from uwb_mitigation.link.layout import Mode
from uwb_mitigation.link.messages import Hello
from uwb_mitigation.link.radio import RadioSettings
from uwb_mitigation.link.session import BoardSession
from uwb_mitigation.offsets import Offsets

FIRST_RETRY_S = 0.1
LAST_RETRY_S = 0.5
"""A port that came back is to be noticed well within a second; looking costs next to nothing."""

REOPEN_AFTER_SILENCE_NS = 10 * 10**9
"""A port that stays open but dead, as after a suspend, works again only when it is opened anew."""

_TICK_S = 0.05
_READ_BYTES = 1 << 16


@dataclass(frozen=True, slots=True)
class PortAddress:
    """Where a board is: a device file, or a USB device wherever it is plugged in.

    Attributes:
        device: path of the device file; empty = find by USB.
        vendor, product: USB ids.
        serial_number: of the USB device; empty = the first that has the ids.
    """

    device: str = ""
    vendor: int = 0
    product: int = 0
    serial_number: str = ""

    @classmethod
    def parse(cls, text: str) -> PortAddress:
        """Read `/dev/ttyACM0`, `usb:2341:805a` or `usb:2341:805a:SERIAL` (ids in hexadecimal).

        Raises:
            ParameterError: the text is none of these.
        """
        if not text:
            raise ParameterError(
                "no port is given", valid="port:=/dev/ttyACM0 or port:=usb:VENDOR:PRODUCT[:SERIAL]"
            )
        if text.startswith("/"):
            return cls(device=text)
        kind, *parts = text.split(":", 3)
        try:
            if kind == "usb" and len(parts) in (2, 3):
                vendor, product = int(parts[0], 16), int(parts[1], 16)
                if 0 <= vendor <= 0xFFFF and 0 <= product <= 0xFFFF:
                    return cls("", vendor, product, parts[2] if len(parts) == 3 else "")
        except ValueError:
            pass
        raise ParameterError(
            f"the port {text!r}", valid="a path such as /dev/ttyACM0, or usb:VENDOR:PRODUCT[:SERIAL]"
        )

    def __str__(self) -> str:
        if self.device:
            return self.device
        tail = f":{self.serial_number}" if self.serial_number else ""
        return f"usb:{self.vendor:04x}:{self.product:04x}{tail}"

    def find(self) -> str | None:
        """Path of the device file, or None while there is none."""
        if self.device:
            return self.device if os.path.exists(self.device) else None
        for port in list_ports.comports():
            if (port.vid, port.pid) == (self.vendor, self.product) and self.serial_number in (
                "",
                port.serial_number,
            ):
                return str(port.device)
        return None


def users_of(path: str) -> list[str]:
    """Return the other programs that have a device file open, such as `minicom (process 123)`; only those of this user
    unless it is root.
    """
    device, found = os.path.realpath(path), []
    for process in os.listdir("/proc"):
        if not process.isdigit() or int(process) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            folder = f"/proc/{process}/fd"
            if any(os.readlink(f"{folder}/{fd}") == device for fd in os.listdir(folder)):
                with open(f"/proc/{process}/comm", encoding="utf-8") as name:
                    found.append(f"{name.read().strip()} (process {process})")
    return found


def why_not_opened(address: PortAddress, error: Exception) -> str:
    """Return why a port could not be opened, and what to do."""
    code = getattr(error, "errno", None)
    if code in (errno.EAGAIN, errno.EBUSY):
        users = ", ".join(users_of(address.find() or "")) or "another program"
        return f"in use by {users} (close it; sudo fuser -v {address.find()} lists the users)"
    return (
        f"{error} (sudo usermod -aG dialout $USER, then log in again)" if code == errno.EACCES else str(error)
    )


@dataclass(frozen=True, slots=True)
class PortReport:
    """How a port and its board fare, for diagnostics.

    Attributes:
        port: the device file in use; empty while there is none.
        problem: what keeps the board from being connected; empty while it is.
        hello: what the connected board says of itself.
        clock_offset_s: host's clock minus the board's uptime.
        clock_drift_ppm: what the host's clock gains on the board's.
        clock_uncertainty_us: standard deviation of the offset; NaN before the first round trip.
        counts: {name: count} of frames and events that were lost, and why.
    """

    port: str
    problem: str
    hello: Hello | None
    clock_offset_s: float
    clock_drift_ppm: float
    clock_uncertainty_us: float
    counts: dict[str, int]


class BoardPort:
    """Keeps a board connected until `close`, through unplugging, resets, silence and noise.

    Nothing that the port or the board does ends it or raises: `report` says what is wrong.

    Args:
        address: where the board is.
        baud: of a real serial line; native USB ignores it.
        dtr: the level of DTR. Boards with native USB send only while it is set; on boards with a
            USB bridge, its change resets the board.
        mode, expected_model_id: see `BoardSession`.
        stamp_clock: the clock that stamps are on, ns; a node passes its own.
        capacity: events that wait at most; beyond it the oldest are dropped, and counted.
    """

    def __init__(
        self,
        address: PortAddress,
        *,
        baud: int = 921_600,
        dtr: bool = True,
        mode: Mode | None = None,
        expected_model_id: int | None = None,
        stamp_clock: Callable[[], int] = time.time_ns,
        capacity: int = 1024,
    ) -> None:
        self._address = address
        self._baud = baud
        self._dtr = dtr
        self._stamp_clock = stamp_clock
        self._session = BoardSession(mode=mode, expected_model_id=expected_model_id)
        self._events: EventQueue[Event] = EventQueue(capacity)
        self._openings = 0
        self._port = self._others = ""
        self._problem = f"{address} is not there"
        # Guards the session, and what is told of it.
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, name=f"board at {address}", daemon=True)
        self._thread.start()

    def get(self, timeout_s: float) -> Event | None:
        """The next event, or None if there is none within the time.

        Once the port is closed it is None at once: events that were still waiting are void.
        """
        return self._events.get(timeout_s)

    def set_mode(self, mode: Mode) -> None:
        """See `BoardSession.set_mode`."""
        with self._lock:
            self._session.set_mode(mode)

    def set_radio(self, settings: RadioSettings) -> None:
        """See `BoardSession.set_radio`."""
        with self._lock:
            self._session.set_radio(settings)

    def set_offsets(self, offsets: Offsets) -> None:
        """See `BoardSession.set_offsets`."""
        with self._lock:
            self._session.set_offsets(offsets)

    def report(self) -> PortReport:
        """How things stand."""
        with self._lock:
            session = self._session
            decoder, counts = session.decoder_counts, session.counts
            return PortReport(
                port=self._port,
                problem=self._problem_now(),
                hello=session.hello,
                clock_offset_s=session.clock.offset_ns / 1e9,
                clock_drift_ppm=session.clock.drift * 1e6,
                clock_uncertainty_us=session.clock.uncertainty_ns / 1e3
                if session.clock.synchronised
                else math.nan,
                counts={
                    "frames": decoder.frames,
                    "corrupt": decoder.corrupt,
                    "foreign_version": decoder.foreign_versions.total(),
                    "lost": counts.lost,
                    "stale": counts.stale,
                    "withheld": counts.withheld,
                    "unknown_type": counts.unknown_types.total(),
                    "malformed": counts.malformed,
                    "wrong_model": counts.wrong_model,
                    "wrong_offsets": counts.wrong_offsets,
                    "unasked": counts.unasked,
                    "unsent": counts.unsent,
                    "overflowed": self._events.overflowed,
                    "connections": counts.connections,
                    "openings": self._openings,
                },
            )

    @property
    def problem(self) -> str:
        """As `report` has it."""
        with self._lock:
            return self._problem_now()

    @property
    def closed(self) -> bool:
        """True once `close` was called."""
        return self._stop.is_set()

    def close(self) -> None:
        """End the thread and close the port; may be called twice, and from any thread."""
        with self._lock:
            if self._stop.is_set():
                return
            self._stop.set()
        self._events.close()
        os.write(self._wake_write, b"\0")
        self._thread.join()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _run(self) -> None:
        retry_s = FIRST_RETRY_S
        while not self._stop.is_set():
            connections = self._session.counts.connections
            port = self._open()
            if port is not None:
                problem = self._serve(port)
                with self._lock:
                    self._port, self._problem = "", problem
                    self._events.put(self._session.closed(time.monotonic_ns()))
                port.close()
            if self._session.counts.connections > connections:
                retry_s = FIRST_RETRY_S
            self._stop.wait(retry_s)
            retry_s = min(2 * retry_s, LAST_RETRY_S)

    def _open(self) -> serial.Serial | None:
        try:
            path = self._address.find()
            if path is None:
                self._say(f"{self._address} is not there")
                return None
            port = serial.Serial(None, self._baud, timeout=0, exclusive=True)
            port.dtr = self._dtr
            port.port = path
            port.open()
        except (OSError, ValueError) as error:
            # SerialException is an OSError; a ValueError is a baud rate that the port refuses.
            self._say(f"{self._address} cannot be opened: {why_not_opened(self._address, error)}")
            return None
        with contextlib.suppress(OSError, ValueError, NotImplementedError):
            # Bridges hold bytes back for 16 ms otherwise. Other ports do not know the flag.
            port.set_low_latency_mode(True)
        others = ", ".join(users_of(path))
        with self._lock:
            self._port, self._problem = path, ""
            self._others = others
            self._openings += 1
            self._events.put(self._session.opened(time.monotonic_ns()))
        return port

    def _serve(self, port: serial.Serial) -> str:
        """Talk to the board until the port is lost or to be closed; say why."""
        fd = port.fileno()
        os.set_blocking(fd, False)
        outgoing = bytearray()
        try:
            while not self._stop.is_set():
                readable, _, _ = select.select([fd, self._wake_read], [], [], _TICK_S)
                data = os.read(fd, _READ_BYTES) if fd in readable else b""
                if fd in readable and not data:
                    return f"{self._address} was unplugged"
                now_ns, stamp_ns = time.monotonic_ns(), self._stamp_clock()
                with self._lock:
                    self._events.put(self._session.receive(data, now_ns, stamp_ns))
                    if self._session.silent_ns(now_ns) > REOPEN_AFTER_SILENCE_NS:
                        return f"{self._address} is silent"
                    # While the port takes nothing, requests wait in the session, which bounds them.
                    if not outgoing:
                        outgoing += self._session.outgoing()
                if outgoing:
                    with contextlib.suppress(BlockingIOError):
                        del outgoing[: os.write(fd, outgoing)]
        except OSError as error:
            return f"{self._address} was lost: {error.strerror}"
        return "closed"

    def _problem_now(self) -> str:
        session = self._session
        if self._problem:
            return self._problem
        if session.state is LinkState.WRONG_VERSION:
            return f"{session.state.value}: {session.foreign_version}"
        if session.state is not LinkState.READY:
            others = f"; the port is also open in {self._others}" if self._others else ""
            return f"{session.state.value}{others}"
        return "" if session.model_matches else "the board holds another model than the expected one"

    def _say(self, problem: str) -> None:
        with self._lock:
            self._problem = problem
