"""Feeds of the driver: their interface, boards on serial links, and radios at this computer."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, fields, replace
from typing import Any, Protocol

from uwb_mitigation.errors import ParameterError, format_id, parse_id
from uwb_mitigation.nodes.support import diagnostics
from uwb_mitigation.nodes.support.diagnostics import Description
from uwb_mitigation.radios.dw1000.bus import bus_opener
from uwb_mitigation.radios.dw1000.driver import RadioDriver, RadioEvent, RadioLost
from uwb_mitigation.radios.port import PortThread
from uwb_mitigation.radios.serial import BoardDriver
from uwb_mitigation.radios.settings import AGE_UNKNOWN_MS, RadioSettings, RadioState, RadioStatus, Role
from uwb_mitigation.radios.wire.events import (
    Connected,
    Disconnected,
    Event,
    ModeChanged,
    ModeRefused,
    OffsetsRefused,
    RadioRefused,
    VersionMismatch,
)
from uwb_mitigation.radios.wire.layout import PROTOCOL_VERSION, LogLevel, Mode
from uwb_mitigation.radios.wire.messages import BoardStatus, Correction, Log, RadioConfigured
from uwb_mitigation.types.measurement import RangeMeasurement
from uwb_mitigation.types.offsets import Offsets

Value = Callable[[str], Any]
"""Returns the value of a parameter."""

EVENT_TIMEOUT_S = 0.5

PREFIX = "radio."
"""Prefix of the parameters of radios."""

_OFFSETS_PROBLEM, _RADIO_PROBLEM = "the offsets are not set", "the radio's settings are not used"
"""Settings that a board may refuse."""

_STATES = {
    RadioState.ABSENT: "no DW1000 answers the board: check wiring and supply",
    RadioState.BUS: "the board's SPI fails",
    RadioState.NO_CLOCK: "the clock PLL of the DW1000 does not lock: check its supply",
}
_COUNTS = tuple(row.name for row in fields(RadioStatus) if row.type == "int")


class SourceHandle(Protocol):
    """A source that is playing or connected; `stop` ends it and may be called twice."""

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def describe(self) -> Description: ...

    def apply(self, changed: Collection[str], value: Value, offsets: Offsets) -> None:
        """Use new values of the parameters `changed`."""


class LiveFeed:
    """Handles the events of each connection in its own thread, and publishes the ranges.

    Args:
        ports: closed by `stop`.
        on_range: publishes a range; called by one thread at a time.
        now_ns: the clock of the stamps.
        logger: with `info`, `warning` and `error`, as rclpy's.

    Attributes:
        ranges: number of ranges that were published.
    """

    def __init__(
        self,
        ports: Sequence[PortThread[Any]],
        on_range: Callable[[RangeMeasurement], None],
        now_ns: Callable[[], int],
        logger: Any,
    ) -> None:
        self.ranges = 0
        self.meter = diagnostics.RateMonitor(now_ns)
        self._logger = logger
        self._ports = ports
        self._on_range = on_range
        self._now_ns = now_ns
        self._publishing = threading.Lock()
        self._problems: dict[PortThread[Any], tuple[str, float, bool]] = {}
        self._threads = [
            threading.Thread(target=self._run, args=(port,), name="feed", daemon=True) for port in ports
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Close the connections and wait for the threads."""
        for port in self._ports:
            port.close()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    def handle(self, event: Any, port: Any) -> None:
        """Handle an event that is not a range."""
        raise NotImplementedError

    def check(self, port: PortThread[Any]) -> None:
        """Log a problem once if it lasts longer than `EVENT_TIMEOUT_S`; a handshake is shorter.

        Called after every event, and at least every `EVENT_TIMEOUT_S`.
        """
        problem, now_s = port.problem, time.monotonic()
        known, since_s, logged = self._problems.get(port, ("", now_s, False))
        if problem != known:
            since_s, logged = now_s, False
        if problem and not logged and now_s - since_s >= EVENT_TIMEOUT_S and not port.closed:
            self._logger.warning(f"{problem}; waiting for the board")
            logged = True
        self._problems[port] = problem, since_s, logged

    def _run(self, port: PortThread[Any]) -> None:
        while not port.closed:
            event = port.get(EVENT_TIMEOUT_S)
            if isinstance(event, RangeMeasurement):
                with self._publishing:
                    self.ranges += 1
                    self._on_range(event)
                    self.meter.add(self._now_ns() - event.stamp_ns)
            elif event is not None:
                self.handle(event, port)
            self.check(port)


