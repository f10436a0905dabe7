"""UCI boards: packets, sessions and joins on byte streams, without ports."""

from __future__ import annotations

import contextlib
import logging
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks import uci
from benchmarks.equipment.uci_board import FIRST_PATH, TAPS, UciBoardModel, UciFaults, _Session, taps_of
from uwb_mitigation.errors import DamagedRecordingError, LinkError, RecordingError
from uwb_mitigation.mitigation.model.choice import CirKind
from uwb_mitigation.radios.capture import CaptureWriter, first_line
from uwb_mitigation.radios.fira import codes, messages
from uwb_mitigation.radios.fira.calibration import OriginalsFile
from uwb_mitigation.radios.fira.cir import CirReport, PositionUnit, read_cir
from uwb_mitigation.radios.fira.codes import PacketType
from uwb_mitigation.radios.fira.joining import DiagnosticsMatcher
from uwb_mitigation.radios.fira.messages import CirBlock, Diagnostics, SegmentMetrics
from uwb_mitigation.radios.fira.packets import MAX_GAP_NS, PacketDecoder, encode_packets
from uwb_mitigation.radios.fira.session import UciSession, UciSettings
from uwb_mitigation.radios.port import PortAddress
from uwb_mitigation.radios.settings import Role
from uwb_mitigation.radios.uci import UciPort, UciPortSettings, open_capture
from uwb_mitigation.types.measurement import RadioType, RangeMeasurement, Segment

FIRST_LINE = first_line("UCI")
TAG_LINES = f'{FIRST_LINE}\nboard 0 {{"role": "TAG", "peers": [2]}}\n'
MS = 10**6
RANGE = bytes.fromhex(
    # seq 7, handle 1, rfu, 200 ms, two-way, rfu, short, primary session, rfu, 1 record
    "07000000 01000000 00 c8000000 01 00 00 00000000 00000000 01"
    # peer 2, ok, NLOS unknown, 210 cm, AoA, slot, RSSI 78 dBm, rfu
    "0200 00 ff d200 000000000000000000000000 00 9c 0000000000000000000000"
)
RANGE_PACKET = bytes.fromhex("62000038") + RANGE
WORKING_CONFIG = bytes.fromhex(
    "2103006a 01000000 1b 000101 110101 030100 010102 06020000 040109 220101 020100 120103 2e010b"
    "27020807 2806010203040506 0d0101 2b080000000000000000 14010a 150102 08026009 0904c8000000 1b0119"
    "32020000 2c0100 130100 2d0100 050101 07020100 240100 350101"
)
ANCHOR = {"role": Role.ANCHOR, "address": 2, "peers": (1,)}


class Bench:
    """A session and a board model, connected in virtual time."""

    def __init__(
        self, board: UciBoardModel | None = None, originals: OriginalsFile | None = None, **settings: object
    ) -> None:
        self.board = board or UciBoardModel()
        self.session = UciSession(UciSettings(**{"window": 16, **settings}), originals)
        self.now_ns = 0
        self.measured_ranges: list[RangeMeasurement] = []
        self.sent = b""
        self.session.opened(0)

    @property
    def handle(self) -> int:
        (handle,) = self.board.sessions
        return handle

    def step(self, data: bytes = b"", ms: float = 5.0) -> None:
        self.now_ns += round(ms * MS)
        self.measured_ranges += self.session.receive(data, self.now_ns, self.now_ns)
        sent = self.session.outgoing()
        self.sent += sent
        answer = self.board.receive(sent, self.now_ns / 1e9)
        if answer:
            self.measured_ranges += self.session.receive(answer, self.now_ns, self.now_ns)

    def wait(self, seconds: float, until: Callable[[str], bool] = lambda state: False) -> Bench:
        """Run for a time, or until the state of the session fulfils a condition."""
        for _ in range(round(seconds / 0.005)):
            self.step()
            if until(self.session.state):
                break
        return self

    def wait_for(self, text: str) -> str:
        """Wait until the state contains a text; return it."""
        return self.wait(20.0, lambda state: text in state).session.state

    def start(self, seconds: float = 10.0) -> Bench:
        assert self.wait(seconds, lambda state: not state).session.state == ""
        return self

    def start_again(self) -> Bench:
        self.session.closed(0)
        self.session.opened(self.now_ns)
        return self.start()

    def stop(self) -> dict[str, int]:
        """Stop the session; return the calibration of its board."""
        self.session.stop(self.now_ns)
        while not self.session.stopped:
            self.step()
        return self.board._calibration

    def port(self) -> UciPort:
        settings = UciPortSettings(PortAddress("/dev/no"), self.session.settings)
        port = UciPort(settings, (0, None, print, lambda: 0))
        port.session = self.session
        return port

    def range(self, sequence: int, distance_m: float = 3.0) -> bytes:
        return self.board.range_packet(self.handle, sequence, distance_m)

    def diagnostics(self, sequence: int) -> bytes:
        return self.board.diagnostics_packet(self.handle, sequence)

    def exchange(self, *sequences: int, handle: int = 0, distance_m: float = 3.0) -> Bench:
        for sequence in sequences:
            self.step(self.board.exchange(handle or self.handle, sequence, distance_m), 18.0)
        return self


def bench(**faults: object) -> Bench:
    return Bench(UciBoardModel(faults=UciFaults(**faults)))


def taps_in(measured: RangeMeasurement) -> int:
    """Return the number of taps in a range; those of another exchange are a failure."""
    count = len(measured.cir)
    expected = taps_of(measured.sequence, count, 5)
    assert np.array_equal(measured.cir.samples.reshape(-1, 2), expected) or not count
    return count


