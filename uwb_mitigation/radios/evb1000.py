"""Source `evb1000`: EVB1000 boards with factory firmware as bridges from USB to the SPI of their DW1000.

Decawave's own PC programs use the same protocol with EVK1000 and TREK1000 kits: each request is one chip-select
period. A request with its answer takes 1 to 2 ms; there is no interrupt and no reset line.
"""

from __future__ import annotations

import contextlib
import os
import select
import struct
import time
from functools import partial

import serial

from uwb_mitigation.errors import LinkError
from uwb_mitigation.radios.dw1000.port import open_chips, read_chips
from uwb_mitigation.radios.port import PortAddress

ANSWER_TIMEOUT_S = 0.4
REPEATED_TIMEOUT_S = 0.2
"""Timeout of a repeated request: a board that is gone is detected within a second."""

MAX_TRIES = 3
"""Number of tries: after stray octets from another program (ModemManager), the firmware ignores the first one."""

QUIET_S = 0.02
"""Time without input after which the rest of a damaged answer has been discarded."""

MAX_READ_BYTES = 4093

_START, _END = 0x02, 0x03
_WRITE, _FAST = 1, 2
_HEADER = struct.Struct("<BBHH")
_REMEDY = "DIP switch S1-3 off (TREK1000: S1-4 to S1-7 on), then power the board on again: the display shows USB to SPI"


read_settings = partial(read_chips, PortAddress.parse)
open = partial(open_chips, lambda chip: Evb1000Bus(PortAddress.parse(chip.port)))


class Evb1000Bus:
    """A board in USB-to-SPI mode; see `Bus`.

    Args:
        address: address of the serial port.

    Attributes:
        version: firmware version that the board reports.
        repeated: number of requests that were repeated after a damaged or missing answer.

    Raises:
        LinkError: the port is absent or in use, or the board is in another mode; the message contains the remedy.
    """

    has_reset = False
    # Eight transactions of 1.5 to 1.8 ms and the delay of polling. On a slower bus the time is increased at run time.
    reply_us = 16_500
    timeout_us = 60_000

    def __init__(self, address: PortAddress) -> None:
        self.repeated = 0
        self._address = address
        self._fast = False
        self._port: serial.Serial | None = address.open()
        try:
            self.version = self._read_version()
        except LinkError:
            self.close()
            raise
        self.name = f"{self.version} at {address}"

    def transfer(self, header: bytes, out: bytes | None, count: int) -> bytes:
        flags = (_WRITE if out is not None else 0) | (_FAST if self._fast else 0)
        payload = header + (out or b"")
        data = count if out is None else len(out)
        if data > MAX_READ_BYTES:
            raise self._error(f"{data} octets in one transaction", f"{MAX_READ_BYTES}")
        request = _HEADER.pack(_START, flags, _HEADER.size + len(payload) + 1, data) + payload + bytes([_END])
        size = 3 + (count if out is None else 0)
        error: LinkError | None = None
        for timeout_s in (ANSWER_TIMEOUT_S, *[REPEATED_TIMEOUT_S] * (MAX_TRIES - 1)):
            if error is None:
                self._read_some(0.0)
            else:
                self.repeated += 1
                self._discard_input()
            self._send(request)
            answer = self._receive(size, timeout_s)
            if len(answer) < size:
                error = self._error(f"received {len(answer)} of {size} octets within {timeout_s} s")
            elif len(answer) > size or answer[0] != _START or answer[1] or answer[-1] != _END:
                # A stray octet moves the answer: its content cannot be trusted.
                error = self._error(
                    f"the board answered {answer[:2].hex()}...{answer[-1:].hex()}", "0200...03"
                )
            else:
                if error is not None:
                    # The answer to the first request may be late.
                    self._discard_input()
                return answer[2:-1]
        assert error is not None
        raise error

    def speed(self, fast: bool) -> None:
        self._fast = fast

    def reset(self) -> None:
        """Do nothing: there is no reset line."""

    def pause(self) -> None:
        """Do nothing: the bus is slow enough."""

    def close(self) -> None:
        if self._port is not None:
            with contextlib.suppress(OSError):
                self._port.close()
            self._port = None

    def _read_version(self) -> str:
        text = ""
        for _ in range(MAX_TRIES):
            # A late answer to an earlier program or request may arrive first.
            text = self._query() or text
            if text.startswith(("y", "n")):
                break
        if text.startswith("y"):
            return text[1:]
        if text.startswith("n"):
            raise self._error("the board is in ranging mode")
        problem = f"the board answers {text!r} to deca?" if text else "the board does not answer deca?"
        raise self._error(problem, f"an EVB1000; {_REMEDY}")

    def _query(self) -> str:
        """Return the answer to `deca?` up to its first NUL; a stale octet follows the NUL."""
        self._discard_input()
        self._send(b"deca?")
        answer = b""
        until = time.monotonic() + ANSWER_TIMEOUT_S
        while b"\0" not in answer and time.monotonic() < until:
            answer += self._read_some(until - time.monotonic())
        self._discard_input()
        return answer.partition(b"\0")[0].decode("ascii", "replace")

    def _discard_input(self) -> None:
        """Discard the rest of earlier answers."""
        with contextlib.suppress(LinkError):
            until = time.monotonic() + ANSWER_TIMEOUT_S
            while time.monotonic() < until and self._read_some(QUIET_S):
                pass

    def _send(self, data: bytes) -> None:
        fd = self._fd()
        until = time.monotonic() + ANSWER_TIMEOUT_S
        try:
            while data:
                _, writable, _ = select.select([], [fd], [], max(0.0, until - time.monotonic()))
                if not writable:
                    raise self._error("the board does not accept data")
                data = data[os.write(fd, data) :]
        except OSError as error:
            raise self._lost(error.strerror or str(error)) from error

    def _receive(self, count: int, timeout_s: float) -> bytes:
        """Return an answer of `count` octets; fewer after the timeout, more if there are stray octets."""
        answer = b""
        until = time.monotonic() + timeout_s
        while len(answer) < count and (piece := self._read_some(until - time.monotonic())):
            answer += piece
        return answer

    def _read_some(self, within_s: float) -> bytes:
        """Read at least one octet; return no octets after a timeout."""
        fd = self._fd()
        try:
            readable, _, _ = select.select([fd], [], [], max(0.0, within_s))
            piece = os.read(fd, 1 << 13) if readable else b""
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._lost(error.strerror or str(error)) from error
        if readable and not piece:
            raise self._lost("unplugged")
        return piece

    def _fd(self) -> int:
        if self._port is None:
            raise self._lost("closed")
        return int(self._port.fileno())

    def _error(self, what: str, valid: str = _REMEDY) -> LinkError:
        return LinkError(what, where=str(self._address), valid=valid)

    def _lost(self, why: str) -> LinkError:
        return LinkError(f"was lost: {why}", where=str(self._address), valid="plug the board in")
