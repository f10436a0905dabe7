"""Fuzz targets of the link: whatever bytes a board or a channel makes up, nothing fails, hangs or grows.

`test_link_framing.py` runs them briefly with Hypothesis, `fuzz_link.py` for long and guided by coverage.
"""

from benchmarks.equipment.board import Board
from uwb_mitigation.radios.wire import messages
from uwb_mitigation.radios.wire.framing import FrameDecoder, WireFrame, encode_frame
from uwb_mitigation.radios.wire.layout import MAX_ENCODED_BYTES, MAX_PAYLOAD_BYTES, Mode
from uwb_mitigation.radios.wire.session import BoardSession, LinkState

EPOCH = 1_760_000_000 * 10**9


class Script:
    """Reads decisions off the fuzzer's bytes; zeros when they are used up."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def take(self, size: int) -> bytes:
        piece = self._data[self._at : self._at + size]
        self._at += size
        return piece

    def number(self, size: int) -> int:
        return int.from_bytes(self.take(size), "little")


def decoder(data: bytes) -> None:
    """The first byte says how the rest is cut; a frame after it all is found."""
    chunk = (data[0] if data else 0) * 16 + 1
    fed = FrameDecoder()
    for at in range(1, len(data), chunk):
        for frame in fed.feed(data[at : at + chunk]):
            assert len(frame.payload) <= MAX_PAYLOAD_BYTES
            assert FrameDecoder().feed(encode_frame(frame)) == [frame]
        assert len(fed._tail) <= MAX_ENCODED_BYTES
    last = WireFrame(4, 0, 1, 2, b"the end")
    assert fed.feed(encode_frame(last))[-1:] == [last]


def session(data: bytes) -> None:
    """A board that says anything at any time, in frames whose CRC is right or in plain noise."""
    script = Script(data)
    host = BoardSession(mode=Mode.DEVICE)
    now = 0
    while script:
        kind = script.number(1)
        now += script.number(2) * 10**5
        host.receive(_made_up(kind, script), now, EPOCH + now)
        if kind % 16 == 15:
            host.set_mode(Mode(kind % 2))
        if kind % 16 == 14:
            host.closed(now)
        assert len(host.outgoing()) <= 1 << 17
        assert (host.hello is not None) == (host.state is LinkState.READY)
        assert len(host.clock._times) <= 1024


def board(data: bytes) -> None:
    """A host that says anything: answers are frames, and never many times what was asked."""
    script = Script(data)
    firmware = Board(messages.Hello())
    now = 0
    while script:
        kind = script.number(1)
        now += script.number(2)
        data = _made_up(kind, script)
        answer = firmware.receive(data, now)
        assert len(answer) <= 4 * len(data) + 100
        answers = FrameDecoder()
        answers.feed(answer)
        assert answers.corrupt == 0


def _made_up(kind: int, script: Script) -> bytes:
    if kind % 4 == 0:
        return script.take(script.number(1))
    if kind % 4 == 1:
        hello = messages.Hello(
            1, script.number(1), script.number(1), script.number(1), 157, mode=Mode(kind % 2)
        )
        return encode_frame(WireFrame(1, kind & 1, script.number(1), 0, messages.encode(hello)[1]))
    frame = WireFrame(
        script.number(1) % 70,
        script.number(1),
        script.number(1 if kind % 4 == 2 else 4),
        script.number(8),
        script.take(script.number(1)),
    )
    return encode_frame(frame)


TARGETS = {"decoder": decoder, "session": session, "board": board}
