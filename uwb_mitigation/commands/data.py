"""`uwb-mitigation data`: import recordings into bags, simulate them, and show the contents of a recording."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.console import JsonOption, print_line, show_table
from uwb_mitigation.commands.support.options import Command, argument, option, output_option
from uwb_mitigation.errors import DamagedRecordingError, ParameterError, RecordingError, check_name
from uwb_mitigation.types.stamps import NS_PER_S

if TYPE_CHECKING:
    from uwb_mitigation.recordings.bag.writer import BagWriter
    from uwb_mitigation.recordings.summary import PauseShortener, RecordingSummary
    from uwb_mitigation.types.source import Source
    from uwb_mitigation.types.tracks import Imu, Odometry

app = typer.Typer(help="Import, simulate and show recordings.", no_args_is_help=True)

_LONGEST_PAUSE_S = 5.0

CirName = Literal["final", "poll"]


@app.command("import", cls=Command)
def import_recordings(
    sources: Annotated[list[Path], argument("SRC...")],
    output: Annotated[Path | None, output_option("OUT")] = None,
    mapping: Annotated[str, typer.Option("--map", metavar="FILE")] = "",
    dry_run: bool = False,
    cir: CirName = "final",
    longest_pause: Annotated[float, option(metavar="SECONDS")] = _LONGEST_PAUSE_S,
    force: bool = False,
    json: JsonOption = None,
) -> None:
    """Write recordings into one MCAP bag, with truth where known.

    Options:
        sources: Recordings: logs, folders, bags.
        output: OUT.mcap for one file, any other name for a bag folder.
        mapping: Mapping file for other formats, or a shipped name.
        dry_run: With --map: show how the recording is understood; write nothing.
        cir: Frame of a DecaRanging exchange whose CIR is used.
        longest_pause: Longer pauses are shortened to this; inf: never.
        force: Replace OUT if it exists.
    """
    from uwb_mitigation.commands.support import mapped_report
    from uwb_mitigation.recordings.bag.writer import check_bag_output
    from uwb_mitigation.recordings.formats import open_mapped

    if dry_run and not mapping:
        raise ParameterError("--dry-run needs --map", valid="--map FILE")
    if output is None and not dry_run:
        raise ParameterError("no output", valid="-o OUT, or --dry-run with --map")
    if output is not None and not dry_run:
        # Before a long recording is read.
        check_bag_output(output, force=force)
    opened: Sequence[Source]
    extra: dict[str, Any] = {}
    if mapping:
        opened = mapped = [open_mapped(path, mapping) for path in sources]
        extra = mapped_report.show(mapped, preview=dry_run)
    else:
        opened = [_open(path, cir) for path in sources]
    if output is None or dry_run:
        console.write_json(json, extra)
        return
    # If a tag is known to move, its time continues during a pause.
    in_motion = any(getattr(source, "in_motion", False) for source in opened)
    _write(opened, output, math.inf if in_motion else longest_pause, force, json, extra=extra)


@app.command(cls=Command)
def simulate(
    output: Annotated[Path, output_option("OUT")],
    like: Literal["drive", "buildings"] = "drive",
    seed: int = 1,
    ranges: int = 20_000,
    exchanges: int = 20,
    anchors: int = 4,
    channel: int = 2,
    force: bool = False,
    json: JsonOption = None,
) -> None:
    """Simulate ranges with their truth, and write them to a bag.

    The bag is marked as simulated. A drive also contains `/odom`, `/imu` and `/tf` (odom to base_link) of the robot,
    with a scale error of 2 %, drift and slip. The antenna of the tag is at the origin of base_link.

    Options:
        output: OUT.mcap for one file, any other name for a bag folder.
        like: drive: a robot that drives through a flat; buildings: static placements in random buildings, with different
            boards.
        seed: Seed. Stamps start today at 0:00 UTC.
        ranges: Number of ranges, including those that are too weak to be received.
        exchanges: Exchanges of each static placement (buildings).
        anchors: Number of anchors of a drive, 4 to 8.
        channel: UWB channel: 1 to 5, or 7.
        force: Replace OUT if it exists.
    """
    source = simulated_source(like, seed, ranges, exchanges, anchors, channel)
    write_simulated(source, ranges, seed, output, force, json)


def write_simulated(
    source: Source, total: int, seed: int, output: Path, force: bool, json: Path | None
) -> None:
    """Write a simulated source to a bag; `total` is the number of ranges for the progress bar."""
    from uwb_mitigation.simulation.simulated import SimulatedSource

    # A robot moves on during a pause.
    longest_pause = math.inf if isinstance(source, SimulatedSource) else _LONGEST_PAUSE_S
    _write([source], output, longest_pause, force, json, total, {"seed": seed, "simulated": True})


def _write(
    sources: Sequence[Source],
    output: Path,
    longest_pause: float,
    force: bool,
    json: Path | None,
    total: int | None = None,
    extra: dict[str, Any] | None = None,
) -> None:
    """Write sources into one bag, and show its contents.

    Raises:
        RecordingError: there are no ranges; or a source is damaged, after the bag was written.
    """
    from uwb_mitigation.recordings.bag.writer import BagWriter
    from uwb_mitigation.recordings.summary import PauseShortener, RecordingSummary

    console.exit_on_sigterm()
    summary = RecordingSummary()
    kinds = {source.simulated for source in sources}
    simulated = "true" if True in kinds else "unknown" if None in kinds else "false"
    origin = {"source": "; ".join(source.name for source in sources), "simulated": simulated}
    # Simulated ranges start today.
    start_ns = None if total is None else int(time.time() // 86_400) * 86_400 * NS_PER_S
    pauses = PauseShortener(longest_pause, start_ns)
    with BagWriter(output, origin, force=force) as bag:
        damage = _copy(sources, bag, pauses, summary, total)
        if summary.ranges == 0:
            raise damage or RecordingError("the recording contains no ranges", where=origin["source"])
    result = summary.as_json()
    for source in sources:
        _show_source(source)
    if total is None:
        _show_summary(result)
    if pauses.cut and total is None:
        print_line(
            f"Shortened {pauses.cut} pauses to {pauses.longest_s:g} s, {pauses.cut_s:.0f} s in total; "
            "--longest-pause inf keeps them."
        )
    for shift_s in pauses.shifts_s:
        print_line(f"{shift_s:+.0f} s were added to the stamps of a recording without a date.")
    if len(sources) == 1:
        _save_anchors(sources[0], output)
    messages = bag.counts.total()
    lost = ", ".join(f"{count} x {reason}" for reason, count in summary.skipped.items())
    print_line(
        f"Wrote {messages} messages, {summary.ranges} ranges of {_pairs(result)}, to {bag.file}"
        + (f"; skipped: {lost}." if lost and total is not None else ".")
    )
    console.write_json(json, {"messages": messages, "output": str(bag.file), **result, **(extra or {})})
    if damage:
        raise damage


def _copy(
    sources: Sequence[Source],
    bag: BagWriter,
    pauses: PauseShortener,
    summary: RecordingSummary,
    total: int | None,
) -> DamagedRecordingError | None:
    """Write the records of all sources to a bag; return the first damage."""
    from uwb_mitigation.recordings.bag.odometry import write_robot

    damage: list[DamagedRecordingError] = []
    robot, row = _motion_of(sources[0], pauses.start_ns or 0), 0
    with console.counting("writing", total) as counted:
        for source in sources:
            pauses.is_new_source = True
            try:
                with source:
                    for record in map(pauses.without, counted(summary.watch(source))):
                        if robot is not None:
                            row = write_robot(bag, *robot, row, record.measurement.stamp_ns)
                        bag.write(record)
            except DamagedRecordingError as error:
                damage.append(error)
    return damage[0] if damage else None


def _motion_of(source: Source, start_ns: int) -> tuple[Odometry, Imu | None] | None:
    """Return odometry and IMU data of a simulated drive that starts at `start_ns`, or the odometry of a mapping."""
    from uwb_mitigation.recordings.mapping.mapped import MappedRecording
    from uwb_mitigation.simulation.simulated import SimulatedSource

    if isinstance(source, MappedRecording) and source.motion is not None:
        return source.motion, None
    if not isinstance(source, SimulatedSource):
        return None
    motion = source.motion()
    stamps = motion.odometry.stamp_ns + start_ns
    return replace(motion.odometry, stamp_ns=stamps), replace(motion.imu, stamp_ns=stamps)


def simulated_source(like: str, seed: int, ranges: int, exchanges: int, anchors: int, channel: int) -> Source:
    """Return the simulator's source.

    Raises:
        ParameterError: a number is out of its range.
    """
    from uwb_mitigation.simulation.channel import CHANNELS
    from uwb_mitigation.simulation.simulated import SimulatedBuildings, SimulatedSource

    check_name("channel", channel, CHANNELS)
    if like == "buildings":
        if exchanges < 1 or ranges % exchanges:
            raise ParameterError(
                f"{ranges} ranges of {exchanges} exchanges a placement", valid="a multiple of the exchanges"
            )
        return SimulatedBuildings(seed, ranges // exchanges, exchanges, CHANNELS[channel])
    if ranges < 1:
        raise ParameterError(f"{ranges} ranges", valid="1 or more: a drive is endless")
    return SimulatedSource.with_anchors(anchors, seed=seed, count=ranges, channel=CHANNELS[channel])


def _open(path: Path, cir: CirName) -> Source:
    """Open any recording, including DeepUWB's pickle; raises the errors of `open_recording`."""
    from uwb_mitigation.recordings.formats import open_recording

    if path.suffix == ".pkl":
        from uwb_mitigation.training.data.deepuwb import DeepUwbRecording

        return DeepUwbRecording(path)
    return open_recording(path, cir=cir)


