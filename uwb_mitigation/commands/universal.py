"""`uwb-mitigation train-universal`: train the model for unknown sites and boards."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from uwb_mitigation.commands.support import console, model_tables
from uwb_mitigation.commands.support.checks import ScalingName, check_output, output_option
from uwb_mitigation.commands.support.console import JsonOption


def train_universal(
    output: Annotated[Path, output_option("FILE", "int8 bundle to write.")],
    seed: Annotated[
        int, typer.Option(min=0, max=2**31, help="Seed of the simulated buildings and of the network.")
    ] = 0,
    samples: Annotated[int, typer.Option(help="Window length K.")] = 157,
    scaling: Annotated[
        ScalingName, typer.Option(help="max: for windows without preamble counts.")
    ] = "preamble",
    radio: Annotated[
        Literal["dw1000", "dw3000"], typer.Option(help="dw3000: for windows of an STS.")
    ] = "dw1000",
    blocks: Annotated[
        int | None, typer.Option(min=1, max=10_000, help="Number of blocks of 256 placements for training.")
    ] = None,
    float_output: Annotated[
        Path | None, typer.Option("--float", metavar="FILE", help="Also write the float bundle.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=256, help="Processes of the simulation; default: one per processor."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that exist.")] = False,
    json: JsonOption = None,
) -> None:
    """Train a model for unknown sites in simulated buildings.

    Simulates buildings, trains a network, quantises it, and evaluates the int8 network in held-out simulated buildings.

    The same seed gives the same bundle on the same machine.

        uwb-mitigation train-universal --seed 0 -o universal.onnx

        uwb-mitigation train-universal --scaling max -o amplitude.onnx
    """
    from uwb_mitigation.mitigation.model import graph
    from uwb_mitigation.mitigation.model.bundle import save_bundle
    from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
    from uwb_mitigation.simulation.buildings import RADIO
    from uwb_mitigation.simulation.radio import DW3000_STS

    preprocessing = Preprocessing(samples, Scaling(scaling))
    radios = {"dw1000": RADIO, "dw3000": DW3000_STS}
    for path in (output, *([float_output] if float_output else [])):
        check_output(path, force)
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
