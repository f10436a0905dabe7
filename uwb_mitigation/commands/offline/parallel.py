"""Select bags and output paths; process bags in parallel on this machine or on a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

from uwb_mitigation.commands.offline.process import Job, Outcome, try_process
from uwb_mitigation.errors import ParameterError, RecordingError
from uwb_mitigation.recordings.bag.rosbag2 import listed_files
from uwb_mitigation.recordings.bag.writer import partial_file


def plan(sources: Sequence[Path], output: Path) -> dict[Path, Path]:
    """Return every bag in `sources` with its output path, {output: bag}.

    A single bag is written to `output` itself. Several bags, or a folder of bags, are written to the folder `output` with
    their names and subfolders. Outputs of an earlier run inside a source folder are skipped.

    Raises:
        RecordingError: a source is missing, or a folder contains no bag.
        ParameterError: `output` is a file instead of a folder, or two bags have the same output path.
    """
    if len(sources) == 1 and _is_one_bag(sources[0]):
        return {output: sources[0]}
    folders = {source: list(_bags(source, output.resolve())) for source in sources if not _is_one_bag(source)}
    for source, bags in folders.items():
        if not bags:
            valid = "MCAP bags; `uwb-mitigation data import` converts logs and tables"
            raise RecordingError("the folder contains no MCAP bag", where=source, valid=valid)
    if output.suffix == ".mcap" or (output.exists() and not output.is_dir()):
        raise ParameterError(
            "one output file for several bags",
            where=output,
            valid="a folder, which is created if it does not exist",
        )
    planned: dict[Path, Path] = {}
    for source in sources:
        if source not in folders:
            named = [(source, Path(source.resolve().name))]
        else:
            # Mirror the contents of a single folder; with several folders, also keep their names.
            root = Path() if len(sources) == 1 else Path(source.resolve().name)
            named = [(bag, root / bag.relative_to(source)) for bag in folders[source]]
        for bag, name in named:
            place = output / name
            if place in planned:
                raise ParameterError(
                    f"{planned[place]} and {bag} have the same name",
                    where=place,
                    valid="different names, or separate runs",
                )
            planned[place] = bag
    return planned


def _is_one_bag(path: Path) -> bool:
    """Return whether a path is a file, or a folder with a `metadata.yaml` of one bag."""
    if not path.exists():
        raise RecordingError("no such file or folder", where=path)
    if not path.is_dir():
        return True
    described = listed_files(path)
    return described is not None and {file.name for file in path.glob("*.mcap")} <= set(described)


def _bags(folder: Path, without: Path) -> Iterator[Path]:
    """Return the bags below a folder that is not a bag itself."""
    for place, folders, files in os.walk(folder):
        root = Path(place)
        below = []
        for name in sorted(folders):
            path = root / name
            if path.resolve() == without:
                continue
            if _may_be_one_bag(path):
                yield path
            else:
                below.append(name)
        folders[:] = below
        yield from (root / name for name in sorted(files) if name.endswith(".mcap"))


def _may_be_one_bag(path: Path) -> bool:
    try:
        return _is_one_bag(path)
    except RecordingError:
        # Processing this bag fails with the same error, which is reported without stopping the others.
        return True


def num_cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_locally(jobs: Sequence[Job], workers: int) -> Iterator[Outcome]:
    """Process the bags in at most `workers` processes; yield each outcome when it is ready.

    If a process crashes, for example because memory runs out, the remaining bags are processed one at a time, so that
    only the bag that causes it fails.
    """
    is_new = {job: not job.output.exists() for job in jobs}
    unfinished = []
    with _processes(min(workers, len(jobs))) as executor:
        for job, outcome in _run(executor, _in_worker, jobs):
            if outcome is None:
                unfinished.append(job)
            else:
                yield outcome
    for job in unfinished:
        # A process that was stopped may have written its output already.
        again = replace(job, force=job.force or is_new[job])
        reason = "the process crashed, perhaps because memory ran out"
        crashed = Outcome(job, error=RecordingError(reason, where=job.source))
        with _processes(1) as executor:
            for _, outcome in _run(executor, _in_worker, [again]):
                yield replace(outcome or crashed, job=job)
        partial_file(job.output).unlink(missing_ok=True)


def run_on_dask(jobs: Sequence[Job], address: str) -> Iterator[Outcome]:
    """Process the bags on the Dask cluster with the scheduler at `address`; yield each outcome when it is ready.

    The workers need this package and the same file paths. A bag that has started is finished even if the
    iterator is closed, since Dask cannot interrupt it.

    Raises:
        ImportError: `distributed` is not installed.
        ParameterError: no scheduler responds.
    """
    from distributed import Client
    from distributed.comm import get_address_host

    try:
        # If the client itself tries an invalid address, closing it takes a minute.
        get_address_host(address)
        client = Client(address, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise ParameterError(
            f"no Dask scheduler: {str(error) or type(error).__name__}",
            where=address,
            valid="tcp://HOST:8786, as `dask scheduler` prints",
        ) from error
    with client, client.get_executor(pure=False) as executor:
        for _, outcome in _run(executor, try_process, jobs):
            assert outcome is not None
            yield outcome


def _processes(workers: int) -> ProcessPoolExecutor:
    # Forking a process with threads (ONNX Runtime, rich) may deadlock.
    server = "forkserver" in multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if server else "spawn")
    return ProcessPoolExecutor(workers, context, signal.signal, (signal.SIGINT, signal.SIG_IGN))


def _run(
    executor: Executor, work: Callable[[Job], Outcome], jobs: Sequence[Job]
) -> Iterator[tuple[Job, Outcome | None]]:
    """Yield each job with its outcome when it is ready; None: a worker process crashed before."""
    futures = {executor.submit(work, job): job for job in jobs}
    try:
        for future in as_completed(futures):
            job = futures[future]
            try:
                yield job, future.result()
            except BrokenProcessPool:
                yield job, None
            except Exception as error:  # Errors of the cluster or of pickling have no common type.
                reason = f"cannot be processed: {type(error).__name__}: {error}"
                yield job, Outcome(job, error=RecordingError(reason, where=job.source))
    finally:
        for future in futures:
            future.cancel()


def _in_worker(job: Job) -> Outcome:
    """Process a bag. Ctrl-C, which a terminal sends to all processes, removes its unfinished output."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return try_process(job)
    except KeyboardInterrupt:
        # The interrupt may come between the creation of the file and the block that removes it.
        partial_file(job.output).unlink(missing_ok=True)
        return Outcome(job, error=RecordingError("interrupted", where=job.source))
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
