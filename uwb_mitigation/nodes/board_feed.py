"""Publishes the ranges and corrections of a board on a serial link, and keeps its diagnosis."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from dataclasses import asdict
from typing import Any

from uwb_mitigation.errors import format_id
from uwb_mitigation.link.events import (
    Connected,
    Disconnected,
    Event,
    ModeChanged,
    ModeRefused,
    OffsetsRefused,
    RadioRefused,
    VersionMismatch,
)
from uwb_mitigation.link.layout import PROTOCOL_VERSION, LogLevel, Mode
from uwb_mitigation.link.messages import BoardStatus, Correction, Log, Radio
from uwb_mitigation.link.port import BoardPort
from uwb_mitigation.link.radio import RadioSettings, RadioStatus
from uwb_mitigation.measurement import RangeMeasurement
from uwb_mitigation.nodes import diagnostics, radio_facts
from uwb_mitigation.nodes.diagnostics import Description
from uwb_mitigation.nodes.feed import EVENT_TIMEOUT_S, LiveFeed, Value
from uwb_mitigation.nodes.radio_feed import PREFIX, settings_of
from uwb_mitigation.offsets import Offsets


class BoardFeed(LiveFeed):
    """Publishes what a board sends, and logs what happens to it.

    Args:
        port: closed by `stop`.
        on_correction: publishes a range that the board has corrected.
        on_range, now_ns, logger: see `LiveFeed`.

    Attributes:
        corrections: number of corrections that were published.
        status: the latest STATUS of the board; None before the first.
    """

    def __init__(
        self,
        port: BoardPort,
        *,
        on_range: Callable[[RangeMeasurement], None],
        on_correction: Callable[[Correction], None],
        now_ns: Callable[[], int],
        logger: Any,
    ) -> None:
        super().__init__([port], on_range=on_range, now_ns=now_ns, logger=logger)
        self.port = port
        self.corrections = 0
        self.status: BoardStatus | None = None
        self._problem = self._logged = ""
        self._checked_s = 0.0
        self._on_correction = on_correction
        self._refused_offsets = self._refused_radio = ""
        self._radio: RadioSettings | None = None
        self._radio_status: RadioStatus | None = None

    def apply(self, changed: Collection[str], value: Value, offsets: Offsets) -> None:
        """Send new settings to the board."""
        if any(name.startswith(PREFIX) for name in changed):
            self._refused_radio = ""
            self.port.set_radio(settings_of(value))
        if {"mode", "offsets"} & set(changed) and value("mode") != "host":
            self._refused_offsets = ""
            self.port.set_offsets(offsets)
        if "mode" in changed:
            self.port.set_mode(Mode[value("mode").upper()])

    def describe(self) -> Description:
        report = self.port.report()
        facts: dict[str, object] = {
            "port": report.port or "none",
            "ranges published": self.ranges,
            "corrections published": self.corrections,
        }
        hardware = "no board"
        if report.hello is not None:
            hardware = f"board {format_id(report.hello.board_id)}"
            facts |= {
                "firmware": f"{report.hello.firmware_name} {report.hello.firmware_version}",
                "model id": diagnostics.model_id(report.hello.model_id),
                "mode": report.hello.mode.name.lower(),
            }
        facts |= self.meter.facts()
        facts |= {
            "clock offset s": f"{report.clock_offset_s:.6f}",
            "clock drift ppm": f"{report.clock_drift_ppm:.2f}",
            "clock uncertainty us": f"{report.clock_uncertainty_us:.1f}",
        }
        facts |= report.counts
        if self.status is not None:
            facts |= {f"board: {name}": value for name, value in asdict(self.status).items()}
        radio, status = self._radio, self._radio_status
        if radio is not None:
            hardware += f", radio {format_id(radio.address)}"
        if status is not None:
            facts |= radio_facts.facts(radio, status, "radio: ") | radio_facts.anchors(status)
        problem = report.problem
        if not problem and self._refused_offsets:
            problem = f"the offsets are not set: {self._refused_offsets}"
        if not problem and self._refused_radio:
            problem = f"the radio's settings are not used: {self._refused_radio}"
        if not problem and status is not None:
            problem = radio_facts.problem(status)
        if problem:
            return hardware, diagnostics.ERROR, problem, facts
        warning = radio_facts.warning(radio, status) if status is not None else ""
        if warning:
            return hardware, diagnostics.WARN, warning, facts
        return hardware, diagnostics.OK, "connected", facts

    def check(self, port: BoardPort) -> None:
        """Log a problem once if it has lasted since the last check; a handshake does not last."""
        now_s = time.monotonic()
        if now_s - self._checked_s < EVENT_TIMEOUT_S:
            return
        self._checked_s = now_s
        before, self._problem = self._problem, port.problem
        if self._problem and self._problem == before != self._logged and not port.closed:
            self._logger.warning(f"{self._problem}; waiting for the board")
            self._logged = self._problem

    def handle(self, event: Event, port: BoardPort) -> None:
        if isinstance(event, Correction):
            self.corrections += 1
            self._on_correction(event)
            self.meter.add(self._now_ns() - event.stamp_ns)
        elif isinstance(event, BoardStatus):
            self.status = event
        elif isinstance(event, RadioStatus):
            self._radio_status = event
        elif isinstance(event, Radio):
            # A board repeats it at times.
            if event.settings != self._radio:
                self._logger.info(
                    f"the board's radio {format_id(event.settings.address)}: {radio_facts.told(event.settings)}"
                )
            self._radio = event.settings
        elif isinstance(event, RadioRefused):
            self._refused_radio = event.text
            self._logger.error(f"the radio's settings are not used: {event.text}")
        elif isinstance(event, Connected):
            self._refused_offsets = self._refused_radio = ""
            self._radio = self._radio_status = None
            self._logged = ""
            hello = event.hello
            self._logger.info(
                f"connected to board {format_id(hello.board_id)}, model {diagnostics.model_id(hello.model_id)}, "
                f"mode {hello.mode.name}"
            )
        elif isinstance(event, Disconnected):
            if not port.closed:
                self._logger.warning(f"the board is gone: {event.loss.value}; waiting for it")
        elif isinstance(event, VersionMismatch):
            self._logger.error(
                f"the board speaks version {event.version} of the protocol, this driver version "
                f"{PROTOCOL_VERSION}: update the older of the two"
            )
        elif isinstance(event, ModeChanged):
            self._logger.info(f"the board is in mode {event.mode.name}")
        elif isinstance(event, ModeRefused):
            self._logger.warning(
                f"the board stays in mode {event.mode.name} instead of {event.wanted.name}: has it a model?"
            )
        elif isinstance(event, OffsetsRefused):
            self._refused_offsets = event.text
            self._logger.error(
                f"the board's corrections are not published, as the offsets are not set: {event.text}"
            )
        elif isinstance(event, Log):
            # rclpy ties a severity to a line of code, hence two of them.
            if event.level >= LogLevel.WARNING:
                self._logger.warning(f"board: {event.text}")
            else:
                self._logger.info(f"board: {event.text}")
