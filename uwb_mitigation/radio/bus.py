"""What joins the driver and a chip at this computer: one interface for USB and SPI."""

from __future__ import annotations

from typing import Protocol


class Bus(Protocol):
    """SPI to one DW1000. A method raises LinkError where the chip can no longer be reached, and within a second."""

    @property
    def name(self) -> str:
        """What a person calls it."""
        ...

    def transfer(self, header: bytes, out: bytes | None, count: int) -> bytes:
        """One chip-select period: `header`, then `out`, or `count` octets that are read and returned."""
        ...

    def speed(self, fast: bool) -> None:
        """At most 3 MHz, or if `fast` at most 20 MHz."""
        ...

    @property
    def reply_us(self) -> int:
        """That a tag on it needs from ANSWER to FINAL."""
        ...

    @property
    def patience_us(self) -> int:
        """That an anchor on it needs for its frames, at most."""
        ...

    @property
    def has_reset(self) -> bool:
        """Whether RSTn is wired."""
        ...

    def reset(self) -> None:
        """Pull RSTn low for a while, and let it float."""
        ...

    def pause(self) -> None:
        """Wait between two looks at the chip's status."""
        ...

    def close(self) -> None:
        """May be called twice."""
        ...
