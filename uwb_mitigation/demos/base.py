"""What the demos share: nodes as processes that are stopped in the end, and one line for each failure."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from types import TracebackType

from rich.console import Console

from uwb_mitigation.errors import UwbMitigationError
from uwb_mitigation.nodes import processes


class Nodes:
    """The nodes of a demo, as processes; they are stopped at the end of the block.

    Attributes:
        failures: what went wrong; after the block with the nodes that ended with an error.
    """

    def __init__(self) -> None:
        self.failures: list[str] = []
        self._started: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, *parameters: str) -> None:
        self._started[name] = processes.start(name, *parameters)

    def wait(self, condition: Callable[[], bool], failure: str) -> None:
        """Wait for a condition; raise UwbMitigationError at a timeout, or if a node has ended."""
        processes.wait(condition, failure, self.processes)

    @property
    def processes(self) -> Sequence[subprocess.Popen[bytes]]:
        return list(self._started.values())

    @property
    def running(self) -> bool:
        return all(process.poll() is None for process in self.processes)

    def __enter__(self) -> Nodes:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        codes = processes.stop(*self.processes)
        self.failures += [
            f"{name} ended with exit code {code}"
            for name, code in zip(self._started, codes, strict=True)
            if code
        ]


def run_demo(name: str, run: Callable[[Console], Sequence[str]]) -> int:
    """Run a demo in its own ROS domain and print its failures; return the exit code: 0, 1 or 130 (Ctrl-C)."""
    processes.isolate()
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
