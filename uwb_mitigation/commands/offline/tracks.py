"""The Python interface of `track`: the tracks of a whole recording, as arrays, data frame, TUM file and plot."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from uwb_mitigation.commands.offline.track import read_config, tum, tum_file
from uwb_mitigation.errors import ParameterError, check_name, format_id
from uwb_mitigation.files import write_all_atomically
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import Bundle
from uwb_mitigation.mitigation.model.shipped import load_model
from uwb_mitigation.positioning.geometry import Area
from uwb_mitigation.positioning.noise_model import NoiseModel
from uwb_mitigation.positioning.recorded_tracks import KINDS, TagTracks, check_one_tag, track_tags
from uwb_mitigation.positioning.track_settings import TrackSettings
from uwb_mitigation.recordings.bag.anchor_markers import recorded_anchors
from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.recordings.mcap import McapRecording
from uwb_mitigation.recordings.recorded_ranges import RangeTable, RecordedRanges, read_ranges
from uwb_mitigation.types.anchors import AnchorMap, AnyAnchors, anchors_path, as_anchors
from uwb_mitigation.types.measurement import CorrectedRange, Record
from uwb_mitigation.types.offsets import NO_OFFSETS, AnyOffsets
from uwb_mitigation.types.ros.codec import measurement_key
from uwb_mitigation.types.tracks import TruePath

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

_STYLES: dict[str, dict[str, Any]] = {
    "snapshot": {"color": "#b87f00", "linestyle": "none", "marker": "+", "markersize": 3},
    "raw_live": {"color": "#d55e00", "linewidth": 1},
    "smoothed": {"color": "#0072b2", "linewidth": 2},
}
"""Tracks that `Tracks.plot` shows, in the colours of Okabe and Ito."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Tracks of the tags of a recording; `tracks[0]` is that of the tag with the smallest id, `len(tracks)` their number.

    A tag has four kinds of tracks: `smoothed` (ten positions per second, from all ranges), `live` (a position for each range,
    from the ranges before), `raw_live` (the same filter on raw ranges) and `snapshot` (least squares on raw ranges). Their
    arrays have the names of evo: `timestamps`, `positions_xyz`, `orientations_quat_wxyz`, and in addition `velocity` and
    `covariance`. `errors["smoothed"].rmse` and the other errors are NaN if the true positions are unknown.

    Attributes:
        tags: tracks of each tag.
        anchors: positions of the anchors.
        warnings: ranges that were left out, and reasons why tracks may be unreliable; empty: none.
    """

    tags: Sequence[TagTracks]
    anchors: AnchorMap
    warnings: Sequence[str]

    def __repr__(self) -> str:
        tags = (f"{format_id(tag.recording.tag_id)}: {len(tag.smoothed)} positions" for tag in self.tags)
        return f"Tracks({', '.join(tags)})"

    def __len__(self) -> int:
        return len(self.tags)

    def __iter__(self) -> Iterator[TagTracks]:
        return iter(self.tags)

    def __getitem__(self, index: int) -> TagTracks:
        return self.tags[index]

    def to_dataframe(self, kind: str = "smoothed") -> pd.DataFrame:
        """Return the positions of all tags, one in each row.

        Args:
            kind: `smoothed`, `live`, `raw_live` or `snapshot`.

        Returns:
            `stamp` (UTC), `tag_id`, position `x`, `y`, `z` (m), velocity `vx`, `vy`, `vz` (m/s), standard deviations `sd_x`,
            `sd_y`, `sd_z` (m), `yaw` (rad), and the horizontal error `error_m`. NaN: unknown.

        Raises:
            ParameterError: another kind.
            ImportError: pandas is not installed.
        """
        import pandas as pd

        check_name("kind of track", kind, KINDS)
        tables = []
        for tag in self.tags:
            track = getattr(tag, kind)
            error = track.position - tag.recording.truth.position_at(track.stamp_ns)
            variance = np.diagonal(track.covariance, axis1=1, axis2=2)[:, :3]
            columns: dict[str, Any] = {"stamp": pd.to_datetime(track.stamp_ns, utc=True)}
            columns["tag_id"] = np.full(len(track), tag.recording.tag_id, np.uint64)
            for names, values in (
                (("x", "y", "z"), track.position),
                (("vx", "vy", "vz"), track.velocity),
                (("sd_x", "sd_y", "sd_z"), np.sqrt(variance)),
            ):
                columns |= dict(zip(names, values.T, strict=True))
            tables.append(
                pd.DataFrame(
                    columns | {"yaw": track.yaw[:, 0], "error_m": np.hypot(error[:, 0], error[:, 1])}
                )
            )
        return pd.concat(tables, ignore_index=True)

    def write_tum(self, path: Path | str, kind: str = "smoothed") -> list[Path]:
        """Write the tracks in TUM's format, as evo reads it; return the files: one for each tag, with its id in the name.

        Raises:
            ParameterError: another kind, or a file cannot be written.
        """
        check_name("kind of track", kind, KINDS)
        files = {
            tum_file(Path(path), tag.recording.tag_id, len(self) > 1): tum(getattr(tag, kind))
            for tag in self.tags
        }
        write_all_atomically(files, ParameterError)
        return list(files)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Plot a map of anchors, true paths and tracks, with the RMSE if the truth is known; return the axes.

        Args:
            ax: axes of matplotlib; None: new ones.

        Raises:
            ImportError: matplotlib is not installed.
        """
        import matplotlib.pyplot as plt

        if ax is None:
            _, ax = plt.subplots(layout="constrained")
        for tag in self.tags:
            name = f"tag {format_id(tag.recording.tag_id)}, " if len(self) > 1 else ""
            for kind, style in _STYLES.items():
                if kind == "raw_live" and not tag.recording.corrected:
                    continue
                errors, position = tag.errors[kind], getattr(tag, kind).position
                rmse = f" (RMSE {errors.rmse:.2f} m)" if errors.epochs else ""
                ax.plot(*position.T[:2], label=f"{name}{kind}{rmse}", **style)
            if len(truth := tag.recording.truth):
                ax.plot(
                    *truth.position.T[:2], color="black", linestyle="--", linewidth=1, label=f"{name}truth"
                )
        ax.plot(*self.anchors.position.T[:2], "^", color="black", markersize=9, label="anchors")
        for anchor in self.anchors.anchors:
            ax.annotate(str(anchor), anchor.position[:2], (4, 4), textcoords="offset points")
        ax.set(aspect="equal", xlabel="x, m", ylabel="y, m")
        ax.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        return ax


