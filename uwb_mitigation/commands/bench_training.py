"""`uwb-mitigation bench training`."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer
from rich.table import Table

from uwb_mitigation.commands import console
from uwb_mitigation.commands.checks import needs_torch
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.commands.training import share_bar
from uwb_mitigation.errors import ParameterError


def bench_training(
    samples: Annotated[int, typer.Option(help="Window length K.")] = 157,
    batch: Annotated[int, typer.Option(help="Inputs a step.")] = 32,
    rounds: Annotated[int, typer.Option(help="Of 25 steps for either, in turn.")] = 8,
    processes: Annotated[int, typer.Option(help="Of one thread each, that train at once.")] = 2,
    json: JsonOption = None,
) -> None:
    """How many samples a second REMNet trains on, beside torch's own operators."""
    for name, value, high in (
        ("samples", samples, 1016),
        ("batch", batch, 4096),
        ("rounds", rounds, 1000),
        ("processes", processes, 64),
    ):
        if not 1 <= value <= high:
            raise ParameterError(f"{name} = {value}", valid=f"1 to {high}")
    with needs_torch():
        from uwb_mitigation.training import benchmark

    with share_bar("training") as update:
        speed = benchmark.measure(samples, batch, rounds, processes, update)
    run = benchmark.PAPER_SAMPLES * benchmark.PAPER_EPOCHS
    table = Table(title=f"REMNet, K = {samples}, batches of {batch}")
    for column in ("", "samples/s", "samples/s of processor time"):
        table.add_column(column, justify="right" if column else "left")
    table.add_row("torch module, one process", f"{speed.torch_module:,.0f}", f"{speed.torch_module_cpu:,.0f}")
    table.add_row("learner, one process", f"{speed.learner:,.0f}", f"{speed.learner_cpu:,.0f}")
    table.add_row(f"learner, {processes} processes in sum", f"{speed.together:,.0f}", "")
    console.out.print(table)
    console.out.print(
        f"{speed.ratio:.1f} x the torch module; the paper's training ({run:,} samples) would take an estimated "
        f"{run / speed.learner:.0f} s alone",
        highlight=False,
    )
    console.write_json(
        json, asdict(speed) | {"ratio": speed.ratio, "paper_training_estimated_s": run / speed.learner}
    )
