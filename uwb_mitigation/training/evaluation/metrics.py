"""Statistics of range errors (measured - true, or corrected - true), in metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import DatasetError


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Statistics of range errors in metres.

    Attributes:
        mae: mean absolute error.
        std: standard deviation of the signed error.
        p95: 95th percentile of the absolute error.
    """

    mae: float
    std: float
    p95: float

    @classmethod
    def of(cls, error_m: NDArray[np.floating]) -> ErrorStatistics:
        """Return the statistics of errors of shape (n,).

        Raises:
            DatasetError: `error_m` is empty, or a value is not finite.
        """
        if len(error_m) == 0 or not np.isfinite(error_m).all():
            raise DatasetError(
                f"statistics of {len(error_m)} errors", valid="at least one, all of them finite"
            )
        magnitude = np.abs(error_m)
        return cls(float(magnitude.mean()), float(np.std(error_m)), float(np.percentile(magnitude, 95)))


class GroupMae(NamedTuple):
    """Number of ranges of a group and their MAE before and after correction, m."""

    n: int
    raw_mae: float
    corrected_mae: float


def mae_by_group(
    names: NDArray[np.str_], raw_m: NDArray[np.floating], corrected_m: NDArray[np.floating]
) -> dict[str, GroupMae]:
    """Return {name: MAE of `raw_m` and `corrected_m`} of errors of shape (n,), in order of first use."""
    groups = {}
    for name in dict.fromkeys(names.tolist()):
        rows = names == name
        groups[name] = GroupMae(
            int(rows.sum()), float(np.abs(raw_m[rows]).mean()), float(np.abs(corrected_m[rows]).mean())
        )
    return groups


def coverage(
    error_m: NDArray[np.floating],
    variance_m2: NDArray[np.floating] | float,
    sigmas: NDArray[np.floating] | float,
) -> float:
    """Return the share of errors within `sigmas` standard deviations of zero."""
    return float(np.mean(np.abs(error_m) <= sigmas * np.sqrt(variance_m2)))


def bootstrap_interval(
    error_m: NDArray[np.floating], configurations: NDArray[np.str_]
) -> tuple[float, float]:
    """Return the 95 % interval of the MAE of errors (n,) by resampling whole configurations with replacement.

    Percentile bootstrap (Efron and Tibshirani, "An Introduction to the Bootstrap", chapter 13) over clusters.
    """
    _, configuration_index, count = np.unique(configurations, return_inverse=True, return_counts=True)
    total = np.bincount(configuration_index, np.abs(error_m))
    drawn = np.random.default_rng(0).integers(0, len(count), (2000, len(count)))
    low, high = np.percentile(total[drawn].sum(axis=1) / count[drawn].sum(axis=1), (2.5, 97.5))
    return float(low), float(high)


def mae_after_rejection(
    error_m: NDArray[np.floating], variance_m2: NDArray[np.floating], rejected: float
) -> float:
    """Return the MAE of errors (n,) after rejecting the share `rejected` with the largest variances."""
    accepted = np.argsort(variance_m2, kind="stable")[: max(1, round((1 - rejected) * len(error_m)))]
    return float(np.abs(error_m[accepted]).mean())
