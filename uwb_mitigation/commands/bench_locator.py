"""`uwb-mitigation bench locator`: how well positions are told, and what that costs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.checks import import_bench
from uwb_mitigation.commands.console import JsonOption, Table

if TYPE_CHECKING:
    from uwb_mitigation.benches.positions import Errors


def bench_locator(
    data: Annotated[
        Path | None,
        typer.Option(
            help="Folder with hanyang_outdoor and evk1000_apartment; without it, simulated drives alone."
        ),
    ] = None,
    rate: Annotated[float, typer.Option(min=1.0, max=5000.0, help="Ranges a second to the node.")] = 1000.0,
    seconds: Annotated[float, typer.Option(min=1.0, help="For how long.")] = 20.0,
    json: JsonOption = None,
) -> None:
    """Position errors, time of the filter, latency and loss of the node."""
    from uwb_mitigation.benches import positions

    cost = import_bench("locator")
    with console.progress() as bar:
        task = bar.add_task("filter", total=None)
        us_per_range = cost.filter_us()
        node = cost.node(rate, seconds, lambda text: bar.update(task, description=text))
        runs, static = [], None
        if data is not None:
            for folder in sorted((data / "hanyang_outdoor").glob("*_*")):
                bar.update(task, description=f"Hanyang {folder.name}")
                runs.append(positions.hanyang(folder))
            if (data / "evk1000_apartment").is_dir():
                bar.update(task, description="EVK1000 apartment")
                static = positions.apartment(data / "evk1000_apartment")
        flats = []
        for count in (4, 6, 8):
            bar.update(task, description=f"simulated flat, {count} anchors")
            flats.append(positions.flat(count))
    table = Table("recording", title="Horizontal RMSE, m", title_justify="left")
    for column in ("snapshots", "live", "smoothed", "live in 95 % ellipse", "live NEES/dof"):
        table.add_column(column, justify="right")
    for run in runs:
        table.add_row(run.name, *_cells(run))
    for flat in flats:
        table.add_row(f"simulated flat, {flat.anchors} anchors, raw", *_cells(flat.raw))
        table.add_row("    line in received power", *_cells(flat.corrected))
        table.add_row("    universal model", *_cells(flat.universal))
    console.out.print(table)
    if static is not None:
        console.out.print(
            f"EVK1000 apartment, {static.tags} tags at rest, mean error: raw {static.raw_m:.2f} m, "
            f"line from the other tags {static.corrected_m:.2f} m, NEES/dof {static.nees_per_dof:.2f}"
        )
    console.out.print(
        f"filter {us_per_range:.1f} us a range; node at {rate:.0f} ranges/s: p50 {node.p50_ms:.2f} ms, "
        f"p99 {node.p99_ms:.2f} ms, {node.lost} of {node.sent} lost"
    )
    result: dict[str, Any] = {
        "us_per_range": us_per_range,
        "node_p50_ms": node.p50_ms if math.isfinite(node.p50_ms) else None,
        "node_p99_ms": node.p99_ms if math.isfinite(node.p99_ms) else None,
        "lost": node.lost,
        "sent": node.sent,
        "hanyang": {run.name: _as_json(run) for run in runs},
        "flat": [
            {"anchors": flat.anchors}
            | {kind: _as_json(getattr(flat, kind)) for kind in ("raw", "corrected", "universal")}
            for flat in flats
        ],
    }
    if static is not None:
        result["apartment"] = {
            "tags": static.tags,
            "raw_m": static.raw_m,
            "corrected_m": static.corrected_m,
            "nees_per_dof": static.nees_per_dof,
        }
    console.write_json(json, result)


def _cells(errors: Errors) -> tuple[str, ...]:
    rmse = (errors.snapshot.rmse, errors.live.rmse, errors.smoothed.rmse)
    return (
        *(f"{value:.3f}" for value in rmse),
        f"{errors.live.coverage95:.1%}",
        f"{errors.live.nees_per_dof:.2f}",
    )


def _as_json(errors: Errors) -> dict[str, Any]:
    return {kind: getattr(errors, kind).as_json() for kind in ("live", "smoothed", "snapshot")}
