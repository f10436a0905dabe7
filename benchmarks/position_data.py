"""Recordings and simulated drives on which positions are measured.

Real recordings are in one folder for each data set, whose name is that of a shipped mapping (`hanyang`, `rcv`, `nlink_tagframe0`;
a prefix or a suffix such as `_outdoor` does not matter). Each folder below it that contains the files of the mapping is one run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from benchmarks.sites import Drive
from uwb_mitigation.errors import RecordingError, UwbMitigationError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import Bundle, load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.positioning.config import RobotData
from uwb_mitigation.positioning.geometry import Area, Height, extents
from uwb_mitigation.recordings.mapping.mapped import MappedRecording
from uwb_mitigation.recordings.mapping.mapping import load_mapping, shipped_mappings
from uwb_mitigation.simulation.odometry import RATE_HZ, motion_along, stamps_s
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.anchors import Anchor, AnchorMap, load_anchors
from uwb_mitigation.types.measurement import Record
from uwb_mitigation.types.offsets import NO_OFFSETS, Offsets
from uwb_mitigation.types.stamps import NS_PER_S
from uwb_mitigation.types.tracks import Heights, Ranges, TruePath

HANYANG_TIME_OFFSET_S = 0.2
"""Time offset of the ranges relative to the ground truth in every Hanyang run."""

HEIGHTS = {"hanyang": Height(1.0, 0.2), "labyrinth": Height(0.0, 0.1)}
"""Height of the tag in the sets in which it is constant and documented."""

LEVEL_M = 0.1
"""If the true height changes by less (standard deviation), the tag is evaluated with a constant height."""

HEIGHT_SD_M = 0.05
"""Noise of the simulated height sensor of the sets that end with `_height`: ten measurements of the true height per second."""

MOVING = 0.1
"""Speed (m/s) from which the direction of travel is the true heading of a robot without a recorded one."""

SITES = range(10, 20)
"""Seeds of the simulated sites; lower ones are for development."""

KINDS, KIND_SEEDS = ("site_gains", "plasterboard", "open_hall", "drone_room"), range(10, 14)
"""Drives with CIRs of other boards and in other rooms, and their seeds."""

DRONES = range(10, 16)
GEOMETRY_SEEDS = (10, 11)
"""Seeds of the drives in layouts of real deployments; lower ones are for development."""

GEOMETRIES = "geometries.yaml"
DRIVE_S = 120.0
TUTORIAL_OFFSET_M = 0.22
MAX_RUNS, MIN_TRUE_POSITIONS = 200, 10
_SIMULATED_HEIGHT = Height(0.0, 0.05)
_GROUPS = 10
_WAVES = 8


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Ranges of one tag with everything that estimators may use, and its true path.

    Attributes:
        set_name, name: of the data set, and of the run.
        simulated: whether the ranges are simulated.
        anchors: rows of the ranges.
        ranges: as measured; their variances are unknown.
        truth: true path, only where errors are evaluated.
        height: constant height of the tag; `heights`: measured ones; `area` that contains it.
        robot: recorded motion of the robot that carries the tag.
        read_records: reads the complete measurements, in the order of `ranges`.
        has_cirs: whether they contain CIRs.
        offsets: of the radios, if the recipe of the set includes them.
    """

    set_name: str
    name: str
    simulated: bool
    anchors: AnchorMap
    ranges: Ranges
    truth: TruePath
    height: Height | None = None
    heights: Heights | None = None
    robot: RobotData | None = None
    read_records: Callable[[], list[Record]] = list
    has_cirs: bool = False
    area: Area | None = None
    offsets: Offsets = NO_OFFSETS

    def corrected(self, bundle: Bundle | None = None, offsets: Offsets | None = None) -> Ranges:
        """Return the ranges corrected by a model, by default by the universal one."""
        mitigation = Mitigation(bundle or load_bundle(default_model_path()), offsets or self.offsets)
        results = mitigation.correct([record.measurement for record in self.read_records()])
        range_m = np.maximum([result.range_m for result in results], 0.0)
        is_corrected = np.array([result.status.is_corrected for result in results])
        variance_m2 = np.array([result.variance_m2 for result in results])
        # As in `MultiTagEstimator`.
        variance_m2[~np.logical_or.accumulate(is_corrected)] = np.nan
        return replace(self.ranges, range_m=range_m, variance_m2=variance_m2, is_corrected=is_corrected)


