"""The EVB1000's side of its USB-to-SPI protocol, as in the factory firmware. No I/O, no clock.

A request is 0x02, flags (1: write, 2: fast SPI), its own length and the data's (16 bits each), the DW1000's SPI
header, the data to write, 0x03. The answer is 0x02, a status (0: good), the data read, 0x03.
"""

from __future__ import annotations

from collections.abc import Callable

START, END = 0x02, 0x03
WRITE, FAST = 1, 2
GOOD, BAD = 0, 1
FAST_HZ, SLOW_HZ = 18_000_000, 2_250_000
"""An STM32F105's SPI clock for the two speeds: 36 MHz divided by 2 and by 16."""

MAX_READ = 4093
BUFFER = 10_000

QUESTION = b"deca?"
VERSION = "EVB1000 USB2SPI 2.0"
STALE = b"\x5a"
"""Last octet of the answer to the question, after the NUL: the firmware sends one octet more than it has written."""

_PACKET = 64
_FIXED = 6
"""Octets before the SPI header."""


class Bridge:
    """Receives USB packets from the host and returns the answers.

    The firmware collects packets in a buffer until its length is the one that octets 2 and 3 contain. Stray octets
    therefore stay in the buffer until a packet that is a question on its own; that question clears the buffer, but
    only the next one is answered.

    Args:
        spi: one chip-select period: octets out, frequency in Hz; returns as many octets.
        ranging: the switches are set for ranging: the board answers the question with `n` and ignores the rest.
    """

    def __init__(self, spi: Callable[[bytes, int], bytes], *, ranging: bool = False) -> None:
        self._spi = spi
        self._ranging = ranging
        self._waiting = b""

    def reset(self) -> None:
        """Clear the buffer."""
        self._waiting = b""

    def receive(self, data: bytes) -> list[bytes]:
        """Return the answers to `data`, which arrives in packets of at most 64 octets."""
        packets = (data[start : start + _PACKET] for start in range(0, len(data), _PACKET))
        return [answer for packet in packets if (answer := self._receive(packet))]

    def _receive(self, packet: bytes) -> bytes:
        request = (self._waiting + packet)[:BUFFER]
        self._waiting = b""
        if request == QUESTION:
            return f"{'n' if self._ranging else 'y'}{VERSION}\0".encode() + STALE
        if packet == QUESTION:
            return b""
        if len(request) < 4 or int.from_bytes(request[2:4], "little") != len(request):
            self._waiting = request
            return b""
        return self._transfer(request) if request[0] == START and not self._ranging else b""

    def _transfer(self, request: bytes) -> bytes:
        count = int.from_bytes(request[4:6], "little")
        write = bool(request[1] & WRITE)
        out = request[_FIXED:-1]
        header = len(out) - (count if write else 0)
        read = 0 if write else count
        if request[-1] != END or read > MAX_READ or not 1 <= header <= 3:
            return bytes((START, BAD)) + bytes(read) + bytes((END,))
        answer = self._spi(out + bytes(read), FAST_HZ if request[1] & FAST else SLOW_HZ)
        return bytes((START, GOOD)) + (answer[header:] if read else b"") + bytes((END,))
