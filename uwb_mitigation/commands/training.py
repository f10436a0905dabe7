"""`uwb-mitigation protocol`, `search`, `train-lr-range` and `prune`."""

from __future__ import annotations

import os
import statistics
from collections import defaultdict
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD

from uwb_mitigation.commands import console
from uwb_mitigation.commands.checks import check_output, needs_torch, scaling_of
from uwb_mitigation.commands.console import JsonOption, Table
from uwb_mitigation.errors import ParameterError, UwbMitigationError
from uwb_mitigation.evaluation import paper

if TYPE_CHECKING:
    from uwb_mitigation.evaluation.results import ExperimentResults
    from uwb_mitigation.training.parts import Parts
    from uwb_mitigation.training.search import Trial

DataOption = Annotated[
    Path, typer.Option(help="Recording with true ranges: DeepUWB's dataset.pkl, a bag, or a folder of logs.")
]
SplitOption = Annotated[
    str,
    typer.Option(
        help="paper or all_but_room_2 (DeepUWB: test in the medium room), configurations (a quarter held out), "
        "or auto: paper for DeepUWB, else configurations."
    ),
]
ScalingOption = Annotated[str, typer.Option(help="max or preamble.")]
WorkersOption = Annotated[
    int | None, typer.Option(help="Processes of one thread each; without it, one a processor.")
]


def protocol(
    data: DataOption,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the results.")],
    networks: Annotated[
        str, typer.Option(help="Of remnet, remnet_k5, remnet_attention, mlp; with commas.")
    ] = "remnet,mlp",
    windows: Annotated[str, typer.Option(help="Window lengths K, with commas.")] = ",".join(
        map(str, paper.WINDOWS)
    ),
    seeds: Annotated[int, typer.Option(help="Networks of each kind.")] = paper.SEEDS,
    epochs: Annotated[int, typer.Option(help="Passes over the data.")] = paper.EPOCHS,
    learning_rate: Annotated[float, typer.Option(help="Of Adam.")] = paper.LEARNING_RATE,
    split: SplitOption = "auto",
    scaling: ScalingOption = "max",
    workers: WorkersOption = None,
    json: JsonOption = None,
) -> None:
    """The paper's experiment: every network, K and seed, tested.

    Each is trained, optimised, quantised and tested.

    Beside them stand the medians and the line in the received power, fitted on the same training part.

    Run it again to go on with an interrupted run: what is in DIR already is not trained again.
    """
    lengths = _lengths(windows)
    with needs_torch():
        from uwb_mitigation.training import experiment

    wanted = experiment.tasks([name.strip() for name in networks.split(",")], lengths, seeds)
    options = replace(experiment.PAPER, epochs=epochs, learning_rate=learning_rate)
    if output.exists() and not output.is_dir():
        raise ParameterError("not a folder", where=str(output), valid="a folder, or a name for one")
    parts = _parts(data, max(lengths), scaling, split)
    with console.share_bar(f"{len(wanted)} networks") as update:
        result = experiment.run(parts, output, wanted, options, _workers(workers), update)
    _show_experiment(result)
    console.write_json(json, result.model_dump(mode="json"))


def search(
    data: DataOption,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of journal and front.")
    ],
    random: Annotated[int, typer.Option(help="Networks drawn at random.")] = 24,
    grid: Annotated[int, typer.Option(help="At most so many neighbours of the best of them.")] = 16,
    windows: Annotated[str, typer.Option(help="Window lengths K to draw from, with commas.")] = "157,64,32",
    epochs: Annotated[int, typer.Option(help="Passes over the data, each network.")] = 8,
    learning_rate: Annotated[float, typer.Option(help="Of Adam.")] = paper.LEARNING_RATE,
    seed: Annotated[int, typer.Option(help="Of the draw and of every network.")] = 0,
    split: SplitOption = "auto",
    scaling: ScalingOption = "max",
    workers: WorkersOption = None,
    json: JsonOption = None,
) -> None:
    """Search shapes of REMNet: error against operations.

    Random search, then a grid, over N, k0, kn, F and K: MAE against multiply-accumulates.

    Networks are judged on a fifth of the training part's configurations; the test part has no say.

    Writes journal.jsonl, with which an interrupted search goes on, and front.png.
    """
    lengths = _lengths(windows)
    with needs_torch():
        from uwb_mitigation.training import plots
        from uwb_mitigation.training import search as searches
        from uwb_mitigation.training.experiment import PAPER

    options = replace(PAPER, epochs=epochs, learning_rate=learning_rate, seed=seed)
    _make_folder(output)
    train = _parts(data, max(lengths), scaling, split).train
    with console.share_bar("searching") as update:
        trials = searches.search(
            train,
            output / "journal.jsonl",
            options,
            random=random,
            grid=grid,
            windows=lengths,
            workers=_workers(workers),
            on_progress=update,
        )
    best = searches.front(trials)
    _show_front(best, len(trials))
    plots.draw_front(trials, output / "front.png")
    console.write_json(
        json,
        {"trials": [_trial_json(trial) for trial in trials], "front": [_trial_json(trial) for trial in best]},
    )


