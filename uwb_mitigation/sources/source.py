"""The interface that every source of measurements implements."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol

from uwb_mitigation.measurement import RangeMeasurement, Truth


@dataclass(frozen=True, slots=True)
class Record:
    """One measurement, with what a surveyed recording knows of the truth."""

    measurement: RangeMeasurement
    truth: Truth | None = None


class Source(Protocol):
    """Yields measurements in the order of their times; a consumer may stop at any point.

    A recording can be iterated again and then yields the same. What a source leaves out, repairs or
    finds odd is counted in `skipped` by kind while it iterates (each iteration starts the count
    anew), so that nothing is dropped silently. Iterating raises `RecordingError` when the input is
    not what the source reads, and `DamagedRecordingError` where readable input ends early, after
    everything before the damage has been yielded.

    Attributes:
        name: what a person sees: kind and place, and the word "simulated" where it is.
        simulated: True where no radio was involved.
        skipped: oddities of the current or last iteration, {kind: count}.
    """

    name: str
    simulated: bool
    skipped: Counter[str]

    def __iter__(self) -> Iterator[Record]: ...

    def close(self) -> None:
        """Release files and ports; may be called twice, and from another thread than iterates."""
        ...

    def __enter__(self) -> Source: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...
