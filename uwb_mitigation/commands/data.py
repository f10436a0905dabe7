"""`uwb-mitigation data`: bring recordings into bags or simulate them, and show what a recording holds."""

from __future__ import annotations

import enum
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.commands.fetch import fetch
from uwb_mitigation.errors import DamagedRecordingError, ParameterError, RecordingError

if TYPE_CHECKING:
    from uwb_mitigation.sources.inventory import Inventory
    from uwb_mitigation.sources.source import Source

app = typer.Typer(
    help="Bring recordings into bags or simulate them, and show what a recording holds.", no_args_is_help=True
)
app.command()(fetch)

_STRIDE = 100
"""Ranges between two updates of a progress bar."""


class CirChoice(str, enum.Enum):
    """Which frame of a DecaRanging exchange gives the CIR."""

    FINAL = "final"
    POLL = "poll"


class Scene(str, enum.Enum):
    """What is simulated."""

    DRIVE = "drive"
    SURVEY = "survey"
    DEEPUWB = "deepuwb"


_RANGES = 20_000
"""Of a survey or drive where no number is asked for; in the shape of DeepUWB the source has its own."""

CirOption = Annotated[
    CirChoice, typer.Option(help="Of a DecaRanging exchange, take the CIR of this frame: final or poll.")
]


@app.command("import")
def import_recordings(
    sources: Annotated[list[Path], typer.Argument(metavar="SRC...", help="Recordings: logs, folders, bags.")],
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="OUT", help="OUT.mcap for one file, any other name for a bag folder."
        ),
    ],
    cir: CirOption = CirChoice.FINAL,
    force: Annotated[bool, typer.Option("--force", help="Replace OUT if it exists.")] = False,
    json: JsonOption = None,
) -> None:
    """Write recordings into one MCAP bag, with their truth where it is known."""
    from uwb_mitigation.bag.writer import BagWriter
    from uwb_mitigation.sources.inventory import Inventory
    from uwb_mitigation.sources.opening import open_recording

    opened = [open_recording(path, cir=cir.value) for path in sources]
    inventory = Inventory()
    origin = {
        "source": "; ".join(source.name for source in opened),
        "simulated": "true" if any(source.simulated for source in opened) else "false",
    }
    damage: list[DamagedRecordingError] = []
    with BagWriter(output, origin, force=force) as bag, console.progress() as bar:
        task = bar.add_task("importing", total=None)
        for source in opened:
            try:
                with source:
                    for record in inventory.watch(source):
                        bag.write(record)
                        if inventory.ranges % _STRIDE == 0:
                            bar.update(task, description=f"importing: {inventory.ranges} ranges")
            except DamagedRecordingError as error:  # noqa: PERF203 - once a source
                damage.append(error)
        if inventory.ranges == 0:
            raise (
                damage[0] if damage else RecordingError("no ranges in it", where=", ".join(map(str, sources)))
            )
    for source in opened:
        _show(source, inventory if len(opened) == 1 else None)
    if len(opened) > 1:
        _show_inventory(inventory)
    messages = bag.counts.total()
    console.out.print(f"Wrote {messages} messages to {bag.file}.", markup=False, soft_wrap=True)
    if bag.notice:
        console.err.print(bag.notice, style="yellow", markup=False, soft_wrap=True)
    console.write_json(json, {"messages": messages, "output": str(bag.file), **inventory.as_json()})
    # What was readable is kept; that it is not everything must not pass unnoticed.
    if damage:
        raise damage[0]


