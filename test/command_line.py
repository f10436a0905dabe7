"""Run `uwb-mitigation`, or `python -m benchmarks` (`paper` and `emulate-board`), in the process of the test, which saves a second of imports.

Each command also has at least one test that starts a process (`start`).
"""

import contextlib
import io
import os
import shlex
import subprocess
import sys
from pathlib import Path
from unittest import mock

import benchmarks.cli
from uwb_mitigation.commands import cli
from uwb_mitigation.commands.support import console

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parent.parent), "COLUMNS": "160"}
"""Environment of a command in its own process: the package of this repository, and the terminal width."""

Finished = subprocess.CompletedProcess[str]
OF_BENCHMARKS = ("paper", "emulate-board")


def run(words: str, *arguments: object, folder: Path, columns: int = 160) -> Finished:
    """Run the command in `folder`, on a terminal of the given width: `words` as in a shell, then arguments."""
    out, err = io.StringIO(), io.StringIO()
    before = Path.cwd()
    with (
        mock.patch.object(sys, "argv", ["uwb-mitigation", *shlex.split(words), *map(str, arguments)]),
        mock.patch.dict(os.environ, COLUMNS=str(columns)),
        # A console that another test created has the width of that time.
        mock.patch.object(console.out, "_width", columns),
        mock.patch.object(console.err, "_width", columns),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        os.chdir(folder)
        try:
            (benchmarks.cli.main if words.startswith(OF_BENCHMARKS) else cli.main)()
            code = 0
        except SystemExit as end:
            code = end.code or 0
        finally:
            os.chdir(before)
    return Finished(words, code, out.getvalue(), err.getvalue())


def succeed(words: str, *arguments: object, folder: Path, columns: int = 160) -> Finished:
    """Run the command, which must exit with 0; see `run`."""
    done = run(words, *arguments, folder=folder, columns=columns)
    assert done.returncode == 0, done.stderr
    return done


def start(words: str, *arguments: object, folder: Path) -> Finished:
    """Run the command in `folder` in a separate process; see `run`."""
    options = {"cwd": folder, "env": ENVIRONMENT, "capture_output": True, "text": True, "timeout": 240}
    return subprocess.run(command(words, *arguments), **options, check=False)


def command(words: str, *arguments: object) -> list[str]:
    """Return the command line; see `run`."""
    module = "benchmarks" if words.startswith(OF_BENCHMARKS) else "uwb_mitigation.commands.cli"
    return [sys.executable, "-m", module, *shlex.split(words), *map(str, arguments)]
