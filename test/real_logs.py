"""What tests need from the real logs, made once for all workers of a test run."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import pytest


def import_once(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with `apartment.mcap`, `import.json` and `printed.txt` of `data import`."""
    from command_line import succeed  # Quick tests without commands load this module, too.

    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    folder = shared / f"{recording.name}_imported"
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "printed.txt").exists():
            folder.mkdir(exist_ok=True)
            options = "-o apartment.mcap --longest-pause inf --json import.json"
            done = succeed("data", "import", recording, *options.split(), folder=folder)
            (folder / "printed.txt").write_text(done.stdout)
    return folder
