"""Source `spi`: a DW1000 on the SPI of a Linux computer, through spidev, with an optional reset line on a GPIO."""

from __future__ import annotations

import contextlib
import fcntl
import importlib
import os
import re
import struct
import time
from functools import partial
from typing import Any

from uwb_mitigation.errors import LinkError, ParameterError, not_installed
from uwb_mitigation.files import os_errors
from uwb_mitigation.radios.dw1000.port import open_chips, read_chips

SLOW_HZ, FAST_HZ = 2_000_000, 16_000_000
RESET_PULSE_S = 0.001

# linux/gpio.h: struct gpiohandle_request and its ioctl.
_LINES = 64
_REQUEST = struct.Struct(f"{_LINES}I I {_LINES}s 32s I i")
_GET_LINE = 3 << 30 | _REQUEST.size << 16 | 0xB4 << 8 | 0x03
_INPUT, _OUTPUT, _OPEN_DRAIN = 1 << 0, 1 << 1, 1 << 3


read_settings = partial(read_chips, str)
open = partial(open_chips, lambda chip: SpidevBus(chip.port, chip.reset))


class SpidevBus:
    """A chip at `/dev/spidevBUS.SELECT`; see `Bus`.

    Args:
        device: path of the device file.
        reset: `CHIP:LINE` of a GPIO, such as `gpiochip0:25`; empty = not wired.

    Raises:
        ParameterError: the device or the GPIO has another format.
        MissingDependencyError: spidev is not installed.
        LinkError: the device cannot be opened.
    """

    # A transaction takes 0.1 ms in Linux, occasionally much longer.
    reply_us = 3_000
    timeout_us = 15_000

    def __init__(self, device: str, reset: str = "") -> None:
        match = re.fullmatch(r"/dev/spidev(\d+)\.(\d+)", device)
        if match is None:
            raise ParameterError(f"the SPI device {device!r}", valid="/dev/spidevBUS.SELECT")
        line = re.fullmatch(r"(?:/dev/)?(gpiochip\d+):(\d+)", reset)
        if reset and line is None:
            raise ParameterError(f"the reset line {reset!r}", valid="gpiochipN:LINE, or empty")
        try:
            spidev = importlib.import_module("spidev")
        except ModuleNotFoundError:
            raise not_installed("spidev") from None
        self.name = device
        self._line = (f"/dev/{line[1]}", int(line[2])) if line is not None else None
        self.has_reset = line is not None
        self._line_fd: int | None = None
        self._spi: Any = spidev.SpiDev()
        try:
            self._spi.open(int(match[1]), int(match[2]))
            self._spi.mode = 0
            self.speed(False)
            self._float()
        except OSError as error:
            self.close()
            raise LinkError(
                f"cannot be opened: {error.strerror}", where=device, valid="enable SPI"
            ) from error

    def transfer(self, header: bytes, out: bytes | None, count: int) -> bytes:
        with os_errors(LinkError, "was lost", self.name, "check the wiring"):
            # One message is one chip-select period: at most 4096 octets, the accumulator and 30 more.
            answer = self._spi.xfer2(list(header + (bytes(count) if out is None else out)))
        return bytes(answer[len(header) :])

    def speed(self, fast: bool) -> None:
        self._spi.max_speed_hz = FAST_HZ if fast else SLOW_HZ

    def reset(self) -> None:
        if self._line is None:
            return
        self._release()
        low = self._request(_OUTPUT | _OPEN_DRAIN)
        time.sleep(RESET_PULSE_S)
        os.close(low)
        self._float()

    def pause(self) -> None:
        time.sleep(50e-6)

    def close(self) -> None:
        self._release()
        with contextlib.suppress(OSError):
            self._spi.close()

    def _float(self) -> None:
        # The chip pulls the line up itself: the host must not drive it high.
        if self._line is not None:
            self._line_fd = self._request(_INPUT)

    def _release(self) -> None:
        if self._line_fd is not None:
            os.close(self._line_fd)
            self._line_fd = None

    def _request(self, flags: int) -> int:
        assert self._line is not None
        path, line = self._line
        request = bytearray(
            _REQUEST.pack(line, *[0] * (_LINES - 1), flags, bytes(_LINES), b"uwb_mitigation", 1, -1)
        )
        with os_errors(LinkError, f"line {line}", path, "an unused GPIO"):
            chip = os.open(path, os.O_RDWR | os.O_CLOEXEC)
            try:
                fcntl.ioctl(chip, _GET_LINE, request)
            finally:
                os.close(chip)
        return int(_REQUEST.unpack(request)[-1])
