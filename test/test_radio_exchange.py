"""Driver and exchange of the firmware on modelled chips, and a host of a board with them, in virtual time."""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from compilers import NEEDS_CC

from benchmarks.equipment.dw1000_model.boards import ModelledAir, SerialLink
from benchmarks.equipment.dw1000_model.pairs import Pair
from uwb_mitigation.radios.port import PortAddress
from uwb_mitigation.radios.serial import BoardPort, SerialSettings
from uwb_mitigation.radios.settings import PREAMBLES, PortMessage, RadioSettings, Role
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.radios.wire.session import BoardSession, Refused
from uwb_mitigation.types.measurement import RangeMeasurement

pytestmark = NEEDS_CC

WRAP = 1 << 40


def accumulator(samples: int = 1016, first_path: int = 745, seed: int = 0) -> np.ndarray:
    """Return noise and a path of amplitude 8,000 with a tail, int16 (2 n,)."""
    random = np.random.default_rng(seed)
    iq = random.normal(0, 40, 2 * samples)
    tail = 8000 * np.exp(-np.arange(60) / 12)
    iq[2 * first_path : 2 * first_path + 120 : 2] += tail
    iq[2 * first_path + 1 : 2 * first_path + 121 : 2] += 0.3 * tail
    return iq.round().astype(np.int16)


def pair(
    air: ModelledAir, channel: Pair, /, ppm: tuple[float, float] = (20, -20), anchor=None, **settings: object
) -> tuple[int, int]:
    """Add a tag, and an anchor with the same settings except for those in `anchor`."""
    tag = air.add(RadioSettings(**settings), ppm=ppm[0], clock_ticks=WRAP - 3 * 10**9)
    of_anchor = RadioSettings(**settings | {"role": Role.ANCHOR} | (anchor or {}))
    boards = tag, air.add(of_anchor, ppm=ppm[1], clock_ticks=12345)
    air.set_pair(*boards, channel)
    return boards


def ranges_of(channel: Pair, seconds: float, **settings: object) -> tuple[np.ndarray, np.ndarray]:
    """Return the ranges of a pair, and their samples."""
    with ModelledAir() as air:
        pair(air, channel, **settings)
        air.run(seconds)
        return air.ranges()


@pytest.mark.parametrize("window", [0, 157, 1016])
def test_cir_equals_that_of_the_channel_bit_by_bit(window: int):
    iq = accumulator()
    channel = Pair(7, samples=iq, first_path_index=745.25, preamble_count=100)
    rows, store = ranges_of(channel, 0.05, window=window)
    assert len(rows) > 2
    for row in rows:
        assert row["values"] == 2 * window
        start = row["start_index"]
        assert start == (0 if window == 1016 else 740) or window == 0
        expected = iq[2 * start : 2 * (start + window)]
        np.testing.assert_array_equal(store[row["at"] : row["at"] + row["values"]], expected)
        assert abs(row["first_path_index"] - 745.25) <= 1 / 64


@pytest.mark.parametrize(("prf", "reference_db", "samples"), [(64, 121.74, 1016), (16, 113.77, 992)])
def test_powers_are_the_manuals_formulas_of_the_registers(prf: int, reference_db: float, samples: int):
    iq = accumulator(samples)
    channel = Pair(7, samples=iq, first_path_index=745.0, preamble_count=100)
    rows, _ = ranges_of(channel, 0.05, prf_mhz=prf, window=0)
    magnitude = np.hypot(*iq.reshape(-1, 2).T.astype(float))
    first = np.sqrt((magnitude[746:749] ** 2).sum())
    expected = 20 * math.log10(first / 100) - reference_db
    assert rows["first_path_power_dbm"] == pytest.approx(expected, abs=20 * math.log10(1 + 2 / first))
    # The received power is that of the accumulator above its noise; the unit of CIR_PWR is 2^17 of squared
    # magnitude.
    energy = (magnitude**2).sum() - (magnitude[64:576] ** 2).mean() * samples
    low, high = (10 * math.log10((energy + step * 2**17) / 100**2) - reference_db for step in (-1, 1))
    assert high - low < 0.01
    assert ((low <= rows["rx_power_dbm"]) & (rows["rx_power_dbm"] <= high)).all()
    assert (rows["preamble_count"] == 100).all()


