"""`python -m benchmarks emulate-evb1000`: radios without hardware, behind the EVB1000's USB-to-SPI protocol."""

from __future__ import annotations

import contextlib
import itertools
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.board import open_source
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.errors import ParameterError

if TYPE_CHECKING:
    from benchmarks.dw1000_model.evb1000 import EmulatedEvb1000s

_UNPLUGGED_S = 0.5


def emulate_evb1000(
    recording: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RECORDING]", help="Its CIRs and errors are the links'; without it, simulated."
        ),
    ] = None,
    boards: Annotated[int, typer.Option(help="How many: the first is the tag, the others anchors.")] = 2,
    link: Annotated[
        Path | None,
        typer.Option(metavar="PREFIX", help="Symbolic links to the ports: PREFIX0, PREFIX1, ..."),
    ] = None,
    round_trip: Annotated[float, typer.Option(help="s, from a request to its answer over USB.")] = 1.5e-3,
    rate: Annotated[float, typer.Option(help="How often a link changes to the next CIR, Hz.")] = 20.0,
    ranging: Annotated[
        list[int] | None,
        typer.Option(metavar="BOARD", help="Switched to ranging, not USB to SPI; may be repeated."),
    ] = None,
    loss: Annotated[float, typer.Option(help="Share of frames lost on the air.")] = 0.0,
    damage: Annotated[float, typer.Option(help="Share of frames damaged on the air.")] = 0.0,
    distance: Annotated[
        float | None,
        typer.Option(help="m, between all boards, in line of sight; instead of a recording."),
    ] = None,
    antenna_delay: Annotated[
        int, typer.Option(help="Antenna delay in the OTP memory of each chip, ticks, TX + RX.")
    ] = 32872,
    unplug_every: Annotated[
        float | None, typer.Option(help="s between pulls of a cable, in turn; SIGUSR1 pulls one too.")
    ] = None,
    duration: Annotated[float | None, typer.Option(help="s, then end; without it, on Ctrl-C.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.")] = 1,
    json: JsonOption = None,
) -> None:
    """Emulate EVB1000s without hardware, each on a pseudo-terminal.

    Modelled DW1000s with the USB-to-SPI protocol of the factory firmware, in wall-clock time. Use the printed ports
    like /dev/ttyACM0. The emulation was not compared with a real board.
    """
    from benchmarks.dw1000_model.evb1000 import DEFAULT_DISTANCE_M, EmulatedEvb1000s

    for name, value in (("duration", duration), ("unplug-every", unplug_every)):
        if value is not None and not value > 0:
            raise ParameterError(f"{name} = {value}", valid="above 0")
    if seed < 0:
        raise ParameterError(f"seed = {seed}", valid="0 or more")
    switched = frozenset(ranging or ())
    if not all(0 <= number < boards for number in switched):
        raise ParameterError(f"ranging = {sorted(switched)}", valid=f"numbers of boards, 0 to {boards - 1}")
    if distance is not None and recording is not None:
        raise ParameterError(f"--distance {distance} with a recording", valid="one of both")
    with open_source(recording, rate, seed) as source:
        emulated = EmulatedEvb1000s(
            source if distance is None else None,
            boards=boards,
            rate_hz=rate,
            round_trip_s=round_trip,
            ranging=switched,
            port_links=link,
            loss=loss,
            damage=damage,
            seed=seed,
            antenna_delay=antenna_delay,
            distance_m=DEFAULT_DISTANCE_M if distance is None else distance,
        )
        with emulated, _signals() as asked:
            for number, port in enumerate(emulated.ports):
                what = "tag" if number == 0 else f"anchor {number}"
                console.out.print(f"{what} at {port}", soft_wrap=True, highlight=False)
            _keep_running(emulated, asked, duration, unplug_every)
    console.write_json(json, {"requests": list(emulated.requests)})
    if emulated.failure is not None:
        raise emulated.failure


@contextlib.contextmanager
def _signals() -> Iterator[list[int]]:
    """Collect received SIGUSR1 signals."""
    asked: list[int] = []
    before = signal.signal(signal.SIGUSR1, lambda number, _: asked.append(number))
    try:
        yield asked
    finally:
        signal.signal(signal.SIGUSR1, before)


def _keep_running(
    emulated: EmulatedEvb1000s, asked: list[int], duration: float | None, unplug_every: float | None
) -> None:
    began = pulled = time.monotonic()
    turns = itertools.cycle(range(len(emulated.ports)))
    while emulated.failure is None and (duration is None or time.monotonic() - began < duration):
        time.sleep(0.05)
        if asked or (unplug_every is not None and time.monotonic() - pulled > unplug_every):
            asked.clear()
            number = next(turns)
            emulated.unplug(number)
            time.sleep(_UNPLUGGED_S)
            emulated.plug(number)
            pulled = time.monotonic()
            port = emulated.ports[number]
            console.out.print(f"board {number} plugged in again at {port}", soft_wrap=True, highlight=False)
