"""`uwb-mitigation data`: bring recordings into bags or simulate them, and show what a recording holds."""

from __future__ import annotations

import enum
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.errors import DamagedRecordingError, ParameterError, RecordingError, format_id

if TYPE_CHECKING:
    from uwb_mitigation.sources.inventory import Inventory
    from uwb_mitigation.sources.pauses import Pauses
    from uwb_mitigation.sources.source import Source

app = typer.Typer(help="Bring recordings into bags, simulate them, look at them.", no_args_is_help=True)

_STRIDE = 100
"""Ranges between two updates of a progress bar."""


class CirChoice(str, enum.Enum):
    """Which frame of a DecaRanging exchange gives the CIR."""

    FINAL = "final"
    POLL = "poll"


class Like(str, enum.Enum):
    """What is simulated."""

    DRIVE = "drive"
    SURVEY = "survey"
    BUILDINGS = "buildings"


LongestPauseOption = Annotated[
    float,
    typer.Option(
        metavar="SECONDS", help="Pauses are cut to this, so that the bag can be played; inf cuts none."
    ),
]
_LONGEST_PAUSE_S = 5.0

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
    longest_pause: LongestPauseOption = _LONGEST_PAUSE_S,
    force: Annotated[bool, typer.Option("--force", help="Replace OUT if it exists.")] = False,
    json: JsonOption = None,
) -> None:
    """Write recordings into one MCAP bag, with truth where known."""
    from uwb_mitigation.bag.writer import BagWriter
    from uwb_mitigation.sources.inventory import Inventory
    from uwb_mitigation.sources.pauses import Pauses

    opened = [_opened(path, cir) for path in sources]
    inventory = Inventory()
    origin = {
        "source": "; ".join(source.name for source in opened),
        "simulated": _simulated(opened),
    }
    # A tag that is known to move goes on through a pause: its time is not to be cut.
    in_motion = any(getattr(source, "in_motion", False) for source in opened)
    pauses = Pauses(math.inf if in_motion else longest_pause, _today_ns())
    damage: list[DamagedRecordingError] = []
    with BagWriter(output, origin, force=force) as bag, console.progress() as bar:
        task = bar.add_task("importing", total=None)
        for source in opened:
            try:
                with source:
                    for record in inventory.watch(source):
                        bag.write(pauses.without(record))
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
    if len(opened) == 1:
        _save_anchors(opened[0], output)
    if len(opened) > 1:
        _show_inventory(inventory)
    messages = bag.counts.total()
    _show_pauses(pauses)
    console.out.print(f"Wrote {messages} messages to {bag.file}.", markup=False, soft_wrap=True)
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
        Like,
        typer.Option(
            help="drive: a robot that drives through a flat; survey: static placements in that flat; buildings: placements "
            "in random buildings, with different boards. `paper simulate`: DeepUWB's rooms."
        ),
    ] = Like.DRIVE,
    seed: Annotated[
        int, typer.Option(help="The same seed gives the same ranges, from today 0:00 UTC on.")
    ] = 1,
    ranges: Annotated[
        int, typer.Option(help="Number of ranges, including those that are too weak to be received.")
    ] = 20_000,
    exchanges: Annotated[int, typer.Option(help="For each placement at rest; a drive has none.")] = 20,
    anchors: Annotated[int, typer.Option(help="That a drive goes past, 4 to 8.")] = 4,
    longest_pause: LongestPauseOption = _LONGEST_PAUSE_S,
    force: Annotated[bool, typer.Option("--force", help="Replace OUT if it exists.")] = False,
    json: JsonOption = None,
) -> None:
    """Simulate ranges with their truth, and write them to a bag.

    The bag is marked as simulated.
    """
    source = simulated_source(like, seed, ranges, exchanges, anchors)
    write_simulated(source, ranges, seed, output, longest_pause, force, json)


