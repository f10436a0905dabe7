"""A UCI board on a serial port, operated by a thread."""

from __future__ import annotations

import contextlib
import math
import os
import select
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import serial

from uwb_mitigation.errors import LinkError
from uwb_mitigation.radios.fira.capture import CaptureWriter
from uwb_mitigation.radios.fira.session import UciSession, UciSettings
from uwb_mitigation.radios.port import PortAddress, PortThread
from uwb_mitigation.radios.settings import Role
from uwb_mitigation.types.measurement import RangeMeasurement
from uwb_mitigation.types.stamps import NS_PER_S

BAUD = 115_200
REOPEN_NS = 10 * NS_PER_S
"""Time without ranging after which the port is opened again."""

_TICK_S = 0.02
_READ_BYTES = 1 << 16


@dataclass(frozen=True, slots=True)
class UciStarted:
    """The board ranges."""

    settings: UciSettings
    window: tuple[int, int] | None


UciEvent = RangeMeasurement | UciStarted


@dataclass(frozen=True, slots=True)
class UciReport:
    """The state of a board, for diagnostics.

    Attributes:
        port: the device file in use; empty = no port is open.
        problem: reason why the board does not range; empty while it works.
        settings: active settings.
        window: taps and lead of the CIR that the board has confirmed; None = unknown.
        rejected: parameters that the board did not accept, {tag: status}.
        device_info: identity of the board, not decoded.
        clock_offset_ppm: median carrier frequency offset of the peers; NaN = unknown.
        counts: {name: count}.
    """

    port: str
    problem: str
    settings: UciSettings
    window: tuple[int, int] | None
    rejected: dict[int, int]
    device_info: bytes
    clock_offset_ppm: float
    counts: dict[str, int]


class UciDriver(PortThread[UciEvent]):
    """Operates one board until `close`; starts it again after a loss.

    Events are measurements and `UciStarted`. An anchor delivers its measurements only if its settings
    request it.

    Args:
        address: port of the board.
        settings: what the board does.
        stamp_clock: clock for stamps, ns.
        capture: stores the raw bytes; None = not stored.
        number: number of the board in the capture.
    """

    def __init__(
        self,
        address: PortAddress,
        settings: UciSettings,
        *,
        stamp_clock: Callable[[], int] = time.time_ns,
        capture: CaptureWriter | None = None,
        number: int = 0,
    ) -> None:
        super().__init__(f"UCI board at {address}", f"{address} has not been opened")
        self._address = address
        self._stamp_clock = stamp_clock
        self._capture = capture
        self._number = number
        self._session = UciSession(settings)
        self._port = ""
        self._thread.start()

    def set_settings(self, settings: UciSettings) -> None:
        """Start the board again with other settings.

        Raises:
            ParameterError: the settings are invalid.
        """
        settings.check()
        with self._lock:
            self._session.settings = settings
            if self._port:
                self._begin()

    @property
    def problem(self) -> str:
        """Reason why the board does not range; empty while it works."""
        with self._lock:
            return self._problem or self._session.state

    def report(self) -> UciReport:
        """Return the present state."""
        with self._lock:
            session = self._session
            return UciReport(
                self._port,
                self._problem or session.state,
                session.settings,
                session.window,
                session.rejected,
                session.device_info,
                statistics.median(session.clock_offsets_ppm or [math.nan]),
                session.totals() | {"openings": self.openings, "overflowed": self.overflowed},
            )

    def _connect(self) -> None:
        port = self._address.open(BAUD)
        with self._lock:
            self._port, self._problem = port.port, ""
            self.openings += 1
            self._begin()
        try:
            self._serve(port)
        except OSError as error:
            raise LinkError(f"was lost: {error.strerror}", where=str(self._address)) from error
        finally:
            stop = self._session.stop_commands()
            with contextlib.suppress(OSError):
                os.write(port.fileno(), stop)
            with self._lock:
                self._port = ""
                self._session.closed()
            port.close()

    def _begin(self) -> None:
        if self._capture is not None:
            self._capture.add_board(self._number, self._session.settings)
        self._session.opened(time.monotonic_ns())

    def _serve(self, port: serial.Serial) -> None:
        fd = port.fileno()
        outgoing = bytearray()
        starts, worked_ns = self._session.starts, time.monotonic_ns()
        while not self.closed:
            readable, _, _ = select.select([fd], [], [], _TICK_S)
            data = os.read(fd, _READ_BYTES) if readable else b""
            if readable and not data:
                raise LinkError("was unplugged", where=str(self._address))
            now_ns, stamp_ns = time.monotonic_ns(), self._stamp_clock()
            if self._capture is not None:
                self._capture.add(self._number, data, sent=False)
            with self._lock:
                session = self._session
                found = session.receive(data, now_ns, stamp_ns)
                events: list[UciEvent] = []
                if session.starts != starts:
                    starts, self._worked = session.starts, True
                    events.append(UciStarted(session.settings, session.window))
                if not session.state:
                    worked_ns = now_ns
                if session.settings.role is Role.TAG or session.settings.report:
                    events += found
                self._put(events)
                if not outgoing:
                    outgoing += session.outgoing()
            if now_ns - worked_ns > REOPEN_NS:
                raise LinkError(session.state, where=str(self._address))
            if outgoing:
                with contextlib.suppress(BlockingIOError):
                    written = os.write(fd, outgoing)
                    if self._capture is not None:
                        self._capture.add(self._number, bytes(outgoing[:written]), sent=True)
                    del outgoing[:written]
