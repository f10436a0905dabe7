"""`uwb-mitigation paper`: the paper's experiment, tables and figures, and DeepUWB."""

from __future__ import annotations

import os
import shlex
import statistics
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.checks import check_output, needs_torch, scaling_of
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.errors import ParameterError, UwbMitigationError

if TYPE_CHECKING:
    from uwb_mitigation.paper.parts import Parts
    from uwb_mitigation.paper.results import ExperimentResults
    from uwb_mitigation.paper.search import Trial

app = typer.Typer(
    help="The paper's experiment, tables and figures; DeepUWB, downloaded or simulated.", no_args_is_help=True
)

DataOption = Annotated[
    Path, typer.Option(help="Recording with true ranges: DeepUWB's dataset.pkl, a bag, or a folder of logs.")
]
SplitOption = Annotated[
    str,
    typer.Option(
        help="paper or all_but_room_2 (DeepUWB: test in the medium room), configurations (a quarter held out), "
        "or auto: paper for DeepUWB, otherwise configurations."
    ),
]
ScalingOption = Annotated[str, typer.Option(help="max or preamble.")]
WorkersOption = Annotated[
    int | None, typer.Option(help="Processes with one thread each; default: one per processor.")
]
FolderOption = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the results.")]
EpochsOption = Annotated[int, typer.Option(help="Passes over the data.")]
RateOption = Annotated[float, typer.Option(help="Learning rate of Adam.")]
SeedOption = Annotated[int, typer.Option(help="Seed of all random numbers.")]


