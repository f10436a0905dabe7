"""What joins the driver and a chip at this computer: one interface for USB and SPI."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Protocol

from uwb_mitigation.link.connection import PortAddress


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


def opener(source: str, place: str, reset: str = "") -> Callable[[], Bus]:
    """Return what opens the bus of one radio.

    Args:
        source: `evb1000` or `spi`.
        place: `/dev/ttyACM0`, `usb:0483:5740`; or `/dev/spidev0.0`.
        reset: of spi, the reset line, as `gpiochip0:25`; empty = not wired.

    Raises:
        ParameterError: `place` is not valid.
        MissingDependencyError: what this kind of bus needs is not installed.
    """
    # Each kind imports its own dependencies, and only when it is wanted.
    if source == "spi":
        from uwb_mitigation.radio.spidev_bus import SpidevBus

        return functools.partial(SpidevBus, place, reset)
    from uwb_mitigation.radio.evb1000 import Evb1000Bus

    return functools.partial(Evb1000Bus, PortAddress.parse(place))
