"""`uwb-mitigation calibrate`: a site's model and offsets from a drive past its anchors, without a survey."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwb_mitigation.commands import console
from uwb_mitigation.commands.checks import check_output
from uwb_mitigation.commands.console import JsonOption
from uwb_mitigation.commands.positioning import (
    AreaOption,
    HeightOption,
    HeightSdOption,
    OffsetOption,
    area_of,
    height_of,
)
from uwb_mitigation.errors import DatasetError, ParameterError, RecordingError, format_id

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from uwb_mitigation.evaluation.site_data import SiteData
    from uwb_mitigation.model.bundle import Bundle
    from uwb_mitigation.positioning.anchors import AnchorMap
    from uwb_mitigation.positioning.localised import PosePath
    from uwb_mitigation.training.calibrated import Calibrated

MOST_SHOWN = 40
BASE_FRAME = "base_link"
"""The robot's frame if the poses do not name it."""


def calibrate(
    bags: Annotated[
        list[Path],
        typer.Argument(metavar="BAG...", help="Drives past the anchors: bags, or what `data import` reads."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="Bundle to write; its offsets go beside it, X.offsets.yaml.",
        ),
    ],
    anchors: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Where the anchors are; without it, the first BAG's own X.anchors.yaml."
        ),
    ] = None,
    height: HeightOption = None,
    height_sd: HeightSdOption = 0.1,
    area: AreaOption = None,
    truth_topic: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC",
            help="Take the truth from the robot's localisation: nav_msgs/Odometry, geometry_msgs/PoseStamped or "
            "PoseWithCovarianceStamped, or /tf.",
        ),
    ] = None,
    frames: Annotated[
        tuple[str, str] | None,
        typer.Option(metavar="MAP BASE", help="With --truth-topic /tf: the anchors' frame, and the robot's."),
    ] = None,
    time_offset: Annotated[
        float | None,
        typer.Option(
            help="With --truth-topic: what to add to ranges' stamps, s; without it, it is estimated."
        ),
    ] = None,
    lever_arm: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="With --truth-topic: position of the antenna in the robot's frame, m. Default: the transform in the bag "
            "to the frame_id of the ranges, otherwise 0.",
        ),
    ] = None,
    estimate_lever_arm: Annotated[
        bool,
        typer.Option(
            "--estimate-lever-arm",
            help="With --truth-topic: estimate the lever arm, starting from that value. Needs a drive with turns.",
        ),
    ] = False,
    height_topic: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC",
            help="Measured height of the tag, in place of --height: sensor_msgs/Range, nav_msgs/Odometry or "
            "geometry_msgs/PoseWithCovarianceStamped.",
        ),
    ] = None,
    stamp_offset: OffsetOption = 0.0,
    report: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write a page that shows what was found: FILE.html."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of what is held out, and of a network that is tuned.")] = 0,
    force: Annotated[
        bool, typer.Option("--force", help="Replace what exists, and write even what makes ranges worse.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Calibrate a site from a drive, without surveyed places.

    Drive a tag past four anchors or more for two minutes, or put tags at a dozen places. Track, offsets of the
    radios, and a model of what the walls do are found together, and tested on parts of the drive that were held out.

        uwb-mitigation calibrate drive.mcap --anchors anchors.yaml --height 0.4 -o site.onnx

        uwb-mitigation process other.mcap --model site.onnx --offsets site.offsets.yaml -o corrected.mcap
    """
    from uwb_mitigation.commands.bundles import bundle_for
    from uwb_mitigation.sources.site import anchors_file, load_anchors
    from uwb_mitigation.training import calibrated, calibrating

    check_output(output)
    beside = calibrated.offsets_file(output)
    for file in (output, beside, *([report] if report else [])):
        if file.exists() and not force:
            raise ParameterError("exists already", where=str(file), valid="--force replaces it")
    with_poses = (frames, time_offset, lever_arm, estimate_lever_arm or None)
    if truth_topic is None and any(option is not None for option in with_poses):
        raise ParameterError(
            "--frames, --time-offset, --lever-arm and --estimate-lever-arm", valid="with --truth-topic"
        )
    if height is not None and height_topic is not None:
        raise ParameterError("--height and --height-topic", valid="one of them")
    if not abs(stamp_offset) <= 3600.0:
        raise ParameterError(f"stamp offset {stamp_offset}", valid="-3600 to 3600 s")
    place, box, arm = height_of(height, height_sd), area_of(area), _lever_arm(lever_arm)
    if time_offset is not None and not abs(time_offset) <= 3600.0:
        raise ParameterError(f"time offset {time_offset}", valid="-3600 to 3600 s")
    known = load_anchors(anchors or anchors_file(bags[0]))
    source = bundle_for(None, bags[0])
    try:
        site = _gather(bags, known, source, stamp_offset, height_topic)
        if height_topic is not None and len(site.tags) > 1:
            raise ParameterError(f"--height-topic with {len(site.tags)} tags", valid="bags with one tag")
        for why, count in site.left_out.items():
            _warn(f"left out: {count} x {why}")
        with console.stage_bars() as on_progress:
            if truth_topic is None:
                found = calibrating.without_truth(
                    site, source, height=place, area=box, seed=seed, on_progress=on_progress
                )
            else:
                paths, arms = _poses(bags, site, truth_topic, frames, arm)
                found = calibrating.with_truth(
                    site,
                    source,
                    paths,
                    truth_topic,
                    time_offset_s=time_offset,
                    lever_arms_m=arms,
                    estimate_lever_arm=estimate_lever_arm,
                    seed=seed,
                    on_progress=on_progress,
                )
    except DatasetError as error:
        console.write_json(json, _refused(str(error), truth_topic))
        raise
    _show(found)
    if found.harms and not force:
        harm = DatasetError(
            f"not written: held-out ranges err by {found.calibrated_mae_m:.3f} m after calibration, by "
            f"{found.raw_mae_m:.3f} m before; positions scatter by {found.position_scatter_m[1]:.3f} m and "
            f"{found.position_scatter_m[0]:.3f} m" + "".join(f"; {note}" for note in found.notes[:1]),
            valid="a longer drive, or --force",
        )
        console.write_json(json, found.as_json() | {"refused": str(harm)})
        raise harm
    name = ", ".join(bag.resolve().name for bag in bags)
    if report is not None:
        _write_report(report, found, name)
    bundle, beside = calibrated.write(output, found, source, name)
    console.out.print(
        f"Wrote {output} (model {bundle.model_id:08x}) and {beside}.", markup=False, soft_wrap=True
    )
    console.write_json(json, found.as_json() | {"model_id": bundle.model_id, "offsets_file": str(beside)})


def _gather(
    bags: list[Path], anchors: AnchorMap, source: Bundle, stamp_offset: float, height_topic: str | None
) -> SiteData:
    from contextlib import ExitStack

    from uwb_mitigation.bag.pose_paths import read_heights
    from uwb_mitigation.evaluation.site_data import gather
    from uwb_mitigation.sources.opening import open_recording

    heights = None if height_topic is None else [read_heights(bag, height_topic) for bag in bags]
    with ExitStack() as stack, console.reading() as on_record:
        recordings = [stack.enter_context(open_recording(bag)) for bag in bags]
        return gather(
            recordings,
            anchors,
            source.preprocessing,
            on_record,
            stamp_offset_s=stamp_offset,
            heights=heights,
        )


def _poses(
    bags: list[Path],
    site: SiteData,
    topic: str,
    frames: tuple[str, str] | None,
    arm: tuple[float, float, float] | None,
) -> tuple[list[list[PosePath]], NDArray[np.float64]]:
    """The poses of the body that carries each tag, for each bag; and the lever arms (T, 3)."""
    import numpy as np

    from uwb_mitigation.bag.pose_paths import read_bodies, read_lever_arm
    from uwb_mitigation.bag.poses import UWB_TAG, tag_frame, tag_of_frame

    if arm is not None and len(site.tags) > 1:
        raise ParameterError(
            f"one --lever-arm for {len(site.tags)} tags",
            valid="transforms to the frames of the tags in the bag",
        )
    bodies = [read_bodies(bag, topic, frames) for bag in bags]
    paths, arms = [], np.zeros((len(site.tags), 3))
    for number, tag in enumerate(site.tags):
        own, body = [], ""
        for bag, known in zip(bags, bodies, strict=True):
            body = tag_frame(tag.tag_id)
            if body not in known:
                # Poses of another tag's own frame are no poses of a robot that carries this tag.
                others = list(known)
                if len(others) != 1 or tag_of_frame(others[0]) is not None:
                    raise RecordingError(
                        f"no body for tag {format_id(tag.tag_id)}: poses of {', '.join(sorted(known))}",
                        where=f"{bag}, topic {topic}",
                        valid=f"--frames MAP CHILD, or poses of {body}",
                    )
                body = others[0]
            own.append(known[body])
        paths.append(own)
        if arm is not None:
            arms[number] = arm
        elif body not in (tag_frame(tag.tag_id), UWB_TAG):
            found = [read_lever_arm(bags[0], body or BASE_FRAME, frame) for frame in site.frames[tag.tag_id]]
            known_arms = [one for one in found if one is not None]
            if known_arms:
                arms[number] = known_arms[0]
            else:
                _warn(
                    f"tag {format_id(tag.tag_id)}: no transform from {body or BASE_FRAME} to its antenna in the bag, so that the lever "
                    "arm is 0; set --lever-arm"
                )
    return paths, arms


def _refused(why: str, truth: str | None) -> dict[str, object]:
    return {
        "offsets_m": {},
        "raw_mae_m": None,
        "calibrated_mae_m": None,
        "truth": truth or "none",
        "refused": why,
    }


def _lever_arm(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError as error:
        raise ParameterError(f"lever arm {text!r}", valid="three numbers: X,Y,Z") from error
    if not all(math.isfinite(value) and abs(value) <= 100.0 for value in (x, y, z)):
        raise ParameterError(f"lever arm {text!r}", valid="-100 to 100 m each")
    return x, y, z


def _show(found: Calibrated) -> None:
    from uwb_mitigation.commands.console import Table

    if found.localised is not None:
        one = found.localised
        console.out.print(
            f"time offset {one.time_offset_s:.3f} +- {one.time_offset_sd_s:.3f} s", highlight=False
        )
        for ranges, arm, arm_sd in zip(found.site.tags, one.lever_arm_m, one.lever_arm_sd_m, strict=True):
            known = ", ".join(
                f"{value:.3f}" + ("" if sd == 0.0 or math.isnan(sd) else f" +- {sd:.3f}")
                for value, sd in zip(arm.tolist(), arm_sd.tolist(), strict=True)
            )
            console.out.print(f"tag {format_id(ranges.tag_id)}: lever arm {known} m", highlight=False)
    table = Table("tag", "anchor", "offset m", "deviation m", title="Offsets", title_justify="left")
    for column in table.columns[2:]:
        column.justify = "right"
    for (tag, anchor), (value, sd) in list(found.pair_m.items())[:MOST_SHOWN]:
        table.add_row(str(tag), str(anchor), f"{value:.3f}", f"{sd:.3f}")
    console.out.print(table)
    if len(found.pair_m) > MOST_SHOWN:
        console.out.print(f"and {len(found.pair_m) - MOST_SHOWN} pairs more")
    table = Table("model", "MAE m", title="On stretches and anchors held out", title_justify="left")
    table.columns[1].justify = "right"
    table.add_row("raw", f"{found.raw_mae_m:.3f}")
    for name, mae in found.choice.mae().items():
        chosen = name == found.choice.chosen
        table.add_row(name + (" (chosen)" if chosen else ""), f"{mae:.3f}", style="bold" if chosen else None)
    console.out.print(table)
    for note in found.notes:
        _warn(note)
    if found.outliers:
        _warn(f"{found.outliers} outliers left out of all figures")
    console.out.print(found.sentence(), markup=False, highlight=False, soft_wrap=True)


def _write_report(path: Path, found: Calibrated, name: str) -> None:
    from uwb_mitigation.evaluation.site_page import site_page
    from uwb_mitigation.files import write_whole
    from uwb_mitigation.training.calibrated import shown

    write_whole(path, site_page(shown(found, name)))
    console.out.print(f"Wrote {path}.", markup=False, soft_wrap=True)


def _warn(text: str) -> None:
    console.err.print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)
