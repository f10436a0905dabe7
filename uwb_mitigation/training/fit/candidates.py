"""Candidates for model selection: models that can be fitted to labelled ranges, in order of complexity.

`train` chooses between new models (`new_models`) and the universal network with an offset (`with_cold_start`). Only
candidates that train a network need torch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.mitigation.model import graph
from uwb_mitigation.mitigation.model.architecture import Remnet
from uwb_mitigation.mitigation.model.bundle import Bundle, Session
from uwb_mitigation.mitigation.model.floating import float_network
from uwb_mitigation.mitigation.model.linear_bias import LinearBiasModel
from uwb_mitigation.mitigation.model.weights import FloatWeights
from uwb_mitigation.training.data import splits
from uwb_mitigation.training.data.dataset import Dataset
from uwb_mitigation.training.fit import linear_fit
from uwb_mitigation.training.fit.options import FitOptions
from uwb_mitigation.types.measurement import LINE_OF_SIGHT_DB

NEW_MODELS = CONSTANT, LINE, LINE_NETWORK, NETWORK = "constant", "line", "line+network", "network"
"""Models that are fitted to the data only."""

COLD_START = "cold start"

NETWORK_ONLY = FitOptions(epochs=20, learning_rate=1e-3, dropout=0.2)
"""Options of a network without a line: it needs more training than one that refines a line."""

PER_CONFIGURATION = 20
"""The network is fitted to at most this number of ranges of a configuration, so that a long recording of one placement does not
outweigh a short one."""

MIN_CONFIGURATIONS = 20
"""With fewer configurations, the universal network with an offset is preferred."""

_BATCH = 1024


@dataclass(frozen=True, slots=True, eq=False)
class FittedModel:
    """A linear bias model, and a network or None."""

    linear_bias: LinearBiasModel
    network: FloatWeights | None = None

    def correction_m(self, data: Dataset) -> NDArray[np.float64]:
        """Return linear bias + network, shape (n,), m; 0 where a power that the linear bias model needs is unknown."""
        predicted = linear_bias_m(self.linear_bias, data).astype(np.float64)
        if self.network is not None:
            predicted = predicted + network_m(self.network, data.inputs)
        return np.where(np.isfinite(predicted), predicted, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A candidate model.

    Attributes:
        name: Name in tables.
        fit: fits the model to a dataset, with a seed.
        trains: whether it trains a network. Such a model is kept only if the nested error shows a gain.
    """

    name: str
    fit: Callable[[Dataset, int], FittedModel]
    trains: bool = False


@dataclass(frozen=True, slots=True)
class Recipe:
    """Options for fitting a new model; they are recorded in the card.

    Attributes:
        architecture: Architecture of the network.
        fit: options of a network that refines a line. network_only: options of a network without a line.
        line: fit a line; otherwise the network predicts the whole error.
        network: fit the network; otherwise it predicts 0. With neither, the linear bias model is a constant.
    """

    architecture: Remnet
    fit: FitOptions
    network_only: FitOptions = NETWORK_ONLY
    line: bool = True
    network: bool = True

    def for_candidate(self, name: str) -> Recipe:
        """Return the recipe of one of `NEW_MODELS`."""
        network = name in (LINE_NETWORK, NETWORK)
        options = self.network_only if name == NETWORK else self.fit
        return replace(self, line=name in (LINE, LINE_NETWORK), network=network, fit=options)


def linear_bias_m(linear_bias: LinearBiasModel, data: Dataset) -> NDArray[np.float32]:
    """Return the prediction of a linear bias model, shape (n,), m; NaN where it needs a power that is unknown."""
    needs_gap = linear_bias.per_power_gap != 0.0
    first_path = data.first_path_power_dbm if needs_gap else data.rx_power_dbm
    return linear_bias.predict_m(data.rx_power_dbm, first_path)


