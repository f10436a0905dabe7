"""Random buildings: seeded, balanced over conditions, and the same as records and as arrays."""

from __future__ import annotations

import numpy as np
import pytest

from uwb_mitigation.errors import ParameterError
from uwb_mitigation.evaluation.dataset import Dataset, build_dataset
from uwb_mitigation.preprocessing import Preprocessing
from uwb_mitigation.sources.simulated_buildings import SimulatedBuildings
from uwb_mitigation.sources.simulation import buildings
from uwb_mitigation.sources.simulation.buildings import (
    BUILDINGS,
    PLACEMENTS,
    RADIO,
    WIDE_KINDS,
    block_of,
    draw_plan,
)
from uwb_mitigation.sources.simulation.channel import Multipath
from uwb_mitigation.sources.simulation.radio import Boards, Reception
from uwb_mitigation.training.simulated import building_dataset

BLOCKS = 8


@pytest.fixture(scope="module")
def world() -> Dataset:
    return building_dataset(5, BLOCKS, Preprocessing(), workers=2)


def arrays(dataset: Dataset) -> list[bytes]:
    columns = (dataset.inputs, dataset.range_m, dataset.error_m, dataset.configurations, dataset.labels)
    return [column.tobytes() for column in columns]


def test_the_same_whatever_the_number_of_workers(world: Dataset) -> None:
    assert arrays(building_dataset(5, BLOCKS, Preprocessing(), workers=1)) == arrays(world)


def test_another_seed_is_another_world(world: Dataset) -> None:
    other = building_dataset(6, 1, Preprocessing(), workers=1)
    assert not np.isin(other.error_m, world.error_m).any()


def test_records_and_arrays_are_one_world(world: Dataset) -> None:
    count = PLACEMENTS + 40
    records = build_dataset(SimulatedBuildings(seed=5, placements=count), Preprocessing())
    first = world.rows(np.arange(len(records)))
    assert records.inputs.tobytes() == first.inputs.tobytes()
    assert (records.configurations == first.configurations).all()
    assert (records.labels == first.labels).all()
    np.testing.assert_allclose(records.error_m, first.error_m, atol=1e-12)


def test_conditions_are_balanced_and_few_frames_are_lost(world: Dataset) -> None:
    share = {name: np.mean(world.labels == name) for name in ("LOS", "NLOS", "NDP NLOS")}
    assert sum(share.values()) == pytest.approx(1.0)
    assert min(share.values()) > 0.15
    assert max(share.values()) < 0.5
    assert len(world) > 0.85 * BLOCKS * PLACEMENTS


def test_the_error_is_the_channels_alone(world: Dataset) -> None:
    los, nlos, ndp = (world.error_m[world.labels == name] for name in ("LOS", "NLOS", "NDP NLOS"))
    assert np.median(los) == pytest.approx(0.0, abs=0.03)
    assert 0.1 < np.median(nlos) < 0.4 < np.median(ndp)
    # Noise before the path is taken for it now and then; nothing else comes early.
    assert np.mean(world.error_m < -0.15) < 0.01


def test_within_a_placement_the_error_is_nearly_constant_and_placements_differ() -> None:
    data = build_dataset(SimulatedBuildings(seed=5, placements=60, exchanges=6), Preprocessing())
    groups = [data.error_m[data.configurations == name] for name in data.names]
    assert len(groups) > 45
    assert np.median([group.std() for group in groups if len(group) == 6]) < 0.04
    assert np.std([group.mean() for group in groups]) > 0.2


@pytest.mark.parametrize("kind", WIDE_KINDS, ids=lambda kind: kind.name)
def test_plans_hold_what_their_kind_says(kind: buildings.Kind) -> None:
    rng = np.random.default_rng(0)
    plans = [draw_plan(kind, rng) for _ in range(30)]
    for plan in plans:
        assert kind.length_m[0] <= plan.size[0] <= kind.length_m[1]
        assert kind.width_m[0] <= plan.size[1] <= kind.width_m[1]
        assert all(0.006 <= wall.thickness_m <= 0.5 for wall in plan.walls)
        for wall in plan.walls:
            ends = np.array([wall.start, wall.end])
            assert (ends >= -1e-9).all()
            assert (ends <= np.add(plan.size, 1e-9)).all()
    if kind.name not in ("hall", "open"):
        assert np.mean([len(plan.walls) for plan in plans]) > 3
    assert any(plan.screens for plan in plans)


