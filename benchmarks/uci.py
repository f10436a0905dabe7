"""UCI boards: rate of two emulated boards, wrong joins on a damaged stream, and recovery after reconnecting."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue

import numpy as np

from benchmarks.equipment.uci_board import EmulatedUciBoards, UciBoardModel, taps_of
from uwb_mitigation.errors import LinkError
from uwb_mitigation.radios import uci
from uwb_mitigation.radios.fira.session import UciSession, UciSettings
from uwb_mitigation.radios.port import PortAddress
from uwb_mitigation.radios.settings import Role
from uwb_mitigation.radios.uci import UciPortSettings
from uwb_mitigation.types.measurement import RangeMeasurement

_TIMEOUT_S = 10.0
_DISTANCE_OFFSET = 4 + 25 + 4
"""Position of the distance in the packet of a range with a short address."""

_SAME_TAPS = 0.5
"""Share of equal samples above which a CIR is that of an exchange; others have none in common but small numbers."""


@dataclass(frozen=True, slots=True)
class Joins:
    """Result of `joins`.

    Attributes:
        exchanges: number of exchanges.
        ranges: number of published ranges.
        with_cir: number of ranges with CIR.
        wrong: number of ranges with the CIR of another exchange.
        restarts: how often the damage looked like a restart of the board.
    """

    exchanges: int
    ranges: int
    with_cir: int
    wrong: int
    restarts: int


def joins(
    exchanges: int, taps: int, lose: float, damage: float, seed: int, on_progress: Callable[[float], None]
) -> Joins:
    """Feed a session with notifications of which some are lost and some bytes are replaced, in virtual time.

    Args:
        exchanges: number of exchanges.
        taps: size of the CIR.
        lose: share of lost notifications.
        damage: share of bytes that are replaced by random ones.
        seed: seed of losses and damage.
        on_progress: called with the completed fraction.
    """
    random = np.random.default_rng(seed)
    board, session = UciBoardModel(), UciSession(UciSettings(window=taps))
    now_ns, interval_ns = 0, session.settings.effective_interval_ms * 10**6
    session.opened(now_ns)
    while session.state:
        now_ns += 10**6
        session.receive(board.receive(session.outgoing(), now_ns / 1e9), now_ns, now_ns)
    (handle,) = board.sessions
    received_cm: dict[int, int] = {}
    ranges = with_cir = wrong = 0

    def damaged(packet: bytes) -> bytes:
        octets = np.frombuffer(packet, np.uint8).copy()
        hit = random.random(len(octets)) < damage
        octets[hit] = random.integers(0, 256, int(hit.sum()), dtype=np.uint8)
        return b"" if random.random() < lose else octets.tobytes()

    def check(measurements: list[RangeMeasurement]) -> None:
        nonlocal ranges, with_cir, wrong
        for measured in measurements:
            ranges += 1
            if not len(measured.cir):
                continue
            with_cir += 1
            # The exchange of the CIR has the same taps; the range must be the one that arrived for that exchange.
            number = measured.sequence
            samples = measured.cir.samples.reshape(-1, 2)
            expected = taps_of(number, taps, 5) >> int(np.log2(measured.cir.scale))
            length = min(len(samples), len(expected))
            same = np.mean(samples[:length] == expected[:length]) > _SAME_TAPS
            wrong += not same or round(100 * measured.range_m) != received_cm.get(number)

    for sequence in range(1, exchanges + 1):
        distance_m = 1.0 + sequence * 7919 % 60_000 / 100
        packet = damaged(board.range_packet(handle, sequence, distance_m))
        if packet:
            received_cm[sequence] = int.from_bytes(packet[_DISTANCE_OFFSET : _DISTANCE_OFFSET + 2], "little")
        received_cm.pop(sequence - 100, None)
        check(session.receive(packet, now_ns, now_ns))
        check(
            session.receive(
                damaged(board.diagnostics_packet(handle, sequence)), now_ns + 10**6, now_ns + 10**6
            )
        )
        now_ns += interval_ns
        # Damaged bytes may look like a restart of the board; the session then starts it again.
        sent = session.outgoing()
        while sent or session.state:
            check(session.receive(board.receive(sent, now_ns / 1e9), now_ns, now_ns))
            now_ns += 10**7
            sent = session.outgoing()
        handle = next(iter(board.sessions), handle)
        if sequence % 500 == 0:
            on_progress(sequence / exchanges)
    return Joins(exchanges, ranges, with_cir, wrong, session.counts["restarts"])


def rate_hz(taps: int, seconds: float) -> float:
    """Return the ranges with complete CIR per second of two emulated boards with the default interval."""
    with EmulatedUciBoards() as boards, _opened(boards.ports, taps) as tag:
        tag.wait()
        began, ranges = time.monotonic(), 0
        while (elapsed := time.monotonic() - began) < seconds:
            ranges += tag.has_range(0.1)
        return ranges / elapsed


def recoveries_s(unplugs: int) -> list[float]:
    """Return the times from plugging a board in to the next range."""
    durations_s = []
    with ExitStack() as stack:
        # A pseudo-terminal gets a new name when it is plugged in again: open it through a link.
        links = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "uci"
        boards = stack.enter_context(EmulatedUciBoards(links=links))
        tag = stack.enter_context(_opened((f"{links}0", f"{links}1"), 16))
        for number in range(unplugs):
            tag.wait()
            boards.unplug(number % 2)
            time.sleep(0.7)
            boards.plug(number % 2)
            began = time.monotonic()
            tag.events = SimpleQueue()
            tag.wait()
            durations_s.append(time.monotonic() - began)
    return durations_s


class _Tag:
    """The events of a tag."""

    def __init__(self, port: str, taps: int) -> None:
        self.events: SimpleQueue[object] = SimpleQueue()
        self._taps = taps
        settings = UciPortSettings(PortAddress.parse(port), UciSettings(window=taps))
        (self.port,) = uci.open([settings], lambda event: self.events.put(event))

    def wait(self) -> None:
        """Wait for a range with a complete CIR.

        Raises:
            LinkError: there is none within the timeout.
        """
        until = time.monotonic() + _TIMEOUT_S
        while not self.has_range(0.1):
            if time.monotonic() > until:
                raise LinkError(f"no range within {_TIMEOUT_S:g} s", where=self.port.problem)

    def has_range(self, timeout_s: float) -> bool:
        """Return whether the next event is a range with a complete CIR."""
        try:
            event = self.events.get(timeout=timeout_s)
        except Empty:
            return False
        return isinstance(event, RangeMeasurement) and len(event.cir) == self._taps


@contextmanager
def _opened(ports: Sequence[str], taps: int) -> Iterator[_Tag]:
    """Open a tag and its anchor."""
    settings = UciPortSettings(PortAddress.parse(ports[1]), UciSettings(Role.ANCHOR, 2, (1,), window=taps))
    (anchor,) = uci.open([settings], lambda event: None)
    with closing(anchor), closing((tag := _Tag(ports[0], taps)).port):
        yield tag
