"""A radio at this computer, kept ranging in a thread of its own: found, started, and started again when it was lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.link.event_queue import EventQueue
from uwb_mitigation.link.layout import RadioState
from uwb_mitigation.link.messages import Radio
from uwb_mitigation.link.radio import RadioSettings, RadioStatus
from uwb_mitigation.measurement import RangeMeasurement
from uwb_mitigation.radio.bus import Bus
from uwb_mitigation.radio.host import HostRadio, load

RETRY_S = 0.2
"""Between two tries to reach a radio: one that came back is to be noticed well within a second."""

STATUS_INTERVAL_S = 1.0
SENSORS_INTERVAL_S = 10.0
"""Between two readings of temperature and voltage, for which the receiver is off: over USB for 20 ms."""

_TURN_S = 0.1
_CAPACITY = 1024
"""Events that wait at most; beyond it the oldest are dropped, and counted."""


@dataclass(frozen=True, slots=True)
class RadioLost:
    """The radio cannot be reached any more, and is waited for; `text` says why, and what to do."""

    text: str


RadioEvent = RangeMeasurement | Radio | RadioStatus | RadioLost


@dataclass(frozen=True, slots=True)
class RadioReport:
    """How a radio fares, for diagnostics.

    Attributes:
        name: of the bus in use; empty while there is none.
        problem: what keeps the radio from ranging; empty while nothing does.
        settings: in force; None before the chip has first started.
        status: counts, state, anchors in reach.
        openings: how often the bus was opened.
        overflowed: events that nobody took in time.
    """

    name: str
    problem: str
    settings: RadioSettings | None
    status: RadioStatus
    openings: int
    overflowed: int


class RadioPort:
    """Keeps one radio ranging until `close`, whatever becomes of its bus.

    Nothing that the bus or the chip does ends it or raises: `report` says what is wrong. Events are
    measurements, `Radio` at each start of the chip, `RadioStatus` once a second, `RadioLost`.

    Args:
        open_bus: opens the bus; called again after it was lost.
        settings: what the radio is to do.
        stamp_clock: the clock that stamps are on, ns.

    Raises:
        ParameterError: settings that no radio has.
        MissingDependencyError: there is no C compiler.
    """

    def __init__(
        self,
        open_bus: Callable[[], Bus],
        settings: RadioSettings,
        *,
        stamp_clock: Callable[[], int] = time.time_ns,
    ) -> None:
        settings.check()
        load()
        self._open_bus = open_bus
        self._stamp_clock = stamp_clock
        self._wanted = settings
        self._changed = False
        self._events: EventQueue[RadioEvent] = EventQueue(_CAPACITY)
        self._openings = 0
        self._name = ""
        self._problem = "it has not been reached yet"
        self._settings: RadioSettings | None = None
        self._status = RadioStatus(state=RadioState.BUS)
        # Guards what is told of the radio, and what is wanted of it.
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="radio", daemon=True)
        self._thread.start()

    def get(self, timeout_s: float) -> RadioEvent | None:
        """The next event, or None if there is none within the time or the port is closed."""
        return self._events.get(timeout_s)

    def set_radio(self, settings: RadioSettings) -> None:
        """Use other settings from the next exchange on; a `Radio` follows.

        Raises:
            ParameterError: settings that no radio has.
        """
        settings.check()
        with self._lock:
            self._wanted, self._changed = settings, True

    def report(self) -> RadioReport:
        """How things stand."""
        with self._lock:
            return RadioReport(
                self._name,
                self._problem,
                self._settings,
                self._status,
                self._openings,
                self._events.overflowed,
            )

    @property
    def closed(self) -> bool:
        """True once `close` was called."""
        return self._stop.is_set()

    def close(self) -> None:
        """End the thread and close the bus; may be called twice, and from any thread."""
        self._stop.set()
        self._events.close()
        self._thread.join()

    def _run(self) -> None:
        radio: HostRadio | None = None
        while not self._stop.is_set():
            bus: Bus | None = None
            try:
                bus = self._open_bus()
                if radio is None:
                    radio = HostRadio(bus, self._wanted, stamp_clock=self._stamp_clock)
                radio.use(bus)
                with self._lock:
                    self._name = bus.name
                    self._openings += 1
                self._serve(radio)
            except UwbMitigationError as error:
                self._lose(str(error))
            finally:
                if bus is not None:
                    bus.close()
            self._stop.wait(RETRY_S)
        if radio is not None:
            radio.close()

    def _serve(self, radio: HostRadio) -> None:
        """Range until the bus is lost, which raises, or the port is to be closed."""
        started = False
        status_due = sensors_due = 0.0
        while not self._stop.is_set():
            with self._lock:
                changed, self._changed = self._changed, False
                wanted = self._wanted
            if changed:
                radio.configure(wanted)
                started = False
            measured = radio.turn(_TURN_S)
            status = radio.status()
            events: list[RadioEvent] = []
            if not started and radio.address:
                started = True
                events.append(Radio(radio.settings))
            if measured is not None:
                events.append(measured)
            if time.monotonic() >= status_due:
                status_due = time.monotonic() + STATUS_INTERVAL_S
                if time.monotonic() >= sensors_due:
                    sensors_due = time.monotonic() + SENSORS_INTERVAL_S
                    radio.read_sensors()
                    status = radio.status()
                events.append(status)
            with self._lock:
                self._problem = ""
                self._settings = radio.settings if started else None
                self._status = status
                self._events.put(events)

    def _lose(self, text: str) -> None:
        with self._lock:
            known = self._problem == text
            self._name, self._problem = "", text
            if not known:
                self._events.put([RadioLost(text)])
