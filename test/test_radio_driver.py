"""The node `driver` with local radios: emulated EVB1000s with USB-to-SPI, over real ROS 2."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import ros_harness
from compilers import NEEDS_CC
from diagnostic_msgs.msg import DiagnosticStatus
from ros_harness import diagnostic_values
from uwb_mitigation_msgs.msg import Cir, RangeCir

from benchmarks.equipment.dw1000_model.boards import ModelledAir, SerialLink
from benchmarks.equipment.dw1000_model.evb1000 import EmulatedEvb1000s
from benchmarks.equipment.dw1000_model.pairs import Pair
from benchmarks.equipment.emulated_board import EmulatedBoard, PseudoTerminal
from uwb_mitigation.errors import ParameterError, format_id
from uwb_mitigation.nodes.support.parameter_tables import DRIVER
from uwb_mitigation.radios.settings import (
    AGE_UNKNOWN_MS,
    AnchorStatus,
    RadioSettings,
    RadioStatus,
    Role,
    radio_values,
    read_radio,
)
from uwb_mitigation.simulation.simulated import SimulatedSource

pytestmark = [pytest.mark.ros, NEEDS_CC]

DEFAULTS = {row.name: row.default for row in DRIVER}


@pytest.fixture
def boards(tmp_path: Path) -> Iterator[EmulatedEvb1000s]:
    with EmulatedEvb1000s(None, boards=3, port_links=tmp_path / "radio") as emulated:
        yield emulated


def level_of(status: DiagnosticStatus) -> int:
    return status.level[0] if isinstance(status.level, bytes) else status.level


def test_tag_ranges_with_two_anchors_and_settings_are_applied_live(
    ros: ros_harness.Ros, boards: EmulatedEvb1000s, tmp_path: Path
):
    raw = ros.collect(RangeCir, "/uwb/range_raw")
    ports = ",".join(str(tmp_path / f"radio{number}") for number in range(3))
    ros.start("driver", "source:=evb1000", f"port:={ports}")
    ros.spin_until(lambda: len({message.anchor_id for message in raw}) == 2)
    message = raw[0]
    assert len(message.cir.samples) == 2 * 157
    assert message.cir.preamble_count > 0
    assert (message.cir.radio, message.cir.segment) == (Cir.DW1000, Cir.IPATOV)
    assert np.isfinite([message.range, message.cir.rx_power, message.cir.first_path_power]).all()
    status = ros.diagnosis("driver", lambda status: level_of(status) == 0 and "ranging" in status.message)
    values = diagnostic_values(status)
    assert int(values["radio 0: ranged"]) > 0
    assert sum("anchor 0x" in key and "dBm" in value for key, value in values.items()) == 2

    refused = ros.set_parameter("driver", "radio.channel", 6)
    assert not refused.successful
    assert "channel" in refused.reason
    assert ros.set_parameter("driver", "radio.window", 32).successful
    ros.spin_until(lambda: len(raw[-1].cir.samples) == 64)


@pytest.mark.parametrize(
    ("name", "value", "named"),
    [
        ("radio.channel", 6, "channel"),
        ("radio.prf", 32, "prf"),
        ("radio.preamble", 100, "preamble"),
        ("radio.data_rate", 111, "rate"),
        ("radio.anchors", "12,xyz", "radio.anchors"),
        *(("radio.address", text, "radio.address") for text in ("0", "12e4", "1122334455667788")),
        ("radio.preamble_code", 3, "preamble_code"),
    ],
)
def test_unsupported_setting_is_refused_and_named(name: str, value: object, named: str):
    with pytest.raises(ParameterError, match=named):
        read_radio(lambda key: value if key == name else DEFAULTS[key])


@pytest.mark.parametrize("address", [34, 0xDECA010203040506])
def test_address_is_read_as_it_is_printed(address: int):
    values = DEFAULTS | {"radio.address": format_id(address), "radio.anchors": f"7, {format_id(address)}"}
    settings = read_radio(values.__getitem__)
    assert (settings.address, settings.anchors) == (address, (7, address))
    if address < 1 << 16:
        assert read_radio((values | {"radio.address": address}).__getitem__).address == address


def test_anchor_that_never_answered_has_no_last_seen_time():
    anchors = AnchorStatus(7, 9, 0, np.nan, AGE_UNKNOWN_MS), AnchorStatus(8, 9, 9, -80.0, 1500)
    never, recent = [*radio_values(None, RadioStatus(anchors=anchors)).values()][-2:]
    assert never == "0 of 9 ranged, nan dBm, last seen never"
    assert recent == "9 of 9 ranged, -80.0 dBm, last seen 1.5 s ago"


def test_default_parameters_do_not_change_the_radio_of_a_board():
    assert read_radio(DEFAULTS.__getitem__) == RadioSettings()


@contextmanager
def modelled_board(link: Path) -> Iterator[None]:
    """Operate a board with a radio on a modelled chip and its UART on a pseudo-terminal; other chips are the anchors."""
    terminal, stop, step_s = PseudoTerminal(link), threading.Event(), 0.005
    terminal.plug()

    def run() -> None:
        with ModelledAir() as air:
            tag = air.add(RadioSettings(), serial_link=SerialLink())
            nearby = air.add(RadioSettings(role=Role.ANCHOR))
            far = air.add(RadioSettings(role=Role.ANCHOR, channel=2, prf_mhz=16))
            air.set_pair(tag, nearby, Pair(5))
            air.set_pair(tag, far, Pair(9))
            waiting = bytearray()
            while not stop.wait(step_s):
                air.write(tag, terminal.read())
                air.run(step_s)
                waiting += air.read(tag)
                terminal.write(waiting)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        terminal.unplug()


def test_radio_of_a_serial_board_is_configured_and_reports_its_status(ros: ros_harness.Ros, tmp_path: Path):
    raw = ros.collect(RangeCir, "/uwb/range_raw")
    with modelled_board(tmp_path / "board"):
        driver = ros.start("driver", "source:=serial", f"port:={tmp_path / 'board'}", "radio.window:=40")
        ros.spin_until(lambda: bool(raw) and len(raw[-1].cir.samples) == 80)
        assert abs(raw[-1].range - 5) < 0.1
        status = ros.diagnosis("driver", lambda s: int(diagnostic_values(s).get("radio: ranged", 0)) > 0)
        values = diagnostic_values(status)
        assert level_of(status) == 0
        assert (values["radio: role"], values["radio: antenna delay"]) == ("tag", str(2 * 16436))
        assert "radio" in status.hardware_id
        assert any("anchor 0x" in key and "dBm" in value for key, value in values.items())

        driver.wait_for_output("channel 5, 6800 kbit/s")
        for name, value in (("radio.prf", 16), ("radio.channel", 2)):
            assert ros.set_parameter("driver", name, value).successful
        ros.spin_until(lambda: raw[-1].cir.prf == 16)
        assert abs(raw[-1].range - 9) < 0.1
        driver.wait_for_output("channel 2, 6800 kbit/s")


def test_board_without_radio_support_is_reported_and_keeps_running(ros: ros_harness.Ros, tmp_path: Path):
    raw = ros.collect(RangeCir, "/uwb/range_raw")
    with EmulatedBoard(SimulatedSource(seed=4, count=50), link=tmp_path / "board"):
        driver = ros.start("driver", "source:=serial", f"port:={tmp_path / 'board'}", "radio.pan:=7")
        status = ros.diagnosis("driver", lambda status: level_of(status) == 2 and "flash" in status.message)
        assert "the radio's settings are not used" in status.message
        driver.wait_for_output("the radio's settings are not used")
        count_before = len(raw)
        ros.spin_until(lambda: len(raw) > count_before)