class BoardFeed(LiveFeed):
    """Publishes ranges and corrections of a board, and logs its events.

    Args:
        port: closed by `stop`.
        on_range, now_ns, logger: see `LiveFeed`.
        on_correction: publishes a range that the board has corrected.
    """

    def __init__(
        self,
        port: BoardDriver,
        on_range: Callable[[RangeMeasurement], None],
        on_correction: Callable[[Correction], None],
        now_ns: Callable[[], int],
        logger: Any,
    ) -> None:
        super().__init__([port], on_range, now_ns, logger)
        self._port = port
        self._corrections = 0
        self._status: BoardStatus | None = None
        self._radio: RadioSettings | None = None
        self._radio_status: RadioStatus | None = None
        self._on_correction = on_correction
        # Refused settings and the reasons.
        self._refused: dict[str, str] = {}

    def apply(self, changed: Collection[str], value: Value, offsets: Offsets) -> None:
        """Send new settings to the board."""
        if any(name.startswith(PREFIX) for name in changed):
            self._refused.pop(_RADIO_PROBLEM, None)
            self._port.set_radio(settings_of(value))
        if {"mode", "offsets"} & set(changed) and value("mode") != "host":
            self._refused.pop(_OFFSETS_PROBLEM, None)
            self._port.set_offsets(offsets)
        if "mode" in changed:
            self._port.set_mode(Mode[value("mode").upper()])

    def describe(self) -> Description:
        report, radio, status = self._port.report(), self._radio, self._radio_status
        entries: dict[str, object] = {
            "port": report.port or "none",
            "ranges published": self.ranges,
            "corrections published": self._corrections,
        }
        hardware = "no board"
        if (hello := report.hello) is not None:
            hardware = f"board {format_id(hello.board_id)}"
            entries |= {
                "firmware": f"{hello.firmware_name} {hello.firmware_version}",
                "model id": diagnostics.model_id(hello.model_id),
                "mode": hello.mode.name.lower(),
            }
        entries |= self.meter.entries() | {
            "clock offset s": f"{report.clock_offset_s:.6f}",
            "clock drift ppm": f"{report.clock_drift_ppm:.2f}",
            "clock uncertainty us": f"{report.clock_uncertainty_us:.1f}",
        }
        entries |= report.counts
        if self._status is not None:
            entries |= {f"board: {name}": value for name, value in asdict(self._status).items()}
        if radio is not None:
            hardware += f", radio {format_id(radio.address)}"
        problems = [report.problem, *(f"{what}: {text}" for what, text in self._refused.copy().items())]
        warning = ""
        if status is not None:
            entries |= radio_values(radio, status, "radio: ") | anchor_values(status)
            problems.append(_STATES.get(status.state, ""))
            warning = radio_warning(radio, status)
        problem = next(filter(None, problems), "")
        return hardware, *level_of(problem, warning, "connected"), entries

    def handle(self, event: Event, port: BoardDriver) -> None:
        log = self._logger
        match event:
            case Correction():
                self._corrections += 1
                self._on_correction(event)
                self.meter.add(self._now_ns() - event.stamp_ns)
            case BoardStatus():
                self._status = event
            case RadioStatus():
                self._radio_status = event
            case RadioConfigured(settings=settings):
                # A board may repeat its settings.
                if settings != self._radio:
                    log.info(f"the board's radio {format_id(settings.address)}: {settings_text(settings)}")
                self._radio = settings
            case RadioRefused(text=text):
                self._refused[_RADIO_PROBLEM] = text
                log.error(f"{_RADIO_PROBLEM}: {text}")
            case Connected(hello=hello):
                self._refused.clear()
                self._radio = self._radio_status = None
                model, mode = diagnostics.model_id(hello.model_id), hello.mode.name
                log.info(f"connected to board {format_id(hello.board_id)}, model {model}, mode {mode}")
            case Disconnected(loss=loss):
                if not port.closed:
                    log.warning(f"disconnected from the board: {loss.value}; waiting for it")
            case VersionMismatch(version=version):
                log.error(
                    f"the board uses version {version} of the protocol, this driver version {PROTOCOL_VERSION}: "
                    "update the older one"
                )
            case ModeChanged(mode=mode):
                log.info(f"the board is in mode {mode.name}")
            case ModeRefused(mode=mode, wanted=wanted):
                log.warning(
                    f"the board stays in mode {mode.name} instead of {wanted.name}: does it have a model?"
                )
            case OffsetsRefused(text=text):
                self._refused[_OFFSETS_PROBLEM] = text
                log.error(f"the board's corrections are not published: {_OFFSETS_PROBLEM}: {text}")
            case Log(level=level, text=text):
                # rclpy allows only one severity for each line of code.
                if level >= LogLevel.WARNING:
                    log.warning(f"board: {text}")
                else:
                    log.info(f"board: {text}")