@dataclass(frozen=True, slots=True)
class RunSource:
    """A run that is loaded in the process that evaluates it.

    Attributes:
        set_name, name: as in `Run`.
        load: name of the function of this module that loads it, and `arguments` of that function.
        donor: another run with the same anchors and radios, from which the calibration is made; None: there is none.
    """

    set_name: str
    name: str
    load: str
    arguments: tuple[str | int | bool, ...]
    donor: RunSource | None = None

    def read(self) -> Run:
        """Return the run.

        Raises:
            UwbMitigationError: it cannot be read.
        """
        loader: Callable[..., Run] = globals()[self.load]
        return loader(self.set_name, self.name, *self.arguments)


def simulated_runs() -> list[RunSource]:
    """Return the simulated drives."""
    flats = [
        RunSource(
            "flat", f"{count} anchors", "load_flat", (count, 1), RunSource("", "", "load_flat", (count, 0))
        )
        for count in (4, 6, 8)
    ]
    sites = [
        RunSource("site", str(seed), "load_site", (seed, 1), RunSource("", "", "load_site", (seed, 0)))
        for seed in SITES
    ]
    sites += [
        RunSource(kind, str(seed), "load_site", (seed, 1, kind)) for kind in KINDS for seed in KIND_SEEDS
    ]
    drones = [
        RunSource("drone" + "_height" * height, str(seed), "load_drone", (seed, height))
        for height in (False, True)
        for seed in DRONES
    ]
    halls = [RunSource("hall", kind, "load_hall", (kind,)) for kind in ("clean", "nlos", "outliers")]
    return [RunSource("tutorial", "drive", "load_tutorial", ()), *flats, *sites, *drones, *halls]


def real_runs(data: Path) -> tuple[list[RunSource], list[dict[str, str]]]:
    """Return the runs of the data sets in a folder, and those that cannot be read with the reason."""
    groups: dict[tuple[object, ...], list[RunSource]] = {}
    skipped: list[dict[str, str]] = []
    for folder in sorted(entry for entry in data.iterdir() if entry.is_dir()):
        if (folder / GEOMETRIES).exists():
            continue
        mapping = mapping_of(folder.name)
        if mapping is None:
            skipped.append({"path": str(folder), "reason": "the name is not that of a shipped mapping"})
            continue
        paths = list(_runs_below(folder, mapping))[:MAX_RUNS]
        if not paths:
            skipped.append({"path": str(folder), "reason": f"no files of the mapping {mapping}"})
        for path in paths:
            for key, source in _readable_sources(path, folder, mapping, skipped):
                groups.setdefault(key, []).append(source)
    runs = [
        replace(source, donor=group[index - 1] if len(group) > 1 else None)
        for group in groups.values()
        for index, source in enumerate(group)
    ]
    return runs, skipped


def mapping_of(name: str) -> str | None:
    """Return the longest name of a shipped mapping in the name of a folder; None: none."""
    names = [shipped for shipped in shipped_mappings() if shipped in name.lower().replace("-", "_")]
    if not names and "starloc" in name.lower().replace("-", "").replace("_", ""):
        return "starloc"
    return max(names, key=len, default=None)


def _runs_below(folder: Path, mapping: str) -> Iterator[Path]:
    """Yield the folders, or the bags, that contain one run each."""
    table = load_mapping(mapping)
    if table.topics:
        bags = [path for path in sorted(folder.rglob("*")) if path.suffix in (".bag", ".mcap", ".db3")]
        yield from dict.fromkeys(
            path.parent if (path.parent / "metadata.yaml").is_file() else path for path in bags
        )
        return
    pattern = table.files if isinstance(table.files, str) else "*"
    files = folder.rglob(pattern.removeprefix("**/"))
    yield from dict.fromkeys(file.parent for file in sorted(files) if file.is_file())


def _readable_sources(
    path: Path, folder: Path, mapping: str, skipped: list[dict[str, str]]
) -> list[tuple[tuple[object, ...], RunSource]]:
    try:
        return list(_sources_of(path, folder, mapping))
    except Exception as error:  # The other recordings continue.
        skipped.append({"path": str(path), "reason": f"{type(error).__name__}: {error}"})
        return []


