"""Run jobs in several processes, with a journal: jobs that an earlier run finished are not repeated."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, TypeVar

from uwb_mitigation.errors import ParameterError, UwbMitigationError

Job = TypeVar("Job")


def run_jobs(
    work: Callable[[Job], dict[str, Any]],
    jobs: Mapping[str, Job],
    journal: Path,
    fingerprint: int,
    *,
    cost: Callable[[Job], float],
    workers: int = 1,
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> dict[str, dict[str, Any]]:
    """Return {name: result} of all jobs, in the order of `jobs`.

    Args:
        work: called with each job; its result can be written as JSON. Picklable if there are several workers.
        jobs: {name: job}.
        journal: file with one JSON object per line; lines with another fingerprint are ignored.
        fingerprint: checksum of data and options.
        cost: computing time of a job, in any unit; the most expensive jobs start first.
        workers: processes; 1 runs everything in this process.
        on_progress: called with the finished share of the work, 0 to 1.

    Raises:
        ParameterError: `workers` is less than 1.
        UwbMitigationError: a process was killed, or the journal cannot be read or written; any error of `work`.
    """
    if workers < 1:
        raise ParameterError(f"{workers} workers", valid="1 or more")
    try:
        results = _finished(journal, fingerprint, jobs)
        stream = journal.open("a", encoding="utf-8")
    except OSError as error:
        raise UwbMitigationError(f"cannot be used: {error.strerror}", where=str(journal)) from error
    missing = sorted((name for name in jobs if name not in results), key=lambda name: -cost(jobs[name]))
    total = sum(map(cost, jobs.values())) or 1.0
    with stream:
        for name, result in _run(work, {name: jobs[name] for name in missing}, workers):
            results[name] = result
            # The line before may be incomplete, if its process was killed.
            stream.write(f"\n{json.dumps({'fingerprint': fingerprint, 'name': name, 'result': result})}\n")
            stream.flush()
            on_progress(sum(cost(jobs[finished]) for finished in results) / total)
    return {name: results[name] for name in jobs}


def _finished(journal: Path, fingerprint: int, jobs: Mapping[str, Job]) -> dict[str, dict[str, Any]]:
    """Return the results of `jobs` in a journal."""
    results: dict[str, dict[str, Any]] = {}
    text = journal.read_text(encoding="utf-8", errors="replace") if journal.exists() else ""
    for line in text.splitlines():
        with contextlib.suppress(ValueError, TypeError, KeyError):  # empty or incomplete line
            entry = json.loads(line)
            if entry["fingerprint"] == fingerprint and entry["name"] in jobs:
                results[entry["name"]] = dict(entry["result"])
    return results


def _run(
    work: Callable[[Job], dict[str, Any]], jobs: Mapping[str, Job], workers: int
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and result of each job as it ends; the jobs start in their order."""
    if workers == 1 or len(jobs) < 2:
        for name, job in jobs.items():
            yield name, work(job)
        return
    # Not forked: a forked child would inherit torch's thread pools in an undefined state.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(jobs)), context) as pool:
        pending = {pool.submit(work, job): name for name, job in jobs.items()}
        try:
            for future in as_completed(pending):
                yield pending[future], future.result()
        except BrokenProcessPool as error:
            raise UwbMitigationError(
                "a training process was killed", valid="fewer workers, or more memory"
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
