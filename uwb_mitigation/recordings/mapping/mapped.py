"""Recordings in any format, read with a mapping file."""

from __future__ import annotations

import contextlib
import math
import os
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DamagedRecordingError, RecordingError, format_id
from uwb_mitigation.recordings.mapping.cirs import CirFile, join_by_row, join_by_time
from uwb_mitigation.recordings.mapping.conversion import (
    NO_CIR,
    UNKNOWN_ID,
    UNKNOWN_STAMP,
    ColumnDict,
    Converter,
    count_bad,
    joined,
    kept_rows,
    measurement,
    take,
)
from uwb_mitigation.recordings.mapping.mapping import (
    CirSource,
    FieldRule,
    Mapping,
    Poses,
    TableFormat,
    axes,
    series,
)
from uwb_mitigation.recordings.mapping.tables import find_files, read_chunks
from uwb_mitigation.types.anchors import MAX_ANCHORS, Anchor, AnchorMap
from uwb_mitigation.types.measurement import Cir, Record, Truth
from uwb_mitigation.types.source import Source
from uwb_mitigation.types.tracks import Odometry, TruePath

MAX_RANGES = 20_000_000
MAX_PLAUSIBLE_M, MIN_PLAUSIBLE_M = 300.0, 0.03
"""A median range outside of these limits shows a wrong unit: UWB reaches 300 m."""

MAX_POSSIBLE = 10_000.0
"""Rows with a larger range (m), level (dBm) or first-path index are not used."""

MAX_DIFFERENCE_M = 0.3
"""Largest plausible median difference of true ranges and the distances of true positions."""

MAX_ERROR_M = 20.0
"""Largest plausible median error of ranges."""

MAX_INDEX = 1016
_LIMITED = ("range", "true range", "rx_power", "first_path_power", "first_path_index")
_TAG, _ANCHOR, _POSE = (tuple(axes(name, None)) for name in ("tag", "anchor", "pose"))


