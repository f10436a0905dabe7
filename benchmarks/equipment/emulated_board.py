"""An emulated board: plays measurements over a pseudo-terminal, with optional transmission faults.

Linux and macOS only, because other systems have no pseudo-terminals.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import select
import threading
import time
import tty
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.equipment.board import Board, Corrector
from benchmarks.equipment.faults import Faults, damage
from uwb_mitigation.errors import ParameterError, RecordingError, UwbMitigationError
from uwb_mitigation.radios.wire.layout import Mode
from uwb_mitigation.radios.wire.messages import Hello
from uwb_mitigation.types.measurement import RangeMeasurement, Record

_READ_BYTES = 4096
_NO_FAULTS = Faults()
EMULATED = Hello(0xE0, firmware_minor=1, firmware_name="emulated")

MAX_BACKLOG_BYTES = 1 << 16
"""Size of the output queue. If the host does not read, further measurements are dropped and counted."""


class PseudoTerminal:
    """A port for a host, with a symbolic link to it. Not thread-safe.

    Args:
        link: path of the symbolic link, kept up to date; None = no link.

    Attributes:
        port: path of the port for the host to open; empty while unplugged.
        fd: the other end of the port, non-blocking; None while unplugged.

    Raises:
        ParameterError: `link` is the path of a file.
    """

    def __init__(self, link: Path | None) -> None:
        if link is not None and link.exists() and not link.is_symlink():
            raise ParameterError("the symbolic link to the port would replace a file", where=str(link))
        self.port = ""
        self.fd: int | None = None
        self._link = link
        self._open_device_fd = -1

    def plug(self) -> bool:
        """Create the port, usually with a new name; return False if it already exists.

        Raises:
            ParameterError: the link cannot be created.
        """
        if self.fd is not None:
            return False
        self.fd, self._open_device_fd = os.openpty()
        tty.setraw(self._open_device_fd)
        os.set_blocking(self.fd, False)
        self.port = os.ttyname(self._open_device_fd)
        if self._link is not None:
            try:
                self._link.unlink(missing_ok=True)
                self._link.symlink_to(self.port)
            except OSError as error:
                self.unplug()
                raise ParameterError(
                    f"cannot link to the port: {error.strerror}", where=str(self._link)
                ) from error
        return True

    def unplug(self) -> bool:
        """Remove the port, as if the cable were pulled; return False if there is no port."""
        if self.fd is None:
            return False
        for fd in (self.fd, self._open_device_fd):
            os.close(fd)
        self.fd, self.port = None, ""
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        return True

    def read(self) -> bytes:
        """Return what the host has sent."""
        # A pseudo-terminal reports EIO while its other end is closed.
        with contextlib.suppress(OSError):
            return b"" if self.fd is None else os.read(self.fd, _READ_BYTES)
        return b""

    def write(self, data: bytearray) -> None:
        """Write as much of `data` as the port accepts, and remove it from `data`."""
        with contextlib.suppress(OSError):
            if self.fd is not None:
                del data[: os.write(self.fd, data)]


class EmulatedBoard:
    """A board on a pseudo-terminal that plays `source` in a loop.

    Measurements keep their ids, sequence and device time; their stamps are replaced by the time of playback.
    The methods may be called from any thread.

    Args:
        source: measurements, played in a loop; None = no measurements.
        rate_hz: measurements per second.
        identity, corrector, mode: see `Board`.
        faults: transmission faults, applied to all data.
        link: path of a symbolic link to the port, kept up to date; None = no link.
        seed: of all random numbers.

    Raises:
        ParameterError: the rate is not finite and positive, or `link` is an existing file that is no symbolic link.
        RecordingError: the source contains no readable measurement.

    Attributes:
        failure: error that ended the playback; None if there was no error.
    """

    def __init__(
        self,
        source: Iterable[Record] | None = None,
        *,
        rate_hz: float = 50.0,
        identity: Hello = EMULATED,
        corrector: Corrector | None = None,
        mode: Mode = Mode.HOST,
        faults: Faults = _NO_FAULTS,
        link: Path | None = None,
        seed: int = 0,
    ) -> None:
        if not 0 < rate_hz <= 1e6:
            raise ParameterError(f"a rate of {rate_hz} Hz", valid="above 0, at most 1e6")
        self._terminal = PseudoTerminal(link)
        self.failure: UwbMitigationError | None = None
        self.sent_measurements = 0
        self._measuring = True
        self._source = source
        # Read the source before the port exists: the caller gets the error of an empty source.
        records = _repeat(source)
        first = [] if source is None else [next(records)]
        self._records: Iterator[RangeMeasurement] = itertools.chain(first, records)
        self._period_s = 1 / rate_hz
        self._identity = identity
        self._corrector = corrector
        self._mode = mode
        self._faults = faults
        self._random = np.random.default_rng(seed)
        self._boots = int(self._random.integers(1, 1 << 31))
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._backlog = bytearray()
        self.plug()
        self._thread = threading.Thread(target=self._run, name="emulated board", daemon=True)
        self._thread.start()

    @property
    def port(self) -> str:
        """Path of the port for the host to open; empty while unplugged."""
        return self._terminal.port

    def plug(self) -> None:
        """Plug the board in, usually with a new port name; it boots."""
        with self._lock:
            if self._terminal.plug():
                self.reset()

    def unplug(self) -> None:
        """Pull the cable: remove the port and power off the board."""
        with self._lock:
            self._terminal.unplug()

    def reset(self) -> None:
        """Restart the firmware; the port stays."""
        with self._lock:
            self._boots += 1
            self._booted_ns = time.monotonic_ns()
            self._board = self._create_board()
            # Unsent bytes of the firmware are lost, also those of a partly sent frame.
            self._backlog.clear()
            self._transmit(self._board.hello(0))

    def _create_board(self) -> Board:
        return Board(self._identity, self._corrector, mode=self._mode, boot_id=self._boots)

    def pause(self) -> None:
        """Stop measuring until `resume`; the link continues."""
        self._measuring = False

    def resume(self) -> None:
        """Measure again."""
        self._measuring = True

    def close(self) -> None:
        """Unplug the board and stop the thread; may be called twice."""
        self._stop.set()
        self._thread.join()
        self.unplug()

    def __enter__(self) -> EmulatedBoard:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stop.is_set():
            now = time.monotonic()
            with self._lock:
                plugged = self._terminal.fd is not None
                if plugged and self._measuring and now >= due:
                    self._measure()
            if now >= due:
                # After a pause the board does not send the missed measurements.
                due = max(due + self._period_s, now - 0.1)
            if plugged:
                self._exchange(min(max(due - time.monotonic(), 0.0), 0.02))
            else:
                self._stop.wait(0.01)

    def _measure(self) -> None:
        try:
            measurement = next(self._records, None)
            if measurement is None:
                return
            if len(self._backlog) > MAX_BACKLOG_BYTES:
                self._board.measurements_lost += 1
            else:
                self._transmit(self._board.measure(measurement, self._uptime_us()))
                self.sent_measurements += 1
        except UwbMitigationError as error:
            # The end of the recording is damaged, or a measurement does not fit into a frame.
            self.failure = error
            self._records = iter(())

    def _exchange(self, timeout_s: float) -> None:
        """Read from and write to the host, for at most `timeout_s`."""
        with self._lock:
            if (controller := self._terminal.fd) is None:
                return
            sending = bool(self._backlog)
        try:
            readable, writable, _ = select.select(
                [controller], [controller] if sending else [], [], timeout_s
            )
        except (OSError, ValueError):
            return
        with self._lock:
            # During the wait, the cable may have been unplugged and plugged in again.
            if self._terminal.fd != controller:
                return
            if readable:
                self._transmit(self._board.receive(self._terminal.read(), self._uptime_us()))
            self._transmit(self._board.tick(self._uptime_us()))
            if writable:
                self._terminal.write(self._backlog)

    def _transmit(self, data: bytes) -> None:
        if not data:
            return
        faults = self._faults
        chances = self._random.random(2)
        if chances[0] < faults.lose:
            return
        if chances[1] < faults.duplicate:
            data += data
        if faults != _NO_FAULTS:
            data = damage(data, faults, self._random).data
        self._backlog += data

    def _uptime_us(self) -> int:
        return (time.monotonic_ns() - self._booted_ns) // 1000


def _repeat(source: Iterable[Record] | None) -> Iterator[RangeMeasurement]:
    empty = True
    while source is not None:
        for record in source:
            empty = False
            yield record.measurement
        if empty:
            raise RecordingError("the source contains no measurements")
