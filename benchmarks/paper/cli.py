"""`python -m benchmarks paper`: the paper's experiment, tables and figures, and DeepUWB."""

from __future__ import annotations

import os
import shlex
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.console import JsonOption
from uwb_mitigation.errors import ParameterError, UwbMitigationError

if TYPE_CHECKING:
    from benchmarks.paper.data import Parts

app = typer.Typer(
    help="The paper's experiment, tables and figures; DeepUWB, downloaded or simulated.", no_args_is_help=True
)

DataOption = Annotated[
    Path, typer.Option(help="Recording with true ranges: DeepUWB's dataset.pkl, a bag, or a folder of logs.")
]
WorkersOption = Annotated[
    int | None,
    typer.Option(min=1, max=256, help="Processes with one thread each; default: one per processor."),
]
FolderOption = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the results.")]


@app.command()
def fetch(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="File to write.")] = Path(
        "deepuwb.pkl"
    ),
    url: Annotated[
        str | None, typer.Option(metavar="MIRROR", help="Download from this URL instead of the DOI.")
    ] = None,
    sha256: Annotated[
        str | None,
        typer.Option("--sha256", metavar="HEX", help="Expected SHA-256 checksum; default: that of Zenodo."),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Download DeepUWB and verify its checksum.

    `data import` and all commands of `paper` read the file.
    """
    from benchmarks.paper.download import fetch_deepuwb

    with console.progress() as bar:
        bar.add_task("downloading", total=None)
        checksum = fetch_deepuwb(output, url, sha256)
    size = output.stat().st_size
    console.out.print(f"{output}: {size} bytes, {checksum} verified", markup=False, soft_wrap=True)
    console.write_json(json, {"output": str(output), "bytes": size, "checksum": checksum})


@app.command("simulate")
def simulate_deepuwb(
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="OUT", help="OUT.mcap for one file, any other name for a bag folder."
        ),
    ],
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 1,
    ranges: Annotated[int, typer.Option(help="Number of ranges; default: that of DeepUWB.")] = 55_158,
    exchanges: Annotated[int, typer.Option(help="Number of ranges of each placement.")] = 20,
    force: Annotated[bool, typer.Option("--force", help="Replace OUT if it exists.")] = False,
    json: JsonOption = None,
) -> None:
    """Simulate data with the rooms, obstacles and format of DeepUWB, and write it to a bag.

    The bag is marked as simulated. `make paper` runs the complete experiment on it.
    """
    from benchmarks.paper.simulated import SimulatedDeepUwb
    from uwb_mitigation.commands.data import write_simulated

    source = SimulatedDeepUwb(seed=seed, ranges=ranges, exchanges=exchanges)
    write_simulated(source, ranges, seed, output, force, json)


@app.command()
def protocol(
    data: DataOption,
    output: FolderOption,
    networks: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help="Networks, separated by commas: remnet, remnet_k5, remnet_attention, mlp.",
        ),
    ] = "remnet,remnet_k5,remnet_attention,mlp",
    windows: Annotated[
        str, typer.Option(metavar="K,...", help="Window lengths K, separated by commas.")
    ] = "157,128,64,32,16,8",
    seeds: Annotated[int, typer.Option(help="Number of networks of each kind.")] = 5,
    epochs: Annotated[int, typer.Option(help="Passes over the data.")] = 30,
    learning_rate: Annotated[float, typer.Option(help="Learning rate of Adam.")] = 3e-4,
    trials: Annotated[
        int,
        typer.Option(
            min=0,
            help="Networks of the random search, and of the grid search; 0: no search and no range test.",
        ),
    ] = 12,
    workers: WorkersOption = None,
    json: JsonOption = None,
) -> None:
    """Train, prune, quantise and test the paper's networks, after a range test of the learning rate and a search.

    The median error of the training part is the baseline.

    An interrupted run can be continued: networks that are already in DIR are not trained again.
    """
    lengths = _lengths(windows)
    from benchmarks.paper import experiment
    from benchmarks.paper.results import RESULTS

    tasks = experiment.list_tasks([name.strip() for name in networks.split(",")], lengths, seeds)
    options = replace(experiment.PAPER, epochs=epochs, learning_rate=learning_rate)
    if output.exists() and not output.is_dir():
        raise ParameterError(
            "not a folder", where=str(output), valid="a folder; it is created if it does not exist"
        )
    split_data = _split_data(data, max(lengths))
    with console.stage_bars() as on_progress:
        update = partial(on_progress, f"{len(tasks)} kinds of networks")
        result = experiment.run_experiment(
            split_data, output, tasks, options, trials, workers or os.cpu_count() or 1, update, _command()
        )
    console.out.print(f"{output / RESULTS}: {len(result.models)} networks", markup=False, soft_wrap=True)
    console.write_json(json, result.model_dump(mode="json"))


@app.command()
def report(
    data: DataOption,
    output: FolderOption,
    models: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder written by `paper protocol`, for Tables 1 and 2 and Fig. 5."
        ),
    ] = None,
    firmware: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="JSON result of `python -m benchmarks firmware`, for Table 3."),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Write an HTML page with the tables and figures of the paper and of your data."""
    # Read everything before the work begins, so that a missing library or a wrong file is an early error.
    from benchmarks.paper import published, results
    from benchmarks.paper import report as reports
    from benchmarks.paper.data import load_paper_data
    from uwb_mitigation.files import write_atomically
    from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling

    trainings = None if models is None else results.read(results.ExperimentResults, models / results.RESULTS)
    bench = () if firmware is None else results.read(results.FirmwareResults, firmware).rows
    _make_folder(output)
    with console.counting() as counted:
        longest = Preprocessing(max(published.WINDOWS), Scaling.MAX)
        study = reports.Study(data, *load_paper_data(data, longest, counted), _command())
    result = reports.build_report(study, trainings, bench)
    page = output / "report.html"
    write_atomically(page, result.html())
    console.write_json(json, result.as_json())
    gaps = [table.title.split(".")[0] for table in result.tables if table.has_gaps]
    lines = [
        f"{page}: {len(result.tables)} tables, {len(result.figures)} figures, {len(study.dataset)} measurements"
    ]
    lines += [f"{name}: some values are not measured; the page contains the command" for name in gaps]
    lines += [f"{figure}: no results. Run: {command}" for figure, command in result.lacking.items()]
    console.out.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)


def _command() -> str:
    """Return the command line of this process, for the provenance of results."""
    return shlex.join(["python", "-m", "benchmarks", *sys.argv[1:]])


def _split_data(path: Path, samples: int) -> Parts:
    from benchmarks.paper import data as paper_data
    from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling

    preprocessing = Preprocessing(samples, Scaling.MAX)
    with console.counting() as counted:
        name, _, dataset = paper_data.load_paper_data(path, preprocessing, counted)
    console.show_skipped(dataset.skipped)
    return paper_data.split_dataset(name, dataset)


def _lengths(text: str) -> list[int]:
    from uwb_mitigation.mitigation.preprocessing import Preprocessing

    try:
        lengths = [int(length) for length in text.split(",")]
    except ValueError:
        raise ParameterError(
            f"windows {text!r}", valid="numbers separated by commas, such as 157,64"
        ) from None
    for samples in lengths:
        Preprocessing(samples)
    return list(dict.fromkeys(lengths))


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UwbMitigationError(f"cannot be created: {error.strerror}", where=str(path)) from error
