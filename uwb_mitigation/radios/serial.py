"""Source `serial`: boards with our firmware, or with another one that uses the wire protocol."""

from __future__ import annotations

import logging
import math
import re
import time
from dataclasses import asdict, dataclass
from typing import Any

from uwb_mitigation.errors import LinkError, ParameterError, format_id
from uwb_mitigation.radios import port
from uwb_mitigation.radios.parameters import ValueReader, read_baud, read_radio
from uwb_mitigation.radios.settings import DEFAULT_RADIO, PortMessage, RadioSettings, RadioStatus, Role
from uwb_mitigation.radios.wire.layout import LogLevel, Mode
from uwb_mitigation.radios.wire.messages import BoardStatus, Correction, Hello, Log, RadioConfigured
from uwb_mitigation.radios.wire.session import (
    OFFSETS_PROBLEM,
    RADIO_PROBLEM,
    BoardSession,
    Event,
    LinkState,
    Loss,
    Refused,
)
from uwb_mitigation.types.measurement import RangeMeasurement
from uwb_mitigation.types.offsets import NO_OFFSETS, Offsets, read_offsets

BAUD = 921_600

REOPEN_TIMEOUT_NS = 10 * 10**9
"""Timeout after which the port is opened again. After a suspend, an open port may never receive data again."""


@dataclass(frozen=True, kw_only=True)
class SerialSettings(port.StreamSettings):
    """Settings of a board with the wire protocol.

    Attributes:
        mode: what the board sends; None = do not change it.
        model_id: expected model of the board, whose corrections are delivered; None = any.
        radio: settings of the board's radio; None = the board keeps its own.
        offsets: offsets that the board subtracts in mode DEVICE.
    """

    baud: int = BAUD
    mode: Mode | None = None
    model_id: int | None = None
    radio: RadioSettings | None = None
    offsets: Offsets = NO_OFFSETS


def read_settings(value: ValueReader) -> list[SerialSettings]:
    """Return the settings of the board from the parameters; raise ParameterError if one is invalid."""
    digits = value("board_model")
    if digits and not re.fullmatch("[0-9a-fA-F]{8}", digits):
        raise ParameterError(
            f"parameter board_model = {digits!r}", valid="eight hexadecimal digits, or empty"
        )
    radio = read_radio(value)
    settings = SerialSettings(
        port.PortAddress.parse(value("port")),
        baud=read_baud(value, BAUD),
        dtr=value("dtr"),
        mode=Mode[value("mode").upper()],
        model_id=int(digits, 16) if digits else None,
        radio=radio if radio != DEFAULT_RADIO else None,
        offsets=read_offsets(str(value("offsets"))),
    )
    return [settings]


