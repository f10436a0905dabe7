"""What a report looks at in labelled data: windows of one scale, the groups it draws, and statistics. Pure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.dataset import Dataset
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.evaluation.results import TrainedModel, clean
from uwb_mitigation.evaluation.splits import AUTO, by_name
from uwb_mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.sources import deepuwb

LOS = "LOS"
NO_LABEL = "no label"


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """Labelled data, and what a person calls it.

    Attributes:
        name: of the data, fit for a page.
        simulated: no radio was involved.
        dataset: n measurements with windows of the longest K.
        has_rooms: the configurations are DeepUWB's.
    """

    name: str
    simulated: bool
    dataset: Dataset
    has_rooms: bool

    @classmethod
    def of(cls, name: str, simulated: bool, dataset: Dataset) -> Study:
        """Tell by the names of the configurations whether the data has rooms."""
        return cls(clean(name), simulated, dataset, deepuwb.has_rooms(dataset.configurations))

    @property
    def title(self) -> str:
        """The name, with the word "simulated" where it is."""
        is_said = "simulated" in self.name.lower()
        return f"{self.name} (simulated)" if self.simulated and not is_said else self.name

    @property
    def labels(self) -> NDArray[np.str_]:
        """Propagation condition of each row; never empty."""
        return _each(self.dataset.labels, lambda label: clean(label, 40) or NO_LABEL)

    @property
    def places(self) -> NDArray[np.str_]:
        """The room of each row, or its configuration where the data has no rooms."""
        if self.has_rooms:
            return _each(self.dataset.configurations, lambda name: deepuwb.ROOMS[deepuwb.room_of(name)])
        return _each(self.dataset.configurations, lambda name: clean(name, 40) or "no name")

    @property
    def materials(self) -> NDArray[np.str_]:
        """What stands between the antennas, of each row; the label where the data does not say."""
        return _each(self.dataset.configurations, _material) if self.has_rooms else self.labels

    @property
    def has_placements(self) -> bool:
        """Whether a configuration is one placement of both antennas; DeepUWB tells only room and materials."""
        return not self.has_rooms or bool(
            (np.char.find(self.dataset.configurations, "/placement ") >= 0).all()
        )

    @property
    def amplitudes(self) -> NDArray[np.float32]:
        """Magnitudes of the windows, float32 (n, K), the largest of each being 1."""
        return _scaled_by_maximum(self.dataset.inputs, self.dataset.preprocessing.scaling)

    @property
    def published(self) -> bool:
        """Whether the rows of each room are as many as in the published DeepUWB."""
        if not self.has_rooms:
            return False
        counts = {name: int((self.places == name).sum()) for name in deepuwb.ROOMS}
        return tuple(counts.values()) == deepuwb.ROOM_ROWS

    def test_rows(self, n: int, mae_raw: float | None) -> NDArray[np.intp] | None:
        """The rows that a training was tested on, recognised by their number and their raw MAE.

        None where they cannot be told: no errors are then shown rather than those of other rows.
        """
        try:
            rows = by_name(self.dataset.configurations, AUTO)[1].test
        except DatasetError:
            return None
        raw = float(np.abs(self.dataset.error_m[rows]).mean())
        return rows if len(rows) == n and mae_raw is not None and abs(raw - mae_raw) < 1e-6 else None

    def window(self, rows: NDArray[np.intp], preprocessing: Preprocessing) -> NDArray[np.float32] | None:
        """Network inputs of rows, float32 (n, K); None where the windows at hand do not give them."""
        inputs = self.dataset.inputs[rows, : preprocessing.samples]
        if inputs.shape[1] < preprocessing.samples:
            return None
        if preprocessing.scaling is not Scaling.MAX:
            return inputs if preprocessing.scaling is self.dataset.preprocessing.scaling else None
        return _scaled_by_maximum(inputs, self.dataset.preprocessing.scaling)


def _scaled_by_maximum(inputs: NDArray[np.float32], scaling: Scaling) -> NDArray[np.float32]:
    """Windows of either scaling as magnitudes, the largest of each being 1."""
    # PREAMBLE is a square root; its factor cancels.
    magnitudes = inputs**2 if scaling is Scaling.PREAMBLE else inputs
    peak = magnitudes.max(axis=1, keepdims=True)
    return np.asarray(magnitudes / np.where(peak > 0, peak, 1), np.float32)


@dataclass(frozen=True, slots=True)
class Box:
    """A distribution of signed errors, m: median, quartiles, and the 5th and 95th percentile; n of them."""

    low: float
    first: float
    median: float
    third: float
    high: float
    n: int

    @classmethod
    def of(cls, error_m: NDArray[np.floating]) -> Box:
        """Of errors (n,), n at least 1."""
        low, first, median, third, high = (float(v) for v in np.percentile(error_m, (5, 25, 50, 75, 95)))
        return cls(low, first, median, third, high, len(error_m))


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """A window to show: amplitudes (K,), the largest being 1; the error it came with, and its condition."""

    label: str
    error_m: float
    amplitudes: NDArray[np.float32]


def examples(study: Study, most: int = 3) -> list[Example]:
    """One window of each condition, LOS first: the one whose error is the median of its kind."""
    labels, errors = study.labels, study.dataset.error_m
    amplitudes = study.amplitudes
    found = []
    for label in sorted(
        np.unique(labels).tolist(), key=lambda name: (name != LOS, -int((labels == name).sum()), name)
    )[:most]:
        rows = np.flatnonzero(labels == label)
        row = rows[np.argsort(errors[rows], kind="stable")[(len(rows) - 1) // 2]]
        found.append(Example(label, float(errors[row]), amplitudes[row]))
    return found


def agrees(model: TrainedModel, left_m: NDArray[np.floating]) -> bool:
    """Whether errors left on the test rows are those that the training wrote down."""
    mae = model.left.all.mae
    return mae is not None and abs(float(np.abs(left_m).mean()) - mae) < 1e-4


def _material(configuration: str) -> str:
    materials = deepuwb.materials_of(configuration)
    if not materials:
        return "none (LOS)"
    return materials[0] if len(materials) == 1 else "several"


def _each(names: NDArray[np.str_], shown: Callable[[str], str]) -> NDArray[np.str_]:
    """`shown` of each name; called once for each that differs."""
    unique, inverse = np.unique(names, return_inverse=True)
    return np.array([shown(str(name)) for name in unique])[inverse]
