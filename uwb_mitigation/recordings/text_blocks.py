"""Text files in any encoding, packed or damaged, in blocks of complete lines."""

from __future__ import annotations

import codecs
import gzip
import io
import lzma
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from uwb_mitigation.errors import DamagedRecordingError, RecordingError

BLOCK_CHARS, MAX_ROW_CHARS = 1 << 22, 1 << 26
"""Size of a block, and largest size of a row."""

MAX_EXPANSION, MIN_BOMB_CHARS = 500, 1 << 28
"""A packed file that expands to a larger multiple and to more characters is not read."""

_DAMAGES = (OSError, EOFError, lzma.LZMAError, zlib.error)
_OPENERS: dict[str, Any] = {".xz": lzma.open, ".gz": gzip.open}
OnWarning = Callable[[str], None]


class UpToDamage(io.RawIOBase):
    """The bytes of a file, unpacked from `.xz` or `.gz`, up to a damage; `damage` is then the reason.

    Raises:
        OSError: the file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._stream = _OPENERS.get(path.suffix, open)(path, "rb")
        self.damage: Exception | None = None

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read bytes into a buffer; return their number, 0 at the end or at the damage."""
        try:
            # `read` loses what precedes the damage.
            data = self._stream.read1(len(buffer))
        except _DAMAGES as error:
            self.damage, data = error, b""
        buffer[: len(data)] = data
        return len(data)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
        super().close()


def text_blocks(path: Path, on_warning: OnWarning | None, quote: str = "") -> Iterator[str]:
    """Yield the lines of a text file, in blocks that end with a line break, and not within quotes.

    Args:
        path: the file.
        on_warning: called if the last line has no line break, and is not yielded; None: it is yielded. The only line of a
            file is always yielded.
        quote: the mark of quotes; empty: none.

    Raises:
        RecordingError: a quote is not closed, or the file is empty or a decompression bomb.
        DamagedRecordingError: the file ends early, after yielding the lines before.
    """
    limit, total = max(MAX_EXPANSION * path.stat().st_size, MIN_BOMB_CHARS), 0
    unread, yielded = "", False
    with UpToDamage(path) as source:
        buffered = io.BufferedReader(source)
        text = io.TextIOWrapper(buffered, _encoding(buffered.peek(4096)), errors="replace")
        while len(unread) < MAX_ROW_CHARS and (data := text.read(BLOCK_CHARS)):
            total, unread = total + len(data), unread + data
            if total > limit:
                what = f"the file expands to more than {MAX_EXPANSION} times its size"
                raise RecordingError(what, where=path, valid="no decompression bomb")
            end = unread.rfind("\n") + 1
            if quote and unread.count(quote, 0, end) % 2:
                end = unread.rfind("\n", 0, unread.rfind(quote, 0, end)) + 1
            if end:
                yield unread[:end]
                unread, yielded = unread[end:], True
    if len(unread) >= MAX_ROW_CHARS or ("\n" in unread and not source.damage):
        what = f"a closing quote or a line break is missing after {unread[:60]!r}"
        raise RecordingError(what, where=path)
    if source.damage:
        raise DamagedRecordingError(f"truncated or corrupt: {source.damage}", where=path)
    if unread and on_warning and yielded:
        on_warning(f"{path.name}: the file does not end with a line break; the last row is not used")
    elif unread:
        yield unread
    elif not yielded:
        raise RecordingError("the file is empty", where=path)


def _encoding(head: bytes) -> str:
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"
