"""The lines of a text log, plain or xz-compressed, and the tables of integer pairs among them.

A window of bounded size slides over the file: memory does not grow with the log, whatever it holds.
What the lines mean is not known here.
"""

from __future__ import annotations

import lzma
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DamagedRecordingError, RecordingError

CHUNK_BYTES = 1 << 16
MAX_LINE_BYTES = 1 << 12
"""Longer lines are not text of a log; each is handed out as `OVERLONG`."""

XZ_CHUNK_BYTES = 1 << 13
"""Decompressed at a time: as much as is lost before the place where a stream turns out corrupt."""

OVERLONG = b"\x00"

XZ_MAGIC = b"\xfd7zXZ\x00"
XZ_MEMORY_BYTES = 128 << 20
"""A stream may ask for a dictionary of 4 GiB; what `xz -9` writes needs 65 MiB."""

_WIDEST_PAIR = len(b"-32768, -32768\r\n")
_INT16 = np.iinfo(np.int16)


def chunks(file: BinaryIO, path: Path) -> Iterator[bytes]:
    """The text of an open log, decompressed where it is an xz stream, in pieces.

    Raises:
        DamagedRecordingError: the stream is cut short or corrupt, or the disk fails.
        RecordingError: the file is named `.xz` and is none.
    """
    compressed = _blocks(file, path)
    block = next(compressed, b"")
    if block.startswith(XZ_MAGIC):
        yield from _decompressed(block, compressed, path)
        return
    if path.suffix == ".xz" and block:
        raise RecordingError("not an xz stream", where=str(path), valid="a log compressed with xz")
    while block:
        yield block
        block = next(compressed, b"")


def _blocks(file: BinaryIO, path: Path) -> Iterator[bytes]:
    while True:
        try:
            block = file.read(CHUNK_BYTES)
        except OSError as error:
            raise DamagedRecordingError(f"cannot read on: {error.strerror}", where=str(path)) from error
        if not block:
            return
        yield block


def _decompressed(block: bytes, compressed: Iterator[bytes], path: Path) -> Iterator[bytes]:
    taken = len(block)
    while block:
        decoder = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=XZ_MEMORY_BYTES)
        while not decoder.eof:
            try:
                text = decoder.decompress(block, XZ_CHUNK_BYTES)
            except lzma.LZMAError as error:
                raise DamagedRecordingError(
                    f"the xz stream is corrupt before byte {taken}: {error}", where=str(path)
                ) from error
            if text:
                yield text
            block = b""
            if decoder.needs_input and not decoder.eof:
                block = next(compressed, b"")
                taken += len(block)
                if not block:
                    raise DamagedRecordingError(
                        f"the xz stream is cut short at byte {taken}", where=str(path)
                    )
        # Streams may follow each other, padded with zeros.
        block = decoder.unused_data.lstrip(b"\x00")
        while not block:
            more = next(compressed, b"")
            if not more:
                return
            taken += len(more)
            block = more.lstrip(b"\x00")


