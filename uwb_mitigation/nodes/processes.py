"""Nodes as processes of their own, for the benchmarks and demos that watch them from outside. No ROS here.

They end with the process that started them, however that ends.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
from typing import NoReturn

_PATIENCE_S = 30.0


def isolate() -> None:
    """Keep this process's nodes, and those that it starts, on this machine and on a domain of their own.

    So they meet no robot and no second demo. What the environment says already is left as it is.
    """
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def start(
    node: str, *parameters: str, namespace: str = "", log_level: str = "warn"
) -> subprocess.Popen[bytes]:
    """Start a node of this package with parameters such as `rate:=2.0`; `stop` is to be called in the end.

    It ends with the thread that calls: by Linux, should this process be killed.
    """
    if threading.current_thread() is threading.main_thread():
        _leave_on_sigterm()
    command = [sys.executable, "-m", "uwb_mitigation.entry", node, "--ros-args", "--log-level", log_level]
    if (setpriv := shutil.which("setpriv")) is not None:
        command = [setpriv, "--pdeathsig", "INT", *command]
    if namespace:
        command += ["-r", f"__ns:=/{namespace}"]
    for parameter in parameters:
        command += ["-p", parameter]
    # A group of its own: Ctrl-C reaches this process, which ends the nodes in order. But of one session, as a launch
    # has them: Linux shares processors between sessions first, and a nice value counts within one.
    if sys.version_info >= (3, 11):
        return subprocess.Popen(command, process_group=0)
    return subprocess.Popen(command, preexec_fn=os.setpgrp)


def stop(*processes: subprocess.Popen[bytes]) -> list[int]:
    """End nodes as Ctrl-C would, and return their exit codes; kill only what does not end.

    Another signal meanwhile is not listened to: it must not leave one of them behind.
    """
    # Only the main thread may say so, and only it is interrupted.
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


def _leave_on_sigterm() -> None:
    """From now on SIGTERM raises, as Ctrl-C does, so that whoever started nodes stops them."""
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _leave)


def _leave(number: int, frame: object) -> NoReturn:
    sys.exit(128 + number)


def _exit_code(process: subprocess.Popen[bytes]) -> int:
    try:
        return process.wait(timeout=_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()