class Answering(UciBoardModel):
    """Gives other answers to some commands.

    Args:
        answers: {name of the command: payload of the answer, or a function of the payload of the command}; None: the usual one.
    """

    def __init__(self, answers: dict[tuple[int, int], bytes | Callable[[bytes], bytes | None]]) -> None:
        self.answers = answers
        super().__init__()

    def _command(self, name, payload, now_s):
        answer = self.answers.get(name)
        if callable(answer):
            answer = answer(payload)
        return super()._command(name, payload, now_s) if answer is None else self._respond(name, answer)


# Messages --------------------------------------------------------------------------------------------------------


def test_a_range_notification_of_a_real_board_is_parsed():
    (message,) = PacketDecoder().feed(RANGE_PACKET, 0)
    (record,) = message.content.records
    assert (message.content.handle, message.content.sequence) == (1, 7)
    assert (record.peer, record.status, record.range_m, record.rssi_dbm) == (2, 0, 2.10, -78.0)
    messages.parse_ranges(RANGE + b"\0")
    with pytest.raises(LinkError):
        messages.parse_ranges(RANGE + RANGE_PACKET)
    # A failed and an invalid range have no distance.
    for position, value in ((27, b"\x21\xff"), (29, b"\xff\xff")):
        data = RANGE[:position] + value + RANGE[position + 2 :]
        assert np.isnan(messages.parse_ranges(data).records[0].range_m)


def test_the_levels_of_each_segment_are_parsed():
    numbers = (
        (8, -80, 256 * 80, 739, 256 * 84, 64 * 739 + 16, 740, 0, 0),
        (1, -80, 0, 362, 0, 64 * 362, 363, 0, 0),
    )
    data = b"".join(struct.pack("<BhHHHHHHH", *row) for row in numbers)
    report = struct.pack("<IIBBBBBBH", 1, 7, 1, 2, 0, 0, 1, 6, len(data)) + data
    first, second = messages.parse_diagnostics(report).frames[0].metrics
    assert first == SegmentMetrics(0, 0, True, -80.0, -84.0, 739, 739.25, 740)
    assert (second.segment, second.primary, second.first_path, second.peak_index) == (1, False, 362.0, 363)
    assert np.isnan([second.rx_dbm, second.first_path_dbm]).all()


def test_the_settings_of_a_session_are_those_that_worked_on_a_real_board():
    commands = Bench(address=0x1111, peers=(1,), interval_ms=200).start().sent
    packet = commands[commands.index(bytes.fromhex("21030070")) :][: 4 + 0x70]
    expected = WORKING_CONFIG.replace(b"\x06\x02\x00\x00", b"\x06\x02\x11\x11")
    expected = expected.replace(b"\x1b\x01\x19", b"\x1b\x01\x06")
    assert packet[:3] + b"\x6a" + packet[4:8] + b"\x1b" + packet[9:-6] == expected
    assert packet[8] == 0x1D
    assert packet[-6:] == bytes.fromhex("e80101e90178")


def test_a_damaged_length_hides_packets_only_until_a_timeout():
    decoder = PacketDecoder()
    assert decoder.feed(RANGE_PACKET[:3] + b"\xff" + RANGE_PACKET[4:] + RANGE_PACKET, 0) == []
    assert [message.content.sequence for message in decoder.feed(b"", MAX_GAP_NS + 1)] == [7]


def test_a_long_command_is_sent_in_fragments():
    sent = encode_packets(1, 3, bytes(600))
    assert [sent[0], sent[254], sent[508]] == [0x31, 0x31, 0x21]
    assert len(sent) == 600 + 3 * 4


# CIRs ------------------------------------------------------------------------------------------------------------


def block(taps: np.ndarray, offset: int = -5, segment: int = 1) -> CirBlock:
    return CirBlock(0, segment, True, offset, taps)


def levels(index: int = 362, first_path: float = 362.5, peak: int = 363, segment: int = 1) -> SegmentMetrics:
    return SegmentMetrics(0, segment, True, -80.0 - segment, -84.0, index, first_path, peak)


def reading(
    blocks: tuple[CirBlock, ...], metrics: tuple[SegmentMetrics, ...] = (), unit: PositionUnit | None = None
) -> CirReport:
    frame = messages.FrameReport(2, True, None, 0.0, metrics, blocks, False)
    return read_cir(Diagnostics(1, 1, (frame,)), 9, -70.0, unit)


def test_the_cir_has_the_taps_of_the_exchange():
    run = Bench(window=157).start().exchange(1, 2, 3)
    assert run.session.window == (157, 5)
    measured = run.measured_ranges[1]
    cir = measured.cir
    assert (measured.tag_id, measured.anchor_id, measured.sequence, measured.range_m) == (1, 2, 2, 3.0)
    assert taps_in(measured) == 157
    assert (cir.start_index, cir.first_path_index) == (FIRST_PATH - 5, FIRST_PATH + 2 / 64)
    assert (cir.radio, cir.segment, cir.channel) == (RadioType.DW3000, Segment.STS, 9)
    assert cir.rx_power_dbm == -80.5


@pytest.mark.parametrize("tap_bytes", [4, 6, 8])
@pytest.mark.parametrize("max_taps", [16, 64])
def test_a_smaller_window_and_other_taps_are_used_as_delivered(tap_bytes: int, max_taps: int):
    run = Bench(UciBoardModel(max_taps=max_taps, tap_bytes=tap_bytes), window=157).start().exchange(1)
    assert run.session.window == (max_taps, 5)
    assert taps_in(run.measured_ranges[0]) == max_taps


