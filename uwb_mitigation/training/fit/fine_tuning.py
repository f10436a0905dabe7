"""Train the universal network further on the ranges of a site. Needs torch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.weights import FloatWeights
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.fit import fitting, linear_fit
from uwb_mitigation.training.fit.options import FitOptions

OPTIONS = FitOptions(epochs=2, learning_rate=3e-4, dropout=0.2)
"""In five of six simulated sites, the network with these options reduces the live position error by 1 to 24 % more than the
universal one."""

PER_CONFIGURATION, MAX_INPUTS = 6, 2500
"""Maximum number of inputs per configuration, and in total: more cost time and hardly change the result."""

SEED = 0


def fine_tune(
    network: FloatWeights, data: Dataset, universal_m: NDArray[np.float64]
) -> tuple[LinearBiasModel, FloatWeights]:
    """Return a constant, and a network for the remaining errors of ranges.

    Args:
        network: the universal network.
        data: n ranges with CIRs.
        universal_m: its predictions for them, float64 (n,), m.

    Raises:
        DatasetError: see `fitting.fit`.
    """
    constant = linear_fit.fit_constant(data.configurations, data.error_m - universal_m)
    subset = data.rows(splits.subsample(data.configurations, PER_CONFIGURATION, SEED))
    if len(subset) > MAX_INPUTS:
        chosen = np.random.default_rng(SEED).choice(len(subset), MAX_INPUTS, replace=False)
        subset = subset.rows(np.sort(chosen))
    options, targets = replace(OPTIONS, seed=SEED), subset.error_m - constant.offset_m
    return constant, fitting.fit(network.architecture, subset.inputs, targets, options, start=network)