class RadioFeed(LiveFeed):
    """Publishes the ranges of radios of this computer, and logs their events.

    Args:
        ports: one or several radios, the tag first; closed by `stop`.
        on_range, now_ns, logger: see `LiveFeed`.
    """

    _ports: Sequence[RadioDriver]

    def apply(self, changed: Collection[str], value: Value, offsets: Offsets) -> None:
        """Use new radio settings from the next exchange on."""
        if any(name.startswith(PREFIX) for name in changed):
            settings = settings_of(value)
            for number, port in enumerate(self._ports):
                port.set_radio(_role_of(settings, number))

    def describe(self) -> Description:
        reports = [port.report() for port in self._ports]
        first = reports[0]
        entries: dict[str, object] = {"ranges published": self.ranges}
        entries |= self.meter.entries()
        for number, report in enumerate(reports):
            prefix = f"radio {number}: " if len(reports) > 1 else ""
            entries[f"{prefix}port"] = report.name or "none"
            entries |= radio_values(report.settings, report.status, prefix)
        entries |= anchor_values(first.status)
        hardware = "no radio" if first.settings is None else f"radio {format_id(first.settings.address)}"
        problem = "; ".join(report.problem for report in reports if report.problem)
        warnings = (radio_warning(report.settings, report.status) for report in reports)
        is_tag = first.settings is not None and first.settings.role is Role.TAG
        level = level_of(problem, next(filter(None, warnings), ""), "ranging" if is_tag else "answering")
        return hardware, *level, entries

    def check(self, port: PortThread[Any]) -> None:
        """Do nothing: the events of a radio contain its problems."""

    def handle(self, event: RadioEvent, port: RadioDriver) -> None:
        match event:
            case RadioConfigured(settings=settings):
                name, text = port.report().name, settings_text(settings)
                self._logger.info(f"radio {format_id(settings.address)} at {name}: {text}")
            case RadioLost(text=text) if not port.closed:
                self._logger.warning(f"{text}; waiting for the radio")


def settings_of(value: Value) -> RadioSettings:
    """Return the radio settings of the parameters `radio.*`.

    Raises:
        ParameterError: a setting is invalid; names the parameter.
    """

    def get(name: str) -> Any:
        return value(PREFIX + name)

    anchors = [part.strip() for part in str(get("anchors")).split(",") if part.strip()]
    settings = RadioSettings(
        role=Role[get("role").upper()],
        address=_address(get("address"), "address") if get("address") != "" else 0,
        pan=get("pan"),
        channel=get("channel") or RadioSettings().channel,
        prf_mhz=int(get("prf")),
        preamble=get("preamble"),
        preamble_code=get("preamble_code"),
        rate_kbps=get("data_rate"),
        decawave_sfd=get("decawave_sfd"),
        tx_power=get("tx_power"),
        antenna_delay=get("antenna_delay"),
        window=get("window"),
        anchors=tuple(_address(part, "anchors") for part in anchors),
        interval_us=round(1e6 / get("rate")) if get("rate") else 0,
        report=get("report"),
        bias_correction=get("bias_correction"),
    )
    try:
        settings.check()
    except ParameterError as error:
        raise ParameterError(f"parameters {PREFIX}*: {error.what}", valid=error.valid) from error
    return settings