def test_taps_of_18_bits_are_scaled_to_16_bits():
    taps = np.array([[0, 0], [131071, -131072], [-2, 2]], np.int32)
    cir = reading((block(taps, -1),)).cir
    assert np.all(np.abs(cir.samples.astype(int)) < 32767)
    assert np.abs(cir.samples.reshape(-1, 2) * cir.scale - taps).max() < cir.scale
    assert (cir.first_path_index, cir.rx_power_dbm) == (1.0, -70.0)


@pytest.mark.parametrize("metrics", [(), (levels(),)], ids=["without levels", "with levels"])
@pytest.mark.parametrize(
    ("offset", "consistent"), [(-5, True), (-3, False), (-8, False), (-9, False), (-40, False), (120, False)]
)
def test_the_first_path_is_checked_against_the_leading_edge(offset: int, consistent: bool, metrics: tuple):
    report = reading((block(taps_of(1, 64, 5), offset),), metrics)
    assert report.consistent is consistent
    assert np.isfinite(report.cir.first_path_index) == consistent


@pytest.mark.parametrize(("peak", "consistent"), [(3, True), (-3, False)])
def test_the_reported_peak_is_searched_after_the_first_path(peak: int, consistent: bool):
    taps = np.full((16, 2), (5, 0), np.int32)
    taps[[5, 8]] = (300, 0), (1000, 0)
    assert reading((block(taps),), (levels(peak=362 + peak),)).consistent is consistent


def test_of_two_primary_segments_the_sts_is_used():
    blocks = tuple(block(taps_of(segment + 1, 16, 5), segment=segment) for segment in (0, 1))
    cir = reading(blocks, (levels(739, 739.5, 740, 0), levels())).cir
    assert (cir.segment, cir.start_index, cir.rx_power_dbm) == (Segment.STS, 357, -81.0)
    assert np.array_equal(cir.samples.reshape(-1, 2), taps_of(2, 16, 5))
    # The levels of another segment are not those of its taps.
    assert reading(blocks[1:], (levels(739, 739.5, 740, 0),)).cir.start_index == 0


@pytest.mark.parametrize(
    ("index", "scale", "unit"),
    [
        *((index, 1.0, "taps") for index in (362, 739)),
        *((index, 1.0016, "nanoseconds") for index in (362, 739)),
        (362, 1.02, "contradictory"),
    ],
)
def test_first_path_positions_are_in_taps_or_nanoseconds(index: int, scale: float, unit: str):
    position_unit, errors = PositionUnit(), []
    for number in range(64):
        first_path = index + number * 37 % 64 / 64
        reported = levels(index, round(64 * first_path * scale) / 64, index + 1)
        report = reading((block(taps_of(number, 16, 5)),), (reported,), position_unit)
        errors.append(report.cir.first_path_index - first_path)
    assert position_unit.name == unit
    assert np.abs(errors[8:]).max() < (0.02 if unit != "contradictory" else 1.0)


def test_a_cir_of_an_unknown_layout_is_skipped_but_its_levels_are_used():
    run = Bench(UciBoardModel(tap_bytes=10)).start().exchange(1)
    (measured,) = run.measured_ranges
    assert len(measured.cir) == 0
    assert measured.cir.rx_power_dbm == -80.5
    assert run.session.totals()["damaged"] == 0


def test_an_anchor_uses_the_final_frame_and_ranges_with_its_tag():
    (measured,) = Bench(**ANCHOR).start().exchange(1).measured_ranges
    assert (measured.tag_id, measured.anchor_id, len(measured.cir)) == (1, 2, 16)


# Joins -----------------------------------------------------------------------------------------------------------


MIXED = {"garbage": 0.2, "swap": 0.2, "late": 0.1}


@pytest.mark.parametrize(
    ("faults", "cirs"),
    [({"swap": 1.0}, 395), ({"late": 0.2}, 395), ({"late": 1.0}, 395), ({"garbage": 0.3}, 250), (MIXED, 250)],
)
def test_every_range_arrives_with_its_own_cir_or_without(faults: dict, cirs: int):
    run = bench(**faults).start()
    for sequence in range(1, 400):
        run.exchange(sequence, distance_m=1.0 + sequence / 100)
    run.step(ms=500)
    assert len({m.sequence for m in run.measured_ranges}) > 370
    assert sum(taps_in(m) > 0 for m in run.measured_ranges) > cirs
    assert all(m.range_m == pytest.approx(1.0 + m.sequence / 100) for m in run.measured_ranges)


@pytest.mark.parametrize("is_swapped", [False, True], ids=["range first", "diagnostics first"])
def test_a_damaged_sequence_number_is_not_joined(is_swapped: bool):
    run = bench(swap=float(is_swapped)).start().exchange(*range(1, 101))
    count = len(run.measured_ranges)
    # The range of exchange 101 claims to be 102, whose own range and the diagnostics of 101 are lost.
    packets = [run.range(102, 9.0), run.diagnostics(102)]
    for packet in packets[::-1] if is_swapped else packets:
        run.step(packet, 18)
    run.step(ms=500)
    assert [(m.range_m, len(m.cir)) for m in run.measured_ranges[count:]] == [(9.0, 0)]