def test_a_block_holds_placements_of_its_buildings() -> None:
    block, _ = block_of(1, 3)
    assert set(block.building.tolist()) <= set(range(BUILDINGS))
    assert len(block.boards.gain_db) == PLACEMENTS
    assert set(np.unique(block.boards.preamble_symbols + buildings.DETECTION_SYMBOLS)) == set(
        buildings.PREAMBLES
    )


def test_open_sites_are_in_line_of_sight_and_some_antennas_are_tilted() -> None:
    blocks = [block_of(7, number, wide=True)[0] for number in range(40)]
    crossings = {
        kind: np.concatenate([block.links.path.crossings for block in blocks if block.kind == kind])
        for kind in ("open", "flat")
    }
    # A block takes a third of each condition as far as a site has them.
    assert np.mean(crossings["open"] == 0) > 0.45 > 0.4 > np.mean(crossings["flat"] == 0)
    # In line of sight nothing but a tilted antenna weakens the direct path.
    loss = [block.links.path.loss_db[block.links.path.crossings == 0] for block in blocks]
    tilted = [values.max() > 0.0 for values in loss if len(values)]
    assert 0.1 < np.mean(tilted) < 0.5


@pytest.mark.parametrize("distance_m", [(0.0, 3.0), (3.0, 8.0), (12.0, 50.0)])
def test_behind_obstacles_what_goes_around_comes_later_the_longer_the_way(
    distance_m: tuple[float, float],
) -> None:
    blocks = [block_of(5, number)[0] for number in range(12)]
    distance = np.concatenate([block.links.distance_m for block in blocks])
    first = np.concatenate([block.links.fields[1].delay_ns[:, 0] for block in blocks])
    here = (distance >= distance_m[0]) & (distance < distance_m[1])
    # Of the environments 2.7 ns at 4 m, and never more than three times as much.
    expected = 2.7 * np.minimum(distance[here] / 4.0, 3.0)
    assert here.sum() > 100
    assert np.mean(first[here] / expected) == pytest.approx(1.0, abs=4.0 / np.sqrt(here.sum()))
    in_sight = np.concatenate([block.links.fields[0].delay_ns[:, 0] for block in blocks])
    assert (in_sight == 0.0).all()


def lone_path(gain_db: float) -> Multipath:
    return Multipath(np.zeros((64, 1)), np.full((64, 1), 10.0 ** (gain_db / 20.0) + 0j))


def test_boards_shift_level_count_and_sensitivity() -> None:
    def received(gain_db: float) -> Reception:
        boards = Boards(np.full(64, gain_db), np.full(64, RADIO.noise_figure_db), np.full(64, 104.0))
        return RADIO.receive(lone_path(-66.0), np.random.default_rng(1), boards)

    plain = RADIO.receive(lone_path(-66.0), np.random.default_rng(1))
    assert np.median(plain.rx_power_dbm - received(-10.0).rx_power_dbm) == pytest.approx(9.0, abs=1.5)
    assert (received(-10.0).preamble_count == 104).all()
    # A tenth of the preamble costs 10 dB of sensitivity.
    assert np.isnan(received(-12.0).error_m).all()


@pytest.mark.parametrize("direct_db", [-104.0, -80.0])
def test_the_margin_foretells_what_is_detected(direct_db: float) -> None:
    diffuse_db = -70.0
    path = lone_path(direct_db)
    late = Multipath(np.tile([0.0, 60.0], (64, 1)), np.hstack([path.gain, lone_path(diffuse_db).gain]))
    margin = RADIO.direct_margin_db(np.full(64, direct_db), np.full(64, diffuse_db), RADIO.boards(64))
    found = RADIO.receive(late, np.random.default_rng(2)).direct_above_threshold
    assert found.mean() == pytest.approx(float((margin > 0).mean()), abs=0.1)


@pytest.mark.parametrize("words", [{"placements": 0}, {"exchanges": 0}, {"seed": -1}, {"exchanges": 1001}])
def test_arguments_out_of_range_are_refused(words: dict[str, int]) -> None:
    with pytest.raises(ParameterError):
        SimulatedBuildings(**words)
