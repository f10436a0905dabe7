"""Evaluate a model at an unknown site without offset, with the LOS offset, and with that of all other placements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.correction import CorrectionRule
from uwb_mitigation.mitigation.model.bundle import Bundle, ModelCard, Session
from uwb_mitigation.training.data.dataset import Dataset

LOS = "LOS"

NAMES = ("universal", "universal_los_offset", "universal_offset")
"""Rows: no offset; minus the median error of the LOS placements; minus the median error of all other placements."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Residuals and predictions of n measurements that no model was fitted to.

    Attributes:
        errors: {row: float64 (n,), m}.
        variance_m2: predicted variances, (n,).
        sigmas95: number of standard deviations that should cover 95 %, (n,).
        passed_through: bool (n,), not corrected.
    """

    errors: Mapping[str, NDArray[np.float64]]
    variance_m2: NDArray[np.floating]
    sigmas95: NDArray[np.float64]
    passed_through: NDArray[np.bool_]


def correct_with_card(
    dataset: Dataset, card: ModelCard, predicted_m: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Apply the limits, the OOD score and the variances of a card to predictions, shape (n,).

    Returns:
        Corrections (0 if a range is passed through), m; variances, m^2; and which ranges are passed through; each (n,).
    """
    rule = CorrectionRule(card)
    levels = dataset.rx_power_dbm, dataset.first_path_power_dbm
    with np.errstate(over="ignore", invalid="ignore"):
        score = rule.score(dataset.inputs, dataset.range_m.astype(np.float32), *levels)
        accepted = np.array(rule.accepts(predicted_m, score))
        correction, variance = rule.apply(predicted_m, score)
    uncorrected = np.float32(card.variance_uncorrected_m2)
    return np.where(accepted, correction, 0.0), np.where(accepted, variance, uncorrected), ~accepted


def evaluate_zero_shot(dataset: Dataset, bundle: Bundle) -> HeldOut:
    """Correct a dataset that is preprocessed as for `bundle`; return the rows `NAMES`.

    The offset of a pair of boards is a median over placements: errors of one placement are not independent. Without LOS
    placements, `universal_los_offset` equals `universal`.

    Raises:
        ModelError: ONNX Runtime rejects the bundle's network.
    """
    linear_bias = bundle.card.linear_bias.predict_m(dataset.rx_power_dbm, dataset.first_path_power_dbm)
    network_m = Session(bundle).predict_m(dataset.inputs)
    if bundle.card.early_path:
        network_m = dataset.with_early_paths(network_m).astype(np.float32)
    predicted = (linear_bias + network_m).astype(np.float32)
    correction_m, variance_m2, is_passed_through = correct_with_card(dataset, bundle.card, predicted)
    residual = dataset.error_m - correction_m

    _, configuration_index = np.unique(dataset.configurations, return_inverse=True)
    count = np.bincount(configuration_index)
    means = np.bincount(configuration_index, residual) / count
    is_los = np.bincount(configuration_index, dataset.labels == LOS) > 0.5 * count
    los_offset = float(np.median(means[is_los])) if is_los.any() else 0.0
    offset_of_others = np.array(
        [np.median(np.delete(means, k)) if len(means) > 1 else 0.0 for k in range(len(means))]
    )
    residuals = residual, residual - los_offset, residual - offset_of_others[configuration_index]
    errors = dict(zip(NAMES, residuals, strict=True))
    sigmas95 = np.full(len(dataset), bundle.card.interval95_sigmas)
    return HeldOut(errors, variance_m2, sigmas95, is_passed_through)