class LogLines:
    """Hands out the lines of `pieces` in order, with or without carriage returns.

    Attributes:
        number: the line taken last, from 1.
    """

    def __init__(self, pieces: Iterator[bytes], path: Path) -> None:
        self.number = 0
        self._pieces = pieces
        self._path = path
        self._window = b""
        self._at = 0
        self._returned: bytes | None = None
        self._ended = False
        self._damage: DamagedRecordingError | None = None

    def head(self) -> bytes:
        """What the log begins with: at least a page, unless it is shorter.

        Raises:
            RecordingError: see `chunks`.
        """
        self._fill(MAX_LINE_BYTES)
        if not self._window and self._damage is not None:
            raise self._damage
        return self._window

    def take(self) -> bytes | None:
        """The next line without its end; None at the end of the log.

        Raises:
            DamagedRecordingError: the log ends in the middle of a line, or as `chunks` says.
        """
        if self._returned is not None:
            line, self._returned = self._returned, None
            self.number += 1
            return line
        overlong = False
        end = self._window.find(b"\n", self._at)
        while end < 0:
            ahead = len(self._window) - self._at
            if ahead > MAX_LINE_BYTES:
                overlong, ahead, self._at = True, 0, len(self._window)
            self._fill(ahead + 1)
            if len(self._window) - self._at == ahead:
                if ahead or overlong:
                    raise self.damaged("the log ends in the middle of a line")
                if self._damage is not None:
                    raise self.damaged("")
                return None
            end = self._window.find(b"\n", self._at + ahead)
        line = self._window[self._at : end]
        self._at = end + 1
        self.number += 1
        if overlong or len(line) > MAX_LINE_BYTES:
            return OVERLONG
        return line[:-1] if line.endswith(b"\r") else line

    def give_back(self, line: bytes) -> None:
        """Let the line taken last be the next one to take."""
        self._returned = line
        self.number -= 1

    def pairs(self, count: int) -> NDArray[np.int16] | None:
        """Take the next `count` lines, each `<int16>, <int16>`, as int16 of shape (2 count,).

        Returns None, and takes nothing, where they are anything else.
        """
        self._fill(_WIDEST_PAIR * count)
        text = np.frombuffer(
            self._window, np.uint8, min(_WIDEST_PAIR * count, len(self._window) - self._at), self._at
        )
        parsed = parse_pairs(text, count)
        if parsed is None:
            return None
        values, length = parsed
        self._at += length
        self.number += count
        return values

    def damaged(self, what: str) -> DamagedRecordingError:
        """The error for a log that ends early here; damage of the file itself goes before `what`."""
        if self._damage is not None:
            what = self._damage.what
        return DamagedRecordingError(
            what,
            where=f"{self._path}: after line {self.number}",
            valid="everything before was read; copy the file anew",
        )

    def _fill(self, size: int) -> None:
        if len(self._window) - self._at >= size or self._ended:
            return
        parts = [self._window[self._at :]]
        ahead = len(parts[0])
        while ahead < size and not self._ended:
            try:
                piece = next(self._pieces, b"")
            except DamagedRecordingError as damage:
                # What was read before the damage is handed out first.
                self._damage = damage
                piece = b""
            self._ended = not piece
            parts.append(piece)
            ahead += len(piece)
        self._window = b"".join(parts)
        self._at = 0


def parse_pairs(text: NDArray[np.uint8], count: int) -> tuple[NDArray[np.int16], int] | None:
    """Parse the `count` lines `<int16>, <int16>` that `text` begins with; also their length in bytes.

    The lines of an accumulator are most of a log, hence whole-array arithmetic: find all separators,
    and add up the digits of all numbers a decimal place at a time. Every byte is accounted for:
    returns None unless the text is exactly such lines, all with or all without carriage returns.
    """
    separators = np.flatnonzero((text == ord(",")) | (text == ord("\n")))[: 2 * count]
    if len(separators) < 2 * count:
        return None
    commas, newlines = separators[0::2], separators[1::2]
    length = int(newlines[-1]) + 1
    text = text[:length]
    if (text[commas] != ord(",")).any() or (text[newlines] != ord("\n")).any():
        return None
    returns = int(length > 1 and text[-2] == ord("\r"))
    if returns and (text[newlines - 1] != ord("\r")).any():
        return None
    # A comma is never the last byte here, so the byte after it exists.
    if (text[commas + 1] != ord(" ")).any():
        return None

    starts = np.empty_like(separators)
    starts[0] = 0
    starts[1::2] = commas + 2
    starts[2::2] = newlines[:-1] + 1
    ends = separators
    ends[1::2] -= returns
    widths = ends - starts
    if int(widths.min()) < 1:
        return None
    negative = text[starts] == ord("-")
    widths -= negative
    longest = int(widths.max())
    if int(widths.min()) < 1 or longest > 5:
        return None
    digits = text - np.uint8(ord("0"))  # what is below "0" wraps to above 9
    others = (3 + returns) * count + np.count_nonzero(negative)
    if np.count_nonzero(digits > 9) != others:
        return None

    ends -= 1
    values = digits.take(ends).astype(np.int32)
    for place in range(1, longest):
        here = digits.take(ends - place, mode="clip") * (widths > place)
        values += here.astype(np.int32) * np.int32(10**place)
    np.negative(values, out=values, where=negative)
    if int(values.min()) < _INT16.min or int(values.max()) > _INT16.max:
        return None
    return values.astype(np.int16), length
