"""As much of the protocol-buffers wire format as it takes to look into an ONNX file before trusting it.

So that a hostile or damaged file is refused by our own bounded reader, with a clear error, and before
ONNX Runtime sees it. The `onnx` package would add 0.2 s of processor time, 0.35 s in all, to the start of a node,
and with `ml-dtypes` a numpy that shadows ROS's.
"""

from __future__ import annotations

from collections.abc import Iterator

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5


class WireError(ValueError):
    """The bytes are not well-formed protocol buffers."""


def fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield (field number, value) of one message: an int, or the bytes of a length-delimited field.

    Raises:
        WireError: a field is malformed or longer than the message.
    """
    position, end = 0, len(data)
    while position < end:
        tag, position = _varint(data, position)
        kind = tag & 7
        if kind == VARINT:
            value, position = _varint(data, position)
            yield tag >> 3, value
            continue
        if kind == BYTES:
            size, position = _varint(data, position)
        elif kind in (FIXED64, FIXED32):
            size = 8 if kind == FIXED64 else 4
        else:
            raise WireError(f"wire type {kind} at byte {position}")
        if size > end - position:
            raise WireError(f"a field of {size} bytes at byte {position} of {end}")
        yield tag >> 3, data[position : position + size]
        position += size


def messages(data: memoryview, number: int) -> Iterator[memoryview]:
    """Yield the length-delimited fields of one number."""
    for found, value in fields(data):
        if found == number:
            if isinstance(value, int):
                raise WireError(f"field {number} is a number")
            yield value


def integers(data: memoryview, number: int) -> Iterator[int]:
    """Yield the integers of a repeated field, packed or not."""
    for found, value in fields(data):
        if found != number:
            continue
        if isinstance(value, int):
            yield value
            continue
        position = 0
        while position < len(value):
            item, position = _varint(value, position)
            yield item


def text(data: memoryview, number: int) -> str:
    """The last string of a field; empty where absent.

    Raises:
        WireError: it is not UTF-8.
    """
    last = b""
    for value in messages(data, number):
        last = bytes(value)
    try:
        return last.decode()
    except UnicodeDecodeError as error:
        raise WireError(f"field {number} is not UTF-8") from error


def delimited(number: int, content: bytes) -> bytes:
    """A length-delimited field."""
    return _encode(number << 3 | BYTES) + _encode(len(content)) + content


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(data):
            raise WireError("ends inside a number")
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
    raise WireError(f"a number of more than ten bytes at byte {position}")


def _encode(value: int) -> bytes:
    encoded = bytearray()
    while value >= 0x80:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)
