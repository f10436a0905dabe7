"""Recordings in any format, read with a mapping file."""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DamagedRecordingError, RecordingError, format_id
from uwb_mitigation.measurement import Cir, Encoding, Record, Truth
from uwb_mitigation.positioning.anchors import MAX_ANCHORS, Anchor, AnchorMap
from uwb_mitigation.positioning.tracks import Odometry, TruePath
from uwb_mitigation.sources.conversion import (
    NO_SAMPLES,
    UNKNOWN_ID,
    Columns,
    Converter,
    Names,
    kept_rows,
    read_ids,
    read_numbers,
    read_stamps,
    samples_of,
)
from uwb_mitigation.sources.mapping import CirSource, Mapping, Motion, Poses, Table, Value
from uwb_mitigation.sources.source import Source
from uwb_mitigation.sources.tables import UNREADABLE, Chunk, find_files, read_chunks, series

MAX_RANGES = 20_000_000
MAX_PLAUSIBLE_M, MIN_PLAUSIBLE_M = 300.0, 0.03
"""A median range outside of these limits shows a wrong unit: UWB reaches 300 m."""

MAX_DIFFERENCE_M = 0.3
"""Largest plausible median difference of true ranges and the distances of true positions."""

MAX_INDEX = 1016
_UNKNOWN_STAMP = np.iinfo(np.int64).min
_NO_CIR = Cir(NO_SAMPLES)