def network_m(network: FloatWeights, inputs: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the prediction of a network, shape (n,), m. ONNX Runtime is much faster than NumPy."""
    session = Session(graph.float_model(network))
    starts = range(0, len(inputs), _BATCH)
    outputs = [session.predict_m(inputs[start : start + _BATCH]) for start in starts]
    return np.concatenate(outputs).astype(np.float64)


def fit_new_model(
    data: Dataset, recipe: Recipe, seed: int, on_epoch: Callable[[], None] = lambda: None
) -> FittedModel:
    """Fit a new model. Without a network, it contains the initial network, which predicts 0.

    Raises:
        DatasetError: see `fitting.fit`.
    """
    from uwb_mitigation.training.fit import fitting, networks

    linear_bias = LinearBiasModel(0.0)
    if recipe.line:
        linear_bias = fit_line(data)
    elif not recipe.network:
        linear_bias = _constant(data)
    if not recipe.network:
        with fitting.single_thread(seed):
            return FittedModel(linear_bias, networks.weights_of(networks.Network(recipe.architecture, 0.0)))
    subset = data.rows(splits.subsample(data.configurations, PER_CONFIGURATION, seed))
    residual = subset.error_m - linear_bias_m(linear_bias, subset)
    # If the linear bias model needs a power that is unknown, the range is passed through.
    rows, options = np.isfinite(residual), replace(recipe.fit, seed=seed)
    network = fitting.fit(recipe.architecture, subset.inputs[rows], residual[rows], options, on_epoch)
    return FittedModel(linear_bias, network)


def _constant(data: Dataset) -> LinearBiasModel:
    """Fit a constant: to configurations, or without CIRs to single ranges."""
    # Each range counts as a configuration.
    configurations = data.configurations if data.has_cirs else np.arange(len(data)).astype(str)
    return linear_fit.fit_constant(configurations, data.error_m)


def fit_line(data: Dataset) -> LinearBiasModel:
    """Fit a line in both powers: to configurations (see `linear_fit`), or without CIRs to single ranges."""
    if not data.has_cirs:
        # Ranges of one pair at one distance are not independent.
        true_m = np.round(data.range_m - data.error_m, 1)
        assert data.tags is not None
        assert data.anchors is not None
        cells = zip(data.configurations, true_m, data.tags, data.anchors, strict=True)
        names = np.array(["/".join(map(str, cell)) for cell in cells])
        rows = data.rows(splits.subsample(names, PER_CONFIGURATION, 0))
        gap = rows.rx_power_dbm - rows.first_path_power_dbm
        is_los = np.where(rows.labels == "", gap < LINE_OF_SIGHT_DB, rows.labels == "LOS")
        return linear_fit.fit_linear_bias_to_rows(
            rows.rx_power_dbm, rows.first_path_power_dbm, rows.error_m, is_los.astype(np.bool_)
        )
    return linear_fit.fit_linear_bias(
        data.configurations, data.rx_power_dbm, data.first_path_power_dbm, data.error_m
    )


def _with_offset(network: FloatWeights, data: Dataset, seed: int) -> FittedModel:
    """Return a network with an offset of the data."""
    return FittedModel(
        linear_fit.fit_constant(data.configurations, data.error_m - network_m(network, data.inputs)), network
    )


def new_models(recipe: Recipe) -> list[Candidate]:
    """Return a constant, a line, a network on the residuals of the line, and a network without a line."""

    def network(name: str) -> Candidate:
        return Candidate(
            name, lambda data, seed: fit_new_model(data, recipe.for_candidate(name), seed), trains=True
        )

    return [
        Candidate(CONSTANT, lambda data, seed: FittedModel(_constant(data))),
        Candidate(LINE, lambda data, seed: FittedModel(fit_line(data))),
        network(LINE_NETWORK),
        network(NETWORK),
    ]


def with_cold_start(candidates: Sequence[Candidate], data: Dataset, universal: Bundle) -> list[Candidate]:
    """Add the universal network with an offset of the data, if the data is preprocessed for it.

    With few configurations it is the first candidate, so that it is preferred, otherwise it follows the constant.
    """
    added = list(candidates)
    if data.preprocessing == universal.card.preprocessing:
        start = partial(_with_offset, float_network(universal))
        place = 0 if has_few_configurations(data) else [item.name for item in added].index(CONSTANT) + 1
        added.insert(place, Candidate(COLD_START, start))
    return added


def has_few_configurations(data: Dataset) -> bool:
    """Whether the cold start is preferred because there are few configurations."""
    return len(data.names) < MIN_CONFIGURATIONS
