"""A connection to hardware that a thread opens, serves, and reopens after a loss.

Used for boards on serial ports (`board_driver`) and radios of this computer (`radio.radio_driver`).
"""

from __future__ import annotations

import contextlib
import errno
import os
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

import serial
from serial.tools import list_ports

from uwb_mitigation.errors import LinkError, ParameterError, UwbMitigationError

MIN_RETRY_S = 0.1
MAX_RETRY_S = 0.4
"""Hardware that was plugged in again is found within a second; the search takes little time."""

QUEUE_CAPACITY = 1024
"""Default size of the event queue; if it is full, the oldest events are dropped."""

_Event = TypeVar("_Event")


class PortThread(ABC, Generic[_Event]):
    """Keeps hardware connected until `close`, and queues its events. Methods may be called from any thread.

    Hardware errors neither end the thread nor raise an exception; `problem` describes them.

    Args:
        name: of the thread.
        problem: value of `problem` before the first attempt.
        capacity: see `QUEUE_CAPACITY`.

    Attributes:
        openings: how often the hardware was opened.
        overflowed: number of events dropped because the queue was full.
    """

    def __init__(self, name: str, problem: str, capacity: int = QUEUE_CAPACITY) -> None:
        self.openings = 0
        self.overflowed = 0
        self._problem = problem
        self._was_connected = False
        self._capacity = capacity
        self._events: deque[_Event] = deque()
        # Guards the state of the connection; the condition signals new events.
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def get(self, timeout_s: float) -> _Event | None:
        """Return the next event; None after the timeout or if the connection is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._events or self.closed, timeout_s)
            return self._events.popleft() if self._events and not self.closed else None

    @property
    def problem(self) -> str:
        """Reason why the hardware does not work; empty if it works."""
        with self._lock:
            return self._problem

    @property
    def closed(self) -> bool:
        """True once `close` was called."""
        return self._stop.is_set()

    def close(self) -> None:
        """Stop the thread and close the hardware; may be called twice."""
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        self._thread.join()

    @abstractmethod
    def _connect(self) -> None:
        """Open the hardware and serve it until the connection is closed.

        Raises:
            UwbMitigationError: it cannot be opened, or was lost.
        """

    def _on_loss(self, text: str) -> None:
        """Handle a loss or a failed attempt; called with the lock held."""

    def _put(self, events: Iterable[_Event]) -> None:
        with self._changed:
            self._events.extend(events)
            while len(self._events) > self._capacity:
                self._events.popleft()
                self.overflowed += 1
            self._changed.notify_all()

    def _run(self) -> None:
        retry_s = MIN_RETRY_S
        while not self.closed:
            self._was_connected = False
            try:
                self._connect()
            except UwbMitigationError as error:
                with self._lock:
                    self._on_loss(str(error))
                    self._problem = str(error)
            if self._was_connected:
                retry_s = MIN_RETRY_S
            self._stop.wait(retry_s)
            retry_s = min(2 * retry_s, MAX_RETRY_S)


@dataclass(frozen=True, slots=True)
class PortAddress:
    """Address of a board: a device file, or the ids of a USB device.

    Attributes:
        device: path of the device file; empty = search by USB ids.
        vendor, product: USB ids.
        serial_number: of the USB device; empty = the first device with the ids.
    """

    device: str = ""
    vendor: int = 0
    product: int = 0
    serial_number: str = ""

    @classmethod
    def parse(cls, text: str) -> PortAddress:
        """Read `/dev/ttyACM0`, `usb:2341:805a` or `usb:2341:805a:SERIAL` (ids in hexadecimal).

        Raises:
            ParameterError: the text has another format.
        """
        if text.startswith("/"):
            return cls(device=text)
        kind, *parts = text.split(":", 3)
        try:
            if kind == "usb" and len(parts) in (2, 3):
                vendor, product = int(parts[0], 16), int(parts[1], 16)
                if 0 <= vendor <= 0xFFFF and 0 <= product <= 0xFFFF:
                    return cls("", vendor, product, parts[2] if len(parts) == 3 else "")
        except ValueError:
            pass
        raise ParameterError(
            f"the port {text!r}" if text else "no port is given",
            valid="port:=/dev/ttyACM0, or port:=usb:VENDOR:PRODUCT[:SERIAL]",
        )

    def __str__(self) -> str:
        if self.device:
            return self.device
        tail = f":{self.serial_number}" if self.serial_number else ""
        return f"usb:{self.vendor:04x}:{self.product:04x}{tail}"

    def find(self) -> str | None:
        """Return the path of the device file, or None if it does not exist."""
        if self.device:
            return self.device if os.path.exists(self.device) else None
        for port in list_ports.comports():
            if (port.vid, port.pid) == (self.vendor, self.product) and self.serial_number in (
                "",
                port.serial_number,
            ):
                return str(port.device)
        return None

    def open(self, baud: int = 9600, dtr: bool = True) -> serial.Serial:
        """Open the port exclusively, with non-blocking reads and writes.

        Raises:
            LinkError: it is absent, in use or forbidden; the message contains the remedy.
        """
        path = ""
        try:
            path = self.find() or ""
            if not path:
                raise LinkError("is not there", where=str(self), valid="plug the board in")
            port = serial.Serial(None, baud, timeout=0, exclusive=True)
            port.dtr = dtr
            port.port = path
            port.open()
        except (OSError, TypeError, ValueError) as error:
            # SerialException is an OSError; a ValueError is a baud rate that the port refuses; pyserial raises a
            # TypeError if a USB device is unplugged while it lists the ports.
            raise LinkError(f"cannot be opened: {_open_error(path, error)}", where=str(self)) from error
        os.set_blocking(port.fileno(), False)
        return port


def processes_using(path: str) -> list[str]:
    """Return the other programs that have a device file open, such as `minicom (process 123)`.

    Without root, only the programs of this user are visible.
    """
    device, found = os.path.realpath(path), []
    for process in os.listdir("/proc"):
        if not process.isdigit() or int(process) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            folder = f"/proc/{process}/fd"
            if any(os.readlink(f"{folder}/{fd}") == device for fd in os.listdir(folder)):
                with open(f"/proc/{process}/comm", encoding="utf-8") as name:
                    found.append(f"{name.read().strip()} (process {process})")
    return found


def _open_error(path: str, error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code in (errno.EAGAIN, errno.EBUSY):
        users = ", ".join(processes_using(path)) or "another program"
        return f"in use by {users} (close it; sudo fuser -v {path} lists the users)"
    remedy = " (sudo usermod -aG dialout $USER, then log in again)" if code == errno.EACCES else ""
    return f"{error}{remedy}"