@app.command()
def fetch(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="File to write.")] = Path(
        "deepuwb.pkl"
    ),
    url: Annotated[
        str | None, typer.Option(metavar="MIRROR", help="Download from here, not from the DOI.")
    ] = None,
    sha256: Annotated[
        str | None, typer.Option("--sha256", metavar="HEX", help="Expected checksum, instead of Zenodo's.")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Download DeepUWB and verify its checksum.

    `data import` and all commands of `paper` read the file.
    """
    from uwb_mitigation.paper.download import fetch_deepuwb

    with console.progress() as bar:
        bar.add_task("downloading", total=None)
        checksum = fetch_deepuwb(output, url, sha256)
    size = output.stat().st_size
    console.out.print(f"{output}: {size} bytes, {checksum} verified", markup=False, soft_wrap=True)
    console.write_json(json, {"output": str(output), "bytes": size, "checksum": checksum})


@app.command()
def simulate(
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="OUT", help="OUT.mcap for one file, any other name for a bag folder."
        ),
    ],
    seed: SeedOption = 1,
    ranges: Annotated[int, typer.Option(help="Number of ranges; default: that of DeepUWB.")] = 55_158,
    exchanges: Annotated[int, typer.Option(help="Ranges of each placement.")] = 20,
    force: Annotated[bool, typer.Option("--force", help="Replace OUT if it exists.")] = False,
    json: JsonOption = None,
) -> None:
    """Simulate DeepUWB's rooms, obstacles and format, and write them to a bag.

    The bag is marked as simulated. In a checkout, `make paper` runs the complete experiment on it.
    """
    from uwb_mitigation.commands.data import write_simulated
    from uwb_mitigation.paper.simulated import SimulatedDeepUwb

    source = SimulatedDeepUwb(seed=seed, ranges=ranges, exchanges=exchanges)
    write_simulated(source, ranges, seed, output, 5.0, force, json)


@app.command()
def protocol(
    data: DataOption,
    output: FolderOption,
    networks: Annotated[
        str, typer.Option(help="Some of remnet, remnet_k5, remnet_attention, mlp; separated by commas.")
    ] = "remnet,mlp",
    windows: Annotated[
        str, typer.Option(help="Window lengths K, separated by commas.")
    ] = "157,128,64,32,16,8",
    seeds: Annotated[int, typer.Option(help="Number of networks of each kind.")] = 5,
    epochs: EpochsOption = 30,
    learning_rate: RateOption = 3e-4,
    split: SplitOption = "auto",
    scaling: ScalingOption = "max",
    workers: WorkersOption = None,
    json: JsonOption = None,
) -> None:
    """Train, quantise and test the paper's networks.

    Baselines (medians, and a line in the received power) are fitted on the same training part.

    An interrupted run continues: networks that are finished in DIR are not trained again.
    """
    lengths = _lengths(windows)
    with needs_torch():
        from uwb_mitigation.paper import experiment

    wanted = experiment.tasks([name.strip() for name in networks.split(",")], lengths, seeds)
    options = replace(experiment.PAPER, epochs=epochs, learning_rate=learning_rate)
    if output.exists() and not output.is_dir():
        raise ParameterError("not a folder", where=str(output), valid="a folder, or a new name")
    parts = _parts(data, max(lengths), scaling, split)
    with console.share_bar(f"{len(wanted)} networks") as update:
        result = experiment.run(parts, output, wanted, options, _workers(workers), update, _command())
    _show_experiment(result)
    console.write_json(json, result.model_dump(mode="json"))


@app.command()
def search(
    data: DataOption,
    output: FolderOption,
    random: Annotated[int, typer.Option(help="Number of networks drawn at random.")] = 24,
    grid: Annotated[int, typer.Option(help="Maximum number of neighbours of the best of them.")] = 16,
    windows: Annotated[
        str, typer.Option(help="Window lengths K to draw from, separated by commas.")
    ] = "157,64,32",
    epochs: EpochsOption = 8,
    seed: SeedOption = 0,
    split: SplitOption = "auto",
    scaling: ScalingOption = "max",
    workers: WorkersOption = None,
    json: JsonOption = None,
) -> None:
    """Search REMNet architectures: error against operations.

    Random search, then a grid around the best, over N, k0, kn, F and K: MAE against multiply-accumulates.

    Networks are judged on a fifth of the training configurations; the test part is not used.

    Writes journal.jsonl, from which an interrupted search continues, and front.png.
    """
    lengths = _lengths(windows)
    with needs_torch():
        from uwb_mitigation.paper import figures
        from uwb_mitigation.paper import search as searches
        from uwb_mitigation.paper.experiment import PAPER

    _make_folder(output)
    train = _parts(data, max(lengths), scaling, split).train
    with console.share_bar("searching") as update:
        trials = searches.search(
            train,
            output / "journal.jsonl",
            replace(PAPER, epochs=epochs, seed=seed),
            random=random,
            grid=grid,
            windows=lengths,
            workers=_workers(workers),
            on_progress=update,
        )
    best = searches.front(trials)
    columns = ("K", "N", "k0", "kn", "F", "parameters", "multiply-accumulates", "MAE, m")
    rows = []
    for trial in best:
        shape = trial.architecture
        sizes = (shape.samples, shape.modules, shape.first_kernel, shape.kernel, shape.filters)
        rows.append((*sizes, shape.parameters, shape.multiply_accumulates, f"{trial.mae_m:.4f}"))
    _show_table(f"Pareto front of {len(trials)} networks, cheapest first", columns, rows)
    figures.draw_front(trials, output / "front.png")
    console.write_json(
        json, {"trials": list(map(_trial_json, trials)), "front": list(map(_trial_json, best))}
    )


@app.command("lr-range")
def lr_range(
    data: DataOption,
    samples: Annotated[int, typer.Option(help="Window length K.")] = 157,
    low: Annotated[float, typer.Option(help="First learning rate.")] = 1e-6,
    high: Annotated[float, typer.Option(help="Last learning rate.")] = 0.3,
    steps: Annotated[int, typer.Option(help="Batches.")] = 600,
    seed: SeedOption = 0,
    split: SplitOption = "auto",
    scaling: ScalingOption = "max",
    plot: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw the loss over the rate.")] = None,
    json: JsonOption = None,
) -> None:
    """Run the learning-rate range test of Smith (2017) on the training part."""
    with needs_torch():
        from uwb_mitigation.paper.experiment import PAPER
        from uwb_mitigation.paper.learning_rate import range_test
    from uwb_mitigation.model.architecture import Remnet

    train = _parts(data, samples, scaling, split).train
    options = replace(PAPER, seed=seed)
    with console.step_bar("range test", steps) as on_step:
        result = range_test(
            Remnet(samples),
            train.inputs,
            train.error_m,
            options,
            low=low,
            high=high,
            steps=steps,
            on_step=on_step,
        )
    console.out.print(
        f"steepest descent of the loss at {result.suggested:.2g}, minimum at {result.highest:.2g}"
        f"{'; divergence beyond' if result.diverged else ''}",
        highlight=False,
    )
    if plot is not None:
        from uwb_mitigation.paper import figures

        figures.draw_range_test(result, plot)
    console.write_json(json, asdict(result))


@app.command()
def prune(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL_FLOAT", help="Float bundle of a REMNet from `paper protocol`.")
    ],
    data: DataOption,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="Bundle to write.")],
    filters: Annotated[int, typer.Option(help="Filters F to keep.")] = 8,
    epochs: EpochsOption = 10,
    seed: SeedOption = 0,
    split: SplitOption = "auto",
    json: JsonOption = None,
) -> None:
    """Remove the weakest filters of a REMNet and train the rest.

    Writes a smaller float bundle. Trains on the training part of the split and tests on its test part.

    Rejects a bundle that was trained on another split or other data: it may have seen the test part.
    """
    with needs_torch():
        from uwb_mitigation.paper.experiment import PAPER
        from uwb_mitigation.paper.pruning import prune_bundle
    from uwb_mitigation.model.bundle import load_bundle

    source = load_bundle(model)
    check_output(output)
    preprocessing = source.preprocessing
    parts = _parts(data, preprocessing.samples, preprocessing.scaling.value, split)
    with console.step_bar("training", epochs) as on_epoch:
        options = replace(PAPER, epochs=epochs, seed=seed)
        bundle, mae = prune_bundle(source, parts, filters, options, output, on_epoch)
    after = bundle.architecture
    cost = {
        "multiply_accumulates": after.multiply_accumulates,
        "multiply_accumulates_before": source.architecture.multiply_accumulates,
        "parameters": after.parameters,
    }
    console.out.print(
        f"{output}: {filters} filters, {cost['parameters']} parameters, "
        f"{cost['multiply_accumulates_before'] / cost['multiply_accumulates']:.1f} x fewer multiply-accumulates\n"
        f"test MAE: {mae['before']:.4f} m before, {mae['pruned']:.4f} m pruned, {mae['tuned']:.4f} m trained again",
        markup=False,
        highlight=False,
    )
    console.write_json(json, {"model_id": bundle.model_id, "mae": dict(mae), **cost})


@app.command()
def report(
    data: DataOption,
    output: FolderOption,
    models: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of `paper protocol`, for Tables 1, 2 and Fig. 5."),
    ] = None,
    firmware: Annotated[
        Path | None, typer.Option(metavar="FILE", help="JSON of `bench firmware`, for Table 3.")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Write one HTML page: the paper's tables and figures next to yours."""
    # Read everything before the work begins, so that a missing library or a wrong file stops at once.
    from uwb_mitigation.files import write_whole
    from uwb_mitigation.paper import published, results
    from uwb_mitigation.paper import report as reports
    from uwb_mitigation.paper.parts import load
    from uwb_mitigation.preprocessing import Preprocessing, Scaling

    trainings = None if models is None else results.read(results.ExperimentResults, models / results.RESULTS)
    bench = () if firmware is None else results.read(results.FirmwareResults, firmware).rows
    _make_folder(output)
    with console.reading() as on_record:
        longest = Preprocessing(max(published.WINDOWS), Scaling.MAX)
        study = reports.Study(data, *load(data, longest, on_record), _command())
    with console.step_bar("drawing", reports.STEPS) as on_step:
        result = reports.build(study, trainings, bench, on_step)
    page = output / "report.html"
    write_whole(page, result.html())
    console.write_json(json, result.as_json())
    gaps = [table.title.split(".")[0] for table in result.tables if table.has_gaps]
    lines = [
        f"{page}: {len(result.tables)} tables, {len(result.figures)} figures, {len(study.dataset)} measurements"
    ]
    lines += [f"{name}: some values are not measured; the page names the command" for name in gaps]
    lines += [f"{part}: left out. Run: {command}" for part, command in result.lacking.items()]
    console.out.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)


