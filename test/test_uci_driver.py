"""The node `driver` with emulated UCI boards on pseudo-terminals, over real ROS 2."""

import re
import signal
from array import array
from collections.abc import Iterator
from pathlib import Path

import pytest
import ros_harness
from port_events import PortEvents, driver_values, wait_until
from ros_harness import diagnostic_values
from uwb_mitigation_msgs.msg import Cir, RangeCir, RangeCorrected

from benchmarks.equipment.uci_board import EmulatedUciBoards, UciFaults
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import shipped_model_path
from uwb_mitigation.nodes.support.parameter_tables import DRIVER
from uwb_mitigation.radios import uci
from uwb_mitigation.radios.fira.session import UciSettings
from uwb_mitigation.radios.port import PortAddress
from uwb_mitigation.radios.settings import Role
from uwb_mitigation.radios.uci import UciPortSettings, read_settings
from uwb_mitigation.types.measurement import RangeMeasurement


@pytest.fixture
def boards(tmp_path: Path) -> Iterator[EmulatedUciBoards]:
    with EmulatedUciBoards(boards=3, links=tmp_path / "uci") as emulated:
        yield emulated


@pytest.mark.ros
def test_two_anchors_range_through_a_capture_and_an_unplugged_cable(
    ros: ros_harness.Ros, boards: EmulatedUciBoards, tmp_path: Path
):
    raw = ros.collect(RangeCir, "/uwb/range_raw")
    corrected = ros.collect(RangeCorrected, "/uwb/range_corrected")
    mitigator = ros.start("mitigator", "offsets:=0.5")
    ports = ",".join(str(tmp_path / f"uci{number}") for number in range(3))
    capture = tmp_path / "capture.txt"
    options = ("radio.window:=16", "radio.anchors:=[2, 3]", f"capture:={capture}")
    node = ros.start("driver", "source:=uci", f"port:={ports}", *options)

    # On a busy computer, diagnostics may be too late for their range; `test_uci` counts them in virtual time.
    def with_cirs() -> list[RangeCir]:
        return [message for message in raw if message.cir.samples]

    ros.spin_until(lambda: {2, 3} == {message.anchor_id for message in with_cirs()} and len(with_cirs()) > 20)
    assert {len(message.cir.samples) for message in with_cirs()} == {32}
    assert all(abs(message.range - 3.0) < 0.2 for message in raw)

    status = ros.diagnosis("driver", lambda status: "ranging" in status.message)
    assert diagnostic_values(status)["radio 0: CIR taps"] == "16"

    assert {(m.cir.radio, m.cir.segment) for m in with_cirs()} == {(Cir.DW3000, Cir.STS)}
    ros.spin_until(lambda: sum(m.status != RangeCorrected.NO_CIR for m in corrected) > 20)
    experimental = load_bundle(shipped_model_path("dw3000_sts")).model_id
    used = [m for m in corrected if m.status != RangeCorrected.NO_CIR]
    assert {(m.model_id, m.status) for m in used} == {(experimental, RangeCorrected.OK)}
    assert all(0 < abs(m.range - (m.range_raw - 0.5)) < 0.1 for m in used)
    reason = "model dw3000_sts (experimental), id "
    mitigator.wait_for_output(reason)
    assert mitigator.output.count(reason) == 1
    status = ros.diagnosis("mitigator", lambda status: any(reason in v.value for v in status.values))
    models = r"DW3000 STS .*: model dw3000_sts .* \(tag-anchor 1-2, 1-3\)"
    assert re.search(models, diagnostic_values(status)["models by radio"])

    assert ros.set_parameter("mitigator", "model", "universal").successful
    status = ros.diagnosis("mitigator", lambda status: "DW3000 STS" in status.message)
    assert "trained for DW1000 IPATOV" in status.message
    ros.spin_until(lambda: corrected[-1].status == RangeCorrected.OUT_OF_DISTRIBUTION)
    assert corrected[-1].range == pytest.approx(corrected[-1].range_raw - 0.5)

    boards.unplug(1)
    ros.diagnosis("driver", lambda status: "uci1" in status.message)
    ros.spin_until(lambda: raw[-1].anchor_id == 3 and len({m.anchor_id for m in raw[-10:]}) == 1)
    boards.plug(1)
    ros.spin_until(lambda: len({m.anchor_id for m in raw[-10:]}) == 2)
    boards.set_faults(UciFaults(empty_cir=True))
    ros.spin_until(lambda: not raw[-1].cir.samples)
    assert node.signal(signal.SIGINT) == 0

    measured = {(m.anchor_id, m.sequence): m.range for m in raw}
    raw.clear()
    ros.start("driver", "source:=uci", f"path:={capture}", "rate:=50.0")
    ros.spin_until(lambda: len(raw) > 50)
    assert all(measured.get((m.anchor_id, m.sequence), m.range) == m.range for m in raw)


def test_a_tag_without_ranges_is_a_warning_and_closing_restores_the_calibration(
    boards: EmulatedUciBoards, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("uwb_mitigation.radios.port.PERIOD_S", 1.0)
    before = [dict(model._calibration) for model in boards._models]
    settings = UciSettings(), UciSettings(Role.ANCHOR, 2, (1,))
    tag, anchor = (
        PortEvents(uci, UciPortSettings(PortAddress(f"{tmp_path}/uci{number}"), board))
        for number, board in enumerate(settings)
    )
    with tag:
        with anchor:
            tag.wait_for(RangeMeasurement, 5)
            assert boards._models[0]._calibration != before[0]
            wait_until(lambda: tag.port.report().warning == "")
            boards.set_faults(UciFaults(offset_m=-3.0))
            negative = "negative distance.*antenna delay"
            wait_until(lambda: re.search(negative, tag.port.report().warning, re.DOTALL))
            boards.set_faults(UciFaults())
            wait_until(lambda: tag.port.report().warning == "")
        silent = r"no range for \d.*reception timeout: are the other boards on"
        wait_until(lambda: re.match(silent, tag.port.report().warning, re.DOTALL))
    assert [model._calibration for model in boards._models] == before
    assert not boards._models[0].sessions


def uci_settings(value):
    return [settings.board for settings in read_settings(value)]


def test_the_first_board_is_the_tag_of_the_others_also_at_another_computer():
    tag, anchor, second_anchor = uci_settings(driver_values(port="/dev/a,/dev/b,/dev/c", radio__rate=20.0))
    assert (tag.role, tag.address, tag.peers, tag.channel) == (Role.TAG, 1, (2, 3), 9)
    assert (second_anchor.role, second_anchor.address, second_anchor.peers) == (Role.ANCHOR, 3, (1,))
    assert tag.effective_interval_ms == anchor.effective_interval_ms == 100
    assert tag.session_id(3) == second_anchor.session_id(1)
    (tag,) = uci_settings(driver_values(port="/dev/a"))
    (anchor,) = uci_settings(driver_values(port="/dev/a", radio__role="anchor"))
    assert tag.session_id(2) == anchor.session_id(1)
    assert tag.effective_interval_ms == anchor.effective_interval_ms == 88
    assert (anchor.address, anchor.peers) == (2, (1,))


@pytest.mark.parametrize("anchors", [[3, 4], ["3", "0x4"], "3,4", "[3, 4]", array("q", [3, 4])])
def test_anchors_are_a_list_or_a_text(anchors: object):
    row = next(row for row in DRIVER if row.name == "radio.anchors")
    row.check(anchors)
    (tag,) = uci_settings(driver_values(port="/dev/a", radio__anchors=anchors))
    assert tag.peers == (3, 4)
