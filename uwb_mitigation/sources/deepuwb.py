"""DeepUWB (doi 10.5281/zenodo.4290069) as a source: `dataset.pkl`, one row a sample, without pandas.

The data has no distances, times, ids or powers, and its CIRs are cut and normalised. What stands for them
in a `RangeMeasurement` is fixed here and described in docs/deepuwb.md.
"""

from __future__ import annotations

import enum
import re
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, RecordingError
from uwb_mitigation.measurement import Cir, Encoding, RangeMeasurement, Truth
from uwb_mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.sources.pickle_machine import Name
from uwb_mitigation.sources.pickled_frame import Column, numbers, read_columns
from uwb_mitigation.sources.source import Record

DOI = "10.5281/zenodo.4290069"
FILE_NAME = "dataset.pkl"
"""Where the data is published, and under which name."""

COLUMNS = ("CIR", "Error", "Room", "Obstacles")

CIR_SAMPLES = 157

ROOMS = ("cross-room", "big room", "medium room", "small room", "outdoor")
"""What the column `Room` numbers."""

ROOM_ROWS = (954, 18_422, 13_210, 17_601, 4_971)
"""Published rows of each."""

MATERIALS = (
    "wall",
    "polystyrene plate",
    "plastic",
    "plywood plate",
    "cardboard box",
    "LCD TV",
    "metal plate",
    "wood door",
    "glass plate",
    "metal window",
)
"""What the characters of the column `Obstacles` stand for; all 0 is LOS."""

NOMINAL_RANGE_M = 10.0
"""The true distance that every record is given: the data has errors only. A binary32 holds it exactly and
10 m + error to within 1e-6 m, for errors below 22 m."""

FIRST_PATH_INDEX = float(WINDOW_LEAD)
"""Makes the preprocessing's window the whole CIR, which the data's authors cut around the first path."""

FIRST_STAMP_NS = 1_577_836_800 * 10**9
STAMP_STEP_NS = 10_000_000
"""Stamps are made up: row i is i x 10 ms after 2020-01-01T00:00:00Z."""

TAG_ID = 1
FIRST_ANCHOR_ID = 1000
"""Ids are made up: the anchor of room r is 1000 + r."""

MAX_ROWS = 1_000_000
MAX_ERROR_M = 1000.0

NEGATIVE = "CIR with negative amplitudes"
ALL_ZERO = "CIR of zeros only"
"""Oddities that `DeepUwbRecording.skipped` counts; the records are there all the same."""

FULL_SCALE = np.iinfo(np.int16).max - 1  # the largest itself means a saturated sample
_OBSTACLES = re.compile(f"[01]{{{len(MATERIALS)}}}")
_CONFIGURATION = re.compile(r"(?:simulated seed [0-9]+/)?deepuwb/room([0-4])/([^/]+)(?:/placement [0-9]+)?")
_NO_MATERIAL = "clear"


@dataclass(frozen=True, slots=True, eq=False)
class DeepUwb:
    """The data as arrays of n rows, in the order of the file.

    Attributes:
        samples: int16 (n, 157), CIR amplitudes in counts; the largest of a row is 32766.
        scale: float32 (n,), amplitude per count.
        error_m: float64 (n,), measured - true.
        room: uint8 (n,), index into `ROOMS`.
        obstacles: n strings of ten 0 or 1, see `MATERIALS`.
    """

    samples: NDArray[np.int16]
    scale: NDArray[np.float32]
    error_m: NDArray[np.float64]
    room: NDArray[np.uint8]
    obstacles: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.error_m)


class RoomSplit(str, enum.Enum):
    """How the data is divided: both test on the medium room, which no training row was taken in.

    PAPER trains in the big and the small room (36,023 rows; test: 13,210).
    ALL_BUT_ROOM_2 trains on all rows but the test's (41,948 rows), as later work does.
    """

    PAPER = "paper"
    ALL_BUT_ROOM_2 = "all_but_room_2"


_TEST_ROOM = 2
_TRAINING_ROOMS = {RoomSplit.PAPER: (1, 3), RoomSplit.ALL_BUT_ROOM_2: (0, 1, 3, 4)}