@app.command()
def simulate(
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="OUT", help="OUT.mcap for one file, any other name for a bag folder."
        ),
    ],
    like: Annotated[
        Scene,
        typer.Option(
            help="deepuwb: five rooms with obstacles, in DeepUWB's shape and size; survey: placements at rest "
            "in a flat; drive: a robot through that flat."
        ),
    ] = Scene.DEEPUWB,
    seed: Annotated[int, typer.Option(help="The same seed gives the same bag.")] = 1,
    ranges: Annotated[
        int | None,
        typer.Option(
            help="How many; without it, 55158 as DeepUWB has, or 20000 of a survey or drive, less those "
            "that are too weak to be received."
        ),
    ] = None,
    exchanges: Annotated[int, typer.Option(help="For each placement at rest; a drive has none.")] = 20,
    force: Annotated[bool, typer.Option("--force", help="Replace OUT if it exists.")] = False,
    json: JsonOption = None,
) -> None:
    """Simulate ranges with their truth, and write them to an MCAP bag that says it is simulated.

    Try the protocol and the report without hardware or a download:

        uwb-mitigation data simulate --like deepuwb -o sim.mcap

        uwb-mitigation protocol --data sim.mcap -o models

        uwb-mitigation report --data sim.mcap --models models -o report
    """
    from uwb_mitigation.bag.writer import BagWriter
    from uwb_mitigation.sources.inventory import Inventory

    source, total = simulated_source(like, seed, ranges, exchanges)
    inventory = Inventory()
    origin = {"source": source.name, "simulated": "true"}
    with BagWriter(output, origin, force=force) as bag, console.progress() as bar:
        task = bar.add_task("simulating", total=total)
        for record in inventory.watch(source):
            bag.write(record)
            if inventory.ranges % _STRIDE == 0:
                bar.update(task, completed=inventory.ranges)
    _show(source, None)
    lost = ", ".join(f"{count} x {why}" for why, count in inventory.skipped.items())
    console.out.print(
        f"Wrote {inventory.ranges} ranges of {inventory.pair_count} pairs to {bag.file}"
        + (f"; left out: {lost}." if lost else "."),
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    if bag.notice:
        console.err.print(bag.notice, style="yellow", markup=False, soft_wrap=True)
    console.write_json(
        json, {"output": str(bag.file), "seed": seed, "simulated": True, **inventory.as_json()}
    )


def simulated_source(like: Scene, seed: int, ranges: int | None, exchanges: int) -> tuple[Source, int]:
    """The simulator's source, and how many ranges it simulates.

    Raises:
        ParameterError: a number is out of its range.
    """
    from uwb_mitigation.sources import simulated

    if like is Scene.DEEPUWB:
        chosen = {} if ranges is None else {"ranges": ranges}
        rooms = simulated.SimulatedDeepUwb(seed=seed, exchanges=exchanges, **chosen)
        return rooms, sum(rooms.rows)
    ranges = _RANGES if ranges is None else ranges
    if like is Scene.SURVEY:
        if exchanges < 1 or ranges % exchanges:
            raise ParameterError(
                f"{ranges} ranges of {exchanges} exchanges a placement", valid="a multiple of the exchanges"
            )
        placements = ranges // exchanges
        return simulated.SimulatedSurvey(seed=seed, configurations=placements, exchanges=exchanges), ranges
    if ranges < 1:
        raise ParameterError(f"{ranges} ranges", valid="1 or more: a drive has no end of its own")
    return simulated.SimulatedSource(seed=seed, count=ranges), ranges


@app.command()
def info(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="A recording: log, folder or bag.")],
    cir: CirOption = CirChoice.FINAL,
    json: JsonOption = None,
) -> None:
    """Show what a recording holds: pairs, counts, times and oddities."""
    from uwb_mitigation.sources.inventory import Inventory
    from uwb_mitigation.sources.mcap import McapRecording
    from uwb_mitigation.sources.opening import open_recording

    source = open_recording(path, cir=cir.value)
    inventory = Inventory()
    try:
        with source, console.progress() as bar:
            task = bar.add_task("reading", total=None)
            for _ in inventory.watch(source):
                if inventory.ranges % _STRIDE == 0:
                    bar.update(task, description=f"reading: {inventory.ranges} ranges")
    finally:
        # What was readable is shown before an error of the rest.
        if inventory.ranges or inventory.skipped:
            _show(source, inventory)
    messages = source.message_count if isinstance(source, McapRecording) else inventory.ranges
    console.write_json(
        json,
        {
            "messages": messages,
            "source": source.name,
            "simulated": source.simulated,
            **inventory.as_json(),
        },
    )


def _show(source: Source, inventory: Inventory | None) -> None:
    console.out.print(source.name, style="bold", markup=False, soft_wrap=True)
    console.out.print("simulated: no radio was involved" if source.simulated else "measured by radios")
    if inventory is not None:
        _show_inventory(inventory)


def _show_inventory(inventory: Inventory) -> None:
    from rich.table import Table

    console.out.print(
        f"{inventory.ranges} ranges, {inventory.with_truth} with truth, {inventory.pair_count} pairs, "
        f"{inventory.duration_s:.1f} s"
    )
    pairs = Table("anchor", "tag", "label", title="Pairs", title_justify="left")
    for column in ("ranges", "rate (Hz)", "mean range (m)", "mean true (m)"):
        pairs.add_column(column, justify="right")
    for pair in inventory.pairs.values():
        pairs.add_row(
            _identity(pair.anchor_id),
            _identity(pair.tag_id),
            pair.label,
            str(pair.ranges),
            _number(pair.rate_hz, 1),
            _number(pair.mean_m, 3),
            _number(pair.mean_true_m, 3),
        )
    console.out.print(pairs)
    if inventory.skipped:
        oddities = Table("oddity", title="Oddities", title_justify="left")
        oddities.add_column("count", justify="right")
        for kind, count in inventory.skipped.most_common():
            oddities.add_row(kind, str(count))
        console.out.print(oddities)


def _identity(number: int) -> str:
    """Small numbers as they are; long addresses as the radio's tools print them."""
    return str(number) if number < 1 << 16 else f"{number:016x}"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"