def _sources_of(path: Path, folder: Path, mapping: str) -> Iterator[tuple[tuple[object, ...], RunSource]]:
    """Yield the runs of a recording; runs with the same key have the same anchors and tag."""
    recording = _open(str(path), mapping)
    name = path.relative_to(folder).as_posix() if path != folder else folder.name
    tags, places = np.unique(recording.values["tag"]).tolist(), recording.anchors.position.round(2).tobytes()
    for tag in tags:
        is_tag = recording.values["tag"] == tag
        true = np.stack([recording.values[f"tag {axis}"][is_tag] for axis in "xyz"])
        true_positions = true[:, np.isfinite(true).all(axis=0)]
        if true_positions.shape[1] < MIN_TRUE_POSITIONS:
            raise RecordingError(f"tag {tag} has no true positions", where=str(path))
        is_level = mapping in HEIGHTS or float(true_positions[2].std()) < LEVEL_M
        run = name if len(tags) == 1 else f"{name}, tag {tag}"
        for sensor in (False,) if is_level else (False, True):
            arguments = (str(path), mapping, tag, is_level, sensor)
            set_name = mapping + "_height" * sensor
            yield (set_name, tag, places), RunSource(set_name, run, "load_real", arguments)


@cache
def _open(path: str, mapping: str) -> MappedRecording:
    """Open a recording; choose the anchor constellation of MILUV that explains the true ranges."""
    table = load_mapping(mapping)
    recording = MappedRecording(table, Path(path))
    anchors_file = next((p / "anchors.yaml" for p in (Path(path), *Path(path).parents[:2])), None)
    if not hasattr(recording, "anchors") and anchors_file is not None and anchors_file.is_file():
        recording.anchors = load_anchors(anchors_file)
    if not hasattr(recording, "anchors"):
        raise RecordingError("the positions of the anchors are unknown", where=path)
    if mapping == "miluv":
        candidates = [recording]
        for group in range(1, _GROUPS):
            anchors = [source.model_copy(update={"group": str(group)}) for source in table.anchors]
            try:
                candidates.append(MappedRecording(table.model_copy(update={"anchors": anchors}), Path(path)))
            except (UwbMitigationError, KeyError, ValueError):
                break
        recording = min(candidates, key=_inconsistency_m)
    return recording


def _inconsistency_m(recording: MappedRecording) -> float:
    """Return the median difference of true ranges and the distances of true positions."""
    values, index = recording.values, recording.anchors.index
    rows = np.array([index.get(anchor, -1) for anchor in values["anchor"].tolist()])
    tag = np.stack([values[f"tag {axis}"] for axis in "xyz"], axis=1)
    distance = np.linalg.norm(tag - recording.anchors.position[rows], axis=1)
    return float(np.nanmedian(np.where(rows >= 0, np.abs(distance - values["range"]), np.nan)))


def load_real(set_name: str, name: str, path: str, mapping: str, tag: int, level: bool, sensor: bool) -> Run:
    """Return the run of one tag of a recording, with a constant height if it is `level`, or with a simulated height sensor."""
    recording = _open(path, mapping)
    values, anchors = recording.values, recording.anchors
    usable = (
        (values["tag"] == tag) & np.isin(values["anchor"], list(anchors.index)) & (values["range"] >= 0.0)
    )
    stamps, n = values["stamp"][usable], int(usable.sum())
    position = np.stack([values[f"tag {axis}"][usable] for axis in "xyz"], axis=1)
    rows = np.array([anchors.index[anchor] for anchor in values["anchor"][usable].tolist()], np.intp)
    unknown = np.full(n, np.nan)
    ranges = Ranges(stamps, rows, values["range"][usable], unknown, values["rx_power"][usable], tag)
    has_truth = np.isfinite(position).all(axis=1)
    _, first = np.unique(stamps[has_truth], return_index=True)
    truth = TruePath(stamps[has_truth][first], position[has_truth][first])
    if mapping == "hanyang":
        ranges = replace(ranges, stamp_ns=stamps - round(HANYANG_TIME_OFFSET_S * NS_PER_S))
        truth = hanyang_window(recording.truth, Path(path).name)
    robot = None
    if recording.motion is not None:
        robot = RobotData(recording.motion)
        truth = _with_heading(recording.truth if len(recording.truth) else truth)
    height = HEIGHTS.get(mapping) or (Height(float(np.median(truth.position[:, 2]))) if level else None)
    heights = measured_heights(truth, seed=0) if sensor else None
    has_cirs = bool((values["cir"][usable] >= 0).any())

    def read_records() -> list[Record]:
        return [record for record, is_usable in zip(recording, usable.tolist(), strict=True) if is_usable]

    return Run(set_name, name, False, anchors, ranges, truth, height, heights, robot, read_records, has_cirs)


