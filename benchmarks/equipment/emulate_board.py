"""`python -m benchmarks emulate-board`: a board with our firmware on a pseudo-terminal."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.console import JsonOption, print_line
from uwb_mitigation.errors import ParameterError, check_name

if TYPE_CHECKING:
    from uwb_mitigation.mitigation.correction import Mitigation
    from uwb_mitigation.radios.wire.messages import Hello
    from uwb_mitigation.types.source import Source


def emulate_board(
    recording: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RECORDING]", help="Recording that is played in a loop. Default: simulated ranges."
        ),
    ] = None,
    link: Annotated[Path | None, typer.Option(help="Symbolic link to the port while the board runs.")] = None,
    rate: Annotated[float, typer.Option(help="Rate of the measurements, Hz.")] = 50.0,
    model: Annotated[Path | None, typer.Option(help="Bundle on the board.")] = None,
    mode: Annotated[str, typer.Option(help="Initial mode: host or device.")] = "host",
    duration: Annotated[float | None, typer.Option(help="Duration, s. Default: until Ctrl-C.")] = None,
    damage: Annotated[
        float, typer.Option(help="Share of bytes that are flipped, dropped and inserted, each.")
    ] = 0.0,
    lose: Annotated[float, typer.Option(help="Share of lost messages.")] = 0.0,
    duplicate: Annotated[float, typer.Option(help="Share of duplicated messages.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Seed of the faults and of simulated measurements.")] = 1,
    json: JsonOption = None,
) -> None:
    """Emulate a board on a pseudo-terminal.

    Open the printed port like /dev/ttyACM0.
    """
    from benchmarks.equipment.emulated_board import EmulatedBoard
    from benchmarks.equipment.faults import Faults
    from uwb_mitigation.radios.wire.layout import Mode

    check_name("mode", mode, ("host", "device"))
    if duration is not None and not duration > 0:
        raise ParameterError(f"duration = {duration}", valid="above 0")
    if seed < 0:
        raise ParameterError(f"seed = {seed}", valid="0 or more")
    faults = Faults(damage, damage, damage, lose, duplicate)
    identity, mitigation = _firmware(model)
    with open_source(recording, rate, seed) as source:
        board = EmulatedBoard(
            source,
            rate_hz=rate,
            identity=identity,
            corrector=mitigation,
            mode=Mode[mode.upper()],
            faults=faults,
            link=link,
            seed=seed,
        )
        with board:
            print_line(f"{source.name} at {board.port}")
            end_s = time.monotonic() + (duration or math.inf)
            while board.failure is None and time.monotonic() < end_s:
                time.sleep(0.05)
    console.write_json(json, {"sent": board.sent_measurements})
    if board.failure is not None:
        raise board.failure


def open_source(recording: Path | None, rate: float, seed: int) -> Source:
    """Return the source of measurements: a recording, or the simulator without one."""
    if recording is None:
        from uwb_mitigation.simulation.simulated import SimulatedSource

        return SimulatedSource(seed=seed, rate_hz=rate)
    from uwb_mitigation.recordings.formats import open_recording

    return open_recording(recording)


def _firmware(model: Path | None) -> tuple[Hello, Mitigation | None]:
    from benchmarks.equipment.emulated_board import EMULATED

    if model is None:
        return EMULATED, None
    from uwb_mitigation.mitigation.correction import Mitigation
    from uwb_mitigation.mitigation.model.bundle import load_bundle

    bundle = load_bundle(model)
    return replace(EMULATED, model_id=bundle.model_id, window=bundle.card.preprocessing.samples), Mitigation(
        bundle
    )