@pytest.mark.parametrize("is_reopened", [False, True])
def test_halves_of_two_notifications_are_not_assembled(is_reopened: bool):
    run = Bench(window=64).start().exchange(*range(1, 20))
    first, second = run.diagnostics(20), run.diagnostics(21)
    assert len(first) > 2 * 259 - 100
    run.step(run.range(20), 18)
    run.step(first[:259], 0.1)
    damages = run.session.totals()["damaged"]
    if is_reopened:
        run.start_again()
        assert run.session.totals()["damaged"] == damages, "its halves are discarded"
        return
    run.step(run.range(21) + second[259:], 20)
    run.step(ms=500)
    assert [len(m.cir) for m in run.measured_ranges[-2:]] == [0, 0]


def test_a_range_of_another_session_or_peer_is_ignored():
    run = Bench().start()
    handle, board = run.handle, run.board
    for number, is_swapped in ((handle, True), (handle + 7, False)):
        board.sessions[number] = board.sessions[handle]
        board.faults = UciFaults(swapped_ids=is_swapped)
        run.step(board.range_packet(number, 1, 3.0) + board.diagnostics_packet(number, 1), 18)
    run.step(ms=500)
    assert not run.measured_ranges
    assert run.session.counts["unknown_session"] >= 2
    assert run.port().report().warning.startswith("the only ranges are of other addresses")


def test_ranges_are_published_in_order_and_soon_after_a_lost_cir():
    run = Bench().start().exchange(*range(1, 41))
    run.step(run.range(41), 18)
    run.step(run.board.exchange(run.handle, 42, 3.0), 2.0)
    arrived_ns = run.now_ns
    while run.measured_ranges[-1].sequence < 42:
        run.step(ms=1.0)
    assert run.now_ns - arrived_ns <= 6 * MS
    assert [m.sequence for m in run.measured_ranges] == sorted(m.sequence for m in run.measured_ranges)
    assert [len(m.cir) for m in run.measured_ranges[-2:]] == [0, 16]


def test_repeated_notifications_are_published_once():
    run = Bench().start()
    for sequence in range(1, 101):
        run.step(2 * run.range(sequence) + 2 * run.diagnostics(sequence), 18)
    assert [m.sequence for m in run.measured_ranges] == list(range(1, 101))
    assert all(len(m.cir) == 16 for m in run.measured_ranges)
    assert run.session.counts["duplicates"] == 200


def test_ranges_without_diagnostics_are_published_without_delay():
    run = Bench().start()
    for sequence in range(100):
        run.step(run.range(sequence), 18)
    assert len(run.measured_ranges) == 100
    assert run.measured_ranges[-1].stamp_ns == run.now_ns
    assert str(CirKind.of(run.measured_ranges[-1].cir)) == "DW3000 without CIR"


@pytest.mark.parametrize("masks", [(0x38, 0x40), (0x18, 0x20, 0x40)])
@pytest.mark.parametrize("position", [0, 1, 2])
def test_diagnostics_in_several_notifications_are_joined(masks: tuple[int, ...], position: int):
    run = Bench().start()
    config = run.board.sessions[run.handle].config
    for sequence in range(1, 60):
        parts = []
        for mask in masks:
            config[0xE9] = bytes([mask])
            parts.append(run.diagnostics(sequence))
        parts.insert(position, run.range(sequence))
        for part in parts:
            run.step(part, 18 / len(parts))
    assert len(run.measured_ranges) >= 58
    for measured in run.measured_ranges[6:]:
        assert taps_in(measured) == 16
        assert measured.cir.start_index == FIRST_PATH - 5
    # A board that reports them in one notification again, after other firmware was loaded.
    config[0xE9] = b"\x78"
    count = len(run.measured_ranges)
    run.exchange(*range(60, 120))
    assert run.measured_ranges[-1].sequence == 119
    assert all(len(m.cir) == 16 for m in run.measured_ranges[count + 8 :])


def test_sessions_that_share_a_counter_get_their_cirs():
    run = Bench(peers=(2, 3)).start()
    for sequence in range(1, 201):
        run.exchange(sequence, handle=1 + sequence % 2)
    assert {m.anchor_id for m in run.measured_ranges[-2:]} == {2, 3}
    assert all(len(m.cir) == 16 for m in run.measured_ranges[-60:])
    # A lost range is still a gap in the sequence.
    gaps = run.session.totals()["gaps"]
    run.exchange(205, handle=1 + 205 % 2)
    assert run.session.totals()["gaps"] > gaps


def test_the_benchmark_finds_no_wrong_join_but_would_find_one(monkeypatch: pytest.MonkeyPatch):
    result = uci.joins(1000, 16, 0.05, 0.01, 1, lambda _: None)
    assert (result.wrong, result.exchanges) == (0, 1000)
    assert result.with_cir > 300
    packet = UciBoardModel.diagnostics_packet

    def previous_cir(self, handle: int, sequence: int) -> bytes:
        built = packet(self, handle, sequence - 1)
        return built[:8] + struct.pack("<I", sequence) + built[12:]

    monkeypatch.setattr(DiagnosticsMatcher, "_accept", lambda *_, **__: True)
    monkeypatch.setattr(UciBoardModel, "diagnostics_packet", previous_cir)
    assert uci.joins(200, 16, 0.0, 0.0, 1, lambda _: None).wrong > 100


