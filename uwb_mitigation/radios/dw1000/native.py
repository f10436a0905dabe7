"""One DW1000 at this computer: the firmware's driver and exchange, compiled for the host, on a `Bus`."""

from __future__ import annotations

import ctypes
import functools
import secrets
import threading
import time
from collections.abc import Callable
from ctypes import CFUNCTYPE, POINTER, c_char_p, c_int, c_size_t, c_uint32, c_uint64, c_void_p
from typing import Any

from uwb_mitigation.errors import LinkError, ParameterError
from uwb_mitigation.mitigation.embedded import compiling
from uwb_mitigation.radios.dw1000.bus import Bus
from uwb_mitigation.radios.settings import RadioSettings, RadioStatus
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.radios.wire.layout import MAX_PAYLOAD_BYTES, MessageType
from uwb_mitigation.radios.wire.messages import RadioConfigured
from uwb_mitigation.types.measurement import RangeMeasurement

# Each start of a driver compiles them, and ranging spends little time in them.
_OPTIONS = ("-std=c99", "-O1", "-fPIC", *compiling.WARNINGS)
_RANGED, _FAULT = 1, 2

_loading = threading.Lock()

_FUNCTIONS: dict[str, Any] = {
    "transfer": CFUNCTYPE(c_int, c_void_p, c_void_p, c_size_t, c_void_p, c_void_p, c_size_t),
    "speed": CFUNCTYPE(None, c_void_p, c_int),
    "reset": CFUNCTYPE(None, c_void_p),
    "now_us": CFUNCTYPE(c_uint64, c_void_p),
    "wait": CFUNCTYPE(None, c_void_p, c_uint64),
    "sleep": CFUNCTYPE(None, c_void_p, c_uint32),
}


class Io(ctypes.Structure):
    """`uwb_dw1000_io`: functions of a bus; each gets the context first."""

    _fields_ = (("context", c_void_p), *_FUNCTIONS.items())