def open_radios(value: Value, now_ns: Callable[[], int]) -> list[RadioDriver]:
    """Open the radios of `source`, `port` and `radio.*`. The first has the role of the parameter, the others are anchors.

    Raises:
        ParameterError: a port or a setting is invalid.
        MissingDependencyError: there is no C compiler.
    """
    settings = settings_of(value)
    names = [part.strip() for part in value("port").split(",") if part.strip()]
    if not names:
        valid = "/dev/ttyACM0 or usb:0483:5740, or several with commas"
        if value("source") == "spi":
            valid = "/dev/spidevBUS.SELECT"
        raise ParameterError("parameter port is empty", valid=valid)
    if settings.address and len(names) > 1:
        raise ParameterError(
            f"parameter {PREFIX}address with {len(names)} ports",
            valid="empty: each radio uses the address of its chip",
        )
    openers = [bus_opener(value("source"), name, value(PREFIX + "reset")) for name in names]
    ports: list[RadioDriver] = []
    try:
        for number, open_bus in enumerate(openers):
            ports.append(RadioDriver(open_bus, _role_of(settings, number), stamp_clock=now_ns))
    except Exception:
        for port in ports:
            port.close()
        raise
    return ports


def _role_of(settings: RadioSettings, number: int) -> RadioSettings:
    return settings if number == 0 else replace(settings, role=Role.ANCHOR, anchors=())


def _address(value: object, name: str) -> int:
    """Return an address; raise ParameterError if the value is not an address."""
    with contextlib.suppress(ValueError):
        if 0 < (address := parse_id(str(value))) < 2**64 - 1:
            return address
    raise ParameterError(
        f"parameter {PREFIX}{name} = {str(value)!r:.40}",
        valid="a number below 65536, or 0x and up to 16 hexadecimal digits in quotes",
    )


def settings_text(settings: RadioSettings) -> str:
    """Return the settings as text for the log."""
    return (
        f"{settings.role.name.lower()}, channel {settings.channel}, {settings.rate_kbps} kbit/s, preamble "
        f"{settings.preamble}, PAN 0x{settings.pan:04x}"
    )


def level_of(problem: str, warning: str, ok: str) -> tuple[bytes, str]:
    """Return level and message of a diagnostic status."""
    if problem:
        return diagnostics.ERROR, problem
    return (diagnostics.WARN, warning) if warning else (diagnostics.OK, ok)


def radio_warning(settings: RadioSettings | None, status: RadioStatus) -> str:
    """Return a possible reason why a radio without a problem does not range, or an empty string."""
    if status.state is RadioState.LOCK_UNCONFIRMED:
        return "the DW1000 has not reported that its clock PLL locked; if it does not range, check its supply"
    if settings is not None and settings.role is Role.TAG and not status.anchors:
        return "no anchor answers: check their power, channel, data rate and PAN id"
    return ""


def radio_values(settings: RadioSettings | None, status: RadioStatus, prefix: str) -> dict[str, object]:
    """Return the values of a radio for the diagnostics, without those of the anchors."""
    values: dict[str, object] = {}
    if settings is not None:
        values = {
            "address": format_id(settings.address),
            "role": settings.role.name.lower(),
            "antenna delay": settings.antenna_delay,
        }
    values |= {name.replace("_", " "): getattr(status, name) for name in _COUNTS}
    values |= {"temperature C": f"{status.temperature_c:.1f}", "voltage V": f"{status.voltage:.2f}"}
    return {f"{prefix}{name}": value for name, value in values.items()}


def anchor_values(status: RadioStatus) -> dict[str, object]:
    """Return the values of the anchors in reach for the diagnostics."""
    values: dict[str, object] = {}
    for anchor in status.anchors:
        last_seen = "never" if anchor.age_ms == AGE_UNKNOWN_MS else f"{anchor.age_ms / 1000:.1f} s ago"
        values[f"anchor {format_id(anchor.address)}"] = (
            f"{anchor.ranged} of {anchor.tried} ranged, {anchor.rx_power_dbm:.1f} dBm, last seen {last_seen}"
        )
    return values