@pytest.mark.parametrize(
    ("keep", "warning"),
    [
        (lambda packet: packet[:60] + packet[61:], "bytes or notifications are lost between board and host"),
        (lambda packet: packet[:-100], "bytes or notifications are lost between board and host"),
        (lambda packet: b"", "most ranges have no CIR: the firmware may not support it"),
        (lambda packet: packet, "ranging without the parameters that the board rejected"),
    ],
    ids=["lost byte", "lost fragment", "never sent", "sent"],
)
def test_ranges_without_cir_are_explained_by_damages_and_rejected_parameters(keep, warning: str):
    run = Bench(UciBoardModel(rejects=frozenset([0x2D])), window=157).start()
    port = run.port()
    for sequence in range(1, 60):
        port.monitor.add_range(time.monotonic())
        run.step(run.range(sequence), 5.0)
        run.step(keep(run.diagnostics(sequence)), 95.0)
    report = port.report()
    assert report.warning.startswith(warning)
    assert (
        report.values["rejected parameters"] == "BLOCK_STRIDE_LENGTH (0x2d): invalid parameter (status 0x04)"
    )
    assert report.warning.endswith(report.values["rejected parameters"])
    started, logged = port._received(b"", run.now_ns, run.now_ns)
    assert "157 taps" in started.text
    assert (logged.level, logged.text) == (
        logging.WARNING,
        f"ranging without the parameters that the board rejected: {report.values['rejected parameters']}",
    )


def test_failed_exchanges_are_explained_by_their_status():
    run = Bench().start()
    port, packet = run.port(), bytearray(run.range(0))
    causes = {
        0x24: "STS error",
        0x23: "no time of arrival",
        0x22: "PHY decoding error",
        0x21: "reception timeout",
        0x20: "transmission failed",
        0x1B: "negative distance",
        0x77: "status 0x77",
    }
    for packet[4], packet[4 + 27] in enumerate(causes):
        port._received(bytes(packet), run.now_ns, run.now_ns)
    assert port.monitor.totals == dict.fromkeys(causes.values(), 1)
    assert list(port.monitor.totals) == list(causes.values())
    # Next to ranges, only those count that have another cause than the distance.
    now_s = time.monotonic()
    port.monitor.add_range(now_s)
    for cause in list(causes.values())[-4:-1]:
        port.monitor.add_failures(cause, 9, now_s)
    assert "9 of 28 exchanges failed: negative distance: " in port.monitor.warning()
    packet[4], packet[4 + 27], packet[4 + 29 : 4 + 31] = len(causes), 0, b"\xff\xff"
    assert port._received(bytes(packet), run.now_ns, run.now_ns) == []
    assert port.monitor.totals["no distance"] == 1


# Sessions --------------------------------------------------------------------------------------------------------


def test_error_answers_are_repeated_until_the_board_ranges():
    assert bench(errors=0.15).start(100.0).session.counts["error_answers"] > 0


def test_responses_have_no_effect_before_their_command():
    run = Bench()
    run.step(encode_packets(*codes.RANGE_START, b"\0", PacketType.RESPONSE) * 10)
    assert run.session.state


@pytest.mark.parametrize("is_reset", [True, False], ids=["the board", "the session"])
def test_a_board_or_session_that_restarts_ranges_again_and_keeps_its_counts(is_reset: bool):
    run = Bench().start().exchange(1, 2, 3)
    before = run.session.totals()
    run.board.sessions[run.handle].active = False
    run.step(run.board.boot() if is_reset else run.board._state(run.handle, 3))
    run.start().exchange(1, 2)
    assert run.session.starts == 2
    assert [m.sequence for m in run.measured_ranges] == [1, 2, 3, 1, 2]
    assert all(run.session.totals()[name] >= count for name, count in before.items())


class Ending(UciBoardModel):
    """Ends each session 50 ms after its start, with a reason."""

    reason = 0x02
    set_calibrations = 0
    ending = None

    def _command(self, name, payload, now_s):
        self.set_calibrations += name == codes.SET_CALIBRATION
        answer = super()._command(name, payload, now_s)
        if name == codes.RANGE_START:
            self.end_s, self.ending = now_s + 0.05, struct.unpack_from("<I", payload)[0]
        return answer

    def receive(self, data, now_s):
        ended = b""
        if self.ending in self.sessions and now_s >= self.end_s:
            self.sessions[self.ending].active = False
            status = struct.pack("<IBB", self.ending, 3, self.reason)
            self.ending, ended = None, self._notify(codes.SESSION_STATUS, status)
        return ended + super().receive(data, now_s)


def test_a_session_that_ends_by_itself_is_started_again_with_growing_pauses_and_without_writes():
    run = Bench(Ending(), window=157).start()
    assert run.board.set_calibrations == 2
    texts = set()
    for _ in range(int(60 / 0.005)):
        run.step()
        texts.add(run.session.state)
    # After 0.5, 1, 2, 4, 8, 16 and 30 s.
    assert run.session.counts["restarts"] == 6
    assert run.board.set_calibrations == run.session.counts["calibration_writes"] == 2
    (waiting,) = [text for text in texts if text.endswith("after 16 s")]
    assert "the session with 2: maximum number of measurements (reason 0x02)" in waiting
    assert not any("no answer to the reset" in text for text in texts)


@pytest.mark.parametrize(
    ("reason", "text"),
    [
        (0x02, "maximum number of measurements"),
        (0x42, "initiation time"),
        (0x9F, "manufacturer"),
        (0x77, "unknown"),
    ],
)
def test_a_session_that_ends_without_having_been_active_shows_its_reason(reason: int, text: str):
    class Silent(Ending):
        def _state(self, handle, state):
            return b"" if state == 2 else super()._state(handle, state)

    Silent.reason = reason
    state = Bench(Silent()).start().wait(0.5).session.state
    assert text in state
    assert f"(reason 0x{reason:02x})" in state