def train_lr_range(
    data: DataOption,
    samples: Annotated[int, typer.Option(help="Window length K.")] = 157,
    low: Annotated[float, typer.Option(help="First learning rate.")] = 1e-6,
    high: Annotated[float, typer.Option(help="Last learning rate.")] = 0.3,
    steps: Annotated[int, typer.Option(help="Batches.")] = 600,
    seed: Annotated[int, typer.Option(help="Of the weights and the batches.")] = 0,
    split: SplitOption = "auto",
    scaling: ScalingOption = "max",
    plot: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw the loss against the rate.")] = None,
    json: JsonOption = None,
) -> None:
    """The learning-rate range test of Smith (2017).

    Runs on the training part of the split.
    """
    with needs_torch():
        from uwb_mitigation.training import plots
        from uwb_mitigation.training.experiment import PAPER
        from uwb_mitigation.training.learning_rate import range_test
    from uwb_mitigation.model.architecture import Remnet

    shape = Remnet(samples)
    train = _parts(data, samples, scaling, split).train
    with console.step_bar("range test", steps) as on_step:
        result = range_test(
            shape,
            train.inputs,
            train.error_m,
            replace(PAPER, seed=seed),
            low=low,
            high=high,
            steps=steps,
            on_step=on_step,
        )
    console.out.print(
        f"the loss falls steepest at {result.suggested:.2g} and is least at {result.highest:.2g}"
        f"{'; it diverges beyond' if result.diverged else ''}",
        highlight=False,
    )
    if plot is not None:
        plots.draw_range_test(result, plot)
    console.write_json(json, asdict(result))


def prune(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL_FLOAT", help="Float bundle of a REMNet that `protocol` made.")
    ],
    data: DataOption,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="Bundle to write.")],
    filters: Annotated[int, typer.Option(help="Filters F to keep.")] = 8,
    epochs: Annotated[int, typer.Option(help="Passes over the data to tune what is left.")] = 10,
    learning_rate: Annotated[float, typer.Option(help="Of Adam.")] = paper.LEARNING_RATE,
    seed: Annotated[int, typer.Option(help="Of the order and the dropout.")] = 0,
    split: SplitOption = "auto",
    json: JsonOption = None,
) -> None:
    """Drop the weakest filters of a REMNet, and train the rest.

    Writes a smaller float bundle.

    Trains on the training part of the split, and tells the error on its test part.

    A bundle that was trained on another split or other data is refused: it may know what is tested.
    """
    with needs_torch():
        from uwb_mitigation.training.experiment import PAPER
        from uwb_mitigation.training.pruning import prune_bundle
    from uwb_mitigation.model.bundle import load_bundle

    source = load_bundle(model)
    check_output(output)
    preprocessing = source.preprocessing
    parts = _parts(data, preprocessing.samples, preprocessing.scaling.value, split)
    options = replace(PAPER, epochs=epochs, learning_rate=learning_rate, seed=seed)
    with console.step_bar("tuning", epochs) as on_epoch:
        pruned = prune_bundle(source, parts, filters, options, output, on_epoch)
    after, mae = pruned.bundle.architecture, pruned.mae_m
    cost = {
        "multiply_accumulates": after.multiply_accumulates,
        "multiply_accumulates_before": pruned.before.multiply_accumulates,
        "parameters": after.parameters,
    }
    console.out.print(
        f"{output}: {filters} filters, {cost['parameters']} parameters, "
        f"{cost['multiply_accumulates_before'] / cost['multiply_accumulates']:.1f} x fewer multiply-accumulates",
        markup=False,
        highlight=False,
    )
    console.out.print(
        f"test MAE {mae['before']:.4f} m before, {mae['pruned']:.4f} m pruned, {mae['tuned']:.4f} m tuned",
        highlight=False,
    )
    console.write_json(json, {"model_id": pruned.bundle.model_id, "mae": dict(mae), **cost})