class MappedRecording(Source):
    """The ranges of a recording in the order of their stamps; a `Source`.

    All values except the CIRs are in memory; the CIRs are in a temporary file.

    Args:
        mapping: where the values are.
        path: a file, or a folder with the files of the mapping.

    Attributes:
        mapping: the mapping.
        values: the ranges in SI units.
        warnings: implausible values, for the user.
        dropped: {rule: number of rows that are not used}.
        with_cir: number of ranges with a CIR.
        anchors: positions of the anchors; only if known.
        truth: true positions of the first tag from its poses; empty: unknown.
        motion: wheel odometry; None: not in the mapping.
        in_motion: keep pauses.

    Raises:
        RecordingError: a file cannot be read, a column is missing, or a unit is implausible.
    """

    def __init__(self, mapping: Mapping, path: Path) -> None:
        self.mapping = mapping
        self.name = f"{mapping.name} {path.name}"
        self.simulated = mapping.simulated
        self.in_motion = mapping.moving
        self.skipped: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.warnings: list[str] = []
        self._converter = Converter(mapping)
        self._cirs = _CirFile()
        self._damage: DamagedRecordingError | None = None
        self._positions: dict[int, Anchor] = {}
        self._rows_read = 0
        self.truth = TruePath(np.zeros(0, np.int64), np.zeros((0, 3)))
        folder = path if path.is_dir() else path.parent
        self._files = files = find_files(mapping, path)
        parts = [
            part
            for number, file in enumerate(files)
            if (part := self._read_file(file, number, folder)) is not None
        ]
        if not sum(map(len, parts)):
            raise self._damage or RecordingError(
                "no ranges", where=str(path), valid=f"dropped: {dict(self.dropped) or 'none'}"
            )
        values = Columns.joined(parts)
        stamps = values.stamp_ns
        late = int(np.count_nonzero(np.diff(stamps) < 0)) if len(files) == 1 else 0
        self.values = values.take(np.argsort(stamps, kind="stable"))
        if late:
            self.warnings.append(f"{late} stamps are earlier than the one before; the ranges were sorted")
        self._warn_of_repeated_stamps()
        self._read_anchors(files[0])
        self._add_truth()
        self._check_plausible()
        self.motion = None if mapping.odometry is None else _read_motion(mapping.odometry, files[0])

    @property
    def with_cir(self) -> int:
        """Return the number of ranges with a CIR."""
        return int(np.count_nonzero(self.values.numbers["cir"] >= 0))

    @property
    def tags(self) -> list[int]:
        """Return the ids of the tags."""
        return [int(each) for each in np.unique(self.values.tag_id)]

    @property
    def anchor_ids(self) -> list[int]:
        """Return the ids of the anchors in the ranges."""
        return [int(each) for each in np.unique(self.values.anchor_id)]

    def cir(self, row: int) -> Cir | None:
        """Return the samples of a range."""
        number = int(self.values.numbers["cir"][row])
        return None if number < 0 else self._cirs.read(number)

    @property
    def errors_m(self) -> NDArray[np.float64]:
        """Return measured - true of the ranges with a true range."""
        errors: NDArray[np.float64] = self.values.numbers["range"] - self.values.numbers["true range"]
        return errors[np.isfinite(errors)]

    def __iter__(self) -> Iterator[Record]:
        self.skipped = Counter({f"dropped: {rule}": count for rule, count in self.dropped.items()})
        self.skipped.update(self.warnings)
        values, numbers = self.values, self.values.numbers
        truth_m = numbers["true range"]
        places = np.stack([numbers[f"tag {axis}"] for axis in "xyz"], axis=1)
        placed, labels = np.asarray(np.isfinite(places).all(axis=1)), values.label.tolist()
        for row in range(len(values)):
            true_m, label = float(truth_m[row]), labels[row]
            known = label or math.isfinite(true_m)
            truth = Truth(true_m, label, values.configuration[row]) if known else None
            place = tuple(places[row].tolist()) if placed[row] else None
            yield Record(values.measurement(row, self.cir(row) or _NO_CIR, row), truth, place)
        if self._damage:
            raise self._damage

    def close(self) -> None:
        """Delete the temporary file."""
        self._cirs.close()

    def _read_file(self, file: Path, number: int, folder: Path) -> Columns | None:
        mapping, converter, parts = self.mapping, self._converter, []
        name = file.relative_to(folder).as_posix() if file.is_relative_to(folder) else file.name
        names = (converter.tags, converter.anchors)
        other = (
            _OtherCirs(mapping.cir, file, self._cirs, names) if mapping.cir and mapping.cir.files else None
        )
        before = self._rows_read
        try:
            for chunk in read_chunks(mapping, file, converter.columns, converter.optional):
                self._rows_read += chunk.count
                if self._rows_read > MAX_RANGES:
                    raise RecordingError(f"more than {MAX_RANGES} rows", where=str(file))
                chunk = replace(chunk, before=before)
                chunk = chunk.take(kept_rows(mapping.drop, chunk, self.dropped))
                part = converter.convert(chunk, name)
                part.numbers["cir"] = self._cirs_of(chunk) if other is None else other.rows(chunk)
                self._note_anchors(part, file)
                part.numbers["file"] = np.full(len(part), float(number))
                parts.append(self._usable(part))
        except DamagedRecordingError as error:
            self._damage = error
        if not parts:
            return None
        whole = Columns.joined(parts)
        if other is not None and other.joined:
            other.join_to(whole)
        return whole

    def _usable(self, part: Columns) -> Columns:
        """Leave out rows without a valid range or stamp."""
        kept = np.ones(len(part), bool)
        for what, good in (
            ("range is not a number", np.isfinite(part.numbers["range"])),
            ("stamp is not a number", part.stamp_ns != _UNKNOWN_STAMP),
            ("tag or anchor is unknown", (part.tag_id != UNKNOWN_ID) & (part.anchor_id != UNKNOWN_ID)),
        ):
            count = int(np.count_nonzero(~good))
            if count:
                self.dropped[what] += count
                kept &= good
        return part if kept.all() else part.take(kept)

    def _cirs_of(self, chunk: Chunk) -> NDArray[np.float64]:
        """Store the CIRs of a chunk; return their numbers, -1: none."""
        source = self.mapping.cir
        if source is None:
            return np.full(chunk.count, -1.0)
        names = series(source.column)
        if len(names) > 1:
            lists: Any = np.stack([np.asarray(chunk.columns[name], np.float64) for name in names], axis=1)
        else:
            lists = chunk.columns[names[0]]
        return self._cirs.add_all(lists, source, chunk)

    def _note_anchors(self, part: Columns, file: Path) -> None:
        """Collect the positions of the anchors from the rows of the ranges."""
        source = self.mapping.anchors
        if source is None or self.mapping.anchor_columns is None:
            return
        place = np.stack([part.numbers[f"anchor {axis}"] for axis in "xyz"], axis=1)
        found, first = np.unique(part.anchor_id, return_index=True)
        for anchor, row in zip(found.tolist(), first.tolist(), strict=True):
            x, y, z = place[row].tolist()
            position = (x, y, z)
            if not np.isfinite(place[row]).all():
                continue
            known = self._positions.setdefault(int(anchor), Anchor(int(anchor), position, source.sd))
            same = place[part.anchor_id == anchor]
            if np.abs(same - known.position).max() > 1e-3:
                raise RecordingError(
                    f"anchor {format_id(int(anchor))} has two positions",
                    where=str(file),
                    valid="one for each anchor",
                )

    def _read_anchors(self, file: Path) -> None:
        source = self.mapping.anchors
        if source is not None and source.files:
            try:
                paths = _beside(source, file)
            except RecordingError:
                if not source.optional:
                    raise
                paths = []
            for path in paths[:1]:
                self._positions = self._anchors_in(path)
        names = {number: text for text, number in self._converter.anchors.numbers.items()}
        if len(self._positions) > MAX_ANCHORS:
            self.warnings.append(
                f"{len(self._positions)} anchors, of which none is written: at most {MAX_ANCHORS}"
            )
        elif self._positions:
            chosen = [self._positions[key] for key in sorted(self._positions)]
            self.anchors = AnchorMap(
                [Anchor(each.id, each.position, each.sd, names.get(each.id, "")[:100]) for each in chosen],
                str(file),
            )

    def _anchors_in(self, path: Path) -> dict[int, Anchor]:
        source = self.mapping.anchors
        assert source is not None
        if source.id is None or source.position is None:
            raise RecordingError("anchors: id and position are needed with files", where=str(path))
        fields = self.mapping.fields.model_copy(
            update={
                "anchor": source.id,
                "range": Value(constant=0.0),
                "stamp": Value(constant=0),
                "tag": Value(constant=0),
            }
        )
        only = {
            "fields": fields,
            "anchors": source.model_copy(update={"files": ""}),
            "registers": None,
            "cir": None,
        }
        none = dict.fromkeys(
            ("sequence", "rx_power", "first_path_power", "first_path_index", "preamble_count", "channel")
        )
        plain = self.mapping.model_copy(
            update=only
            | {
                "fields": fields.model_copy(update=none),
                "drop": source.drop,
                "truth": type(self.mapping.truth)(),
            }
        )
        converter, found = Converter(plain, anchors=self._converter.anchors), {}
        for chunk in read_chunks(source, path, converter.columns, converter.optional):
            part = converter.convert(chunk.take(kept_rows(source.drop, chunk, Counter())))
            for row in range(len(part)):
                x, y, z = (float(part.numbers[f"anchor {axis}"][row]) for axis in "xyz")
                found[int(part.anchor_id[row])] = Anchor(int(part.anchor_id[row]), (x, y, z), source.sd)
        return found

    def _add_truth(self) -> None:
        values, truth = self.values, self.mapping.truth
        numbers = values.numbers
        for axis in "xyz":
            numbers.setdefault(f"tag {axis}", np.full(len(values), np.nan))
        if truth.poses:
            self._add_poses(truth.poses)
        if truth.range_from_positions and not self._positions:
            raise RecordingError("range_from_positions needs the positions of the anchors", where=self.name)
        unknown = (np.nan, np.nan, np.nan)
        by_id = {key: anchor.position for key, anchor in self._positions.items()}
        anchors = np.array([by_id.get(int(key), unknown) for key in values.anchor_id.tolist()])
        distance = np.linalg.norm(
            np.stack([numbers[f"tag {axis}"] for axis in "xyz"], axis=1) - anchors, axis=1
        )
        if truth.range_from_positions:
            numbers["true range"] = distance
        differs = np.abs(distance - numbers["true range"])
        if np.isfinite(differs).any() and np.nanmedian(differs) > MAX_DIFFERENCE_M:
            self.warnings.append(
                f"true ranges and positions differ by {np.nanmedian(differs):.2f} m: wrong anchors, lever arm or frame?"
            )
        if truth.error:
            given, measured = numbers["error"], numbers["range"]
            if truth.range:
                same, opposite = (
                    float(np.nanmedian(np.abs(measured - sign * given - numbers["true range"])))
                    for sign in (1, -1)
                )
                if opposite < same:
                    raise RecordingError(
                        "the error is true - measured", where=self.name, valid="truth.error: scale: -1"
                    )
            else:
                numbers["true range"] = measured - given

    def _add_poses(self, poses: Poses) -> None:
        """Interpolate the true positions of the antennas of all tags."""
        values = self.values
        by_poses: dict[tuple[Path, ...], list[int]] = {}
        for number, file in enumerate(self._files):
            by_poses.setdefault(tuple(_beside(poses, file)), []).append(number)
        for paths, numbers in by_poses.items():
            stamp, place, turn = self._read_poses(poses, paths)
            here = np.isin(values.numbers["file"], numbers)
            for tag in np.unique(values.tag_id[here]).tolist():
                arm = poses.lever_arm
                offset = np.array(arm.get(tag, (0.0, 0.0, 0.0)) if isinstance(arm, dict) else arm)
                antenna = place + (offset if turn is None else _turned(turn, offset))
                path = TruePath(stamp, antenna)
                self.truth = path if len(self.truth) == 0 else self.truth
                rows = here & (values.tag_id == tag)
                found = path.at(values.stamp_ns[rows])
                for column, axis in enumerate("xyz"):
                    values.numbers[f"tag {axis}"][rows] = found[:, column]

    def _read_poses(
        self, poses: Poses, paths: tuple[Path, ...]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64] | None]:
        """Return stamps, positions and orientations in the order of the stamps."""
        columns = [poses.stamp, *poses.position, *(poses.orientation or ())]
        needed = list(dict.fromkeys(name for value in columns for name in value.columns))
        needed += [rule.column for rule in poses.drop if rule.column not in needed]
        stamps, places, turns = [np.zeros(0, np.int64)], [np.zeros((0, 3))], [np.zeros((0, 4))]
        for path in paths:
            for chunk in read_chunks(poses, path, needed):
                chunk = chunk.take(kept_rows(poses.drop, chunk, self.dropped, "pose "))
                stamps.append(read_stamps(poses.stamp, chunk, path.name))
                places.append(_points(poses.position, chunk))
                if poses.orientation:
                    turns.append(_points(poses.orientation, chunk))
        stamp, place, turn = np.concatenate(stamps), np.concatenate(places), np.concatenate(turns)
        good = np.isfinite(place).all(axis=1) & (stamp != _UNKNOWN_STAMP)
        if poses.orientation:
            good &= np.isfinite(turn).all(axis=1) & (np.linalg.norm(turn, axis=1) > 0.5)
        order = np.flatnonzero(good)[np.argsort(stamp[good], kind="stable")]
        return stamp[order], place[order], turn[order] if poses.orientation else None

    def _warn_of_repeated_stamps(self) -> None:
        values = self.values
        keys = np.stack([values.stamp_ns.view(np.uint64), values.tag_id, values.anchor_id])
        ordered = keys[:, np.lexsort(keys)]
        repeated = int(np.count_nonzero((ordered[:, 1:] == ordered[:, :-1]).all(axis=0)))
        if repeated:
            self.warnings.append(f"{repeated} ranges repeat the stamp of another range of the same pair")

    def _check_plausible(self) -> None:
        """Raise RecordingError for wrong units, and collect warnings."""
        numbers = self.values.numbers
        for name in ("range", "true range"):
            found = numbers[name][np.isfinite(numbers[name])]
            median = float(np.median(np.abs(found))) if len(found) else 1.0
            if median > MAX_PLAUSIBLE_M:
                raise RecordingError(
                    f"the median {name} is {median:,.0f} m",
                    where=self.name,
                    valid="the unit is probably mm: set unit: mm",
                )
            if 0 < median < MIN_PLAUSIBLE_M:
                raise RecordingError(
                    f"the median {name} is {median:.4f} m",
                    where=self.name,
                    valid="the unit is probably m: set unit: m",
                )
        index = numbers["first_path_index"]
        known = index[np.isfinite(index)]
        if len(known) and float(np.median(known)) > MAX_INDEX:
            raise RecordingError(
                f"the median first-path index is {np.median(known):,.0f}, above {MAX_INDEX}",
                where=self.name,
                valid="10.6 fixed-point numbers of the DW1000: set unit: '10.6'",
            )
        errors = self.errors_m
        if len(errors) >= 20:
            low, middle, high = np.percentile(errors, (5, 50, 95))
            if middle - low > 2 * max(high - middle, 0.0) and low < -0.3 and middle < 0:
                self.warnings.append(
                    f"most errors are negative (median {middle:.2f} m, 5 % below {low:.2f} m): the error is probably "
                    "true - measured; set scale: -1"
                )
        negative = int(np.count_nonzero(numbers["range"] < 0))
        if negative:
            self.warnings.append(f"{negative} ranges are negative")
        levels = numbers["rx_power"][np.isfinite(numbers["rx_power"])]
        if len(levels) and not -140 < float(np.median(levels)) < -20:
            self.warnings.append(f"the median receive level is {np.median(levels):.0f}, which is not in dBm")


