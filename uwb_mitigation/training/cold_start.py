"""What `train` has from simulated buildings: a network that knows no wall of the site, but what walls do.

With few placements it is the start: an offset of the site's own is all that is fitted. With twenty or more it may be
averaged with the site's own line: a line of three coefficients errs by its own scatter, the network by what is
particular to the site, and their mean has less of either.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uwb_mitigation.evaluation import lad
from uwb_mitigation.evaluation.dataset import Dataset
from uwb_mitigation.model import floating
from uwb_mitigation.model.bundle import Bundle
from uwb_mitigation.model.float_networks import float_network, scaled
from uwb_mitigation.model.prior import LinePrior
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training import choosing
from uwb_mitigation.training.choosing import Candidate, Fitted

NAME, MEAN = NAMES = ("cold start", "line and cold start")

ENOUGH_FOR_MEAN = 20
"""Configurations: a line that was fitted to fewer is not averaged with."""

MUST_GAIN = 0.10
"""With fewer than that, what another candidate must gain on the cold start: errors on so few configurations tell only
what is far off."""


def offered(candidates: Sequence[Candidate], dataset: Dataset, source: Bundle) -> list[Candidate]:
    """The candidates and those of this module, if the dataset is preprocessed as for `source`.

    The cold start comes first where configurations are few, and otherwise behind the constant. The mean comes
    behind the line, if there are enough configurations with power levels.
    """
    if dataset.preprocessing != source.preprocessing:
        return list(candidates)
    network = float_network(source)
    start = Candidate(NAME, lambda data, seed: (_offset(data, network), network))
    if is_few(dataset):
        return [start, *candidates]
    half = scaled(network, 0.5)
    known = np.isfinite(dataset.rx_power_dbm - dataset.first_path_power_dbm)
    has_line = len(dataset.rows(known).names) >= ENOUGH_FOR_MEAN

    def mean(data: Dataset, seed: int) -> Fitted:
        line, offset = choosing.line(data), _offset(data, network).offset_m
        total = (line.offset_m + offset, line.per_rx_power, line.per_power_gap)
        return LinePrior(*(float(np.float32(value / 2)) for value in total)), half

    behind = {choosing.CONSTANT: [start], choosing.LINE: [Candidate(MEAN, mean)] if has_line else []}
    return [item for one in candidates for item in (one, *behind.get(one.name, ()))]


def is_few(dataset: Dataset) -> bool:
    """Whether the cold start is preferred."""
    return len(dataset.names) < ENOUGH_FOR_MEAN


def _offset(data: Dataset, network: FloatWeights) -> LinePrior:
    return lad.constant(data.configurations, data.error_m - floating.predict_m(network, data.inputs))
