"""The interface that every source of measurements implements."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from typing import TypeVar

from uwb_mitigation.measurement import Record

Self = TypeVar("Self", bound="Source")


class Source(ABC):
    """Yields measurements in the order of their times; a consumer may stop at any point.

    A recording can be iterated again and then yields the same. What a source leaves out, repairs or
    finds odd is counted in `skipped` by kind while it iterates (each iteration starts the count
    anew), so that nothing is dropped silently. Iterating raises `RecordingError` when the input is
    not what the source reads, and `DamagedRecordingError` where readable input ends early, after
    everything before the damage has been yielded.

    Attributes:
        name: what a person sees: kind and place, and the word "simulated" where it is.
        simulated: True where no radio was involved; None = not known.
        skipped: oddities of the current or last iteration, {kind: count}.
    """

    name: str
    simulated: bool | None
    skipped: Counter[str]

    @abstractmethod
    def __iter__(self) -> Iterator[Record]: ...

    def close(self) -> None:
        """Release files and ports, where any are held; may be called twice, and from another thread than iterates."""
        return

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
