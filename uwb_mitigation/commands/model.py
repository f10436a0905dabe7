"""`uwb-mitigation train`, `quantize` and `evaluate`: make models, and measure them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from uwb_mitigation.commands import console, model_tables
from uwb_mitigation.commands.checks import check_output, needs_torch
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.errors import DatasetError, ModelError, ParameterError

if TYPE_CHECKING:
    from uwb_mitigation.dataset import Dataset
    from uwb_mitigation.model.bundle import Bundle
    from uwb_mitigation.preprocessing import Preprocessing, Scaling
    from uwb_mitigation.sources.source import Record
    from uwb_mitigation.training.choosing import Candidate, Choice
    from uwb_mitigation.training.options import FitOptions
    from uwb_mitigation.training.recipe import CrossValidation, Recipe

app = typer.Typer()

DataOption = Annotated[
    Path, typer.Option(help="Recording with true ranges: a bag, or a folder of DecaRanging logs.")
]
OutputOption = Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="Bundle to write.")]
# What only one way of `train` or `evaluate` reads: it is refused, not ignored, with the other.
_OF_DATA = {
    "choose": "--recipe",
    "samples": "--samples",
    "scaling": "--scaling",
    "first_kernel": "--first-kernel",
    "per_configuration": "--per-configuration",
    "prior": "--prior/--no-prior",
}
_OF_CROSS_VALIDATION = {"seeds": "--seeds", "folds": "--folds", "scaling": "--scaling"}


@app.command()
def train(
    context: typer.Context,
    output: OutputOption,
    data: Annotated[
        Path | None,
        typer.Option(help="Recording with true ranges: a bag, or a folder of DecaRanging logs."),
    ] = None,
    from_bag: Annotated[
        Path | None,
        typer.Option(
            metavar="BAG",
            help="Instead: start from a model, and fit it to the boards and walls of this bag. What is "
            "marked `with --data` is that model's then, and refused here.",
        ),
    ] = None,
    truth: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="CSV",
            help="With --from-bag: true ranges of its pairs (tag_id, anchor_id, range_m, and optionally start_s, "
            "stop_s, configuration, label); may be given several times.",
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            help="With --from-bag: bundle to start from; without it, the shipped one, or where there are few "
            "configurations the simulator's."
        ),
    ] = None,
    choose: Annotated[
        str, typer.Option("--recipe", help="With --data: auto, constant, line, line+network, or network.")
    ] = "auto",
    samples: Annotated[int, typer.Option(help="With --data: window length K.")] = 157,
    scaling: Annotated[str, typer.Option(help="With --data: preamble or max.")] = "preamble",
    first_kernel: Annotated[int, typer.Option(help="With --data: kernel k0 of the first convolution.")] = 3,
    epochs: Annotated[int | None, typer.Option(help="Passes over the data.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Of Adam.")] = None,
    per_configuration: Annotated[
        int, typer.Option(help="With --data: fit to at most so many of a configuration.")
    ] = 20,
    seed: Annotated[int, typer.Option(help="Of the split, the weights and the order.")] = 0,
    folds: Annotated[int, typer.Option(help="Folds of the cross-validation.")] = 6,
    prior: Annotated[
        bool, typer.Option("--prior/--no-prior", help="With --data: --no-prior is --recipe network.")
    ] = True,
    json: JsonOption = None,
) -> None:
    """Choose by cross-validation over configurations what the data can carry, then train it on all of the data:
    a float bundle. With 18 configurations or fewer, `cold start` is among what is chosen from, and preferred: half a
    line of the data's own, half a network that was trained in a simulated flat; not with --recipe or --model."""
    from uwb_mitigation.model.architecture import Remnet
    from uwb_mitigation.training.options import FitOptions

    if (data is None) == (from_bag is None):
        raise ParameterError("what to train on", valid="one of --data and --from-bag")
    if from_bag is None and (truth or model):
        raise ParameterError("--truth and --model", valid="with --from-bag")
    if from_bag is not None and (idle := _given(context, _OF_DATA)):
        raise ParameterError(
            f"{idle} with --from-bag",
            valid="with --data: a bag's fit has these from the model that it starts from",
        )
    chosen_scaling = _scaling(scaling)
    if per_configuration < 1:
        raise ParameterError(f"per-configuration = {per_configuration}", valid="1 or more")
    asked: dict[str, Any] = {"epochs": epochs, "learning_rate": learning_rate, "seed": seed}
    asked = {key: value for key, value in asked.items() if value is not None}
    options = FitOptions(**asked)
    architecture = Remnet(samples=samples, first_kernel=first_kernel)
    check_output(output)
    with needs_torch():
        from uwb_mitigation.training import choosing, cold_start, site
        from uwb_mitigation.training import recipe as recipes

    if from_bag is not None:
        _site(from_bag, truth or [], model, output, options, folds, seed, json)
        return
    assert data is not None
    from uwb_mitigation.model import graph
    from uwb_mitigation.model.bundle import load_bundle, save_bundle
    from uwb_mitigation.model.shipped import simulated_model_path

    if choose not in ("auto", *choosing.STANDARD):
        raise ParameterError(f"recipe {choose!r}", valid=", ".join(("auto", *choosing.STANDARD)))
    choose = choose if prior else choosing.NETWORK
    recipe = recipes.Recipe(architecture, options, per_configuration=per_configuration)
    alone = replace(choosing.ALONE, **asked)
    dataset, name = _scaled_dataset(data, samples, chosen_scaling)
    _check_configurations(dataset, choosing.least_configurations(folds) if choose == "auto" else 2)
    folds = min(folds, len(dataset.names))
    choice = None
    if choose == "auto":
        start = load_bundle(simulated_model_path())
        candidates = cold_start.offered(choosing.standard(recipe, alone), dataset, start)
        choice = _choose(dataset, candidates, folds, seed)
        choose = choice.chosen
    if choice is not None and choose == cold_start.NAME:
        graded, validation = site.fit_chosen(dataset, choice, candidates, start, options, output.stem, name)
        bundle = save_bundle(output, graph.float_model(graded.network), graded.card)
        tested = "float"
    else:
        recipe = choosing.recipe_of(choose, recipe, alone)
        bundle, validation = _train(dataset, name, recipe, output, folds, seed)
        model_tables.show_validation(validation)
        tested = "int8"
    mae = {row: statistics["mae"] for row, statistics in validation.statistics().items()}
    after = mae[tested] if choice is None else choice.mae()[choosing.NESTED]
    model_tables.show_verdict(after, {"raw": mae["raw"]})
    model_tables.show_bundle(bundle)
    console.write_json(
        json,
        {
            "model_id": bundle.model_id,
            "n": len(dataset),
            "refused": dict(dataset.refused),
            "helped": after < mae["raw"],
            "rows": [{"name": row, **statistics} for row, statistics in validation.statistics().items()],
            "by_configuration": {
                key: {"n": n, "raw_mae": before, "corrected_mae": after}
                for key, (n, before, after) in validation.by_configuration(tested).items()
            },
            **({} if choice is None else {"choice": choice.as_json()}),
        },
    )


