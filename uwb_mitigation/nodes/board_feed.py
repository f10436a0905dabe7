"""Hands what a board sends to the driver's publishers, from a thread of its own, and keeps its diagnosis.

The port and the protocol are `link`'s; topics and messages are the driver's.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
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
from uwb_mitigation.link.layout import PROTOCOL_VERSION, LogLevel
from uwb_mitigation.link.messages import BoardStatus, Correction, Log
from uwb_mitigation.link.port import BoardPort
from uwb_mitigation.link.radio import Radio, RadioSettings, RadioStatus
from uwb_mitigation.measurement import RangeMeasurement
from uwb_mitigation.nodes import diagnostics, radio_facts
from uwb_mitigation.offsets import Offsets

PATIENCE_S = 0.5


class BoardFeed:
    """Calls `on_range` and `on_correction` for what arrives, and logs what happens to the board.

    Args:
        port: closed by `stop`.
        now_ns: the clock that stamps are on.
        logger: with `info`, `warning`, `error`, as rclpy's.

    Attributes:
        ranges, corrections: how many were handed on.
        status: the board's latest STATUS; None before the first.
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
        self.port = port
        self.ranges = 0
        self.corrections = 0
        self.meter = diagnostics.Meter(now_ns)
        self.status: BoardStatus | None = None
        self._problem = self._told = ""
        self._on_range = on_range
        self._on_correction = on_correction
        self._now_ns = now_ns
        self._logger = logger
        self._refused_offsets = self._refused_radio = ""
        self._radio: RadioSettings | None = None
        self._radio_status: RadioStatus | None = None
        self._thread = threading.Thread(target=self._run, name="board feed", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Close the port and wait for the thread; may be called twice."""
        self.port.close()
        if self._thread.is_alive():
            self._thread.join()

    def describe(self) -> tuple[str, bytes, str, dict[str, object]]:
        """Hardware id, level, message and facts for the diagnostics."""
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
                "firmware": f"{report.hello.firmware_name} {'.'.join(map(str, report.hello.firmware_version))}",
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

    def set_offsets(self, offsets: Offsets) -> None:
        """See `BoardSession.set_offsets`."""
        self._refused_offsets = ""
        self.port.set_offsets(offsets)

    def set_radio(self, settings: RadioSettings) -> None:
        """See `BoardSession.set_radio`."""
        self._refused_radio = ""
        self.port.set_radio(settings)

    def _run(self) -> None:
        looked_s = 0.0
        while not self.port.closed:
            event = self.port.get(PATIENCE_S)
            if event is not None:
                self._handle(event)
            if (now_s := time.monotonic()) - looked_s >= PATIENCE_S:
                looked_s = now_s
                self._look()

    def _look(self) -> None:
        """Tell once what keeps the board away, if it has lasted since the last look: a handshake does not."""
        before, self._problem = self._problem, self.port.problem
        if self._problem and self._problem == before != self._told and not self.port.closed:
            self._logger.warning(f"{self._problem}; waiting for the board")
            self._told = self._problem

    def _handle(self, event: Event) -> None:
        if isinstance(event, RangeMeasurement):
            self.ranges += 1
            self._on_range(event)
            self.meter.add(self._now_ns() - event.stamp_ns)
        elif isinstance(event, Correction):
            self.corrections += 1
            self._on_correction(event)
            self.meter.add(self._now_ns() - event.stamp_ns)
        elif isinstance(event, BoardStatus):
            self.status = event
        elif isinstance(event, RadioStatus):
            self._radio_status = event
        elif isinstance(event, Radio):
            # A board tells it anew at times.
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
            self._told = ""
            hello = event.hello
            self._logger.info(
                f"connected to board {format_id(hello.board_id)}, model {diagnostics.model_id(hello.model_id)}, "
                f"mode {hello.mode.name}"
            )
        elif isinstance(event, Disconnected):
            if not self.port.closed:
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
