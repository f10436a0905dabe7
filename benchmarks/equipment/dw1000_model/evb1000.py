"""Emulated EVB1000s in USB-to-SPI mode, each on a pseudo-terminal, in wall-clock time.

Linux and macOS only, because other systems have no pseudo-terminals.
"""

from __future__ import annotations

import heapq
import itertools
import math
import select
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.equipment.dw1000_model.air import ANTENNA_DELAY_TICKS, Air, Chip
from benchmarks.equipment.dw1000_model.pairs import Pair, pair_of
from benchmarks.equipment.dw1000_model.usb2spi import Bridge
from benchmarks.equipment.emulated_board import PseudoTerminal
from uwb_mitigation.errors import ParameterError, RecordingError, UwbMitigationError
from uwb_mitigation.types.source import Source

MAX_BOARDS = 33
ROUND_TRIP_S = 1.5e-3
"""Round-trip time of a request over full-speed USB."""

PPM = (3.0, -4.0, 7.0, -9.0, 1.0, 12.0, -2.0)
"""Frequency errors of the boards' crystals, in turn; they differ between any two boards that range."""

_MAX_WAIT_S = 0.02
DEFAULT_DISTANCE_M = 3.0


class _Board:
    """One board: chip, bridge and port."""

    def __init__(self, chip: Chip, bridge: Bridge, link: Path | None) -> None:
        self.chip = chip
        self.bridge = bridge
        self.terminal = PseudoTerminal(link)
        self.backlog = bytearray()
        self.requests = 0

    def plug(self) -> None:
        """Power the board and create its port."""
        if self.terminal.plug():
            self.bridge.reset()
            self.backlog.clear()

    def unplug(self) -> None:
        """Pull the cable: remove the port and power off the chip."""
        if self.terminal.unplug():
            self.chip.reset_drive(0)


