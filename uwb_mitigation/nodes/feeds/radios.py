"""Feeds of the driver: their interface, and the feed of all radios, whose ports are in `radios`."""

from __future__ import annotations

import importlib
import logging
import math
import threading
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, Protocol

from uwb_mitigation.nodes.feeds.publishing import RangePublisher
from uwb_mitigation.nodes.support import diagnostics
from uwb_mitigation.nodes.support.diagnostics import Description
from uwb_mitigation.radios.parameters import ValueReader
from uwb_mitigation.radios.port import OnEvent, RadioPort
from uwb_mitigation.radios.settings import PortMessage
from uwb_mitigation.radios.wire.messages import Correction
from uwb_mitigation.types.measurement import RangeMeasurement
from uwb_mitigation.types.source import Source

RADIO_SOURCES = ("serial", "evb1000", "spi", "uci", "lines", "pans")
"""Sources that are modules of `radios`; pans is lines with the mapping of a board."""

CAPTURED_SOURCES = ("uci", "lines", "pans")
"""Sources that replay a capture, if there is a path."""

NO_RANGE_S = 5.0
"""After this time without a range, the reason is also in the log: who starts a driver for the first time looks there."""


class SourceHandle(Protocol):
    """A source that is playing or connected; `stop` ends it and may be called twice."""

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def describe(self) -> Description: ...

    def apply(self, changed: Collection[str], value: ValueReader) -> None:
        """Use new values of the parameters `changed`."""


class RadioSource(Protocol):
    """The interface of the modules in `RADIO_SOURCES`."""

    def read_settings(self, value: ValueReader) -> Sequence[Any]:
        """Return the settings of each radio; raise ParameterError for an invalid parameter."""

    def open(
        self, settings: Sequence[Any], on_event: OnEvent, stamp_clock: Callable[[], int]
    ) -> Sequence[RadioPort]:
        """Open the radios."""

    def open_capture(self, path: Path, value: ValueReader) -> Source:
        """Open a capture; only for `CAPTURED_SOURCES`."""


def radio_source(name: str) -> RadioSource:
    """Return the module of a source; it is imported here, because each needs other dependencies."""
    module = "lines" if name == "pans" else name
    return importlib.import_module(f"uwb_mitigation.radios.{module}")


class RadioFeed:
    """Publishes the ranges and corrections of radios, logs their messages, and describes their state.

    Args:
        source: kind of the radios.
        value: returns a parameter's value.
        output: called by one thread at a time.
        now_ns: the clock of the stamps.
        logger: with `info`, `warning` and `error`, as rclpy's.

    Raises:
        UwbMitigationError: a parameter is invalid, or a dependency is missing.
    """

    def __init__(
        self,
        source: RadioSource,
        value: ValueReader,
        output: RangePublisher,
        now_ns: Callable[[], int],
        logger: Any,
    ) -> None:
        self._source, self._output, self._now_ns, self._logger = source, output, now_ns, logger
        self._ranges = 0
        self._meter = diagnostics.RateMonitor(now_ns)
        self._publishing = threading.Lock()
        self._settings = source.read_settings(value)
        self._ports: Sequence[RadioPort] = ()
        self._silent_until_s = math.inf

    def start(self) -> None:
        """Open the radios."""
        self._ports = self._source.open(self._settings, self._on_event, self._now_ns)
        self._silent_until_s = time.monotonic() + NO_RANGE_S

    def stop(self) -> None:
        """Close the radios, all at the same time."""
        for port in self._ports:
            port.request_close()
        for port in self._ports:
            port.close()

    def apply(self, changed: Collection[str], value: ValueReader) -> None:
        """Pass changed settings to the radios."""
        for port, settings in zip(self._ports, self._source.read_settings(value), strict=False):
            port.apply(settings)

    def describe(self) -> Description:
        """Return the diagnostics: values of all radios, and the most important problem or warning."""
        reports = [port.report() for port in self._ports]
        values: dict[str, object] = {"ranges published": self._ranges} | self._meter.entries()
        for number, report in enumerate(reports):
            prefix = f"radio {number}: " if len(reports) > 1 else ""
            values[f"{prefix}port"] = report.device or "none"
            values |= {f"{prefix}{name}": value for name, value in report.values.items()}
        problem = "; ".join(report.problem for report in reports if report.problem)
        warning = next((report.warning for report in reports if report.warning), "")
        level = diagnostics.ERROR if problem else diagnostics.WARN if warning else diagnostics.OK
        if time.monotonic() > self._silent_until_s:
            self._silent_until_s = math.inf
            # The ports have logged problems.
            if warning and not problem and not self._ranges:
                self._logger.warning(f"no range in {NO_RANGE_S:.0f} s: {warning}")
        hardware, activity = (reports[0].hardware, reports[0].activity) if reports else ("no radio", "closed")
        return hardware, level, problem or warning or activity, values

    def _on_event(self, event: object) -> None:
        match event:
            case RangeMeasurement() | Correction():
                with self._publishing:
                    if isinstance(event, Correction):
                        self._output.publish_correction(event)
                    else:
                        self._ranges += 1
                        self._output.publish_range(event)
                    self._meter.add(self._now_ns() - event.stamp_ns)
            case PortMessage(level=level, text=text):
                # rclpy allows only one severity for each line of code.
                if level >= logging.ERROR:
                    self._logger.error(text)
                elif level >= logging.WARNING:
                    self._logger.warning(text)
                else:
                    self._logger.info(text)
