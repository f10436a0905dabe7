"""Modelled chips as EVB1000s in USB-to-SPI mode: each on a pseudo-terminal, in wall-clock time.

Linux and macOS only, as pseudo-terminals are.
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

from benchmarks.dw1000_model.air import ANTENNA_DELAY_TICKS, Air, Chip
from benchmarks.dw1000_model.links import Link, link_of
from benchmarks.dw1000_model.usb2spi import Bridge
from uwb_mitigation.errors import ParameterError, RecordingError, UwbMitigationError
from uwb_mitigation.link.emulated_board import PseudoTerminal
from uwb_mitigation.sources.source import Source

MAX_BOARDS = 33
ROUND_TRIP_S = 1.5e-3
"""Of a request and its answer over full-speed USB."""

PPM = (3.0, -4.0, 7.0, -9.0, 1.0, 12.0, -2.0)
"""By how much the boards' crystals are fast, in turn: no two that range agree."""

_LONGEST_WAIT_S = 0.02
CLEAN_M = 3.0


class _Board:
    """One board: its chip, its bridge, its port."""

    def __init__(self, chip: Chip, bridge: Bridge, link: Path | None) -> None:
        self.chip = chip
        self.bridge = bridge
        self.terminal = PseudoTerminal(link)
        self.backlog = bytearray()
        self.requests = 0

    def plug(self) -> None:
        """Give it power, and a port."""
        if self.terminal.plug():
            self.bridge.reset()
            self.backlog.clear()

    def unplug(self) -> None:
        """Pull the cable: the port is gone, and the chip without power."""
        if self.terminal.unplug():
            self.chip.reset_drive(0)


class EmulatedEvb1000s:
    """EVB1000s on one air, from the moment it is made until `close`.

    Board 0 stands where the source's tag does, and the others where its anchors are, in the order in which they
    appear: each record of a pair anew becomes their link. The methods may be called from any thread.

    Args:
        source: where links come from, played over and over; None = all boards `clean_m` apart, clean, as
            those are that the source knows no anchor for.
        boards: 2 to 33.
        rate_hz: records a second.
        round_trip_s: from a request to its answer.
        ranging: these boards' switches are set for ranging, not for USB to SPI.
        port_links: prefix of symbolic links to the ports, with the board's number behind it; None = none.
        loss, damage: probabilities, of every frame on every link.
        seed: of all chance.
        antenna_delay: of each chip, transmitter and receiver together, ticks.
        clean_m: between the tag and a board that the source knows no anchor for, and between anchors.

    Raises:
        ParameterError: an argument is out of its range, or a link would replace a file.
        RecordingError: the source holds no range that chips could measure.
        MissingDependencyError: there is no C compiler.

    Attributes:
        failure: why playing ended early; None while all is well.
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
        clean_m: float = CLEAN_M,
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
            clean = Link(clean_m, loss=loss, damage=damage)
            for one, other in itertools.combinations(self._boards, 2):
                self._air.link(one.chip, other.chip, clean)
            self._distances_m = [clean_m] * boards
            # Before there is a port: what holds nothing is told to who asks for boards.
            records = self._records(source)
            self._links: Iterator[tuple[int, Link]] = itertools.chain(
                list(itertools.islice(records, boards - 1)), records
            )
            self._relinked = 0
            self._began = time.monotonic()
            for board in self._boards:
                board.plug()
        except BaseException:
            self._close()
            raise
        self._thread = threading.Thread(target=self._run, name="emulated EVB1000s", daemon=True)
        self._thread.start()

    @property
    def ports(self) -> tuple[str, ...]:
        """The boards' ports, for the host to open; empty where unplugged."""
        with self._lock:
            return tuple(board.terminal.port for board in self._boards)

    @property
    def distances_m(self) -> tuple[float, ...]:
        """Between the tag and each board, at the moment; meaningless for the tag itself."""
        return tuple(self._distances_m)

    @property
    def requests(self) -> tuple[int, ...]:
        """How many requests each board has answered."""
        return tuple(board.requests for board in self._boards)

    def unplug(self, number: int) -> None:
        """Pull a board's cable."""
        with self._lock:
            self._boards[number].unplug()

    def plug(self, number: int) -> None:
        """Plug it in again: the chip starts anew."""
        with self._lock:
            board = self._boards[number]
            if board.terminal.fd is None:
                board.chip.reset_drive(1)
            board.plug()

    def close(self) -> None:
        """Unplug all, and end the thread; may be called twice."""
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

    def _records(self, source: Source | None) -> Iterator[tuple[int, Link]]:
        """Anchors' numbers and what joins them to the tag, without end."""
        numbers: dict[int, int] = {}
        while source is not None:
            usable = False
            for record in source:
                try:
                    link = link_of(record.measurement, record.truth, loss=self._loss, damage=self._damage)
                except ParameterError:
                    continue
                usable = True
                number = numbers.setdefault(record.measurement.anchor_id, 1 + len(numbers))
                if number < len(self._boards):
                    yield number, link
            if not usable:
                raise RecordingError("no range with a CIR that chips could measure", where=source.name)

    def _relink(self, now: float) -> None:
        """Play the records that are due."""
        due = 1 + int((now - self._began) / self._period_s)
        # After a pause there is no use in playing what nobody measured.
        self._relinked = max(self._relinked, due - len(self._boards))
        try:
            while self._relinked < due:
                self._relinked += 1
                for number, link in itertools.islice(self._links, 1):
                    self._air.link(self._boards[0].chip, self._boards[number].chip, link)
                    self._distances_m[number] = link.distance_m
        except UwbMitigationError as error:
            # A recording that ends in damage.
            self.failure = error
            self._links = iter(())

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
            patience_s = min(max(due - time.monotonic(), 0.0), _LONGEST_WAIT_S)
            try:
                readable, writable, _ = select.select(list(fds), full, [], patience_s)
            except (OSError, ValueError):
                continue
            with self._lock:
                now = time.monotonic()
                self._relink(now)
                self._keep_time(now)
                for fd in {*readable, *writable}:
                    board = self._boards[fds[fd]]
                    # While this waited, the cable may have been pulled, and plugged again.
                    if board.terminal.fd == fd:
                        self._serve(fds[fd], now)
                        board.terminal.write(board.backlog)
                self._answer(time.monotonic())

    def _keep_time(self, now: float) -> None:
        late = now - self._began - self._boards[0].chip.now()
        if late > 0:
            self._air.run(late)

    def _serve(self, number: int, now: float) -> None:
        board = self._boards[number]
        for answer in board.bridge.receive(board.terminal.read()):
            board.requests += 1
            # A long transaction at the slow speed takes longer than the bus.
            due = max(now + self._round_trip_s, self._began + board.chip.now())
            heapq.heappush(self._answers, (due, next(self._counter), number, answer))

    def _answer(self, now: float) -> None:
        while self._answers and self._answers[0][0] <= now:
            _, _, number, answer = heapq.heappop(self._answers)
            board = self._boards[number]
            if board.terminal.fd is not None:
                board.backlog += answer
                # The bus holds back what the host does not take yet.
                board.terminal.write(board.backlog)
