"""Which bus a person's words for a radio at this computer mean."""

from __future__ import annotations

import functools
from collections.abc import Callable

from uwb_mitigation.link.connection import PortAddress
from uwb_mitigation.radio.bus import Bus


def opener(source: str, place: str, reset: str = "") -> Callable[[], Bus]:
    """What opens the bus of one radio.

    Args:
        source: `evb1000` or `spi`.
        place: `/dev/ttyACM0`, `usb:0483:5740`; or `/dev/spidev0.0`.
        reset: of spi, the reset line, as `gpiochip0:25`; empty = not wired.

    Raises:
        ParameterError: `place` is none.
        MissingDependencyError: what this kind of bus needs is not installed.
    """
    # Each kind imports its own dependencies, and only when it is wanted.
    if source == "spi":
        from uwb_mitigation.radio.spidev_bus import SpidevBus

        return functools.partial(SpidevBus, place, reset)
    from uwb_mitigation.radio.evb1000 import Evb1000Bus

    return functools.partial(Evb1000Bus, PortAddress.parse(place))
