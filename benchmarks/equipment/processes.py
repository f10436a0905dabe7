"""Start nodes as processes and observe them with a probe, for benchmarks and demos.

The processes end when their parent process ends, even if it is killed.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import NoReturn

from rich.console import Console

from uwb_mitigation.errors import UwbMitigationError

TIMEOUT_S = 30.0
ENTRY = "uwb_mitigation.commands.entry"
"""Module of the executables of this package."""
_DEPTH = 50_000


def isolate() -> None:
    """Restrict the nodes of this process and its children to this machine and a separate ROS domain.

    Environment variables that are already set are not changed.
    """
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def start(
    node: str, *parameters: str, namespace: str = "", log_level: str = "warn", module: str = ENTRY
) -> subprocess.Popen[bytes]:
    """Start a node of this package with parameters such as `rate:=2.0`; call `stop` at the end.

    If this process is killed, Linux ends the node with the calling thread.
    """
    # SIGTERM must raise as Ctrl-C does, so that the nodes are stopped.
    if threading.current_thread() is threading.main_thread() and (
        signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    ):
        signal.signal(signal.SIGTERM, _exit)
    command = [sys.executable, "-m", module, node, "--ros-args", "--log-level", log_level]
    if (setpriv := shutil.which("setpriv")) is not None:
        command = [setpriv, "--pdeathsig", "INT", *command]
    if namespace:
        command += ["-r", f"__ns:=/{namespace}"]
    for parameter in parameters:
        command += ["-p", parameter]
    # A new process group, so that Ctrl-C reaches only this process, which stops the nodes in order. The same session,
    # as in a launch: Linux schedules sessions first, and a nice value applies within a session.
    if sys.version_info >= (3, 11):
        return subprocess.Popen(command, process_group=0)
    return subprocess.Popen(command, preexec_fn=os.setpgrp)


def stop(*processes: subprocess.Popen[bytes]) -> list[int]:
    """Stop nodes with SIGINT and return their exit codes; kill a node if it does not end.

    Other signals are ignored meanwhile, so that no node keeps running.
    """
    numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    before = {number: signal.signal(number, signal.SIG_IGN) for number in numbers}
    try:
        for process in processes:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        return [_exit_code(process) for process in processes]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _exit(number: int, frame: object) -> NoReturn:
    sys.exit(128 + number)


def _exit_code(process: subprocess.Popen[bytes]) -> int:
    try:
        return process.wait(timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def wait(
    condition: Callable[[], bool], failure: str, processes: Sequence[subprocess.Popen[bytes]] = ()
) -> None:
    """Wait until a condition holds.

    Raises:
        UwbMitigationError: with the text `failure`, at a timeout or if a process has ended.
    """
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        if time.monotonic() > deadline or any(process.poll() is not None for process in processes):
            raise UwbMitigationError(failure)
        time.sleep(0.001)


class NodeProcesses:
    """The nodes of a demo, as processes; they are stopped at the end of the block.

    Attributes:
        failures: error messages; after the block, also the nodes that ended with an error.
    """

    def __init__(self) -> None:
        self.failures: list[str] = []
        self._started: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, *parameters: str) -> None:
        self._started[name] = start(name, *parameters)

    def wait(self, condition: Callable[[], bool], failure: str) -> None:
        """Wait for a condition; raise UwbMitigationError at a timeout, or if a node has ended."""
        wait(condition, failure, self.processes)

    @property
    def processes(self) -> Sequence[subprocess.Popen[bytes]]:
        return list(self._started.values())

    @property
    def running(self) -> bool:
        return all(process.poll() is None for process in self.processes)

    def __enter__(self) -> NodeProcesses:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        codes = stop(*self.processes)
        self.failures += [
            f"{name} ended with exit code {code}"
            for name, code in zip(self._started, codes, strict=True)
            if code
        ]


def run_demo(name: str, run: Callable[[Console], Sequence[str]]) -> int:
    """Run a demo in its own ROS domain and print its failures; return the exit code: 0, 1 or 130 (Ctrl-C)."""
    isolate()
    console = Console()
    try:
        failures = run(console)
    except UwbMitigationError as error:
        failures = [f"{name}: {error}"]
    except KeyboardInterrupt:
        return 130
    for failure in failures:
        console.print(failure, style="red", markup=False)
    return 1 if failures else 0
