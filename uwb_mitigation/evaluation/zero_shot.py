"""A model where it was not surveyed: with no offset, with one known distance in sight, with all but one placement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.mitigation import Grader
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.model.runtime import Session

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


def run(dataset: Dataset, bundle: Bundle) -> ZeroShot:
    """Correct a dataset that is preprocessed as for `bundle`.

    The offset of a pair of boards is a median over placements of what is left in them: errors of one placement
    are not independent.

    Raises:
        ModelError: ONNX Runtime refuses the bundle's network.
    """
    card = bundle.card
    grader = Grader(card)
    score = grader.score(
        dataset.inputs,
        dataset.range_m.astype(np.float32),
        dataset.rx_power_dbm,
        dataset.first_path_power_dbm,
    )
    prior = card.prior.predict_m(dataset.rx_power_dbm, dataset.first_path_power_dbm)
    predicted = (prior + Session(bundle).predict_m(dataset.inputs)).astype(np.float32)
    corrects = grader.passes(predicted, score)
    with np.errstate(invalid="ignore"):
        correction, spread = grader.grade(predicted, score)
    left = dataset.error_m - np.where(corrects, correction, 0.0)
    variance = np.where(corrects, spread, np.float32(card.variance_uncorrected_m2))

    names, of = np.unique(dataset.configurations, return_inverse=True)
    means = np.bincount(of, left) / np.bincount(of)
    is_los = np.array([(dataset.labels[of == k] == LOS).mean() > 0.5 for k in range(len(names))])
    los_offset = float(np.median(means[is_los])) if is_los.any() else 0.0
    others = np.array([np.median(np.delete(means, k)) if len(means) > 1 else 0.0 for k in range(len(means))])
    errors = dict(zip(NAMES, (left, left - los_offset, left - others[of]), strict=True))
    return ZeroShot(errors, los_offset, variance, card.interval95_sigmas, ~corrects)
