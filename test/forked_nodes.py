"""Nodes as forks of a process that has imported them, because imports take most of the time to start a node.

`test_entry`, `test_launch` and `test_installed` start the executables.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from signal import Signals
from typing import Any

from uwb_mitigation.commands import entry

ENTRY = [sys.executable, "-m", entry.__name__]
AT_START = {name: os.environ.get(name) for name in ("PYTHONPATH", "LD_LIBRARY_PATH")}
"""Variables that are read only when a process starts."""

PRELOADED = (
    *("onnxruntime", "rclpy.experimental", "rosbags.typesys", "rosidl_generator_py"),
    *("geometry_msgs.msg", "nav_msgs.msg", "sensor_msgs.msg", "type_description_interfaces.msg"),
)
"""What nodes import when they need it."""


def can_fork(command: list[str], environment: dict[str, str]) -> bool:
    """Return whether a command starts a node, without other libraries than those of this process."""
    same = all(environment.get(name) == value for name, value in AT_START.items())
    return same and command[: len(ENTRY)] == ENTRY


class ForkedNode:
    """A node with the methods of `subprocess.Popen`."""

    def __init__(self, command: list[str], environment: dict[str, str], log: Path) -> None:
        log.touch()
        self.pid = _ask(command[len(ENTRY) :], environment, str(Path.cwd()), str(log.absolute()))
        self._code: int | None = None

    def poll(self) -> int | None:
        if self._code is None:
            self._code = _ask(self.pid)
        return self._code

    def wait(self, timeout_s: float) -> int:
        deadline = time.monotonic() + timeout_s
        while (code := self.poll()) is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("a node", timeout_s)
            time.sleep(0.02)
        return code

    def send_signal(self, number: Signals) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)


@cache
def _server() -> subprocess.Popen[str]:
    """Return the process that forks; it ends with this one."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    server = subprocess.Popen([sys.executable, "-u", __file__], text=True, **pipes)
    atexit.register(server.communicate)
    return server


def _ask(*request: object) -> Any:
    server = _server()
    print(json.dumps(request), file=server.stdin, flush=True)
    return json.loads(server.stdout.readline())


def serve() -> None:
    """Answer requests: fork a node (its PID), or ask for its exit code; return in a fork when its node has ended."""
    sys.path[0] = ""  # as with `python -m`
    for module in PRELOADED:
        importlib.import_module(module)
    while line := sys.stdin.readline():
        request = json.loads(line)
        if len(request) == 1:
            pid, status = os.waitpid(request[0], os.WNOHANG)
            print(json.dumps(os.waitstatus_to_exitcode(status) if pid else None))
            continue
        (node, *words), environment, folder, log = request
        importlib.import_module("uwb_mitigation.nodes.support.spinning").load_node(node)
        if pid := os.fork():
            print(pid)
            continue
        os.environ.clear()
        os.environ.update(environment)
        os.chdir(folder)
        out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        for number, file in enumerate((os.open(os.devnull, os.O_RDONLY), out, out)):
            os.dup2(file, number)
        sys.argv = [entry.__file__, *words]
        getattr(entry, node)()
        return


if __name__ == "__main__":
    serve()
