"""Random buildings: seeded, balanced over conditions, and equal as records and as arrays."""

from __future__ import annotations

import numpy as np
import pytest

from uwb_mitigation.mitigation.preprocessing import Preprocessing
from uwb_mitigation.simulation.buildings import PLACEMENTS, block_of
from uwb_mitigation.simulation.simulated import SimulatedBuildings
from uwb_mitigation.training.data.dataset import Dataset, build_dataset
from uwb_mitigation.training.data.simulated import building_dataset

BLOCKS = 8


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return building_dataset(5, BLOCKS, Preprocessing(), workers=2)


def arrays(dataset: Dataset) -> list[bytes]:
    columns = (dataset.inputs, dataset.range_m, dataset.error_m, dataset.configurations, dataset.labels)
    return [column.tobytes() for column in columns]


def test_result_does_not_depend_on_the_number_of_workers(dataset: Dataset) -> None:
    assert arrays(building_dataset(5, BLOCKS, Preprocessing(), workers=1)) == arrays(dataset)


def test_records_equal_arrays(dataset: Dataset) -> None:
    count = PLACEMENTS + 40
    records = build_dataset(SimulatedBuildings(seed=5, placements=count), Preprocessing())
    first = dataset.rows(np.arange(len(records)))
    assert records.inputs.tobytes() == first.inputs.tobytes()
    assert (records.configurations == first.configurations).all()
    assert (records.labels == first.labels).all()
    np.testing.assert_allclose(records.error_m, first.error_m, atol=1e-12)


def test_conditions_are_balanced_and_few_frames_are_lost(dataset: Dataset) -> None:
    share = {name: np.mean(dataset.labels == name) for name in ("LOS", "NLOS", "NDP NLOS")}
    assert sum(share.values()) == pytest.approx(1.0)
    assert all(0.15 < value < 0.5 for value in share.values())
    assert len(dataset) > 0.85 * BLOCKS * PLACEMENTS


def test_error_contains_only_the_channel(dataset: Dataset) -> None:
    los, nlos, ndp = (dataset.error_m[dataset.labels == name] for name in ("LOS", "NLOS", "NDP NLOS"))
    assert np.median(los) == pytest.approx(0.0, abs=0.03)
    assert 0.1 < np.median(nlos) < 0.4 < np.median(ndp)
    # Noise before the path is sometimes detected as first path; nothing else is early.
    assert np.mean(dataset.error_m < -0.15) < 0.01


@pytest.mark.parametrize("distance_m", [(0.0, 3.0), (3.0, 8.0), (12.0, 50.0)])
def test_nlos_delay_grows_with_the_distance(distance_m: tuple[float, float]) -> None:
    blocks = [block_of(5, number)[0] for number in range(24)]
    distance = np.concatenate([block.pairs.distance_m for block in blocks])
    first = np.concatenate([block.pairs.fields[1].delay_ns[:, 0] for block in blocks])
    here = (distance >= distance_m[0]) & (distance < distance_m[1])
    # The delay of the environments is 2.7 ns at 4 m and at most three times as long.
    expected = 2.7 * np.minimum(distance[here] / 4.0, 3.0)
    assert here.sum() > 100
    assert np.mean(first[here] / expected) == pytest.approx(1.0, abs=4.0 / np.sqrt(here.sum()))
    los = np.concatenate([block.pairs.fields[0].delay_ns[:, 0] for block in blocks])
    assert (los == 0.0).all()