def track(
    recording: str | Path | Iterable[Record],
    anchors: AnyAnchors | None = None,
    *,
    model: Bundle | Sequence[Bundle] | None = None,
    offsets: AnyOffsets = NO_OFFSETS,
    mapping: str = "",
    height_m: float | None = None,
    height_sd_m: float = 0.1,
    area: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None,
    acceleration: float = NoiseModel().acceleration,
    stamp_offset_s: float = 0.0,
    odometry: str | None = None,
    imu: str | None = None,
    lever_arm_m: tuple[float, float, float] | None = None,
) -> Tracks:
    """Estimate the tracks of a recording's tags, as `uwb-mitigation track` does.

    Args:
        recording: path of a recording, or its records. The corrected ranges of a bag are used; others are corrected.
        anchors: positions: a map, {id: (x, y, z)} in m, or the path of a file; None: those of the recording.
        model: corrects ranges; None: `load_model()`.
        offsets: offsets of the radios, see `Mitigation`.
        mapping: see `open_recording`.
        height_m: height of the tags' antennas in the anchors' frame, if it is constant; None: estimate it.
        height_sd_m: standard deviation of this height.
        area: (lower corner, upper corner) of the box that contains the tags, x, y, z in m; None: unknown.
        acceleration: agility of the tags: square root of the spectral density of the acceleration, m/s^1.5.
        stamp_offset_s: added to the stamps of the ranges.
        odometry: topic of the odometry of the robot with the tag, in the bag: also estimate its heading.
        imu: with `odometry`: topic of its IMU.
        lever_arm_m: with `odometry`: the antenna in the robot's frame; None: from the transforms of the bag, otherwise 0.

    Raises:
        RecordingError: the recording cannot be read, or has no range of an anchor.
        DatasetError: the position of no tag can be determined.
        ParameterError: a value is invalid, or the anchors are unknown.
        ModelError: the model cannot be used.
    """
    box = None if area is None else Area(*area)
    settings = TrackSettings(
        height_m, height_sd_m, None, box, odometry, imu, lever_arm_m, stamp_offset_s, acceleration
    )
    path, source, bag = None, recording, None
    if isinstance(recording, str | Path):
        path, source = Path(recording), open_recording(recording, mapping=mapping)
        bag = path if isinstance(source, McapRecording) else None
    if anchors is None:
        in_bag = None if bag is None else recorded_anchors(bag)
        anchors = getattr(source, "anchors", in_bag) or anchors_path(path or Path("recording"))
    anchor_map = as_anchors(anchors)
    pairs = Mitigation(model or load_model(), offsets, median_at_rest=True).correct_records(
        cast(Iterable[Record], source)
    )
    if bag is not None:
        recorded = read_ranges(bag, anchor_map, stamp_offset_s, pairs)
        config = read_config(bag, anchor_map, settings)
    elif odometry is not None:
        raise ParameterError("odometry without a bag", valid="the path of a bag with one tag")
    else:
        recorded = _read_records(pairs, anchor_map, stamp_offset_s)
        recorded.check(anchor_map)
        config = settings.config(anchor_map)
    check_one_tag(config, recorded.tags)
    tags, failures = track_tags(recorded.tags, config)
    warnings = [*recorded.warnings, *map(str, failures)]
    warnings += [f"tag {format_id(tag.recording.tag_id)}: {text}" for tag in tags for text in tag.warnings]
    return Tracks(tags, anchor_map, warnings)


def _read_records(
    pairs: Iterable[tuple[Record, CorrectedRange]], anchors: AnchorMap, stamp_offset_s: float
) -> RecordedRanges:
    """Return the ranges of records that are not in a bag, see `read_ranges`."""
    table, poses = RangeTable(), defaultdict[int | None, list[tuple[int, Any, float]]](list)
    for record, corrected in pairs:
        measured = record.measurement
        table.add_raw(measured)
        table.add_corrected(measurement_key(measured), corrected)
        if record.tag_position is not None:
            yaw = math.nan if record.tag_yaw is None else record.tag_yaw
            poses[measured.tag_id].append((measured.stamp_ns, record.tag_position, yaw))
    truths = {
        tag: TruePath(*map(np.array, zip(*sorted(rows, key=lambda row: row[0]), strict=True)))
        for tag, rows in poses.items()
    }
    return table.by_tag(anchors, stamp_offset_s, truths)