def _train(
    dataset: Dataset, name: str, recipe: Recipe, output: Path, folds: int, seed: int
) -> tuple[Bundle, CrossValidation]:
    from uwb_mitigation.model import graph
    from uwb_mitigation.model.bundle import save_bundle
    from uwb_mitigation.training import recipe as recipes

    with console.progress() as bar:
        task = bar.add_task("training", total=recipe.fit.epochs * (folds + 1))

        def advance() -> None:
            bar.advance(task)

        validation = recipes.cross_validate(dataset, recipe, folds, seed, advance)
        line, network = recipes.fit_model(dataset, recipe, advance)
    card = recipes.describe(output.stem, recipe, line, validation, name)
    return save_bundle(output, graph.float_model(network), card), validation


def _choose(dataset: Dataset, candidates: Sequence[Candidate], folds: int, seed: int) -> Choice:
    from uwb_mitigation.training import choosing, cold_start

    is_cold = candidates[0].name == cold_start.NAME
    with console.progress() as bar:
        total = choosing.fits(folds, len(dataset.names), len(candidates))
        task = bar.add_task("choosing", total=total)
        choice = choosing.choose(
            dataset,
            candidates,
            folds,
            seed,
            lambda: bar.advance(task),
            must_gain=cold_start.MUST_GAIN if is_cold else choosing.MUST_GAIN,
        )
    model_tables.show_choice(choice)
    if is_cold:
        console.out.print(
            f"With {cold_start.MOST_CONFIGURATIONS} configurations or fewer, {cold_start.NAME} is kept unless "
            f"another one is {cold_start.MUST_GAIN:.0%} better.",
            highlight=False,
        )
    return choice


