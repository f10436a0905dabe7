"""Downloads a published data set to a file, checked against its checksum, whole or not at all."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TypeAlias

import pooch  # type: ignore[import-untyped]

from uwb_mitigation.errors import ParameterError, RecordingError

Report: TypeAlias = Callable[[int, "int | None"], None]
"""Is told the bytes that came, and how many are to come in all (None = unknown)."""

_CHUNK = 1 << 16
_DIGITS = {"md5": 32, "sha256": 64}


@dataclass(frozen=True, slots=True)
class Remote:
    """A file in a repository that a DOI names.

    Attributes:
        doi: the repository's DOI, without a prefix.
        name: the file's name in it.
        max_bytes: ceiling on its size.
    """

    doi: str
    name: str
    max_bytes: int

    @property
    def url(self) -> str:
        """The address of the file, as pooch takes it."""
        return f"doi:{self.doi}/{self.name}"


@dataclass(frozen=True, slots=True)
class Downloaded:
    """A file that is there and has its checksum.

    Attributes:
        path: the file.
        url: where it came from, or would have.
        checksum: `md5:...` or `sha256:...`, which the file was checked against.
        fetched: False where it was there already.
    """

    path: Path
    url: str
    checksum: str
    fetched: bool


def download(
    remote: Remote,
    target: Path,
    report: Report = lambda done, total: None,
    *,
    url: str | None = None,
    checksum: str | None = None,
    force: bool = False,
    retries: int = 2,
) -> Downloaded:
    """Bring `remote` to `target`; nothing stands there until all of it has come and its checksum is right.

    An attempt that fails is cleared away and made again from the start. A file that is there with the
    right checksum is kept.

    Args:
        remote: what to download.
        target: the file to write; its folder is made where there is none.
        report: is told of the progress.
        url: a mirror, http or https; by default what the DOI leads to.
        checksum: `md5:...` or `sha256:...`; by default the one that the DOI's repository states.
        force: replace a file that is there and is another.
        retries: further attempts after the first.

    Raises:
        ParameterError: the mirror's address or the checksum is malformed.
        RecordingError: another file is there, the download failed, or it is larger than the ceiling.
    """
    if url is not None and not url.startswith(("http://", "https://")):
        raise ParameterError(f"address {url!r}", valid="http:// or https://")
    source = url or remote.url
    known = stated_checksum(remote) if checksum is None else checksum.lower()
    algorithm, _, digest = known.partition(":")
    if len(digest) != _DIGITS.get(algorithm) or set(digest) - set("0123456789abcdef"):
        raise ParameterError(
            f"checksum {known[:80]!r}", valid="md5: and 32, or sha256: and 64 hexadecimal digits"
        )
    pooch.get_logger().setLevel("WARNING")  # the progress bar says what it would
    try:
        if target.exists():
            if target.is_file() and pooch.file_hash(str(target), algorithm) == digest:
                return Downloaded(target, source, known, fetched=False)
            if not force or not target.is_file():
                raise RecordingError(
                    "is there already, and is another file",
                    where=str(target),
                    valid="--force replaces a file",
                )
        pup = pooch.create(
            target.parent,
            base_url="",
            registry={target.name: known},
            urls={target.name: source},
            retry_if_failed=retries,
        )
        pup.fetch(target.name, downloader=_Downloader(remote.max_bytes, report))
    except (OSError, ValueError) as error:  # those of requests are OSError, a wrong checksum is ValueError
        raise RecordingError(
            f"download failed: {error}", where=source, valid="try again, or --url MIRROR"
        ) from error
    return Downloaded(target, source, known, fetched=True)


def matches(data: bytes, checksum: str) -> bool:
    """Whether `data` has the checksum `md5:...` or `sha256:...`."""
    algorithm, _, digest = checksum.partition(":")
    return algorithm in _DIGITS and hashlib.new(algorithm, data).hexdigest() == digest


def stated_checksum(remote: Remote) -> str:
    """What the repository behind the DOI says the file's checksum is: `md5:...`.

    Raises:
        RecordingError: it does not answer, or knows no such file.
    """
    pup = pooch.create(Path(), base_url=f"doi:{remote.doi}/", registry=None)
    try:
        pup.load_registry_from_doi()
        return str(pup.registry[remote.name]).lower()
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise RecordingError(
            f"its checksum cannot be had: {error or type(error).__name__}",
            where=remote.url,
            valid="try again, or --url MIRROR --sha256 CHECKSUM",
        ) from error


class _Downloader:
    """Writes what pooch fetches through a `_Meter`."""

    def __init__(self, max_bytes: int, report: Report) -> None:
        self._max_bytes = max_bytes
        self._report = report

    def __call__(self, url: str, output_file: str, pup: pooch.Pooch) -> None:
        with Path(output_file).open("wb") as stream:
            meter = _Meter(stream, url, self._max_bytes, self._report)
            kind = pooch.DOIDownloader if url.startswith("doi:") else pooch.HTTPDownloader
            kind(progressbar=meter, chunk_size=_CHUNK)(url, meter, pup)


class _Meter:
    """The file and the progress bar that pooch is given, in one: counts and limits the bytes that come."""

    def __init__(self, stream: BinaryIO, url: str, max_bytes: int, report: Report) -> None:
        self._stream = stream
        self._url = url
        self._max_bytes = max_bytes
        self._report = report
        self._done = 0
        self._total: int | None = None

    @property
    def total(self) -> int | None:
        return self._total

    @total.setter
    def total(self, size: int) -> None:
        self._check(size)
        self._total = size or None

    def write(self, data: bytes) -> int:
        self._done += len(data)
        self._check(self._done)
        written = self._stream.write(data)
        self._report(self._done, self._total)
        return written

    def _check(self, size: int) -> None:
        if size > self._max_bytes:
            raise RecordingError(
                f"{size} bytes or more", where=self._url, valid=f"at most {self._max_bytes} bytes"
            )

    def flush(self) -> None:
        """pooch asks for it at every chunk; closing the file does it once."""

    def update(self, size: int) -> None:
        """pooch's own count, which takes every chunk for a full one."""

    def reset(self) -> None:
        """Part of a progress bar as pooch wants it."""

    def close(self) -> None:
        """Part of a progress bar as pooch wants it."""