def _command() -> str:
    """The command line of this process, for the provenance of results."""
    return shlex.join(["uwb-mitigation", *sys.argv[1:]])


def _parts(data: Path, samples: int, scaling: str, split: str) -> Parts:
    from uwb_mitigation.paper import parts
    from uwb_mitigation.preprocessing import Preprocessing

    preprocessing = Preprocessing(samples, scaling_of(scaling))
    with console.reading() as on_record:
        name, _, dataset = parts.load(data, preprocessing, on_record)
    console.show_refused(dataset.refused)
    return parts.divided(name, dataset, split)


def _lengths(text: str) -> list[int]:
    from uwb_mitigation.preprocessing import Preprocessing

    try:
        lengths = [int(part) for part in text.split(",")]
    except ValueError:
        raise ParameterError(
            f"windows {text!r}", valid="numbers separated by commas, such as 157,64"
        ) from None
    for samples in lengths:
        Preprocessing(samples)
    return list(dict.fromkeys(lengths))


def _workers(given: int | None) -> int:
    if given is not None and not 1 <= given <= 256:
        raise ParameterError(f"{given} workers", valid="1 to 256")
    return given or os.cpu_count() or 1


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UwbMitigationError(f"cannot be created: {error.strerror}", where=str(path)) from error


def _show_table(title: str, columns: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
    from rich.box import SIMPLE_HEAD

    from uwb_mitigation.commands.console import Table

    # Without lines between columns it fits a terminal with 80 columns.
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 0, 0, 1))
    for column in columns:
        table.add_column(column, justify="left" if column == "network" else "right", no_wrap=True)
    for row in rows:
        table.add_row(*map(str, row))
    console.out.print(table)


