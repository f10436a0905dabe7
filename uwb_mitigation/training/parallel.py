"""Jobs over several processes of one thread each, with progress that all of them report to."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol, TypeVar

from uwb_mitigation.errors import ParameterError, UwbMitigationError

J = TypeVar("J", contravariant=True)

_POLL_S = 0.5
_worker: Any = None
_counter: Any = None


class Work(Protocol[J]):
    """Does one job, and calls `advance` with the amounts of work that are done."""

    def __call__(self, job: J, advance: Callable[[float], None], /) -> None: ...


def each(work: Work[J], jobs: Sequence[J], workers: int, on_progress: Callable[[float], None]) -> None:
    """Do every job, in this process if `workers` is 1; `on_progress` is called with the work done in sum.

    The first job to fail ends the others, and its error is raised.

    Raises:
        ParameterError: `workers` is less than 1.
        UwbMitigationError: a process was killed.
    """
    if workers < 1:
        raise ParameterError(f"{workers} workers", valid="1 or more")
    if workers == 1 or len(jobs) < 2:
        amounts: list[float] = []

        def advance(amount: float) -> None:
            amounts.append(amount)
            on_progress(sum(amounts))

        for job in jobs:
            work(job, advance)
        return
    # A forked child would inherit torch's thread pools in whatever state they are.
    context = multiprocessing.get_context("spawn")
    counter = context.Value("d", 0.0)
    with ProcessPoolExecutor(min(workers, len(jobs)), context, _start, (work, counter)) as pool:
        pending = {pool.submit(_do, job) for job in jobs}
        try:
            while pending:
                done, pending = wait(pending, _POLL_S, FIRST_EXCEPTION)
                on_progress(counter.value)
                for future in done:
                    future.result()
        except BrokenProcessPool as error:
            raise UwbMitigationError(
                "a training process ended abruptly", valid="fewer workers, or more memory"
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _start(work: Any, counter: Any) -> None:
    global _worker, _counter
    _worker, _counter = work, counter


def _do(job: Any) -> None:
    def advance(amount: float) -> None:
        with _counter.get_lock():
            _counter.value += amount

    _worker(job, advance)