RADIOS = [{"channel": channel, "prf_mhz": prf} for channel in (1, 2, 3, 4, 5, 7) for prf in (16, 64)] + [
    {"rate_kbps": 850, "decawave_sfd": True},
    {"rate_kbps": 110, "preamble": 1024, "decawave_sfd": True},
]


@pytest.mark.parametrize("radio", [*RADIOS, *({"preamble": symbols} for symbols in PREAMBLES)], ids=str)
def test_every_channel_rate_and_preamble_ranges(radio: dict[str, object]):
    slow = {"reply_us": 20_000, "timeout_us": 60_000}
    with ModelledAir() as air:
        tag, _ = pair(air, Pair(12), **(slow | radio))
        air.run(0.3)
        rows, _ = air.ranges()
        counts = air.counts(tag)
    assert counts["ranged"] >= counts["tried"] - 1 >= 2
    assert abs(rows["range_m"].mean() - 12) < 0.005


def test_radios_that_differ_in_the_channel_or_the_network_do_not_range():
    for peer in ({"channel": 2}, {"prf_mhz": 16}, {"pan": 1}, {"preamble_code": 10}):
        with ModelledAir() as air:
            tag, _ = pair(air, Pair(3), anchor=peer)
            air.run(0.3)
            assert air.counts(tag)["tried"] == 0
            assert air.counts(tag)["restarts"] <= 1


def test_tag_finds_its_anchors_and_ranges_with_all_of_them_in_turn():
    with ModelledAir() as air:
        tag = air.add(RadioSettings(window=0), ppm=3)
        anchors = [air.add(RadioSettings(role=Role.ANCHOR), ppm=i - 16) for i in range(32)]
        for i, anchor in enumerate(anchors):
            air.set_pair(tag, anchor, Pair(1.0 + i))
        air.run(6)
        air.ranges()
        air.run(1)
        rows, _ = air.ranges()
        heard = {air.address(anchor): 1.0 + i for i, anchor in enumerate(anchors)}
    counted = {anchor: (rows["anchor"] == anchor).sum() for anchor in heard}
    assert len(heard) == 32
    assert min(counted.values()) >= 3
    assert max(counted.values()) - min(counted.values()) <= 2, "each in its turn"
    for row in rows:
        assert abs(row["range_m"] - heard[row["anchor"]]) < 0.02


def test_tags_share_the_channel_without_mixing_ranges():
    with ModelledAir() as air:
        anchors = [air.add(RadioSettings(role=Role.ANCHOR), ppm=i) for i in range(2)]
        tags = [air.add(RadioSettings(window=0), ppm=-i) for i in range(4)]
        for i, tag in enumerate(tags):
            for j, anchor in enumerate(anchors):
                air.set_pair(tag, anchor, Pair(3.0 + 10 * i + 5 * j))
            for peer in tags[:i]:
                air.set_pair(tag, peer, Pair(2))
        air.set_pair(*anchors, Pair(4))
        air.run(10)
        rows, _ = air.ranges()
        tag_ids, anchor_ids = ([air.address(board) for board in boards] for boards in (tags, anchors))
    ids = itertools.product(enumerate(tag_ids), enumerate(anchor_ids))
    truth = {(tag, anchor): 3.0 + 10 * i + 5 * j for (i, tag), (j, anchor) in ids}
    assert {(row["tag"], row["anchor"]) for row in rows} == set(truth)
    for row in rows:
        assert abs(row["range_m"] - truth[row["tag"], row["anchor"]]) < 0.05
    for tag in tags:
        assert (rows["board"] == tag).sum() > 50


def test_anchor_with_a_host_reports_the_range_with_the_cir_of_final():
    iq = accumulator(seed=3)
    with ModelledAir() as air:
        boards = pair(air, Pair(9, samples=iq, first_path_index=745.0), anchor={"report": True})
        air.run(0.2)
        rows, store = air.ranges()
        addresses = tuple(map(air.address, boards))
    excerpt = rows[rows["board"] == boards[1]]
    assert len(excerpt) > 20
    assert abs(excerpt["range_m"] - 9).max() < 0.02
    assert {(row["tag"], row["anchor"]) for row in excerpt} == {addresses}
    np.testing.assert_array_equal(store[excerpt[0]["at"] : excerpt[0]["at"] + 314], iq[2 * 740 : 2 * 897])


