"""`uwb-mitigation bench nodes` and `bench soak`: what the nodes cost, and whether they stay as they are."""

from __future__ import annotations

from dataclasses import asdict
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.errors import MissingDependencyError

if TYPE_CHECKING:
    from uwb_mitigation.nodes.bench_nodes import Figures


def bench_nodes(
    repeats: Annotated[
        int, typer.Option(min=1, help="Searches of the highest rate; their median counts.")
    ] = 3,
    slices: Annotated[int, typer.Option(min=1, help="Of each latency; their medians count.")] = 7,
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of a slice.")] = 2.0,
    json: JsonOption = None,
) -> None:
    """Put the same ranges through a relay, the mitigator and the one-process pipeline, by turns."""
    bench = _nodes("bench_nodes")
    with console.progress() as bar:
        task = bar.add_task("starting the nodes", total=None)
        figures: dict[str, Figures] = bench.measure(
            repeats, slices, seconds, lambda text: bar.update(task, description=text)
        )
    ratios = ratios_of(figures)
    console.out.print(_table(figures))
    console.out.print(_ratio_table(ratios))
    console.write_json(json, {name: _as_json(f) for name, f in figures.items()} | {"ratios": ratios})


def bench_soak(
    messages: Annotated[
        int, typer.Option(min=1000, help="Ranges; 8 hours at 40 a second are 1152000.")
    ] = 1_152_000,
    rate: Annotated[float, typer.Option(min=1.0, max=20_000.0, help="Ranges a second.")] = 2000.0,
    one_process: Annotated[
        bool, typer.Option("--one-process", help="Through the pipeline instead of two nodes.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Run many ranges through the nodes, and watch their memory, descriptors and threads."""
    soak = _nodes("soak")
    with console.progress() as bar:
        task = bar.add_task("ranges corrected", total=messages)
        outcome = soak.soak(
            messages, rate, one_process=one_process, advance=lambda done: bar.update(task, completed=done)
        )
    table = Table(title=f"{outcome.received} ranges in {outcome.seconds:.0f} s, {outcome.lost} lost")
    for column in ("ranges", "memory, MB", "descriptors", "threads"):
        table.add_column(column, justify="right")
    for look in outcome.course:
        table.add_row(str(look.ranges), f"{look.memory_mb:.1f}", str(look.descriptors), str(look.threads))
    console.out.print(table)
    console.write_json(json, asdict(outcome))


def ratios_of(figures: dict[str, Figures]) -> dict[str, float]:
    """What the subjects are to each other: rates of the mitigator and the pipeline, added latency in us."""
    relay, mitigator, pipeline = (figures[name] for name in ("relay", "mitigator", "pipeline"))
    return {
        "mitigator_rate_over_relay": mitigator.max_lossless_rate_hz / (relay.max_lossless_rate_hz or 1.0),
        "pipeline_rate_over_mitigator": pipeline.max_lossless_rate_hz
        / (mitigator.max_lossless_rate_hz or 1.0),
        "added_p99_us_at_500_hz": mitigator.latency_us[500].p99 - relay.latency_us[500].p99,
    }


def _nodes(name: str) -> ModuleType:
    """A module of the nodes, imported only where ROS is wanted.

    Raises:
        MissingDependencyError: there is no ROS.
    """
    from importlib import import_module

    try:
        return import_module(f"uwb_mitigation.nodes.{name}")
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"this needs ROS 2: {error}", valid="run `make setup`, or source ROS's setup.sh"
        ) from error


def _as_json(figures: Figures) -> dict[str, Any]:
    values = asdict(figures)
    values["latency_us"] = {str(rate): latency for rate, latency in values["latency_us"].items()}
    return {"max_lossless_rate_hz": figures.max_lossless_rate_hz} | values


def _table(figures: dict[str, Figures]) -> Table:
    table = Table(title="ranges of 157 complex samples; latency from when one was due, us: p50 / p99 / max")
    rates = list(next(iter(figures.values())).latency_us)
    for column in ("", *(f"{rate} Hz" for rate in rates), "max Hz", "CPU us", "MB"):
        table.add_column(column, justify="right" if column else "left")
    for name, of in figures.items():
        latencies = (
            f"{of.latency_us[r].p50:.0f} / {of.latency_us[r].p99:.0f} / {of.latency_us[r].max:.0f}"
            for r in rates
        )
        table.add_row(
            name.replace("_", ", "),
            *latencies,
            f"{of.max_lossless_rate_hz:.0f}",
            f"{of.cpu_us_per_message:.0f}",
            f"{of.memory_mb:.0f}",
        )
    return table


def _ratio_table(ratios: dict[str, float]) -> Table:
    table = Table("", "", show_header=False)
    table.add_row("mitigator's highest rate / relay's", f"{ratios['mitigator_rate_over_relay']:.2f}")
    table.add_row("pipeline's highest rate / mitigator's", f"{ratios['pipeline_rate_over_mitigator']:.2f}")
    table.add_row("mitigator's p99 - relay's at 500 Hz, us", f"{ratios['added_p99_us_at_500_hz']:.0f}")
    return table
