"""Measurements of a board on a serial port, live."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from types import TracebackType

from uwb_mitigation.link.port import BoardPort
from uwb_mitigation.measurement import RangeMeasurement
from uwb_mitigation.sources.source import Record

_PATIENCE_S = 1.0


class SerialSource:
    """The measurements that a board sends, until `close`; see `Source`.

    An iteration never ends by itself: a board that is gone is waited for. Whoever also wants the
    board's own corrections reads the events of the `BoardPort` instead.

    Args:
        name: what a person sees.
        port: read, and closed, by this source alone.
    """

    simulated = False

    def __init__(self, name: str, port: BoardPort) -> None:
        self.name = name
        self._port = port

    @property
    def skipped(self) -> Counter[str]:
        """What was lost or left out since the port was first opened, {kind: count}."""
        counts = self._port.report().counts
        received = ("frames", "connections", "openings")
        return Counter({kind: count for kind, count in counts.items() if count and kind not in received})

    def __iter__(self) -> Iterator[Record]:
        while not self._port.closed:
            event = self._port.get(_PATIENCE_S)
            if isinstance(event, RangeMeasurement):
                yield Record(event)

    def close(self) -> None:
        """Close the port; ends an iteration in another thread at once."""
        self._port.close()

    def __enter__(self) -> SerialSource:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
