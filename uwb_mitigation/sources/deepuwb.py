"""DeepUWB (doi 10.5281/zenodo.4290069) as a source: `dataset.pkl`, one row a sample, a pickled pandas frame.

The data has no distances, times, ids or powers, and its CIRs are cut and normalised. What stands for them
in a `RangeMeasurement` is fixed here and described in docs/deepuwb.md.
"""

from __future__ import annotations

import enum
import io
import re
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError, RecordingError
from uwb_mitigation.files import read_bounded
from uwb_mitigation.measurement import Cir, Encoding, RangeMeasurement, Record, Truth
from uwb_mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.sources.download import Remote, matches, stated_checksum
from uwb_mitigation.sources.source import Source

if TYPE_CHECKING:
    import pandas as pd

PUBLISHED = Remote("10.5281/zenodo.4290069", "dataset.pkl", max_bytes=1 << 29)
"""Where the data is, and how large at most."""

UNPICKLING = "a pickle is a program: reading it does whatever its author wrote, with all that you may do"

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


def read_deepuwb(path: Path, *, trust: bool = False) -> DeepUwb:
    """Read and check the whole of `dataset.pkl`.

    Args:
        path: the file. It is read only if it has the checksum that the publisher states for the data.
        trust: read it whatever its checksum; `UNPICKLING` tells what that means.

    Raises:
        RecordingError: the file is absent, too large, another than the published one, or no frame that
            pandas reads; or a value in it is not as the data's description has it; names the row, counted
            from 0, and the column.
    """
    columns = _frame(path, trust)
    count = len(columns)
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


def _frame(path: Path, trust: bool) -> pd.DataFrame:
    data = read_bounded(path, PUBLISHED.max_bytes, RecordingError, "DeepUWB's dataset.pkl")
    if not trust:
        _check_published(data, path)
    import pandas as pd

    try:
        # The very bytes that were checked, not the file again.
        frame = pd.read_pickle(io.BytesIO(data), compression=None)
    except Exception as error:
        # Whatever the pickle's own calls raise.
        raise RecordingError(
            f"not a pickle that pandas {pd.__version__} can read: {type(error).__name__}: {error}",
            where=str(path),
        ) from error
    if not isinstance(frame, pd.DataFrame):
        raise RecordingError(f"a pickled {type(frame).__name__}", where=str(path), valid="a data frame")
    for name in COLUMNS:
        if name not in frame.columns:
            held = ", ".join(map(str, frame.columns[:12])) or "none"
            raise RecordingError(f"no column {name!r}", where=str(path), valid=f"the frame holds: {held}")
    return frame


def _check_published(data: bytes, path: Path) -> None:
    try:
        if matches(data, stated_checksum(PUBLISHED)):
            return
        what = "not the published dataset.pkl"
    except RecordingError as error:
        what = f"whether this is the published dataset.pkl cannot be told: {error.what}"
    raise RecordingError(
        f"{what}; {UNPICKLING}",
        where=str(path),
        valid="`data fetch deepuwb` brings the published one; if you trust who made this one, "
        "`data import --trust` makes a bag of it, which every command reads",
    )


_VALID_ROOM = "0 (cross-room), 1 (big), 2 (medium), 3 (small) or 4 (outdoor)"


class _Rows:
    """Checks the cells of one file, and says in which row they are wrong."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def _error(self, row: int, column: str, what: str, valid: str) -> RecordingError:
        return RecordingError(f"{column}: {what}", where=f"{self._path}, row {row}", valid=valid)

    def scalars(self, column: pd.Series, name: str, valid: str) -> NDArray[np.float64]:
        """A column of one number a row, float64 (n,), all finite."""
        values = np.empty(len(column))
        for row, cell in enumerate(column):
            if not isinstance(cell, Real):
                raise self._error(row, name, _kind(cell), valid)
            values[row] = cell
        self.all(np.isfinite(values), values, name, valid)
        return values

    def all(self, good: NDArray[np.bool_], values: NDArray[np.float64], column: str, valid: str) -> None:
        """Refuse the first row that is not good."""
        if not good.all():
            row = int(np.argmin(good))
            raise self._error(row, column, f"{values[row]:g}", valid)

    def obstacles(self, cell: object, row: int) -> str:
        if not isinstance(cell, str) or not _OBSTACLES.fullmatch(cell):
            shown = repr(cell[:20]) if isinstance(cell, str) else _kind(cell)
            raise self._error(row, "Obstacles", shown, f"{len(MATERIALS)} characters of 0 or 1")
        return cell

    def quantise(self, cell: object, row: int, out: NDArray[np.int16]) -> float:
        """Write a CIR's amplitudes as counts, int16 (157,); returns the amplitude per count."""
        valid = f"{CIR_SAMPLES} finite amplitudes"
        amplitudes = _numbers(cell)
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


def _numbers(cell: object) -> NDArray[np.float64] | None:
    """An array, list or tuple of numbers as float64 (n,); None if it is none."""
    if not isinstance(cell, (np.ndarray, list, tuple)):
        return None
    try:
        values = np.asarray(cell)
    except ValueError:  # rows of several lengths
        return None
    numeric = values.dtype.kind in "biuf" or (
        values.dtype == object and all(isinstance(value, Real) for value in values.flat)
    )
    return values.astype(np.float64) if numeric and values.ndim == 1 else None


def _kind(cell: object) -> str:
    """What a cell is that is not what it should be; never its value, which may be huge."""
    import pandas as pd

    if cell is None or cell is pd.NA or (isinstance(cell, float) and np.isnan(cell)):
        return "missing"
    if isinstance(cell, str):
        return "text"
    return "a number" if isinstance(cell, Real) else "no array of numbers"


class DeepUwbRecording(Source):
    """DeepUWB's `dataset.pkl`; a `Source`.

    The file is read and checked whole on the first iteration and then kept, 320 bytes a row.

    Args:
        path: the pickle.
        trust: read it even if it is not the published one, see `read_deepuwb`.
    """

    simulated = False

    def __init__(self, path: Path | str, *, trust: bool = False) -> None:
        self.path = Path(path)
        self._trust = trust
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
            self._data = read_deepuwb(self.path, trust=self._trust)
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
