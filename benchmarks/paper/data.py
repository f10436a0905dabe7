"""The data of an experiment: splits of a recording into a training and a test part, and shorter windows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.paper.rooms import has_rooms, parse_configuration
from uwb_mitigation.errors import DatasetError, ParameterError
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.recordings.formats import open_recording
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset, build_dataset
from uwb_mitigation.training.data.deepuwb import DeepUwbRecording
from uwb_mitigation.training.data.recordings import Counted

TRAINING_ROOMS, TEST_ROOM = (1, 3), 2
"""Rooms of the paper's split: 36,023 training and 13,210 test rows."""

FOLDS = 4
"""Number of folds of data without rooms; one fold is the test part."""


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


def load_paper_data(
    path: Path, preprocessing: Preprocessing, counted: Counted = iter
) -> tuple[str, bool, Dataset]:
    """Return the recording's name, whether it is simulated, and its labelled measurements.

    Raises:
        RecordingError, DatasetError: it cannot be read, or no measurement is usable.
    """
    with (DeepUwbRecording if path.suffix == ".pkl" else open_recording)(path) as source:
        dataset = build_dataset(counted(source), preprocessing)
        name, simulated = path.resolve().name, bool(source.simulated)
    return (f"{name} (simulated)" if simulated and "simulated" not in name else name), simulated, dataset


def split_dataset(name: str, dataset: Dataset) -> Parts:
    """Return training and test part: the paper's rooms, or a quarter of the configurations if the data has no rooms.

    Raises:
        DatasetError: a part is empty.
    """
    if not has_rooms(dataset.configurations):
        fold = splits.by_configuration(dataset.configurations, FOLDS, seed=0)[0]
        description = f"configurations: 1 of {FOLDS} parts held out"
        return Parts(name, description, dataset.rows(fold.train), dataset.rows(fold.test))
    rooms = np.array([parse_configuration(str(configuration))[0] for configuration in dataset.configurations])
    train, test = dataset.rows(np.isin(rooms, TRAINING_ROOMS)), dataset.rows(rooms == TEST_ROOM)
    if not (len(train) and len(test)):
        raise DatasetError(
            f"the paper's split: {len(train)} training rows and {len(test)} test rows",
            valid=f"rows of room {TEST_ROOM} and of rooms {TRAINING_ROOMS}",
        )
    return Parts(name, "paper", train, test)


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