def split_rows(
    configurations: Sequence[str] | NDArray[np.str_], split: RoomSplit
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of n rows are for training and which for testing: two masks, bool (n,).

    Args:
        configurations: n names as this source gives them, such as `Dataset.configurations`.
        split: which division.

    Raises:
        DatasetError: a name is not one of this source's, or a part is empty.
    """
    names, inverse = np.unique(np.asarray(configurations, np.str_), return_inverse=True)
    rooms = np.array([room_of(str(name)) for name in names], np.intp)[inverse]
    train, test = np.isin(rooms, _TRAINING_ROOMS[split]), rooms == _TEST_ROOM
    if not (train.any() and test.any()):
        raise DatasetError(
            f"the split {split.value!r} has {train.sum()} rows to train on and {test.sum()} to test on",
            valid=f"rows of room {_TEST_ROOM} and of rooms {_TRAINING_ROOMS[split]}",
        )
    return train, test


def configuration_of(room: int, obstacles: str) -> str:
    """The name of a row's configuration: `deepuwb/room2/wall+metal plate`, `deepuwb/room1/clear`."""
    present = [material for material, digit in zip(MATERIALS, obstacles, strict=True) if digit == "1"]
    return f"deepuwb/room{room}/{'+'.join(present) or _NO_MATERIAL}"


def has_rooms(configurations: Sequence[str] | NDArray[np.str_]) -> bool:
    """Whether all names are of DeepUWB's rooms, or of the simulator's in their place."""
    return all(_CONFIGURATION.fullmatch(str(name)) for name in np.unique(np.asarray(configurations, np.str_)))


def room_of(configuration: str) -> int:
    """The room, an index into `ROOMS`, in the name of a configuration.

    Raises:
        DatasetError: the name is not one of this source's.
    """
    return _parsed(configuration)[0]


def materials_of(configuration: str) -> tuple[str, ...]:
    """The materials between the antennas in the name of a configuration; empty for LOS.

    Raises:
        DatasetError: the name is not one of this source's.
    """
    return _parsed(configuration)[1]


def _parsed(configuration: str) -> tuple[int, tuple[str, ...]]:
    match = _CONFIGURATION.fullmatch(configuration)
    materials = tuple(match[2].split("+")) if match and match[2] != _NO_MATERIAL else ()
    if match is None or not set(materials) <= set(MATERIALS):
        raise DatasetError(
            f"configuration {configuration[:80]!r} is not of DeepUWB",
            valid="a name such as 'deepuwb/room2/wall+metal plate'",
        )
    return int(match[1]), materials


def read_deepuwb(path: Path) -> DeepUwb:
    """Read and check the whole of `dataset.pkl`.

    Raises:
        RecordingError: the file cannot be read as a frame (see `read_columns`), or a value in it is not
            as the data's description has it; names the row, counted from 0, and the column.
    """
    columns = read_columns(path, COLUMNS)
    count = len(columns["Error"])
    if not 0 < count <= MAX_ROWS:
        raise RecordingError(f"{count} rows", where=str(path), valid=f"1 to {MAX_ROWS}")
    check = _Rows(path)
    error_m = check.scalars(columns["Error"], "Error", f"a number of metres within +-{MAX_ERROR_M:g}")
    check.all(np.abs(error_m) <= MAX_ERROR_M, error_m, "Error", f"within +-{MAX_ERROR_M:g} m")
    rooms = check.scalars(columns["Room"], "Room", _VALID_ROOM)
    check.all(np.isin(rooms, range(len(ROOMS))), rooms, "Room", _VALID_ROOM)
    obstacles = tuple(check.obstacles(cell, row) for row, cell in enumerate(columns["Obstacles"]))
    samples = np.empty((count, CIR_SAMPLES), np.int16)
    scale = np.empty(count, np.float32)
    for row, cell in enumerate(columns["CIR"]):
        scale[row] = check.quantise(cell, row, samples[row])
    samples.flags.writeable = False
    return DeepUwb(samples, scale, error_m, rooms.astype(np.uint8), obstacles)


_VALID_ROOM = "0 (cross-room), 1 (big), 2 (medium), 3 (small) or 4 (outdoor)"


class _Rows:
    """Checks the cells of one file, and says in which row they are wrong."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def _error(self, row: int, column: str, what: str, valid: str) -> RecordingError:
        return RecordingError(f"{column}: {what}", where=f"{self._path}, row {row}", valid=valid)

    def scalars(self, column: Column, name: str, valid: str) -> NDArray[np.float64]:
        """A column of one number a row, float64 (n,), all finite."""
        if isinstance(column, np.ndarray):
            values = column.astype(np.float64)
        else:
            values = np.empty(len(column))
            for row, cell in enumerate(column):
                parts = numbers(cell)
                if parts is None or len(parts) != 1:
                    raise self._error(row, name, _kind(cell), valid)
                values[row] = parts[0]
        self.all(np.isfinite(values), values, name, valid)
        return values

    def all(self, good: NDArray[np.bool_], values: NDArray[np.float64], column: str, valid: str) -> None:
        """Refuse the first row that is not good."""
        if not good.all():
            row = int(np.argmin(good))
            raise self._error(row, column, f"{values[row]:g}", valid)

    def obstacles(self, cell: object, row: int) -> str:
        if type(cell) is not str or not _OBSTACLES.fullmatch(cell):
            shown = repr(cell[:20]) if type(cell) is str else _kind(cell)
            raise self._error(row, "Obstacles", shown, f"{len(MATERIALS)} characters of 0 or 1")
        return cell

    def quantise(self, cell: object, row: int, out: NDArray[np.int16]) -> float:
        """Write a CIR's amplitudes as counts, int16 (157,); returns the amplitude per count."""
        valid = f"{CIR_SAMPLES} finite amplitudes"
        amplitudes = numbers(cell)
        if amplitudes is None:
            raise self._error(row, "CIR", _kind(cell), valid)
        if len(amplitudes) != CIR_SAMPLES:
            raise self._error(row, "CIR", f"{len(amplitudes)} samples", valid)
        if not np.isfinite(amplitudes).all():
            raise self._error(row, "CIR", f"sample {np.argmin(np.isfinite(amplitudes))} is not finite", valid)
        peak = float(np.abs(amplitudes).max())
        if peak == 0:
            out[:] = 0
            return 1.0
        if not 1e-20 <= peak <= 1e20:
            raise self._error(row, "CIR", f"a peak of {peak:g}", "amplitudes from 1e-20 to 1e20")
        np.rint(amplitudes * (FULL_SCALE / peak), out=amplitudes)
        out[:] = amplitudes
        return peak / FULL_SCALE


def _kind(cell: object) -> str:
    """What a cell is that is not what it should be; never its value, which may be huge."""
    if cell is None or type(cell) is Name:  # pandas.NA
        return "missing"
    if type(cell) is str:
        return "text"
    return "a number" if type(cell) in (bool, int, float) else "no array of numbers"


class DeepUwbRecording:
    """DeepUWB's `dataset.pkl`; a `Source`.

    The file is read and checked whole on the first iteration and then kept, 320 bytes a row.

    Args:
        path: the pickle.
    """

    simulated = False

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.name = f"DeepUWB {self.path.name}"
        self.skipped: Counter[str] = Counter()
        self._data: DeepUwb | None = None
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Record]:
        """Yield the rows in the file's order; each has a truth.

        Raises:
            RecordingError: see `read_deepuwb`.
        """
        self.skipped = Counter()
        if self._closed.is_set():
            raise RecordingError("the source is closed", where=str(self.path), valid="open it anew")
        if self._data is None:
            self._data = read_deepuwb(self.path)
        data = self._data
        for row in range(len(data)):
            if self._closed.is_set():
                return
            yield self._record(data, row)

    def _record(self, data: DeepUwb, row: int) -> Record:
        samples = data.samples[row]
        if samples.min() < 0:
            self.skipped[NEGATIVE] += 1
        elif not samples.any():
            self.skipped[ALL_ZERO] += 1
        room, obstacles = int(data.room[row]), data.obstacles[row]
        cir = Cir(
            samples,
            Encoding.MAGNITUDE,
            first_path_index=FIRST_PATH_INDEX,
            scale=float(data.scale[row]),
        )
        measurement = RangeMeasurement(
            stamp_ns=FIRST_STAMP_NS + row * STAMP_STEP_NS,
            tag_id=TAG_ID,
            anchor_id=FIRST_ANCHOR_ID + room,
            sequence=row,
            device_time=0,
            range_m=NOMINAL_RANGE_M + float(data.error_m[row]),
            cir=cir,
        )
        label = "NLOS" if "1" in obstacles else "LOS"
        return Record(measurement, Truth(NOMINAL_RANGE_M, label, configuration_of(room, obstacles)))

    def close(self) -> None:
        """End iterations under way and let go of the data; the source cannot be iterated again."""
        self._closed.set()
        self._data = None

    def __enter__(self) -> DeepUwbRecording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
