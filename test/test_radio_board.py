"""A session with a board that has a radio, on modelled chips: settings, status and ranges."""

from __future__ import annotations

import itertools

from compilers import NEEDS_CC

from benchmarks.equipment.dw1000_model.boards import ModelledAir, SerialLink
from benchmarks.equipment.dw1000_model.pairs import Pair
from uwb_mitigation.radios.settings import RadioSettings, RadioState, RadioStatus, Role
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.radios.wire.events import Event, Refused
from uwb_mitigation.radios.wire.messages import SetRadio
from uwb_mitigation.radios.wire.session import BoardSession
from uwb_mitigation.types.measurement import RangeMeasurement

pytestmark = NEEDS_CC


class Host:
    """A session with a modelled board in virtual time."""

    def __init__(self, air: ModelledAir, board: int) -> None:
        self.air, self.board = air, board
        self.session = BoardSession()
        self.events: list[Event] = self.session.opened(0)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.01)):
            now_ns = round(self.air.run(0.01) * 1e9)
            self.events += self.session.receive(self.air.read(self.board), now_ns, now_ns)
            self.air.write(self.board, self.session.outgoing())

    def received(self, kind: type) -> list:
        return [event for event in self.events if isinstance(event, kind)]


def test_ranges_settings_and_status_of_the_radio_reach_the_host():
    with ModelledAir() as air:
        tag = air.add(RadioSettings(), serial_link=SerialLink())
        anchor = air.add(RadioSettings(role=Role.ANCHOR))
        air.set_pair(tag, anchor, Pair(6, loss=0.05))
        host = Host(air, tag)
        host.run(3)
        addresses = air.address(tag), air.address(anchor)
    ranges = host.received(RangeMeasurement)
    assert len(ranges) > 100
    assert host.session.counts["lost"] == 0
    last = ranges[-1]
    assert (last.tag_id, last.anchor_id) == addresses
    assert abs(last.range_m - 6) < 0.02
    assert (len(last.cir), last.cir.channel, last.cir.prf_mhz) == (157, 5, 64)
    assert all(later.stamp_ns > earlier.stamp_ns for earlier, later in itertools.pairwise(ranges))
    assert 3e9 - last.stamp_ns < 0.06e9

    settings = host.session.radio.settings
    assert (settings.address, settings.antenna_delay, settings.preamble_code) == (addresses[0], 2 * 16436, 9)
    assert settings.tx_power not in (0, 0xFFFFFFFF)
    status = host.received(RadioStatus)[-1]
    assert status.state is RadioState.RUNNING
    assert status.tried >= status.ranged > 50
    assert status.no_answer + status.timeout > 0
    assert abs(status.temperature_c - 25) < 3
    assert abs(status.voltage - 3.3) < 0.1
    (in_reach,) = status.anchors
    assert in_reach.address == addresses[1]
    assert -100 < in_reach.rx_power_dbm < -60
    assert in_reach.age_ms < 500


def test_settings_that_a_board_does_not_support_are_refused_with_a_reason():
    with ModelledAir() as air:
        board = air.add(RadioSettings(), serial_link=SerialLink())
        host = Host(air, board)
        host.run(0.5)
        request = SetRadio(RadioSettings(channel=6))
        assert messages.decode(*messages.encode(request)) == request
        host.session._radio_request.begin(request)
        host.run(1)
        (refusal,) = host.received(Refused)
        assert "channel" in refusal.text
        assert host.session.radio.settings.channel == 5
