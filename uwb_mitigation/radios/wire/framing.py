"""Frame encoder and decoder: COBS between zero delimiters, a fixed header, a CRC-32.

The decoder accepts chunks of any size, buffers at most one frame, and resynchronises at the next
delimiter after damage. `messages` decodes the payloads.
"""

from __future__ import annotations

import zlib
from collections import Counter
from typing import NamedTuple

from cobs import cobs

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.radios.wire import layout
from uwb_mitigation.radios.wire.layout import CRC_BYTES, HEADER_BYTES, MAX_ENCODED_BYTES, PROTOCOL_VERSION

DELIMITER = b"\0"

# The CRC-32 of any message followed by its own CRC, little-endian, is this constant.
_CRC_RESIDUE = 0x2144DF1C

# Limits the memory for splitting data that consists mainly of delimiters.
_SLICE_BYTES = 1 << 16

_CORRUPT = ("bad_cobs", "bad_length", "bad_crc", "oversize")
_MIN_FRAME_BYTES = HEADER_BYTES + CRC_BYTES
_header = layout.HEADER.as_struct()


class WireFrame(NamedTuple):
    """One intact frame of this protocol version; the fields of `layout.HEADER` and the payload."""

    type: int
    flags: int
    sequence: int
    time_us: int
    payload: bytes


def encode_frame(frame: WireFrame, version: int = PROTOCOL_VERSION) -> bytes:
    """Return the encoded frame, with a delimiter before and after it.

    The leading delimiter terminates preceding noise, boot text or partial frames, so that a frame is lost
    only if one of its own bytes is damaged.

    Raises:
        ParameterError: the payload is longer than `MAX_PAYLOAD_BYTES`.
    """
    if len(frame.payload) > layout.MAX_PAYLOAD_BYTES:
        raise ParameterError(
            f"a payload of {len(frame.payload)} bytes", valid=f"at most {layout.MAX_PAYLOAD_BYTES}"
        )
    body = _header.pack(version, frame.type, frame.flags, frame.sequence, frame.time_us) + frame.payload
    return b"".join(
        (DELIMITER, cobs.encode(body + zlib.crc32(body).to_bytes(CRC_BYTES, "little")), DELIMITER)
    )


class FrameEncoder:
    """Numbers and encodes the frames of one sender.

    Attributes:
        sequence: sequence number of the next frame.
    """

    def __init__(self, version: int = PROTOCOL_VERSION) -> None:
        self.sequence = 0
        self._version = version

    def encode(self, kind: int, payload: bytes, *, flags: int = 0, time_us: int = 0) -> bytes:
        """Return the next frame, encoded; see `encode_frame`."""
        wire = encode_frame(WireFrame(kind, flags, self.sequence, time_us, payload), self._version)
        self.sequence = (self.sequence + 1) % (1 << 32)
        return wire


class FrameDecoder:
    """Decodes the intact frames in a byte stream, which arrives in chunks of any size.

    Never raises. Between calls it buffers at most `MAX_ENCODED_BYTES` bytes.

    Attributes:
        counts: number of intact `frames`, of those of a `foreign_version`, of `bytes_received`, and of segments between
            delimiters that are no frame: `bad_cobs`, `bad_length` (shorter than header and CRC), `bad_crc`, `oversize`.
        last_foreign_version: version of the last frame of another protocol version; None = not yet received.
    """

    def __init__(self) -> None:
        self.counts = Counter(dict.fromkeys(("frames", "foreign_version", "bytes_received", *_CORRUPT), 0))
        self.last_foreign_version: int | None = None
        self._tail = b""
        self._overrun = False

    @property
    def corrupt(self) -> int:
        """Number of segments that are not an intact frame of any version."""
        return sum(self.counts[name] for name in _CORRUPT)

    def feed(self, data: bytes) -> list[WireFrame]:
        """Return the frames that `data` completes, in order."""
        frames: list[WireFrame] = []
        for start in range(0, len(data), _SLICE_BYTES):
            self._feed_slice(data[start : start + _SLICE_BYTES], frames)
        return frames

    def reset(self) -> None:
        """Discard a partly received frame, for example after the port was reopened; keep the counts."""
        self._tail = b""
        self._overrun = False

    def _feed_slice(self, data: bytes, frames: list[WireFrame]) -> None:
        counts = self.counts
        counts["bytes_received"] += len(data)
        segments = data.split(DELIMITER)
        if self._overrun:
            # The rest of a segment that is already counted as oversize.
            if len(segments) == 1:
                return
            segments[0] = b""
            self._overrun = False
        elif self._tail:
            segments[0] = self._tail + segments[0]
        tail = segments.pop()
        for segment in segments:
            frame = self._decode(segment) if segment else ""
            if isinstance(frame, WireFrame):
                frames.append(frame)
            elif frame:
                counts[frame] += 1
        if len(tail) > MAX_ENCODED_BYTES:
            counts["oversize"] += 1
            self._overrun = True
            tail = b""
        self._tail = tail

    def _decode(self, segment: bytes) -> WireFrame | str:
        """Return a frame, or the name of the count of a segment that is none."""
        if len(segment) > MAX_ENCODED_BYTES:
            return "oversize"
        try:
            body = cobs.decode(segment)
        except cobs.DecodeError:
            return "bad_cobs"
        if not _MIN_FRAME_BYTES <= len(body) <= layout.MAX_FRAME_BYTES:
            return "bad_length"
        if zlib.crc32(body) != _CRC_RESIDUE:
            return "bad_crc"
        version, kind, flags, sequence, time_us = _header.unpack_from(body)
        if version != PROTOCOL_VERSION:
            self.last_foreign_version = version
            return "foreign_version"
        self.counts["frames"] += 1
        return WireFrame(kind, flags, sequence, time_us, body[HEADER_BYTES:-CRC_BYTES])
