"""Recordings in any format, read with a mapping file."""

from __future__ import annotations

import contextlib
import math
import os
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from collections.abc import Mapping as Columns
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from uwb_mitigation.errors import DamagedRecordingError, RecordingError, format_id
from uwb_mitigation.recordings.mapping import checks, conversion
from uwb_mitigation.recordings.mapping.checks import median
from uwb_mitigation.recordings.mapping.cirs import CirFile, join_by_row, join_by_time
from uwb_mitigation.recordings.mapping.conversion import NO_CIR, UNKNOWN_ID, ColumnDict, Converter, Mask, take
from uwb_mitigation.recordings.mapping.mapping import CirSource, FieldRule, Mapping, TableFormat, axes
from uwb_mitigation.recordings.mapping.tables import TableFile, find_files
from uwb_mitigation.types.anchors import MAX_ANCHORS, Anchor, AnchorMap
from uwb_mitigation.types.measurement import Cir, Record, Truth
from uwb_mitigation.types.source import Source
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Odometry, TruePath

MAX_RANGES = 20_000_000
MAX_STAMP_NS = 2**31 * NS_PER_S
"""Stamps of ROS are from 1970 to 2038."""

_Rules = Columns[str, FieldRule | None]
_Paths = Sequence[Path]
_TAG, _ANCHOR, _POSE = (tuple(axes(name, None)) for name in ("tag", "anchor", "pose"))


