"""`uwb-mitigation bench serial`: what the driver stands on a board's serial link."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.checks import import_bench
from uwb_mitigation.commands.console import JsonOption, Table


def bench_serial(
    rate: Annotated[
        float, typer.Option(min=1.0, max=10_000.0, help="Ranges a second from the board.")
    ] = 1000.0,
    seconds: Annotated[float, typer.Option(min=1.0, max=1e6, help="Length of the steady stream.")] = 60.0,
    unplugs: Annotated[int, typer.Option(min=1, max=1_000_000, help="How often the cable is pulled.")] = 50,
    json: JsonOption = None,
) -> None:
    """Stream a board through the driver; pull its cable often.

    The board is emulated.
    """
    bench = import_bench("serial_link")
    with console.progress() as bar:
        task = bar.add_task("streaming", total=None)
        steady = bench.steady(rate, seconds)
        bar.update(task, description="unplugging")
        unplug = bench.unplug(unplugs)
    table = Table("serial link, emulated board", "", title_justify="left")
    table.add_row("ranges sent / received / lost", f"{steady.sent} / {steady.received} / {steady.lost}")
    table.add_row("rate, Hz", f"{steady.sent / steady.seconds:.0f}")
    table.add_row("driver's share of a core", f"{steady.driver_cpu:.2f}")
    table.add_row("stamp to arrival, ms, p50 / p99", f"{steady.late_ms_p50:.2f} / {steady.late_ms_p99:.2f}")
    table.add_section()
    table.add_row("unplugged and plugged in", str(unplug.cycles))
    table.add_row(
        "port's return to range, ms, p50 / max",
        f"{unplug.resumed_ms_p50:.0f} / {unplug.resumed_ms_max:.0f}",
    )
    for name in ("descriptors", "threads"):
        before, after = getattr(unplug, name)
        table.add_row(f"{name}, before / after", f"{before} / {after}")
    before, after = unplug.memory_mb
    table.add_row("memory, MB, before / after", f"{before:.1f} / {after:.1f}")
    console.out.print(table)
    console.write_json(json, {"steady": asdict(steady), "unplug": asdict(unplug)})
