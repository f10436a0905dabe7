"""Reads the parameters of the driver that several sources share: ports, files and the settings `radio.*`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

from uwb_mitigation.errors import ParameterError, parse_id
from uwb_mitigation.radios.settings import DEFAULT_RADIO, RadioSettings, Role

ValueReader = Callable[[str], Any]
"""Returns the value of a parameter of the driver."""


PREFIX = "radio."
"""Prefix of the parameters of radios."""


def read_ports(value: ValueReader) -> list[str]:
    """Return the ports of the parameter `port`.

    Raises:
        ParameterError: it is empty.
    """
    ports = [text.strip() for text in value("port").split(",") if text.strip()]
    if not ports:
        valid = "/dev/ttyACM0 or usb:VENDOR:PRODUCT[:SERIAL], or several with commas"
        if value("source") == "spi":
            valid = "/dev/spidevBUS.SELECT, or several with commas"
        raise ParameterError("parameter port is empty", valid=valid)
    return ports


def read_capture(value: ValueReader) -> Path | None:
    """Return the parameter `capture`; None = none."""
    path = value("capture")
    return Path(path).expanduser() if path else None


def read_baud(value: ValueReader, default: int) -> int:
    """Return the parameter `baud`, or a default for 0; raise ParameterError if it is too small."""
    if 0 < (baud := int(value("baud"))) < 1200:
        raise ParameterError(f"parameter baud = {baud}", valid="0, or 1200 to 12000000")
    return baud or default


def read_addresses(value: ValueReader, name: str, highest: int = 2**64 - 2) -> tuple[int, ...]:
    """Return the addresses of the parameter `radio.NAME`: a number, a text with commas, or an array.

    Raises:
        ParameterError: one of them is not an address.
    """
    content = value(PREFIX + name)
    texts = content.strip(" []").split(",") if isinstance(content, str) else content
    texts = texts if isinstance(texts, Iterable) else [texts]
    addresses = []
    for text in filter(None, (str(item).strip() for item in texts)):
        address = 0
        with contextlib.suppress(ValueError):
            address = parse_id(text)
        if not 0 < address <= highest:
            what, valid = f"parameter {PREFIX}{name} = {text!r:.40}", "1 to 65534"
            if highest > 0xFFFE:
                valid = "a number below 65536, or 0x and up to 16 hexadecimal digits"
            raise ParameterError(what, valid=f"{valid}; several with commas")
        addresses.append(address)
    return tuple(addresses)


def read_radio(value: ValueReader) -> RadioSettings:
    """Return the settings of a DW1000 from the parameters `radio.*`.

    Raises:
        ParameterError: a setting is invalid; names the parameter.
    """
    names = {"prf_mhz": "prf", "rate_kbps": "data_rate"}
    computed = ("role", "address", "anchors", "channel", "interval_us", "reply_us", "timeout_us")
    settings = {
        row.name: value(PREFIX + names.get(row.name, row.name))
        for row in fields(RadioSettings)
        if row.name not in computed
    }
    rate_hz = value(PREFIX + "rate")
    radio = RadioSettings(
        role=Role[value(PREFIX + "role").upper()],
        address=(*read_addresses(value, "address"), 0)[0],
        anchors=read_addresses(value, "anchors"),
        channel=value(PREFIX + "channel") or DEFAULT_RADIO.channel,
        interval_us=round(1e6 / rate_hz) if rate_hz else 0,
        **settings,
    )
    check_parameters(radio)
    return radio


def check_parameters(settings: Any) -> None:
    """Check settings that were read from the parameters `radio.*`; raise ParameterError, with their name."""
    try:
        settings.check()
    except ParameterError as error:
        raise ParameterError(f"parameters {PREFIX}*: {error.what}", valid=error.valid) from error