def test_a_refused_start_is_repeated_with_growing_pauses():
    starts = []
    refusing = Answering({codes.SESSION_INIT: lambda _: starts.append(1) or b"\x14"})
    state = Bench(refusing).wait(20.0).session.state
    assert len(starts) <= 2 * 6
    assert "the board refuses SESSION_INIT: too many sessions (status 0x14)" in state


def test_one_session_that_ends_does_not_stop_the_others():
    run = Bench(peers=(2, 3)).start()
    first, second = run.board.sessions
    run.board.sessions[first].active = False
    run.step(run.board._state(first, 3))
    assert run.session.state
    for sequence in range(1, 60):
        run.exchange(sequence, handle=second)
        assert second in run.board.sessions
    assert run.session.state == ""
    assert len(run.measured_ranges) >= 58


def test_a_second_session_that_is_refused_is_tried_again_while_the_first_ranges():
    refusals = [b"\x12"] * 3
    busy, states = Answering({}), set[str]()
    busy.answers[codes.SESSION_INIT] = lambda _: refusals.pop() if busy.sessions and refusals else None
    busy._rejects = frozenset([0x13])
    run = Bench(busy, peers=(2, 3))
    for number in range(400):
        run.step()
        states.add(run.session.state)
        for handle, session in list(busy.sessions.items()):
            if session.active and handle in busy.sessions:
                run.step(busy.range_packet(handle, number, 3.0))
    assert run.session.state == ""
    assert {measured.anchor_id for measured in run.measured_ranges} == {2, 3}
    # The refusal is not explained by a parameter of the first session that the board rejects.
    assert run.session.ranging.rejected
    assert [state for state in states if "refuses SESSION_INIT" in state]
    assert not [state for state in states if "rejects" in state]


def test_a_silent_board_is_started_again_but_a_waiting_anchor_is_not():
    run = Bench(**ANCHOR).start().wait(10.0)
    assert run.session.starts == 1
    assert b"\x21\x06\0\x04" in run.sent, "GET_SESSION_STATE of FiRa"
    run.board.receive = lambda data, now_s: b""
    assert run.wait(10.0).session.state


def test_an_anchor_without_its_tag_waits_if_the_board_cannot_report_its_state():
    run = Bench(Answering({codes.GET_SESSION_STATE: b"\x08"}), **ANCHOR).start().wait(10.0)
    assert run.session.starts == 1
    assert run.exchange(1).wait(10.0).session.starts == 2


@pytest.mark.parametrize("tag", [0x00, 0x06, 0x07, 0x11, 0x1B])
def test_a_parameter_without_which_a_board_does_not_range_is_named(tag: int):
    problem = "a parameter is missing (status 0x15)" if tag == 0x1B else "refuses SET_APP_CONFIG"
    state = Bench(UciBoardModel(rejects=frozenset([tag]))).wait_for(problem)
    assert problem in state
    assert f"it rejects {codes.parameter_name(tag)}: invalid parameter (status 0x04)" in state


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (b"error \r\n\r\nerror\r\n", "answers with text ('error"),
        (b"\r\n> unknown command\r\n", "answers with text ('> unknown command'): flash the UCI image"),
        (b"\x81\x00\xff\x13" * 4, "no answer to the reset: is this a board with UCI firmware?"),
    ],
)
def test_a_board_that_answers_with_text_is_not_called_mute(line: bytes, text: str):
    run = Bench()
    run.board.receive = lambda data, now_s: line if data else b""
    assert text in run.wait_for("CLI image")


@given(st.binary(max_size=600), st.integers(1, 40))
@settings(max_examples=100)
def test_no_bytes_make_a_session_fail(data: bytes, piece: int):
    run = Bench().start()
    good = run.range(1)
    for position in range(0, len(data), piece):
        run.step(data[position : position + piece])
    # A damaged length may hide up to 255 bytes; after a timeout the decoder searches inside of them.
    for _ in range(300):
        run.step(ms=2 * MAX_GAP_NS / MS)
    counts = run.session._decoder.counts
    before = counts["messages"]
    run.step(good)
    assert counts["messages"] > before


@given(st.binary(max_size=300))
@settings(max_examples=300)
def test_no_payload_makes_a_parser_fail(data: bytes):
    for parse in (messages.parse_ranges, messages.parse_diagnostics):
        with contextlib.suppress(LinkError):
            parse(data)
    messages.calibration_values(data)
    messages.rejected_tags(data)


