"""Frames to bytes and back: COBS between zero delimiters, a fixed header, a CRC-32.

The decoder takes a stream cut anywhere, keeps at most one frame of it, and starts afresh at the next
delimiter after damage. What a payload means is for `messages`.
"""

from __future__ import annotations

import zlib
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from cobs import cobs

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.link.layout import (
    CRC_BYTES,
    HEADER,
    HEADER_BYTES,
    MAX_ENCODED_BYTES,
    MAX_FRAME_BYTES,
    MAX_PAYLOAD_BYTES,
    PROTOCOL_VERSION,
)

DELIMITER = b"\0"

# The CRC-32 of any message followed by its own CRC, little-endian, is this constant.
_CRC_RESIDUE = 0x2144DF1C

# Bounds what splitting a flood of delimiters takes in memory.
_SLICE_BYTES = 1 << 16

_MIN_FRAME_BYTES = HEADER_BYTES + CRC_BYTES
_header = HEADER.packing()


class Frame(NamedTuple):
    """One intact frame of this protocol version; the fields of `layout.HEADER` and the payload."""

    type: int
    flags: int
    sequence: int
    time_us: int
    payload: bytes


@dataclass(slots=True)
class DecoderCounts:
    """What became of the bytes that a decoder was fed.

    Attributes:
        frames: intact frames delivered.
        bad_cobs: stretches between delimiters that are not COBS.
        bad_length: COBS, but shorter than header and CRC.
        bad_crc: of a frame's length, but damaged.
        oversize: stretches longer than the longest frame.
        foreign_versions: intact frames of other protocol versions, {version: count}.
        last_foreign_version: the last one of them; None = there was none.
        bytes_received: all bytes fed.
    """

    frames: int = 0
    bad_cobs: int = 0
    bad_length: int = 0
    bad_crc: int = 0
    oversize: int = 0
    foreign_versions: Counter[int] = field(default_factory=Counter)
    last_foreign_version: int | None = None
    bytes_received: int = 0

    @property
    def corrupt(self) -> int:
        """Stretches that were no intact frame of any version."""
        return self.bad_cobs + self.bad_length + self.bad_crc + self.oversize


def encode_frame(frame: Frame, version: int = PROTOCOL_VERSION) -> bytes:
    """The frame as it goes on the wire, with a delimiter before and after.

    The leading one closes whatever noise, boot text or half a frame lies before it, so that a frame
    is lost only if one of its own bytes is.

    Raises:
        ParameterError: the payload is longer than `MAX_PAYLOAD_BYTES`.
    """
    if len(frame.payload) > MAX_PAYLOAD_BYTES:
        raise ParameterError(f"a payload of {len(frame.payload)} bytes", valid=f"at most {MAX_PAYLOAD_BYTES}")
    body = _header.pack(version, frame.type, frame.flags, frame.sequence, frame.time_us) + frame.payload
    return b"".join(
        (DELIMITER, cobs.encode(body + zlib.crc32(body).to_bytes(CRC_BYTES, "little")), DELIMITER)
    )


class FrameEncoder:
    """Numbers and encodes the frames of one sender, from its start.

    Attributes:
        sequence: of the next frame.
    """

    def __init__(self, version: int = PROTOCOL_VERSION) -> None:
        self.sequence = 0
        self._version = version

    def encode(self, kind: int, payload: bytes, *, flags: int = 0, time_us: int = 0) -> bytes:
        """The next frame on the wire; see `encode_frame`."""
        wire = encode_frame(Frame(kind, flags, self.sequence, time_us, payload), self._version)
        self.sequence = (self.sequence + 1) % (1 << 32)
        return wire


class FrameDecoder:
    """Turns a byte stream, in chunks of any size, into the intact frames in it.

    Raises nothing on any input; what it drops is counted in `counts`. Between calls it holds at most
    `MAX_ENCODED_BYTES` bytes.
    """

    def __init__(self) -> None:
        self.counts = DecoderCounts()
        self._tail = b""
        self._overrun = False

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that `data` completes, in order."""
        frames: list[Frame] = []
        for start in range(0, len(data), _SLICE_BYTES):
            self._feed_slice(data[start : start + _SLICE_BYTES], frames)
        return frames

    def reset(self) -> None:
        """Forget a half-received frame, as when the port was opened anew; counts stay."""
        self._tail = b""
        self._overrun = False

    def _feed_slice(self, data: bytes, frames: list[Frame]) -> None:
        counts = self.counts
        counts.bytes_received += len(data)
        stretches = data.split(DELIMITER)
        if self._overrun:
            # The rest of a stretch that is already counted as oversize.
            if len(stretches) == 1:
                return
            stretches[0] = b""
            self._overrun = False
        elif self._tail:
            stretches[0] = self._tail + stretches[0]
        tail = stretches.pop()
        for stretch in stretches:
            frame = self._decode(stretch) if stretch else None
            if frame is not None:
                frames.append(frame)
        if len(tail) > MAX_ENCODED_BYTES:
            counts.oversize += 1
            self._overrun = True
            tail = b""
        self._tail = tail

    def _decode(self, stretch: bytes) -> Frame | None:
        counts = self.counts
        if len(stretch) > MAX_ENCODED_BYTES:
            counts.oversize += 1
            return None
        try:
            body = cobs.decode(stretch)
        except cobs.DecodeError:
            counts.bad_cobs += 1
            return None
        if not _MIN_FRAME_BYTES <= len(body) <= MAX_FRAME_BYTES:
            counts.bad_length += 1
            return None
        if zlib.crc32(body) != _CRC_RESIDUE:
            counts.bad_crc += 1
            return None
        version, kind, flags, sequence, time_us = _header.unpack_from(body)
        if version != PROTOCOL_VERSION:
            counts.foreign_versions[version] += 1
            counts.last_foreign_version = version
            return None
        counts.frames += 1
        return Frame(kind, flags, sequence, time_us, body[HEADER_BYTES:-CRC_BYTES])
