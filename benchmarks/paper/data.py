"""The data of an experiment: splits of a recording into a training and a test part, and shorter windows."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.rooms import has_rooms, parse_configuration
from uwb_mitigation.errors import DatasetError, ParameterError, check_name
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset, build_dataset
from uwb_mitigation.training.data.deepuwb import DeepUwbRecording
from uwb_mitigation.training.data.splits import Split
from uwb_mitigation.types.source import Source

AUTO, PAPER, CONFIGURATIONS = "auto", "paper", "configurations"
TRAINING_ROOMS = {PAPER: (1, 3), "all_but_room_2": (0, 1, 3, 4)}
"""{split: rooms to train on}. Both are tested in the medium room. `paper` has 36,023 training and 13,210 test rows;
`all_but_room_2` has 41,948 training rows and is used by later work."""

TEST_ROOM = 2
SPLITS = (AUTO, CONFIGURATIONS, *TRAINING_ROOMS)
FOLDS = 4
"""Number of folds of data without rooms; one fold is the test part."""


def split_by_name(configurations: NDArray[np.str_], name: str) -> tuple[str, Split]:
    """Return one of `SPLITS` and its description. AUTO is `paper` for DeepUWB, otherwise `configurations`.

    Raises:
        ParameterError: unknown split.
        DatasetError: a part is empty, or the configurations have no rooms.
    """
    check_name("split", name, SPLITS)
    if name == AUTO:
        name = PAPER if has_rooms(configurations) else CONFIGURATIONS
    if name == CONFIGURATIONS:
        fold = splits.by_configuration(configurations, FOLDS, seed=0)[0]
        return f"{CONFIGURATIONS}: 1 of {FOLDS} parts held out", fold
    rooms = np.array(
        [parse_configuration(str(configuration))[0] for configuration in configurations], np.intp
    )
    train, test = np.flatnonzero(np.isin(rooms, TRAINING_ROOMS[name])), np.flatnonzero(rooms == TEST_ROOM)
    if not (len(train) and len(test)):
        raise DatasetError(
            f"split {name!r}: {len(train)} training rows and {len(test)} test rows",
            valid=f"rows of room {TEST_ROOM} and of rooms {TRAINING_ROOMS[name]}",
        )
    return name, Split(train, test)


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """The data of an experiment; `data` and `split` are human-readable descriptions."""

    data: str
    split: str
    train: Dataset
    test: Dataset

    def shorten_windows(self, samples: int) -> Parts:
        """Return the same parts with shorter windows; raises as `shorten_windows`."""
        return replace(
            self, train=shorten_windows(self.train, samples), test=shorten_windows(self.test, samples)
        )


def open_data(path: Path) -> Source:
    """Open DeepUWB's pickle (`.pkl`) or any recording; raises as `open_recording`."""
    return DeepUwbRecording(path) if path.suffix == ".pkl" else open_recording(path)


def load_paper_data(
    path: Path, preprocessing: Preprocessing, on_record: Callable[[], None] = lambda: None
) -> tuple[str, bool, Dataset]:
    """Return the recording's name, whether it is simulated, and its labelled measurements.

    Raises:
        RecordingError, DatasetError: it cannot be read, or no measurement is usable.
    """
    with open_data(path) as source:
        dataset = build_dataset(source, preprocessing, on_record)
        name, simulated = path.resolve().name, bool(source.simulated)
    return (f"{name} (simulated)" if simulated and "simulated" not in name else name), simulated, dataset


def split_dataset(name: str, dataset: Dataset, split: str) -> Parts:
    """Return training and test part by one of `SPLITS`; raises as `split_by_name`."""
    description, rows = split_by_name(dataset.configurations, split)
    return Parts(name, description, dataset.rows(rows.train), dataset.rows(rows.test))


def shorten_windows(dataset: Dataset, samples: int) -> Dataset:
    """Return the same measurements with shorter windows, scaled again where scaling is by the maximum.

    Raises:
        ParameterError: longer than the existing windows.
    """
    if not 1 <= samples <= dataset.preprocessing.samples:
        raise ParameterError(f"window of {samples} samples", valid=f"1 to {dataset.preprocessing.samples}")
    inputs = dataset.inputs[:, :samples]
    if dataset.preprocessing.scaling is Scaling.MAX:
        peak = inputs.max(axis=1, keepdims=True)
        inputs = inputs / np.where(peak > 0, peak, np.float32(1))
    preprocessing = Preprocessing(samples, dataset.preprocessing.scaling)
    return replace(dataset, preprocessing=preprocessing, inputs=np.ascontiguousarray(inputs))


def fingerprint(text: str, *datasets: Dataset) -> int:
    """Return a checksum of options and data, to recognise the results of an earlier run."""
    checksum = zlib.crc32(text.encode())
    for dataset in datasets:
        for array in (dataset.inputs, dataset.error_m):
            checksum = zlib.crc32(array.tobytes(), checksum)
    return checksum