def _site(
    bag: Path,
    truth: list[Path],
    model: Path | None,
    output: Path,
    options: FitOptions,
    folds: int,
    seed: int,
    json: Path | None,
) -> None:
    from uwb_mitigation.dataset import build_dataset
    from uwb_mitigation.model import graph
    from uwb_mitigation.model.bundle import load_bundle, save_bundle
    from uwb_mitigation.model.shipped import default_model_path, simulated_model_path
    from uwb_mitigation.sources.truth_table import load_truth, with_truth
    from uwb_mitigation.training import choosing, cold_start, site

    source = load_bundle(model or default_model_path())
    simulated = load_bundle(simulated_model_path())
    candidates = site.candidates(source, options)
    stretches = [row for path in truth for row in load_truth(path)]
    records = _records(bag)
    dataset = build_dataset(with_truth(records, stretches) if stretches else records, source.preprocessing)
    for reason, count in dataset.refused.items():
        console.err.print(f"left out: {count} x {reason}", markup=False)
    _check_configurations(dataset, choosing.least_configurations(folds))
    folds = min(folds, len(dataset.names))
    if model is None:
        candidates = cold_start.offered(candidates, dataset, simulated)
    choice = _choose(dataset, candidates, folds, seed)
    start = simulated if choice.chosen == cold_start.NAME else source
    graded, _ = site.fit_chosen(dataset, choice, candidates, start, options, output.stem, bag.resolve().name)
    bundle = save_bundle(output, graph.float_model(graded.network), graded.card)
    mae = choice.mae()
    before = {name: mae[name] for name in ("raw", site.AS_SHIPPED)}
    model_tables.show_verdict(mae[site.NESTED], before)
    model_tables.show_bundle(bundle)
    console.write_json(
        json,
        {
            "model_id": bundle.model_id,
            "n": len(dataset),
            "refused": dict(dataset.refused),
            "helped": mae[site.NESTED] < min(before.values()),
            "choice": choice.as_json(),
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
    check_output(output)
    dataset, _ = _dataset(data, source.preprocessing)
    inputs = quantization.calibration_inputs(dataset, seed=0)
    network = graph.float_weights(source.model, source.architecture)
    integers = quantization.quantize(network, inputs, percentile)
    difference = np.abs(IntegerNetwork(integers).predict_m(inputs) - floating.predict_m(network, inputs))
    card = replace(source.card, name=output.stem, quantised=True)
    bundle = save_bundle(output, graph.int8_model(integers), card)
    model_tables.show_bundle(bundle)
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
    context: typer.Context,
    data: DataOption,
    model: Annotated[Path | None, typer.Option(help="Bundle; without it, the shipped one.")] = None,
    cross_validate: Annotated[
        str | None,
        typer.Option(
            metavar="GROUP",
            help="Instead, fit the shipped recipe and what it must beat anew, and test them on what was held "
            "out: configuration, tag (each location in turn) or half (of the anchors).",
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(help="With --cross-validate: splits and networks.")] = 3,
    folds: Annotated[int, typer.Option(help="With --cross-validate configuration.")] = 6,
    scaling: Annotated[
        str, typer.Option(help="With --cross-validate: preamble, or max for data without preamble counts.")
    ] = "preamble",
    json: JsonOption = None,
) -> None:
    """Correct a recording that knows its true ranges, and tell the error before and after."""
    if cross_validate is not None:
        if model is not None:
            raise ParameterError(
                "--model with --cross-validate", valid="one of them: cross-validation fits models of its own"
            )
        _contest(data, cross_validate, folds, seeds, _scaling(scaling), json)
        return
    if idle := _given(context, _OF_CROSS_VALIDATION):
        raise ParameterError(idle, valid="with --cross-validate")
    from uwb_mitigation.evaluation import outcome
    from uwb_mitigation.mitigation import Mitigation
    from uwb_mitigation.model.bundle import load_bundle
    from uwb_mitigation.model.shipped import default_model_path

    mitigation = Mitigation(load_bundle(model or default_model_path()))
    result = outcome.evaluate(mitigation, _records(data))
    model_tables.show_outcome(result)
    console.write_json(json, result.as_json())


def _contest(data: Path, group: str, folds: int, seeds: int, scaling: Scaling, json: Path | None) -> None:
    from uwb_mitigation.evaluation import splits
    from uwb_mitigation.model.architecture import Remnet
    from uwb_mitigation.training.options import FitOptions

    if group not in {kind.value for kind in splits.Group}:
        raise ParameterError(
            f"cross-validate = {group!r}", valid=", ".join(kind.value for kind in splits.Group)
        )
    if not 1 <= seeds <= 100:
        raise ParameterError(f"seeds = {seeds}", valid="1 to 100")
    with needs_torch():
        from uwb_mitigation.training import contest
        from uwb_mitigation.training.recipe import Recipe

    dataset, _ = _scaled_dataset(data, Remnet().samples, scaling)
    kind = splits.Group(group)
    with console.progress() as bar:
        total = seeds * len(splits.by_group(dataset, kind, folds, 0))
        task = bar.add_task("cross-validating", total=total)
        result = contest.run(
            dataset, Recipe(Remnet(), FitOptions()), kind, folds, seeds, lambda: bar.advance(task)
        )
    model_tables.show_contest(result)
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


def _scaled_dataset(data: Path, samples: int, scaling: Scaling) -> tuple[Dataset, str]:
    """`_dataset` for a network of its own: where it was the scaling that left nothing, the error says so."""
    from uwb_mitigation.preprocessing import CirFault, Preprocessing

    try:
        return _dataset(data, Preprocessing(samples, scaling))
    except DatasetError as error:
        if CirFault.NO_PREAMBLE_COUNT.value not in error.what:
            raise
        raise DatasetError(error.what, valid="--scaling max does without preamble counts") from error


def _check_configurations(dataset: Dataset, needed: int) -> None:
    """Refuse before any fold is drawn what has too few of them."""
    if (count := len(dataset.names)) < needed:
        raise DatasetError(
            f"{count} configuration{'' if count == 1 else 's'}, that is placements of tag and anchor",
            valid=f"{needed} or more, each under a name of its own in `configuration` of the true ranges",
        )


def _scaling(name: str) -> Scaling:
    from uwb_mitigation.preprocessing import Scaling

    if name not in {kind.value for kind in Scaling}:
        raise ParameterError(f"scaling {name!r}", valid=", ".join(kind.value for kind in Scaling))
    return Scaling(name)


def _given(context: typer.Context, flags: Mapping[str, str]) -> str:
    """Those of `flags`, {parameter: option}, that the command line holds, with commas."""
    sources = {flag: context.get_parameter_source(name) for name, flag in flags.items()}
    return ", ".join(flag for flag, source in sources.items() if source and source.name == "COMMANDLINE")
