"""Structured pruning (paper, section II-B): whole filters are dropped, and what is left is a smaller REMNet.

Residual sums tie channels together: the outputs of `first` and `module1.residual` are one set of channels, those
of `module1.reduce`, `module1.skip` and `module2.residual` the next, and so on. The same number is kept of each
set, so that the result is a `Remnet` with fewer filters, which everything else can export and run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwb_mitigation.errors import ModelError, ParameterError
from uwb_mitigation.evaluation.metrics import ErrorStatistics
from uwb_mitigation.model import floating, graph
from uwb_mitigation.model.architecture import HEAD, Remnet
from uwb_mitigation.model.bundle import Bundle, save_bundle
from uwb_mitigation.model.weights import FloatWeights
from uwb_mitigation.training import experiment
from uwb_mitigation.training.fitting import fit
from uwb_mitigation.training.options import FitOptions
from uwb_mitigation.training.parts import Parts


def prune(weights: FloatWeights, filters: int) -> FloatWeights:
    """`weights` with the `filters` strongest channels of each set.

    A channel's strength is the L2 norm of the filters that write it, each in units of its layer's mean.

    Raises:
        ModelError: the network is not a REMNet.
        ParameterError: not fewer filters than there are.
    """
    shape = weights.architecture
    if not isinstance(shape, Remnet):
        raise ModelError("only a REMNet can be pruned", valid="a bundle of a REMNet")
    if not 1 <= filters < shape.filters:
        raise ParameterError(f"filters = {filters}", valid=f"1 to {shape.filters - 1}")
    kept = [np.sort(np.argsort(-_strength(weights, names))[:filters]) for names in _writers(shape)]
    weight, bias = {}, {}
    for number, (read, written) in enumerate(_sets(shape)):
        name = shape.convolutions[number].name
        values = weights.weight[name][kept[written]]
        weight[name] = np.ascontiguousarray(values if read is None else values[:, kept[read]])
        bias[name] = weights.bias[name][kept[written]]
    head = weights.weight[HEAD].reshape(shape.filters, -1)[kept[-1]]
    weight[HEAD], bias[HEAD] = head.reshape(-1, 1).copy(), weights.bias[HEAD].copy()
    return FloatWeights(replace(shape, filters=filters), weight, bias)


@dataclass(frozen=True, slots=True, eq=False)
class Pruned:
    """Attributes:
    bundle: as it was written.
    mae_m: on the test part, {`before`, `pruned`, `tuned`: MAE}.
    before: the architecture that was pruned.
    """

    bundle: Bundle
    mae_m: Mapping[str, float]
    before: Remnet


def prune_bundle(
    source: Bundle,
    parts: Parts,
    filters: int,
    options: FitOptions,
    output: Path,
    on_epoch: Callable[[], None] = lambda: None,
) -> Pruned:
    """Prune a float bundle, train what is left on the training part, tell its error on the test part, and write it.

    Raises:
        ModelError: the source is quantised, no REMNet, or may have been fitted to the test part.
        ParameterError: see `prune`. DatasetError: see `fit`.
    """
    if source.quantised:
        raise ModelError("already quantised", where=str(source.path), valid="the float bundle it was made of")
    weights = graph.float_weights(source.model, source.architecture)
    smaller = prune(weights, filters)
    _check_trained_on(source, parts)
    train, test = parts.train, parts.test
    tuned = fit(smaller.architecture, train.inputs, train.error_m, options, on_epoch, start=smaller)
    networks = {"before": weights, "pruned": smaller, "tuned": tuned}
    found = {"raw": ErrorStatistics.of(test.error_m)} | {
        row: ErrorStatistics.of(test.error_m - floating.predict_m(network, test.inputs))
        for row, network in networks.items()
    }
    card = experiment.describe(output.stem, tuned.architecture, parts, options)
    training = {
        **card.training,
        "pruned": {
            "name": source.name,
            "from": f"{source.model_id:08x}",
            "architecture": asdict(weights.architecture),
            "recipe": source.card.training.get("recipe"),
        },
        "metrics_m": {
            row: {key: round(value, 4) for key, value in asdict(found[of]).items()}
            for row, of in (("raw", "raw"), ("float", "tuned"))
        },
    }
    bundle = save_bundle(output, graph.float_model(tuned), replace(card, training=training))
    assert isinstance(weights.architecture, Remnet)
    return Pruned(bundle, {row: found[row].mae for row in networks}, weights.architecture)


def _check_trained_on(source: Bundle, parts: Parts) -> None:
    """Refuse a bundle that may have been fitted to the test part."""
    here = {
        "data": parts.data,
        "split": parts.split,
        "measurements": len(parts.train),
        "tested_on": len(parts.test),
    }
    trained = {key: source.card.training.get(key) for key in here}
    if trained != here:
        differ = "; ".join(
            f"{key} {trained[key]}, not {here[key]}" for key in here if trained[key] != here[key]
        )
        raise ModelError(
            f"trained on other data than the training part, which leaves nothing to test on: {differ}",
            where=str(source.path),
            valid="a bundle of `protocol`, with its --data and --split",
        )


def _sets(shape: Remnet) -> list[tuple[int | None, int]]:
    """For each convolution, in order: the set of channels that it reads, and the one that it writes."""
    sets: list[tuple[int | None, int]] = [(None, 0)]
    for module in range(shape.modules):
        sets += [(module, module), (module, module + 1), (module, module + 1)]
    return sets


def _writers(shape: Remnet) -> list[list[str]]:
    """For each set of channels, the convolutions that write it."""
    writers: list[list[str]] = [[] for _ in range(shape.modules + 1)]
    for layer, (_, written) in zip(shape.convolutions, _sets(shape), strict=True):
        writers[written].append(layer.name)
    return writers


def _strength(weights: FloatWeights, names: list[str]) -> NDArray[np.float64]:
    norms = [np.sqrt((weights.weight[name].astype(np.float64) ** 2).sum(axis=(1, 2))) for name in names]
    total: NDArray[np.float64] = np.sum([norm / max(norm.mean(), 1e-12) for norm in norms], axis=0)
    return total
