"""The EVB1000's side of its USB-to-SPI protocol, as the factory's firmware has it. No I/O, no clock.

A request is 0x02, flags (1: write, 2: fast SPI), its own length and the data's (16 bits each), the DW1000's SPI
header, the data where it writes, 0x03. The answer is 0x02, a status (0: good), the data that was read, 0x03.
"""

from __future__ import annotations

from collections.abc import Callable

START, END = 0x02, 0x03
WRITE, FAST = 1, 2
GOOD, BAD = 0, 1
FAST_HZ, SLOW_HZ = 18_000_000, 2_250_000
"""An STM32F105's SPI clock for the two speeds: 36 MHz divided by 2 and by 16."""

MAX_READ = 4093
MAX_REQUEST = 4096 + 16

QUESTION = b"deca?"
VERSION = "EVB1000 USB2SPI 1.0"

_FIXED = 6
"""Octets before the SPI header."""


class Bridge:
    """Takes what the host sends, in pieces of any size, and tells what to answer.

    Args:
        spi: one chip-select period: octets out, frequency in Hz; returns as many octets.
        ranging: the board's switches are set for ranging: it answers the question with `n`, and nothing else.
    """

    def __init__(self, spi: Callable[[bytes, int], bytes], *, ranging: bool = False) -> None:
        self._spi = spi
        self._ranging = ranging
        self._waiting = bytearray()

    def reset(self) -> None:
        """Forget an unfinished request."""
        self._waiting.clear()

    def receive(self, data: bytes) -> list[bytes]:
        """The answers to all requests that are complete now, in order."""
        self._waiting += data
        answers = []
        while self._waiting:
            taken, answer = self._take()
            if not taken:
                break
            del self._waiting[:taken]
            if answer:
                answers.append(answer)
        return answers

    def _take(self) -> tuple[int, bytes]:
        """How many octets are dealt with, 0 = more must come; and the answer."""
        data = self._waiting
        if data[0] == QUESTION[0]:
            heard = bytes(data[: len(QUESTION)])
            if heard == QUESTION:
                word = "n" if self._ranging else "y"
                return len(QUESTION), f"{word}{VERSION}\0".encode()
            return (0, b"") if QUESTION.startswith(heard) else (1, b"")
        if data[0] != START or self._ranging:
            return 1, b""
        if len(data) < _FIXED:
            return 0, b""
        total, count = int.from_bytes(data[2:4], "little"), int.from_bytes(data[4:6], "little")
        written = count if data[1] & WRITE else 0
        header = total - _FIXED - 1 - written
        if not 1 <= header <= 3 or total > MAX_REQUEST or (not written and count > MAX_READ):
            # No length to go by: what came is dropped, up to the next request.
            return len(data), bytes((START, BAD, END))
        if len(data) < total:
            return 0, b""
        if data[total - 1] != END:
            return total, bytes((START, BAD, END))
        out = bytes(data[_FIXED : total - 1])
        hz = FAST_HZ if data[1] & FAST else SLOW_HZ
        if data[1] & WRITE:
            self._spi(out, hz)
            return total, bytes((START, GOOD, END))
        read = self._spi(out + bytes(count), hz)[header:]
        return total, bytes((START, GOOD)) + read + bytes((END,))