@app.command(cls=Command)
def info(path: Annotated[Path, argument("PATH")], cir: CirName = "final", json: JsonOption = None) -> None:
    """Show the contents of a recording: pairs, counts, warnings.

    Options:
        path: A recording: log, folder or bag.
        cir: Frame of a DecaRanging exchange whose CIR is used.
    """
    from uwb_mitigation.recordings.mcap import McapRecording
    from uwb_mitigation.recordings.summary import RecordingSummary

    source = _open(path, cir)
    summary = RecordingSummary()
    try:
        with source, console.counting() as counted:
            for _ in counted(summary.watch(source)):
                pass
    finally:
        # Show the readable part before an error of the rest is raised.
        result = summary.as_json()
        if summary.ranges or summary.skipped:
            _show_source(source)
            _show_summary(result)
    messages = source.message_count if isinstance(source, McapRecording) else summary.ranges
    about = {"messages": messages, "source": source.name, "simulated": source.simulated}
    console.write_json(json, {**about, **result})


def _save_anchors(source: Source, bag: Path) -> None:
    from uwb_mitigation.types.anchors import anchors_path, save_anchors

    if anchors := getattr(source, "anchors", None):
        path = anchors_path(bag)
        # An existing bag was already refused, unless `--force` is given.
        save_anchors(path, anchors, f"anchors of {source.name}", force=True)
        print_line(f"Wrote {len(anchors)} anchors to {path}.")