class BoardPort(port.StreamPort):
    """Keeps a board connected until `close`; reconnects after unplugging, resets, timeouts and noise; see `StreamPort`.

    Events are measurements, corrections, events of the session and `PortMessage`.
    """

    session: BoardSession

    _range_types = (RangeMeasurement, Correction)

    def __init__(self, settings: SerialSettings, place: port.StreamPlace) -> None:
        session = BoardSession(mode=settings.mode, expected_model_id=settings.model_id)
        super().__init__(settings, session, port.ExchangeMonitor(RadioStatus.REMEDIES), place)
        self._board = settings
        self._connections = 0
        self._other_users = ""
        self._refused: dict[str, str] = {}
        self._status: BoardStatus | None = None
        self._radio: RadioSettings | None = None
        self._radio_status: RadioStatus | None = None
        self._corrections = 0
        if settings.radio is not None:
            self.session.set_radio(settings.radio)
        if settings.mode is Mode.DEVICE:
            self.session.set_offsets(settings.offsets)

    def apply(self, settings: SerialSettings) -> None:
        """Send the settings that differ to the board."""
        with self._lock:
            before, self._board = self._board, settings
            if settings.radio != before.radio:
                self._refused.pop(RADIO_PROBLEM, None)
                self.session.set_radio(settings.radio or DEFAULT_RADIO)
            has_new_offsets = (settings.mode, settings.offsets) != (before.mode, before.offsets)
            if settings.mode is Mode.DEVICE and has_new_offsets:
                self._refused.pop(OFFSETS_PROBLEM, None)
                self.session.set_offsets(settings.offsets)
            if settings.mode is not None and settings.mode != before.mode:
                self.session.set_mode(settings.mode)

    @property
    def problem(self) -> str:
        """Reason why the board is not connected or does not do what was requested; empty if it does."""
        with self._lock:
            session = self.session
            if self._lost:
                return self._lost
            if session.state is LinkState.WRONG_VERSION:
                return f"{session.state.value}: {session.foreign_version}"
            if session.state is not LinkState.READY:
                users = f"; the port is also open in {self._other_users}" if self._other_users else ""
                return f"{session.state.value}{users}"
            return "" if session.model_matches else "the board has another model than the expected one"

    def report(self) -> port.PortReport:
        """Return the present state."""
        with self._lock:
            hello, clock = self.session.hello, self.session.clock
            radio, status = self._radio, self._radio_status
            uncertainty_us = clock.uncertainty_ns / 1e3 if clock.synchronised else math.nan
            values: dict[str, object] = {"corrections published": self._corrections}
            hardware = "no board"
            if hello is not None:
                hardware = f"board {format_id(hello.board_id)}"
                values |= {
                    "firmware": f"{hello.firmware_name} {hello.firmware_version}",
                    "model id": f"{hello.model_id:08x} ({hello.model_id})",
                    "mode": hello.mode.name.lower(),
                }
            values |= {
                "clock offset s": f"{clock.offset_ns / 1e9:.6f}",
                "clock drift ppm": f"{clock.drift * 1e6:.2f}",
                "clock uncertainty us": f"{uncertainty_us:.1f}",
            }
            values |= self.session.totals() | {"openings": self.openings}
            if self._status is not None:
                values |= {f"board: {name}": count for name, count in asdict(self._status).items()}
            problems = [self.problem, *(f"{name}: {text}" for name, text in self._refused.items())]
            warning = ""
            if radio is not None:
                hardware += f", radio {format_id(radio.address)}"
            if status is not None:
                values |= status.values(radio, "radio: ")
                problems.append(status.problem)
                warning = status.warning
            if radio is None or radio.role is Role.TAG or radio.report:
                exchanges = self.monitor.warning(radio.interval_us / 1e6 if radio is not None else 0.0)
                warning = warning or (f"connected; {exchanges}" if exchanges else "")
            return port.PortReport(
                self.device, hardware, next(filter(None, problems), ""), warning, "connected", values
            )

    def _opened(self, now_ns: int) -> list[Any]:
        self._other_users = ", ".join(port.processes_using(self.device))
        self._connections = self.session.counts["connections"]
        return self._observed(self.session.opened(now_ns))

    def _received(self, data: bytes, now_ns: int, stamp_ns: int) -> list[Any]:
        observed = self._observed(self.session.receive(data, now_ns, stamp_ns))
        if self.session.idle_ns(now_ns) > REOPEN_TIMEOUT_NS:
            raise LinkError("sends no data", where=self._name)
        return observed

    def _closed(self, now_ns: int) -> list[Any]:
        self._was_connected = self.session.counts["connections"] > self._connections
        return self._observed(super()._closed(now_ns))

    def _observed(self, received: list[Event]) -> list[Any]:
        """Update the state for the diagnostics; return the events and the messages for the log."""
        observed = [item for event in received for item in (event, self._message(event))]
        return [item for item in observed if item is not None]

    def _message(self, event: Event) -> PortMessage | None:
        level, text = logging.INFO, ""
        match event:
            case Correction():
                self._corrections += 1
            case BoardStatus():
                self._status = event
            case RadioStatus():
                self.monitor.add_status(self._radio_status, event, time.monotonic())
                self._radio_status = event
            case RadioConfigured(settings=settings):
                # A board may repeat its settings.
                if settings != self._radio:
                    text = f"the board's radio {format_id(settings.address)}: {settings.text}"
                self._radio = settings
            case Refused(problem=problem, text=reason):
                self._refused[problem] = reason
                level, text = logging.ERROR, f"{problem}: {reason}"
            case Hello():
                self._refused.clear()
                self._radio = self._radio_status = None
                board, model = format_id(event.board_id), f"{event.model_id:08x} ({event.model_id})"
                text = f"connected to board {board}, model {model}, mode {event.mode.name}"
            case Loss():
                self.monitor.reset()
                if not self.closed:
                    level = logging.WARNING
                    text = f"disconnected from the board: {event.value}; waiting for it"
            case Log(level=severity, text=board_text):
                level = logging.WARNING if severity >= LogLevel.WARNING else logging.INFO
                text = f"board: {board_text}"
        return PortMessage(level, text) if text else None


open = port.stream_opener(BoardPort)
