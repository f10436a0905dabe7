"""`uwb-mitigation offset`: offset of the radios from a known distance, and refused ranges."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_material import write_records
from command_line import run, succeed
from model_material import amplitudes_only, changed

from uwb_mitigation.calibration.radio_offsets import estimate_offset
from uwb_mitigation.errors import DatasetError, ParameterError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.mitigation.preprocessing import Scaling
from uwb_mitigation.recordings.bag.writer import BagWriter
from uwb_mitigation.simulation.simulated import SimulatedSource
from uwb_mitigation.types.measurement import Cir, RadioType, RangeMeasurement, Record, Segment
from uwb_mitigation.types.offsets import Offsets, parse_offsets

NO_SAMPLES = np.empty(0, np.int16)


@pytest.fixture(scope="module")
def universal() -> Mitigation:
    return Mitigation(load_bundle(default_model_path()))


def labelled(label: str) -> list[Record]:
    """Return simulated ranges with their truth."""
    source = SimulatedSource(seed=11, count=1500)
    return [record for record in source if record.truth is not None and record.truth.label == label]


@pytest.fixture(scope="module")
def direct() -> list[Record]:
    """Return ranges of one pair in LOS."""
    return [changed(record, tag_id=1, anchor_id=2) for record in labelled("LOS")]


def longer(records: list[Record], by_m: float) -> Iterator[Record]:
    for record in records:
        yield changed(record, range_m=record.measurement.range_m + by_m)


def without_levels(records: list[Record]) -> Iterator[Record]:
    """Return the records without preamble counts and levels."""
    unknown = {"rx_power_dbm": float("nan"), "first_path_power_dbm": float("nan")}
    for record in records:
        yield changed(record, amplitudes_only(record.measurement.cir, **unknown))


def test_added_offset_is_estimated(universal: Mitigation, direct: list[Record]):
    before, after = estimate_offset(universal, direct), estimate_offset(universal, longer(direct, 0.625))
    assert after.offset_m - before.offset_m == pytest.approx(0.625, abs=0.02)
    assert after.sd_m == pytest.approx(before.sd_m, abs=0.02)
    assert before.ranges >= 20
    assert len([one for one in before.placements if not one.refused]) > 1
    # The offset of simulated boards.
    assert before.offset_m == pytest.approx(0.22, abs=3.0 * before.sd_m)
    # Offsets that the mitigator already subtracts are not counted twice.
    with_offset = Mitigation(universal.bundle, Offsets(0.625))
    assert estimate_offset(with_offset, longer(direct, 0.625)).offset_m == pytest.approx(
        after.offset_m, abs=0.02
    )


def test_without_levels_los_is_detected_in_the_cir(direct: list[Record]):
    amplitude = Mitigation(load_bundle(default_model_path(Scaling.MAX)))
    found = estimate_offset(amplitude, without_levels(direct))
    assert found.offset_m == pytest.approx(0.22, abs=3.0 * found.sd_m)
    gaps = {one.placement: one.power_gap_db for one in estimate_offset(amplitude, direct).placements}
    for one in found.placements:
        assert one.power_gap_db == pytest.approx(gaps[one.placement], abs=1.0)
    with pytest.raises(DatasetError, match="not line of sight"):
        estimate_offset(amplitude, without_levels(labelled("NDP NLOS")[:1] * 20))


def test_nlos_is_refused_with_the_evidence(universal: Mitigation, direct: list[Record]):
    levels = [{"first_path_power_dbm": one.measurement.cir.first_path_power_dbm - 9.0} for one in direct]
    with pytest.raises(DatasetError, match=r"not line of sight: the first path is \d+\.\d dB below"):
        estimate_offset(universal, map(changed, direct, levels), 3.0)
    no_index = {"rx_power_dbm": float("nan"), "first_path_index": float("nan")}
    with pytest.raises(DatasetError, match="CIRs with levels or a first-path index, or ranges without CIRs"):
        estimate_offset(universal, (changed(record, no_index) for record in direct), 3.0)
    with pytest.raises(DatasetError, match="check the distance"):
        estimate_offset(universal, longer(direct, 20.0), 3.0)
    with pytest.raises(DatasetError, match="only 5 ranges are in line of sight"):
        estimate_offset(universal, [direct[0]] * 5, 3.0)
    with pytest.raises(DatasetError, match="none of 20 ranges has a true distance"):
        estimate_offset(universal, [replace(record, truth=None) for record in direct[:20]])


STS = Cir(np.full(64, 900, np.int16), first_path_index=9.0, radio=RadioType.DW3000, segment=Segment.STS)


@pytest.mark.parametrize("cir", [Cir(NO_SAMPLES), STS])
def test_distance_counts_without_levels_and_cirs_with_a_warning(cir: Cir, tmp_path: Path):
    """The user saw that the radios stood in line of sight; the few taps of an STS do not show it."""
    with BagWriter(tmp_path / "los.mcap", {}) as out:
        for number in range(20):
            range_m = 5.25 + 0.01 * (number % 2)
            out.write(Record(RangeMeasurement(10**8 * number, 1, 7, number, 0, range_m, cir)))
    outcome = succeed("offset los.mcap --distance 5 --model universal", folder=tmp_path)
    assert "offset 0.255 m" in outcome.stdout
    assert "line of sight was not checked" in outcome.stderr


def test_single_distance_needs_a_single_pair(universal: Mitigation, direct: list[Record]):
    two = [changed(record, anchor_id=2 + n % 2) for n, record in enumerate(direct)]
    with pytest.raises(ParameterError, match=r"2 pairs.*--anchor and --tag"):
        estimate_offset(universal, two, 3.0)
    found = estimate_offset(universal, two, anchor_id=3)
    assert {one.anchor_id for one in found.placements} == {3}
    with pytest.raises(DatasetError, match="no ranges of this anchor"):
        estimate_offset(universal, two, anchor_id=9)


def test_los_of_the_real_logs_gives_the_offset_of_the_boards(apartment_imported: Path, tmp_path: Path):
    options = ("--truth", "--common", "-o", "o.yaml", "--json", "o.json", "--model", default_model_path())
    succeed("offset", apartment_imported / "apartment.mcap", *options, folder=tmp_path)
    result = json.loads((tmp_path / "o.json").read_text())
    # The median of the placements that are labelled LOS.
    assert result["offset_m"] == pytest.approx(0.237, abs=2.0 * result["sd_m"])
    assert 0.02 < result["sd_m"] < 0.1
    refused = {pair["placement"].rpartition("/")[2] for pair in result["pairs"] if pair["refused"]}
    # Behind a wall and a cabinet; in the open.
    assert {"27", "51", "18"} <= refused
    assert not {"12", "14", "5"} & refused
    assert result["ranges"] == sum(pair["ranges"] for pair in result["pairs"])
    offsets = parse_offsets((tmp_path / "o.yaml").read_text(), "o.yaml")
    assert offsets.lookup([5], [6])[0] == pytest.approx(result["offset_m"], abs=1e-6)
    assert not offsets.pairs


def test_written_offsets_are_read_by_the_other_commands(direct: list[Record], tmp_path: Path):
    write_records(tmp_path / "los.mcap", longer(direct[:300], 0.5))
    asked = ("offset", "los.mcap", "--truth", "-o", "o.yaml")
    succeed(*asked, folder=tmp_path)
    again = run(*asked, folder=tmp_path)
    assert (again.returncode, "--force" in again.stderr) == (2, True)
    succeed(*asked, "--force", folder=tmp_path)
    errors = {}
    for offsets in ("0", "o.yaml", "0.5"):
        words = f"evaluate --data los.mcap --offsets {offsets} --json e.json"
        succeed(words, folder=tmp_path)
        errors[offsets] = json.loads((tmp_path / "e.json").read_text())["corrected"]["mae"]
    assert errors["o.yaml"] < 0.5 * errors["0"]
    assert errors["0.5"] < errors["0"]
    wrong = run("evaluate", "--data", "los.mcap", "--offsets", "220", folder=tmp_path)
    assert wrong.returncode != 0
    assert "millimetres" in wrong.stderr


def test_ranges_of_another_radio_have_their_whole_error_as_offset(
    universal: Mitigation, direct: list[Record]
):
    dw3000 = {"radio": RadioType.DW3000, "segment": Segment.STS, "preamble_count": 0}
    records = [changed(record, dw3000) for record in longer(direct, 0.4)]
    errors = [record.measurement.range_m - record.truth.range_m for record in records]
    estimate = estimate_offset(universal, records)
    assert estimate.offset_m == pytest.approx(np.median(errors), abs=0.1)
