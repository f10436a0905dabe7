"""Create the card of a trained bundle: variances, correction limits and origin of the model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.model.architecture import Architecture
from uwb_mitigation.mitigation.model.bundle import ModelCard
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.ood import OodBands, ood_features
from uwb_mitigation.mitigation.preprocessing import Scaling
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.evaluation.intervals import fit_intervals


def card_of(
    name: str,
    architecture: Architecture,
    dataset: Dataset,
    linear_bias: LinearBiasModel,
    held_out: Dataset,
    residual_m: NDArray[np.floating],
    training: Mapping[str, Any],
    ood_bands: OodBands | None = None,
) -> ModelCard:
    """Return the card of a float model.

    Variances are conformal (see `evaluation.intervals`). The variance of corrected ranges is computed from the residuals
    on held-out configurations, the variance of passed-through ranges from the raw errors.

    Args:
        name: human-readable name.
        architecture: shape of the network.
        dataset: training data of the model.
        linear_bias: linear bias model.
        held_out: n held-out measurements.
        residual_m: errors of the held-out measurements after correction, (n,), m.
        training: human-readable origin of the model.
        ood_bands: in-distribution bands; None: unknown.

    Raises:
        DatasetError: no error is finite.
    """
    low, high = float(dataset.error_m.min()), float(dataset.error_m.max())
    margin = max(high - low, 0.1) / 2
    corrected = fit_intervals(residual_m, held_out.error_m - residual_m, held_out.configurations)
    uncorrected = fit_intervals(dataset.error_m, np.zeros(len(dataset)), dataset.configurations)
    return ModelCard(
        name=name,
        architecture=architecture,
        preprocessing=dataset.preprocessing,
        linear_bias=linear_bias,
        quantised=False,
        variance_m2=corrected.variance_m2,
        variance_uncorrected_m2=uncorrected.variance_m2,
        correction_limits_m=(float(np.float32(low - margin)), float(np.float32(high + margin))),
        training=training,
        scale=corrected.scale,
        interval95_sigmas=corrected.sigmas95,
        ood_bands=ood_bands,
        radios=dataset.radios,
        segments=dataset.segments,
        channels=dataset.channels,
    )


def ood_bands_of(dataset: Dataset, known_offset_m: float | None = None) -> OodBands | None:
    """Return the in-distribution bands of a model that was fitted to `dataset`.

    Without levels (scaling MAX), only features that need no levels have bands. Returns None if a model needs levels
    and no measurement has both powers.
    """
    scaling = dataset.preprocessing.scaling
    with_levels = scaling is Scaling.PREAMBLE
    unknown = np.full(len(dataset), np.nan, np.float32)
    levels = (dataset.rx_power_dbm, dataset.first_path_power_dbm) if with_levels else (unknown, unknown)
    features = ood_features(dataset.inputs, scaling, dataset.range_m.astype(np.float32), *levels)
    values = np.column_stack(features)
    if with_levels and not np.isfinite(values).all(axis=1).any():
        return None
    if known_offset_m is not None:
        return OodBands.of(known_offset_m, values)
    means = [dataset.error_m[dataset.configurations == name].mean() for name in dataset.names]
    return OodBands.of(float(np.median(means)), values)