class MappedRecording(Source):
    """The ranges of a recording in the order of their stamps; a `Source`.

    All values except the CIRs are in memory; the CIRs are in a temporary file.

    Args:
        mapping: where the values are.
        path: a file, or a folder with the files of the mapping.

    Attributes:
        values: the ranges in SI units, and `cir` (-1: none).
        names: {name of a tag or anchor: its number}, of ids with `names: true`.
        notes: how the recording was understood, for the user.
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
        self.notes: list[str] = []
        self.warnings: list[str] = []
        self.truth = TruePath(np.zeros(0, np.int64), np.zeros((0, 3)))
        self.names: dict[str, int] = {}
        self._folder = path if path.is_dir() else path.parent
        self._cirs = CirFile()
        self._damage: DamagedRecordingError | None = None
        self._files = find_files(mapping, path)
        inline = mapping.cir if mapping.cir and not mapping.cir.files else None
        self.values = values = self._read(mapping, self._files, mapping.values, cir=inline)
        self._drop(conversion.unknown_rows(values))
        del values
        stamp = mapping.fields.stamp or FieldRule(constant=0)
        if not stamp.rate_hz:
            self._continue_clocks(stamp)
        if not stamp.rate_hz and not mapping.topics:
            checks.check_stamps(self.values, self.name, stamp, moving=mapping.moving)
        count, repeated = checks.repeated_rows(self.values)
        if count and not repeated.any():
            self.warnings.append(f"{count} ranges repeat the stamp of another range of the same pair")
        self._drop({"repeated row": repeated, **checks.no_measurements(self.values)})
        self._add_other_cirs()
        del self.values["row"]
        if stamp.rate_hz:
            self._separate_placements(stamp.rate_hz)
        late = int(np.count_nonzero(np.diff(self.values["stamp"]) < 0))
        if late and len(self._files) == 1 and not stamp.rate_hz:
            self.warnings.append(f"{late} stamps are earlier than the one before; the ranges were sorted")
        if late:
            self.values = take(self.values, np.argsort(self.values["stamp"], kind="stable"))
        self._add_truth(self._anchor_positions())
        truth = mapping.truth.ranges.range if mapping.truth.ranges else mapping.truth.range
        checks.check_units(self.values, self.name, mapping.fields.range.unit, truth.unit if truth else "")
        self._drop(conversion.impossible_rows(self.values))
        errors_measured = bool(mapping.truth.error and not mapping.truth.range)
        self.warnings += checks.value_warnings(self.values, errors_measured=errors_measured)
        self._check_first_paths()
        if mapping.truth.poses and not np.isfinite(self.values["tag x"]).any():
            self.warnings.append("no range is within the times of the true poses: compare the stamps")
        self.motion = self._read_motion()
        self._shift_stamps()

    def _check_first_paths(self) -> None:
        """Warn if most first paths are outside of their CIRs."""
        index, numbers = self.values["first_path_index"], self.values["cir"]
        rows = np.flatnonzero((numbers >= 0) & np.isfinite(index))
        samples = np.array([self._cirs.samples(number) for number in numbers[rows].tolist()], np.int64)
        outside = rows[index[rows] >= samples]
        if len(outside) > len(rows) / 2:
            example = f"{index[outside[0]]:.2f} of {self._cirs.samples(int(numbers[outside[0]]))} samples"
            self.warnings.append(
                f"{len(outside)} of {len(rows)} first paths are outside of their CIRs, such as {example}: if these are windows, "
                "set first_path_index with offset: -START, the index of their first sample, or with sum: {INDEX: 1, START: -1}, two columns"
            )

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
        values, positions = self.values, _stacked(self.values, _TAG)
        kind = self._mapping.cir_kind
        has_position, labels = np.asarray(np.isfinite(positions).all(axis=1)), values["label"].tolist()
        for row in range(len(self)):
            true_m, label = float(values["true range"][row]), labels[row]
            has_truth = label or math.isfinite(true_m)
            truth = Truth(true_m, label, values["configuration"][row]) if has_truth else None
            position = tuple(positions[row].tolist()) if has_position[row] else None
            measured = conversion.measurement(values, row, self.cir(row), kind, row)
            yield Record(measured, truth, position)
        if self._damage:
            raise self._damage

    def close(self) -> None:
        """Delete the temporary file."""
        self._cirs.close()

    def _read(
        self, table: TableFormat, paths: _Paths, values: _Rules, what: str = "", cir: CirSource | None = None
    ) -> ColumnDict:
        """Return the rows of files that no rule drops: `values`, `cir`, `row`, `file`; `what` names them in counts."""
        medians = {f"{what}{rule}": rule for rule in table.drop if rule.from_median is not None}
        values = {**values, **{name: FieldRule(column=rule.column) for name, rule in medians.items()}}
        converter, tables, before = Converter(values, self.names), list[ColumnDict](), 0
        dropped = Counter[str]()
        columns = converter.columns | dict.fromkeys(cir.sample_columns if cir else (), False)
        for number, path in enumerate(paths):
            name = Path(os.path.relpath(path, self._folder)).as_posix()
            try:
                arguments = columns, converter.id_columns, name, dropped, self.warnings.append
                for chunk in TableFile(table, path, *arguments).chunks(before):
                    before += chunk.count
                    if before > MAX_RANGES:
                        raise RecordingError(f"more than {MAX_RANGES} rows", where=path)
                    rules = conversion.filter_rows(table.drop, chunk, what)
                    chunk = chunk.take(conversion.count_kept(rules, chunk.count, self.dropped))
                    cirs = self._cirs.add(cir, chunk) if cir else np.broadcast_to(-1, chunk.count)
                    places = {"cir": cirs, "row": chunk.rows, "file": np.full(chunk.count, number, np.int32)}
                    tables.append(converter.convert(chunk) | places)
            except DamagedRecordingError as error:
                self._damage = error
                self.warnings.append(f"{error}: only the rows before are used")
        self.dropped.update({f"{what}{reason}": count for reason, count in dropped.items()})
        if not tables:
            raise self._damage or RecordingError("no rows", where=paths[0])
        rows = conversion.concat(tables)
        numbers = {name: rows.pop(name) for name in medians}
        outliers = {
            n: np.abs(column - median(column)) > medians[n].from_median for n, column in numbers.items()
        }
        return take(rows, conversion.count_kept(outliers, len(rows["row"]), self.dropped))

    def _read_complete(self, table: TableFormat, paths: _Paths, rules: _Rules, what: str) -> ColumnDict:
        """Return the rows of files in which all values are known, in the order of their stamps."""
        rows = self._read(table, paths, rules, what)
        for name in rules:
            unknown = {"stamp": conversion.UNKNOWN_STAMP, "anchor": UNKNOWN_ID, "tag": UNKNOWN_ID}.get(name)
            rows = take(rows, rows[name] != unknown if unknown else np.isfinite(rows[name]))
        return take(rows, np.argsort(rows["stamp"], kind="stable")) if "stamp" in rules else rows

    def _files_of(self, table: TableFormat, file: Path, *, optional: bool = False) -> list[Path]:
        """Return the files of a table in the folder of the ranges; topics are in the same bag."""
        if table.topics or not table.files:
            return [file]
        with contextlib.suppress(*[RecordingError] if optional else []):
            return find_files(table, file.parent, file)
        return []

    def _by_files(self, table: TableFormat, optional: bool = False) -> Iterator[tuple[list[Path], Mask]]:
        """Yield files of a table, and which ranges they belong to."""
        groups = defaultdict[tuple[Path, ...], list[int]](list)
        for number, file in enumerate(self._files):
            groups[tuple(self._files_of(table, file, optional=optional))].append(number)
        for paths, numbers in groups.items():
            if paths:
                yield list(paths), np.isin(self.values["file"], numbers)

    def _drop(self, rules: dict[str, Mask]) -> None:
        """Drop and count the ranges to which a rule applies."""
        mask = conversion.count_kept(rules, len(self), self.dropped)
        if not mask.any():
            where, valid = str(self._files[0]), f"dropped: {dict(self.dropped) or 'none'}"
            raise self._damage or RecordingError("no ranges", where=where, valid=valid)
        self.values = take(self.values, mask)

    def _continue_clocks(self, stamp: FieldRule) -> None:
        mapping, truth = self._mapping, self._mapping.truth
        if what := checks.continue_clocks(self.values, stamp, self._files):
            if mapping.odometry or truth.poses or truth.ranges or (mapping.cir and mapping.cir.join):
                valid = "one recording for each part, because other tables are joined by time"
                raise RecordingError(what, where=self.name, valid=valid)
            self.warnings.append(what)

    def _add_other_cirs(self) -> None:
        """Join the CIRs of other files, by row or by time and ids."""
        if (source := self._mapping.cir) is None or not source.files:
            return
        join, keys = source.join, {"first_path_index": source.first_path_index}
        if join:
            keys |= {"stamp": join.stamp, "tag": join.tag, "anchor": join.anchor}
        self.values |= {name: self.values[name].copy() for name in ("cir", "first_path_index")}
        for paths, mask in self._by_files(source, source.optional):
            rows, cirs = np.flatnonzero(mask), self._read(source, paths, keys, "CIR ", source)
            if join:
                text, is_warning = join_by_time(self.values, rows, cirs, join)
                name = f"{paths[0].parent.name}/{paths[0].name}: " if len(self._files) > 1 else ""
                (self.warnings if is_warning else self.notes).append(f"{name}{text}")
            else:
                join_by_row(self.values, rows, cirs, str(paths[0]))

    def _separate_placements(self, rate_hz: float) -> None:
        """Put the ranges of each placement one after the other, with pauses between placements."""
        values = self.values
        names = ["tag", *_TAG] if np.isfinite(_stacked(values, _TAG)).all() else ["tag", "configuration"]
        groups = pd.DataFrame({name: values[name] for name in names}).groupby(names, sort=False).ngroup()
        group = groups.to_numpy()
        if (count := int(group.max()) + 1) > 1 and not self._mapping.moving:
            self.values = values = take(values, np.argsort(group, kind="stable"))
            pause_s = max(checks.PAUSE_S - 1 / rate_hz, 0.0)
            times = np.arange(len(group)) / rate_hz + np.sort(group) * pause_s
            values["stamp"] = np.rint(times * 1e9).astype(np.int64)
            if names[-1] != "configuration" and not self._mapping.truth.configuration:
                values["configuration"] = np.array([f"placement {n + 1}" for n in np.sort(group)], object)
            self.notes.append(f"{count} placements, with pauses of {checks.PAUSE_S:g} s between them")

    def _anchor_positions(self) -> dict[int, NDArray[np.float64]]:
        """Return the positions from the ranges or from another file, and set `anchors`."""
        rows, sources, sd = self.values, self._mapping.anchors, 0.02
        for source in sources:
            sd = source.sd
            if not source.files:
                break
            if paths := self._files_of(source, self._files[0], optional=source.optional or len(sources) > 1):
                rules = {"anchor": source.id} | axes("anchor", source.position)
                rows = self._read_complete(source, paths[:1], rules, "anchor ")
                break
        else:
            if sources:
                self.notes.append(f"no anchors: no file {source.files!r} in {self._files[0].parent}")
        names, where = {number: text for text, number in self.names.items()}, str(self._files[0])
        columns = {name: rows[name] for name in ("anchor", *_ANCHOR)}
        by_anchor = pd.DataFrame(columns).dropna().groupby("anchor")
        moved = (by_anchor.max() - by_anchor.min()).max(axis=1)
        positions = dict(zip(moved.index.tolist(), by_anchor.first().to_numpy(), strict=True))
        if differs := moved.index[moved > 1e-3].tolist():
            what, valid = f"anchor {format_id(differs[0])} has two", "one; are tag and anchor exchanged?"
            raise RecordingError(f"{what} positions", where=where, valid=valid)
        if len(positions) > MAX_ANCHORS:
            self.warnings.append(f"{len(positions)} anchors, of which none is written: at most {MAX_ANCHORS}")
        elif positions and sources:
            named = [(key, (*xyz.tolist(),), names.get(key, "")[:100]) for key, xyz in positions.items()]
            anchors = [Anchor(key, xyz, sd, name) for key, xyz, name in named]
            self.anchors = AnchorMap(anchors, where)
        return positions

    def _add_truth(self, positions: dict[int, NDArray[np.float64]]) -> None:
        values, truth = self.values, self._mapping.truth
        self._add_poses()
        self._add_true_ranges()
        anchors = np.full((len(self), 3), np.nan)
        for key, position in positions.items():
            anchors[values["anchor"] == key] = position
        with np.errstate(over="ignore"):
            distance = np.linalg.norm(_stacked(values, _TAG) - anchors, axis=1)
        distance[np.isinf(distance)] = np.nan
        if truth.range_from_positions and not positions:
            raise RecordingError("range_from_positions needs the positions of the anchors", where=self.name)
        if truth.range_from_positions:
            values["true range"] = distance
        if truth.error and not truth.range:
            values["true range"] = values["range"] - values["error"]
        elif truth.error:
            signed = (values["range"] - sign * values["error"] - values["true range"] for sign in (1, -1))
            same, opposite = (median(np.abs(difference)) for difference in signed)
            if 2 * opposite < same:
                valid = "truth.error: scale: -1"
                raise RecordingError("the error is true - measured", where=self.name, valid=valid)
        self.warnings += checks.anchor_warnings(values, positions, distance - values["true range"])

    def _add_true_ranges(self) -> None:
        """Interpolate the true ranges of all pairs in another file."""
        if (source := self._mapping.truth.ranges) is None:
            return
        values, true = self.values, np.full(len(self), np.nan)
        rules = {"tag": source.tag, "anchor": source.anchor, "range": source.range}
        rules["stamp"] = source.stamp or FieldRule(constant=0)
        for paths, mask in self._by_files(source):
            rows = self._read_complete(source, paths, rules, "true range ")
            pairs = pd.DataFrame({"tag": rows["tag"], "anchor": rows["anchor"]}).groupby(["tag", "anchor"])
            for (tag, anchor), is_pair in pairs.indices.items():
                is_target = mask & (values["tag"] == tag) & (values["anchor"] == anchor)
                if not source.stamp and np.ptp(rows["range"][is_pair]) > 0:
                    what = f"tag {format_id(tag)} and anchor {format_id(anchor)} have several true ranges"
                    raise RecordingError(what, where=paths[0], valid="truth.range.stamp: their times")
                stamps = values["stamp"][is_target] if source.stamp else np.zeros(is_target.sum(), np.int64)
                path = TruePath(rows["stamp"][is_pair], rows["range"][is_pair][:, np.newaxis])
                true[is_target] = path.position_at(stamps)[:, 0]
        values["true range"] = true
        self.notes.append(f"true ranges joined: {np.isfinite(true).sum()} of {len(true)}")

    def _add_poses(self) -> None:
        """Interpolate the true positions of the antennas of all tags."""
        from scipy.spatial.transform import Rotation

        if (poses := self._mapping.truth.poses) is None:
            return
        values, turns = self.values, {f"turn {n}": value for n, value in enumerate(poses.orientation or ())}
        values |= {name: values[name].copy() for name in _TAG}
        rules = {"stamp": poses.stamp, **axes("pose", poses.position), **turns}
        for paths, mask in self._by_files(poses):
            rows = self._read_complete(poses, paths, rules, "pose ")
            if turns:
                rows = take(rows, np.linalg.norm(_stacked(rows, tuple(turns)), axis=1) > 0.5)
            for tag in np.unique(values["tag"][mask]).tolist():
                arm = poses.lever_arm
                offset = np.array(arm.get(tag, (0.0, 0.0, 0.0)) if isinstance(arm, dict) else arm)
                offset = Rotation.from_quat(_stacked(rows, tuple(turns))).apply(offset) if turns else offset
                path = TruePath(rows["stamp"], _stacked(rows, _POSE) + offset)
                self.truth = path if len(self.truth) == 0 else self.truth
                selected = mask & (values["tag"] == tag)
                for name, coordinate in zip(_TAG, path.position_at(values["stamp"][selected]).T, strict=True):
                    values[name][selected] = coordinate

    def _shift_stamps(self) -> None:
        """Shift all stamps if ROS cannot represent them."""
        first, last = int(self.values["stamp"][0]), int(self.values["stamp"][-1])
        if first >= 0 and last < MAX_STAMP_NS:
            return
        shift_ns = -(first // NS_PER_S) * NS_PER_S
        self.values["stamp"] = self.values["stamp"] + shift_ns
        self.truth = TruePath(self.truth.stamp_ns + shift_ns, self.truth.position)
        if self.motion:
            self.motion = replace(self.motion, stamp_ns=self.motion.stamp_ns + shift_ns)
        what = "were added to all stamps, because those of ROS are from 1970 to 2038"
        self.warnings.append(f"{shift_ns / 1e9:+.0f} s {what}")

    def _read_motion(self) -> Odometry | None:
        """Read speeds, and integrate the poses from them."""
        source = self._mapping.odometry
        if source is None:
            return None
        speeds = {"forward": source.forward, "left": source.left, "yaw_rate": source.yaw_rate}
        rules = {"stamp": source.stamp, **speeds}
        rows = self._read_complete(source, self._files_of(source, self._files[0]), rules, "odometry ")
        stamp, first = np.unique(rows["stamp"], return_index=True)
        twist = _stacked(rows, tuple(speeds))[first]
        return Odometry.integrated(stamp, twist)


def _stacked(columns: ColumnDict, names: Sequence[str]) -> NDArray[np.float64]:
    return np.stack([columns[name] for name in names], axis=1)
