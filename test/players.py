"""A source of bare records at given times, and a playback of it whose calls are noted."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from rclpy.clock import Clock, ClockType

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.measurement import Cir, RangeMeasurement, Record
from uwb_mitigation.nodes.playback import Playback, ReplayOptions

_NO_CIR = Cir(np.zeros(0, np.int16))


class ListSource:
    """Records at given times, numbered from 0; may end in damage."""

    name = "list"
    simulated = True

    def __init__(self, stamps_ns: Sequence[int], error: UwbMitigationError | None = None) -> None:
        self.stamps_ns = stamps_ns
        self.error = error
        self.skipped: Counter[str] = Counter()

    def __iter__(self) -> Iterator[Record]:
        for index, stamp_ns in enumerate(self.stamps_ns):
            yield Record(RangeMeasurement(stamp_ns, 1, 2, index, 0, 1.0, _NO_CIR))
        if self.error is not None:
            raise self.error

    def close(self) -> None:
        pass


class Player:
    """Plays a source; `on_record(player, sequence)` is called for each record, from the playing thread."""

    def __init__(
        self,
        source: ListSource,
        on_record: Callable[[Player, int], None] = lambda player, sequence: None,
        **options: object,
    ) -> None:
        self.clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.sequences: list[int] = []
        self.recorded: list[int] = []
        self.stamps: list[int] = []
        self.batches: list[int] = []
        self.clock_times: list[int] = []
        self.ends: list[UwbMitigationError | None] = []
        self.ended = threading.Event()
        self.on_record = on_record
        self.playback = Playback(
            source,
            self.clock,
            ReplayOptions(**({"longest_pause_s": 100.0} | options)),
            ready=lambda: True,
            publish=self.publish,
            on_time=self.tell_time,
            on_end=self.end,
        )

    def publish(self, records: Sequence[tuple[Record, int]]) -> None:
        self.batches.append(len(records))
        for record, stamp_ns in records:
            self.sequences.append(record.measurement.sequence)
            self.recorded.append(record.measurement.stamp_ns)
            self.stamps.append(stamp_ns)
            self.on_record(self, record.measurement.sequence)

    def tell_time(self, time_ns: int) -> None:
        self.clock_times.append(time_ns)

    def end(self, error: UwbMitigationError | None) -> None:
        self.ends.append(error)
        self.ended.set()

    def stop(self) -> None:
        """From the playing thread: play no further."""
        self.playback.stop()
        self.ended.set()

    def play(self) -> Player:
        self.playback.start()
        assert self.ended.wait(240)
        self.playback.stop()
        return self


def stop_after(count: int) -> Callable[[Player, int], None]:
    """Ends a player once so many records have come."""
    return lambda player, _: player.stop() if len(player.sequences) == count else None
