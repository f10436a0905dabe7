"""Publishes the ranges of radios at this computer, and keeps their diagnosis."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

from uwb_mitigation.errors import ParameterError, format_id, parse_id
from uwb_mitigation.link.layout import Role
from uwb_mitigation.link.messages import Radio
from uwb_mitigation.link.radio import RadioSettings
from uwb_mitigation.measurement import RangeMeasurement
from uwb_mitigation.nodes import diagnostics, radio_facts
from uwb_mitigation.nodes.diagnostics import Description
from uwb_mitigation.nodes.feed import LiveFeed, Value
from uwb_mitigation.offsets import Offsets
from uwb_mitigation.radio.bus import opener
from uwb_mitigation.radio.port import RadioEvent, RadioLost, RadioPort

RADIOS = ("evb1000", "spi")
"""Sources that are radios at this computer."""

PREFIX = "radio."
"""Of the parameters that are a radio's."""


def settings_of(value: Callable[[str], Any]) -> RadioSettings:
    """What the parameters `radio.*` ask of a radio; `value(name)` gives a parameter's value.

    Raises:
        ParameterError: no radio has such settings; names the parameter.
    """

    def of(name: str) -> Any:
        return value(PREFIX + name)

    settings = RadioSettings(
        role=Role[of("role").upper()],
        address=_address(str(of("address")), PREFIX + "address") if of("address") != "" else 0,
        pan=of("pan"),
        channel=of("channel"),
        prf_mhz=int(of("prf")),
        preamble=of("preamble"),
        preamble_code=of("preamble_code"),
        rate_kbps=of("data_rate"),
        decawave_sfd=of("decawave_sfd"),
        tx_power=of("tx_power"),
        antenna_delay=of("antenna_delay"),
        window=of("window"),
        anchors=tuple(
            _address(part.strip(), PREFIX + "anchors")
            for part in str(of("anchors")).split(",")
            if part.strip()
        ),
        interval_us=round(1e6 / of("rate")) if of("rate") else 0,
        report=of("report"),
        bias_correction=of("bias_correction"),
    )
    try:
        settings.check()
    except ParameterError as error:
        raise ParameterError(f"parameters {PREFIX}*: {error.what}", valid=error.valid) from error
    return settings


def open_radios(value: Callable[[str], Any], now_ns: Callable[[], int]) -> list[RadioPort]:
    """The radios that `source`, `port` and `radio.*` name, ranging. The first takes the role asked for, the others are anchors.

    Raises:
        ParameterError: a port or a setting is none.
        MissingDependencyError: there is no C compiler.
    """
    settings = settings_of(value)
    places = [part.strip() for part in value("port").split(",") if part.strip()]
    if not places:
        valid = (
            "/dev/spidevBUS.SELECT"
            if value("source") == "spi"
            else "/dev/ttyACM0 or usb:0483:5740, or several with commas"
        )
        raise ParameterError("parameter port is empty", valid=valid)
    if settings.address and len(places) > 1:
        raise ParameterError(
            f"parameter {PREFIX}address with {len(places)} ports", valid="empty: each has its chip's own"
        )
    openers = [opener(value("source"), place, value(PREFIX + "reset")) for place in places]
    ports: list[RadioPort] = []
    try:
        for number, open_bus in enumerate(openers):
            wanted = settings if number == 0 else replace(settings, role=Role.ANCHOR, anchors=())
            ports.append(RadioPort(open_bus, wanted, stamp_clock=now_ns))
    except Exception:
        for port in ports:
            port.close()
        raise
    return ports


class RadioFeed(LiveFeed):
    """Publishes what the radios measure, and logs what happens to them.

    Args:
        ports: of one or several radios, the tag first; closed by `stop`.
        on_range, now_ns, logger: see `LiveFeed`.
    """

    def __init__(
        self,
        ports: Sequence[RadioPort],
        *,
        on_range: Callable[[RangeMeasurement], None],
        now_ns: Callable[[], int],
        logger: Any,
    ) -> None:
        super().__init__(ports, on_range=on_range, now_ns=now_ns, logger=logger)
        self._radios = list(ports)

    def apply(self, changed: Collection[str], value: Value, offsets: Offsets) -> None:
        """Use other radio settings from the next exchange on; the ports after the first stay anchors."""
        if any(name.startswith(PREFIX) for name in changed):
            settings = settings_of(value)
            for number, port in enumerate(self._radios):
                port.set_radio(settings if number == 0 else replace(settings, role=Role.ANCHOR, anchors=()))

    def describe(self) -> Description:
        reports = [port.report() for port in self._radios]
        first = reports[0]
        facts: dict[str, object] = {"ranges published": self.ranges}
        facts |= self.meter.facts()
        for number, report in enumerate(reports):
            prefix = f"radio {number}: " if len(reports) > 1 else ""
            facts[f"{prefix}port"] = report.name or "none"
            facts |= radio_facts.facts(report.settings, report.status, prefix)
        facts |= radio_facts.anchors(first.status)
        hardware = "no radio" if first.settings is None else f"radio {format_id(first.settings.address)}"
        problems = [report.problem for report in reports if report.problem]
        if problems:
            return hardware, diagnostics.ERROR, "; ".join(problems), facts
        warnings = [
            text for report in reports if (text := radio_facts.warning(report.settings, report.status))
        ]
        if warnings:
            return hardware, diagnostics.WARN, warnings[0], facts
        tag = first.settings is not None and first.settings.role is Role.TAG
        return hardware, diagnostics.OK, "ranging" if tag else "answering", facts

    def handle(self, event: RadioEvent, port: RadioPort) -> None:
        if isinstance(event, Radio):
            settings = event.settings
            self._logger.info(
                f"radio {format_id(settings.address)} at {port.report().name}: {radio_facts.told(settings)}"
            )
        elif isinstance(event, RadioLost) and not port.closed:
            self._logger.warning(f"{event.text}; waiting for the radio")


def _address(text: str, name: str) -> int:
    """Return an address; raise ParameterError if the text is none."""
    with contextlib.suppress(ValueError):
        if 0 < (address := parse_id(text)) < 2**64 - 1:
            return address
    raise ParameterError(
        f"parameter {name} = {text!r:.40}",
        valid="a number below 65536, or 0x and up to 16 hexadecimal digits in quotes",
    )
