"""The real logs, unpacked and read once for all workers of a test run."""

from __future__ import annotations

import fcntl
import os
import pickle
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import pytest

from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.types.measurement import Record


class Reading(NamedTuple):
    """Records and warnings of a source."""

    records: list[Record]
    skipped: Counter[str]


def read_once(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Reading:
    """Return all records of a recording; the first worker reads it, the others use the cached result."""
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    kept = shared / f"{folder.name}.pickle"
    with kept.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            with open_recording(folder) as source:
                kept.write_bytes(pickle.dumps(Reading(list(source), source.skipped)))
    return pickle.loads(kept.read_bytes())