def test_missing_antenna_delay_appears_in_the_range():
    rows, _ = ranges_of(Pair(5), 0.1, antenna_delay=2 * 16436 - 400, anchor={"antenna_delay": 0})
    # Half of the missing delay of one device, as distance: 2.346 mm per tick.
    assert abs(rows["range_m"].mean() - 5 - 400 * 0.0046917639 / 2) < 0.005


def test_power_dependent_bias_is_corrected_if_enabled():
    rows, _ = ranges_of(Pair(5, samples=accumulator()), 0.1, bias_correction=True)
    power_dbm = rows["rx_power_dbm"][0]
    true_dbm = power_dbm + max(0.0, power_dbm + 88) * 1.1667
    table = [-110, -105, -100, -93, -82, -69, -51, -27, 0, 21, 35, 42, 49, 62, 71, 76, 81, 86]
    bias_m = np.interp(-true_dbm, np.arange(61, 97, 2), table) / 1000
    assert abs(rows["range_m"].mean() - 5 + bias_m) < 0.005


def talk(air: ModelledAir, board: int, session: Any, seconds: float) -> list[Any]:
    """Connect a board with the session of its host; return the events."""
    events: list[Any] = []
    for _ in range(round(seconds / 0.01)):
        now_ns = round(air.run(0.01) * 1e9)
        events += session.receive(air.read(board), now_ns, now_ns)
        air.write(board, session.outgoing())
    return events


def test_settings_that_a_board_does_not_support_are_refused_with_a_reason():
    with ModelledAir() as air:
        board, session = air.add(RadioSettings(), serial_link=SerialLink()), BoardSession()
        session.opened(0)
        talk(air, board, session, 0.5)
        request = RadioSettings(channel=6)
        assert messages.decode(*messages.encode(request)) == request
        session._radio_request.begin(request)
        (refusal,) = (event for event in talk(air, board, session, 1.0) if isinstance(event, Refused))
    assert "channel" in refusal.text
    assert session.radio.settings.channel == 5


def test_settings_of_the_driver_are_applied_live_and_the_diagnostics_show_the_radio():
    settings = SerialSettings(PortAddress("/dev/no"), radio=RadioSettings(window=40))
    port = BoardPort(settings, (0, None, print, lambda: 0))
    session = SimpleNamespace(receive=port._received, outgoing=port.session.outgoing)
    with ModelledAir() as air:
        tag = air.add(RadioSettings(), serial_link=SerialLink())
        for distance_m, channel in ((5, {}), (9, {"channel": 2, "prf_mhz": 16})):
            anchor = air.add(RadioSettings(role=Role.ANCHOR, **channel))
            air.set_pair(tag, anchor, Pair(distance_m))
        before, report = talk(air, tag, session, 3), port.report()
        port.apply(replace(settings, radio=RadioSettings(channel=2, prf_mhz=16)))
        after = talk(air, tag, session, 3)
    first, second = (
        [event for event in events if isinstance(event, RangeMeasurement)][-1] for events in (before, after)
    )
    assert (len(first.cir), round(first.range_m, 1)) == (40, 5.0)
    assert (second.cir.prf_mhz, round(second.range_m, 1)) == (16, 9.0)
    assert (report.values["radio: role"], report.values["radio: antenna delay"]) == ("tag", 2 * 16436)
    assert int(report.values["radio: ranged"]) > 0
    assert any("anchor 0x" in key and "dBm" in str(value) for key, value in report.values.items())
    assert "radio" in report.hardware
    texts = [
        event.text for event in before + after if isinstance(event, PortMessage) and "kbit/s" in event.text
    ]
    assert ["channel 5, 6800 kbit/s" in texts[0], "channel 2, 6800 kbit/s" in texts[-1]] == [True, True]
