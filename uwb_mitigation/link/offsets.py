"""The radios' offsets on the wire: what a host sets, and what a board answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from uwb_mitigation.errors import LinkError, ParameterError
from uwb_mitigation.link.layout import OFFSET, PAYLOADS, MessageType, OffsetOf
from uwb_mitigation.offsets import Offsets

_entry = OFFSET.packing()
_packing = {kind: PAYLOADS[kind].packing() for kind in (MessageType.OFFSETS, MessageType.SET_OFFSETS)}


@dataclass(frozen=True, slots=True)
class SetOffsets:
    """Asks the board to take these off what it measures; it answers with an `OffsetsAnswer`."""

    offsets: Offsets


@dataclass(frozen=True, slots=True)
class OffsetsAnswer:
    """What the board says to a `SetOffsets`.

    Attributes:
        request_sequence: of the frame that this answers.
        slots: offsets that the board can keep beside the default.
        accepted: whether they are in force.
    """

    request_sequence: int
    slots: int
    accepted: bool


def encode_offsets(message: SetOffsets | OffsetsAnswer) -> tuple[MessageType, bytes]:
    """The message's type and payload; struct.error if a value does not fit its field."""
    if isinstance(message, OffsetsAnswer):
        kind = MessageType.OFFSETS
        return kind, _packing[kind].pack(message.request_sequence, message.slots, message.accepted)
    offsets, kind = message.offsets, MessageType.SET_OFFSETS
    entries = [
        *(_entry.pack(tag, anchor, m, OffsetOf.PAIR) for (tag, anchor), m in offsets.pairs.items()),
        *(_entry.pack(0, anchor, m, OffsetOf.ANCHOR) for anchor, m in offsets.anchors.items()),
        *(_entry.pack(tag, 0, m, OffsetOf.TAG) for tag, m in offsets.tags.items()),
    ]
    return kind, _packing[kind].pack(offsets.default, len(entries)) + b"".join(entries)


def decode_offsets(_: bytes, values: tuple[Any, ...], __: int) -> OffsetsAnswer:
    """The OFFSETS of these values."""
    request_sequence, slots, accepted = values
    return OffsetsAnswer(request_sequence, slots, bool(accepted))


def decode_set_offsets(payload: bytes, values: tuple[Any, ...], _: int) -> SetOffsets:
    """The SET_OFFSETS of these values and this payload; LinkError if its tail is none."""
    default, count = values
    start = _packing[MessageType.SET_OFFSETS].size
    if len(payload) < start + count * _entry.size:
        raise LinkError(f"a payload of {len(payload)} bytes", where="SET_OFFSETS", valid=f"{count} offsets")
    anchors: dict[int, float] = {}
    tags: dict[int, float] = {}
    pairs: dict[tuple[int, int], float] = {}
    for tag, anchor, offset_m, kind in _entry.iter_unpack(payload[start : start + count * _entry.size]):
        if kind == OffsetOf.PAIR:
            pairs.setdefault((tag, anchor), offset_m)
        elif kind == OffsetOf.ANCHOR:
            anchors.setdefault(anchor, offset_m)
        elif kind == OffsetOf.TAG:
            tags.setdefault(tag, offset_m)
        else:
            raise LinkError(f"an offset of {kind}", where="SET_OFFSETS", valid="0 to 2")
    try:
        return SetOffsets(Offsets(default, anchors, tags, pairs))
    except ParameterError as error:
        raise LinkError(error.what, where="SET_OFFSETS", valid=error.valid) from error
