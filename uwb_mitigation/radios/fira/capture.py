"""Captures of the raw bytes of UCI boards: text files that a user can attach to an issue, and replay.

The first line is `# uwb_mitigation UCI capture 1`. Lines `board N {JSON settings}` precede the bytes of a board; lines
`SECONDS N < HEX` and `SECONDS N > HEX` contain received and sent bytes. A capture contains no host or user name.
"""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import IO

from uwb_mitigation.errors import DamagedRecordingError, ParameterError, RecordingError
from uwb_mitigation.radios.fira.session import UciSession, UciSettings
from uwb_mitigation.radios.settings import Role
from uwb_mitigation.types.measurement import Record
from uwb_mitigation.types.source import Source
from uwb_mitigation.types.stamps import NS_PER_S

FIRST_LINE = "# uwb_mitigation UCI capture 1"
MAX_LINE = 1 << 18
_TAIL_NS = 2 * NS_PER_S


class CaptureWriter:
    """Writes the bytes of several boards to one file. Thread-safe.

    Args:
        path: replaced if it exists.
        boards: number of boards; the last of as many calls of `close` closes the file.
        limit_bytes: size after which nothing more is written.

    Raises:
        ParameterError: the file cannot be written.
    """

    def __init__(self, path: Path, boards: int = 1, limit_bytes: int = 1 << 30) -> None:
        try:
            self._file: IO[str] = path.open("w", encoding="ascii")
        except OSError as error:
            raise ParameterError(
                f"the capture cannot be written: {error.strerror}", where=str(path)
            ) from error
        self._free_bytes, self._users = limit_bytes, boards
        self._lock = threading.Lock()
        self._began_ns = time.monotonic_ns()
        self._write(FIRST_LINE)

    def add_board(self, number: int, settings: UciSettings) -> None:
        """Write the settings of a board whose port was opened; the bytes after it begin with its start."""
        values = asdict(settings) | {"role": settings.role.name}
        self._write(f"board {number} {json.dumps(values)}")

    def add(self, number: int, data: bytes, *, sent: bool) -> None:
        """Write bytes that were sent to a board or received from it."""
        if data:
            seconds = (time.monotonic_ns() - self._began_ns) / NS_PER_S
            self._write(f"{seconds:.6f} {number} {'>' if sent else '<'} {data.hex()}")

    def close(self) -> None:
        """Close the file for one board."""
        with self._lock:
            self._users -= 1
            if self._users <= 0:
                self._file.close()

    def _write(self, line: str) -> None:
        with self._lock:
            self._free_bytes -= len(line) + 1
            if self._free_bytes >= 0 and not self._file.closed:
                self._file.write(line + "\n")
                self._file.flush()


class UciCapture(Source):
    """A capture as a recording; the sessions decode its bytes as they decode those of a board.

    Args:
        path: a file of `CaptureWriter`.

    Raises:
        RecordingError: the file cannot be read, or is not a capture.
    """

    simulated = None

    def __init__(self, path: Path) -> None:
        self.name = f"UCI capture {path}"
        self.skipped: Counter[str] = Counter()
        self._path = path
        with self._open() as file:
            if file.readline(len(FIRST_LINE) + 2).rstrip("\r\n") != FIRST_LINE:
                raise RecordingError(
                    "not a UCI capture", where=str(path), valid="a file of parameter capture"
                )

    def __iter__(self) -> Iterator[Record]:
        self.skipped.clear()
        boards: dict[int, UciSession] = {}
        reported: set[int] = set()
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
                        settings = _settings(line.split(maxsplit=2)[2])
                        board, session = int(words[1]), UciSession(settings)
                        boards[board] = session
                        session.opened(now_ns)
                        (reported.add if settings.delivers else reported.discard)(board)
                        continue
                    seconds, board_text, direction, digits = words
                    now_ns, board, data = (
                        round(float(seconds) * NS_PER_S),
                        int(board_text),
                        bytes.fromhex(digits),
                    )
                    session = boards[board]
                except (ValueError, KeyError, IndexError, TypeError, OverflowError, ParameterError) as error:
                    raise DamagedRecordingError(
                        "the capture is damaged", where=f"{self._path}, line {number}"
                    ) from error
                if direction == "<":
                    yield from self._records(session, data, now_ns, board in reported)
            for board, session in boards.items():
                yield from self._records(session, b"", now_ns + _TAIL_NS, board in reported)

    def _records(self, session: UciSession, data: bytes, now_ns: int, reported: bool) -> Iterator[Record]:
        measurements = session.receive(data, now_ns, now_ns)
        # The commands of the replayed session repeat the captured ones.
        session.outgoing()
        if reported:
            yield from (Record(measurement) for measurement in measurements)

    def _open(self) -> IO[str]:
        try:
            return self._path.open(encoding="ascii", errors="replace")
        except OSError as error:
            raise RecordingError(f"cannot be read: {error.strerror}", where=str(self._path)) from error


def _settings(text: str) -> UciSettings:
    values = json.loads(text)
    values |= {"role": Role[values["role"]], "peers": tuple(map(int, values["peers"]))}
    values.pop("identify", None)  # of earlier versions
    settings = UciSettings(**values)
    settings.check()
    return settings
