"""Interface between the driver and a chip at this computer, for USB and SPI."""

from __future__ import annotations

from typing import Protocol


class Bus(Protocol):
    """SPI to one DW1000. If the chip is unreachable, methods raise LinkError within a second.

    Attributes:
        name: name for users.
        reply_us: time that a tag on this bus needs from ANSWER to FINAL.
        timeout_us: timeout of a tag for the frames of an anchor on such a bus.
        has_reset: whether RSTn is wired.
    """

    name: str
    reply_us: int
    timeout_us: int
    has_reset: bool

    def transfer(self, header: bytes, out: bytes | None, count: int) -> bytes:
        """Transfer in one chip-select period: write `header`, then write `out` or read and return `count` octets."""

    def speed(self, fast: bool) -> None:
        """Set the SPI clock: at most 3 MHz, or at most 20 MHz if `fast`."""

    def reset(self) -> None:
        """Pull RSTn low for a short time, then let it float."""

    def pause(self) -> None:
        """Wait between two polls of the chip's status."""

    def close(self) -> None:
        """Close the bus; may be called twice."""
