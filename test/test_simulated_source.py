"""Simulated drives and buildings: seeded, marked as simulated, with the correct truth; equal as records and arrays."""

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from model_material import window_of
from typer.testing import CliRunner

from uwb_mitigation.commands.cli import app
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.mitigation.preprocessing import Preprocessing
from uwb_mitigation.recordings.mcap import McapRecording
from uwb_mitigation.simulation.buildings import PLACEMENTS, block_of
from uwb_mitigation.simulation.channel import RESIDENTIAL_NLOS, DiffuseField, draw_diffuse_field
from uwb_mitigation.simulation.radio import Receiver
from uwb_mitigation.simulation.scene import ROUTE, along_route
from uwb_mitigation.simulation.simulated import NOT_RECEIVED, TAG_ID, SimulatedBuildings, SimulatedSource
from uwb_mitigation.training.data.dataset import Dataset, build_dataset
from uwb_mitigation.training.data.simulated import building_dataset
from uwb_mitigation.types.measurement import Record


def values(record: Record) -> tuple[object, ...]:
    """Return the content of a record for comparison: `Cir` and `RangeMeasurement` compare by identity."""
    m = record.measurement
    fields = [getattr(m, name) for name in m.__slots__ if name != "cir"]
    fields += [getattr(m.cir, name) for name in m.cir.__slots__ if name != "samples"]
    return (*fields, m.cir.samples.tobytes(), record.truth)


@pytest.fixture(scope="module")
def drive() -> list[Record]:
    return list(SimulatedSource(seed=3, count=1500))


def test_same_seed_gives_the_same_measurements() -> None:
    endless = SimulatedSource(seed=5, rate_hz=333.0)
    first = [values(r) for r in itertools.islice(endless, 90)]
    assert [values(r) for r in itertools.islice(endless, 90)] == first
    counted = [values(r) for r in SimulatedSource(seed=5, rate_hz=333.0, count=70)]
    assert counted == first[: len(counted)]


def test_truth_is_the_distance_between_anchor_and_robot() -> None:
    anchors = ((1.0, 1.0), (6.0, 5.0))
    for record in SimulatedSource(count=200, anchors=anchors):
        m, truth = record.measurement, record.truth
        place = along_route(ROUTE, np.array([0.5 * m.stamp_ns / 1e9]))[0]
        assert truth.range_m == pytest.approx(math.dist(place, anchors[m.anchor_id - 1]))
        assert m.tag_id == TAG_ID


def test_exchanges_that_are_not_received_are_counted() -> None:
    source = SimulatedSource(count=400, radio=Receiver(tx_power_dbm=-30.0))
    received = len(list(source))
    assert 0 < received < 400
    assert source.skipped == {NOT_RECEIVED: 400 - received}
    assert len(list(source)) == received
    assert source.skipped[NOT_RECEIVED] == 400 - received


def test_line_of_sight_errors_centre_on_the_offset(drive: list[Record]) -> None:
    error = [r.measurement.range_m - r.truth.range_m for r in drive if r.truth and r.truth.label == "LOS"]
    assert np.median(error) == pytest.approx(Receiver().range_offset_m, abs=0.02)
    assert np.percentile(error, 75) - np.percentile(error, 25) < 0.06


def test_levels_are_of_the_order_of_real_logs(drive: list[Record]) -> None:
    rx = np.array([r.measurement.cir.rx_power_dbm for r in drive])
    gap = rx - [r.measurement.cir.first_path_power_dbm for r in drive]
    peaks = [window_of(r.measurement.cir, Preprocessing())[1].max() for r in drive[::5]]
    assert -101.5 < rx.min() < rx.max() < -77.5
    assert -1.0 < np.percentile(gap, 1) < np.percentile(gap, 99) < 25.0
    assert 0.2 < np.min(peaks) < np.max(peaks) < 1.6


