"""Captures of the raw bytes of boards: text files that a user can attach to an issue, and replay.

The first line is `# uwb_mitigation KIND capture 1`. Lines `board N {JSON settings}` precede the bytes of a board; lines
`SECONDS N < HEX` and `SECONDS N > HEX` contain received and sent bytes. A capture contains no host or user name.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from uwb_mitigation.errors import DamagedRecordingError, ParameterError, RecordingError
from uwb_mitigation.files import os_errors
from uwb_mitigation.types.measurement import Record
from uwb_mitigation.types.source import Source
from uwb_mitigation.types.stamps import NS_PER_S

MAX_LINE = 1 << 18
_TAIL_NS = 2 * NS_PER_S


def first_line(kind: str) -> str:
    """Return the first line of a capture of a kind of boards, UCI or lines."""
    return f"# uwb_mitigation {kind} capture 1"


class CaptureWriter:
    """Writes the bytes of several boards to one file. Thread-safe.

    Args:
        path: replaced if it exists.
        kind: see `first_line`.
        boards: number of boards; the last of as many calls of `close` closes the file.
        limit_bytes: size after which nothing more is written.

    Raises:
        ParameterError: the file cannot be created.
    """

    def __init__(self, path: Path, kind: str = "UCI", boards: int = 1, limit_bytes: int = 1 << 30) -> None:
        with os_errors(ParameterError, "the capture cannot be written", path):
            self._file: IO[str] = path.open("w", encoding="ascii", buffering=1)
        self._free_bytes, self._users = limit_bytes, boards
        self._lock = threading.Lock()
        self._problem = ""
        self._began_ns = time.monotonic_ns()
        self._write(first_line(kind))

    def add_board(self, number: int, settings: Mapping[str, Any]) -> None:
        """Write the settings of a board whose port was opened; the bytes after it begin with its start."""
        self._write(f"board {number} {json.dumps(settings)}")

    def add(self, number: int, data: bytes, *, sent: bool) -> None:
        """Write bytes that were sent to a board or received from it."""
        if data:
            seconds = (time.monotonic_ns() - self._began_ns) / NS_PER_S
            self._write(f"{seconds:.6f} {number} {'>' if sent else '<'} {data.hex()}")

    def take_problem(self) -> str:
        """Return, once, why the file could not be written to its end; empty: it is complete until now."""
        problem, self._problem = self._problem, ""
        return problem

    def close(self) -> None:
        """Close the file for one board."""
        with self._lock:
            self._users -= 1
            if self._users <= 0:
                self._file.close()

    def _write(self, line: str) -> None:
        with self._lock:
            self._free_bytes -= len(line) + 1
            if self._free_bytes < 0 or self._file.closed:
                return
            try:
                self._file.write(line + "\n")
            except OSError as error:  # such as a full disk, which must not end the ranges
                self._problem = f"the capture has ended: {error.strerror}"
                with contextlib.suppress(OSError):
                    self._file.close()


class Session(ABC):
    """The host's side of a board on a stream of bytes, at a port or in a capture. No I/O.

    `now_ns` is monotonic, `stamp_ns` is the clock of the stamps. Send `outgoing` right after each call.
    """

    def __init__(self) -> None:
        self._outgoing = bytearray()

    @property
    def delivers(self) -> bool:
        """Whether the ranges of the board are published."""
        return True

    @abstractmethod
    def opened(self, now_ns: int) -> Any:
        """Start after the port was opened; discard partly received and unsent bytes."""

    def closed(self, now_ns: int) -> list[Any]:
        """End after the port was lost or closed; return events."""
        return []

    @abstractmethod
    def receive(self, data: bytes, now_ns: int, stamp_ns: int) -> list[Any]:
        """Handle received bytes and timeouts; return measurements and other events."""

    def outgoing(self) -> bytes:
        """Return the bytes to send, once."""
        data = bytes(self._outgoing)
        self._outgoing.clear()
        return data


class Capture(Source):
    """A capture as a recording; the sessions decode its bytes as they decode those of a board.

    Args:
        path: a file of `CaptureWriter`.
        kind: see `first_line`.
        open_session: returns the session of a board with these settings.

    Raises:
        RecordingError: the file cannot be read, or is not a capture of this kind.
    """

    simulated = None

    def __init__(self, path: Path, kind: str, open_session: Callable[[dict[str, Any]], Session]) -> None:
        self.name = f"{kind} capture {path}"
        self.skipped: Counter[str] = Counter()
        self._path, self._open_session = path, open_session
        with self._open() as file:
            if file.readline(len(first_line(kind)) + 2).rstrip("\r\n") != first_line(kind):
                valid = "a file of parameter capture"
                raise RecordingError(f"not a capture of source {kind.lower()}", where=path, valid=valid)

    def __iter__(self) -> Iterator[Record]:
        self.skipped.clear()
        boards: dict[int, Session] = {}
        now_ns = 0
        with self._open() as file:
            number = 0
            while line := file.readline(MAX_LINE):
                number += 1
                words = line.split(maxsplit=3)
                try:
                    if not words or words[0].startswith("#"):
                        continue
                    if words[0] == "board":
                        session = self._open_session(json.loads(line.split(maxsplit=2)[2]))
                        boards[int(words[1])] = session
                        session.opened(now_ns)
                        continue
                    seconds, board_text, direction, digits = words
                    now_ns, data = round(float(seconds) * NS_PER_S), bytes.fromhex(digits)
                    session = boards[int(board_text)]
                except (ValueError, KeyError, IndexError, TypeError, OverflowError, ParameterError) as error:
                    raise DamagedRecordingError(
                        "the capture is damaged", where=f"{self._path}, line {number}"
                    ) from error
                if direction == "<":
                    yield from _records(session, data, now_ns)
            for session in boards.values():
                yield from _records(session, b"", now_ns + _TAIL_NS)

    def _open(self) -> IO[str]:
        with os_errors(RecordingError, "cannot be read", self._path):
            return self._path.open(encoding="ascii", errors="replace")


def _records(session: Session, data: bytes, now_ns: int) -> Iterator[Record]:
    measurements = session.receive(data, now_ns, now_ns)
    # The commands of the replayed session repeat the captured ones.
    session.outgoing()
    if session.delivers:
        yield from map(Record, measurements)