def hanyang_window(path: TruePath, name: str) -> TruePath:
    """Return the path in the authors' window.

    The window of trajectory A is from the first x > 49.3 and y > -5 to the next x <= 12 and y > 3.4; that of B from
    the first x < 8.6 and y < -7 to the next x > 8.6 and y < -7.
    """
    x, y, _ = path.position.T
    is_a = name.rpartition("_")[2].startswith("A")
    enters = (x > 49.3) & (y > -5.0) if is_a else (x < 8.6) & (y < -7.0)
    leaves = (x <= 12.0) & (y > 3.4) if is_a else (x > 8.6) & (y < -7.0)
    first = np.flatnonzero(enters)
    if not len(first) or not (last := np.flatnonzero(leaves[first[0] :])).size:
        return path
    return path.take(slice(int(first[0]), int(first[0] + last[0])))


def hanyang_run(folder: Path) -> Run:
    """Return a Hanyang run; its truth is limited to the authors' window."""
    tag = int(_open(str(folder), "hanyang").values["tag"][0])
    return load_real("hanyang", folder.name, str(folder), "hanyang", tag, True, False)


def _with_heading(path: TruePath) -> TruePath:
    velocity = np.gradient(path.position[:, :2], path.stamp_ns / NS_PER_S, axis=0)
    yaw = np.where(np.hypot(*velocity.T) > MOVING, np.arctan2(velocity[:, 1], velocity[:, 0]), np.nan)
    return replace(path, yaw=yaw)


