"""A session with a board: handshake, versions, modes, stamps, losses; time and bytes are simulated."""

import logging

import numpy as np
import pytest

from benchmarks.equipment.board import Board
from uwb_mitigation.radios.settings import PortMessage, RadioSettings
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.radios.wire.framing import FrameDecoder, FrameEncoder, WireFrame
from uwb_mitigation.radios.wire.layout import MAX_OFFSETS, Flag, LogLevel, MessageType, Mode
from uwb_mitigation.radios.wire.messages import BoardStatus, Correction, Hello, Log
from uwb_mitigation.radios.wire.session import BoardSession, Event, LinkState, Loss, Refused
from uwb_mitigation.types.measurement import Cir, CorrectedBy, CorrectedRange, RangeMeasurement, Status
from uwb_mitigation.types.offsets import NO_OFFSETS, Offsets

MS = 10**6
EPOCH = 1_760_000_000 * 10**9
IDENTITY = Hello(board_id=0xB0, model_id=0xCAFE, window=157, firmware_name="simulated")


class HalfMetre:
    """A model that predicts an error of 0.5 m for every range."""

    def correct(self, measurements: list[RangeMeasurement]) -> list[CorrectedRange]:
        source = Status.OK, CorrectedBy.HOST, IDENTITY.model_id
        return [CorrectedRange(m.range_m - 0.5, m.range_m, 0.5, 0.01, *source) for m in measurements]


def measurement(sequence: int) -> RangeMeasurement:
    cir = Cir(np.arange(314, dtype=np.int16), preamble_count=9)
    return RangeMeasurement(77, 1, 2, sequence, 1000 + sequence, 4.0, cir)


