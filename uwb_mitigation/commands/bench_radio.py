"""`uwb-mitigation bench radio`: how well and how fast the firmware ranges with modelled DW1000s."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption, Table
from uwb_mitigation.errors import ParameterError

if TYPE_CHECKING:
    from uwb_mitigation.benches.radio import RadioSoak, Ranging


def bench_radio(
    seconds: Annotated[
        float, typer.Option(help="Of virtual time, for each distance and pair of clocks.")
    ] = 3.0,
    exchanges: Annotated[int, typer.Option(help="Of the soak; 0 = none.")] = 200_000,
    evb1000: Annotated[
        float, typer.Option(help="s of wall-clock time for two emulated EVB1000s; 0 = none.")
    ] = 10.0,
    seed: Annotated[int, typer.Option(help="Of the soak.")] = 1,
    json: JsonOption = None,
) -> None:
    """The firmware's ranging on modelled radios: error, rates, soak.

    The chips are modelled register by register, in virtual time, but for the emulated EVB1000s, which answer in
    wall-clock time: a busy computer slows them down. Nothing of this was measured on a board.
    """
    from uwb_mitigation.benches import radio as bench
    from uwb_mitigation.link.layout import Mode

    for name, value, most in (("seconds", seconds, 60), ("evb1000", evb1000, 600)):
        if not 0 <= value <= most or (name == "seconds" and value < 0.5):
            raise ParameterError(
                f"--{name} {value}", valid=f"{'0.5' if name == 'seconds' else '0'} to {most}"
            )
    if not 0 <= exchanges <= 10_000_000:
        raise ParameterError(f"--exchanges {exchanges}", valid="0 to 10000000")
    if seed < 0:
        raise ParameterError(f"seed = {seed}", valid="0 or more")
    with console.progress() as bar:
        task = bar.add_task("ranging", total=len(bench.PPM_PAIRS) * len(bench.DISTANCES_M))
        rows = bench.ranging(seconds, lambda: bar.advance(task))
        host_hz, device_hz = bench.line_rate_hz(Mode.HOST), bench.line_rate_hz(Mode.DEVICE)
        evb1000_hz = None
        if evb1000:
            task = bar.add_task("EVB1000s", total=None)
            evb1000_hz = bench.evb1000_rate_hz(evb1000)
        soaked = None
        if exchanges:
            task = bar.add_task("soak", total=exchanges)
            soaked = bench.soak(exchanges, seed, lambda done: bar.update(task, completed=done))
    console.out.print(_ranging_table(rows))
    console.out.print(_table(host_hz, device_hz, evb1000_hz, soaked))
    console.write_json(
        json,
        {
            "ranging": [asdict(row) for row in rows],
            "host_rate_hz": host_hz,
            "device_rate_hz": device_hz,
            "evb1000_rate_hz": evb1000_hz,
            "soak": None if soaked is None else asdict(soaked),
        },
    )


def _ranging_table(rows: list[Ranging]) -> Table:
    table = Table(title="ranges of modelled chips; the counters wrap meanwhile", caption="errors in mm")
    for name in ("ppm", "distance, m", "ranges", "mean error", "sd"):
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(
            f"{row.ppm_a:+g} / {row.ppm_b:+g}",
            f"{row.distance_m:g}",
            f"{row.exchanges}",
            f"{1000 * row.mean_error_m:+.2f}",
            f"{1000 * row.sd_m:.2f}",
        )
    return table


def _table(host_hz: float, device_hz: float, evb1000_hz: float | None, soaked: RadioSoak | None) -> Table:
    table = Table("ranges a second, 157 samples", "")
    table.add_row("921600 baud, host corrects (virtual time)", f"{host_hz:.0f}")
    table.add_row("921600 baud, board corrects (virtual time, estimated cycles)", f"{device_hz:.0f}")
    if evb1000_hz is not None:
        table.add_row("two emulated EVB1000s, 1.5 ms a round trip (wall-clock time)", f"{evb1000_hz:.1f}")
    if soaked is not None:
        table.add_section()
        table.add_row("soak: exchanges / ranges", f"{soaked.exchanges:,} / {soaked.delivered:,}")
        table.add_row("ranges off by more than 0.1 m", f"{soaked.wrong}")
        table.add_row("chips reset, anchors gone for a while", f"{soaked.disturbances:,}")
        table.add_row("longest return to the next range, s", f"{soaked.longest_recovery_s:.2f}")
        table.add_row("growth of memory, MB", f"{soaked.memory_growth_mb:.1f}")
    return table
