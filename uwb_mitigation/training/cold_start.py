"""Few configurations: half a line of their own, half a network that was trained in a simulated flat.

A line of three coefficients, fitted to a dozen configurations, errs by its own scatter; the network knows no wall of
the site, but what walls do. Their errors have little in common, so that their mean has less of either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from uwb_mitigation.dataset import Dataset
from uwb_mitigation.evaluation import lad
from uwb_mitigation.model import floating
from uwb_mitigation.model.architecture import HEAD
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.model.prior import LinePrior
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training import choosing
from uwb_mitigation.training.choosing import Candidate, Fitted
from uwb_mitigation.training.site import float_network

NAME = "cold start"

MOST_CONFIGURATIONS = 18
"""With more, a line of one's own is as good or better (docs/evaluation.md)."""

MUST_GAIN = 0.10
"""What another candidate must gain on it: errors on so few configurations tell only what is far off."""


def offered(candidates: Sequence[Candidate], dataset: Dataset, source: Bundle) -> list[Candidate]:
    """The candidates, behind the cold start where the dataset is small, is preprocessed as for `source`, and has
    ranges with power levels in as many configurations as a line needs, or in all of fewer.
    """
    count = len(dataset.names)
    known = np.isfinite(dataset.rx_power_dbm - dataset.first_path_power_dbm)
    has_powers = len(dataset.rows(known).names) >= min(count, lad.MIN_CONFIGURATIONS)
    is_alike = dataset.preprocessing == source.preprocessing
    if count > MOST_CONFIGURATIONS or not (has_powers and is_alike):
        return list(candidates)
    return [candidate(source), *candidates]


def candidate(source: Bundle) -> Candidate:
    """The mean of the dataset's line, and of the source's network with the dataset's offset.

    Raises:
        ModelError: the source's network is no REMNet.
    """
    network = float_network(source)
    half = _halved(network)

    def fit(data: Dataset, seed: int) -> Fitted:
        line = choosing.line(data)
        left = data.error_m - floating.predict_m(network, data.inputs)
        offset = lad.constant(data.configurations, left).offset_m
        total = (line.offset_m + offset, line.per_rx_power, line.per_power_gap)
        return LinePrior(*(float(np.float32(value / 2)) for value in total)), half

    return Candidate(NAME, fit)


def _halved(network: FloatWeights) -> FloatWeights:
    """The network that predicts half as much."""
    weight = {**network.weight, HEAD: network.weight[HEAD] * np.float32(0.5)}
    bias = {**network.bias, HEAD: network.bias[HEAD] * np.float32(0.5)}
    return replace(network, weight=weight, bias=bias)