@pytest.mark.parametrize("like", ["buildings", "drive"])
def test_command_writes_a_bag_marked_as_simulated(tmp_path: Path, like: str) -> None:
    ranges = 100
    words = ["data", "simulate", "--like", like, "--ranges", str(ranges), "-o", str(tmp_path / "sim.mcap")]
    words += ["--channel", "5"]
    done = CliRunner().invoke(app, [*words, "--json", str(tmp_path / "sim.json")])
    assert done.exit_code == 0, done.output
    assert "simulated" in done.stdout
    result = json.loads((tmp_path / "sim.json").read_text())
    assert result["simulated"]
    assert result["ranges"] == ranges - result["skipped"].get(NOT_RECEIVED, 0)
    read = McapRecording(tmp_path / "sim.mcap")
    assert read.simulated
    assert [record.measurement.cir.channel for record in read] == [5] * result["ranges"]
    levels = [record.measurement.cir.rx_power_dbm for record in read]
    other = CliRunner().invoke(app, [*words[:-1], "2", "--force"])
    assert other.exit_code == 0, other.output
    wider = [record.measurement.cir.rx_power_dbm for record in McapRecording(tmp_path / "sim.mcap")]
    assert np.nanmean(wider) - np.nanmean(levels) > 0.5, "channel 5 is weaker than channel 2"
    assert "--force" in str(CliRunner().invoke(app, words).exception)


@pytest.mark.parametrize(
    ("options", "excerpts"),
    [
        ({"seed": -1}, ("seed", "-1", "0 to")),
        ({"seed": 1.5}, ("seed", "1.5", "whole number")),
        ({"count": -5}, ("count", "-5", "0 to")),
        ({"rate_hz": math.nan}, ("rate_hz", "nan", "0.1 to 100000")),
        ({"anchors": ()}, ("anchors", "()", "pairs of finite")),
        ({"anchors": ((math.nan, 0.0),)}, ("anchors", "nan", "pairs of finite")),
        ({"route": ((0.0, 0.0), (1.0, 1.0))}, ("route", "2", "3 to 10000")),
    ],
)
def test_invalid_parameter_is_refused(options: dict, excerpts: tuple[str, ...]) -> None:
    with pytest.raises(ParameterError) as caught:
        SimulatedSource(**options)
    assert [excerpt for excerpt in excerpts if excerpt not in str(caught.value)] == []


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


def test_nlos_delay_grows_with_the_distance() -> None:
    blocks = [block_of(5, number)[0] for number in range(24)]
    distance = np.concatenate([block.pairs.distance_m for block in blocks])
    first = np.concatenate([block.pairs.fields[1].delay_ns[:, 0] for block in blocks])
    for near_m, far_m in ((0.0, 3.0), (3.0, 8.0), (12.0, 50.0)):
        here = (distance >= near_m) & (distance < far_m)
        # The delay of the environments is 2.7 ns at 4 m and at most three times as long.
        expected = 2.7 * np.minimum(distance[here] / 4.0, 3.0)
        assert here.sum() > 100
        assert np.mean(first[here] / expected) == pytest.approx(1.0, abs=4.0 / np.sqrt(here.sum()))
    assert (np.concatenate([block.pairs.fields[0].delay_ns[:, 0] for block in blocks]) == 0.0).all()


@pytest.fixture(scope="module")
def moved() -> list[DiffuseField]:
    """Fields of 2,000 pairs behind obstacles: first at the start of a segment, then one per cent, and one half of it later."""
    start, end = (draw_diffuse_field(RESIDENTIAL_NLOS, 2000, np.random.default_rng(n)) for n in (0, 1))
    changes_at = np.random.default_rng(2).random(start.delay_ns.shape)
    return [start.moved(end, np.full(2000, progress), changes_at) for progress in (0.0, 0.01, 0.5)]


def test_fields_change_gradually_along_a_drive(moved: list[DiffuseField]) -> None:
    start, later, half = (field.delay_ns[:, 0] for field in moved)
    assert np.corrcoef(start, later)[0, 1] > 0.95
    assert np.mean(moved[0].nakagami_m == moved[1].nakagami_m) == pytest.approx(0.99, abs=0.001)
    assert np.corrcoef(start, half)[0, 1] < 0.7


def test_fields_in_motion_have_the_distributions_of_placements(moved: list[DiffuseField]) -> None:
    start, _, half = moved
    quantiles = (10, 50, 90)
    for name in ("shadowing_db", "pattern_loss_db", "delay_ns"):
        expected, found = (
            np.percentile(getattr(field, name).reshape(2000, -1)[:, 0], quantiles) for field in (start, half)
        )
        np.testing.assert_allclose(found, expected, rtol=0.15, atol=0.15)


def test_fields_of_two_anchors_change_independently() -> None:
    source = SimulatedSource(seed=4, count=4000, rate_hz=400.0, anchors=((1.0, 1.0), (1.0, 1.0)))
    loss = np.concatenate([batch.pairs.fields[1].shadowing_db for batch, _ in source._batches()])
    assert np.abs(np.diff(loss[::2])).max() < 0.5
    assert np.abs(loss[::2] - loss[1::2]).max() > 1.0
