"""`python -m benchmarks emulate-lines`: boards that print ranges as text, on pseudo-terminals or to a UDP port."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.equipment.emulate_evb1000 import keep_running
from uwb_mitigation.commands.support import console
from uwb_mitigation.errors import ParameterError


def emulate_lines(
    kind: Annotated[str, typer.Option(help="pans (DWM1001), at, json, or cli (DWM3001CDK).")] = "pans",
    boards: Annotated[int, typer.Option(min=1, max=32, help="Number of tags.")] = 1,
    link: Annotated[
        Path | None, typer.Option(metavar="PREFIX", help="Symbolic links to the ports: PREFIX0, PREFIX1, ...")
    ] = None,
    udp: Annotated[int, typer.Option(min=0, max=65535, help="UDP port of this computer; 0: terminals.")] = 0,
    rate: Annotated[float, typer.Option(min=0.01, max=200.0, help="Outputs per second, Hz.")] = 10.0,
    distance: Annotated[
        float | None,
        typer.Option(min=0.0, max=600.0, help="Distance of the only anchor, m. Default: four anchors."),
    ] = None,
    unplug_every: Annotated[float | None, typer.Option(help="s between unplugging a board, in turn.")] = None,
    duration: Annotated[float | None, typer.Option(help="s, then end; without it, on Ctrl-C.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers.")] = 1,
) -> None:
    """Emulate boards that print ranges as text.

    The emulation was written from public facts and was not compared with a real board.
    """
    from benchmarks.equipment.text_board import TextBoards

    for name, value in (("duration", duration), ("unplug-every", unplug_every)):
        if value is not None and not value > 0:
            raise ParameterError(f"{name} = {value}", valid="above 0")
    target = ("127.0.0.1", udp) if udp else None
    emulated = TextBoards(
        kind, boards=boards, links=link, rate_hz=rate, distance_m=distance, udp=target, seed=seed
    )
    with emulated:
        for number, port in enumerate(emulated.ports):
            where = f"udp:{udp}" if udp else port
            console.out.print(f"board {number} at {where}", soft_wrap=True, highlight=False)
        keep_running(emulated, [], duration, unplug_every)
