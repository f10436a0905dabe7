"""A DW1000 at this computer, operated by a thread; `evb1000` and `spi` open its bus."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from uwb_mitigation.errors import ParameterError, format_id
from uwb_mitigation.radios.dw1000.bus import Bus
from uwb_mitigation.radios.dw1000.native import NativeRadio, load_native
from uwb_mitigation.radios.parameters import PREFIX, ValueReader, read_ports, read_radio
from uwb_mitigation.radios.port import ExchangeMonitor, OnEvent, PortReport, RadioPort
from uwb_mitigation.radios.settings import PortMessage, RadioSettings, RadioState, RadioStatus, Role

STATUS_INTERVAL_S = 1.0
SENSORS_INTERVAL_S = 10.0
"""Interval between readings of temperature and voltage. The receiver is off meanwhile: 20 ms over USB."""

_EXCHANGE_TIMEOUT_S = 0.1


@dataclass(frozen=True, slots=True)
class ChipSettings:
    """Settings of a radio: port of its bus, what it does, and its reset line (see `SpidevBus`)."""

    port: str
    radio: RadioSettings
    reset: str = ""


def read_chips(check_port: Callable[[str], object], value: ValueReader) -> list[ChipSettings]:
    """Return the settings of each radio. The first has the role of the parameter, the others are anchors.

    Raises:
        ParameterError: a parameter is invalid; also by `check_port`.
    """
    radio, ports = read_radio(value), read_ports(value)
    if radio.address and len(ports) > 1:
        raise ParameterError(
            f"parameter {PREFIX}address with {len(ports)} ports",
            valid="empty: each radio uses the address of its chip",
        )
    for port in ports:
        check_port(port)
    anchor, reset = replace(radio, role=Role.ANCHOR, anchors=()), value(f"{PREFIX}reset")
    return [ChipSettings(port, anchor if number else radio, reset) for number, port in enumerate(ports)]


def open_chips(
    open_bus: Callable[[ChipSettings], Bus],
    settings: Sequence[ChipSettings],
    on_event: OnEvent,
    stamp_clock: Callable[[], int] = time.time_ns,
) -> list[ChipPort]:
    """Open radios; see `ChipPort` for the events and errors."""
    ports = [ChipPort(chip, partial(open_bus, chip), on_event, stamp_clock) for chip in settings]
    return [port.start() for port in ports]


class ChipPort(RadioPort):
    """Operates one radio until `close`, and reopens its bus after a loss.

    Events are measurements, `RadioStatus` once a second, and `PortMessage`.

    Args:
        settings: what the radio does, and where.
        open_bus: opens the bus; called again after it was lost.
        on_event: see `RadioPort`.
        stamp_clock: clock for stamps, ns.

    Attributes:
        settings: active settings; None while the chip has not started.
        status: state and counts.

    Raises:
        ParameterError: the settings are invalid.
        MissingDependencyError: no C compiler is installed.
    """

    def __init__(
        self,
        settings: ChipSettings,
        open_bus: Callable[[], Bus],
        on_event: OnEvent,
        stamp_clock: Callable[[], int],
    ) -> None:
        super().__init__(settings.port, on_event, ExchangeMonitor(RadioStatus.REMEDIES))
        settings.radio.check()
        load_native()
        self.settings: RadioSettings | None = None
        self.status = RadioStatus(state=RadioState.BUS)
        self._open_bus = open_bus
        self._stamp_clock = stamp_clock
        self._requested_settings = self._configured_settings = settings.radio
        self._radio: NativeRadio | None = None
        self._is_started = False
        self._status_due_s = self._sensors_due_s = 0.0

    def apply(self, settings: ChipSettings) -> None:
        """Use other settings of the radio, starting with the next exchange.

        Raises:
            ParameterError: the settings are invalid.
        """
        settings.radio.check()
        self._requested_settings = settings.radio

    def report(self) -> PortReport:
        """Return the present state."""
        with self._lock:
            settings, status = self.settings, self.status
            is_tag = self._requested_settings.role is Role.TAG
            warning = "" if settings is None else status.warning
            if is_tag or self._requested_settings.report:
                warning = warning or self.monitor.warning(self._requested_settings.interval_us / 1e6)
            hardware = "no radio" if settings is None else f"radio {format_id(settings.address)}"
            values: dict[str, object] = {"openings": self.openings}
            values |= status.values(settings)
            activity = "ranging" if is_tag else "answering"
            return PortReport(self.device, hardware, self._lost, warning, activity, values)

    def close(self) -> None:
        """Stop the thread, close the bus and free the radio."""
        super().close()
        if self._radio is not None:
            self._radio.close()

    def _open(self) -> Bus:
        bus = self._open_bus()
        if self._radio is None:
            self._radio = NativeRadio(bus, self._requested_settings, stamp_clock=self._stamp_clock)
        self._radio.use(bus)
        self._is_started, self._status_due_s, self._sensors_due_s = False, 0.0, 0.0
        self.device = bus.name
        return bus

    def _serve(self, hardware: Bus) -> list[Any]:
        radio = self._radio
        assert radio is not None
        if (requested := self._requested_settings) != self._configured_settings:
            self._configured_settings, self._is_started = requested, False
            radio.configure(requested)
        measured = radio.exchange(_EXCHANGE_TIMEOUT_S)
        events: list[Any] = [] if measured is None else [measured]
        starts = not self._is_started and radio.address != 0
        self._is_started |= starts
        now_s = time.monotonic()
        if now_s >= self._sensors_due_s:
            self._sensors_due_s = now_s + SENSORS_INTERVAL_S
            radio.read_sensors()
        status = radio.status()
        if now_s >= self._status_due_s:
            self._status_due_s = now_s + STATUS_INTERVAL_S
            events.append(status)
        with self._lock:
            self._lost = ""
            self.settings = radio.settings if self._is_started else None
            self.monitor.add_status(self.status, status, now_s)
            self.status = status
        if starts:
            self._was_connected = True
            text = f"radio {format_id(radio.address)} at {self.device}: {radio.settings.text}"
            events.insert(0, PortMessage(logging.INFO, text))
        return events

    def _closed(self, now_ns: int) -> list[Any]:
        self.settings = None
        return []
