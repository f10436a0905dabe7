"""The interface that every source of measurements implements."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from typing import TypeVar

from uwb_mitigation.types.measurement import Record

Self = TypeVar("Self", bound="Source")


class Source(ABC):
    """Yields measurements in the order of their times; a consumer may stop at any point.

    A recording can be iterated several times with the same result. An iteration counts skipped, repaired
    and suspicious data in `skipped` by kind (each iteration resets the counts), so that no data is dropped
    silently. Iterating raises `RecordingError` if the input has another format, and `DamagedRecordingError` if
    it is damaged or truncated, after yielding everything before the damage.

    Attributes:
        name: name for users: kind, path, and the word "simulated" if it is.
        simulated: whether the data is simulated; None = unknown.
        skipped: warnings of the current or last iteration, {kind: count}.
    """

    name: str
    simulated: bool | None
    skipped: Counter[str]

    @abstractmethod
    def __iter__(self) -> Iterator[Record]: ...

    def close(self) -> None:
        """Close files and ports, if any; may be called twice, and from a thread other than the iterating one."""
        return

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