class NativeRadio:
    """A radio that performs one exchange per call, according to its settings. Not thread-safe.

    Args:
        bus: bus of the chip; the caller closes it.
        settings: settings of the radio.
        stamp_clock: clock for stamps, ns.

    Raises:
        ParameterError: the settings are invalid.
        MissingDependencyError: no C compiler is installed.
    """

    def __init__(
        self, bus: Bus, settings: RadioSettings, *, stamp_clock: Callable[[], int] = time.time_ns
    ) -> None:
        self._bus = bus
        self._library = load_native()
        self._stamp_clock = stamp_clock
        self._failure: BaseException | None = None
        self._payload = ctypes.create_string_buffer(MAX_PAYLOAD_BYTES)
        # The library keeps pointers to these objects until the radio is closed.
        catch = self._catch_exception
        self._io = Io(
            transfer=_FUNCTIONS["transfer"](self._transfer),
            speed=_FUNCTIONS["speed"](lambda _, fast: catch(lambda: self._bus.speed(bool(fast)))),
            now_us=_FUNCTIONS["now_us"](lambda _: time.monotonic_ns() // 1000),
            wait=_FUNCTIONS["wait"](lambda _, until_us: catch(lambda: self._bus.pause())),
            sleep=_FUNCTIONS["sleep"](lambda _, us: time.sleep(us * 1e-6)),
        )
        if bus.has_reset:
            self._io.reset = _FUNCTIONS["reset"](lambda _: catch(lambda: self._bus.reset()))
        self._radio = self._library.native_radio_new(
            ctypes.byref(self._io), *self._encoded(settings), secrets.randbits(64)
        )

    def exchange(self, timeout_s: float) -> RangeMeasurement | None:
        """Perform one exchange; return None after the timeout. An exchange may end after it.

        Raises:
            LinkError: the bus is lost, or no chip answers; the next call tries to start the chip again.
        """
        until_us = time.monotonic_ns() // 1000 + round(timeout_s * 1e6)
        event = self._call(self._library.native_radio_exchange, until_us)
        if event == _FAULT:
            text = self.status().problem or "the DW1000 was reset, or did not finish a command in time"
            raise LinkError(text, where=self._bus.name)
        return self._measurement() if event == _RANGED else None

    def use(self, bus: Bus) -> None:
        """Replace a lost bus by another one of the same type and restart the chip."""
        self._bus = bus

    def configure(self, settings: RadioSettings) -> None:
        """Use other settings, starting with the next exchange.

        Raises:
            ParameterError: the settings are invalid or not supported by this radio.
        """
        refusal = self._library.native_radio_configure(self._radio, *self._encoded(settings))
        if refusal is not None:
            raise ParameterError(f"radio settings: {refusal.decode()}")

    @property
    def address(self) -> int:
        """Address of the radio; 0 until the chip has started."""
        return int(self._library.native_radio_address(self._radio))

    @property
    def settings(self) -> RadioSettings:
        """Active settings; contains the chip's own values once it has started."""
        radio: RadioConfigured = self._decoded(MessageType.RADIO, self._library.native_radio_settings)
        return radio.settings

    def read_sensors(self) -> None:
        """Measure the chip's temperature and voltage, for `status`.

        Raises:
            LinkError: the bus is lost.
        """
        self._call(self._library.native_radio_sensors)

    def status(self) -> RadioStatus:
        """Return the status: state and counts."""
        status: RadioStatus = self._decoded(MessageType.RADIO_STATUS, self._library.native_radio_status)
        return status

    def close(self) -> None:
        """Free the radio; the bus stays open. May be called twice."""
        if self._radio is not None:
            self._library.native_radio_free(self._radio)
            self._radio = None

    def _encoded(self, settings: RadioSettings) -> tuple[bytes, int, int, int]:
        """Return a payload of SET_RADIO, its size, and the default times of a tag on this bus."""
        settings.check()
        _, payload = messages.encode(settings)
        return payload, len(payload), self._bus.reply_us, self._bus.timeout_us

    def _decoded(self, kind: MessageType, write: Callable[..., int]) -> Any:
        """Return the message whose payload a function writes."""
        count = write(self._radio, self._payload)
        return messages.decode(kind, self._payload.raw[:count])

    def _call(self, function: Callable[..., int], *arguments: Any) -> int:
        """Call a function that uses the bus; raise what a callback has raised."""
        self._failure = None
        result = function(self._radio, *arguments)
        if self._failure is not None:
            raise self._failure
        return result

    def _measurement(self) -> RangeMeasurement:
        count, measured_us = c_size_t(), c_uint64()
        data = self._library.native_radio_measurement(
            self._radio, ctypes.byref(count), ctypes.byref(measured_us)
        )
        age_ns = time.monotonic_ns() - 1000 * measured_us.value
        payload = ctypes.string_at(data, count.value)
        measured = messages.decode(MessageType.RANGE_CIR, payload, stamp_ns=self._stamp_clock() - age_ns)
        assert isinstance(measured, RangeMeasurement)
        return measured

    def _transfer(
        self, _: int, header: int, header_bytes: int, out: int | None, into: int, count: int
    ) -> int:
        def transfer() -> None:
            sent = ctypes.string_at(out, count) if out else None
            answer = self._bus.transfer(ctypes.string_at(header, header_bytes), sent, count)
            if sent is None:
                ctypes.memmove(into, answer, count)

        return self._catch_exception(transfer)

    def _catch_exception(self, act: Callable[[], None]) -> int:
        try:
            act()
        except BaseException as error:  # nothing may pass through C
            self._failure = error
            return -1
        return 0


def load_native() -> ctypes.CDLL:
    """Compile the firmware's driver and exchange, once per process, and load them as a shared library.

    Raises:
        MissingDependencyError: there is no C compiler, or the sources are not installed.
        UwbMitigationError: they do not compile.
    """
    with _loading:
        return _compiled()


@functools.cache
def _compiled() -> ctypes.CDLL:
    firmware = compiling.firmware_folder()
    folder = firmware / "src"
    shared = sorted([*folder.glob("uwb_dw1000*.c"), *folder.glob("uwb_twr*.c")])
    sources = (*shared, firmware / "native" / "native_radio.c")
    objects = compiling.compile_objects(compiling.c_compiler(), (*_OPTIONS, f"-I{folder}"), sources)
    radio, settings = c_void_p, (c_char_p, c_size_t, c_uint32, c_uint32)
    signatures: compiling.Signatures = {
        "new": (c_void_p, (POINTER(Io), *settings, c_uint64)),
        "free": (None, (radio,)),
        "configure": (c_char_p, (radio, *settings)),
        "exchange": (c_int, (radio, c_uint64)),
        "measurement": (c_void_p, (radio, POINTER(c_size_t), POINTER(c_uint64))),
        "address": (c_uint64, (radio,)),
        "settings": (c_size_t, (radio, c_void_p)),
        "status": (c_size_t, (radio, c_void_p)),
        "sensors": (c_int, (radio,)),
    }
    return compiling.load_library("native_radio_", objects, signatures)
