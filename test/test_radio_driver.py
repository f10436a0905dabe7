"""The node `driver` with local radios: emulated EVB1000s with USB-to-SPI, over real ROS 2."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import ros_harness
from compilers import NEEDS_CC
from diagnostic_msgs.msg import DiagnosticStatus
from port_events import driver_values
from ros_harness import diagnostic_values
from uwb_mitigation_msgs.msg import Cir, RangeCir

from benchmarks.equipment.dw1000_model.evb1000 import EmulatedEvb1000s
from benchmarks.equipment.emulated_board import EmulatedBoard
from uwb_mitigation.errors import format_id
from uwb_mitigation.radios.parameters import read_radio
from uwb_mitigation.radios.settings import AGE_UNKNOWN_MS, AnchorStatus, RadioSettings, RadioStatus
from uwb_mitigation.simulation.simulated import SimulatedSource

pytestmark = [pytest.mark.ros, NEEDS_CC]


@pytest.fixture
def boards(tmp_path: Path) -> Iterator[EmulatedEvb1000s]:
    with EmulatedEvb1000s(None, boards=3, port_links=tmp_path / "radio") as emulated:
        yield emulated


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
    status = ros.diagnosis(
        "driver", lambda status: status.level == DiagnosticStatus.OK and "ranging" in status.message
    )
    values = diagnostic_values(status)
    assert int(values["radio 0: ranged"]) > 0
    assert sum("anchor 0x" in key and "dBm" in value for key, value in values.items()) == 2

    refused = ros.set_parameter("driver", "radio.channel", 6)
    assert not refused.successful
    assert "channel" in refused.reason
    assert ros.set_parameter("driver", "radio.window", 32).successful
    ros.spin_until(lambda: len(raw[-1].cir.samples) == 64)


@pytest.mark.parametrize("address", [34, 0xDECA010203040506])
def test_address_is_read_as_it_is_printed(address: int):
    text = format_id(address)
    settings = read_radio(driver_values(radio__address=text, radio__anchors=f"7, {text}"))
    assert (settings.address, settings.anchors) == (address, (7, address))
    if address < 1 << 16:
        assert read_radio(driver_values(radio__address=address)).address == address


def test_anchor_that_never_answered_has_no_last_seen_time():
    anchors = AnchorStatus(7, 9, 0, np.nan, AGE_UNKNOWN_MS), AnchorStatus(8, 9, 9, -80.0, 1500)
    never, recent = [*RadioStatus(anchors=anchors).values(None).values()][-2:]
    assert never == "0 of 9 ranged, nan dBm, last seen never"
    assert recent == "9 of 9 ranged, -80.0 dBm, last seen 1.5 s ago"


def test_default_parameters_do_not_change_the_radio_of_a_board():
    assert read_radio(driver_values()) == RadioSettings()


def test_board_without_radio_support_is_reported_and_keeps_running(ros: ros_harness.Ros, tmp_path: Path):
    raw = ros.collect(RangeCir, "/uwb/range_raw")
    with EmulatedBoard(SimulatedSource(seed=4, count=50), link=tmp_path / "board"):
        driver = ros.start("driver", "source:=serial", f"port:={tmp_path / 'board'}", "radio.pan:=7")
        status = ros.diagnosis(
            "driver", lambda status: status.level == DiagnosticStatus.ERROR and "flash" in status.message
        )
        assert "the radio's settings are not used" in status.message
        driver.wait_for_output("the radio's settings are not used")
        count_before = len(raw)
        ros.spin_until(lambda: len(raw) > count_before)
