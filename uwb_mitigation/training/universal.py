"""Train a model for unknown sites and boards in simulated buildings, and evaluate it in other ones.

The model is not fitted to errors of real ranges. Each step was kept because it improved the results on the real logs
or in held-out simulated buildings (models/universal.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from uwb_mitigation.mitigation.model import floating
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.bundle import ModelCard
from uwb_mitigation.mitigation.model.integer import IntegerNetwork
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.weights import FloatWeights, Int8Weights
from uwb_mitigation.mitigation.preprocessing import Preprocessing, Scaling
from uwb_mitigation.simulation.buildings import PLACEMENTS, RADIO, WIDE_SHARE
from uwb_mitigation.simulation.radio import Receiver
from uwb_mitigation.training.data import augmentation
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.data.simulated import building_dataset
from uwb_mitigation.training.evaluation.intervals import fit_scale, sigmas95_of
from uwb_mitigation.training.evaluation.metrics import ErrorStatistics
from uwb_mitigation.training.fit.fitting import fit
from uwb_mitigation.training.fit.linear_fit import fit_linear_bias_to_rows
from uwb_mitigation.training.fit.model_card import card_of, ood_bands_of
from uwb_mitigation.training.fit.options import FitOptions
from uwb_mitigation.training.fit.quantisation import quantise_network
from uwb_mitigation.training.fit.selection import step_counter

CALIBRATION_INPUTS = 512
WIDE_SHARES = {Scaling.PREAMBLE: WIDE_SHARE, Scaling.MAX: 1.0}
"""Share of the blocks with other boards and sites. Without levels, boards differ more: with half of the blocks, the model has 1.09
instead of 1.03 times the error of a constant in the hall of the second simulator (docs/experiments/second_simulator.py)."""

CONDITION_SHARES = {"LOS": 0.43, "NLOS": 0.52, "NDP NLOS": 0.05}
"""Frequencies of the conditions in simulated drives at sites and in flats, with which the scale is fitted."""

CHANNELS = (1, 2, 3, 5)
"""Channels on which the standard deviations are right (docs/experiments/other_channels.py). Channel 2 is simulated; the others have its
bandwidth and another frequency."""

HELD_OUT_SEED = 1_000_003
"""Added to the seed to get the held-out buildings for the evaluation."""

RECIPE = FitOptions(epochs=10, learning_rate=1e-3, batch=64, dropout=0.1)


@dataclass(frozen=True, slots=True)
class TrainingPlan:
    """Training plan of a universal model.

    Attributes:
        seed: seed of the buildings and of the network.
        samples: window length K.
        scaling: preamble, or max for windows without preamble counts.
        blocks, held_out_blocks: number of blocks of 256 placements for training and for evaluation.
        fit: training options; the seed is that of the plan.
        radio: type of the radios.
    """

    seed: int = 0
    samples: int = 157
    scaling: Scaling = Scaling.PREAMBLE
    blocks: int = 400
    held_out_blocks: int = 40
    fit: FitOptions = RECIPE
    radio: Receiver = RADIO


@dataclass(frozen=True, slots=True, eq=False)
class UniversalModel:
    """Trained universal model and its evaluation.

    Attributes:
        card: card of the float network; for int8 only `quantised` differs.
        network, integers: float and int8.
        held_out: {row: {label: statistics}} in the held-out simulated buildings: `raw`; two baselines that are fitted to
            the training data, `constant` and `line in levels`; `float` and `int8`.
    """

    card: ModelCard
    network: FloatWeights
    integers: Int8Weights
    held_out: dict[str, dict[str, ErrorStatistics]]


def train_universal_model(
    plan: TrainingPlan,
    name: str,
    workers: int,
    on_progress: Callable[[str, float], None] = lambda stage, fraction: None,
) -> UniversalModel:
    """Train the model of `plan`. The result does not depend on `workers`; `on_progress` gets the stage and its finished share."""
    preprocessing = Preprocessing(plan.samples, plan.scaling)
    total_blocks = plan.blocks + plan.held_out_blocks
    count_block = step_counter(total_blocks, lambda fraction: on_progress("simulating", fraction))
    # Augmentation needs the levels, even if the scaling removes them.
    level_preprocessing = Preprocessing(plan.samples)
    train_data = building_dataset(
        plan.seed,
        plan.blocks,
        level_preprocessing,
        workers,
        count_block,
        radio=plan.radio,
        wide_share=WIDE_SHARES[plan.scaling],
    )
    held_out = building_dataset(
        plan.seed + HELD_OUT_SEED, plan.held_out_blocks, preprocessing, workers, count_block, radio=plan.radio
    )
    count_epoch = step_counter(plan.fit.epochs, lambda fraction: on_progress("training", fraction))
    options = replace(plan.fit, seed=plan.seed)
    # The network does not correct missed direct paths: nothing in its window shows them.
    early_m = train_data.early_path_m
    network_data = train_data if early_m is None else train_data.rows(np.isnan(early_m))
    network = fit(
        Remnet(samples=plan.samples),
        network_data.inputs,
        network_data.error_m,
        options,
        count_epoch,
        vary=_vary_levels if plan.scaling is Scaling.PREAMBLE else _vary_amplitudes,
    )
    subset = network_data.inputs[:: max(1, len(network_data) // CALIBRATION_INPUTS)]
    integers = quantise_network(network, augmentation.scaled_calibration_inputs(subset, plan.scaling))
    return _evaluate(plan, name, network, integers, train_data, held_out)


def _vary_levels(inputs: Tensor, generator: torch.Generator) -> Tensor:
    return augmentation.vary_noise(augmentation.vary_channel(inputs, generator), generator)


def _vary_amplitudes(inputs: Tensor, generator: torch.Generator) -> Tensor:
    # The simulated boards of the wide blocks already differ in noise.
    return augmentation.normalised(
        augmentation.vary_receiver(augmentation.vary_channel(inputs, generator), generator)
    )


def _evaluate(
    plan: TrainingPlan,
    name: str,
    network: FloatWeights,
    integers: Int8Weights,
    train_data: Dataset,
    test: Dataset,
) -> UniversalModel:
    """Return intervals, limits and in-distribution bands from the held-out buildings `test`."""
    error = test.error_m
    line = fit_linear_bias_to_rows(
        train_data.rx_power_dbm,
        train_data.first_path_power_dbm,
        train_data.error_m,
        train_data.labels == "LOS",
    )
    errors = {
        "raw": error,
        "constant": error - np.median(train_data.error_m),
        "line in levels": error - line.predict_m(test.rx_power_dbm, test.first_path_power_dbm),
    }
    for row, predict_m in (
        ("float", partial(floating.predict_m, network)),
        ("int8", IntegerNetwork(integers).predict_m),
    ):
        errors[row] = error - test.with_early_paths(predict_m(test.inputs)).astype(float)
    conditions = {"all": np.ones(len(test), np.bool_)} | {
        str(label): test.labels == label for label in np.unique(test.labels)
    }
    statistics = {
        row: {label: ErrorStatistics.of(values[rows]) for label, rows in conditions.items()}
        for row, values in errors.items()
    }
    balanced = _balanced_rows(test.labels)
    card = card_of(
        name,
        network.architecture,
        test,
        LinearBiasModel(0.0),
        test.rows(balanced),
        errors["float"][balanced],
        _description(plan, statistics),
        # The correction shrinks to zero out of distribution, because an offset depends on the radio, not on the channel.
        ood_bands_of(test, known_offset_m=0.0),
    )
    channels = CHANNELS if plan.radio == RADIO else ()
    card = replace(card, early_path=test.early_path_m is not None, channels=channels)
    if plan.scaling is Scaling.PREAMBLE:
        # Without levels, conformal intervals are better: on the EVK1000 logs the 68 % intervals cover 69 instead of 86 %.
        card = with_scale(card, test, errors["int8"])
    return UniversalModel(card, network, integers, statistics)


def with_scale(card: ModelCard, test: Dataset, residual_m: NDArray[np.floating]) -> ModelCard:
    """Return a card with the scale of residuals, m, (n,), in the held-out buildings `test`."""
    predicted, weight = test.error_m - residual_m, np.empty(len(test))
    for label, share in CONDITION_SHARES.items():
        weight[test.labels == label] = share / max(int((test.labels == label).sum()), 1)
    scale = fit_scale(residual_m, predicted, weight)
    rows = _balanced_rows(test.labels)
    deviation = np.interp(np.abs(predicted[rows]), *np.array(scale).T)
    sigmas95 = sigmas95_of(residual_m[rows], deviation, test.configurations[rows])
    return replace(card, scale=scale, interval95_sigmas=sigmas95)


def _description(
    plan: TrainingPlan, statistics: Mapping[str, Mapping[str, ErrorStatistics]]
) -> dict[str, object]:
    """Return the origin of the model for its card."""
    evidence = "no radio was involved"
    if plan.radio != RADIO:
        evidence = "experimental, no real recording was available"
    return {
        "data": f"simulated buildings, seed {plan.seed}: {evidence}",
        "boards": f"simulated {plan.radio.kind.name}s whose powers, antennas and preambles differ; no site",
        "placements": plan.blocks * PLACEMENTS,
        "split": f"graded in simulated buildings, seed {plan.seed + HELD_OUT_SEED}",
        "seed": plan.seed,
        "recipe": asdict(replace(plan.fit, seed=plan.seed)),
        "metrics_m": {
            row: {key: round(value, 4) for key, value in asdict(statistics[row]["all"]).items()}
            for row in ("raw", "float", "int8")
        },
    }


def _balanced_rows(labels: NDArray[np.str_]) -> NDArray[np.intp]:
    """Return rows with each condition equally often: its frequency at a site is unknown, and the intervals must be valid in all of them."""
    conditions = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    return np.concatenate([batch[: min(map(len, conditions))] for batch in conditions])
