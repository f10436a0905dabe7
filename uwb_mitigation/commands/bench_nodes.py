"""`uwb-mitigation bench nodes` and `bench soak`: what the nodes cost, and whether they stay as they are."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.checks import import_bench
from uwb_mitigation.commands.console import JsonOption, Table

if TYPE_CHECKING:
    from uwb_mitigation.benches.nodes import Figures
    from uwb_mitigation.benches.viewer import ViewerCosts


def bench_nodes(
    repeats: Annotated[
        int, typer.Option(min=1, help="Searches of the highest rate; their median counts.")
    ] = 3,
    slices: Annotated[int, typer.Option(min=1, help="Of each latency; their medians count.")] = 5,
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of a slice.")] = 2.0,
    viewer: Annotated[
        bool,
        typer.Option(
            "--viewer",
            help="Instead: what the viewer takes with 0, 1 and 10 open pages, and from the mitigator.",
        ),
    ] = False,
    json: JsonOption = None,
) -> None:
    """Rate and latency: relay, mitigator, one-process pipeline.

    The same ranges go through each by turns; that takes about five minutes.
    """
    if viewer:
        _bench_viewer(repeats, seconds, json)
        return
    bench = import_bench("nodes")
    with console.progress() as bar:
        task = bar.add_task("starting the nodes", total=1.0)
        figures: dict[str, Figures] = bench.measure(
            repeats, slices, seconds, lambda text, share: bar.update(task, description=text, completed=share)
        )
    ratios = ratios_of(figures)
    console.out.print(_table(figures))
    console.out.print(_ratio_table(ratios))
    console.write_json(json, {name: _as_json(f) for name, f in figures.items()} | {"ratios": ratios})


def _bench_viewer(repeats: int, seconds: float, json: Path | None) -> None:
    bench = import_bench("viewer")
    with console.progress() as bar:
        task = bar.add_task("starting the nodes", total=1.0)
        costs: ViewerCosts = bench.measure(
            repeats, 5.0 * seconds, lambda text, share: bar.update(task, description=text, completed=share)
        )
    table = Table("the viewer at 100 ranges a second", "", title_justify="left")
    for pages, share in costs.core_share.items():
        table.add_row(f"share of a core, {pages} open page{'s' if pages != 1 else ''}", f"{share:.1%}")
    table.add_section()
    for name, range_us in costs.range_us.items():
        table.add_row(f"driver and mitigator, us a range, {name}", f"{range_us:.0f}")
    table.add_section()
    for name, rates_hz in costs.rates_hz.items():
        table.add_row(f"mitigator's highest rate, Hz, {name}", f"{median(rates_hz):.0f}")
    for name, ratio in list(costs.rate_ratios.items())[1:]:
        table.add_row(f"{name} / no viewer", f"{ratio:.2f}")
    console.out.print(table)
    console.write_json(json, asdict(costs) | {"rate_ratios": costs.rate_ratios})


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
    """Many ranges through the nodes: memory, descriptors, threads."""
    soak = import_bench("soak")
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