class _CirFile:
    """CIRs in a temporary file: rows of int16 with their scale."""

    def __init__(self) -> None:
        self._file: Any = None
        self._rows: list[tuple[int, int, float, Encoding, int]] = []
        self._end = 0

    def add_all(self, lists: Any, source: CirSource, chunk: Chunk) -> NDArray[np.float64]:
        """Store the CIRs of rows; return their numbers, -1 if a row has none."""
        found = np.full(chunk.count, -1.0)
        for row in range(chunk.count):
            values = lists[row]
            if values is None or isinstance(values, float):
                continue
            try:
                samples, encoding, scale = samples_of(values, source.samples)
            except UNREADABLE as error:
                raise RecordingError(
                    f"not a CIR: {error}", where=chunk.where(row), valid=source.samples
                ) from error
            if len(samples):
                found[row] = self._add(samples, encoding, scale, source.start_index)
        return found

    def _add(self, samples: NDArray[np.int16], encoding: Encoding, scale: float, start_index: int) -> int:
        if self._file is None:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        self._file.seek(self._end)
        self._file.write(samples.tobytes())
        self._rows.append((self._end, len(samples), scale, encoding, start_index))
        self._end += samples.nbytes
        return len(self._rows) - 1

    def read(self, number: int) -> Cir:
        """Return the samples of a row."""
        offset, length, scale, encoding, start_index = self._rows[number]
        self._file.seek(offset)
        samples = np.frombuffer(self._file.read(2 * length), np.int16)
        return Cir(samples, encoding, start_index, scale=scale)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


