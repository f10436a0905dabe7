"""`uwb-mitigation train`, `quantize` and `evaluate`: make models, and measure them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.errors import MissingDependencyError, ModelError, ParameterError

if TYPE_CHECKING:
    from uwb_mitigation.dataset import Dataset
    from uwb_mitigation.evaluation.outcome import Outcome
    from uwb_mitigation.model.bundle import Bundle
    from uwb_mitigation.preprocessing import Preprocessing
    from uwb_mitigation.sources.source import Record
    from uwb_mitigation.training.recipe import CrossValidation

app = typer.Typer()

DataOption = Annotated[
    Path, typer.Option(help="Recording with true ranges: a bag, or a folder of DecaRanging logs.")
]
OutputOption = Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="Bundle to write.")]

# Seen in rows of the cross-validation table, in this order.
_ROWS = {
    "raw": "raw",
    "overall_median": "overall median",
    "l1_line": "line",
    "float": "model, float",
    "int8": "model, int8",
}


@app.command()
def train(
    data: DataOption,
    output: OutputOption,
    samples: Annotated[int, typer.Option(help="Window length K.")] = 157,
    scaling: Annotated[str, typer.Option(help="preamble or max.")] = "preamble",
    first_kernel: Annotated[int, typer.Option(help="Kernel k0 of the first convolution.")] = 3,
    epochs: Annotated[int | None, typer.Option(help="Passes over the data.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Of Adam.")] = None,
    per_configuration: Annotated[int, typer.Option(help="Fit to at most so many of a configuration.")] = 20,
    seed: Annotated[int, typer.Option(help="Of the split, the weights and the order.")] = 0,
    folds: Annotated[int, typer.Option(help="Folds of the cross-validation.")] = 6,
    prior: Annotated[
        bool, typer.Option("--prior/--no-prior", help="Fit the line prior, or leave all to the network.")
    ] = True,
    json: JsonOption = None,
) -> None:
    """Cross-validate the recipe by configuration, then train it on all of the data: a float bundle."""
    from uwb_mitigation.model.architecture import Remnet
    from uwb_mitigation.model.bundle import save_bundle
    from uwb_mitigation.preprocessing import Preprocessing, Scaling

    try:
        from uwb_mitigation.training import recipe as recipes
        from uwb_mitigation.training.fitting import FitOptions
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise MissingDependencyError("training needs torch", valid="run `make setup-training`") from error
    from uwb_mitigation.model import graph

    if scaling not in {kind.value for kind in Scaling}:
        raise ParameterError(f"scaling {scaling!r}", valid=", ".join(kind.value for kind in Scaling))
    if per_configuration < 1:
        raise ParameterError(f"per-configuration = {per_configuration}", valid="1 or more")
    given = {"epochs": epochs, "learning_rate": learning_rate, "seed": seed}
    options = FitOptions(**{key: value for key, value in given.items() if value is not None})  # type: ignore[arg-type]
    recipe = recipes.Recipe(
        Remnet(samples=samples, first_kernel=first_kernel), options, prior, per_configuration
    )
    _check_output(output)
    dataset, name = _dataset(data, Preprocessing(samples, Scaling(scaling)))
    with console.progress() as bar:
        task = bar.add_task("training", total=options.epochs * (folds + 1))

        def advance() -> None:
            bar.advance(task)

        validation = recipes.cross_validate(dataset, recipe, folds, seed, advance)
        line, network = recipes.fit_model(dataset, recipe, advance)
    card = recipes.describe(output.stem, recipe, line, validation, name)
    bundle = save_bundle(output, graph.float_model(network), card)
    _show_validation(validation)
    _show_bundle(bundle)
    console.write_json(
        json,
        {
            "model_id": bundle.model_id,
            "n": len(dataset),
            "refused": dict(dataset.refused),
            "rows": [{"name": row, **statistics} for row, statistics in validation.statistics().items()],
            "by_configuration": {
                key: {"n": n, "raw_mae": before, "corrected_mae": after}
                for key, (n, before, after) in validation.by_configuration("int8").items()
            },
        },
    )


@app.command()
def quantize(
    model: Annotated[Path, typer.Argument(metavar="MODEL_FLOAT", help="Float bundle, of `train`.")],
    data: DataOption,
    output: OutputOption,
    percentile: Annotated[
        float, typer.Option(help="Of each activation, what 255 stands for; 100 = the largest seen.")
    ] = 100.0,
    json: JsonOption = None,
) -> None:
    """Quantise a float bundle to int8, with the scales of its activations from the data it was trained on."""
    import numpy as np

    from uwb_mitigation.model import floating, graph
    from uwb_mitigation.model.bundle import load_bundle, save_bundle
    from uwb_mitigation.model.integer import IntegerNetwork
    from uwb_mitigation.training import quantization

    source = load_bundle(model)
    if source.quantised:
        raise ModelError("already quantised", where=str(model), valid="the float bundle it was made of")
    if not 90 <= percentile <= 100:
        raise ParameterError(f"percentile = {percentile}", valid="90 to 100")
    _check_output(output)
    dataset, _ = _dataset(data, source.preprocessing)
    inputs = quantization.calibration_inputs(dataset, seed=0)
    network = graph.float_weights(source.model, source.architecture)
    integers = quantization.quantize(network, inputs, percentile)
    difference = np.abs(IntegerNetwork(integers).predict_m(inputs) - floating.predict_m(network, inputs))
    card = replace(source.card, name=output.stem, quantised=True)
    bundle = save_bundle(output, graph.int8_model(integers), card)
    _show_bundle(bundle)
    console.out.print(
        f"int8 differs from float by {difference.mean():.4f} m on average, {difference.max():.4f} m at most"
    )
    console.write_json(
        json,
        {
            "model_id": bundle.model_id,
            "float_model_id": source.model_id,
            "calibration_inputs": len(inputs),
            "mean_difference": float(difference.mean()),
            "max_difference": float(difference.max()),
            "bytes": len(bundle.model),
        },
    )


@app.command()
def evaluate(
    data: DataOption,
    model: Annotated[Path | None, typer.Option(help="Bundle; without it, the shipped one.")] = None,
    json: JsonOption = None,
) -> None:
    """Correct a recording that knows its true ranges, and tell the error before and after."""
    from uwb_mitigation.evaluation import outcome
    from uwb_mitigation.mitigation import Mitigation
    from uwb_mitigation.model.bundle import load_bundle
    from uwb_mitigation.model.shipped import default_model_path

    mitigation = Mitigation(load_bundle(model or default_model_path()))
    result = outcome.evaluate(mitigation, _records(data))
    _show_outcome(result)
    console.write_json(json, result.as_json())


def _records(data: Path) -> Iterator[Record]:
    """The records of a recording, behind a progress bar."""
    from uwb_mitigation.sources.opening import open_recording

    with open_recording(data) as source, console.progress() as bar:
        task = bar.add_task("reading", total=None)
        for count, record in enumerate(source, start=1):
            if count % 100 == 0:
                bar.update(task, description=f"reading: {count} ranges")
            yield record


def _dataset(data: Path, preprocessing: Preprocessing) -> tuple[Dataset, str]:
    """The recording as arrays, and its name."""
    from uwb_mitigation.dataset import build_dataset

    dataset = build_dataset(_records(data), preprocessing)
    for reason, count in dataset.refused.items():
        console.err.print(f"left out: {count} x {reason}", markup=False)
    return dataset, data.resolve().name


def _check_output(output: Path) -> None:
    """Refuse before the work is done, not after."""
    if output.suffix != ".onnx" or output.is_dir() or not output.resolve().parent.is_dir():
        raise ParameterError(
            "not a place for a bundle", where=str(output), valid="a file .onnx in a folder that exists"
        )


def _show_validation(validation: CrossValidation) -> None:
    table = Table(title=f"{validation.folds}-fold cross-validation by configuration, m")
    table.add_column("")
    for column in ("MAE", "std", "p95"):
        table.add_column(column, justify="right")
    for row, statistics in validation.statistics().items():
        table.add_row(_ROWS[row], *(f"{value:.3f}" for value in statistics.values()))
    console.out.print(table)


def _show_bundle(bundle: Bundle) -> None:
    kind = "int8" if bundle.quantised else "float32"
    console.out.print(
        f"{bundle.path}: {kind}, {len(bundle.model)} bytes, model id {bundle.model_id:08x}",
        markup=False,
        soft_wrap=True,
        highlight=False,
    )


def _show_outcome(result: Outcome) -> None:
    table = Table(title=f"{result.n} ranges, model {result.model_id:08x}, m")
    table.add_column("")
    for column in ("n", "raw MAE", "corrected MAE", "std", "p95"):
        table.add_column(column, justify="right")
    table.add_row(
        "all",
        f"{result.n}",
        f"{result.raw.mae:.3f}",
        f"{result.corrected.mae:.3f}",
        f"{result.corrected.std:.3f}",
        f"{result.corrected.p95:.3f}",
        end_section=True,
    )
    for label, (n, before, after) in result.by_label.items():
        table.add_row(label or "no label", f"{n}", f"{before:.3f}", f"{after:.3f}")
    console.out.print(table)
    for status, count in result.statuses.items():
        if status != "OK":
            console.out.print(f"{status}: {count} ranges passed through as measured", highlight=False)
