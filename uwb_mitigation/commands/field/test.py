"""The measurements of a field report, for every kind of radio."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from uwb_mitigation.commands.field.checks import Observation
from uwb_mitigation.errors import ParameterError, UwbMitigationError
from uwb_mitigation.radios.dw1000.bus import bus_opener
from uwb_mitigation.radios.dw1000.driver import RadioDriver
from uwb_mitigation.radios.fira.capture import CaptureWriter
from uwb_mitigation.radios.fira.session import UciSettings
from uwb_mitigation.radios.port import PortAddress, PortThread
from uwb_mitigation.radios.serial import BoardDriver
from uwb_mitigation.radios.settings import RadioSettings, RadioStatus, Role
from uwb_mitigation.radios.uci import UciDriver
from uwb_mitigation.radios.wire.layout import Mode
from uwb_mitigation.radios.wire.messages import RadioConfigured
from uwb_mitigation.types.measurement import RangeMeasurement

SOURCES = {
    "uci": "board with UCI firmware",
    "evb1000": "EVB1000",
    "spi": "DW1000 on SPI",
    "serial": "board with the firmware of uwb_mitigation",
}
"""Names of the kinds of radios."""

START_TIMEOUT_S = 30.0
UNPLUG_TIMEOUT_S = 60.0

_WINDOW = 157
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
    observation: Observation,
    capture: Path,
    unplug: Callable[[str], None] | None,
    on_progress: Callable[[float], None],
) -> None:
    """Range for the duration of the observation and fill it in.

    Args:
        source: one of `SOURCES`.
        ports: port of the tag, and of the anchor if it is at this computer.
        observation: has distance and duration.
        capture: file for the raw bytes of UCI boards.
        unplug: asks the user to unplug and reconnect the first port; None = skip this test.
        on_progress: called with the completed fraction.

    Raises:
        ParameterError: a port is invalid.
        MissingDependencyError: a library of the source is not installed.
    """
    with ExitStack() as stack:
        drivers = _open(source, ports, capture, stack)
        collect = _Collector(drivers[0], observation)
        collect.until(lambda: bool(observation.ranges), START_TIMEOUT_S)
        observation.ranges.clear()
        began = time.monotonic()
        while (elapsed := time.monotonic() - began) < observation.seconds:
            collect.once()
            on_progress(elapsed / observation.seconds)
        _describe(source, drivers, observation)
        measured = list(observation.ranges)
        if unplug is not None:
            unplug(ports[0])
            observation.recovery_s = _recovery_s(drivers[0], collect)
        observation.ranges[:] = measured
    if source in ("evb1000", "spi"):
        _read_registers(source, ports[0], observation)


class _Collector:
    """Collects the events of a driver."""

    def __init__(self, driver: PortThread[Any], observation: Observation) -> None:
        self._driver = driver
        self._observation = observation

    def once(self) -> None:
        event = self._driver.get(0.1)
        if isinstance(event, RangeMeasurement):
            self._observation.ranges.append(event)
        elif isinstance(event, RadioStatus):
            self._observation.temperature_c, self._observation.voltage = event.temperature_c, event.voltage
        elif isinstance(event, RadioConfigured):
            self._observation.read |= _values(event.settings)

    def until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        end = time.monotonic() + timeout_s
        while not done() and time.monotonic() < end:
            self.once()
        return done()


def _open(source: str, ports: list[str], capture: Path, stack: ExitStack) -> list[Any]:
    if source not in SOURCES:
        raise ParameterError(f"source {source!r}", valid=", ".join(SOURCES))
    if not 1 <= len(ports) <= (1 if source == "serial" else 2):
        raise ParameterError(f"{len(ports)} ports", valid="the tag's, or the tag's and the anchor's")
    if source == "uci":
        writer = CaptureWriter(capture, 64 << 20)
        stack.callback(writer.close)
        roles = (UciSettings(identify=True), UciSettings(Role.ANCHOR, 2, (1,)))
        return [
            stack.enter_context(
                closing(UciDriver(PortAddress.parse(port), settings, capture=writer, number=number))
            )
            for number, (port, settings) in enumerate(zip(ports, roles, strict=False))
        ]
    if source == "serial":
        board = BoardDriver(PortAddress.parse(ports[0]), mode=Mode.HOST)
        return [stack.enter_context(closing(board))]
    settings = RadioSettings(window=_WINDOW)
    of_roles = (settings, replace(settings, role=Role.ANCHOR))
    return [
        stack.enter_context(closing(RadioDriver(bus_opener(source, port), role)))
        for port, role in zip(ports, of_roles, strict=False)
    ]


def _values(settings: RadioSettings) -> dict[str, object]:
    return {"channel": settings.channel, "PRF (MHz)": settings.prf_mhz, "CIR samples": settings.window}


def _describe(source: str, drivers: list[Any], o: Observation) -> None:
    """Copy the state of the drivers to the observation."""
    report = drivers[0].report()
    o.problem = report.problem
    if source == "uci":
        settings = report.settings
        o.expected_ids = (settings.address, settings.peers[0])
        o.identity = {
            "device info": report.device_info.hex() or "not answered",
            "rejected parameters": ", ".join(f"0x{tag:02x}" for tag in sorted(report.rejected)) or "none",
        }
        o.written = {"CIR taps": settings.window, "CIR taps before the first path": 5}
        if report.window is not None:
            o.read = dict(zip(o.written, report.window, strict=True))
        o.clock_offset_ppm = report.clock_offset_ppm
        o.damaged, o.foreign = report.counts["damaged"], report.counts["unknown_session"]
    elif source == "serial":
        if (hello := report.hello) is not None:
            o.identity = {
                "firmware": f"{hello.firmware_name} {hello.firmware_version}",
                "model": f"{hello.model_id:08x}",
            }
        o.damaged = report.counts.get("corrupt", 0)
    else:
        o.identity = {"firmware": report.name.partition(" at ")[0]} if source == "evb1000" else {}
        o.written = _values(RadioSettings(window=_WINDOW))
        o.temperature_c, o.voltage = report.status.temperature_c, report.status.voltage
        if report.settings is not None:
            o.written[_ANTENNA_DELAY] = report.settings.antenna_delay
            other = drivers[1].report().settings if len(drivers) > 1 else None
            o.expected_ids = None if other is None else (report.settings.address, other.address)


def _recovery_s(driver: Any, collect: _Collector) -> float:
    """Return the time from the reopening of the port to the next range; infinite if there is none."""
    openings = driver.openings
    if not collect.until(lambda: bool(driver.openings > openings), UNPLUG_TIMEOUT_S):
        return math.inf
    began, count = time.monotonic(), len(collect._observation.ranges)
    if not collect.until(lambda: len(collect._observation.ranges) > count, START_TIMEOUT_S):
        return math.inf
    return time.monotonic() - began


def _read_registers(source: str, port: str, o: Observation) -> None:
    """Read registers of a DW1000 that keeps its configuration after the driver was closed."""
    values: dict[str, int] = {}
    with contextlib.suppress(UwbMitigationError), closing(bus_opener(source, port)()) as bus:
        bus.speed(False)
        for name, header, octets in _REGISTERS:
            values[name] = int.from_bytes(bus.transfer(header, None, octets), "little")
    o.written |= {"device id": f"0x{_DW1000_ID:08x}"}
    if "RX antenna delay" in values:
        o.read |= {
            "device id": f"0x{values['device id']:08x}",
            _ANTENNA_DELAY: values["TX antenna delay"] + values["RX antenna delay"],
        }