def measured_heights(truth: TruePath, seed: int) -> Heights:
    """Return ten heights per second of the true path with white noise."""
    stamps = np.arange(int(truth.stamp_ns[0]), int(truth.stamp_ns[-1]), NS_PER_S // 10)
    height_m = truth.position_at(stamps)[:, 2] + np.random.default_rng(seed).normal(
        0.0, HEIGHT_SD_M, len(stamps)
    )
    has_truth = np.isfinite(height_m)
    return Heights(stamps[has_truth], height_m[has_truth], np.full(int(has_truth.sum()), HEIGHT_SD_M**2))


def load_tutorial(set_name: str, name: str) -> Run:
    """Return the drive of the tutorial, whose radios have a documented offset."""
    source = SimulatedSource.with_anchors(4, seed=1, count=3000)
    return replace(simulated_run(set_name, name, source), offsets=Offsets(TUTORIAL_OFFSET_M))


def load_flat(set_name: str, name: str, anchors: int, drive: int) -> Run:
    """Return a drive through the flat of the simulator."""
    source = SimulatedSource.with_anchors(anchors, seed=1 + drive, count=3000, rate_hz=40.0)
    return simulated_run(set_name, name, source)


def load_site(set_name: str, name: str, seed: int, drive: int, kind: str = "site") -> Run:
    """Return a drive of a `kind` of `Drive` with 4 to 8 anchors, whose radios have offsets."""
    return simulated_run(set_name, name, Drive(seed, drive, 4 + seed % 5, 120.0, kind))


def simulated_run(set_name: str, name: str, source: SimulatedSource | Drive) -> Run:
    """Return a simulated drive."""
    records, anchors = list(source), source.anchors
    stamps = np.array([record.measurement.stamp_ns for record in records], np.int64)
    rows = np.array([anchors.index[record.measurement.anchor_id] for record in records], np.intp)
    range_m = np.maximum([record.measurement.range_m for record in records], 0.0)
    power = np.array([record.measurement.cir.rx_power_dbm for record in records], float)
    ranges = Ranges(stamps, rows, range_m, np.full(len(rows), np.nan), power, records[0].measurement.tag_id)
    position = np.array([record.tag_position for record in records], float)
    truth = TruePath(stamps, position, np.array([record.tag_yaw for record in records], float))
    motion = source.motion()
    robot = RobotData(motion.odometry)
    return Run(
        set_name, name, True, anchors, ranges, truth, _SIMULATED_HEIGHT, None, robot, lambda: records, True
    )


_CORNERS = [(0.0, 0.0, 0.3), (7.0, 0.0, 2.5), (7.0, 6.0, 0.4), (0.0, 6.0, 2.2)]


def load_drone(set_name: str, name: str, seed: int, height: bool) -> Run:
    """Return a flight between four anchors, with white, persisting and constant errors of each anchor and short NLOS."""
    rng = np.random.default_rng([0xD1, seed])
    anchors = AnchorMap(
        [Anchor(n, (x, y, z), 0.02) for n, (x, y, z) in enumerate(_CORNERS + rng.normal(0.0, 0.2, (4, 3)), 1)]
    )
    phase, rates = rng.uniform(0.0, math.tau, 3), rng.uniform(0.25, 0.55, 3)

    def path(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        wave = np.sin(rates * time_s[:, None] + phase)
        position: NDArray[np.float64] = np.array([3.5, 3.0, 1.2]) + np.array([2.6, 2.2, 0.7]) * wave
        return position

    ranges, truth = _ranges(anchors, path, rng, white_m=0.05, slow_m=0.06, constant_m=0.07, nlos_share=0.05)
    heights = measured_heights(truth, seed) if height else None
    return Run(set_name, name, True, anchors, ranges, truth, None, heights)


def load_hall(set_name: str, name: str, kind: str) -> Run:
    """Return a drive on an ellipse in a hall with five anchors and white errors of 0.03 m (kind `clean`).

    `nlos`: two anchors are blocked for half of the time, for 10 s each; `outliers`: 40 % of the ranges are 10 m too long.
    """
    rng = np.random.default_rng([0x4A, len(kind)])
    places = [(0.0, 0.0, 2.5), (12.0, 0.0, 0.5), (12.0, 9.0, 2.5), (0.0, 9.0, 0.5), (6.0, 0.0, 1.5)]
    anchors = AnchorMap([Anchor(n, place, 0.01) for n, place in enumerate(places, 1)])

    def path(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        phase = 0.2 * time_s
        return np.stack([6 + 4 * np.cos(phase), 4.5 + 3 * np.sin(phase), np.ones_like(phase)], axis=1)

    ranges, truth = _ranges(anchors, path, rng, white_m=0.03, common_m=0.0)
    range_m = ranges.range_m.copy()
    if kind == "nlos":
        interval = ranges.stamp_ns // (10 * NS_PER_S)
        blocked = (ranges.anchor < 2) & ((interval + ranges.anchor) % 2 == 0)
        range_m[blocked] += (0.3 + 0.3 * (interval % 3))[blocked]
    elif kind == "outliers":
        range_m[rng.random(len(ranges)) < 0.4] += 10.0
    return Run(set_name, name, True, anchors, replace(ranges, range_m=range_m), truth, Height(1.0, 0.05))


def geometry_runs(data: Path, seeds: Iterable[int] = GEOMETRY_SEEDS) -> list[RunSource]:
    """Return simulated drives with the anchors of real deployments, with a known and with an unknown height of the tag.

    Args:
        data: folder of the data sets, one of which can contain the file of the layouts.
        seeds: of the drives in each layout.
    """
    path = next(data.glob(f"*/{GEOMETRIES}"), None)
    if path is None:
        return []
    names = [layout["name"] for layout in yaml.safe_load(path.read_text())["geometries"]]
    return [
        RunSource(f"geometry_{name}_{dims}d", str(seed), "load_geometry", (str(path), name, dims, seed))
        for name in names
        for dims in (2, 3)
        for seed in seeds
    ]


def load_geometry(
    set_name: str, name: str, file: str, layout_name: str, dims: int, seed: int, seconds: float = DRIVE_S
) -> Run:
    """Return a drive along smooth waves through the volume of a layout, with odometry.

    With two dimensions the height is constant and known. Anchors on a line have two solutions even then: an area ends at them.
    """
    layouts = yaml.safe_load(Path(file).read_text())["geometries"]
    number, layout = next((n, one) for n, one in enumerate(layouts) if one["name"] == layout_name)
    rng = np.random.default_rng([0x6E0, number, seed])
    anchors = AnchorMap([Anchor(n, tuple(place), 0.02) for n, place in enumerate(layout["anchors"], 1)])
    low, high = (np.array(layout["tag"][corner], float) for corner in ("low", "high"))
    if dims == 2:
        low[2] = high[2] = (low[2] + high[2]) / 2.0
    path = _wave_path(low, high, layout["tag"]["speed"], rng, seconds)
    errors = {
        f"{kind}_m": layout["errors"][kind] for kind in ("common", "constant", "slow", "length", "white")
    }
    nlos_share, rate_hz = layout["errors"]["nlos"], layout["rate_hz"]
    ranges, truth = _ranges(
        anchors, path, rng, nlos_share=nlos_share, rate_hz=rate_hz, seconds=seconds, **errors
    )
    time_s = stamps_s(seconds)
    position = path(time_s)[:, :2]
    # The robot faces its direction of travel, averaged over a second.
    direction = np.gradient(position, axis=0)
    yaw = uniform_filter1d(np.unwrap(np.arctan2(direction[:, 1], direction[:, 0])), round(RATE_HZ))
    motion = motion_along(position, yaw, seed)
    truth = replace(truth, yaw=np.interp(truth.stamp_ns, motion.odometry.stamp_ns, yaw))
    area = None
    if extents(anchors.position) == 1:
        wall = float(anchors.position[:, 0].min()) - 0.1
        west, south = (low[:2] - 1.0).tolist()
        area = Area((west, south, 0.0), (wall, float(high[1]) + 1.0, float(high[2]) + 0.5))
    height = Height(float(low[2]), HEIGHT_SD_M) if dims == 2 else None
    robot = RobotData(motion.odometry)
    return Run(set_name, name, True, anchors, ranges, truth, height, None, robot, area=area)


def _wave_path(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    speed: float,
    rng: np.random.Generator,
    seconds: float,
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return the position at times (n,) in s up to `seconds`, of a path with constant speed that fills a box."""
    extent = high - low
    rates = rng.uniform(0.7, 1.4, 3) / np.sqrt(np.maximum(extent, 0.1))
    phase = rng.uniform(0.0, math.tau, 3)

    def at(angle: NDArray[np.float64]) -> NDArray[np.float64]:
        position: NDArray[np.float64] = (low + high) / 2.0 + extent / 2.0 * np.sin(
            rates * angle[:, None] + phase
        )
        return position

    angle = np.linspace(0.0, 4.0 * speed * (seconds + 2.0) / float((extent * rates).max()) + 20.0, 20_000)
    travelled = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(at(angle), axis=0), axis=1)))
    return lambda time_s: at(np.interp(speed * (time_s + 1.0), travelled, angle))


def _ranges(
    anchors: AnchorMap,
    path: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    rng: np.random.Generator,
    *,
    white_m: float,
    slow_m: float = 0.0,
    constant_m: float = 0.0,
    nlos_share: float = 0.0,
    common_m: float = 0.1,
    length_m: float = 0.3,
    seconds: float = DRIVE_S,
    rate_hz: float = 40.0,
) -> tuple[Ranges, TruePath]:
    """Return ranges to the anchors in turn. The white noise has heavy tails (Student-t with five degrees of freedom)."""
    n = round(seconds * rate_hz)
    time_s, anchor = np.arange(n) / rate_hz, np.arange(n) % len(anchors)
    position = path(time_s)
    distance = np.linalg.norm(position - anchors.position[anchor], axis=1)
    error = white_m * rng.standard_t(5.0, n) / math.sqrt(5.0 / 3.0)
    # Errors that depend on the position of the tag: a Gaussian process of each anchor (random Fourier features).
    waves = rng.normal(0.0, 1.0 / length_m, (len(anchors), _WAVES, 3))
    phase = rng.uniform(0.0, math.tau, (len(anchors), _WAVES))[anchor]
    angle = np.einsum("nwi,ni->nw", waves[anchor], position) + phase
    error += slow_m * math.sqrt(2.0 / _WAVES) * np.sin(angle).sum(axis=1)
    error += rng.normal(common_m, constant_m, len(anchors))[anchor]
    interval = (time_s // 2.0).astype(int)
    blocked = rng.random((len(anchors), interval[-1] + 1)) < nlos_share
    error += (blocked * rng.exponential(0.5, blocked.shape))[anchor, interval]
    stamps = np.rint(time_s * NS_PER_S).astype(np.int64)
    unknown = np.full(n, np.nan)
    ranges = Ranges(stamps, anchor, np.maximum(distance + error, 0.0), unknown, unknown, 1)
    return ranges, TruePath(stamps, position)
