"""One DW1000 at this computer: the firmware's driver and exchange, compiled for the host, on a `Bus`."""

from __future__ import annotations

import ctypes
import functools
import secrets
import threading
import time
from collections.abc import Callable
from ctypes import POINTER, c_char_p, c_float, c_int, c_size_t, c_uint32, c_uint64, c_void_p
from dataclasses import replace
from typing import Any

from uwb_mitigation.errors import LinkError, ParameterError
from uwb_mitigation.mitigation.embedded.compiling import (
    WARNINGS,
    Signatures,
    c_compiler,
    compile_objects,
    firmware_folder,
    load_library,
)
from uwb_mitigation.radios.dw1000 import structures
from uwb_mitigation.radios.dw1000.bus import Bus
from uwb_mitigation.radios.settings import (
    AGE_UNKNOWN_MS,
    STATE_PROBLEMS,
    AnchorStatus,
    RadioSettings,
    RadioState,
    RadioStatus,
)
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.radios.wire.layout import MessageType
from uwb_mitigation.types.measurement import RangeMeasurement

_OPTIONS = ("-std=c99", "-O2", "-fPIC", *WARNINGS)
_RANGED, _FAULT = 1, 2

_loading = threading.Lock()


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
        config = self._config(settings)
        self._stamp_clock = stamp_clock
        self._settings = settings
        self._failure: BaseException | None = None
        # The library keeps pointers to these objects until the radio is closed.
        self._io = structures.Io(
            None,
            structures.TRANSFER(self._transfer),
            structures.SPEED(lambda _, fast: self._catch_exception(lambda: self._bus.speed(bool(fast)))),
            structures.RESET(lambda _: self._catch_exception(lambda: self._bus.reset()))
            if bus.has_reset
            else structures.RESET(),
            structures.NOW(lambda _: time.monotonic_ns() // 1000),
            structures.WAIT(lambda _, until_us: self._catch_exception(lambda: self._bus.pause())),
            structures.SLEEP(lambda _, us: time.sleep(us * 1e-6)),
        )
        self._radio = self._library.native_radio_new(
            ctypes.byref(self._io), ctypes.byref(config), secrets.randbits(64)
        )
        self._temperature_c = self._voltage = float("nan")

    def exchange(self, timeout_s: float) -> RangeMeasurement | None:
        """Perform one exchange; return None after the timeout. An exchange may end after it.

        Raises:
            LinkError: the bus is lost, or no chip answers; the next call tries to start the chip again.
        """
        until_us = time.monotonic_ns() // 1000 + round(timeout_s * 1e6)
        event = self._call(self._library.native_radio_exchange, until_us)
        if event == _FAULT:
            text = STATE_PROBLEMS.get(
                self._state(), "the DW1000 was reset, or did not finish a command in time"
            )
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
        refusal = self._library.native_radio_configure(self._radio, ctypes.byref(self._config(settings)))
        if refusal is not None:
            raise ParameterError(f"radio settings: {refusal.decode()}")
        self._settings = settings

    @property
    def address(self) -> int:
        """Address of the radio; 0 until the chip has started."""
        address: int = self._library.native_radio_address(self._radio)
        return address

    @property
    def settings(self) -> RadioSettings:
        """Active settings; contains the chip's own values once it has started."""
        chip: structures.ChipSettings = self._library.native_radio_settings(self._radio)[0]
        return replace(
            self._settings,
            address=self.address or self._settings.address,
            preamble_code=chip.preamble_code,
            tx_power=chip.tx_power,
            antenna_delay=chip.antenna_delay,
            reply_us=self._times_us[0],
            timeout_us=self._times_us[1],
        )

    def read_sensors(self) -> None:
        """Measure the chip's temperature and voltage, for `status`.

        Raises:
            LinkError: the bus is lost.
        """
        temperature, voltage = c_float(), c_float()
        sensors = self._library.native_radio_sensors
        if not self._call(sensors, ctypes.byref(temperature), ctypes.byref(voltage)):
            self._temperature_c, self._voltage = temperature.value, voltage.value

    def status(self) -> RadioStatus:
        """Return the status: state and counts."""
        counts: structures.TwrCounts = self._library.native_radio_counts(self._radio)[0]
        count = c_size_t()
        table = self._library.native_radio_anchors(self._radio, ctypes.byref(count))
        now_us = time.monotonic_ns() // 1000
        return RadioStatus(
            **counts.as_dict(),
            temperature_c=self._temperature_c,
            voltage=self._voltage,
            state=self._state(),
            anchors=tuple(
                AnchorStatus(
                    anchor.address,
                    anchor.tried,
                    anchor.ranged,
                    anchor.rx_power_dbm,
                    min((now_us - anchor.last_seen_us) // 1000, AGE_UNKNOWN_MS - 1)
                    if anchor.last_seen_us
                    else AGE_UNKNOWN_MS,
                )
                for anchor in table[: count.value]
            ),
        )

    def close(self) -> None:
        """Free the radio; the bus stays open. May be called twice."""
        if self._radio is not None:
            self._library.native_radio_free(self._radio)
            self._radio = None

    def _config(self, settings: RadioSettings) -> structures.Config:
        config = structures.config(settings, 0, 0)
        self._library.uwb_twr_set_default_times(
            ctypes.byref(config), self._bus.reply_us, self._bus.timeout_us
        )
        self._times_us = config.reply_us, config.timeout_us
        return config

    def _call(self, function: Callable[..., int], *arguments: Any) -> int:
        """Call a function that uses the bus; raise what a callback has raised."""
        self._failure = None
        result = function(self._radio, *arguments)
        if self._failure is not None:
            raise self._failure
        return result

    def _state(self) -> RadioState:
        return RadioState(self._library.native_radio_state(self._radio))

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
    firmware = firmware_folder()
    sources = tuple(
        sorted([*(firmware / "src").glob("uwb_dw1000*.c"), *(firmware / "src").glob("uwb_twr*.c")])
    )
    options = (*_OPTIONS, f"-I{firmware / 'src'}")
    objects = compile_objects(c_compiler(), options, (*sources, firmware / "native" / "native_radio.c"))
    radio = c_void_p
    signatures: Signatures = {
        "new": (c_void_p, (POINTER(structures.Io), POINTER(structures.Config), c_uint64)),
        "free": (None, (radio,)),
        "configure": (c_char_p, (radio, POINTER(structures.Config))),
        "exchange": (c_int, (radio, c_uint64)),
        "measurement": (c_void_p, (radio, POINTER(c_size_t), POINTER(c_uint64))),
        "state": (c_int, (radio,)),
        "address": (c_uint64, (radio,)),
        "settings": (POINTER(structures.ChipSettings), (radio,)),
        "counts": (POINTER(structures.TwrCounts), (radio,)),
        "anchors": (POINTER(structures.TwrAnchor), (radio, POINTER(c_size_t))),
        "sensors": (c_int, (radio, POINTER(c_float), POINTER(c_float))),
    }
    library = load_library("native_radio_", objects, signatures)
    library.uwb_twr_set_default_times.argtypes = (POINTER(structures.Config), c_uint32, c_uint32)
    return library
