"""`uwb-mitigation calibrate`: model and offsets of a site from a drive past its anchors, without ground truth."""

from __future__ import annotations

import functools
import importlib
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from uwb_mitigation.commands.support import console, options
from uwb_mitigation.commands.support.console import JsonOption, print_line, show_table, warn
from uwb_mitigation.commands.support.options import FileOption, argument, option, output_option
from uwb_mitigation.errors import DatasetError, ParameterError, RecordingError, format_id

if TYPE_CHECKING:
    from uwb_mitigation.calibration.site import SiteCalibration
    from uwb_mitigation.calibration.site_data import SiteData
    from uwb_mitigation.mitigation.model.bundle import Bundle
    from uwb_mitigation.positioning.track_settings import TrackSettings
    from uwb_mitigation.types.anchors import AnchorMap
    from uwb_mitigation.types.tracks import PosePath

MAX_LEVER_ARM_DIFFERENCE_M = 0.01
BASE_FRAME = "base_link"
"""The robot's frame if the poses do not name it."""


@options.with_settings("height", "height_sd", "height_topic", "area", "stamp_offset")
def calibrate(
    bags: Annotated[list[Path], argument("BAG...")],
    output: Annotated[Path, output_option("FILE")],
    settings: TrackSettings,
    anchors: options.AnchorsOption = None,
    truth_topic: Annotated[str | None, option(metavar="TOPIC")] = None,
    frames: Annotated[tuple[str, str] | None, option(metavar="MAP BASE")] = None,
    time_offset: float | None = None,
    lever_arm: Annotated[str | None, option(metavar="X,Y,Z")] = None,
    estimate_lever_arm: bool = False,
    check: Annotated[list[Path] | None, option(metavar="BAG")] = None,
    report: FileOption = None,
    force: bool = False,
    json: JsonOption = None,
) -> None:
    """Calibrate a site from a drive, without surveyed positions.

    Drive a tag past four anchors or more for two minutes, or put tags at a dozen positions. The track and the offsets of
    the radios are estimated jointly, and tested on held-out halves of the drive.

        uwb-mitigation calibrate drive.mcap --anchors anchors.yaml --height 0.4 -o site.onnx

        uwb-mitigation process other.mcap --model site.onnx --offsets site.offsets.yaml -o corrected.mcap

    Options:
        bags: Recordings of drives past the anchors: bags, or other formats that `data import` reads.
        output: Bundle to write; the offsets are written next to it as X.offsets.yaml.
        truth_topic: Topic of the robot's localisation, used as ground truth: nav_msgs/Odometry,
            geometry_msgs/PoseStamped or PoseWithCovarianceStamped, or /tf.
        frames: With --truth-topic /tf: frame of the anchors and frame of the robot.
        time_offset: With --truth-topic: time offset added to the stamps of the ranges, s. Default: estimated.
        lever_arm: With --truth-topic: position of the antenna in the robot's frame, m. Default: the transform in the
            bag to the frame_id of the ranges, otherwise 0.
        estimate_lever_arm: With --truth-topic: estimate the lever arm, starting from the given one. Needs a drive with
            turns.
        check: Recording of another drive at the same site, on which the calibration is only tested; may be repeated.
        report: Also write an HTML page with the results.
        force: Replace existing files, and write a calibration that does not reduce the errors.
    """
    from uwb_mitigation.calibration.site import calibrate_site, offsets_file
    from uwb_mitigation.calibration.solution import Localisation, solve_with_truth, solve_without_truth
    from uwb_mitigation.commands.support.bundles import bundle_for
    from uwb_mitigation.positioning.geometry import parse_lever_arm
    from uwb_mitigation.positioning.track_settings import MAX_STAMP_OFFSET_S
    from uwb_mitigation.recordings.bag.anchor_markers import read_anchors

    options.check_output(output)
    options.check_replaceable((output, offsets_file(output), *([report] if report else [])), force)
    given_arm_m = parse_lever_arm(lever_arm)
    truth_options = frames, time_offset, given_arm_m, estimate_lever_arm or None
    if truth_topic is None and any(option is not None for option in truth_options):
        raise ParameterError(
            "--frames, --time-offset, --lever-arm or --estimate-lever-arm without --truth-topic",
            valid="with --truth-topic",
        )
    if time_offset is not None and not abs(time_offset) <= MAX_STAMP_OFFSET_S:
        raise ParameterError(f"time offset {time_offset}", valid="-3600 to 3600 s")
    if check and truth_topic is not None:
        raise ParameterError("--check with --truth-topic", valid="either of them")
    anchor_map = read_anchors(bags[0], anchors)
    # For CIRs of another radio, a line in the levels is compared with offsets only.
    source = bundle_for(None, bags[0], may_be_experimental=False)
    try:
        gather = functools.partial(_gather, anchors=anchor_map, source=source, settings=settings)
        site, drives = gather(bags), [gather([bag]) for bag in check or []]
        with console.stage_bars() as show_stage:
            show_stage("estimating tracks and offsets", None)
            if truth_topic is not None:
                paths, lever_arms_m = _poses_of_tags(bags, site, truth_topic, frames, given_arm_m)
                localisation = Localisation(truth_topic, paths, time_offset, lever_arms_m, estimate_lever_arm)
                solution = solve_with_truth(site, localisation, height=settings.height)
            else:
                solution = solve_without_truth(
                    site,
                    height=settings.height,
                    area=settings.area,
                    height_sd_m=settings.height_sd_m,
                )
            show_stage("testing on held-out ranges", None)
            calibration = calibrate_site(site, source, solution, check=drives)
    except DatasetError as error:
        # --force does not override this: the anchors, the offsets or the geometry are wrong.
        unknown = dict.fromkeys(("raw_mae_m", "calibrated_mae_m", "live_position_change"))
        refused = {"offsets_m": {}, "truth": truth_topic or "none", "refused": error}
        console.write_json(json, unknown, refused)
        raise
    _show(calibration)
    if calibration.refusal and not force:
        no_gain = DatasetError(
            f"not written: {calibration.summary()}" + "".join(f" {note}." for note in calibration.notes[:1]),
            valid="a longer drive, or --force to write it anyway",
        )
        console.write_json(json, calibration, {"refused": no_gain})
        raise no_gain
    console.write_json(json, calibration, _write(calibration, bags, source, output, report))


