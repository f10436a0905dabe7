"""A radio at this computer, operated by a thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from uwb_mitigation.radios.dw1000.bus import Bus
from uwb_mitigation.radios.dw1000.native import NativeRadio, load_native
from uwb_mitigation.radios.port import PortThread
from uwb_mitigation.radios.settings import RadioSettings, RadioState, RadioStatus
from uwb_mitigation.radios.wire.messages import RadioConfigured
from uwb_mitigation.types.measurement import RangeMeasurement

STATUS_INTERVAL_S = 1.0
SENSORS_INTERVAL_S = 10.0
"""Interval between readings of temperature and voltage. The receiver is off meanwhile: 20 ms over USB."""

_EXCHANGE_TIMEOUT_S = 0.1


@dataclass(frozen=True, slots=True)
class RadioLost:
    """The radio is unreachable; `text` contains the reason and the remedy."""

    text: str


RadioEvent = RangeMeasurement | RadioConfigured | RadioStatus | RadioLost


@dataclass(frozen=True, slots=True)
class RadioReport:
    """The state of a radio, for diagnostics.

    Attributes:
        name: name of the bus in use; empty = no bus is open.
        problem: reason why the radio does not range; empty while it works.
        settings: active settings; None before the first start of the chip.
        status: counts, state, anchors in range.
        openings: how often the bus was opened.
        overflowed: number of events dropped because the queue was full.
    """

    name: str
    problem: str
    settings: RadioSettings | None
    status: RadioStatus
    openings: int
    overflowed: int


class RadioDriver(PortThread[RadioEvent]):
    """Operates one radio until `close`, and reopens its bus after a loss.

    Events are measurements, `RadioConfigured` at each start of the chip, `RadioStatus` once a second, `RadioLost`.

    Args:
        open_bus: opens the bus; called again after it was lost.
        settings: what the radio does.
        stamp_clock: clock for stamps, ns.

    Raises:
        ParameterError: the settings are invalid.
        MissingDependencyError: no C compiler is installed.
    """

    def __init__(
        self,
        open_bus: Callable[[], Bus],
        settings: RadioSettings,
        *,
        stamp_clock: Callable[[], int] = time.time_ns,
    ) -> None:
        super().__init__("radio", "the radio was not opened yet")
        settings.check()
        load_native()
        self._open_bus = open_bus
        self._stamp_clock = stamp_clock
        self._requested_settings = settings
        self._settings_changed = False
        self._name = ""
        self._settings: RadioSettings | None = None
        self._status = RadioStatus(state=RadioState.BUS)
        self._radio: NativeRadio | None = None
        self._thread.start()

    def set_radio(self, settings: RadioSettings) -> None:
        """Use other settings, starting with the next exchange; a `RadioConfigured` follows.

        Raises:
            ParameterError: the settings are invalid.
        """
        settings.check()
        with self._lock:
            self._requested_settings, self._settings_changed = settings, True

    def report(self) -> RadioReport:
        """Return the present state."""
        with self._lock:
            return RadioReport(
                self._name, self._problem, self._settings, self._status, self.openings, self.overflowed
            )

    def close(self) -> None:
        super().close()
        if self._radio is not None:
            self._radio.close()

    def _connect(self) -> None:
        bus = self._open_bus()
        try:
            if self._radio is None:
                self._radio = NativeRadio(bus, self._requested_settings, stamp_clock=self._stamp_clock)
            self._radio.use(bus)
            with self._lock:
                self._name = bus.name
                self.openings += 1
            self._serve(self._radio)
        finally:
            bus.close()

    def _on_loss(self, text: str) -> None:
        self._name = ""
        if self._problem != text:
            self._put([RadioLost(text)])

    def _serve(self, radio: NativeRadio) -> None:
        """Range until the connection is closed; raise an exception if the bus is lost."""
        started = False
        status_due = sensors_due = 0.0
        while not self.closed:
            with self._lock:
                changed, self._settings_changed = self._settings_changed, False
                wanted = self._requested_settings
            if changed:
                radio.configure(wanted)
                started = False
            measured = radio.exchange(_EXCHANGE_TIMEOUT_S)
            events: list[RadioEvent] = []
            if not started and radio.address:
                started = self._was_connected = True
                events.append(RadioConfigured(radio.settings))
            if measured is not None:
                events.append(measured)
            now_s = time.monotonic()
            if now_s >= sensors_due:
                sensors_due = now_s + SENSORS_INTERVAL_S
                radio.read_sensors()
            status = radio.status()
            if now_s >= status_due:
                status_due = now_s + STATUS_INTERVAL_S
                events.append(status)
            with self._lock:
                self._problem = ""
                self._settings = radio.settings if started else None
                self._status = status
                self._put(events)