def _show_experiment(result: ExperimentResults) -> None:
    def mean(values: list[Any], form: str) -> str:
        known = [value for value in values if value is not None]
        return format(statistics.fmean(known), form) if known else "-"

    blank = ("", "", "", "")
    rows: list[tuple[Any, ...]] = []
    if result.models:
        rows.append(("raw", "", "", "", f"{result.models[0].mae_raw:.4f}", *blank))
    for baseline in result.baselines:
        left = baseline.errors.all.mae if baseline.errors else None
        rows.append((baseline.name, "", "", "", mean([left], ".4f"), *blank))
    for network, samples in dict.fromkeys((model.network, model.samples) for model in result.models):
        models = result.of(network, samples)
        last = [model.mae_float if model.mae_int8 is None else model.mae_int8 for model in models]
        rows.append(
            (
                *(network, samples, len(models), models[0].parameters),
                *(mean([model.mae_m[form] for model in models], ".4f") for form in range(3)),
                f"{statistics.stdev(last):.4f}" if len(last) > 1 else "-",
                mean([model.bytes_int8 for model in models], ".0f"),
            )
        )
    title = (
        f"{result.data}, split {result.split}: {result.train} to train on, {result.test} to test, "
        f"{result.options.epochs} epochs; MAE in m, mean and standard deviation (of the last form) over seeds"
    )
    columns = ("network", "K", "seeds", "params", "float", "optimised", "int8", "std", "bytes")
    _show_table(title, columns, rows)
    for baseline in result.baselines:
        if baseline.reason:
            console.out.print(f"{baseline.name}: not available: {baseline.reason}", markup=False)


def _trial_json(trial: Trial) -> dict[str, Any]:
    costs = ("parameters", "multiply_accumulates")
    return asdict(trial) | {name: getattr(trial.architecture, name) for name in costs}
