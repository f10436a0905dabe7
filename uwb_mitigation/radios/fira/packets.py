"""UCI packets in a stream of bytes. No I/O.

A packet has a header of four bytes (message type, fragment flag, group; opcode; reserved; length), and neither a
synchronisation word nor a checksum. The decoder therefore also checks the content of notifications.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from dataclasses import dataclass

from uwb_mitigation.errors import LinkError
from uwb_mitigation.radios.fira import codes, messages
from uwb_mitigation.radios.fira.codes import PacketType
from uwb_mitigation.radios.fira.messages import Diagnostics, RangeNotification

COMMAND_BYTES = 250
"""Maximum payload of a command packet; a longer command is sent in fragments."""

MAX_MESSAGE_BYTES = 1 << 16
"""Maximum size of an assembled message. 157 taps of 8 bytes on each frame take 9 kB."""

MAX_GAP_NS = 250 * 10**6
"""Maximum time between the parts of a packet, after which its header is considered damaged."""

MIN_TEXT, MAX_TEXT = 4, 40
"""Number of characters that are a text, and that are shown of it."""

_HEADER_BYTES = 4
_MORE = 0x10
_RANGES = (PacketType.NOTIFICATION, *codes.RANGE_START)
_DIAGNOSTICS = (PacketType.NOTIFICATION, *codes.RANGE_DIAGNOSTICS)
_STATE_NOTIFICATIONS = (codes.DEVICE_STATUS, codes.GENERIC_ERROR, codes.SESSION_STATUS, codes.BOOT)
_NOTIFICATIONS = {_RANGES, _DIAGNOSTICS, *((PacketType.NOTIFICATION, *name) for name in _STATE_NOTIFICATIONS)}


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """A response or notification, assembled from its fragments.

    Attributes:
        kind, name: from the header; `name` consists of group and opcode.
        payload: of all fragments.
        content: the parsed content of ranges and diagnostics.
    """

    kind: PacketType
    name: tuple[int, int]
    payload: bytes
    content: RangeNotification | Diagnostics | None = None

    @property
    def status(self) -> int:
        """The status of a response; 0xFF if it has none."""
        return self.payload[0] if self.payload else 0xFF


def encode_packets(
    group: int, opcode: int, payload: bytes, kind: PacketType = PacketType.COMMAND, size: int = COMMAND_BYTES
) -> bytes:
    """Return the packets of a message, in fragments of `size` bytes."""
    fragments = [payload[start : start + size] for start in range(0, len(payload), size)] or [b""]
    more = [_MORE] * (len(fragments) - 1) + [0]
    return b"".join(
        bytes([kind << 5 | flag | group, opcode, 0, len(fragment)]) + fragment
        for flag, fragment in zip(more, fragments, strict=True)
    )


class PacketDecoder:
    """Finds the messages in a stream; skips garbage and damaged packets.

    Attributes:
        counts: number of `messages`, `unknown` notifications, `damaged` packets, and `skipped` bytes.
        damages: number of places where the stream was damaged, for users that must trust a sequence of messages.
    """

    def __init__(self) -> None:
        self.counts = Counter(messages=0, unknown=0, damaged=0, skipped=0)
        self.damages = 0
        self._buffer = bytearray()
        self._fragments = bytearray()
        self._name: tuple[int, int, int] | None = None
        self._since_ns = 0
        self._lost = False
        self._skipped = bytearray()

    def reset(self) -> None:
        """Forget incomplete packets and messages."""
        self._buffer.clear()
        self._skipped.clear()
        self._drop_fragments()
        self._lost = False

    @property
    def text(self) -> str:
        """The text that was received instead of messages, shortened; empty: none."""
        received = self._skipped + (self._buffer if self._lost else b"")
        text = received.decode("ascii", "replace").strip()
        is_text = len(text) >= MIN_TEXT and all(mark.isprintable() or mark in "\r\n\t" for mark in text)
        return " ".join(text.split())[:MAX_TEXT] if is_text else ""

    def feed(self, data: bytes, now_ns: int) -> list[Packet]:
        """Return the messages that are complete with `data`; call it with no data to end a timeout."""
        late = len(self._buffer) > 0 and now_ns - self._since_ns > MAX_GAP_NS
        if self._name is not None and now_ns - self._since_ns > MAX_GAP_NS:
            self._damage()
        if data:
            self._since_ns = now_ns
        self._buffer += data
        packets: list[Packet] = []
        if late:
            # The length of the waiting packet is wrong: search for packets inside of it.
            self._skip()
        while (size := self._next(packets)) is not None:
            del self._buffer[:size]
        return packets

    def _next(self, packets: list[Packet]) -> int | None:
        """Handle the packet at the start of the buffer; return the number of bytes used, None = more are needed."""
        buffer = self._buffer
        if len(buffer) < _HEADER_BYTES:
            return None
        if not self._is_header(0):
            self._skip()
            return 0
        end = _HEADER_BYTES + buffer[3]
        if len(buffer) < end:
            return None
        name = (buffer[0] >> 5, buffer[0] & 0xF, buffer[1])
        more = bool(buffer[0] & _MORE)
        # A fragment cannot be checked by itself: the next header must follow it.
        if more and len(buffer) >= end + _HEADER_BYTES and not self._is_header(end):
            self._skip()
            return 0
        payload = bytes(buffer[_HEADER_BYTES:end])
        if self._name is not None and name != self._name:
            self._damage()
        if more:
            self._name = name
            self._fragments += payload
            if len(self._fragments) > MAX_MESSAGE_BYTES:
                self._damage()
            return end
        assembled = bytes(self._fragments) + payload
        message = _parsed(name, assembled)
        if message is None:
            self._damage()
            self._skip()
            return 0
        self._drop_fragments()
        self._skipped.clear()
        self._lost = False
        self.counts["messages"] += 1
        if name[0] == PacketType.NOTIFICATION and name not in _NOTIFICATIONS:
            self.counts["unknown"] += 1
        packets.append(message)
        return end

    def _is_header(self, start: int) -> bool:
        first, opcode, reserved = self._buffer[start : start + 3]
        kind, group = first >> 5, first & 0xF
        plausible = kind in (PacketType.RESPONSE, PacketType.NOTIFICATION) and opcode < 64 and not reserved
        if not plausible or not self._lost:
            return plausible
        # Among damaged bytes, only believe in the packets that the host needs.
        return kind == PacketType.RESPONSE or (kind, group, opcode) in _NOTIFICATIONS

    def _skip(self) -> None:
        """Skip one byte of the buffer."""
        if not self._lost:
            self._damage()
        self._lost = True
        self._skipped = (self._skipped + self._buffer[:1])[-4 * MAX_TEXT :]
        del self._buffer[:1]
        self.counts["skipped"] += 1

    def _damage(self) -> None:
        self.damages += 1
        self.counts["damaged"] += 1
        self._drop_fragments()

    def _drop_fragments(self) -> None:
        self._fragments.clear()
        self._name = None


def _parsed(name: tuple[int, int, int], payload: bytes) -> Packet | None:
    """Return a message; None if its content is damaged."""
    content: RangeNotification | Diagnostics | None = None
    with contextlib.suppress(LinkError):
        if name == _RANGES:
            content = messages.parse_ranges(payload)
        elif name == _DIAGNOSTICS:
            content = messages.parse_diagnostics(payload)
        return Packet(PacketType(name[0]), name[1:], payload, content)
    return None
