"""What a process takes of its machine, from proc(5)."""

from __future__ import annotations

import os
from pathlib import Path

from uwb_mitigation.errors import UwbMitigationError


def cpu_ns(pid: int) -> int:
    """Time on a processor so far, of all threads that live.

    Raises:
        UwbMitigationError: there is no such process.
    """
    try:
        tasks = Path(f"/proc/{pid}/task").iterdir()
        return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks)
    except OSError as error:
        raise _gone(pid) from error


def memory_kb(pid: int) -> int:
    """Resident memory.

    Raises:
        UwbMitigationError: there is no such process.
    """
    try:
        return int(Path(f"/proc/{pid}/status").read_text().split("VmRSS:")[1].split()[0])
    except (OSError, IndexError) as error:
        raise _gone(pid) from error


def descriptors(pid: int) -> int:
    """Open file descriptors.

    Raises:
        UwbMitigationError: there is no such process.
    """
    return _entries(pid, "fd")


def threads(pid: int) -> int:
    """Threads.

    Raises:
        UwbMitigationError: there is no such process.
    """
    return _entries(pid, "task")


def _entries(pid: int, folder: str) -> int:
    try:
        return len(os.listdir(f"/proc/{pid}/{folder}"))
    except OSError as error:
        raise _gone(pid) from error


def _gone(pid: int) -> UwbMitigationError:
    return UwbMitigationError(f"process {pid} has ended", valid="its last words are above")
