"""The PyPI package `dw1000-spi` on modelled chips: replacements for `spidev` and the clock."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import pytest
from firmware_on_model import CLOCK, begin, host

from benchmarks.equipment.dw1000_model.air import ANTENNA_DELAY_TICKS, Host

pytest.importorskip("spidev", reason="spidev is for Linux")

dw1000 = pytest.importorskip("dw1000_spi.dw1000", reason="the develop requirements bring dw1000-spi")

SYSTEM_CALL_S = 60e-6
"""Approximate duration of a transaction with Python on a Raspberry Pi."""


class FakeSpiDev:
    """Replacement for `spidev.SpiDev`; the program that opens it determines the chip."""

    max_speed_hz = 0
    mode = 0

    def open(self, _bus: int, _select: int) -> None:
        self._host = host()

    def xfer2(self, data: list[int]) -> list[int]:
        self._host.delay(SYSTEM_CALL_S)
        return list(self._host.spi(bytes(data), self.max_speed_hz))

    def close(self) -> None:
        pass


def replace_spidev(monkeypatch: pytest.MonkeyPatch) -> None:
    """Connect the driver to the model."""
    module = ModuleType("spidev")
    module.SpiDev = FakeSpiDev  # type: ignore[attr-defined]
    monkeypatch.setattr(dw1000, "spidev", module)
    monkeypatch.setattr(dw1000, "time", CLOCK)


def program(
    run: Callable[[dw1000.DW1000, Host], None], channel: int = 5, prf: int = 64
) -> Callable[[Host], None]:
    """Return a program that opens the driver and passes it to `run`."""

    def started(running: Host) -> None:
        begin(running)
        with dw1000.DW1000(0, 0, channel, prf, 6.8, 128, 9 if prf == 64 else 3, False) as driver:
            driver.write_register([0x98], list(ANTENNA_DELAY_TICKS.to_bytes(2, "little")))
            driver.write_register([0xEE, 0x84, 0x30], list(ANTENNA_DELAY_TICKS.to_bytes(2, "little")))
            run(driver, running)

    return started