class Bench:
    """A session and a board connected without delay; the board boots at time 0."""

    def __init__(self, session: BoardSession, corrector: HalfMetre | None = None, **board: object) -> None:
        self.session = session
        self.now = 0
        self.booted = 0
        self.board = Board(IDENTITY, corrector, **board)
        self.events: list[Event] = session.opened(0)

    @property
    def uptime_us(self) -> int:
        return (self.now - self.booted) // 1000

    def host_hears(self, data: bytes) -> list[Event]:
        events = self.session.receive(data, self.now, EPOCH + self.now)
        self.events += events
        return events

    def run(self, milliseconds: int, deaf: bool = False) -> None:
        """Advance time in steps of 10 ms; `deaf`: the board receives nothing."""
        for _ in range(milliseconds // 10):
            self.now += 10 * MS
            self.events += self.session.tick(self.now, EPOCH + self.now)
            request = self.session.outgoing()
            answer = b"" if deaf else self.board.receive(request, self.uptime_us)
            self.host_hears(answer + self.board.tick(self.uptime_us))

    def measure(self, sequence: int, late_ns: int = 0) -> list[Event]:
        data = self.board.measure(measurement(sequence), self.uptime_us)
        self.now += late_ns
        return self.host_hears(data)

    def reboot(self, boot_id: int = 2, **board: object) -> None:
        self.booted = self.now
        self.board = Board(IDENTITY, HalfMetre(), boot_id=boot_id, **board)

    def received(self, kind: type) -> list[Event]:
        return [event for event in self.events if isinstance(event, kind)]


def connected(**session: object) -> Bench:
    bench = Bench(BoardSession(**session), HalfMetre())
    bench.run(500)
    assert bench.session.state is LinkState.READY
    return bench


def test_messages_before_hello_are_counted_and_a_request_connects():
    bench = Bench(BoardSession())
    assert bench.host_hears(b"boot: radio ok\r\n" + bench.board.measure(measurement(1), 0)) == []
    assert bench.session.counts["withheld"] == 1
    bench.run(20)
    assert [type(event) for event in bench.events] == [Hello]
    assert (bench.session.hello.firmware_name, bench.session.hello.window) == ("simulated", 157)


def test_lost_request_for_a_mode_is_repeated():
    bench = connected()
    bench.session.set_mode(Mode.DEVICE)
    bench.run(800, deaf=True)
    bench.run(600)

    assert bench.received(PortMessage) == [PortMessage(logging.INFO, "the board is in mode DEVICE")]
    assert not connected(mode=Mode.HOST).received(PortMessage), "it is in this mode already"


class Correcting(Board):
    mode = property(lambda board: Mode.DEVICE, lambda board, value: None)


@pytest.mark.parametrize(
    ("wanted", "board", "corrector", "modes"),
    [
        (Mode.DEVICE, Board, None, "HOST instead of DEVICE"),
        (Mode.HOST, Correcting, HalfMetre(), "DEVICE instead of HOST"),
    ],
    ids=["without a model", "another firmware"],
)
def test_board_that_keeps_its_mode_is_asked_and_reported_once(wanted, board, corrector, modes):
    bench = Bench(BoardSession(mode=wanted))
    bench.board = board(IDENTITY, corrector)
    bench.run(3000)

    (refused,) = bench.received(PortMessage)
    assert refused.text.startswith(f"the board stays in mode {modes}")
    assert len(bench.measure(1)) == 1


def test_corrections_by_another_model_than_expected_are_withheld():
    bench = connected(mode=Mode.DEVICE, expected_model_id=0xBEEF)

    assert bench.measure(1) == []
    assert not bench.session.model_matches
    assert bench.session.counts["wrong_model"] == 1


def test_board_of_another_version_is_reported_once_and_ignored_until_it_has_the_right_firmware():
    bench = Bench(BoardSession(), version=7)
    bench.run(5000)
    assert [event.text[:26] for event in bench.events] == ["the board uses version 7 o"]
    assert bench.session.state is LinkState.WRONG_VERSION
    assert bench.session.foreign_version == 7
    assert bench.session.idle_ns(bench.now) < 1000 * MS
    assert bench.measure(1) == []

    bench.reboot()
    bench.run(1000)
    assert bench.session.state is LinkState.READY
    assert bench.session.foreign_version is None


def test_board_times_out_after_3_s_and_reconnects():
    bench = connected()
    sleeping, bench.board = bench.board, Board(IDENTITY, version=1)
    for _ in range(310):
        bench.now += 10 * MS
        bench.events += bench.session.tick(bench.now, EPOCH + bench.now)
        bench.session.outgoing()
    assert bench.received(Loss) == [Loss.TIMEOUT]
    assert bench.session.idle_ns(bench.now) > 3000 * MS

    bench.board = sleeping
    bench.run(600)

    assert bench.session.state is LinkState.READY


def test_boot_id_reveals_a_reset_after_which_clock_and_mode_are_set_again():
    bench = connected(mode=Mode.DEVICE)
    bench.run(10_000)
    # A status once a second keeps a board without measurements connected.
    assert len(bench.received(BoardStatus)) >= 10
    bench.reboot()
    bench.host_hears(bench.board.hello(0))

    assert bench.events[-2:] == [Loss.RESET, bench.received(Hello)[-1]]
    assert len(bench.received(Loss)) == 1
    bench.run(1000)
    took_place = EPOCH + bench.now
    (event,) = bench.measure(1, late_ns=20 * MS)
    assert isinstance(event, Correction)
    assert event.stamp_ns == pytest.approx(took_place, abs=0.1 * MS)


def test_frame_numbers_reveal_a_reset_whose_hello_is_lost():
    bench = connected()
    bench.run(20_000)
    bench.reboot()
    bench.board.hello(0)
    for sequence in range(3):
        bench.measure(sequence)
    assert bench.received(Loss) == [Loss.OUT_OF_SEQUENCE]

    bench.run(100)

    assert bench.session.state is LinkState.READY


def test_missing_frames_are_counted_and_a_repeated_one_is_delivered_once():
    bench = connected()
    bench.measure(1)
    for lost in range(4):
        bench.board.measure(measurement(lost), 0)
    data = bench.board.measure(measurement(6), bench.uptime_us)

    assert len(bench.host_hears(data + data)) == 1
    assert (bench.session.counts["lost"], bench.session.counts["stale"]) == (4, 1)


def connected_to(bench: Bench, first: int = 0) -> FrameEncoder:
    """Replace the board by another one, whose HELLO has the given frame number; return its encoder."""
    encoder = FrameEncoder()
    encoder.sequence = first
    bench.host_hears(encoder.encode(*messages.encode(Hello(0xB0, boot_id=9))))
    return encoder


def test_frame_numbers_wrap():
    bench = connected()
    encoder = connected_to(bench, 2**32 - 1)

    events = bench.host_hears(encoder.encode(*messages.encode(Log(LogLevel.INFO, "wrapped"))))

    assert events == [Log(LogLevel.INFO, "wrapped")]
    assert bench.session.counts["lost"] == 0


CORRECTION = Correction(0, 1, 2, 3, 4, HalfMetre().correct([measurement(1)])[0])


@pytest.mark.parametrize(
    ("kind", "flags", "payload", "counted"),
    [
        (99, 0, b"from the future", {"unknown_type": 1}),
        (MessageType.GET_INFO, 0, b"", {"unknown_type": 1}),
        (MessageType.RANGE_CIR, 0, b"short", {"malformed": 1}),
        (MessageType.RANGE_CORRECTED, Flag.ANSWER, messages.encode(CORRECTION)[1], {"unsolicited": 1}),
    ],
    ids=["unknown", "host's own", "malformed", "answer without request"],
)
def test_frames_that_are_not_delivered_are_counted(kind, flags, payload, counted):
    bench = connected()
    encoder = connected_to(bench)
    before = bench.session.totals()

    assert bench.host_hears(encoder.encode(int(kind), payload, flags=flags)) == []
    after = bench.session.totals()
    rejections = ("unknown_type", "malformed", "unsolicited", "stale", "withheld", "lost")
    assert {name: 1 for name in rejections if after[name] != before[name]} == counted


def test_send_queue_is_bounded():
    bench = connected()
    for _ in range(5000):  # Its requests are not sent.
        bench.now += 1000 * MS
        bench.session.tick(bench.now, EPOCH + bench.now)

    assert len(bench.session.outgoing()) < 1 << 17
    assert bench.session.counts["unsent"] > 0


def test_reopening_the_port_ends_the_connection_and_discards_a_partial_frame():
    bench = connected()
    encoder = connected_to(bench)
    bench.host_hears(encoder.encode(*messages.encode(messages.RadioConfigured(RadioSettings()))))
    assert bench.session.radio is not None
    data = encoder.encode(*messages.encode(measurement(1)))
    bench.host_hears(data[:100])

    assert bench.session.opened(bench.now) == [Loss.CLOSED]
    assert bench.session.radio is None
    assert bench.host_hears(data[100:]) == []
    assert bench.session.counts["withheld"] == 0


def test_clock_is_synchronised_quickly_and_then_every_second():
    bench = Bench(BoardSession())
    requests = 0
    for _ in range(1050):
        bench.now += 10 * MS
        bench.session.tick(bench.now, EPOCH + bench.now)
        request = bench.session.outgoing()
        requests += sum(frame.type == MessageType.TIME_SYNC for frame in FrameDecoder().feed(request))
        bench.host_hears(bench.board.receive(request, bench.uptime_us))

    assert bench.session.clock.synchronised
    assert 8 + 8 <= requests <= 8 + 14


class OffsetsOnly:
    offsets = Offsets(9.0)

    def correct(self, measurements: list[RangeMeasurement]) -> list[CorrectedRange]:
        offset_m = [float(self.offsets.lookup([m.tag_id], [m.anchor_id])[0]) for m in measurements]
        source = Status.OK, CorrectedBy.DEVICE, IDENTITY.model_id
        pairs = zip(measurements, offset_m, strict=True)
        return [CorrectedRange(m.range_m - by_m, m.range_m, by_m, 1.0, *source) for m, by_m in pairs]


class OlderBoard(Board):
    """A board whose firmware ignores offsets."""

    def _answer(self, frame: WireFrame, now_us: int) -> bytes:
        return b"" if frame.type == MessageType.SET_OFFSETS else super()._answer(frame, now_us)


def with_offsets(offsets: Offsets, board: type[Board] = Board) -> Bench:
    bench = Bench(BoardSession())
    bench.board = board(IDENTITY, OffsetsOnly(), mode=Mode.DEVICE)
    bench.host_hears(bench.board.hello(0))
    bench.session.set_offsets(offsets)
    return bench


def ranges_m(bench: Bench) -> list[float]:
    return [event.corrected.range_m for event in bench.measure(1) if isinstance(event, Correction)]


def test_board_subtracts_the_offsets_of_the_host_also_after_a_restart():
    bench = with_offsets(Offsets(0.25))
    assert ranges_m(bench) == []
    assert bench.session.counts["wrong_offsets"] == 1
    bench.run(1000)
    assert ranges_m(bench) == [3.75]
    bench.booted, bench.board = bench.now, Board(IDENTITY, OffsetsOnly(), mode=Mode.DEVICE, boot_id=2)
    bench.host_hears(bench.board.hello(0))
    assert ranges_m(bench) == []
    bench.run(1000)
    assert ranges_m(bench) == [3.75]
    bench.session.set_offsets(NO_OFFSETS)
    bench.run(1000)
    assert ranges_m(bench) == [4.0]
    assert bench.received(Refused) == []


@pytest.mark.parametrize(("offsets", "refusals", "ranges"), [(Offsets(0.25), 1, []), (NO_OFFSETS, 0, [4.0])])
def test_older_board_is_accepted_only_without_offsets(offsets: Offsets, refusals: int, ranges: list[float]):
    bench = with_offsets(offsets, OlderBoard)
    bench.run(20_000)
    texts = [event.text for event in bench.received(Refused)]
    assert ["flash a newer" in text for text in texts] == [True] * refusals
    assert ranges_m(bench) == ranges


def test_too_many_offsets_for_a_board_are_refused_with_both_numbers():
    bench = with_offsets(Offsets(anchors=dict.fromkeys(range(MAX_OFFSETS + 1), 0.1)))
    bench.run(1000)
    (refused,) = bench.received(Refused)
    assert f"can store {MAX_OFFSETS} offsets, but {MAX_OFFSETS + 1}" in refused.text
    assert ranges_m(bench) == []