def _write(
    calibration: SiteCalibration, bags: list[Path], source: Bundle, output: Path, report: Path | None
) -> dict[str, object]:
    """Write bundle, offsets and page; return their entries in the result."""
    name = ", ".join(bag.resolve().name for bag in bags)
    bundle, offsets_path = calibration.write(output, source, name)
    print_line(f"Wrote {output} (model {bundle.model_id:08x}) and {offsets_path}.")
    if report is not None:
        from uwb_mitigation.files import write_atomically

        # As a reader of a format: only this option needs the drawing code.
        page = importlib.import_module("uwb_mitigation.commands.offline.site_page")
        write_atomically(report, page.site_page(calibration, name, bundle, (str(output), str(offsets_path))))
        print_line(f"Wrote {report}.")
    return {"model_id": bundle.model_id, "offsets_file": offsets_path}


def _gather(bags: list[Path], anchors: AnchorMap, source: Bundle, settings: TrackSettings) -> SiteData:
    from contextlib import ExitStack

    from uwb_mitigation.calibration.site_data import read_site
    from uwb_mitigation.recordings.bag.pose_paths import read_heights
    from uwb_mitigation.recordings.formats import open_recording

    topic, sd_m = settings.height_topic, settings.height_sd_m
    heights = None if topic is None else [read_heights(bag, topic, sd_m) for bag in bags]
    with ExitStack() as stack, console.counting() as counted:
        site = read_site(
            [counted(stack.enter_context(open_recording(bag))) for bag in bags],
            anchors,
            source,
            stamp_offset_s=settings.stamp_offset_s,
            heights=heights,
        )
    if heights is not None and len(site.tags) > 1:
        raise ParameterError(f"--height-topic with {len(site.tags)} tags", valid="bags with one tag")
    console.show_skipped(site.skipped)
    return site


def _poses_of_tags(
    bags: list[Path],
    site: SiteData,
    topic: str,
    frames: tuple[str, str] | None,
    lever_arm_m: tuple[float, float, float] | None,
) -> tuple[dict[int, list[PosePath]], dict[int, tuple[float, float, float]]]:
    """Return {tag id: poses of its body in each bag}, and {tag id: its lever arm}, m, by default from the bags."""
    from uwb_mitigation.recordings.bag.pose_paths import read_bodies
    from uwb_mitigation.types.ros.poses import UWB_TAG, tag_of_frame

    if lever_arm_m is not None and len(site.tags) > 1:
        raise ParameterError(
            f"one --lever-arm for {len(site.tags)} tags",
            valid="transforms to the frames of the tags in the bag",
        )
    bodies = [read_bodies(bag, topic, frames) for bag in bags]
    paths: dict[int, list[PosePath]] = {}
    lever_arms_m: dict[int, tuple[float, float, float]] = {}
    for tag in site.tags:
        names = [
            _body_of_tag(tag.tag_id, paths_of_bag, f"{bag}, topic {topic}")
            for bag, paths_of_bag in zip(bags, bodies, strict=True)
        ]
        paths[tag.tag_id] = [paths_of_bag[name] for name, paths_of_bag in zip(names, bodies, strict=True)]
        if lever_arm_m is not None:
            lever_arms_m[tag.tag_id] = lever_arm_m
        elif tag_of_frame(names[0]) is None and names[0].rpartition("/")[2] != UWB_TAG:
            from_bags = _lever_arm_in(bags, names, site.frame_ids[tag.tag_id])
            lever_arms_m[tag.tag_id] = from_bags or (0.0, 0.0, 0.0)
            if from_bags is None:
                warn(
                    f"tag {format_id(tag.tag_id)}: the bag contains no transform from {names[0] or BASE_FRAME} to the "
                    "antenna; the lever arm is 0. Set --lever-arm"
                )
    return paths, lever_arms_m


def _body_of_tag(tag_id: int, bodies: Iterable[str], where: str) -> str:
    """Return the body of a tag: its own frame in any namespace, otherwise the only body that is not a tag."""
    from uwb_mitigation.types.ros.poses import tag_frame, tag_of_frame

    names = sorted(bodies)
    tag_frames = [name for name in names if tag_of_frame(name) == tag_id]
    # Poses of another tag's own frame are not those of a robot that carries this tag.
    if len(tag_frames) != 1 and not (len(names) == 1 and tag_of_frame(names[0]) is None):
        raise RecordingError(
            f"{'several frames' if tag_frames else 'no frame'} for tag {format_id(tag_id)}: poses of {', '.join(names)}",
            where=where,
            valid=f"--frames MAP CHILD, or poses of {tag_frame(tag_id)}",
        )
    return tag_frames[0] if tag_frames else names[0]


def _lever_arm_in(
    bags: list[Path], bodies: list[str], frames: Iterable[str]
) -> tuple[float, float, float] | None:
    """Return the transform from robot to antenna from the bags that contain it; None if no bag does."""
    from uwb_mitigation.recordings.bag.pose_paths import read_lever_arm

    arms = [
        (bag, read_lever_arm(bag, body or BASE_FRAME, frame))
        for bag, body in zip(bags, bodies, strict=True)
        for frame in frames
    ]
    transforms = [(bag, arm) for bag, arm in arms if arm is not None]
    for bag, arm in transforms[1:]:
        if math.dist(arm, transforms[0][1]) > MAX_LEVER_ARM_DIFFERENCE_M:
            raise RecordingError(
                f"the lever arm differs from that in {transforms[0][0]}",
                where=bag,
                valid="--lever-arm, or bags with the antenna at one position",
            )
    return transforms[0][1] if transforms else None


def _show(calibration: SiteCalibration) -> None:
    from uwb_mitigation.calibration.held_out import RAW

    solution = calibration.solution
    if solution.alignment is not None:
        alignment = solution.alignment
        print_line(f"time offset {alignment.time_offset_s:.3f} +- {alignment.time_offset_sd_s:.3f} s")
        for ranges, lever_arm_m, arm_sd in zip(
            calibration.site.tags, alignment.lever_arm_m, alignment.lever_arm_sd_m, strict=True
        ):
            values = ", ".join(
                f"{value:.3f}" + (f" +- {sd:.3f}" if sd > 0.0 else "")
                for value, sd in zip(lever_arm_m.tolist(), arm_sd.tolist(), strict=True)
            )
            print_line(f"tag {format_id(ranges.tag_id)}: lever arm {values} m")
    rows = [
        (format_id(tag), format_id(anchor), *values) for (tag, anchor), values in calibration.pairs.items()
    ]
    show_table("Offsets", ("tag", "anchor", "offset, m", "standard deviation, m"), rows, left=2)
    halves, *checks = calibration.held_out
    columns = {"range MAE, m": halves.mae_m}
    if solution.truth is not None:
        columns = {"live position RMSE, m": halves.live_rmse_m} | columns
    for number, check in enumerate(checks, 1):
        columns[f"MAE on check {number}, m"] = check.mae_m
    show_table(
        "On held-out halves of the drive",
        ("ranges", *columns, "chosen"),
        [
            (name, *(value(name) for value in columns.values()), "<-" if name == calibration.chosen else "")
            for name in [RAW, *(name for name in halves.residual_m if name != RAW)]
        ],
        calibration.chosen,
    )
    for note in calibration.notes:
        warn(note)
    if solution.outliers:
        warn(f"{solution.outliers} outliers are not included in any result")
    print_line(calibration.summary())
