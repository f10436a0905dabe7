"""The measurements of a field report, for every kind of radio."""

from __future__ import annotations

import contextlib
import logging
import math
import re
import statistics
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

from uwb_mitigation.commands.field.checks import Observation
from uwb_mitigation.errors import LinkError, ParameterError, UwbMitigationError
from uwb_mitigation.nodes.support.parameter_tables import DRIVER
from uwb_mitigation.radios import evb1000, lines, serial, spi, uci
from uwb_mitigation.radios.dw1000.port import ChipPort
from uwb_mitigation.radios.evb1000 import Evb1000Bus
from uwb_mitigation.radios.lines import LinePort
from uwb_mitigation.radios.port import PortAddress, RadioPort
from uwb_mitigation.radios.serial import BoardPort
from uwb_mitigation.radios.settings import DEFAULT_RADIO, PortMessage, RadioSettings
from uwb_mitigation.radios.spi import SpidevBus
from uwb_mitigation.radios.uci import UciPort
from uwb_mitigation.types.measurement import RangeMeasurement

if TYPE_CHECKING:
    from uwb_mitigation.radios.dw1000.bus import Bus

SOURCES: dict[str, tuple[str, Any]] = {
    "uci": ("board with UCI firmware", uci),
    "evb1000": ("EVB1000", evb1000),
    "spi": ("DW1000 on SPI", spi),
    "serial": ("board with the firmware of uwb_mitigation", serial),
    "lines": ("board that prints lines", lines),
    "pans": ("DWM1001 with PANS", lines),
}
"""Names of the kinds of radios, and the modules that open them."""

START_TIMEOUT_S = 30.0
UNPLUG_TIMEOUT_S = 60.0
REPORT_INTERVAL_S = 0.5
"""Interval at which the warnings of the driver are collected."""

# Registers of the DW1000: name, header of a read, octets (user manual, chapters 2.2 and 7).
_REGISTERS = (
    ("device id", b"\x00", 4),
    ("TX antenna delay", b"\x18", 2),
    ("RX antenna delay", b"\x6e\x84\x30", 2),  # file 0x2E, offset 0x1804
)
_DW1000_ID = 0xDECA0130
_ANTENNA_DELAY = "antenna delay (15.65 ps)"


def observe(
    source: str,
    ports: list[str],
    mapping: str,
    observation: Observation,
    capture: Path,
    unplug: Callable[[str], None] | None,
    on_progress: Callable[[float], None],
    on_warning: Callable[[str], None],
) -> None:
    """Range for the duration of the observation and fill it in; without ranges it ends after `START_TIMEOUT_S`.

    Args:
        source: one of `SOURCES`.
        ports: port of the tag, and of the anchor if it is at this computer.
        observation: has distance and duration.
        mapping: name or file, for lines; empty for pans: its own.
        capture: file for the raw bytes, for uci, lines and pans.
        unplug: asks the user to unplug and reconnect the first port; None = skip this test.
        on_progress: called with the completed fraction.
        on_warning: called with each warning of the driver.

    Raises:
        ParameterError: a port or mapping is invalid.
        LinkError: a port does not exist.
        MissingDependencyError: a library of the source is not installed.
    """
    if not 1 <= len(ports) <= (1 if source in ("serial", "lines", "pans") else 2):
        raise ParameterError(f"{len(ports)} ports", valid="the tag's, or the tag's and the anchor's")
    for port in ports:
        if source != "spi" and not lines.parse_address(port).find():
            raise LinkError("is not there", where=port, valid="connect the board")
    events: SimpleQueue[object] = SimpleQueue()
    # The default parameters of the driver.
    values = {row.name: row.default for row in DRIVER}
    values |= {"source": source, "port": ",".join(ports), "map": mapping, "capture": str(capture)}
    _, module = SOURCES[source]
    settings = module.read_settings(values.__getitem__)
    with ExitStack() as stack:
        radios: Sequence[RadioPort] = module.open(settings, events.put)
        for radio in radios:
            stack.enter_context(closing(radio))
        collector = _Collector(radios, events, observation, on_warning)
        if collector.until(lambda: bool(observation.ranges), START_TIMEOUT_S):
            observation.ranges.clear()
            observation.warnings.clear()
            before = Counter(radios[0].monitor.totals)
            began_s = time.monotonic()
            while (elapsed_s := time.monotonic() - began_s) < observation.seconds:
                collector.collect()
                on_progress(elapsed_s / observation.seconds)
            observation.failures = dict(radios[0].monitor.totals - before)
        else:
            observation.failures = dict(radios[0].monitor.totals)
        _describe(radios, observation)
        measured, warnings = list(observation.ranges), list(observation.warnings)
        if unplug is not None and measured:
            unplug(ports[0])
            _test_recovery(radios[0], collector, observation)
        observation.ranges[:], observation.warnings[:] = measured, warnings
    if source in ("evb1000", "spi"):
        _read_registers(source, ports[0], observation)


