"""The calibration keys of a board that determine the window of the CIR, and their values before a change."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
from collections import Counter
from collections.abc import Generator, Iterable, Mapping
from pathlib import Path
from typing import IO

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.files import read_bounded, write_atomically
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.radios.fira import codes, messages
from uwb_mitigation.radios.fira.commands import Command
from uwb_mitigation.radios.fira.packets import Packet

TAPS, LEAD = "rx_diag_config.cir_n_taps", "rx_diag_config.cir_fp_tap_offset"
FORMAT, MAX_BYTES = 1, 1 << 16

Changes = dict[str, tuple[int, list[int]]]
"""{key: (original value, values that this driver wrote, or that the board made of them)}."""


class OriginalsFile:
    """Keeps the original values of changed keys on this computer until they are restored, also after a crash.

    `$XDG_STATE_HOME/uwb_mitigation/uci/BOARD-PORT.json` (default `~/.local/state`) has the keys `format` and `keys` (see
    `Changes`). BOARD and PORT are hashes of the device id and of the port, because several boards may have one id. At
    another port, a board is found if only one file has its id and a port that no process uses. A process that uses a port
    holds a lock on `PORT.lock`, which the kernel releases also if the process is killed.

    Args:
        port: name of the port.

    Attributes:
        problem: why the values cannot be stored; empty while they can.
    """

    def __init__(self, port: str) -> None:
        home = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
        self._folder, self._port, self._path = Path(home, "uwb_mitigation", "uci"), _digest(port), Path()
        self._lock: IO[str] | None = None
        self.problem = ""
        # From now on, no other port takes the values of this one.
        with contextlib.suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
            self._lock = (self._folder / f"{self._port}.lock").open("a")
            fcntl.flock(self._lock, fcntl.LOCK_SH)

    def load(self, board: str) -> Changes:
        """Return the values of a board, which later calls of `save` replace."""
        self._path = self._folder / f"{_digest(board)}-{self._port}.json"
        with contextlib.suppress(UwbMitigationError, OSError, ValueError, KeyError, TypeError):
            if board and not self._path.exists():
                (other,) = filter(_is_unused, self._folder.glob(f"{_digest(board)}-*.json"))
                other.replace(self._path)
            document = json.loads(read_bounded(self._path, MAX_BYTES, UwbMitigationError))
            if document["format"] == FORMAT:
                keys = document["keys"].items()
                return {str(key): (int(first), [*map(int, written)]) for key, (first, written) in keys}
        return {}

    def save(self, changes: Changes) -> None:
        """Store values; none: the original values are restored."""
        try:
            if changes:
                self._folder.mkdir(parents=True, exist_ok=True)
                write_atomically(self._path, json.dumps({"format": FORMAT, "keys": changes}))
            else:
                self._path.unlink(missing_ok=True)
            self.problem = ""
        except (OSError, UwbMitigationError) as error:
            self.problem = f"the original calibration of the board cannot be stored: {error}"

    def close(self) -> None:
        """Release the port: other ports may use the values that were not restored."""
        if self._lock is not None:
            self._lock.close()


def _is_unused(path: Path) -> bool:
    """Return whether no process uses the port of a file."""
    port = path.stem.partition("-")[2]
    try:
        with path.with_name(f"{port}.lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class Calibration:
    """The commands that change and restore the keys of a board.

    The keys may be in flash memory: one that could not be read is not written, one that already has the requested value is
    not written either, and a value that the board did not accept is not written again.

    Args:
        originals: stores the original values; None = they are only kept while the object exists.
        counts: `calibration_writes` is increased.
    """

    def __init__(self, originals: OriginalsFile | None, counts: Counter[str]) -> None:
        self._originals, self._counts = originals, counts
        self._board: str | None = None
        self._changes: Changes = {}
        self._results: dict[tuple[str, int], int | None] = {}
        self._count_sizes: tuple[int, ...] = (2, 1)

    def connected(self, board: str) -> None:
        """Use the values of a board by its device id, which may be empty."""
        if board != self._board:
            self._board, self._results = board, {}
            self._changes = self._originals.load(board) if self._originals is not None else {}

    def set_window(self, taps: int) -> Generator[Command, Packet | None, tuple[int, int] | None]:
        """Request a window; return the taps and the lead that the board has, None = unknown.

        A board that refuses keeps its own window: the CIR contains its size.
        """
        requested = {TAPS: taps, LEAD: WINDOW_LEAD}
        values = yield from self._read(requested)
        for size in self._count_sizes:
            different = {
                key: value
                for key, value in requested.items()
                if key in values and values[key] != value and self._results.get((key, value)) != values[key]
            }
            if not different:
                break
            for key, value in different.items():
                original, written = self._changes.get(key, (values[key], []))
                if values[key] not in written:
                    original, written = values[key], []
                self._changes[key] = original, [*written, value]
            self._save()
            before = values
            yield from self._write(different, size)
            values = yield from self._read(requested)
            for key in different:
                self._changes[key][1].append(values.get(key, before[key]))
            if any(values.get(key) != before[key] for key in different):
                self._count_sizes = (size,)
                break
        self._results |= {(key, value): values.get(key) for key, value in requested.items()}
        self._save()
        return (values[TAPS], values.get(LEAD, WINDOW_LEAD)) if TAPS in values else None

    def restore(self) -> Generator[Command, Packet | None, None]:
        """Write the original values of the keys that were changed, unless another program has changed them."""
        values = (yield from self._read(self._changes)) if self._changes else {}
        originals = {
            key: original
            for key, (original, written) in self._changes.items()
            if values.get(key, original) != original and values[key] in written
        }
        answered = yield from self._write(originals, self._count_sizes[0])
        if answered and values.keys() >= self._changes.keys():
            self._changes = {}
            self._save()

    def _save(self) -> None:
        if self._originals is not None:
            self._originals.save(self._changes)

    def _read(self, keys: Iterable[str]) -> Generator[Command, Packet | None, dict[str, int]]:
        answer = yield Command(codes.GET_CALIBRATION, messages.get_calibration(list(keys)), tries=2)
        return messages.calibration_values(answer.payload) if answer is not None else {}

    def _write(self, values: Mapping[str, int], count_size: int) -> Generator[Command, Packet | None, bool]:
        """Return whether the board has answered all commands."""
        answers = []
        for key, value in values.items():
            self._counts["calibration_writes"] += 1
            payload = messages.set_calibration(key, value, count_size)
            answers.append((yield Command(codes.SET_CALIBRATION, payload, tries=1)))
        return None not in answers
