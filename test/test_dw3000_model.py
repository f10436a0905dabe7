"""The experimental model for STS windows of a DW3000: simulated receiver, window lengths, and its automatic choice."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_material import write_records
from typer.testing import CliRunner

from uwb_mitigation.commands.cli import app
from uwb_mitigation.commands.support.bundles import bundle_for
from uwb_mitigation.errors import ModelError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path, shipped_model_path
from uwb_mitigation.mitigation.preprocessing import Scaling
from uwb_mitigation.simulation.buildings import block_of
from uwb_mitigation.simulation.radio import DW3000_STS
from uwb_mitigation.types.measurement import Cir, RadioType, RangeMeasurement, Record, Segment, Status

UNUSED_SEED = 424_242
MODEL = load_bundle(shipped_model_path("dw3000_sts"))


@pytest.fixture(scope="module")
def received() -> tuple[list[RangeMeasurement], np.ndarray]:
    """Ranges with the whole CIR, and their errors, in buildings that were not used for the training or its evaluation."""
    ranges, errors = [], []
    for number in range(3):
        block, rng = block_of(UNUSED_SEED, number, radio=DW3000_STS)
        reception = DW3000_STS.receive(block.pairs.multipath(rng), rng, block.boards)
        for row in np.flatnonzero(np.isfinite(reception.first_path_index)):
            index = float(reception.first_path_index[row])
            cir = Cir(reception.samples[row], 0, 0, index, radio=RadioType.DW3000, segment=Segment.STS)
            range_m = float(block.pairs.distance_m[row] + reception.error_m[row])
            ranges.append(RangeMeasurement(0, 1, 2, 0, 0, range_m, cir))
            errors.append(reception.error_m[row])
    return ranges, np.array(errors)


def windows(ranges: list[RangeMeasurement], taps: int, lead: int = 5) -> list[RangeMeasurement]:
    """Return the ranges with windows as a UCI board delivers them."""
    cut = []
    for each in ranges:
        start = int(each.cir.first_path_index) - lead
        samples = each.cir.samples[2 * start : 2 * (start + taps)]
        cut.append(replace(each, cir=replace(each.cir, samples=samples, start_index=start)))
    return cut


def test_windows_of_all_lengths_get_the_same_useful_correction(received) -> None:
    ranges, error_m = received
    reference = Mitigation(MODEL).correct(windows(ranges, 157))
    for taps, lead in ((16, 5), (32, 5), (64, 5), (16, 8)):
        assert Mitigation(MODEL).correct(windows(ranges, taps, lead)) == reference
    assert np.mean([each.status.is_corrected for each in reference]) > 0.95
    constant_m = np.abs(error_m - np.median(error_m)).mean()
    for shift, share in ((0, 0.85), (-1, 0.9), (1, 0.9)):
        cirs = [replace(each.cir, first_path_index=each.cir.first_path_index + shift) for each in ranges]
        shifted = [replace(each, cir=cir) for each, cir in zip(ranges, cirs, strict=True)]
        corrections = [each.correction_m for each in Mitigation(MODEL).correct(shifted)]
        assert np.abs(error_m - corrections).mean() < share * constant_m


def test_it_is_chosen_for_a_recording_of_the_sts_and_marked_as_experimental(received, tmp_path: Path) -> None:
    ranges = windows(received[0][:5], 16)
    recording = tmp_path / "sts.mcap"
    write_records(recording, (Record(each) for each in ranges))
    assert bundle_for(None, recording).model_id == MODEL.model_id
    assert MODEL.card.label == "dw3000_sts (experimental)"
    for scaling in Scaling:
        other = Mitigation(load_bundle(default_model_path(scaling)))
        assert {each.status for each in other.correct(ranges)} == {Status.OUT_OF_DISTRIBUTION}
        assert "experimental" not in other.bundle.card.label


def test_firmware_of_a_dw1000_gets_no_model_for_a_dw3000(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["board", "export-c", "--model", "dw3000_sts", "-o", str(tmp_path / "c")])
    assert isinstance(done.exception, ModelError)
    assert "DW3000 STS" in str(done.exception)