class _Collector:
    """Collects the events and warnings of radios; only the first one measures."""

    def __init__(
        self,
        radios: Sequence[RadioPort],
        events: SimpleQueue[object],
        observation: Observation,
        on_warning: Callable[[str], None],
    ) -> None:
        self._radios, self._events = radios, events
        self._observation, self._on_warning = observation, on_warning
        self._report_due_s = time.monotonic() + REPORT_INTERVAL_S

    def collect(self) -> None:
        """Wait for the next event, for a short time."""
        with contextlib.suppress(Empty):
            event = self._events.get(timeout=0.1)
            if isinstance(event, RangeMeasurement):
                self._observation.ranges.append(event)
            elif isinstance(event, PortMessage) and event.level >= logging.WARNING:
                self._add_warning(event.text)
        if time.monotonic() >= self._report_due_s:
            self._report_due_s = time.monotonic() + REPORT_INTERVAL_S
            for radio in self._radios if self._observation.ranges else ():
                if warning := radio.report().warning:
                    self._add_warning(warning)

    def until(self, is_complete: Callable[[], bool], timeout_s: float) -> bool:
        """Collect until a condition is true or the timeout; return whether it is."""
        end_s = time.monotonic() + timeout_s
        while not is_complete() and time.monotonic() < end_s:
            self.collect()
        return is_complete()

    def _add_warning(self, text: str) -> None:
        # A warning may contain a duration and counts, which change.
        if _kind(text) not in map(_kind, self._observation.warnings):
            self._observation.warnings.append(text)
            self._on_warning(text)


def _kind(warning: str) -> str:
    return re.sub(r"[\d.]+", "", warning)


def _values(settings: RadioSettings) -> dict[str, object]:
    return {"channel": settings.channel, "PRF (MHz)": settings.prf_mhz, "CIR samples": settings.window}


def _describe(radios: Sequence[RadioPort], o: Observation) -> None:
    """Copy the state of the radios to the observation."""
    tag = radios[0]
    report = tag.report()
    o.problem, o.counters, o.remedies = report.problem, report.values, tag.monitor.remedies
    if isinstance(tag, UciPort):
        session, settings = tag.session, tag.session.settings
        counts = session.totals()
        o.expected_ids = (settings.address, settings.peers[0])
        o.identity = {"device info": session.device_info.hex() or "not answered"}
        o.written = {"CIR taps": settings.window, "CIR taps before the first path": 5}
        if session.window is not None:
            o.read = dict(zip(o.written, session.window, strict=True))
        o.clock_offset_ppm = statistics.median(session.assembly.clock_offsets_ppm or [math.nan])
        o.damaged, o.foreign = counts["damaged"], counts["unknown_session"]
    elif isinstance(tag, LinePort):
        # Such boards have no CIRs unless their mapping has them, and other lines are not damaged.
        o.has_cirs = tag.session.mapping.cir is not None
        o.identity = {"mapping": tag.session.mapping.name}
    elif isinstance(tag, BoardPort):
        if (hello := tag.session.hello) is not None:
            o.identity = {
                "firmware": f"{hello.firmware_name} {hello.firmware_version}",
                "model": f"{hello.model_id:08x}",
            }
        o.damaged = tag.session.totals()["corrupt"]
    elif isinstance(tag, ChipPort):
        o.identity = {"bus": report.device.partition(" at ")[0]}
        o.written = _values(DEFAULT_RADIO)
        o.temperature_c, o.voltage = tag.status.temperature_c, tag.status.voltage
        if tag.settings is not None:
            o.read |= _values(tag.settings)
            o.written[_ANTENNA_DELAY] = tag.settings.antenna_delay
            anchor = radios[1] if len(radios) > 1 else None
            if isinstance(anchor, ChipPort) and anchor.settings is not None:
                o.expected_ids = (tag.settings.address, anchor.settings.address)


def _test_recovery(radio: RadioPort, collector: _Collector, o: Observation) -> None:
    """Measure the time from the reopening of the port to the next range."""
    openings = radio.openings
    is_unplugged = collector.until(lambda: not radio.device or radio.openings > openings, UNPLUG_TIMEOUT_S)
    o.unplugged = is_unplugged
    if not (is_unplugged and collector.until(lambda: radio.openings > openings, UNPLUG_TIMEOUT_S)):
        return
    began_s, count = time.monotonic(), len(o.ranges)
    if collector.until(lambda: len(o.ranges) > count, START_TIMEOUT_S):
        o.recovery_s = time.monotonic() - began_s


def _read_registers(source: str, port: str, o: Observation) -> None:
    """Read registers of a DW1000 that keeps its configuration after the driver was closed."""
    values: dict[str, int] = {}
    with contextlib.suppress(UwbMitigationError):
        bus: Bus = SpidevBus(port) if source == "spi" else Evb1000Bus(PortAddress.parse(port))
        with closing(bus):
            bus.speed(False)
            for name, header, octets in _REGISTERS:
                values[name] = int.from_bytes(bus.transfer(header, None, octets), "little")
    o.written |= {"device id": f"0x{_DW1000_ID:08x}"}
    if "RX antenna delay" in values:
        o.read |= {
            "device id": f"0x{values['device id']:08x}",
            _ANTENNA_DELAY: values["TX antenna delay"] + values["RX antenna delay"],
        }