@given(st.data())
@settings(max_examples=200)
def test_damaged_diagnostics_are_parsed_or_refused(data: st.DataObject):
    damaged_payload = bytearray(DIAGNOSTICS_PAYLOAD)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged_payload[data.draw(st.integers(0, len(damaged_payload) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(LinkError):
        content = messages.parse_diagnostics(bytes(damaged_payload))
        assert len(read_cir(content, 9, np.nan).cir.samples) % 2 == 0


DIAGNOSTICS_PAYLOAD = Bench().start().diagnostics(1)[4:]


# Unusual boards --------------------------------------------------------------------------------------------------


class OneKey(UciBoardModel):
    """Sets one calibration key per command."""

    def __init__(self) -> None:
        super().__init__(count_bytes=1)

    def _set_calibration(self, payload):
        return payload[0] == 1 and super()._set_calibration(payload)


def unnamed() -> UciBoardModel:
    """Refuses a whole packet of parameters without naming the one that it does not know."""
    return Answering({codes.SET_APP_CONFIG: lambda data: b"\x04" if data[4] > 1 or data[5] == 0x35 else None})


def one_by_one() -> UciBoardModel:
    """Names only the first of several unknown parameters."""

    def answer(payload: bytes) -> bytes | None:
        known = ((tag, bytes([tag, 2 if tag == 0x32 else 1])) for tag in (0x2C, 0x32, 0x35))
        return next((bytes([0x04, 1, tag, 0x04]) for tag, entry in known if entry in payload), None)

    return Answering({codes.SET_APP_CONFIG: answer})


class NoReset(UciBoardModel):
    """Refuses the reset while the session of an earlier host exists."""

    def _command(self, name, payload, now_s):
        number = struct.unpack_from("<I", payload)[0] if len(payload) >= 4 else 0
        existing = [handle for handle, session in self.sessions.items() if session.number == number]
        if name == codes.RESET:
            return self._respond(name, b"\x01")
        if name == codes.SESSION_INIT and existing:
            return self._respond(name, b"\x13")
        if name == codes.SESSION_DEINIT and existing:
            payload = struct.pack("<I", existing[0])
        return super()._command(name, payload, now_s)


class OnlyReady(UciBoardModel):
    """Answers a reset only with the status of the device."""

    def _command(self, name, payload, now_s):
        answer = super()._command(name, payload, now_s)
        return answer[:5] if name == codes.RESET else answer


class Numbers(UciBoardModel):
    """Puts the number of the session into notifications, not its handle."""

    def _notify(self, name, payload):
        sent = super()._notify(name, payload)
        position = {codes.RANGE_START: 8, codes.RANGE_DIAGNOSTICS: 4, codes.SESSION_STATUS: 4}.get(name)
        if position is None:
            return sent
        (handle,) = struct.unpack_from("<I", sent, position)
        number = self.sessions[handle].number if handle in self.sessions else handle
        return sent[:position] + struct.pack("<I", number) + sent[position + 4 :]


class Late(UciBoardModel):
    """Answers 0.3 s after each command."""

    def receive(self, data, now_s):
        answers, self.answers = getattr(self, "answers", []), []
        self.answers = [(due, answer) for due, answer in answers if due > now_s]
        if answer := super().receive(data, now_s):
            self.answers.append((now_s + 0.3, answer))
        return b"".join(answer for due, answer in answers if due <= now_s)


class Chatty(UciBoardModel):
    """Sends notifications and fields that no source describes, and bytes after the ranges."""

    def _notify(self, name, payload):
        if name == codes.RANGE_START:
            payload += b"\1\2\3"
        if name == codes.RANGE_DIAGNOSTICS:
            payload = payload[:12] + bytes([payload[12] + 1, 0x77, 3, 0, 1, 2, 3]) + payload[13:]
        return encode_packets(0xA, 0x3E, b"new", PacketType.NOTIFICATION) + super()._notify(name, payload)


class Active(UciBoardModel):
    """Does not answer the first start, and refuses the second one."""

    def _command(self, name, payload, now_s):
        if name == codes.RANGE_START and any(session.active for session in self.sessions.values()):
            return self._respond(name, b"\x13")
        answer = super()._command(name, payload, now_s)
        return answer[5:] if name == codes.RANGE_START else answer


class Extended(UciBoardModel):
    """Reports addresses of eight bytes."""

    def _notify(self, name, payload):
        if name == codes.RANGE_START:
            payload = payload[:15] + b"\1" + payload[16:27] + bytes(6) + payload[27:-6]
        return super()._notify(name, payload)


class NoHandle(UciBoardModel):
    """Sends no handle: the number of the session is used."""

    def _command(self, name, payload, now_s):
        answer = super()._command(name, payload, now_s)
        if name == codes.SESSION_INIT:
            (number,) = struct.unpack_from("<I", payload)
            self.sessions[number] = self.sessions.pop(self._handles)
            answer = self._respond(name, b"\0")
        return answer


class Slow(UciBoardModel):
    """Is ready 0.4 s after a reset."""

    ready_s = 0.0

    def receive(self, data, now_s):
        if now_s < self.ready_s:
            return b""
        ready = self._notify(codes.DEVICE_STATUS, b"\1") if self.ready_s else b""
        self.ready_s = 0.0
        if data.startswith(encode_packets(*codes.RESET, b"\0")):
            self.ready_s = now_s + 0.4
            self.sessions.clear()
            return self._respond(codes.RESET, b"\0")
        return ready + super().receive(data, now_s)


@pytest.mark.parametrize(
    ("board", "rejected"),
    [
        *((board, set()) for board in (NoHandle, Slow, OneKey, NoReset, OnlyReady, Numbers, Late, Chatty)),
        *((Active, set()), (Extended, set()), (unnamed, {0x35}), (one_by_one, {0x2C, 0x32, 0x35})),
    ],
)
def test_boards_that_the_facts_allow_range_with_their_cir(
    board: Callable[[], UciBoardModel], rejected: set[int]
):
    model = board()
    model.sessions[7] = _Session(1 << 16 | 2, {})
    run = Bench(model, window=157).start()
    assert run.session.window == (157, 5)
    assert run.session.starts == 1
    run.exchange(*range(1, 20), handle=max(model.sessions))
    assert [m.range_m for m in run.measured_ranges] == [3.0] * 19
    assert {taps_in(m) for m in run.measured_ranges} == {157}
    assert run.session.ranging.rejected.keys() == rejected


# Calibration -----------------------------------------------------------------------------------------------------


def test_firmware_that_refuses_the_number_of_taps_gets_the_lead():
    refusing = Answering({codes.SET_CALIBRATION: lambda data: b"\x04" if b"\2\x9d\0" in data else None})
    assert Bench(refusing, window=157).start().session.window == (16, 5)


@pytest.mark.parametrize("max_taps", [64, 157], ids=["not accepted", "accepted"])
def test_calibration_is_written_only_if_it_differs_and_restored_at_the_end(max_taps: int):
    run = Bench(UciBoardModel(max_taps=max_taps), window=157).start()
    for _ in range(3):
        assert run.session.window == (max_taps, 5)
        assert run.session.counts["calibration_writes"] == 2
        run.start_again()
    assert run.stop() == UciBoardModel()._calibration
    assert not run.board.sessions
    # A board that has the values already, as after another driver was killed, is not written to.
    ready = UciBoardModel()
    ready._calibration = dict(zip(ready._calibration, (157, 5), strict=True))
    # Neither is a board that cannot report a key.
    unreadable = Answering({codes.GET_CALIBRATION: b"\x01"})
    for board in (ready, unreadable):
        assert Bench(board, window=157).start().session.counts["calibration_writes"] == 0


@pytest.fixture
def killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> UciBoardModel:
    """Return a board with the window of a driver that was killed, whose locks the kernel has released."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    originals = OriginalsFile("/dev/ttyACM0")
    run = Bench(originals=originals, window=157).start()
    assert tuple(run.board._calibration.values()) == (157, 5)
    originals.close()
    return run.board


def restarted(board: UciBoardModel, port: str = "/dev/ttyACM0") -> Bench:
    """Return the next driver of a board."""
    return Bench(board, OriginalsFile(port), window=157).start()


@pytest.mark.parametrize("port", ["/dev/ttyACM0", "/dev/ttyACM1"])
def test_calibration_is_restored_after_the_driver_was_killed(
    killed: UciBoardModel, tmp_path: Path, port: str
):
    assert restarted(killed, port).stop() == UciBoardModel()._calibration
    assert not list(tmp_path.rglob("*.json"))


def test_calibration_at_a_port_in_use_is_not_that_of_another_board_with_its_id(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    program = (
        f"import time; from {OriginalsFile.__module__} import OriginalsFile; file = OriginalsFile('/dev/ttyACM0'); "
        "file.load('board'); file.save({'key': (16, [157])}); print(1, flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as driver:
        driver.stdout.readline()
        assert OriginalsFile("/dev/ttyACM1").load("board") == {}
        driver.kill()
    assert OriginalsFile("/dev/ttyACM1").load("board") == {"key": (16, [157])}


@pytest.mark.parametrize("silent", [codes.GET_CALIBRATION, codes.SET_CALIBRATION], ids=["read", "write"])
def test_original_calibration_is_kept_until_it_was_restored(killed: UciBoardModel, silent: tuple[int, int]):
    run, usual = restarted(killed), killed._command
    killed._command = lambda name, *rest: b"" if name == silent else usual(name, *rest)
    assert run.stop()[TAPS] == 157
    killed._command = usual
    assert restarted(killed).stop() == UciBoardModel()._calibration


def test_calibration_that_another_program_has_changed_is_kept(killed: UciBoardModel):
    killed._calibration[TAPS] = 64
    assert restarted(killed).stop()[TAPS] == 64


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"format": 2, "keys": {}}', '{"format": 1, "keys": {"a": 1}}']
)
def test_damaged_files_of_the_calibration_are_ignored(killed: UciBoardModel, tmp_path: Path, text: str):
    (path,) = tmp_path.rglob("*.json")
    path.write_text(text)
    assert restarted(killed).session.window == (157, 5)


# Captures --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", RecordingError),
        ("0.1 0 < 00", RecordingError),
        (f"{FIRST_LINE}\n0.1 0 < 00", DamagedRecordingError),
        (f"{FIRST_LINE}\nboard 0 {{", DamagedRecordingError),
        (TAG_LINES.replace("2", "1"), DamagedRecordingError),
        (f"{TAG_LINES}inf 0 < 00", DamagedRecordingError),
        (f"{TAG_LINES}1 0 < 0g", DamagedRecordingError),
        (f"{FIRST_LINE}\n" + "9" * 400_000, DamagedRecordingError),
    ],
)
def test_a_capture_that_is_damaged_is_refused(tmp_path, text: str, error: type):
    path = tmp_path / "session.txt"
    path.write_text(text)
    with pytest.raises(error):
        list(open_capture(path))


def test_a_capture_ends_at_its_limit_and_ignores_what_comes_after_its_end(tmp_path):
    writer = CaptureWriter(tmp_path / "session.txt", limit_bytes=200)
    for _ in range(2):
        for _ in range(20):
            writer.add(0, bytes(20), sent=False)
        writer.close()
    assert 100 < (tmp_path / "session.txt").stat().st_size <= 200


def test_a_capture_replays_the_same_measurements(tmp_path):
    run = Bench()
    writer = CaptureWriter(tmp_path / "session.txt")
    writer.add_board(0, asdict(run.session.settings) | {"role": "TAG"})
    receive = run.session.receive

    def recorded(data: bytes, now_ns: int, stamp_ns: int) -> list[RangeMeasurement]:
        writer.add(0, data, sent=False)
        return receive(data, now_ns, stamp_ns)

    run.session.receive = recorded
    run.start().exchange(*range(1, 30))
    writer.close()
    capture = open_capture(tmp_path / "session.txt")
    for _ in range(2):
        replayed = [record.measurement for record in capture]
        assert [m.sequence for m in replayed] == [m.sequence for m in run.measured_ranges]
        assert all(taps_in(measured) == 16 for measured in replayed)
