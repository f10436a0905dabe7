"""Measure the figures of the documentation again, and print those that differ from the pages.

    python docs/figures.py [--list] [WORD ...]     # only commands and pages that contain all words
    make figures [WORDS='results nodes']

Each figure of a page is in the same section as the commands that reproduce it. This runs these commands and looks for every decimal
number of the section (outside of code) in their outputs, rounded as in the page; percentages, mm and ms are converted. A number that is
not found is printed with the nearest one. A number that is found by chance is not noticed, and speeds differ with every run.
Outputs are kept in `build/figures/COMMIT`, so that an interrupted run continues. `$UWB_MITIGATION_DATA` is the folder of recordings.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
PAGES = [
    REPOSITORY / "README.md",
    *sorted((REPOSITORY / "docs").glob("*/*.md")),
    *sorted((REPOSITORY / "models").glob("*.md")),
]
MEASURES = re.compile(
    r"(?:python docs/experiments/|python -m benchmarks (?:firmware|link|locator|nodes|positions|radio|serial|soak|uci)\b"
    r"|uwb-mitigation evaluate )[^`\n]*"
)
NUMBER = re.compile(r"(?<![\w.,/-])-?(\d[\d,]*\.\d+)(?![\w.])( %| mm| ms)?")
SCALES = {" %": 100.0, " mm": 1000.0, " ms": 1000.0}


@dataclass
class Section:
    """A section of a page: its commands, and its figures with the number of their line."""

    title: str
    commands: list[str] = field(default_factory=list)
    figures: list[tuple[int, str, str]] = field(default_factory=list)


def sections_of(page: Path) -> Iterator[Section]:
    """Yield the sections of a page that contain figures or commands."""
    section, is_code = Section(page.name), False
    # A command that continues on the next line is read as one, and the numbers of the lines stay.
    joined = re.sub(r"\\\n +(.*)", r"\1\n", page.read_text(encoding="utf-8"))
    for number, line in enumerate(joined.splitlines(), 1):
        if line.startswith("```"):
            is_code = not is_code
        elif line.startswith("#") and not is_code:
            yield section
            section = Section(line.lstrip("# "))
        section.commands += [found.strip() for found in MEASURES.findall(line.partition("   #")[0])]
        if not is_code:
            text = re.sub(r"`[^`]*`|\]\([^)]*\)|10\.\d{4,}/\S+", " ", line)
            section.figures += [(number, value, unit) for value, unit in NUMBER.findall(text)]
    yield section


def outputs_of(command: str, folder: Path) -> list[float]:
    """Run a command, unless its output is kept, and return all numbers of its output and of its JSON result."""
    stem = folder / hashlib.sha256(command.encode()).hexdigest()[:12]
    text, result = stem.with_suffix(".txt"), stem.with_suffix(".json")
    if not text.exists():
        started = time.monotonic()
        words = f"{command} --json {result}" if "-m benchmarks" in command else command
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        environment = os.environ | {"PATH": path, "PYTHONPATH": str(REPOSITORY), "COLUMNS": "200"}
        done = subprocess.run(
            words, shell=True, cwd=REPOSITORY, env=environment, stdout=subprocess.PIPE, text=True, check=False
        )
        print(f"  {time.monotonic() - started:.0f} s, exit code {done.returncode}: {command}", flush=True)
        if done.returncode:
            return []
        text.write_text(f"{command}\n{done.stdout}", encoding="utf-8")
    found = [
        float(value.replace(",", ""))
        for value in re.findall(r"-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?", text.read_text(encoding="utf-8"))
    ]
    return found + (list(_numbers(json.loads(result.read_text(encoding="utf-8")))) if result.exists() else [])


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, int | float):
        yield float(value)
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _numbers(item)


def difference(figure: str, unit: str, measured: list[float]) -> str:
    """Return the nearest measured value if none of them rounds to the figure; otherwise an empty text."""
    digits, expected = len(figure.partition(".")[2]), float(figure.replace(",", ""))
    candidates = [abs(value) * scale for value in measured for scale in {1.0, SCALES.get(unit, 1.0)}]
    nearest = min(candidates, key=lambda value: abs(value - expected), default=float("nan"))
    return "" if abs(nearest - expected) <= 0.501 * 10.0**-digits else f"{nearest:.{digits}f}"


def main() -> None:
    """Compare all pages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="*", help="words that page, section or command contain")
    parser.add_argument(
        "--list", action="store_true", help="print the commands, and figures without one; run nothing"
    )
    options = parser.parse_args()
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    folder = REPOSITORY / "build" / "figures" / (commit.stdout.strip() or "unknown")
    folder.mkdir(parents=True, exist_ok=True)
    pages = {str(page.relative_to(REPOSITORY)): [*sections_of(page)] for page in PAGES}
    elsewhere = {
        figure
        for sections in pages.values()
        for section in sections
        if section.commands
        for _, figure, _ in section.figures
    }
    for name, sections in pages.items():
        for section in sections:
            about = " ".join([name, section.title, *section.commands])
            if not section.figures or not all(word in about for word in options.words):
                continue
            print(
                f"{name}, {section.title}: {len(section.figures)} figures, {len(section.commands)} commands"
            )
            if not section.commands:
                alone = [
                    f"{number}: {figure}{unit}"
                    for number, figure, unit in section.figures
                    if figure not in elsewhere
                ]
                print(
                    "  not in a section with a command (constants, sources, or figures without one):",
                    *alone,
                    sep="\n    ",
                )
                continue
            if options.list:
                print(*(f"  {command}" for command in section.commands), sep="\n")
                continue
            measured = [value for command in section.commands for value in outputs_of(command, folder)]
            for number, figure, unit in section.figures:
                if nearest := difference(figure, unit, measured):
                    print(f"  {name}:{number}: {figure}{unit}, measured {nearest}")


if __name__ == "__main__":
    main()
