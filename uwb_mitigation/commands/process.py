"""`uwb-mitigation process`: write corrected bags from recorded bags."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from uwb_mitigation.commands.support import console, options
from uwb_mitigation.commands.support.bundles import show_models
from uwb_mitigation.commands.support.console import JsonOption, show_table
from uwb_mitigation.commands.support.options import argument, option, output_option
from uwb_mitigation.errors import ParameterError, RecordingError, UwbMitigationError
from uwb_mitigation.files import os_errors

if TYPE_CHECKING:
    from uwb_mitigation.commands.offline.process import Job, Outcome


def process(
    sources: Annotated[list[Path], argument("IN...")],
    output: Annotated[Path, output_option("OUT")],
    model: options.ModelOption = None,
    offsets: options.OffsetsOption = None,
    workers: Annotated[int | None, typer.Option("-j", "--jobs")] = None,
    scheduler: Annotated[str | None, option(metavar="ADDRESS")] = None,
    force: bool = False,
    json: JsonOption = None,
) -> None:
    """Copy bags and add a corrected range after each raw one.

    All other messages are unchanged.

    Options:
        sources: Bags, or folders of bags at any depth.
        output: For one bag: OUT.mcap for one file, any other name for a bag folder. For several bags: a folder.
        workers: Bags processed at the same time. Default: number of cores.
        scheduler: Address of the scheduler of a Dask cluster: tcp://HOST:8786.
        force: Replace outputs that exist.
    """
    from uwb_mitigation.commands.offline import parallel
    from uwb_mitigation.commands.offline.process import Job
    from uwb_mitigation.mitigation.model.bundle import Bundle
    from uwb_mitigation.mitigation.model.shipped import AUTO, load_model
    from uwb_mitigation.types.offsets import read_offsets

    if workers is not None and workers < 1:
        raise ParameterError(f"jobs = {workers}", valid="1 or more")
    bags = parallel.plan(sources, output)
    # Load the model first: an invalid model would give the same error for every bag.
    bundle = load_model(model)
    # Absolute paths, since a worker of a cluster has another working directory.
    path = bundle.path.absolute() if isinstance(bundle, Bundle) else AUTO
    radio_offsets = read_offsets(offsets or "")
    jobs = []
    for place, bag in bags.items():
        jobs.append(Job(bag.absolute(), place.absolute(), path, force, radio_offsets))
        if place != output:
            with os_errors(ParameterError, "cannot be created", place.parent, "a folder"):
                place.parent.mkdir(parents=True, exist_ok=True)

    started = time.perf_counter()
    if scheduler is not None:
        outcomes = _follow(jobs, parallel.run_on_dask(jobs, scheduler))
    elif len(jobs) == 1:
        outcomes = [_process_one(jobs[0])]
    else:
        outcomes = _follow(jobs, parallel.run_locally(jobs, workers or parallel.num_cores()))
    seconds = outcomes[0].seconds if len(jobs) == 1 else time.perf_counter() - started
    result = _result(outcomes, seconds, bundle.model_id if isinstance(bundle, Bundle) else None)
    if any(outcome.written for outcome in outcomes):
        _show(result)
        show_models(sum((outcome.models for outcome in outcomes), Counter()))
    console.write_json(json, result)
    _raise_failures(outcomes)


def _process_one(job: Job) -> Outcome:
    from uwb_mitigation.commands.offline.process import try_process

    console.exit_on_sigterm()
    with console.progress() as bar:
        task = bar.add_task(escape(job.source.name), total=None)
        return try_process(job, lambda count, total: bar.update(task, completed=count, total=total))


def _follow(jobs: list[Job], outcomes: Iterable[Outcome]) -> list[Outcome]:
    """Show the progress; return the outcomes in the order of the jobs."""
    by_job: dict[Job, Outcome] = {}
    with console.step_bar("bags", len(jobs)) as advance:
        for outcome in outcomes:
            by_job[outcome.job] = outcome
            advance()
    return [by_job[job] for job in jobs]


def _result(outcomes: list[Outcome], seconds: float, model_id: int | None) -> dict[str, Any]:
    ranges = sum(outcome.ranges for outcome in outcomes)
    return {
        "ranges": ranges,
        "ranges_per_s": ranges / seconds if seconds else 0.0,
        "messages": sum(outcome.messages for outcome in outcomes),
        "seconds": seconds,
        "model_id": model_id,
        "failed": sum(outcome.error is not None for outcome in outcomes),
        "bags": [_row(outcome) for outcome in outcomes],
    }


def _row(outcome: Outcome) -> dict[str, Any]:
    ok, unreliable, error = outcome.statuses["OK"], outcome.statuses["UNRELIABLE"], outcome.error
    names = ("messages", "ranges", "replaced", "seconds", "statuses", "reasons", "skipped", "error")
    return {name: getattr(outcome, name) for name in names} | {
        "models": {str(choice): count for choice, count in outcome.models.items() if choice.fits},
        "mismatches": {str(choice): count for choice, count in outcome.models.items() if not choice.fits},
        "bag": outcome.job.source.name,
        "source": str(outcome.job.source),
        "output": str(outcome.job.output) if outcome.written else None,
        "ok": ok,
        "unreliable": unreliable,
        "passed_through": outcome.ranges - ok - unreliable,
        "warnings": outcome.skipped.total(),
        "state": "corrected" if error is None else "damaged" if outcome.written else "failed",
    }


def _show(result: dict[str, Any]) -> None:
    columns = {
        "bag": "bag",
        "ranges": "ranges:d",
        "OK": "ok:d",
        "unreliable": "unreliable:d",
        "passed through": "passed_through:d",
        "warnings": "warnings:d",
        "state": "state",
        "messages": "messages:d",
        "replaced": "replaced:d",
    }
    show_table(
        "Corrected bags",
        columns,
        result["bags"],
        max_rows=len(result["bags"]),
        optional=("warnings", "messages", "replaced") if result["failed"] else tuple(columns)[5:],
    )
    corrected = result["ranges"] - sum(row["passed_through"] for row in result["bags"])
    console.print_line(
        f"{corrected} of {result['ranges']} ranges corrected, {result['ranges_per_s']:.0f} ranges/s"
    )
    reasons: Counter[str] = sum((row["reasons"] for row in result["bags"]), Counter())
    for reason, count in reasons.items():
        console.warn(f"{count} ranges are not corrected: {reason}")
    for row in result["bags"]:
        for kind, count in row["skipped"].items():
            console.warn(f"{row['source']}: {count} x {kind}")


def _raise_failures(outcomes: list[Outcome]) -> None:
    """Raise an error with a line for each failed bag and, for several bags, their number."""
    errors: list[UwbMitigationError] = [outcome.error for outcome in outcomes if outcome.error is not None]
    if not errors:
        return
    if len(outcomes) == 1:
        raise errors[0]
    for error in errors:
        console.err.print(str(error), style="red", markup=False, soft_wrap=True, highlight=False)
    raise RecordingError(f"{len(errors)} of {len(outcomes)} bags failed")
