"""Source `evb1000`: EVB1000 boards with factory firmware as bridges from USB to the SPI of their DW1000.

Decawave's own PC programs use the same protocol with EVK1000 and TREK1000 kits: each request is one chip-select
period. A request with its answer takes 1 to 2 ms; there is no interrupt and no reset line.
"""

from __future__ import annotations

import contextlib
import struct
import termios
import time
from collections.abc import Iterator
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

    Raises:
        LinkError: the port is absent or in use, or the board is in another mode; the message contains the remedy.
    """

    has_reset = False
    # Eight transactions of 1.5 to 1.8 ms and the delay of polling. On a slower bus the time is increased at run time.
    reply_us = 16_500
    timeout_us = 60_000

    def __init__(self, address: PortAddress) -> None:
        self._address = address
        self._fast = False
        self._port: serial.Serial | None = address.open()
        self._port.write_timeout = ANSWER_TIMEOUT_S
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
            if error is not None:
                self._discard_input()
            with self._open_port() as port:
                if port.timeout != timeout_s:
                    port.timeout = timeout_s
                port.reset_input_buffer()
                port.write(request)
                answer = port.read(size)
                answer += port.read(port.in_waiting)
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
                return bytes(answer[2:-1])
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
        with self._open_port() as port:
            port.timeout = ANSWER_TIMEOUT_S
            port.write(b"deca?")
            answer = port.read_until(b"\0")
        self._discard_input()
        return str(answer.partition(b"\0")[0], "ascii", "replace")

    def _discard_input(self) -> None:
        """Discard the rest of earlier answers."""
        with self._open_port() as port:
            port.timeout = QUIET_S
            until = time.monotonic() + ANSWER_TIMEOUT_S
            while time.monotonic() < until and port.read(1 << 13):
                pass

    @contextlib.contextmanager
    def _open_port(self) -> Iterator[serial.Serial]:
        """Yield the port; translate the errors of the block."""
        if self._port is None:
            raise self._lost("closed")
        try:
            yield self._port
        except serial.SerialTimeoutException as error:
            raise self._error("the board does not accept data") from error
        except (OSError, termios.error) as error:
            raise self._lost(getattr(error, "strerror", None) or str(error)) from error

    def _error(self, what: str, valid: str = _REMEDY) -> LinkError:
        return LinkError(what, where=self._address, valid=valid)

    def _lost(self, why: str) -> LinkError:
        return LinkError(f"was lost: {why}", where=self._address, valid="plug the board in")