class _OtherCirs:
    """CIRs in another file: joined by row, or by stamp and ids."""

    def __init__(self, source: CirSource, ranges: Path, cirs: _CirFile, names: tuple[Names, Names]) -> None:
        self._source, self._cirs, self._names = source, cirs, names
        self.joined = source.join is not None
        self._numbers: NDArray[np.float64] = np.zeros(0)
        self._indices: NDArray[np.float64] = np.zeros(0)
        self._keys: list[NDArray[Any]] = []
        try:
            path = _beside(source, ranges)[0]
        except RecordingError:
            if not source.optional:
                raise
            return
        self._read(path)

    def rows(self, chunk: Chunk) -> NDArray[np.float64]:
        """Return the numbers of the CIRs of the same rows, -1: none."""
        if self.joined or not len(self._numbers):
            return np.full(chunk.count, -1.0)
        if chunk.count and chunk.rows[-1] >= len(self._numbers):
            raise RecordingError(
                f"{len(self._numbers)} CIRs for more ranges",
                where=str(chunk.path),
                valid="one row for each range",
            )
        return self._numbers[chunk.rows]

    def join_to(self, ranges: Columns) -> None:
        """Give each range the CIR of its pair that is nearest in time."""
        join = self._source.join
        if join is None or not len(self._numbers):
            return
        stamps, tags, anchors = self._keys
        for tag, anchor in np.unique(np.stack([tags, anchors], axis=1), axis=0).tolist():
            mine = np.flatnonzero((tags == tag) & (anchors == anchor))
            mine = mine[np.argsort(stamps[mine], kind="stable")]
            rows = np.flatnonzero((ranges.tag_id == tag) & (ranges.anchor_id == anchor))
            if not len(rows):
                continue
            wanted, own = ranges.stamp_ns[rows], stamps[mine]
            after = np.clip(np.searchsorted(own, wanted), 0, len(own) - 1)
            before = np.maximum(after - 1, 0)
            nearest = np.where(np.abs(own[before] - wanted) <= np.abs(own[after] - wanted), before, after)
            close = np.abs(own[nearest] - wanted) <= join.tolerance_s * 1e9
            rows, chosen = rows[close], mine[nearest[close]]
            ranges.numbers["cir"][rows] = self._numbers[chosen]
            if self._source.first_path_index:
                ranges.numbers["first_path_index"][rows] = self._indices[chosen]

    def _read(self, path: Path) -> None:
        source, join = self._source, self._source.join
        names = series(source.column)
        index = source.first_path_index
        keys = [value for value in ((join.stamp, join.tag, join.anchor) if join else ()) if value] + [
            index
        ] * bool(index)
        needed = [*names, *dict.fromkeys(name for value in keys if value for name in value.columns)]
        numbers, indices, found = [np.zeros(0)], [np.zeros(0)], []
        for chunk in read_chunks(source, path, needed):
            lists = chunk.columns[names[0]]
            if len(names) > 1:
                lists = np.stack([np.asarray(chunk.columns[name], np.float64) for name in names], axis=1)
            numbers.append(self._cirs.add_all(lists, source, chunk))
            indices.append(read_numbers(index, chunk, "first_path_index", path.name))
            if join:
                found.append(
                    (
                        read_stamps(join.stamp, chunk, path.name),
                        read_ids(join.tag or Value(constant=1), chunk, "tag", path.name, self._names[0]),
                        read_ids(join.anchor, chunk, "anchor", path.name, self._names[1]),
                    )
                )
        self._numbers, self._indices = np.concatenate(numbers), np.concatenate(indices)
        self._keys = [np.concatenate(part) for part in zip(*found, strict=True)]


