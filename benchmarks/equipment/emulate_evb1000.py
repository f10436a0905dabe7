"""`python -m benchmarks emulate-evb1000`: radios without hardware, with the USB-to-SPI protocol of the EVB1000."""

from __future__ import annotations

import contextlib
import itertools
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from benchmarks.equipment.emulate_board import open_source
from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.console import JsonOption
from uwb_mitigation.errors import ParameterError

if TYPE_CHECKING:
    from benchmarks.equipment.dw1000_model.evb1000 import EmulatedEvb1000s
    from benchmarks.equipment.text_board import TextBoards
    from benchmarks.equipment.uci_board import EmulatedUciBoards

_UNPLUG_DURATION_S = 0.5


def emulate_evb1000(
    recording: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RECORDING]",
            help="Recording with the CIRs and errors of the radio channels. Default: simulated.",
        ),
    ] = None,
    boards: Annotated[
        int, typer.Option(help="Number of boards: the first is the tag, the others are anchors.")
    ] = 2,
    link: Annotated[
        Path | None,
        typer.Option(metavar="PREFIX", help="Symbolic links to the ports: PREFIX0, PREFIX1, ..."),
    ] = None,
    round_trip: Annotated[
        float, typer.Option(help="Time from a request to its answer over USB, s.")
    ] = 1.5e-3,
    rate: Annotated[
        float, typer.Option(help="Rate at which the radio channels change to the next CIR, Hz.")
    ] = 20.0,
    ranging: Annotated[
        list[int] | None,
        typer.Option(
            metavar="BOARD", help="Board whose switches select ranging instead of USB to SPI; repeatable."
        ),
    ] = None,
    loss: Annotated[float, typer.Option(help="Share of frames that are lost, 0 to 1.")] = 0.0,
    damage: Annotated[float, typer.Option(help="Share of frames that are damaged, 0 to 1.")] = 0.0,
    distance: Annotated[
        float | None,
        typer.Option(help="Distance between all boards in LOS, m; replaces the recording."),
    ] = None,
    antenna_delay: Annotated[
        int, typer.Option(help="Total TX + RX antenna delay of each chip, also in its OTP memory, ticks.")
    ] = 32872,
    unplug_every: Annotated[
        float | None,
        typer.Option(help="Interval at which a cable is unplugged, s. SIGUSR1 also unplugs one."),
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Duration, s. Default: until Ctrl-C.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 1,
    json: JsonOption = None,
) -> None:
    """Emulate EVB1000s without hardware, each on a pseudo-terminal.

    Modelled DW1000s with the USB-to-SPI protocol of the factory firmware, in wall-clock time. Use the printed ports
    like /dev/ttyACM0. The emulation was not compared with a real board.
    """
    from benchmarks.equipment.dw1000_model.evb1000 import DEFAULT_DISTANCE_M, EmulatedEvb1000s

    for name, value in (("duration", duration), ("unplug-every", unplug_every)):
        if value is not None and not value > 0:
            raise ParameterError(f"{name} = {value}", valid="above 0")
    if seed < 0:
        raise ParameterError(f"seed = {seed}", valid="0 or more")
    ranging_boards = frozenset(ranging or ())
    if not all(0 <= number < boards for number in ranging_boards):
        raise ParameterError(
            f"ranging = {sorted(ranging_boards)}", valid=f"numbers of boards, 0 to {boards - 1}"
        )
    if distance is not None and recording is not None:
        raise ParameterError(f"--distance {distance} with a recording", valid="one of both")
    with open_source(recording, rate, seed) as source:
        emulated = EmulatedEvb1000s(
            source if distance is None else None,
            boards=boards,
            rate_hz=rate,
            round_trip_s=round_trip,
            ranging=ranging_boards,
            port_links=link,
            loss=loss,
            damage=damage,
            seed=seed,
            antenna_delay=antenna_delay,
            distance_m=DEFAULT_DISTANCE_M if distance is None else distance,
        )
        with emulated, _signals() as received_signals:
            for number, port in enumerate(emulated.ports):
                what = "tag" if number == 0 else f"anchor {number}"
                console.out.print(f"{what} at {port}", soft_wrap=True, highlight=False)
            keep_running(emulated, received_signals, duration, unplug_every)
    console.write_json(json, {"requests": list(emulated.requests)})
    if emulated.failure is not None:
        raise emulated.failure


@contextlib.contextmanager
def _signals() -> Iterator[list[int]]:
    """Collect received SIGUSR1 signals."""
    received_signals: list[int] = []
    before = signal.signal(signal.SIGUSR1, lambda number, _: received_signals.append(number))
    try:
        yield received_signals
    finally:
        signal.signal(signal.SIGUSR1, before)


def keep_running(
    emulated: EmulatedEvb1000s | EmulatedUciBoards | TextBoards,
    received_signals: list[int],
    duration: float | None,
    unplug_every: float | None,
) -> None:
    """Wait until the end, and unplug the boards in turn."""
    started_s = unplugged_s = time.monotonic()
    board_numbers = itertools.cycle(range(len(emulated.ports)))
    while emulated.failure is None and (duration is None or time.monotonic() - started_s < duration):
        time.sleep(0.05)
        if received_signals or (unplug_every is not None and time.monotonic() - unplugged_s > unplug_every):
            received_signals.clear()
            number = next(board_numbers)
            emulated.unplug(number)
            time.sleep(_UNPLUG_DURATION_S)
            emulated.plug(number)
            unplugged_s = time.monotonic()
            port = emulated.ports[number]
            console.out.print(f"board {number} plugged in again at {port}", soft_wrap=True, highlight=False)
