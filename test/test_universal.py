"""The universal model, trained with few simulated buildings."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from uwb_mitigation.commands.cli import app
from uwb_mitigation.mitigation.model.bundle import load_bundle
from uwb_mitigation.mitigation.preprocessing import Scaling

torch = pytest.importorskip("torch", reason="training is not set up: run make setup-training")

from uwb_mitigation.training import universal  # noqa: E402
from uwb_mitigation.training.fit.options import FitOptions  # noqa: E402
from uwb_mitigation.training.universal import TrainingPlan  # noqa: E402

SMALL = TrainingPlan(seed=3, samples=32, blocks=2, held_out_blocks=1, fit=FitOptions(epochs=2, batch=64))


def test_command_writes_both_bundles_with_the_error_by_condition(tmp_path: Path) -> None:
    words = ["train-universal", "-o", str(tmp_path / "a.onnx"), "--float", str(tmp_path / "b.onnx")]
    words += ["--samples", "8", "--scaling", "max", "--blocks", "1", "--json", str(tmp_path / "a.json")]
    words += ["--radio", "dw3000", "--workers", "1"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    made, floating = (load_bundle(tmp_path / name) for name in ("a.onnx", "b.onnx"))
    assert (made.quantised, floating.quantised) == (True, False)
    assert made.preprocessing.scaling is Scaling.MAX
    assert made.card.source == "DW3000 STS"
    assert "experimental, no real recording was available" in made.card.origin
    ood_bands = made.card.ood_bands
    assert ood_bands is not None
    assert not ood_bands.needs_levels
    assert ood_bands.lead_level_db is not None
    result = json.loads((tmp_path / "a.json").read_text())
    assert result["model_id"] == made.model_id
    assert result["simulated"]
    held_out = result["held_out"]
    assert list(held_out) == ["raw", "constant", "line in levels", "float", "int8"]
    assert all(set(row) == {"all", "LOS", "NLOS", "NDP NLOS"} for row in held_out.values())
    assert held_out["raw"]["LOS"]["mae"] < held_out["raw"]["NDP NLOS"]["mae"]
    mae_m = {row: by["all"]["mae"] for row, by in held_out.items()}
    assert mae_m["line in levels"] < mae_m["constant"] < mae_m["raw"]


def test_model_of_the_dw1000_uses_early_paths() -> None:
    card = universal.train_universal_model(SMALL, "small", workers=1).card
    assert card.source == "DW1000 IPATOV"
    assert card.channels == universal.CHANNELS
    assert card.early_path


@pytest.mark.parametrize(
    ("words", "excerpt"),
    [
        ("--samples 2000", "1016"),
        ("--scaling loud", "preamble"),
        ("--radio dw1001", "dw1000"),
        ("--seed -1", "seed"),
        ("--blocks 0", "blocks"),
        ("--workers 0", "workers"),
    ],
)
def test_invalid_training_is_refused(tmp_path: Path, words: str, excerpt: str) -> None:
    done = CliRunner().invoke(app, ["train-universal", "-o", str(tmp_path / "a.onnx"), *words.split()])
    assert done.exit_code != 0
    assert excerpt in done.output + str(done.exception)
    assert not list(tmp_path.iterdir())
