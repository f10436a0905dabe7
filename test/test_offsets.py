"""Offsets of radios: file, precedence, effect on a range, and transfer to a board."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from model_material import bundle, measurement

from benchmarks.equipment.board import Board
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.radios.wire.events import Refused
from uwb_mitigation.radios.wire.framing import WireFrame
from uwb_mitigation.radios.wire.layout import MAX_OFFSETS, MessageType, Mode
from uwb_mitigation.radios.wire.messages import Correction, Hello
from uwb_mitigation.radios.wire.session import MAX_TRIES, REQUEST_INTERVAL_NS, BoardSession
from uwb_mitigation.types.measurement import CorrectedBy, CorrectedRange, RangeMeasurement, Status
from uwb_mitigation.types.offsets import (
    MAX_ENTRIES,
    MAX_OFFSET_M,
    NO_OFFSETS,
    Offsets,
    dump_offsets,
    parse_offsets,
    read_offsets,
)

TEXT = """\
default: 0.5
anchors: {1: 0.25, 0x1f: 0.125}
tags: {7: -0.0625}
pairs:
  - {anchor: 1, tag: 7, offset: 1.5}
"""


def test_most_specific_offset_applies_and_radio_offsets_add_up():
    offsets = parse_offsets(TEXT, "x")
    assert offsets.lookup([7, 7, 8, 7, 8], [1, 31, 1, 9, 9]).tolist() == [1.5, 0.0625, 0.25, -0.0625, 0.5]
    unknown = np.array([8, 2**64 - 1], np.uint64)
    assert offsets.lookup(unknown, unknown).tolist() == [0.5, 0.5]


def test_written_offsets_are_read_back():
    offsets = parse_offsets(TEXT, "x")
    assert parse_offsets(dump_offsets(offsets, "found\nso"), "y") == offsets
    assert not parse_offsets(dump_offsets(NO_OFFSETS), "y")
    assert offsets


def test_parameter_is_a_number_or_a_file(tmp_path: Path):
    assert read_offsets("") is NO_OFFSETS
    assert read_offsets(" 0.22 ").lookup([1], [2]) == np.float32(0.22)
    path = tmp_path / "offsets.yaml"
    path.write_text(TEXT, encoding="utf-8")
    assert read_offsets(str(path)) == parse_offsets(TEXT, "x")
    with pytest.raises(ParameterError, match=r"none\.yaml: no such file.*metres"):
        read_offsets(str(tmp_path / "none.yaml"))
    path.write_bytes(b"\xff\xfe\xff")
    with pytest.raises(ParameterError, match="not a text file"):
        read_offsets(str(path))


@pytest.mark.parametrize(
    ("text", "excerpt"),
    [
        ("", "not a file of offsets"),
        ("[0.2]", "not a file of offsets"),
        ("{", "not YAML"),
        ("default: yes", "default = True.*metres"),
        ("default: .nan", "default = nan"),
        ("default: 220", "default = 220 m: are these millimetres"),
        ("default: -220", "default = -220 m: are these millimetres"),
        ("default: 1.0e+9", "-10 to 10 m"),
        ("default: '0.2'", "a number of metres"),
        ("offset: 0.2", "unknown key 'offset'.*default, anchors, tags, pairs"),
        ("anchors: [1, 2]", "id: metres"),
        ("anchors: {a: 0.2}", "id 'a'.*64-bit"),
        ("anchors: {-1: 0.2}", "id -1"),
        ("anchors: {18446744073709551616: 0.2}", "id 18446744073709551616"),
        ("tags: {1: .inf}", "tags: 1 = inf"),
        ("anchors: {1: 0.1, 0x1: 0.2}", "duplicate key 1"),
        ("default: 0.1\ndefault: 0.2", "duplicate key 'default' in line 2"),
        ("pairs: {1: 2}", "pairs = "),
        ("pairs: [{anchor: 1, tag: 2}]", "entry 1.*not a pair.*anchor, tag, offset"),
        (
            "pairs: [{anchor: 1, tag: 2, offset: 0.1}, {anchor: 1, tag: 2, offset: 0.2}]",
            "entry 2.*duplicate pair",
        ),
    ],
)
def test_malformed_offsets_file_is_refused(text: str, excerpt: str):
    with pytest.raises(ParameterError, match=excerpt) as caught:
        parse_offsets(text, "site.yaml")
    assert "site.yaml" in str(caught.value)


@pytest.mark.parametrize(
    ("options", "excerpt"),
    [
        ({"anchors": dict.fromkeys(range(MAX_ENTRIES), 0.1)}, f"{MAX_ENTRIES + 1} offsets"),
        ({"pair_sd": {(1, 2): 0.0}}, "sd = 0.0 m of anchor 2, tag 1"),
        ({"pair_sd": {(1, 2): MAX_OFFSET_M + 1.0}}, "sd = "),
    ],
)
def test_offsets_out_of_the_limits_are_refused(options: dict, excerpt: str):
    with pytest.raises(ParameterError, match=excerpt):
        Offsets(**{"pairs": {(1, 2): 0.1}} | options)


def test_largest_offsets_and_standard_deviations_are_accepted_and_compared():
    widest = {"pairs": {(1, 2): -MAX_OFFSET_M}, "pair_sd": {(1, 2): MAX_OFFSET_M}}
    offsets = Offsets(MAX_OFFSET_M, dict.fromkeys(range(MAX_ENTRIES - 1), 0.1), **widest)
    assert str(offsets) == f"{MAX_OFFSET_M:g} m, and {MAX_ENTRIES} of anchors, tags and pairs"
    small, large = Offsets(0.1), Offsets(0.2)
    assert small == Offsets(0.1)
    assert small != large
    assert large != small


@pytest.fixture(scope="module")
def subject(tmp_path_factory) -> Mitigation:
    return Mitigation(bundle(tmp_path_factory.mktemp("bundle"), Remnet(samples=157)))


def test_offset_is_subtracted_in_addition_to_the_predicted_error(subject: Mitigation):
    offset = 0.25
    plain, moved = subject.correct([measurement(3.0)])[0], measurement(3.25)
    result = Mitigation(subject.bundle, Offsets(offset)).correct([moved])[0]
    assert result.status is Status.OK
    assert result.range_raw_m == 3.25
    assert result.correction_m == pytest.approx(plain.correction_m + offset, abs=1e-6)
    assert result.range_m == np.float32(3.25) - np.float32(result.correction_m)
    assert result.range_m == pytest.approx(plain.range_m, abs=1e-6)
    assert result.variance_m2 == plain.variance_m2


@pytest.mark.parametrize(
    ("range_m", "offset", "expected", "valid"),
    [
        (3.0, 0.5, 2.5, True),
        (0.25, 0.5, -0.25, False),
        (-0.25, -0.5, 0.25, True),
        (math.nan, 0.5, math.nan, False),
    ],
)
def test_passed_through_range_has_the_offset_subtracted(
    subject: Mitigation, range_m: float, offset: float, expected: float, valid: bool
):
    bad = measurement(range_m)
    bad = replace(bad, cir=replace(bad.cir, preamble_count=0))
    result = Mitigation(subject.bundle, Offsets(offset)).correct([bad])[0]
    assert result.status is Status.BAD_CIR
    assert str(result.range_m) == str(expected)
    assert result.correction_m == offset
    assert str(result.range_raw_m) == str(range_m)
    assert math.isfinite(result.variance_m2) is valid


class Echo:
    """Corrects only the offset."""

    def __init__(self) -> None:
        self.offsets = Offsets(9.0)

    def correct(self, measurements: list[RangeMeasurement]) -> list[CorrectedRange]:
        (asked,) = measurements
        offset_m = float(self.offsets.lookup([asked.tag_id], [asked.anchor_id])[0])
        range_m = asked.range_m
        return [CorrectedRange(range_m - offset_m, range_m, offset_m, 1.0, Status.OK, CorrectedBy.DEVICE, 5)]


class OlderBoard(Board):
    """A board whose firmware ignores offsets."""

    def _answer(self, frame: WireFrame, now_us: int) -> bytes:
        return b"" if frame.type == MessageType.SET_OFFSETS else super()._answer(frame, now_us)


class Pair:
    """A session connected to a board."""

    def __init__(self, offsets: Offsets, board: type[Board] = Board) -> None:
        self.session = BoardSession()
        self.board_class = board
        self.now = 0
        self.events: list[object] = []
        self.start()
        self.session.set_offsets(offsets)

    def start(self, boot: int = 1) -> None:
        self.board = self.board_class(Hello(model_id=5), Echo(), mode=Mode.DEVICE, boot_id=boot)
        self.deliver(self.board.hello(self.now))

    def deliver(self, data: bytes) -> None:
        self.events += self.session.receive(data, self.now, self.now)

    def turn(self) -> None:
        self.now += REQUEST_INTERVAL_NS
        self.deliver(b"")
        self.deliver(self.board.receive(self.session.outgoing(), self.now // 1000))

    def range(self) -> list[float]:
        before = len(self.events)
        self.deliver(self.board.measure(measurement(3.0), self.now // 1000))
        return [event.corrected.range_m for event in self.events[before:] if isinstance(event, Correction)]


def test_board_subtracts_the_offsets_of_the_host_also_after_a_restart():
    pair = Pair(Offsets(0.25))
    assert pair.range() == []
    assert pair.session.counts["wrong_offsets"] == 1
    pair.turn()
    assert pair.range() == [2.75]
    pair.start(boot=2)
    assert pair.range() == []
    pair.turn()
    assert pair.range() == [2.75]
    pair.session.set_offsets(NO_OFFSETS)
    pair.turn()
    assert pair.range() == [3.0]
    assert not [event for event in pair.events if isinstance(event, Refused)]


@pytest.mark.parametrize(("offsets", "refusals", "ranges"), [(Offsets(0.25), 1, []), (NO_OFFSETS, 0, [3.0])])
def test_older_board_is_accepted_only_without_offsets(offsets: Offsets, refusals: int, ranges: list[float]):
    pair = Pair(offsets, OlderBoard)
    for _ in range(MAX_TRIES + 3):
        pair.turn()
    refused = [event for event in pair.events if isinstance(event, Refused)]
    assert len(refused) == refusals
    assert all("flash a newer" in event.text for event in refused)
    assert pair.range() == ranges


def test_too_many_offsets_for_a_board_are_refused_with_both_numbers():
    pair = Pair(Offsets(anchors=dict.fromkeys(range(MAX_OFFSETS + 1), 0.1)))
    pair.turn()
    (refused,) = [event for event in pair.events if isinstance(event, Refused)]
    assert f"can store {MAX_OFFSETS} offsets, but {MAX_OFFSETS + 1}" in refused.text
    assert pair.range() == []
