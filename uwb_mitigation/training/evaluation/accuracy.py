"""Evaluate models on a labelled recording with the same code as for live measurements."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from uwb_mitigation.errors import DatasetError
from uwb_mitigation.mitigation.correction import Mitigation
from uwb_mitigation.training.evaluation.metrics import ErrorStatistics, GroupMae, coverage, mae_by_group
from uwb_mitigation.types.measurement import Record


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Accuracy of a model, or of several, on one recording.

    Attributes:
        n: number of measurements with a true range and a valid range.
        raw, corrected: statistics of the errors before and after correction.
        coverage68, coverage95: shares of corrected errors within the predicted intervals: 1 and
            `interval95_sigmas` reported standard deviations.
        by_label, by_configuration: {name: (n, MAE before, MAE after)}.
        statuses: {status: number of measurements}.
        model_id: id of the model of most ranges.
        trained_on: configurations that are also in its training data according to the card. If not empty, the
            result is optimistic.
    """

    n: int
    raw: ErrorStatistics
    corrected: ErrorStatistics
    coverage68: float
    coverage95: float
    by_label: Mapping[str, GroupMae]
    by_configuration: Mapping[str, GroupMae]
    statuses: Mapping[str, int]
    model_id: int
    trained_on: tuple[str, ...]


def evaluate_accuracy(mitigation: Mitigation, records: Iterable[Record]) -> Accuracy:
    """Correct every measurement that has a true range and a valid range, and compare it with the truth.

    Raises:
        DatasetError: no measurement can be compared.
    """
    rows: list[tuple[float, float, float, str, str, int]] = []
    statuses: Counter[str] = Counter()
    read = 0
    for record, result in mitigation.correct_records(records):
        read += 1
        truth = record.truth
        # An infinite variance marks an invalid range.
        if truth is None or not np.isfinite(truth.range_m + result.variance_m2):
            continue
        errors = result.range_raw_m - truth.range_m, result.range_m - truth.range_m
        rows.append((*errors, result.variance_m2, truth.label, truth.configuration, result.model_id))
        statuses[result.status.name] += 1
    if not rows:
        raise DatasetError(f"none of {read} measurements has a valid range and a true one")
    *columns, model_ids = zip(*rows, strict=True)
    raw_m, corrected_m, variances, labels, configurations = map(np.array, columns)
    cards = {bundle.model_id: bundle.card for bundle in mitigation.bundles}
    model_id = max(cards, key=model_ids.count)
    # This part of the card is for people and may contain any JSON value.
    known = cards[model_id].training.get("configurations")
    names = set(configurations.tolist())
    trained_on = [name for name in names if isinstance(known, list) and name in known]
    return Accuracy(
        n=len(rows),
        raw=ErrorStatistics.of(raw_m),
        corrected=ErrorStatistics.of(corrected_m),
        coverage68=coverage(corrected_m, variances, 1.0),
        coverage95=coverage(
            corrected_m, variances, np.array([cards[model_id].interval95_sigmas for model_id in model_ids])
        ),
        by_label=mae_by_group(labels, raw_m, corrected_m),
        by_configuration=mae_by_group(configurations, raw_m, corrected_m),
        statuses=dict(statuses.most_common()),
        model_id=model_id,
        trained_on=tuple(sorted(trained_on)),
    )
