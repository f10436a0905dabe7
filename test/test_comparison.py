"""`evaluate --cross-validate`: rows of the table on the same held-out configurations, and its JSON."""

from __future__ import annotations

import json

import numpy as np
import pytest
from model_material import dataset
from typer.testing import CliRunner

from uwb_mitigation.commands.cli import app
from uwb_mitigation.mitigation.model.architecture import Remnet

pytest.importorskip("torch", reason="run `make setup-training`")
from uwb_mitigation.training import comparison
from uwb_mitigation.training.data import recordings
from uwb_mitigation.training.fit import candidates
from uwb_mitigation.training.fit.candidates import Recipe
from uwb_mitigation.training.fit.options import FitOptions

RECIPE = Recipe(Remnet(samples=8), FitOptions(epochs=1))


@pytest.fixture(scope="module", autouse=True)
def _short():
    """Train the network for a few epochs only, to save time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(candidates, "NETWORK_ONLY", FitOptions(epochs=1))
        yield


@pytest.fixture(scope="module")
def found() -> comparison.Comparison:
    data = dataset(12, 6, samples=8)
    return comparison.compare_models(data, RECIPE, folds=3, seeds=2)


def test_coverage_is_computed_from_the_stated_intervals(found):
    everything, by_label = found.coverage[""], {k: v for k, v in found.coverage.items() if k}
    assert 0 <= everything[0] <= everything[1] <= 1
    counts = [np.sum(dataset(12, 6, samples=8).labels == label) for label in by_label]
    assert np.array(counts) / 72 @ np.array(list(by_label.values())) == pytest.approx(everything)


def test_measurements_without_levels_are_skipped():
    data = dataset(8, 4, samples=8)
    data.rx_power_dbm[data.configurations == "c0"] = np.nan
    found = comparison.compare_models(data, RECIPE, folds=2, seeds=1)
    assert found.configurations == 7
    assert np.isfinite([row.mae_mean for row in found.rows]).all()


def run(*arguments: object):
    return CliRunner().invoke(app, [str(value) for value in arguments], catch_exceptions=True)


def test_command_writes_the_documented_keys(tmp_path, monkeypatch, found):
    monkeypatch.setattr(recordings, "load_dataset", lambda *_: ("made up", dataset(12, 6, samples=8)))
    monkeypatch.setattr(comparison, "compare_models", lambda *_: found)
    result = run(
        "evaluate", "--data", tmp_path, "--cross-validate", "configuration", "--json", tmp_path / "c.json"
    )
    assert result.exit_code == 0, result.output
    written = json.loads((tmp_path / "c.json").read_text())
    assert [row["name"] for row in written["rows"]] == list(comparison.NAMES)
    assert all(set(row) == {"name", "mae_mean", "mae_std", "by_label", "ci95"} for row in written["rows"])
    assert (written["coverage68"], written["coverage95"]) == found.coverage[""]
    assert set(written["coverage_by_label"]) == {"LOS", "NLOS"}
