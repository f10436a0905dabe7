"""Download DeepUWB with pooch, verified against the checksum that Zenodo publishes."""

from __future__ import annotations

from pathlib import Path

import pooch  # type: ignore[import-untyped]

from uwb_mitigation.errors import RecordingError

DOI, NAME = "doi:10.5281/zenodo.4290069", "dataset.pkl"


def fetch_deepuwb(target: Path, url: str | None = None, sha256: str | None = None) -> str:
    """Download `dataset.pkl` to `target` and return its checksum. A file with this checksum is kept.

    Args:
        target: file to write.
        url: a mirror; by default the DOI.
        sha256: expected checksum; by default the MD5 that Zenodo publishes.

    Raises:
        RecordingError: another file is in the way, the download failed, or the checksum is wrong.
    """
    pup = pooch.create(target.parent, base_url=f"{DOI}/", registry=None, retry_if_failed=2)
    pooch.get_logger().setLevel("WARNING")
    try:
        if sha256 is None:
            pup.load_registry_from_doi()
        checksum = str(pup.registry[NAME] if sha256 is None else f"sha256:{sha256}").lower()
        algorithm, _, digest = checksum.partition(":")
        if target.exists() and pooch.file_hash(str(target), algorithm) != digest:
            raise RecordingError("a different file exists", where=str(target), valid="delete or rename it")
        pup.registry, pup.urls = {target.name: checksum}, {target.name: url or f"{DOI}/{NAME}"}
        pup.fetch(target.name)
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise RecordingError(f"download failed: {error}", where=url or f"{DOI}/{NAME}") from error
    return checksum
