"""A model where it was not surveyed: with no offset, with one known distance in sight, with all but one placement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.mitigation import Grader
from uwb_mitigation.model.bundle import Bundle, Card, Session

LOS = "LOS"

NAMES = ("universal", "universal_los_offset", "universal_offset")
"""The rows: no offset; the median of the line-of-sight placements' errors taken off; that of all other placements."""


@dataclass(frozen=True, slots=True, eq=False)
class ZeroShot:
    """What a bundle that knows nothing of the place leaves of n measurements.

    Attributes:
        errors: {row of `NAMES`: float64 (n,), m}; without a placement in line of sight, `universal_los_offset` is
            `universal`.
        los_offset_m: what was taken off; 0 without a placement in line of sight.
        variance_m2: float32 (n,), as promised.
        sigmas95: deviations that are to cover 95 %.
        passed: bool (n,), not corrected.
    """

    errors: dict[str, NDArray[np.float64]]
    los_offset_m: float
    variance_m2: NDArray[np.float32]
    sigmas95: float
    passed: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Graded:
    """What a model makes of its predictions: corrections (0 where it passes a range through) and variances, each (n,)."""

    correction_m: NDArray[np.float32]
    variance_m2: NDArray[np.float32]
    passed: NDArray[np.bool_]


def grade(dataset: Dataset, card: Card, predicted_m: NDArray[np.float32]) -> Graded:
    """Apply the limits, the OOD score and the variances of a card to predictions, shape (n,)."""
    grader = Grader(card)
    score = grader.score(
        dataset.inputs,
        dataset.range_m.astype(np.float32),
        dataset.rx_power_dbm,
        dataset.first_path_power_dbm,
    )
    corrects = grader.passes(predicted_m, score)
    with np.errstate(invalid="ignore"):
        correction, variance = grader.grade(predicted_m, score)
    uncorrected = np.float32(card.variance_uncorrected_m2)
    return Graded(np.where(corrects, correction, 0.0), np.where(corrects, variance, uncorrected), ~corrects)


def run(dataset: Dataset, bundle: Bundle) -> ZeroShot:
    """Correct a dataset that is preprocessed as for `bundle`.

    The offset of a pair of boards is a median over placements: errors of one placement are not independent.

    Raises:
        ModelError: ONNX Runtime refuses the bundle's network.
    """
    prior = bundle.card.prior.predict_m(dataset.rx_power_dbm, dataset.first_path_power_dbm)
    predicted = (prior + Session(bundle).predict_m(dataset.inputs)).astype(np.float32)
    graded = grade(dataset, bundle.card, predicted)
    left = dataset.error_m - graded.correction_m

    names, of = np.unique(dataset.configurations, return_inverse=True)
    means = np.bincount(of, left) / np.bincount(of)
    is_los = np.array([(dataset.labels[of == k] == LOS).mean() > 0.5 for k in range(len(names))])
    los_offset = float(np.median(means[is_los])) if is_los.any() else 0.0
    others = np.array([np.median(np.delete(means, k)) if len(means) > 1 else 0.0 for k in range(len(means))])
    errors = dict(zip(NAMES, (left, left - los_offset, left - others[of]), strict=True))
    sigmas95 = bundle.card.interval95_sigmas
    return ZeroShot(errors, los_offset, graded.variance_m2, sigmas95, graded.passed)
