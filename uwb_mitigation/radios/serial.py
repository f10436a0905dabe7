"""The serial port of a board, kept open by a thread. `session` decodes the bytes."""

from __future__ import annotations

import contextlib
import math
import os
import select
import time
from collections.abc import Callable
from dataclasses import dataclass

import serial

from uwb_mitigation.errors import LinkError
from uwb_mitigation.radios.port import QUEUE_CAPACITY, PortAddress, PortThread, processes_using
from uwb_mitigation.radios.settings import RadioSettings
from uwb_mitigation.radios.wire.events import Event, LinkState
from uwb_mitigation.radios.wire.layout import Mode
from uwb_mitigation.radios.wire.messages import Hello
from uwb_mitigation.radios.wire.session import BoardSession
from uwb_mitigation.types.offsets import Offsets
from uwb_mitigation.types.stamps import NS_PER_S

REOPEN_TIMEOUT_NS = 10 * NS_PER_S
"""Timeout after which the port is reopened. After a suspend, an open port may never receive data again."""

_TICK_S = 0.05
_READ_BYTES = 1 << 16


@dataclass(frozen=True, slots=True)
class BoardReport:
    """The state of a port and its board, for diagnostics.

    Attributes:
        port: the device file in use; empty = no port is open.
        problem: reason why the board is not connected; empty while it is.
        hello: HELLO of the connected board.
        clock_offset_s: host's clock minus the board's uptime.
        clock_drift_ppm: drift of the host's clock relative to the board's.
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


class BoardDriver(PortThread[Event]):
    """Keeps a board connected until `close`; reconnects after unplugging, resets, timeouts and noise.

    Args:
        address: where the board is.
        baud: baud rate of a serial line; native USB ignores it.
        dtr: the level of DTR. Boards with native USB send only while it is set; on boards with a
            USB bridge, its change resets the board.
        mode, expected_model_id: see `BoardSession`.
        stamp_clock: the clock that stamps are on, ns; a node passes its own.
        capacity: see `PortThread`.
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
        capacity: int = QUEUE_CAPACITY,
    ) -> None:
        super().__init__(f"board at {address}", f"{address} is not there", capacity)
        self._address = address
        self._baud = baud
        self._dtr = dtr
        self._stamp_clock = stamp_clock
        self._session = BoardSession(mode=mode, expected_model_id=expected_model_id)
        self._port = self._others = ""
        self._thread.start()

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

    def report(self) -> BoardReport:
        """Return the present state."""
        with self._lock:
            session, clock = self._session, self._session.clock
            return BoardReport(
                port=self._port,
                problem=self.problem,
                hello=session.hello,
                clock_offset_s=clock.offset_ns / 1e9,
                clock_drift_ppm=clock.drift * 1e6,
                clock_uncertainty_us=clock.uncertainty_ns / 1e3 if clock.synchronised else math.nan,
                counts=session.totals() | {"overflowed": self.overflowed, "openings": self.openings},
            )

    @property
    def problem(self) -> str:
        """Reason why the board is not connected; empty while it is."""
        with self._lock:
            session = self._session
            if self._problem:
                return self._problem
            if session.state is LinkState.WRONG_VERSION:
                return f"{session.state.value}: {session.foreign_version}"
            if session.state is not LinkState.READY:
                others = f"; the port is also open in {self._others}" if self._others else ""
                return f"{session.state.value}{others}"
            return "" if session.model_matches else "the board has another model than the expected one"

    def _connect(self) -> None:
        port = self._address.open(self._baud, self._dtr)
        with contextlib.suppress(OSError, ValueError, NotImplementedError):
            # Without this flag USB bridges delay bytes by 16 ms. Other ports do not support it.
            port.set_low_latency_mode(True)
        others = ", ".join(processes_using(port.port))
        connections = self._session.counts.connections
        with self._lock:
            self._port, self._problem, self._others = port.port, "", others
            self.openings += 1
            self._put(self._session.opened(time.monotonic_ns()))
        try:
            self._serve(port)
        except OSError as error:
            raise LinkError(f"was lost: {error.strerror}", where=str(self._address)) from error
        finally:
            with self._lock:
                self._port = ""
                self._put(self._session.closed(time.monotonic_ns()))
            port.close()
            self._was_connected = self._session.counts.connections > connections

    def _serve(self, port: serial.Serial) -> None:
        fd = port.fileno()
        outgoing = bytearray()
        while not self.closed:
            readable, _, _ = select.select([fd], [], [], _TICK_S)
            data = os.read(fd, _READ_BYTES) if readable else b""
            if readable and not data:
                raise LinkError("was unplugged", where=str(self._address))
            now_ns, stamp_ns = time.monotonic_ns(), self._stamp_clock()
            with self._lock:
                self._put(self._session.receive(data, now_ns, stamp_ns))
                if self._session.idle_ns(now_ns) > REOPEN_TIMEOUT_NS:
                    raise LinkError("sends no data", where=str(self._address))
                # While the port accepts no bytes, requests wait in the bounded queue of the session.
                if not outgoing:
                    outgoing += self._session.outgoing()
            if outgoing:
                with contextlib.suppress(BlockingIOError):
                    del outgoing[: os.write(fd, outgoing)]
