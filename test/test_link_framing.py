"""Frames in a byte stream: intact ones are delivered, damaged ones are counted, memory is bounded.

The fuzz targets of the link run briefly with bytes from Hypothesis.
"""

import itertools
import tracemalloc

import pytest
from fuzz import link_targets
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.decoder import loopback
from benchmarks.equipment.faults import Faults
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.radios.wire.framing import FrameDecoder, WireFrame, encode_frame
from uwb_mitigation.radios.wire.layout import MAX_PAYLOAD_BYTES, MessageType, Mode
from uwb_mitigation.radios.wire.session import BoardSession, LinkState

A = WireFrame(MessageType.LOG, 0, 7, 123_456, b"first\0\0")

NUMBERS = [st.integers(0, 2**bits - 1) for bits in (8, 16, 32, 64)]
frames = st.builds(WireFrame, *NUMBERS, st.binary(max_size=600))


def test_longer_payload_is_refused():
    with pytest.raises(ParameterError, match="4225"):
        encode_frame(A._replace(payload=bytes(MAX_PAYLOAD_BYTES + 1)))


@given(st.lists(frames, max_size=5), st.binary(max_size=300), st.lists(st.integers(1, 50), min_size=1))
def test_frames_are_decoded_unchanged_whatever_the_splitting_of_the_stream(sent, noise, sizes):
    stream = noise + b"".join(map(encode_frame, sent)) + noise + b"\0"
    uncut, cut = FrameDecoder(), FrameDecoder()
    received, position = [], 0
    for size in itertools.cycle(sizes):
        received += cut.feed(stream[position : position + size])
        position += size
        if position >= len(stream):
            break
    assert received == uncut.feed(stream) == sent
    assert cut.counts == uncut.counts


@pytest.mark.parametrize("chunk", [1, 1000, 10**6])
def test_endless_frame_is_counted_once_and_decoding_resumes(chunk):
    stream = b"\1" * 20_000 + encode_frame(A)
    decoder = FrameDecoder()
    received = []
    for position in range(0, len(stream), chunk):
        received += decoder.feed(stream[position : position + chunk])

    assert received == [A]
    assert decoder.counts["oversize"] == 1


@pytest.mark.parametrize("flood", [b"\0", b"\1", b"\xff", b"\1\1\0"], ids=["zeros", "ones", "ff", "short"])
def test_flood_does_not_grow_memory(flood):
    data = flood * (1_000_000 // len(flood))
    decoder = FrameDecoder()
    tracemalloc.start()
    decoder.feed(data)
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert held < 50_000
    assert peak < 2_500_000


@pytest.mark.parametrize(
    "faults",
    [Faults(*rates) for rates in ((), (1e-3,), (0, 1e-3), (0, 0, 1e-3), (1e-4,) * 3, (0.05,) * 3)],
    ids=["clean", "flips", "drops", "insertions", "all", "storm"],
)
def test_damaging_channel_delivers_exactly_the_intact_frames(faults):
    result = loopback(6000, faults, payload_bytes=200, seed=11)

    assert result.intact_lost == 0
    assert result.corrupt_delivered == 0
    assert result.delivered >= result.intact
    assert result.intact == 6000 or faults != Faults()


@pytest.mark.parametrize("name", link_targets.TARGETS)
def test_arbitrary_bytes_do_not_break_the_target(name):
    settings(max_examples=300)(given(st.binary(max_size=400))(link_targets.TARGETS[name]))()


def test_session_target_reaches_a_connection(monkeypatch):
    host = BoardSession(mode=Mode.DEVICE)
    monkeypatch.setattr(link_targets, "BoardSession", lambda mode: host)
    # kind 1, no pause, then model, boot and request of a HELLO, and its sequence.
    link_targets.session(bytes([1, 0, 0, 7, 7, 0, 0]))
    assert host.state is LinkState.READY
