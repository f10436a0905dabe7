"""DeepUWB (doi 10.5281/zenodo.4290069) as a source: `dataset.pkl`, a pickled pandas data frame, one row per sample.

The data has no true ranges, times, ids or powers, and its CIRs are cut and normalised. Constants below replace them: a true
range of `NOMINAL_RANGE_M`, a time step, one tag, and one anchor for each room.
"""

from __future__ import annotations

import io
import pickle
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from uwb_mitigation.errors import RecordingError
from uwb_mitigation.files import read_bounded
from uwb_mitigation.mitigation.preprocessing import WINDOW_LEAD
from uwb_mitigation.types.measurement import Cir, Encoding, RangeMeasurement, Record, Truth
from uwb_mitigation.types.source import Source
from uwb_mitigation.types.stamps import NS_PER_S

ROOMS = ("cross-room", "big room", "medium room", "small room", "outdoor")
"""Index: the value of the column `Room`."""

MATERIALS = (
    *("wall", "polystyrene plate", "plastic", "plywood plate", "cardboard box", "LCD TV", "metal plate"),
    *("wood door", "glass plate", "metal window"),
)
"""Index: the position of the character in the column `Obstacles`. All characters 0: LOS."""

NO_MATERIAL = "clear"
MAX_BYTES, MAX_ERROR_M = 1 << 29, 1000.0
CIR_SAMPLES = 157
NOMINAL_RANGE_M = 10.0
FIRST_PATH_INDEX = float(WINDOW_LEAD)
"""With this index the window of the preprocessing is the whole CIR, which the authors cut at the first path."""

FIRST_STAMP_NS, STAMP_STEP_NS = 1_577_836_800 * NS_PER_S, 10_000_000  # 2020-01-01T00:00:00Z, 10 ms
TAG_ID, FIRST_ANCHOR_ID = 1, 1000
FULL_SCALE = np.iinfo(np.int16).max - 1  # the maximum itself means a saturated sample

_PANDAS = re.compile(
    r"DataFrame|Series|(Single)?BlockManager|new_block|_unpickle_block|__pyx_unpickle_NDArrayBacked"
    r"|Categorical|NA|\w*(Index|Array|ArrayNumpySemantics|Dtype)"
)
_ALLOWED = {
    "numpy": {"_reconstruct", "ndarray", "dtype", "scalar", "_frombuffer"},
    **{module: {"slice", "object"} for module in ("builtins", "__builtin__")},
    **{module: {"_reconstructor"} for module in ("copyreg", "copy_reg")},
    "_codecs": {"encode"},
}
"""Classes that a pickled frame of arrays, lists and scalars needs. None of them runs code from the file."""


def configuration_of(room: int, obstacles: str) -> str:
    """Return the configuration name of a row: `deepuwb/room2/wall+metal plate`, `deepuwb/room1/clear`."""
    present = [material for material, digit in zip(MATERIALS, obstacles, strict=True) if digit == "1"]
    return f"deepuwb/room{room}/{'+'.join(present) or NO_MATERIAL}"