_KINDS = {True: "simulated", False: "measured by radios", None: "unknown whether measured or simulated"}


def _show_source(source: Source) -> None:
    console.out.print(source.name, style="bold", markup=False, soft_wrap=True)
    console.out.print(_KINDS[source.simulated])


def _show_summary(result: dict[str, Any]) -> None:
    console.out.print(
        f"{result['ranges']} ranges, {result['with_truth']} with truth, {_pairs(result)}, {result['duration_s']:.1f} s"
    )
    columns = {
        "anchor": "anchor_id:id",
        "tag": "tag_id:id",
        "label": "label",
        "ranges": "ranges:d",
        "rate, Hz": "rate_hz:.1f",
        "range, m": "mean_range_m:.3f",
        "true, m": "mean_true_range_m:.3f",
    }
    rows = sorted(result["by_pair"], key=lambda pair: (pair["anchor_id"], pair["tag_id"], pair["label"]))
    show_table("Pairs, mean ranges", columns, rows, max_rows=len(rows), optional=("true, m", "rate, Hz"))
    if result["skipped"]:
        counts = sorted(result["skipped"].items(), key=lambda item: -item[1])
        show_table("Warnings", ("warning", "count"), counts, max_rows=len(counts))


def _pairs(result: dict[str, Any]) -> str:
    return f"{result['pairs']} pair{'' if result['pairs'] == 1 else 's'}"
