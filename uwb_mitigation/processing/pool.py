"""Many jobs at once: a process for each bag on this machine, or an existing Dask cluster.

A process of its own keeps a bag that exhausts memory or crashes a library from taking others with it. Dask beside
the processes: they need nothing but Python and have one machine's cores, a fleet's recordings need many machines.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import FrameType

from uwb_mitigation.bag.writer import partial_file
from uwb_mitigation.errors import MissingDependencyError, ParameterError, RecordingError
from uwb_mitigation.processing.job import Job, Outcome, attempt

STOP_TIMEOUT_S = 10.0
"""How long a worker may take to remove what it was writing."""


@dataclass(frozen=True, slots=True)
class Progress:
    """A job that has started, and how far it is, in messages."""

    job: Job
    done: int = 0
    total: int = 0


Event = Progress | Outcome


def cores() -> int:
    """The processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_here(jobs: Sequence[Job], workers: int) -> Iterator[Event]:
    """Do the jobs, at most `workers` at a time, each in a process; outcomes come as they are ready.

    Closing the iterator, or Ctrl-C, stops the workers, which remove what they have not finished.
    """
    # Forking what has threads (ONNX Runtime, rich) may deadlock; the server forks from a clean state.
    server = "forkserver" in multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if server else "spawn")
    if server:
        context.set_forkserver_preload([__name__])
    waiting = deque(jobs)
    running: dict[Connection, tuple[Job, BaseProcess]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                job = waiting.popleft()
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(target=_work, args=(job, theirs), daemon=True)  # type: ignore[attr-defined]
                process.start()
                theirs.close()
                running[ours] = (job, process)
                yield Progress(job)
            for ready in wait(list(running)):
                assert isinstance(ready, Connection)
                job, process = running[ready]
                try:
                    event: Event = ready.recv()
                except (EOFError, OSError):
                    process.join()
                    event = _died(job, process.exitcode)
                if isinstance(event, Outcome):
                    process.join()
                    ready.close()
                    del running[ready]
                yield event
    finally:
        _stop([process for _, process in running.values()], [job for job, _ in running.values()])


def run_on_dask(jobs: Sequence[Job], address: str) -> Iterator[Event]:
    """Do the jobs on the Dask cluster whose scheduler is at `address`; outcomes come as they are ready.

    The workers need this package, and the same paths as here. Closing the iterator withdraws what has not
    started; a worker finishes the bag that it is at, since Dask cannot interrupt it.

    Raises:
        MissingDependencyError: `distributed` is not installed.
        ParameterError: no scheduler answers.
    """
    try:
        from distributed import Client, as_completed
        from distributed.comm import get_address_host
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            "a scheduler needs Dask", valid="python -m pip install distributed"
        ) from error
    try:
        # A client that fails on the address itself takes a minute to be disposed of.
        get_address_host(address)
        client = Client(address, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = str(error) or type(error).__name__
        raise ParameterError(
            f"no Dask scheduler: {reason}", where=address, valid="tcp://HOST:8786, as `dask scheduler` prints"
        ) from error
    with client:
        futures = {client.submit(attempt, job, pure=False): job for job in jobs}
        try:
            for future in as_completed(list(futures), loop=client.loop):
                job = futures[future]
                problem = future.exception()
                if problem is None:
                    yield future.result()
                else:
                    reason = f"the cluster could not process it: {type(problem).__name__}: {problem}"
                    yield Outcome(job, error=RecordingError(reason, where=str(job.source)))
        finally:
            client.cancel(list(futures))


def _work(job: Job, events: Connection) -> None:
    """A worker: reports progress and, last, the outcome."""
    # The terminal sends Ctrl-C to everybody: the parent decides, and asks by SIGTERM.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    with contextlib.suppress(BrokenPipeError):
        events.send(attempt(job, lambda done, total: events.send(Progress(job, done, total))))


def _leave(number: int, frame: FrameType | None) -> None:
    sys.exit(128 + number)


def _died(job: Job, exit_code: int | None) -> Outcome:
    reason = f"exit code {exit_code}"
    if exit_code is not None and exit_code < 0:
        reason = signal.Signals(-exit_code).name
        if exit_code == -signal.SIGKILL:
            reason += ", as when memory runs out"
    _remove_partial(job)
    return Outcome(
        job, error=RecordingError(f"the process that worked on it died ({reason})", where=str(job.source))
    )


def _stop(processes: Sequence[BaseProcess], jobs: Sequence[Job]) -> None:
    for process in processes:
        process.terminate()
    for process, job in zip(processes, jobs, strict=True):
        process.join(STOP_TIMEOUT_S)
        if process.is_alive():
            process.kill()
            process.join()
        # Also of one that left by itself: it may have been about to enter what would have removed it.
        _remove_partial(job)


def _remove_partial(job: Job) -> None:
    with contextlib.suppress(OSError):
        partial_file(job.output).unlink(missing_ok=True)