def _beside(table: Table, ranges: Path) -> list[Path]:
    """Return the files of a table in the folder of the ranges; topics are in the same bag."""
    return [ranges] if table.topics or not table.files else find_files(table, ranges.parent, ranges)


def _read_motion(source: Motion, ranges: Path) -> Odometry:
    """Read speeds, and integrate the poses from them."""
    values = (source.forward, source.left, source.yaw_rate)
    needed = list(dict.fromkeys(name for value in (source.stamp, *values) for name in value.columns))
    needed += [rule.column for rule in source.drop if rule.column not in needed]
    stamps, twists = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for path in _beside(source, ranges):
        for chunk in read_chunks(source, path, needed):
            chunk = chunk.take(kept_rows(source.drop, chunk, Counter()))
            stamps.append(read_stamps(source.stamp, chunk, path.name))
            twists.append(_points(values, chunk))
    stamp, twist = np.concatenate(stamps), np.concatenate(twists)
    good = np.isfinite(twist).all(axis=1) & (stamp != _UNKNOWN_STAMP)
    stamp, first = np.unique(stamp[good], return_index=True)
    twist = twist[good][first]
    step = np.diff(stamp, prepend=stamp[:1]) / 1e9
    yaw = np.cumsum(twist[:, 2] * step)
    middle = yaw - twist[:, 2] * step / 2
    x = np.cumsum((twist[:, 0] * np.cos(middle) - twist[:, 1] * np.sin(middle)) * step)
    y = np.cumsum((twist[:, 0] * np.sin(middle) + twist[:, 1] * np.cos(middle)) * step)
    unknown = np.zeros((len(stamp), 3, 3))
    return Odometry(stamp, np.stack([x, y, yaw], axis=1), unknown, twist, unknown)


def _points(values: tuple[Value, ...], chunk: Chunk) -> NDArray[np.float64]:
    return np.stack([read_numbers(value, chunk, "position", "") for value in values], axis=1)


def _turned(quaternions: NDArray[np.float64], arm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a lever arm in the frame of the poses, for each quaternion x, y, z, w."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(quaternions).apply(arm))