class DeepUwbRecording(Source):
    """DeepUWB's `dataset.pkl`; a `Source`. It is read and checked completely when it is opened.

    Only the classes that a data frame of arrays consists of are unpickled, so that a malicious file cannot run code.

    Raises:
        RecordingError: the file is missing, larger than 512 MiB, not such a frame, or contains an invalid cell; the error
            gives row (from 0) and column.
    """

    simulated = False

    def __init__(self, path: Path) -> None:
        self.name = f"DeepUWB {path.name}"
        self.skipped: Counter[str] = Counter()
        frame = _read_frame(path)
        where = str(path)
        amplitudes = _numbers(frame, "CIR", (CIR_SAMPLES,), where)
        # NaN is not smaller.
        is_finite = np.asarray((np.abs(amplitudes) < 1e20).all(axis=1))
        _check(is_finite, "CIR", where, f"{CIR_SAMPLES} finite amplitudes")
        self._error_m = _numbers(frame, "Error", (), where)
        _check(np.abs(self._error_m) <= MAX_ERROR_M, "Error", where, f"within +-{MAX_ERROR_M:g} m")
        rooms = _numbers(frame, "Room", (), where)
        _check(np.isin(rooms, range(len(ROOMS))), "Room", where, f"0 to {len(ROOMS) - 1}")
        self._rooms = rooms.astype(int)
        self._obstacles = list(frame["Obstacles"])
        digits = re.compile(f"[01]{{{len(MATERIALS)}}}")
        valid = [isinstance(cell, str) and digits.fullmatch(cell) is not None for cell in self._obstacles]
        _check(np.array(valid), "Obstacles", where, f"{len(MATERIALS)} characters 0 or 1")
        peak = np.abs(amplitudes).max(axis=1)
        self._scale = np.where(peak > 0, peak / FULL_SCALE, 1.0).astype(np.float32)
        counts = amplitudes * np.where(peak > 0, FULL_SCALE / np.where(peak > 0, peak, 1.0), 0.0)[:, None]
        self._samples = np.rint(counts).astype(np.int16)

    def __iter__(self) -> Iterator[Record]:
        """Yield the rows in the order of the file, with truth."""
        for row, (room, obstacles) in enumerate(zip(self._rooms.tolist(), self._obstacles, strict=True)):
            scale = float(self._scale[row])
            cir = Cir(self._samples[row], Encoding.MAGNITUDE, first_path_index=FIRST_PATH_INDEX, scale=scale)
            range_m = NOMINAL_RANGE_M + float(self._error_m[row])
            stamp_ns, anchor_id = FIRST_STAMP_NS + row * STAMP_STEP_NS, FIRST_ANCHOR_ID + room
            label = "NLOS" if "1" in obstacles else "LOS"
            yield Record(
                RangeMeasurement(stamp_ns, TAG_ID, anchor_id, row, 0, range_m, cir),
                Truth(NOMINAL_RANGE_M, label, configuration_of(room, obstacles)),
            )


class _FrameUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        package = module.partition(".")[0]
        allowed = _PANDAS.fullmatch(name) if package == "pandas" else name in _ALLOWED.get(package, ())
        if package == "pyarrow":  # its constructors do not check the offsets that a file contains
            raise ValueError("it has columns of pyarrow; convert them with astype(object)")
        if not allowed:
            raise ValueError(f"{module}.{name} is not part of a data frame of numbers and text")
        if name in ("Int64Index", "UInt64Index", "Float64Index"):  # classes of pandas before version 2
            return pd.Index
        return super().find_class(module, name)


def _read_frame(path: Path) -> pd.DataFrame:
    data = read_bounded(path, MAX_BYTES, RecordingError, "DeepUWB's dataset.pkl")
    try:
        frame = _FrameUnpickler(io.BytesIO(data)).load()
    except Exception as error:  # a damaged pickle raises any kind of error
        raise RecordingError(f"not a pickled data frame: {error}", where=path) from error
    columns = ("CIR", "Error", "Room", "Obstacles")
    if not isinstance(frame, pd.DataFrame) or not set(columns) <= set(frame.columns):
        raise RecordingError("not DeepUWB's frame", where=path, valid=f"columns {', '.join(columns)}")
    if len(frame) == 0:
        raise RecordingError("no rows", where=path)
    return frame


def _check(valid: NDArray[np.bool_], column: str, where: str, expected: str) -> None:
    if not valid.all():
        raise RecordingError(
            f"{column}: invalid value", where=f"{where}, row {int(np.argmin(valid))}", valid=expected
        )


def _numbers(frame: pd.DataFrame, column: str, shape: tuple[int, ...], where: str) -> NDArray[np.float64]:
    """Return the numbers in the cells of a column, float64 (n, *shape)."""
    numbers, valid = np.zeros((len(frame), *shape)), np.zeros(len(frame), np.bool_)
    for row, cell in enumerate(frame[column]):
        values = np.asarray(cell, object if isinstance(cell, (list, tuple)) else None)
        is_numeric = values.dtype.kind in "biuf" or all(
            isinstance(value, (int, float, np.number)) for value in values.flat
        )
        if values.shape == shape and is_numeric:
            numbers[row], valid[row] = values, True
    _check(valid, column, where, f"numbers of shape {shape}" if shape else "a number")
    return numbers