class EmulatedEvb1000s:
    """EVB1000s on one air, from construction until `close`.

    Board 0 is at the position of the source's tag, the others are at those of its anchors, in order of appearance.
    Each new record of a pair replaces their radio channel. The methods may be called from any thread.

    Args:
        source: records for the pairs, played in a loop; None = undisturbed pairs at `distance_m`.
            Boards without an anchor in the source have the same pair.
        boards: number of boards, 2 to 33.
        rate_hz: records per second.
        round_trip_s: time from a request to its answer.
        ranging: boards whose switches are set for ranging instead of USB to SPI.
        port_links: prefix of symbolic links to the ports, followed by the board's number; None = no links.
        loss, damage: probabilities for every frame of every pair.
        seed: seed of all random numbers.
        antenna_delay: total TX + RX antenna delay of each chip, ticks.
        distance_m: distance between anchors, and between the tag and boards without an anchor in the source.

    Raises:
        ParameterError: an argument is outside its range, or a link would replace a file.
        RecordingError: the source contains no range that chips could measure.
        MissingDependencyError: no C compiler is installed.

    Attributes:
        failure: error that ended the playback; None if there was no error.
    """

    def __init__(
        self,
        source: Source | None = None,
        *,
        boards: int = 2,
        rate_hz: float = 20.0,
        round_trip_s: float = ROUND_TRIP_S,
        ranging: frozenset[int] = frozenset(),
        port_links: Path | None = None,
        loss: float = 0.0,
        damage: float = 0.0,
        seed: int = 1,
        antenna_delay: int = 2 * ANTENNA_DELAY_TICKS,
        distance_m: float = DEFAULT_DISTANCE_M,
    ) -> None:
        for name, value, low, high in (
            ("boards", boards, 2, MAX_BOARDS),
            ("antenna_delay", antenna_delay, 0, 2 * 0xFFFF),
            ("rate_hz", rate_hz, 0.1, 1000),
            ("round_trip_s", round_trip_s, 0, 1),
            ("loss", loss, 0, 1),
            ("damage", damage, 0, 1),
        ):
            if not low <= value <= high:
                raise ParameterError(f"{name} = {value}", valid=f"{low} to {high}")
        self.failure: UwbMitigationError | None = None
        self._loss, self._damage = loss, damage
        self._round_trip_s = round_trip_s
        self._period_s = 1 / rate_hz
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._answers: list[tuple[float, int, int, bytes]] = []
        self._counter = itertools.count()
        self._air = Air(seed)
        self._boards: list[_Board] = []
        try:
            for number in range(boards):
                chip = self._air.chip(
                    ppm=PPM[number % len(PPM)],
                    clock_ticks=number * 123_456_789_123,
                    tx_delay_ticks=antenna_delay // 2,
                    rx_delay_ticks=antenna_delay - antenna_delay // 2,
                )
                link = None
                if port_links is not None:
                    link = port_links.with_name(f"{port_links.name}{number}")
                self._boards.append(_Board(chip, Bridge(chip.spi, ranging=number in ranging), link))
            clean_pair = Pair(distance_m, loss=loss, damage=damage)
            for first, second in itertools.combinations(self._boards, 2):
                self._air.set_pair(first.chip, second.chip, clean_pair)
            self._distances_m = [distance_m] * boards
            # Read the source before the ports exist: the caller gets the error of an empty source.
            records = self._read_pairs(source)
            self._records: Iterator[tuple[int, Pair]] = itertools.chain(
                list(itertools.islice(records, boards - 1)), records
            )
            self._num_played = 0
            self._start_s = time.monotonic()
            for board in self._boards:
                board.plug()
        except BaseException:
            self._close()
            raise
        self._thread = threading.Thread(target=self._run, name="emulated EVB1000s", daemon=True)
        self._thread.start()

    @property
    def ports(self) -> tuple[str, ...]:
        """Ports of the boards for the host to open; empty if unplugged."""
        with self._lock:
            return tuple(board.terminal.port for board in self._boards)

    @property
    def distances_m(self) -> tuple[float, ...]:
        """Current distance between the tag and each board; undefined for the tag itself."""
        return tuple(self._distances_m)

    @property
    def requests(self) -> tuple[int, ...]:
        """Number of requests that each board has answered."""
        return tuple(board.requests for board in self._boards)

    def unplug(self, number: int) -> None:
        """Unplug a board."""
        with self._lock:
            self._boards[number].unplug()

    def plug(self, number: int) -> None:
        """Plug a board in again; its chip is reset."""
        with self._lock:
            board = self._boards[number]
            if board.terminal.fd is None:
                board.chip.reset_drive(1)
            board.plug()

    def close(self) -> None:
        """Unplug all boards and stop the thread; may be called twice."""
        self._stop.set()
        self._thread.join()
        self._close()

    def __enter__(self) -> EmulatedEvb1000s:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _close(self) -> None:
        for board in self._boards:
            board.unplug()
        self._air.close()

    def _read_pairs(self, source: Source | None) -> Iterator[tuple[int, Pair]]:
        """Yield the number of an anchor and its pair with the tag, in an endless loop."""
        numbers: dict[int, int] = {}
        while source is not None:
            usable = False
            for record in source:
                try:
                    pair = pair_of(record.measurement, record.truth, loss=self._loss, damage=self._damage)
                except ParameterError:
                    continue
                usable = True
                number = numbers.setdefault(record.measurement.anchor_id, 1 + len(numbers))
                if number < len(self._boards):
                    yield number, pair
            if not usable:
                raise RecordingError("no range with a CIR that chips could measure", where=source.name)

    def _update_pairs(self, now: float) -> None:
        """Play the records that are due."""
        due = 1 + int((now - self._start_s) / self._period_s)
        # After a pause, skip the records that no board has measured.
        self._num_played = max(self._num_played, due - len(self._boards))
        try:
            while self._num_played < due:
                self._num_played += 1
                for number, pair in itertools.islice(self._records, 1):
                    self._air.set_pair(self._boards[0].chip, self._boards[number].chip, pair)
                    self._distances_m[number] = pair.distance_m
        except UwbMitigationError as error:
            # The end of the recording is damaged.
            self.failure = error
            self._records = iter(())

    def _run(self) -> None:
        while not self._stop.is_set():
            with self._lock:
                fds = {
                    board.terminal.fd: number
                    for number, board in enumerate(self._boards)
                    if board.terminal.fd is not None
                }
                full = [fd for fd, number in fds.items() if self._boards[number].backlog]
                due = self._answers[0][0] if self._answers else math.inf
            timeout_s = min(max(due - time.monotonic(), 0.0), _MAX_WAIT_S)
            try:
                readable, writable, _ = select.select(list(fds), full, [], timeout_s)
            except (OSError, ValueError):
                continue
            with self._lock:
                now = time.monotonic()
                self._update_pairs(now)
                self._advance_air(now)
                for fd in {*readable, *writable}:
                    board = self._boards[fds[fd]]
                    # During the wait, the cable may have been unplugged and plugged in again.
                    if board.terminal.fd == fd:
                        self._serve(fds[fd], now)
                        board.terminal.write(board.backlog)
                self._send_due_answers(time.monotonic())

    def _advance_air(self, now: float) -> None:
        late = now - self._start_s - self._boards[0].chip.now()
        if late > 0:
            self._air.run(late)

    def _serve(self, number: int, now: float) -> None:
        board = self._boards[number]
        for answer in board.bridge.receive(board.terminal.read()):
            board.requests += 1
            # A long transaction at the slow speed takes longer than the bus.
            due = max(now + self._round_trip_s, self._start_s + board.chip.now())
            heapq.heappush(self._answers, (due, next(self._counter), number, answer))

    def _send_due_answers(self, now: float) -> None:
        while self._answers and self._answers[0][0] <= now:
            _, _, number, answer = heapq.heappop(self._answers)
            board = self._boards[number]
            if board.terminal.fd is not None:
                board.backlog += answer
                # Keep the bytes that the host does not accept yet.
                board.terminal.write(board.backlog)
