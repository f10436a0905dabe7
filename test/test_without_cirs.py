"""Models and offsets for ranges without CIRs: constants and lines in the levels. All data is simulated here."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_material import write_records
from command_line import run, succeed
from model_material import changed

from uwb_mitigation.calibration.radio_offsets import estimate_offset
from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.model.shipped import default_model_path
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.training.data.dataset import Dataset, build_dataset
from uwb_mitigation.training.fit.linear_fit import fit_linear_bias_to_rows
from uwb_mitigation.types.measurement import Cir, RangeMeasurement, Record, Truth

EMPTY = np.zeros(0, np.int16)


def ranges(environments: int = 10, seed: int = 0) -> list[Record]:
    """Environments with LOS and NLOS placements; the error grows with the power gap, with a long tail."""
    rng, records = np.random.default_rng(seed), []
    for environment in range(environments):
        shift = rng.normal(0.0, 0.03)
        for placement in range(12):
            nlos = rng.random() < 0.5
            distance = rng.uniform(2.0, 9.0)
            excess = rng.exponential(0.7) if nlos else 0.0
            for _ in range(15):
                gap = rng.normal(12.0 + 6.0 * excess, 2.0) if nlos else rng.normal(3.0, 1.0)
                level = -75.0 - 20.0 * np.log10(distance / 2.0) - 4.0 * nlos + rng.normal(0.0, 0.5)
                error = -0.05 + shift + excess + rng.normal(0.0, 0.05)
                stamp_ns, number = 10**18 + len(records) * 10**8, len(records)
                ids = 7, 1 + placement, number, 0
                cir = Cir(EMPTY, rx_power_dbm=level, first_path_power_dbm=level - gap)
                truth = Truth(distance, "NLOS" if nlos else "LOS", f"environment {environment}")
                records.append(Record(RangeMeasurement(stamp_ns, *ids, distance + error, cir), truth))
    return records


def dataset(records: list[Record]) -> Dataset:
    return build_dataset(records, Preprocessing(157, Scaling.PREAMBLE))


def mae(values: np.ndarray) -> float:
    return float(np.abs(values).mean())


@pytest.mark.parametrize("has_levels", [False, True])
def test_line_of_sight_is_spared_also_if_most_ranges_are_not(has_levels: bool):
    generator = np.random.default_rng(3)
    is_los = np.arange(1000) % 10 < 3
    error = np.where(is_los, 0.0, 0.9) + generator.normal(0.0, 0.05, 1000)
    levels = generator.uniform(-95.0, -75.0, (2, 1000)) if has_levels else np.full((2, 1000), np.nan)
    left = error - fit_linear_bias_to_rows(*levels, error, is_los).predict_m(*levels)
    assert mae(left[is_los]) < mae(error[is_los]) + 0.03


def test_cirs_are_preferred_to_ranges_without():
    bare = ranges(1)
    strong = np.full(2 * 200, 100, np.int16)
    cir = replace(bare[0].measurement.cir, samples=strong, first_path_index=20.0, preamble_count=128)
    mixed = dataset([*bare[1:5], changed(bare[0], cir), *bare[5:9]])
    assert mixed.has_cirs
    assert len(mixed) == 1
    assert sum(mixed.skipped.values()) == 8


def test_train_and_evaluate_without_cirs(tmp_path: Path):
    write_records(tmp_path / "bare.mcap", ranges())
    succeed("train", "--data", "bare.mcap", "-o", "line.onnx", "--json", "train.json", folder=tmp_path)
    trained = json.loads((tmp_path / "train.json").read_text())
    assert trained["choice"]["chosen"] == "line"
    assert {row["name"] for row in trained["rows"]} == {"raw", "overall_median", "l1_line", "float"}
    assert trained["improved"]
    assert not load_bundle(tmp_path / "line.onnx").card.needs_cir

    succeed("evaluate --data bare.mcap --model line.onnx --json e.json", folder=tmp_path)
    result = json.loads((tmp_path / "e.json").read_text())
    assert set(result["statuses"]) <= {"OK", "UNRELIABLE"}
    assert result["corrected"]["mae"] < 0.7 * result["raw"]["mae"]
    los = result["by_label"]["LOS"]
    assert los["corrected_mae"] < los["raw_mae"] + 0.03

    words = "evaluate --data bare.mcap --cross-validate configuration --seeds 1 --json c.json"
    succeed(words, folder=tmp_path)
    compared = json.loads((tmp_path / "c.json").read_text())
    assert 0 < compared["coverage68"] < compared["coverage95"] <= 1
    assert set(compared["coverage_by_label"]) == {"LOS", "NLOS"}
    rows = {row["name"]: row["mae_mean"] for row in compared["rows"]}
    assert list(rows) == ["raw", "los_median", "overall_median", "l1_line", "shipped_float"]
    assert rows["l1_line"] < 0.7 * rows["raw"]

    refused = run("train", "--data", "bare.mcap", "-o", "n.onnx", "--recipe", "network", folder=tmp_path)
    assert refused.returncode != 0
    assert "no CIRs, which networks need" in refused.stderr


def test_ranges_without_first_path_level_are_passed_through(tmp_path: Path):
    records = ranges()
    records[::5] = [changed(record, {"first_path_power_dbm": np.nan}) for record in records[::5]]
    write_records(tmp_path / "some.mcap", records)
    done = succeed("train", "--data", "some.mcap", "-o", "line.onnx", "--json", "t.json", folder=tmp_path)
    mae_m = {row["name"]: row["mae"] for row in json.loads((tmp_path / "t.json").read_text())["rows"]}
    assert 0.2 * mae_m["raw"] < mae_m["l1_line"] < 0.8 * mae_m["raw"]
    command = ("evaluate", "--data", "some.mcap", "--cross-validate", "configuration", "--seeds", 1)
    done = run(*command, folder=tmp_path)
    assert "360 ranges without receive or first-path level are left out" in done.stdout, done.stderr


@pytest.mark.parametrize("levels", [{"rx_power_dbm": -80.0, "first_path_power_dbm": -82.0}, {}])
def test_offset_without_cirs_prefers_labels_to_levels_and_needs_none(tmp_path: Path, levels: dict):
    universal = Mitigation(load_bundle(default_model_path()))
    records = [changed(record, Cir(EMPTY, **levels)) for record in ranges(4)]
    found = estimate_offset(universal, records)
    assert {one.refused for one in found.placements} == {"", "not line of sight: labelled as NLOS"}
    assert found.offset_m == pytest.approx(-0.05, abs=0.05)
    write_records(tmp_path / "bare.mcap", records)
    assert "nan" not in succeed("offset", "bare.mcap", "--truth", folder=tmp_path).stdout
    blocked = [record for record in records if record.truth is not None and record.truth.label == "NLOS"]
    with pytest.raises(DatasetError, match="labelled as NLOS"):
        estimate_offset(universal, blocked)
