"""A simple DW1000 driver in Python, written from the user manual, for tests of the chip model."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.equipment.dw1000_model.air import ANTENNA_DELAY_TICKS, Air, Chip, Host
from benchmarks.equipment.dw1000_model.pairs import Pair

SLOW_HZ, FAST_HZ = 2_000_000, 16_000_000
WRAP = 1 << 40
TICK_S = 1 / (128 * 499.2e6)
TICK_M = 299_792_458 * TICK_S

TXSTRT, TXDLYS, WAIT4RESP, RXENAB = 2, 4, 0x80, 0x100
CPLOCK, RXPHE, RXFCG, RXRFTO = (1 << bit for bit in (1, 12, 14, 17))

_CODE = 9


@dataclass(frozen=True)
class Mode:
    """Radio settings: channel 5, PRF 64 MHz, 6.8 Mbit/s, 128 symbols."""

    long_frames: bool = False


class Driver:
    """Registers and the sequences for ranging, on any `Host`."""

    def __init__(self, host: Host) -> None:
        self.host = host
        self.hz = FAST_HZ

    def read(self, file: int, sub: int = 0, octets: int = 4) -> bytes:
        header = [0x40 | file, sub] if sub < 0x80 else [0x40 | file, 0x80 | (sub & 0x7F), sub >> 7]
        if sub == 0:
            header = [file]
        return self.host.spi(bytes(header) + bytes(octets), self.hz)[len(header) :]

    def get(self, file: int, sub: int = 0, octets: int = 4) -> int:
        return int.from_bytes(self.read(file, sub, octets), "little")

    def write(self, file: int, sub: int, data: bytes) -> None:
        header = [0xC0 | file, sub] if sub < 0x80 else [0xC0 | file, 0x80 | (sub & 0x7F), sub >> 7]
        if sub == 0:
            header = [0x80 | file]
        self.host.spi(bytes(header) + data, self.hz)

    def set(self, file: int, sub: int, value: int, octets: int = 4) -> None:
        self.write(file, sub, value.to_bytes(octets, "little"))

    @property
    def status(self) -> int:
        return self.get(0x0F, 0, 5)

    def command(self, bits: int) -> None:
        self.set(0x0D, 0, bits, 4)

    def start(self) -> None:
        """Reset and configure."""
        self.hz = SLOW_HZ
        self.host.reset_pin()
        self.host.delay(5e-3)
        assert self.get(0x00) == 0xDECA0130
        self.set(0x36, 0, 0x0301, 2)
        self.set(0x2D, 6, 0x8000, 2)
        self.host.delay(150e-6)
        self.set(0x36, 0, 0x0200, 2)
        self.host.delay(1e-3)
        self.hz = FAST_HZ
        self.configure(Mode())
        self.set(0x18, 0, ANTENNA_DELAY_TICKS, 2)
        self.set(0x2E, 0x1804, ANTENNA_DELAY_TICKS, 2)

    def configure(self, mode: Mode) -> None:
        self.set(0x1F, 0, 0x55 | 2 << 18 | _CODE << 22 | _CODE << 27)
        self.set(0x2B, 7, 0x0800041D)
        self.set(0x27, 8, 0x313B006B)  # acquisition chunks of 8 symbols
        self.set(0x27, 0x20, 129, 2)
        self.set(0x2E, 0x0806, 0x6D, 1)
        self.set(0x04, 0, 0x1200 | (3 if mode.long_frames else 0) << 16)
        self.fctrl = 2 << 13 | 0x8000 | 2 << 16 | 0x5 << 18

    def send(self, data: bytes) -> None:
        """Send immediately, without waiting for the end."""
        self.write(0x09, 0, data)
        self.set(0x08, 0, self.fctrl | (len(data) + 2), 4)
        self.command(TXSTRT)

    def listen(self) -> None:
        self.command(RXENAB)

    def reset_receiver(self) -> None:
        self.set(0x36, 3, 0xE0, 1)
        self.set(0x36, 3, 0xF0, 1)

    @property
    def tx_stamp(self) -> int:
        return self.get(0x17, 0, 5)

    @property
    def rx_stamp(self) -> int:
        return self.get(0x15, 0, 5)


def pair(air: Air, channel: Pair | None = None) -> tuple[Driver, Driver, Chip, Chip]:
    """Return the drivers of two started chips at a distance of 3 m, and the chips."""
    chips = air.chip(), air.chip()
    air.set_pair(*chips, channel or Pair(3.0))
    drivers = [Driver(chip) for chip in chips]
    for driver in drivers:
        driver.start()
    return (*drivers, *chips)


DATA = bytes.fromhex("4188") + b"\x07payload"


def exchange(sender: Driver, receiver: Driver) -> int:
    """Send a frame to the other chip; return the status of the receiver."""
    receiver.listen()
    receiver.host.delay(20e-6)
    sender.send(DATA)
    sender.host.delay(6e-3)
    return receiver.status


def flight_ticks(sender: Driver, receiver: Driver) -> float:
    """Return the signed difference of two stamps, modulo the counter."""
    return (receiver.rx_stamp - sender.tx_stamp + WRAP // 2) % WRAP - WRAP // 2