def _parts(data: Path, samples: int, scaling: str, split: str) -> Parts:
    """The recording's parts; tells what is left out."""
    from uwb_mitigation.preprocessing import Preprocessing
    from uwb_mitigation.training import parts

    preprocessing = Preprocessing(samples, scaling_of(scaling))
    with console.reading() as on_record:
        name, dataset = parts.load(data, preprocessing, on_record=on_record)
    console.show_refused(dataset.refused)
    return parts.divided(name, dataset, split)


def _lengths(text: str) -> list[int]:
    from uwb_mitigation.preprocessing import Preprocessing

    try:
        lengths = [int(part) for part in text.split(",")]
    except ValueError:
        raise ParameterError(f"windows {text!r}", valid="numbers with commas, such as 157,64") from None
    for samples in lengths:
        Preprocessing(samples)
    return list(dict.fromkeys(lengths))


def _workers(given: int | None) -> int:
    if given is None:
        return os.cpu_count() or 1
    if not 1 <= given <= 256:
        raise ParameterError(f"workers = {given}", valid="1 to 256")
    return given


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UwbMitigationError(f"cannot be made: {error.strerror}", where=str(folder)) from error


def _show_experiment(result: ExperimentResults) -> None:
    groups = defaultdict(list)
    for model in result.models:
        groups[model.network, model.samples].append(model)
    table = Table(
        title=f"{result.data}, split {result.split}: {result.train} to train on, {result.test} to test, "
        f"{result.options.epochs} epoch{'' if result.options.epochs == 1 else 's'}; MAE in m: "
        "mean over seeds, and its standard deviation in the last form",
        # Without lines between columns it fits a terminal of 80.
        box=SIMPLE_HEAD,
        padding=(0, 0, 0, 1),
    )
    for column in ("network", "K", "seeds", "params", "float", "optimised", "int8", "std", "bytes"):
        table.add_column(column, justify="left" if column == "network" else "right", no_wrap=True)
    if result.models:
        table.add_row("none", "", "", "", f"{result.models[0].mae_raw:.4f}")
    for baseline in result.baselines:
        left = None if baseline.errors is None else baseline.errors.all.mae
        table.add_row(_BASELINES.get(baseline.name, baseline.name), "", "", "", _mean([left], ".4f"))
    for (network, samples), models in groups.items():
        forms = [
            [getattr(model, form) for model in models] for form in ("mae_float", "mae_optimised", "mae_int8")
        ]
        last = [value for value in (forms[2] if any(forms[2]) else forms[0]) if value is not None]
        table.add_row(
            network,
            f"{samples}",
            f"{len(models)}",
            f"{models[0].parameters}",
            *(_mean(values, ".4f") for values in forms),
            f"{statistics.stdev(last):.4f}" if len(last) > 1 else "-",
            _mean([model.bytes_int8 for model in models], ".0f"),
        )
    console.out.print(table)
    for baseline in result.baselines:
        if baseline.reason:
            name = _BASELINES.get(baseline.name, baseline.name)
            console.out.print(f"{name}: not there: {baseline.reason}", markup=False, highlight=False)


_BASELINES = {"los_median": "LOS median", "overall_median": "median", "line": "L1 line"}


def _mean(values: list[float | None], form: str) -> str:
    known = [value for value in values if value is not None]
    return format(statistics.fmean(known), form) if known else "-"


def _show_front(best: list[Trial], tried: int) -> None:
    table = Table(title=f"best of {tried} networks, cheapest first")
    for column in ("K", "N", "k0", "kn", "F", "parameters", "multiply-accumulates", "MAE, m"):
        table.add_column(column, justify="right")
    for trial in best:
        shape = trial.architecture
        sizes = (shape.samples, shape.modules, shape.first_kernel, shape.kernel, shape.filters)
        cost = (f"{shape.parameters}", f"{shape.multiply_accumulates}")
        table.add_row(*map(str, sizes), *cost, f"{trial.mae_m:.4f}")
    console.out.print(table)


def _trial_json(trial: Trial) -> dict[str, Any]:
    costs = ("parameters", "multiply_accumulates")
    return asdict(trial) | {name: getattr(trial.architecture, name) for name in costs}
