"""`uwb-mitigation offset`: estimate the range offset of two radios (antenna delays) at one known distance."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import asdict
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated

from uwb_mitigation.commands.support import console
from uwb_mitigation.commands.support.bundles import bundle_for
from uwb_mitigation.commands.support.console import JsonOption, print_line, show_table, warn
from uwb_mitigation.commands.support.options import ModelOption, argument, check_output, option, output_option
from uwb_mitigation.errors import ParameterError, parse_id

if TYPE_CHECKING:
    from uwb_mitigation.calibration.radio_offsets import OffsetEstimate

MAX_DISTANCE_M = 1000.0


def offset(
    bag: Annotated[Path, argument("BAG")],
    distance: Annotated[float | None, option(metavar="M")] = None,
    truth: bool = False,
    anchor: Annotated[str | None, option(metavar="ID")] = None,
    tag: Annotated[str | None, option(metavar="ID")] = None,
    model: ModelOption = None,
    output: Annotated[Path | None, output_option("FILE")] = None,
    common: bool = False,
    force: bool = False,
    json: JsonOption = None,
) -> None:
    """Estimate the range offset due to the antenna delays.

    Place tag and anchor at a known distance of two metres or more, without obstacles between or next to them, and
    record some hundred ranges. NLOS ranges are rejected. More placements reduce the uncertainty; more ranges of
    one placement have little effect.

        uwb-mitigation offset los.mcap --distance 5.00 -o offsets.yaml
        ros2 param set /mitigator offsets offsets.yaml

    Options:
        bag: Ranges in line of sight: a bag, or a folder of DecaRanging logs.
        distance: True distance between the antennas, m.
        truth: Instead of --distance: use the true distances in the recording.
        anchor: Only ranges of this anchor.
        tag: Only ranges of this tag.
        output: File to write, for --offsets and the parameter `offsets` of the nodes.
        common: Write one offset, if the same boards were at several positions.
        force: Replace files that exist.
    """
    from uwb_mitigation.calibration import radio_offsets
    from uwb_mitigation.files import write_atomically
    from uwb_mitigation.mitigation.correction import Mitigation
    from uwb_mitigation.recordings.formats import open_recording
    from uwb_mitigation.types.offsets import dump_offsets

    if (distance is None) == (not truth):
        raise ParameterError("no distance, or two sources of it", valid="either --distance or --truth")
    if distance is not None and not 0.0 < distance <= MAX_DISTANCE_M:
        raise ParameterError(f"distance = {distance}", valid=f"above 0, at most {MAX_DISTANCE_M:g} m")
    if output is not None:
        check_output(output, force, suffix="")
    anchor_id, tag_id = (
        _id(name, text) if text is not None else None for name, text in (("anchor", anchor), ("tag", tag))
    )
    mitigation = Mitigation(bundle_for(model, bag))
    with open_recording(bag) as source, console.counting() as counted:
        estimate = radio_offsets.estimate_offset(
            mitigation, counted(source), distance, tag_id=tag_id, anchor_id=anchor_id
        )
    _show(estimate)
    if output is not None:
        comment = (
            f"Antenna delays, m, for model {estimate.model_id:08x}, estimated by uwb-mitigation offset in {bag.name}.\n"
            f"Standard deviation {estimate.sd_m:.3f} m."
        )
        write_atomically(output, dump_offsets(estimate.offsets(common=common), comment), ParameterError)
    console.write_json(json, estimate)


def _id(name: str, text: str) -> int:
    try:
        return parse_id(text)
    except ValueError as error:
        raise ParameterError(
            f"{name} = {text!r}", valid="an id, such as 3 or 0x1f; more than 65535: hexadecimal"
        ) from error


def _show(estimate: OffsetEstimate) -> None:
    accepted = [
        {**asdict(placement), "placement": PurePath(placement.placement).name}
        for placement in estimate.placements
        if not placement.refused
    ]
    columns = {
        "anchor": "anchor_id:id",
        "tag": "tag_id:id",
        "placement": "placement",
        "ranges": "ranges:d",
        "offset, m": "offset_m:.3f",
        "sd, m": "sd_m:.3f",
        "power gap, dB": "power_gap_db:.1f",
        "first path, dBm": "first_path_dbm:.1f",
        "predicted, m": "predicted_m:.3f",
    }
    show_table("", columns, accepted, optional=("predicted, m", "first path, dBm", "power gap, dB"))
    rejected = Counter(placement.refused.partition(":")[0] for placement in estimate.placements)
    for reason, count in rejected.items():
        if reason:
            warn(f"skipped: {count} placements: {reason} (each one: --json)")
    unchecked = sum(math.isnan(row["power_gap_db"]) for row in accepted)
    if unchecked:
        warn(f"{unchecked} placements: the radio reports no levels, so line of sight was not checked")
    print_line(
        f"offset {estimate.offset_m:.3f} m, standard deviation {estimate.sd_m:.3f} m, from {estimate.ranges} ranges, "
        f"for model {estimate.model_id:08x}"
    )
