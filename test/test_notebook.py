"""The notebook of the tutorials: its cells run as one script, and mypy checks them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPOSITORY

NOTEBOOK = REPOSITORY / "docs" / "tutorials" / "own_ranges.ipynb"


def script(folder: Path) -> Path:
    """Write the cells as a script."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert not any(cell.get("outputs") for cell in cells), "the notebook is committed without outputs"
    path = folder / "own_ranges.py"
    path.write_text("\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"))
    return path


@pytest.mark.slow
def test_cells_run_and_the_correction_reduces_the_error(tmp_path: Path):
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"MPLBACKEND": "agg", "PATH": path}
    command = [sys.executable, script(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    raw, corrected = (
        float(line.split()[-2]) for line in done.stdout.splitlines() if "mean absolute error" in line
    )
    assert corrected < 0.5 * raw


@pytest.mark.slow
def test_cells_have_valid_types(tmp_path: Path):
    command = [sys.executable, "-m", "mypy", "--strict", "--config-file", str(REPOSITORY / "pyproject.toml")]
    done = subprocess.run(
        [*command, script(tmp_path)], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout
