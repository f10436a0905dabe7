"""`uwb-mitigation track` and `survey`: estimate the positions of a recording's tags and anchors."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from uwb_mitigation.commands.support import console, options
from uwb_mitigation.commands.support.bundles import show_models
from uwb_mitigation.commands.support.console import JsonOption, print_line, show_table, warn
from uwb_mitigation.commands.support.options import (
    FileOption,
    argument,
    check_replaceable,
    option,
    output_option,
)
from uwb_mitigation.errors import ParameterError, check_name, format_id

if TYPE_CHECKING:
    from uwb_mitigation.calibration.survey import SurveyResult
    from uwb_mitigation.commands.offline import track as tracking
    from uwb_mitigation.mitigation.correction import Mitigation
    from uwb_mitigation.positioning.config import EstimatorConfig
    from uwb_mitigation.positioning.recorded_tracks import TagTracks
    from uwb_mitigation.positioning.track_settings import TrackSettings
    from uwb_mitigation.recordings.recorded_ranges import RecordedRanges
    from uwb_mitigation.types.anchors import AnchorMap

TRACK_NAMES = {
    "snapshot": "least squares, raw",
    "raw_live": "live, raw",
    "live": "live, corrected",
    "smoothed": "smoothed, corrected",
}
"""{kind of track: its name in the table}. The two live tracks are from the same filter."""

TRACK_COLUMNS = {
    "track": "name",
    "RMSE, m": "errors.rmse:.3f",
    "95 %, m": "errors.p95:.3f",
    "in ellipse": "errors.coverage95:.0%",
    "NEES": "errors.nees_per_dof:.2f",
    "height, m": "errors.height_rmse:.3f",
    "beyond": "errors.exceeded:.1%",
    "median, m": "errors.median:.3f",
    "epochs": "epochs:d",
}


@options.with_settings()
def track(
    bag: Annotated[Path, argument("BAG")],
    output: Annotated[Path, output_option("OUT")],
    settings: TrackSettings,
    anchors: options.AnchorsOption = None,
    tum: FileOption = None,
    report: FileOption = None,
    png: FileOption = None,
    force: bool = False,
    json: JsonOption = None,
) -> None:
    """Estimate the tracks of a recording's tags: filtered and smoothed.

    It uses the corrected ranges of the bag (`uwb-mitigation process`). If there are none, it corrects the raw ranges. If the
    bag contains the truth, a table shows the errors of both and of least squares on raw ranges. A second table,
    which needs no truth, shows the residuals of raw and corrected ranges. Anchor positions are written to OUT.anchors.yaml.

        uwb-mitigation data import LOS_A1 -o a1.mcap

        uwb-mitigation track a1.mcap -o a1_track.mcap --stamp-offset=-0.2

        uwb-mitigation track drive.mcap -o track.mcap --odometry /odom --imu /imu

    Options:
        bag: An MCAP bag with ranges, corrected or raw.
        output: OUT.mcap for one file, any other name for a folder.
        tum: Also write the smoothed track in TUM's format, as evo reads it.
        report: Also write an HTML page: verdict, map, errors over time.
        png: Also draw a map of the tracks (needs matplotlib).
        force: Replace what exists.
    """
    from uwb_mitigation.commands.offline import track as tracking
    from uwb_mitigation.files import write_atomically
    from uwb_mitigation.positioning.recorded_tracks import track_tags
    from uwb_mitigation.recordings.bag.writer import BagWriter
    from uwb_mitigation.types.anchors import anchors_path, save_anchors

    corrector = tracking.mitigation(settings)
    config, recorded = _read(bag, anchors, settings, corrector)
    if not corrector.used and (settings.model or settings.offsets):
        raise ParameterError("--model or --offsets", where=bag, valid="a bag without corrected ranges")
    show_models(corrector.used)
    several = len(recorded.tags) > 1
    tum_files = {
        tag.tag_id: tracking.tum_file(tum, tag.tag_id, several) for tag in recorded.tags if tum is not None
    }
    check_replaceable((*tum_files.values(), *filter(None, (report, png))), force)
    origin = {"source": f"track of {bag.name}", "simulated": "false"}
    with BagWriter(output, origin, force=force) as out:
        with console.step_bar("tracking tags", len(recorded.tags)) as advance:
            tracks, failures = track_tags(recorded.tags, config, advance)
        tracking.write_tracks(out, tracks)
    for failure in failures:
        warn(f"{failure}.")
    if force or not anchors_path(output).exists():
        save_anchors(anchors_path(output), config.anchors, f"anchors of the track of {bag.name}", force=True)
    _show_tracks(tracks)
    residuals = tracking.held_out(tracks, config)
    _show_residuals(residuals, config.anchors)
    print_line(f"Wrote {out.counts.total()} messages to {out.file}.")
    for tracked in tracks if tum is not None else []:
        write_atomically(tum_files[tracked.recording.tag_id], tracking.tum(tracked.smoothed))
    if report is not None:
        from uwb_mitigation.viewer.report import write_report

        displaced, offset_s = tracking.worst_displaced(residuals), settings.stamp_offset_s
        write_report(report, bag, config, lambda: tracking.mitigation(settings), tracks, displaced, offset_s)
        print_line(f"Wrote {report}.")
    if png is not None:
        from uwb_mitigation.commands.offline.tracks import Tracks

        picture = Tracks(tracks, config.anchors, ()).plot().get_figure(root=True)
        assert picture is not None
        picture.savefig(png, dpi=150, format="png")
        print_line(f"Wrote {png}.")
    console.write_json(json, _result(tracks, recorded), {"held_out": residuals})


@options.with_settings("height", "height_sd", "height_topic", "area", "stamp_offset", "acceleration")
def survey(
    bag: Annotated[Path, argument("BAG")],
    output: Annotated[Path, output_option("FILE")],
    settings: TrackSettings,
    anchors: options.AnchorsOption = None,
    off: float = 1.0,
    fixed: Annotated[list[str] | None, option(metavar="ID")] = None,
    force: bool = False,
    json: JsonOption = None,
) -> None:
    """Estimate anchor positions from rough guesses and a drive past them.

    Drive a loop of a minute or more that passes every anchor on more than one side. The output names anchors that are
    not at the position in the file, and swapped pairs. Translation and rotation of all anchors are unobservable from
    ranges: they come from the guesses, or from anchors that are `--fixed`.

    Options:
        bag: An MCAP bag with ranges, corrected or raw.
        output: The anchors file to write.
        off: Standard deviation of the guesses in FILE, m in each coordinate.
        fixed: An anchor that is where FILE says; may be repeated.
        force: Replace FILE if it exists.
    """
    from uwb_mitigation.calibration.survey import survey_anchors
    from uwb_mitigation.types.anchors import save_anchors

    if not 0.0 < off <= 100.0:
        raise ParameterError(f"off = {off}", valid="more than 0, 100 at most")
    check_replaceable([output], force)
    config, recorded = _read(bag, anchors, settings)
    index = config.anchors.index
    ids = {text: row for identity, row in index.items() for text in (str(identity), format_id(identity))}
    for text in fixed or []:
        valid = f"one of {', '.join(map(format_id, index))}"
        check_name("anchor of --fixed:", text.lower(), ids, valid=valid)
    rows = [ids[text.lower()] for text in fixed or []]
    tag = max(recorded.tags, key=lambda recording: len(recording.ranges))
    with console.step_bar(f"surveying from {len(tag.ranges)} ranges of tag {format_id(tag.tag_id)}"):
        result = survey_anchors(config, tag.ranges, off_m=off, fixed=frozenset(rows))
    save_anchors(
        output, result.anchors, f"surveyed from {bag.name}, tag {format_id(tag.tag_id)}", force=force
    )
    _show_survey(result, has_fixed=len(rows) > 1)
    print_line(f"Wrote {len(index)} anchors to {output}.")
    console.write_json(json, {"output": output}, result)


def _read(
    bag: Path, anchors: Path | None, settings: TrackSettings, mitigation: Mitigation | None = None
) -> tuple[EstimatorConfig, RecordedRanges]:
    from uwb_mitigation.commands.offline import track as tracking
    from uwb_mitigation.positioning.recorded_tracks import check_one_tag
    from uwb_mitigation.recordings.bag.anchor_markers import read_anchors
    from uwb_mitigation.recordings.formats import open_recording
    from uwb_mitigation.recordings.recorded_ranges import read_ranges

    config = tracking.read_config(bag, read_anchors(bag, anchors), settings, warn)
    with console.step_bar("reading"):
        corrected = () if mitigation is None else mitigation.correct_records(open_recording(bag))
        recorded = read_ranges(bag, config.anchors, settings.stamp_offset_s, corrected)
    for text in recorded.warnings:
        warn(text)
    check_one_tag(config, recorded.tags)
    return config, recorded


def _show_tracks(tracks: list[TagTracks]) -> None:
    rows: list[dict[str, object]] = []
    for tag in tracks:
        for kind, name in TRACK_NAMES.items():
            if tag.recording.corrected or kind != "raw_live":
                shown = name if tag.recording.corrected else name.replace("corrected", "raw")
                errors = tag.errors[kind]
                epochs = errors.epochs or len(getattr(tag, kind))
                rows.append({"tag": tag.recording.tag_id, "name": shown, "errors": errors, "epochs": epochs})
    columns = TRACK_COLUMNS if len(tracks) == 1 else {"tag": "tag:id", **TRACK_COLUMNS}
    optional = ["height, m", "beyond", "median, m", "epochs"]
    if any(math.isfinite(error.heading_rmse_deg) for tag in tracks for error in tag.errors.values()):
        columns = columns | {"heading, deg": "errors.heading_rmse_deg:.1f"}
    show_table("Horizontal errors", columns, rows, max_rows=len(rows), optional=optional)
    console.out.print(
        "In ellipse: true positions inside the 95 % ellipses. NEES: 1 is consistent, more is overconfident. Height and "
        "heading: RMSE. Beyond: errors beyond the protection levels.",
        style="dim",
    )
    for tag in tracks:
        name = f"tag {format_id(tag.recording.tag_id)}"
        if not tag.errors["live"].epochs:
            print_line(f"{name}: no truth in the bag, so no errors")
        if tag.determination.is_unique:
            print_line(f"{name}: position {tag.determination}")
        for warning in tag.warnings:
            warn(f"{name}: {warning}.")


def _show_residuals(residuals: list[tracking.HoldoutErrors], anchors: AnchorMap) -> None:
    from uwb_mitigation.calibration.hypotheses import fit_text

    rows: list[dict[str, Any]] = [
        {
            "anchor": "all"
            if residual.anchor_id is None
            else anchors.anchors[anchors.index[residual.anchor_id]],
            "residual": residual,
        }
        for residual in residuals
    ]
    columns = {
        "anchor": "anchor",
        "ranges": "residual.ranges:d",
        "raw, m": "residual.raw_m:.3f",
        "corrected, m": "residual.corrected_m:.3f",
    }
    show_table("Residuals of held-out ranges", columns, rows, max_rows=len(rows))
    console.out.print(
        "Median absolute residuals. The ranges of each anchor are compared with a track of the other anchors' ranges.",
        style="dim",
    )
    accused = [(row["anchor"], row["residual"].fitted) for row in rows if row["residual"].fitted is not None]
    for anchor, fitted in accused:
        warn(
            f"anchor {anchor}: {fit_text(anchor, fitted)}. Check height and lever arm of the tag, and measure the anchor again."
        )
    if len(accused) > 1:
        warn(
            "One cause is enough for several anchors: one wrong position, or a blocked line of sight, also of an anchor that is not named."
        )


def _show_survey(result: SurveyResult, *, has_fixed: bool) -> None:
    anchors = result.anchors.anchors
    rows = [
        {"anchor": anchor, "xyz": dict(zip("xyz", anchor.position, strict=True)), "moved_m": moved_m}
        for anchor, moved_m in zip(anchors, result.moved_m.tolist(), strict=True)
    ]
    columns = {f"{axis}, m": f"xyz.{axis}:.2f" for axis in "xyz"}
    columns = {"anchor": "anchor", **columns, "sd, m": "anchor.sd:.2f", "from guess, m": "moved_m:.2f"}
    show_table("Anchors", columns, rows, max_rows=len(rows))
    if not result.explained:
        warn(
            f"these anchors do not explain the ranges: the mean loss is {result.loss:.1f}, but 0.5 or less if they do. Do "
            "not use them. Start with better guesses, and drive past every anchor on more than one side"
        )
    for row, (x, y, z) in result.alternatives.items():
        warn(
            f"anchor {anchors[row]}: ({x:.2f}, {y:.2f}, {z:.2f}) explains the ranges equally well; only the guess decides. "
            "Drive a route that leaves its line or plane, or measure this anchor"
        )
    if result.undetermined:
        names = ", ".join(str(anchors[row]) for row in result.undetermined)
        warn(
            f"the ranges do not determine the positions of the anchors {names}, only the guesses do. Without --height, "
            "ranges do not determine how the whole is tilted: set --fixed for three measured anchors, or a smaller --off"
        )
    if result.mirrored:
        warn(
            "the mirror image of all anchors fits the guesses about as well, and ranges cannot distinguish the two. "
            "Measure one anchor that is not on the line of the others, and set --fixed"
        )
    for a, b in result.swapped:
        warn(f"anchors {anchors[a]} and {anchors[b]} are swapped in the file")
    for row in set(result.misplaced).difference(*result.swapped):
        warn(f"anchor {anchors[row]} is {result.moved_m[row]:.2f} m from its position in the file")
    if result.misplaced and not has_fixed:
        # In simulated halls with one wrong guess, displacements were up to 16 % too small, and right anchors moved by up to 0.6 m.
        warn(
            "without --fixed, positions are a compromise of all guesses: right anchors move too, and displacements are too small. "
            "Set --fixed for two or more anchors that are right"
        )


def _result(tracks: list[TagTracks], recorded: RecordedRanges) -> dict[str, Any]:
    from uwb_mitigation.positioning.recorded_tracks import KINDS, pooled

    has_truth = any(tag.errors["live"].epochs for tag in tracks)
    hdops = [tag.hdop for tag in tracks if math.isfinite(tag.hdop)]
    overall = {kind: pooled([tag.errors[kind] for tag in tracks]) for kind in KINDS}
    return {
        "tags": tracks,
        **(overall if has_truth else dict.fromkeys(KINDS)),
        "hdop_median": max(hdops) if hdops else None,
        "corrected": all(tag.recording.corrected for tag in tracks),
        "unknown_anchors": recorded.unknown_anchors,
        "skipped": recorded.skipped,
    }
