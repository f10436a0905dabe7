"""The model for places that it never saw: made from the seed alone, whatever the number of processes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from uwb_mitigation.commands.cli import app
from uwb_mitigation.errors import ParameterError
from uwb_mitigation.model.bundle import load_bundle
from uwb_mitigation.preprocessing import Scaling

torch = pytest.importorskip("torch", reason="training is not set up: run make setup-training")

from uwb_mitigation.training import augmentation, universal  # noqa: E402
from uwb_mitigation.training.options import FitOptions  # noqa: E402
from uwb_mitigation.training.universal import Plan, Universal  # noqa: E402

SMALL = Plan(seed=3, samples=32, blocks=2, held_out_blocks=1, fit=FitOptions(epochs=2, batch=64))


@pytest.fixture(scope="module")
def small() -> Universal:
    return universal.train(SMALL, "small", workers=1)


def test_the_same_whatever_the_number_of_workers(small: Universal) -> None:
    again = universal.train(SMALL, "small", workers=2)
    assert again.card == small.card
    for name, weight in small.network.weight.items():
        assert again.network.weight[name].tobytes() == weight.tobytes()


def test_it_is_graded_by_condition_in_another_world(small: Universal) -> None:
    for row in ("raw", "float", "int8"):
        assert set(small.held_out[row]) == {"all", "LOS", "NLOS", "NDP NLOS"}
    assert small.held_out["raw"]["LOS"].mae < small.held_out["raw"]["NDP NLOS"].mae


def test_decays_vary_behind_the_first_path_alone_and_some_inputs_are_louder() -> None:
    inputs = torch.ones(4000, 157) * torch.linspace(1.0, 0.1, 157)
    varied = augmentation.vary_channel(inputs, torch.Generator().manual_seed(0)).numpy()
    gain = varied[:, 0]
    assert gain.min() == 1.0
    assert np.mean(gain > 1.0) == pytest.approx(augmentation.LOUDER_SHARE, abs=0.03)
    assert gain.max() == pytest.approx(10 ** (augmentation.LOUDER_DB / 40), rel=0.02)
    first = augmentation.FIRST_VARIED
    np.testing.assert_allclose(
        varied[:, : first + 1], gain[:, None] * inputs[:, : first + 1].numpy(), rtol=1e-6
    )
    # An amplitude is the square of an input.
    decay = 2.0 * np.log(varied[:, first + 100] / gain / inputs[0, first + 100].item())
    assert np.mean(decay) == pytest.approx(0.0, abs=0.05)
    assert np.std(decay) == pytest.approx(augmentation.DECAY_NEPERS, rel=0.05)


def test_receivers_vary_in_pulse_first_path_clipping_and_length() -> None:
    inputs = torch.zeros(4000, 157)
    inputs[:, 7], inputs[:, 100] = 1.0, 0.5
    varied = augmentation.vary_receiver(inputs, torch.Generator().manual_seed(0)).numpy()
    assert np.isfinite(varied).all()
    assert varied.min() == 0.0
    ends_early = varied[:, 98:103].max(axis=1) == 0.0
    share = augmentation.OTHER_RECEIVERS
    assert 0.4 < ends_early.mean() / (share * augmentation.DAMAGED_SHARE) < 1.3
    amplitude = varied[:, 5:10] ** 2
    place = (amplitude @ np.arange(5, 10)) / amplitude.sum(axis=1)
    assert np.abs(place - 7.0).max() <= augmentation.EARLY_TAPS + 0.1
    assert np.mean(np.abs(place - 7.0) > 1e-6) == pytest.approx(share, abs=0.05)
    assert np.std(place) == pytest.approx(augmentation.EARLY_TAPS * np.sqrt(share / 3.0), rel=0.15)


def test_the_command_writes_both_bundles(tmp_path: Path) -> None:
    words = ["train-universal", "-o", str(tmp_path / "a.onnx"), "--float", str(tmp_path / "b.onnx")]
    words += ["--samples", "8", "--scaling", "max", "--blocks", "1", "--json", str(tmp_path / "a.json")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    made, floating = (load_bundle(tmp_path / name) for name in ("a.onnx", "b.onnx"))
    assert made.quantised
    assert not floating.quantised
    assert made.preprocessing.scaling is Scaling.MAX
    familiarity = made.card.familiarity
    assert familiarity is not None
    assert not familiarity.needs_levels
    assert familiarity.lead_level_db is not None
    result = json.loads((tmp_path / "a.json").read_text())
    assert result["model_id"] == made.model_id
    assert result["simulated"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--samples", "2000"], "1016"),
        (["--scaling", "loud"], "preamble"),
        (["--seed", "-1"], "seed"),
        (["--blocks", "0"], "blocks"),
        (["--workers", "0"], "workers"),
    ],
)
def test_what_cannot_be_trained_is_refused(tmp_path: Path, words: list[str], told: str) -> None:
    done = CliRunner().invoke(app, ["train-universal", "-o", str(tmp_path / "a.onnx"), *words])
    assert isinstance(done.exception, ParameterError)
    assert told in str(done.exception)
    assert not list(tmp_path.iterdir())
