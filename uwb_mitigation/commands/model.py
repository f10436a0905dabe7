"""`uwb-mitigation train`, `train-universal`, `quantise` and `evaluate`: create and evaluate models."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from uwb_mitigation.commands.support import console, model_tables, options
from uwb_mitigation.commands.support.bundles import show_models
from uwb_mitigation.commands.support.console import JsonOption
from uwb_mitigation.commands.support.options import argument, option
from uwb_mitigation.errors import ParameterError

if TYPE_CHECKING:
    from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
    from uwb_mitigation.training.data.dataset import Dataset

OutputOption = Annotated[Path, options.output_option("FILE")]


def train(
    output: OutputOption,
    data: Annotated[Path, typer.Option("--data", "--from-bag")],
    truth: Annotated[list[Path] | None, option(metavar="CSV")] = None,
    recipe: Literal["auto", "constant", "line", "line+network", "network"] = "auto",
    samples: int = 157,
    scaling: options.ScalingName = "preamble",
    epochs: int | None = None,
    learning_rate: float | None = None,
    seed: int = 0,
    folds: int = 6,
    force: bool = False,
    json: JsonOption = None,
) -> None:
    """Train a float bundle; the amount of data determines the complexity of the model.

    Cross-validation over configurations selects the model, which is then trained on all of the data.

    One candidate is `cold start`, a network trained in simulated buildings, with an offset estimated from the data.
    It is preferred with fewer than 20 configurations. With 20 or more, its mean with the linear bias model is another
    candidate. It is not used with --recipe. A network trained on the data is selected only if it reduces
    the error on held-out data.

    Options:
        output: Bundle to write.
        data: Recording with true ranges: a bag, or a folder of DecaRanging logs.
        truth: True ranges of the pairs (tag_id, anchor_id, range_m, and optionally start_s, stop_s, configuration, label)
            instead of those of the recording; may be given several times.
        recipe: Kind of model; auto: selected by cross-validation.
        samples: Window length K.
        scaling: Scaling of the CIR by its preamble count, or by its maximum.
        epochs: Passes over the data.
        learning_rate: Learning rate of Adam.
        seed: Seed of the splits, the initial weights and the order of the data.
        folds: Number of folds of the cross-validation.
        force: Replace FILE if it exists.
    """
    from uwb_mitigation.mitigation.model.architecture import Remnet
    from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
    from uwb_mitigation.training.fit.options import FitOptions

    set_options: dict[str, Any] = {"epochs": epochs, "learning_rate": learning_rate, "seed": seed}
    set_options = {key: value for key, value in set_options.items() if value is not None}
    architecture, fit_options = Remnet(samples), FitOptions(**set_options)
    options.check_output(output, force)
    from uwb_mitigation.training import train as training
    from uwb_mitigation.training.fit import candidates, fitting  # noqa: F401  (imports torch)

    name, dataset = _dataset(data, Preprocessing(samples, Scaling(scaling)), truth or ())
    network_only = replace(candidates.NETWORK_ONLY, **set_options)
    with console.stage_bars() as on_progress:
        job = training.TrainingJob(dataset, name, output, folds, on_progress)
        parts = candidates.Recipe(architecture, fit_options, network_only)
        trained = training.train_new_model(job, parts, recipe)
    model_tables.show_trained(trained)
    console.write_json(json, trained)


def train_universal(
    output: OutputOption,
    seed: Annotated[int, option(min=0, max=2**31)] = 0,
    samples: int = 157,
    scaling: options.ScalingName = "preamble",
    radio: Literal["dw1000", "dw3000"] = "dw1000",
    blocks: Annotated[int | None, option(min=1, max=10_000)] = None,
    float_output: Annotated[Path | None, typer.Option("--float", metavar="FILE")] = None,
    workers: Annotated[int | None, option(min=1, max=256)] = None,
    force: bool = False,
    json: JsonOption = None,
) -> None:
    """Train a model for unknown sites in simulated buildings.

    Simulates buildings, trains a network, quantises it, and evaluates the int8 network in held-out simulated buildings.

    The same seed gives the same bundle on the same machine.

        uwb-mitigation train-universal --seed 0 -o universal.onnx

        uwb-mitigation train-universal --scaling max -o amplitude.onnx

    Options:
        output: int8 bundle to write.
        seed: Seed of the simulated buildings and of the network.
        samples: Window length K.
        scaling: max: for windows without preamble counts.
        radio: dw3000: for windows of an STS.
        blocks: Number of blocks of 256 placements for training.
        float_output: Also write the float bundle.
        workers: Processes of the simulation; default: one per processor.
        force: Replace files that exist.
    """
    from uwb_mitigation.mitigation.model import graph
    from uwb_mitigation.mitigation.model.bundle import save_bundle
    from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
    from uwb_mitigation.simulation.buildings import RADIO
    from uwb_mitigation.simulation.radio import DW3000_STS

    preprocessing = Preprocessing(samples, Scaling(scaling))
    radios = {"dw1000": RADIO, "dw3000": DW3000_STS}
    for path in (output, *([float_output] if float_output else [])):
        options.check_output(path, force)
    from uwb_mitigation.training import universal

    plan = universal.TrainingPlan(
        seed=seed, samples=samples, scaling=preprocessing.scaling, radio=radios[radio]
    )
    if blocks is not None:
        plan = replace(plan, blocks=blocks)
    with console.stage_bars() as on_progress:
        processes = workers or os.cpu_count() or 1
        trained = universal.train_universal_model(plan, output.stem, processes, on_progress)
    if float_output is not None:
        save_bundle(
            float_output, graph.float_model(trained.network), replace(trained.card, name=float_output.stem)
        )
    bundle = save_bundle(output, graph.int8_model(trained.integers), replace(trained.card, quantised=True))
    model_tables.show_held_out(trained.held_out)
    model_tables.show_bundle(bundle)
    console.write_json(
        json, {"model_id": bundle.model_id, "seed": seed, "simulated": True, "held_out": trained.held_out}
    )


def quantise(
    model: Annotated[Path, argument("MODEL_FLOAT")],
    data: Annotated[Path, option()],
    output: OutputOption,
    force: bool = False,
    json: JsonOption = None,
) -> None:
    """Quantise a float bundle to int8.

    Its training data determine the scales of the activations.

    Options:
        model: Float bundle, as `train` or `--float` writes it.
        data: Recording with CIRs, best the training data; true ranges are not needed.
        output: Bundle to write.
        force: Replace FILE if it exists.
    """
    from uwb_mitigation.mitigation.model.bundle import load_bundle
    from uwb_mitigation.training.data import recordings
    from uwb_mitigation.training.fit import quantisation

    source = load_bundle(model)
    quantisation.check(source)
    options.check_output(output, force)
    with console.counting() as counted:
        dataset = recordings.load_inputs(data, source.card.preprocessing, counted)
    console.show_skipped(dataset.skipped)
    bundle, difference = quantisation.quantise_bundle(source, dataset, output)
    model_tables.show_bundle(bundle)
    console.out.print(
        f"int8 differs from float by {difference.mean():.4f} m on average, {difference.max():.4f} m at most"
    )
    console.write_json(
        json,
        {
            "model_id": bundle.model_id,
            "float_model_id": source.model_id,
            "calibration_inputs": len(difference),
            "mean_difference": float(difference.mean()),
            "max_difference": float(difference.max()),
            "bytes": len(bundle.model),
        },
    )


def evaluate(
    data: Annotated[Path, option()],
    model: options.ModelOption = None,
    offsets: options.OffsetsOption = None,
    cross_validate: Literal["configuration"] | None = None,
    seeds: Annotated[int | None, option(min=1, max=100)] = None,
    folds: int | None = None,
    scaling: options.ScalingName | None = None,
    json: JsonOption = None,
) -> None:
    """Compute the errors of raw and corrected ranges in a recording with ground truth.

    Options:
        data: Recording with true ranges: a bag, or a folder of DecaRanging logs.
        cross_validate: Instead of evaluating a model: fit the shipped recipe and the baselines, and test them on held-out
            placements (configuration).
        seeds: With --cross-validate: number of repetitions with other splits and networks. Default: 3.
        folds: With --cross-validate: number of folds. Default: 6.
        scaling: With --cross-validate: max for data without preamble counts. Default: preamble.
    """
    unused: dict[str, object] = {"--offsets": offsets, "--model": model}
    mode, valid = "with", "one of them: cross-validation fits new models"
    if cross_validate is None:
        unused = {"--seeds": seeds, "--folds": folds, "--scaling": scaling}
        mode, valid = "without", "only with --cross-validate"
    if given := ", ".join(flag for flag, value in unused.items() if value is not None):
        raise ParameterError(f"{given} {mode} --cross-validate", valid=valid)
    if cross_validate is not None:
        from uwb_mitigation.mitigation.preprocessing import Scaling

        _compare(data, 6 if folds is None else folds, seeds or 3, Scaling(scaling or "preamble"), json)
        return
    from uwb_mitigation.mitigation.correction import Mitigation
    from uwb_mitigation.mitigation.model.shipped import load_model
    from uwb_mitigation.recordings.formats import open_recording
    from uwb_mitigation.training.evaluation import accuracy
    from uwb_mitigation.types.offsets import read_offsets

    mitigation = Mitigation(load_model(model), read_offsets(offsets or ""))
    with open_recording(data) as source, console.counting() as counted:
        result = accuracy.evaluate_accuracy(mitigation, counted(source))
    model_tables.show_accuracy(result)
    if len(mitigation.used) > 1:
        show_models(mitigation.used)
    console.write_json(json, result)


def _compare(data: Path, folds: int, seeds: int, scaling: Scaling, json: Path | None) -> None:
    from uwb_mitigation.mitigation.model.architecture import Remnet
    from uwb_mitigation.mitigation.model.bundle import load_bundle
    from uwb_mitigation.mitigation.model.shipped import default_model_path
    from uwb_mitigation.mitigation.preprocessing import Preprocessing
    from uwb_mitigation.training import comparison
    from uwb_mitigation.training.fit.candidates import Recipe
    from uwb_mitigation.training.fit.options import FitOptions

    _, dataset = _dataset(data, Preprocessing(Remnet().samples, scaling))
    universal = load_bundle(default_model_path(scaling))
    recipe = Recipe(Remnet(), FitOptions())
    with console.step_bar("cross-validating", seeds * folds) as on_fold:
        result = comparison.compare_models(dataset, recipe, folds, seeds, on_fold, universal)
    model_tables.show_comparison(result)
    console.write_json(json, result)


def _dataset(data: Path, preprocessing: Preprocessing, truth: Sequence[Path] = ()) -> tuple[str, Dataset]:
    """Return name and measurements of a recording; print the number of skipped ranges by reason."""
    from uwb_mitigation.training.data import recordings

    with console.counting() as counted:
        name, dataset = recordings.load_dataset(data, preprocessing, truth, counted)
    console.show_skipped(dataset.skipped)
    return name, dataset
