"""Ports and settings of boards: addresses, ports that are absent or in use, settings that are refused."""

import os
import subprocess
import sys
from contextlib import closing
from queue import SimpleQueue
from types import SimpleNamespace

import pytest
from port_events import TIMEOUT_S, PortEvents, driver_values, terminal, wait_until

from uwb_mitigation.errors import LinkError, ParameterError
from uwb_mitigation.radios import lines, serial, uci
from uwb_mitigation.radios.evb1000 import Evb1000Bus
from uwb_mitigation.radios.port import PortAddress
from uwb_mitigation.radios.serial import SerialSettings


def test_absent_port_is_logged_with_the_second_attempt(monkeypatch: pytest.MonkeyPatch):
    attempts: list[PortAddress] = []
    monkeypatch.setattr(PortAddress, "find", lambda address: attempts.append(address))
    counts: SimpleQueue[int] = SimpleQueue()
    (port,) = serial.open([SerialSettings(PortAddress("/dev/absent"))], lambda _: counts.put(len(attempts)))
    with closing(port):
        assert counts.get(timeout=TIMEOUT_S) == 2


@pytest.mark.parametrize("exclusive", [True, False])
def test_port_in_use_is_reported_with_the_program(exclusive: bool):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    program = "import serial; port = serial.Serial({!r}, exclusive={}); print(1, flush=True); input()"
    with terminal() as name:
        with subprocess.Popen([sys.executable, "-c", program.format(name, exclusive)], **pipes) as other:
            other.stdout.readline()
            with PortEvents(serial, SerialSettings(PortAddress(name))) as events:
                text = "in use by" if exclusive else "also open in"
                wait_until(lambda: text in events.port.problem)
                assert f"(process {other.pid})" in events.port.problem
                assert f"(process {os.getpid()})" not in events.port.problem
            if exclusive:
                with pytest.raises(LinkError, match=rf"in use by .*\(process {other.pid}\)"):
                    Evb1000Bus(PortAddress(name))
            other.stdin.close()
        with closing(PortAddress(name).open()) as port:
            assert not os.get_blocking(port.fileno()), "a board that does not read must not stop the driver"


@pytest.mark.parametrize(
    ("text", "device"),
    [("usb:2341:805a", "ttyACM0"), ("usb:2341:805A:B:1", "ttyACM1"), ("usb:2341:805a:C", None)],
)
def test_usb_device_is_found_by_its_ids_and_serial_number(monkeypatch, text: str, device: str | None):
    devices = (("ttyS0", None, 1, None), ("ttyS1", 0x2341, 1, "A"), ("ttyACM0", 0x2341, 0x805A, "A"))
    devices += (("ttyACM1", 0x2341, 0x805A, "B:1"),)
    names = ("device", "vid", "pid", "serial_number")
    ports = [SimpleNamespace(**dict(zip(names, values, strict=True))) for values in devices]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)

    address = PortAddress.parse(text)
    assert address.find() == device
    assert PortAddress.parse(str(address)) == address


@pytest.mark.parametrize(
    "error", [OSError("sysfs"), TypeError("int() argument"), ValueError("invalid literal")]
)
def test_usb_device_unplugged_during_listing_is_awaited(monkeypatch, error: Exception):
    def comports() -> list[object]:
        raise error

    monkeypatch.setattr("serial.tools.list_ports.comports", comports)

    with pytest.raises(LinkError):
        PortAddress.parse("usb:2341:805a").open()


@pytest.mark.parametrize(
    ("source", "changes", "message"),
    [
        ("serial", {"port": ""}, "no port is given"),
        ("serial", {"port": "COM1"}, "usb:VENDOR:PRODUCT"),
        ("serial", {"board_model": "xyz"}, "eight hexadecimal digits"),
        ("serial", {"baud": 3}, "baud"),
        ("serial", {"radio__channel": 6}, "channel"),
        ("serial", {"radio__prf": 32}, "prf"),
        ("serial", {"radio__preamble": 100}, "preamble"),
        ("serial", {"radio__data_rate": 111}, "rate"),
        ("serial", {"radio__anchors": "12,xyz"}, "radio.anchors"),
        *(
            ("serial", {"radio__address": text}, "radio.address")
            for text in ("0", "12e4", "1122334455667788")
        ),
        ("serial", {"radio__preamble_code": 3}, "preamble_code"),
        ("lines", {}, "parameter map is empty"),
        ("lines", {"port": "", "map": "string_at"}, "parameter port is empty"),
        ("lines", {"port": "udp:x", "map": "string_at"}, "udp:ADDRESS:PORT"),
        ("lines", {"port": "udp:70000", "map": "string_at"}, "udp:ADDRESS:PORT"),
        ("lines", {"map": "ewine"}, "is for recordings or topics"),
        ("lines", {"map": "string_at", "baud": 3}, "parameter baud = 3"),
        ("lines", {"map": "string_aT"}, "did you mean 'string_at'"),
        ("uci", {"radio__channel": 2}, r"radio\..*channel"),
        ("uci", {"radio__address": "0x12345"}, r"radio\.address"),
        ("uci", {"radio__anchors": "x"}, r"radio\.anchors"),
        ("uci", {"radio__window": 1016}, r"radio\..*window"),
        ("uci", {"radio__address": 2, "radio__anchors": "2"}, r"radio\..*peers"),
        ("uci", {"radio__preamble_code": 3}, r"radio\..*preamble_code"),
        ("uci", {"radio__rate": 200.0}, r"radio\..*interval_ms"),
        ("uci", {"radio__role": "anchor", "port": "/dev/a,/dev/b"}, r"radio\.role"),
    ],
)
def test_settings_that_no_board_can_have_are_refused(source: str, changes: dict[str, object], message: str):
    values = driver_values(**{"source": source, "port": "/dev/a"} | changes)
    with pytest.raises(ParameterError, match=message):
        {"serial": serial, "lines": lines, "uci": uci}[source].read_settings(values)
