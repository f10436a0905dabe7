"""`uwb-mitigation emulate-board`: a board without hardware."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.errors import ParameterError

if TYPE_CHECKING:
    from uwb_mitigation.link.board import Identity
    from uwb_mitigation.link.emulated_board import EmulatedBoard
    from uwb_mitigation.mitigation import Mitigation
    from uwb_mitigation.sources.source import Source


def emulate_board(
    recording: Annotated[
        Path | None,
        typer.Argument(metavar="[RECORDING]", help="Played over and over; without it, simulated."),
    ] = None,
    link: Annotated[
        Path | None, typer.Option(help="Symbolic link to the port, kept while the board runs.")
    ] = None,
    rate: Annotated[float, typer.Option(help="Measurements a second, Hz.")] = 50.0,
    model: Annotated[Path | None, typer.Option(help="Bundle that the board holds.")] = None,
    mode: Annotated[str, typer.Option(help="At the start: host, device or both.")] = "host",
    duration: Annotated[float | None, typer.Option(help="s, then end; without it, on Ctrl-C.")] = None,
    damage: Annotated[float, typer.Option(help="Share of bytes flipped, dropped, inserted, each.")] = 0.0,
    lose: Annotated[float, typer.Option(help="Share of messages lost.")] = 0.0,
    duplicate: Annotated[float, typer.Option(help="Share of messages that arrive twice.")] = 0.0,
    stall: Annotated[float, typer.Option(help="s, longest time that the bus holds bytes back.")] = 0.0,
    reset_every: Annotated[float | None, typer.Option(help="s between resets of the firmware.")] = None,
    unplug_every: Annotated[float | None, typer.Option(help="s between pulls of the cable.")] = None,
    seed: Annotated[int, typer.Option(help="Of all faults, and of simulated measurements.")] = 1,
    json: JsonOption = None,
) -> None:
    """Be a board without hardware, on a pseudo-terminal.

    Open the port it prints as if it were /dev/ttyACM0.
    """
    from uwb_mitigation.link.emulated_board import BoardFaults, EmulatedBoard
    from uwb_mitigation.link.faults import ByteFaults
    from uwb_mitigation.link.layout import Mode

    if mode.upper() not in Mode.__members__:
        raise ParameterError(f"mode {mode!r}", valid=", ".join(name.lower() for name in Mode.__members__))
    for name, value in (
        ("duration", duration),
        ("reset-every", reset_every),
        ("unplug-every", unplug_every),
    ):
        if value is not None and not value > 0:
            raise ParameterError(f"{name} = {value}", valid="above 0")
    if seed < 0:
        raise ParameterError(f"seed = {seed}", valid="0 or more")
    faults = BoardFaults(ByteFaults(damage, damage, damage), lose, duplicate, stall)
    identity, mitigation = _firmware(model)
    with _source(recording, rate, seed) as source:
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
            console.out.print(f"{source.name} at {board.port}", soft_wrap=True, highlight=False)
            _keep_running(board, duration, reset_every, unplug_every)
    console.write_json(json, {"sent": board.sent_measurements})
    if board.failure is not None:
        raise board.failure


def _keep_running(
    board: EmulatedBoard, duration: float | None, reset_every: float | None, unplug_every: float | None
) -> None:
    began = reset = plugged = time.monotonic()
    while board.failure is None and (duration is None or time.monotonic() - began < duration):
        time.sleep(0.05)
        now = time.monotonic()
        if reset_every is not None and now - reset > reset_every:
            reset = now
            board.reset()
        if unplug_every is not None and now - plugged > unplug_every:
            board.unplug()
            time.sleep(0.5)
            board.plug()
            plugged = time.monotonic()
            console.out.print(f"plugged in again at {board.port}", soft_wrap=True, highlight=False)


def _source(recording: Path | None, rate: float, seed: int) -> Source:
    if recording is None:
        from uwb_mitigation.sources.simulated import SimulatedSource

        return SimulatedSource(seed=seed, rate_hz=rate)
    from uwb_mitigation.sources.opening import open_recording

    return open_recording(recording)


def _firmware(model: Path | None) -> tuple[Identity, Mitigation | None]:
    from uwb_mitigation.link.board import Identity

    if model is None:
        return Identity(), None
    from uwb_mitigation.mitigation import Mitigation
    from uwb_mitigation.model.bundle import load_bundle

    bundle = load_bundle(model)
    return Identity(model_id=bundle.model_id, window=bundle.preprocessing.samples), Mitigation(bundle)
