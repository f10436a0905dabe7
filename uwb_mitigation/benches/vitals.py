"""What a process takes of its machine."""

from __future__ import annotations

from dataclasses import dataclass

import psutil

from uwb_mitigation.errors import UwbMitigationError


@dataclass(frozen=True, slots=True)
class Vitals:
    """Processor time so far, s, of all threads; resident memory, MB; open file descriptors; threads."""

    cpu_s: float
    memory_mb: float
    descriptors: int
    threads: int


def look(pid: int) -> Vitals:
    """Look at a process.

    Raises:
        UwbMitigationError: there is no such process.
    """
    try:
        process = psutil.Process(pid)
        with process.oneshot():
            times = process.cpu_times()
            return Vitals(
                times.user + times.system,
                process.memory_info().rss / 2**20,
                process.num_fds(),
                process.num_threads(),
            )
    except psutil.Error as error:
        raise UwbMitigationError(f"process {pid} has ended", valid="its last words are above") from error
