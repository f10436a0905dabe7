"""`python -m benchmarks emulate-uci`: boards with UCI firmware on pseudo-terminals."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.equipment.emulate_evb1000 import keep_running
from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.console import JsonOption
from uwb_mitigation.errors import ParameterError


def emulate_uci(
    boards: Annotated[int, typer.Option(help="Number of boards.")] = 2,
    link: Annotated[
        Path | None, typer.Option(metavar="PREFIX", help="Symbolic links to the ports: PREFIX0, PREFIX1, ...")
    ] = None,
    distance: Annotated[float, typer.Option(help="Distance between the boards, m.")] = 3.0,
    max_taps: Annotated[int, typer.Option(help="Largest CIR window that the firmware accepts.")] = 255,
    tap_bytes: Annotated[int, typer.Option(help="Size of a complex tap: 4, 6 or 8.")] = 6,
    lose: Annotated[float, typer.Option(help="Share of lost notifications.")] = 0.0,
    swap: Annotated[float, typer.Option(help="Share of diagnostics sent before their range.")] = 0.0,
    late: Annotated[float, typer.Option(help="Share of diagnostics sent after the next range.")] = 0.0,
    garbage: Annotated[
        float, typer.Option(help="Share of notifications with random bytes before them.")
    ] = 0.0,
    errors: Annotated[float, typer.Option(help="Share of commands that are rejected.")] = 0.0,
    offset: Annotated[float, typer.Option(help="Error of all ranges, m.")] = 0.0,
    unplug_every: Annotated[float | None, typer.Option(help="s between unplugging a board, in turn.")] = None,
    duration: Annotated[float | None, typer.Option(help="s, then end; without it, on Ctrl-C.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.")] = 1,
    json: JsonOption = None,
) -> None:
    """Emulate boards with Qorvo's UCI firmware, each on a pseudo-terminal.

    Use the printed ports like /dev/ttyACM0. The emulation was written from public facts and was not compared with a
    real board.
    """
    from benchmarks.equipment.uci_board import EmulatedUciBoards, UciFaults

    for name, value in (("duration", duration), ("unplug-every", unplug_every)):
        if value is not None and not value > 0:
            raise ParameterError(f"{name} = {value}", valid="above 0")
    if tap_bytes not in (4, 6, 8):
        raise ParameterError(f"tap-bytes = {tap_bytes}", valid="4, 6 or 8")
    if not 1 <= max_taps <= 255 or seed < 0 or not 0 <= distance <= 600:
        raise ParameterError(
            f"max-taps = {max_taps}, seed = {seed}, distance = {distance}",
            valid="1 to 255 taps, a seed of 0 or more, 0 to 600 m",
        )
    faults = UciFaults(lose=lose, swap=swap, late=late, garbage=garbage, errors=errors, offset_m=offset)
    with EmulatedUciBoards(
        boards=boards,
        distance_m=distance,
        links=link,
        max_taps=max_taps,
        tap_bytes=tap_bytes,
        faults=faults,
        seed=seed,
    ) as emulated:
        for number, port in enumerate(emulated.ports):
            console.out.print(f"board {number} at {port}", soft_wrap=True, highlight=False)
        keep_running(emulated, [], duration, unplug_every)
    console.write_json(json, {"exchanges": emulated.exchanges})