def write_simulated(
    source: Source, total: int, seed: int, output: Path, longest_pause: float, force: bool, json: Path | None
) -> None:
    """Write a simulated source to a bag; `total` is the number of ranges for the progress bar."""
    from uwb_mitigation.bag.writer import BagWriter
    from uwb_mitigation.sources.inventory import Inventory
    from uwb_mitigation.sources.pauses import Pauses

    inventory = Inventory()
    origin = {"source": source.name, "simulated": "true"}
    pauses = Pauses(longest_pause, _today_ns())
    with BagWriter(output, origin, force=force) as bag, console.progress() as bar:
        task = bar.add_task("simulating", total=total)
        for record in inventory.watch(source):
            bag.write(pauses.without(record))
            if inventory.ranges % _STRIDE == 0:
                bar.update(task, completed=inventory.ranges)
    _show(source, None)
    _show_pauses(pauses)
    _save_anchors(source, output)
    lost = ", ".join(f"{count} x {why}" for why, count in inventory.skipped.items())
    console.out.print(
        f"Wrote {inventory.ranges} ranges of {_pairs(inventory)} to {bag.file}"
        + (f"; left out: {lost}." if lost else "."),
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    console.write_json(
        json, {"output": str(bag.file), "seed": seed, "simulated": True, **inventory.as_json()}
    )


def simulated_source(like: Like, seed: int, ranges: int, exchanges: int, anchors: int = 4) -> Source:
    """Return the simulator's source.

    Raises:
        ParameterError: a number is out of its range.
    """
    from uwb_mitigation.sources import simulated
    from uwb_mitigation.sources.simulated_buildings import SimulatedBuildings

    if like in (Like.SURVEY, Like.BUILDINGS):
        if exchanges < 1 or ranges % exchanges:
            raise ParameterError(
                f"{ranges} ranges of {exchanges} exchanges a placement", valid="a multiple of the exchanges"
            )
        placements = ranges // exchanges
        if like is Like.BUILDINGS:
            return SimulatedBuildings(seed=seed, placements=placements, exchanges=exchanges)
        return simulated.SimulatedSurvey(seed=seed, configurations=placements, exchanges=exchanges)
    if ranges < 1:
        raise ParameterError(f"{ranges} ranges", valid="1 or more: a drive has no end of its own")
    return simulated.SimulatedSource.with_anchors(anchors, seed=seed, count=ranges)


def _opened(path: Path, cir: CirChoice) -> Source:
    """Open any recording, DeepUWB's pickle included; raises as `open_recording`."""
    from uwb_mitigation.sources.opening import open_recording

    if path.suffix == ".pkl":
        from uwb_mitigation.paper.deepuwb import DeepUwbRecording

        return DeepUwbRecording(path)
    return open_recording(path, cir=cir.value)


@app.command()
def info(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="A recording: log, folder or bag.")],
    cir: CirOption = CirChoice.FINAL,
    json: JsonOption = None,
) -> None:
    """Show what a recording holds: pairs, counts, oddities."""
    from uwb_mitigation.sources.inventory import Inventory
    from uwb_mitigation.sources.mcap import McapRecording

    source = _opened(path, cir)
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


def _save_anchors(source: Source, bag: Path) -> None:
    from uwb_mitigation.sources.site import KnowsAnchors, anchors_file, save_anchors

    if isinstance(source, KnowsAnchors):
        path = anchors_file(bag)
        # The bag itself was refused, or `--force` given, before.
        save_anchors(path, source.anchors, f"anchors of {source.name}", force=True)
        console.out.print(f"Wrote {len(source.anchors)} anchors to {path}.", markup=False, soft_wrap=True)


def _show(source: Source, inventory: Inventory | None) -> None:
    console.out.print(source.name, style="bold", markup=False, soft_wrap=True)
    told = {
        True: "simulated: no radio was involved",
        False: "measured by radios",
        None: "unknown whether radios measured it or a simulator made it",
    }
    console.out.print(told[source.simulated])
    if inventory is not None:
        _show_inventory(inventory)


def _simulated(sources: list[Source]) -> str:
    """Of all together, as a bag's metadata says it."""
    kinds = {source.simulated for source in sources}
    return "true" if True in kinds else "unknown" if None in kinds else "false"


def _show_pauses(pauses: Pauses) -> None:
    if pauses.cut:
        console.out.print(
            f"Cut {pauses.cut} pauses to {pauses.longest_s:g} s each, {pauses.cut_s:.0f} s in all; "
            "--longest-pause inf keeps them.",
            highlight=False,
            soft_wrap=True,
        )


def _today_ns() -> int:
    """Today at 0:00 UTC, where recordings begin that bear no date."""
    return int(time.time() // 86_400) * 86_400 * 10**9


def _show_inventory(inventory: Inventory) -> None:
    from uwb_mitigation.commands.console import Table

    console.out.print(
        f"{inventory.ranges} ranges, {inventory.with_truth} with truth, "
        f"{_pairs(inventory)}, {inventory.duration_s:.1f} s"
    )
    pairs = Table("anchor", "tag", "label", title="Pairs", title_justify="left")
    for column in ("ranges", "rate (Hz)", "mean range (m)", "mean true (m)"):
        pairs.add_column(column, justify="right")
    for pair in inventory.pairs.values():
        pairs.add_row(
            format_id(pair.anchor_id),
            format_id(pair.tag_id),
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


def _pairs(inventory: Inventory) -> str:
    return f"{inventory.pair_count} pair{'' if inventory.pair_count == 1 else 's'}"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"
