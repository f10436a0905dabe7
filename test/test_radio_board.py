"""A session with a board that has a radio, on modelled chips: settings, status and ranges."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

from compilers import NEEDS_CC

from benchmarks.equipment.dw1000_model.boards import ModelledAir, SerialLink
from benchmarks.equipment.dw1000_model.pairs import Pair
from uwb_mitigation.radios.port import PortAddress
from uwb_mitigation.radios.serial import BoardPort, SerialSettings
from uwb_mitigation.radios.settings import PortMessage, RadioSettings, Role
from uwb_mitigation.radios.wire.events import Event
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


def test_settings_of_the_driver_are_applied_live_and_the_diagnostics_show_the_radio():
    settings = SerialSettings(PortAddress("/dev/no"), radio=RadioSettings(window=40))
    port = BoardPort(settings, (0, None, print, lambda: 0))
    with ModelledAir() as air:
        tag = air.add(RadioSettings(), serial_link=SerialLink())
        for distance_m, channel in ((5, {}), (9, {"channel": 2, "prf_mhz": 16})):
            anchor = air.add(RadioSettings(role=Role.ANCHOR, **channel))
            air.set_pair(tag, anchor, Pair(distance_m))
        host = Host(air, tag)
        host.session = SimpleNamespace(receive=port._received, outgoing=port.session.outgoing)
        host.run(3)
        first, report = host.received(RangeMeasurement)[-1], port.report()
        port.apply(replace(settings, radio=RadioSettings(channel=2, prf_mhz=16)))
        host.run(3)
        second = host.received(RangeMeasurement)[-1]
    assert (len(first.cir), round(first.range_m, 1)) == (40, 5.0)
    assert (second.cir.prf_mhz, round(second.range_m, 1)) == (16, 9.0)
    assert (report.values["radio: role"], report.values["radio: antenna delay"]) == ("tag", 2 * 16436)
    assert int(report.values["radio: ranged"]) > 0
    assert any("anchor 0x" in key and "dBm" in str(value) for key, value in report.values.items())
    assert "radio" in report.hardware
    texts = [message.text for message in host.received(PortMessage) if "kbit/s" in message.text]
    assert ["channel 5, 6800 kbit/s" in texts[0], "channel 2, 6800 kbit/s" in texts[-1]] == [True, True]
