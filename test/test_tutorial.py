"""The commands and the notebook of the tutorials, and the output that pages quote."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import succeed
from conftest import REPOSITORY


def page(name: str | Path) -> str:
    return (REPOSITORY / name).read_text(encoding="utf-8")


TUTORIAL = page("docs/tutorials/first_steps.md")
COMMANDS = re.findall(r"^uwb-mitigation (?!doctor|view)(.*)$", TUTORIAL, re.M)
QUOTES = {
    "evaluate": (TUTORIAL, "`evaluate` prints:"),
    "track": (TUTORIAL, "correction only."),
    "process": (TUTORIAL, "and with which model:"),
    "residuals": (page("docs/tutorials/your_site.md"), "seeds 1 and 2) give:"),
    "info": (page("docs/guides/recordings.md"), "(real logs, 28 placements):"),
    "offset": (page("docs/guides/calibration.md"), "--truth --common -o offsets.yaml\n```"),
    "calibrate": (page("docs/guides/calibration.md"), "offset 0.22 m):"),
    "survey": (page("docs/guides/calibration.md"), "anchor 3 is entered 0.7 m off):"),
    "demo": (page("README.md"), "the demo prints (shortened):"),
}


def quoted(text: str, before: str) -> str:
    _, found, after = text.partition(f"{before}\n\n```text\n")
    assert found, before
    return after.partition("```")[0]


def lines(text: str) -> list[str]:
    """Return lines without box characters and ids of models."""
    text = re.sub(r"\b(model|id) [0-9a-f]{8}", "ID", re.sub(r"\d+ ranges/s", "N ranges/s", text))
    return [" ".join(re.sub("[┃│┏┡├└━┳╇┻┴┼─┓┩┘┤]", " ", line).split()) for line in text.splitlines()]


def output_of(folder: Path, line: str) -> str:
    done = succeed(*shlex.split(line), folder=folder, columns=80)
    assert max((len(line) for line in done.stdout.splitlines() if line[:1] in ("┃", "│")), default=0) <= 80
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tutorial")


@pytest.fixture(scope="module")
def outputs(folder: Path) -> dict[str, str]:
    """The output of each command."""
    return {line: output_of(folder, line) for line in COMMANDS}


ANCHORS = "--anchors drive.anchors.yaml --height 0"


@pytest.fixture(scope="module")
def calibrated(folder: Path, outputs: dict[str, str]) -> str:
    """The output of `calibrate`, and its model in `site.onnx`."""
    return output_of(folder, f"calibrate drive.mcap {ANCHORS} -o site.onnx")


def printed(name: str, folder: Path, request: pytest.FixtureRequest) -> str:
    if name in ("info", "offset"):
        if name == "info":
            return output_of(folder, f"data info {shlex.quote(str(request.getfixturevalue('apartment')))}")
        bag = request.getfixturevalue("apartment_imported") / "apartment.mcap"
        return output_of(folder, f"offset {shlex.quote(str(bag))} --truth --common")
    if name == "demo":
        pytest.importorskip("rclpy", reason="ROS is not set up: run make setup")
        words = [sys.executable, "-m", "benchmarks", "demo", "--rate", "2"]
        environment = os.environ | {"COLUMNS": "80"}
        return subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stdout
    outputs: dict[str, str] = request.getfixturevalue("outputs")
    if name in ("evaluate", "track", "process"):
        return next(text for line, text in outputs.items() if line.startswith(name))
    if name == "survey":
        text = (folder / "drive.anchors.yaml").read_text()
        assert "x: 5.6," in text
        (folder / "moved.yaml").write_text(text.replace("x: 5.6,", "x: 6.3,"))
        output_of(folder, "process drive.mcap -o without_offsets.mcap")
        return output_of(
            folder, "survey without_offsets.mcap --anchors moved.yaml --height 0 --off 1.0 -o surveyed.yaml"
        )
    calibrated: str = request.getfixturevalue("calibrated")
    if name == "calibrate":
        return calibrated
    output_of(folder, "data simulate --like drive --ranges 3000 --seed 2 -o second.mcap")
    output_of(
        folder, "process second.mcap --model site.onnx --offsets site.offsets.yaml -o second_corrected.mcap"
    )
    return output_of(folder, f"track second_corrected.mcap {ANCHORS} -o second_track.mcap")


@pytest.mark.parametrize("name", QUOTES)
def test_quoted_output_is_printed(name: str, folder: Path, request: pytest.FixtureRequest):
    shown = lines(printed(name, folder, request))
    quote = lines(quoted(*QUOTES[name]))
    assert [line for line in quote if line and line not in shown] == []
    if name == "process":
        assert [line for line in shown if line and line not in quote] == []


def test_tables_on_pages_are_covered():
    texts = [quoted(*place) for place in QUOTES.values()]
    pages = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*/*.md"))]
    blocks = [block for path in pages for block in re.findall(r"```text\n(.*?)```", page(path), re.S)]
    tables = [block for block in blocks if "┃" in block or "│ " in block]
    assert len(tables) >= len(QUOTES) - 1
    # The figures of `monitor` differ with the time; test_monitor.py compares its header.
    assert [block for block in tables if block not in texts and "rate" not in block] == []


NOTEBOOK = REPOSITORY / "docs" / "tutorials" / "own_ranges.ipynb"


@pytest.mark.slow
def test_cells_run_and_the_correction_reduces_the_error(tmp_path: Path):
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert not any(cell.get("outputs") for cell in cells), "the notebook is committed without outputs"
    script = tmp_path / "own_ranges.py"
    script.write_text("\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"))
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"MPLBACKEND": "agg", "PATH": path}
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    raw, corrected = (
        float(line.split()[-2]) for line in done.stdout.splitlines() if "mean absolute error" in line
    )
    assert corrected < 0.5 * raw
