"""What tests need from the real logs, made once for all workers of a test run."""

from __future__ import annotations

import fcntl
import os
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.types.measurement import Record


def make_once(name: str, tmp_path_factory: pytest.TempPathFactory, make: Callable[[Path], object]) -> Path:
    """Return a folder that the first worker fills with `make`, for all workers."""
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    folder = shared / name
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "complete").exists():
            folder.mkdir(exist_ok=True)
            make(folder)
            (folder / "complete").touch()
    return folder


def read_once(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Record]:
    """Return the records of a recording."""

    def read(folder: Path) -> None:
        with open_recording(recording) as source:
            (folder / "records.pickle").write_bytes(pickle.dumps(list(source)))

    kept = make_once(f"{recording.name}_read", tmp_path_factory, read)
    return pickle.loads((kept / "records.pickle").read_bytes())


def import_once(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with `apartment.mcap`, `import.json` and `printed.txt` of `data import`."""
    from command_line import succeed  # Quick tests without commands load this module, too.

    def convert(folder: Path) -> None:
        options = "-o apartment.mcap --longest-pause inf --json import.json"
        done = succeed("data", "import", recording, *options.split(), folder=folder)
        (folder / "printed.txt").write_text(done.stdout)

    return make_once(f"{recording.name}_imported", tmp_path_factory, convert)