class MappedRecording(Source):
    """The ranges of a recording in the order of their stamps; a `Source`.

    All values except the CIRs are in memory; the CIRs are in a temporary file.

    Args:
        mapping: where the values are.
        path: a file, or a folder with the files of the mapping.

    Attributes:
        values: the ranges in SI units, and `cir` (-1: none).
        warnings: implausible values, for the user.
        dropped: {rule: number of rows that are not used}.
        anchors: positions of the anchors; only if known.
        truth: true positions of the first tag from its poses; empty: unknown.
        motion: wheel odometry; None: not in the mapping.
        in_motion: keep pauses.

    Raises:
        RecordingError: a file cannot be read, a column is missing, or a unit is implausible.
    """

    def __init__(self, mapping: Mapping, path: Path) -> None:
        self._mapping = mapping
        self.name = f"{mapping.name} {path.name}"
        self.simulated = mapping.simulated
        self.in_motion = mapping.moving
        self.skipped: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.warnings: list[str] = []
        self.truth = TruePath(np.zeros(0, np.int64), np.zeros((0, 3)))
        self._folder = path if path.is_dir() else path.parent
        self._names: dict[str, dict[str, int]] = {"tag": {}, "anchor": {}}
        self._cirs = CirFile()
        self._damage: DamagedRecordingError | None = None
        self._files = find_files(mapping, path)
        inline = mapping.cir if mapping.cir and not mapping.cir.files else None
        self.values = values = self._read(mapping, self._files, mapping.values, cir=inline)
        self._keep(
            {
                "range is not a number": np.isfinite(values["range"]),
                "stamp is not a number": values["stamp"] != UNKNOWN_STAMP,
                "tag or anchor is unknown": (values["tag"] != UNKNOWN_ID) & (values["anchor"] != UNKNOWN_ID),
            }
        )
        if mapping.cir and mapping.cir.files:
            self._add_other_cirs(mapping.cir)
        late = int(np.count_nonzero(np.diff(self.values["stamp"]) < 0))
        if late and len(self._files) == 1:
            self.warnings.append(f"{late} stamps are earlier than the one before; the ranges were sorted")
        self.values = take(self.values, np.argsort(self.values["stamp"], kind="stable"))
        self._add_truth(self._anchor_positions())
        self._check_units()
        limited = {f"{name} is above {MAX_POSSIBLE:g}": np.abs(self.values[name]) for name in _LIMITED}
        self._keep({what: ~(numbers > MAX_POSSIBLE) for what, numbers in limited.items()})
        self._warn()
        self.motion = self._read_motion()

    def __len__(self) -> int:
        return len(self.values["stamp"])

    @property
    def errors_m(self) -> NDArray[np.float64]:
        """Return measured - true of the ranges with a true range."""
        errors: NDArray[np.float64] = self.values["range"] - self.values["true range"]
        return errors[np.isfinite(errors)]

    def cir(self, row: int) -> Cir:
        """Return the samples of a range."""
        number = int(self.values["cir"][row])
        return NO_CIR if number < 0 else self._cirs.read(number)

    def __iter__(self) -> Iterator[Record]:
        self.skipped = Counter({f"dropped: {rule}": count for rule, count in self.dropped.items()})
        self.skipped.update(self.warnings)
        values, places = self.values, _stacked(self.values, _TAG)
        placed, labels = np.asarray(np.isfinite(places).all(axis=1)), values["label"].tolist()
        for row in range(len(self)):
            true_m, label = float(values["true range"][row]), labels[row]
            known = label or math.isfinite(true_m)
            truth = Truth(true_m, label, values["configuration"][row]) if known else None
            place = tuple(places[row].tolist()) if placed[row] else None
            yield Record(measurement(values, row, self.cir(row), row), truth, place)
        if self._damage:
            raise self._damage

    def close(self) -> None:
        """Delete the temporary file."""
        self._cirs.close()

    def _read(
        self,
        table: TableFormat,
        paths: Sequence[Path],
        values: dict[str, FieldRule | None],
        what: str = "",
        cir: CirSource | None = None,
    ) -> ColumnDict:
        """Return the rows of files that no rule drops: `values`, `cir`, `row`, `file`; `what` names them in counts."""
        medians = {f"{what}{rule}": rule for rule in table.drop if rule.from_median is not None}
        values = values | {name: FieldRule(column=rule.column) for name, rule in medians.items()}
        converter, parts, before = Converter(values, self._names), [], 0
        columns = converter.columns | dict.fromkeys(series(cir.column) if cir else (), False)
        for number, path in enumerate(paths):
            name = Path(os.path.relpath(path, self._folder)).as_posix()
            try:
                for chunk in read_chunks(table, path, columns, before):
                    before += chunk.count
                    if before > MAX_RANGES:
                        raise RecordingError(f"more than {MAX_RANGES} rows", where=str(path))
                    chunk = chunk.take(kept_rows(table.drop, chunk, self.dropped, what))
                    part = converter.convert(chunk, name)
                    part["cir"] = self._cirs.add(cir, chunk) if cir else np.full(chunk.count, -1)
                    parts.append(part | {"row": chunk.rows, "file": np.full(chunk.count, number)})
            except DamagedRecordingError as error:
                self._damage = error
        if not parts:
            raise self._damage or RecordingError("no rows", where=str(paths[0]))
        found = joined(parts)
        kept = np.ones(len(found["row"]), bool)
        for name, rule in medians.items():
            numbers = found.pop(name)
            kept &= ~count_bad(np.abs(numbers - _median(numbers)) > rule.from_median, self.dropped, name)
        return take(found, kept)

    def _beside(self, table: TableFormat, file: Path, *, optional: bool = False) -> list[Path]:
        """Return the files of a table in the folder of the ranges; topics are in the same bag."""
        if table.topics or not table.files:
            return [file]
        with contextlib.suppress(*[RecordingError] if optional else []):
            return find_files(table, file.parent, file)
        return []

    def _keep(self, rules: dict[str, NDArray[np.bool_]]) -> None:
        """Drop and count the ranges that do not satisfy all rules."""
        kept = np.ones(len(self), bool)
        for what, good in rules.items():
            kept &= ~count_bad(~good & kept, self.dropped, what)
        if not kept.any():
            where, valid = str(self._files[0]), f"dropped: {dict(self.dropped) or 'none'}"
            raise self._damage or RecordingError("no ranges", where=where, valid=valid)
        self.values = take(self.values, kept)

    def _add_other_cirs(self, source: CirSource) -> None:
        """Join the CIRs of other files, by row or by time and ids."""
        join = source.join
        keys: dict[str, FieldRule | None] = {"first_path_index": source.first_path_index}
        if join:
            keys |= {"stamp": join.stamp, "tag": join.tag, "anchor": join.anchor}
        for number, file in enumerate(self._files):
            if paths := self._beside(source, file, optional=source.optional):
                rows = np.flatnonzero(self.values["file"] == number)
                found = self._read(source, paths, keys, "CIR ", source)
                if join:
                    join_by_time(self.values, rows, found, join.tolerance_s)
                    if (self.values["cir"][rows] < 0).all():
                        self.warnings.append("no CIR belongs to a range: compare stamps and ids of cir.join")
                else:
                    join_by_row(self.values, rows, found, str(file))

    def _anchor_positions(self) -> dict[int, NDArray[np.float64]]:
        """Return the positions from the ranges or from another file, and set `anchors`."""
        source, found, where = self._mapping.anchors, self.values, str(self._files[0])
        if source and source.files:
            columns = {"anchor": source.id} | axes("anchor", source.position)
            if paths := self._beside(source, self._files[0], optional=source.optional):
                found = self._read(source, paths[:1], columns, "anchor ")
        place = _stacked(found, _ANCHOR)
        good = np.isfinite(place).all(axis=1) & (found["anchor"] != UNKNOWN_ID)
        ids, first, index = np.unique(found["anchor"][good], return_index=True, return_inverse=True)
        place = place[good]
        moved = np.abs(place - place[first][index]).max(axis=1, initial=0.0) > 1e-3
        if moved.any():
            what = f"anchor {format_id(int(ids[index[moved][0]]))} has two positions"
            raise RecordingError(what, where=where, valid="one for each anchor")
        if len(ids) > MAX_ANCHORS:
            self.warnings.append(f"{len(ids)} anchors, of which none is written: at most {MAX_ANCHORS}")
        elif len(ids) and source:
            names = {number: text for text, number in self._names["anchor"].items()}
            self.anchors = AnchorMap(
                [
                    Anchor(key, (x, y, z), source.sd, names.get(key, "")[:100])
                    for key, (x, y, z) in zip(ids.tolist(), place[first].tolist(), strict=True)
                ],
                where,
            )
        return dict(zip(ids.tolist(), place[first], strict=True))

    def _add_truth(self, positions: dict[int, NDArray[np.float64]]) -> None:
        values, truth = self.values, self._mapping.truth
        if truth.poses:
            self._add_poses(truth.poses)
        anchors = np.full((len(self), 3), np.nan)
        for key, position in positions.items():
            anchors[values["anchor"] == key] = position
        with np.errstate(over="ignore"):
            distance = np.linalg.norm(_stacked(values, _TAG) - anchors, axis=1)
        distance[np.isinf(distance)] = np.nan
        if truth.range_from_positions:
            if not positions:
                raise RecordingError(
                    "range_from_positions needs the positions of the anchors", where=self.name
                )
            values["true range"] = distance
        if truth.error and not truth.range:
            values["true range"] = values["range"] - values["error"]
        elif truth.error:
            same, opposite = (
                _median(np.abs(values["range"] - sign * values["error"] - values["true range"]))
                for sign in (1, -1)
            )
            if 2 * opposite < same:
                raise RecordingError(
                    "the error is true - measured", where=self.name, valid="truth.error: scale: -1"
                )
        differs = _median(np.abs(distance - values["true range"]))
        if differs > MAX_DIFFERENCE_M:
            self.warnings.append(
                f"true ranges and positions differ by {differs:.2f} m: wrong anchors, lever arm or frame?"
            )

    def _add_poses(self, poses: Poses) -> None:
        """Interpolate the true positions of the antennas of all tags."""
        from scipy.spatial.transform import Rotation

        values, files_by_poses = self.values, defaultdict[tuple[Path, ...], list[int]](list)
        for number, file in enumerate(self._files):
            files_by_poses[tuple(self._beside(poses, file))].append(number)
        turns: dict[str, FieldRule | None] = {
            f"turn {n}": value for n, value in enumerate(poses.orientation or ())
        }
        for paths, numbers in files_by_poses.items():
            found = self._read(
                poses, paths, {"stamp": poses.stamp} | axes("pose", poses.position) | turns, "pose "
            )
            place = _stacked(found, _POSE)
            good = np.isfinite(place).all(axis=1) & (found["stamp"] != UNKNOWN_STAMP)
            if turns:
                turn = _stacked(found, tuple(turns))
                good &= np.isfinite(turn).all(axis=1) & (np.linalg.norm(turn, axis=1) > 0.5)
            order = np.flatnonzero(good)[np.argsort(found["stamp"][good], kind="stable")]
            here = np.isin(values["file"], numbers)
            for tag in np.unique(values["tag"][here]).tolist():
                arm = poses.lever_arm
                offset = np.array(arm.get(tag, (0.0, 0.0, 0.0)) if isinstance(arm, dict) else arm)
                antenna = place[order] + (Rotation.from_quat(turn[order]).apply(offset) if turns else offset)
                path = TruePath(found["stamp"][order], antenna)
                self.truth = path if len(self.truth) == 0 else self.truth
                rows = np.flatnonzero(here & (values["tag"] == tag))
                for name, numbers_of_axis in zip(_TAG, path.at(values["stamp"][rows]).T, strict=True):
                    values[name][rows] = numbers_of_axis

    def _check_units(self) -> None:
        """Raise RecordingError for wrong units."""
        for name, low, high, unit, other in (
            ("range", MIN_PLAUSIBLE_M, MAX_PLAUSIBLE_M, "m", "mm or cm"),
            ("true range", MIN_PLAUSIBLE_M, MAX_PLAUSIBLE_M, "m", "mm or cm"),
            ("first_path_index", 0.0, MAX_INDEX, "samples", "'10.6'"),
        ):
            median = _median(np.abs(self.values[name]))
            if median > high or 0 < median < low:
                raise RecordingError(
                    f"the median {name} is {median:,.{0 if median > high else 4}f} {unit}",
                    where=self.name,
                    valid=f"{low:g} to {high:g}; probably set unit: {other if median > high else unit}",
                )

    def _warn(self) -> None:
        """Collect warnings of implausible values."""
        import pandas as pd

        values, truth = self.values, self._mapping.truth
        keys = pd.DataFrame({name: values[name] for name in ("stamp", "tag", "anchor")})
        if repeated := int(keys.duplicated().sum()):
            self.warnings.append(f"{repeated} ranges repeat the stamp of another range of the same pair")
        if truth.poses and not np.isfinite(values["tag x"]).any():
            self.warnings.append("no range is within the times of the true poses: compare the stamps")
        if hasattr(self, "anchors") and not np.isin(values["anchor"], list(self.anchors.index)).any():
            self.warnings.append("no anchor of a range has a position: compare the ids")
        errors = self.errors_m
        if (error := _median(np.abs(errors))) > MAX_ERROR_M:
            self.warnings.append(f"the median error is {error:.0f} m: do range and truth have the same unit?")
        if truth.error and not truth.range and len(errors) >= 20:
            # Errors of UWB have a tail of late first paths, which are positive.
            low, middle, high = np.percentile(errors, (5, 50, 95))
            if middle - low > 2 * max(high - middle, 0.0) and low < -0.3 and middle < 0:
                self.warnings.append(
                    f"most errors are negative (median {middle:.2f} m, 5 % below {low:.2f} m): probably the error column is "
                    "true - measured (set scale: -1), if not many ranges are too short; estimated from the distribution"
                )
        if negative := int(np.count_nonzero(values["range"] < 0)):
            self.warnings.append(f"{negative} ranges are negative")
        level = _median(values["rx_power"])
        if level and not -140 < level < -20:
            self.warnings.append(f"the median receive level is {level:.0f}, which is not in dBm")

    def _read_motion(self) -> Odometry | None:
        """Read speeds, and integrate the poses from them."""
        source = self._mapping.odometry
        if source is None:
            return None
        speeds = {"forward": source.forward, "left": source.left, "yaw_rate": source.yaw_rate}
        found = self._read(
            source, self._beside(source, self._files[0]), {"stamp": source.stamp, **speeds}, "odometry "
        )
        twist = _stacked(found, tuple(speeds))
        good = np.isfinite(twist).all(axis=1) & (found["stamp"] != UNKNOWN_STAMP)
        stamp, first = np.unique(found["stamp"][good], return_index=True)
        twist = twist[good][first]
        step = np.diff(stamp, prepend=stamp[:1]) / 1e9
        yaw = np.cumsum(twist[:, 2] * step)
        middle = yaw - twist[:, 2] * step / 2
        x = np.cumsum((twist[:, 0] * np.cos(middle) - twist[:, 1] * np.sin(middle)) * step)
        y = np.cumsum((twist[:, 0] * np.sin(middle) + twist[:, 1] * np.cos(middle)) * step)
        unknown = np.zeros((len(stamp), 3, 3))
        return Odometry(stamp, np.stack([x, y, yaw], axis=1), unknown, twist, unknown)


def _median(numbers: NDArray[np.float64]) -> float:
    """Return the median of the finite numbers; 0 without any."""
    known = numbers[np.isfinite(numbers)]
    return float(np.median(known)) if len(known) else 0.0


def _stacked(columns: ColumnDict, names: Sequence[str]) -> NDArray[np.float64]:
    return np.stack([columns[name] for name in names], axis=1)
