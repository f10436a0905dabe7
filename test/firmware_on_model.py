"""Driver and exchange of the firmware on modelled chips, compiled natively, in virtual time."""

import random
import threading
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from benchmarks.equipment.dw1000_model.air import Host
from uwb_mitigation.radios.dw1000 import native as firmware
from uwb_mitigation.radios.dw1000.native import NativeRadio
from uwb_mitigation.radios.settings import RadioSettings
from uwb_mitigation.types.measurement import RangeMeasurement

REPLY_US = 3000

_program = threading.local()


def host() -> Host:
    """Return the host of the calling program."""
    running: Host = _program.host
    return running


CLOCK = SimpleNamespace(
    sleep=lambda seconds: host().delay(seconds),
    perf_counter=lambda: host().now(),
    monotonic_ns=lambda: int(host().now() * 1e9),
    time_ns=lambda: int(host().now() * 1e9),
)
"""Replacement for the module `time`."""


def begin(running: Host) -> None:
    """Set the host of the program in this thread."""
    _program.host = running


class ModelBus:
    """Connects the firmware to the chip of the program in which it runs; see `radio.bus.Bus`.

    Attributes:
        writes: every register write: (time in s, register file, sub-address, data).
    """

    name = "a modelled chip"
    reply_us = REPLY_US
    timeout_us = 15_000
    has_reset = True

    def __init__(self, host: Host) -> None:
        self._host = host
        self._hz = 2_000_000
        self.writes: list[tuple[float, int, int, bytes]] = []

    def transfer(self, header: bytes, out: bytes | None, count: int) -> bytes:
        if out is not None:
            low, high = (*header[1:], 0, 0)[:2]
            self.writes.append((self._host.now(), header[0] & 0x3F, low & 0x7F | high << 7, out))
        return self._host.spi(header + (bytes(count) if out is None else out), self._hz)[len(header) :]

    def speed(self, fast: bool) -> None:
        self._hz = 8_000_000 if fast else 2_000_000

    def reset(self) -> None:
        self._host.reset_pin()

    def pause(self) -> None:
        self._host.delay(200e-6)

    def close(self) -> None:
        pass


def use_virtual_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the firmware the time of its program, and the same random numbers in each run."""
    monkeypatch.setattr(firmware, "time", CLOCK)
    monkeypatch.setattr(firmware, "secrets", SimpleNamespace(randbits=random.Random(1).getrandbits))


def ranging(
    settings: RadioSettings,
    ranges: list[RangeMeasurement],
    seconds: float,
    *,
    bus: Callable[[Host], ModelBus] = ModelBus,
    at_end: Callable[[NativeRadio], None] = lambda _: None,
) -> Callable[[Host], None]:
    """Return a program that runs the exchange for `seconds` and collects the ranges."""

    def run(host: Host) -> None:
        begin(host)
        radio = NativeRadio(bus(host), settings, stamp_clock=CLOCK.time_ns)
        try:
            while host.now() < seconds:
                measured = radio.exchange(0.02)
                if measured is not None:
                    ranges.append(measured)
            at_end(radio)
        finally:
            radio.close()

    return run
