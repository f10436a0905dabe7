"""Many `RangeCir` messages at once: to arrays, and back to `RangeCorrected`, without an object for each.

A recording repeats one layout: the same frame, the same number of samples. Messages that share it are rows
of one structured array. `codec` defines what a message means; what does not fit a block is left to it.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.bag import codec
from uwb_mitigation.errors import RecordingError
from uwb_mitigation.measurement import (
    CorrectedColumns,
    CorrectedRange,
    RangeColumns,
    RangeMeasurement,
    Status,
)

MIN_BLOCK = 8
"""Fewer messages of a layout are faster one by one."""

_FRAME_AT = 12
_LENGTH = struct.Struct("<I")

# Offsets from the first field behind the header; `codec` packs the same ones.
_RANGE_FIELDS = {
    "tag_id": ("<u8", 0),
    "anchor_id": ("<u8", 8),
    "sequence": ("<u4", 16),
    "range": ("<f4", 32),
    "start_index": ("<i4", 40),
    "first_path_index": ("<f4", 44),
    "encoding": ("u1", 48),
    "scale": ("<f4", 52),
    "count": ("<u4", 56),
}
_SAMPLES_AT = 60
_CORRECTED_FIELDS = {
    "tag_id": ("<u8", 0),
    "anchor_id": ("<u8", 8),
    "sequence": ("<u4", 16),
    "range": ("<f4", 20),
    "range_raw": ("<f4", 24),
    "correction": ("<f4", 28),
    "variance": ("<f4", 32),
    "status": ("u1", 36),
}
_HEADER_FIELDS = {"encapsulation": ("S2", 0), "seconds": ("<i4", 4), "nanoseconds": ("<u4", 8)}
_COPIED = ("seconds", "nanoseconds", "tag_id", "anchor_id", "sequence")


@dataclass(frozen=True, slots=True, eq=False)
class MessageBlock:
    """Messages of one layout.

    Attributes:
        rows: int (n,), which of the messages that were given.
        fields: structured (n,), their bytes by name.
        first: the first of them, decoded.
    """

    rows: NDArray[np.intp]
    fields: NDArray[np.void]
    first: RangeMeasurement

    @property
    def columns(self) -> RangeColumns:
        """What correcting them takes."""
        fields = self.fields
        return RangeColumns(
            tag_id=fields["tag_id"],
            anchor_id=fields["anchor_id"],
            range_m=fields["range"],
            encoding=self.first.cir.encoding,
            samples=fields["samples"],
            start_index=fields["start_index"],
            first_path_index=fields["first_path_index"],
            scale=fields["scale"],
            preamble_count=fields["preamble_count"],
            rx_power_dbm=fields["rx_power"],
            first_path_power_dbm=fields["first_path_power"],
        )

    def encode_corrected(self, corrected: CorrectedColumns) -> list[bytes]:
        """Return `RangeCorrected` of each row: the bytes of `codec.encode_corrected`."""
        like = CorrectedRange(0.0, 0.0, 0.0, 0.0, Status.OK, corrected.origin, corrected.model_id)
        template = codec.encode_corrected(self.first, like)
        at = len(template) - codec.CORRECTED_SIZE
        size = len(template)
        # What no field names must stay as it is: copies of structured arrays leave such bytes undefined.
        buffer = bytearray(template * len(self.rows))
        out = np.frombuffer(buffer, _structure(at, size, _CORRECTED_FIELDS))
        for name in _COPIED:
            out[name] = self.fields[name]
        out["range"] = corrected.range_m
        out["range_raw"] = self.fields["range"]
        out["correction"] = corrected.correction_m
        out["variance"] = corrected.variance_m2
        out["status"] = corrected.status
        data = bytes(buffer)
        return [data[start : start + size] for start in range(0, len(data), size)]


def blocks(messages: Sequence[bytes]) -> list[MessageBlock]:
    """The messages that share a layout with several others; those in no block are for `codec.decode_range`."""
    groups: dict[tuple[int, bytes], list[int]] = {}
    for number, message in enumerate(messages):
        if len(message) >= _FRAME_AT + _LENGTH.size:
            end = _FRAME_AT + _LENGTH.size + _LENGTH.unpack_from(message, _FRAME_AT)[0]
            groups.setdefault((len(message), message[_FRAME_AT:end]), []).append(number)
    found = []
    for numbers in groups.values():
        if len(numbers) >= MIN_BLOCK:
            block = _block(messages, numbers)
            if block is not None:
                found.append(block)
    return found


def _block(messages: Sequence[bytes], numbers: list[int]) -> MessageBlock | None:
    model = messages[numbers[0]]
    try:
        first = codec.decode_range(model)
    except RecordingError:
        return None
    (frame_length,) = _LENGTH.unpack_from(model, _FRAME_AT)
    at = codec.after_frame(_FRAME_AT + _LENGTH.size + frame_length)
    count = len(first.cir.samples)
    behind = _SAMPLES_AT + 2 * count
    powers = behind + 4 + 2 * (count % 2)
    layout = _RANGE_FIELDS | {
        "samples": (("<i2", (count,)), _SAMPLES_AT),
        "preamble_count": ("<u2", behind),
        "rx_power": ("<f4", powers),
        "first_path_power": ("<f4", powers + 4),
    }
    fields = np.frombuffer(
        b"".join([messages[number] for number in numbers]), _structure(at, len(model), layout)
    )
    alike = fields["encapsulation"] == codec.LITTLE_ENDIAN
    alike &= fields["nanoseconds"] < 1_000_000_000
    alike &= fields["encoding"] == int(first.cir.encoding)
    alike &= fields["count"] == count
    rows = np.array(numbers, np.intp)
    if not alike.all():
        rows, fields = rows[alike], fields[alike]
    return MessageBlock(rows, fields, first)


def _structure(at: int, size: int, fields: Mapping[str, tuple[object, int]]) -> np.dtype[np.void]:
    """A message of `size` bytes whose first field behind the header is at `at`."""
    placed: dict[str, tuple[Any, int]] = _HEADER_FIELDS | {
        name: (kind, at + offset) for name, (kind, offset) in fields.items()
    }
    return np.dtype(
        {
            "names": list(placed),
            "formats": [kind for kind, _ in placed.values()],
            "offsets": [offset for _, offset in placed.values()],
            "itemsize": size,
        }
    )
