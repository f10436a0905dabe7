"""Modelled chips behind the EVB1000's USB-to-SPI protocol: the protocol, the ports, and ranging in wall-clock time."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import serial
from compilers import NEEDS_CC

pytestmark = NEEDS_CC

PATIENCE_S = 240


def test_the_command_prints_its_ports_unplugs_on_a_signal_and_ends(tmp_path: Path):
    command = [
        sys.executable,
        "-m",
        "benchmarks",
        "emulate-evb1000",
        "--boards",
        "3",
        "--ranging",
        "2",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = [process.stdout.readline().split(" at ") for _ in range(3)]
        assert [what for what, _ in lines] == ["tag", "anchor 1", "anchor 2"]
        with serial.Serial(lines[2][1].strip(), timeout=PATIENCE_S) as port:
            port.write(b"deca?")
            assert port.read(1) == b"n"
        process.send_signal(signal.SIGUSR1)
        assert process.stdout.readline().startswith("board 0 plugged in again at /dev/")
        process.send_signal(signal.SIGINT)
        try:
            assert process.wait(PATIENCE_S) == 130
        finally:
            process.kill()
